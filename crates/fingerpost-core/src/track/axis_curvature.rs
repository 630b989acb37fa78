//! Curvature of the finger's axis: the segment a finger line is reported for, and the bias that the
//! curvature leaves.
//!
//! The finger line is the least-squares line through the finger's medial line. A cylinder has the
//! same line for every segment of its flanks and under every light. A real finger is bent by a
//! fraction of a pixel, and its line turns with the segment that is measured. For a medial line
//! y = κ x² / 2, the least-squares line over c ± h has the slope κ c and, at c, the offset
//! κ (c² + h² / 3) / 2; shifting the segment of a hand's line by 3 px turns it by a quarter of a
//! degree. The visible part of the flanks varies from frame to frame, and an initial template is
//! not as long as a detected one.
//!
//! Therefore all lines of a hand are reported for one segment, the distal one that points
//! ([`FRONT_SEGMENT`]). They are measured on the whole finger, because the angle of a short segment
//! is imprecise, and extrapolated to the front by the curvature measured from the pixels
//! ([`PhotometricReport::bend_px`]), weighted by the part of it that is reliable
//! ([`HALF_RELIABLE_CONTRAST_RATIO`]); at weight 0 the line stays that of the whole finger
//! ([`WHOLE_FINGER_SEGMENT`]). A finger is not a parabola at its knuckle: if its bend turns the
//! line by more than the noise does, the pixels of the front are measured alone, and the difference
//! of their line from that of the whole ([`FrontLine`]) replaces most of the curvature's
//! correction.
//!
//! The far end of the front is given in half-widths, because a view does not foreshorten the width,
//! times the foreshortening of the length. Each line carries the segment it is finally reported for
//! ([`FingerLine::stretch`]), because lens distortion also bends the image of a straight finger:
//! undistorted, it is straight where the line cuts it.
//!
//! The remaining bias is not reduced by averaging frames: joints, nail and shading turn and shift
//! the medial line as the bend does. Its size is derived from the bend and added to the covariance
//! of each line; the part of it that the filter over frames averages away is restored. The bias
//! that shade and background cause on a flank of low contrast is added likewise, whether or not the
//! line is bent ([`FAINT`]).
//!
//! [`PhotometricReport::bend_px`]: crate::axis::PhotometricReport::bend_px

use super::line::FingerLine;
use super::running_mean::RunningMean;
use crate::axis::Stretch;
use crate::axis::{PhotometricReport, Refined, Source};
use crate::geometry::shape_space::Axis;
use crate::numeric::ablation::{Mechanism, is_off};
use nalgebra::{Matrix2, Vector2};

/// A segment that lines may be reported for.
struct AxisSegment {
    /// Distance behind the tip at which it begins, and at which it ends for a finger seen from its
    /// side \[half-widths\]. If the hand's flanks usually end nearer to the tip, it ends there.
    near_half_widths: f64,
    far_half_widths: f64,
    /// Upper limit of the shift of the measured segment's middle, as a part of the measured
    /// half-length: beyond it the parabola is not extrapolated.
    max_shift_part: f64,
}

impl AxisSegment {
    /// Distance of its end behind the tip in this view \[px\].
    fn far_px(&self, scale: &FingerScale) -> f64 {
        self.far_half_widths * scale.foreshortening * scale.half_width_px
    }
}

/// The pointing segment. Index fingers are 9 to 10 half-widths long; it covers 92 to 40 % of the
/// way from knuckle to tip. On 27 films of rendered hands, a line over 10 to 97 % is turned against
/// that one by 0.5 to 0.9° in one view and by 0 to 0.5° in the other; a parabola predicts the turn
/// to within 0.1°. A view along the finger foreshortens its length, down to 0.8 on 14 other films,
/// but not its width: with fronts of a fixed length in half-widths their lines were turned by 0.15
/// to 0.3° more. In views from the side, the knuckles of 16 hands lie 9.0 to 9.5 half-widths behind
/// their tips: 60 % of that is 5.4 to 5.7.
const FRONT_SEGMENT: AxisSegment =
    AxisSegment { near_half_widths: 0.76, far_half_widths: 5.6, max_shift_part: 0.4 };
/// The whole finger except its round end.
const WHOLE_FINGER_SEGMENT: AxisSegment =
    AxisSegment { near_half_widths: 0.3, far_half_widths: 8.8, max_shift_part: 0.15 };
