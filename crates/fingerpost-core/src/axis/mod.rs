//! The finger's axis as exactly as the image allows, with a covariance that can be believed.
//!
//! A tracker's contour is a template: it shares what it knows between finger and thumb, and its
//! edges are found one by one. A [`Refiner`] looks at the two flanks of the finger alone, twice:
//!
//! 1. It finds the edges of the flanks and takes their bisector, which is the projection of the axis
//!    of a surface of revolution whatever the taper and the perspective.
//! 2. From there it fits what the camera recorded near the flanks, pixel by pixel, to a model of a
//!    blurred, shaded, slightly bent finger with a round end before a background that is known or
//!    not. This uses all that the pixels tell: of a clean picture the angle is as sure as the
//!    Cramér–Rao bound of two free flanks allows.
//!
//! The second line counts if the pixels agree with the model and the flanks stand out from what is
//! behind them. If they agree with it less, it is handed out as unsure, to be weighed against what
//! else is known; otherwise the first counts, if its edges lie on two straight lines; otherwise none
//! ([`Source`], [`RefineOptions`]).
//!
//! ```
//! use fingerpost_core::nalgebra::{Point2, Vector2};
//! use fingerpost_core::axis::{Finger, RefineOptions, Refiner, Source, Stretch};
//! use fingerpost_core::measure::edge::Polarity;
//! use fingerpost_core::geometry::shape_space::Axis;
//! use fingerpost_core::{Frame, GrayView};
//!
//! // A finger, 14 px wide, that points to the upper right; it ends at (90, 45).
//! let (width, height, angle_rad) = (128, 96, -0.5_f64);
//! let (end, e) = (Point2::new(90.0, 45.0), Vector2::new(angle_rad.cos(), angle_rad.sin()));
//! let pixel = |i: usize| {
//!     let d = Point2::new((i % width) as f64, (i / width) as f64) - end;
//!     let outside = (d - e * d.dot(&e).min(0.0)).norm() - 7.0;
//!     (70.0 + 80.0 / (1.0 + (1.7 * outside).exp())).round() as u8
//! };
//! let pixels: Vec<u8> = (0..width * height).map(pixel).collect();
//! let frame = Frame::gray(GrayView::new(&pixels, width, height, width)?);
//!
//! // What a tracker believes of it, half a pixel and half a degree off.
//! let axis = Axis::of_finger(end - e * 30.0 + Vector2::new(0.0, 0.5), angle_rad + 0.009, 37.0);
//! let stretch = Stretch { from_px: -20.0, to_px: 34.0 };
//! let finger = Finger {
//!     axis,
//!     half_width_px: 7.3,
//!     taper: 0.0,
//!     flanks: [stretch; 2],
//!     round_end_px: Some(30.0),
//!     belief: None,
//! };
//! let mut refiner = Refiner::new(RefineOptions::default())?;
//! let refined = refiner.refine(&frame, &finger, Polarity::Bright, None, None)?;
//! let refined = refined.expect("a finger in plain view");
//! assert_eq!(refined.source, Source::Photometric);
//! assert!((refined.axis.angle_rad - angle_rad).abs() < 1e-3);
//! assert!(refined.axis.normal().dot(&(refined.axis.anchor - end)).abs() < 0.03);
//! # Ok::<(), fingerpost_core::Error>(())
//! ```

mod background;
mod bisector;
mod block;
mod blur;
mod gram;
mod noise;
mod options;
mod photometric;
mod pixels;
mod profile;
mod round;
mod shading;
mod sketch;
mod straightness;
mod texture;
mod unknowns;
mod visible_flanks;

pub use background::KnownBackground;
pub use options::{BisectorOptions, PhotometricOptions, RefineOptions};
pub use round::RoundFinger;
pub use straightness::Bend;
#[cfg(test)]
pub(crate) use texture::tests::Painted;
pub(crate) use texture::{Area, TexturePatch, TexturePose};

use crate::appearance::histogram::HistogramModel;
use crate::geometry::shape_space::Axis;
use crate::image::frame::Frame;
use crate::image::gray::GrayView;
use crate::measure::edge::Polarity;
use crate::measure::edge_search::Cue;
use crate::numeric::simd::Isa;
use crate::{Error, Result};
use bisector::{Bisector, BisectorFit};
use nalgebra::Matrix2;
use noise::NoiseEstimator;
use photometric::{Photometric, PhotometricFit};
use sketch::Sketch;
use straightness::Straightness;
use visible_flanks::VisibleFlanks;

/// The longest stretch of a finger that is looked at \[px\]: the pictures that edges are looked for in,
/// of up to 32767 px a side, have no room for it.
pub const MAX_STRETCH_PX: f64 = 65_536.0;

