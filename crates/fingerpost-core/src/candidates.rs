//! Where in an image a pointing hand may be.
//!
//! A finger is a band with a round end. Such bands are looked for at every place, angle and size at
//! once, coarsely: in a pyramid in which a finger of each size is five cells wide, the orientation of
//! the strongest gradient of any channel (colours, and the foreground where a background is known)
//! is quantised, spread over its neighbours, and a template of round end and flanks is scored by how
//! many of its normals meet an edge of their orientation, whichever side is brighter. The best
//! places are then looked at closely: where exactly the band ends, whether its inside differs from
//! what lies to its left, to its right and ahead, how far back that holds, whether it is foreground,
//! and whether a second band nearby could be its thumb.
//!
//! What comes out are *candidates*, ranked; many of them are pens, cables and other fingers. Only a
//! fit, and the other views, can tell.
//!
//! Sources: Hinterstoisser et al. 2012 (LINEMOD) for spread orientations and their fast sums.

use crate::background::{Background, ForegroundMap};
use crate::frame::{Frame, chromaticity};
use crate::image::GrayView;
use crate::template::Thumb;
use crate::{Error, Result};
use nalgebra::{Matrix3, Point2, Vector2, Vector3};
use std::f64::consts::{PI, TAU};

/// What is looked for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FinderOptions {
    /// Half-width of the slimmest finger, in parts of the image's longer side, 0.003–0.1.
    pub min_half_width: f64,
    /// Half-width of the stoutest finger, in the same parts, above the least and up to 0.2.
    pub max_half_width: f64,
    /// The least change of brightness from one cell to the next that is an edge \[grey levels\],
    /// 1–100; a sharp step is spread over two cells.
    pub min_gradient_grey: f64,
    /// The most candidates that are given, 1–100.
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

/// A place where a pointing hand may be.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Candidate {
    /// The finger's tip \[px\].
    pub tip_px: Point2<f64>,
    /// Direction of pointing \[rad\], from +u (right) towards +v (down).
    pub angle_rad: f64,
    /// Visible length of the finger \[px\].
    pub length_px: f64,
    /// Half its width \[px\].
    pub half_width_px: f64,
    /// Side of a second band that may be its thumb.
    pub thumb: Thumb,
    /// Mean colour of its inside, in the order of the frame's channels; a grey level three times.
    pub colour: [f64; 3],
    /// How like foreground its inside is, 0–1; 0 while no background is known.
    pub foreground: f64,
    /// How like a finger it is by its shape and colours alone, 0–1.
    pub score: f64,
}

