//! Comparison of the pixels' and the contour's line of a hand: the variance factor of both, and the
//! bias of the contours' lines.
//!
//! Where the squared difference of the two lines exceeds the predicted variance on average, as in
//! grey and compressed images and before patterned cloth, all covariances are scaled by the ratio
//! ([`VarianceFactor`]).
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
use super::running_mean::RunningMean;
use super::variance_factor::{MIN_COMPARISON_RATE, PRIOR_COMPARISONS, VarianceFactor};
use crate::numeric::ablation::{Mechanism, is_off};
use nalgebra::{Matrix2, Point2, Vector2};

/// 99 % quantile of χ² with 1 degree of freedom: a difference is limited to it, in units of the
/// estimated variance.
const CHI2_1DOF_99: f64 = 6.635;

/// Statistics of the difference between the pixels' and the contour's line of a hand, in offset and
/// in angle.
#[derive(Debug, Clone, Copy)]
pub(super) struct LineComparison {
    /// Mean difference of the pixels' line from the contour's (px, rad), with a prior of 0.
    bias: [RunningMean; 2],
    /// Mean square of it, in units of the predicted variances.
    variance_factors: [VarianceFactor; 2],
    /// Position of the contour at the last comparison.
    place: Option<Point2<f64>>,
}

impl Default for LineComparison {
    fn default() -> Self {
        Self {
            bias: [RunningMean { value: 0.0, count: PRIOR_COMPARISONS }; 2],
            variance_factors: [VarianceFactor::default(); 2],
            place: None,
        }
    }
}

impl LineComparison {
    /// Learns from the difference of the pixels' line from the contour's; `half_width_px` is the
    /// finger's.
    pub fn learn(&mut self, contour: &FingerLine, pixels: &FingerLine, half_width_px: f64) {
        let place = contour.axis.anchor;
        let travel = self.place.map_or(0.0, |last| (place - last).norm() / half_width_px);
        self.place = Some(place);
        let (difference, expected) = contour.difference_from(pixels);
        self.count(&difference, &expected, 1.0 - correlation(travel));
    }

    /// Learns from a difference with its covariance and its new part, 0–1.
    fn count(&mut self, difference: &Vector2<f64>, expected: &Matrix2<f64>, freshness: f64) {
        let components = self.bias.iter_mut().zip(&mut self.variance_factors).enumerate();
        for (k, (bias, variance_factor)) in components {
            let sigma = expected[(k, k)].sqrt();
            let limit = sigma * (CHI2_1DOF_99 * variance_factor.inflation()).sqrt();
            let difference = difference[k].clamp(-limit, limit);
            bias.learn(difference, freshness, MIN_COMPARISON_RATE);
            variance_factor.learn((difference / sigma).powi(2), freshness);
        }
    }

    /// The line of a contour, corrected by the mean difference of the pixels' lines, with its
    /// covariance scaled.
    pub fn bias_corrected(&self, contour: FingerLine) -> FingerLine {
        if is_off(Mechanism::VarianceFactor) {
            return contour;
        }
        self.scaled(contour.moved(&Vector2::from(self.bias.map(|bias| bias.value))))
    }

    /// A line with its covariance scaled by the variance factor of offset and angle.
    pub fn scaled(&self, line: FingerLine) -> FingerLine {
        if is_off(Mechanism::VarianceFactor) {
            return line;
        }
        let sigmas = Vector2::from(self.variance_factors.map(|factor| factor.inflation().sqrt()));
        let scaled = line.covariance.component_mul(&(sigmas * sigmas.transpose()));
        FingerLine { covariance: scaled, ..line }
    }
}

