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
//! the whole ([`Front`]) takes the place of most of the bend. How far back the front goes is known by the
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
//! [`PhotometricReport::bend_px`]: crate::refine::PhotometricReport::bend_px

use super::line::FingerLine;
use crate::refine::{PhotometricReport, Refined, Source, Stretch};
use crate::shape_space::Axis;
use nalgebra::{Matrix2, Vector2};

/// A stretch that lines may be told for.
struct Extent {
    /// It begins so far behind the tip, and ends so far of a finger that is seen from its side, or where
    /// the hand's flanks usually end if that is nearer \[half-widths\].
    near: f64,
    far: f64,
    /// The middle of what was looked at is moved by no more than this part of its half-length to get
    /// there: what is seen less of is not told from a parabola.
    farthest: f64,
}

impl Extent {
    /// Where it ends behind the tip, as a view shows it \[px\].
    fn far_px(&self, seen: &Seen) -> f64 {
        self.far * seen.foreshortening * seen.half_width_px
    }
}

/// What points: index fingers are 9 to 10 half-widths long, and these are 92 and 40 % of the way from
/// knuckle to tip. On 27 films of rendered hands a line over 10 to 97 % is turned against that one by
/// 0.5 to 0.9° in one view and by 0 to 0.5° in the other, and a parabola tells it to within 0.1°. A view
/// that looks along the finger shows it shorter, down to 0.8 on 14 others, and not slimmer: with fronts
/// of one length in half-widths its lines were turned by 0.15 to 0.3° more. In views from the side, the
/// knuckles of 16 hands lie 9.0 to 9.5 half-widths behind their tips: 60 % of that is 5.4 to 5.7.
const FRONT: Extent = Extent { near: 0.76, far: 5.6, farthest: 0.4 };
/// All of a finger, but for its round end.
const WHOLE: Extent = Extent { near: 0.3, far: 8.8, farthest: 0.15 };
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
const MISLEADS: f64 = 0.32;
/// Where a flank hardly shows, what is behind it and the shade on it move the edge all along: a line is
/// off that looks as straight as any. On 38 films of rendered hands, lines were turned by 0.7 to 0.8°
/// more than noise and bend allow where the contrast of the fainter flank is less than so many times
/// what its pixels scatter beyond the image's noise, and by no more where it is greater. So much of its
/// half-length is what either end may be misled by: half of it at that contrast, 4 % at one and a half
/// times and all but 4 % at two thirds of it. Noise turns lines as well, but is in their covariance. The
/// 95 % ellipses then hold 96 % of the points of hands whose start was told and 95 % of those that were
/// found; 93 and 87 % without.
const FAINT_MISLEADS: f64 = 0.007;
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
pub(super) struct Seen {
    pub half_width_px: f64,
    /// See [`ContourTracker::foreshortening`](super::ContourTracker::foreshortening).
    pub foreshortening: f64,
}

/// How the line of a finger's front lies to that of the whole in one frame, by the pixels of either.
pub(super) struct Front {
    /// How far aside \[px\], beside the anchor of the whole's line, and by how much it is turned
    /// \[rad\].
    apart: Vector2<f64>,
    /// How unsure that is, where the front knows nothing of what the whole errs by.
    covariance: Matrix2<f64>,
    cuts: Cuts,
}

impl Front {
    /// By the lines of both.
    pub fn beside(front: &FingerLine, whole: &FingerLine) -> Self {
        let front = front.told_beside(whole);
        let (apart, covariance) = (whole.apart(&front.axis), front.covariance);
        Self { apart, covariance, cuts: Cuts::of(&front.stretch) }
    }

    /// A line of the whole, taken so much of the way to the front, 0–1.
    fn taken(&self, line: FingerLine, part: f64) -> FingerLine {
        let stretch = Cuts::of(&line.stretch).towards(self.cuts, part).stretch();
        let covariance = line.covariance + self.covariance * (part * part);
        FingerLine { stretch, covariance, ..line.moved(&(self.apart * part)) }
    }
}

/// The bend of a hand's finger, learned frame by frame.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Sagitta {
    /// The bend and the variance of one look at it, in parts of the half-length that was looked at,
    /// and that \[px\].
    bend: Mean,
    variance: Mean,
    half_length_px: Mean,
    /// The part of the bend that is its own.
    own_part: Mean,
    /// How much of what a faint flank may do it does, 0–1.
    faintness: Mean,
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
    fn learn(&mut self, value: f64, rate: f64) {
        self.frames += 1.0;
        self.value += (1.0 / self.frames).max(rate) * (value - self.value);
    }
}

