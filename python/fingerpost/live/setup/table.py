"""The working plane in the views: detected references, expected errors, and problems.

References are detected by the functions of `fingerpost init`, errors are predicted by those of
`fingerpost advise`, and problems are found by those of `fingerpost doctor`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from fingerpost.advise import AdviceOptions, Concern, advise
from fingerpost.config import (
    FixedReference,
    MarkersReference,
    Plane,
    RectangleReference,
    Rig,
    Start,
    View,
)
from fingerpost.doctor import examine
from fingerpost.errors import FingerpostError, InvalidInputError
from fingerpost.formats import SIZES_MM, corners_of, sides_of
from fingerpost.live.scene import RigScene
from fingerpost.live.setup.asked import Arrange, Chosen, Pair
from fingerpost.live.setup.offers import Offer, Offers
from fingerpost.live.setup.wording import page_words
from fingerpost.locating import ReferenceSearch, absence
from fingerpost.pipeline import DEFAULT_REFERENCE_SIGMA_PX, Pointer
from fingerpost.recognition import likelier_size, shows_markers
from fingerpost.references import size_scores
from fingerpost.setting_up import MARKERS, UNIT, reference_of
from fingerpost.uncertainty import largest_sigma

MAT = "400x400"
"""Assumed size of a square until the user states another."""

GUESSED = ("A4", "credit-card", MAT)
"""Planes that can be distinguished by their aspect ratios in pictures, the most usual first: letter
and A3 are too similar to A4."""

UNCHANGED_PX = 0.05
"""Greatest distance at which a point returned by a page is still the detected one."""

# A resolution sufficient for a map, in a third of a second.
_ADVICE = AdviceOptions(cells=5, sectors=12, samples=40)
_EXPECTED = (Concern.FOCAL_LENGTH,)  # applies to nearly every camera, without a remedy
_MOST_WORDS = 5

Covariance = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Points:
    """The reference points of one view.

    Attributes
    ----------
    points_px
        (u, v) of each; empty if unknown.
    covariances_px2
        (uu, uv, vv) of each; None if a person placed one of them.
    """

    points_px: tuple[Pair, ...] = ()
    covariances_px2: tuple[Covariance, ...] | None = None

    @property
    def sigma_px(self) -> float:
        """Greatest standard deviation of any point in any direction."""
        if self.covariances_px2 is None:
            return DEFAULT_REFERENCE_SIGMA_PX
        matrices = (np.array([[uu, uv], [uv, vv]]) for uu, uv, vv in self.covariances_px2)
        return max(map(largest_sigma, matrices))

    def as_dict(self) -> dict[str, Any]:
        """Return them as JSON values."""
        return {
            "points": [[round(u, 2), round(v, 2)] for u, v in self.points_px],
            "sigma": round(self.sigma_px, 3) if self.points_px else None,
            "found": self.covariances_px2 is not None,
        }


@dataclass(eq=False, slots=True)
class Table:
    """Present views and plane.

    Attributes
    ----------
    plane
        Reference on the table, as parsed by `reference_of`.
    chosen
        The views that a page has chosen.
    points
        Their reference points.
    missing
        Missing reference and remedy, by view.
    number
        Number of the last arrangement.
    """

    plane: str = ""
    chosen: tuple[Chosen, ...] = ()
    points: list[Points] = field(default_factory=list)
    missing: dict[int, str] = field(default_factory=dict)
    number: int = 0

    @property
    def is_complete(self) -> bool:
        """Whether there are two views or more, and all have points."""
        return len(self.chosen) >= 2 and all(each.points_px for each in self.points)

    def arrange(self, wanted: Arrange, offers: Offers) -> None:
        """Set views and plane from a page; search for missing references if requested.

        Raises
        ------
        InvalidInputError
            A view that is not offered, or an invalid plane.
        """
        self.number = wanted.number
        for view in wanted.views:
            if not 0 <= view.offer < len(offers) or offers[view.offer].problem:
                raise InvalidInputError(f"view {view.offer} is none of those that are offered")
            if view.points_px and len(view.points_px) != 4:
                raise InvalidInputError(
                    f"{len(view.points_px)} reference points; the four corners are needed"
                )
        if wanted.plane:
            reference_of(wanted.plane)  # refuses an invalid one
        before = {view.offer: points for view, points in zip(self.chosen, self.points, strict=True)}
        is_same_kind = wanted.plane.startswith(MARKERS) == self.plane.startswith(MARKERS)
        self.chosen = wanted.views
        self.points = [
            _kept(view, before.get(view.offer), is_same_kind=is_same_kind) for view in wanted.views
        ]
        self.plane = wanted.plane or self.plane
        self.missing = {}
        if wanted.finds:
            self._find(offers)

    def _find(self, offers: Offers) -> None:
        pictures = {
            k: image
            for k, view in enumerate(self.chosen)
            if (image := offers[view.offer].image) is not None
        }
        if not pictures:
            return
        self.plane = self.plane or guessed(list(pictures.values()))
        rig = _open_rig(self.plane, self.chosen, self.points, offers)
        search = ReferenceSearch(rig, images=1)
        found = search.look(pictures)
        self.missing = {k: absence(rig.views[k]) for k in search.missing}
        if self.missing and len(self.missing) < len(rig.views):
            # Use the views that do show it.
            shown = [k for k in range(len(rig.views)) if k not in self.missing]
            part = structs.replace(rig, views=tuple(rig.views[k] for k in shown))
            found = ReferenceSearch(part, images=1).look(
                {i: pictures[k] for i, k in enumerate(shown)}
            )
            self._take(shown, found)
        else:
            self._take(range(len(rig.views)), found)

    def _take(self, places: Sequence[int], found: Rig | None) -> None:
        for k, view in zip(places, found.views if found is not None else (), strict=False):
            if not self.points[k].points_px:
                self.points[k] = Points(
                    tuple((u, v) for u, v in view.reference_points_px),
                    view.reference_covariances_px2,
                )

    def rig(self, offers: Offers) -> Rig:
        """Return the complete rig.

        Raises
        ------
        InvalidInputError
            `Pointer` refuses it; the message says why.
        """
        if not self.is_complete:
            raise InvalidInputError("two views or more are needed, with four corners in each")
        reference = reference_of(self.plane)
        views = tuple(
            View(
                name=offers[view.offer].name,
                source=offers[view.offer].source,
                size_px=offers[view.offer].size_px,
                reference_points_px=points.points_px,
                reference_covariances_px2=points.covariances_px2,
                reference=reference if points.covariances_px2 is not None else FixedReference(),
                start=_start(view),
            )
            for view, points in zip(self.chosen, self.points, strict=True)
        )
        plane = Plane(unit=UNIT, points=corners_of(sides_of(reference.size, UNIT)))
        rig = Rig(plane=plane, views=views)
        Pointer(rig)  # refuses an unusable rig
        return rig

    def as_dict(self) -> dict[str, Any]:
        """Return it as JSON values."""
        sides = sides_of(reference_of(self.plane).size, UNIT) if self.plane else None
        return {
            "plane": self.plane,
            "sides": sides,
            "number": self.number,
            "views": [
                {"offer": view.offer, **points.as_dict(), "missing": self.missing.get(k, "")}
                for k, (view, points) in enumerate(zip(self.chosen, self.points, strict=True))
            ],
        }


def _kept(view: Chosen, before: Points | None, *, is_same_kind: bool) -> Points:
    """Return a view's points: the detected ones, unless a person has moved one of them."""
    if not view.points_px or before is None or before.covariances_px2 is None:
        return Points(view.points_px)
    off_px = np.abs(np.subtract(view.points_px, before.points_px)).max()
    return before if off_px < UNCHANGED_PX and is_same_kind else Points(view.points_px)


