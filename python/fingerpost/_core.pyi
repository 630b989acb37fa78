"""The stages of the contour tracker, written in Rust (crate ``fingerpost-core``).

One frame's way is search → fit → accept: `EdgeSearch` measures edges along the normals of a
contour, `Fitter` turns the measurements into a step of the shape vector that a `ShapeSpace`
allows, and `ContourTracker` runs both over the life of a hand, from the `Template` that waits for
it to the finger line of every frame. The other stages stand here to be studied, tested and
combined anew; who only wants to track needs `Template`, `StartPose` and `ContourTracker`.

Conventions
-----------
Pixel (0, 0) is the centre of the top-left pixel, u runs right and v down; a point is (u, v).
Angles are in radians from +u towards +v. Template coordinates (p, q) have their origin in the
middle of the visible index finger, which is one unit long; p runs towards the tip, q to the right
of the pointing direction.

*Images* are NumPy arrays of ``uint8`` that are read where they lie, without a copy, whatever the
distance from row to row. The pixels of a row must be contiguous and the rows must follow one
another in memory: a cropped image will do, one that is mirrored, transposed or a single channel of
another needs `numpy.ascontiguousarray`. Nothing may write to an image while a call works on it.

*Other arrays* may be anything that NumPy reads as real numbers. Arrays that come back are
read-only.

*Options* are nested dictionaries that name only what differs from the defaults, which the property
``options`` of every stage tells; an unknown key is refused with its path.

*Threads*: whatever takes longer than some microseconds releases the GIL. Objects are immutable and
may be shared, but for `ContourTracker`, `Background`, `HandFinder` and `PlaneRegistration`: while
one is at work in one thread, any use of it in another raises `fingerpost.errors.FingerpostError`.

Bad input raises `fingerpost.errors.InvalidInputError`, a `ValueError`, that names the value and
what would be right; an object of the wrong class raises `TypeError`. A hand that is not there is
no error but a status.
"""

from collections.abc import Mapping, Sequence
from typing import Literal, TypedDict, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fingerpost.errors import FingerpostError

__all__ = [
    "ArcLength",
    "Axis",
    "BSpline",
    "Background",
    "BasisRows",
    "Candidate",
    "ContourSamples",
    "ContourTracker",
    "CurvePoints",
    "Diagnostics",
    "EdgePoints",
    "EdgeSearch",
    "FingerLine",
    "FitReport",
    "Fitter",
    "HandFinder",
    "LineFit",
    "PlacedContour",
    "PlaneLevel",
    "PlaneRegistration",
    "RegisteredPlane",
    "RoundFinger",
    "SearchLines",
    "ShapeSpace",
    "SplineFit",
    "StartPose",
    "Template",
    "Track",
    "edges_along",
    "fit_line",
    "sample_contour",
    "update_views",
]

# --- options ---------------------------------------------------------------------------------

class _BackgroundOptions(TypedDict, total=False):
    """How a background is learned."""

    learn_frames: int
    """Visits that a level must have lasted before its pixel is known, 1 to 200."""
    rate: float
    """Part by which mean and variance take over a visit that agrees, 0.001 to 1."""
    absorb_frames: int
    """Frames for which something new has to stay until it is background, 4 to 1000."""
    noise_grey: float
    """Least standard deviation of a pixel about its level [grey levels], 0.1 to 64."""
    changed_sigmas: float
    """A pixel this many standard deviations away from its level has changed, 1 to 20."""
    shadow_light: float
    """Light that the deepest shadow leaves, 0 to 1; 1 where there are none."""
    void_share: float
    """The camera has moved when more of the image than this has changed, 0 to 1."""

class _FinderOptions(TypedDict, total=False):
    """What a finder looks for."""

    min_half_width: float
    """Half-width of the slimmest finger [parts of the longer side], 0.003 to 0.1."""
    max_half_width: float
    """Half-width of the stoutest finger [the same], above the least and up to 0.2."""
    min_gradient_grey: float
    """The least change of brightness from cell to cell that is an edge [grey levels], 1 to 100."""
    candidates: int
    """The most candidates that are given, 1 to 100."""

class _SearchOptions(TypedDict, total=False):
    """How edges are looked for."""

    scale_px: float
    """Scale s of the derivative of Gaussian [px], 0.5 to 8."""
    blur_px: float
    """Blur σ_b of the edges in the image [px], 0 to 8; contrast and variance depend on it."""
    noise_grey: float
    """Standard deviation σ_n of the image noise [grey levels], 0.1 to 64."""
    min_contrast_grey: float
    """The least contrast that counts as an edge [grey levels], 0 to 255."""

class _FitOptions(TypedDict, total=False):
    """How offsets become a step of the shape vector."""

    loss: float | Literal["none"]
    """Cutoff of Tukey's biweight [robust standard deviations], above 1; or plain least squares."""
    solve: Literal["joint", "two-stage"]
    """All components at once; or translation first, then the others, as the 1994 tracker did."""
    max_iterations: int
    """At most this many reweighted solutions, 1 to 100."""
    min_scale_px: float
    """The robust scale of the residual offsets is never taken below this [px], 0 to 10."""

class _AcceptOptions(TypedDict, total=False):
    """When a fit counts."""

    min_inliers: float
    """Least part of the visible samples whose edges agree with the fit, 0 to 1."""
    max_residual_px: float
    """Largest root mean square of their residual offsets [px], positive; a fifth of the finger's
    half-width if that is more."""

class _AcquireOptions(TypedDict, total=False):
    """How the template waits for the hand."""

    half_length_px: float
    """Half-length of the search lines [px], 1 to 128."""
    accept: _AcceptOptions
    """When a fit counts."""
    settle_frames: int
    """Accepted frames in a row until the hand is acquired, at least 1."""
    settle_change: float
    """Largest change of the finger's half-width from frame to frame, in parts of it, positive."""
    max_scale: float
    """The hand is between 1 / this and this times as wide as the waiting template, above 1."""

class _TrackOptions(TypedDict, total=False):
    """How the hand is followed."""

    half_length_px: float
    """Longest half-length of the search lines of a hand that moves as expected [px], 1 to 128.

    A hand that is not found there is sought this much further, and for every frame without it once
    more.
    """
    accept: _AcceptOptions
    """When a fit counts."""
    lose_after_frames: int
    """Frames in a row without an accepted fit until the hand is lost, at least 1."""
    appearance_rate: float
    """Part of the known appearance that every accepted frame replaces, 0 to 1."""
    dynamics: _DynamicsOptions
    """How the hand moves."""

class _DynamicsOptions(TypedDict, total=False):
    """How a hand moves in the image between frames; a Kalman filter predicts it.

    Accelerations and speeds are root mean squares, along u and along v or of the finger's angle.
    """

    acceleration_px_s2: float
    """Typical acceleration [px/s²], 1 to 1e5."""
    acceleration_rad_s2: float
    """Typical angular acceleration [rad/s²], 0.01 to 1000."""
    acceleration_lasts_s: float
    """How long an acceleration keeps its direction [s], 0.001 to 1."""
    first_speed_px_s: float
    """Typical speed of a hand that is first seen [px/s], 0 to 1e5."""
    first_speed_rad_s: float
    """The same of the finger's angle [rad/s], 0 to 100."""
    confidence: float
    """Probability that the search along a normal reaches the hand's edge, 0.5 to 0.999999."""
    longest_gap_s: float
    """A hand unseen for longer than this is not followed but found again [s], 0.001 to 60."""

class _TrackerOptions(TypedDict, total=False):
    """Everything that can be set about a `ContourTracker`."""

    model: Literal["ribbon", "paper"]
    """Finger and thumb with widths of their own; or the planar template of 1994."""
    samples: int
    """Samples along the contour, 8 to 2000."""
    max_iterations: int
    """Searches along the normals per shape space and frame at most, 1 to 100."""
    search: _SearchOptions
    """What an edge is."""
    polarity: Literal["bright", "dark", "unknown"]
    """Whether the hand is brighter or darker than what is behind it."""
    fit: _FitOptions
    """How offsets become a step."""
    correlation: float
    """The covariance is multiplied by this, at least 1: neighbouring measurements share pixels."""
    refine: bool
    """Whether the band model's finger line is refined by the flanks alone, and told with those of
    the frames before; the paper's never is."""
    acquire: _AcquireOptions
    """Until the hand is acquired."""
    track: _TrackOptions
    """From then on."""

