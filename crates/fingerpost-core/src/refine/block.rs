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

use super::gram::Gram;
use super::profile::{EDGE, FEATURES, INSIDE, OUTSIDE};
use nalgebra::{Matrix3, Vector3};

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
    inverse: Matrix3<f64>,
    right: Vector3<f64>,
    coupling: [Vector3<f64>; FEATURES],
}

/// A block's equations with its deviations eliminated.
pub(super) struct Reduced {
    pub information: [[f64; FEATURES]; FEATURES],
    pub right: [f64; FEATURES],
    /// How many deviations were fitted, in effect.
    pub freed: f64,
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
            inverse: Matrix3::zeros(),
            right: Vector3::zeros(),
            coupling: [Vector3::zeros(); FEATURES],
        }
    }

    /// Eliminates the deviations, whose variances are given, from the block's equations; `noise2`
    /// is the variance of a pixel.
    pub fn eliminate(
        &mut self,
        gram: &Gram,
        variances: &[f64; 3],
        noise2: f64,
        evidence: &mut Evidence,
    ) -> Reduced {
        let own = Matrix3::from_fn(|i, k| gram.information[EFFECTS[i]][EFFECTS[k]]);
        let lambda = Vector3::from_fn(|k, _| {
            let told = noise2 / own[(k, k)].max(LEAST_INFORMATION);
            noise2 / variances[k].max(LEAST_VARIANCE * told)
        });
        // Λ is positive, so there always is one.
        let regular = own + Matrix3::from_diagonal(&lambda);
        self.inverse = regular.try_inverse().unwrap_or_else(Matrix3::zeros);
        let effects = Vector3::from(self.effects);
        self.right =
            Vector3::from_fn(|k, _| gram.right[EFFECTS[k]]) - lambda.component_mul(&effects);
        for (coupling, row) in self.coupling.iter_mut().zip(&gram.information) {
            *coupling = Vector3::from_fn(|k, _| row[EFFECTS[k]]);
        }
        let expected = effects + self.inverse * self.right;
        evidence.add(self.say, &expected, &self.inverse, &lambda, noise2);

        let (mut information, mut right) = (gram.information, gram.right);
        for i in 0..FEATURES {
            let row = self.inverse * self.coupling[i];
            right[i] -= row.dot(&self.right);
            for (entry, coupling) in information[i].iter_mut().zip(&self.coupling) {
                *entry -= row.dot(coupling);
            }
        }
        let freed = own.component_mul(&self.inverse).trace();
        Reduced { information, right, freed }
    }

    /// Takes the deviations to where they belong after the shared step was taken to the part `part`
    /// of its length and changed the features by `by_feature`.
    pub fn follow(&mut self, by_feature: &[f64; FEATURES], part: f64) {
        let mut right = self.right * part;
        for (coupling, step) in self.coupling.iter().zip(by_feature) {
            right -= coupling * *step;
        }
        let step = self.inverse * right;
        for (effect, step) in self.effects.iter_mut().zip(step.iter()) {
            *effect += step;
        }
    }
}

impl Evidence {
    /// Adds what a block tells, by moments: of a deviation of variance τ² the block's own estimate
    /// y, given the other deviations, has the variance τ² + σ² / h.
    fn add(
        &mut self,
        say: f64,
        expected: &Vector3<f64>,
        inverse: &Matrix3<f64>,
        lambda: &Vector3<f64>,
        noise2: f64,
    ) {
        for k in 0..3 {
            let all = 1.0 / inverse[(k, k)].max(f64::MIN_POSITIVE);
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
