//! Search for bands with a round end by the orientations of gradients, at every place, angle and
//! size.

use nalgebra::Vector2;
use std::f64::consts::PI;

/// Template samples relative to its tip, in cells.
#[derive(Debug, Clone)]
pub(super) struct BandTemplate {
    pub(super) angle_rad: f64,
    /// Round end: the cell and the orientation of its normal.
    cap: [((isize, isize), usize); CAP_SAMPLES],
    /// First sample of either flank; the flanks' normals have one orientation.
    flanks: [(isize, isize); 2],
    flank_bin: usize,
    /// Offset from the first sample to the second, from the first two to the next two, and so on.
    doublings: [(isize, isize); FLANK_SAMPLES.ilog2() as usize],
}

/// Planes of bytes, one per channel.
#[derive(Debug, Clone, Default)]
pub(super) struct Octave {
    pub(super) width: usize,
    pub(super) height: usize,
    pub(super) planes: Vec<u8>,
}

/// One level of the pyramid; all levels use the same buffers in turn.
#[derive(Debug, Clone, Default)]
pub(super) struct Level {
    width: usize,
    height: usize,
    /// Cells in a row of the planes below, which include a margin on all sides.
    stride: usize,
    image: Vec<u8>,
    orientations: Vec<u8>,
    spread: Vec<u8>,
    responses: Vec<u8>,
    flank: [Vec<u8>; 2],
    cap: Vec<u8>,
    best: Vec<u8>,
    angle: Vec<u8>,
}

impl BandTemplate {
    pub(super) fn new(angle_rad: f64) -> Self {
        let (sin, cos) = angle_rad.sin_cos();
        let (e, n) = (Vector2::new(cos, sin), Vector2::new(-sin, cos));
        let cell = |v: Vector2<f64>| (v.x.round() as isize, v.y.round() as isize);
        let bin = |angle: f64| (angle.rem_euclid(PI) / PI * BINS as f64).round() as usize % BINS;
        let w = HALF_WIDTH_CELLS;
        let cap = std::array::from_fn(|k| {
            let part = 2.0 * k as f64 / (CAP_SAMPLES - 1) as f64 - 1.0;
            let about = part * CAP_REACH_RAD;
            (cell(e * (w * (about.cos() - 1.0)) + n * (w * about.sin())), bin(angle_rad + about))
        });
        let (near, far) = FLANK_HALF_WIDTHS;
        let step = (far - near) * w / (FLANK_SAMPLES - 1) as f64;
        Self {
            angle_rad,
            cap,
            flanks: [-1.0, 1.0].map(|side| cell(n * (side * w) - e * (w * (1.0 + near)))),
            flank_bin: bin(angle_rad + PI / 2.0),
            doublings: std::array::from_fn(|k| cell(e * (-step * f64::from(1 << k)))),
        }
    }
}

impl Octave {
    /// Means of 2 × 2 pixels of another octave.
    pub(super) fn halve(&mut self, from: &Self, channels: usize) {
        (self.width, self.height) = ((from.width / 2).max(1), (from.height / 2).max(1));
        self.planes.clear();
        let (right, below) =
            (usize::from(from.width > 1), if from.height > 1 { from.width } else { 0 });
        for c in 0..channels {
            let plane = &from.planes[c * from.width * from.height..][..from.width * from.height];
            for y in 0..self.height {
                let row = &plane[2 * y.min(from.height / 2) * from.width..];
                self.planes.extend((0..self.width).map(|x| {
                    let sum = [0, right, below, below + right]
                        .iter()
                        .map(|o| u16::from(row[2 * x + o]))
                        .sum::<u16>();
                    ((sum + 2) / 4) as u8
                }));
            }
        }
    }
}

impl Level {
    /// Resamples an octave at every `step` pixels, bilinearly.
    pub(super) fn sample(&mut self, octave: &Octave, channels: usize, step: f64) {
        (self.width, self.height) = (
            ((octave.width as f64 / step) as usize).max(1),
            ((octave.height as f64 / step) as usize).max(1),
        );
        self.stride = self.width + 2 * MARGIN;
        self.image.clear();
        // Positions in 1/256 px.
        let fixed = |i: usize, n: usize| {
            let at = ((i as f64 + 0.5) * step - 0.5).clamp(0.0, (n - 1) as f64);
            let whole = (at as usize).min(n.saturating_sub(2));
            (whole, ((at - whole as f64) * 256.0) as u32)
        };
        let right = usize::from(octave.width > 1);
        let below = if octave.height > 1 { octave.width } else { 0 };
        for c in 0..channels {
            let plane = &octave.planes[c * octave.width * octave.height..];
            for y in 0..self.height {
                let (y0, t) = fixed(y, octave.height);
                let row = &plane[y0 * octave.width..];
                self.image.extend((0..self.width).map(|x| {
                    let (x0, s) = fixed(x, octave.width);
                    let level = |o: usize| u32::from(row[x0 + o]);
                    let top = level(0) * (256 - s) + level(right) * s;
                    let bottom = level(below) * (256 - s) + level(below + right) * s;
                    ((top * (256 - t) + bottom * t) >> 16) as u8
                }));
            }
        }
    }

