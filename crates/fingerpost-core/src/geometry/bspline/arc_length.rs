//! Arc length of a B-spline curve, and the parameters at given lengths.
//!
//! Inside a knot span the velocity is a polynomial of degree two at most, so its magnitude, the
//! speed, is smooth except at cusps. Every span is halved until Gauss–Legendre quadrature over a
//! piece agrees with the sum over its halves. A length is located in its piece by Newton's method,
//! kept inside a shrinking bracket.

use nalgebra::{Point2, Vector2};

use crate::geometry::bspline::{BSpline, check_control_point_count, check_count, finite_point};
use crate::{Error, Result};

/// Nodes in (0, 1) and weights of the Gauss–Legendre rule of 8 points on [−1, 1], which has each of
/// them with both signs.
const GAUSS_LEGENDRE: [(f64, f64); 4] = [
    (0.183_434_642_495_649_8, 0.362_683_783_378_362),
    (0.525_532_409_916_329, 0.313_706_645_877_887_3),
    (0.796_666_477_413_626_7, 0.222_381_034_453_374_48),
    (0.960_289_856_497_536_3, 0.101_228_536_290_376_26),
];

/// Relative difference of a piece and its halves, in units of the control polygon's length. The
/// halves, which are kept, are far more accurate, and a curve has hundreds of pieces.
const PIECE_TOLERANCE: f64 = 1e-13;

/// Tolerance of a located length, in units of the control polygon's length.
const LENGTH_TOLERANCE: f64 = 1e-13;

/// Maximum number of halvings of a span; only a cusp, where the speed has a kink, needs more than a
/// few.
const MAX_HALVINGS: u32 = 48;

/// Maximum number of Newton steps; bisection alone would reach the resolution of `f64` with these.
const MAX_STEPS: u32 = 64;

/// The arc length along one curve. Made by [`BSpline::arc_length`].
///
/// Lengths, and positions of parameters along the curve, are accurate to 10⁻¹⁰ of the control
/// polygon's length.
#[derive(Debug, Clone, PartialEq)]
pub struct ArcLength {
    /// In the order of the curve.
    pieces: Vec<Piece>,
    total: f64,
    domain: (f64, f64),
    closed: bool,
    tolerance: f64,
}

impl BSpline {
    /// Measures the curve of `control_points`.
    ///
    /// # Errors
    ///
    /// [`Error::WrongCount`] and [`Error::NotFiniteAt`] for unsuitable control points,
    /// [`Error::UnusableLength`] if they all coincide or their distances overflow.
    ///
    /// ```
    /// use fingerpost_core::{BSpline, Degree};
    /// use fingerpost_core::nalgebra::Point2;
    ///
    /// // A straight line that starts slowly: half its parameters make a third of its length.
    /// let spline = BSpline::open_uniform(Degree::Quadratic, 3)?;
    /// let line = [0.0, 1.0, 6.0].map(|u| Point2::new(u, 0.0));
    /// let arc_length = spline.arc_length(&line)?;
    /// assert!((arc_length.total() - 6.0).abs() < 1e-9);
    /// assert!((arc_length.parameter_at(2.0)? - 0.5).abs() < 1e-9);
    /// # Ok::<(), fingerpost_core::Error>(())
    /// ```
    pub fn arc_length(&self, control_points: &[Point2<f64>]) -> Result<ArcLength> {
        check_control_point_count(control_points, self.control_point_count())?;
        for i in 0..control_points.len() {
            finite_point("control point", control_points, i)?;
        }
        let polygon = polygon_length(control_points)?;
        let tolerance = LENGTH_TOLERANCE * polygon;

        let mut pieces = Vec::new();
        for span in self.spans() {
            let velocity = self.span_velocity(span, control_points);
            let whole = velocity.length(0.0, 1.0);
            measure(velocity, (0.0, 1.0), whole, PIECE_TOLERANCE * polygon, 0, &mut pieces);
        }
        let mut total = 0.0;
        for piece in &mut pieces {
            piece.before = total;
            total += piece.length;
        }
        if total > 0.0 && total < f64::INFINITY {
            let (domain, closed) = (self.domain(), self.is_closed());
            Ok(ArcLength { pieces, total, domain, closed, tolerance })
        } else {
            Err(Error::UnusableLength { what: "curve", length: total })
        }
    }

    /// The non-empty spans of the domain.
    fn spans(&self) -> impl Iterator<Item = usize> {
        let first = self.degree() as usize;
        let pairs = self.domain_knots().windows(2).enumerate();
        pairs.filter(|(_, pair)| pair[0] < pair[1]).map(move |(i, _)| first + i)
    }

    /// The velocity in a span, from its values at both ends and the middle.
    fn span_velocity(&self, span: usize, control_points: &[Point2<f64>]) -> SpanVelocity {
        let (start, end) = (self.knots[span], self.knots[span + 1]);
        let width = end - start;
        let at = |x: f64| {
            let row = self.basis_in_span(span, start + x * width);
            // Relative to one of the control points: far from the origin, derivatives would
            // otherwise be small differences of large numbers.
            let origin = control_points[row.first()];
            row.indices()
                .zip(row.first_derivatives())
                .map(|(i, derivative)| (control_points[i] - origin) * (derivative * width))
                .sum::<Vector2<f64>>()
        };
        let (first, middle, last) = (at(0.0), at(0.5), at(1.0));
        let coefficients =
            [first, middle * 4.0 - first * 3.0 - last, (first + last) * 2.0 - middle * 4.0];
        SpanVelocity { start, end, coefficients }
    }
}

