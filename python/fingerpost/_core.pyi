"""The stages of the contour tracker, written in Rust (crate ``fingerpost-core``).

A frame is processed in three stages: `EdgeSearch` measures edges along the normals of a contour,
`Fitter` solves for a step of the shape vector in a `ShapeSpace`, and the fit is accepted or
refused. `ContourTracker` runs them for one hand in one view, from the `Template` at its start pose
to the finger line of every frame. Tracking needs only `Template`, `StartPose` and
`ContourTracker`; the other classes are for study, for tests and for other trackers.

Conventions
-----------
Pixel (0, 0) is the centre of the top-left pixel; u points right and v down; a point is (u, v).
Angles are in radians from +u towards +v. Template coordinates (p, q) have their origin in the
middle of the visible index finger, whose length is 1; p points towards the tip, q to the right of
the pointing direction.

*Images* are NumPy arrays of ``uint8``. They are not copied, and the stride between rows may be
any. The pixels of a row must be contiguous and the rows must follow one another in memory: a
cropped image is accepted; one that is mirrored, transposed or a single channel of another needs
`numpy.ascontiguousarray`. Do not write to an image while a call uses it.

*Other arrays* may be anything that NumPy reads as real numbers. Returned arrays are read-only.

*Options* are nested dictionaries with the values that differ from the defaults. The property
``options`` of every stage returns all values in force. An unknown key is refused with its path.

*Threads*: a call that takes longer than some microseconds releases the GIL. Objects are immutable
and may be shared between threads, except `ContourTracker`, `Background`, `HandFinder` and
`PlaneRegistration`: while a call on one of these runs in one thread, any use of it in another
raises `fingerpost.errors.FingerpostError`.

Invalid input raises `fingerpost.errors.InvalidInputError`, a `ValueError` whose message states the
value and the valid ones. An object of the wrong class raises `TypeError`. The absence of a hand is
a status, not an error.
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
    """Options of a `Background`."""

    learn_frames: int
    """Number of observations of a level from which its pixel is known, 1 to 200."""
    rate: float
    """Learning rate of the running mean and variance of a pixel, 0.001 to 1."""
    absorb_frames: int
    """Number of frames after which a new object becomes background, 4 to 1000."""
    noise_grey: float
    """Least standard deviation of a pixel about its level [grey levels], 0.1 to 64."""
    changed_sigmas: float
    """Difference from its level beyond which a pixel has changed [standard deviations], 1 to 20."""
    shadow_light: float
    """Ratio of brightness in the deepest shadow, 0 to 1; 1 if there are no shadows."""
    void_share: float
    """Fraction of changed pixels above which the camera has moved, 0 to 1.

    Only pixels that would show a motion of the camera count.
    """

class _FinderOptions(TypedDict, total=False):
    """Options of a `HandFinder`."""

    min_half_width: float
    """Half-width of the slimmest finger, as a fraction of the image's longer side, 0.003 to 0.1."""
    max_half_width: float
    """Half-width of the widest finger, as the same fraction, above the minimum and up to 0.2."""
    min_gradient_grey: float
    """Minimum change of brightness from cell to cell at an edge [grey levels], 1 to 100."""
    candidates: int
    """Maximum number of candidates, 1 to 100."""

class _SearchOptions(TypedDict, total=False):
    """Options of an `EdgeSearch`."""

    scale_px: float
    """Scale s of the derivative of Gaussian [px], 0.5 to 8."""
    blur_px: float
    """Blur σ_b of the edges in the image [px], 0 to 8; only contrast and variance depend on it."""
    noise_grey: float
    """Standard deviation σ_n of the image noise [grey levels], 0.1 to 64."""
    min_contrast_grey: float
    """Minimum contrast of an edge [grey levels], 0 to 255."""

class _FitOptions(TypedDict, total=False):
    """Options of a `Fitter`."""

    loss: float | Literal["none"]
    """Cutoff of Tukey's biweight [robust standard deviations], above 1; "none": least squares."""
    solve: Literal["joint", "two-stage"]
    """All components at once; or translation first, then the others, as in the 1994 tracker."""
    max_iterations: int
    """Maximum number of reweighted solutions, 1 to 100."""
    min_scale_px: float
    """Lower bound on the robust scale of the residual offsets [px], 0 to 10."""

class _AcceptOptions(TypedDict, total=False):
    """Conditions for accepting a fit."""

    min_inliers: float
    """Minimum fraction of the visible samples whose edges agree with the fit, 0 to 1."""
    max_residual_px: float
    """Maximum root mean square of their residual offsets [px], positive; a fifth of the finger's
    half-width if that is more."""

class _AcquireOptions(TypedDict, total=False):
    """Options of acquisition."""

    half_length_px: float
    """Half-length of the search lines [px], 1 to 128."""
    accept: _AcceptOptions
    """Conditions for accepting a fit."""
    settle_frames: int
    """Number of consecutive accepted frames until the hand is acquired, at least 1."""
    settle_change: float
    """Maximum relative change of the finger's half-width from frame to frame, positive."""
    max_scale: float
    """Maximum ratio of the hand's width to the initial template's, or its inverse, above 1."""

class _TrackOptions(TypedDict, total=False):
    """Options of tracking."""

    half_length_px: float
    """Maximum half-length of the search lines of a hand that moves as predicted [px], 1 to 128.

    If the hand is not found there, the search range grows by this length, and again for every
    frame without it.
    """
    accept: _AcceptOptions
    """Conditions for accepting a fit."""
    lose_after_frames: int
    """Number of consecutive frames without an accepted fit until the hand is lost, at least 1."""
    appearance_rate: float
    """Learning rate of the appearance model per accepted frame, 0 to 1."""
    dynamics: _DynamicsOptions
    """Motion model of the hand."""

class _DynamicsOptions(TypedDict, total=False):
    """Motion model of a hand in the image: a Kalman filter with constant velocity.

    Accelerations and speeds in pixels are those along u and those along v.
    """

    acceleration_px_s2: float
    """Root mean square acceleration [px/s²], 1 to 1e5."""
    acceleration_rad_s2: float
    """Root mean square angular acceleration of the finger [rad/s²], 0.01 to 1000."""
    acceleration_lasts_s: float
    """Correlation time of the acceleration [s], 0.001 to 1."""
    first_speed_px_s: float
    """Standard deviation of the initial speed [px/s], 0 to 1e5."""
    first_speed_rad_s: float
    """Standard deviation of the initial angular speed of the finger [rad/s], 0 to 100."""
    confidence: float
    """Probability that the search along a normal reaches the hand's edge, 0.5 to 0.999999."""
    longest_gap_s: float
    """Longest gap over which a hand is tracked; after a longer one it is acquired again [s],
    0.001 to 60."""