def _start(view: Chosen) -> Start | None:
    held = view.held
    if held is None:
        return None
    return Start(
        tip_px=held.tip_px,
        angle_deg=held.angle_deg,
        length_px=held.length_px,
        thumb=held.thumb,
    )


def _open_rig(
    plane: str, chosen: Sequence[Chosen], points: Sequence[Points], offers: Offers
) -> Rig:
    """Return a rig in which the references of views without points must be detected."""
    reference: RectangleReference | MarkersReference = reference_of(plane)
    views = tuple(
        View(
            name=offers[view.offer].name,
            source=offers[view.offer].source,
            reference_points_px=known.points_px,
            reference=FixedReference() if known.points_px else reference,
        )
        for view, known in zip(chosen, points, strict=True)
    )
    return Rig(
        plane=Plane(unit=UNIT, points=corners_of(sides_of(reference.size, UNIT))), views=views
    )


def guessed(pictures: Sequence[NDArray[np.uint8]]) -> str:
    """Return the most likely reference on the table, as parsed by `reference_of`.

    A sheet of markers is recognised in any picture. Rectangles are recognised by their aspect
    ratio in all pictures together; their size is the usual one of that shape.
    """
    if any(map(shows_markers, pictures)):
        return MARKERS
    sizes = [sides_of(reference_of(plane).size, UNIT) for plane in GUESSED]
    scores = np.array([size_scores(picture, sizes) for picture in pictures])
    if not scores.any():
        return GUESSED[0]
    return GUESSED[int(np.argmax(np.log(np.maximum(scores, 1.0)).sum(axis=0)))]


