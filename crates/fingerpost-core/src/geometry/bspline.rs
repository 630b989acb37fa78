//! Quadratic and cubic B-spline curves in the plane, open and closed.
//!
//! [`BSpline`] is the basis alone: degree, knots and whether it closes. The control points are an
//! argument, because every deformation of a contour moves them and leaves the basis unchanged. To
//! sample one contour repeatedly, evaluate [`BSpline::basis`] once per sample and
//! [blend](BasisRow::blend) it with the current control points.
//!
//! The basis functions follow from the Cox–de Boor recursion in the triangular form that never
//! divides by an empty knot span, their derivatives from differences of the functions of lower
//! degree. A knot repeated `degree` times makes a corner. A closed B-spline is an open one on
//! periodically continued knots, with control points taken modulo their number.
//!
//! [`BSpline::fit`] fits control points to an ordered outline by linear least squares;
//! [`BSpline::arc_length`] computes parameters at given lengths along the curve.
//!
//! Sources: C. de Boor, *A Practical Guide to Splines*, chapters IX, X and XIII; L. Piegl and W.
//! Tiller, *The NURBS Book*, algorithms A2.1 to A2.3 and section 9.4.

mod arc_length;
mod fit;

pub use arc_length::ArcLength;
pub use fit::{Parametrization, SplineFit};

use nalgebra::{Point2, Vector2};

use crate::{Error, Result};

/// Number of non-zero basis functions at one parameter, for the highest degree.
const MAX_ORDER: usize = 4;

/// Minimum knot span relative to the knots' magnitude: a parameter then has five digits left for
/// its position in the span.
const MIN_RELATIVE_SPAN: f64 = 1e-10;

/// Maximum number of control points of a uniform B-spline: far above any use for a contour, with
/// knots that still fit into memory.
const MAX_CONTROL_POINTS: usize = 1 << 20;

/// Range of the knot spans, within which no second derivative of a basis function overflows.
const SPAN_RANGE: (f64, f64) = (1e-100, 1e100);

/// The degree of a B-spline's polynomial pieces.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Degree {
    /// Degree 2: continuous tangent at a simple knot, corner at a double one.
    Quadratic = 2,
    /// Degree 3: continuous curvature at a simple knot, corner at a triple one.
    Cubic = 3,
}

impl Degree {
    /// Control points that act on one polynomial piece: degree + 1.
    #[must_use]
    pub fn order(self) -> usize {
        self as usize + 1
    }
}

impl TryFrom<usize> for Degree {
    type Error = Error;

    fn try_from(degree: usize) -> Result<Self> {
        match degree {
            2 => Ok(Self::Quadratic),
            3 => Ok(Self::Cubic),
            _ => Err(Error::UnsupportedDegree { degree }),
        }
    }
}

/// A B-spline basis: degree, knots, open or closed. Control points give it a shape.
///
/// ```
/// use fingerpost_core::{BSpline, Degree};
/// use fingerpost_core::nalgebra::Point2;
///
/// // A knot repeated three times makes the corner of an L: the curve passes through (4, 0).
/// let spline = BSpline::open_clamped(Degree::Cubic, &[0.0, 1.0, 1.0, 1.0, 2.0])?;
/// let control_points =
///     [(0.0, 0.0), (1.0, 0.0), (2.0, 0.0), (4.0, 0.0), (4.0, 1.0), (4.0, 2.0), (4.0, 3.0)]
///         .map(|(u, v)| Point2::new(u, v));
/// let corner = spline.evaluate(&control_points, 1.0)?;
/// assert_eq!(corner.position, Point2::new(4.0, 0.0));
/// assert_eq!(corner.first_derivative.normalize().y, 1.0);
/// # Ok::<(), fingerpost_core::Error>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct BSpline {
    degree: Degree,
    closed: bool,
    control_point_count: usize,
    /// Non-decreasing; for a closed B-spline with `degree` knots more on either side of its period.
    /// Basis function i is non-zero on `[knots[i], knots[i + degree + 1]]`, and the domain starts
    /// at `knots[degree]`.
    knots: Vec<f64>,
}

