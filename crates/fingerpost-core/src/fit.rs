//! Weighted least squares for the step of a shape vector.
//!
//! Every equation says that a step δ of the shape vector should move the contour by the measured
//! offset along one normal: rowᵀ δ = offset, with the offset's variance. Robust weights (Tukey) are
//! found by iterated reweighting; the scale of the residual offsets is estimated from themselves.
//! The solver reports what the equations determine: when they leave a direction of the shape
//! space open it says so and returns no step, instead of choosing one.
//!
//! The two-stage solve is that of the 1994 tracker: translation first, then the deformations from
//! what the translation leaves over (Hollinghurst & Cipolla 1994; the *residual offsets* of
//! section 3.3 of the paper). It is no optimum when the two are correlated.
//!
//! This module never sees a pixel.

#![expect(
    clippy::inline_always,
    reason = "what is inlined into a function with wider instructions is compiled for them"
)]

use crate::simd::{Isa, Work, each};
use crate::{Error, Result};
use nalgebra::{SMatrix, SVector};

/// How gross errors are kept from the solution.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Loss {
    /// Plain least squares.
    None,
    /// Tukey's biweight: equations whose residual exceeds `cutoff` robust standard deviations have
    /// no say. 4.685 keeps 95 % efficiency on clean Gaussian offsets. Range: above 1.
    Tukey {
        /// Where the weight reaches zero \[robust standard deviations\].
        cutoff: f64,
    },
}

/// In which order the unknowns are solved for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Solve {
    /// All components of the shape vector at once.
    Joint,
    /// The two components of translation first, then the others from the residual offsets, as the
    /// 1994 tracker did.
    TwoStage,
}

/// Options of [`Fitter`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FitOptions {
    /// Robust loss.
    pub loss: Loss,
    /// Order of the solve.
    pub solve: Solve,
    /// At most this many reweighted solutions, 1–100.
    pub max_iterations: usize,
    /// The robust scale of the residual offsets is never taken below this \[px\], 0–10: it covers
    /// what image noise does not, a hand that is not quite the template.
    pub min_scale_px: f64,
}

impl Default for FitOptions {
    fn default() -> Self {
        Self {
            loss: Loss::Tukey { cutoff: 4.685 },
            solve: Solve::Joint,
            max_iterations: 10,
            min_scale_px: 0.05,
        }
    }
}

/// An equation with a robust weight beyond this agrees with the solution.
const INLIER_WEIGHT: f64 = 0.1;
/// Where the residual offsets' root mean square exceeds their robust scale this much, gross errors
/// pull at the plain solution. The first weighting cannot trust it then, so its cutoff is so much
/// wider.
const GROSS_RMS: f64 = 1.5;
const FIRST_CUTOFF_FACTOR: f64 = 3.0;
/// A step is lengthened by no more than this: where gross errors abound, the loss is not convex.
const MOST_RELAXED: f64 = 1.5;
/// Turns the median absolute deviation of a normal distribution into its standard deviation.
const MAD_TO_SIGMA: f64 = 1.4826;
/// Reweighting has settled when the step moves by less than this part of its own sigma. The moves
/// shrink: what is left is a thousandth of the variance on average, and next to never a fifth of
/// the sigma (`tests/fit.rs`). A contour that is searched for again goes on from there.
const SETTLED: f64 = 0.2;
/// A direction is determined if its pivot exceeds this, every component scaled to unit information
/// of its own.
const RANK_TOLERANCE: f64 = 1e-9;

/// Equations that are worked on side by side, and sizes of their residuals that are counted so.
const LANES: usize = 4;
const SIZES: usize = 64;
/// One number of each of them.
type Lanes = [f64; LANES];

/// Storage for equations of any number of unknowns, reused from solve to solve.
#[derive(Debug, Clone, Default)]
pub struct EquationBuffer {
    count: usize,
    /// Row components of `LANES` equations, component by component; then of the next ones. Lanes
    /// without an equation have zeros, a zero offset and a variance of one.
    rows: Vec<Lanes>,
    offsets_px: Vec<Lanes>,
    variances_px2: Vec<Lanes>,
}

impl EquationBuffer {
    /// A buffer that holds `equations` equations of `unknowns` unknowns without allocating.
    #[must_use]
    pub fn with_capacity(equations: usize, unknowns: usize) -> Self {
        let groups = equations.div_ceil(LANES);
        Self {
            count: 0,
            rows: Vec::with_capacity(groups * unknowns),
            offsets_px: Vec::with_capacity(groups),
            variances_px2: Vec::with_capacity(groups),
        }
    }

