//! *Tracking*: prediction of the hand's pose, localisation near it, and validation of the fit.

use super::fit_result::{FitResult, Refusal};
use super::hand::Hand;
use super::hypotheses::Selection;
use super::motion_prediction::MotionPrediction;
use super::motion_prior::MotionPrior;
use super::options::{AcceptOptions, TrackOptions};
use super::outcome::{Track, track};
use super::scene::Scene;
use super::stage::Window;
use super::status::Status;
use super::tracker::{ContourTracker, LOST_REACH, Phase};
use super::validation::{InnovationCheck, Validation};
use crate::Result;
use crate::solve::dynamics::{Innovation, Prediction};

/// Cell size of distinct places: this fraction of the finger's length along u and along v, and the
/// same number in radians.
const PLACE_PART: f64 = 1.0 / 8.0;
/// Frames in a row with a bent finger after which the hand is lost.
const MOST_BENT_FRAMES: usize = 30;

impl ContourTracker {
    /// One frame of tracking. After a long gap the hand is not tracked but acquired again.
    pub(super) fn follow(
        &mut self,
        scene: &Scene<'_>,
        time_s: f64,
        missed: usize,
    ) -> Result<Track> {
        let TrackOptions { half_length_px, accept, lose_after_frames, .. } = self.options.track;
        let from = self.hand.shape;
        let Some(prediction) = self.predict_motion(time_s)? else {
            return self.recover(scene, time_s, 0, self.hand.remembered(from));
        };
        let expected = prediction.window.expected.vector;
        // The hand may also have stopped or reversed, and may have done more the longer it is
        // unseen.
        let predicted_motion_px = (expected - from.placement()).xy().norm();
        let reach_factor = if self.hand.is_back { LOST_REACH } else { 1.0 };
        let reach_px = self.largeness() * half_length_px * (reach_factor + missed as f64)
            + predicted_motion_px;
        let predicted = from.placed(&expected);
        let Selection { found, occlusion_shift_px, likeness } =
            self.find(scene, predicted, reach_px, Some(&prediction))?;
        let prediction = prediction.with_occlusion_shift(occlusion_shift_px);
        self.hand.note_covered(&found);
        let followed = prediction.followed(&found)?;
        let innovation = followed.as_ref().and_then(|(_, innovation)| innovation.as_ref());
        let validation = self.validation(&accept, innovation);
        let innovation = innovation.map(Innovation::normalised_square);
        let validity = validation.judge(&found, likeness);
        let min_agreement =
            found.fit.map_or(accept.min_inliers, |fit| validation.min_agreement(&fit, likeness));
        let accept = AcceptOptions { min_inliers: min_agreement, ..accept };
        if let (Ok(()), Some((dynamics, _))) = (validity, followed) {
            let bend = self.bend(scene, &found)?;
            self.hand.bend_state = self.hand.bend_state.after(bend.as_ref(), &found);
            self.hand.shape = found.shape;
            self.hand.is_back = false;
            let is_improbable = innovation.is_some_and(|square| square > self.innovation_gate);
            let before = prediction.dynamics.velocity();
            self.dynamics =
                Some(if is_improbable { dynamics.with_velocity_reset(before) } else { dynamics });
            let mut track = if self.hand.bend_state.is_bent() {
                self.hold_bent(time_s, &found, &accept)
            } else {
                self.hand.bent_frames = 0;
                self.hand.straight_frames += 1;
                self.hand.grow();
                self.hand.count_thumb(&found, lose_after_frames);
                self.hand.count_partly(&found);
                if !found.fit.is_some_and(|fit| fit.matched_only) {
                    self.update_appearance(scene, &found)?;
                }
                self.motion_prior.follow(innovation);
                self.hand.learn_usual(&found);
                self.phase = Phase::Tracking { missed: 0 };
                self.tracked(scene, time_s, &found, &accept)?
            };
            track.diagnostics.innovation = innovation;
            return Ok(track.bent(bend.as_ref()));
        }
        let missed = missed + 1;
        let status = if missed >= lose_after_frames {
            self.phase = Phase::Lost { last: self.hand.remembered(from), settled: 0 };
            Status::Lost
        } else {
            self.phase = Phase::Tracking { missed };
            Status::Tracking
        };
        let mut track = track(time_s, status, &found, &accept, validity.err());
        track.diagnostics.innovation = innovation;
        Ok(track)
    }

    /// The prediction for this frame; `None` before acquisition and after a long gap.
    fn predict_motion(&self, time_s: f64) -> Result<Option<MotionPrediction>> {
        let Some(dynamics) = self.dynamics else { return Ok(None) };
        Ok(match dynamics.predict(time_s)? {
            Prediction::Expected(expected) => {
                let window = Window {
                    expected,
                    gate: self.gate,
                    near_px: self.near_px(),
                    matched_only: false,
                };
                Some(MotionPrediction { dynamics, time_s, window })
            }
            Prediction::Lost { .. } => None,
        })
    }

    /// A bent finger yields no line but stays tracked until it is straight; not for more frames
    /// than it has been straight, since a bent shape may be no finger at all.
    fn hold_bent(&mut self, time_s: f64, found: &FitResult, accept: &AcceptOptions) -> Track {
        self.hand.bent_frames += 1;
        // The template slides as the finger bends, and back again.
        self.motion_prior = MotionPrior::unknown();
        let max_frames = self.hand.straight_frames.min(MOST_BENT_FRAMES);
        let is_over = self.hand.bent_frames > max_frames;
        self.phase = if is_over {
            Phase::Lost { last: self.hand.remembered(found.shape), settled: 0 }
        } else {
            Phase::Tracking { missed: 0 }
        };
        track(time_s, self.status(), found, accept, Some(Refusal::Misfit))
    }

    /// The reference values for validating a fit of the tracked hand.
    pub(super) fn validation(
        &self,
        accept: &AcceptOptions,
        innovation: Option<&Innovation<3>>,
    ) -> Validation<'_> {
        let Hand { acquired, .. } = &self.hand;
        let motion_prior =
            if self.hand.is_known_whole() { self.motion_prior } else { MotionPrior::unknown() };
        let cell = (PLACE_PART * self.hand.measure.length_px).powi(2) * PLACE_PART;
        let innovation = innovation.map(|i| {
            InnovationCheck::of(i, self.innovation_gate, motion_prior.placement_penalty(i, cell))
        });
        let most_scatter_px = self.hand.max_scale_px();
        Validation { accept: *accept, acquired, innovation, most_scatter_px }
    }
}
