//! Random deviations of blocks from the smooth model, and their variances.
//!
//! A block's inside level, background level and edge may deviate from the smooth model. Each
//! deviation y is random with a variance τ²; in the block's equations
//!
//! ```text
//! [H  C] [δ]   [g]
//! [Cᵀ Y] [y] = [h]          Y = Σ w f fᵀ + Λ,  Λ = σ² / τ²
//! ```
//!
//! the deviations are eliminated. H − C Y⁻¹ Cᵀ and g − C Y⁻¹ h remain for the step δ of the
//! unknowns shared by all blocks. This maximises the likelihood with the deviations integrated out.
//!
//! Blocks are processed in lanes ([`pixels`](super::pixels)): every number here has one lane per
//! block.

#![expect(
    clippy::inline_always,
    reason = "what is inlined into a function with wider instructions is compiled for them"
)]

use super::gram::{Gram, GramEquations};
use super::pixels::{BlockGroup, Doubles, LANES, total};
use super::profile::{COLUMNS, EDGE, INSIDE, OUTSIDE, RIGHT};
use crate::numeric::simd::each;

/// The features through which the deviations act.
pub(super) const EFFECTS: [usize; 3] = [INSIDE, OUTSIDE, EDGE];
pub(super) const INSIDE_EFFECT: usize = 0;
pub(super) const OUTSIDE_EFFECT: usize = 1;
pub(super) const EDGE_EFFECT: usize = 2;
/// Lower bound on a deviation's variance, as a fraction of σ² / Σ w f², the variance of its
/// estimate from one block. It keeps Λ finite without effect on the result.
const LEAST_VARIANCE: f64 = 1e-3;
/// Lower bound on the information Σ w f² of a block.
const LEAST_INFORMATION: f64 = 1e-6;
/// Threshold on the product of neighbouring edges, in standard deviations of its distribution for
/// independent edges. A larger product shows a structure longer than a block, such as a joint.
const CHANCE: f64 = 1.5;
/// Variance factor of deviations that correlate from block to block: 2 / (1 − ρ), with ρ = ½
/// between neighbours.
const RUN: f64 = 4.0;

/// The upper triangle of a symmetric 3 × 3 matrix, row by row.
type Symmetric = [Doubles; 6];

/// The deviations of a group's blocks, and their coupling to the shared unknowns.
#[derive(Debug, Clone, Copy)]
pub(super) struct Deviations {
    /// y: inside and background level \[grey levels\], edge outward \[px\].
    pub effects: [Doubles; 3],
    /// Weight of each block, 0–1; zero in a lane without a block.
    pub block_weight: Doubles,
    /// χ² per pixel.
    pub chi_squared: Doubles,
    /// Variance of the edge due to structure in the background and in the finger's level \[px²\].
    pub restless_px2: Doubles,
    /// Effective number of deviations fitted.
    pub freed: Doubles,
    /// Y⁻¹.
    inverse: Symmetric,
    /// Cᵀ, with h beside it.
    coupling: [[Doubles; COLUMNS]; 3],
}

/// Sums from which the variances of the deviations are estimated.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Evidence {
    excess: [Doubles; 3],
    information: [Doubles; 3],
    /// The last block's edge: the weighted root of its information, and its estimate.
    last: Option<[f64; 2]>,
    /// Over neighbouring blocks: the sum of products of edges, that of their information, and the
    /// number of pairs.
    together: f64,
    shared: f64,
    pairs: f64,
}

impl Deviations {
    /// Zero deviations for a group's blocks.
    pub fn none(group: &BlockGroup) -> Self {
        Self {
            effects: [[0.0; LANES]; 3],
            block_weight: group.is_block,
            chi_squared: [1.0; LANES],
            restless_px2: [0.0; LANES],
            freed: [0.0; LANES],
            inverse: [[0.0; LANES]; 6],
            coupling: [[[0.0; LANES]; COLUMNS]; 3],
        }
    }

