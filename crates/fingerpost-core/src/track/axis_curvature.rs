//! How bent a finger is: the stretch that its line stands for, and how much of it stays open.
//!
//! The line of a finger is the straight one closest to its medial line. A cylinder has one, wherever
//! its flanks are looked at and however it is lit. A finger is bent by a part of a pixel, and its line
//! turns with the stretch that is looked at. Through a medial line of curvature κ, the line of least
//! squares over c ± h has the slope κ c and, at c, the offset κ (c² + h² / 3) / 2; so a stretch that
//! lies 3 px further on turns the line of a hand in a picture by a quarter of a degree. Frame by frame
//! other parts of the flanks are seen, and a template that was held up is not as long as one that was
//! found. Therefore all lines of a hand are told for one stretch: for the front of the finger
//! ([`FRONT`]), which points. They are measured on all of it, for a short stretch tells an angle badly,
//! and taken to the front by the curvature that the pixels show ([`PhotometricReport::bend_px`]), as far
//! as that can be believed to be the finger's own ([`HALF_OWN`]); what cannot leaves them the lines of
//! the whole ([`WHOLE`]). A finger is no parabola where its knuckle begins: if its bend turns the line by
//! more than noise does, the pixels of the front are looked at alone, and how its line lies to that of
//! the whole ([`FrontLine`]) takes the place of most of the bend. How far back the front goes is known by the
//! width, which a view shows as it is, and by how much it shows the length shorter. Each line says for
//! which stretch it is told at last ([`FingerLine::stretch`]), for a known lens bends the image of a
//! straight finger as well: it is straight again where the line cuts it.
//!
//! What is left, no average over frames removes: joints, nail and shading turn and shift a medial line
//! as the bend does. How far another look at the same finger may differ is told from the bend, and
//! added to the covariance of each line; what the frames before average away of it is put back. So is
//! what shade and background may do to a flank that hardly shows, whether it bends the line or not
//! ([`FAINT`]).
//!
//! [`PhotometricReport::bend_px`]: crate::axis::PhotometricReport::bend_px

use super::line::FingerLine;
use crate::axis::{PhotometricReport, Refined, Source, Stretch};
use crate::geometry::shape_space::Axis;
use nalgebra::{Matrix2, Vector2};

/// A stretch that lines may be told for.
struct AxisSegment {
    /// It begins so far behind the tip, and ends so far of a finger that is seen from its side, or where
    /// the hand's flanks usually end if that is nearer \[half-widths\].
    near: f64,
    far: f64,
    /// The middle of what was looked at is moved by no more than this part of its half-length to get
    /// there: what is seen less of is not told from a parabola.
    farthest: f64,
}

impl AxisSegment {
    /// Where it ends behind the tip, as a view shows it \[px\].
    fn far_px(&self, seen: &FingerScale) -> f64 {
        self.far * seen.foreshortening * seen.half_width_px
    }
}

