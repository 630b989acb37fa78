//! The line that a finger points along, and how several looks at it are told together.

use crate::axis::{Refined, Stretch};
use crate::geometry::shape_space::Axis;
use nalgebra::{Matrix2, Vector2};
use std::f64::consts::TAU;

/// The image line that the finger points along.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FingerLine {
    /// The axis: the middle of what it was measured on, its tip and its direction.
    pub axis: Axis,
    /// Half the length of what it was measured on \[px\].
    pub half_length_px: f64,
    /// The stretch that it is told for, along the line from the anchor. It cuts a slightly bent finger
    /// where the line of least squares through a parabola over that stretch does: in front of its middle
    /// and behind it, by 1 / √3 of half its length.
    pub stretch: Stretch,
    /// Covariance of (offset \[px\] along the line's normal at the anchor, angle \[rad\]).
    pub covariance: Matrix2<f64>,
    /// What it was measured on.
    pub source: LineSource,
}

/// Correlation of the errors of two looks at one finger, contour and pixels: they share its edges. It
/// is 0.1–0.5 on footage of hands.
const COMMON: f64 = 0.5;
/// Two honest looks differ by more than this, in the square of the differences' covariance, in one
/// case of ten: χ² of offset and angle.
const CHI2_2DOF_90: f64 = 4.605;
/// And by more than this in one case of a hundred: then one of them is of something else.
pub(super) const CHI2_2DOF_99: f64 = 9.21;

impl FingerLine {
    /// The axis of a fitted template, which is told at its middle.
    pub(super) fn of_contour(axis: &Axis, covariance: &Matrix2<f64>) -> Self {
        let half_length_px = (axis.tip - axis.anchor).norm();
        let stretch = Stretch::about(0.0, half_length_px);
        let covariance = *covariance;
        Self { axis: *axis, half_length_px, stretch, covariance, source: LineSource::Contour }
    }

    /// Variance of the line over its stretch \[px²\].
    pub(super) fn spread(&self) -> f64 {
        self.covariance[(0, 0)] + self.half_length_px.powi(2) * self.covariance[(1, 1)]
    }

    /// How far another axis is from this one, in offset and angle.
    pub(super) fn difference(&self, other: &Axis) -> Vector2<f64> {
        let turn = other.angle_rad - self.axis.angle_rad;
        let turn = turn - (turn / TAU).round() * TAU;
        Vector2::new(self.axis.normal().dot(&(other.anchor - self.axis.anchor)), turn)
    }

    /// The same line, told so much farther along.
    fn expressed_along(self, by_px: f64) -> Self {
        let anchor = self.axis.anchor + self.axis.direction() * by_px;
        // Offset there: that here + by_px · angle.
        let there = Matrix2::new(1.0, by_px, 0.0, 1.0);
        let covariance = there * self.covariance * there.transpose();
        let stretch = self.stretch.beside(by_px);
        Self { axis: Axis { anchor, ..self.axis }, stretch, covariance, ..self }
    }

    /// The same line, told beside a point and towards a tip.
    pub(super) fn expressed_at(self, axis: &Axis) -> Self {
        let expressed =
            self.expressed_along((axis.anchor - self.axis.anchor).dot(&self.axis.direction()));
        Self { axis: Axis { tip: axis.tip, ..expressed.axis }, ..expressed }
    }

    /// The line that lies so much aside \[px\] and is turned by so much \[rad\].
    pub(super) fn moved(self, by: &Vector2<f64>) -> Self {
        let Axis { anchor, angle_rad, tip } = self.axis;
        let tip_px = (tip - anchor).dot(&self.axis.direction());
        let anchor = anchor + self.axis.normal() * by.x;
        Self { axis: Axis::of_finger(anchor, angle_rad + by.y, tip_px), ..self }
    }

    /// The same line, told beside the anchor of another.
    pub(super) fn expressed_beside(self, other: &Self) -> Self {
        self.expressed_along((other.axis.anchor - self.axis.anchor).dot(&self.axis.direction()))
    }

    /// The same line, when another look at the finger has its axis elsewhere: which of them is wrong
    /// is not known, and it may be wrong by as much as they differ.
    pub(super) fn with_disagreement(self, other: &Axis) -> Self {
        let difference = self.difference(other);
        Self { covariance: self.covariance + difference * difference.transpose(), ..self }
    }

