//! Search for bands with a round end by the orientations of gradients, at every place, angle and
//! size.

#![expect(
    clippy::inline_always,
    reason = "what is inlined into a function with wider instructions is compiled for them"
)]

use crate::appearance::background::ForegroundMap;
use crate::image::frame::Frame;
use crate::numeric::simd::Work;
use nalgebra::Vector2;
use std::f64::consts::PI;

/// Template samples relative to its tip, in cells.
#[derive(Debug, Clone)]
pub(super) struct BandTemplate {
    pub(super) angle_rad: f64,
    /// Round end: the cell and the orientation of its normal.
    cap: [((isize, isize), usize); CAP_SAMPLES],
    /// First sample of either flank.
    flanks: [(isize, isize); 2],
    /// The flanks' samples relative to the first, and the orientation of their normals: both the
    /// same for the template of the opposite direction, whose flanks begin at the other end.
    flank: [(isize, isize); FLANK_SAMPLES],
    flank_bin: usize,
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
    /// The octave's column and the weight of the next one, in 1/256, of each column.
    columns: Vec<(usize, u16)>,
    /// A row interpolated between two of the octave's.
    blended: Vec<u16>,
    gradients: Gradients,
    image: Vec<u8>,
    orientations: Vec<u8>,
    /// Orientations of three neighbours in a row, from the first on.
    rows: Vec<u8>,
    spread: Vec<u8>,
    responses: Vec<u8>,
    /// Sums along the flank that begins at each cell.
    flank: Vec<u8>,
    best: Vec<u8>,
    angle: Vec<u8>,
}

/// The strongest gradient of any channel in each cell of a row: its components, in one eighth of a
/// grey level per cell, and the sum of their squares.
#[derive(Debug, Clone, Default)]
struct Gradients {
    u: Vec<i16>,
    v: Vec<i16>,
    strength: Vec<i32>,
    /// Across three rows, in each column: the weighted sum and the difference.
    sum: Vec<i16>,
    difference: Vec<i16>,
}

impl Gradients {
    /// Starts a row of `cells`: a gradient must be stronger than `least`.
    #[inline(always)]
    fn clear(&mut self, cells: usize, least: i32) {
        for component in [&mut self.u, &mut self.v] {
            component.clear();
            component.resize(cells, 0);
        }
        self.strength.clear();
        self.strength.resize(cells, least);
    }

    /// Adds a channel by three of its rows: Sobel's operator. Every step is a loop over bytes or
    /// words in a row, which compilers vectorise.
    #[inline(always)]
    fn add(&mut self, [above, here, below]: [&[u8]; 3]) {
        let rows = || above.iter().zip(here).zip(below);
        let word = |&level: &u8| i16::from(level);
        self.sum.clear();
        self.sum.extend(rows().map(|((a, h), b)| word(a) + 2 * word(h) + word(b)));
        self.difference.clear();
        self.difference.extend(rows().map(|((a, _), b)| word(b) - word(a)));
        let best = self.u.iter_mut().zip(&mut self.v).zip(&mut self.strength);
        let sums = self.sum.iter().zip(&self.sum[2..]);
        let differences =
            self.difference.iter().zip(&self.difference[1..]).zip(&self.difference[2..]);
        for ((((best_u, best_v), best), (s0, s2)), ((d0, d1), d2)) in
            best.zip(sums).zip(differences)
        {
            let (u, v) = (s2 - s0, d0 + 2 * d1 + d2);
            let strength = i32::from(u) * i32::from(u) + i32::from(v) * i32::from(v);
            // By masks of all bits or none: compilers make a branch of a choice, and no vectors.
            let stronger = -i16::from(strength > *best);
            *best_u ^= (*best_u ^ u) & stronger;
            *best_v ^= (*best_v ^ v) & stronger;
            *best = (*best).max(strength);
        }
    }

