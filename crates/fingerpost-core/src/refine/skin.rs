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

use crate::image::GrayView;
use crate::shape_space::Axis;
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
pub(crate) struct Skin {
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
pub(crate) struct Lie {
    /// The axis that was drawn on the skin when it was first seen, told at the skin's middle.
    pub axis: Axis,
    /// Covariance of its offset there \[px\] and of its angle \[rad\].
    pub covariance: Matrix2<f64>,
    gain: f32,
    offset: f32,
}

impl Lie {
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

impl Skin {
    /// None yet.
    pub fn unseen(area: Area) -> Self {
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
        self.look(image, &self.middle_of(axis));
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
    fn look(&mut self, image: &GrayView<'_>, at: &Axis) {
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
    pub fn find(&mut self, image: &GrayView<'_>, near: &Axis) -> Option<Lie> {
        let start = self.middle_of(near);
        let (mut axis, mut light, mut along_px) = (start, [1.0, 0.0], 0.0);
        let correlation = self.correlation();
        for iteration in 1..=ITERATIONS {
            self.look(image, &axis);
            let scale = self.scale(light)?;
            let told = self.equations(light, scale);
            if told.agreeing < LEAST_SEEN * self.cells as f64 {
                return None;
            }
            let prior = prior();
            let mut right = told.right / correlation;
            right[0] -= along_px * prior[(0, 0)];
            let inverse = (told.information / correlation + prior).try_inverse()?;
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
                let scatter = told.scatter / (correlation * correlation) + prior;
                let covariance = inverse * scatter * inverse;
                let covariance = covariance.fixed_view::<2, 2>(1, 1).into_owned();
                return is_it.then_some(Lie { axis, covariance, gain, offset });
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
                let told = [-slope, -across, slope * d - across * from_middle, level, 1.0];
                if !(left > 0.0 && (slope + across).is_finite()) {
                    continue;
                }
                agreeing += 1.0;
                weights += left * left;
                slopes += left * (5.0 * left - 4.0);
                let weight = weight * left * left / scale;
                for k in 0..UNKNOWNS {
                    let weighted = weight * told[k];
                    for j in k..UNKNOWNS {
                        sums[k][j] += weighted * told[j];
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
    pub fn learn(&mut self, lie: &Lie) {
        self.frames += 1.0;
        let rate = (1.0 / self.frames).max(RATE);
        let light = 1.0 / lie.gain;
        let cells = self.mean.iter_mut().zip(&mut self.variance).zip(&self.now);
        for ((mean, variance), now) in cells {
            let change = (now - lie.offset) * light - *mean;
            if change.is_finite() {
                *mean += rate * change;
                *variance = ((1.0 - rate) * *variance + rate * change * change).max(LEAST_VARIANCE);
            } else if now.is_finite() {
                *mean = (now - lie.offset) * light;
            }
        }
    }
}

/// The information of how well a lie is known before.
fn prior() -> Information {
    let sigmas = PRIOR_SIGMAS.map(|sigma: f64| sigma.powi(-2));
    Information::from_diagonal(&Vector::from_fn(|k, _| sigmas.get(k).copied().unwrap_or_default()))
}

// The skin is private to the crate, and what it must agree with is where its finger was painted.
#[cfg(test)]
#[expect(clippy::unwrap_used, reason = "a test may panic")]
pub(crate) mod tests {
    use super::*;
    use nalgebra::Point2;

    pub(crate) const WIDTH: usize = 160;
    pub(crate) const HEIGHT: usize = 120;
    const LENGTH_PX: f64 = 60.0;
    const HALF_WIDTH_PX: f64 = 8.0;

    /// A finger of 60 × 16 px before stripes.
    #[derive(Clone, Copy)]
    pub(crate) struct Painted {
        pub tip: Point2<f64>,
        pub angle_rad: f64,
        /// Shading across it and creases along it \[grey levels\]; without, it is even.
        pub texture: f64,
        pub gain: f64,
        /// How its hand is turned beside it, about the finger's middle; there may be none.
        pub hand_rad: Option<f64>,
        /// Where the stripes behind it begin \[px\].
        pub stripes_px: f64,
        pub noise: f64,
        /// Its correlation reaches so many pixels to every side.
        pub spread_px: usize,
        pub seed: u64,
    }

    impl Painted {
        pub(crate) fn at(tip: [f64; 2], angle_rad: f64) -> Self {
            let tip = Point2::from(tip);
            let [texture, gain, stripes_px, noise] = [20.0, 1.0, 0.0, 0.0];
            let (hand_rad, spread_px, seed) = (None, 0, 1);
            Self { tip, angle_rad, texture, gain, hand_rad, stripes_px, noise, spread_px, seed }
        }

        pub(crate) fn axis(&self) -> Axis {
            let back = Axis::of_finger(self.tip, self.angle_rad, 0.0).direction() * 30.0;
            Axis::of_finger(self.tip - back, self.angle_rad, 30.0)
        }

        fn level(&self, x: f64, y: f64) -> f64 {
            let axis = self.axis();
            let from_tip = Point2::new(x, y) - self.tip;
            let (s, d) = (from_tip.dot(&axis.direction()), from_tip.dot(&axis.normal()));
            let outside = d.hypot((s + HALF_WIDTH_PX).max(0.0)) - HALF_WIDTH_PX;
            let depth = (1.0 - (d / HALF_WIDTH_PX).powi(2)).max(0.0).sqrt();
            let skin = self.skin(depth, s, d);
            let behind = 90.0 + 15.0 * (0.4 * (x - 0.5 * y) + self.stripes_px).sin();
            let behind = self.hand(x, y).map_or(behind, |[hand, outside]| {
                behind + (hand - behind) / (1.0 + (2.0 * outside).exp())
            });
            behind + (skin - behind) / (1.0 + (2.0 * outside).exp())
        }

        fn skin(&self, depth: f64, s: f64, d: f64) -> f64 {
            let crease = (0.31 * s + 0.4 * d).sin() + (0.17 * s - 0.25 * d).cos();
            140.0 + self.texture * (depth + 0.5 * crease)
        }

        /// Level of the hand, from 52 px behind the tip on and 44 px across, and how far outside of it
        /// a place is.
        fn hand(&self, x: f64, y: f64) -> Option<[f64; 2]> {
            let axis = Axis { angle_rad: self.angle_rad + self.hand_rad?, ..self.axis() };
            let from_middle = Point2::new(x, y) - axis.anchor;
            let (s, d) = (from_middle.dot(&axis.direction()), from_middle.dot(&axis.normal()));
            Some([self.skin(0.5, 1.3 * s, 0.7 * d), (s + 22.0).max(d.abs() - 22.0)])
        }

        pub(crate) fn bytes(&self) -> Vec<u8> {
            let noise = self.unit_noise();
            (0..WIDTH * HEIGHT)
                .map(|i| {
                    let level = self.level((i % WIDTH) as f64, (i / WIDTH) as f64);
                    (self.gain * level + self.noise * noise[i]).round().clamp(0.0, 255.0) as u8
                })
                .collect()
        }

        /// Noise of unit variance, a mean of as many pixels as its spread has it.
        fn unit_noise(&self) -> Vec<f64> {
            let mut state = self.seed;
            let mut normal = || {
                // Sum of uniforms from a linear congruential generator.
                (0..12).fold(-6.0, |sum, _| {
                    state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
                    sum + (state >> 40) as f64 / f64::from(1 << 24)
                })
            };
            let white: Vec<f64> = (0..WIDTH * HEIGHT).map(|_| normal()).collect();
            let across = 2 * self.spread_px + 1;
            let first = self.spread_px * (WIDTH + 1);
            let spread = |i: usize| {
                let rows = (0..across).map(|row| i + white.len() - first + row * WIDTH);
                let pixels = rows.flat_map(|row| (row..row + across).map(|k| k % white.len()));
                pixels.map(|k| white[k]).sum::<f64>() / across as f64
            };
            (0..white.len()).map(spread).collect()
        }

        pub(crate) fn show<T>(&self, look: impl FnOnce(&GrayView<'_>) -> T) -> T {
            look(&GrayView::new(&self.bytes(), WIDTH, HEIGHT, WIDTH).unwrap())
        }
    }

    fn drawn(painted: &Painted) -> Skin {
        let mut skin = Skin::unseen(Area::Finger);
        let seen =
            painted.show(|image| skin.draw(image, &painted.axis(), HALF_WIDTH_PX, 0.0, LENGTH_PX));
        assert!(seen);
        skin
    }

    /// How far a lie is from where the finger was painted: offset at its anchor and angle.
    fn off(lie: &Lie, painted: &Painted) -> [f64; 2] {
        let truth = painted.axis();
        [
            truth.normal().dot(&(lie.axis.anchor - truth.anchor)),
            lie.axis.angle_rad - truth.angle_rad,
        ]
    }

    #[test]
    fn skin_is_found_where_its_finger_has_moved_and_turned_in_another_light() {
        let mut skin = drawn(&Painted::at([110.0, 70.0], 0.4));
        for (tip, angle_rad, gain) in
            [([110.0, 70.0], 0.4, 1.0), ([112.3, 68.4], 0.43, 1.0), ([90.2, 80.9], 0.9, 0.8)]
        {
            let painted = Painted { gain, ..Painted::at(tip, angle_rad) };
            let near = Painted::at([tip[0] + 0.5, tip[1] - 1.0], angle_rad - 0.02).axis();
            let lie = painted.show(|image| skin.find(image, &near)).unwrap();
            let [offset_px, angle] = off(&lie, &painted);
            assert!(offset_px.abs() < 0.08 && angle.abs() < 0.003, "{tip:?}: {offset_px} {angle}");
            assert!((f64::from(lie.gain) - gain).abs() < 0.05, "{}", lie.gain);
        }
    }

    #[test]
    fn skin_is_found_in_four_tenths_of_the_light() {
        let mut skin = drawn(&Painted::at([110.0, 70.0], 0.4));
        let painted = Painted { gain: 0.4, ..Painted::at([112.3, 68.4], 0.43) };
        let near = Painted::at([112.8, 67.4], 0.41).axis();
        let lie = painted.show(|image| skin.find(image, &near)).unwrap();
        let [offset_px, angle] = off(&lie, &painted);
        assert!(offset_px.abs() < 0.08 && angle.abs() < 0.003, "{offset_px} {angle}");
        assert!((lie.gain - 0.4).abs() < 0.05, "{}", lie.gain);
    }

    #[test]
    fn no_row_of_a_finger_is_wider_than_it() {
        // The shorter a finger is in cells, the nearer its last row is to where a hand would begin.
        for half_width_px in [1.5, 3.0, 8.0, 20.0] {
            for length in [1.0, 3.0, 5.0, 12.0] {
                let painted = Painted::at([110.0, 70.0], 0.4);
                let mut skin = Skin::unseen(Area::Finger);
                let length_px = length * half_width_px;
                painted.show(|i| skin.draw(i, &painted.axis(), half_width_px, 0.0, length_px));
                let widest = skin.used.iter().map(|[from, to]| to - from).max().unwrap();
                let most = 2.0 * ACROSS * half_width_px / skin.across_px + 1.0;
                assert!(widest as f64 <= most, "{half_width_px} {length}: {widest} {most}");
            }
        }
    }

    #[test]
    fn the_less_texture_the_less_is_told() {
        let told = |texture: f64| {
            let painted = Painted { texture, noise: 2.0, ..Painted::at([110.0, 70.0], 0.4) };
            let mut skin = drawn(&painted);
            let again = Painted { seed: 2, ..painted };
            let lie = again.show(|image| skin.find(image, &painted.axis())).unwrap();
            lie.covariance[(1, 1)].sqrt()
        };
        let [strong, weak] = [40.0, 10.0].map(told);
        assert!(strong < weak && weak < 0.03, "{strong} {weak}");
    }

    /// Squares of the errors that noise makes, of offset and angle, in those that are told of.
    fn squared_in_told(noise: f64, spread_px: usize) -> [f64; 2] {
        let painted = Painted { noise, spread_px, ..Painted::at([110.0, 70.0], 0.4) };
        let mut skin = drawn(&Painted { noise: 0.0, ..painted });
        let (mut squares, mut told) = ([0.0; 2], [0.0; 2]);
        for seed in 1..=60 {
            let painted = Painted { seed, ..painted };
            let lie = painted.show(|image| skin.find(image, &painted.axis())).unwrap();
            for (k, off) in off(&lie, &painted).into_iter().enumerate() {
                squares[k] += off * off;
                told[k] += lie.covariance[(k, k)];
            }
        }
        [0, 1].map(|k| squares[k] / told[k])
    }

    #[test]
    fn the_covariance_holds_what_noise_does() {
        for ratio in squared_in_told(3.0, 0) {
            assert!((0.7..1.0).contains(&ratio), "{ratio}");
        }
    }

    #[test]
    fn the_covariance_holds_noise_that_compression_has_spread() {
        for ratio in squared_in_told(3.0, 1) {
            assert!((0.7..1.3).contains(&ratio), "{ratio}");
        }
    }

    #[test]
    fn a_lie_takes_over_an_angle_as_one_more_look_at_it_would() {
        let axis = Axis::of_finger(Point2::new(40.0, 30.0), 0.3, 20.0);
        let covariance = Matrix2::new(0.04, 0.002, 0.002, 4e-4);
        let lie = Lie { axis, covariance, gain: 1.0, offset: 0.0 };
        // A look at the angle alone, of the same variance, halves that.
        let (other_rad, other) = (0.33, 4e-4);
        let gain = covariance.column(1) / (covariance[(1, 1)] + other);
        let step = gain * (other_rad - axis.angle_rad);
        let expected = covariance - gain * covariance.row(1);
        let told = lie.turned_to(axis.angle_rad + step.y, expected[(1, 1)]);
        assert!((told.covariance - expected).norm() < 1e-12, "{}", told.covariance);
        let moved = axis.normal().dot(&(told.axis.anchor - axis.anchor));
        assert!((moved - step.x).abs() < 1e-12, "{moved} {}", step.x);
        assert!((told.axis.angle_rad - 0.315).abs() < 1e-12);
        assert!(((told.axis.tip - told.axis.anchor).norm() - 20.0).abs() < 1e-9);
    }

    #[test]
    fn what_is_not_the_skin_is_not_found() {
        let painted = Painted::at([110.0, 70.0], 0.4);
        let mut skin = drawn(&painted);
        for gone in [[150.0, 20.0], [40.0, 20.0], [400.0, 300.0]] {
            let elsewhere = Painted::at(gone, -1.2);
            assert!(
                elsewhere.show(|image| skin.find(image, &painted.axis())).is_none(),
                "{gone:?}"
            );
        }
        assert!(painted.show(|image| skin.find(image, &painted.axis())).is_some());
        let outside = Painted::at([-200.0, 70.0], 0.4).axis();
        assert!(painted.show(|image| skin.find(image, &outside)).is_none());
    }

    #[test]
    fn what_changes_as_the_finger_moves_loses_its_say() {
        let mut skin = drawn(&Painted::at([110.0, 70.0], 0.4));
        for k in 1..30 {
            let stripes_px = f64::from(k);
            let painted = Painted { stripes_px, noise: 1.0, ..Painted::at([110.0, 70.0], 0.4) };
            let lie = painted.show(|image| skin.find(image, &painted.axis())).unwrap();
            skin.learn(&lie);
        }
        let row = skin.rows / 2;
        let [from, to] = skin.used[row];
        let variance = |column: usize| skin.variance[row * skin.columns + column];
        let inside = variance(usize::midpoint(from, to));
        assert!(variance(from) > 4.0 * inside && variance(to - 1) > 4.0 * inside);
    }
}
