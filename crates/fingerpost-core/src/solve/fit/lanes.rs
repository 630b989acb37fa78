//! The loops over all equations, four at a time, for any instruction set.

use super::equations::{Equations, LANES, Lanes};
use crate::numeric::simd::{Work, each};
use nalgebra::SVector;

/// Minimum robust weight of an inlier.
pub(super) const INLIER_WEIGHT: f64 = 0.1;

/// Sums over the equations.
#[derive(Default)]
pub(super) struct Statistics {
    pub(super) weight: f64,
    chi_squared: f64,
    pub(super) inliers: f64,
    /// Of the inliers' residual offsets.
    squares_px2: f64,
}

impl Statistics {
    /// Variance factor: χ² of the residuals per degree of freedom. It is at least one, because a
    /// few small residuals do not prove a better measurement.
    pub(super) fn variance_factor(&self, unknowns: usize) -> f64 {
        let freedom = self.weight - unknowns as f64;
        if freedom > 0.0 { (self.chi_squared / freedom).max(1.0) } else { 1.0 }
    }

    pub(super) fn rms_px(&self) -> f64 {
        (self.squares_px2 / self.inliers.max(1.0)).sqrt()
    }
}

/// The normal equations of weighted equations, lane by lane. Totals are taken elsewhere, otherwise
/// the compiler vectorises within one lane.
pub(super) struct Accumulate<'a, const D: usize> {
    pub(super) equations: &'a Equations<'a, D>,
    pub(super) precisions: &'a [Lanes],
    /// The matrix from the diagonal on; entries below it are undefined.
    pub(super) products: &'a mut [[Lanes; D]; D],
    /// The right side.
    pub(super) offsets: &'a mut [Lanes; D],
}

impl<const D: usize> Accumulate<'_, D> {
    /// Row `a`, if the matrix has that row.
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
        // The sums of one row fit the registers, those of all do not. With a constant row the loops
        // over its columns are unrolled.
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
pub(super) fn plus_product(sum: &Lanes, a: &Lanes, b: &Lanes) -> Lanes {
    each(|j| sum[j] + a[j] * b[j])
}

#[inline(always)]
pub(super) fn total(lanes: &Lanes) -> f64 {
    (lanes[0] + lanes[1]) + (lanes[2] + lanes[3])
}

/// Residual offsets after a step.
pub(super) struct ComputeResiduals<'a, const D: usize> {
    pub(super) equations: &'a Equations<'a, D>,
    pub(super) step: &'a SVector<f64, D>,
    pub(super) residuals: &'a mut [Lanes],
    pub(super) sizes: &'a mut [i16],
    pub(super) squares_px2: &'a mut Lanes,
}

impl<const D: usize> Work for ComputeResiduals<'_, D> {
    #[inline(always)]
    fn run(self) {
        let Self { equations, step, residuals, sizes, squares_px2 } = self;
        // A copy, so that no write below can alias it.
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

/// Order statistic of non-negative numbers, given as the upper halves of their bit patterns in
/// single precision: to 1/256 of its value.
pub(super) struct Select<'a> {
    pub(super) sizes: &'a [i16],
    pub(super) rank: usize,
    pub(super) selected: &'a mut f32,
}

impl Work for Select<'_> {
    #[inline(always)]
    fn run(self) {
        // Two bits per pass: sorting would mispredict branches. The sign is known, so the first
        // pass determines one bit.
        let [fewer, ..] = below(self.sizes, [1 << 14; 3]);
        let mut selected = i16::from(fewer <= self.rank) << 14;
        for place in [12, 10, 8, 6, 4, 2, 0] {
            let fewer = below(self.sizes, [1, 2, 3].map(|part| selected | (part << place)));
            selected |=
                fewer.iter().map(|&fewer| i16::from(fewer <= self.rank)).sum::<i16>() << place;
        }
        // The truncated part is half of the last place on average.
        let bits = (u32::from(selected.cast_unsigned()) << 16) | 0x8000;
        *self.selected = if selected == 0 { 0.0 } else { f32::from_bits(bits) };
    }
}

/// Number of sizes below each of three.
#[inline(always)]
pub(super) fn below(sizes: &[i16], [low, middle, high]: [i16; 3]) -> [usize; 3] {
    let mut all = [0; 3];
    // Chunks whose counts fit 16 bits.
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

/// Tukey's weights, and the resulting weights over variances.
pub(super) struct Weigh<'a, const D: usize> {
    pub(super) equations: &'a Equations<'a, D>,
    pub(super) misfit_px2: f64,
    pub(super) residuals: &'a [Lanes],
    /// Inverse of the residual at which the weight reaches zero.
    pub(super) per_limit: f64,
    pub(super) weights: &'a mut [Lanes],
    pub(super) precisions: &'a mut [Lanes],
    /// Of the weights, and of their square roots.
    pub(super) sums: (&'a mut Lanes, &'a mut Lanes),
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

/// Statistics of the solution.
pub(super) struct WeightSums<'a> {
    pub(super) weights: &'a [Lanes],
    pub(super) precisions: &'a [Lanes],
    pub(super) residuals: &'a [Lanes],
    pub(super) statistics: &'a mut Statistics,
}

impl Work for WeightSums<'_> {
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