class _ThumbProportions(TypedDict, total=False):
    """The thumb of a pistol; lengths are in units of the visible index finger."""

    base: float
    """Where the thumb's axis meets the finger's: p of that point, −1 to 0.5."""
    angle_rad: float
    """Angle between the two axes [rad], 0.5 to 2."""
    length: float
    """Length of the thumb's axis from there to its apex, 0.3 to 2."""
    half_width: float
    """Half the thumb's width, 0.03 to 0.4."""
    far_flank: float
    """Part of the thumb's far flank that the outline follows back from the tip, 0 to 1."""

class _Proportions(TypedDict, total=False):
    """The shape of a pistol; lengths are in units of the visible index finger."""

    half_width: float
    """Half the finger's width, 0.03 to 0.4."""
    flank_start: float
    """Where the outline begins on the finger's flank: p from −0.5 to 0.3."""
    thumb: _ThumbProportions | None
    """The thumb; None for a finger alone."""

# --- contours --------------------------------------------------------------------------------

@final
class BSpline:
    """A quadratic or cubic B-spline basis: degree, knots, open or closed.

    It has no shape until control points give it one; they come as an argument, because every
    deformation of a contour moves them and leaves the basis as it is.

    Immutable; two are equal if degree, knots and closure are.

    References
    ----------
    C. de Boor, *A Practical Guide to Splines*; L. Piegl and W. Tiller, *The NURBS Book*.
    """

    @staticmethod
    def open(degree: int, knots: ArrayLike) -> BSpline:
        """Make an open B-spline on a full knot vector.

        Parameters
        ----------
        degree
            2 or 3.
        knots : (n + degree + 1,)
            For n control points; not decreasing. The domain runs from knot ``degree`` to knot n.
            Inner knots may occur ``degree`` times, which makes a corner, the first and the last
            ``degree + 1`` times, which makes the curve start and end at a control point.

        Raises
        ------
        InvalidInputError
            Another degree; too few, decreasing, too often repeated or not finite knots;
            neighbours that differ by less than 1e-10 of the domain's larger end.
        """

    @staticmethod
    def open_clamped(degree: int, breaks: ArrayLike) -> BSpline:
        """Make an open B-spline that starts at the first control point and ends at the last.

        Parameters
        ----------
        degree
            2 or 3.
        breaks : (B,)
            The knots with both ends once: ``B + degree − 1`` control points.

        Raises
        ------
        InvalidInputError
            Fewer than two breaks, else as `open`.
        """

    @staticmethod
    def open_uniform(degree: int, control_points: int) -> BSpline:
        """Make an open, clamped B-spline with knots one apart, on [0, control_points − degree].

        Parameters
        ----------
        degree
            2 or 3.
        control_points
            Their number, from ``degree + 1`` to 2^20.

        Raises
        ------
        InvalidInputError
            Another degree or number.
        """

    @staticmethod
    def closed(degree: int, knots: ArrayLike) -> BSpline:
        """Make a closed B-spline on the knots of one period.

        Parameters
        ----------
        degree
            2 or 3.
        knots : (n + 1,)
            For n control points; not decreasing, the last one a period after the first. Any knot
            may occur ``degree`` times, which makes a corner; the first and the last are the same
            knot of the curve.

        Raises
        ------
        InvalidInputError
            Fewer than ``degree + 2`` knots, else as `open`.
        """

    @staticmethod
    def closed_uniform(degree: int, control_points: int) -> BSpline:
        """Make a closed B-spline with knots one apart, on [0, control_points].

        Parameters
        ----------
        degree
            2 or 3.
        control_points
            Their number, from ``degree + 1`` to 2^20.

        Raises
        ------
        InvalidInputError
            Another degree or number.
        """

    @property
    def degree(self) -> int:
        """Degree of the polynomial pieces, 2 or 3."""

    @property
    def is_closed(self) -> bool:
        """Whether the curve ends where it starts."""

    @property
    def control_point_count(self) -> int:
        """Number of control points that the curve needs."""

    @property
    def knots(self) -> NDArray[np.float64]:
        """The knots as `open` or `closed` takes them."""

    @property
    def domain(self) -> tuple[float, float]:
        """First and last parameter; a closed curve takes any other as well and repeats itself."""

    def basis(self, parameters: ArrayLike) -> BasisRows:
        """Evaluate the basis functions that are not zero, with their derivatives.

        At a knot the derivatives are those from the right, at the end of an open curve those from
        the left.

        Parameters
        ----------
        parameters : (N,)
            Finite; on an open curve within `domain`.

        Raises
        ------
        InvalidInputError
            Parameters elsewhere.
        """

    def evaluate(self, control_points: ArrayLike, parameters: ArrayLike) -> CurvePoints:
        """Evaluate position and derivatives of a curve.

        Parameters
        ----------
        control_points : (n, 2)
            As many as `control_point_count`, in any unit.
        parameters : (N,)
            Finite; on an open curve within `domain`.

        Raises
        ------
        InvalidInputError
            Another number of control points, one that is used and not finite, or parameters
            elsewhere.
        """

    def fit(
        self,
        outline: ArrayLike,
        parametrization: Literal["chord-length", "centripetal"] | ArrayLike,
    ) -> SplineFit:
        """Fit control points to an ordered outline by linear least squares.

        They minimise the sum of squared distances between each outline point and the curve at its
        parameter.

        Parameters
        ----------
        outline : (N, 2)
            At least as many points as control points, in any unit. Of a closed curve the first
            need not be repeated.
        parametrization : word or (N,)
            How the points get the parameters at which the curve shall meet them: in proportion to
            the length of the polygon through them, the usual choice for an outline traced at even
            steps; in proportion to the sums of the square roots of its sides, gentler at sharp
            turns (*The NURBS Book*, equation 9.6); or the parameters themselves, in any order.

        Raises
        ------
        InvalidInputError
            Too few points; points that are not finite or all coincide; parameters outside the
            domain; a control point that no outline point determines (the condition of Schoenberg
            and Whitney); more than 2^24 outline points times control points.
        """

    def arc_length(self, control_points: ArrayLike) -> ArcLength:
        """Measure the length along a curve.

        Parameters
        ----------
        control_points : (n, 2)
            As many as `control_point_count`, in any unit.

        Raises
        ------
        InvalidInputError
            Another number of control points, one that is not finite, or all in one place.
        """

    def __eq__(self, other: object, /) -> bool: ...
    def __ne__(self, other: object, /) -> bool: ...
    __hash__: None  # type: ignore[assignment]

@final
class BasisRows:
    """The weights of the control points at N parameters of a B-spline; see `BSpline.basis`.

    Every row has degree + 1 entries, for the control points that act at the parameter.
    """

    @property
    def indices(self) -> NDArray[np.int64]:
        """Which control points those are, counted from 0, (N, degree + 1); all different."""

    @property
    def values(self) -> NDArray[np.float64]:
        """Their weights, (N, degree + 1): not negative, with sum 1."""

    @property
    def first_derivatives(self) -> NDArray[np.float64]:
        """First derivatives of the weights by the parameter; their sum is 0."""

    @property
    def second_derivatives(self) -> NDArray[np.float64]:
        """Second derivatives of the weights by the parameter; their sum is 0."""

@final
class CurvePoints:
    """N points of a curve with their derivatives by the parameter; see `BSpline.evaluate`."""

    @property
    def position(self) -> NDArray[np.float64]:
        """Where the curve is, (N, 2), in the unit of the control points."""

    @property
    def first_derivative(self) -> NDArray[np.float64]:
        """Along the tangent in the direction of growing parameter, (N, 2); zero at a cusp."""

    @property
    def second_derivative(self) -> NDArray[np.float64]:
        """Its component across the tangent bends the curve, (N, 2)."""