    /// Writes the bit of the orientation of each gradient that is stronger than `least`, 0 for the
    /// others. Orientations are bins over half a turn, the first of them about +u.
    #[inline(always)]
    fn orientations(&self, least: i32, out: &mut [u8]) {
        // Tangents of 11.25°, 33.75°, 56.25° and 78.75°, in 1/1024, and the bins beyond them on
        // either side.
        const BINS_BEYOND: [(i32, u8, u8); 4] =
            [(204, 1 << 1, 1 << 7), (684, 1 << 2, 1 << 6), (1532, 1 << 3, 1 << 5), (5148, 16, 16)];
        let gradients = self.u.iter().zip(&self.v).zip(&self.strength);
        for (out, ((&u, &v), &strength)) in out.iter_mut().zip(gradients) {
            let (u, v) = (i32::from(u), i32::from(v));
            let falls = (u < 0) != (v < 0);
            let mut bit = 1;
            for (tangent, rising, falling) in BINS_BEYOND {
                let beyond = if falls { falling } else { rising };
                bit = if 1024 * v.abs() > tangent * u.abs() { beyond } else { bit };
            }
            *out = if strength > least { bit } else { 0 };
        }
    }
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
        // Offsets of one, two and four samples, rounded, add up to those of all samples.
        let flank = std::array::from_fn(|sample| {
            let steps = (0..FLANK_SAMPLES.ilog2()).filter(|k| sample >> k & 1 == 1);
            let offsets = steps.map(|k| cell(e * (-step * f64::from(1 << k))));
            offsets.fold((0, 0), |(x, y), (dx, dy)| (x + dx, y + dy))
        });
        let is_opposite = angle_rad >= PI;
        let (x, y) = if is_opposite { flank[FLANK_SAMPLES - 1] } else { (0, 0) };
        let flanks = [-1.0, 1.0].map(|side| {
            let (u, v) = cell(n * (side * w) - e * (w * (1.0 + near)));
            (u + x, v + y)
        });
        let flank = if is_opposite { flank.map(|(u, v)| (-u, -v)) } else { flank };
        Self { angle_rad, cap, flanks, flank, flank_bin: bin(angle_rad + PI / 2.0) }
    }
}

impl Octave {
    /// Sets the planes to the channels of a frame, and to the foreground if it is given.
    #[inline(always)]
    fn split(&mut self, frame: &Frame<'_>, foreground: Option<&ForegroundMap>) {
        let image = frame.image();
        (self.width, self.height) = (image.width(), image.height());
        let (width, pixels) = (self.width, self.width * self.height);
        let colours = if frame.colour().is_some() { 3 } else { 1 };
        self.planes.resize((colours + usize::from(foreground.is_some())) * pixels, 0);
        let (shown, last) = self.planes.split_at_mut(colours * pixels);
        if let Some(colour) = frame.colour() {
            let (first, others) = shown.split_at_mut(pixels);
            let (second, third) = others.split_at_mut(pixels);
            let rows = first.chunks_exact_mut(width).zip(second.chunks_exact_mut(width));
            for (y, ((a, b), c)) in rows.zip(third.chunks_exact_mut(width)).enumerate() {
                let row = colour.row(y).unwrap_or_default().as_chunks::<3>().0;
                for (((a, b), c), levels) in a.iter_mut().zip(b).zip(c).zip(row) {
                    [*a, *b, *c] = *levels;
                }
            }
        } else {
            for (y, row) in shown.chunks_exact_mut(width).enumerate() {
                row.copy_from_slice(image.row(y).unwrap_or_default());
            }
        }
        let Some(map) = foreground else { return };
        for (rows, cells) in last.chunks_mut(map.step * width).zip(map.cells.chunks(map.width)) {
            let (row, others) = rows.split_at_mut(width);
            for (out, &cell) in row.chunks_mut(map.step).zip(cells) {
                out.fill((FOREGROUND_GAIN * f64::from(cell)) as u8);
            }
            others.chunks_mut(width).for_each(|other| other.copy_from_slice(row));
        }
    }

