//! A finger line that frame after frame has a say in.
//!
//! Before wood, the line of one frame is off by half a degree: here and there an edge is the grain's.
//! The next frame is off by as much, but otherwise, for the hand has moved on. Its skin ([`TextureRegistration`])
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

use super::line::{CHI2_2DOF_99, FingerLine};
use super::registration::{TextureRegistration, drift};
use crate::axis::TexturePose;
use crate::geometry::shape_space::Axis;
use crate::image::gray::GrayView;
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
const POSE_TERMS: f64 = 2.0;
/// Lines are believed to scatter as they say by so many frames, in degrees of freedom two each; each
/// that is fresh changes that by one part in so many more, but at least by this. The more so if it
/// contradicts what is known, but no more than that.
const BELIEVED_FRAMES: f64 = 8.0;
const SCATTER_RATE: f64 = 0.05;
/// Skin that has not been found in so many frames in a row is learned anew.
const MOST_MISSED: usize = 5;
/// The part of the template's length that is skin for certain.
const TEXTURED_PART: f64 = 0.9;

/// What the frames so far have told of a hand's line.
#[derive(Debug, Clone)]
pub(super) struct LineFilter {
    registration: TextureRegistration,
    state: Option<LineState>,
}

#[derive(Debug, Clone, Copy)]
struct LineState {
    /// The line as it runs in the skin, beside the axis that was drawn on it: offset \[px\] at the
    /// skin's middle, and angle \[rad\].
    line: Vector2<f64>,
    /// Its covariance; of a finger that rests without what all its lines have in common, as if the part
    /// that is their own were as large as can be.
    covariance: Matrix2<f64>,
    /// The look that it comes from, as long as the finger rests.
    rest: Option<RestingLine>,
    /// The variance of unit weight, and of how many frames it is.
    variance_factor: f64,
    frames: f64,
    /// How the skin lay last, and when.
    pose: Axis,
    /// Frames in a row in which the skin was not found.
    missed: usize,
    time_s: f64,
    half_width_px: f64,
}

/// A look at a finger that rests.
#[derive(Debug, Clone, Copy)]
struct RestingLine {
    /// How the skin lay first.
    first: Axis,
    /// The sum of the inverse covariances of its lines, and how many they are.
    information: Matrix2<f64>,
    frames: f64,
    /// The sum of χ² of how far each lay from those before, less what is the skin's, and what that would
    /// be of lines that have nothing in common.
    variance_factor: f64,
    most_scatter: f64,
}

impl RestingLine {
    /// None yet of a finger whose skin lies there.
    fn at(first: Axis) -> Self {
        Self {
            first,
            information: Matrix2::zeros(),
            frames: 0.0,
            variance_factor: 0.0,
            most_scatter: 0.0,
        }
    }

    /// With one more line of such a covariance.
    fn seen(self, covariance: &Matrix2<f64>) -> Option<Self> {
        let information = self.information + covariance.try_inverse()?;
        Some(Self { information, frames: self.frames + 1.0, ..self })
    }

    /// With how far one more lies from what is known, as in [`LineState::covariance`].
    fn with_residual(self, observation: &LineObservation, state: &Matrix2<f64>) -> Option<Self> {
        let inverse = observation.measured.covariance.try_inverse()?;
        let registration_term =
            POSE_TERMS * (inverse * observation.texture_pose.covariance).trace();
        let variance_factor =
            observation.surprise.dot(&(inverse * observation.surprise)) - registration_term;
        let most = 2.0 + (inverse * state).trace() / MOST_OWN_PART;
        Some(Self {
            variance_factor: self.variance_factor + variance_factor,
            most_scatter: self.most_scatter + most,
            ..self
        })
    }