/// A stretch of a flank, in px along the axis from its anchor; empty unless `to_px > from_px`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Stretch {
    /// Where it begins.
    pub from_px: f64,
    /// Where it ends, nearer to the tip.
    pub to_px: f64,
}

impl Stretch {
    /// Its length \[px\]; not positive if it is empty.
    #[must_use]
    pub fn length_px(&self) -> f64 {
        self.to_px - self.from_px
    }

    /// Where its middle is \[px\].
    pub(crate) fn middle_px(&self) -> f64 {
        0.5 * (self.from_px + self.to_px)
    }

    /// So far to either side of a middle \[px\].
    pub(crate) fn about(middle_px: f64, half_length_px: f64) -> Self {
        Self { from_px: middle_px - half_length_px, to_px: middle_px + half_length_px }
    }

    /// The one over which the line of least squares through a parabola cuts it in two places, so far from
    /// their middle (squared): these are 1 / √3 of half its length from there. A line that cuts it
    /// nowhere is told for what is next to it.
    pub(crate) fn cut(middle_px: f64, cut_px2: f64) -> Self {
        const SHORTEST_PX: f64 = 1.0;
        Self::about(middle_px, (3.0 * cut_px2.max(0.0)).sqrt().max(SHORTEST_PX))
    }

    /// The same stretch, for an anchor that lies so much farther along \[px\].
    pub(crate) fn beside(&self, anchor_px: f64) -> Self {
        Self { from_px: self.from_px - anchor_px, to_px: self.to_px - anchor_px }
    }

    /// The same stretch in pixels of which so many are one of its own.
    pub(crate) fn scaled(&self, px: f64) -> Self {
        Self { from_px: px * self.from_px, to_px: px * self.to_px }
    }
}

/// Where a finger is believed to be, to within a few px: what the tracker knows of it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Finger {
    /// Its axis.
    pub axis: Axis,
    /// Half its width at the anchor of the axis \[px\], positive.
    pub half_width_px: f64,
    /// Growth of the half-width per px towards the tip.
    pub taper: f64,
    /// The stretches to look at, of the right flank (at +90°, in the direction (−sin θ, cos θ))
    /// and of the left one, together at most [`MAX_STRETCH_PX`] long. What a thumb or another finger
    /// covers is left out of them.
    pub flanks: [Stretch; 2],
    /// The middle of the finger's round end, in px along the axis from its anchor; `None` if the
    /// end is not to be seen.
    pub round_end_px: Option<f64>,
    /// What is believed of it, if something may cover it in part: then what does not look like the hand
    /// before what has been behind it is left out. `None` if nothing covers it.
    pub belief: Option<Belief>,
}

impl Finger {
    /// From where to where along the axis either of its flanks is looked at \[px\]; empty if neither is.
    pub(crate) fn stretch(&self) -> Stretch {
        let seen = self.flanks.iter().filter(|s| s.length_px() > 0.0);
        let nothing = Stretch { from_px: f64::INFINITY, to_px: f64::NEG_INFINITY };
        seen.fold(nothing, |all, s| Stretch {
            from_px: all.from_px.min(s.from_px),
            to_px: all.to_px.max(s.to_px),
        })
    }
}

/// What is believed of a finger that something covers in part: how wide it was when it was seen whole,
/// and how sure its axis is. The few edges that are bare may lie as well on a line that is turned by a
/// quarter of a radian.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Belief {
    /// Half its width at the anchor of its axis \[px\], positive.
    pub half_width_px: f64,
    /// Growth of the half-width per px towards the tip.
    pub taper: f64,
    /// Standard deviation of the half-width \[px\], positive.
    pub half_width_sigma_px: f64,
    /// Standard deviation of the taper, positive.
    pub taper_sigma: f64,
    /// Standard deviations of the axis: of its offset at the anchor \[px\] and of its angle \[rad\],
    /// positive.
    pub axis_sigmas: [f64; 2],
}

/// Where a refined line comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Source {
    /// The pixels agree with the model of a finger: the line of maximum likelihood.
    Photometric,
    /// They agree with it, but not well enough for the line to be believed alone.
    Unsure,
    /// They do not, but the edges of the flanks agree with two straight lines: their bisector.
    Bisector,
}

/// How the bisector was found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BisectorReport {
    /// Edges used, on both flanks.
    pub edges: usize,
    /// The part of them that had no say.
    pub rejected: f64,
    /// Robust standard deviation of the edges about the flanks \[px\].
    pub residual_px: f64,
}

