"""Detects references whose pixels the rig does not give, in the first frames of its views.

Every view proposes quadrilaterals that may be the rectangle. All views together determine which of
them it is and the order of its corners: rectified to the plane, the views show the same table,
whose texture matches only if all begin at the same corner. If the table has too little texture, the
cameras are assumed to stand on the same side of it. A plane seen from above is never mirrored.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from fingerpost.config import (
    FixedReference,
    MarkersReference,
    RectangleReference,
    Rig,
    ScreenReference,
    View,
)
from fingerpost.consistency import Scenery
from fingerpost.homography import transfer_jacobian_by_point
from fingerpost.pointing import PlaneView
from fingerpost.references import (
    LEAST_LIKENESS,
    Candidate,
    MarkersMeter,
    Measured,
    Meter,
    RectangleMeter,
    Sides,
    find_rectangles,
    likeness,
    signed_area,
    turned,
)

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]

SIDE_WEIGHT = 0.5
"""Weight of the log-likelihood of a quadrilateral in its own view, relative to the correlation of
two views' textures."""

UPRIGHT_WEIGHT = 0.15
"""Weight, likewise, of the cosine of the angle between the upward directions of two cameras."""

SEARCHED_IMAGES = 3
"""Images of a view in which a rectangle is searched, unless its outline shows throughout: noise
breaks a side in one image and not in the next, and then a line of the table may take its place."""

WHOLE = 0.8
"""Least score relative to the length of an outline for which a rectangle shows throughout, and has
the right shape. Sheets on wood have 0.92 and more, quadrilaterals of its grain 0.71 at most."""

LOOK_EVERY = 16
"""While a reference is missing after that, the frames searched are those whose number is a power of
two or a multiple of this."""


@dataclass(frozen=True, eq=False)
class Placed:
    """Possible image of the plane's points in one view.

    Attributes
    ----------
    measured
        The points, in their order.
    score
        Log-likelihood in its own view, up to a constant.
    """

    measured: Measured
    score: float


