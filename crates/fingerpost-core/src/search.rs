//! Edge search along the normals of a contour.
//!
//! Every search line samples the image at whole pixels along an outward normal, correlates the
//! profile with the derivative of a Gaussian and reports where the response peaks, to a fraction
//! of a pixel. With kernel scale s, edge blur σ_b, S² = s² + σ_b², contrast A and white noise σ_n
//! the offset of the peak has the variance
//!
//! ```text
//! Var(offset) = (3 √π / 4) · σ_n² S⁶ / (A² s⁵)        [px²]
//! ```
//!
//! per independent pixel of contour: the noise of the response's slope, ∫ g″² · σ_n², over the
//! squared curvature of the blurred step's response at its peak.
//!
//! Source: Canny 1986 for the operator; Cipolla & Blake 1992 for the search along normals.

use crate::appearance::Appearance;
use crate::frame::Frame;
use crate::image::GrayView;
use crate::shape_space::PlacedSample;
use crate::{Error, Result};
use nalgebra::Vector2;
use std::f64::consts::PI;

/// Which side of an edge is the hand.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Polarity {
    /// The hand is brighter than what is behind it.
    Bright,
    /// The hand is darker than what is behind it.
    Dark,
    /// Not known: either will do.
    Unknown,
}

impl Polarity {
    /// The polarity of an edge of the given signed contrast (hand minus background).
    #[must_use]
    pub fn of_contrast(contrast_grey: f64) -> Self {
        if contrast_grey >= 0.0 { Self::Bright } else { Self::Dark }
    }
}

/// How edges are looked for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SearchOptions {
    /// Scale s of the derivative of Gaussian \[px\], 0.5–8.
    pub scale_px: f64,
    /// Blur σ_b of the edges in the image \[px\], 0–8; only contrast and variance depend on it.
    pub blur_px: f64,
    /// Standard deviation σ_n of the image noise \[grey levels\], 0.1–64.
    pub noise_grey: f64,
    /// The least contrast that counts as an edge \[grey levels\], 0–255.
    pub min_contrast_grey: f64,
}

impl Default for SearchOptions {
    fn default() -> Self {
        Self { scale_px: 1.6, blur_px: 1.0, noise_grey: 2.0, min_contrast_grey: 8.0 }
    }
}

/// What a search line looks for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Cue<'a> {
    /// The strongest edge.
    Edges,
    /// The edge that best separates the hand from what is behind it.
    HandEdges(&'a Appearance),
    /// The place where the pixels' votes change sides, edge or none: coarse, but the same from any
    /// distance and under any motion blur.
    Votes(&'a Appearance),
}

impl<'a> Cue<'a> {
    fn appearance(self) -> Option<&'a Appearance> {
        match self {
            Self::Edges => None,
            Self::HandEdges(appearance) | Self::Votes(appearance) => Some(appearance),
        }
    }
}

/// How large a kernel looks for edges.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Scale {
    /// [`SearchOptions::scale_px`]: places a sharp edge best.
    Fine,
    /// Two and a half times that: sees an edge that motion has smeared.
    Coarse,
}

/// One line to search: a placed contour sample, how far to look and what to look for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SearchLine {
    /// The sample and its outward normal.
    pub sample: PlacedSample,
    /// Offsets −L … +L are searched \[px\]; rounded up to a whole pixel.
    pub half_length_px: f64,
    /// Which side of the edge is the hand.
    pub polarity: Polarity,
}

/// Why a search line found no edge.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Miss {
    /// Too little of the line lies inside the image.
    OutOfImage,
    /// No response of the right polarity reaches the least contrast.
    NoContrast,
    /// The response still rises where the line ends: the edge, if any, lies beyond.
    BeyondEnd,
}

/// An edge found along a search line.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Edge {
    /// Signed distance along the outward normal \[px\].
    pub offset_px: f64,
    /// Contrast, hand minus background \[grey levels\]; its sign is the polarity found.
    pub contrast_grey: f64,
    /// Variance of the offset \[px²\] from image noise alone.
    pub variance_px2: f64,
    /// How the pixels on either side vote, if the hand's appearance is known: the mean vote inside
    /// minus the mean vote outside. Near zero the edge is not the hand's.
    pub separation: Option<f64>,
}

/// What one search line yields: an edge, or why there is none. A miss is never an offset of zero.
pub type EdgeMeasurement = std::result::Result<Edge, Miss>;

