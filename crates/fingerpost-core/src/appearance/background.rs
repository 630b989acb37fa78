//! Background model of a static camera.
//!
//! Every pixel keeps the grey level that it shows most of the time, with a running mean and
//! variance of the observations that agree with it, and their count. An observation that disagrees
//! decrements the count; at zero the pixel restarts with its present level (the majority algorithm
//! of Boyer and Moore, as a running estimate). So the first frames give the level that most of them
//! show, a passing hand changes nothing, and an object that is put down and stays becomes
//! background after a while. The regions of a tracked hand and of a moving arm are excluded.
//!
//! The light may change: every frame is first explained as `gain · background + offset`, fitted
//! robustly to a grid of pixels, and all comparison and learning is done in the light of the
//! background. The remaining differences are foreground, except where the pixel is darker by a
//! ratio that a shadow may have and, if there are colours, of unchanged hue. If most of the pixels
//! that would show a motion of the camera have changed, the camera has moved: the background is
//! discarded and learned anew. A displacement of the camera by a fraction of a pixel changes few of
//! them by much; it is measured from the gradient of the background, and while it lasts, the
//! background's edges are displaced ([`Background::is_exact`]).
//!
//! A frame updates every fourth pair of rows in turn, every eighth once nothing has been new for
//! long, and allocates nothing after the first frame.
//!
//! Sources: Stauffer & Grimson 1999 for a background of persistent levels; Horprasert, Harwood &
//! Davis 1999 for shadows as a change of brightness without a change of hue.

mod change;
mod light;
pub mod options;
mod visit;

use super::background::options::{BackgroundOptions, KeepOut, Light};
use crate::Result;
use crate::image::frame::Frame;
use crate::numeric::simd::Isa;
use change::{Change, Comparison, ForegroundRow};
use nalgebra::Vector2;
use std::iter::once;
use std::ops::Range;
pub use visit::CELL_PX;
use visit::{BackgroundLearning, Visits};

/// Expected grey level at a place where nothing is before the background.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ExpectedGrey {
    /// The level in the light of the last frame \[grey levels\].
    pub grey: f64,
    /// Its standard deviation as an estimate of the mean, without the noise of a frame that it is
    /// compared with \[grey levels\].
    pub sigma_grey: f64,
}

/// Foreground probability of the image, on a grid of cells of `step` × `step` pixels.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ForegroundMap {
    /// Cells in a row; cell (x, y) represents the pixel (x · step, y · step).
    pub width: usize,
    /// Rows of cells.
    pub height: usize,
    /// Pixels from one cell to the next.
    pub step: usize,
    /// Row by row: 0 for background, 255 for foreground; uncertain between them.
    pub cells: Vec<u8>,
}

impl ForegroundMap {
    /// Foreground probability of the cell nearest to a place, 0–1.
    #[must_use]
    pub fn at(&self, u: f64, v: f64) -> f64 {
        let cell = |x: f64, n: usize| {
            ((x / self.step.max(1) as f64).round().max(0.0) as usize).min(n.saturating_sub(1))
        };
        let i = cell(v, self.height) * self.width + cell(u, self.width);
        self.cells.get(i).map_or(0.0, |&c| f64::from(c) / 255.0)
    }
}

/// The learned background of one view.
///
/// ```
/// use fingerpost_core::{Background, BackgroundOptions, Frame, GrayView};
///
/// let mut background = Background::new(BackgroundOptions::default())?;
/// let table = [80; 64 * 48];
/// for _ in 0..10 {
///     background.observe(&Frame::gray(GrayView::new(&table, 64, 48, 64)?), &[])?;
/// }
/// assert!(background.is_known());
/// let expected = background.expected(20.3, 10.7).expect("the pixels around it are known");
/// assert_eq!(expected.grey, 80.0);
/// # Ok::<(), fingerpost_core::Error>(())
/// ```
#[derive(Debug, Clone)]
pub struct Background {
    options: BackgroundOptions,
    size: Option<(usize, usize)>,
    grey: Plane,
    /// Colours in the frame's order of channels, at every second pixel of every second row; empty
    /// without colours.
    colour: Vec<[f32; 3]>,
    light: Light,
    /// Standard deviation of the light fit's inliers beyond the noise \[grey levels\].
    light_sigma: f32,
    /// Part of the textured pixels that have changed, and the number of consecutive frames in which
    /// it exceeded the limit.
    changed_share: f64,
    moved_frames: usize,
    /// Displacement of the image from the background \[px\], if the background's edges determine
    /// it.
    shift_px: Option<Vector2<f64>>,
    bumped_frames: usize,
    frames: usize,
    /// Frames since the start, or since a region was last forgotten.
    settling_frames: usize,
    slopes: Vec<Slope>,
    pairs: Vec<(f32, f32)>,
    ratios: Vec<f32>,
    /// Columns of a row that are kept out, region by region.
    kept_columns: Vec<Range<usize>>,
}

