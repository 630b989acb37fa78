//! How bent a finger is: the stretch that its line stands for, and how much of it stays open.
//!
//! The line of a finger is the straight one closest to its medial line. A cylinder has one, wherever
//! its flanks are looked at and however it is lit. A finger is bent by a part of a pixel, and its line
//! turns with the stretch that is looked at. Through a medial line of curvature κ, the line of least
//! squares over c ± h has the slope κ c and, at c, the offset κ (c² + h² / 3) / 2; so a stretch that
//! lies 3 px further on turns the line of a hand in a picture by a quarter of a degree. Frame by frame
//! other parts of the flanks are seen, and a template that was held up is not as long as one that was
//! found. Therefore all lines are told for one stretch ([`FAR`]), by the curvature that the pixels show
//! ([`PhotometricReport::bend_px`]).
//!
//! What is left, no average over frames removes: joints, nail and shading turn and shift a medial line
//! as the bend does. How far another look at the same finger may differ is told from the bend, and
//! added to the covariance of each line; what the frames before average away of it is put back.
//!
//! [`PhotometricReport::bend_px`]: crate::refine::PhotometricReport::bend_px

use super::line::FingerLine;
use crate::refine::{Refined, Source};
use crate::shape_space::Axis;

/// The stretch that lines are told for ends so far behind the tip, in half-widths, or where the hand's
/// flanks usually end if that is nearer; it begins where the round end does. Index fingers are 9 to 10
/// half-widths long from knuckle to tip.
const FAR: f64 = 8.8;
const NEAR: f64 = 0.3;
/// The middle of a stretch is moved by no more than this part of its half-length: what is seen less
/// of is not told from a parabola.
const FARTHEST: f64 = 0.15;
/// Either end of a line may be misled by this part of the bend. Turned into an angle that is the spread of
/// lines through stretches whose middles scatter by 0.18 half-lengths. On 38 films of rendered hands the
/// 95 % ellipses then hold 91 % of the points by the exact medial lines, 87 % if the frames before may
/// average a bend away.
const MISLEADS: f64 = 0.32;
/// Part of a frame that is learned once some are known.
const RATE: f64 = 0.1;

/// The bend of a hand's finger, learned frame by frame.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Sagitta {
    /// The bend and the variance of one look at it, in parts of the half-length that was looked at,
    /// and that \[px\].
    bend: Mean,
    variance: Mean,
    half_length_px: Mean,
    /// How far behind the tip the stretches end, and the half-width \[px\].
    far_px: Mean,
    half_width_px: Mean,
}

/// A running mean.
#[derive(Debug, Clone, Copy, Default)]
struct Mean {
    value: f64,
    frames: f64,
}

impl Mean {
    fn learn(&mut self, value: f64) {
        self.frames += 1.0;
        self.value += (1.0 / self.frames).max(RATE) * (value - self.value);
    }
}

impl Sagitta {
    /// Takes over what the pixels of a frame tell, if they agree with a finger.
    pub fn learn(&mut self, refined: &Refined) {
        let Some(report) = refined.photometric.filter(|_| refined.source != Source::Bisector)
        else {
            return;
        };
        let half_length_px = report.half_length_px;
        self.half_length_px.learn(half_length_px);
        self.bend.learn(report.bend_px / half_length_px);
        self.variance.learn((report.bend_sigma_px / half_length_px).powi(2));
    }

    /// The line of a finger of some half-width, told for the stretch that all are told for.
    pub fn told(&mut self, line: FingerLine, half_width_px: f64) -> FingerLine {
        let Axis { anchor, angle_rad, tip } = line.axis;
        let ahead_px = (tip - anchor).dot(&line.axis.direction());
        self.half_width_px.learn(half_width_px);
        self.far_px.learn(ahead_px + line.half_length_px);
        let far_px = self.far_px.value.min(FAR * self.half_width_px.value);
        let near_px = NEAR * self.half_width_px.value;
        // From the middle of the line's stretch to that of the other, towards the tip.
        let farthest_px = FARTHEST * line.half_length_px;
        let by_px = (ahead_px - 0.5 * (far_px + near_px)).clamp(-farthest_px, farthest_px);
        let half_px = 0.5 * (far_px - near_px).max(0.0);
        let curvature = self.curvature();
        // The difference of both lines of least squares, beside the anchor.
        let squares = (half_px.powi(2) - line.half_length_px.powi(2)) / 3.0 - by_px * by_px;
        let anchor = anchor + line.axis.normal() * (0.5 * curvature * squares);
        let angle_rad = angle_rad + curvature * by_px;
        FingerLine { axis: Axis::of_finger(anchor, angle_rad, ahead_px), ..line }
    }