impl BSpline {
    /// An open B-spline on a full knot vector: n + degree + 1 knots for n control points. The
    /// domain runs from knot `degree` to knot n.
    ///
    /// On clamped knots, whose first and last occur degree + 1 times, the curve starts at the first
    /// control point and ends at the last. Inner knots may repeat `degree` times, which makes a
    /// corner at a control point.
    ///
    /// # Errors
    ///
    /// [`Error::TooFew`] below 2 (degree + 1) knots, [`Error::NotFiniteAt`],
    /// [`Error::KnotsDecrease`], [`Error::KnotMultiplicity`] and [`Error::EmptyDomain`] for knots
    /// that make no connected curve, [`Error::KnotSpan`] for neighbours that are not equal but
    /// closer than 10⁻¹⁰ of the domain's larger end.
    pub fn open(degree: Degree, knots: &[f64]) -> Result<Self> {
        let order = degree.order();
        check_count("knots", knots.len(), 2 * order)?;
        check_knots(knots)?;
        check_multiplicities(knots, degree, order)?;
        Self::with_spans_checked(degree, false, knots.len() - order, knots.to_vec())
    }

    /// An open B-spline that starts at the first control point and ends at the last:
    /// [`open`](Self::open) on `breaks` with the first and the last repeated to multiplicity degree
    /// + 1. Inner knots are given with their multiplicity, the two ends once: `breaks.len() +
    /// degree − 1` control points.
    ///
    /// # Errors
    ///
    /// [`Error::TooFew`] below two breaks, else as [`open`](Self::open).
    pub fn open_clamped(degree: Degree, breaks: &[f64]) -> Result<Self> {
        let (Some(&start), Some(&end), 2..) = (breaks.first(), breaks.last(), breaks.len()) else {
            return Err(Error::TooFew { what: "breaks", given: breaks.len(), needed: 2 });
        };
        let repeats = degree as usize;
        let mut knots = Vec::with_capacity(breaks.len() + 2 * repeats);
        knots.resize(repeats, start);
        knots.extend_from_slice(breaks);
        knots.resize(knots.len() + repeats, end);
        Self::open(degree, &knots)
    }

    /// An open, clamped B-spline with `n` control points and knots one apart: its domain is
    /// [0, n − degree].
    ///
    /// # Errors
    ///
    /// [`Error::TooFew`] below degree + 1 control points, [`Error::OutOfRange`] above 2²⁰.
    ///
    /// ```
    /// # use fingerpost_core::{BSpline, Degree};
    /// let spline = BSpline::open_uniform(Degree::Quadratic, 5)?;
    /// assert_eq!(spline.knots(), [0.0, 0.0, 0.0, 1.0, 2.0, 3.0, 3.0, 3.0]);
    /// # Ok::<(), fingerpost_core::Error>(())
    /// ```
    pub fn open_uniform(degree: Degree, n: usize) -> Result<Self> {
        check_uniform_count(n, degree)?;
        let breaks: Vec<f64> = (0..=n - degree as usize).map(|k| k as f64).collect();
        Self::open_clamped(degree, &breaks)
    }

    /// A closed B-spline on the knots of one period: n + 1 knots for n control points, the last a
    /// period after the first. Control point i acts from knot i − degree to knot i + 1.
    ///
    /// Any knot may repeat `degree` times, which makes a corner. The first and the last are the
    /// same knot of the curve, so their multiplicities add.
    ///
    /// # Errors
    ///
    /// [`Error::TooFew`] below degree + 2 knots, else as [`open`](Self::open).
    pub fn closed(degree: Degree, knots: &[f64]) -> Result<Self> {
        check_count("knots", knots.len(), degree.order() + 1)?;
        check_knots(knots)?;
        let periodic = continue_periodically(knots, degree as usize);
        check_multiplicities(&periodic, degree, degree as usize)?;
        Self::with_spans_checked(degree, true, knots.len() - 1, periodic)
    }

    /// A closed B-spline with `n` control points and knots one apart: its domain is [0, n].
    ///
    /// # Errors
    ///
    /// [`Error::TooFew`] below degree + 1 control points, [`Error::OutOfRange`] above 2²⁰.
    pub fn closed_uniform(degree: Degree, n: usize) -> Result<Self> {
        check_uniform_count(n, degree)?;
        let knots: Vec<f64> = (0..=n).map(|k| k as f64).collect();
        Self::closed(degree, &knots)
    }