/// The background's gradient at a pixel, in the light of the frame, and the frame's difference from
/// the background.
#[derive(Debug, Clone, Copy)]
struct Slope {
    by_px: Vector2<f64>,
    residual: f64,
    /// One over the largest residual that a shift explains.
    per_most: f64,
}

/// Level, variance and number of agreeing observations of every pixel.
#[derive(Debug, Clone, Default)]
struct Plane {
    level: Vec<f32>,
    variance: Vec<f32>,
    seen: Vec<u8>,
}

/// Number of frames in which all pairs of rows are updated: a frame updates every fourth pair, so
/// that all frames update equally many rows with colours.
const IN_TURN: usize = 4;
/// The same once no region has been new for [`BackgroundOptions::absorb_frames`].
const SETTLED_IN_TURN: usize = 8;
/// Rows that are updated together: those of a cell.
const PAIR: usize = CELL_PX;
/// Approximate number of pixels from which the light and the part of changed pixels are estimated.
const SAMPLES: usize = 3000;
/// Displacement up to which the background counts as exact \[px\].
const EXACT_PX: f64 = 0.15;
/// Ratio of the variance of the light fit's residuals beyond the noise to the part of it that
/// remains in the mean of a pixel: each frame has a light of its own, and their errors average over
/// the frames. A tenth of the standard deviation is assumed to remain; this was not measured.
const LIGHT_VARIANCE_DIVISOR: f64 = 100.0;

impl Background {
    /// A background without observations.
    ///
    /// # Errors
    /// If an option is outside its documented range.
    pub fn new(options: BackgroundOptions) -> Result<Self> {
        options.check()?;
        Ok(Self {
            options,
            size: None,
            grey: Plane::default(),
            colour: Vec::new(),
            light: Light::UNCHANGED,
            light_sigma: 0.0,
            changed_share: 0.0,
            moved_frames: 0,
            shift_px: None,
            bumped_frames: 0,
            frames: 0,
            settling_frames: 0,
            slopes: Vec::with_capacity(2 * SAMPLES),
            pairs: Vec::with_capacity(2 * SAMPLES),
            ratios: Vec::with_capacity(2 * SAMPLES),
            kept_columns: Vec::new(),
        })
    }

    /// The options in use.
    #[must_use]
    pub fn options(&self) -> &BackgroundOptions {
        &self.options
    }

    /// Discards all observations.
    pub fn clear(&mut self) {
        self.size = None;
        (self.frames, self.settling_frames) = (0, 0);
        self.moved_frames = 0;
        self.shift_px = None;
        self.bumped_frames = 0;
        (self.light, self.light_sigma) = (Light::UNCHANGED, 0.0);
        self.changed_share = 0.0;
    }

    /// Discards the observations of a region, such as a hand that has been there from the start.
    ///
    /// # Errors
    /// If the region is not finite or its radius not positive.
    pub fn forget(&mut self, part: &KeepOut) -> Result<()> {
        part.check()?;
        let Some((width, height)) = self.size else { return Ok(()) };
        self.settling_frames = 0;
        for y in 0..height {
            let columns = part.columns(y as f64, width);
            self.grey.seen[y * width..][columns].fill(0);
        }
        Ok(())
    }

    /// Whether it was observed long enough to separate the foreground.
    #[must_use]
    pub fn is_known(&self) -> bool {
        self.frames >= self.options.learn_frames && self.moved_frames == 0
    }

    /// Whether it is known and its edges are where the last frame shows them: the camera has not
    /// been displaced by more than 0.15 px.
    #[must_use]
    pub fn is_exact(&self) -> bool {
        self.is_known() && self.shift_px.is_none_or(|shift| shift.norm() <= EXACT_PX)
    }

    /// Displacement of the last frame from the background \[px\], if edges determine it; beyond a
    /// pixel it only indicates that the camera has moved. If all edges have one direction, only the
    /// displacement across them is determined, and the component along them is 0.
    #[must_use]
    pub fn shift_px(&self) -> Option<Vector2<f64>> {
        self.shift_px
    }

