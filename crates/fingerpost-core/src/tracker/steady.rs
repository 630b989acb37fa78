//! A finger line that frame after frame has a say in.
//!
//! Before wood, the line of one frame is off by half a degree: here and there an edge is the grain's.
//! The next frame is off by as much, but otherwise, for the hand has moved on. Its skin ([`Skins`])
//! tells how the finger moved and turned in between, so that the lines of all frames can be told on
//! it: how the axis runs in the skin is a constant that drifts slowly ([`drift`]), as the hand turns and
//! other light falls on it, and a Kalman filter learns it.
//!
//! The lines' errors are not independent. As long as the hand rests, the same grain lies behind it,
//! and the next line errs as the last; how much of an error is new grows with the distance that the
//! finger has moved. Of a line whose error correlates by ρ from frame to frame, many tell as much as
//! independent ones of (1 + ρ) / (1 − ρ) times the variance. And a line that is surer than what is
//! known counts as it is: a finger before an even background gains nothing from the frames before,
//! nor does it lose.
//!
//! Of a finger that rests, all frames are one look at it. A part of each line's error is the same in
//! all of them, and stays; but what noise makes of clutter (an edge that is taken for the finger's in
//! one frame and not in the next) is new in every frame, and that part is averaged away, as far as the
//! skin tells better than the frame how the finger lies. How large it is, the lines tell themselves, by
//! how they scatter beside the skin: lines that all err alike stay as they are.
//!
//! How far the lines scatter about what is known tells besides what their covariances are worth: the
//! variance of unit weight, χ² per degree of freedom. Where it is more than 1, here as after any
//! adjustment by least squares, all are that much less sure.

use super::line::{CONTRADICTION, FingerLine};
use super::skins::{Skins, drift};
use crate::image::GrayView;
use crate::refine::Lie;
use crate::shape_space::Axis;
use nalgebra::{Matrix2, Vector2};

/// The errors of two lines correlate by exp(−distance / this), in half-widths.
const FRESH_WIDTHS: f64 = 0.5;
/// They are never taken for the same altogether: pixels have noise of their own.
const MOST_CORRELATED: f64 = 0.98;
/// This part of their variance they have in common however far the finger moves, as what a shaded
/// flank does to all of them.
const COMMON_PART: f64 = 0.15;
/// What contradicts what is known by more than this, in the square of their covariance, is another
/// finger's.
const OTHER: f64 = 100.0;
/// As long as a finger has not gone so far, in half-widths, its lines are one look at it.
const ONE_LOOK_WIDTHS: f64 = 0.5;
/// At most this part of the variance of each is its own, and new in every frame.
const MOST_OWN_PART: f64 = 0.5;
/// How the skin lies has a say in how far two of them are apart, once for each.
const LIES: f64 = 2.0;
/// Lines are believed to scatter as they say by so many frames, in degrees of freedom two each; each
/// that is fresh changes that by one part in so many more, but at least by this. The more so if it
/// contradicts what is known, but no more than that.
const BELIEVED_FRAMES: f64 = 8.0;
const SCATTER_RATE: f64 = 0.05;
/// Skin that has not been found in so many frames in a row is learned anew.
const MOST_MISSED: usize = 5;
/// The part of the template's length that is skin for certain.
const SKIN_PART: f64 = 0.9;

/// What the frames so far have told of a hand's line.
#[derive(Debug, Clone)]
pub(super) struct Steady {
    skins: Skins,
    known: Option<Known>,
}

#[derive(Debug, Clone, Copy)]
struct Known {
    /// The line as it runs in the skin, beside the axis that was drawn on it: offset \[px\] at the
    /// skin's middle, and angle \[rad\].
    line: Vector2<f64>,
    /// Its covariance; of a finger that rests without what all its lines have in common, as if the part
    /// that is their own were as large as can be.
    covariance: Matrix2<f64>,
    /// The look that it comes from, as long as the finger rests.
    rest: Option<Rest>,
    /// The variance of unit weight, and of how many frames it is.
    scatter: f64,
    frames: f64,
    /// How the skin lay last, and when.
    lay: Axis,
    /// Frames in a row in which the skin was not found.
    missed: usize,
    time_s: f64,
    half_width_px: f64,
}

