//! Motion prior: the recent motion of a hand, in addition to the process noise.
//!
//! The process noise of the filter allows a hand to start, stop or reverse in any frame, so that it
//! is not lost when it does. For a hand at rest this admits every edge nearby: a jump costs
//! nothing. The innovations of the last frames determine how likely a jump is. Since the hand may
//! start to move, the penalty on a jump grows only with the logarithm (Student's t, with the scale
//! of the last innovations).
//!
//! Two penalties follow from it. The [ranking penalty](MotionPrior::ranking_penalty) orders the
//! hypotheses of one frame by their distance from the likeliest place. The [placement
//! penalty](MotionPrior::placement_penalty) raises the agreement that is required of the hypothesis
//! selected: it adds to that distance the number of places in which the hand may be, which is
//! nearly the same for all hypotheses of a frame and so does not matter in their order, and it is
//! bounded for a hand that starts to move.
//!
//! The longer a hand is unseen, the more places it may be in, and the more often one of them
//! resembles it by chance. The required fraction of the contour therefore grows as the prior
//! probability of a fit's place falls.

use super::options::MIN_HALF_LENGTH_PX;
use super::stage::Window;
use crate::numeric::ablation::{Mechanism, is_off};
use crate::solve::dynamics::{Expectation, Innovation};

/// Frames over which innovations are averaged.
const FRAMES: f64 = 5.0;
/// Least expected mean square of the innovation, relative to the process noise.
const STILLEST: f64 = 0.01;
/// Components of the innovation: place and angle.
const COMPONENTS: f64 = 3.0;
/// Fraction of frames in which a hand starts, stops or reverses.
const CHANGES: f64 = 0.05;
/// Penalty of one nat of log-odds against a motion, as a fraction of the contour.
const LOG_ODDS_WEIGHT: f64 = 0.05;

/// Mean square of the last innovations, in units of their covariance: 1 for a hand that moves as
/// the process noise states, less for one that is at rest or moves uniformly.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct MotionPrior {
    mean_square: f64,
    frames: f64,
}

impl MotionPrior {
    /// The prior of a hand that has not been tracked yet.
    pub fn unknown() -> Self {
        Self { mean_square: 1.0, frames: 1.0 }
    }

    /// Updates the prior by the normalised square of a frame's innovation.
    pub fn follow(&mut self, normalised_square: Option<f64>) {
        let Some(square) = normalised_square else { return };
        self.frames = (self.frames + 1.0).min(FRAMES);
        self.mean_square += (square / COMPONENTS - self.mean_square) / self.frames;
    }

    /// Expected mean square of the next innovation.
    fn expected(self) -> f64 {
        self.mean_square.clamp(STILLEST, 1.0)
    }

    /// The window of a hand at constant velocity.
    pub fn constant_velocity(self, window: &Window) -> Window {
        let Expectation { vector, covariance } = window.expected;
        let expected = Expectation { vector, covariance: covariance * self.expected() };
        Window { expected, near_px: MIN_HALF_LENGTH_PX, matched_only: true, ..*window }
    }

    /// Additional agreement required of a fit at its place, as a fraction of the contour:
    /// `LOG_ODDS_WEIGHT` × min(o(s), o(1) − ln `CHANGES`), with s the expected mean square, r² the
    /// normalised square per component, n = √det S / `cell`, and the log-odds o(s) = ln max(n
    /// s^(3/2), 1) + ln(1 + r²/s). The first term counts the cells in which the hand may be, the
    /// second is the distance from the likeliest. The hand either continues as before (s) or moves
    /// as the process noise allows (1).
    pub fn placement_penalty(self, innovation: &Innovation<3>, cell: f64) -> f64 {
        if is_off(Mechanism::MotionPrior) {
            return 0.0;
        }
        let places = innovation.covariance.determinant().max(0.0).sqrt() / cell;
        let square = innovation.normalised_square() / COMPONENTS;
        let odds = |expected: f64| {
            (places * expected.powf(0.5 * COMPONENTS)).max(1.0).ln() + (square / expected).ln_1p()
        };
        LOG_ODDS_WEIGHT * odds(self.expected()).min(odds(1.0) - CHANGES.ln())
    }

