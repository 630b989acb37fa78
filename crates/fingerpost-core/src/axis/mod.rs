//! Refinement of the finger's axis from its two flanks, with a covariance.
//!
//! The tracker's contour shares a shape vector between finger and thumb and measures edges one by
//! one. A [`Refiner`] uses the two flanks of the finger alone, in two stages:
//!
//! 1. Edges are measured across the flanks and their bisector is fitted. The bisector is the
//!    projection of the axis of a surface of revolution for any taper and perspective.
//! 2. From there a model of a blurred, shaded, slightly bent finger with a round end, before a
//!    known or unknown background, is fitted to the pixels near the flanks by maximum likelihood.
//!    On a clean image its angle reaches the Cramér–Rao bound of two free flanks.
//!
//! The photometric line is accepted if the pixels agree with the model and the flanks contrast with
//! the background. If the agreement is weaker, the line is returned as unsure, to be weighed
//! against other evidence. Otherwise the bisector is accepted if its edges lie on two straight
//! lines; otherwise no line is returned ([`Source`], [`RefineOptions`]).
//!
//! ```
//! use fingerpost_core::nalgebra::{Point2, Vector2};
//! use fingerpost_core::axis::{Finger, RefineOptions, Refiner, Source, Stretch};
//! use fingerpost_core::{Axis, Frame, GrayView, Polarity};
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
//! // The tracker's estimate, half a pixel and half a degree off.
//! let axis = Axis::of_finger(end - e * 30.0 + Vector2::new(0.0, 0.5), angle_rad + 0.009, 37.0);
//! let stretch = Stretch { from_px: -20.0, to_px: 34.0 };
//! let finger = Finger {
//!     axis,
//!     half_width_px: 7.3,
//!     taper: 0.0,
//!     flanks: [stretch; 2],
//!     round_end_px: Some(30.0),
//!     prior: None,
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
mod finger_estimate;
mod gram;
mod noise;
mod options;
mod photometric;
mod pixels;
mod profile;
mod round;
mod shading;
mod straightness;
mod texture;
mod unknowns;
mod visible_flanks;

pub use background::KnownBackground;
pub use options::{BisectorOptions, PhotometricOptions, RefineOptions};
pub use round::RoundFinger;
pub use straightness::Bend;
#[cfg(test)]
pub(crate) use texture::tests::RenderedFinger;
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
use finger_estimate::FingerEstimate;
use nalgebra::Matrix2;
use noise::NoiseEstimator;
use photometric::{Photometric, PhotometricFit};
use straightness::Straightness;
use visible_flanks::VisibleFlanks;

/// Upper bound on the length of a stretch \[px\]. Images searched for edges have sides of up to
/// 32767 px, so no longer stretch fits in one.
pub const MAX_STRETCH_PX: f64 = 65_536.0;

/// A stretch of a flank, in px along the axis from its anchor; empty unless `to_px > from_px`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Stretch {
    /// Start \[px\].
    pub from_px: f64,
    /// End, nearer to the tip \[px\].
    pub to_px: f64,
}

impl Stretch {
    /// Length \[px\]; not positive if the stretch is empty.
    #[must_use]
    pub fn length_px(&self) -> f64 {
        self.to_px - self.from_px
    }

    /// Midpoint \[px\].
    pub(crate) fn middle_px(&self) -> f64 {
        0.5 * (self.from_px + self.to_px)
    }

    /// The stretch of the given half-length about a midpoint \[px\].
    pub(crate) fn about(middle_px: f64, half_length_px: f64) -> Self {
        Self { from_px: middle_px - half_length_px, to_px: middle_px + half_length_px }
    }

    /// The stretch over which the least-squares line through a parabola meets the parabola at
    /// `middle_px` ± √`cut_px2`. The crossings of a stretch of half-length L are at ± L / √3 from
    /// its middle. Without a crossing (`cut_px2` ≤ 0) L is 1 px.
    pub(crate) fn cut(middle_px: f64, cut_px2: f64) -> Self {
        const SHORTEST_PX: f64 = 1.0;
        Self::about(middle_px, (3.0 * cut_px2.max(0.0)).sqrt().max(SHORTEST_PX))
    }

    /// The same stretch relative to an anchor `anchor_px` farther along the axis.
    pub(crate) fn beside(&self, anchor_px: f64) -> Self {
        Self { from_px: self.from_px - anchor_px, to_px: self.to_px - anchor_px }
    }

    /// The same stretch in another unit; `px` of it equal one present unit.
    pub(crate) fn scaled(&self, px: f64) -> Self {
        Self { from_px: px * self.from_px, to_px: px * self.to_px }
    }
}

