//! Weighted moments of the residuals and features of blocks, sufficient for the normal equations.

#![expect(
    clippy::inline_always,
    reason = "what is inlined into a function with wider instructions is compiled for them"
)]

use super::blur::BlurTable;
use super::pixels::{Chunk, Doubles, LANES, PixelLanes};
use super::profile::{COLUMNS, OUTSIDE, Profile, ProfilePrediction, RIGHT, RoundEnd};
use crate::numeric::simd::each;

/// Weighting of a pixel's residual: Tukey's biweight.
#[derive(Debug, Clone, Copy)]
pub(super) struct Weighing {
    /// Standard deviation σ of a pixel \[grey levels\].
    pub noise_grey: f64,
    /// Residual at which the weight reaches zero, in σ.
    pub cutoff: f64,
}

/// Features and residuals of some pixels, each times the root of its pixel's weight.
pub(super) type Weighed = [PixelLanes; COLUMNS];
/// Normal equations of the features, in the upper triangle; the right side is a column of its own.
pub(super) type GramEquations = [[Doubles; COLUMNS]; COLUMNS];

/// Sums over the pixels of blocks.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Gram {
    /// Σ w f fᵀ, and Σ w f r.
    pub equations: GramEquations,
    /// Number of pixels.
    pub pixels: Doubles,
    /// Σ w, Σ w² r² and Σ ψ′, for the covariance of the robust fit.
    pub weight: Doubles,
    pub psi_squared: Doubles,
    pub psi_slope: Doubles,
    /// Σ min(r², cutoff² σ²), in σ².
    pub chi_squared: Doubles,
    /// Number of pixels with zero weight.
    pub rejected: Doubles,
}

impl Gram {
    /// Computes the sums of blocks against the model `profile`, near a round end or clear of it;
    /// `space` has room for all their chunks.
    #[inline(always)]
    pub fn take(
        &mut self,
        chunks: &[Chunk],
        profile: &Profile,
        end: Option<RoundEnd>,
        table: BlurTable,
        weighing: &Weighing,
        space: &mut [Weighed],
    ) {
        let mut tally = PixelTally::new(weighing);
        let shading = profile.shading();
        if let Some(end) = end {
            for (weighed, chunk) in space.iter_mut().zip(chunks) {
                *weighed = tally.weigh(chunk, &profile.round(&shading, table, chunk, end));
            }
        } else {
            for (weighed, chunk) in space.iter_mut().zip(chunks) {
                *weighed = tally.weigh(chunk, &profile.straight(&shading, table, chunk));
            }
        }
        let weighed = space.get(..chunks.len()).unwrap_or_default();
        // The sums of one row fit the registers, those of all do not.
        row::<0>(weighed, &mut self.equations);
        row::<1>(weighed, &mut self.equations);
        row::<2>(weighed, &mut self.equations);
        row::<3>(weighed, &mut self.equations);
        row::<4>(weighed, &mut self.equations);
        row::<5>(weighed, &mut self.equations);
        row::<6>(weighed, &mut self.equations);
        row::<7>(weighed, &mut self.equations);
        tally.report(self);
    }
}

/// Row `A` of the equations, from its diagonal on.
#[inline(always)]
fn row<const A: usize>(weighed: &[Weighed], equations: &mut GramEquations) {
    let mut sums = [[0.0; LANES]; COLUMNS];
    for columns in weighed {
        for b in A..COLUMNS {
            for i in 0..LANES {
                sums[b][i] += columns[A][i] * columns[b][i];
            }
        }
    }
    for b in A..COLUMNS {
        equations[A][b] = doubles(&sums[b]);
    }
}

#[inline(always)]
fn doubles(lanes: &PixelLanes) -> Doubles {
    each(|i| f64::from(lanes[i]))
}

/// The other sums, lane by lane.
struct PixelTally {
    per_cut: f32,
    per_noise2: f32,
    weight: PixelLanes,
    psi_squared: PixelLanes,
    psi_slope: PixelLanes,
    /// Σ min((r / cut)², 1).
    capped: PixelLanes,
    kept: PixelLanes,
    pixels: PixelLanes,
    cutoff: f64,
}

impl PixelTally {
    #[inline(always)]
    fn new(weighing: &Weighing) -> Self {
        let Weighing { noise_grey, cutoff } = *weighing;
        Self {
            per_cut: (1.0 / (cutoff * noise_grey)) as f32,
            per_noise2: (1.0 / (noise_grey * noise_grey)) as f32,
            weight: [0.0; LANES],
            psi_squared: [0.0; LANES],
            psi_slope: [0.0; LANES],
            capped: [0.0; LANES],
            kept: [0.0; LANES],
            pixels: [0.0; LANES],
            cutoff,
        }
    }

    /// Weights the pixels of a chunk, and adds them to the sums.
    #[inline(always)]
    fn weigh(&mut self, chunk: &Chunk, predicted: &ProfilePrediction) -> Weighed {
        let mut columns = predicted.columns;
        let mut roots = [0.0; LANES];
        for i in 0..LANES {
            let r = chunk.grey[i] - predicted.grey[i];
            // The variance of the background adds to the pixel's by the square of its visible
            // share.
            let variance = chunk.variance[i] * self.per_noise2;
            let shown = columns[OUTSIDE][i];
            let precision = chunk.weight[i] / (1.0 + shown * shown * variance);
            let t = r * self.per_cut;
            let t2 = t * t * precision;
            let left = if t2 < 1.0 { 1.0 - t2 } else { 0.0 };
            let inside = if t2 < 1.0 { chunk.weight[i] } else { 0.0 };
            let robust = left * left;
            let w = robust * precision;
            columns[RIGHT][i] = r;
            roots[i] = w.sqrt();
            self.weight[i] += robust * chunk.weight[i];
            self.psi_squared[i] += robust * w * r * r;
            self.psi_slope[i] += inside * left * (1.0 - 5.0 * t2);
            self.capped[i] += if t2 < 1.0 { t2 } else { 1.0 };
            self.kept[i] += inside;
            self.pixels[i] += chunk.weight[i];
        }
        for column in &mut columns {
            for i in 0..LANES {
                column[i] *= roots[i];
            }
        }
        columns
    }

    /// Writes the sums of every block.
    #[inline(always)]
    fn report(&self, gram: &mut Gram) {
        let cutoff2 = self.cutoff * self.cutoff;
        gram.pixels = doubles(&self.pixels);
        gram.weight = doubles(&self.weight);
        gram.psi_squared = doubles(&self.psi_squared);
        gram.psi_slope = doubles(&self.psi_slope);
        gram.chi_squared = each(|i| f64::from(self.capped[i]) * cutoff2);
        gram.rejected = each(|i| f64::from(self.pixels[i] - self.kept[i]));
    }
}
