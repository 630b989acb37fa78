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
use super::profile::{END, FEATURES, OUTSIDE, Prediction, Profile, RoundEnd};

/// How a pixel's residual is weighed: Tukey's biweight.
#[derive(Debug, Clone, Copy)]
pub(super) struct Weighing {
    /// Standard deviation σ of a pixel \[grey levels\].
    pub noise_grey: f64,
    /// Where the weight reaches zero, in σ.
    pub cutoff: f64,
}

/// Features beside a last column for what stands on the right side of equations.
pub(super) const RIGHT: usize = FEATURES;
pub(super) type Augmented<T> = [[T; FEATURES + 1]; FEATURES];

/// Sums over the pixels of one block.
#[derive(Debug, Clone, Copy)]
pub(super) struct Gram {
    /// Σ w f fᵀ, and Σ w f r.
    pub equations: Augmented<f64>,
    /// Σ w, Σ w² r² and Σ ψ′, which make the covariance of a robust fit.
    pub weight: f64,
    pub psi_squared: f64,
    pub psi_slope: f64,
    /// Σ min(r², cutoff² σ²), in σ².
    pub chi_squared: f64,
    /// Pixels of no weight.
    pub rejected: f64,
}

impl Gram {
    /// The sums of a block whose pixels should look like `profile`, near a round end or clear of it.
    #[inline(always)]
    pub fn of(
        chunks: &[Chunk],
        profile: &Profile,
        end: Option<RoundEnd>,
        table: BlurTable,
        weighing: &Weighing,
    ) -> Self {
        let mut sums = Accumulator::new(weighing);
        if let Some(end) = end {
            for chunk in chunks {
                sums.add::<FEATURES>(chunk, &profile.round(table, chunk, end));
            }
            sums.total::<FEATURES>()
        } else {
            for chunk in chunks {
                sums.add::<END>(chunk, &profile.straight(table, chunk));
            }
            sums.total::<END>()
        }
    }
}

/// The sums lane by lane.
struct Accumulator {
    per_cut: f32,
    per_noise2: f32,
    equations: Augmented<Lanes>,
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
            equations: [[[0.0; LANES]; _]; _],
            weight: [0.0; LANES],
            psi_squared: [0.0; LANES],
            psi_slope: [0.0; LANES],
            capped: [0.0; LANES],
            kept: [0.0; LANES],
            pixels: [0.0; LANES],
            cutoff,
        }
    }

    /// Adds the pixels of a chunk, by the first `N` features: the others are zero.
    #[inline(always)]
    fn add<const N: usize>(&mut self, chunk: &Chunk, predicted: &Prediction) {
        let f = &predicted.features;
        let (mut weights, mut residuals) = ([0.0; LANES], [0.0; LANES]);
        for i in 0..LANES {
            let r = chunk.grey[i] - predicted.grey[i];
            // A pixel of doubtful background is as noisy as the part of it that shows.
            let doubt = chunk.doubt[i] * self.per_noise2;
            let shown = f[OUTSIDE][i];
            let precision = chunk.weight[i] / (1.0 + shown * shown * doubt);
            let t = r * self.per_cut;
            let t2 = t * t * precision;
            let left = if t2 < 1.0 { 1.0 - t2 } else { 0.0 };
            let inside = if t2 < 1.0 { chunk.weight[i] } else { 0.0 };
            let robust = left * left;
            let w = robust * precision;
            residuals[i] = r;
            weights[i] = w;
            self.weight[i] += robust * chunk.weight[i];
            self.psi_squared[i] += robust * w * r * r;
            self.psi_slope[i] += inside * left * (1.0 - 5.0 * t2);
            self.capped[i] += if t2 < 1.0 { t2 } else { 1.0 };
            self.kept[i] += inside;
            self.pixels[i] += chunk.weight[i];
        }
        for a in 0..N {
            let mut wf = [0.0; LANES];
            for i in 0..LANES {
                wf[i] = weights[i] * f[a][i];
                self.equations[a][RIGHT][i] += wf[i] * residuals[i];
            }
            for b in a..N {
                for i in 0..LANES {
                    self.equations[a][b][i] += wf[i] * f[b][i];
                }
            }
        }
    }

    /// The sums over all lanes.
    #[inline(always)]
    fn total<const N: usize>(&self) -> Gram {
        let mut equations = [[0.0; _]; _];
        for a in 0..N {
            equations[a][RIGHT] = sum(&self.equations[a][RIGHT]);
            for b in a..N {
                let value = sum(&self.equations[a][b]);
                equations[a][b] = value;
                equations[b][a] = value;
            }
        }
        Gram {
            equations,
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