class _TrackerOptions(TypedDict, total=False):
    """Options of a `ContourTracker`."""

    model: Literal["ribbon", "paper"]
    """Model of the hand: "ribbon", bands with independent widths of finger and thumb; "paper", the
    planar template of 1994."""
    samples: int
    """Number of samples along the contour, 8 to 2000."""
    max_iterations: int
    """Maximum number of searches along the normals per shape space and frame, 1 to 100."""
    search: _SearchOptions
    """Edge detection."""
    polarity: Literal["bright", "dark", "unknown"]
    """Whether the hand is brighter or darker than its background."""
    fit: _FitOptions
    """Robust least squares."""
    correlation: float
    """Factor on the covariance, at least 1, because neighbouring measurements share pixels."""
    refine: bool
    """Whether the band model's finger line is refined by the flanks alone and combined with the
    lines of earlier frames; the paper's model is never refined."""
    acquire: _AcquireOptions
    """Options until the hand is acquired."""
    track: _TrackOptions
    """Options from then on."""

class _ThumbProportions(TypedDict, total=False):
    """Shape of a pistol's thumb; lengths are in units of the visible index finger."""

    base: float
    """p of the intersection of the thumb's axis with the finger's, −1 to 0.5."""
    angle_rad: float
    """Angle between the two axes [rad], 0.5 to 2."""
    length: float
    """Length of the thumb's axis from the intersection to its apex, 0.3 to 2."""
    half_width: float
    """Half-width of the thumb, 0.03 to 0.4."""
    far_flank: float
    """Fraction of the thumb's far flank that the outline follows back from the tip, 0 to 1."""

class _Proportions(TypedDict, total=False):
    """Shape of a pistol; lengths are in units of the visible index finger."""

    half_width: float
    """Half-width of the finger, 0.03 to 0.4."""
    flank_start: float
    """Start of the outline on the finger's flank: p from −0.5 to 0.3."""
    thumb: _ThumbProportions | None
    """The thumb; None for a finger alone."""

# --- contours --------------------------------------------------------------------------------

@final
class BSpline:
    """A quadratic or cubic B-spline basis: degree, knots, open or closed.

    The control points, which define the shape, are an argument of the methods, because every
    deformation of a contour moves them and leaves the basis unchanged.

    Immutable; two are equal if their degrees, knots and closures are.

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
            Inner knots may occur ``degree`` times, which makes a corner. The first and the last
            may occur ``degree + 1`` times; the curve then starts and ends at a control point.

        Raises
        ------
        InvalidInputError
            An invalid degree; too few, decreasing, non-finite or too often repeated knots;
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
            The knots, each end once, for ``B + degree − 1`` control points.

        Raises
        ------
        InvalidInputError
            Fewer than two breaks; otherwise as for `open`.
        """

    @staticmethod
    def open_uniform(degree: int, control_points: int) -> BSpline:
        """Make an open, clamped B-spline with knots one apart, on [0, control_points − degree].

        Parameters
        ----------
        degree
            2 or 3.
        control_points
            Number of control points, from ``degree + 1`` to 2^20.

        Raises
        ------
        InvalidInputError
            A degree or number out of range.
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
            may occur ``degree`` times, which makes a corner. The first and the last are the same
            knot of the curve, so their multiplicities add.

        Raises
        ------
        InvalidInputError
            Fewer than ``degree + 2`` knots; otherwise as for `open`.
        """

    @staticmethod
    def closed_uniform(degree: int, control_points: int) -> BSpline:
        """Make a closed B-spline with knots one apart, on [0, control_points].

        Parameters
        ----------
        degree
            2 or 3.
        control_points
            Number of control points, from ``degree + 1`` to 2^20.

        Raises
        ------
        InvalidInputError
            A degree or number out of range.
        """

    @property
    def degree(self) -> int:
        """Degree of the polynomial pieces, 2 or 3."""

    @property
    def is_closed(self) -> bool:
        """Whether the curve is closed."""

    @property
    def control_point_count(self) -> int:
        """Number of control points of the curve."""

    @property
    def knots(self) -> NDArray[np.float64]:
        """The knots in the form taken by `open` or `closed`."""

    @property
    def domain(self) -> tuple[float, float]:
        """First and last parameter. A closed curve is periodic and takes any parameter."""

    def basis(self, parameters: ArrayLike) -> BasisRows:
        """Evaluate the non-zero basis functions and their derivatives.

        At a knot the derivatives are those from the right, at the end of an open curve those from
        the left.

        Parameters
        ----------
        parameters : (N,)
            Finite; on an open curve within `domain`.

        Raises
        ------
        InvalidInputError
            Parameters that are not finite, or outside the domain of an open curve.
        """

    def evaluate(self, control_points: ArrayLike, parameters: ArrayLike) -> CurvePoints:
        """Evaluate position and derivatives of a curve.

        Parameters
        ----------
        control_points : (n, 2)
            n is `control_point_count`; in any unit.
        parameters : (N,)
            Finite; on an open curve within `domain`.

        Raises
        ------
        InvalidInputError
            A wrong number of control points; one that contributes to the result and is not
            finite; parameters as for `basis`.
        """

    def fit(
        self,
        outline: ArrayLike,
        parametrization: Literal["chord-length", "centripetal"] | ArrayLike,
    ) -> SplineFit:
        """Fit control points to an ordered outline by linear least squares.

        The fit minimises the sum of squared distances between each outline point and the curve at
        its parameter.

        Parameters
        ----------
        outline : (N, 2)
            At least as many points as control points, in any unit. The first point of a closed
            outline need not be repeated.
        parametrization : word or (N,)
            Parameters of the outline points. "chord-length": in proportion to the length of the
            polygon through them, the usual choice for an outline traced at even steps.
            "centripetal": in proportion to the sums of the square roots of its sides, smoother at
            sharp turns (*The NURBS Book*, equation 9.6). Or the parameters themselves, in any
            order.

        Raises
        ------
        InvalidInputError
            Too few points; points that are not finite or all coincide; parameters outside the
            domain; a control point that no outline point determines (the condition of Schoenberg
            and Whitney); a product of outline points and control points above 2^24.
        """

    def arc_length(self, control_points: ArrayLike) -> ArcLength:
        """Measure the length along a curve.

        Parameters
        ----------
        control_points : (n, 2)
            n is `control_point_count`; in any unit.

        Raises
        ------
        InvalidInputError
            A wrong number of control points; one that is not finite; all at one place.
        """

    def __eq__(self, other: object, /) -> bool: ...
    def __ne__(self, other: object, /) -> bool: ...
    __hash__: None  # type: ignore[assignment]