impl Sagitta {
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
    pub fn front_to_look_at(&self, whole: &Refined, seen: &Seen) -> Option<f64> {
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
    pub fn told(&mut self, line: FingerLine, front: Option<&Front>, seen: &Seen) -> FingerLine {
        let Axis { anchor, tip, .. } = line.axis;
        let ahead_px = (tip - anchor).dot(&line.axis.direction());
        self.half_width_px.learn(seen.half_width_px, SIZE_RATE);
        self.far_px.learn(ahead_px + line.half_length_px, SIZE_RATE);
        let line = front.map_or(line, |front| front.taken(line, self.own_part.value));
        let measured = Cuts::of(&line.stretch);
        let meant = self.meant(&line, &measured, ahead_px, seen.foreshortening);
        let cuts = measured.towards(meant, self.own_bend());
        let [turn_rad, twice_aside_px] = ((cuts.0 - measured.0) * self.curvature()).into();
        let step = Vector2::new(0.5 * twice_aside_px, turn_rad);
        FingerLine { stretch: cuts.stretch(), ..line.moved(&step) }
    }

    /// Where a line whose tip lies so far ahead \[px\] is to cut the medial line, and not where it was
    /// measured.
    fn meant(
        &self,
        line: &FingerLine,
        measured: &Cuts,
        ahead_px: f64,
        foreshortening: f64,
    ) -> Cuts {
        let from_px = measured.middle_px();
        let [whole, front] = [WHOLE, FRONT].map(|extent| {
            let [near_px, far_px] = self.ends_px(&extent, foreshortening);
            let most_px = extent.farthest * line.half_length_px;
            let by_px = ahead_px - 0.5 * (far_px + near_px) - from_px;
            let middle_px = from_px + by_px.clamp(-most_px, most_px);
            Cuts::of(&Stretch::about(middle_px, 0.5 * (far_px - near_px).max(0.0)))
        });
        whole.towards(front, self.own_part.value)
    }

    /// Where an extent begins and ends behind the tip, as far as the hand's flanks usually go \[px\].
    fn ends_px(&self, extent: &Extent, foreshortening: f64) -> [f64; 2] {
        let half_width_px = self.half_width_px.value;
        let far_px = self.far_px.value.min(extent.far_px(&Seen { half_width_px, foreshortening }));
        [extent.near * half_width_px, far_px]
    }

    /// By how much either end of a line may be misled, in parts of its half-length: nothing by a bend
    /// that is noise.
    pub fn misleads(&self) -> f64 {
        MISLEADS * self.told_squared().sqrt()
    }

    /// The same for a flank that hardly shows: by as much in every frame, however straight the finger.
    pub fn faint_misleads(&self) -> f64 {
        FAINT_MISLEADS * self.faintness.value
    }

    /// The square of the bend, in parts of the half-length, without what noise adds to it.
    fn told_squared(&self) -> f64 {
        (self.bend.value * self.bend.value - self.variance.value).max(0.0)
    }

    /// The part of the bend that is none of what noise makes of it, 0–1.
    fn own_bend(&self) -> f64 {
        let squared = self.bend.value * self.bend.value;
        if squared > 0.0 { self.told_squared() / squared } else { 0.0 }
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

// What it learns from is made by the refinement; here it is written down.
#[cfg(test)]
mod tests {
    use super::*;
    use crate::tracker::LineSource;
    use nalgebra::{Matrix2, Point2};

    const HALF_PX: f64 = 30.0;
    const RESIDUAL_GREY: f64 = 2.0;
    const NOISE_GREY: f64 = 2.0;

    fn refined(bend_px: f64, bend_sigma_px: f64, source: Source) -> Refined {
        let photometric = PhotometricReport {
            pixels: 900,
            blocks: 40,
            trusted: 1.0,
            rejected: 0.0,
            residual_grey: RESIDUAL_GREY,
            blur_px: 1.0,
            half_length_px: HALF_PX,
            bend_px,
            bend_sigma_px,
            contrast_grey: [1e9; 2],
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
            noise_grey: NOISE_GREY,
            bisector: None,
            photometric: Some(photometric),
        }
    }

    fn from_its_side(half_width_px: f64) -> Seen {
        Seen { half_width_px, foreshortening: 1.0 }
    }

    #[test]
    fn a_bent_finger_leaves_its_line_open_and_one_that_noise_bends_does_not() {
        let mut bent = Sagitta::default();
        assert!(bent.misleads().abs() < 1e-12);
        for _ in 0..5 {
            bent.learn(&refined(-0.5, 0.3, Source::Unsure), true);
        }
        assert!((bent.misleads() - MISLEADS * 0.4 / HALF_PX).abs() < 1e-9);

        let mut straight = Sagitta::default();
        for k in 0..40 {
            let noise = 0.3 * (2.3 * f64::from(k)).sin();
            straight.learn(&refined(noise, 0.3, Source::Photometric), true);
        }
        assert!(straight.misleads().abs() < 1e-12);
    }

    #[test]
    fn of_a_finger_that_hardly_shows_the_bend_takes_the_line_only_part_of_the_way_to_its_front() {
        let (curvature, half_width_px) = (2e-3, 7.0);
        let bend_px = curvature * HALF_PX * HALF_PX / 3.0;
        let turn = |faintest: f64, is_coloured: bool| {
            let look = refined(bend_px, 0.0, Source::Unsure);
            let contrast_grey = [-1e9, faintest * HALF_OWN * RESIDUAL_GREY];
            let photometric = look.photometric.map(|p| PhotometricReport { contrast_grey, ..p });
            let mut sagitta = Sagitta::default();
            sagitta.learn(&Refined { photometric, ..look }, is_coloured);
            let line = line_over(curvature, 9.0 * half_width_px, 0.0);
            sagitta.told(line, None, &from_its_side(half_width_px)).apart(&line.axis).y
        };
        let [whole, front] = [turn(1e9, false), turn(1e9, true)];
        assert!((front - whole).abs() > 0.01, "{whole} {front}");
        for (faintest, own_part) in [(0.0, 0.0), (1.0, 0.5), (-2.0, 16.0 / 17.0)] {
            let expected = whole + own_part * (front - whole);
            assert!((turn(faintest, true) - expected).abs() < 1e-9, "{faintest}");
        }
    }

    /// How much of what a faint flank may do one of such a contrast does, whose pixels scatter so much.
    fn faintness(contrast_grey: f64, residual_grey: f64, is_coloured: bool) -> f64 {
        let look = refined(0.0, 0.3, Source::Photometric);
        let contrast_grey = [-1e9, contrast_grey];
        let shows = |p| PhotometricReport { residual_grey, contrast_grey, ..p };
        let mut sagitta = Sagitta::default();
        let photometric = look.photometric.map(shows);
        sagitta.learn(&Refined { photometric, ..look }, is_coloured);
        assert!(sagitta.misleads().abs() < 1e-12);
        sagitta.faint_misleads() / FAINT_MISLEADS
    }

    #[test]
    fn a_flank_that_hardly_shows_leaves_the_straightest_line_open() {
        let texture_grey: f64 = 6.0;
        let residual_grey = (texture_grey.powi(2) + NOISE_AT_MOST * NOISE_GREY.powi(2)).sqrt();
        for is_coloured in [true, false] {
            let faintness =
                |times: f64| faintness(times * FAINT * texture_grey, residual_grey, is_coloured);
            assert!((faintness(0.0) - 1.0).abs() < 1e-12);
            assert!((faintness(-1.0) - 0.5).abs() < 1e-9);
            assert!((faintness(1.5) - 0.04).abs() < 0.005);
            assert!(faintness(3.0) < 1e-3);
        }
        assert!(Sagitta::default().faint_misleads().abs() < 1e-12);
    }

    #[test]
    fn noise_makes_no_flank_faint() {
        for times in [0.5, 1.0, 1.09] {
            assert!(faintness(5.0 * NOISE_GREY, times * NOISE_GREY, true) < 0.05);
        }
    }

    #[test]
    fn pixels_that_are_no_fingers_tell_nothing() {
        let mut sagitta = Sagitta::default();
        sagitta.learn(&refined(5.0, 0.1, Source::Bisector), true);
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
            stretch: Stretch::about(0.0, half_px),
            covariance: Matrix2::identity(),
            source: LineSource::Pixels,
        }
    }

    #[test]
    fn lines_of_different_stretches_are_told_for_one() {
        let (curvature, half_width_px) = (2e-3, 7.0);
        let mut bent = Sagitta::default();
        bent.learn(&refined(curvature * HALF_PX * HALF_PX / 3.0, 0.0, Source::Photometric), true);
        for foreshortening in [1.0, 0.8] {
            let seen = Seen { half_width_px, foreshortening };
            let far_px = FRONT.far * foreshortening * half_width_px;
            let near_px = FRONT.near * half_width_px;
            let expected = line_over(curvature, far_px, near_px);
            for (more_far_px, more_near_px) in [(0.0, 0.0), (7.0, 1.0), (4.0, 4.0), (9.0, -1.0)] {
                let line = line_over(curvature, far_px + more_far_px, near_px + more_near_px);
                let mut sagitta = bent;
                let told = sagitta.told(line, None, &seen);
                let apart = told.apart(&expected.told_beside(&told).axis);
                assert!(apart.x.abs() < 2e-3 && apart.y.abs() < 2e-5, "{apart}");
                // A straight finger has one line.
                let straight = Sagitta::default().told(line, None, &seen);
                assert_eq!(straight.axis.anchor, line.axis.anchor);
                assert!((straight.axis.angle_rad - line.axis.angle_rad).abs() < 1e-15);
            }
        }
    }

    #[test]
    fn a_line_cuts_the_finger_where_its_stretch_says() {
        let (curvature, half_width_px) = (5e-4, 7.0);
        let bend_px = curvature * HALF_PX * HALF_PX / 3.0;
        let line = line_over(curvature, 66.0, 3.0);
        // However far it is taken: all of the way, or part of it for a bend that may be noise or shade.
        for (sigma_px, faintest) in [(0.0, 1e9), (0.0, 1.0), (0.7 * bend_px, 1e9), (9.0, 1e9)] {
            let look = refined(bend_px, sigma_px, Source::Photometric);
            let contrast_grey = [1e9, faintest * HALF_OWN * RESIDUAL_GREY];
            let photometric = look.photometric.map(|p| PhotometricReport { contrast_grey, ..p });
            let mut sagitta = Sagitta::default();
            sagitta.learn(&Refined { photometric, ..look }, true);
            let told = sagitta.told(line, None, &from_its_side(half_width_px));
            let cut_px = told.stretch.length_px() / 12.0_f64.sqrt();
            for along_px in [-1.0, 1.0].map(|s| told.stretch.middle_px() + s * cut_px) {
                let Point2 { coords, .. } = told.axis.anchor + told.axis.direction() * along_px;
                // The vertex of its bend is the tip.
                let medial = 0.5 * curvature * (coords.x - 200.0).powi(2);
                assert!((coords.y - medial).abs() < 3e-4, "{sigma_px} {faintest}: {coords}");
            }
        }
        // One that nothing is known of is told for what it was measured on.
        let told = Sagitta::default().told(line, None, &from_its_side(half_width_px));
        assert!((told.stretch.length_px() - 63.0).abs() < 1e-9, "{:?}", told.stretch);
        assert!(told.stretch.middle_px().abs() < 1e-9, "{:?}", told.stretch);
    }

    /// What is known after a look at a finger whose bend turns its line so much towards the front, in a
    /// picture with colours or without, and the look.
    fn bent(turn_rad: f64, sigma_px: f64, is_coloured: bool) -> (Sagitta, Refined) {
        // A stretch 60 px long is 20.8 px longer than the front of a finger of 7 px.
        let curvature = turn_rad / (0.5 * (2.0 * HALF_PX - 5.6 * 7.0));
        let look = refined(curvature * HALF_PX * HALF_PX / 3.0, sigma_px, Source::Photometric);
        let mut sagitta = Sagitta::default();
        sagitta.learn(&look, is_coloured);
        (sagitta, Refined { covariance: Matrix2::identity() * 1e-6, ..look })
    }

    #[test]
    fn the_front_of_a_finger_is_looked_at_where_its_bend_is_more_than_noise() {
        let looked_at = |(sagitta, look): &(Sagitta, Refined)| {
            sagitta.front_to_look_at(look, &from_its_side(7.0))
        };
        assert_eq!(looked_at(&bent(0.01, 0.0, true)), Some(5.6 * 7.0));
        assert_eq!(looked_at(&bent(-0.01, 0.0, true)), Some(5.6 * 7.0));
        // Of no bend, of one of a shade, and of one that may be noise, there is nothing to be had.
        assert_eq!(looked_at(&bent(0.001, 0.0, true)), None);
        assert_eq!(looked_at(&bent(0.01, 0.0, false)), None);
        assert_eq!(looked_at(&bent(0.01, 1.0, true)), None);
        // Nor where the short stretch would err by more, or there is nothing behind it.
        let (sagitta, look) = bent(0.01, 0.0, true);
        let noisy = Refined { covariance: Matrix2::identity() * 0.02_f64.powi(2), ..look };
        assert_eq!(sagitta.front_to_look_at(&noisy, &from_its_side(7.0)), None);
        assert_eq!(sagitta.front_to_look_at(&look, &from_its_side(11.0)), None);
    }

    #[test]
    fn what_the_front_alone_tells_takes_the_place_of_the_bend() {
        let (mut sagitta, _) = bent(0.01, 0.0, true);
        let half_width_px = 7.0;
        let (far_px, near_px) = (FRONT.far * half_width_px, FRONT.near * half_width_px);
        // A knuckle turns the line of the whole, and not that of the front: no parabola does so.
        let whole = line_over(0.0, 66.0, near_px).moved(&Vector2::new(0.7, 0.05));
        let straight = line_over(0.0, far_px, near_px);
        let front = Front::beside(&straight, &whole);
        let told = sagitta.told(whole, Some(&front), &from_its_side(half_width_px));
        let apart = told.apart(&straight.told_beside(&told).axis);
        assert!(apart.x.abs() < 1e-2 && apart.y.abs() < 1e-3, "{apart}");
        assert!((told.stretch.length_px() - (far_px - near_px)).abs() < 0.1, "{:?}", told.stretch);
        // It is as unsure as both.
        let beside = straight.told_beside(&whole).covariance;
        assert!((told.covariance - whole.covariance - beside).norm() < 1e-6 * beside.norm());
    }

    #[test]
    fn a_finger_of_no_length_has_the_tangent_of_its_bend() {
        let mut sagitta = Sagitta::default();
        sagitta.learn(&refined(0.6, 0.0, Source::Photometric), true);
        // So foreshortened, its front ends before it begins.
        let seen = Seen { half_width_px: 7.0, foreshortening: 0.01 };
        let told = sagitta.told(line_over(2e-3, 66.0, 3.0), None, &seen);
        assert!((told.stretch.length_px() - 2.0).abs() < 1e-9, "{:?}", told.stretch);
    }

    #[test]
    fn a_short_stretch_is_not_stretched_to_a_long_one() {
        let (curvature, half_width_px) = (2e-3, 7.0);
        let mut sagitta = Sagitta::default();
        sagitta
            .learn(&refined(curvature * HALF_PX * HALF_PX / 3.0, 0.0, Source::Photometric), true);
        let near_px = FRONT.near * half_width_px;
        // What is always seen of this hand is what its line is told for.
        let short = line_over(curvature, 30.0, near_px);
        let apart = sagitta.told(short, None, &from_its_side(half_width_px)).apart(&short.axis);
        assert!(apart.norm() < 1e-12, "{apart}");
        // Seen less of for once, its line is moved by a part of that.
        let shorter = line_over(curvature, 12.0, near_px);
        let turn =
            sagitta.told(shorter, None, &from_its_side(half_width_px)).apart(&shorter.axis).y;
        let most = curvature * FRONT.farthest * shorter.half_length_px;
        assert!((turn.abs() - most).abs() < 1e-9, "{turn} {most}");
    }

    #[test]
    fn a_stretch_further_on_lies_within_what_the_bend_leaves_open() {
        let (bend_px, shift_px) = (0.6, MISLEADS * HALF_PX / 3.0_f64.sqrt());
        let curvature = 3.0 * bend_px / (HALF_PX * HALF_PX);
        let [turned, straight] =
            [shift_px, 0.0].map(|middle_px| least_squares(curvature, middle_px, HALF_PX)[1]);
        let mut sagitta = Sagitta::default();
        sagitta.learn(&refined(bend_px, 0.0, Source::Photometric), true);
        let sigma = sagitta.misleads() * 3.0_f64.sqrt();
        assert!(((turned - straight) / sigma - 1.0).abs() < 1e-3, "{turned} {straight} {sigma}");
    }
}
