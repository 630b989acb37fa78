//! Registration of the finger's texture from frame to frame.
//!
//! Nail, creases and shading move with the finger, before any background. In the finger's own
//! coordinates, s along it from the tip and d across it, the texture is constant, so its
//! displacement in a frame measures the shift and turn of the finger since the patch was drawn. The
//! texture gives no axis of its own: only the edges locate the axis within the texture. It carries
//! the edge measurements of many frames, before different backgrounds, from one frame to the next.
//! The same holds for the finger together with the hand behind it ([`Area`]).
//!
//! The model of a frame is I = g m(s, d) + o, with m the mean of the previous frames and gain g and
//! offset o of the illumination free. It is fitted by Gauss–Newton over a shift along the finger, a
//! shift across it and a turn about the middle. Every cell is weighted by Tukey's biweight and by
//! the inverse of its variance to date: cells that show background or a reflection vary as the
//! finger moves and soon lose their weight. A finger without texture or shading determines nothing,
//! and the covariance shows it. The covariance is the sandwich over blocks of cells, because cells
//! share pixels, compression correlates neighbours, and skin changes over wide areas at once.
//!
//! Source: Lucas & Kanade 1981, An iterative image registration technique; the inverse-variance
//! weights are those of independent Gaussians. Liang & Zeger 1986, Longitudinal data analysis using
//! generalized linear models, §2: the covariance from independent clusters.

use crate::geometry::shape_space::Axis;
use crate::image::gray::GrayView;
use nalgebra::{Matrix2, SMatrix, SVector};

/// Cells across half of the finger; a cell is at least one pixel wide.
const CELLS_ACROSS: f64 = 8.0;
/// Length of a cell over its width: texture changes less along a finger.
const ELONGATION: f64 = 2.0;
/// Half-width of the patch \[half-widths of the finger\]: beyond 1, because the edge of a finger
/// whose width is underestimated lies there.
const ACROSS: f64 = 1.1;
/// Upper bound on the length of finger in the patch \[half-widths\].
const LONGEST: f64 = 10.0;
/// The hand behind the finger: distance behind the tip where it begins and where it ends \[lengths
/// of the finger\], and reach to either side \[half-widths\]. An index finger lies at one edge of
/// its hand or at the other, so both sides are included.
const BEHIND: f64 = 1.1;
const HAND_LENGTH: f64 = 1.6;
const HAND_ACROSS: f64 = 4.0;
/// Cell size of a hand over that of a finger.
const COARSER: usize = 2;
/// Capacity for the cells of a finger or of a hand.
const ROWS: usize = 48;
const COLUMNS: usize = 44;

/// Initial variance of a cell, and its lower bound (`LEAST_VARIANCE`) \[grey levels²\].
const FIRST_VARIANCE: f32 = 6.0;
/// Initial variance behind the finger, where the cells may not show the hand \[grey levels²\].
const FIRST_VARIANCE_BEHIND: f32 = 100.0;
const LEAST_VARIANCE: f32 = 2.0;
/// Learning rate once 1 / frames is below it.
const RATE: f32 = 0.05;
/// Tukey's cutoff \[robust standard deviations\].
const CUTOFF: f32 = 4.685;
/// Median of χ² with one degree of freedom.
const MEDIAN: f32 = 0.455;
/// Lower bound on the robust variance of the cells, in units of their own variances.
const LEAST_SCALE: f32 = 0.25;
/// Upper bound on the same; above it the frame does not show the patch.
const MOST_SCALE: f32 = 9.0;
/// Upper bound on the gain, and its inverse the lower bound. Before white paper, which lights the
/// dark side, the shading of a finger has half the amplitude that it has before wood.
const MOST_GAIN: f32 = 4.0;
/// Fraction of the cells that must lie in the image, and that must agree with the patch.
const LEAST_SEEN: f64 = 0.6;
/// Rows and columns of a block of a finger's cells; blocks count as independent. On compressed
/// footage residuals of adjacent cells correlate by 0.7 and 0.5, over four cells by 0.1.
const BLOCK: [usize; 2] = [4, 6];
/// Number of a finger's cells that count as one independent measurement beside the prior.
const CORRELATION: f64 = 9.0;
/// Lower bound on Σ ψ′ / Σ w.
const LEAST_SLOPE: f32 = 0.2;

/// Standard deviations of the shift along, the shift across and the turn \[px, px, rad\]. The first
/// is that of the predicted tip; the others damp each step.
const PRIOR_SIGMAS: [f64; 3] = [1.0, 3.0, 0.1];
/// Convergence: no cell moves by more than this in an iteration \[px\]. If one still moves by more
/// than [`LOOSE_PX`] in the last iteration, the registration fails.
const SETTLED_PX: f64 = 0.04;
const LOOSE_PX: f64 = 0.4;
const ITERATIONS: usize = 6;
/// Origin of the grey levels, the middle of their range.
const MIDDLE_GREY: f32 = 128.0;

