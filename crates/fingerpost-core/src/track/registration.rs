//! Pose of a finger, by registration of its own texture and of its hand's.
//!
//! A finger is slim: image noise turns the pose of its [`TexturePatch`] by a tenth or two of a
//! degree, independently in every frame. Its hand is larger and turns with it, but not exactly: as
//! both rotate in depth they drift apart in the image by an unknown angle. Therefore the hand's
//! registration gives the finger's rotation since the last frame, and the finger's gives the mean
//! angle between the two over many frames: a Kalman filter of an angle that drifts as lines do on a
//! hand ([`drift`]). On 14 films of rendered hands the angle's scatter from frame to frame falls
//! from 0.15° to 0.12°, before wood from 0.23° to 0.15°.

use crate::axis::{Area, TexturePatch, TexturePose};
use crate::geometry::shape_space::Axis;
use crate::image::gray::GrayView;
use nalgebra::Point2;

/// Process noise of a line on a hand: variance of the offset \[half-widths²\] and of the angle
/// \[rad²\] for every half-width of motion and for every second; in addition of the angle for every
/// rad² of rotation.
const DRIFT_PER_WIDTH: [f64; 2] = [5e-5, 2e-6];
const DRIFT_PER_S: [f64; 2] = [1e-4, 4e-6];
const DRIFT_PER_TURN: f64 = 2.5e-3;
/// Validation gate of the angle between finger and hand, innovation squared in units of its
/// variance: beyond it the hand has opened or closed, and the filter restarts.
const OTHER: f64 = 12.0;
/// Variance of the finger's own angle \[rad²\] below which the hand is not registered: the angle
/// between the two drifts by as much from frame to frame.
const SURE: f64 = 2e-6;
/// Ratio of the variance of the hand's angle to that of the finger's from which the hand is not
/// used.
const UNSURE: f64 = 4.0;

/// Drift of lines on a hand that has moved by `travel` \[half-widths\] and turned by `turned_rad`
/// in `passed_s`: variances of the offset \[half-widths²\] and of the angle \[rad²\]. A negative
/// time counts as 0.
pub(super) fn drift(travel: f64, passed_s: f64, turned_rad: f64) -> [f64; 2] {
    let [offset, angle] =
        [0, 1].map(|k| DRIFT_PER_WIDTH[k] * travel + DRIFT_PER_S[k] * passed_s.max(0.0));
    [offset, angle + DRIFT_PER_TURN * turned_rad.sin().powi(2)]
}

/// The texture patches of a finger and of its hand, learned frame by frame.
#[derive(Debug, Clone)]
pub(super) struct TextureRegistration {
    finger: TexturePatch,
    hand: TexturePatch,
    half_width_px: f64,
    turn: Option<HeadingFilter>,
}

/// Kalman filter of the angle between the finger's texture and the hand's.
#[derive(Debug, Clone, Copy)]
struct HeadingFilter {
    angle_rad: f64,
    /// Its variance \[rad²\].
    variance: f64,
    /// Position of the finger, angle of the hand, and time at the last update.
    place: Point2<f64>,
    hand_rad: f64,
    time_s: f64,
}

/// Poses of both in a frame.
#[derive(Debug, Clone, Copy)]
pub(super) struct TexturePoses {
    /// The finger's pose from both.
    pub together: TexturePose,
    finger: TexturePose,
    hand: Option<TexturePose>,
}

impl TextureRegistration {
    /// No textures yet.
    pub fn empty() -> Self {
        let [finger, hand] = [Area::Finger, Area::Hand].map(TexturePatch::empty);
        Self { finger, hand, half_width_px: 1.0, turn: None }
    }

    /// Draws an axis on both, as [`TexturePatch::draw`] does; returns whether the image shows
    /// enough texture of the finger.
    pub fn draw(
        &mut self,
        image: &GrayView<'_>,
        axis: &Axis,
        half_width_px: f64,
        taper: f64,
        length_px: f64,
    ) -> bool {
        (self.half_width_px, self.turn) = (half_width_px, None);
        // Without texture of the hand here, later frames do not find it either.
        self.hand.draw(image, axis, half_width_px, taper, length_px);
        self.finger.draw(image, axis, half_width_px, taper, length_px)
    }

