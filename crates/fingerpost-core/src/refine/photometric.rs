//! The line that the pixels themselves make most likely.
//!
//! Both flanks are fitted at once: the bisector q = d + ϑ p, the half-width w₀ + w₁ p, a bend and a
//! bulge of the finger along the Legendre polynomial P₂(p / h), the blur, the middle of the round
//! end, and for each flank the brightness of the finger and of what is behind it
//! ([`profile`](super::profile)). Neither P₂ term shifts or turns the straight line that runs closest
//! to the medial line.
//!
//! What no smooth model says is random from block to block: the inside level, the background level
//! and the place of the edge. Each of these has a variance, estimated from the picture itself, and is
//! eliminated block by block (Schur complement), so that a flat scene costs nothing and a cluttered
//! one widens the covariance by what it is worth.

use super::blur::BlurTable;
use super::gram::{Accumulator, Gram, Weighing};
use super::pixels::{Block, Strip};
use super::profile::{self, CLEAR, EDGE, FEATURES, INSIDE, LIMB, OUTSIDE, Profile, RAMP, RoundEnd};
use super::sketch::{FlankLines, SIDES, Sketch};
use super::{KnownBackground, PhotometricOptions, PhotometricReport};
use crate::image::GrayView;
use nalgebra::{Cholesky, Matrix2, Matrix3, Matrix4, SMatrix, SVector, Vector2, Vector3};

/// Unknowns that both flanks share.
mod shared {
    pub const OFFSET: usize = 0;
    pub const SLOPE: usize = 1;
    pub const BEND: usize = 2;
    pub const HALF_WIDTH: usize = 3;
    pub const TAPER: usize = 4;
    pub const BULGE: usize = 5;
    pub const BLUR: usize = 6;
    pub const END: usize = 7;
    pub const INSIDE_CHANGE: usize = 8;
    pub const OUTSIDE_CHANGE: usize = 9;
    pub const COUNT: usize = 10;
}
/// Unknowns of each flank, counted from the first of its own.
mod own {
    pub const INSIDE: usize = 0;
    pub const OUTSIDE: usize = 1;
    pub const RAMP: usize = 2;
    pub const LIMB: usize = 3;
    pub const COUNT: usize = 4;
}
const UNKNOWNS: usize = shared::COUNT + 2 * own::COUNT;
type Unknowns = SVector<f64, UNKNOWNS>;

/// What one flank depends on: which feature, times which function of p.
const FLANK: usize = 11;
const FLANK_FEATURE: [usize; FLANK] =
    [EDGE, EDGE, EDGE, profile::BLUR, profile::END, INSIDE, OUTSIDE, INSIDE, OUTSIDE, RAMP, LIMB];
/// The unknowns as a flank sees them: edge coefficients are those of the bisector, with the side's
/// sign, plus those of the half-width.
const PARTS: usize = shared::COUNT + own::COUNT;
const PART_SLOT: [usize; PARTS] = [0, 1, 2, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10];

fn part_unknown(part: usize, flank: usize) -> usize {
    if part < shared::COUNT { part } else { part + flank * own::COUNT }
}
fn part_sign(part: usize, side: f64) -> f64 {
    if part < 3 { side } else { 1.0 }
}

/// The random effects of a block.
const EFFECTS: [usize; 3] = [INSIDE, OUTSIDE, EDGE];

/// The median of χ²/n of a block of some 25 pixels, (1 − 2/9n)³.
const MEDIAN_OF_BLOCK: f64 = 0.974;

/// What a block deviates by, and what its equations were when it was last looked at.
#[derive(Debug, Clone, Copy)]
struct State {
    effects: Vector3<f64>,
    /// (H_yy + Λ)⁻¹, its right side, and H_xy.
    inverse: Matrix3<f64>,
    right: Vector3<f64>,
    coupling: [[f64; 3]; FEATURES],
    factors: [f64; FLANK],
    score: [f64; FEATURES],
    say: f64,
    chi: f64,
    edge: f64,
}

#[derive(Debug, Clone)]
pub(super) struct Photometric {
    options: PhotometricOptions,
    table: BlurTable,
    strips: [Strip; 2],
    states: [Vec<State>; 2],
    /// Variance of each random effect, by flank, in the square of its unit.
    variances: [Vector3<f64>; 2],
    sorted: Vec<f64>,
}