/// Contrast-to-scatter ratio of the fainter flank at which half of the measured bend is reliable.
/// On a flank of low contrast, shading displaces the edge; it bends the medial line as a joint
/// does, and averaging frames does not reduce it. The part of the bend by which the line is moved
/// from the whole to the front is 1 / (1 + (this / ratio)⁴): nearly 1 at twice this ratio, hardly
/// more than 0 at half of it. Without colours a shade resembles an edge, and the part is 0.
const HALF_RELIABLE_CONTRAST_RATIO: f64 = 14.0;
/// Error of the parabola's turn of the line, as a multiple of that turn. A parabola models a finger
/// with a knuckle at its end badly: on two rendered hands, half and a fifth of the true bend were
/// measured. If this error exceeds the noise of the front segment alone, the front is measured
/// separately, provided that the turn exceeds [`LEAST_TURN_RAD`] \[rad\] and the reliable part of
/// the bend exceeds [`MIN_RELIABLE_PART`].
const OFF_BY: f64 = 2.0;
const LEAST_TURN_RAD: f64 = 0.0035;
const MIN_RELIABLE_PART: f64 = 0.4;
/// Standard deviation of the bias of a line at its anchor, as a part of the bend; at either end it
/// is twice as large ([`FingerLine::with_relative_bias`]). As an angle, √3 times this over the
/// half-length, it is the spread of lines through segments whose middles scatter by 0.18
/// half-lengths. On 38 films of rendered hands the 95 % ellipses then hold 91 % of the points by
/// the exact medial lines; 87 % if the filter over frames may average the bias away.
const BEND_BIAS: f64 = 0.32;
/// Standard deviation of the bias of a line at its anchor due to a flank of low contrast, as a part
/// of the half-length; at either end it is twice as large. Background and shade displace such an
/// edge along its whole length, so the line is biased without appearing bent. On 38 films of
/// rendered hands, lines were turned by 0.7 to 0.8° more than noise and bend allow where the
/// contrast of the fainter flank is less than [`FAINT`] times the scatter of its pixels beyond the
/// image's noise, and by no more where it is greater. The bias is weighted by 1 − 1 / (1 + (`FAINT` /
/// ratio)⁸): half at that ratio, 4 % at 1.5 times it, all but 4 % at two thirds of it. Image noise
/// turns lines as well, but is part of their covariance. The 95 % ellipses then hold 96 % of the
/// points of hands whose initial pose was given and 95 % of those that were detected; 93 and 87 %
/// without.
const FAINT_FLANK_BIAS: f64 = 0.007;
const FAINT: f64 = 23.0;
/// Upper confidence factor of the noise variance, which is estimated from the few pixels of a
/// finger. With a factor of 1, half of the lines of clean cylinders of 24 grey levels under noise
/// of 4 were counted as faint.
const NOISE_AT_MOST: f64 = 1.2;
/// Variance due to rounding to whole grey levels, the lower limit of the variance of texture
/// \[grey²\].
const ROUNDING_GREY2: f64 = 1.0 / 12.0;
/// Lower limit of the learning rate of the bend: a finger's bend is constant, and one frame
/// measures it with an error of half its size. The second is that of its size in the image, which
/// changes as it moves.
const BEND_RATE: f64 = 0.03;
const SIZE_RATE: f64 = 0.1;

/// Scale of a finger in one frame of a view.
pub(super) struct FingerScale {
    pub half_width_px: f64,
    /// See [`ContourTracker::foreshortening`](super::ContourTracker::foreshortening).
    pub foreshortening: f64,
}

/// Difference of the line of the finger's front from that of the whole in one frame, each measured
/// from its own pixels.
pub(super) struct FrontLine {
    /// Offset \[px\] at the anchor of the whole's line, and angle \[rad\].
    difference: Vector2<f64>,
    /// The covariance it adds to a moved line: that of the front, counted as independent.
    covariance: Matrix2<f64>,
    cuts: Cuts,
}

impl FrontLine {
    /// From both lines.
    pub fn beside(front: &FingerLine, whole: &FingerLine) -> Self {
        let front = front.expressed_beside(whole);
        let (difference, covariance) = (whole.difference(&front.axis), front.covariance);
        Self { difference, covariance, cuts: Cuts::of(&front.stretch) }
    }

    /// A line of the whole, moved by the given part of the way to the front, 0–1.
    fn moved_to_front(&self, line: FingerLine, part: f64) -> FingerLine {
        let stretch = Cuts::of(&line.stretch).towards(self.cuts, part).stretch();
        let covariance = line.covariance + self.covariance * (part * part);
        FingerLine { stretch, covariance, ..line.moved(&(self.difference * part)) }
    }
}

