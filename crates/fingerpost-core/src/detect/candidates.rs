//! Detection of candidates for pointing hands in an image.
//!
//! A finger is a band with a round end. Such bands are first searched coarsely at every place,
//! angle and size. In a pyramid whose levels show a finger of one size each with a width of five
//! cells, the orientation of the strongest gradient of any channel (colours, and the foreground if
//! a background is known) is quantised and spread over its neighbours. The score of a template of
//! round end and flanks is the number of its normals that meet an edge of their orientation, of
//! either polarity. The best candidates are then refined: the position of the band's end, the
//! contrast of its inside with its left, its right and the region ahead, the length over which that
//! holds, its foreground probability, and a second band nearby that could be its thumb.
//!
//! The result is a ranked list of *candidates*; many of them are pens, cables and other fingers.
//! Only a fit and the other views distinguish them.
//!
//! Sources: Hinterstoisser et al. 2012 (LINEMOD) for spread orientations and their fast sums.

pub use super::band::Candidate;
use super::band::{
    Band, BandFrame, Inside, RefinedCandidate, WHOLE_CORE, half_lit_stands_out, inside_foreground,
    refine_candidate, stands_out,
};
use super::orientation::{
    ANGLES, BandTemplate, CAP_SAMPLES, HALF_WIDTH_CELLS, LEVEL_RATIO, Level, MEETS, Octave,
    ScoreLevel, SplitFrame,
};
use crate::appearance::background::{Background, ForegroundMap};
use crate::geometry::template::Thumb;
use crate::image::frame::Frame;
use crate::numeric::simd::Isa;
use crate::{Error, Result};
use nalgebra::Point2;
use std::f64::consts::TAU;

/// Options of the detection.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FinderOptions {
    /// Half-width of the slimmest finger, as a part of the image's longer side, 0.003–0.1.
    pub min_half_width: f64,
    /// Half-width of the widest finger, as the same part, above the least and up to 0.2.
    pub max_half_width: f64,
    /// Least change of brightness from one cell to the next that counts as an edge \[grey levels\],
    /// 1–100; a sharp step extends over two cells.
    pub min_gradient_grey: f64,
    /// Largest number of candidates returned, 1–100.
    pub candidates: usize,
}

impl Default for FinderOptions {
    fn default() -> Self {
        Self {
            min_half_width: 0.008,
            max_half_width: 0.032,
            min_gradient_grey: 4.0,
            candidates: 40,
        }
    }
}

/// Number of bands refined per level.
const REFINED_CANDIDATES: usize = 48;

/// Detects candidates, frame by frame. Its buffers grow with the first frame of a size and are
/// reused.
///
/// ```
/// use fingerpost_core::{FinderOptions, Frame, GrayView, HandFinder};
///
/// // A bright finger of 14 px that points right, its tip at (200, 120).
/// let pixels: Vec<u8> = (0..320 * 240)
///     .map(|i| {
///         let (x, y) = ((i % 320) as f64, (i / 320) as f64);
///         let inside = 7.0 - (x.max(193.0) - 193.0).hypot(y - 120.0);
///         (60.0 + 100.0 * (0.5 + inside).clamp(0.0, 1.0)) as u8
///     })
///     .collect();
/// let mut finder = HandFinder::new(FinderOptions::default())?;
/// let frame = Frame::gray(GrayView::new(&pixels, 320, 240, 320)?);
/// let best = finder.find(&frame, None)[0];
/// assert!((best.tip_px.x - 200.0).abs() < 4.0 && (best.tip_px.y - 120.0).abs() < 4.0);
/// assert!(best.angle_rad.abs() < 0.2);
/// # Ok::<(), fingerpost_core::Error>(())
/// ```
#[derive(Debug, Clone)]
pub struct HandFinder {
    options: FinderOptions,
    /// Template samples by angle.
    templates: Vec<BandTemplate>,
    size: (usize, usize),
    channels: usize,
    /// The frame's channels, one plane each, at full resolution and halved repeatedly.
    octaves: Vec<Octave>,
    foreground: ForegroundMap,
    level: Level,
    bands: Vec<Band>,
    refined: Vec<RefinedCandidate>,
    found: Vec<Candidate>,
}

