//! Weighted least squares for the step of a shape vector.
//!
//! An equation row · δ = offset, with the offset's variance, states that the step δ of the shape
//! vector moves the contour by the measured offset along one normal. Tukey weights are found by
//! iterated reweighting, and the scale of the residual offsets is estimated from them. The solver
//! reports the rank: if the equations leave a direction of the shape space undetermined, it returns
//! no step.
//!
//! The two-stage solve is that of the 1994 tracker: translation first, then the deformations from
//! the residual offsets (Hollinghurst & Cipolla 1994; section 3.3 of the paper). It is not optimal
//! if the two are correlated.
//!
//! This module never sees a pixel.

#![expect(
    clippy::inline_always,
    reason = "what is inlined into a function with wider instructions is compiled for them"
)]

mod equations;
mod factor;
mod lanes;

pub use equations::{EquationBuffer, Equations};

use super::fit::equations::{LANES, Lanes};
use super::fit::factor::{Factor, NormalEquations, determined, two_stage};
use super::fit::lanes::{
    Accumulate, ComputeResiduals, INLIER_WEIGHT, Select, Statistics, Weigh, WeightSums, total,
};
use crate::numeric::simd::{Isa, each};
use crate::{Error, Result};
use nalgebra::{SMatrix, SVector};

/// The robust loss.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Loss {
    /// Plain least squares.
    None,
    /// Tukey's biweight: residuals beyond `cutoff` robust standard deviations have zero weight.
    /// 4.685 keeps 95 % efficiency for Gaussian offsets. Range: above 1.
    Tukey {
        /// Residual at which the weight reaches zero \[robust standard deviations\].
        cutoff: f64,
    },
}

/// Order in which the unknowns are solved for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Solve {
    /// All components of the shape vector at once.
    Joint,
    /// The two components of translation first, then the others from the residual offsets, as in
    /// the 1994 tracker.
    TwoStage,
}

/// Options of [`Fitter`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FitOptions {
    /// Robust loss.
    pub loss: Loss,
    /// Order of the solve.
    pub solve: Solve,
    /// Maximum number of reweighted solutions, 1–100.
    pub max_iterations: usize,
    /// Lower bound on the robust scale of the residual offsets \[px\], 0–10. It accounts for
    /// deviations of the hand from the template, which image noise does not contain.
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

/// Ratio of the root mean square of the residual offsets to their robust scale beyond which the
/// plain solution is distorted by gross errors. The cutoff of the first weighting is then wider by
/// `FIRST_CUTOFF_FACTOR`.
const GROSS_RMS: f64 = 1.5;
const FIRST_CUTOFF_FACTOR: f64 = 3.0;
/// Upper bound on the over-relaxation of a step: with many gross errors the loss is not convex.
const MOST_RELAXED: f64 = 1.5;
/// Standard deviation of a normal distribution over its median absolute deviation.
const MAD_TO_SIGMA: f64 = 1.4826;
/// Convergence of the reweighting: the step moves by less than this fraction of its own sigma. The
/// moves shrink: the remainder is a thousandth of the variance on average, and almost never a fifth
/// of the sigma (`tests/suite/fit.rs`). A contour that is searched again continues from there.
const SETTLED: f64 = 0.2;

const SIZES: usize = 64;

/// A Gaussian prior on the step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Prior<const D: usize> {
    /// Expected step.
    pub mean: SVector<f64, D>,
    /// Inverse covariance; zero in directions without prior knowledge.
    pub information: SMatrix<f64, D, D>,
}

/// Whether the equations determine a step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Outcome {
    /// The step and its covariance are determined.
    Determined,
    /// There are fewer equations than unknowns, and no prior.
    TooFewEquations,
    /// The equations and the prior leave `D − rank` directions of the shape space undetermined, or
    /// contain numbers that are not finite.
    Undetermined,
}