    /// An axis expressed at the middle of the finger's texture.
    pub fn middle_of(&self, axis: &Axis) -> Axis {
        self.finger.middle_of(axis)
    }

    /// The finger's pose in an image, searched near an axis; `None` where its texture is not found.
    pub fn find(&mut self, image: &GrayView<'_>, near: &Axis, time_s: f64) -> Option<TexturePoses> {
        let finger = self.finger.find(image, near)?;
        let is_sure = finger.covariance[(1, 1)] < SURE;
        let near = self.predicted_hand(&finger.axis);
        let hand = if is_sure { None } else { self.hand.find(image, &near) };
        let together = hand.map_or(finger, |hand| self.combined_pose(&finger, &hand, time_s));
        Some(TexturePoses { together, finger, hand })
    }

    /// Learns the textures of the frame in which they were last found.
    pub fn learn(&mut self, texture_poses: &TexturePoses) {
        self.finger.learn(&texture_poses.finger);
        if let Some(hand) = &texture_poses.hand {
            self.hand.learn(hand);
        }
    }

    /// The hand's predicted pose, given the finger's.
    fn predicted_hand(&self, finger: &Axis) -> Axis {
        let angle_rad = finger.angle_rad - self.turn.map_or(0.0, |turn| turn.angle_rad);
        Axis::of_finger(finger.anchor, angle_rad, (finger.tip - finger.anchor).norm())
    }

    /// The finger's pose from both registrations; updates the filter of the angle between them.
    fn combined_pose(
        &mut self,
        finger: &TexturePose,
        hand: &TexturePose,
        time_s: f64,
    ) -> TexturePose {
        let [finger_variance, hand_variance] =
            [finger, hand].map(|texture_pose| texture_pose.covariance[(1, 1)]);
        let hand_rad = hand.axis.angle_rad;
        let measured = HeadingFilter {
            angle_rad: (finger.axis.angle_rad - hand_rad).sin().asin(),
            variance: finger_variance + hand_variance,
            place: finger.axis.anchor,
            hand_rad,
            time_s,
        };
        let filtered = self.turn.and_then(|turn| turn.with(&measured, self.half_width_px));
        let turn = *self.turn.insert(filtered.unwrap_or(measured));
        if hand_variance >= UNSURE * finger_variance {
            return *finger;
        }
        // The finger is part of the hand: this never increases the variance of its own angle.
        finger.turned_to(
            hand_rad + turn.angle_rad,
            finger_variance.min(turn.variance + hand_variance),
        )
    }
}

impl HeadingFilter {
    /// Update by another frame; `None` if its innovation fails the validation gate.
    fn with(self, measured: &Self, half_width_px: f64) -> Option<Self> {
        let travel = (measured.place - self.place).norm() / half_width_px;
        let turned_rad = measured.hand_rad - self.hand_rad;
        let [_, drift] = drift(travel, measured.time_s - self.time_s, turned_rad);
        let variance = self.variance + drift;
        let (innovation, expected) =
            (measured.angle_rad - self.angle_rad, variance + measured.variance);
        let gain = variance / expected;
        let angle_rad = self.angle_rad + gain * innovation;
        let filtered = Self { angle_rad, variance: (1.0 - gain) * variance, ..*measured };
        (innovation * innovation <= OTHER * expected).then_some(filtered)
    }
}

// The registration is private to the crate; the truth is the rendered pose.
#[cfg(test)]
mod tests {
    use super::*;
    use crate::axis::RenderedFinger;

    const FRAMES: usize = 60;

