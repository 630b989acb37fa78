//! One flank as it is fitted: its strip, its blocks, and how they are linearised.

use crate::axis::block::{Deviations, Evidence, INSIDE_EFFECT, OUTSIDE_EFFECT};
use crate::axis::gram::{Gram, Weighed};
use crate::axis::pixels::{Doubles, LANES, Strip, USUAL_BLOCKS, USUAL_PIXELS};

/// Blocks with something in them have too much say in the first, and their deviations in the next.
pub(super) const UNTRIED_ITERATIONS: usize = 3;

/// One flank's pixels, and what deviates along it.
#[derive(Debug, Clone)]
pub(super) struct Flank {
    pub(super) strip: Strip,
    /// Those of every group of blocks.
    pub(super) deviations: Vec<Deviations>,
    /// What is between the pixels of a group and its equations.
    pub(super) weighed: Vec<Weighed>,
    pub(super) gram: Box<Gram>,
    /// The deviations of the background's level, block by block.
    levels: Vec<f64>,
    /// Variance of each deviation from block to block, in the square of its unit.
    pub(super) variances: [f64; 3],
    /// What runs of blocks whose edges deviate alike add to the edge's \[px²\].
    pub(super) runs_px2: f64,
}

impl Flank {
    pub(super) fn new() -> Self {
        Self {
            strip: Strip::new(),
            deviations: Vec::with_capacity(USUAL_BLOCKS.div_ceil(LANES)),
            weighed: Vec::with_capacity(USUAL_PIXELS),
            gram: Box::default(),
            levels: Vec::with_capacity(USUAL_BLOCKS),
            variances: [0.0; 3],
            runs_px2: 0.0,
        }
    }

    /// Before a fit to the pixels that the strip has gathered.
    pub(super) fn begin(&mut self) {
        self.weighed.resize(self.strip.most_pixels(), Weighed::default());
        self.deviations.clear();
        self.deviations.extend(self.strip.groups.iter().map(Deviations::none));
        (self.variances, self.runs_px2) = ([0.0; 3], 0.0);
    }

    /// A number of every block, in order along the finger.
    pub(super) fn of_blocks<'a>(
        &'a self,
        lanes: impl Fn(&'a Deviations) -> &'a Doubles + 'a,
    ) -> impl Iterator<Item = f64> + 'a {
        let all = self.deviations.iter().flat_map(lanes);
        all.copied().skip(self.strip.first_slot())
    }

    /// Takes over the variances that the evidence speaks for; by half once there are some that owe
    /// nothing to the first look, which every block has a say in, so that they do not swing with the
    /// deviations that depend on them.
    pub(super) fn adapt(&mut self, evidence: &Evidence, noise2: f64, iteration: usize) {
        let keep = if iteration <= UNTRIED_ITERATIONS { 0.0 } else { 0.5 };
        let blend = |old: &mut f64, told: f64| *old = keep * *old + (1.0 - keep) * told;
        for (variance, told) in self.variances.iter_mut().zip(evidence.variances()) {
            blend(variance, told);
        }
        blend(&mut self.runs_px2, evidence.runs(noise2));
    }

    /// Works out how much the background's changes from block to block, and the finger's deviations,
    /// leave each edge in doubt.
    pub(super) fn watch_levels(&mut self, restlessness_px: f64, contrast_grey: f64, scale: f64) {
        let mut levels = std::mem::take(&mut self.levels);
        levels.clear();
        levels.extend(self.of_blocks(|deviations| &deviations.effects[OUTSIDE_EFFECT]));
        for (k, &here) in levels.iter().enumerate() {
            let (mut sum, mut weight) = (0.0, 0.0);
            for (away, share) in [(1, 1.0), (2, 0.5)] {
                for other in [k.checked_sub(away), Some(k + away)] {
                    if let Some(there) = other.and_then(|other| levels.get(other)) {
                        sum += share * (there - here).powi(2);
                        weight += share;
                    }
                }
            }
            // An edge of no contrast says nothing anyhow.
            let behind = self.strip.blocks.get(k).map_or(0.0, |b| b.behind);
            let contrast2 = (contrast_grey - behind - here).powi(2).max(9.0 * scale * scale);
            let change2 = if weight > 0.0 { sum / weight } else { 0.0 };
            let slot = self.strip.first_slot() + k;
            if let Some(deviations) = self.deviations.get_mut(slot / LANES) {
                let lane = slot % LANES;
                let change2 = change2 + deviations.effects[INSIDE_EFFECT][lane].powi(2);
                deviations.restless_px2[lane] = restlessness_px.powi(2) * change2 / contrast2;
            }
        }
        self.levels = levels;
    }
}
