//! The levels across a finger, and how they differ from those across a shaded round body.
//!
//! At y half-widths from its axis a round body has the normal (y, √(1 − y²)) in the plane across it.
//! Under a distant light at the angle φ from the line of sight, beside light from everywhere, it shows
//!
//! I = a + b max(0, y sin φ + √(1 − y²) cos φ) + c y + e √(1 − y²),
//!
//! between a background that is linear on either side, all of it blurred. Levels are linear, and are
//! solved for whatever the body's place, width, light and blur are: what is left are the residuals of
//! the levels that explain the profile best.

use crate::geometry::shape_space::Axis;
use crate::image::frame::Frame;
use nalgebra::{Cholesky, Point2, SMatrix};

/// Places of a profile, and how far off the axis the outermost are \[half-widths\].
const PLACES: usize = 31;
const REACH: f64 = 2.1;
/// Farther out something else begins soon: what is seen there counts less.
const NEAR: f64 = 1.6;
const FAR_WEIGHT: f64 = 0.3;
/// Rows that a profile is the mean of, and how far apart they are \[half-widths\].
const ROWS: usize = 5;
const ROW_STEP: f64 = 0.18;

/// Grey levels, or three channels.
const CHANNELS: usize = 3;
/// The levels of a body: light from everywhere, and from one side; what of the first depends on the
/// normal; the background on either side, and its slopes.
const LEVELS: usize = 8;
const EVERYWHERE: usize = 0;
const ONE_SIDE: usize = 1;
/// What holds each of them near to zero, in squares of a level that one pixel has: little of what
/// depends on the normal and slopes that are steep are told by many pixels or not at all.
const RIDGE: [f64; LEVELS] = [1e-3, 1e-3, 1.0, 1.0, 1e-3, 1e-3, 1.0, 1.0];
/// Slopes are changes of level over so many half-widths.
const SLOPE: f64 = 0.65;
/// How softly light ends where a surface turns from it, in cosines: skin lets some through.
const TERMINATOR: f64 = 0.15;
/// Residuals are in parts of this \[grey levels\]: bodies are no rounder, and no smoother.
const SCALE_GREY: f64 = 3.0;
/// What is darker than without light costs in parts of this \[grey levels\].
const DARKER_GREY: f64 = 10.0;

/// Those of the pixels, then those of the levels that may not be negative.
const RESIDUALS: usize = CHANNELS * (PLACES + 2);
pub(super) type Residuals = [f64; RESIDUALS];

/// A body across one place of the finger.
#[derive(Debug, Clone, Copy)]
pub(super) struct Section {
    /// Its middle and half its width \[units of the profile\].
    pub middle: f64,
    pub half_width: f64,
    /// Where light comes from \[rad\], 0 from where it is seen, positive from the side of the normal.
    pub light_rad: f64,
    /// Logarithm of the standard deviation of the blur \[px\].
    pub log_blur: f64,
}

/// The levels across a finger at one place along it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Profile {
    levels: [[f64; CHANNELS]; PLACES],
    channels: usize,
    unit_px: f64,
}

impl Profile {
    /// What a frame shows across an axis, `along` units of `unit_px` ahead of its anchor; `None` where
    /// that is not all in the picture.
    pub fn of(frame: &Frame<'_>, axis: &Axis, along: f64, unit_px: f64) -> Option<Self> {
        let (e, n) = (axis.direction() * unit_px, axis.normal() * unit_px);
        let mut levels = [[0.0; CHANNELS]; PLACES];
        for ((q, _), mean) in places().zip(&mut levels) {
            for row in 0..ROWS {
                let p = along + ROW_STEP * (row as f64 - 0.5 * (ROWS - 1) as f64);
                let seen = shown(frame, axis.anchor + e * p + n * q)?;
                for (mean, level) in mean.iter_mut().zip(seen) {
                    *mean += level / ROWS as f64;
                }
            }
        }
        let channels = if frame.colour().is_some() { CHANNELS } else { 1 };
        Some(Self { levels, channels, unit_px })
    }

