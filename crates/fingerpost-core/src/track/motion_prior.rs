//! How a hand has moved lately, beside what a hand may do at any time.
//!
//! The filter's process noise allows for a hand that starts, stops or turns round in any frame, so
//! that it is not lost when it does. To a hand at rest that leaves room for every edge nearby: a jump
//! costs it nothing. What it did in the last frames tells how likely a jump is. It may start to move
//! all the same, so that what is unlikely costs with the logarithm alone (Student's t, whose scale
//! the last innovations give).
//!
//! The longer a hand was not seen, the more places it may be in, and the more often one of them shows
//! by chance what looks like it: a fit is asked to explain the more of the contour, the less likely its
//! place was beforehand.

use super::options::MIN_HALF_LENGTH_PX;
use super::stage::Window;
use crate::solve::dynamics::{Expectation, Innovation};

/// Innovations of so many frames tell how a hand moves.
const FRAMES: f64 = 5.0;
/// However still it keeps, its innovation is expected to be this part of what the process noise
/// says, in squares.
const STILLEST: f64 = 0.01;
/// Place and angle.
const COMPONENTS: f64 = 3.0;
/// A hand starts, stops or turns round in this part of all frames.
const CHANGES: f64 = 0.05;
/// What an e-fold of surprise costs, in parts of the contour explained.
const SURPRISE_WEIGHT: f64 = 0.05;

/// The mean square of the last innovations, in units of their covariance: 1 for a hand that moves as
/// its process noise says, less for one that keeps still or moves steadily.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct MotionPrior {
    mean_square: f64,
    frames: f64,
}

impl MotionPrior {
    /// Of a hand that has not been followed yet.
    pub fn unknown() -> Self {
        Self { mean_square: 1.0, frames: 1.0 }
    }

    /// Takes over the innovation of a frame, as a normalised square.
    pub fn follow(&mut self, normalised_square: Option<f64>) {
        let Some(square) = normalised_square else { return };
        self.frames = (self.frames + 1.0).min(FRAMES);
        self.mean_square += (square / COMPONENTS - self.mean_square) / self.frames;
    }

    /// What is expected of the next innovation's mean square.
    fn expected(self) -> f64 {
        self.mean_square.clamp(STILLEST, 1.0)
    }

    /// Where a hand is that goes on as it did.
    pub fn constant_velocity(self, window: &Window) -> Window {
        let Expectation { vector, covariance } = window.expected;
        let expected = Expectation { vector, covariance: covariance * self.expected() };
        Window { expected, near_px: MIN_HALF_LENGTH_PX, own_only: true, ..*window }
    }

    /// What tells against a fit beside those to anything else, in parts of the contour explained: the
    /// hand may be in so many places, each as large as a `cell`, and this is not the likeliest, whether
    /// it goes on as it did or as it may at any time. It is the logarithm of the odds before the contour
    /// is looked at.
    pub fn unlikely(self, innovation: &Innovation<3>, cell: f64) -> f64 {
        let places = innovation.covariance.determinant().max(0.0).sqrt() / cell;
        let square = innovation.normalised_square() / COMPONENTS;
        let odds = |expected: f64| {
            (places * expected.powf(0.5 * COMPONENTS)).max(1.0).ln() + (square / expected).ln_1p()
        };
        SURPRISE_WEIGHT * odds(self.expected()).min(odds(1.0) - CHANGES.ln())
    }

    /// What an innovation costs, in parts of the contour explained.
    pub fn cost(self, innovation: &Innovation<3>) -> f64 {
        let square = innovation.normalised_square() / (COMPONENTS * self.expected());
        SURPRISE_WEIGHT * square.ln_1p()
    }
}

// The pace is private to the crate, and what it must agree with are the odds it stands for.
#[cfg(test)]
#[expect(clippy::unwrap_used, reason = "a test may panic")]
mod tests {
    use super::*;
    use crate::solve::dynamics::Dynamics;
    use crate::track::DynamicsOptions;
    use nalgebra::{Matrix3, Vector3};

    const CELL: f64 = 8.0;

    /// A hand that has kept still for long is next seen so much later, so far off.
    fn innovation(after_s: f64, off: Vector3<f64>) -> Innovation<3> {
        let seen = Matrix3::from_diagonal(&Vector3::new(0.25, 0.25, 1e-4));
        let components = DynamicsOptions::default().components(1.0);
        let mut dynamics = Dynamics::start(components, 1.0, 0.0, &Vector3::zeros(), &seen).unwrap();
        for k in 1..30 {
            dynamics.update(0.04 * f64::from(k), &Vector3::zeros(), &seen).unwrap();
        }
        dynamics.update(29.0 * 0.04 + after_s, &off, &seen).unwrap().unwrap()
    }

    fn still() -> MotionPrior {
        let mut motion_prior = MotionPrior::unknown();
        (0..20).for_each(|_| motion_prior.follow(Some(0.0)));
        motion_prior
    }

    #[test]
    fn a_hand_where_it_was_is_as_likely_as_it_can_be() {
        let here = innovation(0.04, Vector3::zeros());
        assert!(still().unlikely(&here, CELL).abs() < 1e-12);
    }

    #[test]
    fn the_longer_unseen_and_the_farther_off_the_less_likely() {
        let turned = Vector3::new(20.0, 0.0, 1.0);
        for motion_prior in [still(), MotionPrior::unknown()] {
            let unlikely = |after_s, part| {
                motion_prior.unlikely(&innovation(after_s, turned * part), CELL) / SURPRISE_WEIGHT
            };
            // Where it is foretold, but among more and more places; a hand at rest is in its own.
            assert!(unlikely(0.8, 0.0) > unlikely(0.4, 0.0) + 1.0);
            for after_s in [0.04, 0.12, 0.24] {
                assert!(unlikely(after_s, 1.0) > unlikely(after_s, 0.5) + 0.5);
                assert!(unlikely(after_s, 0.5) > unlikely(after_s, 0.0) + 0.3);
            }
        }
    }

    #[test]
    fn a_hand_at_rest_may_start_to_move() {
        let gone = innovation(0.04, Vector3::new(25.0, -20.0, 0.1));
        let more = still().unlikely(&gone, CELL) - MotionPrior::unknown().unlikely(&gone, CELL);
        let most = -SURPRISE_WEIGHT * CHANGES.ln();
        assert!((more - most).abs() < 1e-12, "{more}");
    }
}