    /// By how much either end of a line may be misled, in parts of its half-length: nothing by a bend
    /// that is noise.
    pub fn misleads(&self) -> f64 {
        MISLEADS * self.told_squared().sqrt()
    }

    /// The square of the bend, in parts of the half-length, without what noise adds to it.
    fn told_squared(&self) -> f64 {
        (self.bend.value * self.bend.value - self.variance.value).max(0.0)
    }

    /// The curvature of the medial line \[1/px\], drawn towards zero by as much as it may be noise.
    fn curvature(&self) -> f64 {
        let squared = self.bend.value * self.bend.value;
        if squared > 0.0 {
            3.0 * self.told_squared() / (self.bend.value * self.half_length_px.value)
        } else {
            0.0
        }
    }
}

// What it learns from is made by the refinement; here it is written down.
#[cfg(test)]
mod tests {
    use super::*;
    use crate::refine::{PhotometricReport, Stretch};
    use crate::tracker::LineSource;
    use nalgebra::{Matrix2, Point2};

    const HALF_PX: f64 = 30.0;

    fn refined(bend_px: f64, bend_sigma_px: f64, source: Source) -> Refined {
        let photometric = PhotometricReport {
            pixels: 900,
            blocks: 40,
            trusted: 1.0,
            rejected: 0.0,
            residual_grey: 2.0,
            blur_px: 1.0,
            half_length_px: HALF_PX,
            bend_px,
            bend_sigma_px,
            contrast_grey: [80.0; 2],
            inside_grey: [0.0; 2],
            outside_grey: [0.0; 2],
            edge_px: [0.0; 2],
            iterations: 5,
            converged: true,
        };
        Refined {
            axis: Axis::of_finger(Point2::new(100.0, 80.0), 0.3, HALF_PX),
            covariance: Matrix2::identity(),
            stretch: Stretch { from_px: -HALF_PX, to_px: HALF_PX },
            half_width_px: 8.0,
            taper: 0.0,
            source,
            noise_grey: 2.0,
            bisector: None,
            photometric: Some(photometric),
        }
    }

    #[test]
    fn a_bent_finger_leaves_its_line_open_and_one_that_noise_bends_does_not() {
        let mut bent = Sagitta::default();
        assert!(bent.misleads().abs() < 1e-12);
        for _ in 0..5 {
            bent.learn(&refined(-0.5, 0.3, Source::Unsure));
        }
        assert!((bent.misleads() - MISLEADS * 0.4 / HALF_PX).abs() < 1e-9);

        let mut straight = Sagitta::default();
        for k in 0..40 {
            let noise = 0.3 * (2.3 * f64::from(k)).sin();
            straight.learn(&refined(noise, 0.3, Source::Photometric));
        }
        assert!(straight.misleads().abs() < 1e-12);
    }

    #[test]
    fn pixels_that_are_no_fingers_tell_nothing() {
        let mut sagitta = Sagitta::default();
        sagitta.learn(&refined(5.0, 0.1, Source::Bisector));
        assert!(sagitta.misleads().abs() < 1e-12);
    }

    /// Middle \[px from the medial line's vertex, towards the tip\] and slope of the line of least
    /// squares over a stretch of y = κ x² / 2.
    fn least_squares(curvature: f64, middle_px: f64, half_px: f64) -> [f64; 2] {
        let (mut sums, count) = ([0.0; 3], 2001);
        for k in 0..count {
            let t = 2.0 * f64::from(k) / f64::from(count - 1) - 1.0;
            let medial = 0.5 * curvature * (middle_px + t * half_px).powi(2);
            sums = [sums[0] + medial, sums[1] + t * medial, sums[2] + t * t];
        }
        [sums[0] / f64::from(count), sums[1] / (sums[2] * half_px)]
    }