    /// Weights the blocks by χ² per pixel: above `most_chi_squared` by the square of the ratio.
    #[inline(always)]
    pub fn trust(&mut self, group: &BlockGroup, most_chi_squared: f64) {
        self.block_weight = each(|i| {
            let block_weight = most_chi_squared / self.chi_squared[i];
            (block_weight * block_weight).min(1.0) * group.is_block[i]
        });
    }

    /// Eliminates the deviations, of given variances, from the blocks' equations; `noise2` is the
    /// variance of a pixel.
    #[inline(always)]
    pub fn eliminate(
        &mut self,
        gram: &mut Gram,
        group: &BlockGroup,
        variances: &[Doubles; 3],
        noise2: f64,
        evidence: &mut Evidence,
    ) {
        let equations = &mut gram.equations;
        let (mut own, mut lambda) = ([[0.0; LANES]; 3], [[0.0; LANES]; 3]);
        for k in 0..3 {
            own[k] = equations[EFFECTS[k]][EFFECTS[k]];
            lambda[k] = each(|i| {
                let estimated = noise2 / own[k][i].max(LEAST_INFORMATION);
                noise2 / variances[k][i].max(LEAST_VARIANCE * estimated)
            });
        }
        let regular = |k: usize| -> Doubles { each(|i| own[k][i] + lambda[k][i]) };
        let cross = |k: usize, l: usize| *entry(equations, EFFECTS[k], EFFECTS[l]);
        self.inverse =
            inverse(&[regular(0), cross(0, 1), cross(0, 2), regular(1), cross(1, 2), regular(2)]);
        for k in 0..3 {
            for c in 0..COLUMNS {
                self.coupling[k][c] = *entry(equations, EFFECTS[k], c);
            }
            let right = self.coupling[k][RIGHT];
            self.coupling[k][RIGHT] = each(|i| right[i] - lambda[k][i] * self.effects[k][i]);
        }
        let [inside, outside, edge] = &self.coupling;
        let step = apply(&self.inverse, [&inside[RIGHT], &outside[RIGHT], &edge[RIGHT]]);
        let mut expected = self.effects;
        for k in 0..3 {
            expected[k] = each(|i| expected[k][i] + step[k][i]);
        }
        let own_inverse = [self.inverse[0], self.inverse[3], self.inverse[5]];
        evidence.add(group, &self.block_weight, &expected, &own_inverse, &lambda, noise2);

        for row in 0..COLUMNS {
            let [a, b, c] = apply(&self.inverse, [&inside[row], &outside[row], &edge[row]]);
            for column in row..COLUMNS {
                let (before, f, g, h) =
                    (equations[row][column], &inside[column], &outside[column], &edge[column]);
                equations[row][column] =
                    each(|i| before[i] - (a[i] * f[i] + b[i] * g[i] + c[i] * h[i]));
            }
        }
        self.freed = each(|i| {
            own[0][i] * own_inverse[0][i]
                + own[1][i] * own_inverse[1][i]
                + own[2][i] * own_inverse[2][i]
        });
    }

    /// Updates the deviations after the fraction `part` of the shared step was taken, which changed
    /// the features by `changes`.
    pub fn follow(&mut self, changes: &[Doubles; COLUMNS], part: f64) {
        let mut right = [[0.0; LANES]; 3];
        for (right, coupling) in right.iter_mut().zip(&self.coupling) {
            *right = each(|i| part * coupling[RIGHT][i]);
            for (c, (coupling, change)) in coupling.iter().zip(changes).enumerate() {
                if c != RIGHT {
                    *right = each(|i| right[i] - coupling[i] * change[i]);
                }
            }
        }
        let step = apply(&self.inverse, [&right[0], &right[1], &right[2]]);
        for (effect, step) in self.effects.iter_mut().zip(step) {
            *effect = each(|i| effect[i] + step[i]);
        }
    }
}

/// An entry of the equations.
#[inline(always)]
fn entry(equations: &GramEquations, a: usize, b: usize) -> &Doubles {
    &equations[a.min(b)][a.max(b)]
}