@final
class BasisRows:
    """The non-zero basis functions at N parameters of a B-spline; see `BSpline.basis`.

    A row holds the weights of the degree + 1 control points that act at its parameter.
    """

    @property
    def indices(self) -> NDArray[np.int64]:
        """Indices of these control points, from 0, (N, degree + 1); all different in a row."""

    @property
    def values(self) -> NDArray[np.float64]:
        """Their weights, (N, degree + 1): not negative, with sum 1."""

    @property
    def first_derivatives(self) -> NDArray[np.float64]:
        """First derivatives of the weights by the parameter, (N, degree + 1); their sum is 0."""

    @property
    def second_derivatives(self) -> NDArray[np.float64]:
        """Second derivatives of the weights by the parameter, (N, degree + 1); their sum is 0."""

@final
class CurvePoints:
    """N points of a curve with their derivatives by the parameter; see `BSpline.evaluate`."""

    @property
    def position(self) -> NDArray[np.float64]:
        """Positions, (N, 2), in the unit of the control points."""

    @property
    def first_derivative(self) -> NDArray[np.float64]:
        """Along the tangent in the direction of increasing parameter, (N, 2); zero at a cusp."""

    @property
    def second_derivative(self) -> NDArray[np.float64]:
        """Second derivatives, (N, 2); the component across the tangent determines the curvature."""

@final
class SplineFit:
    """A least-squares fit of a B-spline and its quality; see `BSpline.fit`."""

    @property
    def control_points(self) -> NDArray[np.float64]:
        """Control points of the fitted curve, (n, 2)."""

    @property
    def parameters(self) -> NDArray[np.float64]:
        """Parameter of every outline point, (N,)."""

    @property
    def rms_residual(self) -> float:
        """Root mean square distance between outline points and the curve at their parameters."""

    @property
    def max_residual(self) -> float:
        """The largest of these distances."""

    @property
    def condition(self) -> float:
        """Condition number: it bounds the control points' relative error over the outline's."""

@final
class ArcLength:
    """The arc length along one curve; see `BSpline.arc_length`.

    Lengths are accurate to 1e-10 of the control polygon's length.
    """

    @property
    def total(self) -> float:
        """Length of the whole curve, in the unit of its control points."""

    def parameter_at(self, lengths: ArrayLike) -> NDArray[np.float64]:
        """Return the parameters at given lengths from the start of the domain.

        Parameters
        ----------
        lengths : (N,)
            In [0, `total`] on an open curve; a closed one takes any length and wraps around.

        Returns
        -------
        (N,)
            Where the position is constant over an interval of parameters, the last of them.

        Raises
        ------
        InvalidInputError
            A length that is not finite, or outside [0, `total`] on an open curve.
        """

    def equally_spaced(self, samples: int) -> NDArray[np.float64]:
        """Return parameters at equal steps of arc length.

        Parameters
        ----------
        samples
            Number of parameters, up to 2^20: at least 2 on an open curve, which includes both
            ends; at least 1 on a closed one, where the last is one step before the first.

        Returns
        -------
        (samples,)
            Increasing, from the start of the domain.

        Raises
        ------
        InvalidInputError
            A number out of range.
        """

def sample_contour(
    spline: BSpline,
    control_points: ArrayLike,
    samples: int,
    hand: Literal["left", "right"],
) -> ContourSamples:
    """Sample a curve at equal steps of arc length, with tangents and outward normals.

    Each sample is at the middle of its step: all represent the same length, and none falls on an
    end.

    Parameters
    ----------
    spline
        The curve's basis.
    control_points : (n, 2)
        Its control points, in any unit.
    samples
        Number of samples, 1 to 2^20.
    hand
        The side of the direction of travel on which the hand lies, in axes like the image's:
        travelling towards +u, +v is to the right.

    Raises
    ------
    InvalidInputError
        Control points as for `BSpline.arc_length`; a curve with zero velocity at a sample, which
        then has no tangent; an invalid number or side.
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
        """Positions of the samples, (N, 2)."""

    @property
    def tangent(self) -> NDArray[np.float64]:
        """Unit tangents in the direction of travel, (N, 2)."""

    @property
    def normal(self) -> NDArray[np.float64]:
        """Unit normals, out of the hand, (N, 2)."""

@final
class Template:
    """The B-spline rest shape of the pointing hand, with its pointing axis.

    The axis runs from (−½, 0) at the knuckle to (½, 0) at the tip. It is the basis vector of p, so
    the first column of a fitted map is the pointing direction.

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
            Values that differ from those of the usual hand; see `Template.proportions`.

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
            Start and end of the visible finger's axis, in the same unit.
        hand
            The side of the outline's direction of travel on which the hand lies.
        control_points
            Number of control points of the cubic B-spline that is fitted to the outline, at least
            4; None for a number that suits finger and thumb.

        Returns
        -------
        Template
            It has neither thumb nor proportions, so only the tracker's model "paper" accepts it.

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
        """All proportions of a pistol; None for a traced outline."""

    @property
    def spline(self) -> BSpline:
        """B-spline basis of the outline."""

    @property
    def control_points(self) -> NDArray[np.float64]:
        """Control points (p, q) of the outline, (n, 2)."""

    def outline(self, samples: int | None = None) -> NDArray[np.float64]:
        """Sample the outline at equal steps of arc length.

        Parameters
        ----------
        samples
            Number of samples, 1 to 2^20; None for a tracker's default.

        Returns
        -------
        (samples, 2)
            Points (p, q), up the finger's outer flank, round the tip, then round the thumb.

        Raises
        ------
        InvalidInputError
            A number out of range.
        """

    def __eq__(self, other: object, /) -> bool: ...
    def __ne__(self, other: object, /) -> bool: ...
    __hash__: None  # type: ignore[assignment]

# --- shape spaces ----------------------------------------------------------------------------

