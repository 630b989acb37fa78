//! The unknowns of the photometric fit, and their map to the features of a block's pixels.

#![expect(
    clippy::inline_always,
    reason = "what is inlined into a function with wider instructions is compiled for them"
)]

use super::finger_estimate::{FingerEstimate, FlankLines, SIDES};
use super::gram::GramEquations;
use super::pixels::{Doubles, LANES, total};
use super::profile::{COLUMNS, EDGE, INSIDE, OUTSIDE, Profile, RAMP, RIGHT};
use crate::axis::{PhotometricOptions, profile};
use crate::numeric::simd::each;
use nalgebra::{SMatrix, SVector};

/// Indices of the unknowns shared by both flanks: the coefficients of 1, p and P₂ of the bisector
/// and of the half-width, the blur, the centre of the round end and its additional abscissa on the
/// right flank, and the changes of the levels along the finger.
pub(super) const OFFSET: usize = 0;
pub(super) const SLOPE: usize = 1;
pub(super) const BEND: usize = 2;
pub(super) const HALF_WIDTH: usize = 3;
pub(super) const TAPER: usize = 4;
pub(super) const BULGE: usize = 5;
pub(super) const BLUR: usize = 6;
const END: usize = 7;
const END_SKEW: usize = 8;
const INSIDE_CHANGE: usize = 9;
const OUTSIDE_CHANGE: usize = 10;
/// Index of the first unknown of the flanks, and their number on one flank: inside level a,
/// background level b, slope c, limb l.
const FLANKS: usize = 11;
const PER_FLANK: usize = 4;

/// Number of unknowns.
pub(super) const UNKNOWNS: usize = FLANKS + 2 * PER_FLANK;
pub(super) type UnknownsVector = SVector<f64, UNKNOWNS>;
pub(super) type UnknownsInformation = SMatrix<f64, UNKNOWNS, UNKNOWNS>;

/// Prior standard deviations about the estimate: offset and half-width \[px\], slope and taper,
/// blur \[px\] and centre of the round end \[px\].
const LINE_SIGMA_PX: f64 = 3.0;
const WIDTH_SIGMA_PX: f64 = 2.0;
const SLOPE_SIGMA: f64 = 0.1;
pub(super) const BLUR_SIGMA_PX: f64 = 1.0;
const END_SIGMA_PX: f64 = 1.0;
/// Prior standard deviation of the skew of the round end, in radii. A sphere off the optical axis
/// projects to an ellipse, longer by 1 / cos of the angle from the optical axis, in the direction
/// away from it. Unless that direction is along or across the finger, the round end begins at
/// different abscissae on the two flanks.
const END_SKEW_SIGMA: f64 = 0.01;
/// Lower bound on the contrast that scales the priors of shading \[grey levels\].
pub(super) const LEAST_CONTRAST_GREY: f64 = 10.0;

/// Depth inside the edge at which the contrast is taken \[px\]: the edge of a finger may be as dark
/// as the background.
const SHADED_PX: f64 = 2.0;

/// The parameters of one flank (edge coefficients, levels, blur, …). The derivative by a slot is
/// one feature times one function of p.
const SLOTS: usize = 11;
const SLOT_FEATURE: [usize; SLOTS] = [
    EDGE,
    EDGE,
    EDGE,
    INSIDE,
    INSIDE,
    OUTSIDE,
    OUTSIDE,
    profile::BLUR,
    RAMP,
    profile::LIMB,
    profile::END,
];

/// The unknowns on which a flank depends, and their slots. The edge of flank σ is σ times the
/// bisector plus the half-width.
const OBSERVED: usize = FLANKS + PER_FLANK;
const OBSERVED_SLOT: [usize; OBSERVED] = [0, 1, 2, 0, 1, 2, 7, 10, 10, 4, 6, 3, 5, 8, 9];

fn observed_unknown(seen: usize, flank: usize) -> usize {
    if seen < FLANKS { seen } else { seen + flank * PER_FLANK }
}

fn observed_sign(seen: usize, flank: usize) -> f64 {
    if seen < HALF_WIDTH || seen == END_SKEW { SIDES[flank] } else { 1.0 }
}

/// Values of all unknowns.
#[derive(Debug, Clone, Copy)]
pub(super) struct Unknowns(pub UnknownsVector);

/// Functions of p at some blocks. The derivative by a slot is its feature times one of these, or
/// times 1.
#[derive(Debug, Clone, Copy)]
pub(super) struct Factors {
    p: Doubles,
    bend: Doubles,
    t: Doubles,
}

impl Factors {
    /// For blocks with middles at p, and half the length in use h.
    #[inline(always)]
    pub fn at(p: &Doubles, h: f64) -> Self {
        let per_length = 1.0 / h;
        let t: Doubles = each(|i| p[i] * per_length);
        Self { p: *p, bend: each(|i| 1.5 * t[i] * t[i] - 0.5), t }
    }