/// The bend of a hand's finger, learned frame by frame.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct AxisCurvature {
    /// The bend and the variance of one measurement of it, in parts of the measured half-length,
    /// and that half-length \[px\].
    bend: RunningMean,
    variance: RunningMean,
    half_length_px: RunningMean,
    /// The reliable part of the bend, 0–1: that of the finger rather than of its shading.
    reliable_part: RunningMean,
    /// Weight of the bias of a faint flank, 0–1.
    faintness: RunningMean,
    /// Distance behind the tip of the end of the measured segments, and the half-width \[px\].
    far_px: RunningMean,
    half_width_px: RunningMean,
}

impl AxisCurvature {
    /// Learns from the pixels of a frame, if they agree with the model of a finger; `is_coloured`
    /// says whether the frame has colours.
    pub fn learn(&mut self, refined: &Refined, is_coloured: bool) {
        let Some(report) = refined.photometric.filter(|_| refined.source != Source::Bisector)
        else {
            return;
        };
        let half_length_px = report.half_length_px;
        self.half_length_px.learn(half_length_px, 1.0, SIZE_RATE);
        self.bend.learn(report.bend_px / half_length_px, 1.0, BEND_RATE);
        self.variance.learn((report.bend_sigma_px / half_length_px).powi(2), 1.0, BEND_RATE);
        let [right, left] = report.contrast_grey.map(f64::abs);
        let contrast_grey = right.min(left);
        // No division by zero: rounding alone makes pixels scatter.
        let contrast_ratio = contrast_grey / report.residual_grey;
        let reliable_part = if is_coloured {
            sigmoid(HALF_RELIABLE_CONTRAST_RATIO, contrast_ratio, 4)
        } else {
            0.0
        };
        self.reliable_part.learn(reliable_part, 1.0, BEND_RATE);
        let texture_ratio = contrast_grey / texture_grey(&report, refined.noise_grey);
        self.faintness.learn(1.0 - sigmoid(FAINT, texture_ratio, 8), 1.0, BEND_RATE);
    }

    /// Distance behind the tip \[px\] of the flanks' end for a separate measurement of the front;
    /// `None` where the line of the whole and its curvature are at least as precise.
    pub fn front_to_measure(&self, whole: &Refined, scale: &FingerScale) -> Option<f64> {
        if is_off(Mechanism::FrontLine) {
            return None;
        }
        let far_px = FRONT_SEGMENT.far_px(scale);
        let length_px = whole.stretch.length_px();
        let turn_rad = 0.5 * self.significant_curvature() * (length_px - far_px).max(0.0);
        let noise_rad2 = whole.covariance[(1, 1)] * ((length_px / far_px).powi(3) - 1.0);
        let is_bent =
            turn_rad.abs() > LEAST_TURN_RAD && self.reliable_part.value > MIN_RELIABLE_PART;
        (is_bent && (OFF_BY * turn_rad).powi(2) > noise_rad2).then_some(far_px)
    }

    /// The line of a finger, moved from the segment of the whole towards the front by the reliable
    /// part of the bend. With a separate measurement of the front, that supplies most of the
    /// motion, and the curvature the rest.
    pub fn at_front(
        &mut self,
        line: FingerLine,
        front: Option<&FrontLine>,
        scale: &FingerScale,
    ) -> FingerLine {
        if is_off(Mechanism::AxisCurvature) {
            return line;
        }
        let Axis { anchor, tip, .. } = line.axis;
        let ahead_px = (tip - anchor).dot(&line.axis.direction());
        self.half_width_px.learn(scale.half_width_px, 1.0, SIZE_RATE);
        self.far_px.learn(ahead_px + line.half_length_px, 1.0, SIZE_RATE);
        let line = front.map_or(line, |front| front.moved_to_front(line, self.reliable_part.value));
        let measured = Cuts::of(&line.stretch);
        let target_cuts = self.target_cuts(&line, &measured, ahead_px, scale.foreshortening);
        let cuts = measured.towards(target_cuts, self.significant_part());
        let [turn_rad, twice_lateral_px] = ((cuts.0 - measured.0) * self.curvature()).into();
        let step = Vector2::new(0.5 * twice_lateral_px, turn_rad);
        FingerLine { stretch: cuts.stretch(), ..line.moved(&step) }
    }