@final
class ShapeSpace:
    """The allowed deformations of a template, with D degrees of freedom.

    A planar space maps a template point m = (p, q) to

        x = c + A m,    A = [a b] = R(θ) [[α, κ], [0, β]],

    so the finger's axis lies along a, and the shear κ runs along the finger. The spaces differ in
    the free components of (c, θ, κ, α, β). Every constructor takes a map (c, A) and returns the
    space with the shape vector of this map; the other components keep the map's values.
    `StartPose.centre_px` and `StartPose.linear_px` are such a map.

    Immutable.

    References
    ----------
    Cipolla, Hadfield & Hollinghurst 1994, section 3.2; Blake & Isard, *Active Contours*, ch. 4.
    """

    @staticmethod
    def translation(
        centre_px: ArrayLike, linear_px: ArrayLike
    ) -> tuple[ShapeSpace, NDArray[np.float64]]:
        """Free (c): translation alone.

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
            The shape vector of (c, A).

        Raises
        ------
        InvalidInputError
            A map that is not finite, mirrors the template or flattens it.
        """

    @staticmethod
    def rigid(centre_px: ArrayLike, linear_px: ArrayLike) -> tuple[ShapeSpace, NDArray[np.float64]]:
        """Free (c, θ): rigid motion in the image plane. Otherwise as `translation`."""

    @staticmethod
    def rigid_shear(
        centre_px: ArrayLike, linear_px: ArrayLike
    ) -> tuple[ShapeSpace, NDArray[np.float64]]:
        """Free (c, θ, κ): the tracking space of the 1994 system. Otherwise as `translation`."""

    @staticmethod
    def similarity(
        centre_px: ArrayLike, linear_px: ArrayLike
    ) -> tuple[ShapeSpace, NDArray[np.float64]]:
        """Free (c, θ, s): rigid motion and a common scale of A. Otherwise as `translation`."""

    @staticmethod
    def similarity_shear(
        centre_px: ArrayLike, linear_px: ArrayLike
    ) -> tuple[ShapeSpace, NDArray[np.float64]]:
        """Free (c, θ, κ, s): s scales α and β, not κ. Otherwise as `translation`."""

    @staticmethod
    def affine(
        centre_px: ArrayLike, linear_px: ArrayLike
    ) -> tuple[ShapeSpace, NDArray[np.float64]]:
        """Free (c, a, b): the acquisition space of the 1994 system. Otherwise as `translation`."""

    @staticmethod
    def ribbon(
        template: Template, centre_px: ArrayLike, linear_px: ArrayLike, dof: int
    ) -> tuple[ShapeSpace, NDArray[np.float64]]:
        """Free the first ``dof`` components of the band template.

        Finger and thumb are spheres swept along two straight spines, each with its own width in
        the image. Under a planar map, a foreshortened finger would lose width; a band does not.
        The whole shape vector is (c, θ, w, τ, r, b_u, b_v, w₂): centre, angle, half-width and
        taper of the finger; root on the finger's spine, spine and half-width of the thumb.

        Parameters
        ----------
        template
            A pistol; its proportions determine the components that are not free.
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
            A traced outline; an invalid ``dof``; otherwise as for `translation`.
        """

    @property
    def kind(self) -> str:
        """Name of the constructor."""

    @property
    def names(self) -> list[str]:
        """Name and unit of each component of the shape vector."""

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
            Finite. Its map must neither mirror nor flatten the template, and no half-width may be
            negative.
        template
            For a band template, a pistol with the thumb on the same side.
        samples
            Number of samples of the outline, 1 to 2^20; None for a tracker's default.

        Raises
        ------
        InvalidInputError
            A shape vector, template or number that violates these conditions.
        """

    def normal_rows(
        self,
        shape_vector: ArrayLike,
        template: Template,
        samples: int | None = None,
        *,
        normal: ArrayLike | None = None,
    ) -> NDArray[np.float64]:
        """Return the derivatives of the contour's motion along its normals by the shape vector.

        Parameters
        ----------
        shape_vector, template, samples
            As for `place`.
        normal : (N, 2), optional
            Unit vectors n to use instead of the placed contour's normals.

        Returns
        -------
        (N, D)
            ∂(n·X)/∂x [px per unit of the component]: the rows that `Fitter.solve` takes.

        Raises
        ------
        InvalidInputError
            As for `place`; normals that are not N unit vectors.
        """

    def axis(self, shape_vector: ArrayLike) -> Axis:
        """Return the finger's axis in the image.

        Parameters
        ----------
        shape_vector : (D,)
            As for `place`.

        Raises
        ------
        InvalidInputError
            A shape vector that `place` refuses.
        """

    def axis_jacobian(self, shape_vector: ArrayLike) -> NDArray[np.float64]:
        """Return the derivatives of the axis by the shape vector.

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
            A shape vector that `place` refuses.
        """

@final
class PlacedContour:
    """N samples of the template's outline in the image; see `ShapeSpace.place`."""

    @property
    def position_px(self) -> NDArray[np.float64]:
        """Positions of the samples [px], (N, 2)."""

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
    """Searches for edges along the normals of a contour.

    The image is sampled at whole pixels along each normal, and the profile is correlated with the
    derivative of a Gaussian of scale s. The offset is the peak of the response, to a fraction of a
    pixel. With edge blur σ_b, S² = s² + σ_b², contrast A and white noise σ_n the offset has the
    variance (3√π / 4) σ_n² S⁶ / (A² s⁵) per independent pixel of contour: the noise of the
    response's slope over the squared curvature of a blurred step's response at its peak.

    Immutable; several threads may use one object at once.

    References
    ----------
    Canny 1986 for the operator; Cipolla & Blake 1992 for the search along normals.
    """

    def __new__(cls, options: Mapping[str, object] | None = None) -> EdgeSearch:
        """Make a search with the given options.

        Parameters
        ----------
        options
            Values that differ from the defaults: ``scale_px``, ``blur_px``, ``noise_grey``,
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
            Intersections of the lines with the contour [px]; outside the image they are misses.
        normal : (N, 2)
            Unit vectors along the lines, out of the hand.
        half_length_px : (N,) or scalar
            Search range to either side [px], above 0 and up to 128; rounded up to whole pixels.
        polarity
            Whether the hand is brighter or darker than its background.
        scale
            "fine": a kernel of the option ``scale_px``. "coarse": one 2.5 times as large, which
            responds to edges under motion blur.

        Returns
        -------
        SearchLines
            One line per position, in the same order.

        Raises
        ------
        InvalidInputError
            An image in another form than described above, positions that are not finite, normals
            that are not unit vectors, lengths out of range, arrays of different lengths.
        """

@final
class SearchLines:
    """N search lines with their edge measurements; see `EdgeSearch.search`.

    A line without an edge is a *miss*: its measurements are NaN, never 0.
    """

    @property
    def position_px(self) -> NDArray[np.float64]:
        """Intersections of the lines with the contour [px], (N, 2)."""

    @property
    def normal(self) -> NDArray[np.float64]:
        """Unit vectors along the lines, out of the hand, (N, 2)."""

    @property
    def half_length_px(self) -> NDArray[np.float64]:
        """Search range of each line to either side [px], (N,)."""

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
        """Mean log-likelihood ratio of the pixels inside minus that outside, (N,).

        NaN without an appearance model.
        """

    @property
    def agrees(self) -> NDArray[np.bool_] | None:
        """Whether the edge agrees with the tracker's fit, (N,); False for a miss.

        None for lines of an `EdgeSearch`, to which nothing was fitted.
        """

    @property
    def miss(self) -> NDArray[np.str_]:
        """Reason for the absence of an edge, (N,); empty where there is one.

        "out-of-image": too little of the line lies inside the image. "no-contrast": no response of
        the right polarity reaches the minimum contrast. "beyond-end": the response still rises at
        the end of the line.
        """

    def __len__(self) -> int: ...