    /// Checks that the domain is not empty and that the knots are equal or sufficiently apart.
    fn with_spans_checked(
        degree: Degree,
        closed: bool,
        control_point_count: usize,
        knots: Vec<f64>,
    ) -> Result<Self> {
        let spline = Self { degree, closed, control_point_count, knots };
        let (start, end) = spline.domain();
        if start >= end {
            return Err(Error::EmptyDomain { start, end });
        }
        let least = SPAN_RANGE.0.max(MIN_RELATIVE_SPAN * start.abs().max(end.abs()));
        for pair in spline.knots.windows(2) {
            let span = pair[1] - pair[0];
            if span > 0.0 && !(least..=SPAN_RANGE.1).contains(&span) {
                let (start, greatest) = (pair[0], SPAN_RANGE.1);
                return Err(Error::KnotSpan { start, span, least, greatest });
            }
        }
        Ok(spline)
    }

    /// The degree of the polynomial pieces.
    #[must_use]
    pub fn degree(&self) -> Degree {
        self.degree
    }

    /// Whether the curve is closed.
    #[must_use]
    pub fn is_closed(&self) -> bool {
        self.closed
    }

    /// The number of control points of the curve.
    #[must_use]
    pub fn control_point_count(&self) -> usize {
        self.control_point_count
    }

    /// The knots in the form taken by [`open`](Self::open) or [`closed`](Self::closed).
    #[must_use]
    pub fn knots(&self) -> &[f64] {
        if self.closed { self.domain_knots() } else { &self.knots }
    }

    /// First and last parameter of the curve. A closed curve is periodic and takes any parameter.
    #[must_use]
    pub fn domain(&self) -> (f64, f64) {
        let last_span = self.knots.len() - self.degree.order();
        (self.knots[self.degree as usize], self.knots[last_span])
    }

    /// The non-zero basis functions at parameter `t`, with their derivatives.
    ///
    /// At a knot the derivatives are those from the right, at the end of an open curve those from
    /// the left; this matters where a derivative is discontinuous.
    ///
    /// # Errors
    ///
    /// [`Error::NotFinite`], and for an open B-spline [`Error::OutsideDomain`].
    ///
    /// ```
    /// # use fingerpost_core::{BSpline, Degree};
    /// let row = BSpline::closed_uniform(Degree::Quadratic, 6)?.basis(5.0)?;
    /// assert_eq!(row.values(), [0.5, 0.5, 0.0]);
    /// assert_eq!(row.indices().collect::<Vec<_>>(), [5, 0, 1]);
    /// # Ok::<(), fingerpost_core::Error>(())
    /// ```
    pub fn basis(&self, t: f64) -> Result<BasisRow> {
        let t = self.parameter_in_domain(t)?;
        Ok(self.basis_in_span(self.span(t), t))
    }

    /// Position and derivatives of the curve at parameter `t`; see [`basis`](Self::basis) for the
    /// derivatives at knots.
    ///
    /// # Errors
    ///
    /// Those of [`basis`](Self::basis) and [`BasisRow::blend`].
    pub fn evaluate(&self, control_points: &[Point2<f64>], t: f64) -> Result<CurvePoint> {
        self.basis(t)?.blend(control_points)
    }

    /// The knots of the domain, both its ends included once.
    fn domain_knots(&self) -> &[f64] {
        let degree = self.degree as usize;
        &self.knots[degree..self.knots.len() - degree]
    }

    fn parameter_in_domain(&self, t: f64) -> Result<f64> {
        let t = Error::finite("the parameter of a B-spline", t)?;
        let (start, end) = self.domain();
        // A parameter in the domain is unchanged: rounding must not move it across its knot.
        if t >= start && (t < end || (t <= end && !self.closed)) {
            Ok(t)
        } else if self.closed {
            Ok((start + (t - start).rem_euclid(end - start)).min(end))
        } else {
            Err(Error::OutsideDomain { parameter: t, start, end })
        }
    }