/// Half a finger's width in cells of the level that looks for it.
const HALF_WIDTH_CELLS: f64 = 2.5;
/// Half-widths from one level to the next.
const LEVEL_RATIO: f64 = 1.35;
/// Angles that are tried.
const ANGLES: usize = 24;
/// Orientations that are told apart, over half a turn.
const BINS: usize = 8;
/// Samples of the round end, and of either flank; a power of two for the flank's sums by doubling.
const CAP_SAMPLES: usize = 8;
const FLANK_SAMPLES: usize = 8;
/// The round end's samples lie this far to either side of the axis at most \[rad\], the flank's this
/// far behind the round end's middle \[half-widths\].
const CAP_REACH_RAD: f64 = 1.37;
const FLANK_HALF_WIDTHS: (f64, f64) = (0.3, 3.0);
/// What a sample counts that meets an edge of its orientation, or of the next one; a sum of eight
/// fits a byte.
const MEETS: u8 = 31;
const NEARLY_MEETS: u8 = 19;
/// Cells around a level that the template may reach into.
const MARGIN: usize = 12;
/// A band scores at least this part of what it could.
const LEAST_SCORE: u8 = 144;
/// Bands that are looked at closely, per level.
const LOOKED_AT: usize = 48;
/// How much of the foreground's edge strength counts, so that it outweighs the texture of what is
/// before and behind it.
const FOREGROUND_GAIN: f64 = 0.6;
/// A coarse angle is off by up to about that much \[rad\].
const TURNS_RAD: [f64; 7] = [0.0, -0.1, 0.1, -0.2, 0.2, -0.3, 0.3];
const TURN_REACH_RAD: f64 = 0.5;
/// Squared distances from the inside's colours, in standard deviations, from which a pixel is
/// another colour: three channels and one.
const UNLIKE_COLOUR: f64 = 6.0;
const UNLIKE_GREY: f64 = 4.0;
/// Standard deviation of the inside's colours that is always granted \[grey levels\].
const COLOUR_FLOOR: f64 = 4.0;
/// A finger is half-lit if one half of it is darker than this part of the other.
const HALF_LIT: f64 = 0.75;
/// The inside is looked at over so much of the half-width to either side of the axis; a half of it begins
/// this far from there, in parts of that.
const ACROSS: f64 = 0.55;
const WHOLE: (f64, f64) = (-1.0, 1.0);
const HALF_FROM: f64 = 0.2;
/// A visible finger is this long, in half-widths.
const LENGTHS: (f64, f64) = (4.6, 12.0);
/// Flanks that are seen over less than this tell nothing of the length, which is this then.
const TOLD_LENGTH: f64 = 3.0;
const UNTOLD_LENGTH: f64 = 7.0;
/// Two candidates are one within this distance \[half-widths\] and angle \[rad\].
const SAME_PLACE: f64 = 1.5;
const SAME_ANGLE_RAD: f64 = 0.5;
/// A thumb's angle to its finger \[rad\], its root behind the fingertip \[finger half-widths\] and its
/// width in parts of the finger's.
const THUMB_ANGLES_RAD: (f64, f64) = (0.5, 1.95);
const THUMB_ROOTS: (f64, f64) = (5.0, 20.0);
const THUMB_TIPS: (f64, f64) = (2.5, 16.0);
const THUMB_WIDTHS: (f64, f64) = (0.6, 1.7);

/// Finds candidates, frame by frame. Its buffers grow with the first frame of a size and are used
/// again.
///
/// ```
/// use fingerpost_core::candidates::{FinderOptions, HandFinder};
/// use fingerpost_core::{Frame, GrayView};
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
    /// The frame's channels, plane after plane, and the same halved again and again.
    octaves: Vec<Octave>,
    foreground: ForegroundMap,
    level: Level,
    bands: Vec<Band>,
    looked_at: Vec<Looked>,
    found: Vec<Candidate>,
}

/// Where the template's samples lie from its tip, in cells.
#[derive(Debug, Clone)]
struct BandTemplate {
    angle_rad: f64,
    /// Round end: the cell and the orientation of its normal.
    cap: [((isize, isize), usize); CAP_SAMPLES],
    /// First sample of either flank, whose normals have one orientation.
    flanks: [(isize, isize); 2],
    flank_bin: usize,
    /// From the first sample to the second, from the first two to the next two, and so on.
    doublings: [(isize, isize); FLANK_SAMPLES.ilog2() as usize],
}

/// Planes of bytes, one per channel.
#[derive(Debug, Clone, Default)]
struct Octave {
    width: usize,
    height: usize,
    planes: Vec<u8>,
}