@final
class Background:
    """Background model of a static camera.

    The model holds the grey level that each pixel shows most of the time. The light of a frame is
    fitted as gain · background + offset. The remaining differences are foreground, except where a
    shadow explains them. If most of the image changes for several frames, the camera has moved:
    the background is discarded and learned anew.

    References
    ----------
    Stauffer & Grimson 1999; Horprasert, Harwood & Davis 1999 for shadows.
    """

    def __new__(cls, options: Mapping[str, object] | None = None) -> Background:
        """Make a background without observations.

        Parameters
        ----------
        options
            Values that differ from the defaults; see the property ``options``.

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
        keep_out: Sequence[tuple[ArrayLike, ArrayLike, float]] | None = None,
    ) -> None:
        """Process one frame: `look`, then `learn`.

        Parameters
        ----------
        image : (height, width)
            Grey levels; not copied. Another size starts a new background.
        colour : (height, width, 3), optional
            Colours of the same frame.
        keep_out
            Regions that are not learned, such as a hand: two ends (u, v) of a segment [px], and
            the radius about it [px]; none by default. They may overlap.

        Raises
        ------
        InvalidInputError
            An unsuitable image; a region that is not finite or whose radius is not positive.
        FingerpostError
            The background is in use in another thread.
        """

    def look(self, image: NDArray[np.uint8], colour: NDArray[np.uint8] | None = None) -> None:
        """Process a frame without learning from it: estimate its light, and detect camera motion.

        From then on, all queries refer to this frame.

        Parameters
        ----------
        image : (height, width)
            Grey levels; not copied. Another size starts a new background.
        colour : (height, width, 3), optional
            Colours of the same frame.

        Raises
        ------
        InvalidInputError
            An unsuitable image.
        FingerpostError
            The background is in use in another thread.
        """

    def learn(
        self,
        image: NDArray[np.uint8],
        colour: NDArray[np.uint8] | None = None,
        *,
        keep_out: Sequence[tuple[ArrayLike, ArrayLike, float]] | None = None,
    ) -> None:
        """Learn from the frame that `look` processed last, except within ``keep_out``.

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
        """Discard the observations of a region, such as a hand that was there from the start.

        Parameters
        ----------
        part
            Two ends (u, v) of a segment [px], and the radius about it [px].

        Raises
        ------
        InvalidInputError
            A region that is not finite or whose radius is not positive.
        """

    def clear(self) -> None:
        """Discard all observations."""

    @property
    def is_known(self) -> bool:
        """Whether it was observed long enough to separate the foreground."""

    @property
    def is_exact(self) -> bool:
        """Whether it is known and displaced by at most 0.15 px in the last frame.

        A displacement of the camera by a fraction of a pixel changes few pixels by much, but moves
        every edge.
        """

    @property
    def shift_px(self) -> tuple[float, float] | None:
        """Displacement of the last frame from the background [px], (u, v).

        None if too few edges determine it. Beyond a pixel it only indicates that the camera has
        moved.
        """

    @property
    def light(self) -> tuple[float, float]:
        """Gain and offset [grey levels] of the last frame's light relative to the background's."""

    @property
    def changed_share(self) -> float:
        """Changed fraction of the pixels that would show a motion of the camera, 0 to 1."""

    @property
    def options(self) -> _BackgroundOptions:
        """Every option in force."""

    def expected(self, position_px: ArrayLike) -> NDArray[np.float64]:
        """Return the expected grey levels where no object is before the background.

        Parameters
        ----------
        position_px : (N, 2)
            Positions [px].

        Returns
        -------
        (N, 2)
            Expected grey level in the light of the last frame, and its standard deviation, which
            excludes the image noise of that frame; NaN where the background is unknown.
        """

    def foreground(
        self,
        image: NDArray[np.uint8],
        position_px: ArrayLike,
        colour: NDArray[np.uint8] | None = None,
    ) -> NDArray[np.float64]:
        """Return the foreground probability at some positions of a frame.

        Parameters
        ----------
        image, colour
            As for `observe`.
        position_px : (N, 2)
            Positions [px]; the nearest pixels are used.

        Returns
        -------
        (N,)
            0 to 1; NaN outside the image and where the background is unknown.
        """

    def foreground_map(
        self, image: NDArray[np.uint8], colour: NDArray[np.uint8] | None = None
    ) -> NDArray[np.uint8]:
        """Return the foreground probability of every second pixel of every second row.

        Parameters
        ----------
        image, colour
            As for `observe`.

        Returns
        -------
        (⌈height / 2⌉, ⌈width / 2⌉)
            0 for background to 255 for foreground; all 0 while the background is unknown.
        """

@final
class HandFinder:
    """Detects candidates for pointing hands in an image.

    A template of a finger's round end and flanks is scored coarsely at every position, angle and
    size; the best of these are refined. The results are candidates: only a fit, and the other
    views, distinguish hands from pens, cables and other fingers.

    References
    ----------
    Hinterstoisser et al. 2012 for spread orientations and their fast sums.
    """

    def __new__(cls, options: Mapping[str, object] | None = None) -> HandFinder:
        """Make a finder with the given options.

        Parameters
        ----------
        options
            Values that differ from the defaults; see the property ``options``.

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
        """Find the candidates in a frame, the most likely first.

        Parameters
        ----------
        image : (height, width)
            Grey levels; not copied.
        colour : (height, width, 3), optional
            Colours of the same frame; they distinguish fingers better from their surroundings.
        background
            Background model of the view. Once it is known, foreground candidates rank higher.

        Raises
        ------
        InvalidInputError
            An unsuitable image.
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
        """Return the likeness of a band to a finger by the contrast with its surroundings.

        If the band is lit from one side, each half may have contrast in colour, or in chromaticity
        alone.

        Parameters
        ----------
        image, colour
            As for `find`.
        tip_px, angle_rad
            End of the band [px], and its direction there [rad].
        half_width_px
            Half-width of the band [px], > 0.

        Returns
        -------
        float or None
            0 to 1; None if too little of the band and its surroundings lies in the image.

        Raises
        ------
        InvalidInputError
            Arrays of the wrong type or shape; a position or direction that is not finite; a
            half-width that is not positive.
        """

    @property
    def options(self) -> _FinderOptions:
        """Every option in force."""

