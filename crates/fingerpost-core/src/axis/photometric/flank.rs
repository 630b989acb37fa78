//! One flank of the photometric fit: its strip of pixels, its blocks, and their deviations.

use crate::axis::block::{Deviations, Evidence, INSIDE_EFFECT, OUTSIDE_EFFECT};
use crate::axis::gram::{Gram, Weighed};
use crate::axis::pixels::{Doubles, LANES, Strip, USUAL_BLOCKS, USUAL_PIXELS};

/// Iterations before the variances are damped: outlying blocks have full weight in the first, and
/// affect the deviations of the next.
pub(super) const UNTRIED_ITERATIONS: usize = 3;

/// The pixels of one flank, and the deviations along it.
#[derive(Debug, Clone)]
pub(super) struct PhotometricFlank {
    pub(super) strip: Strip,
    /// Those of every group of blocks.
    pub(super) deviations: Vec<Deviations>,
    /// Workspace: weighted features and residuals of the pixels of a group.
    pub(super) weighed: Vec<Weighed>,
    pub(super) gram: Box<Gram>,
    /// The deviations of the background's level, block by block.
    levels: Vec<f64>,
    /// Variance of each deviation from block to block, in the square of its unit.
    pub(super) variances: [f64; 3],
    /// Variance added to the edge by runs of blocks that deviate together \[px²\].
    pub(super) runs_px2: f64,
}

impl PhotometricFlank {
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

    /// Resets the fit for the pixels that the strip has gathered.
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

    /// Sets the variances to their estimates. After the first iterations, which depend on outlying
    /// blocks with full weight, the change is halved, so that variances and deviations do not
    /// oscillate.
    pub(super) fn adapt(&mut self, evidence: &Evidence, noise2: f64, iteration: usize) {
        let keep = if iteration <= UNTRIED_ITERATIONS { 0.0 } else { 0.5 };
        let blend = |old: &mut f64, estimated: f64| *old = keep * *old + (1.0 - keep) * estimated;
        for (variance, estimated) in self.variances.iter_mut().zip(evidence.variances()) {
            blend(variance, estimated);
        }
        blend(&mut self.runs_px2, evidence.runs(noise2));
    }

    /// Computes the variance of each block's edge due to changes of the background from block to
    /// block and to the finger's level deviations.
    pub(super) fn watch_levels(&mut self, restlessness_px: f64, contrast_grey: f64, scale: f64) {
        let mut levels = std::mem::take(&mut self.levels);
        levels.clear();
        levels.extend(self.of_blocks(|deviations| &deviations.effects[OUTSIDE_EFFECT]));
        for (k, &level) in levels.iter().enumerate() {
            let (mut sum, mut weight) = (0.0, 0.0);
            for (lag, share) in [(1, 1.0), (2, 0.5)] {
                for other in [k.checked_sub(lag), Some(k + lag)] {
                    if let Some(neighbour) = other.and_then(|other| levels.get(other)) {
                        sum += share * (neighbour - level).powi(2);
                        weight += share;
                    }
                }
            }
            // Bounds the denominator: an edge without contrast carries no information anyway.
            let behind = self.strip.blocks.get(k).map_or(0.0, |b| b.behind);
            let contrast2 = (contrast_grey - behind - level).powi(2).max(9.0 * scale * scale);
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