/// What points: index fingers are 9 to 10 half-widths long, and these are 92 and 40 % of the way from
/// knuckle to tip. On 27 films of rendered hands a line over 10 to 97 % is turned against that one by
/// 0.5 to 0.9° in one view and by 0 to 0.5° in the other, and a parabola tells it to within 0.1°. A view
/// that looks along the finger shows it shorter, down to 0.8 on 14 others, and not slimmer: with fronts
/// of one length in half-widths its lines were turned by 0.15 to 0.3° more. In views from the side, the
/// knuckles of 16 hands lie 9.0 to 9.5 half-widths behind their tips: 60 % of that is 5.4 to 5.7.
const FRONT: AxisSegment = AxisSegment { near: 0.76, far: 5.6, farthest: 0.4 };
/// All of a finger, but for its round end.
const WHOLE: AxisSegment = AxisSegment { near: 0.3, far: 8.8, farthest: 0.15 };
/// Of a flank that hardly shows, shading moves the edge; it bends a finger as well as a joint does, and
/// no number of frames averages that away. So much of the bend that is seen is the finger's own, and
/// takes its line from the whole to the front: half of it where the contrast of its fainter flank is so
/// many times what its pixels scatter, nearly all of it where it is twice as much, hardly any where it is
/// half. Without colours a shade looks like an edge, and none of it is.
const HALF_OWN: f64 = 14.0;
/// A parabola is a poor likeness of a finger with a knuckle at its end: of two rendered hands, half and a
/// fifth of the true bend were told, so it may be off by so many times what it turns a line by. Where
/// that is more than the noise of so short a stretch, the pixels of the front are looked at alone: of a
/// finger that turns its line by more than this \[rad\], if so much of what they show is its own.
const OFF_BY: f64 = 2.0;
const LEAST_TURN_RAD: f64 = 0.0035;
const LEAST_OWN: f64 = 0.4;
/// Either end of a line may be misled by this part of the bend. Turned into an angle that is the spread of
/// lines through stretches whose middles scatter by 0.18 half-lengths. On 38 films of rendered hands the
/// 95 % ellipses then hold 91 % of the points by the exact medial lines, 87 % if the frames before may
/// average a bend away.
const BEND_BIAS: f64 = 0.32;
/// Where a flank hardly shows, what is behind it and the shade on it move the edge all along: a line is
/// off that looks as straight as any. On 38 films of rendered hands, lines were turned by 0.7 to 0.8°
/// more than noise and bend allow where the contrast of the fainter flank is less than so many times
/// what its pixels scatter beyond the image's noise, and by no more where it is greater. So much of its
/// half-length is what either end may be misled by: half of it at that contrast, 4 % at one and a half
/// times and all but 4 % at two thirds of it. Noise turns lines as well, but is in their covariance. The
/// 95 % ellipses then hold 96 % of the points of hands whose start was told and 95 % of those that were
/// found; 93 and 87 % without.
const FAINT_FLANK_BIAS: f64 = 0.007;
const FAINT: f64 = 23.0;
/// The variance of the noise is told to within so much, from as few pixels as a finger has: half of the
/// lines of clean cylinders of 24 grey levels under noise of 4 were doubted where it was believed as told.
const NOISE_AT_MOST: f64 = 1.2;
/// What rounding to whole grey levels makes the pixels scatter, squared: no picture is seen to have less
/// texture.
const ROUNDING_GREY2: f64 = 1.0 / 12.0;
/// Part of a frame's bend that is learned once some are known: a finger stays as bent as it is, and one
/// frame shows half a bend more or less. And the same of its size, which changes as it moves.
const BEND_RATE: f64 = 0.03;
const SIZE_RATE: f64 = 0.1;

/// How a view shows a finger in a frame.
pub(super) struct FingerScale {
    pub half_width_px: f64,
    /// See [`ContourTracker::foreshortening`](super::ContourTracker::foreshortening).
    pub foreshortening: f64,
}

/// How the line of a finger's front lies to that of the whole in one frame, by the pixels of either.
pub(super) struct FrontLine {
    /// How far aside \[px\], beside the anchor of the whole's line, and by how much it is turned
    /// \[rad\].
    difference: Vector2<f64>,
    /// How unsure that is, where the front knows nothing of what the whole errs by.
    covariance: Matrix2<f64>,
    cuts: Cuts,
}

impl FrontLine {
    /// By the lines of both.
    pub fn beside(front: &FingerLine, whole: &FingerLine) -> Self {
        let front = front.expressed_beside(whole);
        let (difference, covariance) = (whole.difference(&front.axis), front.covariance);
        Self { difference, covariance, cuts: Cuts::of(&front.stretch) }
    }

    /// A line of the whole, taken so much of the way to the front, 0–1.
    fn moved_to_front(&self, line: FingerLine, part: f64) -> FingerLine {
        let stretch = Cuts::of(&line.stretch).towards(self.cuts, part).stretch();
        let covariance = line.covariance + self.covariance * (part * part);
        FingerLine { stretch, covariance, ..line.moved(&(self.difference * part)) }
    }
}

