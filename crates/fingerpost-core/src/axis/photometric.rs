//! The line that the pixels themselves make most likely.
//!
//! Both flanks are fitted at once: the bisector q = d + ϑ p, the half-width w₀ + w₁ p, a bend and a
//! bulge of the finger along the Legendre polynomial P₂(p / h), the blur, the middle of the round
//! end, and for each flank the brightness of the finger and of what is behind it
//! ([`profile`](super::profile)). With t = p / h, neither P₂ term shifts or turns the straight line
//! that runs closest to the medial line of an evenly seen finger.
//!
//! What no smooth model says is random from block to block ([`block`](super::block)): the inside
//! level, the background level and the place of the edge. Each has a variance that is estimated from
//! the picture itself, so that a flat scene costs nothing and a cluttered one widens the covariance
//! by what it is worth. Two things more keep clutter from being believed:
//!
//! - A block whose pixels scatter more than the others do has something in it that is not in the
//!   model, and counts less.
//! - Where the background's level changes from block to block, something begins or ends behind the
//!   finger, and whatever of it runs along the flank, nearer than the blur, has shifted the edge
//!   without a trace in the residuals. Such a shift is about the change of level over the contrast,
//!   times the distance over which the edge is blurred; that much is added to the variance of the
//!   block's edge. The same goes for where the finger's own level deviates: a nail does not end where
//!   the flank does.
//!
//! And where the edges of neighbouring blocks deviate alike, as at a joint, the blocks are no
//! independent witnesses: what they share counts several times.

#![expect(
    clippy::inline_always,
    reason = "what is inlined into a function with wider instructions is compiled for them"
)]

mod flank;
mod lanes;

use super::block::{EDGE_EFFECT, Evidence, INSIDE_EFFECT, OUTSIDE_EFFECT};
use super::blur::BlurTable;
use super::gram::Weighing;
use super::photometric::flank::Flank;
use super::photometric::lanes::{Linearising, Surveying, Tally};
use super::pixels::USUAL_BLOCKS;
use super::profile::{CLEAR, RoundEnd};
use super::sketch::{FlankLines, Sketch};
use super::unknowns::{
    BEND, BLUR_SIGMA_PX, BULGE, Factors, FlankEquations, FlankStep, Information,
    LEAST_CONTRAST_GREY, OFFSET, Prior, SLOPE, UNKNOWNS, Unknowns, Vector,
};
use super::visible_flanks::VisibleFlanks;
use crate::axis::{KnownBackground, PhotometricOptions, PhotometricReport, Stretch, unknowns};
use crate::image::gray::GrayView;
use crate::numeric::simd::Isa;
use nalgebra::{Cholesky, Const, Matrix2, Matrix4, Vector2};
use std::f64::consts::PI;

/// The first iteration takes residuals of this part of the contrast for noise: it starts from the
/// sketch, a part of a px off.
const FIRST_SCALE: f64 = 0.1;
/// Pixels scatter no less than this part of the image's noise: few that happen to agree prove
/// nothing.
const LEAST_SCALE: f64 = 0.7;
/// The median of χ² / n of blocks of some 25 pixels, (1 − 2 / 9 n)³.
const MEDIAN_OF_BLOCKS: f64 = 0.974;
/// Variances, weights of blocks and the scale are estimated in so many iterations, then held: the
/// rest is Gauss–Newton and converges.
const ADAPTING_ITERATIONS: usize = 8;
/// No iteration moves the flanks by more than this \[px\], or the blur by more than this part.
const LONGEST_STEP_PX: f64 = 1.0;
const LARGEST_BLUR_CHANGE: f64 = 0.3;
/// A step is as small as its noise allows if it is no longer than a third of a standard deviation in
/// all unknowns together: Gauss–Newton leaves a tenth of that. At half of one the line would be as
/// good, but what deviates from block to block is not told apart from noise yet.
const SMALL_STEP: f64 = 0.1;
/// After the last iteration allowed, a motion of so many tolerances is still taken for settled.
const NEARLY_SETTLED: f64 = 10.0;
/// A background that is known and there leaves this part of the blocks of either flank: where it is
/// not, some agree with it by chance.
const LEAST_USABLE: f64 = 0.7;
/// Levels to start from are those of the pixels so far inside and outside the sketch's edge \[px\].
const CLEAR_INSIDE_PX: f32 = 2.0;
const CLEAR_OUTSIDE_PX: f32 = 1.0;
/// The blur to start from is that of the pixels so near to the edge, but no less than that \[px\].
const NEAR_EDGE_PX: f32 = 2.5;
const LEAST_BLUR_PX: f64 = 0.4;

/// Fits lines to pixels; owns the buffers.
#[derive(Debug, Clone)]
pub(super) struct Photometric {
    options: PhotometricOptions,
    isa: Isa,
    table: BlurTable,
    flanks: [Flank; 2],
    sorted: Vec<f64>,
}

