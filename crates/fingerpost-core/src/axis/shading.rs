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

#![expect(
    clippy::inline_always,
    reason = "what is inlined into a function with wider instructions is compiled for them"
)]

use crate::geometry::shape_space::Axis;
use crate::image::frame::Frame;
use crate::numeric::simd::{Isa, Work, each};
use nalgebra::{Cholesky, Const, Point2, SMatrix};

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

/// Step of the forward differences of the coefficients in every number of a section.
const DIFFERENCE: f32 = 1e-3;

/// Lanes of a profile: its samples, then one of weight 0.
const LANES: usize = PLACES + 1;
/// Sums over lanes are taken in this many, on every processor.
const SUMS: usize = 8;
type ProfileLanes = [f32; LANES];
type LevelMatrix = SMatrix<f64, LEVELS, CHANNELS>;
type LevelFactor = Cholesky<f64, Const<LEVELS>>;

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

/// Number of unknowns of a section.
const NUMBERS: usize = 4;

/// Normal matrix and gradient of a profile's cost in the numbers of a section: its middle,
/// half-width, light and blur.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct SectionEquations {
    pub matrix: [[f64; NUMBERS]; NUMBERS],
    pub gradient: [f64; NUMBERS],
}

/// The levels across a finger at one place along it.
#[derive(Debug, Clone, Copy)]
pub(super) struct ShadingProfile {
    /// Levels of each channel, times the weights of the samples.
    weighted: [ProfileLanes; CHANNELS],
    channels: usize,
    unit_px: f64,
}

/// The best levels of a section for a profile, and what they leave.
#[derive(Debug, Clone)]
pub(super) struct SectionFit {
    /// Coefficients of each level at every sample, times its weight.
    coefficients: [ProfileLanes; LEVELS],
    /// Factor of the levels' normal matrix; `None` before the first fit.
    factor: Option<LevelFactor>,
    levels: LevelMatrix,
    /// Residuals of the samples, and of the two levels that may not be negative, in units of
    /// [`SCALE_GREY`] and [`DARKER_GREY`].
    residuals: [ProfileLanes; CHANNELS],
    negative: [[f64; 2]; CHANNELS],
    /// Sum of the robust costs √(1 + r²) − 1 of all residuals.
    pub cost: f64,
}

impl SectionFit {
    /// Before the first fit.
    pub fn none() -> Self {
        Self {
            coefficients: [[0.0; LANES]; LEVELS],
            factor: None,
            levels: LevelMatrix::zeros(),
            residuals: [[0.0; LANES]; CHANNELS],
            negative: [[0.0; 2]; CHANNELS],
            cost: 0.0,
        }
    }
}

impl ShadingProfile {
    /// The profile of a frame across an axis, `along` units of `unit_px` ahead of its anchor;
    /// `None` where a sample is outside the image.
    pub fn of(frame: &Frame<'_>, axis: &Axis, along: f64, unit_px: f64) -> Option<Self> {
        let (e, n) = (axis.direction() * unit_px, axis.normal() * unit_px);
        let mut weighted = [[0.0; LANES]; CHANNELS];
        for i in 0..PLACES {
            let mut mean = [0.0; CHANNELS];
            for row in 0..ROWS {
                let p = along + ROW_STEP * (row as f64 - 0.5 * (ROWS - 1) as f64);
                let at = axis.anchor + e * p + n * f64::from(place(i));
                for (mean, level) in mean.iter_mut().zip(levels_at(frame, at)?) {
                    *mean += level / ROWS as f64;
                }
            }
            for (lanes, mean) in weighted.iter_mut().zip(mean) {
                lanes[i] = weight(i) * mean as f32;
            }
        }
        let channels = if frame.colour().is_some() { CHANNELS } else { 1 };
        Some(Self { weighted, channels, unit_px })
    }

    /// Fits the body's levels for a section.
    pub fn fit(&self, section: &Section, fit: &mut SectionFit) {
        Isa::detect().run(FitSection { profile: self, section, fit });
    }

    /// The normal equations at a section, given its fit.
    pub fn normal_equations(&self, section: &Section, fit: &SectionFit) -> SectionEquations {
        let mut equations = SectionEquations::default();
        Isa::detect().run(Linearise { profile: self, section, fit, equations: &mut equations });
        equations
    }
}

/// Position of a sample \[half-widths\].
#[inline(always)]
fn place(i: usize) -> f32 {
    REACH as f32 * (2.0 * i as f32 / (PLACES - 1) as f32 - 1.0)
}

/// Weight of a sample; 0 beyond the last.
#[inline(always)]
fn weight(i: usize) -> f32 {
    if i >= PLACES {
        0.0
    } else if place(i).abs() < NEAR as f32 {
        1.0
    } else {
        FAR_WEIGHT as f32
    }
}

/// The levels of a frame at a point, of all channels if it has colours; `None` outside the image.
fn levels_at(frame: &Frame<'_>, at: Point2<f64>) -> Option<[f64; CHANNELS]> {
    match frame.colour() {
        Some(colour) => colour.sample_f64(at.x, at.y),
        None => Some([frame.image().sample_f64(at.x, at.y)?, 0.0, 0.0]),
    }
}