/// The bend of a hand's finger, learned frame by frame.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct AxisCurvature {
    /// The bend and the variance of one look at it, in parts of the half-length that was looked at,
    /// and that \[px\].
    bend: RunningMean,
    variance: RunningMean,
    half_length_px: RunningMean,
    /// The part of the bend that is its own.
    own_part: RunningMean,
    /// How much of what a faint flank may do it does, 0–1.
    faintness: RunningMean,
    /// How far behind the tip the stretches end, and the half-width \[px\].
    far_px: RunningMean,
    half_width_px: RunningMean,
}

/// A running mean.
#[derive(Debug, Clone, Copy, Default)]
struct RunningMean {
    value: f64,
    frames: f64,
}

impl RunningMean {
    fn learn(&mut self, value: f64, rate: f64) {
        self.frames += 1.0;
        self.value += (1.0 / self.frames).max(rate) * (value - self.value);
    }
}

impl AxisCurvature {
    /// Takes over what the pixels of a frame tell, which has colours or has none, if they agree with a
    /// finger.
    pub fn learn(&mut self, refined: &Refined, is_coloured: bool) {
        let Some(report) = refined.photometric.filter(|_| refined.source != Source::Bisector)
        else {
            return;
        };
        let half_length_px = report.half_length_px;
        self.half_length_px.learn(half_length_px, SIZE_RATE);
        self.bend.learn(report.bend_px / half_length_px, BEND_RATE);
        self.variance.learn((report.bend_sigma_px / half_length_px).powi(2), BEND_RATE);
        let [right, left] = report.contrast_grey.map(f64::abs);
        let contrast_grey = right.min(left);
        // Rounding alone makes pixels scatter: this is no division by zero.
        let shows = contrast_grey / report.residual_grey;
        let own_part = if is_coloured { beyond(HALF_OWN, shows, 4) } else { 0.0 };
        self.own_part.learn(own_part, BEND_RATE);
        let stands_out = contrast_grey / texture_grey(&report, refined.noise_grey);
        self.faintness.learn(1.0 - beyond(FAINT, stands_out, 8), BEND_RATE);
    }

    /// How far behind the tip \[px\] the flanks are to be looked at again for the line of the front alone;
    /// `None` where the whole and its bend tell that as well.
    pub fn front_to_measure(&self, whole: &Refined, seen: &FingerScale) -> Option<f64> {
        let far_px = FRONT.far_px(seen);
        let length_px = whole.stretch.length_px();
        let turn_rad = 0.5 * self.own_curvature() * (length_px - far_px).max(0.0);
        let noise_rad2 = whole.covariance[(1, 1)] * ((length_px / far_px).powi(3) - 1.0);
        let is_bent = turn_rad.abs() > LEAST_TURN_RAD && self.own_part.value > LEAST_OWN;
        (is_bent && (OFF_BY * turn_rad).powi(2) > noise_rad2).then_some(far_px)
    }

    /// The line of a finger, told for the stretch that all are told for: between the whole and the front,
    /// by how much of the bend is its own. Where the front was looked at alone, that tells most of the
    /// way, and the bend the rest.
    pub fn at_front(
        &mut self,
        line: FingerLine,
        front: Option<&FrontLine>,
        seen: &FingerScale,
    ) -> FingerLine {
        let Axis { anchor, tip, .. } = line.axis;
        let ahead_px = (tip - anchor).dot(&line.axis.direction());
        self.half_width_px.learn(seen.half_width_px, SIZE_RATE);
        self.far_px.learn(ahead_px + line.half_length_px, SIZE_RATE);
        let line = front.map_or(line, |front| front.moved_to_front(line, self.own_part.value));
        let measured = Cuts::of(&line.stretch);
        let target_cuts = self.target_cuts(&line, &measured, ahead_px, seen.foreshortening);
        let cuts = measured.towards(target_cuts, self.own_bend());
        let [turn_rad, twice_lateral_px] = ((cuts.0 - measured.0) * self.curvature()).into();
        let step = Vector2::new(0.5 * twice_lateral_px, turn_rad);
        FingerLine { stretch: cuts.stretch(), ..line.moved(&step) }
    }