    /// Orientation of the strongest gradient of any channel in each cell, spread over its
    /// neighbours, and the response of each orientation to it.
    pub(super) fn orient(&mut self, channels: usize, min_gradient_grey: f64) {
        let (width, height, stride) = (self.width, self.height, self.stride);
        let cells = stride * (height + 2 * MARGIN);
        for plane in [&mut self.orientations, &mut self.spread] {
            plane.clear();
            plane.resize(cells, 0);
        }
        // Sobel's weights add up to eight.
        let least = (8.0 * min_gradient_grey) as i32;
        for y in 1..height.saturating_sub(1) {
            for x in 1..width.saturating_sub(1) {
                let (mut gx, mut gy, mut strength) = (0, 0, least * least);
                let mut found = false;
                for plane in self.image.chunks_exact(width * height).take(channels) {
                    let at =
                        |dx: usize, dy: usize| i32::from(plane[(y + dy - 1) * width + x + dx - 1]);
                    let u = at(2, 0) + 2 * at(2, 1) + at(2, 2) - at(0, 0) - 2 * at(0, 1) - at(0, 2);
                    let v = at(0, 2) + 2 * at(1, 2) + at(2, 2) - at(0, 0) - 2 * at(1, 0) - at(2, 0);
                    if u * u + v * v > strength {
                        (gx, gy, strength, found) = (u, v, u * u + v * v, true);
                    }
                }
                if found {
                    self.orientations[(y + MARGIN) * stride + x + MARGIN] = 1 << bin_of(gx, gy);
                }
            }
        }
        let o = &self.orientations;
        let inner = stride + 1..cells - stride - 1;
        for (i, out) in inner.clone().zip(&mut self.spread[inner]) {
            let row = |j: usize| o[j - 1] | o[j] | o[j + 1];
            *out = row(i - stride) | row(i) | row(i + stride);
        }
        self.responses.clear();
        for bin in 0..BINS {
            let met = response_table(bin);
            self.responses.extend(self.spread.iter().map(|&m| met[usize::from(m)]));
        }
        for plane in [&mut self.best, &mut self.angle, &mut self.cap] {
            plane.clear();
            plane.resize(cells, 0);
        }
        for plane in &mut self.flank {
            plane.clear();
            plane.resize(cells, 0);
        }
    }

    /// Scores the template at every cell, and keeps the best angle.
    pub(super) fn score(&mut self, template: &BandTemplate, angle: u8) {
        let stride = self.stride as isize;
        let cells = self.best.len();
        let shift = |(dx, dy): (isize, isize)| dy * stride + dx;
        // Within the reach of any sample from any cell of the image.
        let first = MARGIN * self.stride;
        let inner = first..cells - first;
        let from = |plane: &[u8], by: isize| -> std::ops::Range<usize> {
            let start = (inner.start as isize + by) as usize;
            start..(start + inner.len()).min(plane.len())
        };
        let plane = |bin: usize| &self.responses[bin * cells..(bin + 1) * cells];

        // The flank's samples lie on a straight line: sums of two, of four, of eight.
        let [even, odd] = &mut self.flank;
        let (mut sum, mut next) = (even, odd);
        sum.copy_from_slice(plane(template.flank_bin));
        for &step in &template.doublings {
            let by = shift(step);
            // Only where both ends of the line lie in the padded plane.
            let (lo, hi) = ((-by).max(0) as usize, cells - by.max(0) as usize);
            let behind = &sum[(lo as isize + by) as usize..(hi as isize + by) as usize];
            for ((out, a), b) in next[lo..hi].iter_mut().zip(&sum[lo..hi]).zip(behind) {
                *out = a.wrapping_add(*b);
            }
            next[..lo].fill(0);
            next[hi..].fill(0);
            std::mem::swap(&mut sum, &mut next);
        }
        let cap = &mut self.cap[inner.clone()];
        cap.fill(0);
        for &(offset, bin) in &template.cap {
            let responses = plane(bin);
            let met = &responses[from(responses, shift(offset))];
            for (out, &m) in cap.iter_mut().zip(met) {
                *out = out.wrapping_add(m);
            }
        }
        let [left, right] = template.flanks.map(|flank| &sum[from(sum, shift(flank))]);
        let best = self.best[inner.clone()].iter_mut().zip(&mut self.angle[inner]);
        for ((((best, at), &l), &r), &c) in best.zip(left).zip(right).zip(cap.iter()) {
            let mean = |a: u8, b: u8| u16::midpoint(u16::from(a), u16::from(b)) as u8;
            let score = mean(l.min(r).min(c), mean(mean(l, r), c));
            *at = if score > *best { angle } else { *at };
            *best = (*best).max(score);
        }
    }