    /// The same line, when what covers the finger in part may have led it astray by so much at either
    /// end: of what is no noise nothing averages out.
    pub(super) fn with_bias(self, by_px: f64) -> Self {
        self.with_relative_bias(by_px / self.half_length_px)
    }

    /// The same by a part of the half-length, which a bend may do.
    pub(super) fn with_relative_bias(self, part: f64) -> Self {
        let added = Vector2::new(part * self.half_length_px, part * 3.0_f64.sqrt());
        let added = Matrix2::from_diagonal(&added.map(|s| s * s));
        Self { covariance: self.covariance + added, ..self }
    }

    /// The same line, of a finger that looks so much wider and more tapered than it is known to be
    /// (px, 1), where these differences have such a covariance. Axis and width are the mean and the
    /// difference of the same two flanks: a flank that is wrong as a whole, which scatters nowhere,
    /// moves and turns the axis by as much as it changes the half-width and the taper. What they differ
    /// by chance is no doubt.
    pub(super) fn with_shape_mismatch(
        self,
        unlike: &Vector2<f64>,
        expected: &Matrix2<f64>,
    ) -> Self {
        let Some(weight) = expected.try_inverse() else { return self };
        let by_chance = CHI2_2DOF_90 / unlike.dot(&(weight * unlike));
        let added = unlike.map(|s| (1.0 - by_chance).max(0.0) * s * s);
        Self { covariance: self.covariance + Matrix2::from_diagonal(&added), ..self }
    }

    /// How far another look at the same finger is from this line, and the covariance of that: (1 − ρ)
    /// (C₁ + C₂), where ρ is the correlation of their errors.
    pub(super) fn difference_from(&self, other: &Self) -> (Vector2<f64>, Matrix2<f64>) {
        let other = other.expressed_beside(self);
        let expected = (1.0 - COMMON) * (self.covariance + other.covariance);
        (self.difference(&other.axis), expected)
    }

    /// Whether another look at the same finger differs by more than both may.
    pub(super) fn contradicts(&self, other: &Self) -> bool {
        let other = other.expressed_beside(self);
        let difference = self.difference(&other.axis);
        let weight = (self.covariance + other.covariance).try_inverse();
        weight.is_some_and(|weight| difference.dot(&(weight * difference)) > CHI2_2DOF_99)
    }

    /// This line and another look at the same finger, at the anchor of this one and as long: the mean
    /// by what each is worth, with the covariance (1 + ρ) (C₁⁻¹ + C₂⁻¹)⁻¹, where ρ is the correlation
    /// of their errors. Where they differ by more than they do by chance, both are worth less by as
    /// much.
    pub(super) fn joined(self, other: &Self) -> Self {
        let covariance = self.covariance;
        let other = other.expressed_beside(&self);
        let difference = self.difference(&other.axis);
        let Some(weight) = (covariance + other.covariance).try_inverse() else { return self };
        let gain = covariance * weight;
        let step = gain * difference;
        let contradiction = difference.dot(&(weight * difference)) / CHI2_2DOF_90;
        let covariance = (1.0 + COMMON) * contradiction.max(1.0) * gain * other.covariance;
        Self { covariance, source: LineSource::Both, ..self.moved(&step) }
    }

    /// A refined line, told at the middle of the stretch that it stands for.
    pub(super) fn of_pixels(refined: &Refined) -> Self {
        let Refined { axis, stretch, covariance, .. } = *refined;
        let half_length_px = 0.5 * stretch.length_px();
        let line = Self { axis, half_length_px, stretch, covariance, source: LineSource::Pixels };
        line.expressed_along(stretch.middle_px())
    }
}

/// What a finger line was measured on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LineSource {
    /// The contour: the axis of the fitted template.
    Contour,
    /// The pixels about both flanks ([`Source::Photometric`](crate::axis::Source::Photometric)).
    Pixels,
    /// Both, where the pixels are not believed alone ([`Source::Unsure`](crate::axis::Source::Unsure)).
    Both,
}