    /// The finger line of a stretch from `far_px` to `near_px` behind the tip at (200, 0), of a finger
    /// that points along +u and has the vertex of its bend at the tip.
    fn line_over(curvature: f64, far_px: f64, near_px: f64) -> FingerLine {
        let (middle_px, half_px) = (-0.5 * (far_px + near_px), 0.5 * (far_px - near_px));
        let [offset_px, slope] = least_squares(curvature, middle_px, half_px);
        let anchor = Point2::new(200.0 + middle_px, offset_px);
        FingerLine {
            axis: Axis::of_finger(anchor, slope, -middle_px),
            half_length_px: half_px,
            covariance: Matrix2::identity(),
            source: LineSource::Pixels,
        }
    }

    #[test]
    fn lines_of_different_stretches_are_told_for_one() {
        let (curvature, half_width_px) = (2e-3, 7.0);
        let (far_px, near_px) = (FAR * half_width_px, NEAR * half_width_px);
        let expected = line_over(curvature, far_px, near_px);
        let mut bent = Sagitta::default();
        bent.learn(&refined(curvature * HALF_PX * HALF_PX / 3.0, 0.0, Source::Photometric));
        for (more_far_px, more_near_px) in [(0.0, 0.0), (7.0, 1.0), (4.0, 4.0), (9.0, -1.0)] {
            let line = line_over(curvature, far_px + more_far_px, near_px + more_near_px);
            let mut sagitta = bent;
            let told = sagitta.told(line, half_width_px);
            let apart = told.apart(&expected.told_beside(&told).axis);
            assert!(apart.x.abs() < 2e-3 && apart.y.abs() < 2e-5, "{apart}");
            // A straight finger has one line.
            let straight = Sagitta::default().told(line, half_width_px);
            assert_eq!(straight.axis.anchor, line.axis.anchor);
            assert!((straight.axis.angle_rad - line.axis.angle_rad).abs() < 1e-15);
        }
    }

    #[test]
    fn a_short_stretch_is_not_stretched_to_a_long_one() {
        let (curvature, half_width_px) = (2e-3, 7.0);
        let mut sagitta = Sagitta::default();
        sagitta.learn(&refined(curvature * HALF_PX * HALF_PX / 3.0, 0.0, Source::Photometric));
        let near_px = NEAR * half_width_px;
        // What is always seen of this hand is what its line is told for.
        let short = line_over(curvature, 30.0, near_px);
        let apart = sagitta.told(short, half_width_px).apart(&short.axis);
        assert!(apart.norm() < 1e-12, "{apart}");
        // Seen less of for once, its line is moved by a part of that.
        let shorter = line_over(curvature, 12.0, near_px);
        let turn = sagitta.told(shorter, half_width_px).apart(&shorter.axis).y;
        let most = curvature * FARTHEST * shorter.half_length_px;
        assert!((turn.abs() - most).abs() < 1e-9, "{turn} {most}");
    }

    #[test]
    fn a_stretch_further_on_lies_within_what_the_bend_leaves_open() {
        let (bend_px, shift_px) = (0.6, MISLEADS * HALF_PX / 3.0_f64.sqrt());
        let curvature = 3.0 * bend_px / (HALF_PX * HALF_PX);
        let [turned, straight] =
            [shift_px, 0.0].map(|middle_px| least_squares(curvature, middle_px, HALF_PX)[1]);
        let mut sagitta = Sagitta::default();
        sagitta.learn(&refined(bend_px, 0.0, Source::Photometric));
        let sigma = sagitta.misleads() * 3.0_f64.sqrt();
        assert!(((turned - straight) / sigma - 1.0).abs() < 1e-3, "{turned} {straight} {sigma}");
    }
}