    /// A finger that moves and turns before its hand, and the hand turned relative to it.
    fn rendered(k: usize, hand_rad: f64) -> RenderedFinger {
        let t = k as f64;
        let tip = [118.0 + 6.0 * (0.3 * t).sin(), 78.0 + 4.0 * (0.2 * t).cos()];
        RenderedFinger {
            hand_rad: Some(hand_rad),
            stripes_px: 0.7 * t,
            noise: 5.0,
            spread_px: 1,
            seed: 11 + k as u64,
            ..RenderedFinger::at(tip, 0.4 + 0.05 * (0.25 * t).sin())
        }
    }

    /// Errors of the finger's angle by its own texture and by both, frame by frame.
    fn errors(of: impl Fn(usize) -> RenderedFinger) -> Vec<[f64; 2]> {
        let mut registration = TextureRegistration::empty();
        let first = RenderedFinger { noise: 0.0, ..of(0) };
        assert!(first.show(|image| registration.draw(image, &first.axis(), 8.0, 0.0, 60.0)));
        let mut error = |k: usize| {
            let rendered = of(k);
            let texture_poses =
                rendered.show(|i| registration.find(i, &rendered.axis(), k as f64 / 25.0))?;
            registration.learn(&texture_poses);
            Some(
                [texture_poses.finger, texture_poses.together]
                    .map(|texture_pose| texture_pose.axis.angle_rad - rendered.angle_rad),
            )
        };
        let errors: Vec<_> = (1..FRAMES).filter_map(&mut error).collect();
        assert!(errors.len() > FRAMES - 5, "{}", errors.len());
        errors
    }

    fn rms(errors: &[[f64; 2]], index: usize) -> f64 {
        (errors.iter().map(|e| e[index].powi(2)).sum::<f64>() / errors.len() as f64).sqrt()
    }

    #[test]
    fn the_hand_reduces_the_noise_of_the_fingers_angle() {
        let errors = errors(|k| rendered(k, 0.0));
        let [alone, together] = [0, 1].map(|index| rms(&errors, index));
        assert!(together < 0.7 * alone, "{together} {alone}");
    }

    #[test]
    fn rotation_of_the_hand_alone_hardly_turns_the_finger() {
        // By up to a quarter of a degree from frame to frame, up to 3 degrees either way.
        let turned_rad = |k: usize| 0.06 * (0.08 * k as f64).sin();
        let errors = errors(|k| rendered(k, turned_rad(k)));
        let together = rms(&errors, 1);
        let turned = (0..FRAMES).map(|k| turned_rad(k).powi(2)).sum::<f64>() / FRAMES as f64;
        assert!(together < 0.2 * turned.sqrt(), "{together} of {turned}");
    }

    #[test]
    fn the_filter_restarts_after_the_hand_has_opened() {
        // Turned by 6 degrees from one frame to the next.
        let errors = errors(|k| rendered(k, if k < 30 { 0.0 } else { 0.1 }));
        assert!(errors.iter().all(|e| e[1].abs() < 0.02), "{errors:?}");
    }

    #[test]
    fn without_a_hand_in_the_image_the_pose_is_that_of_the_fingers_texture() {
        // The image ends behind the finger.
        let at = |k: usize| RenderedFinger {
            noise: 2.0,
            seed: 3 + k as u64,
            ..RenderedFinger::at([60.0, 60.0], 0.0)
        };
        let errors = errors(at);
        assert!(errors.iter().all(|[alone, together]| alone.to_bits() == together.to_bits()));
    }

    #[test]
    fn drift_grows_with_distance_time_and_rotation_of_either_sign() {
        let [offset, angle] = drift(2.0, 0.5, -0.1);
        assert!((offset - (2.0 * 5e-5 + 0.5 * 1e-4)).abs() < 1e-12);
        assert!((angle - (2.0 * 2e-6 + 0.5 * 4e-6 + 2.5e-3 * 0.1_f64.sin().powi(2))).abs() < 1e-12);
        assert_eq!(drift(2.0, 0.5, 0.1).map(f64::to_bits), [offset, angle].map(f64::to_bits));
        // Frames may come in the wrong order.
        assert!(drift(0.0, -1.0, 0.0).iter().all(|variance| variance.abs() < 1e-300));
    }
}
