//! Image noise, from the image itself.

use super::sketch::Sketch;
use crate::image::GrayView;

const CELL: usize = 8;
/// relative sd of a cell
const CELL_SD: f64 = 0.344;
const MARGIN_PX: f64 = 12.0;
const LEAST_GREY: f64 = 0.288_675;

#[derive(Debug, Clone)]
pub(super) struct NoiseEstimator {
    cells: Vec<f64>,
}

impl NoiseEstimator {
    pub fn new() -> Self {
        Self { cells: Vec::with_capacity(4096) }
    }

    pub fn estimate(&mut self, image: &GrayView<'_>, sketch: &Sketch) -> Option<f64> {
        let reach = sketch.half_width_px + MARGIN_PX;
        let l = sketch.half_length_px;
        let half = [
            sketch.along.x.abs() * l + sketch.along.y.abs() * reach,
            sketch.along.y.abs() * l + sketch.along.x.abs() * reach,
        ];
        let span = |c: f64, h: f64, n: usize| {
            let from = (c - h).clamp(1.0, n as f64 - 1.0) as usize;
            let to = (c + h).clamp(1.0, n as f64 - 1.0) as usize;
            (from, to)
        };
        let (x0, x1) = span(sketch.origin.x, half[0], image.width());
        let (y0, y1) = span(sketch.origin.y, half[1], image.height());
        self.cells.clear();
        let mut y = y0;
        while y + CELL <= y1 {
            let mut x = x0;
            while x + CELL <= x1 {
                if let Some(v) = cell(image, x, y) {
                    self.cells.push(v);
                }
                x += CELL;
            }
            y += CELL;
        }
        if self.cells.len() < 4 {
            return None;
        }
        let cells = &mut self.cells;
        cells.sort_unstable_by(f64::total_cmp);
        // quarter quantile of a gamma of that sd
        let mut v = cells[cells.len() / 4] / 0.745;
        for _ in 0..10 {
            let limit = v * (1.0 + 2.5 * CELL_SD);
            let n = cells.partition_point(|c| *c <= limit).max(1);
            let mean = cells[..n].iter().sum::<f64>() / n as f64 / 0.988;
            if (mean - v).abs() < 1e-3 * v {
                break;
            }
            v = mean;
        }
        Some(v.sqrt().max(LEAST_GREY))
    }
}

/// Mean square of the second difference by rows and columns, in units of the noise's variance.
fn cell(image: &GrayView<'_>, x: usize, y: usize) -> Option<f64> {
    let mut sum = 0_i64;
    for v in y..y + CELL {
        let [a, b, c] =
            [image.row(v - 1)?, image.row(v)?, image.row(v + 1)?].map(|r| r.get(x - 1..=x + CELL));
        let (a, b, c) = (a?, b?, c?);
        for k in 1..=CELL {
            if b[k] == 0 || b[k] == 255 {
                return None;
            }
            let d = |r: &[u8]| i32::from(r[k - 1]) - 2 * i32::from(r[k]) + i32::from(r[k + 1]);
            let l = d(a) - 2 * d(b) + d(c);
            sum += i64::from(l * l);
        }
    }
    Some(sum as f64 / (36 * CELL * CELL) as f64)
}