    /// Forgets what the buffer holds and takes equations of `D` unknowns.
    pub fn clear<const D: usize>(&mut self) -> Equations<'_, D> {
        self.count = 0;
        self.rows.clear();
        self.offsets_px.clear();
        self.variances_px2.clear();
        Equations(self)
    }

    /// Makes room for the next equations. (Apart, so that [`Equations::push`] is inlined.)
    #[inline(always)]
    fn begin_group<const D: usize>(&mut self) {
        self.rows.extend_from_slice(&[[0.0; LANES]; D]);
        self.offsets_px.push([0.0; LANES]);
        self.variances_px2.push([1.0; LANES]);
    }
}

/// Refuses an equation that has no meaning.
#[cold]
fn check(sum_of_row: f64, offset_px: f64, variance_px2: f64) -> Result<()> {
    Error::finite("offset [px]", offset_px)?;
    Error::finite("row of the Jacobian", sum_of_row)?;
    Error::within("variance [px²]", variance_px2, "positive", |v| v > 0.0)?;
    Ok(())
}

/// Linear equations for the step: row · δ = offset ± √variance.
#[derive(Debug)]
pub struct Equations<'a, const D: usize>(&'a mut EquationBuffer);

impl<const D: usize> Equations<'_, D> {
    /// Adds one: `row` = ∂(n·X)/∂x, the measured offset along the normal \[px\] and its variance
    /// \[px²\], positive.
    ///
    /// # Errors
    /// When a number is not finite or the variance not positive; nothing is added then.
    #[inline(always)]
    pub fn push(&mut self, row: &SVector<f64, D>, offset_px: f64, variance_px2: f64) -> Result<()> {
        if !((offset_px + row.sum()).is_finite() && variance_px2 > 0.0 && variance_px2 <= f64::MAX)
        {
            check(row.sum(), offset_px, variance_px2)?;
        }
        let buffer = &mut *self.0;
        let lane = buffer.count % LANES;
        if lane == 0 {
            buffer.begin_group::<D>();
        }
        if let (Some(rows), Some(offsets_px), Some(variances_px2)) = (
            buffer.rows.last_chunk_mut::<D>(),
            buffer.offsets_px.last_mut(),
            buffer.variances_px2.last_mut(),
        ) {
            for i in 0..D {
                rows[i][lane] = row[i];
            }
            offsets_px[lane] = offset_px;
            variances_px2[lane] = variance_px2;
            buffer.count += 1;
        }
        Ok(())
    }

    /// How many there are.
    #[must_use]
    pub fn len(&self) -> usize {
        self.0.count
    }

    /// Whether there are none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.0.count == 0
    }

    /// The furthest that `step` moves any of the contour's samples along its normal \[px\].
    #[must_use]
    pub fn largest_motion(&self, step: &SVector<f64, D>) -> f64 {
        // Lanes without an equation do not move.
        let moved = self.groups().map(|group| group.moved_by(step));
        moved.flatten().fold(0.0, |most, moved| moved.abs().max(most))
    }

    #[inline(always)]
    fn groups(&self) -> impl Iterator<Item = Group<'_, D>> {
        let rows = self.0.rows.as_chunks::<D>().0.iter();
        rows.zip(&self.0.offsets_px).map(|(rows, offsets_px)| Group { rows, offsets_px })
    }
}

/// Some equations, lane by lane.
struct Group<'a, const D: usize> {
    rows: &'a [Lanes; D],
    offsets_px: &'a Lanes,
}

impl<const D: usize> Group<'_, D> {
    /// How far a step moves each sample along its normal \[px\].
    #[inline(always)]
    fn moved_by(&self, step: &SVector<f64, D>) -> Lanes {
        let mut moved = [0.0; LANES];
        for i in 0..D {
            moved = each(|j| moved[j] + self.rows[i][j] * step[i]);
        }
        moved
    }
}

/// A Gaussian belief about the step, from prediction or from what cannot change.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Prior<const D: usize> {
    /// Expected step.
    pub mean: SVector<f64, D>,
    /// Inverse covariance of the belief; zero where nothing is believed.
    pub information: SMatrix<f64, D, D>,
}

