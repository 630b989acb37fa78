//! Solution of the normal equations: Cholesky factor, rank, and the two stages of the paper.

use nalgebra::SMatrix;
use nalgebra::SVector;

pub(super) struct NormalEquations<const D: usize> {
    pub(super) information: SMatrix<f64, D, D>,
    pub(super) right: SVector<f64, D>,
}

/// L D Lᵀ factor of an information matrix. It minimises the number of divisions and their
/// dependency chain, which determine the latency of a solution.
pub(super) struct Factor<const D: usize> {
    /// Below the diagonal, L, which has a unit diagonal.
    lower: SMatrix<f64, D, D>,
    /// Inverse pivots.
    per_pivot: SVector<f64, D>,
    /// Product of the pivots, each in units of its component's own information.
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

    pub(super) fn solve(&self, right: &SVector<f64, D>) -> SVector<f64, D> {
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
    pub(super) fn inverse(&self) -> SMatrix<f64, D, D> {
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

/// The factor of an information matrix of full rank; otherwise its rank.
pub(super) fn determined<const D: usize>(
    information: &SMatrix<f64, D, D>,
) -> Result<Factor<D>, usize> {
    let Some(factor) = Factor::of(information) else { return Err(rank(information)) };
    // With every component scaled to unit information, the eigenvalues sum to D. The product of all
    // but the least is then at most e, so the least is at least the determinant over e, and no
    // pivot is less than that.
    if factor.determinant > std::f64::consts::E * RANK_TOLERANCE {
        return Ok(factor);
    }
    match rank(information) {
        rank if rank == D => Ok(factor),
        rank => Err(rank),
    }
}

/// Rank of an information matrix: Cholesky with complete pivoting, each component in units of its
/// own information.
pub(super) fn rank<const D: usize>(information: &SMatrix<f64, D, D>) -> usize {
    let own = information.diagonal().map(|d| if d > 0.0 { 1.0 / d.sqrt() } else { 0.0 });
    let mut left = information.component_mul(&(own * own.transpose()));
    for found in 0..D {
        let (pivot, value) = left.diagonal().argmax();
        if value.is_nan() || value <= RANK_TOLERANCE {
            return found;
        }
        let column = left.column(pivot).into_owned() / value.sqrt();
        left -= column * column.transpose();
        // Rounding must not restore a used pivot.
        left.row_mut(pivot).fill(0.0);
        left.column_mut(pivot).fill(0.0);
    }
    D
}

/// Translation alone, then the rest from the residual offsets. `information` has full rank.
pub(super) fn two_stage<const D: usize>(normal: &NormalEquations<D>) -> SVector<f64, D> {
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

/// Minimum pivot of a determined direction, every component scaled to unit information.
pub(super) const RANK_TOLERANCE: f64 = 1e-9;
