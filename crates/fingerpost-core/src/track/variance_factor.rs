//! Variance factor of the finger lines' covariances, and bias of the contours' lines.
//!
//! A covariance accounts for the errors that scatter within one image. Other errors show in the
//! comparison of two estimates of one line: if their covariances are right, the squared difference
//! is on average the predicted variance. Where it is more, as in grey and compressed images and
//! before patterned cloth, all covariances are scaled by the ratio, the variance of unit weight of
//! least-squares adjustment. A factor below 1 is never applied.
//!
//! The mean of the differences over frames is the contour's bias. Its edges lie at the greatest
//! gradient, which on a limb in the shade is inside the finger; the photometric model includes a
//! shading ramp. In one frame the pixels are less precise than this bias, but the mean over many
//! frames is not: the contour's line is corrected by it. The contour's covariance still includes
//! the bias, because the mean of the pixels has an error of its own. While the hand rests, all
//! frames are one comparison: the new part of the next one grows with the distance that the finger
//! has moved.

use super::line::FingerLine;
use super::line_filter::correlation;
use crate::numeric::ablation::{Mechanism, is_off};
use nalgebra::{Matrix2, Point2, Vector2};

/// Prior weight of a variance factor of 1 and a bias of 0, in comparisons. A comparison changes
/// them by its fresh part times 1 / (comparisons so counted), but at least by the rate below.
const BELIEVED: f64 = 8.0;
const LEAST_RATE: f64 = 0.05;
/// 99 % quantile of χ² with 1 degree of freedom: a difference is limited to it, in units of the
/// estimated variance.
const CHI2_1DOF_99: f64 = 6.635;

/// Statistics of the difference between the pixels' and the contour's line of a hand, in offset and
/// in angle.
#[derive(Debug, Clone, Copy)]
pub(super) struct VarianceFactor {
    /// Mean difference of the pixels' line from the contour's (px, rad).
    bias: Vector2<f64>,
    /// Mean square of it, in units of the predicted variances.
    square: Vector2<f64>,
    comparisons: f64,
    /// Position of the contour at the last comparison.
    place: Option<Point2<f64>>,
}

impl Default for VarianceFactor {
    fn default() -> Self {
        Self {
            bias: Vector2::zeros(),
            square: Vector2::repeat(1.0),
            comparisons: BELIEVED,
            place: None,
        }
    }
}

impl VarianceFactor {
    /// Learns from the difference of the pixels' line from the contour's; `half_width_px` is the
    /// finger's.
    pub fn learn(&mut self, contour: &FingerLine, pixels: &FingerLine, half_width_px: f64) {
        let place = contour.axis.anchor;
        let gone = self.place.map_or(0.0, |last| (place - last).norm() / half_width_px);
        self.place = Some(place);
        let (difference, expected) = contour.difference_from(pixels);
        self.count(&difference, &expected, 1.0 - correlation(gone));
    }

    /// Learns from a difference with its covariance and its new part, 0–1.
    fn count(&mut self, difference: &Vector2<f64>, expected: &Matrix2<f64>, freshness: f64) {
        self.comparisons += freshness;
        let rate = freshness * (1.0 / self.comparisons).max(LEAST_RATE);
        for k in 0..2 {
            let sigma = expected[(k, k)].sqrt();
            let most = sigma * (CHI2_1DOF_99 * self.square[k].max(1.0)).sqrt();
            let difference = difference[k].clamp(-most, most);
            self.bias[k] += rate * (difference - self.bias[k]);
            self.square[k] += rate * ((difference / sigma).powi(2) - self.square[k]);
        }
    }

    /// The line of a contour, corrected by the mean difference of the pixels' lines, with its
    /// covariance scaled.
    pub fn bias_corrected(&self, contour: FingerLine) -> FingerLine {
        if is_off(Mechanism::VarianceFactor) {
            return contour;
        }
        self.scaled(contour.moved(&self.bias))
    }

    /// A line with its covariance scaled by the variance factor of offset and angle.
    pub fn scaled(&self, line: FingerLine) -> FingerLine {
        if is_off(Mechanism::VarianceFactor) {
            return line;
        }
        let sigmas = self.square.map(|square| square.max(1.0).sqrt());
        let scaled = line.covariance.component_mul(&(sigmas * sigmas.transpose()));
        FingerLine { covariance: scaled, ..line }
    }
}

// The differences it learns from are made by the tracker; here they are written down.
#[cfg(test)]
mod tests {
    use super::*;
    use crate::axis::Stretch;
    use crate::geometry::shape_space::Axis;
    use crate::track::LineSource;

    const SIGMAS: [f64; 2] = [0.2, 0.01];

    fn line() -> FingerLine {
        FingerLine {
            axis: Axis::of_finger(Point2::new(10.0, 20.0), 0.3, 30.0),
            half_length_px: 30.0,
            stretch: Stretch::about(0.0, 30.0),
            covariance: Matrix2::new(0.04, 1e-4, 1e-4, 1e-4),
            source: LineSource::Both,
        }
    }