@final
class SplineFit:
    """A least-squares fit of a B-spline and how good it is; see `BSpline.fit`."""

    @property
    def control_points(self) -> NDArray[np.float64]:
        """Control points of the fitted curve, (n, 2)."""

    @property
    def parameters(self) -> NDArray[np.float64]:
        """Parameter of every outline point, (N,)."""

    @property
    def rms_residual(self) -> float:
        """Root mean square distance of outline points and curve at their parameters."""

    @property
    def max_residual(self) -> float:
        """The largest of these distances."""

    @property
    def condition(self) -> float:
        """How many times larger a relative error of the outline can be in the control points."""

@final
class ArcLength:
    """The arc length along one curve; see `BSpline.arc_length`.

    Lengths are right to 1e-10 of the control polygon's length.
    """

    @property
    def total(self) -> float:
        """Length of the whole curve, in the unit of its control points."""

    def parameter_at(self, lengths: ArrayLike) -> NDArray[np.float64]:
        """Find the parameters at given lengths from the start of the domain.

        Parameters
        ----------
        lengths : (N,)
            On an open curve in [0, `total`]; a closed one is gone round.

        Returns
        -------
        (N,)
            Where a curve halts on its way, the parameter at which it moves on.

        Raises
        ------
        InvalidInputError
            A length that is not finite, or not on an open curve.
        """

    def equally_spaced(self, samples: int) -> NDArray[np.float64]:
        """Find parameters at equal arc length from one to the next.

        Parameters
        ----------
        samples
            How many, up to 2^20: at least 2 on an open curve, whose ends are among them, and 1 on
            a closed one, whose last is as far from the first again.

        Returns
        -------
        (samples,)
            In rising order, beginning at the start of the domain.

        Raises
        ------
        InvalidInputError
            Another number.
        """

def sample_contour(
    spline: BSpline,
    control_points: ArrayLike,
    samples: int,
    hand: Literal["left", "right"],
) -> ContourSamples:
    """Sample a curve at equal steps of arc length, with tangents and outward normals.

    Each sample stands in the middle of its step: all stand for the same length, and none falls on
    an end.

    Parameters
    ----------
    spline
        The curve's basis.
    control_points : (n, 2)
        Its control points, in any unit.
    samples
        How many, 1 to 2^20.
    hand
        The side of the direction of travel on which the hand lies, in axes like the image's:
        travelling towards +u, +v is to the right.

    Raises
    ------
    InvalidInputError
        Control points that make no curve, a curve that halts so that a sample has no tangent,
        another number or side.
    """

@final
class ContourSamples:
    """N samples of a contour at equal steps of arc length; see `sample_contour`."""

    @property
    def parameter(self) -> NDArray[np.float64]:
        """The curve's parameter, (N,)."""

    @property
    def arc_length(self) -> NDArray[np.float64]:
        """Length of the curve from its start, (N,)."""

    @property
    def position(self) -> NDArray[np.float64]:
        """Where the samples lie, (N, 2)."""

    @property
    def tangent(self) -> NDArray[np.float64]:
        """Unit tangents in the direction of travel, (N, 2)."""

    @property
    def normal(self) -> NDArray[np.float64]:
        """Unit normals, out of the hand, (N, 2)."""

@final
class Template:
    """The B-spline rest shape of the pointing hand, with its pointing axis.

    The axis runs from (−½, 0) at the knuckle to (½, 0) at the tip; because it is the basis vector
    of p, the first column of a fitted map is the pointing direction.

    Immutable; two are equal if their outlines and sides are.

    References
    ----------
    Cipolla, Hadfield & Hollinghurst 1994, section 3.2 and figure 3.
    """

    @staticmethod
    def pistol(
        thumb: Literal["left", "right", "none"] = "left",
        *,
        proportions: Mapping[str, object] | None = None,
    ) -> Template:
        """Make the template of an index finger with an up-turned thumb, or of the finger alone.

        Parameters
        ----------
        thumb
            Side of the thumb, seen along the pointing direction in the image.
        proportions
            Where the hand differs from the usual one; see `Template.proportions`.

        Raises
        ------
        InvalidInputError
            A proportion that is unknown, not a number or out of range; a thumb so near to the
            finger that there is no crotch between them.
        """

    @staticmethod
    def from_outline(
        outline: ArrayLike,
        *,
        knuckle: ArrayLike,
        tip: ArrayLike,
        hand: Literal["left", "right"],
        control_points: int | None = None,
    ) -> Template:
        """Make a template from a traced outline and its pointing axis.

        Parameters
        ----------
        outline : (N, 2)
            Points in order along the contour, in any unit and in axes like the image's; at least
            as many as control points.
        knuckle, tip : (2,)
            Where the visible finger's axis begins and ends, in the same unit.
        hand
            The side of the outline's direction of travel on which the hand lies.
        control_points
            Of the cubic B-spline that is fitted to the outline, at least 4; None for a number that
            suits finger and thumb.

        Returns
        -------
        Template
            Without a thumb or proportions: only the tracker's model "paper" takes it.

        Raises
        ------
        InvalidInputError
            Points that are too few or not finite; an axis or outline without length.
        """

    @property
    def thumb(self) -> Literal["left", "right", "none"]:
        """Side of the thumb; "none" for a finger alone and for a traced outline."""

    @property
    def hand(self) -> Literal["left", "right"]:
        """Side of the outline's direction of travel on which the hand lies."""

    @property
    def proportions(self) -> _Proportions | None:
        """What a pistol was made from; None for a traced outline."""

    @property
    def spline(self) -> BSpline:
        """Basis of the outline."""

    @property
    def control_points(self) -> NDArray[np.float64]:
        """Control points (p, q) of the outline, (n, 2)."""

    def outline(self, samples: int | None = None) -> NDArray[np.float64]:
        """Sample the outline at equal steps of arc length.

        Parameters
        ----------
        samples
            How many, 1 to 2^20; None for as many as a tracker takes.

        Returns
        -------
        (samples, 2)
            Points (p, q), up the finger's outer flank, round the tip, then round the thumb.

        Raises
        ------
        InvalidInputError
            Another number.
        """

    def __eq__(self, other: object, /) -> bool: ...
    def __ne__(self, other: object, /) -> bool: ...
    __hash__: None  # type: ignore[assignment]

# --- shape spaces ----------------------------------------------------------------------------