/// A photometric line in the frame of the sketch that it was fitted from.
#[derive(Debug, Clone, Copy)]
pub(super) struct PhotometricFit {
    pub line: FlankLines,
    /// The stretch in p over which a line of least squares runs as this one does.
    pub stretch: Stretch,
    /// Of d and ϑ.
    pub covariance: Matrix2<f64>,
    pub report: PhotometricReport,
}

/// The normal equations of all unknowns, and what the covariance needs beyond.
struct Normal {
    information: Information,
    right: Vector,
    tally: Tally,
}

impl Normal {
    /// With what is known beforehand, where a pixel scatters by `scale`.
    fn join(&mut self, prior: &Prior, x: &Unknowns, scale: f64) {
        for i in 0..UNKNOWNS {
            let own = scale * scale * prior.information[i];
            self.information[(i, i)] += own;
            self.right[i] += own * (prior.mean[i] - x.0[i]);
        }
    }
}

/// How a fit ended.
struct Ending {
    residual_grey: f64,
    bend_sigma_px: f64,
    iterations: usize,
    converged: bool,
}

impl Photometric {
    pub fn new(options: PhotometricOptions) -> Self {
        Self {
            options,
            isa: Isa::detect(),
            table: BlurTable::new(),
            flanks: [Flank::new(), Flank::new()],
            sorted: Vec::with_capacity(2 * USUAL_BLOCKS),
        }
    }

    /// The same with another instruction set.
    pub fn with_isa(self, isa: Isa) -> Self {
        Self { isa, ..self }
    }

    /// The line near the sketch, or `None` if too little of a flank shows or the pixels do not
    /// determine the line.
    pub fn fit(
        &mut self,
        image: &GrayView<'_>,
        background: Option<&KnownBackground<'_>>,
        noise_grey: f64,
        sketch: &Sketch,
        visible: &VisibleFlanks,
    ) -> Option<PhotometricFit> {
        if !self.gather(image, background, noise_grey, sketch, visible) {
            return None;
        }
        let mut x = self.start(sketch)?;
        let pixels = self.pixels() as f64;
        let contrast = [0, 1].map(|f| self.flanks[f].strip.contrast_grey(x.contrast_grey(f)).abs());
        let contrast = contrast[0].max(contrast[1]);
        let prior = Prior::about(&x, sketch, contrast, &self.options);
        let mut scale = (FIRST_SCALE * contrast.max(LEAST_CONTRAST_GREY)).max(noise_grey);
        let mut iteration = 0;
        loop {
            iteration += 1;
            let adapting = iteration <= ADAPTING_ITERATIONS;
            let mut normal = self.normal(sketch, &x, scale, iteration);
            let freedom = pixels / (pixels - UNKNOWNS as f64 - normal.tally.freed).max(1.0);
            if adapting {
                scale = self.residual_scale(scale, freedom).max(LEAST_SCALE * noise_grey);
            }
            normal.join(&prior, &x, scale);
            let factor = Cholesky::new(normal.information)?;
            let step = factor.solve(&normal.right);
            let motion = Unknowns::motion_px(&step, sketch.half_length_px);
            if !motion.is_finite() {
                return None;
            }
            let blur = LARGEST_BLUR_CHANGE * x.blur_px() / step[unknowns::BLUR].abs();
            let part = (LONGEST_STEP_PX / motion).min(blur).min(1.0);
            x.0 += step * part;
            self.follow(sketch, &step, part);
            // The square of the step in units of its covariance, of all unknowns together.
            let chi_squared = step.dot(&normal.right) / (scale * scale);
            let is_small = motion < self.options.tolerance_px || chi_squared < SMALL_STEP;
            let settled = iteration > 2 && is_small;
            if settled || iteration >= self.options.max_iterations {
                let settled = settled || motion < NEARLY_SETTLED * self.options.tolerance_px;
                let covariance = covariance(&factor, &normal.tally, freedom)?;
                let ending = Ending {
                    residual_grey: scale,
                    bend_sigma_px: covariance[(2, 2)].sqrt(),
                    iterations: iteration,
                    converged: settled,
                };
                let report = self.report(sketch, &x, &normal.tally, &ending);
                return straight(&x, &covariance, sketch.half_length_px, report);
            }
        }
    }

    /// Takes the pixels about both flanks out of the image, and whether each of them shows enough.
    fn gather(
        &mut self,
        image: &GrayView<'_>,
        background: Option<&KnownBackground<'_>>,
        noise_grey: f64,
        sketch: &Sketch,
        visible: &VisibleFlanks,
    ) -> bool {
        let Self { options, flanks, .. } = self;
        flanks.iter_mut().enumerate().all(|(index, flank)| {
            let Flank { strip, .. } = flank;
            strip.gather(image, background, noise_grey, sketch, &visible.flank(index), options);
            flank.begin();
            let is_contradicted = background.is_some() && flank.strip.usable() < LEAST_USABLE;
            flank.strip.blocks.len() >= options.min_blocks && !is_contradicted
        })
    }

