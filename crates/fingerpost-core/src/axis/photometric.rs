//! Maximum-likelihood fit of the finger's two flanks to the pixels.
//!
//! Both flanks are fitted at once. The unknowns are the bisector q = d + ϑ p, the half-width w₀ +
//! w₁ p, a bend and a bulge of the finger along the Legendre polynomial P₂(p / h), the blur, the
//! centre of the round end, and for each flank the levels of finger and background
//! ([`profile`](super::profile)). With t = p / h, neither P₂ term shifts or turns the least-squares
//! line through the medial line of an evenly sampled finger.
//!
//! Deviations from the smooth model are random effects per block ([`block`](super::block)): inside
//! level, background level and edge position. Their variances are estimated from the image, so a
//! uniform scene costs no accuracy and clutter inflates the covariance. Two further measures reduce
//! the influence of clutter:
//!
//! - A block whose pixels scatter more than those of the others contains structure that the model
//!   lacks, and is weighted down.
//! - A change of the background's level from block to block shows an edge behind the finger. Where
//!   it runs along the flank within the blur, it shifts the measured edge and leaves no residual.
//!   The shift is about (change of level / contrast) × (width of the blurred edge); its square is
//!   added to the variance of the block's edge. Deviations of the finger's own level are treated
//!   in the same way, because a nail does not end at the flank.
//!
//! Where the edges of neighbouring blocks deviate together, as at a joint, the blocks are not
//! independent, and their common deviation enters the variance several times.

#![expect(
    clippy::inline_always,
    reason = "what is inlined into a function with wider instructions is compiled for them"
)]

mod flank;
mod lanes;

use super::Stretch;
use super::block::{EDGE_EFFECT, Evidence};
use super::blur::BlurTable;
use super::finger_estimate::{FingerEstimate, FlankLines};
use super::gram::Weighing;
use super::photometric::flank::PhotometricFlank;
use super::photometric::lanes::{Linearising, PixelSums, Surveying};
use super::pixels::USUAL_BLOCKS;
use super::profile::{CLEAR, RoundEnd};
use super::unknowns::{
    BEND, BLUR_SIGMA_PX, BULGE, Factors, FlankEquations, FlankStep, LEAST_CONTRAST_GREY, OFFSET,
    SLOPE, UNKNOWNS, Unknowns, UnknownsInformation, UnknownsPrior, UnknownsVector,
};
use super::visible_flanks::VisibleFlanks;
use crate::axis::{KnownBackground, PhotometricOptions, PhotometricReport, unknowns};
use crate::image::gray::GrayView;
use crate::numeric::simd::Isa;
use nalgebra::{Cholesky, Const, Matrix2, Matrix4, Vector2};
use std::f64::consts::PI;

/// Residual scale of the first iteration as a fraction of the contrast: the estimate is a fraction
/// of a px off.
const FIRST_SCALE: f64 = 0.1;
/// Lower bound on the residual scale, as a fraction of the image noise: a few pixels that agree by
/// chance must not set it.
const LEAST_SCALE: f64 = 0.7;
/// Median of χ² / n of blocks of about 25 pixels, (1 − 2 / 9 n)³.
const MEDIAN_OF_BLOCKS: f64 = 0.974;
/// Number of iterations that re-estimate variances, block weights and residual scale. They are held
/// afterwards, so that the remaining Gauss–Newton iterations converge.
const ADAPTING_ITERATIONS: usize = 8;
/// Upper bounds per iteration on the motion of the flanks \[px\] and on the relative change of the
/// blur.
const LONGEST_STEP_PX: f64 = 1.0;
const LARGEST_BLUR_CHANGE: f64 = 0.3;
/// Convergence threshold on the χ² of a step: a third of a standard deviation in all unknowns
/// together. Gauss–Newton leaves a tenth of that. At half a standard deviation the line would be as
/// good, but the block deviations are not yet separated from noise.
const SMALL_STEP: f64 = 0.1;
/// After the last iteration, a motion of at most this many tolerances still counts as converged.
const NEARLY_SETTLED: f64 = 10.0;
/// A known background that is present leaves at least this fraction of the blocks of either flank
/// usable. Where it is absent, some blocks agree with it by chance.
const LEAST_USABLE: f64 = 0.7;
/// Initial levels come from pixels at least this far inside and outside the estimate's edge \[px\].
const CLEAR_INSIDE_PX: f32 = 2.0;
const CLEAR_OUTSIDE_PX: f32 = 1.0;
/// The initial blur is estimated from pixels within this distance of the edge, and has this lower
/// bound \[px\].
const NEAR_EDGE_PX: f32 = 2.5;
const LEAST_BLUR_PX: f64 = 0.4;

