//! Frames for the benchmarks: a bright pointing hand that moves over a darker table.

#![expect(
    clippy::unwrap_used,
    clippy::missing_panics_doc,
    reason = "a failure of the set-up should stop a benchmark"
)]

mod iteration;
pub mod sequence;

pub use iteration::{Iteration, Tracked, median};

use fingerpost_core::nalgebra::{Point2, Vector2};
use fingerpost_core::track::StartPose;

/// One frame and the pose of the hand in it.
pub struct Scene {
    /// Grey levels, row by row, without padding.
    pub pixels: Vec<u8>,
    /// Width and height in px.
    pub size: [usize; 2],
    /// The finger's pose.
    pub pose: StartPose,
}

/// Frames that show the whole hand at different places. Taken in turn, each is cold in the cache:
/// 64 VGA frames are 20 MB.
#[must_use]
pub fn frames(size: [usize; 2], count: usize) -> Vec<Scene> {
    first_frames(size, count, count)
}

/// The first `count` frames of a closed path of `all`.
fn first_frames(size: [usize; 2], count: usize, all: usize) -> Vec<Scene> {
    (0..count).map(|i| scene(size, i as f64 / all as f64)).collect()
}

/// The hand at a fraction of its closed path; it moves by at most 2 px per 1/64 in a VGA frame.
fn scene(size: [usize; 2], part: f64) -> Scene {
    let [width, height] = size;
    let scale = width as f64 / 640.0;
    let (sin, cos) = (part * std::f64::consts::TAU).sin_cos();
    let tip_px = Point2::new(
        0.5 * width as f64 + 18.0 * scale * cos,
        0.55 * height as f64 + 10.0 * scale * sin,
    );
    let angle_rad = 0.9 + 0.05 * sin;
    let length_px = 80.0 * scale;
    let pose = StartPose { tip_px, angle_rad, length_px };
    let limbs = limbs(&pose);
    let mut noise = 0x2545_F491_4F6C_DD1D_u64;
    let mut pixels = Vec::with_capacity(width * height);
    for y in 0..height {
        for x in 0..width {
            let inside = limbs.iter().map(|l| l.depth(x as f64, y as f64)).fold(f64::MIN, f64::max);
            noise ^= noise << 13;
            noise ^= noise >> 7;
            noise ^= noise << 17;
            let level = 60.0 + 90.0 * (0.5 + inside / 2.0).clamp(0.0, 1.0);
            pixels.push((level + (noise % 9) as f64 - 4.0) as u8);
        }
    }
    Scene { pixels, size, pose }
}

/// A band with round ends.
struct Limb {
    root: Point2<f64>,
    along: Vector2<f64>,
    length: f64,
    half_width: f64,
}

impl Limb {
    /// Distance inside the limb's outline \[px\].
    fn depth(&self, x: f64, y: f64) -> f64 {
        let d = Point2::new(x, y) - self.root;
        let s = d.dot(&self.along).clamp(0.0, self.length);
        self.half_width - (d - self.along * s).norm()
    }
}

/// Finger and thumb, the thumb on the right of the pointing direction.
fn limbs(pose: &StartPose) -> [Limb; 2] {
    let (sin, cos) = pose.angle_rad.sin_cos();
    let e = Vector2::new(cos, sin);
    let (sin, cos) = (pose.angle_rad + 1.3).sin_cos();
    let half_width = 0.115 * pose.length_px;
    let root = pose.tip_px - e * pose.length_px;
    let finger = Limb { root, along: e, length: pose.length_px - half_width, half_width };
    let thumb = Limb {
        root,
        along: Vector2::new(cos, sin),
        length: 0.7 * pose.length_px,
        half_width: 0.1 * pose.length_px,
    };
    [finger, thumb]
}
