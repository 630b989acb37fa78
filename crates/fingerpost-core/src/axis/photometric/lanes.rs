//! The loops over all pixels of the strips, for any instruction set.

use super::flank::PhotometricFlank;
use crate::axis::block::{Deviations, EDGE_EFFECT, Evidence};
use crate::axis::blur::BlurTable;
use crate::axis::finger_estimate::FingerEstimate;
use crate::axis::gram::{Gram, Weighing};
use crate::axis::pixels::{Doubles, LANES, PixelLanes, Strip, total};
use crate::axis::profile::RoundEnd;
use crate::axis::unknowns::{Factors, FlankEquations, Unknowns};
use crate::numeric::simd::{Work, each};

/// Threshold on χ² per pixel above which a block's weight falls by the square of the ratio. Of
/// clean blocks of 25 pixels, 5 % exceed it.
const MOST_CHI_SQUARED: f64 = 1.5;

/// Linearisation of the model of one flank block by block, with elimination of each block's
/// deviations.
pub(super) struct Linearising<'a> {
    pub(super) flank: &'a mut PhotometricFlank,
    pub(super) index: usize,
    pub(super) estimate: &'a FingerEstimate,
    pub(super) x: &'a Unknowns,
    pub(super) end: Option<RoundEnd>,
    pub(super) clear_px: f64,
    pub(super) table: BlurTable,
    pub(super) weighing: Weighing,
    /// Whether the weights of the blocks are updated.
    pub(super) reweighs: bool,
    /// Outputs.
    pub(super) equations: &'a mut FlankEquations,
    pub(super) evidence: &'a mut Evidence,
    pub(super) tally: &'a mut PixelSums,
}

impl Work for Linearising<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { flank, index, estimate, x, end, clear_px, table, weighing, .. } = self;
        let PhotometricFlank { strip, deviations, weighed, gram, variances, runs_px2, .. } = flank;
        let noise2 = weighing.noise_grey * weighing.noise_grey;
        for (group, deviations) in strip.groups.iter().zip(deviations) {
            let profile = x.profile(estimate, index, &group.p, &deviations.effects);
            // The last block is the one nearest to the end.
            let end = end.filter(|_| group.p[LANES - 1] > clear_px);
            gram.take(strip.chunks(group), &profile, end, table, &weighing, weighed);
            deviations.chi_squared = each(|i| gram.chi_squared[i] / gram.pixels[i].max(1.0));
            if self.reweighs {
                deviations.trust(group, MOST_CHI_SQUARED);
            }
            let mut variances = variances.map(|variance| [variance; LANES]);
            let of_edge = variances[EDGE_EFFECT];
            variances[EDGE_EFFECT] = each(|i| of_edge[i] + *runs_px2 + deviations.restless_px2[i]);
            deviations.eliminate(gram, group, &variances, noise2, self.evidence);
            let factors = Factors::at(&group.p, estimate.half_length_px);
            self.equations.add(&deviations.block_weight, &factors, &gram.equations);
            self.tally.add(deviations, gram);
        }
    }
}

/// A statistic of every block of a flank.
pub(super) struct Surveying<'a, F> {
    pub(super) strip: &'a Strip,
    pub(super) estimate: &'a FingerEstimate,
    /// From a pixel's distance outside the estimate's edge \[px\], its level and that of the known
    /// background behind it: whether it counts, and its value.
    pub(super) measure: F,
    /// Whether a block's statistic is the mean of its pixels' values, or the sum.
    pub(super) mean: bool,
    /// Refilled with the statistics of the blocks that have counting pixels.
    pub(super) means: &'a mut Vec<f64>,
}

impl<F: Fn(f32, f32, f32) -> (bool, f32)> Work for Surveying<'_, F> {
    #[inline(always)]
    fn run(self) {
        let Self { strip, estimate, measure, mean, means } = self;
        means.clear();
        for group in &strip.groups {
            let edge: PixelLanes = each(|i| estimate.half_width_at(group.p[i]) as f32);
            let (mut sums, mut counts) = ([0.0_f32; LANES], [0.0_f32; LANES]);
            for chunk in strip.chunks(group) {
                for i in 0..LANES {
                    let outside_px = chunk.v[i] - edge[i];
                    let (counts_here, value) =
                        measure(outside_px, chunk.grey[i], chunk.background[i]);
                    let weight = if counts_here { chunk.weight[i] } else { 0.0 };
                    sums[i] += weight * value;
                    counts[i] += weight;
                }
            }
            for (sum, count) in sums.into_iter().zip(counts).filter(|(_, count)| *count > 0.0) {
                means.push(f64::from(if mean { sum / count } else { sum }));
            }
        }
    }
}

/// Sums over all pixels.
#[derive(Default)]
pub(super) struct PixelSums {
    pub(super) weight: f64,
    pub(super) psi_squared: f64,
    pub(super) psi_slope: f64,
    pub(super) rejected: f64,
    pub(super) pixels: f64,
    pub(super) freed: f64,
    pub(super) block_weight: f64,
}

impl PixelSums {
    #[inline(always)]
    fn add(&mut self, deviations: &Deviations, gram: &Gram) {
        let Deviations { block_weight, freed, .. } = deviations;
        let weighted = |lanes: &Doubles| total(&each(|i| block_weight[i] * lanes[i]));
        self.weight += weighted(&gram.weight);
        self.psi_squared += weighted(&gram.psi_squared);
        self.psi_slope += weighted(&gram.psi_slope);
        self.rejected += weighted(&gram.rejected);
        self.pixels += weighted(&gram.pixels);
        self.freed += total(freed);
        self.block_weight += total(block_weight);
    }
}
