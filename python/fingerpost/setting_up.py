"""From cameras or films to a rig: detection of references and hand in all views.

References and hand are searched as in a run; the search stops as soon as both are found.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from fingerpost.capture import Frame, Loss, is_url, resolve_source
from fingerpost.config import MarkersReference, Pair, Plane, RectangleReference, Rig, View
from fingerpost.errors import FingerpostError, InvalidInputError
from fingerpost.formats import NAMES, SIZES_MM, UNITS_MM, Size, corners_of, sides_of
from fingerpost.locating import ReferenceSearch, shows_throughout
from fingerpost.pipeline import Pointer, Step, steps
from fingerpost.pointing import FingerLine, Status
from fingerpost.recognition import likelier_size, shows_markers
from fingerpost.recording.picture import Composition
from fingerpost.references import Candidate, contains
from fingerpost.uncertainty import largest_sigma

UNIT = "mm"

MARKERS = "markers"
"""Name of a sheet of markers in a description of a reference."""

DEFAULT_FRAMES = 300
"""Number of frames of each view to search."""

SURE_FRAMES = 3
"""Consecutive frames with a fix that confirm a hand."""


class NotFoundError(FingerpostError):
    """A required object is not found: the message names it, the view, and what would help."""


@dataclass(frozen=True, eq=False)
class SetUp:
    """Result of the search.

    Attributes
    ----------
    rig
        The rig, with the reference points of all views and their covariances.
    picture
        (H, W, 3) The frames with the results drawn into them, blue-green-red.
    lines
        Description of the results in each view, for people.
    hints
        What else lies on the table than was stated, and how to state that.
    without_hand
        Names of the views in which no hand was seen.
    """

    rig: Rig
    picture: NDArray[np.uint8]
    lines: tuple[str, ...]
    hints: tuple[str, ...]
    without_hand: tuple[str, ...]


def reference_of(words: str) -> RectangleReference | MarkersReference:
    """Parse a description of a reference: a rectangle, or "markers" and the paper's size.

    Parameters
    ----------
    words
        As for `plane_size`; "markers", for a sheet of A4, or such as "markers:letter".

    Raises
    ------
    InvalidInputError
        As `plane_size`.
    """
    kind, _, size = words.partition(":")
    if kind.lower() == MARKERS:
        return MarkersReference(size=plane_size(size or "A4"))
    return RectangleReference(size=plane_size(words, others=f"{MARKERS}, "))


def plane_size(words: str, others: str = "") -> Size:
    """Parse the size of a rectangle: its name, or its sides, in mm unless a unit follows.

    Parameters
    ----------
    words
        A name in `SIZES_MM`, or two lengths, as "350x220" or "35x22cm".
    others
        Further answers that would be right, for the message.

    Raises
    ------
    InvalidInputError
        Neither a name in `SIZES_MM` nor two lengths > 0, as "350x220".
    """
    if words.lower() in SIZES_MM:
        return words
    sides = re.fullmatch(r"\s*([\d.]+)\s*[x×*]\s*([\d.]+)\s*(\S*)\s*", words)
    try:
        if sides is not None:
            unit_mm = UNITS_MM[sides[3] or UNIT]
            return sides_of((float(sides[1]) * unit_mm, float(sides[2]) * unit_mm), UNIT)
    except (ValueError, KeyError):  # two dots, a side that is 0, or an unknown unit
        pass
    named = NAMES.partition(" or ")[0].replace('"', "")
    raise InvalidInputError(
        f'plane is "{words}"; needed: {named}, {others}or width and height in mm, such as 350x220'
    )


def rig_of(
    sources: Sequence[str | int],
    reference: RectangleReference | MarkersReference,
    near_px: Mapping[str, Pair] | None = None,
) -> Rig:
    """Return a rig whose references are still to be found.

    Parameters
    ----------
    sources
        Two or more sources, as in a rig file; relative paths start at the current directory.
    reference
        Reference on the table in all views, as returned by `reference_of`.
    near_px
        A pixel inside the rectangle, by view name.

    Raises
    ------
    InvalidInputError
        Fewer than two sources, or a name that no view has.
    """
    if len(sources) < 2:
        raise InvalidInputError(f"{len(sources)} source found; pointing needs two views or more")
    names = view_names(sources)
    near = dict(near_px or {})
    if unknown := set(near) - set(names):
        raise InvalidInputError(
            f"no view is called {', '.join(sorted(unknown))}; they are {', '.join(names)}"
        )
    views = tuple(
        View(
            name=name,
            source=resolve_source(source, Path.cwd()),
            reference=_near(reference, near.get(name)),
        )
        for name, source in zip(names, sources, strict=True)
    )
    return Rig(
        plane=Plane(unit=UNIT, points=corners_of(sides_of(reference.size, UNIT))), views=views
    )


def _near(
    reference: RectangleReference | MarkersReference, near_px: Pair | None
) -> RectangleReference | MarkersReference:
    if near_px is None:
        return reference
    if isinstance(reference, MarkersReference):
        raise InvalidInputError("near is for rectangles; markers have numbers")
    return structs.replace(reference, near_px=near_px)


def view_names(sources: Sequence[str | int]) -> list[str]:
    """Return unique names for the sources, from their files or folders, else by number."""
    files = [None if isinstance(s, int) or is_url(s) else Path(s) for s in sources]
    for name_of in (
        lambda path: path.stem,
        lambda path: path.parent.name,
        lambda path: f"{path.parent.name} {path.stem}",
    ):
        names = [
            f"camera {source}" if isinstance(source, int) else name_of(path) if path else ""
            for source, path in zip(sources, files, strict=True)
        ]
        if len(set(names)) == len(names) and all(
            n and n.isprintable() and "*" not in n for n in names
        ):
            return names
    return [f"view {k + 1}" for k in range(len(sources))]


def set_up(rig: Rig, frames: Iterator[Sequence[Frame | Loss | None]]) -> SetUp:
    """Find references and hand in the frames of all views.

    Parameters
    ----------
    rig
        As returned by `rig_of`.
    frames
        Frames to search; those after the hand was found are not read.

    Raises
    ------
    NotFoundError
        The references of a view are in none of its frames.
    """
    newest: dict[int, Frame] = {}
    frames = _noting(frames, newest)
    search = ReferenceSearch(rig)
    results = (
        search.look({k: one.image for k, one in enumerate(seen) if isinstance(one, Frame)})
        for seen in frames
    )
    found = next(filter(None, results), None) or search.agreed()  # the best one of a few images
    if found is None:
        pictures = [newest[k].image for k in sorted(newest)]
        reasons = search.missing.values() if newest else ["no frame could be read"]
        raise NotFoundError("; ".join([*reasons, *_marker_hints(rig, pictures)]))
    last = [newest.get(k) for k in range(len(rig.views))]
    pointer = Pointer(found)
    best = _best_step(pointer, chain([last], frames))
    return _set_up_from(pointer, best, search.candidates)


def _best_step(pointer: Pointer, frames: Iterable[Sequence[Frame | Loss | None]]) -> Step:
    """Return the first step that confirms a hand, or else the one with most finger lines."""
    best, most, in_a_row = None, -1, 0
    for step in steps(pointer, frames):
        count = sum(isinstance(seen.finger, FingerLine) for seen in step.observations)
        count += step.fix.status is Status.OK
        if count > most:
            best, most = step, count
        in_a_row = in_a_row + 1 if step.fix.status is Status.OK else 0
        if in_a_row == SURE_FRAMES:
            return step
    assert best is not None  # the first frames have images of all views
    return best


def _noting(
    frames: Iterator[Sequence[Frame | Loss | None]], newest: dict[int, Frame]
) -> Iterator[Sequence[Frame | Loss | None]]:
    """Yield frames, and note the newest one of each view."""
    for together in frames:
        newest.update({k: one for k, one in enumerate(together) if isinstance(one, Frame)})
        yield together


def _marker_hints(rig: Rig, pictures: Sequence[NDArray[np.uint8]]) -> list[str]:
    """Return a hint if a rectangle was stated and every view shows a sheet of markers."""
    reference = rig.views[0].reference
    if not isinstance(reference, RectangleReference) or len(pictures) < len(rig.views):
        return []
    if not all(map(shows_markers, pictures)):
        return []
    return ["every view shows a sheet of markers; --plane markers measures by it"]


def _size_hints(rig: Rig, pictures: Sequence[NDArray[np.uint8]]) -> list[str]:
    """Return a hint if another named size fits the sides of the rectangle clearly better."""
    reference = rig.views[0].reference
    if not isinstance(reference, RectangleReference) or len(pictures) < len(rig.views):
        return []
    size = reference.size
    if not isinstance(size, str):
        return []
    quads = [np.array(view.reference_points_px, np.float64) for view in rig.views]
    better = likelier_size(size, quads, [picture.shape for picture in pictures])
    if better is None:
        return []
    return [f"the sides fit {better} better than {size}; --plane {better} takes that size"]


def _other_rectangles(view: View, candidates: Sequence[Candidate]) -> list[Pair]:
    """Return the middles of rectangles beside the one found, unless a person chose it [px]."""
    if not isinstance(view.reference, RectangleReference) or view.reference.near_px is not None:
        return []
    chosen = np.array(view.reference_points_px, np.float64)
    middles = [one.sides.corners_px.mean(axis=0) for one in candidates if shows_throughout(one)]
    return [(u, v) for u, v in middles if not contains(chosen, np.array([u, v]))]


def _set_up_from(
    pointer: Pointer, best: Step, candidates: Mapping[int, Sequence[Candidate]]
) -> SetUp:
    rig, views = pointer.rig, [seen.plane_view for seen in best.observations]
    composition = Composition(pointer.plane_views, unit=rig.plane.unit)
    lines, without = [], []
    for k, (view, seen) in enumerate(zip(rig.views, best.observations, strict=True)):
        corners = ", ".join(f"({u:.1f}, {v:.1f})" for u, v in view.reference_points_px)
        sigma_px = max(map(largest_sigma, view.reference_covariances(1.0)))
        hand = "no hand"
        if isinstance(seen.finger, FingerLine):
            u, v = seen.reduction.whole(seen.finger.tip_px).tolist()
            hand = f"fingertip at ({u:.0f}, {v:.0f})"
        else:
            without.append(view.name)
        lines.append(f'view "{view.name}": corners {corners} ± {sigma_px:.2f} px; {hand}')
        lines += [
            f'view "{view.name}": another such rectangle is about ({u:.0f}, {v:.0f}); '
            f"--near {view.name}={u:.0f},{v:.0f} takes it"
            for u, v in _other_rectangles(view, candidates.get(k, ()))
        ]
    picture = composition.draw(best.observations, best.fix, plane_views=views)
    pictures = [seen.frame.image for seen in best.observations if seen.frame is not None]
    hints = _marker_hints(rig, pictures) or _size_hints(rig, pictures)
    return SetUp(rig, picture, tuple(lines), tuple(hints), tuple(without))
