"""Verification of reference points by the texture and the corners of the pictures.

There are two kinds of evidence. Rectified to the plane by their own points, all views show the same
table: its high-pass filtered texture has a correlation of 0.95 if the points are right and 0.1 if
not. And points that were measured at corners of objects coincide with sharp corners in the picture.
Neither suffices alone: plain sheets have no texture, and crossings of lines are not corners. Common
mistakes are therefore corrected one by one. One is reported if after its correction the views agree
as those of a right rig do, or if all points then are at corners while hardly any were before.

The agreement is the mean over small cells of the plane, each with equal weight. Objects above the
plane, such as a hand or a robot, differ between views and have the strongest edges: in a single
correlation over the whole plane they would outweigh the table, and two superimposed hands would
seem to agree.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import chain, permutations

import numpy as np
from numpy.typing import NDArray

from fingerpost.config import Rig
from fingerpost.consistency.contradiction import Contradiction
from fingerpost.consistency.straightness import BENT_PX, Bend, bend_of
from fingerpost.errors import FingerpostError
from fingerpost.finding.pairs import Viewpoint
from fingerpost.homography import transfer_to_image
from fingerpost.pointing import PlaneView
from fingerpost.references import Reduction

Array = NDArray[np.float64]
Grey = NDArray[np.uint8]

LARGEST_PX = 1280
"""Longest side of a picture that is processed at full size [px]; larger ones are reduced."""

AGREES = 0.8
LEAST_AGREEMENT = 0.55
BETTER = 0.2
"""Agreement of two views' textures of the plane: from the first on there is no mistake; the
correction of a mistake must bring it to the second, and increase it by the third. Right rigs, with
a visible hand, have 0.78 to 1 on simulated wood, prints and sheets, and 0.54 to 0.79 on plain wood
with 4 grey levels of noise; wrong ones −0.1 to 0.36."""

LEAST_CELLS = 12
"""Least number of cells of the plane with texture for the agreement to be defined: a third of them.
On a plain table, a hand covers up to 10."""

DISAGREES = 0.4
TEXTURED_CELLS = 18
"""Agreement below which the points of some view are off, though no correction is known, and least
number of cells with texture in every view for that: half of them."""

ANOTHER_HEIGHT = 0.25
"""Sine of the root mean square angle between displacements and the lines towards the epipole, below
which the texture is at another height."""

TIE = 0.01
"""Difference of agreement up to which the more common mistake is reported."""

MORE_CORNERS = 3
"""Number of additional points at corners that decides between two mistakes: a picture of a textured
table has a corner at one point or two by chance."""

SIMPLER = 0.05
"""Least gain in agreement of a mistake that concerns one more view."""

BARE_LEVELS = 1.0
"""Greatest standard deviation of a filtered picture without content, by noise [grey levels]."""

SAME = 0.97
"""Correlation of the high-pass filtered parts of equal pictures; that of two cameras is 0.1."""

CORNER_PX = 3.0
"""Greatest distance of a sharp corner from a point that coincides with it."""

FURTHEST_PX = 60.0
"""Greatest distance of a poorly measured point from its corner."""

SCALES = (0.25, 1 / 3, 0.5, 2 / 3, 0.75, 4 / 3, 1.5, 2.0, 3.0, 4.0)
"""Ratios of the picture sizes of one camera."""

_PATCH = 96
_CELL = 16
_AROUND = 0.25
_SMOOTH_PATCH = 6.0
_PLAIN_LEVELS = 2.0
_ECC_STEPS = (3, 60, 1e-4)  # iterations and a least improvement
_ECC_BLUR = 5
_QUALITY = 0.02
_LEAST_CONTRAST = 12.0  # below, corners are noise [levels]
_MOST_CORNERS = 150
_CORNERS_APART_PX = 6


@dataclass(frozen=True, eq=False)
class Mistake:
    """A probable mistake in the reference points of some views.

    Attributes
    ----------
    what
        The mistake in words.
    points_px
        The right points (N, 2) [px], by index of the view in the rig; empty if they are unknown.
    agreement, as_given
        Agreement of the views with these points, and with those of the rig, −1 to 1.
    is_certain
        Whether it is a common mistake, and the texture in all views confirms it; otherwise only
        corners are evidence, or it is unknown which view is wrong.
    off_px
        Standard deviation of the error of either coordinate that the points of a view may have
        [px], by index; empty if the mistake is certain.
    """

    what: str
    points_px: dict[int, Array]
    agreement: float
    as_given: float
    is_certain: bool
    off_px: dict[int, float] = field(default_factory=dict)

    def advice(self, rig: Rig) -> str:
        """Return the corrected lines of the rig file, and how sure they are."""
        if not self.points_px:
            return "compare every point with the pictures, also its number"
        sure = "would be right" if self.is_certain else "may be right: look at the pictures"
        return f"{self._lines(rig)} {sure}"

    def _lines(self, rig: Rig) -> str:
        return "; ".join(
            f'view "{rig.views[k].name}": reference_points_px = ['
            + ", ".join(f"[{u:.1f}, {v:.1f}]" for u, v in points.tolist())
            + "]"
            for k, points in self.points_px.items()
        )


class Scenery:
    """Texture of the plane in the views of a rig.

    Parameters
    ----------
    rig
        Two views or more.
    pictures
        One of each, (H, W) or (H, W, 3), if possible without moving objects. Large ones are
        reduced.
    """

    def __init__(self, rig: Rig, pictures: Sequence[NDArray[np.uint8]]) -> None:
        import cv2

        self._rig = rig
        self._plane_points = np.array(rig.plane.points, np.float64)
        self._reductions = [Reduction.of(picture.shape, LARGEST_PX) for picture in pictures]
        stills = [
            _grey(reduction.picture(picture))
            for reduction, picture in zip(self._reductions, pictures, strict=True)
        ]
        self._given = [
            reduction.points(view.reference_points_px)
            for reduction, view in zip(self._reductions, rig.views, strict=True)
        ]
        self._lenses = [
            reduction.lens(view.lens)
            for reduction, view in zip(self._reductions, rig.views, strict=True)
        ]
        self._stills = stills
        self._sizes = [(still.shape[1], still.shape[0]) for still in stills]
        self._smooth = [np.asarray(cv2.GaussianBlur(still, (0, 0), 1.5)) for still in stills]
        self._corners = [_sharp_corners(still) for still in stills]
        self._patches: dict[tuple[int, bytes], Array | None] = {}

    def agreement(self) -> float:
        """Return the agreement of the views on the plane's texture, −1 to 1.

        It is the least agreement of the first view with another; 0 if a view does not show it.
        """
        return self._agreement({})

    def agreement_of(self, points_px: dict[int, Array], views: tuple[int, int]) -> float:
        """Return the agreement of two views with other reference points, −1 to 1.

        Parameters
        ----------
        points_px
            Points (N, 2) of some views [px], by index of the view.
        views
            Indices of the two views.
        """
        reduced = {k: self._reductions[k].points(points) for k, points in points_px.items()}
        one, other = (self._patch(k, reduced.get(k, self._given[k])) for k in views)
        return 0.0 if one is None or other is None else _agreement(one, other)

    def _agreement(self, points_px: dict[int, Array]) -> float:
        """Return the agreement with other points in some views, in reduced pixels."""
        chosen = {**dict(enumerate(self._given)), **points_px}
        first, *others = (self._patch(k, chosen[k]) for k in range(len(self._given)))
        if first is None:
            return 0.0
        return min(0.0 if other is None else _agreement(first, other) for other in others)

    def _may_agree(self, points_px: dict[int, Array]) -> bool:
        """Whether views show enough texture to reach `LEAST_AGREEMENT`.

        Cached results are used first: on a plain table they decide most mistakes.
        """
        chosen = {**dict(enumerate(self._given)), **points_px}
        order = sorted(chosen, key=lambda k: k in points_px)
        return all(self._textured(k, chosen[k]) >= LEAST_AGREEMENT * LEAST_CELLS for k in order)

    def _textured(self, k: int, points_px: Array) -> int:
        """Count the cells in which a view shows a texture of the plane."""
        patch = self._patch(k, points_px)
        if patch is None:
            return 0
        cells = _cells(patch)
        counts = np.isfinite(cells).sum(axis=1)
        is_plain = _is_plain(np.nansum(cells * cells, axis=1), counts)
        return int((~is_plain & (2 * counts >= cells.shape[1])).sum())

    def bends(self) -> dict[int, Bend]:
        """Return the detected distortion of views without a given lens, by index.

        Cameras of a rig are mostly of one kind: where one bends its image, less is needed to
        attribute the curvature in the others to their lenses.
        """
        found = {}
        for k, view in enumerate(self._rig.views):
            if view.lens is None:
                still, given = self._stills[k], self._given[k]
                bend = bend_of(still, self._plane_points, given, self._reductions[k])
                if bend is not None:
                    found[k] = bend
        is_bent = any(b.bent_px >= BENT_PX * self._reductions[k].factor for k, b in found.items())
        return found if is_bent else {}

    def same_pictures(self) -> Contradiction | None:
        """Return a contradiction if two views show the same picture, as two cameras never do."""
        for k, name in enumerate(view.name for view in self._rig.views):
            for j in range(k):
                if self._sizes[j] == self._sizes[k] and self._is_same(j, k):
                    return Contradiction(
                        f'views "{self._rig.views[j].name}" and "{name}" show the same picture',
                        "each needs a camera, or the film of a camera, of its own",
                    )
        return None

    def plain(self) -> list[int]:
        """Return the indices of views whose pictures are blank."""
        return [k for k, smooth in enumerate(self._smooth) if float(smooth.std()) < BARE_LEVELS]

    def _is_same(self, j: int, k: int) -> bool:
        """Whether the high-pass filtered parts of two pictures are equal."""
        import cv2

        one, other = (
            still.astype(np.float64) - cv2.GaussianBlur(still, (0, 0), _SMOOTH_PATCH)
            for still in (self._smooth[j], self._smooth[k])
        )
        return bool(_correlations(one.reshape(1, -1), other.reshape(1, -1))[0] > SAME)

    def mistake(self) -> Mistake | None:
        """Return the most likely mistake in the points; None if none is detected."""
        as_given = self.agreement()
        if as_given >= AGREES:
            return None
        aligned = self._best_by_agreement(as_given, self._alignments(), is_certain=False)
        if aligned is not None and self._is_another_height(aligned.points_px):
            return None
        found = (
            self._best_by_agreement(as_given, chain(self._guesses(), self._at_nearest_corners()))
            or self._best_by_corners(as_given)
            or aligned
        )
        if found is None:
            return self._unexplained(as_given)
        whole_px = {k: self._reductions[k].whole(points) for k, points in found.points_px.items()}
        off_px = {} if found.is_certain else self._doubt_px(found.points_px)
        return replace(found, points_px=whole_px, off_px=off_px)

    def _doubt_px(self, points_px: dict[int, Array]) -> dict[int, float]:
        """Return how far off the points of each view may be, given a correction of some [px].

        Texture alone relates the first view to the others: either one may be wrong.
        """
        off = {k: points - self._given[k] for k, points in points_px.items()}
        largest_px = max(float(np.sqrt(np.square(one).mean())) for one in off.values())
        return {k: self._reductions[k].factor * largest_px for k in {0, *off}}

    def _unexplained(self, as_given: float) -> Mistake | None:
        """Return a mistake without a correction if all views show texture, but another one."""
        has_texture = all(
            self._textured(k, given) >= TEXTURED_CELLS for k, given in enumerate(self._given)
        )
        if as_given >= DISAGREES or not has_texture:
            return None
        what = "the views do not show the same table between their points: those of one are off"
        off_px = {k: one.factor * FURTHEST_PX for k, one in enumerate(self._reductions)}
        return Mistake(what, {}, as_given, as_given, False, off_px)

    def _best_by_agreement(
        self,
        as_given: float,
        guesses: Iterable[tuple[str, dict[int, Array]]],
        *,
        is_certain: bool = True,
    ) -> Mistake | None:
        best: Mistake | None = None
        most, most_hits, also = -1.0, 0, ""
        for what, points_px in guesses:
            if not self._may_agree(points_px):
                continue
            agreement = self._agreement(points_px)
            score = agreement - SIMPLER * len(points_px)
            if agreement <= max(LEAST_AGREEMENT, as_given + BETTER) or score < most - TIE:
                continue
            # Two mistakes that move the views equally leave the same agreement: corners decide.
            hits = sum(self._hits(k, points) for k, points in points_px.items())
            if best is None or score > most + TIE or hits >= most_hits + MORE_CORNERS:
                best, also = Mistake(what, points_px, agreement, as_given, is_certain), ""
                most, most_hits = max(score, most), hits
            elif abs(hits - most_hits) < MORE_CORNERS and _differ(points_px, best.points_px):
                also = also or what
        return (
            replace(best, what=f"{best.what}, or {also}", points_px={}) if best and also else best
        )

    def _best_by_corners(self, as_given: float) -> Mistake | None:
        """Use corners alone if the table has too little texture for an agreement.

        Points that are each moved to the nearest corner are no evidence: a picture with 150 corners
        has one within 20 px of most points.
        """
        if as_given >= LEAST_AGREEMENT:
            return None  # the texture confirms the points
        best, most = None, 0
        for k, given in enumerate(self._given):
            if self._hits(k, given) > 1:
                return None
        for what, points_px in self._guesses():
            if len(points_px) < len(self._given):
                continue
            counts = [self._hits(k, points) for k, points in points_px.items()]
            if min(counts) >= len(self._plane_points) and sum(counts) > most:
                best, most = Mistake(what, points_px, 0.0, as_given, False), sum(counts)
        return best

    def _guesses(self) -> Iterator[tuple[str, dict[int, Array]]]:
        """Yield the corrections of every mistake, in every view alone and in all of them."""
        views = range(len(self._given))
        if len(self._given) == 2:
            yield "the views' points are swapped", {0: self._given[1], 1: self._given[0]}
        for what, right in _slips():
            each = {k: right(self._given[k], self._sizes[k]) for k in views}
            if "order" not in what:  # another order in all views is another pair of axes
                yield f"{what} in all views", each
            # The order is relative between views: the first view's is assumed to be right.
            for k in views[1:] if "order" in what else views:
                yield f'{what} in view "{self._rig.views[k].name}"', {k: each[k]}
        moved = [self._shifted(k) for k in views]
        for k in views:
            for points in moved[k]:
                yield self._shifted_words(k, points), {k: points}
        if all(moved):
            best = {k: moved[k][0] for k in views}
            yield "; ".join(self._shifted_words(k, best[k]) for k in views), best

    def _at_nearest_corners(self) -> Iterator[tuple[str, dict[int, Array]]]:
        """Yield the points of every view, and of all, each at the corner nearest to it.

        Only if the views then agree as those of a right rig do: with one point at a wrong corner
        0.73 is left, at the right ones 0.94 and more.
        """
        for what, points_px in self._moved_to_corners():
            if self._may_agree(points_px) and self._agreement(points_px) >= AGREES:
                yield what, points_px

    def _moved_to_corners(self) -> Iterator[tuple[str, dict[int, Array]]]:
        moved = {}
        for k, (given, corners) in enumerate(zip(self._given, self._corners, strict=True)):
            off_px = np.linalg.norm(corners[None] - given[:, None], axis=-1)
            if off_px.size and off_px.min(axis=1).max() <= FURTHEST_PX:
                moved[k] = corners[off_px.argmin(axis=1)]
                yield self._nearest_words(k, moved[k]), {k: moved[k]}
        if len(moved) == len(self._given):
            yield "; ".join(self._nearest_words(k, points) for k, points in moved.items()), moved

    def _alignments(self) -> Iterator[tuple[str, dict[int, Array]]]:
        """Yield points that align the texture of each view with the first one's."""
        if all(self._hits(k, given) >= 2 for k, given in enumerate(self._given)):
            return  # points are at corners in all views: differences are objects on the plane
        for k in range(1, len(self._given)):
            aligned = self._aligned(k)
            # Further off, a hand in one view has been aligned with another object in the other.
            if aligned is not None and self._off_px(k, aligned) <= FURTHEST_PX:
                yield self._aligned_words(k, aligned), {k: aligned}

    def _is_another_height(self, points_px: dict[int, Array]) -> bool:
        """Whether the texture would agree because it is above or below the plane of the points.

        For example, if a robot has defined the plane at the height of its grip. A plane parallel to
        the working plane is displaced between two views along the lines towards the intersection of
        the line through both camera centres with the plane (Hartley & Zisserman 2004, section
        13.3).
        """
        return all(self._sine_to_epipole(k, px) < ANOTHER_HEIGHT for k, px in points_px.items())

    def _sine_to_epipole(self, k: int, points_px: Array) -> float:
        """Root mean square sine of the angles of displacements to the lines towards the epipole."""
        views = [self._view(j, self._given[j]) for j in (0, k)]
        centres = [
            Viewpoint.of(view, self._sizes[j]).centre for view, j in zip(views, (0, k), strict=True)
        ]
        (x, y, z), (u, v, w) = centres
        epipole = np.array([x * w - u * z, y * w - v * z, w - z])  # homogeneous, on the plane
        places = views[1].back_project(points_px)
        moved = places - self._plane_points
        towards = epipole[:2] - epipole[2] * self._plane_points
        across = moved[:, 0] * towards[:, 1] - moved[:, 1] * towards[:, 0]
        lengths = np.linalg.norm(moved, axis=1) * np.linalg.norm(towards, axis=1)
        return float(np.sqrt((across**2).sum() / (lengths**2).sum()))

    def _nearest_words(self, k: int, points: Array) -> str:
        off_px = np.linalg.norm(points - self._given[k], axis=1) * self._reductions[k].factor
        return (
            f'the points of view "{self._rig.views[k].name}" are up to {off_px.max():.0f} px away '
            "from corners in the picture"
        )

    def _shifted_words(self, k: int, points: Array) -> str:
        moved_px = np.median(points - self._given[k], axis=0) * self._reductions[k].factor
        u, v = moved_px.round().tolist()
        return (
            f'the points of view "{self._rig.views[k].name}" are off by ({-u:g}, {-v:g}) px, as if '
            "measured in a picture cut out of the whole"
        )

    def _aligned_words(self, k: int, points: Array) -> str:
        off_px = self._off_px(k, points) * self._reductions[k].factor
        first, name = self._rig.views[0].name, self._rig.views[k].name
        return (
            f'the points of views "{first}" and "{name}" do not belong together: those of one of '
            f'them are off, by {off_px:.0f} px if they are those of "{name}"'
        )

    def _off_px(self, k: int, points: Array) -> float:
        """Return the median distance of points from the rig's [px]."""
        return float(np.median(np.linalg.norm(points - self._given[k], axis=1)))

    def _aligned(self, k: int) -> Array | None:
        """Return points that align a view's texture with the first one's.

        By the largest correlation over shifts, refined by a homography (Evangelidis & Psarakis
        2008).
        """
        import cv2

        first, other = self._patch(0, self._given[0]), self._patch(k, self._given[k])
        if first is None or other is None:
            return None
        here, there = (np.nan_to_num(patch).astype(np.float32) for patch in (first, other))
        m = _PATCH // 4
        scores = cv2.matchTemplate(there, here[m:-m, m:-m], cv2.TM_CCOEFF_NORMED)
        row, column = np.unravel_index(int(np.argmax(scores)), scores.shape)
        warp = np.array([[1, 0, column - m], [0, 1, row - m], [0, 0, 1]], np.float32)
        seen = np.isfinite(first).astype(np.uint8)
        try:
            _, found = cv2.findTransformECC(
                here, there, warp, cv2.MOTION_HOMOGRAPHY, _ECC_STEPS, seen, _ECC_BLUR
            )
        except cv2.error:  # it does not converge
            return None
        lower, step = self._frame()
        patch_from_plane = np.diag([*(1 / step), 1.0])
        patch_from_plane[:2, 2] = -lower / step
        shown = np.linalg.inv(patch_from_plane) @ np.asarray(found) @ patch_from_plane
        with suppress(FingerpostError):
            view = self._view(k, self._given[k])
            places = view.project(transfer_to_image(shown, self._plane_points))
            return places if np.isfinite(places).all() else None
        return None

    def _frame(self) -> tuple[Array, Array]:
        """Position of a texture's first pixel on the plane, and spacing of its pixels."""
        lower, upper = self._plane_points.min(axis=0), self._plane_points.max(axis=0)
        border = _AROUND * (upper - lower)
        return lower - border, (upper - lower + 2.0 * border) / (_PATCH - 1)

    @cached_property
    def _places(self) -> Array:
        """The points of the plane at which a texture is sampled."""
        lower, step = self._frame()
        return lower + step * np.moveaxis(np.mgrid[:_PATCH, :_PATCH][::-1], 0, -1)

    def _view(self, k: int, points_px: Array) -> PlaneView:
        return PlaneView.from_reference_points(self._plane_points, points_px, None, self._lenses[k])

    def _shifted(self, k: int) -> list[Array]:
        """Return a view's points at corners by a common shift, the most likely ones first."""
        given, corners = self._given[k], self._corners[k]
        if not len(corners):
            return []
        shifts = (corners[None] - given[:, None]).reshape(-1, 2)
        counts = np.array([self._hits(k, given + shift) for shift in shifts])
        enough = np.flatnonzero(counts >= max(len(given) - 1, 3))
        order = enough[np.argsort(-counts[enough], kind="stable")][:5]
        return [self._snapped(k, given + shifts[i]) for i in order]

    def _snapped(self, k: int, points: Array) -> Array:
        """Move points to the corners near them."""
        off_px = np.linalg.norm(self._corners[k][None] - points[:, None], axis=-1)
        nearest = self._corners[k][off_px.argmin(axis=1)]
        return np.where(off_px.min(axis=1)[:, None] <= CORNER_PX, nearest, points)

    def _hits(self, k: int, points: Array) -> int:
        """Count the points that coincide with a sharp corner."""
        if not len(self._corners[k]):
            return 0
        off_px = np.linalg.norm(self._corners[k][None] - points[:, None], axis=-1)
        return int((off_px.min(axis=1) <= CORNER_PX).sum())

    def _patch(self, k: int, points_px: Array) -> Array | None:
        """Return the plane's texture in a view; None if its points give no homography."""
        key = (k, points_px.tobytes())
        if key not in self._patches:
            self._patches[key] = self._texture(k, points_px)
        return self._patches[key]

    def _texture(self, k: int, points_px: Array) -> Array | None:
        import cv2

        try:
            view = self._view(k, points_px)
        except FingerpostError:
            return None
        u, v = np.moveaxis(view.project(self._places).astype(np.float32), -1, 0)
        right, bottom = np.array(self._sizes[k]) - 1.0
        with np.errstate(invalid="ignore"):  # beyond the horizon there is nothing
            seen = (u >= 0.0) & (v >= 0.0) & (u <= right) & (v <= bottom)
        u, v = (np.where(seen, one, np.float32(0.0)) for one in (u, v))
        patch = cv2.remap(self._smooth[k], u, v, cv2.INTER_LINEAR).astype(np.float32)
        share = seen.astype(np.float32)
        weight, around = (
            cv2.GaussianBlur(one, (0, 0), _SMOOTH_PATCH) for one in (share, patch * share)
        )
        return np.asarray(np.where(seen, patch - around / np.maximum(weight, 1e-6), np.nan))