@final
class ShapeSpace:
    """Which deformations of a template are allowed, in D degrees of freedom.

    A planar space moves a template point m = (p, q) to

        x = c + A m,    A = [a b] = R(θ) [[α, κ], [0, β]],

    so the finger's axis lies along a, and the shear κ runs along the finger. The spaces differ in
    what of (c, θ, κ, α, β) is free. Every constructor takes a map (c, A), which is frozen in the
    space as far as the space does not free it, and returns the space with the shape vector of that
    map. `StartPose.centre_px` and `StartPose.linear_px` are such a map.

    Immutable.

    References
    ----------
    Cipolla, Hadfield & Hollinghurst 1994, section 3.2; Blake & Isard, *Active Contours*, ch. 4.
    """

    @staticmethod
    def translation(
        centre_px: ArrayLike, linear_px: ArrayLike
    ) -> tuple[ShapeSpace, NDArray[np.float64]]:
        """Free (c): the template moves and nothing else.

        Parameters
        ----------
        centre_px : (2,)
            c, the image of the middle of the finger [px].
        linear_px : (2, 2)
            A, the images of the basis vectors along and across the finger as columns [px]. Its
            determinant is positive: the thumb's side belongs to the template, not to the map.

        Returns
        -------
        space : ShapeSpace
        shape_vector : (D,)
            What stands for (c, A) in the space.

        Raises
        ------
        InvalidInputError
            A map that is not finite, mirrors the template or flattens it.
        """

    @staticmethod
    def rigid(centre_px: ArrayLike, linear_px: ArrayLike) -> tuple[ShapeSpace, NDArray[np.float64]]:
        """Free (c, θ): rigid motion in the image plane. Else as `translation`."""

    @staticmethod
    def rigid_shear(
        centre_px: ArrayLike, linear_px: ArrayLike
    ) -> tuple[ShapeSpace, NDArray[np.float64]]:
        """Free (c, θ, κ): the tracking space of the 1994 system. Else as `translation`."""

    @staticmethod
    def similarity(
        centre_px: ArrayLike, linear_px: ArrayLike
    ) -> tuple[ShapeSpace, NDArray[np.float64]]:
        """Free (c, θ, s): rigid motion and a common scale of A. Else as `translation`."""

    @staticmethod
    def similarity_shear(
        centre_px: ArrayLike, linear_px: ArrayLike
    ) -> tuple[ShapeSpace, NDArray[np.float64]]:
        """Free (c, θ, κ, s): s scales α and β, not κ. Else as `translation`."""

    @staticmethod
    def affine(
        centre_px: ArrayLike, linear_px: ArrayLike
    ) -> tuple[ShapeSpace, NDArray[np.float64]]:
        """Free (c, a, b): the acquisition space of the 1994 system. Else as `translation`."""

    @staticmethod
    def ribbon(
        template: Template, centre_px: ArrayLike, linear_px: ArrayLike, dof: int
    ) -> tuple[ShapeSpace, NDArray[np.float64]]:
        """Free the first components of the band template.

        Finger and thumb are spheres swept along two straight spines, each band as wide as the
        image shows it: unlike under a planar map, a finger keeps its width when it is
        foreshortened. The whole shape vector is (c, θ, w, τ, r, b_u, b_v, w₂): the finger's
        centre, angle, half-width and taper, and the thumb's root on the finger's spine, spine and
        half-width.

        Parameters
        ----------
        template
            A pistol; its proportions are the components that stay as they are.
        centre_px, linear_px
            As for `translation`; only the first column of ``linear_px`` is used.
        dof
            D: 2, 3, 4, 5, or 9 if the template has a thumb.

        Returns
        -------
        space : ShapeSpace
        shape_vector : (D,)

        Raises
        ------
        InvalidInputError
            A traced outline, another ``dof``, else as `translation`.
        """

    @property
    def kind(self) -> str:
        """Name of the constructor."""

    @property
    def names(self) -> list[str]:
        """What each component of the shape vector is, with its unit."""

    @property
    def dof(self) -> int:
        """Degrees of freedom D."""

    def place(
        self, shape_vector: ArrayLike, template: Template, samples: int | None = None
    ) -> PlacedContour:
        """Deform the template and place it in the image.

        Parameters
        ----------
        shape_vector : (D,)
            Finite; a map that neither mirrors nor flattens the template, half-widths that are not
            negative.
        template
            Of a band template, one with the same thumb.
        samples
            How many samples of its outline, 1 to 2^20; None for as many as a tracker takes.

        Raises
        ------
        InvalidInputError
            Another shape vector, template or number.
        """

    def normal_rows(
        self,
        shape_vector: ArrayLike,
        template: Template,
        samples: int | None = None,
        *,
        normal: ArrayLike | None = None,
    ) -> NDArray[np.float64]:
        """Differentiate the contour's motion along its normals by the shape vector.

        Parameters
        ----------
        shape_vector, template, samples
            As for `place`.
        normal : (N, 2), optional
            Unit vectors to measure along instead of the placed contour's normals.

        Returns
        -------
        (N, D)
            ∂(n·X)/∂x [px per unit of the component]: the rows that `Fitter.solve` takes.

        Raises
        ------
        InvalidInputError
            As `place`; or normals that are not N unit vectors.
        """

    def axis(self, shape_vector: ArrayLike) -> Axis:
        """Give the finger's axis in the image.

        Parameters
        ----------
        shape_vector : (D,)
            As for `place`.

        Raises
        ------
        InvalidInputError
            Another shape vector.
        """

    def axis_jacobian(self, shape_vector: ArrayLike) -> NDArray[np.float64]:
        """Differentiate the axis by the shape vector.

        Parameters
        ----------
        shape_vector : (D,)
            As for `place`.

        Returns
        -------
        (2, D)
            ∂(offset, angle)/∂x: the offset [px] at the anchor, along the axis's normal
            (−sin, cos); the angle in radians.

        Raises
        ------
        InvalidInputError
            Another shape vector.
        """

@final
class PlacedContour:
    """N samples of the template's outline in the image; see `ShapeSpace.place`."""

    @property
    def position_px(self) -> NDArray[np.float64]:
        """Where the samples stand [px], (N, 2)."""

    @property
    def normal(self) -> NDArray[np.float64]:
        """Unit normals, out of the hand, (N, 2)."""

    @property
    def hidden(self) -> NDArray[np.bool_]:
        """Whether the sample lies inside another limb, where there is no edge, (N,)."""

@final
class Axis:
    """The finger's axis in the image; see `ShapeSpace.axis`."""

    @property
    def anchor_px(self) -> tuple[float, float]:
        """A point of the axis: the middle of the visible finger [px]."""

    @property
    def tip_px(self) -> tuple[float, float]:
        """The end of the axis at the finger's apex [px]."""

    @property
    def angle_rad(self) -> float:
        """Direction of pointing [rad], in (−π, π]."""

# --- search and fit --------------------------------------------------------------------------

@final
class EdgeSearch:
    """Looks for edges along the normals of a contour.

    Every line samples the image at whole pixels along its normal, correlates the profile with the
    derivative of a Gaussian of scale s and reports where the response peaks, to a fraction of a
    pixel. With edge blur σ_b, S² = s² + σ_b², contrast A and white noise σ_n the offset has the
    variance (3√π / 4) σ_n² S⁶ / (A² s⁵) per independent pixel of contour: the noise of the
    response's slope over the squared curvature of a blurred step's response at its peak.

    Immutable: one may search in several threads at once.

    References
    ----------
    Canny 1986 for the operator; Cipolla & Blake 1992 for the search along normals.
    """

    def __new__(cls, options: Mapping[str, object] | None = None) -> EdgeSearch:
        """Make a search with the given options.

        Parameters
        ----------
        options
            What differs from the defaults: ``scale_px``, ``blur_px``, ``noise_grey``,
            ``min_contrast_grey``.

        Raises
        ------
        InvalidInputError
            An option that is unknown, not a number or out of range.
        """

    @property
    def options(self) -> _SearchOptions:
        """Every option in force."""

    def search(
        self,
        image: NDArray[np.uint8],
        position_px: ArrayLike,
        normal: ArrayLike,
        half_length_px: ArrayLike,
        polarity: Literal["bright", "dark", "unknown"],
        *,
        scale: Literal["fine", "coarse"] = "fine",
    ) -> SearchLines:
        """Search along lines.

        Parameters
        ----------
        image : (height, width)
            Grey levels; not copied.
        position_px : (N, 2)
            Where the lines cross the contour [px]; outside the image they are misses.
        normal : (N, 2)
            Unit vectors along the lines, out of the hand.
        half_length_px : (N,) or scalar
            How far to look to either side [px], above 0 and up to 128; rounded up to whole pixels.
        polarity
            Whether the hand is brighter or darker than what is behind it.
        scale
            A kernel of the option ``scale_px``; or a larger one, which sees an edge that motion
            has smeared.

        Returns
        -------
        SearchLines
            One line per position, in the same order.

        Raises
        ------
        InvalidInputError
            An image that is not as described above, positions that are not finite, normals that
            are no unit vectors, lengths out of range, arrays that do not match.
        """