/// A look at a finger that rests.
#[derive(Debug, Clone, Copy)]
struct Rest {
    /// How the skin lay first.
    first: Axis,
    /// The sum of the inverse covariances of its lines, and how many they are.
    information: Matrix2<f64>,
    frames: f64,
    /// The sum of χ² of how far each lay from those before, less what is the skin's, and what that would
    /// be of lines that have nothing in common.
    scatter: f64,
    most_scatter: f64,
}

impl Rest {
    /// None yet of a finger whose skin lies there.
    fn at(first: Axis) -> Self {
        Self { first, information: Matrix2::zeros(), frames: 0.0, scatter: 0.0, most_scatter: 0.0 }
    }

    /// With one more line of such a covariance.
    fn seen(self, covariance: &Matrix2<f64>) -> Option<Self> {
        let information = self.information + covariance.try_inverse()?;
        Some(Self { information, frames: self.frames + 1.0, ..self })
    }

    /// With how far one more lies from what is known, as in [`Known::covariance`].
    fn scattered(self, look: &Look, known: &Matrix2<f64>) -> Option<Self> {
        let inverse = look.measured.covariance.try_inverse()?;
        let by_skin = LIES * (inverse * look.lie.covariance).trace();
        let scatter = look.surprise.dot(&(inverse * look.surprise)) - by_skin;
        let most = 2.0 + (inverse * known).trace() / MOST_OWN_PART;
        Some(Self {
            scatter: self.scatter + scatter,
            most_scatter: self.most_scatter + most,
            ..self
        })
    }

    /// The part of the variance of its lines that is new in each.
    fn own_part(&self) -> f64 {
        if self.scatter > 0.0 { MOST_OWN_PART.min(self.scatter / self.most_scatter) } else { 0.0 }
    }

    /// The covariance of what is known of them all, in which the own part was the largest.
    fn whole(&self, own: &Matrix2<f64>) -> Option<Matrix2<f64>> {
        Some(self.common()? + own * (self.own_part() / MOST_OWN_PART))
    }

    /// Covariance of what its lines have in common.
    fn common(&self) -> Option<Matrix2<f64>> {
        Some(self.information.try_inverse()? * (self.frames * (1.0 - self.own_part())))
    }
}

/// The finger as its template has it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Shown {
    pub half_width_px: f64,
    pub taper: f64,
    pub length_px: f64,
}

impl Steady {
    pub fn new() -> Self {
        Self { skins: Skins::unseen(), known: None }
    }

    /// Another hand, or the same in another pose: nothing is known of it.
    pub fn forget(&mut self) {
        self.known = None;
    }

    /// The line of a frame, told with what is known from the frames before.
    pub fn follow(
        &mut self,
        image: &GrayView<'_>,
        time_s: f64,
        line: FingerLine,
        shown: &Shown,
    ) -> FingerLine {
        let Some(known) = self.known else {
            self.begin(image, time_s, &line, shown);
            return line;
        };
        if let Some(told) = self.told(image, time_s, line, known) {
            return told;
        }
        let missed = known.missed + 1;
        self.known = (missed < MOST_MISSED).then_some(Known { missed, ..known });
        known.weighed(line)
    }

    fn begin(&mut self, image: &GrayView<'_>, time_s: f64, line: &FingerLine, shown: &Shown) {
        let Shown { half_width_px, taper, length_px } = *shown;
        let axis = &line.axis;
        let is_seen = self.skins.draw(image, axis, half_width_px, taper, SKIN_PART * length_px);
        let lay = self.skins.middle_of(axis);
        let covariance = line.told_at(&lay).covariance;
        self.known = is_seen.then(|| Known {
            line: Vector2::zeros(),
            covariance: covariance * MOST_OWN_PART,
            rest: Rest::at(lay).seen(&covariance),
            scatter: 1.0,
            frames: BELIEVED_FRAMES,
            lay,
            missed: 0,
            time_s,
            half_width_px,
        });
    }