/// Whether the equations gave a step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Outcome {
    /// The step and its covariance are determined.
    Determined,
    /// There are fewer equations than unknowns, and no prior.
    TooFewEquations,
    /// The equations and the prior leave `D − rank` directions of the shape space open, or hold
    /// numbers that are none.
    Undetermined,
}

/// What a fit found, and how well.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FitReport<const D: usize> {
    /// Whether `step` and `covariance` mean anything.
    pub outcome: Outcome,
    /// The step δ; zero unless determined.
    pub step: SVector<f64, D>,
    /// Σ w row rowᵀ / variance, plus the prior's.
    pub information: SMatrix<f64, D, D>,
    /// Covariance of the step, scaled by the residuals; zero unless determined.
    pub covariance: SMatrix<f64, D, D>,
    /// How many directions of the shape space the information determines.
    pub rank: usize,
    /// Solutions computed until the weights settled.
    pub iterations: usize,
    /// Equations given.
    pub equations: usize,
    /// Equations with more than a tenth of their full weight.
    pub inliers: usize,
    /// Root mean square of the inliers' residual offsets \[px\].
    pub residual_rms_px: f64,
    /// Robust standard deviation of the residual offsets \[px\].
    pub residual_scale_px: f64,
}

/// Solves for steps; owns the buffers, so that solving allocates nothing once they have grown.
#[derive(Debug, Clone)]
pub struct Fitter {
    options: FitOptions,
    /// Variance of the residual offsets beyond that of the measurements.
    misfit_px2: f64,
    count: usize,
    weights: Vec<Lanes>,
    /// Weights over variances: what the equations count.
    precisions: Vec<Lanes>,
    residuals: Vec<Lanes>,
    /// Sizes of the residuals, as the upper halves of bit patterns in single precision: they have
    /// the same order.
    sizes: Vec<[i16; SIZES]>,
    isa: Isa,
}

/// Equations of this many samples fit without another allocation.
const USUAL_EQUATIONS: usize = 1024;

impl Fitter {
    /// A solver with the given options.
    ///
    /// # Errors
    /// When an option is not finite or outside its documented range.
    pub fn new(options: FitOptions) -> Result<Self> {
        if let Loss::Tukey { cutoff } = options.loss {
            Error::within("Tukey cutoff [robust sigma]", cutoff, "above 1", |c| c > 1.0)?;
        }
        Error::within("most iterations", options.max_iterations as f64, "1 to 100", |n| {
            (1.0..=100.0).contains(&n)
        })?;
        Error::within("least residual scale [px]", options.min_scale_px, "0 to 10", |s| {
            (0.0..=10.0).contains(&s)
        })?;
        let groups = USUAL_EQUATIONS.div_ceil(LANES);
        let buffer = || Vec::with_capacity(groups);
        Ok(Self {
            options,
            misfit_px2: 0.0,
            count: 0,
            weights: buffer(),
            precisions: buffer(),
            residuals: buffer(),
            sizes: Vec::with_capacity(USUAL_EQUATIONS.div_ceil(SIZES)),
            isa: Isa::detect(),
        })
    }

    /// The same solver with another instruction set than the processor's widest: slower, with the
    /// same results to the last bit.
    #[must_use]
    pub fn with_isa(self, isa: Isa) -> Self {
        Self { isa, ..self }
    }

    /// The options in force.
    #[must_use]
    pub fn options(&self) -> &FitOptions {
        &self.options
    }

    /// Residual offsets of the last solution \[px\], in the order of its equations.
    #[must_use]
    pub fn residuals(&self) -> &[f64] {
        &self.residuals.as_flattened()[..self.count]
    }

    /// Robust weights of the last solution, 0–1, in the order of its equations.
    #[must_use]
    pub fn weights(&self) -> &[f64] {
        &self.weights.as_flattened()[..self.count]
    }

    /// Whether each equation agrees with the last solution, in their order: the inliers.
    #[must_use]
    pub fn agreeing(&self) -> impl ExactSizeIterator<Item = bool> {
        self.weights().iter().map(|&weight| weight > INLIER_WEIGHT)
    }

    /// The step that the equations, and the prior if there is one, agree on.
    ///
    /// The variances of the equations are those of their measurements; what the residual offsets
    /// scatter beyond that is misfit of the model, the same for all, and is added to each.
    pub fn solve<const D: usize>(
        &mut self,
        equations: &Equations<'_, D>,
        prior: Option<&Prior<D>>,
    ) -> FitReport<D> {
        self.solve_with_scale(equations, prior, (self.options.min_scale_px, f64::INFINITY))
    }