#[derive(Debug, Clone, Copy)]
pub(super) struct PhotometricFit {
    pub line: FlankLines,
    pub covariance: Matrix2<f64>,
    pub report: PhotometricReport,
}

struct Normal {
    h: SMatrix<f64, UNKNOWNS, UNKNOWNS>,
    g: Unknowns,
    weight: f64,
    psi_squared: f64,
    psi_slope: f64,
    rejected: f64,
    freed: f64,
    say: f64,
}

impl Photometric {
    pub fn new(options: PhotometricOptions) -> Self {
        Self {
            options,
            table: BlurTable::new(),
            strips: [Strip::default(), Strip::default()],
            states: [Vec::new(), Vec::new()],
            variances: [Vector3::zeros(); 2],
            sorted: Vec::new(),
        }
    }

    pub fn fit(
        &mut self,
        image: &GrayView<'_>,
        background: Option<&KnownBackground<'_>>,
        noise_grey: f64,
        sketch: &Sketch,
    ) -> Option<PhotometricFit> {
        for (flank, strip) in self.strips.iter_mut().enumerate() {
            strip.gather(image, background, sketch, flank, &self.options);
            if strip.blocks.len() < self.options.min_blocks {
                return None;
            }
        }
        for (states, strip) in self.states.iter_mut().zip(&self.strips) {
            states.clear();
            states.resize(
                strip.blocks.len(),
                State {
                    effects: Vector3::zeros(),
                    inverse: Matrix3::zeros(),
                    right: Vector3::zeros(),
                    coupling: [[0.0; 3]; FEATURES],
                    factors: [0.0; FLANK],
                    score: [0.0; FEATURES],
                    say: 1.0,
                    chi: 1.0,
                    edge: 0.0,
                },
            );
        }
        self.variances = [Vector3::zeros(); 2];
        let pixels = self.strips.iter().map(Strip::pixels).sum::<usize>() as f64;
        let mut x = self.start(sketch);
        let contrast = [0, 1]
            .map(|f| {
                let own = shared::COUNT + f * own::COUNT;
                (x[own + own::INSIDE] - x[own + own::OUTSIDE]).abs()
            })
            .iter()
            .fold(10.0, |a: f64, &b| a.max(b));
        let mean = x;
        let prior = self.prior(contrast);
        let mut scale = (0.1 * contrast).max(noise_grey);
        let mut iteration = 0;
        loop {
            iteration += 1;
            let mut normal = self.normal(sketch, &x, scale, iteration);
            let freedom = pixels / (pixels - UNKNOWNS as f64 - normal.freed).max(1.0);
            let estimated = self.block_scale(scale, freedom).max(0.7 * noise_grey);
            let v = estimated * estimated;
            for i in 0..UNKNOWNS {
                normal.h[(i, i)] += v * prior[i];
                normal.g[i] += v * prior[i] * (mean[i] - x[i]);
            }
            let factor = Cholesky::new(normal.h)?;
            let mut step = factor.solve(&normal.g);
            let l = sketch.half_length_px;
            let motion = step[shared::OFFSET].abs()
                + l * step[shared::SLOPE].abs()
                + step[shared::HALF_WIDTH].abs()
                + l * step[shared::TAPER].abs();
            let part =
                (1.0 / motion).min(0.3 * x[shared::BLUR] / step[shared::BLUR].abs()).min(1.0);
            step *= part;
            x += step;
            self.move_effects(&step, part);
            scale = estimated;
            let settled = motion < self.options.tolerance_px && iteration > 2;
            if !settled && iteration < self.options.max_iterations {
                continue;
            }
            return self
                .report(sketch, &x, &normal, &factor, pixels, iteration, estimated, settled);
        }
    }