struct FitSection<'a> {
    profile: &'a ShadingProfile,
    section: &'a Section,
    fit: &'a mut SectionFit,
}

impl Work for FitSection<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { profile, section, fit } = self;
        fit.coefficients = level_coefficients(section, profile.unit_px);
        let mut normal = SMatrix::<f64, LEVELS, LEVELS>::zeros();
        for a in 0..LEVELS {
            for b in 0..=a {
                normal[(a, b)] = dot(&fit.coefficients[a], &fit.coefficients[b]);
            }
            normal[(a, a)] += RIDGE[a];
        }
        let mut right = LevelMatrix::zeros();
        for k in 0..profile.channels {
            for a in 0..LEVELS {
                right[(a, k)] = dot(&fit.coefficients[a], &profile.weighted[k]);
            }
        }
        // The ridge keeps it positive definite for every section.
        fit.factor = Cholesky::new(normal);
        fit.levels =
            fit.factor.as_ref().map_or_else(LevelMatrix::zeros, |factor| factor.solve(&right));
        fit.cost = 0.0;
        for k in 0..profile.channels {
            let estimated = combined(&fit.coefficients, &fit.levels, k);
            let residual =
                |i: usize| (estimated[i] - profile.weighted[k][i]) * (1.0 / SCALE_GREY as f32);
            fit.residuals[k] = each(residual);
            let robust: ProfileLanes = each(|i| {
                let square = fit.residuals[k][i] * fit.residuals[k][i];
                square / (1.0 + (1.0 + square).sqrt())
            });
            fit.cost += sum(&robust);
            for (n, level) in [EVERYWHERE, ONE_SIDE].into_iter().enumerate() {
                let residual = fit.levels[(level, k)].min(0.0) / DARKER_GREY;
                fit.negative[k][n] = residual;
                fit.cost += (1.0 + residual * residual).sqrt() - 1.0;
            }
        }
    }
}

struct Linearise<'a> {
    profile: &'a ShadingProfile,
    section: &'a Section,
    fit: &'a SectionFit,
    equations: &'a mut SectionEquations,
}

impl Work for Linearise<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { profile, section, fit, .. } = self;
        let Some(factor) = &fit.factor else { return };
        let step = f64::from(DIFFERENCE);
        let perturbed = [
            Section { middle: section.middle + step, ..*section },
            Section { half_width: section.half_width + step, ..*section },
            Section { light_rad: section.light_rad + step, ..*section },
            Section { log_blur: section.log_blur + step, ..*section },
        ];
        let mut changes = [[[0.0; LANES]; CHANNELS]; NUMBERS];
        let mut level_changes = [LevelMatrix::zeros(); NUMBERS];
        for (n, perturbed) in perturbed.iter().enumerate() {
            level_changes[n] = self.differentiate(factor, perturbed, &mut changes[n]);
        }
        for k in 0..profile.channels {
            let residuals = &fit.residuals[k];
            let weights: ProfileLanes = each(|i| 1.0 / (1.0 + residuals[i] * residuals[i]).sqrt());
            for (a, change) in changes.iter().enumerate() {
                let weighed: ProfileLanes = each(|i| weights[i] * change[k][i]);
                self.equations.gradient[a] += dot(&weighed, residuals);
                for (b, other) in changes.iter().enumerate() {
                    self.equations.matrix[a][b] += dot(&weighed, &other[k]);
                }
            }
            for (n, level) in [EVERYWHERE, ONE_SIDE].into_iter().enumerate() {
                let change = level_changes.each_ref().map(|l| l[(level, k)] / DARKER_GREY);
                self.equations.add_penalty(fit.negative[k][n], change);
            }
        }
    }
}

impl Linearise<'_> {
    /// The change of the best levels with one number of the section, and, written to `changes`,
    /// those of the residuals of every channel. With coefficients A and residuals r = A l − y of
    /// the levels l = N⁻¹ Aᵀ y: l' = −N⁻¹ (A'ᵀ r + Aᵀ A' l) and r' = A' l + A l'.
    #[inline(always)]
    fn differentiate(
        &self,
        factor: &LevelFactor,
        perturbed: &Section,
        changes: &mut [ProfileLanes; CHANNELS],
    ) -> LevelMatrix {
        let (fit, by) = (self.fit, &self.fit.coefficients);
        let moved = level_coefficients(perturbed, self.profile.unit_px);
        let slopes: [ProfileLanes; LEVELS] =
            each(|a| each(|i| (moved[a][i] - by[a][i]) * (1.0 / DIFFERENCE)));
        let mut level_changes = LevelMatrix::zeros();
        let channels = changes.iter_mut().enumerate().take(self.profile.channels);
        for (k, change) in channels {
            *change = combined(&slopes, &fit.levels, k);
            for a in 0..LEVELS {
                let residual = SCALE_GREY * dot(&slopes[a], &fit.residuals[k]);
                level_changes[(a, k)] = -(residual + dot(&by[a], change));
            }
        }
        factor.solve_mut(&mut level_changes);
        let channels = changes.iter_mut().enumerate().take(self.profile.channels);
        for (k, change) in channels {
            let indirect = combined(by, &level_changes, k);
            *change = each(|i| (change[i] + indirect[i]) * (1.0 / SCALE_GREY as f32));
        }
        level_changes
    }
}