    /// [`solve`](Self::solve) with the scale of the residual offsets kept between two \[px\], none
    /// negative; the least counts where it is above the largest. While a contour is still far from
    /// its edges, the few that tell how far must not pass for gross errors; and where its edges are
    /// known to lie close, gross errors must not pass for a contour that fits badly.
    pub fn solve_with_scale<const D: usize>(
        &mut self,
        equations: &Equations<'_, D>,
        prior: Option<&Prior<D>>,
        (min_scale_px, max_scale_px): (f64, f64),
    ) -> FitReport<D> {
        let least_misfit_px2 = self.options.min_scale_px * self.options.min_scale_px;
        self.misfit_px2 = least_misfit_px2;
        self.count = equations.len();
        self.residuals.clear();
        self.residuals.extend_from_slice(&equations.0.offsets_px);
        self.weights.resize(self.residuals.len(), [0.0; LANES]);
        self.precisions.resize(self.residuals.len(), [0.0; LANES]);
        self.sizes.clear();
        self.sizes.resize(self.count.div_ceil(SIZES), [0; SIZES]);
        self.weigh(equations, f64::INFINITY);
        if prior.is_none() && equations.len() < D {
            return self.undetermined(equations, Outcome::TooFewEquations, SMatrix::zeros(), 0);
        }
        let measured_px2 = mean_variance(equations);
        let mut step = SVector::zeros();
        let (mut iteration, mut relaxation, mut is_final) = (0, 1.0, false);
        loop {
            iteration += 1;
            let normal = self.normal_equations(equations, prior);
            let factor = match determined(&normal.information) {
                Ok(factor) => factor,
                Err(rank) => {
                    let outcome = Outcome::Undetermined;
                    return self.undetermined(equations, outcome, normal.information, rank);
                }
            };
            let solution = match self.options.solve {
                Solve::Joint => factor.solve(&normal.right),
                Solve::TwoStage => two_stage(&normal),
            };
            let moved = (solution - step) * relaxation;
            step += moved;
            if !step.iter().all(|s| s.is_finite()) {
                let outcome = Outcome::Undetermined;
                return self.undetermined(equations, outcome, normal.information, 0);
            }
            let rms_px = self.update_residuals(equations, &step);
            let settled = moved.dot(&(normal.information * moved)) < SETTLED * SETTLED * D as f64;
            if self.options.loss == Loss::None
                || (is_final && settled)
                || iteration >= self.options.max_iterations
            {
                return self.determined(equations, step, &factor, normal.information, iteration);
            }
            let scale_px = self.residual_scale();
            self.misfit_px2 = (scale_px * scale_px - measured_px2).max(least_misfit_px2);
            let scale_px = scale_px.min(max_scale_px).max(min_scale_px);
            is_final = iteration > 1 || rms_px <= GROSS_RMS * scale_px;
            let widened = if is_final { 1.0 } else { FIRST_CUTOFF_FACTOR };
            relaxation = self.weigh(equations, widened * scale_px);
        }
    }

    fn normal_equations<const D: usize>(
        &self,
        equations: &Equations<'_, D>,
        prior: Option<&Prior<D>>,
    ) -> NormalEquations<D> {
        let (mut products, mut offsets) = ([[[0.0; LANES]; D]; D], [[0.0; LANES]; D]);
        self.isa.run(Accumulate {
            equations,
            precisions: &self.precisions,
            products: &mut products,
            offsets: &mut offsets,
        });
        let mut information = SMatrix::from_fn(|a, b| total(&products[a.min(b)][a.max(b)]));
        let mut right = SVector::from_fn(|a, _| total(&offsets[a]));
        if let Some(prior) = prior {
            information += prior.information;
            right += prior.information * prior.mean;
        }
        NormalEquations { information, right }
    }

    /// Takes over what a step leaves of the offsets; its root mean square \[px\].
    fn update_residuals<const D: usize>(
        &mut self,
        equations: &Equations<'_, D>,
        step: &SVector<f64, D>,
    ) -> f64 {
        let Self { residuals, sizes, .. } = self;
        let mut squares_px2 = [0.0; LANES];
        let sizes = sizes.as_flattened_mut();
        let squares = &mut squares_px2;
        self.isa.run(LeftOver { equations, step, residuals, sizes, squares_px2: squares });
        (total(&squares_px2) / equations.len().max(1) as f64).sqrt()
    }