/// Result of a fit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FitReport<const D: usize> {
    /// Whether `step` and `covariance` are valid.
    pub outcome: Outcome,
    /// The step δ; zero unless determined.
    pub step: SVector<f64, D>,
    /// Σ w row rowᵀ / variance, plus the prior's information.
    pub information: SMatrix<f64, D, D>,
    /// Covariance of the step, scaled by the residuals; zero unless determined.
    pub covariance: SMatrix<f64, D, D>,
    /// Number of directions of the shape space that the information determines.
    pub rank: usize,
    /// Number of solutions until the weights converged.
    pub iterations: usize,
    /// Number of equations.
    pub equations: usize,
    /// Number of equations with more than a tenth of their full weight.
    pub inliers: usize,
    /// Root mean square of the inliers' residual offsets \[px\].
    pub residual_rms_px: f64,
    /// Robust standard deviation of the residual offsets \[px\].
    pub residual_scale_px: f64,
}

/// Solves for steps. It owns its buffers, so solving allocates nothing once they have grown.
#[derive(Debug, Clone)]
pub struct Fitter {
    options: FitOptions,
    /// Variance of the residual offsets in excess of the measurements' \[px²\].
    misfit_px2: f64,
    count: usize,
    weights: Vec<Lanes>,
    /// Weights over variances.
    precisions: Vec<Lanes>,
    residuals: Vec<Lanes>,
    /// Absolute residuals, as the upper halves of their bit patterns in single precision, which
    /// have the same order.
    sizes: Vec<[i16; SIZES]>,
    isa: Isa,
}

/// Capacity of the buffers without another allocation.
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

    /// The same solver with another instruction set than the processor's widest: slower, with
    /// bit-identical results.
    #[must_use]
    #[doc(hidden)]
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

    /// Whether each equation is an inlier of the last solution, in their order.
    #[must_use]
    pub fn agreeing(&self) -> impl ExactSizeIterator<Item = bool> {
        self.weights().iter().map(|&weight| weight > INLIER_WEIGHT)
    }

    /// The step that minimises the robust loss of the equations, plus the prior if there is one.
    ///
    /// The variances of the equations are those of their measurements. Scatter of the residual
    /// offsets in excess of these is model misfit, common to all, and is added to each.
    pub fn solve<const D: usize>(
        &mut self,
        equations: &Equations<'_, D>,
        prior: Option<&Prior<D>>,
    ) -> FitReport<D> {
        self.solve_with_scale(equations, prior, (self.options.min_scale_px, f64::INFINITY))
    }

    /// [`solve`](Self::solve) with the scale of the residual offsets kept between two bounds
    /// \[px\], not negative; the lower bound prevails if it is the larger. A lower bound keeps the
    /// few distant edges of a contour that is still far away from being rejected as gross errors.
    /// An upper bound, where the edges are known to be close, keeps gross errors from widening the
    /// scale.
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

    /// Updates the residuals after a step; returns their root mean square \[px\].
    fn update_residuals<const D: usize>(
        &mut self,
        equations: &Equations<'_, D>,
        step: &SVector<f64, D>,
    ) -> f64 {
        let Self { residuals, sizes, .. } = self;
        let mut squares_px2 = [0.0; LANES];
        let sizes = sizes.as_flattened_mut();
        let squares = &mut squares_px2;
        self.isa.run(ComputeResiduals { equations, step, residuals, sizes, squares_px2: squares });
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

    /// Weights the equations by their residual offsets for the given scale \[px\]. Returns the
    /// relaxation factor: the distance to the loss's minimum over that to the solution of the
    /// weighted equations, if the loss is about quadratic there.
    fn weigh<const D: usize>(&mut self, equations: &Equations<'_, D>, scale_px: f64) -> f64 {
        let limit_px = match self.options.loss {
            Loss::None => f64::INFINITY,
            Loss::Tukey { cutoff } => cutoff * scale_px,
        };
        let Self { misfit_px2, residuals, weights, precisions, .. } = self;
        let misfit_px2 = *misfit_px2;
        // With a scale of zero, as for exact data, zero residuals are within the limit.
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
        // Reweighting takes w for the slope of ψ(r) = w r, which is w (5 √w − 4) / √w. Lanes
        // without an equation have weights of one.
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
        self.isa.run(WeightSums { weights, precisions, residuals, statistics: &mut statistics });
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