@final
class SearchLines:
    """N lines that were searched, and what was found; see `EdgeSearch.search`.

    A line without an edge is a *miss*: its numbers are NaN, never 0.
    """

    @property
    def position_px(self) -> NDArray[np.float64]:
        """Where the lines cross the contour [px], (N, 2)."""

    @property
    def normal(self) -> NDArray[np.float64]:
        """Unit vectors along the lines, out of the hand, (N, 2)."""

    @property
    def half_length_px(self) -> NDArray[np.float64]:
        """How far each line goes to either side [px], (N,)."""

    @property
    def offset_px(self) -> NDArray[np.float64]:
        """Signed distance of the edge from the position along the normal [px], (N,)."""

    @property
    def contrast_grey(self) -> NDArray[np.float64]:
        """Contrast of the edge, hand minus background [grey levels], (N,)."""

    @property
    def variance_px2(self) -> NDArray[np.float64]:
        """Variance of the offset from image noise alone [px²], (N,)."""

    @property
    def separation(self) -> NDArray[np.float64]:
        """Mean log-likelihood ratio inside minus outside, (N,); NaN without an appearance."""

    @property
    def agrees(self) -> NDArray[np.bool_] | None:
        """Whether the edge agrees with the tracker's fit, (N,); False for a miss.

        None for lines of an `EdgeSearch`, to which nothing was fitted.
        """

    @property
    def miss(self) -> NDArray[np.str_]:
        """Why there is no edge, (N,); empty where there is one.

        "out-of-image": too little of the line lies inside the image. "no-contrast": no response of
        the right polarity reaches the least contrast. "beyond-end": the response still rises
        where the line ends.
        """

    def __len__(self) -> int: ...

@final
class Background:
    """What a camera that keeps still sees when no hand is there.

    Every pixel keeps the level that it shows most of the time. The light of a frame is fitted as
    gain · background + offset; what is left is the foreground, unless a shadow explains it. When
    most of the image changes for some frames, the camera has moved and the background is learned
    anew.

    References
    ----------
    Stauffer & Grimson 1999; Horprasert, Harwood & Davis 1999 for shadows.
    """

    def __new__(cls, options: Mapping[str, object] | None = None) -> Background:
        """Make a background that has seen nothing.

        Parameters
        ----------
        options
            What differs from the defaults; see the property ``options``.

        Raises
        ------
        InvalidInputError
            An option that is unknown, of another type or out of range.
        """

    def observe(
        self,
        image: NDArray[np.uint8],
        colour: NDArray[np.uint8] | None = None,
        *,
        keep_out: tuple[ArrayLike, ArrayLike, float] | None = None,
    ) -> None:
        """Take one frame: estimate its light, and learn from what agrees.

        Parameters
        ----------
        image : (height, width)
            Grey levels; not copied. Another size starts a new background.
        colour : (height, width, 3), optional
            Colours of the same frame.
        keep_out
            A part of the image that is not learned: two ends (u, v) of a segment [px], and the
            radius around it [px].

        Raises
        ------
        InvalidInputError
            An image that cannot be used, or a part to keep out that is not finite or has no
            radius.
        FingerpostError
            The background is in use in another thread.
        """

    def look(self, image: NDArray[np.uint8], colour: NDArray[np.uint8] | None = None) -> None:
        """Look at a frame without learning from it.

        Its light is estimated and a camera that has moved is noticed; from then on all that is told
        of the background holds for this frame. `observe` is this and then `learn`.

        Parameters
        ----------
        image : (height, width)
            Grey levels; not copied. Another size starts a new background.
        colour : (height, width, 3), optional
            Colours of the same frame.

        Raises
        ------
        InvalidInputError
            An image that cannot be used.
        FingerpostError
            The background is in use in another thread.
        """

    def learn(
        self,
        image: NDArray[np.uint8],
        colour: NDArray[np.uint8] | None = None,
        *,
        keep_out: tuple[ArrayLike, ArrayLike, float] | None = None,
    ) -> None:
        """Learn from the frame that was looked at last.

        Parameters
        ----------
        image, colour, keep_out
            As for `observe`.

        Raises
        ------
        InvalidInputError, FingerpostError
            As for `observe`.
        """

    def forget(self, part: tuple[ArrayLike, ArrayLike, float]) -> None:
        """Forget a part of the image, such as a hand that has stood there from the start.

        Parameters
        ----------
        part
            Two ends (u, v) of a segment [px], and the radius around it [px].

        Raises
        ------
        InvalidInputError
            A part that is not finite or has no radius.
        """

    def clear(self) -> None:
        """Forget everything."""

    @property
    def is_known(self) -> bool:
        """Whether it has lasted long enough to tell the foreground from it."""

    @property
    def is_exact(self) -> bool:
        """Whether it is known and its edges are where the last frame shows them.

        A camera that is bumped by a part of a pixel changes few pixels by much, but no edge is
        where it was.
        """

    @property
    def shift_px(self) -> tuple[float, float] | None:
        """How far the last frame shows it from where it was learned [px], (u, v).

        None where too few edges tell. Beyond a pixel it is no more than a sign that it has moved.
        """

    @property
    def light(self) -> tuple[float, float]:
        """Gain and offset [grey levels] of the last frame's light over the background's."""

    @property
    def changed_share(self) -> float:
        """Part of the pixels that would show a motion of the camera and have changed, 0 to 1."""

    @property
    def options(self) -> _BackgroundOptions:
        """Every option in force."""

    def expected(self, position_px: ArrayLike) -> NDArray[np.float64]:
        """Tell the grey levels to expect where nothing stands before the background.

        Parameters
        ----------
        position_px : (N, 2)
            Places [px].

        Returns
        -------
        (N, 2)
            Grey level in the light of the last frame, and its standard deviation, without the
            noise of a frame that it is compared with; NaN where it is unknown.
        """

    def foreground(
        self,
        image: NDArray[np.uint8],
        position_px: ArrayLike,
        colour: NDArray[np.uint8] | None = None,
    ) -> NDArray[np.float64]:
        """Tell how likely some places of a frame show something before the background.

        Parameters
        ----------
        image, colour
            As for `observe`.
        position_px : (N, 2)
            Places [px]; the nearest pixels count.

        Returns
        -------
        (N,)
            0 to 1; NaN where the background is unknown.
        """

    def foreground_map(
        self, image: NDArray[np.uint8], colour: NDArray[np.uint8] | None = None
    ) -> NDArray[np.uint8]:
        """Tell the same for every second pixel of every second row.

        Returns
        -------
        (⌈height / 2⌉, ⌈width / 2⌉)
            0 for background, 255 for foreground; all 0 while the background is unknown.
        """

@final
class HandFinder:
    """Finds where in an image a pointing hand may be.

    A template of a finger's round end and flanks is scored at every place, angle and size,
    coarsely; the best places are looked at closely. What comes out are candidates: only a fit, and
    the other views, can tell.

    References
    ----------
    Hinterstoisser et al. 2012 for spread orientations and their fast sums.
    """

    def __new__(cls, options: Mapping[str, object] | None = None) -> HandFinder:
        """Make a finder.

        Parameters
        ----------
        options
            What differs from the defaults; see the property ``options``.

        Raises
        ------
        InvalidInputError
            An option that is unknown, of another type or out of range.
        """

    def find(
        self,
        image: NDArray[np.uint8],
        colour: NDArray[np.uint8] | None = None,
        *,
        background: Background | None = None,
    ) -> list[Candidate]:
        """Find the candidates in a frame, the likeliest first.

        Parameters
        ----------
        image : (height, width)
            Grey levels; not copied.
        colour : (height, width, 3), optional
            Colours of the same frame; with them fingers are told better from what is around.
        background
            What is known of the background; where it is, what has come into view goes first.

        Raises
        ------
        InvalidInputError
            An image that cannot be used.
        FingerpostError
            The finder or the background is in use in another thread.
        """

    @staticmethod
    def likeness(
        image: NDArray[np.uint8],
        tip_px: ArrayLike,
        angle_rad: float,
        half_width_px: float,
        colour: NDArray[np.uint8] | None = None,
    ) -> float | None:
        """Tell how like a finger a band is, by how its inside differs from what is about it.

        Each half of a band that is lit from one side may differ by its colours, or by their
        chromaticity alone.

        Parameters
        ----------
        image, colour
            As for `find`.
        tip_px, angle_rad
            Where the band ends, and in which direction it leads there.
        half_width_px
            Half its width [px], > 0.

        Returns
        -------
        float or None
            0 to 1; None if too little of it and of what is about it lies in the image.

        Raises
        ------
        InvalidInputError
            Arrays of another type or shape, a place that is none or not finite, no width.
        """

    @property
    def options(self) -> _FinderOptions:
        """Every option in force."""