    /// Robust standard deviation of the residual offsets \[px\].
    fn residual_scale(&self) -> f64 {
        if self.count == 0 {
            return 0.0;
        }
        // Places without an equation have the smallest size there is.
        let empty = self.sizes.len() * SIZES - self.count;
        let rank = empty + self.count / 2;
        let mut median = 0.0;
        let sizes = self.sizes.as_flattened();
        self.isa.run(Select { sizes, rank, selected: &mut median });
        MAD_TO_SIGMA * f64::from(median)
    }

    /// Weighs the equations by their residual offsets, for these have such a scale \[px\]. How many
    /// times farther than the solution of the weighted equations is the loss's least value, if it is
    /// about what a parabola would make of it.
    fn weigh<const D: usize>(&mut self, equations: &Equations<'_, D>, scale_px: f64) -> f64 {
        let limit_px = match self.options.loss {
            Loss::None => f64::INFINITY,
            Loss::Tukey { cutoff } => cutoff * scale_px,
        };
        let Self { misfit_px2, residuals, weights, precisions, .. } = self;
        let misfit_px2 = *misfit_px2;
        // Of a scale of zero, which exact data may have, zero residuals are within.
        let per_limit = limit_px.recip().min(f64::MAX);
        let (mut weight, mut within) = ([0.0; LANES], [0.0; LANES]);
        let sums = (&mut weight, &mut within);
        self.isa.run(Weigh {
            equations,
            misfit_px2,
            residuals,
            per_limit,
            weights,
            precisions,
            sums,
        });
        // Reweighting takes w for the slope of ψ(r) = w r, which is w (5 √w − 4) / √w. Lanes without
        // an equation have weights of one.
        let empty = (residuals.len() * LANES - equations.len()) as f64;
        let (weight, within) = (total(&weight) - empty, total(&within) - empty);
        let slope = 5.0 * weight - 4.0 * within;
        if slope * MOST_RELAXED > weight { weight / slope } else { MOST_RELAXED }
    }

    fn determined<const D: usize>(
        &mut self,
        equations: &Equations<'_, D>,
        step: SVector<f64, D>,
        factor: &Factor<D>,
        information: SMatrix<f64, D, D>,
        iterations: usize,
    ) -> FitReport<D> {
        let statistics = self.statistics(equations);
        FitReport {
            outcome: Outcome::Determined,
            step,
            information,
            covariance: factor.inverse() * statistics.variance_factor(D),
            rank: D,
            iterations,
            equations: equations.len(),
            inliers: statistics.inliers as usize,
            residual_rms_px: statistics.rms_px(),
            residual_scale_px: self.residual_scale(),
        }
    }

    fn undetermined<const D: usize>(
        &mut self,
        equations: &Equations<'_, D>,
        outcome: Outcome,
        information: SMatrix<f64, D, D>,
        rank: usize,
    ) -> FitReport<D> {
        let statistics = self.statistics(equations);
        FitReport {
            outcome,
            step: SVector::zeros(),
            information,
            covariance: SMatrix::zeros(),
            rank,
            iterations: 0,
            equations: equations.len(),
            inliers: statistics.inliers as usize,
            residual_rms_px: statistics.rms_px(),
            residual_scale_px: self.residual_scale(),
        }
    }

    fn statistics<const D: usize>(&self, equations: &Equations<'_, D>) -> Statistics {
        let mut statistics = Statistics::default();
        let Self { weights, precisions, residuals, .. } = self;
        self.isa.run(Tally { weights, precisions, residuals, statistics: &mut statistics });
        // Lanes without an equation agree with every solution.
        let empty = residuals.len() * LANES - equations.len();
        statistics.weight -= empty as f64;
        statistics.inliers -= empty as f64;
        statistics
    }
}

/// Mean variance of the offsets \[px²\].
fn mean_variance<const D: usize>(equations: &Equations<'_, D>) -> f64 {
    let (variances_px2, count) = (&equations.0.variances_px2, equations.len());
    let sums = variances_px2.iter().fold([0.0; LANES], |sums, lanes| each(|j| sums[j] + lanes[j]));
    // Lanes without an equation have a variance of one.
    let empty = variances_px2.len() * LANES - count;
    (total(&sums) - empty as f64) / count.max(1) as f64
}

struct NormalEquations<const D: usize> {
    information: SMatrix<f64, D, D>,
    right: SVector<f64, D>,
}