/// One level of the pyramid; every level uses the same buffers in turn.
#[derive(Debug, Clone, Default)]
struct Level {
    width: usize,
    height: usize,
    /// Cells in a row of the planes below, which have a margin all around.
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

/// A coarse find.
#[derive(Debug, Clone, Copy)]
struct Band {
    tip: Point2<f64>,
    angle_rad: f64,
    half_width_px: f64,
    score: f64,
}

/// A band that was looked at closely.
#[derive(Debug, Clone, Copy)]
struct Looked {
    band: Band,
    length_px: f64,
    colour: Vector3<f64>,
    foreground: f64,
    score: f64,
}

impl HandFinder {
    /// A finder with the given options.
    ///
    /// # Errors
    /// When an option is outside its documented range.
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
            looked_at: Vec::new(),
            found: Vec::new(),
        })
    }

    /// The options in force.
    #[must_use]
    pub fn options(&self) -> &FinderOptions {
        &self.options
    }

    /// The candidates in a frame, the likeliest first. A `background` that is known and of the
    /// frame's size tells what has come into view; without one the frame alone has to do.
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
        self.look(frame);
        self.rank();
        &self.found
    }

    /// How like a finger the inside of a band is by how it differs from what is about it, 0–1; its
    /// edges, a fit has found. None if too little of that lies in the image. Each half of one that is lit
    /// from one side may differ by its colours, or by their chromaticity alone.
    ///
    /// # Errors
    /// A place or direction that is not finite, a half-width that is not above 0.
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
        let sight = Sight::new(frame, tip, angle_rad);
        Ok(Inside::of(&sight, half_width_px, WHOLE).and_then(|inside| {
            let likeness = stands_out(&sight, &inside, half_width_px)?;
            let half_lit = half_lit_stands_out(&sight, &inside, half_width_px);
            Some(half_lit.map_or(likeness, |half_lit| half_lit.max(likeness)))
        }))
    }

    /// Takes the frame apart into channels, and halves them until the coarsest level has one.
    fn split(&mut self, frame: &Frame<'_>, with_foreground: bool) {
        let image = frame.image();
        self.size = (image.width(), image.height());
        let colours = if frame.colour().is_some() { 3 } else { 1 };
        self.channels = colours + usize::from(with_foreground);
        if self.octaves.is_empty() {
            self.octaves.push(Octave::default());
        }
        let full = &mut self.octaves[0];
        (full.width, full.height) = self.size;
        let pixels = full.width * full.height;
        full.planes.clear();
        full.planes.resize(self.channels * pixels, 0);
        for (y, row) in (0..full.height).filter_map(|y| Some((y, image.row(y)?))) {
            let at = y * full.width;
            if let Some(colour) = frame.colour() {
                for x in 0..full.width {
                    for (c, level) in colour.pixel(x, y).unwrap_or_default().iter().enumerate() {
                        full.planes[c * pixels + at + x] = *level;
                    }
                }
            } else {
                full.planes[at..at + full.width].copy_from_slice(row);
            }
            if with_foreground {
                let map = &self.foreground;
                let cells = &map.cells[y / map.step * map.width..];
                for (x, out) in
                    full.planes[colours * pixels + at..][..full.width].iter_mut().enumerate()
                {
                    *out = (FOREGROUND_GAIN * f64::from(cells[x / map.step])) as u8;
                }
            }
        }
        let side = self.size.0.max(self.size.1) as f64;
        let coarsest = self.options.max_half_width * side / HALF_WIDTH_CELLS;
        let mut octave = 0;
        while 2_f64.powi(octave as i32 + 1) <= coarsest {
            octave += 1;
            if self.octaves.len() == octave {
                self.octaves.push(Octave::default());
            }
            let (before, after) = self.octaves.split_at_mut(octave);
            after[0].halve(&before[octave - 1], self.channels);
        }
    }

    /// Looks for bands of about one half-width.
    fn search(&mut self, half_width_px: f64) {
        let cell_px = half_width_px / HALF_WIDTH_CELLS;
        let octave = cell_px.log2().floor().clamp(0.0, (self.octaves.len() - 1) as f64) as usize;
        let level = &mut self.level;
        level.sample(&self.octaves[octave], self.channels, cell_px / 2_f64.powi(octave as i32));
        level.orient(self.channels, self.options.min_gradient_grey);
        for (k, template) in self.templates.iter().enumerate() {
            level.score(template, k as u8);
        }
        let first = self.bands.len();
        for (x, y, score, angle) in level.peaks() {
            let place = |i: usize| (i as f64 + 0.5) * cell_px - 0.5;
            self.bands.push(Band {
                tip: Point2::new(place(x), place(y)),
                angle_rad: self.templates[usize::from(angle)].angle_rad,
                half_width_px,
                score: f64::from(score) / f64::from(MEETS * CAP_SAMPLES as u8),
            });
        }
        let level_bands = &mut self.bands[first..];
        // Of equal scores the one in the foreground goes first.
        let map = &self.foreground;
        let worth = |band: &Band| band.score + FOREGROUND_SAY * inside_foreground(map, band);
        level_bands.sort_by(|a, b| worth(b).total_cmp(&worth(a)));
        self.bands.truncate(first + LOOKED_AT);
    }

    /// Looks at every band closely.
    fn look(&mut self, frame: &Frame<'_>) {
        self.looked_at.clear();
        for band in &self.bands {
            if let Some(looked) = look_closely(frame, &self.foreground, band) {
                self.looked_at.push(looked);
            }
        }
        self.looked_at.sort_by(|a, b| b.score.total_cmp(&a.score));
    }

    /// Keeps the best of those that are one, and pairs fingers with thumbs.
    fn rank(&mut self) {
        self.found.clear();
        let mut kept = 0;
        for k in 0..self.looked_at.len() {
            let looked = self.looked_at[k];
            if self.looked_at[..kept].iter().all(|other| !other.is_same(&looked)) {
                self.looked_at[kept] = looked;
                kept += 1;
            }
        }
        let distinct = &self.looked_at[..kept];
        for looked in distinct {
            let thumb = distinct
                .iter()
                .filter_map(|other| looked.thumb(other))
                .max_by(|a, b| a.1.total_cmp(&b.1));
            let (side, bonus) =
                thumb.map_or((Thumb::None, 0.0), |(side, score)| (side, THUMB_SAY * score));
            self.found.push(looked.candidate(side, bonus));
        }
        // Something that was there before may be the hand, but one that has come is likelier.
        let knows = !self.foreground.cells.is_empty();
        let least = if knows { BACKGROUND_WORTH } else { 1.0 };
        let worth = |c: &Candidate| c.score * (least + (1.0 - least) * c.foreground);
        self.found.sort_by(|a, b| worth(b).total_cmp(&worth(a)));
        self.found.truncate(self.options.candidates);
    }
}