/// The longest half-length of a search line \[px\].
pub const MAX_HALF_LENGTH_PX: usize = 128;

/// Samples keep this far from the image's border, so that rounding of a coordinate to single
/// precision cannot put one outside \[px\].
const BORDER_MARGIN_PX: f64 = 1e-2;

/// A derivative of a Gaussian.
#[derive(Debug, Clone)]
struct Kernel {
    scale_px: f64,
    /// Weights at +1, +2, … px, out to 3 s; the weight at −k is the opposite, at 0 it is zero.
    /// They sum to one, so a sharp step of contrast A answers with A.
    weights: Vec<f32>,
    /// S: the kernel's scale and the edge's blur together \[px\].
    blurred_scale_px: f64,
}

/// A coarse kernel is this much larger than the fine one.
const COARSE: f64 = 2.5;

/// The kernels, and the buffers that a search reuses: nothing is allocated while searching.
#[derive(Debug, Clone)]
pub struct EdgeSearch {
    options: SearchOptions,
    kernels: [Kernel; 2],
    profile: Profile,
}

/// What a search line sees, sample by sample.
#[derive(Debug, Clone)]
struct Profile {
    /// Grey levels.
    grey: Vec<f32>,
    /// The kernel's answers, from the first offset at which it fits.
    response: Vec<f32>,
    /// Sums of the votes from the inner end up to each sample.
    votes: Vec<f32>,
}

impl EdgeSearch {
    /// A search with the given options.
    ///
    /// # Errors
    /// When an option is not finite or outside its documented range.
    pub fn new(options: SearchOptions) -> Result<Self> {
        let SearchOptions { scale_px, blur_px, noise_grey, min_contrast_grey } = options;
        Error::within("search scale [px]", scale_px, "0.5 to 8", |s| (0.5..=8.0).contains(&s))?;
        Error::within("edge blur [px]", blur_px, "0 to 8", |b| (0.0..=8.0).contains(&b))?;
        Error::within("image noise [grey levels]", noise_grey, "0.1 to 64", |n| {
            (0.1..=64.0).contains(&n)
        })?;
        Error::within("least contrast [grey levels]", min_contrast_grey, "0 to 255", |c| {
            (0.0..=255.0).contains(&c)
        })?;
        let kernels = [1.0, COARSE].map(|factor| Kernel::new(factor * scale_px, blur_px));
        let reach = kernels.iter().map(Kernel::reach).max().unwrap_or(0);
        let samples = 2 * (MAX_HALF_LENGTH_PX + reach) + 1;
        Ok(Self {
            options,
            kernels,
            profile: Profile {
                grey: Vec::with_capacity(samples),
                response: Vec::with_capacity(samples),
                votes: Vec::with_capacity(samples + 1),
            },
        })
    }

    /// The options in force.
    #[must_use]
    pub fn options(&self) -> &SearchOptions {
        &self.options
    }

    /// Searches every line for `cue`; `measurements` is refilled, one entry a line, in the same
    /// order.
    ///
    /// # Errors
    /// When a line's half-length is not finite, not positive or above [`MAX_HALF_LENGTH_PX`], or
    /// its sample is not finite.
    pub fn search(
        &mut self,
        frame: &Frame<'_>,
        cue: Cue<'_>,
        scale: Scale,
        lines: &[SearchLine],
        measurements: &mut Vec<EdgeMeasurement>,
    ) -> Result<()> {
        measurements.clear();
        for line in lines {
            Error::within(
                "search half-length [px]",
                line.half_length_px,
                "positive and at most 128",
                |l| l > 0.0 && l <= MAX_HALF_LENGTH_PX as f64,
            )?;
            let PlacedSample { position, normal } = &line.sample;
            Error::finite("search position [px]", position.x + position.y)?;
            Error::finite("search normal", normal.x + normal.y)?;
            let kernel = &self.kernels[scale as usize];
            measurements.push(self.profile.search(&self.options, kernel, frame, cue, line));
        }
        Ok(())
    }
}

impl Kernel {
    fn new(scale_px: f64, blur_px: f64) -> Self {
        let reach = (3.0 * scale_px).ceil() as usize;
        let raw = |k: usize| {
            let x = k as f64 / scale_px;
            x * (-0.5 * x * x).exp()
        };
        let sum: f64 = (1..=reach).map(raw).sum();
        let weights = (1..=reach).map(|k| (raw(k) / sum) as f32).collect();
        Self { scale_px, weights, blurred_scale_px: scale_px.hypot(blur_px) }
    }