    /// State after `count` comparisons with these differences, in units of the predicted standard
    /// deviations.
    fn learned(count: usize, difference: impl Fn(usize) -> [f64; 2]) -> VarianceFactor {
        let sigmas = Vector2::from(SIGMAS);
        let expected = Matrix2::from_diagonal(&sigmas.component_mul(&sigmas));
        let mut variance_factor = VarianceFactor::default();
        for k in 0..count {
            variance_factor.count(
                &Vector2::from(difference(k)).component_mul(&sigmas),
                &expected,
                1.0,
            );
        }
        variance_factor
    }

    fn sign(k: usize) -> f64 {
        if k.is_multiple_of(2) { 1.0 } else { -1.0 }
    }

    #[test]
    fn lines_that_differ_as_foretold_or_less_are_worth_what_they_say() {
        for part in [1.0, 0.3, 0.0] {
            let variance_factor = learned(50, |k| [part * sign(k), part]);
            assert!((variance_factor.scaled(line()).covariance - line().covariance).norm() < 1e-12);
        }
    }

    #[test]
    fn lines_that_differ_by_more_are_that_much_less_sure_in_what_differs() {
        let scaled = learned(150, |k| [sign(k), 3.0 * sign(k)]).scaled(line());
        let expected = Matrix2::new(0.04, 3e-4, 3e-4, 9e-4);
        let off = (scaled.covariance - expected).component_div(&expected);
        assert!(off.amax() < 0.02, "{}", scaled.covariance);
        assert_eq!(scaled.axis, line().axis);
    }

    #[test]
    fn one_line_that_is_far_off_makes_neither_worthless_nor_moves_the_rest() {
        let variance_factor =
            learned(20, |k| if k == 10 { [0.0, 1e3] } else { [sign(k), sign(k)] });
        let variance =
            variance_factor.scaled(line()).covariance[(1, 1)] / line().covariance[(1, 1)];
        assert!(1.05 < variance && variance < 1.5, "{variance}");
        let moved = line().difference(&variance_factor.bias_corrected(line()).axis);
        assert!(moved.y.abs() < 0.3 * SIGMAS[1], "{moved}");
    }

    #[test]
    fn what_stays_of_the_difference_is_taken_out_of_the_contour_and_remains_in_its_doubt() {
        let variance_factor = learned(150, |k| [2.0 + sign(k), -1.0]);
        let bias_corrected = variance_factor.bias_corrected(line());
        let moved = line().difference(&bias_corrected.axis);
        assert!((moved.x / SIGMAS[0] - 2.0).abs() < 0.1, "{moved}");
        assert!((moved.y / SIGMAS[1] + 1.0).abs() < 0.1, "{moved}");
        // 2² + 1² in units of the predicted variance.
        let variance = bias_corrected.covariance[(0, 0)] / line().covariance[(0, 0)];
        assert!((variance - 5.0).abs() < 0.3, "{variance}");
        assert_eq!(bias_corrected.covariance, variance_factor.scaled(line()).covariance);
        let tip_px = (bias_corrected.axis.tip - bias_corrected.axis.anchor).norm();
        assert!((tip_px - 30.0).abs() < 1e-9);
    }

    #[test]
    fn a_contour_is_not_moved_by_what_scatters() {
        let moved = line()
            .difference(&learned(150, |k| [sign(k), 2.0 * sign(k)]).bias_corrected(line()).axis);
        assert!(moved.x.abs() < 0.1 * SIGMAS[0] && moved.y.abs() < 0.1 * SIGMAS[1], "{moved}");
    }

    #[test]
    fn a_hand_that_rests_shows_one_difference_however_long() {
        let pixels = |at_px: f64| {
            let contour = line();
            let axis = Axis::of_finger(contour.axis.anchor + Vector2::new(at_px, 0.0), 0.33, 30.0);
            [contour.axis, axis].map(|axis| FingerLine {
                axis: Axis::of_finger(axis.anchor, axis.angle_rad, 30.0),
                ..contour
            })
        };
        let turned = |step_px: f64| {
            let mut variance_factor = VarianceFactor::default();
            for k in 0..30 {
                let [contour, other] = pixels(0.0);
                let aside = Vector2::new(step_px * f64::from(k), 0.0);
                let at = |line: FingerLine| FingerLine {
                    axis: Axis::of_finger(line.axis.anchor + aside, line.axis.angle_rad, 30.0),
                    ..line
                };
                variance_factor.learn(&at(contour), &at(other), 7.0);
            }
            line().difference(&variance_factor.bias_corrected(line()).axis).y
        };
        let [rests, moves] = [0.0, 20.0].map(turned);
        assert!(rests > 0.0 && rests < 0.1 * 0.03, "{rests}");
        assert!(moves > 0.7 * 0.03 && moves < 0.03, "{moves}");
    }
}