// The tracker measures the differences that are learned; here they are given.
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
    fn learned(count: usize, difference: impl Fn(usize) -> [f64; 2]) -> LineComparison {
        let sigmas = Vector2::from(SIGMAS);
        let expected = Matrix2::from_diagonal(&sigmas.component_mul(&sigmas));
        let mut comparison = LineComparison::default();
        for k in 0..count {
            comparison.count(&Vector2::from(difference(k)).component_mul(&sigmas), &expected, 1.0);
        }
        comparison
    }

    fn sign(k: usize) -> f64 {
        if k.is_multiple_of(2) { 1.0 } else { -1.0 }
    }

    #[test]
    fn lines_that_differ_as_predicted_or_less_keep_their_variances() {
        for part in [1.0, 0.3, 0.0] {
            let comparison = learned(50, |k| [part * sign(k), part]);
            assert!((comparison.scaled(line()).covariance - line().covariance).norm() < 1e-12);
        }
    }

    #[test]
    fn each_component_is_scaled_by_its_own_excess() {
        let scaled = learned(150, |k| [sign(k), 3.0 * sign(k)]).scaled(line());
        let expected = Matrix2::new(0.04, 3e-4, 3e-4, 9e-4);
        let relative_error = (scaled.covariance - expected).component_div(&expected);
        assert!(relative_error.amax() < 0.02, "{}", scaled.covariance);
        assert_eq!(scaled.axis, line().axis);
    }

    #[test]
    fn one_outlier_changes_variance_and_bias_little() {
        let comparison = learned(20, |k| if k == 10 { [0.0, 1e3] } else { [sign(k), sign(k)] });
        let variance_ratio =
            comparison.scaled(line()).covariance[(1, 1)] / line().covariance[(1, 1)];
        assert!(1.05 < variance_ratio && variance_ratio < 1.5, "{variance_ratio}");
        let moved = line().difference(&comparison.bias_corrected(line()).axis);
        assert!(moved.y.abs() < 0.3 * SIGMAS[1], "{moved}");
    }

    #[test]
    fn the_mean_difference_corrects_the_contour_and_stays_in_its_covariance() {
        let comparison = learned(150, |k| [2.0 + sign(k), -1.0]);
        let bias_corrected = comparison.bias_corrected(line());
        let moved = line().difference(&bias_corrected.axis);
        assert!((moved.x / SIGMAS[0] - 2.0).abs() < 0.1, "{moved}");
        assert!((moved.y / SIGMAS[1] + 1.0).abs() < 0.1, "{moved}");
        // 2² + 1² in units of the predicted variance.
        let variance_ratio = bias_corrected.covariance[(0, 0)] / line().covariance[(0, 0)];
        assert!((variance_ratio - 5.0).abs() < 0.3, "{variance_ratio}");
        assert_eq!(bias_corrected.covariance, comparison.scaled(line()).covariance);
        let tip_px = (bias_corrected.axis.tip - bias_corrected.axis.anchor).norm();
        assert!((tip_px - 30.0).abs() < 1e-9);
    }

    #[test]
    fn differences_of_zero_mean_do_not_move_the_contour() {
        let moved = line()
            .difference(&learned(150, |k| [sign(k), 2.0 * sign(k)]).bias_corrected(line()).axis);
        assert!(moved.x.abs() < 0.1 * SIGMAS[0] && moved.y.abs() < 0.1 * SIGMAS[1], "{moved}");
    }

    #[test]
    fn all_frames_of_a_resting_hand_count_as_one_comparison() {
        let lines = |at_px: f64| {
            let contour = line();
            let axis = Axis::of_finger(contour.axis.anchor + Vector2::new(at_px, 0.0), 0.33, 30.0);
            [contour.axis, axis].map(|axis| FingerLine {
                axis: Axis::of_finger(axis.anchor, axis.angle_rad, 30.0),
                ..contour
            })
        };
        let angle_bias = |step_px: f64| {
            let mut comparison = LineComparison::default();
            for k in 0..30 {
                let [contour, other] = lines(0.0);
                let displacement = Vector2::new(step_px * f64::from(k), 0.0);
                let at = |line: FingerLine| FingerLine {
                    axis: Axis::of_finger(
                        line.axis.anchor + displacement,
                        line.axis.angle_rad,
                        30.0,
                    ),
                    ..line
                };
                comparison.learn(&at(contour), &at(other), 7.0);
            }
            line().difference(&comparison.bias_corrected(line()).axis).y
        };
        let [resting, moving] = [0.0, 20.0].map(angle_bias);
        assert!(resting > 0.0 && resting < 0.1 * 0.03, "{resting}");
        assert!(moving > 0.7 * 0.03 && moving < 0.03, "{moving}");
    }
}