    /// Where a line whose tip lies so far ahead \[px\] is to cut the medial line, and not where it was
    /// measured.
    fn target_cuts(
        &self,
        line: &FingerLine,
        measured: &Cuts,
        ahead_px: f64,
        foreshortening: f64,
    ) -> Cuts {
        let from_px = measured.middle_px();
        let [whole, front] = [WHOLE, FRONT].map(|segment| {
            let [near_px, far_px] = self.ends_px(&segment, foreshortening);
            let most_px = segment.farthest * line.half_length_px;
            let by_px = ahead_px - 0.5 * (far_px + near_px) - from_px;
            let middle_px = from_px + by_px.clamp(-most_px, most_px);
            Cuts::of(&Stretch::about(middle_px, 0.5 * (far_px - near_px).max(0.0)))
        });
        whole.towards(front, self.own_part.value)
    }

    /// Where an extent begins and ends behind the tip, as far as the hand's flanks usually go \[px\].
    fn ends_px(&self, segment: &AxisSegment, foreshortening: f64) -> [f64; 2] {
        let half_width_px = self.half_width_px.value;
        let far_px =
            self.far_px.value.min(segment.far_px(&FingerScale { half_width_px, foreshortening }));
        [segment.near * half_width_px, far_px]
    }

    /// By how much either end of a line may be misled, in parts of its half-length: nothing by a bend
    /// that is noise.
    pub fn bend_bias(&self) -> f64 {
        BEND_BIAS * self.bend_squared().sqrt()
    }

    /// The same for a flank that hardly shows: by as much in every frame, however straight the finger.
    pub fn faint_flank_bias(&self) -> f64 {
        FAINT_FLANK_BIAS * self.faintness.value
    }

    /// The square of the bend, in parts of the half-length, without what noise adds to it.
    fn bend_squared(&self) -> f64 {
        (self.bend.value * self.bend.value - self.variance.value).max(0.0)
    }

    /// The part of the bend that is none of what noise makes of it, 0–1.
    fn own_bend(&self) -> f64 {
        let squared = self.bend.value * self.bend.value;
        if squared > 0.0 { self.bend_squared() / squared } else { 0.0 }
    }

    /// As much of the curvature as noise does not make.
    fn own_curvature(&self) -> f64 {
        self.curvature() * self.own_bend()
    }

    /// The curvature of the medial line \[1/px\]; 0 where nothing has told of it.
    fn curvature(&self) -> f64 {
        if self.bend.frames > 0.0 { 3.0 * self.bend.value / self.half_length_px.value } else { 0.0 }
    }
}

/// Where a line cuts a parabola y = κ x² / 2: the middle of both places \[px\], and less the product of
/// them \[px²\]. It is turned by the one times κ against the tangent at x = 0, and lies half the other
/// times κ aside of that; so the mean of two lines has the mean of both.
#[derive(Debug, Clone, Copy)]
struct Cuts(Vector2<f64>);

impl Cuts {
    /// Of the line of least squares over a stretch.
    fn of(stretch: &Stretch) -> Self {
        let middle_px = stretch.middle_px();
        Self(Vector2::new(middle_px, stretch.length_px().powi(2) / 12.0 - middle_px * middle_px))
    }

    fn middle_px(&self) -> f64 {
        self.0.x
    }

    /// Of the line so much of the way to another one, 0–1.
    fn towards(self, other: Self, part: f64) -> Self {
        Self(self.0.lerp(&other.0, part))
    }

    /// The stretch whose line of least squares it is.
    fn stretch(&self) -> Stretch {
        let [middle_px, product_px2] = self.0.into();
        Stretch::cut(middle_px, middle_px * middle_px + product_px2)
    }
}

/// What pixels scatter about their finger beyond the noise of the image.
fn texture_grey(report: &PhotometricReport, noise_grey: f64) -> f64 {
    let noise_grey2 = NOISE_AT_MOST * noise_grey.powi(2);
    (report.residual_grey.powi(2) - noise_grey2).max(ROUNDING_GREY2).sqrt()
}

/// How far a contrast lies beyond another one, 0–1: a half there, the steeper about it the higher the
/// power.
fn beyond(half: f64, contrast: f64, power: i32) -> f64 {
    1.0 / (1.0 + (half / contrast).powi(power))
}

#[cfg(test)]
mod tests;
