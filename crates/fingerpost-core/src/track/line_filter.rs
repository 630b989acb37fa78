//! Kalman filter of the finger line over frames, in the coordinates of the hand's texture.
//!
//! Before wood, the line of one frame is off by half a degree, because some of its edges are the
//! grain's. The next frame's line is off by as much, but differently, because the hand has moved.
//! The registration of the finger's texture ([`TextureRegistration`]) measures how the finger moved
//! and turned in between, so that the lines of all frames can be expressed in the texture's frame.
//! There the axis is constant but for a slow drift ([`drift`]), caused by the hand's rotation in
//! depth and changes of light. A Kalman filter estimates it.
//!
//! The errors of the lines are not independent. While the hand rests, the same grain lies behind
//! it, and the next line repeats the error of the last; the new part of the error grows with the
//! distance travelled. If the errors correlate by ρ from frame to frame, many lines carry the
//! information of independent ones with (1 + ρ) / (1 − ρ) times the variance. A single line with
//! less variance than the filtered one is used as it is: a finger before an even background neither
//! gains nor loses by earlier frames.
//!
//! All frames of a finger at rest count as one measurement. Part of each line's error is common to
//! all of them and remains. The other part is new in every frame: noise decides whether an edge of
//! the clutter is taken for the finger's. That part is averaged away, provided that the
//! registration is more precise than the frame's own line. Its share of the variance is estimated
//! from the scatter of the lines in the texture's frame; lines with a common error do not scatter,
//! and are not averaged.
//!
//! The innovations also give the variance of unit weight, χ² per degree of freedom. As in any
//! least-squares adjustment, all covariances are scaled by it where it exceeds 1.

use super::line::{CHI2_2DOF_99, FingerLine};
use super::registration::{TextureRegistration, drift};
use super::variance_factor::VarianceFactor;
use crate::axis::TexturePose;
use crate::geometry::shape_space::Axis;
use crate::image::gray::GrayView;
use crate::numeric::ablation::{Mechanism, is_off};
use nalgebra::{Matrix2, Vector2};

/// Correlation length of the line's error along the path of the finger \[half-widths\]: the errors
/// of two lines correlate by exp(−distance / this).
const FRESH_WIDTHS: f64 = 0.5;
/// Upper limit of that correlation: the noise of the pixels is always independent.
const MOST_CORRELATED: f64 = 0.98;
/// Part of the variance that remains common to all lines however far the finger moves, such as the
/// effect of a shaded flank.
const COMMON_PART: f64 = 0.15;
/// Validation gate, χ² of the innovation: a line beyond it belongs to another finger.
const OTHER: f64 = 100.0;
/// Distance from the first pose within which a finger is at rest \[half-widths\].
const ONE_LOOK_WIDTHS: f64 = 0.5;
/// Upper limit of the independent part of the variance of a line at rest, the part that is new in
/// every frame.
const MAX_INDEPENDENT_PART: f64 = 0.5;
/// Multiple of the texture pose's covariance in the difference of two lines: it enters once for
/// each.
const POSE_TERMS: f64 = 2.0;
/// Consecutive frames without a valid registration after which the texture is learned anew.
const MOST_MISSED: usize = 5;
/// Part of the template's length that certainly shows the finger's texture.
const TEXTURED_PART: f64 = 0.9;

/// The filter of one hand's line.
#[derive(Debug, Clone)]
pub(super) struct LineFilter {
    registration: TextureRegistration,
    state: Option<LineState>,
}

#[derive(Debug, Clone, Copy)]
struct LineState {
    /// State: the line in the frame of the texture, relative to the axis drawn on it: offset \[px\]
    /// at the texture's middle, and angle \[rad\].
    line: Vector2<f64>,
    /// Its covariance. For a finger at rest: without the error common to all its lines, and with
    /// the independent part at its upper limit, [`MAX_INDEPENDENT_PART`].
    covariance: Matrix2<f64>,
    /// The measurement at rest that it comes from, while the finger rests.
    rest: Option<RestingLine>,
    /// Variance of unit weight of the innovations.
    variance_factor: VarianceFactor,
    /// Last pose of the texture, and its time.
    pose: Axis,
    /// Consecutive frames without a valid registration.
    missed: usize,
    time_s: f64,
    half_width_px: f64,
}