impl SectionEquations {
    /// Adds the penalty on one level, by its residual and the change of that.
    #[inline(always)]
    fn add_penalty(&mut self, residual: f64, change: [f64; NUMBERS]) {
        if residual == 0.0 {
            return;
        }
        let weight = 1.0 / (1.0 + residual * residual).sqrt();
        for a in 0..NUMBERS {
            self.gradient[a] += weight * change[a] * residual;
            for b in 0..NUMBERS {
                self.matrix[a][b] += weight * change[a] * change[b];
            }
        }
    }
}

/// Coefficients of each level at every sample of a section, times the sample's weight.
#[inline(always)]
fn level_coefficients(section: &Section, unit_px: f64) -> [ProfileLanes; LEVELS] {
    let per_blur = (unit_px / section.log_blur.exp()) as f32;
    let (sin, cos) = section.light_rad.sin_cos();
    let (sin, cos) = (sin as f32, cos as f32);
    let (middle, half_width) = (section.middle as f32, section.half_width as f32);
    let per_width = 1.0 / half_width;
    let mut coefficients = [[0.0; LANES]; LEVELS];
    let lateral: ProfileLanes = each(|i| place(i) - middle);
    let weights: ProfileLanes = each(weight);
    for i in 0..LANES {
        let (q, weight) = (lateral[i], weights[i]);
        let left = weight * (1.0 - step((q + half_width) * per_blur));
        let right = weight * (1.0 - step((half_width - q) * per_blur));
        let inside = weight * step((q + half_width) * per_blur) * step((half_width - q) * per_blur);
        let y = (q * per_width).clamp(-1.0, 1.0);
        let z = (1.0 - y * y).sqrt();
        let facing = y * sin + z * cos;
        let soft = TERMINATOR as f32 * TERMINATOR as f32;
        let lit = 0.5 * (facing + (facing * facing + soft).sqrt());
        coefficients[0][i] = inside;
        coefficients[1][i] = inside * lit;
        coefficients[2][i] = inside * y;
        coefficients[3][i] = inside * z;
        coefficients[4][i] = left;
        coefficients[5][i] = right;
        coefficients[6][i] = left * (q + half_width) * (1.0 / SLOPE as f32);
        coefficients[7][i] = right * (q - half_width) * (1.0 / SLOPE as f32);
    }
    coefficients
}

/// A blurred step: the logistic function 1 / (1 + exp(−1.702 x)), which is the normal distribution
/// function to within 0.01, with exp(−t) as (1 + t / 16 + t² / 512)⁻¹⁶.
#[inline(always)]
fn step(x: f32) -> f32 {
    let t = 1.702 * x.abs();
    let mut power = 1.0 + t * (1.0 / 16.0 + t * (1.0 / 512.0));
    for _ in 0..4 {
        power *= power;
    }
    let tail = 1.0 / (1.0 + power);
    if x > 0.0 { 1.0 - tail } else { tail }
}

/// The levels at every sample of one channel, times its weight.
#[inline(always)]
fn combined(
    coefficients: &[ProfileLanes; LEVELS],
    levels: &LevelMatrix,
    channel: usize,
) -> ProfileLanes {
    let mut lanes = [0.0; LANES];
    for (by, level) in coefficients.iter().zip(levels.column(channel).iter()) {
        let level = *level as f32;
        for (out, by) in lanes.iter_mut().zip(by) {
            *out += by * level;
        }
    }
    lanes
}

/// The sum of the products of all lanes.
#[inline(always)]
fn dot(one: &ProfileLanes, other: &ProfileLanes) -> f64 {
    let mut sums = [0.0; SUMS];
    for (some, others) in one.chunks_exact(SUMS).zip(other.chunks_exact(SUMS)) {
        for ((sum, a), b) in sums.iter_mut().zip(some).zip(others) {
            *sum += a * b;
        }
    }
    total(sums)
}

/// The sum of all lanes.
#[inline(always)]
fn sum(lanes: &ProfileLanes) -> f64 {
    let mut sums = [0.0; SUMS];
    for some in lanes.chunks_exact(SUMS) {
        for (sum, lane) in sums.iter_mut().zip(some) {
            *sum += lane;
        }
    }
    total(sums)
}

/// The sum of partial sums, in pairs, as vector instructions add halves.
#[inline(always)]
fn total([a, b, c, d, e, f, g, h]: [f32; SUMS]) -> f64 {
    f64::from(((a + e) + (c + g)) + ((b + f) + (d + h)))
}
