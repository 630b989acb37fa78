//! Normal equations of one square of pixels, with its gain and offset eliminated.
//!
//! In a square with levels L, residuals r and weights w, the light is r ≈ o + g L with o free and
//! g ~ N(0, σ²). With columns centred by their weighted means, S = Σ w L², b = Σ w L J and the
//! factor c = (S + 2 σ⁻²) / (S + σ⁻²)², the sums of the columns without their light are
//! Σ w J Jᵀ − c b bᵀ.

#![expect(
    clippy::needless_range_loop,
    reason = "the sums of all unknowns have the same indices, which the compiler turns into vectors"
)]

use crate::numeric::simd::each;

/// Number of unknowns: the entries of a homography's step but the last.
pub(super) const UNKNOWNS: usize = 8;

/// Standard deviation of the relative change of a square's gain.
pub(super) const GAIN_SIGMA: f64 = 0.3;

const GAIN_INFORMATION: f64 = 1.0 / (GAIN_SIGMA * GAIN_SIGMA);

/// Derivatives of a pixel's level by the unknowns.
pub(super) type Derivatives = [f64; UNKNOWNS];

/// Weighted sums of levels and residuals.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct LightSums {
    weight: f64,
    level: f64,
    residual: f64,
    level_level: f64,
    level_residual: f64,
}

impl LightSums {
    #[inline(always)]
    pub(super) fn add(&mut self, weight: f64, level: f64, residual: f64) {
        let weighted = weight * level;
        self.weight += weight;
        self.level += weighted;
        self.residual += weight * residual;
        self.level_level += weighted * level;
        self.level_residual += weighted * residual;
    }

    /// Mean level, mean residual and gain; zeros without any weight.
    #[inline(always)]
    pub(super) fn solved(&self) -> (f64, f64, f64) {
        if self.weight <= 0.0 {
            return (0.0, 0.0, 0.0);
        }
        let (level, residual) = (self.level / self.weight, self.residual / self.weight);
        let contrast = (self.level_level - self.level * level).max(0.0);
        let gain = (self.level_residual - self.level * residual) / (contrast + GAIN_INFORMATION);
        (level, residual, gain)
    }
}

/// Normal matrix and right-hand side of a square, its light eliminated.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct SquareNormal {
    pub matrix: [Derivatives; UNKNOWNS],
    pub right: Derivatives,
}

/// Weighted sums of a square's derivatives, levels and residuals.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Sums {
    light: LightSums,
    normal: SquareNormal,
    row: Derivatives,
    level_row: Derivatives,
}

impl Sums {
    #[inline(always)]
    pub(super) fn add(&mut self, weight: f64, level: f64, residual: f64, row: &Derivatives) {
        self.light.add(weight, level, residual);
        let weighted: Derivatives = each(|k| weight * row[k]);
        for k in 0..UNKNOWNS {
            for j in 0..UNKNOWNS {
                self.normal.matrix[k][j] += weighted[k] * row[j];
            }
        }
        for k in 0..UNKNOWNS {
            self.row[k] += weighted[k];
            self.level_row[k] += weighted[k] * level;
            self.normal.right[k] += weighted[k] * residual;
        }
    }

    /// The normal equations without the light; zeros without any weight.
    #[inline(always)]
    pub(super) fn eliminated(mut self) -> SquareNormal {
        let weight = self.light.weight;
        if weight <= 0.0 {
            return SquareNormal::default();
        }
        let mean = 1.0 / weight;
        let (level, residual) = (self.light.level, self.light.residual);
        let contrast = (self.light.level_level - level * level * mean).max(0.0);
        let level_residual = self.light.level_residual - level * residual * mean;
        let gained = contrast + GAIN_INFORMATION;
        let factor = (contrast + 2.0 * GAIN_INFORMATION) / (gained * gained);
        let centred: Derivatives = each(|k| self.level_row[k] - level * mean * self.row[k]);
        let reduced: Derivatives = each(|k| factor * centred[k]);
        let means: Derivatives = each(|k| mean * self.row[k]);
        for k in 0..UNKNOWNS {
            for j in 0..UNKNOWNS {
                self.normal.matrix[k][j] -= means[k] * self.row[j] + reduced[k] * centred[j];
            }
            self.normal.right[k] -= means[k] * residual + reduced[k] * level_residual;
        }
        self.normal
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Columns less their weighted mean and less the level times their gain, one after the other.
    fn without_light(columns: &[Vec<f64>], weights: &[f64]) -> Vec<Vec<f64>> {
        let total: f64 = weights.iter().sum();
        let centred = |column: &Vec<f64>| -> Vec<f64> {
            let mean = column.iter().zip(weights).map(|(c, w)| c * w).sum::<f64>() / total;
            column.iter().map(|c| c - mean).collect()
        };
        let about: Vec<_> = columns.iter().map(centred).collect();
        let product = |a: &[f64], b: &[f64]| -> f64 {
            a.iter().zip(b).zip(weights).map(|((a, b), w)| a * b * w).sum()
        };
        let level = about[0].clone();
        let gained = product(&level, &level) + GAIN_INFORMATION;
        let left = |column: &Vec<f64>| -> Vec<f64> {
            let gain = product(&level, column) / gained;
            column.iter().zip(&level).map(|(c, l)| c - gain * l).collect()
        };
        about.iter().map(left).collect()
    }

    #[test]
    fn eliminated_sums_are_those_of_columns_without_light() {
        let value = |i: usize, k: usize| ((37 * i + 11 * k + i * i * (k + 3)) % 101) as f64 / 10.0;
        let weights: Vec<f64> = (0..24).map(|i| value(i, 20) / 10.0).collect();
        let columns: Vec<Vec<f64>> =
            (0..UNKNOWNS + 2).map(|k| (0..24).map(|i| value(i, k)).collect()).collect();
        let mut sums = Sums::default();
        for i in 0..24 {
            let row = each(|k| columns[k + 2][i]);
            sums.add(weights[i], columns[0][i], columns[1][i], &row);
        }
        let normal = sums.eliminated();
        let left = without_light(&columns, &weights);
        for k in 0..UNKNOWNS {
            let with = |j: usize| -> f64 {
                (0..24).map(|i| weights[i] * left[k + 2][i] * left[j][i]).sum()
            };
            assert!((normal.right[k] - with(1)).abs() < 1e-9);
            for j in 0..UNKNOWNS {
                assert!((normal.matrix[k][j] - with(j + 2)).abs() < 1e-9);
            }
        }
    }

    #[test]
    fn a_square_without_weight_adds_nothing() {
        let mut sums = Sums::default();
        sums.add(0.0, 100.0, 3.0, &[1.0; UNKNOWNS]);
        let normal = sums.eliminated();
        assert!(normal.matrix.iter().flatten().chain(&normal.right).all(|&s| s == 0.0));
    }
}