    /// `None` where the skin is not to be seen, or lies where no such line can be.
    fn told(
        &mut self,
        image: &GrayView<'_>,
        time_s: f64,
        line: FingerLine,
        known: Known,
    ) -> Option<FingerLine> {
        let lies = self.skins.find(image, &self.expected(&line, &known), time_s)?;
        let lie = lies.together;
        let (known, gone) = known.carried(&lie, time_s);
        let look = Look::of(line, &lie, &known, gone)?;
        let (known, told) = if let Some(rest) = known.rest {
            known.rested(&look, rest)?
        } else {
            known.moved(&look)?
        };
        self.known = Some(known);
        self.skins.learn(&lies);
        Some(known.weighed(told))
    }

    /// Where the skin would lie if this line were right.
    fn expected(&self, line: &FingerLine, known: &Known) -> Axis {
        let here = line.told_at(&self.skins.middle_of(&line.axis)).axis;
        let anchor = here.anchor - here.normal() * known.line.x;
        let ahead_px = (here.tip - here.anchor).norm();
        Axis::of_finger(anchor, here.angle_rad - known.line.y, ahead_px)
    }
}

impl Known {
    /// After the skin has moved to where it lies now, and by how many half-widths.
    fn carried(self, lie: &Lie, time_s: f64) -> (Self, f64) {
        let w = self.half_width_px;
        let gone = (lie.axis.anchor - self.lay.anchor).norm() / w;
        let turned_rad = lie.axis.angle_rad - self.lay.angle_rad;
        let [offset, angle] = drift(gone, time_s - self.time_s, turned_rad);
        let own = Vector2::new(w * w * offset, angle);
        let rests =
            |rest: &Rest| (lie.axis.anchor - rest.first.anchor).norm() < ONE_LOOK_WIDTHS * w;
        let rest = self.rest.filter(rests);
        let left = self.rest.filter(|_| rest.is_none());
        let covariance =
            left.and_then(|rest| rest.whole(&self.covariance)).unwrap_or(self.covariance);
        let carried = Self {
            covariance: covariance + Matrix2::from_diagonal(&own),
            rest,
            lay: lie.axis,
            missed: 0,
            time_s,
            ..self
        };
        (carried, gone)
    }

    /// With another frame of a finger that rests, and the line of all of them.
    fn rested(self, look: &Look, rest: Rest) -> Option<(Self, FingerLine)> {
        let single = look.measured.covariance;
        let rest = rest.scattered(look, &self.covariance)?.seen(&single)?;
        let own_part = rest.own_part();
        let told = if own_part > 0.0 {
            let foretold = self.covariance * (own_part / MOST_OWN_PART) + look.lie.covariance;
            look.together(&(foretold * look.doubt), &(single * own_part), |_| rest.common())?
        } else {
            look.line
        };
        let known = self.taught(look, &(single * MOST_OWN_PART))?;
        Some((Self { rest: Some(rest), ..known }, told))
    }

    /// With another frame of a finger that has moved, and the line that counts.
    fn moved(self, look: &Look) -> Option<(Self, FingerLine)> {
        let scattered = self.scattered(look);
        let common =
            |covariance: &Matrix2<f64>| Some((look.measured.covariance - covariance) * COMMON_PART);
        let together = look.together(&look.foretold, &look.told, common)?;
        if together.spread() <= look.line.spread() {
            return Some((scattered.taught(look, &look.told)?, together));
        }
        Some((scattered.replaced(look)?, look.line))
    }

    /// With what a look tells.
    fn taught(self, look: &Look, told: &Matrix2<f64>) -> Option<Self> {
        let before = self.covariance * look.doubt;
        let gain = before * (look.foretold + told).try_inverse()?;
        let line = self.line + gain * look.surprise;
        Some(Self { line, covariance: (Matrix2::identity() - gain) * before, ..self })
    }

    /// With how far a look lies from what was known.
    fn scattered(self, look: &Look) -> Self {
        let frames = self.frames + look.freshness;
        let rate = look.freshness * (1.0 / frames).max(SCATTER_RATE);
        let scatter = self.scatter + rate * (look.scatter.min(0.5 * CONTRADICTION) - self.scatter);
        Self { scatter, frames, ..self }
    }