    /// Means of 2 × 2 pixels of another octave.
    #[inline(always)]
    fn halve(&mut self, from: &Self, channels: usize) {
        (self.width, self.height) = ((from.width / 2).max(1), (from.height / 2).max(1));
        self.planes.resize(channels * self.width * self.height, 0);
        let below = if from.height > 1 { from.width } else { 0 };
        let planes = self.planes.chunks_exact_mut(self.width * self.height);
        for (plane, half) in from.planes.chunks_exact(from.width * from.height).zip(planes) {
            for (y, out) in half.chunks_exact_mut(self.width).enumerate() {
                let above = &plane[2 * y.min(from.height / 2) * from.width..];
                let (above, below) = (&above[..from.width], &above[below..][..from.width]);
                if from.width == 1 {
                    out[0] = quarter(above[0], above[0], below[0], below[0]);
                    continue;
                }
                let pairs = above.chunks_exact(2).zip(below.chunks_exact(2));
                for (mean, (a, b)) in out.iter_mut().zip(pairs) {
                    *mean = quarter(a[0], a[1], b[0], b[1]);
                }
            }
        }
    }
}

/// Splits a frame into channels, and halves these from octave to octave.
pub(super) struct SplitFrame<'a> {
    pub(super) octaves: &'a mut [Octave],
    pub(super) frame: &'a Frame<'a>,
    pub(super) foreground: Option<&'a ForegroundMap>,
}

impl Work for SplitFrame<'_> {
    #[inline(always)]
    fn run(self) {
        let Some((full, halved)) = self.octaves.split_first_mut() else { return };
        full.split(self.frame, self.foreground);
        let channels = full.planes.len() / (full.width * full.height);
        let mut before = full;
        for octave in halved {
            octave.halve(before, channels);
            before = octave;
        }
    }
}

/// Scores every template at every cell of a level, of which one has `step` pixels of an octave.
pub(super) struct ScoreLevel<'a> {
    pub(super) level: &'a mut Level,
    pub(super) octave: &'a Octave,
    pub(super) channels: usize,
    pub(super) step: f64,
    pub(super) min_gradient_grey: f64,
    pub(super) templates: &'a [BandTemplate],
}

impl Work for ScoreLevel<'_> {
    #[inline(always)]
    fn run(self) {
        self.level.sample(self.octave, self.channels, self.step);
        self.level.orient(self.channels, self.min_gradient_grey);
        let (half_turn, opposite) = self.templates.split_at(self.templates.len() / 2);
        for (k, template) in half_turn.iter().enumerate() {
            self.level.sum_flank(template);
            self.level.score(template, k as u8);
            self.level.score(&opposite[k], (half_turn.len() + k) as u8);
        }
    }
}

