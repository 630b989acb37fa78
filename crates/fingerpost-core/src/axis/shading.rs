//! Profiles of grey levels across a finger, and their residuals against a shaded round body.
//!
//! At y half-widths from its axis a round body has the normal (y, √(1 − y²)) in the cross-section.
//! Under ambient light and a distant light at the angle φ from the line of sight its level is
//!
//! I = a + b max(0, y sin φ + √(1 − y²) cos φ) + c y + e √(1 − y²),
//!
//! between backgrounds that are linear on either side, all of it blurred. The levels are linear
//! parameters and are eliminated for given position, width, light and blur; the residuals are those
//! of the best levels.

use crate::geometry::shape_space::Axis;
use crate::image::frame::Frame;
use nalgebra::{Cholesky, Point2, SMatrix};

/// Number of samples of a profile, and the distance of the outermost from the axis \[half-widths\].
const PLACES: usize = 31;
const REACH: f64 = 2.1;
/// Samples farther out than this have a lower weight: other objects may begin there.
const NEAR: f64 = 1.6;
const FAR_WEIGHT: f64 = 0.3;
/// Number of rows averaged into a profile, and their distance \[half-widths\].
const ROWS: usize = 5;
const ROW_STEP: f64 = 0.18;

/// Grey levels, or three channels.
const CHANNELS: usize = 3;
/// The levels of a body: ambient and directional light; two terms in the normal; the background on
/// either side, and its slopes.
const LEVELS: usize = 8;
const EVERYWHERE: usize = 0;
const ONE_SIDE: usize = 1;
/// Ridge of each level, in units of the square of a level that one pixel carries: the terms in the
/// normal and steep slopes must be supported by many pixels.
const RIDGE: [f64; LEVELS] = [1e-3, 1e-3, 1.0, 1.0, 1e-3, 1e-3, 1.0, 1.0];
/// Distance over which a background slope is one level \[half-widths\].
const SLOPE: f64 = 0.65;
/// Softness of the terminator, in cosines: skin is translucent.
const TERMINATOR: f64 = 0.15;
/// Unit of the residuals \[grey levels\]: the deviation of real fingers from a smooth round body.
const SCALE_GREY: f64 = 3.0;
/// Unit of the penalty on negative levels of ambient and directional light \[grey levels\].
const DARKER_GREY: f64 = 10.0;

/// Per channel the residuals of the pixels, then those of the two levels that may not be negative.
const RESIDUALS: usize = CHANNELS * (PLACES + 2);
pub(super) type Residuals = [f64; RESIDUALS];

/// A cross-section of the body.
#[derive(Debug, Clone, Copy)]
pub(super) struct Section {
    /// Its middle and half-width \[units of the profile\].
    pub middle: f64,
    pub half_width: f64,
    /// Direction of light \[rad\]: 0 from the camera, positive from the side of the normal.
    pub light_rad: f64,
    /// Logarithm of the standard deviation of the blur \[px\].
    pub log_blur: f64,
}

/// The levels across a finger at one place along it.
#[derive(Debug, Clone, Copy)]
pub(super) struct ShadingProfile {
    levels: [[f64; CHANNELS]; PLACES],
    channels: usize,
    unit_px: f64,
}

impl ShadingProfile {
    /// The profile of a frame across an axis, `along` units of `unit_px` ahead of its anchor;
    /// `None` where a sample is outside the image.
    pub fn of(frame: &Frame<'_>, axis: &Axis, along: f64, unit_px: f64) -> Option<Self> {
        let (e, n) = (axis.direction() * unit_px, axis.normal() * unit_px);
        let mut levels = [[0.0; CHANNELS]; PLACES];
        for ((q, _), mean) in places().zip(&mut levels) {
            for row in 0..ROWS {
                let p = along + ROW_STEP * (row as f64 - 0.5 * (ROWS - 1) as f64);
                let sample = levels_at(frame, axis.anchor + e * p + n * q)?;
                for (mean, level) in mean.iter_mut().zip(sample) {
                    *mean += level / ROWS as f64;
                }
            }
        }
        let channels = if frame.colour().is_some() { CHANNELS } else { 1 };
        Some(Self { levels, channels, unit_px })
    }

    /// Residuals against the body's best levels, in units of [`SCALE_GREY`].
    pub fn residuals(&self, section: &Section) -> Residuals {
        let blur = section.log_blur.exp() / self.unit_px;
        let light = section.light_rad.sin_cos();
        let mut parts = [[0.0; LEVELS]; PLACES];
        // The full matrix, though half would do: the compiler vectorises it.
        let mut normal = [[0.0; LEVELS]; LEVELS];
        let mut right = [[0.0; LEVELS]; CHANNELS];
        for (((q, weight), part), levels) in places().zip(&mut parts).zip(&self.levels) {
            let lateral = q - section.middle;
            *part =
                level_coefficients(lateral, section.half_width, light, blur).map(|b| b * weight);
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
        // The ridge keeps it positive definite for every section.
        let Some(factor) = Cholesky::new(normal) else { return residuals };
        let best = factor.solve(&right);
        for k in 0..self.channels {
            let channel_residuals = &mut residuals[k * (PLACES + 2)..(k + 1) * (PLACES + 2)];
            for ((residual, (_, weight)), (part, levels)) in
                channel_residuals.iter_mut().zip(places()).zip(parts.iter().zip(&self.levels))
            {
                let estimated: f64 = part.iter().zip(&best.column(k)).map(|(p, l)| p * l).sum();
                *residual = (estimated - weight * levels[k]) / SCALE_GREY;
            }
            for (residual, level) in
                channel_residuals[PLACES..].iter_mut().zip([EVERYWHERE, ONE_SIDE])
            {
                *residual = best[(level, k)].min(0.0) / DARKER_GREY;
            }
        }
        residuals
    }
}

/// Positions of the samples of a profile, and their weights.
fn places() -> impl Iterator<Item = (f64, f64)> {
    (0..PLACES).map(|i| {
        let q = REACH * (2.0 * i as f64 / (PLACES - 1) as f64 - 1.0);
        (q, if q.abs() < NEAR { 1.0 } else { FAR_WEIGHT })
    })
}

/// The levels of a frame at a point, of all channels if it has colours; `None` outside the image.
fn levels_at(frame: &Frame<'_>, at: Point2<f64>) -> Option<[f64; CHANNELS]> {
    match frame.colour() {
        Some(colour) => colour.sample_f64(at.x, at.y),
        None => Some([frame.image().sample_f64(at.x, at.y)?, 0.0, 0.0]),
    }
}

/// Coefficients of the levels at the distance `lateral` from the middle of a body, for the sine
/// and cosine of the light's angle.
fn level_coefficients(
    lateral: f64,
    half_width: f64,
    (sin, cos): (f64, f64),
    blur: f64,
) -> [f64; LEVELS] {
    let left = 1.0 - step((lateral + half_width) / blur);
    let right = 1.0 - step((half_width - lateral) / blur);
    let inside = (1.0 - left) * (1.0 - right);
    let y = (lateral / half_width).clamp(-1.0, 1.0);
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
        left * (lateral + half_width) / SLOPE,
        right * (lateral - half_width) / SLOPE,
    ]
}

/// A blurred step: the normal distribution function to within 0.01.
fn step(x: f64) -> f64 {
    1.0 / (1.0 + (-1.702 * x).exp())
}
