//! Weighted moments of a block's residuals and features: all that the fit needs of its pixels.

#![expect(
    clippy::inline_always,
    reason = "what is inlined into a function with wider instructions is compiled for them"
)]
#![expect(
    clippy::needless_range_loop,
    reason = "lane by lane through many arrays at once is what the compiler turns into vectors"
)]

use super::blur::BlurTable;
use super::pixels::{Chunk, LANES, Lanes};
use super::profile::{FEATURES, OUTSIDE, Prediction, Profile, RoundEnd};
use crate::simd::Work;

/// How a pixel's residual is weighed: Tukey's biweight.
#[derive(Debug, Clone, Copy)]
pub(super) struct Weighing {
    /// Standard deviation σ of a pixel \[grey levels\].
    pub noise_grey: f64,
    /// Where the weight reaches zero, in σ.
    pub cutoff: f64,
}

/// Sums over the pixels of one block.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Gram {
    /// Σ w f fᵀ and Σ w f r.
    pub information: [[f64; FEATURES]; FEATURES],
    pub right: [f64; FEATURES],
    /// Σ w, Σ w² r² and Σ ψ′, which make the covariance of a robust fit.
    pub weight: f64,
    pub psi_squared: f64,
    pub psi_slope: f64,
    /// Σ min(r², cutoff² σ²), in σ².
    pub chi_squared: f64,
    /// Pixels of no weight.
    pub rejected: f64,
}

/// The sums of a block whose pixels should look like `profile`, near a round end or clear of it.
pub(super) struct Summing<'a> {
    pub chunks: &'a [Chunk],
    pub profile: Profile,
    pub end: Option<RoundEnd>,
    pub table: BlurTable,
    pub weighing: Weighing,
    /// Where the sums go.
    pub gram: &'a mut Gram,
}

impl Work for Summing<'_> {
    #[inline(always)]
    fn run(self) {
        let mut sums = Accumulator::new(&self.weighing);
        match self.end {
            Some(end) => {
                for chunk in self.chunks {
                    sums.add(chunk, &self.profile.round(self.table, chunk, end));
                }
            }
            None => {
                for chunk in self.chunks {
                    sums.add(chunk, &self.profile.straight(self.table, chunk));
                }
            }
        }
        *self.gram = sums.total();
    }
}

/// Entries of a symmetric matrix of the features.
const PAIRS: usize = FEATURES * (FEATURES + 1) / 2;

/// The sums lane by lane.
struct Accumulator {
    per_cut: f32,
    per_noise2: f32,
    pairs: [Lanes; PAIRS],
    right: [Lanes; FEATURES],
    weight: Lanes,
    psi_squared: Lanes,
    psi_slope: Lanes,
    /// Σ min((r / cut)², 1).
    capped: Lanes,
    kept: Lanes,
    pixels: Lanes,
    cutoff: f64,
}

impl Accumulator {
    #[inline(always)]
    fn new(weighing: &Weighing) -> Self {
        let Weighing { noise_grey, cutoff } = *weighing;
        Self {
            per_cut: (1.0 / (cutoff * noise_grey)) as f32,
            per_noise2: (1.0 / (noise_grey * noise_grey)) as f32,
            pairs: [[0.0; LANES]; PAIRS],
            right: [[0.0; LANES]; FEATURES],
            weight: [0.0; LANES],
            psi_squared: [0.0; LANES],
            psi_slope: [0.0; LANES],
            capped: [0.0; LANES],
            kept: [0.0; LANES],
            pixels: [0.0; LANES],
            cutoff,
        }
    }

    /// Adds the pixels of a chunk.
    #[inline(always)]
    fn add(&mut self, chunk: &Chunk, predicted: &Prediction) {
        let f = &predicted.features;
        let (mut weights, mut weighted) = ([0.0; LANES], [0.0; LANES]);
        for i in 0..LANES {
            let r = chunk.grey[i] - predicted.grey[i];
            // A pixel of doubtful background is as noisy as the part of it that shows.
            let doubt = chunk.doubt[i] * self.per_noise2;
            let shown = f[OUTSIDE][i];
            let precision = chunk.weight[i] / (1.0 + shown * shown * doubt);
            let t = r * self.per_cut;
            let t2 = t * t * precision;
            let left = (1.0 - t2).max(0.0);
            let inside = if left > 0.0 { chunk.weight[i] } else { 0.0 };
            let robust = left * left;
            let w = robust * precision;
            weights[i] = w;
            weighted[i] = w * r;
            self.weight[i] += robust * chunk.weight[i];
            self.psi_squared[i] += robust * w * r * r;
            self.psi_slope[i] += inside * left * (1.0 - 5.0 * t2);
            self.capped[i] += t2.min(1.0);
            self.kept[i] += inside;
            self.pixels[i] += chunk.weight[i];
        }
        let mut pair = 0;
        for a in 0..FEATURES {
            let mut wf = [0.0; LANES];
            for i in 0..LANES {
                wf[i] = weights[i] * f[a][i];
                self.right[a][i] += weighted[i] * f[a][i];
            }
            for b in a..FEATURES {
                for i in 0..LANES {
                    self.pairs[pair][i] += wf[i] * f[b][i];
                }
                pair += 1;
            }
        }
    }

    /// The sums over all lanes.
    #[inline(always)]
    fn total(&self) -> Gram {
        let mut information = [[0.0; FEATURES]; FEATURES];
        let mut pair = 0;
        for a in 0..FEATURES {
            for b in a..FEATURES {
                let value = sum(&self.pairs[pair]);
                information[a][b] = value;
                information[b][a] = value;
                pair += 1;
            }
        }
        let mut right = [0.0; FEATURES];
        for a in 0..FEATURES {
            right[a] = sum(&self.right[a]);
        }
        Gram {
            information,
            right,
            weight: sum(&self.weight),
            psi_squared: sum(&self.psi_squared),
            psi_slope: sum(&self.psi_slope),
            chi_squared: sum(&self.capped) * self.cutoff * self.cutoff,
            rejected: sum(&self.pixels) - sum(&self.kept),
        }
    }
}

#[inline(always)]
fn sum(lanes: &Lanes) -> f64 {
    let [a, b, c, d, e, f, g, h] = *lanes;
    // Halves first: one addition of vectors each.
    f64::from(((a + e) + (c + g)) + ((b + f) + (d + h)))
}