    /// Target intersections with the medial line, for a line with its tip `ahead_px` in front of
    /// its anchor.
    fn target_cuts(
        &self,
        line: &FingerLine,
        measured: &Cuts,
        ahead_px: f64,
        foreshortening: f64,
    ) -> Cuts {
        let from_px = measured.middle_px();
        let [whole, front] = [WHOLE_FINGER_SEGMENT, FRONT_SEGMENT].map(|segment| {
            let [near_px, far_px] = self.ends_px(&segment, foreshortening);
            let most_px = segment.max_shift_part * line.half_length_px;
            let by_px = ahead_px - 0.5 * (far_px + near_px) - from_px;
            let middle_px = from_px + by_px.clamp(-most_px, most_px);
            Cuts::of(&Stretch::about(middle_px, 0.5 * (far_px - near_px).max(0.0)))
        });
        whole.towards(front, self.reliable_part.value)
    }

    /// Distances behind the tip at which a segment begins and ends \[px\], limited to the usual
    /// extent of the hand's flanks.
    fn ends_px(&self, segment: &AxisSegment, foreshortening: f64) -> [f64; 2] {
        let half_width_px = self.half_width_px.value;
        let far_px =
            self.far_px.value.min(segment.far_px(&FingerScale { half_width_px, foreshortening }));
        [segment.near_half_widths * half_width_px, far_px]
    }

    /// Standard deviation of the bias of a line at its anchor due to the bend, in parts of the
    /// half-length; 0 for a bend within the noise.
    pub fn bend_bias(&self) -> f64 {
        if is_off(Mechanism::BendBias) {
            return 0.0;
        }
        BEND_BIAS * self.bend_squared().sqrt()
    }

    /// The same for a flank of low contrast, which does not depend on the bend.
    pub fn faint_flank_bias(&self) -> f64 {
        if is_off(Mechanism::FaintFlankBias) {
            return 0.0;
        }
        FAINT_FLANK_BIAS * self.faintness.value
    }

    /// Square of the bend, in parts of the half-length, minus the variance of its noise.
    fn bend_squared(&self) -> f64 {
        (self.bend.value * self.bend.value - self.variance.value).max(0.0)
    }

    /// The part of the measured bend that exceeds its noise, 0–1.
    fn significant_part(&self) -> f64 {
        let squared = self.bend.value * self.bend.value;
        if squared > 0.0 { self.bend_squared() / squared } else { 0.0 }
    }

    /// The curvature times that part \[1/px\].
    fn significant_curvature(&self) -> f64 {
        self.curvature() * self.significant_part()
    }

    /// Curvature of the medial line \[1/px\]; 0 without a measurement.
    fn curvature(&self) -> f64 {
        if self.bend.count > 0.0 { 3.0 * self.bend.value / self.half_length_px.value } else { 0.0 }
    }
}

/// Intersections x₁, x₂ of a line with the parabola y = κ x² / 2, as ((x₁ + x₂) / 2 \[px\],
/// −x₁ x₂ \[px²\]). The slope of the line is κ times the first; its offset at x = 0 is
/// −κ x₁ x₂ / 2, κ/2 times the second. Both are linear in these coordinates: the mean of two lines
/// has the mean of both.
#[derive(Debug, Clone, Copy)]
struct Cuts(Vector2<f64>);

impl Cuts {
    /// Those of the least-squares line over a segment.
    fn of(stretch: &Stretch) -> Self {
        let middle_px = stretch.middle_px();
        Self(Vector2::new(middle_px, stretch.length_px().powi(2) / 12.0 - middle_px * middle_px))
    }

    fn middle_px(&self) -> f64 {
        self.0.x
    }

    /// Those of the line at the given part of the way to another one, 0–1.
    fn towards(self, other: Self, part: f64) -> Self {
        Self(self.0.lerp(&other.0, part))
    }

    /// The segment whose least-squares line it is.
    fn stretch(&self) -> Stretch {
        let [middle_px, product_px2] = self.0.into();
        Stretch::cut(middle_px, middle_px * middle_px + product_px2)
    }
}

/// Scatter of the pixels about the finger's model beyond the noise of the image \[grey levels\].
fn texture_grey(report: &PhotometricReport, noise_grey: f64) -> f64 {
    let noise_grey2 = NOISE_AT_MOST * noise_grey.powi(2);
    (report.residual_grey.powi(2) - noise_grey2).max(ROUNDING_GREY2).sqrt()
}

/// Sigmoid 1 / (1 + (half / contrast)^power) of a contrast, 0–1: ½ at `half`.
fn sigmoid(half: f64, contrast: f64, power: i32) -> f64 {
    1.0 / (1.0 + (half / contrast).powi(power))
}

#[cfg(test)]
mod tests;