    /// Cells with the maximum score within a half-width: place, score and angle.
    pub(super) fn peaks(&self) -> impl Iterator<Item = (usize, usize, u8, u8)> {
        const REACH: usize = 2;
        let at = move |x: usize, y: usize| (y + MARGIN) * self.stride + x + MARGIN;
        (0..self.height)
            .flat_map(move |y| (0..self.width).map(move |x| (x, y)))
            .filter(move |&(x, y)| {
                let here = self.best[at(x, y)];
                here >= LEAST_SCORE
                    && (0..=2 * REACH).all(|dy| {
                        let row = at(x, y) + dy * self.stride - REACH * self.stride - REACH;
                        self.best[row..=row + 2 * REACH].iter().enumerate().all(|(dx, &other)| {
                            // Of equal scores the first one is kept.
                            let before = (dy, dx) < (REACH, REACH);
                            other < here || (other == here && !before)
                        })
                    })
            })
            .map(move |(x, y)| (x, y, self.best[at(x, y)], self.angle[at(x, y)]))
    }
}

/// Orientation of a gradient, in bins over half a turn.
pub(super) fn bin_of(gx: i32, gy: i32) -> usize {
    // Tangents of 11.25°, 33.75°, 56.25° and 78.75°, in 1/1024.
    const TANGENTS: [i32; 4] = [204, 684, 1532, 5148];
    let (gx, gy) = if gy < 0 || (gy == 0 && gx < 0) { (-gx, -gy) } else { (gx, gy) };
    let steps = TANGENTS.iter().filter(|&&t| 1024 * gy > t * gx.abs()).count();
    if gx >= 0 { steps } else { (BINS - steps) % BINS }
}

/// Response of a sample of one orientation to each set of orientations nearby.
pub(super) fn response_table(bin: usize) -> [u8; 256] {
    std::array::from_fn(|set| {
        let has = |b: usize| set >> (b % BINS) & 1 == 1;
        if has(bin) {
            MEETS
        } else if has(bin + 1) || has(bin + BINS - 1) {
            NEARLY_MEETS
        } else {
            0
        }
    })
}

/// Half a finger's width in cells of the level that searches it.
pub(super) const HALF_WIDTH_CELLS: f64 = 2.5;

/// Ratio of the half-widths of successive levels.
pub(super) const LEVEL_RATIO: f64 = 1.35;

/// Number of angles searched.
pub(super) const ANGLES: usize = 24;

/// Number of orientation bins, over half a turn.
pub(super) const BINS: usize = 8;

/// Number of samples of the round end, and of either flank; a power of two for the flank's sums by
/// doubling.
pub(super) const CAP_SAMPLES: usize = 8;
pub(super) const FLANK_SAMPLES: usize = 8;

/// Largest angle of the round end's samples to the axis \[rad\], and range of the flank's samples
/// behind the centre of the round end \[half-widths\].
pub(super) const CAP_REACH_RAD: f64 = 1.37;
pub(super) const FLANK_HALF_WIDTHS: (f64, f64) = (0.3, 3.0);

/// Response of a sample to an edge of its orientation, and to one of the next orientation; a sum of
/// eight fits a byte.
pub(super) const MEETS: u8 = 31;
pub(super) const NEARLY_MEETS: u8 = 19;

/// Margin of a level, within the reach of the template \[cells\].
pub(super) const MARGIN: usize = 12;

/// Least score of a band; the greatest is 8 · 31 = 248.
pub(super) const LEAST_SCORE: u8 = 144;
