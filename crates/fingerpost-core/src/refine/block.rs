//! What deviates from block to block, and how much.
//!
//! A block's inside level, background level and edge may deviate from the smooth model. Each
//! deviation y is random with a variance τ²; with the block's equations
//!
//! ```text
//! [H  C] [δ]   [g]
//! [Cᵀ Y] [y] = [h]          Y = Σ w f fᵀ + Λ,  Λ = σ² / τ²
//! ```
//!
//! the deviations are eliminated, H − C Y⁻¹ Cᵀ and g − C Y⁻¹ h remain for the step δ of what all
//! blocks share: this maximises the likelihood with the deviations integrated out.

#![expect(
    clippy::inline_always,
    reason = "what is inlined into a function with wider instructions is compiled for them"
)]

use super::gram::Gram;
use super::profile::{COLUMNS, EDGE, INSIDE, OUTSIDE, RIGHT};

/// What deviates: the features it acts through.
pub(super) const EFFECTS: [usize; 3] = [INSIDE, OUTSIDE, EDGE];
pub(super) const INSIDE_EFFECT: usize = 0;
pub(super) const OUTSIDE_EFFECT: usize = 1;
pub(super) const EDGE_EFFECT: usize = 2;
/// A deviation's variance is taken for no less than this part of what one block can tell of it:
/// that keeps Λ finite and changes nothing.
const LEAST_VARIANCE: f64 = 1e-3;
/// A block that tells nothing of a deviation tells this much: Σ w f².
const LEAST_INFORMATION: f64 = 1e-6;
/// Neighbours' edges that agree by more than so many standard deviations of chance belong to
/// something longer than a block, as a joint.
const CHANCE: f64 = 1.5;
/// What agrees from block to block counts as much as this many that do not: 2 / (1 − ρ), with
/// ρ = ½ from one to the next.
const RUN: f64 = 4.0;

/// One block's deviations, and its equations when it was last looked at.
#[derive(Debug, Clone, Copy)]
pub(super) struct Deviation {
    /// y: inside and background level \[grey levels\], edge outward \[px\].
    pub effects: [f64; 3],
    /// How much the block counts, 0–1.
    pub say: f64,
    /// χ² of its pixels per pixel.
    pub chi_squared: f64,
    /// Variance of its edge from what the background does about it \[px²\].
    pub restless_px2: f64,
    /// Its sums over pixels; in their equations the deviations are eliminated.
    pub gram: Gram,
    /// How many deviations were fitted, in effect.
    pub freed: f64,
    /// Y⁻¹.
    inverse: [[f64; 3]; 3],
    /// Cᵀ, and h beside it.
    coupling: [[f64; COLUMNS]; 3],
}

/// Evidence of how much a kind of deviation varies.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Evidence {
    excess: [f64; 3],
    information: [f64; 3],
    /// The edge of the last block: the root of what it tells, as far as it counts, and the edge.
    last: Option<[f64; 2]>,
    /// Of neighbours: products of their edges, what these tell, and how many they are.
    together: f64,
    shared: f64,
    pairs: f64,
}

impl Deviation {
    pub fn none() -> Self {
        Self {
            effects: [0.0; 3],
            say: 1.0,
            chi_squared: 1.0,
            restless_px2: 0.0,
            gram: Gram::default(),
            freed: 0.0,
            inverse: [[0.0; 3]; 3],
            coupling: [[0.0; _]; 3],
        }
    }