    /// How it differs from the levels of a body that explain it best, in parts of [`SCALE_GREY`].
    pub fn residuals(&self, section: &Section) -> Residuals {
        let blur = section.log_blur.exp() / self.unit_px;
        let light = section.light_rad.sin_cos();
        let mut parts = [[0.0; LEVELS]; PLACES];
        // Whole rows, though half would do: the compiler makes wide instructions of them.
        let mut normal = [[0.0; LEVELS]; LEVELS];
        let mut right = [[0.0; LEVELS]; CHANNELS];
        for (((q, weight), part), levels) in places().zip(&mut parts).zip(&self.levels) {
            let off = q - section.middle;
            *part = share_of_levels(off, section.half_width, light, blur).map(|b| b * weight);
            for (row, by) in normal.iter_mut().zip(*part) {
                for (sum, share) in row.iter_mut().zip(part.iter()) {
                    *sum += by * share;
                }
            }
            for (row, level) in right.iter_mut().zip(levels).take(self.channels) {
                for (sum, share) in row.iter_mut().zip(part.iter()) {
                    *sum += share * (level * weight);
                }
            }
        }
        let mut normal = SMatrix::from(normal);
        for (k, ridge) in RIDGE.iter().enumerate() {
            normal[(k, k)] += ridge;
        }
        let right = SMatrix::<f64, LEVELS, CHANNELS>::from(right);
        let mut residuals = [0.0; RESIDUALS];
        // The ridge keeps it positive definite, whatever the section.
        let Some(factor) = Cholesky::new(normal) else { return residuals };
        let best = factor.solve(&right);
        for k in 0..self.channels {
            let own = &mut residuals[k * (PLACES + 2)..(k + 1) * (PLACES + 2)];
            for ((residual, (_, weight)), (part, levels)) in
                own.iter_mut().zip(places()).zip(parts.iter().zip(&self.levels))
            {
                let told: f64 = part.iter().zip(&best.column(k)).map(|(p, l)| p * l).sum();
                *residual = (told - weight * levels[k]) / SCALE_GREY;
            }
            for (residual, level) in own[PLACES..].iter_mut().zip([EVERYWHERE, ONE_SIDE]) {
                *residual = best[(level, k)].min(0.0) / DARKER_GREY;
            }
        }
        residuals
    }
}

/// Where the places of a profile are, and how much they count.
fn places() -> impl Iterator<Item = (f64, f64)> {
    (0..PLACES).map(|i| {
        let q = REACH * (2.0 * i as f64 / (PLACES - 1) as f64 - 1.0);
        (q, if q.abs() < NEAR { 1.0 } else { FAR_WEIGHT })
    })
}

/// What a frame shows at a point, its colours if it has any; `None` outside the picture.
fn shown(frame: &Frame<'_>, at: Point2<f64>) -> Option<[f64; CHANNELS]> {
    match frame.colour() {
        Some(colour) => colour.sample_f64(at.x, at.y),
        None => Some([frame.image().sample_f64(at.x, at.y)?, 0.0, 0.0]),
    }
}

/// How much of each level a place shows that lies `off` the middle of a body lit from an angle of that
/// sine and cosine.
fn share_of_levels(off: f64, half_width: f64, (sin, cos): (f64, f64), blur: f64) -> [f64; LEVELS] {
    let left = 1.0 - step((off + half_width) / blur);
    let right = 1.0 - step((half_width - off) / blur);
    let inside = (1.0 - left) * (1.0 - right);
    let y = (off / half_width).clamp(-1.0, 1.0);
    let z = (1.0 - y * y).sqrt();
    let facing = y * sin + z * cos;
    let lit = 0.5 * (facing + (facing * facing + TERMINATOR * TERMINATOR).sqrt());
    [
        inside,
        inside * lit,
        inside * y,
        inside * z,
        left,
        right,
        left * (off + half_width) / SLOPE,
        right * (off - half_width) / SLOPE,
    ]
}

/// A blurred step: the normal distribution function to within 0.01.
fn step(x: f64) -> f64 {
    1.0 / (1.0 + (-1.702 * x).exp())
}