// The lines are private, and what they must agree with is arithmetic.
#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Point2;

    /// An axis, and one 2 px beside it that is turned by 0.1 rad across the angle's jump.
    fn axes() -> [Axis; 2] {
        let axis = Axis::of_finger(Point2::new(10.0, 20.0), 3.1, 30.0);
        let lateral = axis.anchor + axis.normal() * 2.0 + axis.direction() * 5.0;
        [axis, Axis::of_finger(lateral, 3.2, 30.0)]
    }

    #[test]
    fn a_contour_is_doubted_by_as_much_as_the_flanks_lie_elsewhere() {
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
    fn a_line_told_elsewhere_is_told_for_the_same_stretch() {
        let [axis, other] = axes();
        let line = FingerLine::of_contour(&axis, &Matrix2::identity());
        let at = |line: &FingerLine, px: f64| line.axis.anchor + line.axis.direction() * px;
        let there = line.expressed_along(7.0);
        for (expressed, before) in [
            (there.stretch.from_px, line.stretch.from_px),
            (there.stretch.to_px, line.stretch.to_px),
        ] {
            assert!(
                (at(&there, expressed) - at(&line, before)).norm() < 1e-12,
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
    fn looks_contradict_each_other_beyond_what_both_allow() {
        let [axis, other] = axes();
        let line = |axis: &Axis, sigma: f64| {
            FingerLine::of_contour(axis, &(Matrix2::new(4.0, 0.0, 0.0, 0.01) * (sigma * sigma)))
        };
        // 2 px and 0.1 rad apart: one standard deviation each of a look with `sigma` 1.
        assert!(!line(&axis, 1.0).contradicts(&line(&other, 1.0)));
        assert!(line(&axis, 0.2).contradicts(&line(&other, 0.2)));
        assert!(!line(&axis, 0.2).contradicts(&line(&other, 1.0)));
        assert!(!line(&axis, 0.2).contradicts(&line(&axis, 0.2)));
    }

    #[test]
    fn what_covers_a_finger_leads_astray_at_its_ends() {
        let [axis, _] = axes();
        let covariance = Matrix2::new(0.04, 1e-4, 1e-4, 1e-4);
        let line = FingerLine::of_contour(&axis, &covariance);
        let with_bias = line.with_bias(0.3);
        let added = Matrix2::new(0.09, 0.0, 0.0, 3.0 * (0.3 / 30.0_f64).powi(2));
        assert!((with_bias.covariance - covariance - added).norm() < 1e-12);
        assert_eq!(with_bias.axis, line.axis);
        assert_eq!(line.with_bias(0.0), line);
    }

    #[test]
    fn a_flank_that_is_wrong_as_a_whole_shows_in_the_width() {
        let [axis, _] = axes();
        let line = FingerLine::of_contour(&axis, &Matrix2::new(0.04, 1e-4, 1e-4, 1e-4));
        // Flanks lie at ±(w + τ p) about the axis. One of them is moved out by 0.8 px and turned by 0.06.
        let [right, left] = [[0.8, 0.06], [0.0, 0.0]];
        let axis_off = [0, 1].map(|k| 0.5 * (right[k] - left[k]));
        let unlike = Vector2::from([0, 1].map(|k| 0.5 * (right[k] + left[k])));
        let with_disagreement =
            line.with_shape_mismatch(&unlike, &(Matrix2::new(4.0, 0.0, 0.0, 0.02) * 1e-6));
        let added = with_disagreement.covariance - line.covariance;
        assert!((added.diagonal().map(f64::sqrt) - Vector2::from(axis_off)).norm() < 1e-3);
        assert_eq!(with_disagreement.axis, line.axis);
    }

    #[test]
    fn a_width_that_differs_by_chance_is_no_doubt() {
        let [axis, _] = axes();
        let line = FingerLine::of_contour(&axis, &Matrix2::new(0.04, 1e-4, 1e-4, 1e-4));
        let expected = Matrix2::new(0.04, 0.0, 0.0, 4e-4);
        let unlike = |sigmas: f64| Vector2::new(-0.2 * sigmas, 0.0);
        for sigmas in [0.0, 1.0, 2.1] {
            assert_eq!(line.with_shape_mismatch(&unlike(sigmas), &expected), line);
        }
        // From there on it grows steadily: 3² − 4.6 parts of the variance.
        let added = line.with_shape_mismatch(&unlike(3.0), &expected).covariance - line.covariance;
        assert!((added[(0, 0)] / 0.04 - (9.0 - CHI2_2DOF_90)).abs() < 1e-9, "{added}");
    }

    #[test]
    fn two_looks_are_compared_beside_the_first() {
        let [axis, other] = axes();
        let covariance = Matrix2::new(0.04, 1e-4, 1e-4, 1e-4);
        let (difference, variance) =
            pixels(&axis, covariance).difference_from(&pixels(&other, covariance));
        // The other's axis runs 2 px aside, 5 px further on.
        let expected = Vector2::new(2.0 - 5.0 * 0.1_f64.tan(), 0.1);
        assert!((difference - expected).norm() < 0.03, "{difference}");
        // Its offset is told 5 px back; half of the errors is in common.
        let back = Matrix2::new(1.0, -5.0 * 0.1_f64.cos(), 0.0, 1.0);
        let there = back * covariance * back.transpose();
        assert!((variance - 0.5 * (covariance + there)).norm() < 1e-4, "{variance}");
    }

    fn inverse(m: Matrix2<f64>) -> Matrix2<f64> {
        Matrix2::new(m.m22, -m.m12, -m.m21, m.m11) / m.determinant()
    }

    /// A line with the given covariance and the middle of what it was measured on.
    fn pixels(axis: &Axis, covariance: Matrix2<f64>) -> FingerLine {
        let stretch = Stretch::about(0.0, 20.0);
        let source = LineSource::Pixels;
        FingerLine { axis: *axis, half_length_px: 20.0, stretch, covariance, source }
    }

    #[test]
    fn two_looks_are_weighed_by_what_they_are_worth_wherever_their_anchors_are() {
        let axis = Axis::of_finger(Point2::new(10.0, 20.0), 3.1, 30.0);
        let other = Axis::of_finger(axis.anchor + axis.direction() * 8.0, 3.101, 22.0);
        let covariances =
            [Matrix2::new(0.04, 1e-4, 1e-4, 1e-4), Matrix2::new(0.01, -2e-4, -2e-4, 3e-4)];
        let joined = pixels(&axis, covariances[0]).joined(&pixels(&other, covariances[1]));

        // Generalised least squares of (offset, angle) at the first anchor, from the measurements: the
        // first's own are 0, the second's offset is told 8 px further on.
        let design = [Matrix2::identity(), Matrix2::new(1.0, 8.0, 0.0, 1.0)];
        let seen = [Vector2::zeros(), Vector2::new(0.0, 0.001)];
        let (mut information, mut right) = (Matrix2::zeros(), Vector2::zeros());
        for k in 0..2 {
            let weight = design[k].transpose() * inverse(covariances[k]);
            information += weight * design[k];
            right += weight * seen[k];
        }
        let covariance = inverse(information);
        let expressed = covariance * right;
        let beside = joined.axis.anchor - axis.anchor;
        assert!((axis.normal().dot(&beside) - expressed.x).abs() < 1e-6);
        assert!(axis.direction().dot(&beside).abs() < 1e-9);
        assert!((joined.axis.angle_rad - axis.angle_rad - expressed.y).abs() < 1e-9);
        assert!(((joined.axis.tip - joined.axis.anchor).norm() - 30.0).abs() < 1e-9);
        // They agree; half of their errors is in common.
        assert!((joined.covariance / 1.5 - covariance).norm() < 1e-6 * covariance.norm());
        assert_eq!(joined.source, LineSource::Both);
    }

    #[test]
    fn two_looks_that_contradict_each_other_are_worth_less() {
        let [axis, other] = axes();
        let covariance = Matrix2::new(0.04, 1e-4, 1e-4, 1e-4);
        let agreed = pixels(&axis, covariance).joined(&pixels(&axis, covariance));
        assert!((agreed.axis.angle_rad - axis.angle_rad).abs() < 1e-12);
        let torn = pixels(&axis, covariance).joined(&pixels(&other, covariance));
        // Across the jump of the angle, in the middle of both.
        let turn = (torn.axis.angle_rad - 3.15).sin();
        assert!(turn.abs() < 1e-2, "{turn}");
        let spread = (torn.covariance - agreed.covariance).symmetric_eigenvalues();
        assert!(spread.iter().all(|s| *s > 0.0), "{spread}");
        // 0.1 rad apart: neither end is far outside.
        assert!(torn.covariance[(1, 1)].sqrt() > 0.02, "{}", torn.covariance);
    }
}