impl ArcLength {
    /// The length of the whole curve, in the unit of its control points.
    #[must_use]
    pub fn total(&self) -> f64 {
        self.total
    }

    /// The parameter at the length `s` from the start of the domain. A closed curve takes any `s`
    /// and wraps around. Where a curve rests over an interval of parameters, the last of them is
    /// returned.
    ///
    /// # Errors
    ///
    /// [`Error::NotFinite`], and on an open curve [`Error::OutOfRange`] outside [0,
    /// [`total`](Self::total)].
    pub fn parameter_at(&self, s: f64) -> Result<f64> {
        let what = "the length along a curve";
        if self.closed {
            return Ok(self.locate(Error::finite(what, s)?.rem_euclid(self.total)));
        }
        let inside = |s: f64| (0.0..=self.total).contains(&s);
        Error::within(what, s, "between 0 and the curve's total length", inside)
            .map(|s| self.locate(s))
    }

    /// `count` parameters at equal steps of arc length, increasing. The first is the start of the
    /// domain. The last is its end on an open curve; on a closed one it is one step before the
    /// first.
    ///
    /// # Errors
    ///
    /// [`Error::TooFew`] below two samples of an open curve or one of a closed curve.
    pub fn equally_spaced(&self, count: usize) -> Result<Vec<f64>> {
        let (least, steps) = if self.closed { (1, count) } else { (2, count.saturating_sub(1)) };
        check_count("samples of a curve", count, least)?;
        let length = |i| self.total * (i as f64 / steps as f64);
        Ok((0..count).map(|i| self.locate(length(i))).collect())
    }

    /// The parameter at a length in [0, total].
    fn locate(&self, s: f64) -> f64 {
        if s <= 0.0 {
            self.domain.0
        } else if s >= self.total {
            self.domain.1
        } else {
            // The last of the pieces that start at or before `s`: it extends beyond `s`, and is not
            // empty.
            let after = self.pieces.partition_point(|piece| piece.before <= s);
            self.pieces[after - 1].locate(s, self.tolerance)
        }
    }
}

/// The curve's velocity in one knot span as a polynomial in x, which runs over it from 0 to 1.
#[derive(Debug, Clone, Copy, PartialEq)]
struct SpanVelocity {
    start: f64,
    end: f64,
    /// Of 1, x and x².
    coefficients: [Vector2<f64>; 3],
}

impl SpanVelocity {
    fn speed(&self, x: f64) -> f64 {
        let [c0, c1, c2] = self.coefficients;
        let velocity = (c2 * x + c1) * x + c0;
        velocity.x.hypot(velocity.y)
    }

    /// The length from `from` to `to`, if the speed is smooth there.
    fn length(&self, from: f64, to: f64) -> f64 {
        let (middle, half) = (0.5 * (from + to), 0.5 * (to - from));
        let pairs = GAUSS_LEGENDRE.iter().map(|&(node, weight)| {
            weight * (self.speed(middle - half * node) + self.speed(middle + half * node))
        });
        half * pairs.sum::<f64>()
    }
}

/// A part of a span over which one application of the quadrature is accurate enough.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Piece {
    velocity: SpanVelocity,
    from: f64,
    to: f64,
    /// The length of the curve before the piece.
    before: f64,
    length: f64,
}

impl Piece {
    /// The parameter at length `s` of the whole curve, which lies in this piece.
    fn locate(&self, s: f64, tolerance: f64) -> f64 {
        let target = s - self.before;
        let (mut low, mut high) = (self.from, self.to);
        let mut x = low + (high - low) * (target / self.length).min(1.0);
        for _ in 0..MAX_STEPS {
            let excess = self.velocity.length(self.from, x) - target;
            if excess.abs() <= tolerance {
                break;
            }
            (low, high) = if excess > 0.0 { (low, x) } else { (x, high) };
            let newton = x - excess / self.velocity.speed(x);
            // NaN where the speed is zero; bisection then.
            x = if newton > low && newton < high { newton } else { 0.5 * (low + high) };
        }
        let SpanVelocity { start, end, .. } = self.velocity;
        (start + (end - start) * x).min(end)
    }
}

/// Halves a part of a span, whose quadrature gives the length `whole`, until the tolerance is met,
/// and appends the pieces.
fn measure(
    velocity: SpanVelocity,
    (from, to): (f64, f64),
    whole: f64,
    tolerance: f64,
    halvings: u32,
    pieces: &mut Vec<Piece>,
) {
    let middle = 0.5 * (from + to);
    let (left, right) = (velocity.length(from, middle), velocity.length(middle, to));
    if (left + right - whole).abs() > tolerance && halvings < MAX_HALVINGS {
        measure(velocity, (from, middle), left, tolerance, halvings + 1, pieces);
        measure(velocity, (middle, to), right, tolerance, halvings + 1, pieces);
        return;
    }
    for (from, to, length) in [(from, middle, left), (middle, to, right)] {
        pieces.push(Piece { velocity, from, to, before: 0.0, length });
    }
}

/// The length of the polygon through the control points: the size of the curve, to within a factor.
fn polygon_length(control_points: &[Point2<f64>]) -> Result<f64> {
    let sides = control_points.windows(2);
    let length = sides.map(|side| (side[1].x - side[0].x).hypot(side[1].y - side[0].y)).sum();
    if length > 0.0 && length < f64::INFINITY {
        Ok(length)
    } else {
        Err(Error::UnusableLength { what: "control polygon", length })
    }
}
