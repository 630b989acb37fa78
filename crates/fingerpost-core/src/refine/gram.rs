//! Weighted moments of a block's residuals and features: all that the fit needs of its pixels.

#![expect(
    clippy::inline_always,
    reason = "what is inlined into a function with wider instructions is compiled for them"
)]

use super::blur::BlurTable;
use super::pixels::{Chunk, LANES, Lanes};
use super::profile::{COLUMNS, OUTSIDE, Prediction, Profile, RIGHT, RoundEnd};

/// How a pixel's residual is weighed: Tukey's biweight.
#[derive(Debug, Clone, Copy)]
pub(super) struct Weighing {
    /// Standard deviation σ of a pixel \[grey levels\].
    pub noise_grey: f64,
    /// Where the weight reaches zero, in σ.
    pub cutoff: f64,
}

/// Features and residuals of some pixels, each times the root of its pixel's weight.
type Weighted = [Lanes; COLUMNS];
/// Equations of the features; the right sides stand in their column.
pub(super) type Equations = [[f64; COLUMNS]; COLUMNS];

/// Sums over the pixels of one block.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Gram {
    /// Σ w f fᵀ, and Σ w f r.
    pub equations: Equations,
    /// Σ w, Σ w² r² and Σ ψ′, which make the covariance of a robust fit.
    pub weight: f64,
    pub psi_squared: f64,
    pub psi_slope: f64,
    /// Σ min(r², cutoff² σ²), in σ².
    pub chi_squared: f64,
    /// Pixels of no weight.
    pub rejected: f64,
}

/// What is between the pixels of a block and their sums.
#[derive(Debug, Clone)]
pub(super) struct Workspace {
    weighted: Vec<Weighted>,
    /// Sums lane by lane: the upper triangle of the equations, row by row.
    lanes: Vec<Lanes>,
    totals: Vec<f32>,
}

/// Entries of the upper triangle.
const ENTRIES: usize = COLUMNS * (COLUMNS + 1) / 2;

impl Workspace {
    /// Enough for blocks of so many chunks.
    pub fn with_capacity(chunks: usize) -> Self {
        let weighted = Vec::with_capacity(chunks);
        Self { weighted, lanes: vec![[0.0; LANES]; ENTRIES], totals: vec![0.0; ENTRIES] }
    }

    /// Makes room for blocks of so many chunks.
    pub fn fit(&mut self, chunks: usize) {
        self.weighted.resize(chunks, Weighted::default());
    }
}

impl Gram {
    /// The sums of a block whose pixels should look like `profile`, near a round end or clear of it;
    /// `space` has room for all its chunks.
    #[inline(always)]
    pub fn take(
        &mut self,
        chunks: &[Chunk],
        profile: &Profile,
        end: Option<RoundEnd>,
        table: BlurTable,
        weighing: &Weighing,
        space: &mut Workspace,
    ) {
        let Workspace { weighted, lanes, totals } = space;
        let mut tally = PixelTally::new(weighing);
        if let Some(end) = end {
            for (weighted, chunk) in weighted.iter_mut().zip(chunks) {
                *weighted = tally.weigh(chunk, &profile.round(table, chunk, end));
            }
        } else {
            for (weighted, chunk) in weighted.iter_mut().zip(chunks) {
                *weighted = tally.weigh(chunk, &profile.straight(table, chunk));
            }
        }
        let weighted = weighted.get(..chunks.len()).unwrap_or_default();
        // Their lengths are told at run time, so that no compiler takes the lanes apart in order to
        // add them sooner.
        let mut rest = lanes.as_mut_slice();
        rest = row::<0>(weighted, rest);
        rest = row::<1>(weighted, rest);
        rest = row::<2>(weighted, rest);
        rest = row::<3>(weighted, rest);
        rest = row::<4>(weighted, rest);
        rest = row::<5>(weighted, rest);
        rest = row::<6>(weighted, rest);
        row::<7>(weighted, rest);
        for (total, lanes) in totals.iter_mut().zip(&*lanes) {
            *total = sum(lanes);
        }
        let mut totals = totals.iter();
        for a in 0..COLUMNS {
            for (b, total) in (a..COLUMNS).zip(&mut totals) {
                let value = f64::from(*total);
                (self.equations[a][b], self.equations[b][a]) = (value, value);
            }
        }
        tally.tell(self);
    }
}

/// Row `A` of the equations lane by lane, from its diagonal on, to the beginning of `lanes`; returns
/// the rest of them.
#[inline(always)]
fn row<'a, const A: usize>(weighted: &[Weighted], lanes: &'a mut [Lanes]) -> &'a mut [Lanes] {
    let mut sums = [[0.0; LANES]; COLUMNS];
    for columns in weighted {
        for b in A..COLUMNS {
            for i in 0..LANES {
                sums[b][i] += columns[A][i] * columns[b][i];
            }
        }
    }
    let (row, rest) = lanes.split_at_mut(lanes.len().min(COLUMNS - A));
    for (lanes, sums) in row.iter_mut().zip(&sums[A..]) {
        *lanes = *sums;
    }
    rest
}

/// The other sums, lane by lane.
struct PixelTally {
    per_cut: f32,
    per_noise2: f32,
    weight: Lanes,
    psi_squared: Lanes,
    psi_slope: Lanes,
    /// Σ min((r / cut)², 1).
    capped: Lanes,
    kept: Lanes,
    pixels: Lanes,
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

    /// Weighs the pixels of a chunk, and counts them.
    #[inline(always)]
    fn weigh(&mut self, chunk: &Chunk, predicted: &Prediction) -> Weighted {
        let mut columns = predicted.columns;
        let mut roots = [0.0; LANES];
        for i in 0..LANES {
            let r = chunk.grey[i] - predicted.grey[i];
            // A pixel of doubtful background is as noisy as the part of it that shows.
            let doubt = chunk.doubt[i] * self.per_noise2;
            let shown = columns[OUTSIDE][i];
            let precision = chunk.weight[i] / (1.0 + shown * shown * doubt);
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

    /// The sums over all lanes.
    #[inline(always)]
    fn tell(&self, gram: &mut Gram) {
        let total = |lanes: &Lanes| f64::from(sum(lanes));
        gram.weight = total(&self.weight);
        gram.psi_squared = total(&self.psi_squared);
        gram.psi_slope = total(&self.psi_slope);
        gram.chi_squared = total(&self.capped) * self.cutoff * self.cutoff;
        gram.rejected = total(&self.pixels) - total(&self.kept);
    }
}

#[inline(always)]
fn sum(lanes: &Lanes) -> f32 {
    let [a, b, c, d, e, f, g, h] = *lanes;
    // Halves first: one addition of vectors each.
    ((a + e) + (c + g)) + ((b + f) + (d + h))
}
