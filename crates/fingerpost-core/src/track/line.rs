//! The image line along which a finger points, with its covariance, and the combination of several
//! estimates of it.

use crate::axis::Refined;
use crate::axis::Stretch;
use crate::geometry::shape_space::Axis;
use nalgebra::{Matrix2, Vector2};
use std::f64::consts::TAU;

/// The image line that the finger points along.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FingerLine {
    /// The axis: its anchor is the midpoint of the segment it was measured on.
    pub axis: Axis,
    /// Half the length of the segment it was measured on \[px\].
    pub half_length_px: f64,
    /// The segment the line is reported for, along the line from the anchor. A slightly bent finger
    /// is approximated by a parabola; the line cuts it where the least-squares line through the
    /// parabola over this segment does: at the segment's middle ± 1 / √3 of half its length.
    pub stretch: Stretch,
    /// Covariance of (offset \[px\] along the line's normal at the anchor, angle \[rad\]).
    pub covariance: Matrix2<f64>,
    /// The measurements it was estimated from.
    pub source: LineSource,
}

/// ρ, correlation of the errors of the contour's and the pixels' estimate of one line, which share
/// the finger's edges. Measured on footage of hands: 0.1–0.5.
const COMMON: f64 = 0.5;
/// 90 % quantile of χ² with 2 degrees of freedom (offset and angle): two consistent estimates have
/// a squared Mahalanobis distance above this in one case of ten.
const CHI2_2DOF_90: f64 = 4.605;
/// 99 % quantile of the same: beyond it, one of the two estimates is taken to be of another object.
pub(super) const CHI2_2DOF_99: f64 = 9.21;

impl FingerLine {
    /// The axis of a fitted template, expressed at its anchor.
    pub(super) fn of_contour(axis: &Axis, covariance: &Matrix2<f64>) -> Self {
        let half_length_px = (axis.tip - axis.anchor).norm();
        let stretch = Stretch::about(0.0, half_length_px);
        let covariance = *covariance;
        Self { axis: *axis, half_length_px, stretch, covariance, source: LineSource::Contour }
    }

    /// Variance of the line at the end of the segment it was measured on, σ_offset² + h² σ_angle²,
    /// h the half-length \[px²\].
    pub(super) fn spread(&self) -> f64 {
        self.covariance[(0, 0)] + self.half_length_px.powi(2) * self.covariance[(1, 1)]
    }

    /// (offset \[px\], angle \[rad\]) of another axis relative to this one; the angle is wrapped to
    /// ±π.
    pub(super) fn difference(&self, other: &Axis) -> Vector2<f64> {
        let turn = other.angle_rad - self.axis.angle_rad;
        let turn = turn - (turn / TAU).round() * TAU;
        Vector2::new(self.axis.normal().dot(&(other.anchor - self.axis.anchor)), turn)
    }

    /// The same line, with its anchor moved by `by_px` along it.
    fn expressed_along(self, by_px: f64) -> Self {
        let anchor = self.axis.anchor + self.axis.direction() * by_px;
        // Offset at the new anchor: offset + by_px · angle.
        let to_anchor = Matrix2::new(1.0, by_px, 0.0, 1.0);
        let covariance = to_anchor * self.covariance * to_anchor.transpose();
        let stretch = self.stretch.beside(by_px);
        Self { axis: Axis { anchor, ..self.axis }, stretch, covariance, ..self }
    }

    /// The same line, with its anchor at the foot of the perpendicular from another axis' anchor,
    /// and with that axis' tip.
    pub(super) fn expressed_at(self, axis: &Axis) -> Self {
        let expressed =
            self.expressed_along((axis.anchor - self.axis.anchor).dot(&self.axis.direction()));
        Self { axis: Axis { tip: axis.tip, ..expressed.axis }, ..expressed }
    }

    /// The line shifted by `by.x` along its normal \[px\] and turned by `by.y` \[rad\].
    pub(super) fn moved(self, by: &Vector2<f64>) -> Self {
        let Axis { anchor, angle_rad, tip } = self.axis;
        let tip_px = (tip - anchor).dot(&self.axis.direction());
        let anchor = anchor + self.axis.normal() * by.x;
        Self { axis: Axis::of_finger(anchor, angle_rad + by.y, tip_px), ..self }
    }

    /// The same line, with its anchor at the foot of the perpendicular from the anchor of another.
    pub(super) fn expressed_beside(self, other: &Self) -> Self {
        self.expressed_along((other.axis.anchor - self.axis.anchor).dot(&self.axis.direction()))
    }

    /// The same line, when another estimate has its axis elsewhere. Which of the two is wrong is
    /// unknown, so the difference d is added to the covariance as d dᵀ.
    pub(super) fn with_disagreement(self, other: &Axis) -> Self {
        let difference = self.difference(other);
        Self { covariance: self.covariance + difference * difference.transpose(), ..self }
    }

