"""The examination: frames of every view in, findings out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import zip_longest

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from fingerpost.admission import reduced_view
from fingerpost.capture import Frame, Loss, Source, SourceKind, read_views
from fingerpost.config import Rig, View
from fingerpost.doctor.findings import Check, Diagnosis, Finding, Severity, ViewReadings
from fingerpost.doctor.hand import HandReadings, judge_hand, read_hand
from fingerpost.doctor.pictures import judge_pictures, read_pictures, region_between
from fingerpost.doctor.references import judge_sizes, judge_together, judge_views
from fingerpost.doctor.together import judge_tracked, track_together
from fingerpost.errors import InvalidInputError
from fingerpost.pipeline import DEFAULT_REFERENCE_SIGMA_PX, LARGEST_PX, at_most
from fingerpost.pointing import DEFAULT_OPTIONS, PlaneView
from fingerpost.references import Reduction

DEFAULT_FRAMES = 120
"""Number of examined frames per view: a hand that moves in them allows a comparison of the clocks.
"""

PATIENCE_S = 5.0
"""Longest silence of a live view during the examination [s]."""

SLOW_FPS = 15.0
"""Rate below which a hand moves further between two frames than the tracker's search range."""

UNEQUAL_RATES = 0.1
"""Relative difference of rates above which views were probably not recorded together."""

GAP_FRAMES = 2.5
"""Least pause that means lost frames [usual intervals]."""

OFF_CENTRE_SHARE = 0.15
"""Greatest distance of a principal point from the image centre, relative to the longer side."""

FOCAL_SHARES = (0.3, 8.0)
"""Range of focal lengths of real lenses, relative to the longer side of the image."""

LARGEST_KEPT_PX = 800
"""Size to which large frames are reduced, so that all of them fit into memory."""

_ORDER = {Severity.ERROR: 0, Severity.WARNING: 1}
_STILL_FRAMES = 9


def look(sources: Sequence[Source], count: int) -> Iterator[tuple[Frame | Loss | None, ...]]:
    """Read the frames for `examine`.

    Live views are read together, as in the main loop, so that their times can be compared. Recorded
    ones are each read from their start; `examine` reports whether their times overlap.

    Parameters
    ----------
    sources
        One open source per view.
    count
        Number of frames of each, above 0.

    Yields
    ------
    tuple of Frame, Loss or None
        One entry per source; None if a recording has ended, or a live view has no frame at that
        time.

    Raises
    ------
    CaptureError
        A source fails while it is read, or a live one sends nothing for `PATIENCE_S`.
    InvalidInputError
        Recorded and live sources are mixed.
    """
    if all(source.kind is SourceKind.RECORDED for source in sources):
        return zip_longest(*(at_most(source, count) for source in sources))
    return at_most(read_views(sources, give_up_after_s=PATIENCE_S), count)


def reduced(frame: Frame) -> Frame:
    """Reduce a large frame (`fingerpost.pipeline.LARGEST_PX`); return others unchanged."""
    if max(frame.image.shape) <= LARGEST_PX:
        return frame
    picture = Reduction.of(frame.image.shape, LARGEST_KEPT_PX).picture(frame.image)
    return Frame(frame.index, frame.time_s, picture)