    /// The knot span i with `knots[i] ≤ t < knots[i + 1]`; at the end of the domain the last
    /// non-empty one. `t` lies in the domain.
    fn span(&self, t: f64) -> usize {
        let knots = self.domain_knots();
        let starts_before = if t < self.domain().1 {
            knots.partition_point(|&knot| knot <= t)
        } else {
            knots.partition_point(|&knot| knot < t)
        };
        self.degree as usize + starts_before - 1
    }

    /// The polynomials of a non-empty span, evaluated at any `t`.
    fn basis_in_span(&self, span: usize, t: f64) -> BasisRow {
        let degree = self.degree as usize;
        let (mut two_below, mut one_below, mut values) =
            ([0.0; MAX_ORDER], [0.0; MAX_ORDER], [1.0, 0.0, 0.0, 0.0]);
        for d in 1..=degree {
            (two_below, one_below, values) = (one_below, values, self.raise(span, d, t, values));
        }
        let slopes_one_below = self.differentiate(span, degree - 1, two_below);
        BasisRow {
            first: span - degree,
            order: self.degree.order(),
            control_point_count: self.control_point_count,
            values,
            first_derivatives: self.differentiate(span, degree, one_below),
            second_derivatives: self.differentiate(span, degree, slopes_one_below),
        }
    }

    /// One step of the Cox–de Boor recursion: the d + 1 basis functions of degree `d` from the `d`
    /// of the degree below (The NURBS Book, A2.2).
    fn raise(&self, span: usize, d: usize, t: f64, lower: [f64; MAX_ORDER]) -> [f64; MAX_ORDER] {
        let mut raised = [0.0; MAX_ORDER];
        for r in 0..d {
            let (from, to) = self.support(span, d, r);
            // Divided first: 0 and 1 are exact at the ends, and so is a clamped curve's end.
            let rising = (t - from) / (to - from);
            raised[r] += (1.0 - rising) * lower[r];
            raised[r + 1] = rising * lower[r];
        }
        raised
    }

    /// Derivatives of the d + 1 basis functions of degree `d` from the `d` functions of the degree
    /// below (de Boor, X (12)). It is linear: applied to derivatives it gives the next derivatives.
    fn differentiate(&self, span: usize, d: usize, lower: [f64; MAX_ORDER]) -> [f64; MAX_ORDER] {
        let mut derivatives = [0.0; MAX_ORDER];
        for r in 0..d {
            let (from, to) = self.support(span, d, r);
            let share = d as f64 * lower[r] / (to - from);
            derivatives[r] -= share;
            derivatives[r + 1] += share;
        }
        derivatives
    }

    /// Support of the r-th function of degree `d` − 1 at `span`. It contains the span, so its ends
    /// are never equal.
    fn support(&self, span: usize, d: usize, r: usize) -> (f64, f64) {
        (self.knots[span + r + 1 - d], self.knots[span + r + 1])
    }
}

/// The non-zero basis functions at one parameter, with first and second derivatives by the
/// parameter. Made by [`BSpline::basis`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BasisRow {
    first: usize,
    order: usize,
    control_point_count: usize,
    values: [f64; MAX_ORDER],
    first_derivatives: [f64; MAX_ORDER],
    second_derivatives: [f64; MAX_ORDER],
}

impl BasisRow {
    /// The index of the first control point that acts here. The others follow it, on a closed curve
    /// modulo the number of control points; see [`indices`](Self::indices).
    #[must_use]
    pub fn first(&self) -> usize {
        self.first
    }

    /// The indices of the degree + 1 control points that act here, all different.
    #[must_use]
    pub fn indices(&self) -> impl ExactSizeIterator<Item = usize> + use<> {
        let Self { first, order, control_point_count, .. } = *self;
        (0..order).map(move |k| (first + k) % control_point_count)
    }

    /// Their degree + 1 weights: not negative, with sum 1.
    #[must_use]
    pub fn values(&self) -> &[f64] {
        &self.values[..self.order]
    }

    /// The first derivatives of the weights; their sum is 0.
    #[must_use]
    pub fn first_derivatives(&self) -> &[f64] {
        &self.first_derivatives[..self.order]
    }

    /// The second derivatives of the weights; their sum is 0.
    #[must_use]
    pub fn second_derivatives(&self) -> &[f64] {
        &self.second_derivatives[..self.order]
    }