/// How the photometric line was found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PhotometricReport {
    /// Pixels fitted.
    pub pixels: usize,
    /// Blocks that they lie in.
    pub blocks: usize,
    /// How much the blocks count on average, 0–1: those that something disturbs count less.
    pub trusted: f64,
    /// The part of the pixels that had no say.
    pub rejected: f64,
    /// Standard deviation of the pixels about the model \[grey levels\].
    pub residual_grey: f64,
    /// Standard deviation of the blur \[px\].
    pub blur_px: f64,
    /// Half the length of finger in use \[px\].
    pub half_length_px: f64,
    /// How much the medial line is bent over that length: the coefficient of P₂, two thirds of its
    /// sagitta \[px\].
    pub bend_px: f64,
    /// Standard deviation of the bend \[px\].
    pub bend_sigma_px: f64,
    /// Contrast at either flank, finger minus background, 2 px inside the edge, where it shows even
    /// of a finger whose limb is dark \[grey levels\].
    pub contrast_grey: [f64; 2],
    /// Standard deviation of the inside level along either flank \[grey levels\].
    pub inside_grey: [f64; 2],
    /// Standard deviation of the background's level along either flank \[grey levels\].
    pub outside_grey: [f64; 2],
    /// Standard deviation of the edge of either flank about its smooth line \[px\].
    pub edge_px: [f64; 2],
    /// Iterations until the line had settled, or until the last that was allowed.
    pub iterations: usize,
    /// Whether it had settled.
    pub converged: bool,
}

/// A refined finger.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Refined {
    /// The axis. Its anchor lies where the given axis has its own, its tip at the same distance.
    pub axis: Axis,
    /// Covariance of the line's offset at the anchor \[px\] and of its angle \[rad\].
    pub covariance: Matrix2<f64>,
    /// What the line stands for: through a slightly bent finger it runs as a line of least squares
    /// through this stretch does.
    pub stretch: Stretch,
    /// Half-width at the anchor \[px\].
    pub half_width_px: f64,
    /// Growth of the half-width per px towards the tip.
    pub taper: f64,
    /// Which of the two lines it is.
    pub source: Source,
    /// Standard deviation of the image's noise near the finger \[grey levels\].
    pub noise_grey: f64,
    /// How the bisector was found.
    pub bisector: Option<BisectorReport>,
    /// How the photometric line was found.
    pub photometric: Option<PhotometricReport>,
}

/// Refines lines; owns its buffers, so that nothing is allocated once they have grown.
#[derive(Debug, Clone)]
pub struct Refiner {
    options: RefineOptions,
    bisector: Bisector,
    photometric: Photometric,
    straightness: Straightness,
    noise: NoiseEstimator,
    visible: VisibleFlanks,
}

impl Refiner {
    /// A refiner with the given options.
    ///
    /// # Errors
    /// When an option is not finite or outside its documented range.
    pub fn new(options: RefineOptions) -> Result<Self> {
        options.check()?;
        Ok(Self {
            bisector: Bisector::new(options.bisector)?,
            photometric: Photometric::new(options.photometric),
            straightness: Straightness::new(options.bisector)?,
            noise: NoiseEstimator::new(),
            visible: VisibleFlanks::default(),
            options,
        })
    }

    /// The same, compiled for another instruction set; the lines have the same bits.
    #[must_use]
    pub fn with_isa(self, isa: Isa) -> Self {
        let bisector = self.bisector.with_isa(isa);
        let straightness = self.straightness.with_isa(isa);
        Self { bisector, photometric: self.photometric.with_isa(isa), straightness, ..self }
    }

    /// The options in force.
    #[must_use]
    pub fn options(&self) -> &RefineOptions {
        &self.options
    }

    /// The axis of a finger that is believed to be near `finger`; `None` when neither line can be
    /// believed, because the flanks do not show, or show something else than a finger.
    ///
    /// `polarity` says which side of the flanks is brighter, `appearance` what the hand looks like,
    /// `background` what is behind it; where the pixels contradict it, it does not count. The result
    /// depends on the arguments alone.
    ///
    /// # Errors
    /// When a number of the finger is not finite, its half-width is not positive, its stretches reach
    /// over more than [`MAX_STRETCH_PX`], or the background or the picture that it is behind is not of the frame's size.
    pub fn refine(
        &mut self,
        frame: &Frame<'_>,
        finger: &Finger,
        polarity: Polarity,
        appearance: Option<&HistogramModel>,
        background: Option<&KnownBackground<'_>>,
    ) -> Result<Option<Refined>> {
        let image = frame.image();
        if let Some(known) = background {
            let gray = (image.width(), image.height());
            let of = |image: &GrayView<'_>| (image.width(), image.height());
            for background in [(known.width(), known.height()), known.image().map_or(gray, of)] {
                if gray != background {
                    return Err(Error::BackgroundSize { gray, background });
                }
            }
        }
        let Some(sketch) = Sketch::of(finger)? else { return Ok(None) };
        let Some(noise_grey) = self.noise.estimate(image, &sketch) else { return Ok(None) };
        let cue = appearance.map_or(Cue::Edges, Cue::HandEdges);
        self.visible.measure(frame, appearance, &sketch);
        let bisector =
            self.bisector.fit(frame, cue, polarity, noise_grey, &sketch, &self.visible)?;
        let start = bisector.map_or(sketch, |b| b.sketch);
        let photometric = self.fit_pixels(image, background, noise_grey, &start);
        Ok(self.believed(noise_grey, &start, bisector, photometric))
    }