    /// A line with the covariance that it has if it scatters as all do.
    fn weighed(&self, line: FingerLine) -> FingerLine {
        FingerLine { covariance: line.covariance * self.scatter.max(1.0), ..line }
    }

    /// As a frame alone has it, which may be the first of a finger that rests.
    fn replaced(self, look: &Look) -> Option<Self> {
        let single = look.measured.covariance;
        let line = self.line + look.surprise;
        let rest = Some(Rest::at(look.lie.axis).seen(&single)?);
        Some(Self { line, covariance: single * MOST_OWN_PART + look.lie.covariance, rest, ..self })
    }
}

/// A frame's own line beside what is known. Where they contradict each other, all covariances are those
/// of a doubted one.
#[derive(Debug, Clone, Copy)]
struct Look {
    /// As it was measured, and the same told beside the skin.
    line: FingerLine,
    measured: FingerLine,
    lie: Lie,
    /// What is known of the line in the skin, and how far the frame's is from there.
    known: Vector2<f64>,
    surprise: Vector2<f64>,
    /// Of the line that is foretold in this image, and of the frame's as one of many that err alike.
    foretold: Matrix2<f64>,
    told: Matrix2<f64>,
    doubt: f64,
    /// χ² of its difference from what is known per degree of freedom, and how much of it is news, 0–1.
    scatter: f64,
    freshness: f64,
}

impl Look {
    /// `None` where they contradict each other altogether; the finger has gone so far since the last
    /// look, in half-widths.
    fn of(line: FingerLine, lie: &Lie, known: &Known, gone: f64) -> Option<Self> {
        let measured = line.told_at(&lie.axis);
        let drawn = FingerLine { axis: lie.axis, ..measured };
        let surprise = drawn.apart(&measured.axis) - known.line;
        let correlation = correlation(gone);
        let told = measured.covariance * ((1.0 + correlation) / (1.0 - correlation));
        let foretold = known.covariance + lie.covariance;
        let apart = (foretold + measured.covariance).try_inverse()? * surprise;
        let contradiction = surprise.dot(&((foretold + told).try_inverse()? * surprise));
        let doubt = (contradiction / CONTRADICTION).max(1.0);
        let doubted = |line: FingerLine| FingerLine { covariance: line.covariance * doubt, ..line };
        (contradiction <= OTHER).then_some(Self {
            line: doubted(line),
            measured: doubted(measured),
            lie: *lie,
            known: known.line,
            surprise,
            foretold: foretold * doubt,
            told: told * doubt,
            doubt,
            scatter: 0.5 * surprise.dot(&apart),
            freshness: 1.0 - correlation,
        })
    }

    /// The line by both, told where the frame's is: these are their covariances, and what they have in
    /// `common` stays.
    fn together(
        &self,
        foretold: &Matrix2<f64>,
        told: &Matrix2<f64>,
        common: impl FnOnce(&Matrix2<f64>) -> Option<Matrix2<f64>>,
    ) -> Option<FingerLine> {
        let gain = foretold * (foretold + told).try_inverse()?;
        let covariance = (Matrix2::identity() - gain) * foretold;
        let beside = self.known + gain * self.surprise;
        let Axis { anchor, angle_rad, .. } = self.lie.axis;
        let anchor = anchor + self.lie.axis.normal() * beside.x;
        let axis = Axis::of_finger(anchor, angle_rad + beside.y, 0.0);
        let covariance = covariance + common(&covariance)?;
        let told = FingerLine { axis, covariance, ..self.line }.told_beside(&self.line);
        let tip_px = (self.line.axis.tip - self.line.axis.anchor).dot(&self.line.axis.direction());
        let axis = Axis::of_finger(told.axis.anchor, told.axis.angle_rad, tip_px);
        Some(FingerLine { axis, stretch: self.line.stretch, ..told })
    }
}

/// How the errors of two lines of a finger correlate that has gone so far in between, in half-widths.
pub(super) fn correlation(gone: f64) -> f64 {
    MOST_CORRELATED.min((-gone / FRESH_WIDTHS).exp())
}