/// Sums over the equations.
#[derive(Default)]
struct Statistics {
    weight: f64,
    chi_squared: f64,
    inliers: f64,
    /// Of the inliers' residual offsets.
    squares_px2: f64,
}

impl Statistics {
    /// How much larger the residuals are than their variances say; never below one, because few
    /// residuals that happen to be small prove no better measurement.
    fn variance_factor(&self, unknowns: usize) -> f64 {
        let freedom = self.weight - unknowns as f64;
        if freedom > 0.0 { (self.chi_squared / freedom).max(1.0) } else { 1.0 }
    }

    fn rms_px(&self) -> f64 {
        (self.squares_px2 / self.inliers.max(1.0)).sqrt()
    }
}

/// The normal equations of weighted equations, lane by lane: their totals are taken elsewhere, or
/// the compiler would rather keep those of one lane side by side.
struct Accumulate<'a, const D: usize> {
    equations: &'a Equations<'a, D>,
    precisions: &'a [Lanes],
    /// The matrix from the diagonal on; below it is nothing of use.
    products: &'a mut [[Lanes; D]; D],
    /// The right side.
    offsets: &'a mut [Lanes; D],
}

impl<const D: usize> Accumulate<'_, D> {
    /// Row `a`, if the matrix has so many.
    #[expect(clippy::needless_range_loop, reason = "as indices the loops are unrolled")]
    #[inline(always)]
    fn row(&mut self, a: usize) {
        if a >= D {
            return;
        }
        let (mut products, mut offsets) = ([[0.0; LANES]; D], [0.0; LANES]);
        for (group, precisions) in self.equations.groups().zip(self.precisions) {
            let scaled: Lanes = each(|j| group.rows[a][j] * precisions[j]);
            offsets = plus_product(&offsets, &scaled, group.offsets_px);
            for b in a..D {
                products[b] = plus_product(&products[b], &scaled, &group.rows[b]);
            }
        }
        (self.products[a], self.offsets[a]) = (products, offsets);
    }
}

impl<const D: usize> Work for Accumulate<'_, D> {
    #[inline(always)]
    fn run(mut self) {
        // The sums of one row fit the registers, those of all do not. Where the row is a constant
        // the loops over its columns are unrolled.
        self.row(0);
        self.row(1);
        self.row(2);
        self.row(3);
        self.row(4);
        self.row(5);
        self.row(6);
        self.row(7);
        for a in 8..D {
            self.row(a);
        }
    }
}

#[inline(always)]
fn plus_product(sum: &Lanes, a: &Lanes, b: &Lanes) -> Lanes {
    each(|j| sum[j] + a[j] * b[j])
}

#[inline(always)]
fn total(lanes: &Lanes) -> f64 {
    (lanes[0] + lanes[1]) + (lanes[2] + lanes[3])
}

/// What a step leaves of the offsets.
struct LeftOver<'a, const D: usize> {
    equations: &'a Equations<'a, D>,
    step: &'a SVector<f64, D>,
    residuals: &'a mut [Lanes],
    sizes: &'a mut [i16],
    squares_px2: &'a mut Lanes,
}

impl<const D: usize> Work for LeftOver<'_, D> {
    #[inline(always)]
    fn run(self) {
        let Self { equations, step, residuals, sizes, squares_px2 } = self;
        // A copy, which nothing that is written here can change.
        let step = *step;
        let sizes = sizes.as_chunks_mut::<LANES>().0;
        let mut squares = [0.0; LANES];
        for ((residuals, sizes), group) in residuals.iter_mut().zip(sizes).zip(equations.groups()) {
            let moved = group.moved_by(&step);
            let left: Lanes = each(|j| group.offsets_px[j] - moved[j]);
            squares = plus_product(&squares, &left, &left);
            *residuals = left;
            *sizes = each(|j| ((left[j] as f32).abs().to_bits() >> 16) as i16);
        }
        *squares_px2 = squares;
    }
}

/// The number at a place in the order of some numbers that are not negative, given as the upper
/// halves of their bit patterns in single precision: to 1/256 of itself.
struct Select<'a> {
    sizes: &'a [i16],
    rank: usize,
    selected: &'a mut f32,
}

