//! *Tracking*: where the hand is foretold to be, what is found there, and whether that is the hand.

use super::acquire::LOST_REACH;
use super::choose::Sought;
use super::convergence::Window;
use super::found::Found;
use super::hand::Hand;
use super::options::{AcceptOptions, TrackOptions};
use super::pace::Pace;
use super::scene::Scene;
use super::track::{Track, track};
use super::verdict::{Known, Motion, Refusal};
use super::{ContourTracker, Phase, Status};
use crate::Result;
use crate::dynamics::{Dynamics, Innovation, Prediction};
use nalgebra::{Matrix3, Vector3};

/// What a fit's covariance does not know of: how far the template slides on a hand that is not
/// quite like it, standard deviations of (c_u, c_v, θ) \[px, px, rad\].
const MISFIT_SIGMAS: [f64; 3] = [0.5, 0.5, 0.01];
/// A finger that is moved this way and that by this part of its length, and turned by as much, is in
/// another place.
const PLACE_PART: f64 = 1.0 / 8.0;
/// A hand whose finger is bent in more frames in a row than this is lost.
const MOST_BENT_FRAMES: usize = 30;

/// What the last frames foretell of the next one.
#[derive(Debug, Clone, Copy)]
pub(super) struct Foretold {
    pub(super) dynamics: Dynamics<3>,
    pub(super) time_s: f64,
    pub(super) window: Window,
}

impl Foretold {
    /// The same, if what covers the tip may have pushed the finger back along itself by so much \[px\].
    pub(super) fn pushed(mut self, by_px: f64) -> Self {
        let (sin, cos) = self.window.expected.vector[2].sin_cos();
        let by = Vector3::new(by_px * cos, by_px * sin, 0.0);
        self.dynamics = self.dynamics.unsure(&by);
        self.window.expected.covariance += by * by.transpose();
        self
    }

    /// The filter after a fit, and the innovation; None without a fit.
    pub(super) fn followed(
        &self,
        found: &Found,
    ) -> Result<Option<(Dynamics<3>, Option<Innovation<3>>)>> {
        let Some(fit) = found.fit else { return Ok(None) };
        let seen = fit.shape.covariance.fixed_view::<3, 3>(0, 0) + misfit();
        let mut dynamics = self.dynamics;
        let innovation = dynamics.update(self.time_s, &found.shape.placement(), &seen)?;
        Ok(Some((dynamics, innovation)))
    }
}

pub(super) fn misfit() -> Matrix3<f64> {
    Matrix3::from_diagonal(&Vector3::from(MISFIT_SIGMAS.map(|s| s * s)))
}

impl ContourTracker {
    /// One frame of tracking. A hand that was not seen for long is not followed but found again.
    pub(super) fn follow(
        &mut self,
        frame: &Scene<'_>,
        time_s: f64,
        missed: usize,
    ) -> Result<Track> {
        let TrackOptions { half_length_px, accept, lose_after_frames, .. } = self.options.track;
        let from = self.hand.shape;
        let Some(foretold) = self.foretell(time_s)? else {
            return self.recover(frame, time_s, 0, self.hand.remembered(from));
        };
        let expected = foretold.window.expected.vector;
        // It may as well have stopped or turned round, and the longer it is unseen the more it may.
        let went_px = (expected - from.placement()).xy().norm();
        let lately = if self.hand.is_back { LOST_REACH } else { 1.0 };
        let reach_px = self.largeness() * half_length_px * (lately + missed as f64) + went_px;
        let predicted = from.placed(&expected);
        let Sought { found, pushed_px, likeness } =
            self.find(frame, predicted, reach_px, Some(&foretold))?;
        let foretold = foretold.pushed(pushed_px);
        self.hand.note_covered(&found);
        let followed = foretold.followed(&found)?;
        let innovation = followed.as_ref().and_then(|(_, innovation)| innovation.as_ref());
        let known = self.known(&accept, innovation);
        let innovation = innovation.map(Innovation::normalised_square);
        let verdict = known.judge(&found, likeness);
        let min_agreement =
            found.fit.map_or(accept.min_inliers, |fit| known.min_agreement(&fit, likeness));
        let accept = AcceptOptions { min_inliers: min_agreement, ..accept };
        if let (Ok(()), Some((dynamics, _))) = (verdict, followed) {
            let bend = self.bend(frame, &found)?;
            self.hand.posture = self.hand.posture.after(bend.as_ref(), &found);
            self.hand.shape = found.shape;
            self.hand.is_back = false;
            let jumped = innovation.is_some_and(|square| square > self.surprise);
            let before = foretold.dynamics.velocity();
            self.dynamics = Some(if jumped { dynamics.doubting(before) } else { dynamics });
            let mut track = if self.hand.posture.is_bent() {
                self.keep_in_sight(time_s, &found, &accept)
            } else {
                self.hand.bent_frames = 0;
                self.hand.straight_frames += 1;
                self.hand.grow();
                self.hand.count_thumb(&found, lose_after_frames);
                self.hand.count_partly(&found);
                if found.fit.is_some_and(|fit| fit.own_only) {
                    self.learn_behind(frame)?;
                } else {
                    self.take_over_looks(frame, &found)?;
                }
                self.pace.follow(innovation);
                self.hand.learn_usual(&found);
                self.phase = Phase::Tracking { missed: 0 };
                self.tracked(frame, time_s, &found, &accept)?
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
        let mut track = track(time_s, status, &found, &accept, verdict.err());
        track.diagnostics.innovation = innovation;
        Ok(track)
    }

    /// What the hand's motion tells about this frame; nothing after a long gap.
    fn foretell(&self, time_s: f64) -> Result<Option<Foretold>> {
        let Some(dynamics) = self.dynamics else { return Ok(None) };
        Ok(match dynamics.predict(time_s)? {
            Prediction::Expected(expected) => {
                let window =
                    Window { expected, gate: self.gate, near_px: self.near_px(), own_only: false };
                Some(Foretold { dynamics, time_s, window })
            }
            Prediction::Lost { .. } => None,
        })
    }

    /// A bent finger yields no line, but stays in sight, to be followed again when it is straight;
    /// not for longer than it has been straight, for what is bent may be no finger at all.
    fn keep_in_sight(&mut self, time_s: f64, found: &Found, accept: &AcceptOptions) -> Track {
        self.hand.bent_frames += 1;
        // The template slides as the finger bends, and back again.
        self.pace = Pace::unknown();
        let patience = self.hand.straight_frames.min(MOST_BENT_FRAMES);
        let is_over = self.hand.bent_frames > patience;
        self.phase = if is_over {
            Phase::Lost { last: self.hand.remembered(found.shape), settled: 0 }
        } else {
            Phase::Tracking { missed: 0 }
        };
        track(time_s, self.status(), found, accept, Some(Refusal::Misfit))
    }

    /// What a fit of the followed hand is judged by.
    pub(super) fn known(
        &self,
        accept: &AcceptOptions,
        innovation: Option<&Innovation<3>>,
    ) -> Known<'_> {
        let Hand { acquired, .. } = &self.hand;
        let pace = if self.hand.is_known_whole() { self.pace } else { Pace::unknown() };
        let cell = (PLACE_PART * self.hand.measure.length_px).powi(2) * PLACE_PART;
        let motion = innovation.map(|i| Motion::of(i, self.surprise, pace.unlikely(i, cell)));
        let most_scatter_px = self.hand.most_scale_px();
        Known { accept: *accept, acquired, motion, most_scatter_px }
    }
}