    /// Light of the last frame relative to the background's.
    #[must_use]
    pub fn light(&self) -> Light {
        self.light
    }

    /// Part of the pixels that would show a motion of the camera that have changed, 0–1.
    #[must_use]
    pub fn changed_share(&self) -> f64 {
        self.changed_share
    }

    /// Processes one frame: [`look`](Self::look), then [`learn`](Self::learn) from the pixels that
    /// agree with the background. Nothing within `keep_out` is learned. A frame of another size, or
    /// with colours where there were none, starts a new background.
    ///
    /// # Errors
    /// If a region is not finite or its radius not positive.
    pub fn observe(&mut self, frame: &Frame<'_>, keep_out: &[KeepOut]) -> Result<()> {
        self.look(frame);
        self.learn(frame, keep_out)
    }

    /// Processes a frame without learning from it: estimates its light, and detects a motion of the
    /// camera. From then on, all queries refer to this frame.
    pub fn look(&mut self, frame: &Frame<'_>) {
        self.fit_size(frame);
        self.estimate_light(frame);
        self.notice_motion(frame);
        self.measure_shift(frame);
        self.notice_bump();
    }

    /// Learns from the frame last looked at, except within `keep_out`.
    ///
    /// # Errors
    /// If a region is not finite or its radius not positive.
    pub fn learn(&mut self, frame: &Frame<'_>, keep_out: &[KeepOut]) -> Result<()> {
        keep_out.iter().try_for_each(KeepOut::check)?;
        self.fit_size(frame);
        let height = frame.image().height();
        let step = if self.frames < self.options.learn_frames { 1 } else { self.in_turn() };
        for pair in (self.frames % step..height.div_ceil(PAIR)).step_by(step) {
            for y in PAIR * pair..height.min(PAIR * (pair + 1)) {
                self.learn_row(frame, y, keep_out);
            }
        }
        self.frames = self.frames.saturating_add(1);
        self.settling_frames = self.settling_frames.saturating_add(1);
        Ok(())
    }

    /// Number of frames in which all rows are updated.
    fn in_turn(&self) -> usize {
        let settled = self.settling_frames >= self.options.absorb_frames;
        if settled { SETTLED_IN_TURN } else { IN_TURN }
    }

    /// Starts anew with a frame of another size, or with colours instead of none or none instead of
    /// colours.
    fn fit_size(&mut self, frame: &Frame<'_>) {
        let size = (frame.image().width(), frame.image().height());
        let coloured = frame.colour().is_some();
        if self.size != Some(size) || self.colour.is_empty() == coloured {
            self.start(size, coloured);
        }
    }

    /// Expected grey level at a subpixel place in the light of the last frame; `None` where a pixel
    /// around it is unknown or outside the image.
    #[must_use]
    pub fn expected(&self, u: f64, v: f64) -> Option<ExpectedGrey> {
        let (width, height) = self.size?;
        if !(u >= 0.0 && v >= 0.0 && u <= (width - 1) as f64 && v <= (height - 1) as f64) {
            return None;
        }
        let (x, y) =
            ((u as usize).min(width.saturating_sub(2)), (v as usize).min(height.saturating_sub(2)));
        let (s, t) = (u - x as f64, v - y as f64);
        let (right, below) = (usize::from(width > 1), usize::from(height > 1) * width);
        let (mut grey, mut variance) = (0.0, 0.0);
        let corners = [
            (0, (1.0 - s) * (1.0 - t)),
            (right, s * (1.0 - t)),
            (below, (1.0 - s) * t),
            (below + right, s * t),
        ];
        for (offset, weight) in corners.into_iter().filter(|(_, weight)| *weight > 0.0) {
            let i = y * width + x + offset;
            if usize::from(self.grey.seen[i]) < self.known_from() {
                return None;
            }
            grey += weight * f64::from(self.grey.level[i]);
            variance += weight * weight * self.variance_of_mean(i);
        }
        let Light { gain, offset_grey } = self.light;
        Some(ExpectedGrey { grey: gain * grey + offset_grey, sigma_grey: gain * variance.sqrt() })
    }

    /// Probability that the pixel nearest to a place shows an object before the background, 0–1;
    /// `None` outside the image and where the background is unknown.
    #[must_use]
    pub fn foreground(&self, frame: &Frame<'_>, u: f64, v: f64) -> Option<f64> {
        let size = (frame.image().width(), frame.image().height());
        if self.size != Some(size) || !self.is_known() || !frame.image().contains(u, v, -0.5) {
            return None;
        }
        let (x, y) = ((u + 0.5) as usize, (v + 0.5) as usize);
        let (x, y) = (x.min(size.0 - 1), y.min(size.1 - 1));
        self.change(frame, x, y, size.0).map(|c| f64::from(self.comparison().likelihood(&c)))
    }