impl Work for Select<'_> {
    #[inline(always)]
    fn run(self) {
        // By fours: sorting would guess at branches, and miss. The sign is known, so the first two
        // fours are two.
        let [fewer, ..] = below(self.sizes, [1 << 14; 3]);
        let mut selected = i16::from(fewer <= self.rank) << 14;
        for place in [12, 10, 8, 6, 4, 2, 0] {
            let fewer = below(self.sizes, [1, 2, 3].map(|part| selected | (part << place)));
            selected |=
                fewer.iter().map(|&fewer| i16::from(fewer <= self.rank)).sum::<i16>() << place;
        }
        // What was cut off is half of the last place on average.
        let bits = (u32::from(selected.cast_unsigned()) << 16) | 0x8000;
        *self.selected = if selected == 0 { 0.0 } else { f32::from_bits(bits) };
    }
}

/// How many sizes are below each of three.
#[inline(always)]
fn below(sizes: &[i16], [low, middle, high]: [i16; 3]) -> [usize; 3] {
    let mut all = [0; 3];
    // As many as can be counted in 16 bits.
    for sizes in sizes.chunks(1 << 14) {
        let mut counts = [0_i16; 3];
        for &size in sizes {
            counts[0] += i16::from(size < low);
            counts[1] += i16::from(size < middle);
            counts[2] += i16::from(size < high);
        }
        all = each(|i| all[i] + counts[i] as usize);
    }
    all
}

/// Tukey's weights, and what equations of such weights count.
struct Weigh<'a, const D: usize> {
    equations: &'a Equations<'a, D>,
    misfit_px2: f64,
    residuals: &'a [Lanes],
    /// One over where the weight reaches zero.
    per_limit: f64,
    weights: &'a mut [Lanes],
    precisions: &'a mut [Lanes],
    /// Of the weights, and of their square roots.
    sums: (&'a mut Lanes, &'a mut Lanes),
}

impl<const D: usize> Work for Weigh<'_, D> {
    #[inline(always)]
    fn run(self) {
        let Self { equations, misfit_px2, residuals, per_limit, weights, precisions, sums } = self;
        let (mut all_weights, mut all_within) = ([0.0; LANES], [0.0; LANES]);
        let weighted = weights.iter_mut().zip(precisions).zip(residuals);
        for (((weights, precisions), residuals), variances_px2) in
            weighted.zip(&equations.0.variances_px2)
        {
            let within: Lanes = each(|j| {
                let t = residuals[j] * per_limit;
                let within = 1.0 - t * t;
                if within > 0.0 { within } else { 0.0 }
            });
            let weight: Lanes = each(|j| within[j] * within[j]);
            *precisions = each(|j| weight[j] / (variances_px2[j] + misfit_px2));
            all_weights = each(|j| all_weights[j] + weight[j]);
            all_within = each(|j| all_within[j] + within[j]);
            *weights = weight;
        }
        (*sums.0, *sums.1) = (all_weights, all_within);
    }
}

/// What the solution is worth.
struct Tally<'a> {
    weights: &'a [Lanes],
    precisions: &'a [Lanes],
    residuals: &'a [Lanes],
    statistics: &'a mut Statistics,
}

impl Work for Tally<'_> {
    #[inline(always)]
    fn run(self) {
        let (mut weight, mut chi_squared) = ([0.0; LANES], [0.0; LANES]);
        let (mut inliers, mut squares_px2) = ([0.0; LANES], [0.0; LANES]);
        for ((weights, precisions), residuals) in
            self.weights.iter().zip(self.precisions).zip(self.residuals)
        {
            let squares: Lanes = each(|j| residuals[j] * residuals[j]);
            let agrees: Lanes = each(|j| if weights[j] > INLIER_WEIGHT { 1.0 } else { 0.0 });
            weight = each(|j| weight[j] + weights[j]);
            chi_squared = plus_product(&chi_squared, precisions, &squares);
            inliers = each(|j| inliers[j] + agrees[j]);
            squares_px2 = plus_product(&squares_px2, &agrees, &squares);
        }
        *self.statistics = Statistics {
            weight: total(&weight),
            chi_squared: total(&chi_squared),
            inliers: total(&inliers),
            squares_px2: total(&squares_px2),
        };
    }
}

/// L D Lᵀ of an information matrix. Its quotients and their chain are as few as can be: a solution
/// waits for them.
struct Factor<const D: usize> {
    /// Below the diagonal, L, whose diagonal are ones.
    lower: SMatrix<f64, D, D>,
    /// One over the pivots.
    per_pivot: SVector<f64, D>,
    /// The product of the pivots, each in units of its component's own information.
    determinant: f64,
}