/// The product of a symmetric matrix and a vector.
#[inline(always)]
fn apply([aa, ab, ac, bb, bc, cc]: &Symmetric, [a, b, c]: [&Doubles; 3]) -> [Doubles; 3] {
    [
        each(|i| aa[i] * a[i] + ab[i] * b[i] + ac[i] * c[i]),
        each(|i| ab[i] * a[i] + bb[i] * b[i] + bc[i] * c[i]),
        each(|i| ac[i] * a[i] + bc[i] * b[i] + cc[i] * c[i]),
    ]
}

/// The inverse of a symmetric matrix, or zeros if it is singular.
#[inline(always)]
fn inverse([a, b, c, d, e, f]: &Symmetric) -> Symmetric {
    let aa: Doubles = each(|i| d[i] * f[i] - e[i] * e[i]);
    let ab: Doubles = each(|i| c[i] * e[i] - b[i] * f[i]);
    let ac: Doubles = each(|i| b[i] * e[i] - c[i] * d[i]);
    let bb: Doubles = each(|i| a[i] * f[i] - c[i] * c[i]);
    let bc: Doubles = each(|i| b[i] * c[i] - a[i] * e[i]);
    let cc: Doubles = each(|i| a[i] * d[i] - b[i] * b[i]);
    let one: Doubles = each(|i| {
        let one = 1.0 / (a[i] * aa[i] + b[i] * ab[i] + c[i] * ac[i]);
        if one.abs() < f64::INFINITY { one } else { 0.0 }
    });
    [aa, ab, ac, bb, bc, cc].map(|minor| each(|i| minor[i] * one[i]))
}

impl Evidence {
    /// Adds blocks to the method-of-moments estimate. For a deviation of variance τ², a block's own
    /// estimate y, given the other deviations, has the variance τ² + σ² / h.
    #[inline(always)]
    fn add(
        &mut self,
        group: &BlockGroup,
        block_weight: &Doubles,
        expected: &[Doubles; 3],
        inverse: &[Doubles; 3],
        lambda: &[Doubles; 3],
        noise2: f64,
    ) {
        for k in 0..3 {
            let all: Doubles = each(|i| 1.0 / inverse[k][i].max(f64::MIN_POSITIVE));
            let own: Doubles = each(|i| (all[i] - lambda[k][i]).max(LEAST_INFORMATION));
            // The prior Λ shrinks the estimate towards zero; this undoes it.
            let free: Doubles = each(|i| expected[k][i] * all[i] / own[i]);
            let (excess, information) = (self.excess[k], self.information[k]);
            self.excess[k] =
                each(|i| excess[i] + block_weight[i] * (own[i] * free[i] * free[i] - noise2));
            self.information[k] = each(|i| information[i] + block_weight[i] * own[i]);
            if k == EDGE_EFFECT {
                let root: Doubles = each(|i| own[i].sqrt());
                for i in 0..LANES {
                    if group.is_block[i] > 0.0 {
                        self.pair(root[i], free[i], block_weight[i]);
                    }
                }
            }
        }
    }

    /// Adds the product of a block's edge with that of the previous block; it has zero mean for
    /// independent noise.
    #[inline(always)]
    fn pair(&mut self, root: f64, free: f64, block_weight: f64) {
        if let Some([last_root, last]) = self.last {
            self.together += block_weight * root * last_root * free * last;
            self.shared += block_weight * root * last_root;
            self.pairs += block_weight;
        }
        self.last = Some([block_weight * root, free]);
    }

    /// Variance added to an edge by runs of blocks that deviate together \[px²\].
    pub fn runs(&self, noise2: f64) -> f64 {
        if self.shared > 0.0 {
            let chance = CHANCE * noise2 * self.pairs.sqrt();
            RUN * ((self.together - chance) / self.shared).max(0.0)
        } else {
            0.0
        }
    }

    /// The variances of the three deviations.
    pub fn variances(&self) -> [f64; 3] {
        let mut variances = [0.0; 3];
        for (variance, (excess, information)) in
            variances.iter_mut().zip(self.excess.iter().zip(&self.information))
        {
            let (excess, information) = (total(excess), total(information));
            if information > 0.0 {
                *variance = (excess / information).max(0.0);
            }
        }
        variances
    }
}