// What is steadied is private to the crate, and what it must agree with is where it was painted.
#[cfg(test)]
mod tests {
    use super::*;
    use crate::refine::{Painted, Stretch};
    use crate::tracker::LineSource;

    const SHOWN: Shown = Shown { half_width_px: 8.0, taper: 0.0, length_px: 60.0 };

    /// A line that is off by so much, and told with a covariance.
    fn line(painted: &Painted, off: [f64; 2], sigmas: [f64; 2]) -> FingerLine {
        let axis = painted.axis();
        let anchor = axis.anchor + axis.normal() * off[0];
        FingerLine {
            axis: Axis::of_finger(anchor, axis.angle_rad + off[1], 30.0),
            half_length_px: 30.0,
            stretch: Stretch::about(0.0, 30.0),
            covariance: Matrix2::from_diagonal(&Vector2::from(sigmas.map(|s| s * s))),
            source: LineSource::Contour,
        }
    }

    fn painted(k: usize, step_px: f64, texture: f64) -> Painted {
        let k = k as f64;
        let tip = [100.0 + step_px * 9.0 * (0.5 * k).sin(), 70.0 + step_px * 4.0 * (0.3 * k).cos()];
        let stripes_px = 0.7 * k;
        let angle_rad = 0.4 + 0.02 * step_px * (0.2 * k).sin();
        Painted {
            texture,
            stripes_px,
            noise: 2.0,
            seed: 7 + k as u64,
            ..Painted::at(tip, angle_rad)
        }
    }

    /// Errors of as many frames that change from frame to frame, about (0.15 px, 0.01 rad).
    fn error(k: usize) -> [f64; 2] {
        let k = k as f64;
        [0.2 * (2.3 * k).sin(), 0.014 * (2.9 * k + 1.0).sin()]
    }

    /// The error of angle and what is told of it in a frame.
    fn follow(
        steady: &mut Steady,
        k: usize,
        painted: &Painted,
        off: [f64; 2],
        sigmas: [f64; 2],
    ) -> [f64; 2] {
        let line = line(painted, off, sigmas);
        let told = painted.show(|image| steady.follow(image, k as f64 / 25.0, line, &SHOWN));
        [told.axis.angle_rad - painted.angle_rad, told.covariance[(1, 1)].sqrt()]
    }

    /// The same of as many frames.
    fn followed(frames: usize, step_px: f64, texture: f64, sigmas: [f64; 2]) -> Vec<[f64; 2]> {
        let mut steady = Steady::new();
        let off = |k| if step_px > 0.0 { error(k) } else { error(0) };
        (0..frames)
            .map(|k| follow(&mut steady, k, &painted(k, step_px, texture), off(k), sigmas))
            .collect()
    }

    fn rms(values: impl ExactSizeIterator<Item = f64>) -> f64 {
        let count = values.len() as f64;
        (values.map(|v| v * v).sum::<f64>() / count).sqrt()
    }

    #[test]
    fn the_lines_of_a_moving_finger_are_told_together() {
        let told = followed(60, 1.0, 20.0, [0.15, 0.01]);
        let alone = rms((20..60).map(|k| error(k)[1]));
        let together = rms(told[20..].iter().map(|t| t[0]));
        assert!(together < 0.5 * alone, "{together} of {alone}");
        // And they are told to be as sure as they are.
        let sigma = rms(told[20..].iter().map(|t| t[1]));
        assert!(together < 1.3 * sigma && sigma < 0.6 * 0.01, "{together} {sigma}");
    }

    #[test]
    fn the_error_of_a_resting_finger_is_not_averaged_to_nothing() {
        let told = followed(60, 0.0, 20.0, [0.15, 0.01]);
        for [off, sigma] in told {
            assert!((off - error(0)[1]).abs() < 1e-9 && (sigma - 0.01).abs() < 1e-9);
        }
    }

