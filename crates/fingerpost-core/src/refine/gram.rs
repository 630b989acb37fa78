//! Weighted moments of a block's residuals and features: all that the fit needs of its pixels.

#![expect(
    clippy::needless_range_loop,
    reason = "lane by lane through many arrays at once is what the compiler turns into vectors"
)]

use super::pixels::{Chunk, LANES, Lanes};
use super::profile::{FEATURES, OUTSIDE, Prediction};

/// How a pixel's residual is weighed: Tukey's biweight.
#[derive(Debug, Clone, Copy)]
pub(super) struct Weighing {
    /// Standard deviation σ of a pixel \[grey levels\].
    pub noise_grey: f64,
    /// Where the weight reaches zero, in σ.
    pub cutoff: f64,
}

/// Sums over the pixels of one block.
#[derive(Debug, Clone, Copy, PartialEq)]
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

/// Entries of a symmetric matrix of the features.
const PAIRS: usize = FEATURES * (FEATURES + 1) / 2;

/// The sums lane by lane.
pub(super) struct Accumulator {
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
    pub fn new(weighing: &Weighing) -> Self {
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
    #[inline]
    pub fn add(&mut self, chunk: &Chunk, predicted: &Prediction) {
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
    pub fn total(&self) -> Gram {
        let mut information = [[0.0; FEATURES]; FEATURES];
        let mut pairs = self.pairs.iter().map(sum);
        for a in 0..FEATURES {
            for b in a..FEATURES {
                let value = pairs.next().unwrap_or_default();
                information[a][b] = value;
                information[b][a] = value;
            }
        }
        Gram {
            information,
            right: self.right.each_ref().map(sum),
            weight: sum(&self.weight),
            psi_squared: sum(&self.psi_squared),
            psi_slope: sum(&self.psi_slope),
            chi_squared: sum(&self.capped) * self.cutoff * self.cutoff,
            rejected: sum(&self.pixels) - sum(&self.kept),
        }
    }
}

fn sum(lanes: &Lanes) -> f64 {
    f64::from(lanes.iter().sum::<f32>())
}
