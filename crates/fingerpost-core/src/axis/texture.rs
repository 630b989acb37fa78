//! What a finger's skin looks like, and how it lies in another frame.
//!
//! Nail, creases and the shading across a finger move with it, whatever is behind it. Seen in the
//! finger's own coordinates, s along it from the tip and d across it, they stay as they are, and a
//! frame in which they lie elsewhere tells how the finger has moved and turned since. That is no line
//! of its own: where the axis runs in the skin nobody knows but the edges. But it carries what many
//! frames' edges have told from one to the next, before another background each time. The same is done
//! for a finger and the hand behind it together ([`Area`]): all that is said here of a finger holds.
//!
//! The model of a frame is I = g m(s, d) + o, with m the mean of the frames before, and gain and
//! offset of the light free. It is fitted by Gauss–Newton over a shift along the finger, one across
//! it and a turn about the middle, every cell weighted by Tukey's biweight and by how much it has
//! varied so far: what is no skin but background, or a reflection, varies as the finger moves and
//! soon has no say. A finger without texture or shading determines nothing, and its covariance says so:
//! the sandwich of what each block of cells contributes, for cells share pixels, compression mixes what
//! it stores, and skin that has changed has changed all over.
//!
//! Source: Lucas & Kanade 1981, An iterative image registration technique; the weights by what each
//! cell has varied are those of independent Gaussians. Liang & Zeger 1986, Longitudinal data analysis
//! using generalized linear models, §2: the covariance by clusters that are independent.

use crate::geometry::shape_space::Axis;
use crate::image::gray::GrayView;
use nalgebra::{Matrix2, SMatrix, SVector};

/// Cells across half of the finger; they are at least one pixel wide.
const CELLS_ACROSS: f64 = 8.0;
/// A cell is so many times as long as wide: skin changes less along a finger.
const ELONGATION: f64 = 2.0;
/// Cells reach so far across, in half-widths: the edge of a finger that is seen too slim lies there.
const ACROSS: f64 = 1.1;
/// The finger is looked at over so much at most, in half-widths.
const LONGEST: f64 = 10.0;
/// What is behind it of the hand is looked at from so far behind the tip to so far, in lengths of the
/// finger, and so far across, in half-widths: an index finger is at one edge of its hand or the other.
const BEHIND: f64 = 1.1;
const HAND_LENGTH: f64 = 1.6;
const HAND_ACROSS: f64 = 4.0;
/// The cells of a hand are so many times as large as those of a finger.
const COARSER: usize = 2;
/// Room for the cells of any finger and of any hand.
const ROWS: usize = 48;
const COLUMNS: usize = 44;

/// What a cell is expected to vary by at first, and at least \[grey levels²\].
const FIRST_VARIANCE: f32 = 6.0;
/// The same behind the finger: whether that is its hand is yet to be seen.
const FIRST_VARIANCE_BEHIND: f32 = 100.0;
const LEAST_VARIANCE: f32 = 2.0;
/// Part of a frame that is learned once some are known.
const RATE: f32 = 0.05;
/// Tukey's cutoff \[robust standard deviations\].
const CUTOFF: f32 = 4.685;
/// Median of χ² of one degree of freedom.
const MEDIAN: f32 = 0.455;
/// Cells do not scatter by less than this part of what they have varied by, in squares.
const LEAST_SCALE: f32 = 0.25;
/// A frame that scatters by more than this, in squares, shows something else.
const MOST_SCALE: f32 = 9.0;
/// And so does one whose shading is stronger or weaker by more than this factor: before white paper,
/// which lights its dark side, a finger shows half as much of it as before wood.
const MOST_GAIN: f32 = 4.0;
/// As many of the cells have to lie in the picture and to agree.
const LEAST_SEEN: f64 = 0.6;
/// Rows and columns of a block of a finger's cells, beyond which they count as independent: on footage
/// that was compressed their residuals correlate by 0.7 and 0.5 from cell to cell, by 0.1 over four.
const BLOCK: [usize; 2] = [4, 6];
/// Beside what was known before, so many of a finger's cells count as one.
const CORRELATION: f64 = 9.0;
/// Weighted residuals grow on average at least like so much of the residuals.
const LEAST_SLOPE: f32 = 0.2;