    /// How many pixels it covers on either side.
    fn reach(&self) -> usize {
        self.weights.len()
    }

    /// The contrast of a blurred step that answers with `response`.
    fn contrast(&self, response: f32) -> f64 {
        f64::from(response) * self.blurred_scale_px / self.scale_px
    }

    /// Var(offset) of the module's head.
    fn offset_variance(&self, noise_grey: f64, contrast_grey: f64) -> f64 {
        let ratio = noise_grey / contrast_grey;
        0.75 * PI.sqrt() * ratio * ratio * self.blurred_scale_px.powi(6) / self.scale_px.powi(5)
    }
}

impl Profile {
    fn search(
        &mut self,
        options: &SearchOptions,
        kernel: &Kernel,
        frame: &Frame<'_>,
        cue: Cue<'_>,
        line: &SearchLine,
    ) -> EdgeMeasurement {
        let image = frame.image();
        let reach = kernel.reach() as i32;
        let wanted = line.half_length_px.ceil() as i32;
        let (from, to) =
            visible_span(image, &line.sample, wanted + reach).ok_or(Miss::OutOfImage)?;
        let (first, last) = (from + reach, to - reach);
        if last - first < 2 || first > 0 || last < 0 {
            return Err(Miss::OutOfImage);
        }
        if let Some(appearance) = cue.appearance() {
            self.count_votes(frame, appearance, &line.sample, from, to);
        }
        if let Cue::Votes(_) = cue {
            return self.change_of_votes(from, kernel.reach());
        }
        self.sample(image, &line.sample, from, to);
        self.correlate(kernel);
        let voted = cue.appearance().is_some();
        let peak = self.best_peak(options, kernel, line.polarity, voted)?;
        let Some(&[before, at, after]) = self.response.get(peak.wrapping_sub(1)..=peak + 1) else {
            return Err(Miss::BeyondEnd);
        };
        let contrast_grey = kernel.contrast(at);
        Ok(Edge {
            offset_px: f64::from(first) + peak as f64 + parabola_peak(before, at, after),
            contrast_grey,
            variance_px2: kernel.offset_variance(options.noise_grey, contrast_grey),
            separation: voted.then(|| f64::from(self.separation(peak, kernel.reach()))),
        })
    }

    /// Grey levels at whole offsets `from ..= to`; both ends are known to lie in the image.
    fn sample(&mut self, image: &GrayView<'_>, sample: &PlacedSample, from: i32, to: i32) {
        let PlacedSample { position, normal } = sample;
        self.grey.clear();
        self.grey.extend((from..=to).map(|k| {
            let at = position + normal * f64::from(k);
            image.sample_f32(at.x as f32, at.y as f32).unwrap_or(0.0)
        }));
    }

    /// Inside minus outside, weighted by the kernel, at every offset that the kernel fits.
    fn correlate(&mut self, kernel: &Kernel) {
        let reach = kernel.reach();
        self.response.clear();
        self.response.extend(self.grey.windows(2 * reach + 1).map(|window| {
            let (inside, outside) = (window[..reach].iter().rev(), window[reach + 1..].iter());
            inside.zip(outside).zip(&kernel.weights).map(|((i, o), w)| w * (i - o)).sum::<f32>()
        }));
    }

    /// The edge to believe, among the peaks of the wanted polarity: the strongest; where the
    /// pixels vote, the one whose sides they tell apart best.
    fn best_peak(
        &self,
        options: &SearchOptions,
        kernel: &Kernel,
        polarity: Polarity,
        voted: bool,
    ) -> std::result::Result<usize, Miss> {
        let strength = |r: f32| match polarity {
            Polarity::Bright => r,
            Polarity::Dark => -r,
            Polarity::Unknown => r.abs(),
        };
        let last = self.response.len() - 1;
        let (mut best, mut at) = (f32::NEG_INFINITY, None);
        let mut rises_to_end = false;
        for (i, &r) in self.response.iter().enumerate() {
            let here = strength(r);
            if here <= 0.0 || kernel.contrast(here) < options.min_contrast_grey {
                continue;
            }
            let before = if i > 0 { strength(self.response[i - 1]) } else { f32::NEG_INFINITY };
            let after = if i < last { strength(self.response[i + 1]) } else { f32::NEG_INFINITY };
            if here < before || here <= after {
                continue;
            }
            if i == 0 || i == last {
                rises_to_end = true;
                continue;
            }
            let score = if voted {
                let separation = self.separation(i, kernel.reach());
                if separation < MIN_SEPARATION {
                    continue;
                }
                separation + STRENGTH_SAY * here.ln()
            } else {
                here
            };
            if score > best {
                (best, at) = (score, Some(i));
            }
        }
        at.ok_or(if rises_to_end { Miss::BeyondEnd } else { Miss::NoContrast })
    }

