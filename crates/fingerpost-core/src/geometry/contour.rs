//! Samples of a curve at equal steps of arc length, with tangents and with normals that point out
//! of the hand.

use super::bspline::BSpline;
use crate::{Error, Result};
use nalgebra::{Point2, Vector2};

/// The side of the direction of travel along a contour on which the hand lies, in axes like the
/// image's (u right, v down): travelling towards +u, +v is to the right.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum HandSide {
    /// Left of the direction of travel.
    Left,
    /// Right of the direction of travel.
    Right,
}

impl HandSide {
    /// −1 for left, +1 for right: the sign of a rotation towards that side.
    #[must_use]
    pub fn sign(self) -> f64 {
        match self {
            Self::Left => -1.0,
            Self::Right => 1.0,
        }
    }

    /// The unit normal out of the hand, for a unit tangent.
    #[must_use]
    pub fn outward(self, tangent: &Vector2<f64>) -> Vector2<f64> {
        match self {
            Self::Left => Vector2::new(-tangent.y, tangent.x),
            Self::Right => Vector2::new(tangent.y, -tangent.x),
        }
    }
}

/// One sample of a contour.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ContourSample {
    /// The curve's parameter.
    pub parameter: f64,
    /// Length of the curve from its start.
    pub arc_length: f64,
    /// Position of the sample.
    pub position: Point2<f64>,
    /// Unit tangent in the direction of travel.
    pub tangent: Vector2<f64>,
    /// Unit normal, out of the hand.
    pub normal: Vector2<f64>,
}

/// `count` samples at equal steps of arc length. Each is at the middle of its step, so all
/// represent the same length and none falls on an end.
///
/// # Errors
/// [`Error::TooFew`] without a sample; [`Error::UnusableLength`] where the curve has zero velocity,
/// so that a sample has no tangent; the errors of [`BSpline::arc_length`] for unsuitable control
/// points.
///
/// ```
/// use fingerpost_core::{BSpline, Degree, HandSide, sample_contour};
/// use fingerpost_core::nalgebra::Point2;
///
/// let spline = BSpline::open_uniform(Degree::Quadratic, 3)?;
/// let line = [0.0, 1.0, 2.0].map(|u| Point2::new(u, 0.0));
/// let samples = sample_contour(&spline, &line, 4, HandSide::Right)?;
/// assert_eq!(samples[0].arc_length, 0.25);
/// assert_eq!(samples[0].normal.y, -1.0);
/// # Ok::<(), fingerpost_core::Error>(())
/// ```
pub fn sample(
    spline: &BSpline,
    control_points: &[Point2<f64>],
    count: usize,
    hand: HandSide,
) -> Result<Vec<ContourSample>> {
    if count == 0 {
        return Err(Error::TooFew { what: "contour samples", given: 0, needed: 1 });
    }
    let length = spline.arc_length(control_points)?;
    let step = length.total() / count as f64;
    (0..count)
        .map(|i| {
            let arc_length = (i as f64 + 0.5) * step;
            let parameter = length.parameter_at(arc_length)?;
            let point = spline.evaluate(control_points, parameter)?;
            let speed = point.first_derivative.norm();
            if !(speed > 0.0 && speed.is_finite()) {
                return Err(Error::UnusableLength { what: "contour's tangent", length: speed });
            }
            let tangent = point.first_derivative / speed;
            let normal = hand.outward(&tangent);
            Ok(ContourSample { parameter, arc_length, position: point.position, tangent, normal })
        })
        .collect()
}