/// The tip is known this well along the finger, and the rest this badly \[px, px, rad\].
const PRIOR_SIGMAS: [f64; 3] = [1.0, 3.0, 0.1];
/// Settled when an iteration moves no cell by more than this \[px\]; one that still moves by more
/// than [`LOOSE_PX`] after the last has not found it.
const SETTLED_PX: f64 = 0.04;
const LOOSE_PX: f64 = 0.4;
const ITERATIONS: usize = 6;
/// Levels are told from here, the middle of the range \[grey levels\].
const MIDDLE_GREY: f32 = 128.0;

/// Unknowns: shift along, shift across, turn, gain, offset.
const UNKNOWNS: usize = 5;
type Vector = SVector<f64, UNKNOWNS>;
type Information = SMatrix<f64, UNKNOWNS, UNKNOWNS>;

/// The normal equations of a step.
struct Equations {
    information: Information,
    right: Vector,
    /// What the right side varies by: the sum of squares of what blocks of cells contribute to it.
    scatter: Information,
    /// How many cells agree with what is expected.
    agreeing: f64,
}

/// What of a hand a skin is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Area {
    /// A finger.
    Finger,
    /// A finger, and what is behind it of its hand.
    Hand,
}

/// A finger's skin, learned frame by frame.
#[derive(Debug, Clone)]
pub(crate) struct TexturePatch {
    area: Area,
    rows: usize,
    columns: usize,
    /// Size of a cell \[px\].
    along_px: f64,
    across_px: f64,
    /// The columns in use of each row, from and to.
    used: Vec<[usize; 2]>,
    cells: usize,
    /// Row by row, from the tip on: levels about [`MIDDLE_GREY`], and their variances.
    mean: Vec<f32>,
    variance: Vec<f32>,
    /// The frame that is being looked at; NaN outside of it.
    now: Vec<f32>,
    squares: Vec<f32>,
    frames: f32,
}

/// How the skin lies in a frame.
#[derive(Debug, Clone, Copy)]
pub(crate) struct TexturePose {
    /// The axis that was drawn on the skin when it was first seen, told at the skin's middle.
    pub axis: Axis,
    /// Covariance of its offset there \[px\] and of its angle \[rad\].
    pub covariance: Matrix2<f64>,
    gain: f32,
    offset: f32,
}

impl TexturePose {
    /// The same turned to an angle \[rad\] that is known besides, with a variance that is no more: the
    /// offset moves along as far as its error goes with that of the angle.
    pub fn turned_to(&self, angle_rad: f64, variance: f64) -> Self {
        let Axis { anchor, tip, angle_rad: own_rad } = self.axis;
        let own = self.covariance[(1, 1)];
        let along = self.covariance.column(1) / own;
        let turn_rad = (angle_rad - own_rad).sin().asin();
        let anchor_moved = anchor + self.axis.normal() * (along.x * turn_rad);
        let axis = Axis::of_finger(anchor_moved, own_rad + turn_rad, (tip - anchor).norm());
        let covariance = self.covariance - along * along.transpose() * (own - variance);
        Self { axis, covariance, ..*self }
    }
}

impl TexturePatch {
    /// None yet.
    pub fn empty(area: Area) -> Self {
        let cells = ROWS * COLUMNS;
        Self {
            area,
            rows: 0,
            columns: 0,
            along_px: 1.0,
            across_px: 1.0,
            used: Vec::with_capacity(ROWS),
            cells: 0,
            mean: Vec::with_capacity(cells),
            variance: Vec::with_capacity(cells),
            now: Vec::with_capacity(cells),
            squares: Vec::with_capacity(cells),
            frames: 0.0,
        }
    }