/// Prior estimate of a finger from the tracker, correct to within a few px.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Finger {
    /// The axis.
    pub axis: Axis,
    /// Half-width at the anchor of the axis \[px\], positive.
    pub half_width_px: f64,
    /// Growth of the half-width per px towards the tip.
    pub taper: f64,
    /// Stretches to search on the right flank (at +90°, in the direction (−sin θ, cos θ)) and on
    /// the left one, together at most [`MAX_STRETCH_PX`] long. They exclude the parts covered by a
    /// thumb or another finger.
    pub flanks: [Stretch; 2],
    /// Centre of the finger's round end, in px along the axis from its anchor; `None` if the end is
    /// not visible.
    pub round_end_px: Option<f64>,
    /// Prior knowledge of a finger that may be partly covered. Places along the flanks whose pixels
    /// do not have the colours of the hand inside and of the background outside are then left out.
    /// `None` if nothing covers the finger.
    pub prior: Option<WidthPrior>,
}

impl Finger {
    /// The hull of both stretches along the axis \[px\]; empty if both are.
    pub(crate) fn stretch(&self) -> Stretch {
        let non_empty = self.flanks.iter().filter(|s| s.length_px() > 0.0);
        let empty = Stretch { from_px: f64::INFINITY, to_px: f64::NEG_INFINITY };
        non_empty.fold(empty, |all, s| Stretch {
            from_px: all.from_px.min(s.from_px),
            to_px: all.to_px.max(s.to_px),
        })
    }
}

/// Prior of a partly covered finger: its width when it was last fully visible, and the uncertainty
/// of its axis. Without it the few visible edges would fit a line turned by a quarter of a radian
/// as well.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WidthPrior {
    /// Half-width at the anchor of the axis \[px\], positive.
    pub half_width_px: f64,
    /// Growth of the half-width per px towards the tip.
    pub taper: f64,
    /// Standard deviation of the half-width \[px\], positive.
    pub half_width_sigma_px: f64,
    /// Standard deviation of the taper, positive.
    pub taper_sigma: f64,
    /// Standard deviations of the axis: of its offset at the anchor \[px\] and of its angle
    /// \[rad\], positive.
    pub axis_sigmas: [f64; 2],
}

/// Origin of a refined line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Source {
    /// The pixels agree with the finger model: the maximum-likelihood line.
    Photometric,
    /// The pixels agree with the model, but not well enough to accept the line alone.
    Unsure,
    /// The pixels disagree, but the edges of the flanks lie on two straight lines: their bisector.
    Bisector,
}

/// Statistics of the bisector fit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BisectorReport {
    /// Edges used, on both flanks.
    pub edges: usize,
    /// Fraction of the edges with zero weight.
    pub rejected: f64,
    /// Robust standard deviation of the edges about the flanks \[px\].
    pub residual_px: f64,
}

/// Statistics of the photometric fit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PhotometricReport {
    /// Pixels fitted.
    pub pixels: usize,
    /// Blocks that contain them.
    pub blocks: usize,
    /// Mean weight of the blocks, 0–1; blocks with unexplained structure weigh less.
    pub trusted: f64,
    /// Fraction of the pixels with zero weight.
    pub rejected: f64,
    /// Standard deviation of the pixels about the model \[grey levels\].
    pub residual_grey: f64,
    /// Standard deviation of the blur \[px\].
    pub blur_px: f64,
    /// Half the length of finger in use \[px\].
    pub half_length_px: f64,
    /// Bend of the medial line over that length: the coefficient of P₂, two thirds of the height of
    /// the arc above its chord \[px\].
    pub bend_px: f64,
    /// Standard deviation of the bend \[px\].
    pub bend_sigma_px: f64,
    /// Contrast at either flank, finger minus background, 2 px inside the edge, where even a finger
    /// with a dark limb has contrast \[grey levels\].
    pub contrast_grey: [f64; 2],
    /// Standard deviation of the edge of either flank about its smooth line \[px\].
    pub edge_px: [f64; 2],
    /// Iterations until convergence, at most the number allowed.
    pub iterations: usize,
    /// Whether the fit converged.
    pub converged: bool,
}

/// A refined finger.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Refined {
    /// The axis. Its anchor has the abscissa of the given anchor, and its tip the same distance
    /// from it.
    pub axis: Axis,
    /// Covariance of the line's offset at the anchor \[px\] and of its angle \[rad\].
    pub covariance: Matrix2<f64>,
    /// The stretch that the line represents: on a slightly bent finger it equals the least-squares
    /// line through the medial line of this stretch.
    pub stretch: Stretch,
    /// Half-width at the anchor \[px\].
    pub half_width_px: f64,
    /// Growth of the half-width per px towards the tip.
    pub taper: f64,
    /// Which of the two lines this is.
    pub source: Source,
    /// Standard deviation of the image noise near the finger \[grey levels\].
    pub noise_grey: f64,
    /// Statistics of the bisector fit, if it succeeded.
    pub bisector: Option<BisectorReport>,
    /// Statistics of the photometric fit, if it succeeded.
    pub photometric: Option<PhotometricReport>,
}