    /// The same line with an unknown bias in proportion to the half-length h, as by a bend: adds
    /// (part · h)² to the variance of the offset and 3 part² to that of the angle. Offset and angle
    /// then contribute equally to the mean square of the bias over ± h; its standard deviation is
    /// part · h at the anchor and 2 part · h at either end. A bias is systematic: averaging over
    /// frames does not reduce it.
    pub(super) fn with_relative_bias(self, part: f64) -> Self {
        let added = Vector2::new(part * self.half_length_px, part * 3.0_f64.sqrt());
        let added = Matrix2::from_diagonal(&added.map(|s| s * s));
        Self { covariance: self.covariance + added, ..self }
    }

    /// The same line, with a covariance that allows for a mismatch of the measured shape:
    /// `mismatch` is (half-width \[px\], taper \[1\]) measured minus known, `expected` its
    /// covariance. Axis and width are mean and half-difference of the same two flanks. A flank
    /// displaced as a whole leaves no scatter of residuals; it moves and turns the axis by as much
    /// as it changes half-width and taper. Differences within the 90 % quantile of χ² add nothing.
    pub(super) fn with_shape_mismatch(
        self,
        mismatch: &Vector2<f64>,
        expected: &Matrix2<f64>,
    ) -> Self {
        let Some(weight) = expected.try_inverse() else { return self };
        let quantile_ratio = CHI2_2DOF_90 / mismatch.dot(&(weight * mismatch));
        let added = mismatch.map(|s| (1.0 - quantile_ratio).max(0.0) * s * s);
        Self { covariance: self.covariance + Matrix2::from_diagonal(&added), ..self }
    }

    /// Difference of another estimate from this line, and its covariance (1 − ρ) (C₁ + C₂), where ρ
    /// is the correlation of their errors.
    pub(super) fn difference_from(&self, other: &Self) -> (Vector2<f64>, Matrix2<f64>) {
        let other = other.expressed_beside(self);
        let expected = (1.0 - COMMON) * (self.covariance + other.covariance);
        (self.difference(&other.axis), expected)
    }

    /// Whether another estimate differs from this one by more than the 99 % quantile that their
    /// covariances allow.
    pub(super) fn contradicts(&self, other: &Self) -> bool {
        let other = other.expressed_beside(self);
        let difference = self.difference(&other.axis);
        let weight = (self.covariance + other.covariance).try_inverse();
        weight.is_some_and(|weight| difference.dot(&(weight * difference)) > CHI2_2DOF_99)
    }

    /// This line combined with another estimate of the same finger, at the anchor and over the
    /// segment of this one: the mean weighted by C₁⁻¹ and C₂⁻¹, with the covariance
    /// (1 + ρ) (C₁⁻¹ + C₂⁻¹)⁻¹, where ρ is the correlation of their errors. If χ² of the difference
    /// exceeds its 90 % quantile, the covariance is scaled by the ratio.
    pub(super) fn joined(self, other: &Self) -> Self {
        let covariance = self.covariance;
        let other = other.expressed_beside(&self);
        let difference = self.difference(&other.axis);
        let Some(weight) = (covariance + other.covariance).try_inverse() else { return self };
        let gain = covariance * weight;
        let step = gain * difference;
        let excess = difference.dot(&(weight * difference)) / CHI2_2DOF_90;
        let covariance = (1.0 + COMMON) * excess.max(1.0) * gain * other.covariance;
        Self { covariance, source: LineSource::Both, ..self.moved(&step) }
    }

    /// A refined line, expressed at the middle of the segment it is reported for.
    pub(super) fn of_pixels(refined: &Refined) -> Self {
        let Refined { axis, stretch, covariance, .. } = *refined;
        let half_length_px = 0.5 * stretch.length_px();
        let line = Self { axis, half_length_px, stretch, covariance, source: LineSource::Pixels };
        line.expressed_along(stretch.middle_px())
    }
}

/// The measurements a finger line was estimated from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LineSource {
    /// The contour: the axis of the fitted template.
    Contour,
    /// The pixels about both flanks, which agree with the model of a finger.
    Pixels,
    /// Both, where the pixels alone are not trusted.
    Both,
}