    /// The factors of all slots times a.
    #[inline(always)]
    fn times(&self, a: &Doubles) -> [Doubles; SLOTS] {
        let by = |factor: &Doubles| -> Doubles { each(|i| a[i] * factor[i]) };
        let t = by(&self.t);
        [*a, by(&self.p), by(&self.bend), *a, t, *a, t, *a, *a, *a, *a]
    }
}

impl Unknowns {
    /// Initial values: the estimate, with the given inside and background level of either flank.
    pub fn on(estimate: &FingerEstimate, levels: [[f64; 2]; 2], blur_px: f64) -> Self {
        let mut x = UnknownsVector::zeros();
        x[HALF_WIDTH] = estimate.half_width_px;
        x[TAPER] = estimate.taper;
        x[BLUR] = blur_px;
        x[END] = estimate.round_end_px.unwrap_or(0.0);
        for (flank, [inside, outside]) in levels.into_iter().enumerate() {
            x[FLANKS + flank * PER_FLANK] = inside;
            x[FLANKS + flank * PER_FLANK + 1] = outside;
        }
        Self(x)
    }

    /// The straight part of the two flanks.
    pub fn line(&self) -> FlankLines {
        FlankLines {
            offset_px: self.0[OFFSET],
            slope: self.0[SLOPE],
            half_width_px: self.0[HALF_WIDTH],
            taper: self.0[TAPER],
        }
    }

    pub fn blur_px(&self) -> f64 {
        self.0[BLUR]
    }

    /// Centre of the round end on a flank.
    pub fn end_px(&self, flank: usize) -> f64 {
        self.0[END] + SIDES[flank] * self.0[END_SKEW]
    }

    /// Contrast at a flank, finger minus background \[grey levels\].
    pub fn contrast_grey(&self, flank: usize) -> f64 {
        self.0[FLANKS + flank * PER_FLANK] - self.0[FLANKS + flank * PER_FLANK + 1]
    }

    /// Contrast at a flank, finger minus background, [`SHADED_PX`] inside the edge \[grey levels\].
    pub fn shaded_contrast_grey(&self, estimate: &FingerEstimate, flank: usize) -> f64 {
        let depth = SHADED_PX / estimate.half_width_px;
        let first = FLANKS + flank * PER_FLANK;
        self.contrast_grey(flank)
            + self.0[first + 2] * depth
            + self.0[first + 3] * (2.0 * depth).sqrt()
    }

    /// The profile of blocks of a flank with middles at p, whose levels and edges deviate by
    /// `effects`: inside, outside, edge.
    #[inline(always)]
    pub fn profile(
        &self,
        estimate: &FingerEstimate,
        flank: usize,
        p: &Doubles,
        effects: &[Doubles; 3],
    ) -> Profile {
        let x = &self.0;
        let h = estimate.half_length_px;
        let edge = |k: usize| SIDES[flank] * x[OFFSET + k] + x[HALF_WIDTH + k];
        let of_flank = |k: usize| x[FLANKS + flank * PER_FLANK + k];
        // e₀ + e₁ p + e₂ P₂, in powers of p.
        let [e0, e1, e2] = [edge(0), edge(1), edge(2)];
        let (middle, inside, outside) = (e0 - 0.5 * e2, of_flank(0), of_flank(1));
        Profile {
            edge: each(|i| (middle + effects[2][i]) as f32),
            edge_change: [e1, 1.5 * e2 / (h * h)].map(|e| e as f32),
            blur: x[BLUR] as f32,
            inside: each(|i| (inside + effects[0][i]) as f32),
            inside_change: (x[INSIDE_CHANGE] / h) as f32,
            outside: each(|i| (outside + effects[1][i]) as f32),
            outside_change: (x[OUTSIDE_CHANGE] / h) as f32,
            ramp: of_flank(2) as f32,
            limb: of_flank(3) as f32,
            half_width: each(|i| estimate.half_width_at(p[i]) as f32),
        }
    }

    /// Upper bound on the motion of the flanks in use by a step \[px\].
    pub fn motion_px(step: &UnknownsVector, half_length_px: f64) -> f64 {
        step[OFFSET].abs()
            + step[HALF_WIDTH].abs()
            + half_length_px * (step[SLOPE].abs() + step[TAPER].abs())
    }
}

/// A step of the unknowns, in the slots of a flank.
#[derive(Debug, Clone, Copy)]
pub(super) struct FlankStep([f64; SLOTS]);