/// Fits lines to pixels; owns the buffers.
#[derive(Debug, Clone)]
pub(super) struct Photometric {
    options: PhotometricOptions,
    isa: Isa,
    table: BlurTable,
    flanks: [PhotometricFlank; 2],
    sorted: Vec<f64>,
}

/// A photometric line, in the frame of the estimate it was fitted from.
#[derive(Debug, Clone, Copy)]
pub(super) struct PhotometricFit {
    pub line: FlankLines,
    /// The stretch in p whose least-squares line this is.
    pub stretch: Stretch,
    /// Of d and ϑ.
    pub covariance: Matrix2<f64>,
    pub report: PhotometricReport,
}

/// Normal equations of all unknowns, and the sums that the covariance needs besides.
struct Normal {
    information: UnknownsInformation,
    right: UnknownsVector,
    tally: PixelSums,
}

impl Normal {
    /// Adds the prior, for pixels of standard deviation `scale`.
    fn join(&mut self, prior: &UnknownsPrior, x: &Unknowns, scale: f64) {
        for i in 0..UNKNOWNS {
            let own = scale * scale * prior.information[i];
            self.information[(i, i)] += own;
            self.right[i] += own * (prior.mean[i] - x.0[i]);
        }
    }
}

/// State of a fit at its end.
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
            flanks: [PhotometricFlank::new(), PhotometricFlank::new()],
            sorted: Vec::with_capacity(2 * USUAL_BLOCKS),
        }
    }

    /// The same fit for another instruction set.
    pub fn with_isa(self, isa: Isa) -> Self {
        Self { isa, ..self }
    }

    /// The line near the estimate. `None` if too little of a flank is visible or the pixels do not
    /// determine the line.
    pub fn fit(
        &mut self,
        image: &GrayView<'_>,
        background: Option<&KnownBackground<'_>>,
        noise_grey: f64,
        estimate: &FingerEstimate,
        visible: &VisibleFlanks,
    ) -> Option<PhotometricFit> {
        if !self.gather(image, background, noise_grey, estimate, visible) {
            return None;
        }
        let mut x = self.start(estimate)?;
        let pixels = self.pixels() as f64;
        let contrast = [0, 1].map(|f| self.flanks[f].strip.contrast_grey(x.contrast_grey(f)).abs());
        let contrast = contrast[0].max(contrast[1]);
        let prior = UnknownsPrior::about(&x, estimate, contrast, &self.options);
        let mut scale = (FIRST_SCALE * contrast.max(LEAST_CONTRAST_GREY)).max(noise_grey);
        let mut iteration = 0;
        loop {
            iteration += 1;
            let adapting = iteration <= ADAPTING_ITERATIONS;
            let mut normal = self.normal(estimate, &x, scale, iteration);
            let freedom = pixels / (pixels - UNKNOWNS as f64 - normal.tally.freed).max(1.0);
            if adapting {
                scale = self.residual_scale(scale, freedom).max(LEAST_SCALE * noise_grey);
            }
            normal.join(&prior, &x, scale);
            let factor = Cholesky::new(normal.information)?;
            let step = factor.solve(&normal.right);
            let motion = Unknowns::motion_px(&step, estimate.half_length_px);
            if !motion.is_finite() {
                return None;
            }
            let blur = LARGEST_BLUR_CHANGE * x.blur_px() / step[unknowns::BLUR].abs();
            let part = (LONGEST_STEP_PX / motion).min(blur).min(1.0);
            x.0 += step * part;
            self.follow(estimate, &step, part);
            // χ² of the step: its squared length in units of the covariance of all unknowns.
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
                let report = self.report(estimate, &x, &normal.tally, &ending);
                return straight(&x, &covariance, estimate.half_length_px, report);
            }
        }
    }

    /// Collects the pixels near both flanks; returns whether each flank has enough.
    fn gather(
        &mut self,
        image: &GrayView<'_>,
        background: Option<&KnownBackground<'_>>,
        noise_grey: f64,
        estimate: &FingerEstimate,
        visible: &VisibleFlanks,
    ) -> bool {
        let Self { options, flanks, .. } = self;
        flanks.iter_mut().enumerate().all(|(index, flank)| {
            let PhotometricFlank { strip, .. } = flank;
            strip.gather(image, background, noise_grey, estimate, &visible.flank(index), options);
            flank.begin();
            let is_contradicted = background.is_some() && flank.strip.usable() < LEAST_USABLE;
            flank.strip.blocks.len() >= options.min_blocks && !is_contradicted
        })
    }

    /// Number of pixels fitted.
    fn pixels(&self) -> usize {
        self.flanks.iter().map(|f| f.strip.pixels()).sum()
    }

    /// Initial unknowns: the estimate, and per flank the median over the blocks of the levels clear
    /// of the edge. `None` if a flank has no such pixels on either side.
    fn start(&mut self, estimate: &FingerEstimate) -> Option<Unknowns> {
        let Self { isa, flanks, sorted, .. } = self;
        let mut levels = [[0.0; 2]; 2];
        for ([inside, outside], PhotometricFlank { strip, .. }) in levels.iter_mut().zip(flanks) {
            let clear_inside =
                |outside_px: f32, grey: f32, _: f32| (outside_px < -CLEAR_INSIDE_PX, grey);
            isa.run(Surveying {
                strip,
                estimate,
                measure: clear_inside,
                mean: true,
                means: sorted,
            });
            *inside = median(sorted)?;
            let clear_outside = |outside_px: f32, grey: f32, behind: f32| {
                (outside_px > CLEAR_OUTSIDE_PX, grey - behind)
            };
            isa.run(Surveying {
                strip,
                estimate,
                measure: clear_outside,
                mean: true,
                means: sorted,
            });
            *outside = median(sorted)?;
        }
        let blur_px = self.edge_blur_px(estimate, &levels);
        Some(Unknowns::on(estimate, levels, blur_px))
    }

    /// Blur at the estimate's edge, for given levels a and b of either flank, by the median over
    /// its blocks \[px\]. For a blurred step, n = (I − b) / (a − b) satisfies
    /// ∫ n (1 − n) dy = s / √π. Pixels outside the range of the two levels contribute zero.
    fn edge_blur_px(&mut self, estimate: &FingerEstimate, levels: &[[f64; 2]; 2]) -> f64 {
        let Self { isa, flanks, sorted, .. } = self;
        let mut sum = 0.0;
        for (PhotometricFlank { strip, .. }, levels) in flanks.iter().zip(levels) {
            let [a, b] = levels.map(|level| level as f32);
            let across_step = |outside_px: f32, grey: f32, behind: f32| {
                let b = behind + b;
                let parts = ((grey - b) * (a - grey)).max(0.0);
                // Keeps the quotient finite without contrast.
                (outside_px.abs() < NEAR_EDGE_PX, parts / ((a - b) * (a - b)).max(1.0))
            };
            isa.run(Surveying {
                strip,
                estimate,
                measure: across_step,
                mean: false,
                means: sorted,
            });
            sum += 0.5 * median(sorted).unwrap_or(0.0);
        }
        let (measured, expected) = (PI.sqrt() * sum / self.options.block_px, self.options.blur_px);
        measured.clamp((expected - BLUR_SIGMA_PX).max(LEAST_BLUR_PX), expected + BLUR_SIGMA_PX)
    }

    /// Linearises the model at `x` and eliminates the deviations of every block.
    fn normal(
        &mut self,
        estimate: &FingerEstimate,
        x: &Unknowns,
        scale: f64,
        iteration: usize,
    ) -> Normal {
        let mut normal = Normal {
            information: UnknownsInformation::zeros(),
            right: UnknownsVector::zeros(),
            tally: PixelSums::default(),
        };
        let weighing = Weighing { noise_grey: scale, cutoff: self.options.cutoff };
        for (index, flank) in self.flanks.iter_mut().enumerate() {
            let end_px = x.end_px(index);
            let end = estimate
                .end_radius_px()
                .map(|radius| RoundEnd { middle: end_px as f32, radius: radius as f32 });
            let mut equations = FlankEquations::default();
            let mut evidence = Evidence::default();
            self.isa.run(Linearising {
                flank,
                index,
                estimate,
                x,
                end,
                // Below this abscissa the round end affects no pixel of a block.
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

    /// Updates the block deviations after a step of the unknowns.
    fn follow(&mut self, estimate: &FingerEstimate, step: &UnknownsVector, part: f64) {
        let taken = step * part;
        for (index, flank) in self.flanks.iter_mut().enumerate() {
            let taken = FlankStep::of(&taken, index);
            for (group, deviations) in flank.strip.groups.iter().zip(&mut flank.deviations) {
                let factors = Factors::at(&group.p, estimate.half_length_px);
                deviations.follow(&taken.changes(&factors), part);
            }
        }
    }

    /// Standard deviation of a pixel, from the median of χ² over the blocks: up to half of them may
    /// contain outliers \[grey levels\].
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
        estimate: &FingerEstimate,
        x: &Unknowns,
        tally: &PixelSums,
        ending: &Ending,
    ) -> PhotometricReport {
        let Ending { residual_grey, bend_sigma_px, iterations, converged } = *ending;
        let pixels = self.pixels();
        let blocks: usize = self.flanks.iter().map(|f| f.strip.blocks.len()).sum();
        PhotometricReport {
            pixels,
            rejected: tally.rejected / tally.pixels,
            blocks,
            trusted: tally.block_weight / blocks as f64,
            residual_grey,
            contrast_grey: [0, 1]
                .map(|f| self.flanks[f].strip.contrast_grey(x.shaded_contrast_grey(estimate, f))),
            edge_px: [0, 1].map(|f| self.flanks[f].variances[EDGE_EFFECT].sqrt()),
            blur_px: x.blur_px(),
            half_length_px: estimate.half_length_px,
            bend_px: x.0[BEND],
            bend_sigma_px,
            iterations,
            converged,
        }
    }
}

/// Robust covariance of d, ϑ, bend and bulge: E\[ψ²\] / E\[ψ′\]² H⁻¹.
fn covariance(
    factor: &Cholesky<f64, Const<UNKNOWNS>>,
    tally: &PixelSums,
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
        let mut unit = UnknownsVector::zeros();
        unit[unknown] = variance;
        factor.solve_mut(&mut unit);
        for (i, row) in rows.into_iter().enumerate() {
            covariance[(i, j)] = unit[row];
        }
    }
    Some(covariance)
}

/// The straight line closest to the bent medial line in the metric of the information matrix: the
/// estimate of d and ϑ conditional on zero bend and zero bulge.
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

/// The stretch over which the least-squares line through a bend of 1 px is `line` (offset and
/// slope). Both lines meet the bend P₂(p / h) at the same two abscissae, ± half-length / √3 from
/// the stretch's middle.
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