    /// Fills `map` with the foreground probability of every cell of the frame; 0 while the
    /// background is unknown.
    pub fn foreground_map(&self, frame: &Frame<'_>, map: &mut ForegroundMap) {
        let (width, height) = (frame.image().width(), frame.image().height());
        (map.width, map.height) = (width.div_ceil(CELL_PX), height.div_ceil(CELL_PX));
        map.step = CELL_PX;
        map.cells.clear();
        map.cells.resize(map.width * map.height, 0);
        if !self.is_known() || self.size != Some((width, height)) {
            return;
        }
        let (comparison, known_from) = (self.comparison(), self.known_from() as u8);
        for (cy, cells) in map.cells.chunks_exact_mut(map.width).enumerate() {
            let y = CELL_PX * cy;
            let pixels = y * width..(y + 1) * width;
            Isa::detect().run(ForegroundRow {
                comparison,
                known_from,
                level: &self.grey.level[pixels.clone()],
                variance: &self.grey.variance[pixels.clone()],
                seen: &self.grey.seen[pixels],
                now: frame.image().row(y).unwrap_or_default(),
                colour: self.colour.get(cy * map.width..).unwrap_or_default(),
                now_in_colour: frame.colour().and_then(|c| c.row(y)).unwrap_or_default(),
                cells,
            });
        }
    }

    fn start(&mut self, size: (usize, usize), coloured: bool) {
        self.clear();
        self.size = Some(size);
        let pixels = size.0 * size.1;
        self.grey.level.clear();
        self.grey.level.resize(pixels, 0.0);
        self.grey.variance.clear();
        self.grey.variance.resize(pixels, 0.0);
        self.grey.seen.clear();
        self.grey.seen.resize(pixels, 0);
        self.colour.clear();
        if coloured {
            let cells = size.0.div_ceil(CELL_PX) * size.1.div_ceil(CELL_PX);
            self.colour.resize(cells, [0.0; 3]);
        }
    }

    /// Number of agreeing observations from which a pixel is known. The upper limit of the count
    /// follows: one observation represents as many frames as an update of all rows takes.
    fn known_from(&self) -> usize {
        self.options.learn_frames.div_ceil(2)
    }

    fn most_seen(&self) -> u8 {
        let visits = self.options.absorb_frames.div_ceil(self.in_turn());
        visits.max(self.known_from() + 1).min(usize::from(u8::MAX)) as u8
    }

    /// Variance of a pixel's level: that of a mean over its observations, or of the running mean in
    /// the long term.
    fn variance_of_mean(&self, i: usize) -> f64 {
        let rate = self.options.rate;
        let share = (1.0 / f64::from(self.grey.seen[i].max(1))).max(rate / (2.0 - rate));
        share * self.noise_variance(i)
            + f64::from(self.light_sigma * self.light_sigma) / LIGHT_VARIANCE_DIVISOR
    }

    fn noise_variance(&self, i: usize) -> f64 {
        f64::from(self.grey.variance[i]).max(self.options.noise_grey * self.options.noise_grey)
    }

    /// Comparison of the last frame with the background.
    fn comparison(&self) -> Comparison {
        Comparison::new(&self.options, self.light, self.light_sigma)
    }

    /// Difference of a pixel inside the image from its background; `None` where that is unknown.
    #[inline]
    fn change(&self, frame: &Frame<'_>, x: usize, y: usize, width: usize) -> Option<Change> {
        let i = y * width + x;
        if usize::from(self.grey.seen[i]) < self.known_from() {
            return None;
        }
        let now = f32::from(frame.image().pixel(x, y)?);
        let known = (self.grey.level[i], self.grey.variance[i]);
        Some(self.comparison().change(known, now, self.colours(frame, x, y)))
    }

    /// Colours of the background and of the frame at the cell of a pixel.
    fn colours(&self, frame: &Frame<'_>, x: usize, y: usize) -> Option<([f32; 3], [f32; 3])> {
        let (width, _) = self.size?;
        let (cx, cy) = (x / CELL_PX, y / CELL_PX);
        let known = self.colour.get(cy * width.div_ceil(CELL_PX) + cx)?;
        Some((*known, frame.colour()?.pixel(cx * CELL_PX, cy * CELL_PX)?.map(f32::from)))
    }