impl HandFinder {
    /// A finder with the given options.
    ///
    /// # Errors
    /// If an option is outside its documented range.
    pub fn new(options: FinderOptions) -> Result<Self> {
        let FinderOptions { min_half_width, max_half_width, min_gradient_grey, candidates } =
            options;
        Error::within("least half-width", min_half_width, "0.003 to 0.1", |w| {
            (0.003..=0.1).contains(&w)
        })?;
        Error::within("greatest half-width", max_half_width, "above the least, to 0.2", |w| {
            w > min_half_width && w <= 0.2
        })?;
        Error::within("least gradient [grey levels]", min_gradient_grey, "1 to 100", |g| {
            (1.0..=100.0).contains(&g)
        })?;
        Error::within("most candidates", candidates as f64, "1 to 100", |n| {
            (1.0..=100.0).contains(&n)
        })?;
        let angle_rad = |k: usize| k as f64 / ANGLES as f64 * TAU;
        Ok(Self {
            options,
            templates: (0..ANGLES).map(|k| BandTemplate::new(angle_rad(k))).collect(),
            size: (0, 0),
            channels: 0,
            octaves: Vec::new(),
            foreground: ForegroundMap::default(),
            level: Level::default(),
            bands: Vec::new(),
            refined: Vec::new(),
            found: Vec::new(),
        })
    }

    /// The options in use.
    #[must_use]
    pub fn options(&self) -> &FinderOptions {
        &self.options
    }

    /// Candidates in a frame, the most likely first. A `background` that is known and of the
    /// frame's size contributes the foreground; without one, the frame alone is used.
    pub fn find(&mut self, frame: &Frame<'_>, background: Option<&Background>) -> &[Candidate] {
        let background = background.filter(|b| b.is_known());
        match background {
            Some(background) => background.foreground_map(frame, &mut self.foreground),
            None => self.foreground.cells.clear(),
        }
        self.split(frame, background.is_some());
        self.bands.clear();
        let side = self.size.0.max(self.size.1) as f64;
        let mut half_width_px = self.options.min_half_width * side;
        while half_width_px <= self.options.max_half_width * side {
            self.search(half_width_px);
            half_width_px *= LEVEL_RATIO;
        }
        self.refine(frame);
        self.rank();
        &self.found
    }

    /// Likeness of a band to a finger by the contrast of its inside with its surroundings, 0–1; its
    /// edges were found by a fit. `None` if too little of the surroundings lies in the image. Each
    /// half of a band that is lit from one side may have contrast in colour, or in chromaticity
    /// alone.
    ///
    /// # Errors
    /// A position or direction that is not finite, a half-width not above 0.
    pub fn likeness(
        frame: &Frame<'_>,
        tip: Point2<f64>,
        angle_rad: f64,
        half_width_px: f64,
    ) -> Result<Option<f64>> {
        Error::finite("tip u [px]", tip.x)?;
        Error::finite("tip v [px]", tip.y)?;
        Error::finite("angle [rad]", angle_rad)?;
        Error::within("half-width [px]", half_width_px, "above 0", |w| w > 0.0)?;
        let band_frame = BandFrame::new(frame, tip, angle_rad);
        Ok(Inside::of(&band_frame, half_width_px, WHOLE_CORE).and_then(|inside| {
            let likeness = stands_out(&band_frame, &inside, half_width_px)?;
            let half_lit = half_lit_stands_out(&band_frame, &inside, half_width_px);
            Some(half_lit.map_or(likeness, |half_lit| half_lit.max(likeness)))
        }))
    }