/// The lines of a finger at rest, which count as one measurement.
#[derive(Debug, Clone, Copy)]
struct RestingLine {
    /// First pose of the texture.
    first: Axis,
    /// Sum of the inverse covariances of its lines, and their number.
    information: Matrix2<f64>,
    frames: f64,
    /// Sum over the lines of χ² of the innovation, less the part of the texture pose; and the
    /// expectation of that sum for lines without a common error.
    chi_squared: f64,
    most_chi_squared: f64,
}

impl RestingLine {
    /// No lines yet, of a finger whose texture has this pose.
    fn at(first: Axis) -> Self {
        Self {
            first,
            information: Matrix2::zeros(),
            frames: 0.0,
            chi_squared: 0.0,
            most_chi_squared: 0.0,
        }
    }

    /// With one more line of this covariance; `None` if it is singular.
    fn with_line(self, covariance: &Matrix2<f64>) -> Option<Self> {
        let information = self.information + covariance.try_inverse()?;
        Some(Self { information, frames: self.frames + 1.0, ..self })
    }

    /// With the innovation of one more line; `state` is [`LineState::covariance`].
    fn with_residual(self, observation: &LineObservation, state: &Matrix2<f64>) -> Option<Self> {
        let inverse = observation.measured.covariance.try_inverse()?;
        let registration_term =
            POSE_TERMS * (inverse * observation.texture_pose.covariance).trace();
        let chi_squared =
            observation.innovation.dot(&(inverse * observation.innovation)) - registration_term;
        let most = 2.0 + (inverse * state).trace() / MAX_INDEPENDENT_PART;
        Some(Self {
            chi_squared: self.chi_squared + chi_squared,
            most_chi_squared: self.most_chi_squared + most,
            ..self
        })
    }

    /// The independent part of the variance of its lines, 0 to [`MAX_INDEPENDENT_PART`].
    fn independent_part(&self) -> f64 {
        if self.chi_squared > 0.0 {
            MAX_INDEPENDENT_PART.min(self.chi_squared / self.most_chi_squared)
        } else {
            0.0
        }
    }

    /// Covariance of the combined line: the common part, and the state's covariance, in which the
    /// independent part was at its limit.
    fn combined_covariance(&self, state: &Matrix2<f64>) -> Option<Matrix2<f64>> {
        Some(self.common()? + state * (self.independent_part() / MAX_INDEPENDENT_PART))
    }

    /// Covariance of the error common to its lines.
    fn common(&self) -> Option<Matrix2<f64>> {
        Some(self.information.try_inverse()? * (self.frames * (1.0 - self.independent_part())))
    }
}