@final
class Candidate:
    """A possible pointing hand."""

    @property
    def start(self) -> StartPose:
        """The start pose of a template for it."""

    @property
    def half_width_px(self) -> float:
        """Half the finger's width [px]."""

    @property
    def thumb(self) -> Literal["left", "right", "none"]:
        """Side of a second band that may be its thumb."""

    @property
    def colour(self) -> tuple[float, float, float]:
        """Mean colour of its inside, channels as in the frame; without colours, the grey level."""

    @property
    def foreground(self) -> float:
        """Mean foreground probability of its inside, 0 to 1; 0 while no background is known."""

    @property
    def score(self) -> float:
        """Likeness to a finger by shape and colours alone, 0 to 1."""

@final
class PlaneLevel:
    """Chosen pixels of the working plane at one level of a first image's pyramid.

    Parameters
    ----------
    positions_px : (N, 2)
        Undistorted positions of the pixels at full resolution [px].
    levels : (N,)
        Grey levels of the pixels in the smoothed pyramid level.
    gradients : (N, 2)
        Gradients by the position at full resolution [levels/px].
    variances : (N,)
        Variance of an inlier's residual [levels²], positive.
    squares : sequence of int
        Index of the square that each pixel belongs to, in ascending order. Every square has its
        own gain and offset.
    scale
        Size of the level relative to the image, at most 1.
    non_similarity_sigma
        Standard deviation of the change, from image to image, of the components of a homography
        that a similarity lacks, in unit coordinates.
    unit_from_px : (3, 3)
        Scale and shift from pixels at full resolution to unit coordinates: coordinates of order 1,
        in which steps are computed.
    lens : seven floats, optional
        fx, fy, cx, cy, k1, k2 and the maximum radius, as `Lens.radial` returns them.

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
    compositional: Baker & Matthews 2004), from the coarsest level to the full resolution. Tukey's
    biweight rejects objects that cover the plane, and frequent outliers lose weight.

    Parameters
    ----------
    levels
        The levels of one view, from full resolution down; copied.
    points_px : (M, 2)
        Undistorted positions in the first image at which accuracy is required [px].

    Raises
    ------
    InvalidInputError
        No levels, or a singular ``unit_from_px``.
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
            Smoothed pyramid of the image, from full resolution down, with as many levels as that
            of the first image.
        guess : (3, 3)
            Homography from the first image to this one, accurate to a few pixels.
        hand
            Region that is not the plane: two ends of a segment [px], and the radius about it [px].

        Returns
        -------
        RegisteredPlane or None
            None if too little of the plane is visible.

        Raises
        ------
        InvalidInputError
            A wrong number of levels, or numbers that are not finite.
        """

@final
class RegisteredPlane:
    """The pose of the working plane in an image."""

    @property
    def now_from_first(self) -> NDArray[np.float64]:
        """Homography from undistorted pixels of the first image to those of this one, (3, 3)."""

    @property
    def step_covariance(self) -> NDArray[np.float64]:
        """Covariance of the homography's error in unit coordinates, (8, 8).

        The error is a homography that is applied before `now_from_first`; its entries, row by row
        without the last, are the components.
        """

    @property
    def inlier_share(self) -> float:
        """Inliers' fraction of the information of the pixels expected to be inliers, 0 to 1."""

    @property
    def inliers(self) -> int:
        """Number of inliers among these pixels."""

@final
class RoundFinger:
    """The round body whose shading fits the image about an axis best.

    Before a table as bright as one side of the finger, a finger lit from the other side has an
    edge at the terminator instead of the occluding contour. The shading across a round body
    determines its width and its middle nevertheless.
    """

    @staticmethod
    def fit(
        image: NDArray[np.uint8],
        anchor_px: ArrayLike,
        tip_px: ArrayLike,
        half_width_px: float,
        colour: NDArray[np.uint8] | None = None,
    ) -> RoundFinger | None:
        """Fit a body to the image about an axis.

        Parameters
        ----------
        image : (height, width)
            Grey levels.
        anchor_px, tip_px : (2,)
            Middle and tip of the finger, on the bisector of the visible edges [px].
        half_width_px
            Distance from the axis to the visible edges [px], positive.
        colour : (height, width, 3), optional
            Colours, used instead of the grey levels.

        Returns
        -------
        RoundFinger or None
            None if the region used, 1 to 6 half-widths behind the tip and 2 to either side of the
            axis, is not entirely inside the image.

        Raises
        ------
        InvalidInputError
            A number that is not finite, a tip at the anchor, a half-width that is not positive, or
            an unsuitable image.
        """

    @property
    def offset_px(self) -> float:
        """Offset of the fitted axis from the anchor, along the given axis's normal [px].

        The normal is (−sin, cos).
        """

    @property
    def turn_rad(self) -> float:
        """Angle of the fitted axis minus that of the given one [rad]."""

    @property
    def half_width_px(self) -> float:
        """Half-width at the anchor [px]."""

    @property
    def misfit(self) -> float:
        """Robust cost of the fit, summed over the pixels used; dimensionless."""

    @property
    def misfit_about_given(self) -> float:
        """The least such cost of a body about the given axis."""

@final
class Fitter:
    """Weighted least squares for the step of a shape vector.

    An equation row · δ = offset states that the step δ moves the contour by the measured offset
    along one normal. Tukey's biweight, iterated, rejects gross errors. Scatter of the residual
    offsets in excess of their variances is model misfit and is added to every variance. If the
    equations leave a direction of the shape space undetermined, there is no step.

    Immutable; several threads may use one object at once.
    """

    def __new__(cls, options: Mapping[str, object] | None = None) -> Fitter:
        """Make a solver with the given options.

        Parameters
        ----------
        options
            Values that differ from the defaults: ``loss``, ``solve``, ``max_iterations``,
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
        """Find the step that minimises the robust loss of the equations and the prior.

        Parameters
        ----------
        rows : (N, D)
            ∂(n·X)/∂x of every measurement, as returned by `ShapeSpace.normal_rows`; D from 1 to 9.
        offset_px : (N,)
            Measured offsets [px], without misses.
        variance_px2 : (N,)
            Their variances [px²], positive.
        prior : ((D,), (D, D)), optional
            Mean and information (inverse covariance) of a Gaussian prior on the step. The
            information is positive semidefinite, and zero in directions without prior knowledge.

        Raises
        ------
        InvalidInputError
            Arrays of other shapes or not finite; variances that are not positive; a prior
            information that is not symmetric or has a negative eigenvalue.
        """

@final
class FitReport:
    """The result of a fit and its quality; see `Fitter.solve`."""

    @property
    def outcome(self) -> Literal["determined", "too-few-equations", "undetermined"]:
        """Whether there is a step.

        "too-few-equations": fewer equations than unknowns, and no prior. "undetermined": equations
        and prior leave D − `rank` directions of the shape space undetermined.
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
        """Number of directions of the shape space that the information determines."""

    @property
    def iterations(self) -> int:
        """Number of solutions until the weights converged."""

    @property
    def equations(self) -> int:
        """Number of equations."""

    @property
    def inliers(self) -> int:
        """Number of equations with more than a tenth of their full weight."""

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
    """The start pose of the initial template.

    Immutable; two are equal if their values are.
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
            A value that is not a finite number; a length that is not positive.
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
        """Image of the undeformed template's origin, the middle of the finger [px], (2,)."""

    @property
    def linear_px(self) -> NDArray[np.float64]:
        """Images of its basis vectors along and across the finger, as columns [px], (2, 2)."""

    def __eq__(self, other: object, /) -> bool: ...
    def __ne__(self, other: object, /) -> bool: ...
    __hash__: None  # type: ignore[assignment]