    fn report(
        &self,
        sketch: &Sketch,
        x: &Unknowns,
        normal: &Normal,
        factor: &Cholesky<f64, nalgebra::Const<UNKNOWNS>>,
        pixels: f64,
        iterations: usize,
        estimated: f64,
        settled: bool,
    ) -> Option<PhotometricFit> {
        let n = pixels;
        let dof = n / (n - UNKNOWNS as f64 - normal.freed);
        let kappa = normal.psi_slope / normal.weight;
        let variance = normal.psi_squared / normal.weight * dof / (kappa * kappa);
        let pick = [shared::OFFSET, shared::SLOPE, shared::BEND, shared::BULGE];
        let mut c4 = Matrix4::zeros();
        for (j, &unknown) in pick.iter().enumerate() {
            let column = factor.solve(&Unknowns::from_fn(|i, _| f64::from(u8::from(i == unknown))));
            for (i, &row) in pick.iter().enumerate() {
                c4[(i, j)] = variance * column[row];
            }
        }
        // Of all straight lines the one that the bent medial line is least unlikely to be.
        let information = c4.try_inverse()?;
        let own = information.fixed_view::<2, 2>(0, 0).into_owned();
        let to_bend = information.fixed_view::<2, 2>(0, 2).into_owned();
        let covariance = own.try_inverse()?;
        let shift = covariance * (to_bend * Vector2::new(x[shared::BEND], x[shared::BULGE]));
        let line = FlankLines {
            offset_px: x[shared::OFFSET] + shift.x,
            slope: x[shared::SLOPE] + shift.y,
            half_width_px: x[shared::HALF_WIDTH],
            taper: x[shared::TAPER],
        };
        let contrast_grey = [0, 1].map(|f| {
            let own = shared::COUNT + f * own::COUNT;
            x[own + own::INSIDE] - x[own + own::OUTSIDE]
        });
        let report = PhotometricReport {
            pixels: pixels as usize,
            residual_grey: estimated,
            rejected: normal.rejected / pixels,
            blocks: self.states.iter().map(Vec::len).sum(),
            say: normal.say,
            blur_px: x[shared::BLUR],
            bend_px: x[shared::BEND],
            contrast_grey,
            texture_grey: self.variances.map(|v| [v[0].sqrt(), v[1].sqrt()]),
            jitter_px: self.variances.map(|v| v[2].sqrt()),
            iterations,
            converged: settled,
        };
        Some(PhotometricFit { line, covariance, report })
    }

    /// Where the search begins: on the sketch, with the levels that the pixels clear of it have.
    fn start(&mut self, sketch: &Sketch) -> Unknowns {
        let mut x = Unknowns::zeros();
        x[shared::HALF_WIDTH] = sketch.half_width_px;
        x[shared::TAPER] = sketch.taper;
        x[shared::BLUR] = self.options.blur_px;
        x[shared::END] = sketch.round_end_px.unwrap_or(0.0);
        for f in 0..2 {
            let strip = &self.strips[f];
            for (own, inside) in [(own::INSIDE, true), (own::OUTSIDE, false)] {
                self.sorted.clear();
                for block in &strip.blocks {
                    let half_width = sketch.half_width_at(block.p) as f32;
                    let (mut sum, mut n) = (0.0, 0.0);
                    for c in strip.chunks(block) {
                        for i in 0..c.p.len() {
                            let y = c.v[i] - half_width;
                            let clear = if inside { y < -2.0 } else { y > 1.0 };
                            if clear && c.weight[i] > 0.0 {
                                sum += f64::from(
                                    c.grey[i] - c.background[i] * f32::from(u8::from(!inside)),
                                );
                                n += 1.0;
                            }
                        }
                    }
                    if n > 0.0 {
                        self.sorted.push(sum / n);
                    }
                }
                x[shared::COUNT + f * own::COUNT + own] = median(&mut self.sorted).unwrap_or(0.0);
            }
        }
        x
    }

    fn prior(&self, contrast: f64) -> Unknowns {
        let o = &self.options;
        let mut prior = Unknowns::zeros();
        let sd = |s: f64| s.powi(-2);
        prior[shared::OFFSET] = sd(3.0);
        prior[shared::SLOPE] = sd(0.1);
        prior[shared::HALF_WIDTH] = sd(2.0);
        prior[shared::TAPER] = sd(0.1);
        prior[shared::BEND] = sd(o.bend_px);
        prior[shared::BULGE] = sd(o.bend_px);
        prior[shared::BLUR] = sd(1.0);
        prior[shared::END] = sd(1.0);
        prior[shared::INSIDE_CHANGE] = sd(o.change * contrast);
        prior[shared::OUTSIDE_CHANGE] = sd(o.change * contrast);
        for f in 0..2 {
            let own = shared::COUNT + f * own::COUNT;
            prior[own + own::RAMP] = sd(o.ramp * contrast);
            prior[own + own::LIMB] = sd(o.limb * contrast);
        }
        prior
    }