def _slips() -> Iterator[tuple[str, Callable[[Array, tuple[int, int]], Array]]]:
    """Yield common mistakes with pixel coordinates, and the correction of each."""
    yield "rows and columns are swapped", lambda px, _: px[:, ::-1].copy()
    yield "y is counted upwards", lambda px, size: px * [1, -1] + [0, size[1] - 1]
    yield "the image was mirrored", lambda px, size: px * [-1, 1] + [size[0] - 1, 0]
    yield "points are parts of the image's size", lambda px, size: px * size - 0.5
    for scale in SCALES:
        yield (
            f"points were measured in images {1 / scale:.3g} times as large",
            lambda px, _, scale=scale: (px + 0.5) * scale - 0.5,  # type: ignore[misc]
        )
    for order in permutations(range(4)):
        if order != (0, 1, 2, 3):
            yield (
                f"points are to be taken in the order {list(order)}",
                lambda px, _, order=order: np.vstack([px[list(order)], px[4:]]),  # type: ignore[misc]
            )


def _differ(one: dict[int, Array], other: dict[int, Array]) -> bool:
    """Whether two corrections concern other views, or put a point at another place."""
    if one.keys() != other.keys():
        return True
    return any(
        np.linalg.norm(points - other[k], axis=1).max() > FURTHEST_PX for k, points in one.items()
    )