@final
class ContourTracker:
    """Tracks one hand in one view: *acquiring*, *tracking*, *lost*.

    *Acquiring*: the initial template waits at its start pose and is fitted to a hand that is held
    up to it, until its size has settled. *Tracking*: every frame is searched where a Kalman filter
    predicts the hand. *Lost*: after some frames without an accepted fit, the hand is searched for
    at its last pose and at the start pose.

    The same frames and times give bit-identical results. Several trackers may run in parallel
    threads, each in one thread at a time.

    References
    ----------
    Cipolla, Hadfield & Hollinghurst 1994, section 3.2.
    """

    def __new__(
        cls, template: Template, start: StartPose, options: Mapping[str, object] | None = None
    ) -> ContourTracker:
        """Make a tracker whose initial template is at ``start``.

        Parameters
        ----------
        template
            A pistol; for the model "paper" also a traced outline.
        start
            The start pose.
        options
            Values that differ from the defaults, in nested dictionaries; the property ``options``
            returns all of them.

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
        """Make a tracker of a hand that is already at ``start``, such as a `Candidate`.

        The first frame is fitted there directly, from the template's own width; a tracker made by
        the class itself would try several positions, angles and widths. If the first frame shows
        no hand there, acquisition starts as usual.

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
        """Foreshortening of the finger in this view, above 0 and at most 1.

        The sine of the angle between the finger and the ray to its tip. Other views determine it;
        1 until it is set. The line is reported for the distal segment, whose length is derived
        from the finger's width; unlike length, width is not foreshortened.

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
        """Update the tracker by one frame, and return the estimate for it.

        Parameters
        ----------
        image : (height, width) or (height, width, 3)
            Grey levels, or blue, green and red in OpenCV's order; not copied. Edges are measured
            in grey levels (ITU-R BT.601 luma); colours distinguish the hand from its background.
            Three channels that do not differ count as grey.
        time_s
            Time of capture [s], not before the last frame's.
        colour : (height, width, 3), optional
            Colours of the same frame, if ``image`` has its grey levels. The channels may have any
            order, the same in all frames; not copied.
        background
            Background model that has processed this frame by `Background.look`. Its edges are not
            taken for the hand's, and the finger line is fitted against it; background pixels that
            the frame contradicts are ignored. A hand that was present while it was learned is part
            of it.

        Raises
        ------
        InvalidInputError
            An image that is empty, larger than 32767 px in width or height, with rows of more than
            131071 bytes, or in another form than described above; colours or a background of
            another size; a time that is not finite or before the last frame's. The tracker is
            unchanged.
        FingerpostError
            The tracker or the background is in use in another thread.
        """

    def contour(self) -> NDArray[np.float64]:
        """Return the contour after the last frame, or at the start pose.

        Returns
        -------
        (N, 2)
            Points [px], without those that another limb hides.
        """

    def search_lines(self) -> SearchLines:
        """Return the last search along the normals; no lines before the first frame."""

def update_views(
    views: Sequence[
        tuple[ContourTracker, NDArray[np.uint8], float, NDArray[np.uint8] | None, Background | None]
    ],
    *,
    schedule: Literal["by-need", "in-turn", "side-by-side"] | None = None,
) -> list[Track | FingerpostError]:
    """Update the trackers of all views by one frame each, in one call.

    Parameters
    ----------
    views
        For each view its tracker, grey levels, time of capture [s], colours or None and background
        or None, as for `ContourTracker.update`. Every tracker may occur once.
    schedule
        Distribution over threads. "in-turn": all views in the calling thread. "side-by-side": a
        thread for each view. "by-need", the default: views that track a hand in the calling
        thread; each of the others, whose search takes milliseconds, in a thread of its own. The
        tracks are bit-identical for all schedules.

    Returns
    -------
    list
        For each view, in order, the track or the error that `ContourTracker.update` would raise.
        An error of one view does not affect the others.

    Raises
    ------
    InvalidInputError
        An unknown schedule, or a view that does not have five entries.
    """

@final
class Track:
    """The estimate of one frame; see `ContourTracker.update`."""

    @property
    def time_s(self) -> float:
        """Time of capture of the frame [s]."""

    @property
    def status(self) -> Literal["acquiring", "tracking", "lost"]:
        """State of the tracker after the frame."""

    @property
    def finger_line(self) -> FingerLine | None:
        """The finger line; None unless the hand is tracked and the frame's fit was accepted."""

    @property
    def shape_names(self) -> list[str]:
        """Name and unit of each component of the shape vector."""

    @property
    def shape_vector(self) -> NDArray[np.float64] | None:
        """The fitted shape, (D,); None unless the frame's fit was accepted."""

    @property
    def shape_covariance(self) -> NDArray[np.float64] | None:
        """Covariance of the shape vector, (D, D); None unless the frame's fit was accepted."""

    @property
    def diagnostics(self) -> Diagnostics:
        """Diagnostics of the frame's fit."""

@final
class FingerLine:
    """The image line that the finger points along."""

    @property
    def anchor_px(self) -> tuple[float, float]:
        """The point of the line to which `covariance` refers [px].

        It is the midpoint of the segment that the line was measured on.
        """

    @property
    def tip_px(self) -> tuple[float, float]:
        """The finger's apex, on the line [px]."""

    @property
    def angle_rad(self) -> float:
        """Direction of pointing [rad], from +u towards +v, in (−π, π]."""

    @property
    def half_length_px(self) -> float:
        """Half the length of the segment that the line was measured on [px], positive."""

    @property
    def stretch_px(self) -> tuple[float, float]:
        """Start and end of the segment that the line is reported for [px].

        Both are positions along the line relative to the anchor; the end nearer to the tip comes
        last. The axis of a slightly bent finger is approximated by a parabola. The line intersects
        it where the least-squares line over the segment does: at the segment's middle ± 1 / √3 of
        half its length. The correction of a lens straightens the line over this segment.
        """

    @property
    def covariance(self) -> NDArray[np.float64]:
        """Covariance of (offset, angle), (2, 2).

        The offset [px] is along the line's normal (−sin, cos) at the anchor, the angle in radians.
        """

    @property
    def source(self) -> Literal["contour", "pixels", "both"]:
        """The measurements that the line was estimated from.

        "contour": the axis of the fitted template. "pixels": the maximum-likelihood line given the
        pixels about the flanks, if these agree with the model of a finger. "both": the weighted
        mean of the two, if the pixels agree only in part.
        """