    /// Pixels (x, y) of a regular grid of about [`SAMPLES`] pixels; the same for every frame.
    fn grid((width, height): (usize, usize)) -> impl Iterator<Item = (usize, usize)> {
        let step = ((width * height / SAMPLES) as f64).sqrt().ceil().max(1.0) as usize;
        (step / 2..height)
            .step_by(step)
            .flat_map(move |y| (step / 2..width).step_by(step).map(move |x| (x, y)))
    }

    /// Levels of the 3 × 3 neighbourhood of a pixel in the light of the last frame, row by row;
    /// `None` where one of them is unknown or outside the image.
    pub(crate) fn about(&self, x: usize, y: usize) -> Option<[[f32; 3]; 3]> {
        let (width, height) = self.size?;
        if x == 0 || y == 0 || x + 1 >= width || y + 1 >= height {
            return None;
        }
        let (gain, offset) = (self.light.gain as f32, self.light.offset_grey as f32);
        let known_from = self.known_from();
        let mut levels = [[0.0; 3]; 3];
        for (row, levels) in levels.iter_mut().enumerate() {
            let from = (y + row - 1) * width + x - 1;
            let seen = self.grey.seen.get(from..from + 3)?;
            if seen.iter().any(|&s| usize::from(s) < known_from) {
                return None;
            }
            for (level, learned) in levels.iter_mut().zip(self.grey.level.get(from..from + 3)?) {
                *level = gain * learned + offset;
            }
        }
        Some(levels)
    }

    /// The level of a pixel in the light of the last frame; `None` where it is unknown.
    pub(crate) fn level(&self, x: usize, y: usize) -> Option<f32> {
        let i = y * self.size?.0 + x;
        let seen = usize::from(*self.grey.seen.get(i)?);
        let level = *self.grey.level.get(i)?;
        let (gain, offset) = (self.light.gain as f32, self.light.offset_grey as f32);
        (seen >= self.known_from()).then_some(gain * level + offset)
    }

    /// Variance of the expected level at a pixel inside the image, as [`ExpectedGrey::sigma_grey`].
    pub(crate) fn variance(&self, x: usize, y: usize) -> f64 {
        let (width, _) = self.size.unwrap_or_default();
        self.light.gain.powi(2) * self.variance_of_mean(y * width + x)
    }

    /// Width and height of the images that it was learned from; (0, 0) before the first.
    pub(crate) fn size(&self) -> (usize, usize) {
        self.size.unwrap_or_default()
    }

    /// Updates every pixel of a row, except those that are kept out.
    fn learn_row(&mut self, frame: &Frame<'_>, y: usize, keep_out: &[KeepOut]) {
        let (Some((width, _)), Some(row)) = (self.size, frame.image().row(y)) else { return };
        let mut kept = std::mem::take(&mut self.kept_columns);
        kept.clear();
        kept.extend(keep_out.iter().map(|k| k.columns(y as f64, width)).filter(|c| !c.is_empty()));
        kept.sort_unstable_by_key(|columns| columns.start);
        let noise = self.options.noise_grey as f32;
        let sigmas = self.options.changed_sigmas as f32;
        let learning = BackgroundLearning {
            per_gain: 1.0 / self.light.gain as f32,
            offset_grey: self.light.offset_grey as f32,
            rate: self.options.rate as f32,
            noise2: noise * noise,
            sigmas2: sigmas * sigmas,
            most_seen: self.most_seen(),
        };
        let colours = frame.colour().filter(|_| y.is_multiple_of(CELL_PX));
        let colours = colours.and_then(|c| c.row(y)).unwrap_or_default();
        let mut next = 0;
        for kept in kept.iter().cloned().chain(once(width..width)) {
            let part = next..kept.start.max(next);
            next = next.max(kept.end);
            let at = y * width + part.start..y * width + part.end;
            let cell = y / CELL_PX * width.div_ceil(CELL_PX) + part.start.div_ceil(CELL_PX);
            let first = part.start.next_multiple_of(CELL_PX);
            Isa::detect().run(Visits {
                learning,
                level: &mut self.grey.level[at.clone()],
                variance: &mut self.grey.variance[at.clone()],
                seen: &mut self.grey.seen[at],
                now: &row[part.clone()],
                first: first - part.start,
                colour: self.colour.get_mut(cell..).unwrap_or_default(),
                now_in_colour: colours.get(3 * first..).unwrap_or_default(),
            });
        }
        self.kept_columns = kept;
    }
}