    /// The part of the variance of its lines that is new in each.
    fn own_part(&self) -> f64 {
        if self.variance_factor > 0.0 {
            MOST_OWN_PART.min(self.variance_factor / self.most_scatter)
        } else {
            0.0
        }
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
pub(super) struct BandDimensions {
    pub half_width_px: f64,
    pub taper: f64,
    pub length_px: f64,
}

impl LineFilter {
    pub fn new() -> Self {
        Self { registration: TextureRegistration::empty(), state: None }
    }

    /// Another hand, or the same in another pose: nothing is known of it.
    pub fn forget(&mut self) {
        self.state = None;
    }

    /// The line of a frame, told with what is known from the frames before.
    pub fn follow(
        &mut self,
        image: &GrayView<'_>,
        time_s: f64,
        line: FingerLine,
        shown: &BandDimensions,
    ) -> FingerLine {
        let Some(state) = self.state else {
            self.start(image, time_s, &line, shown);
            return line;
        };
        if let Some(filtered) = self.filtered(image, time_s, line, state) {
            return filtered;
        }
        let missed = state.missed + 1;
        self.state = (missed < MOST_MISSED).then_some(LineState { missed, ..state });
        state.scaled(line)
    }

    fn start(
        &mut self,
        image: &GrayView<'_>,
        time_s: f64,
        line: &FingerLine,
        shown: &BandDimensions,
    ) {
        let BandDimensions { half_width_px, taper, length_px } = *shown;
        let axis = &line.axis;
        let is_seen =
            self.registration.draw(image, axis, half_width_px, taper, TEXTURED_PART * length_px);
        let pose = self.registration.middle_of(axis);
        let covariance = line.expressed_at(&pose).covariance;
        self.state = is_seen.then(|| LineState {
            line: Vector2::zeros(),
            covariance: covariance * MOST_OWN_PART,
            rest: RestingLine::at(pose).seen(&covariance),
            variance_factor: 1.0,
            frames: BELIEVED_FRAMES,
            pose,
            missed: 0,
            time_s,
            half_width_px,
        });
    }

    /// `None` where the skin is not to be seen, or lies where no such line can be.
    fn filtered(
        &mut self,
        image: &GrayView<'_>,
        time_s: f64,
        line: FingerLine,
        state: LineState,
    ) -> Option<FingerLine> {
        let texture_poses = self.registration.find(image, &self.expected(&line, &state), time_s)?;
        let texture_pose = texture_poses.together;
        let (state, travel) = state.carried(&texture_pose, time_s);
        let observation = LineObservation::of(line, &texture_pose, &state, travel)?;
        let (state, filtered) = if let Some(rest) = state.rest {
            state.with_resting_line(&observation, rest)?
        } else {
            state.moved(&observation)?
        };
        self.state = Some(state);
        self.registration.learn(&texture_poses);
        Some(state.scaled(filtered))
    }

    /// Where the skin would lie if this line were right.
    fn expected(&self, line: &FingerLine, state: &LineState) -> Axis {
        let here = line.expressed_at(&self.registration.middle_of(&line.axis)).axis;
        let anchor = here.anchor - here.normal() * state.line.x;
        let ahead_px = (here.tip - here.anchor).norm();
        Axis::of_finger(anchor, here.angle_rad - state.line.y, ahead_px)
    }
}

impl LineState {
    /// After the skin has moved to where it lies now, and by how many half-widths.
    fn carried(self, texture_pose: &TexturePose, time_s: f64) -> (Self, f64) {
        let w = self.half_width_px;
        let travel = (texture_pose.axis.anchor - self.pose.anchor).norm() / w;
        let turned_rad = texture_pose.axis.angle_rad - self.pose.angle_rad;
        let [offset, angle] = drift(travel, time_s - self.time_s, turned_rad);
        let own = Vector2::new(w * w * offset, angle);
        let rests = |rest: &RestingLine| {
            (texture_pose.axis.anchor - rest.first.anchor).norm() < ONE_LOOK_WIDTHS * w
        };
        let rest = self.rest.filter(rests);
        let left = self.rest.filter(|_| rest.is_none());
        let covariance =
            left.and_then(|rest| rest.whole(&self.covariance)).unwrap_or(self.covariance);
        let carried = Self {
            covariance: covariance + Matrix2::from_diagonal(&own),
            rest,
            pose: texture_pose.axis,
            missed: 0,
            time_s,
            ..self
        };
        (carried, travel)
    }

    /// With another frame of a finger that rests, and the line of all of them.
    fn with_resting_line(
        self,
        observation: &LineObservation,
        rest: RestingLine,
    ) -> Option<(Self, FingerLine)> {
        let single = observation.measured.covariance;
        let rest = rest.with_residual(observation, &self.covariance)?.seen(&single)?;
        let own_part = rest.own_part();
        let filtered = if own_part > 0.0 {
            let expected =
                self.covariance * (own_part / MOST_OWN_PART) + observation.texture_pose.covariance;
            observation.combined(
                &(expected * observation.inflation),
                &(single * own_part),
                |_| rest.common(),
            )?
        } else {
            observation.line
        };
        let state = self.updated(observation, &(single * MOST_OWN_PART))?;
        Some((Self { rest: Some(rest), ..state }, filtered))
    }

    /// With another frame of a finger that has moved, and the line that counts.
    fn moved(self, observation: &LineObservation) -> Option<(Self, FingerLine)> {
        let with_residual = self.with_residual(observation);
        let common = |covariance: &Matrix2<f64>| {
            Some((observation.measured.covariance - covariance) * COMMON_PART)
        };
        let combined =
            observation.combined(&observation.expected, &observation.filtered, common)?;
        if combined.spread() <= observation.line.spread() {
            return Some((with_residual.updated(observation, &observation.filtered)?, combined));
        }
        Some((with_residual.restarted(observation)?, observation.line))
    }

    /// With what a look tells.
    fn updated(self, observation: &LineObservation, filtered: &Matrix2<f64>) -> Option<Self> {
        let before = self.covariance * observation.inflation;
        let gain = before * (observation.expected + filtered).try_inverse()?;
        let line = self.line + gain * observation.surprise;
        Some(Self { line, covariance: (Matrix2::identity() - gain) * before, ..self })
    }

    /// With how far a look lies from what was known.
    fn with_residual(self, observation: &LineObservation) -> Self {
        let frames = self.frames + observation.freshness;
        let rate = observation.freshness * (1.0 / frames).max(SCATTER_RATE);
        let variance_factor = self.variance_factor
            + rate * (observation.variance_factor.min(0.5 * CHI2_2DOF_99) - self.variance_factor);
        Self { variance_factor, frames, ..self }
    }

    /// A line with the covariance that it has if it scatters as all do.
    fn scaled(&self, line: FingerLine) -> FingerLine {
        FingerLine { covariance: line.covariance * self.variance_factor.max(1.0), ..line }
    }

    /// As a frame alone has it, which may be the first of a finger that rests.
    fn restarted(self, observation: &LineObservation) -> Option<Self> {
        let single = observation.measured.covariance;
        let line = self.line + observation.surprise;
        let rest = Some(RestingLine::at(observation.texture_pose.axis).seen(&single)?);
        Some(Self {
            line,
            covariance: single * MOST_OWN_PART + observation.texture_pose.covariance,
            rest,
            ..self
        })
    }
}

/// A frame's own line beside what is known. Where they contradict each other, all covariances are those
/// of a doubted one.
#[derive(Debug, Clone, Copy)]
struct LineObservation {
    /// As it was measured, and the same told beside the skin.
    line: FingerLine,
    measured: FingerLine,
    texture_pose: TexturePose,
    /// What is known of the line in the skin, and how far the frame's is from there.
    state: Vector2<f64>,
    surprise: Vector2<f64>,
    /// Of the line that is foretold in this image, and of the frame's as one of many that err alike.
    expected: Matrix2<f64>,
    filtered: Matrix2<f64>,
    inflation: f64,
    /// χ² of its difference from what is known per degree of freedom, and how much of it is news, 0–1.
    variance_factor: f64,
    freshness: f64,
}

impl LineObservation {
    /// `None` where they contradict each other altogether; the finger has gone so far since the last
    /// look, in half-widths.
    fn of(
        line: FingerLine,
        texture_pose: &TexturePose,
        state: &LineState,
        travel: f64,
    ) -> Option<Self> {
        let measured = line.expressed_at(&texture_pose.axis);
        let drawn = FingerLine { axis: texture_pose.axis, ..measured };
        let surprise = drawn.difference(&measured.axis) - state.line;
        let correlation = correlation(travel);
        let filtered = measured.covariance * ((1.0 + correlation) / (1.0 - correlation));
        let expected = state.covariance + texture_pose.covariance;
        let apart = (expected + measured.covariance).try_inverse()? * surprise;
        let contradiction = surprise.dot(&((expected + filtered).try_inverse()? * surprise));
        let inflation = (contradiction / CHI2_2DOF_99).max(1.0);
        let with_disagreement =
            |line: FingerLine| FingerLine { covariance: line.covariance * inflation, ..line };
        (contradiction <= OTHER).then_some(Self {
            line: with_disagreement(line),
            measured: with_disagreement(measured),
            texture_pose: *texture_pose,
            state: state.line,
            surprise,
            expected: expected * inflation,
            filtered: filtered * inflation,
            inflation,
            variance_factor: 0.5 * surprise.dot(&apart),
            freshness: 1.0 - correlation,
        })
    }

    /// The line by both, told where the frame's is: these are their covariances, and what they have in
    /// `common` stays.
    fn combined(
        &self,
        expected: &Matrix2<f64>,
        filtered: &Matrix2<f64>,
        common: impl FnOnce(&Matrix2<f64>) -> Option<Matrix2<f64>>,
    ) -> Option<FingerLine> {
        let gain = expected * (expected + filtered).try_inverse()?;
        let covariance = (Matrix2::identity() - gain) * expected;
        let beside = self.state + gain * self.surprise;
        let Axis { anchor, angle_rad, .. } = self.texture_pose.axis;
        let anchor = anchor + self.texture_pose.axis.normal() * beside.x;
        let axis = Axis::of_finger(anchor, angle_rad + beside.y, 0.0);
        let covariance = covariance + common(&covariance)?;
        let filtered = FingerLine { axis, covariance, ..self.line }.expressed_beside(&self.line);
        let tip_px = (self.line.axis.tip - self.line.axis.anchor).dot(&self.line.axis.direction());
        let axis = Axis::of_finger(filtered.axis.anchor, filtered.axis.angle_rad, tip_px);
        Some(FingerLine { axis, stretch: self.line.stretch, ..filtered })
    }
}

/// How the errors of two lines of a finger correlate that has gone so far in between, in half-widths.
pub(super) fn correlation(travel: f64) -> f64 {
    MOST_CORRELATED.min((-travel / FRESH_WIDTHS).exp())
}

#[cfg(test)]
mod tests;