def planes() -> list[str]:
    """Return the named planes, and the square."""
    names = {"a4": "A4", "a3": "A3"}
    return [*(names.get(name, name) for name in SIZES_MM), MAT, MARKERS]


@dataclass(frozen=True, slots=True)
class Words:
    """A message on the set-up, for the user.

    Attributes
    ----------
    severity
        "error" if it prevents pointing, "warning" if it reduces accuracy, "advice" for a possible
        improvement.
    view
        Name of the view; empty for all.
    text
        The problem and its remedy.
    """

    severity: str
    view: str
    text: str


def scene_of_plane(rig: Rig) -> dict[str, Any]:
    """Return the plan of a rig's plane, in the format of the live page, as JSON values."""
    pointer = Pointer(rig)
    return RigScene.of(
        "", rig.plane.unit, pointer.plane_views, rig.sources, is_live=False, frames=None
    ).as_dict()


def judged(rig: Rig, offers: Sequence[Offer]) -> tuple[dict[str, Any] | None, list[Words]]:
    """Return the expected errors, as JSON values, and the problems, the gravest first.

    Parameters
    ----------
    rig
        Rig from `Table.rig`.
    offers
        Offers of its views.
    """
    frames = [list(offer.frames) for offer in offers]
    words = [
        Words(found.severity.value, found.view, page_words(f"{found.what}; {found.right}"))
        for found in examine(structs.replace(rig, views=_without_starts(rig)), frames).findings
    ]
    words += _better_planes(rig, [frame.image for *_, frame in filter(None, frames)])
    try:
        advice = advise(rig, [offer.size_px for offer in offers], _ADVICE)
    except FingerpostError as error:
        return None, [*words, Words("error", "", page_words(str(error)))]
    words += [
        Words("warning", flag.view, page_words(flag.text))
        for flag in advice.flags
        if flag.concern not in _EXPECTED
    ]
    if advice.recommended is not None:
        words.append(Words("advice", "", advice.recommendation))
    half = advice.cell_size / 2.0
    return {
        "unit": advice.unit,
        "half": half,
        "cells": [
            [*np.round(cell.middle, 2).tolist(), _rounded(cell.figures.percentile_95)]
            for cell in advice.cells
        ],
        "median": _rounded(advice.expected.median),
        "most": _rounded(advice.expected.percentile_95),
    }, words[:_MOST_WORDS]


def _better_planes(rig: Rig, pictures: Sequence[NDArray[np.uint8]]) -> Iterator[Words]:
    """Yield what else than the chosen rectangle lies on the table, if it was found as one."""
    references = [view.reference for view in rig.views]
    sizes = [one.size for one in references if isinstance(one, RectangleReference)]
    if not len(sizes) == len(pictures) == len(rig.views):
        return
    if all(map(shows_markers, pictures)):
        yield Words("warning", "", "every view shows a sheet of markers; choose it above")
    elif isinstance(sizes[0], str):
        quads = [np.array(view.reference_points_px, np.float64) for view in rig.views]
        better = likelier_size(sizes[0], quads, [picture.shape for picture in pictures])
        if better is not None:
            text = f"the sides fit {better} better than {sizes[0]}; measure it, and choose above"
            yield Words("warning", "", text)


def _without_starts(rig: Rig) -> tuple[View, ...]:
    """Return the views without their templates: the hand is a separate step."""
    return tuple(structs.replace(view, start=None) for view in rig.views)


def _rounded(error: float) -> float | None:
    """Round an error for display; None if no error can be predicted."""
    return float(f"{error:.3g}") if math.isfinite(error) else None