    /// The point of the curve for `control_points`, with its derivatives.
    ///
    /// # Errors
    ///
    /// [`Error::WrongCount`] if there are not [`BSpline::control_point_count`] control points,
    /// [`Error::NotFiniteAt`] if one of those that act here is not finite.
    pub fn blend(&self, control_points: &[Point2<f64>]) -> Result<CurvePoint> {
        check_control_point_count(control_points, self.control_point_count)?;
        let mut position = Vector2::zeros();
        let mut first_derivative = Vector2::zeros();
        let mut second_derivative = Vector2::zeros();
        for (k, i) in self.indices().enumerate() {
            let point = finite_point("control point", control_points, i)?.coords;
            position += point * self.values[k];
            first_derivative += point * self.first_derivatives[k];
            second_derivative += point * self.second_derivatives[k];
        }
        Ok(CurvePoint { position: position.into(), first_derivative, second_derivative })
    }
}

/// A point of a curve with its derivatives by the parameter.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CurvePoint {
    /// Position, in the unit of the control points.
    pub position: Point2<f64>,
    /// Along the tangent in the direction of increasing parameter; zero at a cusp.
    pub first_derivative: Vector2<f64>,
    /// Second derivative; its component across the tangent determines the curvature.
    pub second_derivative: Vector2<f64>,
}

pub(crate) fn check_count(what: &'static str, given: usize, needed: usize) -> Result<()> {
    if given < needed { Err(Error::TooFew { what, given, needed }) } else { Ok(()) }
}

fn check_uniform_count(n: usize, degree: Degree) -> Result<()> {
    check_count("control points", n, degree.order())?;
    Error::within("number of control points", n as f64, "at most 1048576", |_| {
        n <= MAX_CONTROL_POINTS
    })?;
    Ok(())
}

fn check_control_point_count(control_points: &[Point2<f64>], needed: usize) -> Result<()> {
    let given = control_points.len();
    if given == needed {
        Ok(())
    } else {
        Err(Error::WrongCount { what: "control points", given, needed })
    }
}

/// Point `index`, or the error that one of its coordinates is not finite.
fn finite_point(what: &'static str, points: &[Point2<f64>], index: usize) -> Result<Point2<f64>> {
    let point = points[index];
    match point.iter().find(|coordinate| !coordinate.is_finite()) {
        Some(&value) => Err(Error::NotFiniteAt { what, index, value }),
        None => Ok(point),
    }
}

/// Checks that the knots are finite and non-decreasing.
fn check_knots(knots: &[f64]) -> Result<()> {
    if let Some(index) = knots.iter().position(|knot| !knot.is_finite()) {
        return Err(Error::NotFiniteAt { what: "knot", index, value: knots[index] });
    }
    match knots.windows(2).position(|pair| pair[1] < pair[0]) {
        Some(k) => {
            let (previous, knot) = (knots[k], knots[k + 1]);
            Err(Error::KnotsDecrease { index: k + 1, previous, knot })
        }
        None => Ok(()),
    }
}

/// Checks that no knot occurs more than `degree` times inside and `at_ends` times at the two ends.
fn check_multiplicities(knots: &[f64], degree: Degree, at_ends: usize) -> Result<()> {
    let mut start = 0;
    for equal in knots.chunk_by(|a, b| a >= b) {
        let end = start + equal.len();
        let inside = start > 0 && end < knots.len();
        let allowed = if inside { degree as usize } else { at_ends };
        if equal.len() > allowed {
            let (knot, multiplicity) = (equal[0], equal.len());
            return Err(Error::KnotMultiplicity { knot, multiplicity, allowed });
        }
        start = end;
    }
    Ok(())
}

/// The knots of one period with `degree` more on either side, shifted by the period. Differences
/// are taken within the period, so that equal knots stay equal across the seam.
fn continue_periodically(knots: &[f64], degree: usize) -> Vec<f64> {
    let n = knots.len() - 1;
    let (start, end) = (knots[0], knots[n]);
    let before = knots[n - degree..n].iter().map(|knot| start - (end - knot));
    let after = knots[1..=degree].iter().map(|knot| end + (knot - start));
    before.chain(knots.iter().copied()).chain(after).collect()
}