    /// Sums up the votes along the line.
    fn count_votes(
        &mut self,
        frame: &Frame<'_>,
        appearance: &Appearance,
        sample: &PlacedSample,
        from: i32,
        to: i32,
    ) {
        let mut sum = 0.0;
        self.votes.clear();
        self.votes.push(0.0);
        self.votes.extend((from..=to).map(|k| {
            let at = sample.position + sample.normal * f64::from(k);
            sum += appearance.vote(frame, at.x, at.y);
            sum
        }));
    }

    /// The most likely place of the contour if every pixel votes for itself: the votes inside it,
    /// less those outside, are largest where the sum from the inner end is.
    fn change_of_votes(&self, from: i32, reach: usize) -> EdgeMeasurement {
        let (mut best, mut at) = (f32::NEG_INFINITY, 0);
        for (i, &sum) in self.votes.iter().enumerate() {
            if sum > best {
                (best, at) = (sum, i);
            }
        }
        let Some(around) = self.votes.get(at.wrapping_sub(reach)..=at + reach) else {
            return Err(Miss::BeyondEnd);
        };
        let separation = (2.0 * around[reach] - around[0] - around[2 * reach]) / reach as f32;
        if separation < MIN_SEPARATION {
            return Err(Miss::NoContrast);
        }
        Ok(Edge {
            // The sum up to sample i ends half a pixel before that sample.
            offset_px: f64::from(from) + at as f64 - 0.5,
            contrast_grey: 0.0,
            variance_px2: VOTES_VARIANCE_PX2,
            separation: Some(f64::from(separation)),
        })
    }

    /// Mean vote of the pixels inside an edge at `peak` minus that of the pixels outside, both over
    /// the window that the kernel covers; the edge's own pixel is of neither side.
    fn separation(&self, peak: usize, reach: usize) -> f32 {
        let inside = self.votes[peak + reach] - self.votes[peak];
        let outside = self.votes[peak + 2 * reach + 1] - self.votes[peak + reach + 1];
        (inside - outside) / reach as f32
    }
}

/// An edge whose two sides vote less differently than this is not the hand's; votes go to ±3.
const MIN_SEPARATION: f32 = 1.0;
/// How well a change of votes tells where the contour is \[px²\].
const VOTES_VARIANCE_PX2: f64 = 1.0;
/// What an e-fold of strength adds to the score of an edge, in units of separation.
const STRENGTH_SAY: f32 = 0.5;

/// The whole offsets from −`half` to `half` whose samples lie in the image, if zero is among them.
fn visible_span(image: &GrayView<'_>, sample: &PlacedSample, half: i32) -> Option<(i32, i32)> {
    let PlacedSample { position, normal } = sample;
    let size = Vector2::new(image.width() as f64 - 1.0, image.height() as f64 - 1.0);
    let (mut from, mut to) = (-f64::from(half), f64::from(half));
    for (p, n, last) in [(position.x, normal.x, size.x), (position.y, normal.y, size.y)] {
        if !(0.0..=last).contains(&p) {
            return None;
        }
        if n != 0.0 {
            let (a, b) = (-p / n, (last - p) / n);
            from = from.max(a.min(b) + BORDER_MARGIN_PX);
            to = to.min(a.max(b) - BORDER_MARGIN_PX);
        }
    }
    Some((from.ceil() as i32, to.floor() as i32))
}

/// The peak of the parabola through three neighbours, from the middle one \[samples\], in ±1/2.
fn parabola_peak(before: f32, at: f32, after: f32) -> f64 {
    let curvature = f64::from(before) - 2.0 * f64::from(at) + f64::from(after);
    if curvature == 0.0 {
        return 0.0;
    }
    (0.5 * (f64::from(before) - f64::from(after)) / curvature).clamp(-0.5, 0.5)
}