def examine(
    rig: Rig,
    frames: Sequence[Sequence[Frame]],
    sizes_px: Sequence[tuple[int, int]] | None = None,
    *,
    damage: Sequence[str] = (),
    notes: Sequence[str] = (),
) -> Diagnosis:
    """Examine some frames of every view.

    Parameters
    ----------
    rig
        One view or more.
    frames
        Frames of each view, in order, at least one; usually `DEFAULT_FRAMES` from the start of a
        recording.
    sizes_px
        Width and height of each view's pictures, if frames were `reduced`; all other lengths then
        refer to the reduced pixels.
    damage
        Damaged pictures of each view, as in `Source.damage`.
    notes
        Further remarks.

    Returns
    -------
    Diagnosis

    Raises
    ------
    InvalidInputError
        The number of views differs from the rig's, or a view has no frames.
    """
    if len(frames) != len(rig.views):
        raise InvalidInputError(
            f"frames of {len(frames)} views for a rig of {len(rig.views)}; one sequence for each"
        )
    for view, own in zip(rig.views, frames, strict=True):
        if not own:
            raise InvalidInputError(f'view "{view.name}": no frame; at least one is needed')
    sizes_px = sizes_px or [(own[0].image.shape[1], own[0].image.shape[0]) for own in frames]
    full_size_rig = rig
    rig = _in_pixels_of(rig, frames, sizes_px)
    plane_views = [
        PlaneView.from_reference_points(
            rig.plane.points,
            view.reference_points_px,
            DEFAULT_REFERENCE_SIGMA_PX**2 * np.eye(2),
            view.lens,
        )
        for view in rig.views
    ]
    stills = [_still(own) for own in frames]
    readings, findings = [], list(_judge_damage(rig.views, damage))
    damaged = {finding.view for finding in findings}
    for view, own, size_px in zip(rig.views, frames, sizes_px, strict=True):
        reading, wrong = _examine_view(view, own, has_gaps=view.name in damaged)
        readings.append(replace(reading, size_px=size_px))
        findings += wrong
    findings += judge_views(rig, plane_views, stills)
    findings += judge_together(rig, plane_views, stills)
    findings += judge_sizes(full_size_rig, sizes_px)
    findings += _judge_rates(readings)
    findings += _judge_skew(rig, frames)
    can_track = not any(finding.severity is Severity.ERROR for finding in findings)
    if can_track and (tracked := track_together(rig, frames)) is not None:
        findings += judge_tracked(rig, tracked, min(map(len, frames)))
        readings = [
            reading if reading.hand_found is not None else replace(reading, hand_found=found)
            for reading, found in zip(readings, tracked.found, strict=True)
        ]
    ordered = tuple(sorted(findings, key=lambda f: _ORDER[f.severity]))
    return Diagnosis(tuple(readings), ordered, tuple(notes))


def _judge_damage(views: Sequence[View], damage: Sequence[str]) -> Iterator[Finding]:
    for view, words in zip(views, damage, strict=False):  # unknown without a source
        if words:
            yield Finding(
                Severity.WARNING,
                Check.PICTURES,
                view.name,
                words,
                "they are lost for this view: record over a line that loses nothing, or copy the "
                "files again",
            )


def _in_pixels_of(
    rig: Rig, frames: Sequence[Sequence[Frame]], sizes_px: Sequence[tuple[int, int]]
) -> Rig:
    """Return the rig in pixels of the reduced frames."""
    views = tuple(
        reduced_view(view, Reduction(size_px[0] // own[0].image.shape[1]))
        for view, own, size_px in zip(rig.views, frames, sizes_px, strict=True)
    )
    return structs.replace(rig, views=views)


def _examine_view(
    view: View, frames: Sequence[Frame], *, has_gaps: bool
) -> tuple[ViewReadings, list[Finding]]:
    height, width = frames[0].image.shape[:2]
    greys = [frame.grey() for frame in frames]
    region = region_between(np.array(view.reference_points_px), (height, width))
    pictures = read_pictures(greys, region)
    findings = list(judge_pictures(view.name, pictures))
    hand: HandReadings | None = None
    if view.start is not None:
        hand = read_hand(frames, view.start)
        findings += judge_hand(view.name, hand, view.start, (width, height), len(frames))
    findings += _judge_lens(view, (width, height))
    findings += _judge_times(view.name, frames, has_gaps=has_gaps)
    # All received frames count, fetched or not: a step fetches no more than the slowest view has.
    steps = np.diff([frame.time_s for frame in frames])
    steps /= np.maximum(1, np.diff([frame.index for frame in frames]))
    positive = steps[steps > 0.0]
    reading = ViewReadings(
        view=view.name,
        frames=len(frames),
        size_px=(width, height),
        frames_per_s=float(1.0 / np.median(positive)) if len(positive) else None,
        grey_percentiles=pictures.grey_percentiles,
        clipped=pictures.clipped,
        noise=pictures.noise,
        blur_px=pictures.blur_px,
        hand_found=None if hand is None else hand.found,
        contrast=None if hand is None else hand.contrast,
        finger_px=None if hand is None else hand.finger_px,
    )
    return reading, findings


def _still(frames: Sequence[Frame]) -> NDArray[np.uint8]:
    """Return the median of some frames, which shows static parts."""
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(len(frames), _STILL_FRAMES)).astype(int))
    stack = np.stack([frames[k].grey() for k in chosen])
    return np.asarray(np.median(stack, axis=0)).astype(np.uint8)