impl<const D: usize> Factor<D> {
    /// None if a pivot is not positive.
    fn of(matrix: &SMatrix<f64, D, D>) -> Option<Self> {
        let mut lower = *matrix;
        let mut per_pivot = SVector::zeros();
        let mut determinant = 1.0;
        for k in 0..D {
            let pivot = lower[(k, k)];
            if pivot <= 0.0 || !pivot.is_finite() {
                return None;
            }
            per_pivot[k] = pivot.recip();
            determinant *= pivot / matrix[(k, k)];
            for j in k + 1..D {
                let scaled = lower[(j, k)] * per_pivot[k];
                for i in j..D {
                    lower[(i, j)] -= lower[(i, k)] * scaled;
                }
            }
            for i in k + 1..D {
                lower[(i, k)] *= per_pivot[k];
            }
        }
        Some(Self { lower, per_pivot, determinant })
    }

    fn solve(&self, right: &SVector<f64, D>) -> SVector<f64, D> {
        let Self { lower, per_pivot, .. } = self;
        let mut x = *right;
        for k in 0..D {
            for i in k + 1..D {
                x[i] -= lower[(i, k)] * x[k];
            }
        }
        x.component_mul_assign(per_pivot);
        for k in (0..D).rev() {
            for i in 0..k {
                x[i] -= lower[(k, i)] * x[k];
            }
        }
        x
    }

    /// The inverse of the matrix.
    fn inverse(&self) -> SMatrix<f64, D, D> {
        let Self { lower, per_pivot, .. } = self;
        // L⁻¹ column by column, then L⁻ᵀ D⁻¹ L⁻¹.
        let mut inverted = SMatrix::<f64, D, D>::identity();
        for column in 0..D {
            for k in column..D {
                for i in k + 1..D {
                    inverted[(i, column)] -= lower[(i, k)] * inverted[(k, column)];
                }
            }
        }
        let mut inverse = SMatrix::zeros();
        for a in 0..D {
            for b in a..D {
                let sum = (b..D).map(|k| inverted[(k, a)] * per_pivot[k] * inverted[(k, b)]).sum();
                (inverse[(a, b)], inverse[(b, a)]) = (sum, sum);
            }
        }
        inverse
    }
}

/// The factor of an information matrix that determines all directions; otherwise, how many it
/// does.
fn determined<const D: usize>(
    information: &SMatrix<f64, D, D>,
) -> std::result::Result<Factor<D>, usize> {
    let Some(factor) = Factor::of(information) else { return Err(rank(information)) };
    // With every component scaled to unit information of its own, the eigenvalues add up to D. All
    // but the least of them then multiply to no more than e, so the least is no less than the
    // determinant over e, and no pivot is less than that.
    if factor.determinant > std::f64::consts::E * RANK_TOLERANCE {
        return Ok(factor);
    }
    match rank(information) {
        rank if rank == D => Ok(factor),
        rank => Err(rank),
    }
}

/// How many directions an information matrix determines: Cholesky with complete pivoting, each
/// component in units of its own information.
fn rank<const D: usize>(information: &SMatrix<f64, D, D>) -> usize {
    let own = information.diagonal().map(|d| if d > 0.0 { 1.0 / d.sqrt() } else { 0.0 });
    let mut left = information.component_mul(&(own * own.transpose()));
    for found in 0..D {
        let (pivot, value) = left.diagonal().argmax();
        if value.is_nan() || value <= RANK_TOLERANCE {
            return found;
        }
        let column = left.column(pivot).into_owned() / value.sqrt();
        left -= column * column.transpose();
        // Rounding must not bring a used pivot back.
        left.row_mut(pivot).fill(0.0);
        left.column_mut(pivot).fill(0.0);
    }
    D
}

/// Translation alone, then the rest from what it leaves over. `information` has full rank.
fn two_stage<const D: usize>(normal: &NormalEquations<D>) -> SVector<f64, D> {
    let NormalEquations { information, right } = normal;
    let mut step = SVector::<f64, D>::zeros();
    for block in [0..2.min(D), 2.min(D)..D] {
        let left = right - information * step;
        // Keep the block; an identity elsewhere leaves the other components at zero.
        let mut own = SMatrix::<f64, D, D>::identity();
        let mut own_right = SVector::<f64, D>::zeros();
        for i in block.clone() {
            own_right[i] = left[i];
            for j in block.clone() {
                own[(i, j)] = information[(i, j)];
            }
        }
        if let Some(factor) = Factor::of(&own) {
            step += factor.solve(&own_right);
        }
    }
    step
}