impl Level {
    /// Resamples an octave at every `step` pixels, bilinearly.
    #[inline(always)]
    fn sample(&mut self, octave: &Octave, channels: usize, step: f64) {
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
            (whole, ((at - whole as f64) * 256.0) as u16)
        };
        self.columns.clear();
        self.columns.extend((0..self.width).map(|x| fixed(x, octave.width)));
        let right = usize::from(octave.width > 1);
        let below = if octave.height > 1 { octave.width } else { 0 };
        for c in 0..channels {
            let plane = &octave.planes[c * octave.width * octave.height..];
            for y in 0..self.height {
                let (y0, t) = fixed(y, octave.height);
                let row = &plane[y0 * octave.width..];
                let pairs = row[..octave.width].iter().zip(&row[below..][..octave.width]);
                // Interpolated between two rows, in 1/256 grey level: at most 255 · 256.
                self.blended.clear();
                self.blended
                    .extend(pairs.map(|(&a, &b)| u16::from(a) * (256 - t) + u16::from(b) * t));
                let blended = &self.blended;
                self.image.extend(self.columns.iter().map(|&(x0, s)| {
                    let (a, b) = (u32::from(blended[x0]), u32::from(blended[x0 + right]));
                    ((a * u32::from(256 - s) + b * u32::from(s)) >> 16) as u8
                }));
            }
        }
    }

    /// Orientation of the strongest gradient of any channel in each cell, spread over its
    /// neighbours, and the response of each orientation to it.
    #[inline(always)]
    fn orient(&mut self, channels: usize, min_gradient_grey: f64) {
        let (width, height, stride) = (self.width, self.height, self.stride);
        let cells = stride * (height + 2 * MARGIN);
        for plane in [&mut self.orientations, &mut self.spread] {
            plane.clear();
            plane.resize(cells, 0);
        }
        // Sobel's weights add up to eight.
        let least = (8.0 * min_gradient_grey) as i32;
        let inside = width.saturating_sub(2);
        for y in 1..height.saturating_sub(1) {
            self.gradients.clear(inside, least * least);
            for plane in self.image.chunks_exact(width * height).take(channels) {
                self.gradients.add([y - 1, y, y + 1].map(|y| &plane[y * width..][..width]));
            }
            let out = &mut self.orientations[(y + MARGIN) * stride + MARGIN + 1..];
            self.gradients.orientations(least * least, out);
        }
        // Three cells in a row, then three such rows.
        let o = &self.orientations;
        self.rows.clear();
        self.rows.extend(o.iter().zip(&o[1..]).zip(&o[2..]).map(|((a, b), c)| a | b | c));
        let rows = self.rows.iter().zip(&self.rows[stride..]).zip(&self.rows[2 * stride..]);
        for (out, ((above, here), below)) in self.spread[stride + 1..].iter_mut().zip(rows) {
            *out = above | here | below;
        }
        self.responses.clear();
        for bin in 0..BINS {
            let (own, next) = response_bits(bin);
            self.responses.extend(self.spread.iter().map(|&set| response(set, own, next)));
        }
        for plane in [&mut self.best, &mut self.angle] {
            plane.clear();
            plane.resize(cells, 0);
        }
        self.flank.resize(cells, 0);
    }

    /// Offset of a sample in a plane.
    fn shift(&self, (dx, dy): (isize, isize)) -> isize {
        dy * self.stride as isize + dx
    }

    /// Sums the responses along a flank that begins at each cell, where all of it lies in the
    /// plane.
    #[inline(always)]
    fn sum_flank(&mut self, template: &BandTemplate) {
        let cells = self.best.len();
        let shifts = template.flank.map(|sample| self.shift(sample));
        let first = shifts.iter().fold(0, |first, &by| first.max(-by)) as usize;
        let end = cells - shifts.iter().fold(0, |most, &by| most.max(by)) as usize;
        let responses = &self.responses[template.flank_bin * cells..][..cells];
        let samples = shifts.map(|by| &responses[(first as isize + by) as usize..]);
        sum_samples(&samples, &mut self.flank[first..end]);
    }

    /// Scores the template at every cell, and keeps the best angle; of equal scores, that of the
    /// first angle. Scores below [`LEAST_SCORE`] are incomplete.
    #[inline(always)]
    fn score(&mut self, template: &BandTemplate, angle: u8) {
        let cells = self.best.len();
        // Within the reach of any sample from any cell of the image.
        let first = MARGIN * self.stride;
        let inner = first..cells - first;
        let from = |sample| (first as isize + self.shift(sample)) as usize;
        let flanks = template.flanks.map(from);
        let caps = template.cap.map(|(sample, bin)| bin * cells + from(sample));
        let [left, right] = flanks.map(|start| &self.flank[start..]);
        let caps = caps.map(|start| &self.responses[start..]);
        let mut sums = [0_u8; AT_ONCE];
        let best = self.best[inner.clone()].chunks_mut(AT_ONCE);
        let angles = self.angle[inner].chunks_mut(AT_ONCE);
        for (k, (best, angles)) in best.zip(angles).enumerate() {
            let part = k * AT_ONCE..k * AT_ONCE + best.len();
            let (left, right) = (&left[part.clone()], &right[part.clone()]);
            let flanks = || left.iter().zip(right);
            let may_win = flanks().zip(&*best).fold(false, |may_win, ((&l, &r), &best)| {
                may_win | (score(l, r, MOST_SCORE) >= best.max(LEAST_SCORE))
            });
            if !may_win {
                continue;
            }
            let cap = &mut sums[..best.len()];
            sum_samples(&caps.map(|responses| &responses[part.start..]), cap);
            for (((best, at), &c), (&l, &r)) in best.iter_mut().zip(angles).zip(&*cap).zip(flanks())
            {
                let score = score(l, r, c);
                let is_first = score > *best || (score == *best && angle < *at);
                *at = if is_first { angle } else { *at };
                *best = (*best).max(score);
            }
        }
    }

    /// Cells with the maximum score within a half-width: place, score and angle.
    pub(super) fn peaks(&self) -> impl Iterator<Item = (usize, usize, u8, u8)> {
        const REACH: usize = 2;
        let at = move |x: usize, y: usize| (y + MARGIN) * self.stride + x + MARGIN;
        (0..self.height)
            .flat_map(move |y| {
                let row = self.best[at(0, y)..][..self.width].iter().enumerate();
                row.filter(|(_, score)| **score >= LEAST_SCORE).map(move |(x, _)| (x, y))
            })
            .filter(move |&(x, y)| {
                let here = self.best[at(x, y)];
                (0..=2 * REACH).all(|dy| {
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

/// Sums of samples at successive cells.
#[inline(always)]
fn sum_samples(samples: &[&[u8]; 8], out: &mut [u8]) {
    let [a, b, c, d, e, f, g, h] = samples.map(|sample| &sample[..out.len()]);
    for (i, out) in out.iter_mut().enumerate() {
        *out = (a[i].wrapping_add(b[i]).wrapping_add(c[i]).wrapping_add(d[i]))
            .wrapping_add(e[i].wrapping_add(f[i]).wrapping_add(g[i]).wrapping_add(h[i]));
    }
}

/// Score of a band by the sums of its left and right flank and of its round end.
#[inline(always)]
fn score(left: u8, right: u8, cap: u8) -> u8 {
    mean(left.min(right).min(cap), mean(mean(left, right), cap))
}

/// Mean of two scores, rounded down; in bytes throughout.
#[inline(always)]
fn mean(a: u8, b: u8) -> u8 {
    (a & b) + ((a ^ b) >> 1)
}

/// Rounded mean of four levels.
#[inline(always)]
fn quarter(a: u8, b: u8, c: u8, d: u8) -> u8 {
    ((u16::from(a) + u16::from(b) + u16::from(c) + u16::from(d) + 2) / 4) as u8
}

/// The bit of an orientation in a set of orientations, and those of its two neighbours.
fn response_bits(bin: usize) -> (u8, u8) {
    (1 << bin, (1 << ((bin + 1) % BINS)) | (1 << ((bin + BINS - 1) % BINS)))
}

/// Response of a sample to a set of orientations nearby, given the bits of its own and the next.
#[inline(always)]
fn response(set: u8, own: u8, next: u8) -> u8 {
    let nearly = if set & next == 0 { 0 } else { NEARLY_MEETS };
    if set & own == 0 { nearly } else { MEETS }
}

/// Weight of the foreground's edges, such that they outweigh the texture of hand and background.
const FOREGROUND_GAIN: f64 = 0.6;

/// Half a finger's width in cells of the level that searches it.
pub(super) const HALF_WIDTH_CELLS: f64 = 2.5;

/// Ratio of the half-widths of successive levels.
pub(super) const LEVEL_RATIO: f64 = 1.35;

/// Number of angles searched.
pub(super) const ANGLES: usize = 24;

/// Number of orientation bins, over half a turn.
pub(super) const BINS: usize = 8;

/// Number of samples of the round end, and of either flank.
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

/// Least score of a band, and the greatest.
pub(super) const LEAST_SCORE: u8 = 144;
const MOST_SCORE: u8 = FLANK_SAMPLES as u8 * MEETS;

/// Cells scored at once, or skipped if none of them can reach a score.
const AT_ONCE: usize = 128;

#[cfg(test)]
mod tests {
    use super::*;

    /// The scores of opposite directions use the same sums.
    #[test]
    fn templates_of_opposite_directions_share_their_flank() {
        for k in 0..ANGLES / 2 {
            let angle_rad = k as f64 / ANGLES as f64 * 2.0 * PI;
            let (one, mut other) =
                (BandTemplate::new(angle_rad), BandTemplate::new(angle_rad + PI));
            let mut flank = one.flank;
            flank.sort_unstable();
            other.flank.sort_unstable();
            assert_eq!((flank, one.flank_bin), (other.flank, other.flank_bin));
        }
    }
}