/// What being foreground adds to the score of a coarse band.
const FOREGROUND_SAY: f64 = 0.5;
/// What a candidate loses without a hand behind it, and the part of the places there that look like
/// the finger from which nothing is missing.
const HAND_SAY: f64 = 0.3;
const HAND_PART: f64 = 0.5;
/// What a candidate in the background is worth beside one in the foreground.
const BACKGROUND_WORTH: f64 = 0.5;
/// What part of the missing score a perfect thumb makes good.
const THUMB_SAY: f64 = 0.3;

impl BandTemplate {
    fn new(angle_rad: f64) -> Self {
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
    /// Means of 2 × 2 pixels of another one.
    fn halve(&mut self, from: &Self, channels: usize) {
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

    /// The orientation of the strongest gradient of any channel, cell by cell, spread over the
    /// neighbours, and from it how well an edge of each orientation is met.
    fn orient(&mut self, channels: usize, min_gradient_grey: f64) {
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
    fn score(&mut self, template: &BandTemplate, angle: u8) {
        let stride = self.stride as isize;
        let cells = self.best.len();
        let shift = |(dx, dy): (isize, isize)| dy * stride + dx;
        // As far as any sample reaches from any cell of the image.
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
            // Both ends of the line lie in the padded plane; the rest is nobody's.
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

    /// Cells that no neighbour within a half-width outdoes: place, score and angle.
    fn peaks(&self) -> impl Iterator<Item = (usize, usize, u8, u8)> {
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
                            // Of equals the first one stays.
                            let before = (dy, dx) < (REACH, REACH);
                            other < here || (other == here && !before)
                        })
                    })
            })
            .map(move |(x, y)| (x, y, self.best[at(x, y)], self.angle[at(x, y)]))
    }
}