def _grey(picture: NDArray[np.uint8]) -> Grey:
    import cv2

    if picture.ndim == 2:
        return picture
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), np.uint8)


def _sharp_corners(still: Grey) -> Array:
    """Return the sharpest corners of a picture, (M, 2) [px], with subpixel accuracy."""
    import cv2

    low, high = np.percentile(still, (1, 99)).tolist()
    if high - low < _LEAST_CONTRAST:
        return np.empty((0, 2))
    found = cv2.goodFeaturesToTrack(still, _MOST_CORNERS, _QUALITY, _CORNERS_APART_PX, blockSize=5)
    if found is None:
        return np.empty((0, 2))
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.02)
    refined = cv2.cornerSubPix(still, np.asarray(found, np.float32), (4, 4), (-1, -1), criteria)
    return np.asarray(refined, np.float64).reshape(-1, 2)


def _agreement(first: Array, second: Array) -> float:
    """Return the mean correlation over cells with texture; 0 if there are too few of them.

    Cells of which less than half is visible in both views are ignored. A cell with texture in only
    one of the views counts as uncorrelated.
    """
    found = _correlations(_cells(first), _cells(second))
    known = found[~np.isnan(found)]
    return float(known.mean()) if len(known) >= LEAST_CELLS else 0.0


def _correlations(first: Array, second: Array) -> Array:
    """Return the correlation of the textures in each row, 0 if one of them is plain.

    NaN if both are, or less than half of the row is visible in both.
    """
    both = np.isfinite(first) & np.isfinite(second)
    counts = np.maximum(both.sum(axis=1), 1)
    a, b = (np.where(both, one, 0.0) for one in (first, second))
    means = (one.sum(axis=1) / counts for one in (a, b))
    a, b = (
        np.where(both, one - mean[:, None], 0.0) for one, mean in zip((a, b), means, strict=True)
    )
    squares = np.stack([(a * a).sum(axis=1), (b * b).sum(axis=1)])
    is_plain = _is_plain(squares, counts)
    scales = np.sqrt(np.where(is_plain, 1.0, squares).prod(axis=0))
    found = np.where(is_plain.any(axis=0), 0.0, (a * b).sum(axis=1) / scales)
    return np.where(is_plain.all(axis=0) | (2 * counts < both.shape[1]), np.nan, found)


def _is_plain(squares: Array, counts: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Whether cells have no texture, by the sums of their squared levels and numbers of pixels."""
    return np.asarray(squares < _PLAIN_LEVELS**2 * counts)


def _cells(patch: Array) -> Array:
    """Return the square cells of a patch, each in a row."""
    across = _PATCH // _CELL
    cells = patch.reshape(across, _CELL, across, _CELL).swapaxes(1, 2)
    return cells.reshape(across * across, _CELL * _CELL)