    /// Reduction of a hypothesis's score by its motion, as a fraction of the contour:
    /// `LOG_ODDS_WEIGHT` × ln(1 + r²/s), with r² and s as in
    /// [`placement_penalty`](Self::placement_penalty).
    pub fn ranking_penalty(self, innovation: &Innovation<3>) -> f64 {
        if is_off(Mechanism::MotionPrior) {
            return 0.0;
        }
        let square = innovation.normalised_square() / (COMPONENTS * self.expected());
        LOG_ODDS_WEIGHT * square.ln_1p()
    }
}

// The motion prior is private to the crate, and is tested against the odds that it represents.
#[cfg(test)]
#[expect(clippy::unwrap_used, reason = "a test may panic")]
mod tests {
    use super::*;
    use crate::solve::dynamics::Dynamics;
    use crate::track::DynamicsOptions;
    use nalgebra::{Matrix3, Vector3};

    const CELL: f64 = 8.0;

    /// Innovation of a hand at rest for 30 frames that is next seen `after_s` later, displaced by
    /// `displacement`.
    fn innovation(after_s: f64, displacement: Vector3<f64>) -> Innovation<3> {
        let covariance = Matrix3::from_diagonal(&Vector3::new(0.25, 0.25, 1e-4));
        let components = DynamicsOptions::default().components(1.0);
        let mut dynamics =
            Dynamics::start(components, 1.0, 0.0, &Vector3::zeros(), &covariance).unwrap();
        for k in 1..30 {
            dynamics.update(0.04 * f64::from(k), &Vector3::zeros(), &covariance).unwrap();
        }
        dynamics.update(29.0 * 0.04 + after_s, &displacement, &covariance).unwrap().unwrap()
    }

    fn resting_prior() -> MotionPrior {
        let mut motion_prior = MotionPrior::unknown();
        (0..20).for_each(|_| motion_prior.follow(Some(0.0)));
        motion_prior
    }

    #[test]
    fn a_hand_at_rest_in_its_place_is_not_improbable() {
        let in_place = innovation(0.04, Vector3::zeros());
        assert!(resting_prior().placement_penalty(&in_place, CELL).abs() < 1e-12);
    }

    #[test]
    fn improbability_grows_with_time_unseen_and_distance() {
        let displacement = Vector3::new(20.0, 0.0, 1.0);
        for motion_prior in [resting_prior(), MotionPrior::unknown()] {
            let placement_penalty = |after_s, part| {
                motion_prior.placement_penalty(&innovation(after_s, displacement * part), CELL)
                    / LOG_ODDS_WEIGHT
            };
            // At the predicted place, but among a growing number of possible ones; a hand at rest
            // keeps its place.
            assert!(placement_penalty(0.8, 0.0) > placement_penalty(0.4, 0.0) + 1.0);
            for after_s in [0.04, 0.12, 0.24] {
                assert!(placement_penalty(after_s, 1.0) > placement_penalty(after_s, 0.5) + 0.5);
                assert!(placement_penalty(after_s, 0.5) > placement_penalty(after_s, 0.0) + 0.3);
            }
        }
    }

    #[test]
    fn the_improbability_of_starting_to_move_is_bounded() {
        let moved = innovation(0.04, Vector3::new(25.0, -20.0, 0.1));
        let excess = resting_prior().placement_penalty(&moved, CELL)
            - MotionPrior::unknown().placement_penalty(&moved, CELL);
        let bound = -LOG_ODDS_WEIGHT * CHANGES.ln();
        assert!((excess - bound).abs() < 1e-12, "{excess}");
    }
}