/// The orientation of a gradient, in bins of half a turn.
fn bin_of(gx: i32, gy: i32) -> usize {
    // Tangents of 11.25°, 33.75°, 56.25° and 78.75°, in 1/1024.
    const TANGENTS: [i32; 4] = [204, 684, 1532, 5148];
    let (gx, gy) = if gy < 0 || (gy == 0 && gx < 0) { (-gx, -gy) } else { (gx, gy) };
    let steps = TANGENTS.iter().filter(|&&t| 1024 * gy > t * gx.abs()).count();
    if gx >= 0 { steps } else { (BINS - steps) % BINS }
}

/// What a sample of one orientation counts, by the set of orientations near it.
fn response_table(bin: usize) -> [u8; 256] {
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

/// Mean foreground along the axis of a band.
fn inside_foreground(map: &ForegroundMap, band: &Band) -> f64 {
    const SAMPLES: usize = 6;
    if map.cells.is_empty() {
        return 0.0;
    }
    let (sin, cos) = band.angle_rad.sin_cos();
    let along = Vector2::new(cos, sin) * band.half_width_px;
    let at = |k: usize| band.tip - along * (0.7 + 0.5 * k as f64);
    (0..SAMPLES).map(|k| map.at(at(k).x, at(k).y)).sum::<f64>() / SAMPLES as f64
}

/// The unit vector at an angle.
fn direction(angle_rad: f64) -> Vector2<f64> {
    Vector2::new(angle_rad.cos(), angle_rad.sin())
}

/// A frame as seen from a band: along its axis and across it, in px from its tip.
#[derive(Debug, Clone, Copy)]
struct Sight<'a> {
    frame: &'a Frame<'a>,
    tip: Point2<f64>,
    e: Vector2<f64>,
    n: Vector2<f64>,
    /// Whether it sees chromaticities alone.
    is_chromatic: bool,
}

impl<'a> Sight<'a> {
    fn new(frame: &'a Frame<'a>, tip: Point2<f64>, angle_rad: f64) -> Self {
        let e = direction(angle_rad);
        Self { frame, tip, e, n: Vector2::new(-e.y, e.x), is_chromatic: false }
    }

    /// The same for chromaticities; none without colours.
    fn of_chromaticity(&self) -> Option<Self> {
        self.frame.colour().map(|_| Self { is_chromatic: true, ..*self })
    }

    fn place(&self, along_px: f64, across_px: f64) -> Point2<f64> {
        self.tip + self.e * along_px + self.n * across_px
    }

    /// The colours of the pixel nearest to a place; a grey level three times without colours.
    fn pixel(&self, along_px: f64, across_px: f64) -> Option<Vector3<f64>> {
        let at = self.place(along_px, across_px);
        let image: &GrayView<'_> = self.frame.image();
        if !image.contains(at.x, at.y, -0.5) {
            return None;
        }
        let (x, y) = ((at.x + 0.5) as usize, (at.y + 0.5) as usize);
        match self.frame.colour() {
            Some(colour) => colour.pixel(x, y).map(|p| {
                if self.is_chromatic { chromaticity(p) } else { Vector3::from(p.map(f64::from)) }
            }),
            None => image.pixel(x, y).map(|g| Vector3::repeat(f64::from(g))),
        }
    }

    /// The offset of the strongest change of the mean colour, in `from ..= to` px, and how strong it
    /// is \[grey levels\]. `at(offset, k)` are the places of sample k of the mean at an offset.
    fn strongest_change(
        &self,
        (from, to): (f64, f64),
        samples: usize,
        at: impl Fn(f64, usize) -> (f64, f64),
    ) -> Option<(f64, f64)> {
        let mean = |offset: f64| -> Option<Vector3<f64>> {
            let mut sum = Vector3::zeros();
            for k in 0..samples {
                let (along, across) = at(offset, k);
                sum += self.pixel(along, across)?;
            }
            Some(sum / samples as f64)
        };
        let steps = (to - from).abs().ceil().max(1.0) as usize;
        let offset = |i: usize| from + (to - from) * i as f64 / steps as f64;
        let step = (to - from) / steps as f64;
        let mut best = None;
        let (mut before, mut here) = (mean(from - step)?, mean(from)?);
        for i in 0..=steps {
            let after = mean(offset(i) + step)?;
            let strength = (after - before).amax();
            if best.is_none_or(|(_, s)| strength > s) {
                best = Some((offset(i), strength));
            }
            (before, here) = (here, after);
        }
        best
    }
}