@final
class Diagnostics:
    """Diagnostics of one frame."""

    @property
    def visible(self) -> int:
        """Number of contour samples that no other limb hides."""

    @property
    def hits(self) -> int:
        """Number of visible samples on whose search line an edge was found."""

    @property
    def inliers(self) -> int:
        """Number of edges that agree with the fit."""

    @property
    def agreement(self) -> float:
        """Fraction of the finger's visible samples whose edges agree with the fit, 0 to 1.

        For the paper's model, of the contour's. The thumb does not count, because it bends.
        """

    @property
    def min_agreement(self) -> float:
        """The least agreement at which the fit would be accepted; above 1 if there is none."""

    @property
    def residual_rms_px(self) -> float:
        """Root mean square of the residual offsets of the inliers [px]."""

    @property
    def max_residual_px(self) -> float:
        """The largest such residual at which the fit would be accepted [px]."""

    @property
    def rank(self) -> int:
        """Number of directions of the shape space that the measurements determine."""

    @property
    def iterations(self) -> int:
        """Number of searches along the normals in the last shape space."""

    @property
    def accepted(self) -> bool:
        """Whether the fit was determined and accepted."""

    @property
    def refusal(
        self,
    ) -> (
        Literal["no-fit", "size", "motion", "agreement", "residual", "background", "misfit"] | None
    ):
        """Reason for refusing the fit; None if it was accepted.

        "no-fit": no fit was determined, or none that could be a finger. "size": it is much wider,
        slimmer or more tapered than the tracked hand. "motion": its motion is impossible for a
        hand. "agreement": too few edges agree with it. "residual": the residual offsets of the
        agreeing edges are too large. "background": it lies on the known background, or inside an
        object in front of that. "misfit": the finger is bent; no straight line is its axis.
        """

    @property
    def innovation(self) -> float | None:
        """Normalised square of the innovation of position and angle.

        3 on average for a hand that moves as the option ``track.dynamics`` states; above 21 once
        in 10,000 frames. None without a prediction.
        """

    @property
    def bend_rad(self) -> float | None:
        """Bend of the finger in the image [rad].

        Direction of the half with the tip minus that of the half with the knuckle. The fit is
        refused as "misfit" if the bend exceeds 0.35 (20°) by two standard deviations, or in two
        consecutive frames. This lasts until the bend is below 0.26 (15°) and the tip is visible,
        or until a frame that does not determine the bend shows the whole contour. A view shows
        only the component of a bend across its line of sight. None if the flanks of either half do
        not determine it, if the fit is refused for another reason, and for the paper's model.
        """

@final
class EdgePoints:
    """Edges along a path, at most one for each stretch, in the order of the path."""

    def __len__(self) -> int: ...
    @property
    def position_px(self) -> NDArray[np.float64]:
        """Positions of the edges [px], (N, 2)."""

    @property
    def offset_px(self) -> NDArray[np.float64]:
        """Signed distances of the edges from the path along its normal [px], (N,)."""

    @property
    def contrast(self) -> NDArray[np.float64]:
        """Steps across the edges [grey levels], (N,); positive if they rise along the normal."""

    @property
    def sigma_px(self) -> NDArray[np.float64]:
        """Standard deviations of the distances [px], (N,).

        They follow from noise of 2 grey levels and the roughness of cut edges.
        """

@final
class LineFit:
    """The line with the largest consensus among edges; see `fit_line`."""

    @property
    def point_px(self) -> tuple[float, float]:
        """A point of the line, in the middle of the inliers [px]."""

    @property
    def angle_rad(self) -> float:
        """Direction of the line [rad], determined up to a half turn."""

    @property
    def covariance(self) -> NDArray[np.float64]:
        """Covariance of (offset, angle), (2, 2).

        The offset [px] is along the line's normal at the point, the angle in radians.
        """

    @property
    def share(self) -> float:
        """Fraction of the edges that are inliers, 0 to 1."""

    @property
    def inliers(self) -> NDArray[np.bool_]:
        """Whether each edge is an inlier, (N,)."""

    @property
    def rms_px(self) -> float:
        """Root mean square of the inliers' residuals [px]."""

def edges_along(
    image: NDArray[np.uint8],
    path_px: ArrayLike,
    reach_px: float,
    polarity: int,
    least_contrast: float,
) -> EdgePoints:
    """Localise an edge along a path to a fraction of a pixel.

    Each stretch of the path, 1/32 of its length but at least 1 px and at most 8 px, gives at most
    one edge. The rows or columns of pixels across it are correlated together with the derivative of
    a Gaussian. The kernel is shifted instead of the pixels, so no pixel is interpolated and no
    position in the pixel grid is preferred.

    Parameters
    ----------
    image : (height, width)
        Grey levels; not copied.
    path_px : (K, 2)
        Corners of a polyline near the edge [px]. Parts at which the kernel would leave the image
        have no edges.
    reach_px
        Maximum distance of an edge from the path [px], 0.5 to 100.
    polarity
        1 for edges that rise along the normal, which is the path's direction turned by 90° from +u
        towards +v; -1 for those that fall; 0 for both.
    least_contrast
        Minimum step of an edge [grey levels].

    Raises
    ------
    InvalidInputError
        A reach or polarity out of range; a path or contrast that is not finite.
    """

def fit_line(points_px: ArrayLike, sigmas_px: ArrayLike) -> LineFit | None:
    """Fit the line with the largest consensus, refined by least squares with biweights.

    The covariance is estimated from the residuals; their correlation between neighbours reduces
    the effective number of points.

    Parameters
    ----------
    points_px : (N, 2)
        Points in order along the line [px].
    sigmas_px : (N,)
        Standard deviation of each point, up to one common factor, > 0 [px].

    Returns
    -------
    LineFit or None
        None for fewer than 5 points, or without consensus.

    Raises
    ------
    InvalidInputError
        Different numbers of points and standard deviations; a standard deviation that is not
        positive; values that are not finite.
    """