    /// Eliminates the deviations, whose variances are given, from the block's equations; `noise2`
    /// is the variance of a pixel.
    #[inline(always)]
    pub fn eliminate(&mut self, variances: &[f64; 3], noise2: f64, evidence: &mut Evidence) {
        let equations = &mut self.gram.equations;
        let (mut regular, mut lambda) = ([[0.0; 3]; 3], [0.0; 3]);
        for k in 0..3 {
            for i in 0..3 {
                regular[k][i] = equations[EFFECTS[k]][EFFECTS[i]];
            }
            let told = noise2 / regular[k][k].max(LEAST_INFORMATION);
            lambda[k] = noise2 / variances[k].max(LEAST_VARIANCE * told);
            regular[k][k] += lambda[k];
        }
        // Λ is positive, so there always is one.
        self.inverse = inverse(&regular).unwrap_or([[0.0; 3]; 3]);
        for (k, coupling) in self.coupling.iter_mut().enumerate() {
            *coupling = equations[EFFECTS[k]];
            coupling[RIGHT] -= lambda[k] * self.effects[k];
        }
        let step = apply(&self.inverse, &self.coupling.map(|c| c[RIGHT]));
        let mut expected = self.effects;
        for k in 0..3 {
            expected[k] += step[k];
        }
        evidence.add(self.say, &expected, &self.inverse, &lambda, noise2);

        let [inside, outside, edge] = &self.coupling;
        for i in 0..COLUMNS {
            let [a, b, c] = apply(&self.inverse, &[inside[i], outside[i], edge[i]]);
            for j in 0..COLUMNS {
                equations[i][j] -= a * inside[j] + b * outside[j] + c * edge[j];
            }
        }
        self.freed = 0.0;
        for k in 0..3 {
            self.freed += (regular[k][k] - lambda[k]) * self.inverse[k][k];
        }
    }

    /// Takes the deviations to where they belong after the shared step was taken to the part `part`
    /// of its length and changed the features by those columns of `changes`.
    pub fn follow(&mut self, changes: &[f64; COLUMNS], part: f64) {
        let mut changes = *changes;
        changes[RIGHT] = -part;
        let mut right = [0.0; 3];
        for (right, coupling) in right.iter_mut().zip(&self.coupling) {
            for (coupling, change) in coupling.iter().zip(&changes) {
                *right -= coupling * change;
            }
        }
        let step = apply(&self.inverse, &right);
        for (effect, step) in self.effects.iter_mut().zip(step) {
            *effect += step;
        }
    }
}

/// The product of a symmetric matrix and a vector.
#[inline(always)]
fn apply(m: &[[f64; 3]; 3], v: &[f64; 3]) -> [f64; 3] {
    let mut product = [0.0; 3];
    for k in 0..3 {
        product[k] = m[k][0] * v[0] + m[k][1] * v[1] + m[k][2] * v[2];
    }
    product
}

/// The inverse of a symmetric matrix.
#[inline(always)]
fn inverse([[a, b, c], [_, d, e], [_, _, f]]: &[[f64; 3]; 3]) -> Option<[[f64; 3]; 3]> {
    let (aa, ab, ac) = (d * f - e * e, c * e - b * f, b * e - c * d);
    let determinant = a * aa + b * ab + c * ac;
    let one = 1.0 / determinant;
    let (bb, bc, cc) = (a * f - c * c, b * c - a * e, a * d - b * b);
    let inverse = [[aa, ab, ac], [ab, bb, bc], [ac, bc, cc]].map(|row| row.map(|m| m * one));
    one.is_finite().then_some(inverse)
}

impl Evidence {
    /// Adds what a block tells, by moments: of a deviation of variance τ² the block's own estimate
    /// y, given the other deviations, has the variance τ² + σ² / h.
    #[inline(always)]
    fn add(
        &mut self,
        say: f64,
        expected: &[f64; 3],
        inverse: &[[f64; 3]; 3],
        lambda: &[f64; 3],
        noise2: f64,
    ) {
        for k in 0..3 {
            let all = 1.0 / inverse[k][k].max(f64::MIN_POSITIVE);
            let own = (all - lambda[k]).max(LEAST_INFORMATION);
            // What was expected is drawn to zero by Λ.
            let free = expected[k] * all / own;
            self.excess[k] += say * (own * free * free - noise2);
            self.information[k] += say * own;
            if k == EDGE_EFFECT {
                self.pair(own.sqrt(), free, say);
            }
        }
    }

    /// Puts a block's edge beside that of the block before: noise would have them independent.
    #[inline(always)]
    fn pair(&mut self, root: f64, free: f64, say: f64) {
        if let Some([last_root, last]) = self.last {
            self.together += say * root * last_root * free * last;
            self.shared += say * root * last_root;
            self.pairs += say;
        }
        self.last = Some([say * root, free]);
    }

    /// What runs of blocks whose edges deviate alike add to the variance of an edge \[px²\].
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
            if *information > 0.0 {
                *variance = (excess / information).max(0.0);
            }
        }
        variances
    }
}