/// How a pixel's colours differ from those inside a finger.
struct Inside {
    mean: Vector3<f64>,
    information: Matrix3<f64>,
    unlike: f64,
}

impl Inside {
    /// The colours of a band's core, from so far across it to so far, in parts of the core's half-width;
    /// None if too little of it lies in the image.
    fn of(sight: &Sight<'_>, half_width_px: f64, (from, to): (f64, f64)) -> Option<Self> {
        const ALONG: usize = 16;
        const PLACES: usize = 5;
        let (mut count, mut sum, mut squares) = (0.0, Vector3::zeros(), Matrix3::zeros());
        for i in 0..ALONG {
            let along = -half_width_px * (0.6 + 3.0 * i as f64 / (ALONG - 1) as f64);
            for j in 0..PLACES {
                let part = from + (to - from) * j as f64 / (PLACES - 1) as f64;
                let across = half_width_px * ACROSS * part;
                if let Some(colour) = sight.pixel(along, across) {
                    count += 1.0;
                    sum += colour;
                    squares += colour * colour.transpose();
                }
            }
        }
        if count < 0.7 * (ALONG * PLACES) as f64 {
            return None;
        }
        let mean = sum / count;
        let floor = Matrix3::identity() * (COLOUR_FLOOR * COLOUR_FLOOR);
        let coloured = sight.frame.colour().is_some();
        let covariance = squares / count - mean * mean.transpose();
        if coloured {
            let information = (covariance + floor).try_inverse()?;
            return Some(Self { mean, information, unlike: UNLIKE_COLOUR });
        }
        let information = Matrix3::from_diagonal(&Vector3::new(
            1.0 / (covariance[(0, 0)].max(0.0) + COLOUR_FLOOR * COLOUR_FLOOR),
            0.0,
            0.0,
        ));
        Some(Self { mean, information, unlike: UNLIKE_GREY })
    }

    fn is_unlike(&self, colour: &Vector3<f64>) -> bool {
        let d = colour - self.mean;
        d.dot(&(self.information * d)) > self.unlike
    }

    /// Part of some places that look different; None if most lie outside the image.
    fn unlike_part(
        &self,
        sight: &Sight<'_>,
        places: impl Iterator<Item = (f64, f64)>,
    ) -> Option<f64> {
        let (mut all, mut seen, mut unlike) = (0.0, 0.0, 0.0);
        for (along, across) in places {
            all += 1.0;
            if let Some(colour) = sight.pixel(along, across) {
                seen += 1.0;
                unlike += f64::from(u8::from(self.is_unlike(&colour)));
            }
        }
        (seen > 0.5 * all).then(|| unlike / seen)
    }
}