/// Refines axes. It owns its buffers, so nothing is allocated once they have grown.
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

    /// The same refiner for another instruction set; its lines are bit-identical.
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

    /// The axis of the finger near the estimate `finger`. `None` when neither line is accepted,
    /// because the flanks are not visible or do not bound a finger.
    ///
    /// `polarity` is the brighter side of the flanks, `appearance` the colour model of the hand,
    /// and `background` the learned background, which is ignored where the pixels contradict it.
    /// The result depends on the arguments alone.
    ///
    /// # Errors
    /// When a number of the finger is not finite, its half-width is not positive, its stretches are
    /// together longer than [`MAX_STRETCH_PX`], or the background or the image it belongs to
    /// differs from the frame in size.
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
        let Some(estimate) = FingerEstimate::of(finger)? else { return Ok(None) };
        let Some(noise_grey) = self.noise.estimate(image, &estimate) else { return Ok(None) };
        let cue = appearance.map_or(Cue::Edges, Cue::HandEdges);
        self.visible.measure(frame, appearance, &estimate);
        let bisector =
            self.bisector.fit(frame, cue, polarity, noise_grey, &estimate, &self.visible)?;
        let start = bisector.map_or(estimate, |b| b.estimate);
        let photometric = self.fit_pixels(image, background, noise_grey, &start);
        Ok(self.select_line(noise_grey, &start, bisector, photometric))
    }

    /// The bend of the finger near the estimate `finger`; `None` when its flanks do not determine
    /// it. The arguments are those of [`refine`](Self::refine).
    ///
    /// # Errors
    /// When a number of the finger is not finite, its half-width is not positive, or one of the
    /// halves is longer than [`MAX_STRETCH_PX`].
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

    /// The photometric line in use, and the noise of the image it was fitted to. The first of these
    /// is returned: the fit with the known background, if it is accepted alone; the fit with an
    /// unknown background, if that is accepted alone, because the learned background may be out of
    /// date; the fit with the known background, if it is unsure; the fit with an unknown
    /// background.
    fn fit_pixels(
        &mut self,
        image: &GrayView<'_>,
        background: Option<&KnownBackground<'_>>,
        noise_grey: f64,
        start: &FingerEstimate,
    ) -> Option<(PhotometricFit, f64)> {
        let options = self.options;
        let source_of_fit =
            |(fit, noise): &(PhotometricFit, f64)| options.source_of(&fit.report, *noise);
        let known = background.and_then(|known| self.fit_before(image, known, start));
        let known_source = known.as_ref().and_then(source_of_fit);
        if known_source == Some(Source::Photometric) {
            return known;
        }
        let without_background =
            self.photometric.fit(image, None, noise_grey, start, &self.visible);
        let without_background = without_background.map(|fit| (fit, noise_grey));
        let is_accepted =
            without_background.as_ref().and_then(source_of_fit) == Some(Source::Photometric);
        known.filter(|_| known_source.is_some() && !is_accepted).or(without_background)
    }

    /// The photometric line with a known background, and the noise of the image it was fitted to.
    fn fit_before(
        &mut self,
        image: &GrayView<'_>,
        known: &KnownBackground<'_>,
        start: &FingerEstimate,
    ) -> Option<(PhotometricFit, f64)> {
        let image = known.image().unwrap_or(image);
        let noise_grey = self.noise.estimate(image, start)?;
        let fit = self.photometric.fit(image, Some(known), noise_grey, start, &self.visible)?;
        Some((fit, noise_grey))
    }

    /// Selects the line to return.
    fn select_line(
        &self,
        noise_grey: f64,
        start: &FingerEstimate,
        bisector: Option<BisectorFit>,
        photometric: Option<(PhotometricFit, f64)>,
    ) -> Option<Refined> {
        let source_of_fit =
            photometric.and_then(|(p, noise)| Some((p, self.options.source_of(&p.report, noise)?)));
        let whole = Stretch { from_px: -start.half_length_px, to_px: start.half_length_px };
        let (source, estimate, covariance, stretch) = match (source_of_fit, &bisector) {
            (Some((p, source)), _) => (source, start.moved(&p.line), p.covariance, p.stretch),
            (_, Some(b)) if self.options.accepts_bisector(&b.report) => {
                (Source::Bisector, b.estimate, b.covariance, whole)
            }
            _ => return None,
        };
        let at = estimate.anchor_px;
        // Offset at the anchor: d + at · ϑ.
        let move_to = Matrix2::new(1.0, at, 0.0, 1.0);
        let angle_rad = estimate.along.y.atan2(estimate.along.x);
        Some(Refined {
            axis: Axis::of_finger(estimate.place(at, 0.0), angle_rad, estimate.tip_px - at),
            covariance: move_to * covariance * move_to.transpose(),
            stretch: Stretch { from_px: stretch.from_px - at, to_px: stretch.to_px - at },
            half_width_px: estimate.half_width_at(at),
            taper: estimate.taper,
            source,
            noise_grey: photometric.map_or(noise_grey, |(_, noise)| noise),
            bisector: bisector.map(|b| b.report),
            photometric: photometric.map(|(p, _)| p.report),
        })
    }
}