/// Unknowns: shift along, shift across, turn, gain, offset.
const UNKNOWNS: usize = 5;
type PoseVector = SVector<f64, UNKNOWNS>;
type PoseInformation = SMatrix<f64, UNKNOWNS, UNKNOWNS>;

/// The normal equations of a step.
struct PoseEquations {
    information: PoseInformation,
    right: PoseVector,
    /// Covariance of the right side: the sum over blocks of cells of the outer products of their
    /// contributions.
    scatter: PoseInformation,
    /// Number of cells with non-zero weight.
    agreeing: f64,
}

/// Area of the hand that a patch covers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Area {
    /// The finger.
    Finger,
    /// The finger and the part of the hand behind it.
    Hand,
}

/// The texture of a finger, learned frame by frame.
#[derive(Debug, Clone)]
pub(crate) struct TexturePatch {
    area: Area,
    rows: usize,
    columns: usize,
    /// Size of a cell \[px\].
    along_px: f64,
    across_px: f64,
    /// First column and end column in use, per row.
    used: Vec<[usize; 2]>,
    cells: usize,
    /// Row by row from the tip: mean levels relative to [`MIDDLE_GREY`], and their variances.
    mean: Vec<f32>,
    variance: Vec<f32>,
    /// Levels of the current frame; NaN outside of it.
    now: Vec<f32>,
    squares: Vec<f32>,
    frames: f32,
}

/// Pose of the texture in a frame.
#[derive(Debug, Clone, Copy)]
pub(crate) struct TexturePose {
    /// The axis that was assigned to the texture when the patch was drawn, with its anchor at the
    /// patch's middle.
    pub axis: Axis,
    /// Covariance of its offset there \[px\] and of its angle \[rad\].
    pub covariance: Matrix2<f64>,
    gain: f32,
    offset: f32,
}

impl TexturePose {
    /// The pose conditioned on an angle \[rad\] from another source whose variance does not exceed
    /// the pose's own. The offset moves by its regression on the angle.
    pub fn turned_to(&self, angle_rad: f64, variance: f64) -> Self {
        let Axis { anchor, tip, angle_rad: own_rad } = self.axis;
        let own_variance = self.covariance[(1, 1)];
        let regression = self.covariance.column(1) / own_variance;
        let turn_rad = (angle_rad - own_rad).sin().asin();
        let anchor_moved = anchor + self.axis.normal() * (regression.x * turn_rad);
        let axis = Axis::of_finger(anchor_moved, own_rad + turn_rad, (tip - anchor).norm());
        let covariance =
            self.covariance - regression * regression.transpose() * (own_variance - variance);
        Self { axis, covariance, ..*self }
    }
}

impl TexturePatch {
    /// An empty patch.
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

    /// Draws the patch from an image along an axis, over a length back from its tip. The half-width
    /// is given at the anchor and grows with the taper towards the tip. Returns whether the image
    /// shows enough cells.
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
        // One more on every side, for the gradients.
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

    /// The axis with its anchor at the patch's middle.
    pub fn middle_of(&self, axis: &Axis) -> Axis {
        let tip = axis.anchor + axis.direction() * (axis.tip - axis.anchor).dot(&axis.direction());
        Axis { anchor: tip + axis.direction() * self.middle_px(), tip, ..*axis }
    }

    /// Cell size over that of a finger's patch.
    fn coarser(&self) -> usize {
        match self.area {
            Area::Finger => 1,
            Area::Hand => COARSER,
        }
    }

    /// Number of cells that count as one independent measurement.
    fn correlation(&self) -> f64 {
        CORRELATION / (self.coarser() * self.coarser()) as f64
    }

    /// s of the middle \[px\].
    fn middle_px(&self) -> f64 {
        -0.5 * self.rows.saturating_sub(1) as f64 * self.along_px
    }

    /// s of a row and d of a column \[px\].
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

    /// Samples the image where the patch's cells lie for an axis, with a margin of one cell.
    fn sample(&mut self, image: &GrayView<'_>, at: &Axis) {
        let (e, n) = (at.direction(), at.normal());
        for row in 0..self.rows {
            let used_columns =
                |row: usize| self.used.get(row).copied().filter(|[from, to]| to > from);
            let runs = [row.wrapping_sub(1), row, row + 1];
            let run = runs
                .into_iter()
                .filter_map(used_columns)
                .reduce(|a, b| [a[0].min(b[0]), a[1].max(b[1])]);
            let Some([from, to]) = run else { continue };
            let middle = at.tip + e * self.s(row);
            for column in from.saturating_sub(1)..(to + 1).min(self.columns) {
                let place = middle + n * self.d(column);
                let level = image.sample_f32(place.x as f32, place.y as f32);
                self.now[row * self.columns + column] = level.map_or(f32::NAN, |g| g - MIDDLE_GREY);
            }
        }
    }