@final
class Candidate:
    """A place where a pointing hand may be."""

    @property
    def start(self) -> StartPose:
        """Where a template would wait for it."""

    @property
    def half_width_px(self) -> float:
        """Half the finger's width [px]."""

    @property
    def thumb(self) -> Literal["left", "right", "none"]:
        """Side of a second band that may be its thumb."""

    @property
    def colour(self) -> tuple[float, float, float]:
        """Mean colour of its inside; a grey level three times."""

    @property
    def foreground(self) -> float:
        """How like foreground its inside is, 0 to 1; 0 while no background is known."""

    @property
    def score(self) -> float:
        """How like a finger it is by its shape and colours alone, 0 to 1."""

@final
class PlaneLevel:
    """Chosen pixels of the working plane at one level of a first image's pyramid.

    Parameters
    ----------
    positions_px : (N, 2)
        Where a pinhole shows them at full resolution [px].
    levels : (N,)
        Grey levels of the smoothed level.
    gradients : (N, 2)
        By a position at full resolution [levels/px].
    variances : (N,)
        Of an inlier's residual [levels²], positive.
    squares : sequence of int
        The square of pixels that each belongs to, in ascending order: each has a gain and an
        offset of its own.
    scale
        Size of the level over that of the image, at most 1.
    non_similarity_sigma
        Standard deviation of the change between two images of what a homography has beside a
        similarity, in unit coordinates.
    unit_from_px : (3, 3)
        From pixels at full resolution to coordinates of order 1, in which steps are computed: a
        scale and a shift.
    lens : seven floats, optional
        fx, fy, cx, cy, k1, k2 and the greatest radius, as `Lens.radial` gives them.

    Raises
    ------
    InvalidInputError
        Numbers that are not finite, or columns of different lengths.
    """

    def __new__(
        cls,
        positions_px: ArrayLike,
        levels: ArrayLike,
        gradients: ArrayLike,
        variances: ArrayLike,
        squares: Sequence[int],
        *,
        scale: float,
        non_similarity_sigma: float,
        unit_from_px: ArrayLike,
        lens: tuple[float, float, float, float, float, float, float] | None = None,
    ) -> PlaneLevel: ...

@final
class PlaneRegistration:
    """Registers the working plane of a first image with later ones.

    Iterated least squares on grey levels over the eight entries of a homography (inverse
    compositional: Baker & Matthews 2004), from the coarsest level to the full resolution; Tukey's
    biweight rejects what covers the plane, and pixels that are often outliers lose weight.

    Parameters
    ----------
    levels
        Of one view, from full resolution down; copied.
    points_px : (M, 2)
        Where accuracy is required, as a pinhole shows it in the first image [px].

    Raises
    ------
    InvalidInputError
        No level, or unit coordinates that are none.
    """

    def __new__(cls, levels: Sequence[PlaneLevel], points_px: ArrayLike) -> PlaneRegistration: ...
    def align(
        self,
        smooth: Sequence[NDArray[np.uint8]],
        guess: ArrayLike,
        hand: tuple[ArrayLike, ArrayLike, float] | None = None,
    ) -> RegisteredPlane | None:
        """Register an image.

        Parameters
        ----------
        smooth
            Its smoothed pyramid, a level for each of the first image's, from full resolution down.
        guess : (3, 3)
            Homography from the first image to this one, accurate to a few pixels.
        hand
            Region that is not the plane: two ends of a segment [px], and the radius about it [px].

        Returns
        -------
        RegisteredPlane or None
            None where too little of the plane is visible.

        Raises
        ------
        InvalidInputError
            Another number of levels, or numbers that are not finite.
        """

@final
class RegisteredPlane:
    """The working plane as it lies in an image."""

    @property
    def now_from_first(self) -> NDArray[np.float64]:
        """(3, 3) Homography from the pinhole's pixels of the first image to those of this one."""
    @property
    def step_covariance(self) -> NDArray[np.float64]:
        """(8, 8) Covariance of a step before it, its entries but the last, in unit coordinates."""
    @property
    def inlier_share(self) -> float:
        """Part of the expected pixels' information that inliers have, 0 to 1."""
    @property
    def inliers(self) -> int:
        """Number of inliers among the expected pixels."""

@final
class RoundFinger:
    """The finger whose shading, as a round body's, explains best what is seen about an axis.

    Before a table as bright as one side of it, a finger lit from the other shows where it turns
    from the light, and not where it ends. But a round body is shaded as one, and that tells how
    wide it is and where its middle lies.
    """

    @staticmethod
    def fit(
        image: NDArray[np.uint8],
        anchor_px: ArrayLike,
        tip_px: ArrayLike,
        half_width_px: float,
        colour: NDArray[np.uint8] | None = None,
    ) -> RoundFinger | None:
        """Fit it to what is seen about an axis.

        Parameters
        ----------
        image : (height, width)
            Grey levels.
        anchor_px, tip_px : (2,)
            The middle and the tip of a finger, on the line between the edges that show [px].
        half_width_px
            Half the way from one of them to the other [px], positive.
        colour : (height, width, 3), optional
            Colours, which are looked at instead of the grey levels.

        Returns
        -------
        RoundFinger or None
            None where what is looked at is not all in the picture: 1 to 6 half-widths behind the
            tip, and 2 to either side.

        Raises
        ------
        InvalidInputError
            A number that is not finite, a tip at the anchor, a half-width that is not positive, or
            pictures that are none.
        """

    @property
    def offset_px(self) -> float:
        """How far beside the anchor its axis runs, to the side of the normal (−sin, cos) [px]."""

    @property
    def turn_rad(self) -> float:
        """By how much its axis is turned against the given one [rad]."""

    @property
    def half_width_px(self) -> float:
        """Half its width at the anchor [px]."""

    @property
    def misfit(self) -> float:
        """How much what is seen differs from it: a robust sum over all pixels, in no unit."""

    @property
    def misfit_about_given(self) -> float:
        """The same of the body about the given axis that explains most."""

@final
class Fitter:
    """Weighted least squares for the step of a shape vector.

    Every equation says that a step δ should move the contour by the measured offset along one
    normal. Gross errors lose their weight (Tukey's biweight, iterated); what the residual offsets
    scatter beyond their variances is misfit of the model and is added to all alike. A direction
    that the equations leave open is reported, not chosen.

    Immutable: one may solve in several threads at once.
    """

    def __new__(cls, options: Mapping[str, object] | None = None) -> Fitter:
        """Make a solver with the given options.

        Parameters
        ----------
        options
            What differs from the defaults: ``loss``, ``solve``, ``max_iterations``,
            ``min_scale_px``.

        Raises
        ------
        InvalidInputError
            An option that is unknown, of another type or out of range.
        """

    @property
    def options(self) -> _FitOptions:
        """Every option in force."""

    def solve(
        self,
        rows: ArrayLike,
        offset_px: ArrayLike,
        variance_px2: ArrayLike,
        *,
        prior: tuple[ArrayLike, ArrayLike] | None = None,
    ) -> FitReport:
        """Find the step that the equations, and the prior if there is one, agree on.

        Parameters
        ----------
        rows : (N, D)
            ∂(n·X)/∂x of every measurement, as from `ShapeSpace.normal_rows`; D from 1 to 9.
        offset_px : (N,)
            Measured offsets [px]. Leave misses out.
        variance_px2 : (N,)
            Their variances [px²], positive.
        prior : ((D,), (D, D)), optional
            Mean and information (inverse covariance) of a belief about the step; the information
            is symmetric without negative eigenvalues, and zero where nothing is believed.

        Raises
        ------
        InvalidInputError
            Arrays of other shapes or not finite; variances that are not positive; a prior that is
            no information matrix.
        """