// The combination of lines is private; the expected values are arithmetic.
#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Point2;

    /// An axis, and one 2 px beside it that is turned by 0.1 rad across the wrap of the angle.
    fn axes() -> [Axis; 2] {
        let axis = Axis::of_finger(Point2::new(10.0, 20.0), 3.1, 30.0);
        let lateral = axis.anchor + axis.normal() * 2.0 + axis.direction() * 5.0;
        [axis, Axis::of_finger(lateral, 3.2, 30.0)]
    }

    #[test]
    fn the_disagreement_of_the_flanks_is_added_to_the_covariance() {
        let [axis, other] = axes();
        let covariance = Matrix2::new(0.04, 1e-4, 1e-4, 1e-4);
        let line = FingerLine::of_contour(&axis, &covariance);
        assert!((line.half_length_px - 30.0).abs() < 1e-12);
        let with_disagreement = line.with_disagreement(&other);
        let expected = covariance + Matrix2::new(4.0, 0.2, 0.2, 0.01);
        assert!(
            (with_disagreement.covariance - expected).norm() < 1e-9,
            "{}",
            with_disagreement.covariance
        );
        assert_eq!(with_disagreement.axis, line.axis);
        assert_eq!(line.with_disagreement(&axis), line);
    }

    #[test]
    fn a_line_expressed_elsewhere_keeps_its_segment() {
        let [axis, other] = axes();
        let line = FingerLine::of_contour(&axis, &Matrix2::identity());
        let at = |line: &FingerLine, px: f64| line.axis.anchor + line.axis.direction() * px;
        let moved = line.expressed_along(7.0);
        for (expressed, before) in [
            (moved.stretch.from_px, line.stretch.from_px),
            (moved.stretch.to_px, line.stretch.to_px),
        ] {
            assert!(
                (at(&moved, expressed) - at(&line, before)).norm() < 1e-12,
                "{expressed} {before}"
            );
        }
        assert!((line.stretch.length_px() - 60.0).abs() < 1e-12);
        assert_eq!(
            line.joined(&FingerLine::of_contour(&other, &Matrix2::identity())).stretch,
            line.stretch
        );
    }

    #[test]
    fn estimates_contradict_each_other_beyond_their_variances() {
        let [axis, other] = axes();
        let line = |axis: &Axis, sigma: f64| {
            FingerLine::of_contour(axis, &(Matrix2::new(4.0, 0.0, 0.0, 0.01) * (sigma * sigma)))
        };
        // 2 px and 0.1 rad apart: one standard deviation each for an estimate with `sigma` 1.
        assert!(!line(&axis, 1.0).contradicts(&line(&other, 1.0)));
        assert!(line(&axis, 0.2).contradicts(&line(&other, 0.2)));
        assert!(!line(&axis, 0.2).contradicts(&line(&other, 1.0)));
        assert!(!line(&axis, 0.2).contradicts(&line(&axis, 0.2)));
    }

    #[test]
    fn a_relative_bias_adds_variance_to_offset_and_angle() {
        let [axis, _] = axes();
        let covariance = Matrix2::new(0.04, 1e-4, 1e-4, 1e-4);
        let line = FingerLine::of_contour(&axis, &covariance);
        let with_bias = line.with_relative_bias(0.3 / line.half_length_px);
        let added = Matrix2::new(0.09, 0.0, 0.0, 3.0 * (0.3 / 30.0_f64).powi(2));
        assert!((with_bias.covariance - covariance - added).norm() < 1e-12);
        assert_eq!(with_bias.axis, line.axis);
        assert_eq!(line.with_relative_bias(0.0), line);
    }

    #[test]
    fn a_displaced_flank_adds_its_shift_of_the_axis_to_the_covariance() {
        let [axis, _] = axes();
        let line = FingerLine::of_contour(&axis, &Matrix2::new(0.04, 1e-4, 1e-4, 1e-4));
        // Flanks lie at ±(w + τ p) about the axis. One of them is displaced by 0.8 px and 0.06 rad.
        let [right, left] = [[0.8, 0.06], [0.0, 0.0]];
        let axis_error = [0, 1].map(|k| 0.5 * (right[k] - left[k]));
        let mismatch = Vector2::from([0, 1].map(|k| 0.5 * (right[k] + left[k])));
        let with_mismatch =
            line.with_shape_mismatch(&mismatch, &(Matrix2::new(4.0, 0.0, 0.0, 0.02) * 1e-6));
        let added = with_mismatch.covariance - line.covariance;
        assert!((added.diagonal().map(f64::sqrt) - Vector2::from(axis_error)).norm() < 1e-3);
        assert_eq!(with_mismatch.axis, line.axis);
    }

    #[test]
    fn a_width_difference_within_the_quantile_adds_no_variance() {
        let [axis, _] = axes();
        let line = FingerLine::of_contour(&axis, &Matrix2::new(0.04, 1e-4, 1e-4, 1e-4));
        let expected = Matrix2::new(0.04, 0.0, 0.0, 4e-4);
        let mismatch = |sigmas: f64| Vector2::new(-0.2 * sigmas, 0.0);
        for sigmas in [0.0, 1.0, 2.1] {
            assert_eq!(line.with_shape_mismatch(&mismatch(sigmas), &expected), line);
        }
        // Beyond the quantile the added variance grows linearly: 3² − 4.6 times the variance.
        let added =
            line.with_shape_mismatch(&mismatch(3.0), &expected).covariance - line.covariance;
        assert!((added[(0, 0)] / 0.04 - (9.0 - CHI2_2DOF_90)).abs() < 1e-9, "{added}");
    }

    #[test]
    fn two_estimates_are_compared_at_the_first_anchor() {
        let [axis, other] = axes();
        let covariance = Matrix2::new(0.04, 1e-4, 1e-4, 1e-4);
        let (difference, variance) =
            pixels(&axis, covariance).difference_from(&pixels(&other, covariance));
        // The other axis is offset by 2 px, 5 px further on.
        let expected = Vector2::new(2.0 - 5.0 * 0.1_f64.tan(), 0.1);
        assert!((difference - expected).norm() < 0.03, "{difference}");
        // Its offset is expressed 5 px back; half of the errors is common.
        let to_anchor = Matrix2::new(1.0, -5.0 * 0.1_f64.cos(), 0.0, 1.0);
        let expressed = to_anchor * covariance * to_anchor.transpose();
        assert!((variance - 0.5 * (covariance + expressed)).norm() < 1e-4, "{variance}");
    }

    fn inverse(m: Matrix2<f64>) -> Matrix2<f64> {
        Matrix2::new(m.m22, -m.m12, -m.m21, m.m11) / m.determinant()
    }

    /// A line with the given covariance and the middle of the segment it was measured on.
    fn pixels(axis: &Axis, covariance: Matrix2<f64>) -> FingerLine {
        let stretch = Stretch::about(0.0, 20.0);
        let source = LineSource::Pixels;
        FingerLine { axis: *axis, half_length_px: 20.0, stretch, covariance, source }
    }

    #[test]
    fn two_estimates_are_weighted_by_information_wherever_their_anchors_are() {
        let axis = Axis::of_finger(Point2::new(10.0, 20.0), 3.1, 30.0);
        let other = Axis::of_finger(axis.anchor + axis.direction() * 8.0, 3.101, 22.0);
        let covariances =
            [Matrix2::new(0.04, 1e-4, 1e-4, 1e-4), Matrix2::new(0.01, -2e-4, -2e-4, 3e-4)];
        let joined = pixels(&axis, covariances[0]).joined(&pixels(&other, covariances[1]));

        // Generalised least squares of (offset, angle) at the first anchor: the first line measures
        // 0, the second an offset 8 px further on.
        let design = [Matrix2::identity(), Matrix2::new(1.0, 8.0, 0.0, 1.0)];
        let observed = [Vector2::zeros(), Vector2::new(0.0, 0.001)];
        let (mut information, mut right) = (Matrix2::zeros(), Vector2::zeros());
        for k in 0..2 {
            let weight = design[k].transpose() * inverse(covariances[k]);
            information += weight * design[k];
            right += weight * observed[k];
        }
        let covariance = inverse(information);
        let estimate = covariance * right;
        let displacement = joined.axis.anchor - axis.anchor;
        assert!((axis.normal().dot(&displacement) - estimate.x).abs() < 1e-6);
        assert!(axis.direction().dot(&displacement).abs() < 1e-9);
        assert!((joined.axis.angle_rad - axis.angle_rad - estimate.y).abs() < 1e-9);
        assert!(((joined.axis.tip - joined.axis.anchor).norm() - 30.0).abs() < 1e-9);
        // They agree; half of their errors is common.
        assert!((joined.covariance / 1.5 - covariance).norm() < 1e-6 * covariance.norm());
        assert_eq!(joined.source, LineSource::Both);
    }

    #[test]
    fn two_contradicting_estimates_have_a_larger_variance() {
        let [axis, other] = axes();
        let covariance = Matrix2::new(0.04, 1e-4, 1e-4, 1e-4);
        let agreeing = pixels(&axis, covariance).joined(&pixels(&axis, covariance));
        assert!((agreeing.axis.angle_rad - axis.angle_rad).abs() < 1e-12);
        let contradicting = pixels(&axis, covariance).joined(&pixels(&other, covariance));
        // Midway between both, across the wrap of the angle.
        let angle_error = (contradicting.axis.angle_rad - 3.15).sin();
        assert!(angle_error.abs() < 1e-2, "{angle_error}");
        let spread = (contradicting.covariance - agreeing.covariance).symmetric_eigenvalues();
        assert!(spread.iter().all(|s| *s > 0.0), "{spread}");
        // 0.1 rad apart: neither end is far outside.
        assert!(contradicting.covariance[(1, 1)].sqrt() > 0.02, "{}", contradicting.covariance);
    }
}