    fn profile(
        sketch: &Sketch,
        x: &Unknowns,
        f: usize,
        block: &Block,
        effects: &Vector3<f64>,
    ) -> Profile {
        let (side, h) = (SIDES[f], sketch.half_length_px);
        let at = |k: usize| side * x[shared::OFFSET + k] + x[shared::HALF_WIDTH + k];
        let own = shared::COUNT + f * own::COUNT;
        // e₀ + e₁ p + e₂ P₂, in powers of p.
        let [e0, e1, e2] = [at(0), at(1), at(2)];
        Profile {
            edge: [(e0 - 0.5 * e2 + effects[2]) as f32, e1 as f32, (1.5 * e2 / (h * h)) as f32],
            blur: x[shared::BLUR] as f32,
            inside: [
                (x[own + own::INSIDE] + effects[0]) as f32,
                (x[shared::INSIDE_CHANGE] / h) as f32,
            ],
            outside: [
                (x[own + own::OUTSIDE] + effects[1]) as f32,
                (x[shared::OUTSIDE_CHANGE] / h) as f32,
            ],
            ramp: x[own + own::RAMP] as f32,
            limb: x[own + own::LIMB] as f32,
            half_width: sketch.half_width_at(block.p).max(1.0) as f32,
        }
    }

    fn normal(&mut self, sketch: &Sketch, x: &Unknowns, scale: f64, iteration: usize) -> Normal {
        let mut n = Normal {
            h: SMatrix::zeros(),
            g: Unknowns::zeros(),
            weight: 0.0,
            psi_squared: 0.0,
            psi_slope: 0.0,
            rejected: 0.0,
            freed: 0.0,
            say: 0.0,
        };
        let weighing = Weighing { noise_grey: scale, cutoff: self.options.cutoff };
        let o = self.options;
        let v = scale * scale;
        for f in 0..2 {
            let strip = &self.strips[f];
            let end = sketch
                .end_radius_px()
                .map(|radius| RoundEnd { middle: x[shared::END] as f32, radius: radius as f32 });
            let clear = x[shared::END] - CLEAR * x[shared::BLUR] - 0.5 * self.options.block_px;
            let mut h = [[0.0; FLANK]; FLANK];
            let mut g = [0.0; FLANK];
            let mut excess = Vector3::<f64>::zeros();
            let mut count = Vector3::<f64>::zeros();
            for (block, state) in strip.blocks.iter().zip(&mut self.states[f]) {
                let profile = Self::profile(sketch, x, f, block, &state.effects);
                let mut sums = Accumulator::new(&weighing);
                for chunk in strip.chunks(block) {
                    let predicted = match &end {
                        Some(end) if block.p > clear => profile.round(self.table, chunk, end),
                        _ => profile.straight(self.table, chunk),
                    };
                    sums.add(chunk, &predicted);
                }
                let mut gram: Gram = sums.total();
                state.chi = gram.chi_squared / block.pixels as f64;
                n.rejected += gram.rejected;
                // effects
                let live = iteration > 1;
                let mut lambda = Vector3::repeat(1e12 * v);
                if live {
                    for k in 0..3 {
                        if o.effects[k] > 0.0 {
                            lambda[k] = v / (o.effects[k] * self.variances[f][k]).max(1e-12);
                        }
                    }
                }
                // the edge's own deviation, given the levels
                let hyy = Matrix3::from_fn(|i, k| gram.information[EFFECTS[i]][EFFECTS[k]]);
                let gy = Vector3::from_fn(|i, _| gram.right[EFFECTS[i]]);
                for k in 0..2 {
                    let free = state.effects[k] + gy[k] / hyy[(k, k)].max(1e-9);
                    excess[k] += state.say * (hyy[(k, k)] * free * free - v);
                    count[k] += state.say * hyy[(k, k)];
                }
                let mut levels = Matrix2::new(
                    hyy[(0, 0)] + lambda[0],
                    hyy[(0, 1)],
                    hyy[(1, 0)],
                    hyy[(1, 1)] + lambda[1],
                );
                let c = Vector2::new(hyy[(0, 2)], hyy[(1, 2)]);
                if let Some(i) = levels.try_inverse() {
                    levels = i;
                }
                let he = (hyy[(2, 2)] - c.dot(&(levels * c))).max(1e-9);
                let gl = Vector2::new(
                    gy[0] - lambda[0] * state.effects[0],
                    gy[1] - lambda[1] * state.effects[1],
                );
                let ge = gy[2] - c.dot(&(levels * gl));
                let free = state.effects[2] + ge / he;
                let ratio = he * free * free / v;
                state.edge = ratio;
                excess[2] += state.say * (he * free * free - v);
                count[2] += state.say * he;
                // say
                if live {
                    let j = ratio / (1.0 + he * self.variances[f][2] / v);
                    let chi = (state.chi / (if o.t1 > 0.0 { o.t1 } else { 1e9 })).max(1e-9);
                    let w_chi = if chi > 1.0 { 1.0 / (chi * chi) } else { 1.0 };
                    let w_j = if o.nu > 0.0 { (o.nu + 1.0) / (o.nu + j) } else { 1.0 };
                    state.say = w_chi * w_j.min(1.0);
                }
                n.say += state.say;
                let say = state.say;
                let mut reduced = gram.information;
                let mut right = gram.right;
                let inverse =
                    Matrix3::from_fn(|i, k| hyy[(i, k)] + if i == k { lambda[i] } else { 0.0 })
                        .try_inverse()
                        .unwrap_or_else(Matrix3::zeros);
                let gy = gy - lambda.component_mul(&state.effects);
                for i in 0..FEATURES {
                    for k in 0..3 {
                        state.coupling[i][k] = gram.information[i][EFFECTS[k]];
                    }
                }
                state.inverse = inverse;
                state.right = gy;
                if live {
                    for i in 0..FEATURES {
                        let row = Vector3::from(state.coupling[i]).transpose() * inverse;
                        right[i] -= (row * gy)[0];
                        for j in 0..FEATURES {
                            reduced[i][j] -= (row * Vector3::from(state.coupling[j]))[0];
                        }
                    }
                    for k in 0..3 {
                        n.freed += inverse[(k, k)] * hyy[(k, k)];
                    }
                } else {
                    state.inverse = Matrix3::zeros();
                }
                gram.information = reduced;
                state.score = right;
                n.weight += say * gram.weight;
                n.psi_squared += say * gram.psi_squared;
                n.psi_slope += say * gram.psi_slope;
                let t = block.p / sketch.half_length_px;
                let factors = [1.0, block.p, 1.5 * t * t - 0.5, 1.0, 1.0, t, t, 1.0, 1.0, 1.0, 1.0];
                state.factors = factors;
                for i in 0..FLANK {
                    let fi = FLANK_FEATURE[i];
                    g[i] += say * factors[i] * right[fi];
                    for j in 0..FLANK {
                        h[i][j] += say * factors[i] * factors[j] * reduced[fi][FLANK_FEATURE[j]];
                    }
                }
            }
            for k in 0..3 {
                self.variances[f][k] = (excess[k] / count[k]).max(0.0);
            }
            for i in 0..PARTS {
                let (ui, si, ki) = (part_unknown(i, f), part_sign(i, SIDES[f]), PART_SLOT[i]);
                n.g[ui] += si * g[ki];
                for j in 0..PARTS {
                    n.h[(ui, part_unknown(j, f))] +=
                        si * part_sign(j, SIDES[f]) * h[ki][PART_SLOT[j]];
                }
            }
        }
        n
    }