@final
class FitReport:
    """What a fit found, and how well; see `Fitter.solve`."""

    @property
    def outcome(self) -> Literal["determined", "too-few-equations", "undetermined"]:
        """Whether there is a step; with fewer equations than unknowns and no prior, there is none.

        "undetermined": equations and prior leave D − `rank` directions of the shape space open.
        """

    @property
    def step(self) -> NDArray[np.float64] | None:
        """The step δ, (D,); None unless determined."""

    @property
    def covariance(self) -> NDArray[np.float64] | None:
        """Covariance of the step, scaled by the residuals, (D, D); None unless determined."""

    @property
    def information(self) -> NDArray[np.float64]:
        """Sum of weight · row rowᵀ / variance over the equations, plus the prior's, (D, D)."""

    @property
    def rank(self) -> int:
        """How many directions of the shape space the information determines."""

    @property
    def iterations(self) -> int:
        """Solutions computed until the weights settled."""

    @property
    def equations(self) -> int:
        """Equations given."""

    @property
    def inliers(self) -> int:
        """Equations with more than a tenth of their full weight."""

    @property
    def residual_rms_px(self) -> float:
        """Root mean square of the inliers' residual offsets [px]."""

    @property
    def residual_scale_px(self) -> float:
        """Robust standard deviation of the residual offsets [px]."""

    @property
    def residual_px(self) -> NDArray[np.float64]:
        """Residual offset of every equation [px], (N,); the offset itself unless determined."""

    @property
    def weight(self) -> NDArray[np.float64]:
        """Robust weight of every equation, 0 to 1, (N,)."""

# --- tracking --------------------------------------------------------------------------------

@final
class StartPose:
    """Where the template waits for the hand.

    Immutable; two are equal if their numbers are.
    """

    def __new__(cls, tip_px: ArrayLike, angle_rad: float, length_px: float) -> StartPose:
        """Make a pose.

        Parameters
        ----------
        tip_px : (2,)
            The finger's tip [px]; it may lie outside the image.
        angle_rad
            Direction of pointing [rad], from +u (right) towards +v (down).
        length_px
            Visible length of the index finger [px], positive.

        Raises
        ------
        InvalidInputError
            A value that is no number, not finite or, of the length, not positive.
        """

    @property
    def tip_px(self) -> tuple[float, float]:
        """The finger's tip [px]."""

    @property
    def angle_rad(self) -> float:
        """Direction of pointing [rad]."""

    @property
    def length_px(self) -> float:
        """Visible length of the index finger [px]."""

    @property
    def centre_px(self) -> NDArray[np.float64]:
        """Where the undeformed template's origin stands in this pose [px], (2,)."""

    @property
    def linear_px(self) -> NDArray[np.float64]:
        """Its basis vectors along and across the finger, as columns [px], (2, 2)."""

    def __eq__(self, other: object, /) -> bool: ...
    def __ne__(self, other: object, /) -> bool: ...
    __hash__: None  # type: ignore[assignment]

@final
class ContourTracker:
    """Follows one hand in one view: *acquiring*, *tracking*, *lost*.

    The template waits at its start pose until a hand is held up to it, takes on the hand's
    dimensions, and follows it from then on. After some frames without an accepted fit the hand is
    lost, and looked for where it last was and where the template first waited.

    The same frames and times give the same bits again. Trackers of their own run in parallel
    threads; one tracker works in one thread at a time.

    References
    ----------
    Cipolla, Hadfield & Hollinghurst 1994, section 3.2.
    """

    def __new__(
        cls, template: Template, start: StartPose, options: Mapping[str, object] | None = None
    ) -> ContourTracker:
        """Make a tracker whose template waits at ``start``.

        Parameters
        ----------
        template
            A pistol; for the model "paper" also a traced outline.
        start
            Where it waits.
        options
            What differs from the defaults, in nested dictionaries; see the property ``options``
            for all there are.

        Raises
        ------
        InvalidInputError
            An option that is unknown, of another type or out of range; a traced outline for the
            model "ribbon".
        """

    @staticmethod
    def at_hand(
        template: Template, start: StartPose, options: Mapping[str, object] | None = None
    ) -> ContourTracker:
        """Make a tracker whose hand is believed to be at ``start`` already.

        The first frame is fitted there at once, from the template's own width, where a template
        that waits tries several places, angles and widths. When that frame shows no hand there,
        the template waits.

        Parameters
        ----------
        template, start, options
            As for the class itself.

        Raises
        ------
        InvalidInputError
            As for the class itself.
        """

    @property
    def template(self) -> Template:
        """The template."""

    @property
    def options(self) -> _TrackerOptions:
        """Every option in force."""

    @property
    def foreshortening(self) -> float:
        """By how much the view shows the finger shorter than it is, above 0 and at most 1.

        The sine of the angle between the finger and the ray to its tip; 1 until it is set by
        whoever knows it from other views. The line of a finger is told for its front, which is
        known by its width, and that is not foreshortened.

        Raises
        ------
        InvalidInputError
            It is set to a value out of range.
        FingerpostError
            The tracker is in use in another thread.
        """

    @foreshortening.setter
    def foreshortening(self, value: float) -> None: ...
    def update(
        self,
        image: NDArray[np.uint8],
        time_s: float,
        colour: NDArray[np.uint8] | None = None,
        *,
        background: Background | None = None,
    ) -> Track:
        """Take one frame and tell where the hand is.

        Parameters
        ----------
        image : (height, width) or (height, width, 3)
            Grey levels, or blue, green and red as OpenCV has them; not copied, and not to be
            written to meanwhile. Edges are measured in grey (ITU-R BT.601 luma); by its colours
            the hand is told from what is behind it. Three channels that do not differ are grey.
        time_s
            When it was captured [s], not before the last frame.
        colour : (height, width, 3), optional
            Colours of the same frame beside grey levels of their own, in any order of channels
            that stays the same; not copied.
        background
            What is behind the hand, after `Background.look` at this frame. Its edges are not taken
            for the hand's, and the finger line is measured before what it shows; what the frame
            contradicts does not count. A hand that has stood there while it was learned is part
            of it.

        Raises
        ------
        InvalidInputError
            An image that is empty, more than 32767 px wide or high, of rows of more than 131071
            bytes or not as described above, colours of another size, a background of another size,
            a time that is not finite or runs backwards. The tracker is as it was before.
        FingerpostError
            The tracker or the background is in use in another thread.
        """

    def contour(self) -> NDArray[np.float64]:
        """Give the contour as it stands after the last frame, or where it waits.

        Returns
        -------
        (N, 2)
            Points [px]; those that another limb hides are left out.
        """

    def search_lines(self) -> SearchLines:
        """Give the last search along the normals, without lines before the first frame."""

def update_views(
    views: Sequence[
        tuple[ContourTracker, NDArray[np.uint8], float, NDArray[np.uint8] | None, Background | None]
    ],
    *,
    schedule: Literal["by-need", "in-turn", "side-by-side"] | None = None,
) -> list[Track | FingerpostError]:
    """Take one frame of every view and tell where the hand is in each, in one call.

    Parameters
    ----------
    views
        For each view its tracker, grey levels, capture time [s], colours or None and background or
        None, as `ContourTracker.update` takes them: images are not copied. No tracker comes twice.
    schedule
        Who does the work: one thread "in-turn"; a thread for each view, "side-by-side"; or, by
        default, threads of their own for views that look for their hand, which takes milliseconds,
        and this thread for those that follow it, "by-need". The tracks are the same to the bit.

    Returns
    -------
    list
        In the order of the views: what each tracker made of its frame, or the error that
        `ContourTracker.update` raises for it. The error of one view costs no other its track.

    Raises
    ------
    InvalidInputError
        A schedule that is none of these, or a view of other than five entries.
    """