    /// How many pixels are fitted.
    fn pixels(&self) -> usize {
        self.flanks.iter().map(|f| f.strip.pixels()).sum()
    }

    /// Where the search begins: on the sketch, with the middle levels of the blocks' pixels that are
    /// clear of the edge. `None` if a flank has none on either side.
    fn start(&mut self, sketch: &Sketch) -> Option<Unknowns> {
        let Self { isa, flanks, sorted, .. } = self;
        let mut levels = [[0.0; 2]; 2];
        for ([inside, outside], Flank { strip, .. }) in levels.iter_mut().zip(flanks) {
            let clear_inside = |away: f32, grey: f32, _: f32| (away < -CLEAR_INSIDE_PX, grey);
            isa.run(Surveying { strip, sketch, measure: clear_inside, mean: true, told: sorted });
            *inside = median(sorted)?;
            let clear_outside =
                |away: f32, grey: f32, behind: f32| (away > CLEAR_OUTSIDE_PX, grey - behind);
            isa.run(Surveying { strip, sketch, measure: clear_outside, mean: true, told: sorted });
            *outside = median(sorted)?;
        }
        let blur_px = self.shown_blur_px(sketch, &levels);
        Some(Unknowns::on(sketch, levels, blur_px))
    }

    /// The blur that the pixels about the sketch's edge show, between levels given for either flank,
    /// by the middle one of its blocks \[px\]. Of a step, n = (I − b) / (a − b) has
    /// ∫ n (1 − n) dy = s / √π; what shows more than the step, or less, counts for nothing.
    fn shown_blur_px(&mut self, sketch: &Sketch, levels: &[[f64; 2]; 2]) -> f64 {
        let Self { isa, flanks, sorted, .. } = self;
        let mut sum = 0.0;
        for (Flank { strip, .. }, levels) in flanks.iter().zip(levels) {
            let [a, b] = levels.map(|level| level as f32);
            let across_step = |away: f32, grey: f32, behind: f32| {
                let b = behind + b;
                let parts = ((grey - b) * (a - grey)).max(0.0);
                // Of no contrast there is no part.
                (away.abs() < NEAR_EDGE_PX, parts / ((a - b) * (a - b)).max(1.0))
            };
            isa.run(Surveying { strip, sketch, measure: across_step, mean: false, told: sorted });
            sum += 0.5 * median(sorted).unwrap_or(0.0);
        }
        let (shown, expected) = (PI.sqrt() * sum / self.options.block_px, self.options.blur_px);
        shown.clamp((expected - BLUR_SIGMA_PX).max(LEAST_BLUR_PX), expected + BLUR_SIGMA_PX)
    }

    /// Linearises the model at `x` and eliminates the deviations of every block.
    fn normal(&mut self, sketch: &Sketch, x: &Unknowns, scale: f64, iteration: usize) -> Normal {
        let mut normal = Normal {
            information: Information::zeros(),
            right: Vector::zeros(),
            tally: Tally::default(),
        };
        let weighing = Weighing { noise_grey: scale, cutoff: self.options.cutoff };
        for (index, flank) in self.flanks.iter_mut().enumerate() {
            let end_px = x.end_px(index);
            let end = sketch
                .end_radius_px()
                .map(|radius| RoundEnd { middle: end_px as f32, radius: radius as f32 });
            let mut equations = FlankEquations::default();
            let mut evidence = Evidence::default();
            self.isa.run(Linearising {
                flank,
                index,
                sketch,
                x,
                end,
                // Up to here no pixel of a block feels the round end.
                clear_px: end_px - CLEAR * x.blur_px() - 0.5 * self.options.block_px,
                table: self.table,
                weighing,
                reweighs: 1 < iteration && iteration <= ADAPTING_ITERATIONS,
                equations: &mut equations,
                evidence: &mut evidence,
                tally: &mut normal.tally,
            });
            equations.spread(index, &mut normal.information, &mut normal.right);
            if iteration <= ADAPTING_ITERATIONS {
                flank.adapt(&evidence, scale * scale, iteration);
                let contrast = x.contrast_grey(index);
                flank.watch_levels(self.options.restlessness_px, contrast, scale);
            }
        }
        normal
    }

    /// Takes all deviations along with a step of the unknowns.
    fn follow(&mut self, sketch: &Sketch, step: &Vector, part: f64) {
        let taken = step * part;
        for (index, flank) in self.flanks.iter_mut().enumerate() {
            let taken = FlankStep::of(&taken, index);
            for (group, deviations) in flank.strip.groups.iter().zip(&mut flank.deviations) {
                let factors = Factors::at(&group.p, sketch.half_length_px);
                deviations.follow(&taken.changes(&factors), part);
            }
        }
    }