class ReferenceSearch:
    """Searches the first frames of a rig's views for their references.

    Parameters
    ----------
    rig
        One view or more, with references to be detected.
    images
        Number of images of every view in which a rectangle is searched, ≥ 1; the best result
        counts. One that shows throughout ends the search.

    Attributes
    ----------
    candidates
        Rectangles in the best image of each view, best score first, by index of the view.
    """

    def __init__(self, rig: Rig, *, images: int = SEARCHED_IMAGES) -> None:
        self._rig = rig
        self._images = images
        self.candidates: dict[int, list[Candidate]] = {}
        self._places: dict[int, list[Placed]] = {}
        self._scores: dict[int, float] = {}
        self._decided: set[int] = set()
        self._pictures: dict[int, Picture] = {}
        self._rounds = self._searched = 0

    @staticmethod
    def is_needed(rig: Rig) -> bool:
        """Return whether a rig has references that must be detected."""
        return any(is_open(view) for view in rig.views)

    def look(self, pictures: Mapping[int, Picture]) -> Rig | None:
        """Search images of some views, given by the view's index in the rig.

        Parameters
        ----------
        pictures
            (H, W) or (H, W, 3).

        Returns
        -------
        Rig or None
            The rig with the reference points of all views and their covariances; None while one is
            missing or may be found better.
        """
        self._rounds += 1
        has_looked = self._searched >= self._images
        if has_looked and self._rounds & (self._rounds - 1) and self._rounds % LOOK_EVERY:
            return None
        self._searched += 1
        for k, picture in pictures.items():
            view = self._rig.views[k]
            if not is_open(view):
                self._pictures.setdefault(k, picture.copy())
            elif k not in self._decided:
                self._search(k, view, picture)
        is_decided = self._searched >= self._images or not self.undecided
        return self.agreed() if is_decided else None

    def agreed(self) -> Rig | None:
        """Return the rig by the images so far; None while a reference is missing."""
        return None if self.missing else self._agreed()

    @property
    def missing(self) -> dict[int, str]:
        """Description of each missing reference and of the remedy, by index of the view."""
        return {
            k: f'view "{view.name}": {absence(view)}{_given_instead(view)}'
            for k, view in enumerate(self._rig.views)
            if is_open(view) and k not in self._places
        }

    @property
    def undecided(self) -> dict[int, str]:
        """Reason for which the best image of a rectangle is still sought, by index of the view."""
        return {
            k: f'view "{self._rig.views[k].name}": a part of its rectangle does not show; '
            f"{self._images} images are compared"
            for k in self._places.keys() - self._decided
        }

    def _search(self, k: int, view: View, picture: Picture) -> None:
        """Search a view's reference in an image, and keep the best result."""
        if isinstance(view.reference, RectangleReference):
            near = view.reference_points_px or view.reference.corners_px or view.reference.near_px
            near_px = None if near is None else np.array(near, np.float64)
            found = find_rectangles(picture, sides_of_plane(self._rig), view.lens, near_px)
            if not found or found[0].score <= self._scores.get(k, 0.0):
                return
            self._scores[k], self.candidates[k] = found[0].score, found
            self._places[k] = self._rectangles(found, near_px, picture)
            if shows_throughout(found[0]):
                self._decided.add(k)
        else:
            measured = meter_of(self._rig, view).search(picture, np.zeros((4, 2)))
            if measured is None:
                return
            self._places[k] = [Placed(measured, 0.0)]
            self._decided.add(k)
        self._pictures[k] = picture.copy()

    def _rectangles(
        self, found: Sequence[Candidate], near_px: Array | None, picture: Picture
    ) -> list[Placed]:
        """Return every order of the corners of every candidate."""
        size, clockwise = sides_of_plane(self._rig), self._is_clockwise()
        places = []
        for candidate in found:
            score = SIDE_WEIGHT * math.log(candidate.score / found[0].score)
            if near_px is not None and near_px.ndim == 2:
                best = min(
                    (
                        sides
                        for way in (False, True)
                        for sides in turned(candidate.sides, clockwise=way)
                    ),
                    key=lambda sides: np.abs(sides.corners_px - near_px).max(),
                )
                places.append(_placed(best, score))
                continue
            for sides in turned(candidate.sides, clockwise=clockwise):
                like = likeness(sides.corners_px, size, picture.shape)
                total = score + SIDE_WEIGHT * math.log(max(like, LEAST_LIKENESS))
                places.append(_placed(sides, total))
        return places

    def _is_clockwise(self) -> bool:
        """Return whether the plane's points run clockwise in the images, as any given ones do."""
        for view in self._rig.views:
            given = view.reference_points_px or getattr(view.reference, "corners_px", None)
            if given:
                return bool(signed_area(np.array(given, np.float64)) > 0.0)
        return bool(signed_area(np.array(self._rig.plane.points)) < 0.0)

    def _agreed(self) -> Rig:
        """Choose the most likely combination of one place per view.

        Cameras are assumed to stand upright, or to have similar upward directions.
        """
        rig = self._with({k: places[0] for k, places in self._places.items()})
        views = list(range(len(rig.views)))
        pictures = [self._pictures[k] for k in views]
        scenery = Scenery(rig, pictures)
        options = [self._places.get(k, []) or [_as_given(rig.views[k])] for k in views]
        ups = [[self._up(one.measured.points_px) for one in places] for places in options]
        anchor = next((k for k in views if not is_open(self._rig.views[k])), 0)
        best: dict[int, Placed] = {}
        most = -math.inf
        for first, first_up in zip(options[anchor], ups[anchor], strict=True):
            total = first.score + UPRIGHT_WEIGHT * float(first_up[1])
            chosen = {anchor: first}
            for k in views:
                if k == anchor:
                    continue
                scores = [
                    one.score
                    + scenery.agreement_of(
                        {anchor: first.measured.points_px, k: one.measured.points_px}, (anchor, k)
                    )
                    + UPRIGHT_WEIGHT * float(up @ first_up)
                    for one, up in zip(options[k], ups[k], strict=True)
                ]
                chosen[k] = options[k][int(np.argmax(scores))]
                total += max(scores)
            if total > most:
                best, most = chosen, total
        return self._with({k: best[k] for k in self._places})

    def _up(self, corners_px: Array) -> Array:
        """Return the direction on the plane that points upwards in the image."""
        view = PlaneView.from_reference_points(self._rig.plane.points, corners_px, None)
        centre = view.plane_points.mean(axis=0)
        by_plane = transfer_jacobian_by_point(view.image_from_plane, centre)
        up = np.linalg.solve(by_plane, [0.0, -1.0])
        return np.asarray(up / np.linalg.norm(up))

    def _with(self, places: Mapping[int, Placed]) -> Rig:
        views = list(self._rig.views)
        for k, place in places.items():
            views[k] = structs.replace(
                views[k],
                reference_points_px=tuple((u, v) for u, v in place.measured.points_px.tolist()),
                reference_covariances_px2=tuple(
                    (uu, uv, vv) for (uu, uv), (_, vv) in place.measured.covariances_px2.tolist()
                ),
            )
        return structs.replace(self._rig, views=tuple(views))