@final
class Track:
    """What one frame told; see `ContourTracker.update`."""

    @property
    def time_s(self) -> float:
        """When the frame was captured [s]."""

    @property
    def status(self) -> Literal["acquiring", "tracking", "lost"]:
        """Where the tracker is after the frame."""

    @property
    def finger_line(self) -> FingerLine | None:
        """The finger line; None unless the hand is tracked and the frame's fit was accepted."""

    @property
    def shape_names(self) -> list[str]:
        """What each component of the shape vector is, with its unit."""

    @property
    def shape_vector(self) -> NDArray[np.float64] | None:
        """The fitted shape, (D,); None unless the frame's fit was accepted."""

    @property
    def shape_covariance(self) -> NDArray[np.float64] | None:
        """Covariance of the shape vector, (D, D); None unless the frame's fit was accepted."""

    @property
    def diagnostics(self) -> Diagnostics:
        """Why the frame went the way it did."""

@final
class FingerLine:
    """The image line that the finger points along."""

    @property
    def anchor_px(self) -> tuple[float, float]:
        """The point of the line at which `covariance` holds [px].

        The middle of what the line was measured on.
        """

    @property
    def tip_px(self) -> tuple[float, float]:
        """The finger's apex, on the line [px]."""

    @property
    def angle_rad(self) -> float:
        """Direction of pointing [rad], from +u towards +v, in (−π, π]."""

    @property
    def half_length_px(self) -> float:
        """Half the length of what the line was measured on [px], positive."""

    @property
    def stretch_px(self) -> tuple[float, float]:
        """Where the stretch that the line is told for begins and ends [px].

        Along it from the anchor, the end nearer to the tip last. The line cuts a slightly bent
        finger where the line of least squares over that stretch does: in front of its middle and
        behind it, by 1 / √3 of half its length. A finger that a lens bends is straight again there.
        """

    @property
    def covariance(self) -> NDArray[np.float64]:
        """Covariance of (offset, angle), (2, 2).

        The offset [px] is along the line's normal (−sin, cos) at the anchor, the angle in radians.
        """

    @property
    def source(self) -> Literal["contour", "pixels", "both"]:
        """What it was measured on.

        The contour is the axis of the fitted template, pixels the line of maximum likelihood given
        what the camera recorded near the flanks, where that can be believed. Where it is to be
        believed only in part, the two are weighed.
        """

@final
class Diagnostics:
    """Why a frame went the way it did."""

    @property
    def visible(self) -> int:
        """Samples of the contour that no other limb hides."""

    @property
    def hits(self) -> int:
        """Lines of the frame's last search that found an edge."""

    @property
    def inliers(self) -> int:
        """Edges that agree with the fit."""

    @property
    def agreement(self) -> float:
        """Part of the finger's visible samples whose edges agree with the fit, 0-1.

        Of the contour's for the paper's model. A thumb, which bends, does not count.
        """

    @property
    def min_agreement(self) -> float:
        """The least agreement with which the frame's fit counted; above 1 if none would do."""

    @property
    def residual_rms_px(self) -> float:
        """Root mean square of the residual offsets of those [px]."""

    @property
    def max_residual_px(self) -> float:
        """The largest with which the frame's fit counted [px]."""

    @property
    def rank(self) -> int:
        """Directions of the shape space that the measurements determine."""

    @property
    def iterations(self) -> int:
        """Searches along the normals in the last shape space."""

    @property
    def accepted(self) -> bool:
        """Whether the fit was determined and accepted."""

    @property
    def refusal(
        self,
    ) -> (
        Literal["no-fit", "size", "motion", "agreement", "residual", "background", "misfit"] | None
    ):
        """Why the fit was not accepted; None if it was.

        "no-fit": none was determined that could be a finger. "size": it is much wider, slimmer or
        more tapered than the hand that is followed. "motion": no hand moves like that.
        "agreement", "residual": too few edges agree with it, or they lie too far from it.
        "background": it lies on a table that is known, or inside of what stands before that.
        "misfit": the finger is bent, so that no straight line is its axis.
        """

    @property
    def innovation(self) -> float | None:
        """How much place and angle of a fit surprise, as a normalised square.

        3 on average for a hand that moves as the option ``track.dynamics`` says; above 21 once in
        10,000 frames. None where nothing foretold them.
        """

    @property
    def bend_rad(self) -> float | None:
        """How much the finger is bent, as the image shows it [rad].

        The direction of the part with the tip minus that of the part with the knuckle. Beyond 0.35
        (20°) the fit is a "misfit", if it is so by two standard deviations or in the second frame
        in a row; from then on until it is below 0.26 (15°) and the tip is seen, or a frame that
        does not tell it shows the contour whole. A view sees only what of a bend lies across its
        line of sight. None where the flanks of either part do not tell, for a fit that is refused
        for another reason, and for the paper's model.
        """

@final
class EdgePoints:
    """Edges along a path, one for each stretch of it that has one, in its order."""

    def __len__(self) -> int: ...
    @property
    def position_px(self) -> NDArray[np.float64]:
        """Where they are, (N, 2) [px]."""

    @property
    def offset_px(self) -> NDArray[np.float64]:
        """Their distances from the path along its normal, (N,) [px]."""

    @property
    def contrast(self) -> NDArray[np.float64]:
        """The steps of grey levels across them, (N,); positive where they rise along the normal."""

    @property
    def sigma_px(self) -> NDArray[np.float64]:
        """Standard deviations of the distances by noise of 2 grey levels, and roughness [px]."""

@final
class LineFit:
    """The line that most of some edges lie on."""

    @property
    def point_px(self) -> tuple[float, float]:
        """A point of it, in the middle of its edges [px]."""

    @property
    def angle_rad(self) -> float:
        """Its direction [rad]: up to a half turn, for edges tell no more."""

    @property
    def covariance(self) -> NDArray[np.float64]:
        """Of the offset at the point along the normal [px] and the angle [rad], (2, 2)."""

    @property
    def share(self) -> float:
        """The part of the edges that lie on it, from 0 to 1."""

    @property
    def inliers(self) -> NDArray[np.bool_]:
        """Which edges lie on it, (N,)."""

    @property
    def rms_px(self) -> float:
        """Root mean square of their residuals [px]."""

def edges_along(
    image: NDArray[np.uint8],
    path_px: ArrayLike,
    reach_px: float,
    polarity: int,
    least_contrast: float,
) -> EdgePoints:
    """Locate an edge along a path, to part of a pixel.

    Rows or columns of pixels across each of some 32 stretches of the path, at most 8 px long, are
    taken together and correlated with the derivative of a Gaussian, which moves over them: no
    pixel is interpolated, and no place in the pixel grid is preferred.

    Parameters
    ----------
    image
        (H, W) Grey levels.
    path_px
        (K, 2) Corners of a polyline that runs near the edge [px]. Parts of it so near to the
        border that the kernel leaves the image have no edges.
    reach_px
        How far from the path edges are looked for, 0.5 to 100 [px].
    polarity
        1 for edges that rise along the normal, which is the path's direction turned by 90° from +u
        towards +v; -1 for those that fall; 0 for both.
    least_contrast
        The least step of an edge [grey levels].

    Raises
    ------
    InvalidInputError
        Another reach or polarity, or a path that is not finite.
    """

def fit_line(points_px: ArrayLike, sigmas_px: ArrayLike) -> LineFit | None:
    """Fit the line that most edges lie on, by least squares with biweights.

    The covariance follows from the residuals: neighbours that err alike count as fewer.

    Parameters
    ----------
    points_px
        (N, 2) [px]
    sigmas_px
        (N,) Standard deviation of each, up to one factor, > 0 [px].

    Returns
    -------
    LineFit or None
        None for fewer than 5 points, or if they lie on no line.

    Raises
    ------
    InvalidInputError
        Other numbers of both, or values that are not finite.
    """