/// Dimensions of the finger's template.
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

    /// Discards the state: another hand, or another pose of the same one.
    pub fn forget(&mut self) {
        self.state = None;
    }

    /// The frame's line combined with those of earlier frames.
    pub fn follow(
        &mut self,
        image: &GrayView<'_>,
        time_s: f64,
        line: FingerLine,
        dimensions: &BandDimensions,
    ) -> FingerLine {
        if is_off(Mechanism::LineFilter) {
            return line;
        }
        let Some(state) = self.state else {
            self.start(image, time_s, &line, dimensions);
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
        dimensions: &BandDimensions,
    ) {
        let BandDimensions { half_width_px, taper, length_px } = *dimensions;
        let axis = &line.axis;
        let is_seen =
            self.registration.draw(image, axis, half_width_px, taper, TEXTURED_PART * length_px);
        let pose = self.registration.middle_of(axis);
        let covariance = line.expressed_at(&pose).covariance;
        self.state = is_seen.then(|| LineState {
            line: Vector2::zeros(),
            covariance: covariance * MAX_INDEPENDENT_PART,
            rest: RestingLine::at(pose).with_line(&covariance),
            variance_factor: VarianceFactor::default(),
            pose,
            missed: 0,
            time_s,
            half_width_px,
        });
    }

    /// `None` if the texture is not registered, or the innovation fails the validation gate.
    fn filtered(
        &mut self,
        image: &GrayView<'_>,
        time_s: f64,
        line: FingerLine,
        state: LineState,
    ) -> Option<FingerLine> {
        let texture_poses = self.registration.find(image, &self.expected(&line, &state), time_s)?;
        let texture_pose = texture_poses.together;
        let (state, travel) = state.predicted(&texture_pose, time_s);
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

    /// The texture's pose predicted from the frame's line and the state.
    fn expected(&self, line: &FingerLine, state: &LineState) -> Axis {
        let measured = line.expressed_at(&self.registration.middle_of(&line.axis)).axis;
        let anchor = measured.anchor - measured.normal() * state.line.x;
        let ahead_px = (measured.tip - measured.anchor).norm();
        Axis::of_finger(anchor, measured.angle_rad - state.line.y, ahead_px)
    }
}

impl LineState {
    /// The state predicted for the texture's pose in this frame, and the distance travelled since
    /// the last one \[half-widths\].
    fn predicted(self, texture_pose: &TexturePose, time_s: f64) -> (Self, f64) {
        let w = self.half_width_px;
        let travel = (texture_pose.axis.anchor - self.pose.anchor).norm() / w;
        let turned_rad = texture_pose.axis.angle_rad - self.pose.angle_rad;
        let [offset, angle] = drift(travel, time_s - self.time_s, turned_rad);
        let process_noise = Vector2::new(w * w * offset, angle);
        let is_at_rest = |rest: &RestingLine| {
            (texture_pose.axis.anchor - rest.first.anchor).norm() < ONE_LOOK_WIDTHS * w
        };
        let rest = self.rest.filter(is_at_rest);
        let ended_rest = self.rest.filter(|_| rest.is_none());
        let covariance = ended_rest
            .and_then(|rest| rest.combined_covariance(&self.covariance))
            .unwrap_or(self.covariance);
        let predicted = Self {
            covariance: covariance + Matrix2::from_diagonal(&process_noise),
            rest,
            pose: texture_pose.axis,
            missed: 0,
            time_s,
            ..self
        };
        (predicted, travel)
    }

    /// Update by a frame of a finger at rest: the new state, and the line of all its frames.
    fn with_resting_line(
        self,
        observation: &LineObservation,
        rest: RestingLine,
    ) -> Option<(Self, FingerLine)> {
        let line_covariance = observation.measured.covariance;
        let rest =
            rest.with_residual(observation, &self.covariance)?.with_line(&line_covariance)?;
        let independent_part = rest.independent_part();
        let filtered = if independent_part > 0.0 {
            let expected = self.covariance * (independent_part / MAX_INDEPENDENT_PART)
                + observation.texture_pose.covariance;
            observation.combined(
                &(expected * observation.inflation),
                &(line_covariance * independent_part),
                |_| rest.common(),
            )?
        } else {
            observation.line
        };
        let state = self.updated(observation, &(line_covariance * MAX_INDEPENDENT_PART))?;
        Some((Self { rest: Some(rest), ..state }, filtered))
    }

    /// Update by a frame of a finger that has moved: the new state, and the combined line, or the
    /// frame's own if that has less variance.
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

    /// Kalman update; `filtered` is the covariance of the observation.
    fn updated(self, observation: &LineObservation, filtered: &Matrix2<f64>) -> Option<Self> {
        let predicted = self.covariance * observation.inflation;
        let gain = predicted * (observation.expected + filtered).try_inverse()?;
        let line = self.line + gain * observation.innovation;
        Some(Self { line, covariance: (Matrix2::identity() - gain) * predicted, ..self })
    }

    /// With the variance factor updated by the innovation, whose χ² is limited to its 99 %
    /// quantile.
    fn with_residual(mut self, observation: &LineObservation) -> Self {
        let reduced_chi_squared = observation.reduced_chi_squared.min(0.5 * CHI2_2DOF_99);
        self.variance_factor.learn(reduced_chi_squared, observation.freshness);
        self
    }

    /// A line with its covariance scaled by the variance factor where that exceeds 1.
    fn scaled(&self, line: FingerLine) -> FingerLine {
        FingerLine { covariance: line.covariance * self.variance_factor.inflation(), ..line }
    }

    /// Restarted from the frame's line alone, which may be the first of a finger at rest.
    fn restarted(self, observation: &LineObservation) -> Option<Self> {
        let line_covariance = observation.measured.covariance;
        let line = self.line + observation.innovation;
        let rest =
            Some(RestingLine::at(observation.texture_pose.axis).with_line(&line_covariance)?);
        Some(Self {
            line,
            covariance: line_covariance * MAX_INDEPENDENT_PART
                + observation.texture_pose.covariance,
            rest,
            ..self
        })
    }
}

/// A frame's own line and its innovation. If χ² of the innovation exceeds its 99 % quantile, all
/// covariances are inflated by the ratio.
#[derive(Debug, Clone, Copy)]
struct LineObservation {
    /// The line as measured, and the same expressed at the texture's pose.
    line: FingerLine,
    measured: FingerLine,
    texture_pose: TexturePose,
    /// The state, and the innovation.
    state: Vector2<f64>,
    innovation: Vector2<f64>,
    /// Covariance of the predicted line in this image, and of the frame's line as one of many with
    /// correlated errors, R (1 + ρ) / (1 − ρ).
    expected: Matrix2<f64>,
    filtered: Matrix2<f64>,
    inflation: f64,
    /// χ² of the innovation per degree of freedom, and the part of it that is new, 1 − ρ, 0–1.
    reduced_chi_squared: f64,
    freshness: f64,
}

impl LineObservation {
    /// `None` if the innovation fails the validation gate [`OTHER`]; `travel` is the distance from
    /// the last measurement \[half-widths\].
    fn of(
        line: FingerLine,
        texture_pose: &TexturePose,
        state: &LineState,
        travel: f64,
    ) -> Option<Self> {
        let measured = line.expressed_at(&texture_pose.axis);
        let at_texture = FingerLine { axis: texture_pose.axis, ..measured };
        let innovation = at_texture.difference(&measured.axis) - state.line;
        let correlation = correlation(travel);
        let filtered = measured.covariance * ((1.0 + correlation) / (1.0 - correlation));
        let expected = state.covariance + texture_pose.covariance;
        let weighted_innovation = (expected + measured.covariance).try_inverse()? * innovation;
        let chi_squared = innovation.dot(&((expected + filtered).try_inverse()? * innovation));
        let inflation = (chi_squared / CHI2_2DOF_99).max(1.0);
        let inflated =
            |line: FingerLine| FingerLine { covariance: line.covariance * inflation, ..line };
        (chi_squared <= OTHER).then_some(Self {
            line: inflated(line),
            measured: inflated(measured),
            texture_pose: *texture_pose,
            state: state.line,
            innovation,
            expected: expected * inflation,
            filtered: filtered * inflation,
            inflation,
            reduced_chi_squared: 0.5 * innovation.dot(&weighted_innovation),
            freshness: 1.0 - correlation,
        })
    }

    /// The line combined from the predicted line with covariance `expected` and the frame's with
    /// covariance `filtered`, expressed where the frame's is. `common` gives the covariance of the
    /// error that both share, which is added.
    fn combined(
        &self,
        expected: &Matrix2<f64>,
        filtered: &Matrix2<f64>,
        common: impl FnOnce(&Matrix2<f64>) -> Option<Matrix2<f64>>,
    ) -> Option<FingerLine> {
        let gain = expected * (expected + filtered).try_inverse()?;
        let covariance = (Matrix2::identity() - gain) * expected;
        let updated = self.state + gain * self.innovation;
        let Axis { anchor, angle_rad, .. } = self.texture_pose.axis;
        let anchor = anchor + self.texture_pose.axis.normal() * updated.x;
        let axis = Axis::of_finger(anchor, angle_rad + updated.y, 0.0);
        let covariance = covariance + common(&covariance)?;
        let filtered = FingerLine { axis, covariance, ..self.line }.expressed_beside(&self.line);
        let tip_px = (self.line.axis.tip - self.line.axis.anchor).dot(&self.line.axis.direction());
        let axis = Axis::of_finger(filtered.axis.anchor, filtered.axis.angle_rad, tip_px);
        Some(FingerLine { axis, stretch: self.line.stretch, ..filtered })
    }
}

/// Correlation of the errors of two lines of a finger that moved by `travel` in between
/// \[half-widths\].
pub(super) fn correlation(travel: f64) -> f64 {
    MOST_CORRELATED.min((-travel / FRESH_WIDTHS).exp())
}

#[cfg(test)]
mod tests;