    /// Draws an axis on the skin that an image shows there, over a length back from its tip; the
    /// half-width is that at its anchor, and grows with the taper towards the tip. Whether the image
    /// shows enough of it.
    pub fn draw(
        &mut self,
        image: &GrayView<'_>,
        axis: &Axis,
        half_width_px: f64,
        taper: f64,
        length_px: f64,
    ) -> bool {
        self.across_px = (half_width_px / CELLS_ACROSS).max(1.0) * self.coarser() as f64;
        self.along_px = ELONGATION * self.across_px;
        let finger_px = length_px.min(LONGEST * half_width_px);
        let (length_px, behind_px) = match self.area {
            Area::Finger => (finger_px, f64::INFINITY),
            Area::Hand => (HAND_LENGTH * finger_px, BEHIND * finger_px),
        };
        // One more on every side, for the slopes.
        self.rows = ((length_px / self.along_px) as usize + 3).min(ROWS);
        self.columns = COLUMNS - 1;
        let ahead_px = (axis.tip - axis.anchor).dot(&axis.direction());
        let end_px = half_width_px + taper * ahead_px;
        self.used.clear();
        for row in 0..self.rows {
            let back_px = -self.s(row);
            let half_px = half_width_px + taper * (ahead_px - back_px);
            // The end is round.
            let over_px = (end_px - back_px).max(0.0);
            let across = if back_px > behind_px { HAND_ACROSS } else { ACROSS };
            let reach_px = across * (half_px * half_px - over_px * over_px).max(0.0).sqrt();
            let reach = ((reach_px / self.across_px) as usize).min(self.columns / 2 - 1);
            let middle = self.columns / 2;
            let is_border = row == 0 || row + 1 == self.rows;
            self.used.push(if is_border { [0, 0] } else { [middle - reach, middle + reach + 1] });
        }
        self.cells = self.used.iter().map(|[from, to]| to - from).sum();
        let all = self.rows * self.columns;
        for (levels, value) in
            [(&mut self.mean, 0.0), (&mut self.now, 0.0), (&mut self.variance, FIRST_VARIANCE)]
        {
            levels.clear();
            levels.resize(all, value);
        }
        for (row, variances) in self.variance.chunks_exact_mut(self.columns).enumerate() {
            if row as f64 * self.along_px > behind_px {
                variances.fill(FIRST_VARIANCE_BEHIND);
            }
        }
        self.frames = 1.0;
        self.sample(image, &self.middle_of(axis));
        self.mean.copy_from_slice(&self.now);
        self.used_cells().filter(|&i| self.now[i].is_finite()).count() as f64
            >= LEAST_SEEN * self.cells.max(1) as f64
    }

    /// An axis told at the skin's middle.
    pub fn middle_of(&self, axis: &Axis) -> Axis {
        let tip = axis.anchor + axis.direction() * (axis.tip - axis.anchor).dot(&axis.direction());
        Axis { anchor: tip + axis.direction() * self.middle_px(), tip, ..*axis }
    }

    /// How many times as large its cells are as those of a finger.
    fn coarser(&self) -> usize {
        match self.area {
            Area::Finger => 1,
            Area::Hand => COARSER,
        }
    }

    /// So many of its cells count as one.
    fn correlation(&self) -> f64 {
        CORRELATION / (self.coarser() * self.coarser()) as f64
    }

    /// s of the middle \[px\].
    fn middle_px(&self) -> f64 {
        -0.5 * self.rows.saturating_sub(1) as f64 * self.along_px
    }

    /// s and d of a row and of a column \[px\].
    fn s(&self, row: usize) -> f64 {
        -(row as f64) * self.along_px
    }

    fn d(&self, column: usize) -> f64 {
        (column as f64 - (self.columns / 2) as f64) * self.across_px
    }