/// Puts a band in its place, and tells how its inside differs from what is around it.
fn look_closely(frame: &Frame<'_>, map: &ForegroundMap, band: &Band) -> Option<Looked> {
    const ALONG: usize = 10;
    const ACROSS: usize = 5;
    let w = band.half_width_px;
    let middle = band.tip - direction(band.angle_rad) * w;
    // The flanks first, at the angle at which they show best; then the end between them.
    let back = |k: usize| -w * (0.8 + 2.6 * k as f64 / (ALONG - 1) as f64);
    let mut best: Option<(f64, f64, Sight<'_>, [f64; 2])> = None;
    for turn_rad in TURNS_RAD {
        let angle_rad = band.angle_rad + turn_rad;
        let sight = Sight::new(frame, middle + direction(angle_rad) * w, angle_rad);
        let flank = |side: f64| {
            sight.strongest_change((0.6 * w, 1.5 * w), ALONG, |offset, k| (back(k), side * offset))
        };
        let (Some((left, l)), Some((right, r))) = (flank(-1.0), flank(1.0)) else { continue };
        let strength = l.min(r) * (1.0 - (turn_rad / TURN_REACH_RAD).powi(2));
        if best.as_ref().is_none_or(|(s, ..)| strength > *s) {
            best = Some((strength, angle_rad, sight, [left, right]));
        }
    }
    let (_, angle_rad, mut sight, [left, right]) = best?;
    let half_width_px = 0.5 * (left + right);
    sight.tip += sight.n * (0.5 * (right - left));
    let (end, _) = sight.strongest_change((-0.9 * w, 0.9 * w), ACROSS, |offset, k| {
        (offset, half_width_px * (0.2 * k as f64 - 0.4))
    })?;
    sight.tip += sight.e * end;

    let inside = Inside::of(&sight, half_width_px, WHOLE)?;
    let score = band.score * stands_out(&sight, &inside, half_width_px)?;
    let band = Band { tip: sight.tip, angle_rad, half_width_px, ..*band };
    let foreground = inside_foreground(map, &band);
    let length_px = visible_length(&sight, &inside, half_width_px);
    Some(Looked { band, length_px, colour: inside.mean, foreground, score })
}

/// How far the inside of a band differs from what is beside it and ahead, and not from what is
/// behind, 0–1.
fn stands_out(sight: &Sight<'_>, inside: &Inside, w: f64) -> Option<f64> {
    let unlike = [
        inside.unlike_part(sight, beside(w, -1.0))?,
        inside.unlike_part(sight, beside(w, 1.0))?,
        inside.unlike_part(sight, ahead(w))?,
    ];
    Some(finger_before_hand(sight, inside, w, unlike))
}

/// The same of a band that is lit from one side: what is beside it is compared with the half that is next to
/// it, by colours or by chromaticity, whichever tells more, and what is behind by chromaticity. None if it is
/// no such band.
fn half_lit_stands_out(sight: &Sight<'_>, inside: &Inside, w: f64) -> Option<f64> {
    let chromatic = sight.of_chromaticity()?;
    let halves = [(-1.0, (-1.0, -HALF_FROM)), (1.0, (HALF_FROM, 1.0))];
    let [left, right] = halves.map(|(_, half)| Inside::of(sight, w, half));
    let (one, other) = (left.as_ref()?.mean.sum(), right.as_ref()?.mean.sum());
    if one.min(other) > HALF_LIT * one.max(other) {
        return None;
    }
    let [left, right] = halves.map(|(side, half)| {
        let unlike = |sight| Inside::of(sight, w, half)?.unlike_part(sight, beside(w, side));
        Some(unlike(sight)?.max(unlike(&chromatic)?))
    });
    let whole = Inside::of(&chromatic, w, WHOLE)?;
    let ahead = inside.unlike_part(sight, ahead(w))?.max(whole.unlike_part(&chromatic, ahead(w))?);
    Some(finger_before_hand(&chromatic, &whole, w, [left?, right?, ahead]))
}

/// Places beside a band's flank.
fn beside(w: f64, side: f64) -> impl Iterator<Item = (f64, f64)> {
    (0..12).flat_map(move |i| {
        let along = -w * (1.0 + 2.6 * f64::from(i) / 11.0);
        (0..4).map(move |j| (along, side * w * (1.35 + 0.16 * f64::from(j))))
    })
}

/// Places ahead of its tip.
fn ahead(w: f64) -> impl Iterator<Item = (f64, f64)> {
    (0..9).flat_map(move |i| {
        let (sin, cos) = (1.05 * (f64::from(i) / 4.0 - 1.0)).sin_cos();
        (0..4).map(move |j| {
            let r = w * (1.35 + 0.16 * f64::from(j));
            (r * cos - w, r * sin)
        })
    })
}

/// How like a finger a band is of which such parts of what is on its left, on its right and ahead are
/// unlike it, 0–1: behind a finger is a hand.
fn finger_before_hand(sight: &Sight<'_>, inside: &Inside, w: f64, unlike: [f64; 3]) -> f64 {
    let least = unlike.iter().copied().fold(1.0, f64::min);
    let mean = unlike.iter().sum::<f64>() / 3.0;
    let behind = 1.0 - inside.unlike_part(sight, hand_places(w)).unwrap_or(1.0);
    let hand = 1.0 - HAND_SAY * (1.0 - behind / HAND_PART).max(0.0);
    (0.3 + 0.4 * least + 0.3 * mean) * hand
}

/// Places where a hand is, behind its finger.
fn hand_places(w: f64) -> impl Iterator<Item = (f64, f64)> {
    (0..8).flat_map(move |i| {
        let along = -w * (5.0 + 5.0 * f64::from(i) / 7.0);
        (0..7).map(move |j| (along, w * (2.5 * (f64::from(j) / 3.0 - 1.0))))
    })
}

/// How far back both flanks show, in the range of what a finger has; where the colours do not tell
/// even beside the tip, a middle length.
fn visible_length(sight: &Sight<'_>, inside: &Inside, w: f64) -> f64 {
    let differs = |along: f64, side: f64| {
        (0..3).any(|j| {
            let across = side * w * (1.3 + 0.2 * f64::from(j));
            sight.pixel(along, across).is_some_and(|c| inside.is_unlike(&c))
        })
    };
    let (mut seen, mut back, mut misses) = (0.0, 1.0, 0);
    while back <= LENGTHS.1 && misses < 2 {
        if differs(-back * w, -1.0) && differs(-back * w, 1.0) {
            (seen, misses) = (back, 0);
        } else {
            misses += 1;
        }
        back += 0.5;
    }
    w * if seen < TOLD_LENGTH { UNTOLD_LENGTH } else { seen.clamp(LENGTHS.0, LENGTHS.1) }
}

impl Looked {
    /// The candidate that it is, with a thumb that makes good a part of the missing score.
    fn candidate(&self, thumb: Thumb, bonus: f64) -> Candidate {
        Candidate {
            tip_px: self.band.tip,
            angle_rad: self.band.angle_rad,
            length_px: self.length_px,
            half_width_px: self.band.half_width_px,
            thumb,
            colour: self.colour.into(),
            foreground: self.foreground,
            score: (self.score + bonus * (1.0 - self.score)).min(1.0),
        }
    }

    fn is_same(&self, other: &Self) -> bool {
        let (a, b) = (&self.band, &other.band);
        let apart = (a.angle_rad - b.angle_rad + PI).rem_euclid(TAU) - PI;
        (a.tip - b.tip).norm() < SAME_PLACE * a.half_width_px.max(b.half_width_px)
            && apart.abs() < SAME_ANGLE_RAD
    }

    /// The side on which another band could be this finger's thumb, and how good a band it is.
    fn thumb(&self, other: &Self) -> Option<(Thumb, f64)> {
        let (a, b) = (&self.band, &other.band);
        let w = a.half_width_px;
        let within = |x: f64, (low, high): (f64, f64)| x >= low && x <= high;
        let (sin, cos) = a.angle_rad.sin_cos();
        let (e, n) = (Vector2::new(cos, sin), Vector2::new(-sin, cos));
        let to = b.tip - a.tip;
        let across = to.dot(&n);
        let (sin, cos) = b.angle_rad.sin_cos();
        let direction = Vector2::new(cos, sin);
        let side = across.signum();
        // Both directions lead away from where the axes meet.
        let turned = (side * direction.dot(&n)).atan2(direction.dot(&e));
        if !within(turned, THUMB_ANGLES_RAD) || !within(b.half_width_px / w, THUMB_WIDTHS) {
            return None;
        }
        let root = across / direction.dot(&n);
        let meet = -(to - direction * root).dot(&e) / w;
        let reaches = within(meet, THUMB_ROOTS) && within(root / w, THUMB_TIPS);
        let thumb = if side < 0.0 { Thumb::Left } else { Thumb::Right };
        reaches.then_some((thumb, other.score))
    }
}