    /// Splits the frame into channels, and halves them down to the octave of the coarsest level.
    fn split(&mut self, frame: &Frame<'_>, with_foreground: bool) {
        self.size = (frame.image().width(), frame.image().height());
        let colours = if frame.colour().is_some() { 3 } else { 1 };
        self.channels = colours + usize::from(with_foreground);
        let side = self.size.0.max(self.size.1) as f64;
        let coarsest = self.options.max_half_width * side / HALF_WIDTH_CELLS;
        let halvings = (1..32).take_while(|&k| 2_f64.powi(k) <= coarsest).count();
        self.octaves.resize_with(halvings + 1, Octave::default);
        Isa::detect().run(SplitFrame {
            octaves: &mut self.octaves,
            frame,
            foreground: with_foreground.then_some(&self.foreground),
        });
    }

    /// Searches bands of about one half-width.
    fn search(&mut self, half_width_px: f64) {
        let cell_px = half_width_px / HALF_WIDTH_CELLS;
        let octave = cell_px.log2().floor().clamp(0.0, (self.octaves.len() - 1) as f64) as usize;
        Isa::detect().run(ScoreLevel {
            level: &mut self.level,
            octave: &self.octaves[octave],
            channels: self.channels,
            step: cell_px / 2_f64.powi(octave as i32),
            min_gradient_grey: self.options.min_gradient_grey,
            templates: &self.templates,
        });
        let first = self.bands.len();
        for (x, y, score, angle) in self.level.peaks() {
            let place = |i: usize| (i as f64 + 0.5) * cell_px - 0.5;
            let tip = Point2::new(place(x), place(y));
            let angle_rad = self.templates[usize::from(angle)].angle_rad;
            let score = f64::from(score) / f64::from(MEETS * CAP_SAMPLES as u8);
            let foreground = inside_foreground(&self.foreground, tip, angle_rad, half_width_px);
            let weight = score + FOREGROUND_WEIGHT * foreground;
            self.bands.push(Band { tip, angle_rad, half_width_px, score, weight });
        }
        // Among equal scores, the one in the foreground goes first.
        self.bands[first..].sort_by(|a, b| b.weight.total_cmp(&a.weight));
        self.bands.truncate(first + REFINED_CANDIDATES);
    }

    /// Refines every band.
    fn refine(&mut self, frame: &Frame<'_>) {
        self.refined.clear();
        for band in &self.bands {
            if let Some(candidate) = refine_candidate(frame, &self.foreground, band) {
                self.refined.push(candidate);
            }
        }
        self.refined.sort_by(|a, b| b.score.total_cmp(&a.score));
    }

    /// Keeps the best of candidates that are the same, and pairs fingers with thumbs.
    fn rank(&mut self) {
        self.found.clear();
        let mut kept = 0;
        for k in 0..self.refined.len() {
            let candidate = self.refined[k];
            if self.refined[..kept].iter().all(|other| !other.is_same(&candidate)) {
                self.refined[kept] = candidate;
                kept += 1;
            }
        }
        let distinct = &self.refined[..kept];
        for candidate in distinct {
            let thumb = distinct
                .iter()
                .filter_map(|other| candidate.thumb(other))
                .max_by(|a, b| a.1.total_cmp(&b.1));
            let (side, bonus) =
                thumb.map_or((Thumb::None, 0.0), |(side, score)| (side, THUMB_WEIGHT * score));
            self.found.push(candidate.candidate(side, bonus));
        }
        // An object that was there before may be the hand, but a new one is more likely.
        let is_background_known = !self.foreground.cells.is_empty();
        let least = if is_background_known { BACKGROUND_WEIGHT } else { 1.0 };
        let weight = |c: &Candidate| c.score * (least + (1.0 - least) * c.foreground);
        self.found.sort_by(|a, b| weight(b).total_cmp(&weight(a)));
        self.found.truncate(self.options.candidates);
    }
}

/// Weight of the foreground probability added to the score of a coarse band.
const FOREGROUND_WEIGHT: f64 = 0.5;
/// Weight of a candidate in the background relative to one in the foreground.
const BACKGROUND_WEIGHT: f64 = 0.5;
/// Part of a score's difference from 1 that a perfect thumb adds.
const THUMB_WEIGHT: f64 = 0.3;