    /// Standard deviation of a pixel: that of the middle one of the blocks, so that up to half of
    /// them may have something in them \[grey levels\].
    fn residual_scale(&mut self, scale: f64, freedom: f64) -> f64 {
        self.sorted.clear();
        for flank in &self.flanks {
            self.sorted.extend(flank.of_blocks(|deviations| &deviations.chi_squared));
        }
        let middle = median(&mut self.sorted).unwrap_or(1.0);
        scale * (middle * freedom / MEDIAN_OF_BLOCKS).sqrt()
    }

    fn report(
        &self,
        sketch: &Sketch,
        x: &Unknowns,
        tally: &Tally,
        ending: &Ending,
    ) -> PhotometricReport {
        let Ending { residual_grey, bend_sigma_px, iterations, converged } = *ending;
        let pixels = self.pixels();
        let blocks: usize = self.flanks.iter().map(|f| f.strip.blocks.len()).sum();
        let sigma = |effect: usize| [0, 1].map(|f| self.flanks[f].variances[effect].sqrt());
        PhotometricReport {
            pixels,
            rejected: tally.rejected / tally.pixels,
            blocks,
            trusted: tally.block_weight / blocks as f64,
            residual_grey,
            contrast_grey: [0, 1]
                .map(|f| self.flanks[f].strip.contrast_grey(x.shaded_contrast_grey(sketch, f))),
            inside_grey: sigma(INSIDE_EFFECT),
            outside_grey: sigma(OUTSIDE_EFFECT),
            edge_px: sigma(EDGE_EFFECT),
            blur_px: x.blur_px(),
            half_length_px: sketch.half_length_px,
            bend_px: x.0[BEND],
            bend_sigma_px,
            iterations,
            converged,
        }
    }
}

/// Covariance of d, ϑ, bend and bulge: that of a robust fit, E\[ψ²\] / E\[ψ′\]² H⁻¹.
fn covariance(
    factor: &Cholesky<f64, Const<UNKNOWNS>>,
    tally: &Tally,
    freedom: f64,
) -> Option<Matrix4<f64>> {
    let kappa = tally.psi_slope / tally.weight;
    let variance = freedom * tally.psi_squared / tally.weight / (kappa * kappa);
    if !(kappa > 0.0 && variance > 0.0) {
        return None;
    }
    let rows = [OFFSET, SLOPE, BEND, BULGE];
    let mut covariance = Matrix4::zeros();
    for (j, unknown) in rows.into_iter().enumerate() {
        let mut unit = Vector::zeros();
        unit[unknown] = variance;
        factor.solve_mut(&mut unit);
        for (i, row) in rows.into_iter().enumerate() {
            covariance[(i, j)] = unit[row];
        }
    }
    Some(covariance)
}

/// The straight line that runs closest to the bent medial line, where closeness counts by what the
/// pixels say: the estimate of d and ϑ given that there is no bend and no bulge.
fn straight(
    x: &Unknowns,
    covariance: &Matrix4<f64>,
    half_length_px: f64,
    report: PhotometricReport,
) -> Option<PhotometricFit> {
    let information = covariance.try_inverse()?;
    let own: Matrix2<f64> = information.fixed_view::<2, 2>(0, 0).into_owned();
    let to_bend: Matrix2<f64> = information.fixed_view::<2, 2>(0, 2).into_owned();
    let covariance = own.try_inverse()?;
    let by_bend = covariance * to_bend;
    let shift = by_bend * Vector2::new(x.0[BEND], x.0[BULGE]);
    let mut line = x.line();
    line.offset_px += shift.x;
    line.slope += shift.y;
    let stretch = stretch(&by_bend.column(0).into_owned(), half_length_px);
    let positive = covariance[(0, 0)] > 0.0 && covariance.determinant() > 0.0;
    positive.then_some(PhotometricFit { line, stretch, covariance, report })
}

/// The stretch over which a line of least squares through a bend of 1 px is `line` (offset and
/// slope): both cut the bend P₂(p / h) in the same two places, ± its half-length / √3 from its
/// middle.
fn stretch(line: &Vector2<f64>, h: f64) -> Stretch {
    let middle_px = line.y * h * h / 3.0;
    let cut_px2 = middle_px * middle_px + h * h * (1.0 + 2.0 * line.x) / 3.0;
    Stretch::cut(middle_px, cut_px2)
}

fn median(values: &mut [f64]) -> Option<f64> {
    let middle = values.len() / 2;
    if values.is_empty() {
        return None;
    }
    Some(*values.select_nth_unstable_by(middle, f64::total_cmp).1)
}