def shows_throughout(candidate: Candidate) -> bool:
    """Return whether all of a candidate's outline has an edge, and it is the rectangle's shape."""
    return bool(candidate.score >= WHOLE * candidate.sides.seen_px.sum())


def is_open(view: View) -> bool:
    """Return whether a view's references must be detected: it has no covariances of them."""
    return not isinstance(view.reference, FixedReference) and (
        not view.reference_points_px or view.reference_covariances_px2 is None
    )


def meter_of(rig: Rig, view: View) -> Meter:
    """Return the meter for the references of a view that are detected, not given."""
    reference, size = view.reference, sides_of_plane(rig)
    if isinstance(reference, MarkersReference | ScreenReference):
        points = np.array(rig.plane.points, np.float64)
        return MarkersMeter(size, reference.sheet, points, view.lens)
    return RectangleMeter(size, view.lens)


def _placed(sides: Sides, score: float) -> Placed:
    return Placed(Measured(sides.corners_px, sides.covariance), score)


def _as_given(view: View) -> Placed:
    corners_px = np.array(view.reference_points_px, np.float64)
    return Placed(Measured(corners_px, np.eye(corners_px.size)), 0.0)


def sides_of_plane(rig: Rig) -> tuple[float, float]:
    """Return the lengths of the plane's first two sides."""
    points = np.array(rig.plane.points[:4])
    first, second = np.linalg.norm(np.diff(points, axis=0), axis=1)[:2].tolist()
    return first, second


def absence(view: View) -> str:
    """Return which reference of a view is not found, and what it needs to be."""
    reference = view.reference
    if isinstance(reference, RectangleReference):
        size = f"{reference.size} rectangle" if isinstance(reference.size, str) else "rectangle"
        return (
            f"no {size} is found; all four of its sides must show in part, plainly "
            "lighter or darker than what is around"
        )
    sheet = getattr(reference, "sheet", 1)
    return (
        f"no marker of sheet {sheet} is found; one must show whole with its white margin, "
        "20 px wide or more, flat and without glare (`fingerpost markers` writes the sheet)"
    )


def _given_instead(view: View) -> str:
    """Return how a rig file states what is not detected."""
    is_rectangle = isinstance(view.reference, RectangleReference)
    return ", or name its corners as corners_px" if is_rectangle else ""


def stand_in(rig: Rig) -> Rig:
    """Return a rig with placeholders for the reference points that must be detected.

    The placeholders correspond to no image; they only allow the views to be constructed.
    """
    points = np.array(rig.plane.points, np.float64)
    lower, upper = points.min(axis=0), points.max(axis=0)
    parts = (points - lower) / np.where(upper > lower, upper - lower, 1.0)
    # Seen from above: Y points upwards in the image.
    shown = tuple((100.0 + 400.0 * x, 400.0 - 300.0 * y) for x, y in parts.tolist())
    views = tuple(
        structs.replace(view, reference_points_px=shown, reference_covariances_px2=None)
        if is_open(view)
        else view
        for view in rig.views
    )
    return structs.replace(rig, views=views)