    fn move_effects(&mut self, step: &Unknowns, part: f64) {
        for f in 0..2 {
            let mut slots = [0.0; FLANK];
            for i in 0..PARTS {
                slots[PART_SLOT[i]] += part_sign(i, SIDES[f]) * step[part_unknown(i, f)];
            }
            for state in &mut self.states[f] {
                let mut by_feature = [0.0; FEATURES];
                for i in 0..FLANK {
                    by_feature[FLANK_FEATURE[i]] += state.factors[i] * slots[i];
                }
                let mut right = state.right * part;
                for (c, b) in state.coupling.iter().zip(by_feature) {
                    right -= Vector3::from(*c) * b;
                }
                state.effects += state.inverse * right;
            }
        }
    }

    /// Standard deviation of a pixel, from the middle one of the blocks.
    fn block_scale(&mut self, scale: f64, freedom: f64) -> f64 {
        self.sorted.clear();
        self.sorted.extend(self.states.iter().flatten().map(|s| s.chi));
        let chi = median(&mut self.sorted).unwrap_or(1.0);
        (chi * freedom / MEDIAN_OF_BLOCK).sqrt() * scale
    }
}

fn median(values: &mut [f64]) -> Option<f64> {
    let middle = values.len() / 2;
    if values.is_empty() {
        return None;
    }
    Some(*values.select_nth_unstable_by(middle, f64::total_cmp).1)
}