    #[test]
    fn what_is_new_in_every_frame_of_a_resting_finger_is_averaged_away() {
        let mut steady = Steady::new();
        let (common, sigmas) = ([0.1, 0.007], [0.2, 0.014]);
        let own = |k: usize| error(k).map(|off| 0.7 * off);
        let off = |k: usize| [common[0] + own(k)[0], common[1] + own(k)[1]];
        let told: Vec<_> = (0..40)
            .map(|k| follow(&mut steady, k, &painted(k, 0.0, 20.0), off(k), sigmas))
            .collect();
        let alone = rms((20..40).map(|k| own(k)[1]));
        let together = rms(told[20..].iter().map(|t| t[0] - common[1]));
        assert!(together < 0.3 * alone, "{together} of {alone}");
        // It is honest about what is left.
        let (error, sigma) = (rms(told[20..].iter().map(|t| t[0])), told[39][1]);
        assert!((0.5..1.3).contains(&(error / sigma)), "{error} {sigma}");
    }

    #[test]
    fn a_finger_that_comes_to_rest_is_told_by_the_frames_since() {
        let mut steady = Steady::new();
        for k in 0..20 {
            follow(&mut steady, k, &painted(k, 1.0, 20.0), error(k), [0.15, 0.01]);
        }
        // Where it rests, a frame tells more than all before.
        let still = |k: usize| Painted { seed: 7 + k as u64, ..painted(20, 1.0, 20.0) };
        let own = |k: usize| error(k).map(|off| 0.3 * off);
        let told: Vec<_> =
            (20..60).map(|k| follow(&mut steady, k, &still(k), own(k), [0.06, 0.004])).collect();
        let alone = rms((40..60).map(|k| own(k)[1]));
        let together = rms(told[20..].iter().map(|t| t[0]));
        assert!(together < 0.5 * alone, "{together} of {alone}");
    }

    #[test]
    fn a_line_that_is_surer_than_the_skin_stays_as_it_is() {
        let told = followed(40, 1.0, 20.0, [1e-3, 1e-4]);
        for (k, [off, _]) in told.into_iter().enumerate() {
            assert!((off - error(k)[1]).abs() < 1e-3, "{k}: {off}");
        }
    }

    #[test]
    fn skin_that_is_out_of_sight_leaves_the_line_alone_and_is_learned_anew() {
        let mut steady = Steady::new();
        let away = Painted::at([400.0, 300.0], 0.4);
        for k in 0..20 {
            let painted = painted(k, 1.0, 20.0);
            let shown = if (8..12).contains(&k) { away } else { painted };
            let line = line(&painted, error(k), [0.15, 0.01]);
            let told = shown.show(|image| steady.follow(image, k as f64 / 25.0, line, &SHOWN));
            if (8..12).contains(&k) {
                assert_eq!(told, line);
            }
        }
        assert!(steady.known.is_some_and(|known| known.missed == 0));
        for k in 20..20 + MOST_MISSED {
            let line = line(&painted(k, 1.0, 20.0), error(k), [0.15, 0.01]);
            assert_eq!(
                away.show(|image| steady.follow(image, k as f64 / 25.0, line, &SHOWN)),
                line
            );
        }
        assert!(steady.known.is_none());
    }

    #[test]
    fn lines_that_scatter_by_more_than_they_say_are_told_to() {
        let told = followed(60, 1.0, 20.0, [0.15, 0.01]);
        let boasting = followed(60, 1.0, 20.0, [0.05, 0.0033]);
        let sigma = |told: &[[f64; 2]]| rms(told[30..].iter().map(|t| t[1]));
        let off = rms(boasting[30..].iter().map(|t| t[0]));
        assert!(off < 1.5 * sigma(&boasting), "{off} {}", sigma(&boasting));
        assert!(sigma(&boasting) > 0.5 * sigma(&told), "{} {}", sigma(&boasting), sigma(&told));
    }

    #[test]
    fn a_line_that_contradicts_those_before_is_doubted_and_so_are_they() {
        let mut steady = Steady::new();
        let mut follow = |k, off| follow(&mut steady, k, &painted(k, 1.0, 20.0), off, [0.15, 0.01]);
        let usual = (0..20).map(|k| follow(k, error(k))).last();
        let [off, sigma] = follow(20, [0.5, 0.09]);
        assert!(off.abs() < 0.03, "{off}");
        assert!(usual.is_some_and(|[_, usual]| sigma > 1.2 * usual), "{usual:?} {sigma}");
    }
}