    /// Registers the patch in an image near the predicted axis `near`; `None` where the image does
    /// not show the patch.
    pub fn find(&mut self, image: &GrayView<'_>, near: &Axis) -> Option<TexturePose> {
        let start = self.middle_of(near);
        let (mut axis, mut light, mut along_px) = (start, [1.0, 0.0], 0.0);
        let correlation = self.correlation();
        for iteration in 1..=ITERATIONS {
            self.sample(image, &axis);
            let scale = self.scale(light)?;
            let equations = self.equations(light, scale);
            if equations.agreeing < LEAST_SEEN * self.cells as f64 {
                return None;
            }
            let prior = prior();
            let mut right = equations.right / correlation;
            right[0] -= along_px * prior[(0, 0)];
            let inverse = (equations.information / correlation + prior).try_inverse()?;
            let step: PoseVector = inverse * right;
            along_px += step[0];
            let (e, n) = (axis.direction(), axis.normal());
            let anchor = axis.anchor + e * step[0] + n * step[1];
            axis = Axis::of_finger(anchor, axis.angle_rad + step[2], -self.middle_px());
            light = [light[0] + step[3] as f32, light[1] + step[4] as f32];
            let moved_px = step[1].abs() + self.middle_px().abs() * step[2].abs();
            if moved_px < SETTLED_PX || (iteration == ITERATIONS && moved_px < LOOSE_PX) {
                let [gain, offset] = light;
                let is_valid = scale <= MOST_SCALE && (1.0 / MOST_GAIN..=MOST_GAIN).contains(&gain);
                let scatter = equations.scatter / (correlation * correlation) + prior;
                let covariance = inverse * scatter * inverse;
                let covariance = covariance.fixed_view::<2, 2>(1, 1).into_owned();
                return is_valid.then_some(TexturePose { axis, covariance, gain, offset });
            }
        }
        None
    }

    /// Robust variance of the residuals, in units of the cells' variances; `None` without cells in
    /// the image.
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

    /// The normal equations of a step for a gain, an offset and a residual scale.
    fn equations(&self, [gain, offset]: [f32; 2], scale: f32) -> PoseEquations {
        let mut sums = [[0.0_f32; UNKNOWNS + 1]; UNKNOWNS];
        let mut blocks = [[0.0_f32; UNKNOWNS]; COLUMNS * COARSER / BLOCK[1] + 1];
        let mut scatter = PoseInformation::zeros();
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
                let root_weight = 1.0 - residual * residual * weight * cutoff;
                // Rows run from the tip back.
                let slope =
                    gain * per_along * (self.mean[i - self.columns] - self.mean[i + self.columns]);
                let across = gain * per_across * (self.mean[i + 1] - self.mean[i - 1]);
                let d = self.d(column) as f32;
                let jacobian = [-slope, -across, slope * d - across * from_middle, level, 1.0];
                if !(root_weight > 0.0 && (slope + across).is_finite()) {
                    continue;
                }
                agreeing += 1.0;
                weights += root_weight * root_weight;
                slopes += root_weight * (5.0 * root_weight - 4.0);
                let weight = weight * root_weight * root_weight / scale;
                for k in 0..UNKNOWNS {
                    let weighted = weight * jacobian[k];
                    for j in k..UNKNOWNS {
                        sums[k][j] += weighted * jacobian[j];
                    }
                    sums[k][UNKNOWNS] += weighted * residual;
                    blocks[column / block_columns][k] += weighted * residual;
                }
            }
            if (row + 1) % block_rows == 0 || row + 1 == self.used.len() {
                for block in &mut blocks {
                    let block = PoseVector::from(std::mem::take(block).map(f64::from));
                    scatter += block * block.transpose();
                }
            }
        }
        let information = PoseInformation::from_fn(|i, j| f64::from(sums[i.min(j)][i.max(j)]));
        let right = PoseVector::from_fn(|i, _| f64::from(sums[i][UNKNOWNS]));
        // ψ(r) = r (1 − t²)², w = (1 − t²)²: the information by ψ′ is Σ ψ′ / Σ w times that by
        // weights.
        scatter *= f64::from(weights / slopes.max(LEAST_SLOPE * weights)).powi(2);
        PoseEquations { information, right, scatter, agreeing }
    }

    /// Updates the patch with the frame in which it has just been registered.
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

/// Information matrix of the prior of the pose.
fn prior() -> PoseInformation {
    let sigmas = PRIOR_SIGMAS.map(|sigma: f64| sigma.powi(-2));
    PoseInformation::from_diagonal(&PoseVector::from_fn(|k, _| {
        sigmas.get(k).copied().unwrap_or_default()
    }))
}

#[cfg(test)]
#[expect(clippy::unwrap_used, reason = "a test may panic")]
pub(crate) mod tests;