    /// How a finger that is believed to be near `finger` is bent; `None` when its flanks do not tell.
    /// The arguments are those of [`refine`](Self::refine).
    ///
    /// # Errors
    /// When a number of the finger is not finite, its half-width is not positive, or one of the halves
    /// is longer than [`MAX_STRETCH_PX`].
    pub fn bend(
        &mut self,
        frame: &Frame<'_>,
        finger: &Finger,
        polarity: Polarity,
        appearance: Option<&HistogramModel>,
    ) -> Result<Option<Bend>> {
        let cue = appearance.map_or(Cue::Edges, Cue::HandEdges);
        self.straightness.bend(frame, cue, polarity, finger)
    }

    /// The photometric line that counts, and the noise of the picture that shows it: the one before the
    /// known background if it is believed. What is known may not be what is there; then pixels that agree
    /// with a finger before something else are believed. Where neither are, a finger is not quite like the
    /// model, and to know what is behind it is better than not to.
    fn fit_pixels(
        &mut self,
        image: &GrayView<'_>,
        background: Option<&KnownBackground<'_>>,
        noise_grey: f64,
        start: &Sketch,
    ) -> Option<(PhotometricFit, f64)> {
        let options = self.options;
        let told = |(fit, noise): &(PhotometricFit, f64)| options.tells(&fit.report, *noise);
        let known = background.and_then(|known| self.fit_before(image, known, start));
        let known_source = known.as_ref().and_then(told);
        if known_source == Some(Source::Photometric) {
            return known;
        }
        let alone = self.photometric.fit(image, None, noise_grey, start, &self.visible);
        let alone = alone.map(|fit| (fit, noise_grey));
        let is_believed = alone.as_ref().and_then(told) == Some(Source::Photometric);
        known.filter(|_| known_source.is_some() && !is_believed).or(alone)
    }

    /// The photometric line before a known background, and the noise of the picture that shows it.
    fn fit_before(
        &mut self,
        image: &GrayView<'_>,
        known: &KnownBackground<'_>,
        start: &Sketch,
    ) -> Option<(PhotometricFit, f64)> {
        let image = known.image().unwrap_or(image);
        let noise_grey = self.noise.estimate(image, start)?;
        let fit = self.photometric.fit(image, Some(known), noise_grey, start, &self.visible)?;
        Some((fit, noise_grey))
    }

    /// Decides which line counts.
    fn believed(
        &self,
        noise_grey: f64,
        start: &Sketch,
        bisector: Option<BisectorFit>,
        photometric: Option<(PhotometricFit, f64)>,
    ) -> Option<Refined> {
        let told =
            photometric.and_then(|(p, noise)| Some((p, self.options.tells(&p.report, noise)?)));
        let whole = Stretch { from_px: -start.half_length_px, to_px: start.half_length_px };
        let (source, sketch, covariance, stretch) = match (told, &bisector) {
            (Some((p, source)), _) => (source, start.moved(&p.line), p.covariance, p.stretch),
            (_, Some(b)) if self.options.believes_edges(&b.report) => {
                (Source::Bisector, b.sketch, b.covariance, whole)
            }
            _ => return None,
        };
        let at = sketch.anchor_px;
        // Offset at the anchor: d + at · ϑ.
        let move_to = Matrix2::new(1.0, at, 0.0, 1.0);
        let angle_rad = sketch.along.y.atan2(sketch.along.x);
        Some(Refined {
            axis: Axis::of_finger(sketch.place(at, 0.0), angle_rad, sketch.tip_px - at),
            covariance: move_to * covariance * move_to.transpose(),
            stretch: Stretch { from_px: stretch.from_px - at, to_px: stretch.to_px - at },
            half_width_px: sketch.half_width_at(at),
            taper: sketch.taper,
            source,
            noise_grey: photometric.map_or(noise_grey, |(_, noise)| noise),
            bisector: bisector.map(|b| b.report),
            photometric: photometric.map(|(p, _)| p.report),
        })
    }
}
