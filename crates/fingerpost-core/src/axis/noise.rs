//! Estimation of the image noise from one image.
//!
//! Near the finger the image is divided into cells. The second difference by rows of the second
//! difference by columns, [1 −2 1] × [1 −2 1]ᵀ, cancels levels, slopes and straight edges along
//! rows or columns, and has 36 times the variance of white noise. Cells on flat parts of the scene
//! agree on that variance; cells with edges or texture exceed it and are left out.

use super::finger_estimate::FingerEstimate;
use crate::image::gray::GrayView;
use crate::numeric::simd::each;

/// Side of a cell \[px\].
const CELL: usize = 8;
/// A row of a cell, with one pixel before and after it.
type Row = [u8; CELL + 2];
/// Sum of squares of the weights of the double second difference: (1 + 4 + 1)².
const GAIN: f64 = 36.0;
/// Relative standard deviation of a cell's variance: neighbours share pixels, and its 64
/// differences count as 17 independent ones, √(2 / 17).
const CELL_SIGMA: f64 = 0.344;
/// Lower quartile of a cell's variance, a gamma variable, over its mean.
const QUARTILE: f64 = 0.745;
/// Cells up to this many standard deviations above the mean are kept. The truncation lowers the
/// mean by the factor `KEPT_MEAN`.
const KEPT_SIGMAS: f64 = 2.5;
const KEPT_MEAN: f64 = 0.988;
/// Minimum number of cells for an estimate.
const MIN_CELLS: usize = 4;
/// Reach of the region beyond the flanks \[px\].
const MARGIN_PX: f64 = 12.0;
/// Lower bound on the noise: quantisation to whole grey levels, 1 / √12.
const LEAST_GREY: f64 = 0.288_675;
const MAX_ROUNDS: usize = 10;
const SETTLED: f64 = 1e-3;

/// Estimates noise; owns its buffer.
#[derive(Debug, Clone)]
pub(super) struct NoiseEstimator {
    cells: Vec<f64>,
}

impl NoiseEstimator {
    pub fn new() -> Self {
        Self { cells: Vec::with_capacity(256) }
    }

    /// Standard deviation of the noise near the finger \[grey levels\]; `None` if too few cells
    /// there are free of clipped pixels.
    pub fn estimate(&mut self, image: &GrayView<'_>, estimate: &FingerEstimate) -> Option<f64> {
        self.collect(image, estimate);
        let cells = &mut self.cells;
        if cells.len() < MIN_CELLS {
            return None;
        }
        cells.sort_unstable_by(f64::total_cmp);
        let mut variance = cells[cells.len() / 4] / QUARTILE;
        for _ in 0..MAX_ROUNDS {
            let limit = variance * (1.0 + KEPT_SIGMAS * CELL_SIGMA);
            let kept = cells.partition_point(|c| *c <= limit).max(1);
            let mean = cells[..kept].iter().sum::<f64>() / kept as f64 / KEPT_MEAN;
            let moved = (mean - variance).abs();
            variance = mean;
            if moved < SETTLED * variance {
                break;
            }
        }
        Some(variance.sqrt().max(LEAST_GREY))
    }

    /// Collects the variances of the cells in the bounding box of the finger.
    fn collect(&mut self, image: &GrayView<'_>, estimate: &FingerEstimate) {
        let (half_length_px, half_reach_px) =
            (estimate.half_length_px, estimate.half_width_px + MARGIN_PX);
        let (u, v) = (estimate.along.x.abs(), estimate.along.y.abs());
        // A cell's differences reach one px beyond it.
        let span = |middle: f64, half: f64, size: usize| {
            let last = size as f64 - 1.0;
            ((middle - half).clamp(1.0, last) as usize, (middle + half).clamp(1.0, last) as usize)
        };
        let (left, right) =
            span(estimate.origin.x, u * half_length_px + v * half_reach_px, image.width().max(2));
        let (top, bottom) =
            span(estimate.origin.y, v * half_length_px + u * half_reach_px, image.height().max(2));
        self.cells.clear();
        for y in (top..(bottom + 1).saturating_sub(CELL)).step_by(CELL) {
            for x in (left..(right + 1).saturating_sub(CELL)).step_by(CELL) {
                self.cells.extend(cell(image, x, y));
            }
        }
    }
}

/// The noise variance of the cell whose first pixel is (x, y); `None` if a pixel of it is clipped.
fn cell(image: &GrayView<'_>, x: usize, y: usize) -> Option<f64> {
    let row = |v| image.row(v)?.get(x - 1..)?.first_chunk::<{ CELL + 2 }>();
    let second = |r: &Row| -> [i16; CELL] {
        each(|k| i16::from(r[k]) - 2 * i16::from(r[k + 1]) + i16::from(r[k + 2]))
    };
    let (mut above, mut here) = (second(row(y - 1)?), second(row(y)?));
    let (mut sum, mut is_clipped) = (0, false);
    for v in y..y + CELL {
        let below = second(row(v + 1)?);
        for k in 0..CELL {
            let double_difference = i32::from(above[k] - 2 * here[k] + below[k]);
            sum += double_difference * double_difference;
        }
        // Without a shortcut, so that the loop is vectorised.
        for p in &row(v)?[1..=CELL] {
            is_clipped |= p.wrapping_add(1) < 2;
        }
        (above, here) = (here, below);
    }
    (!is_clipped).then(|| f64::from(sum) / (GAIN * (CELL * CELL) as f64))
}