def _judge_lens(view: View, size_px: tuple[int, int]) -> Iterator[Finding]:
    lens = view.lens
    if lens is None:
        return
    longer = max(size_px)
    middle = (np.array(size_px) - 1.0) / 2.0
    off = float(np.abs(np.array([lens.cx, lens.cy]) - middle).max())
    shares = (lens.fx / longer, lens.fy / longer)
    likely = FOCAL_SHARES[0] <= min(shares) and max(shares) <= FOCAL_SHARES[1]
    if off <= OFF_CENTRE_SHARE * longer and likely:
        return
    yield Finding(
        Severity.WARNING,
        Check.LENS,
        view.name,
        f"lens fx, fy, cx, cy ({lens.fx:g}, {lens.fy:g}, {lens.cx:g}, {lens.cy:g}) do not fit "
        f"images of {size_px[0]} × {size_px[1]} px",
        "they hold for the size at which the camera was calibrated: scale them, or calibrate again",
    )


def _judge_times(name: str, frames: Sequence[Frame], *, has_gaps: bool) -> Iterator[Finding]:
    times = np.array([frame.time_s for frame in frames])
    steps = np.diff(times)
    if not len(steps):
        return
    if (steps <= 0.0).any():
        k = int(np.argmax(steps <= 0.0)) + 1
        yield Finding(
            Severity.ERROR,
            Check.TIMING,
            name,
            f"frame {frames[k].index} is of {times[k]:.4f} s, after one of {times[k - 1]:.4f} s",
            "times are to increase: a clock that stands or jumps cannot bring views together",
        )
        return
    usual = float(np.median(steps))
    if usual > 1.0 / SLOW_FPS:
        yield Finding(
            Severity.WARNING,
            Check.TIMING,
            name,
            f"{1.0 / usual:.1f} frames a second",
            f"{SLOW_FPS:.0f} or more is right, or hands must move slowly",
        )
    longest = int(np.argmax(steps))
    if not has_gaps and steps[longest] > GAP_FRAMES * usual:
        yield Finding(
            Severity.WARNING,
            Check.TIMING,
            name,
            f"a pause of {steps[longest]:.3f} s after frame {frames[longest].index}, where "
            f"{usual:.3f} s is usual",
            "frames are lost: a slower rate, smaller images, or a bus of its own for each camera",
        )


def _judge_rates(readings: Sequence[ViewReadings]) -> Iterator[Finding]:
    rates = {r.view: r.frames_per_s for r in readings if r.frames_per_s is not None}
    if len(rates) < 2 or max(rates.values()) <= (1.0 + UNEQUAL_RATES) * min(rates.values()):
        return
    words = ", ".join(f"{view} {rate:.1f}" for view, rate in rates.items())
    yield Finding(
        Severity.WARNING,
        Check.TIMING,
        "",
        f"the views run at different rates: {words} frames a second",
        "equal rates are right; check that the recordings belong together",
    )


def _judge_skew(rig: Rig, frames: Sequence[Sequence[Frame]]) -> Iterator[Finding]:
    """Find views that cannot be interpolated at the first one's times, so that there is no fix."""
    first = np.array([frame.time_s for frame in frames[0]])
    most_s = DEFAULT_OPTIONS.max_gap_s
    for view, own in zip(rig.views[1:], frames[1:], strict=True):
        times = np.array([frame.time_s for frame in own])
        skew = float(np.median(np.abs(first[:, None] - times).min(axis=1)))
        step_s = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
        off = f"its frames are {skew:.3g} s off those of {rig.views[0].name}"
        if skew > most_s:
            right = f"at most {most_s:g} s can be bridged: one clock for all views"
        elif skew > DEFAULT_OPTIONS.max_skew_s and step_s > most_s:
            off += f", and {step_s:.3g} s apart"
            right = (
                f"at most {most_s:g} s can be bridged: {1 / most_s:.0f} frames a second and more, "
                "or all views at the same times"
            )
        else:
            continue
        yield Finding(Severity.ERROR, Check.TIMING, view.name, off, right)