    fn used_cells(&self) -> impl Iterator<Item = usize> + '_ {
        let columns = self.columns;
        self.used
            .iter()
            .enumerate()
            .flat_map(move |(row, [from, to])| row * columns + from..row * columns + to)
    }

    /// Samples the image where the skin would lie on an axis, and one cell around it.
    fn sample(&mut self, image: &GrayView<'_>, at: &Axis) {
        let (e, n) = (at.direction(), at.normal());
        for row in 0..self.rows {
            let beside = |row: usize| self.used.get(row).copied().filter(|[from, to]| to > from);
            let runs = [row.wrapping_sub(1), row, row + 1];
            let run =
                runs.into_iter().filter_map(beside).reduce(|a, b| [a[0].min(b[0]), a[1].max(b[1])]);
            let Some([from, to]) = run else { continue };
            let middle = at.tip + e * self.s(row);
            for column in from.saturating_sub(1)..(to + 1).min(self.columns) {
                let place = middle + n * self.d(column);
                let level = image.sample_f32(place.x as f32, place.y as f32);
                self.now[row * self.columns + column] = level.map_or(f32::NAN, |g| g - MIDDLE_GREY);
            }
        }
    }

    /// How the skin lies in an image, near where an axis would have it; `None` where the image does
    /// not show it.
    pub fn find(&mut self, image: &GrayView<'_>, near: &Axis) -> Option<TexturePose> {
        let start = self.middle_of(near);
        let (mut axis, mut light, mut along_px) = (start, [1.0, 0.0], 0.0);
        let correlation = self.correlation();
        for iteration in 1..=ITERATIONS {
            self.sample(image, &axis);
            let scale = self.scale(light)?;
            let determined = self.equations(light, scale);
            if determined.agreeing < LEAST_SEEN * self.cells as f64 {
                return None;
            }
            let prior = prior();
            let mut right = determined.right / correlation;
            right[0] -= along_px * prior[(0, 0)];
            let inverse = (determined.information / correlation + prior).try_inverse()?;
            let step: Vector = inverse * right;
            along_px += step[0];
            let (e, n) = (axis.direction(), axis.normal());
            let anchor = axis.anchor + e * step[0] + n * step[1];
            axis = Axis::of_finger(anchor, axis.angle_rad + step[2], -self.middle_px());
            light = [light[0] + step[3] as f32, light[1] + step[4] as f32];
            let moved_px = step[1].abs() + self.middle_px().abs() * step[2].abs();
            if moved_px < SETTLED_PX || (iteration == ITERATIONS && moved_px < LOOSE_PX) {
                let [gain, offset] = light;
                let is_it = scale <= MOST_SCALE && (1.0 / MOST_GAIN..=MOST_GAIN).contains(&gain);
                let scatter = determined.scatter / (correlation * correlation) + prior;
                let covariance = inverse * scatter * inverse;
                let covariance = covariance.fixed_view::<2, 2>(1, 1).into_owned();
                return is_it.then_some(TexturePose { axis, covariance, gain, offset });
            }
        }
        None
    }

    /// The robust variance of what is seen about what is expected, in units of what each cell varies
    /// by.
    fn scale(&mut self, [gain, offset]: [f32; 2]) -> Option<f32> {
        let mut squares = std::mem::take(&mut self.squares);
        squares.clear();
        squares.extend(self.used_cells().filter_map(|i| {
            let residual = self.now[i] - gain * self.mean[i] - offset;
            let square = residual * residual / self.variance[i];
            square.is_finite().then_some(square)
        }));
        let middle = squares.len() / 2;
        let scale = (!squares.is_empty())
            .then(|| *squares.select_nth_unstable_by(middle, f32::total_cmp).1 / MEDIAN);
        self.squares = squares;
        scale.map(|s| s.max(LEAST_SCALE))
    }

    /// The normal equations of a step in such a light, where residuals scatter like this.
    fn equations(&self, [gain, offset]: [f32; 2], scale: f32) -> Equations {
        let mut sums = [[0.0_f32; UNKNOWNS + 1]; UNKNOWNS];
        let mut blocks = [[0.0_f32; UNKNOWNS]; COLUMNS * COARSER / BLOCK[1] + 1];
        let mut scatter = Information::zeros();
        let (mut agreeing, mut weights, mut slopes) = (0.0, 0.0, 0.0);
        let (per_along, per_across) = (0.5 / self.along_px as f32, 0.5 / self.across_px as f32);
        let cutoff = 1.0 / (CUTOFF * CUTOFF * scale);
        let middle_px = self.middle_px();
        let [block_rows, block_columns] = BLOCK.map(|cells| cells / self.coarser());
        for (row, &[from, to]) in self.used.iter().enumerate() {
            let from_middle = (self.s(row) - middle_px) as f32;
            for column in from..to {
                let i = row * self.columns + column;
                let (now, level) = (self.now[i], self.mean[i]);
                let residual = now - gain * level - offset;
                let weight = 1.0 / self.variance[i];
                let left = 1.0 - residual * residual * weight * cutoff;
                // Rows run from the tip back.
                let slope =
                    gain * per_along * (self.mean[i - self.columns] - self.mean[i + self.columns]);
                let across = gain * per_across * (self.mean[i + 1] - self.mean[i - 1]);
                let d = self.d(column) as f32;
                let determined = [-slope, -across, slope * d - across * from_middle, level, 1.0];
                if !(left > 0.0 && (slope + across).is_finite()) {
                    continue;
                }
                agreeing += 1.0;
                weights += left * left;
                slopes += left * (5.0 * left - 4.0);
                let weight = weight * left * left / scale;
                for k in 0..UNKNOWNS {
                    let weighted = weight * determined[k];
                    for j in k..UNKNOWNS {
                        sums[k][j] += weighted * determined[j];
                    }
                    sums[k][UNKNOWNS] += weighted * residual;
                    blocks[column / block_columns][k] += weighted * residual;
                }
            }
            if (row + 1) % block_rows == 0 || row + 1 == self.used.len() {
                for block in &mut blocks {
                    let block = Vector::from(std::mem::take(block).map(f64::from));
                    scatter += block * block.transpose();
                }
            }
        }
        let information = Information::from_fn(|i, j| f64::from(sums[i.min(j)][i.max(j)]));
        let right = Vector::from_fn(|i, _| f64::from(sums[i][UNKNOWNS]));
        // ψ(r) = r (1 − t²)², w = (1 − t²)²: by ψ′ the information is Σ ψ′ / Σ w of that by weights.
        scatter *= f64::from(weights / slopes.max(LEAST_SLOPE * weights)).powi(2);
        Equations { information, right, scatter, agreeing }
    }

    /// Learns the frame in which the skin has just been found.
    pub fn learn(&mut self, texture_pose: &TexturePose) {
        self.frames += 1.0;
        let rate = (1.0 / self.frames).max(RATE);
        let light = 1.0 / texture_pose.gain;
        let cells = self.mean.iter_mut().zip(&mut self.variance).zip(&self.now);
        for ((mean, variance), now) in cells {
            let change = (now - texture_pose.offset) * light - *mean;
            if change.is_finite() {
                *mean += rate * change;
                *variance = ((1.0 - rate) * *variance + rate * change * change).max(LEAST_VARIANCE);
            } else if now.is_finite() {
                *mean = (now - texture_pose.offset) * light;
            }
        }
    }
}

/// The information of how well a lie is known before.
fn prior() -> Information {
    let sigmas = PRIOR_SIGMAS.map(|sigma: f64| sigma.powi(-2));
    Information::from_diagonal(&Vector::from_fn(|k, _| sigmas.get(k).copied().unwrap_or_default()))
}

#[cfg(test)]
#[expect(clippy::unwrap_used, reason = "a test may panic")]
pub(crate) mod tests;