impl FlankStep {
    pub fn of(step: &UnknownsVector, flank: usize) -> Self {
        let mut slots = [0.0; SLOTS];
        for (seen, &slot) in OBSERVED_SLOT.iter().enumerate() {
            slots[slot] += observed_sign(seen, flank) * step[observed_unknown(seen, flank)];
        }
        Self(slots)
    }

    /// Changes of the features of blocks by the step, column by column.
    pub fn changes(&self, factors: &Factors) -> [Doubles; COLUMNS] {
        let Factors { p, bend, t } = factors;
        let [e0, e1, e2, a, a1, b, b1, blur, ramp, limb, end] = self.0;
        let all = |change: f64| [change; LANES];
        [
            each(|i| e0 + p[i] * e1 + bend[i] * e2),
            each(|i| a + t[i] * a1),
            each(|i| b + t[i] * b1),
            all(blur),
            all(ramp),
            all(limb),
            all(0.0),
            all(end),
        ]
    }
}

/// The prior of the unknowns: independent normal distributions.
pub(super) struct UnknownsPrior {
    pub mean: UnknownsVector,
    /// Inverse variances.
    pub information: UnknownsVector,
}

impl UnknownsPrior {
    /// The prior about the initial values; width and taper of a known hand are those of its
    /// [`WidthPrior`](crate::axis::WidthPrior).
    pub fn about(
        start: &Unknowns,
        estimate: &FingerEstimate,
        contrast_grey: f64,
        options: &PhotometricOptions,
    ) -> Self {
        let PhotometricOptions { bend_px, change, ramp, limb, .. } = options;
        let contrast = contrast_grey.max(LEAST_CONTRAST_GREY);
        let (mut mean, mut sigma) = (start.0, UnknownsVector::repeat(f64::INFINITY));
        (sigma[OFFSET], sigma[SLOPE]) = (LINE_SIGMA_PX, SLOPE_SIGMA);
        (sigma[HALF_WIDTH], sigma[TAPER]) = (WIDTH_SIGMA_PX, SLOPE_SIGMA);
        (sigma[BEND], sigma[BULGE]) = (*bend_px, *bend_px);
        (sigma[BLUR], sigma[END]) = (BLUR_SIGMA_PX, END_SIGMA_PX);
        sigma[END_SKEW] = END_SKEW_SIGMA * estimate.half_width_px;
        (sigma[INSIDE_CHANGE], sigma[OUTSIDE_CHANGE]) = (change * contrast, change * contrast);
        for first in [FLANKS, FLANKS + PER_FLANK] {
            (sigma[first + 2], sigma[first + 3]) = (ramp * contrast, limb * contrast);
        }
        if let Some(prior) = estimate.prior {
            (mean[HALF_WIDTH], mean[TAPER]) = (prior.half_width_px, prior.taper);
            (sigma[HALF_WIDTH], sigma[TAPER]) = (prior.half_width_sigma_px, prior.taper_sigma);
        }
        Self { mean, information: sigma.map(|s| 1.0 / (s * s)) }
    }
}

/// Normal equations of one flank, in the upper triangle of its slots, with their right side.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct FlankEquations([[f64; SLOTS + 1]; SLOTS]);

impl FlankEquations {
    /// Adds the equations of blocks, from those of their features.
    #[inline(always)]
    pub fn add(&mut self, block_weight: &Doubles, factors: &Factors, equations: &GramEquations) {
        let weighted = factors.times(block_weight);
        for (i, sums) in self.0.iter_mut().enumerate() {
            let (a, feature) = (&weighted[i], SLOT_FEATURE[i]);
            for (j, sum) in sums.iter_mut().enumerate().skip(i) {
                let other = SLOT_FEATURE.get(j).copied().unwrap_or(RIGHT);
                let b = &equations[feature.min(other)][feature.max(other)];
                let product: Doubles = each(|l| a[l] * b[l]);
                *sum += total(&match j {
                    1 => each(|l| product[l] * factors.p[l]),
                    2 => each(|l| product[l] * factors.bend[l]),
                    4 | 6 => each(|l| product[l] * factors.t[l]),
                    _ => product,
                });
            }
        }
    }

    /// Adds them to the equations of all unknowns.
    pub fn spread(
        &self,
        flank: usize,
        information: &mut UnknownsInformation,
        right: &mut UnknownsVector,
    ) {
        for (a, &i) in OBSERVED_SLOT.iter().enumerate() {
            let (row, sign) = (observed_unknown(a, flank), observed_sign(a, flank));
            right[row] += sign * self.0[i][SLOTS];
            // The lower triangle alone, which the Cholesky factorisation reads.
            for (b, &j) in OBSERVED_SLOT.iter().enumerate().skip(a) {
                information[(observed_unknown(b, flank), row)] +=
                    sign * observed_sign(b, flank) * self.0[i.min(j)][i.max(j)];
            }
        }
    }
}
