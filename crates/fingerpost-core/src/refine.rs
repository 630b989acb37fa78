//! The finger's axis as exactly as the image allows, with a covariance that can be believed.
//!
//! A tracker's contour is a template: it bends real fingers straight and shares what it knows
//! between finger and thumb. The [`Refiner`] looks at the two flanks of the finger alone. First it
//! finds their edges and takes the bisector; then it fits what the camera recorded near the flanks,
//! pixel by pixel, to a physical model of a blurred, shaded, slightly bent finger. Which of the two
//! lines counts, or neither, is decided by what the pixels say of the model ([`Source`]).

mod background;
mod bisector;
mod block;
mod blur;
mod gram;
mod noise;
mod photometric;
mod pixels;
mod profile;
mod sketch;
mod unknowns;

pub use background::KnownBackground;

use crate::appearance::Appearance;
use crate::frame::Frame;
use crate::search::{Cue, Polarity};
use crate::shape_space::Axis;
use crate::{Error, Result};
use bisector::{Bisector, BisectorFit};
use nalgebra::Matrix2;
use noise::NoiseEstimator;
use photometric::{Photometric, PhotometricFit};
use sketch::Sketch;

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
    /// and of the left one. What a thumb or another finger covers is left out of them.
    pub flanks: [Stretch; 2],
    /// The middle of the finger's round end, in px along the axis from its anchor; `None` if the
    /// end is not to be seen.
    pub round_end_px: Option<f64>,
}

/// How the bisector of the flanks' edges is found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BisectorOptions {
    /// Scale of the derivative of Gaussian that finds the edges \[px\], 0.5–8.
    pub scale_px: f64,
    /// How far from the flanks edges are looked for \[px\], 1–128, but not beyond the axis.
    pub half_length_px: f64,
    /// The least contrast that counts as an edge \[grey levels\], 0–255.
    pub min_contrast_grey: f64,
    /// Edges within this of a common straight line agree \[px\], positive.
    pub consensus_px: f64,
    /// Tukey's cutoff \[robust standard deviations\], above 1.
    pub cutoff: f64,
    /// Fewer edges than this on either flank are no flank, at least 6.
    pub min_stations: usize,
    /// At most this many searches, 1–20.
    pub max_passes: usize,
    /// Edges a pixel apart share pixels and are interpolated alike: the covariance of independent
    /// ones is multiplied by this, at least 1.
    pub correlation: f64,
}

/// How the photometric line is found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PhotometricOptions {
    /// Pixels so far inside the edge are fitted \[px\], 2–20.
    pub inner_px: f64,
    /// Pixels so far outside the edge are fitted \[px\], 1–20.
    pub outer_px: f64,
    /// How much of the round end is fitted, from its middle, in parts of its radius, 0–0.9.
    pub cap: f64,
    /// Length of a block \[px\], 1–20.
    pub block_px: f64,
    /// Fewer blocks than this on either flank are no flank, at least 3.
    pub min_blocks: usize,
    /// Tukey's cutoff \[standard deviations of a pixel\], above 1.
    pub cutoff: f64,
    /// The blur that is expected, to within 1 px: standard deviation \[px\], 0.3–8.
    pub blur_px: f64,
    /// Standard deviation of the bend and of the bulge of fingers \[px\], positive.
    pub bend_px: f64,
    /// Standard deviation of the change of brightness between the middle of the stretch and its
    /// end, in parts of the contrast, positive.
    pub change: f64,
    /// Standard deviation of what light from the side adds to the brightness in the middle of the
    /// finger, in parts of the contrast, positive.
    pub ramp: f64,
    /// Standard deviation of what light from the camera adds there, which falls off towards the
    /// limb as the root of the depth, in parts of the contrast, positive.
    pub limb: f64,
    /// The line has settled when an iteration moves it less than this \[px\], positive.
    pub tolerance_px: f64,
    /// At most this many iterations, 1–100.
    pub max_iterations: usize,
    /// How far background that changes from block to block may shift the edge unseen, for a change
    /// as large as the contrast \[px\], 0–5.
    pub restlessness_px: f64,
}

/// Options of a [`Refiner`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RefineOptions {
    /// The bisector.
    pub bisector: BisectorOptions,
    /// The photometric line.
    pub photometric: PhotometricOptions,
    /// The photometric line counts if its residuals are at most this many times the image's noise.
    pub max_residual: f64,
    /// And if at most this part of its pixels was rejected.
    pub max_rejected: f64,
}

impl Default for RefineOptions {
    fn default() -> Self {
        Self {
            bisector: BisectorOptions {
                scale_px: 1.8,
                half_length_px: 6.0,
                min_contrast_grey: 8.0,
                consensus_px: 1.0,
                cutoff: 4.685,
                min_stations: 10,
                max_passes: 4,
                correlation: 1.5,
            },
            photometric: PhotometricOptions {
                inner_px: 5.0,
                outer_px: 2.0,
                cap: 0.5,
                block_px: 3.0,
                min_blocks: 4,
                cutoff: 6.0,
                blur_px: 1.1,
                bend_px: 0.5,
                change: 0.3,
                ramp: 1.0,
                limb: 0.3,
                tolerance_px: 5e-4,
                max_iterations: 15,
                restlessness_px: 1.25,
            },
            max_residual: 4.0,
            max_rejected: 0.1,
        }
    }
}

/// Where a refined line comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Source {
    /// The pixels agree with the model of a finger: the line of maximum likelihood.
    Photometric,
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
    /// How much the medial line is bent: half its sagitta, about \[px\].
    pub bend_px: f64,
    /// Contrast at either flank, finger minus background \[grey levels\].
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
    noise: NoiseEstimator,
}

impl Refiner {
    /// A refiner with the given options.
    ///
    /// # Errors
    /// When an option is not finite or outside its documented range.
    pub fn new(options: RefineOptions) -> Result<Self> {
        Ok(Self {
            bisector: Bisector::new(options.bisector)?,
            photometric: Photometric::new(options.photometric),
            noise: NoiseEstimator::new(),
            options,
        })
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
    /// `background` what is behind it. The result depends on the arguments alone.
    ///
    /// # Errors
    /// When a number of the finger is not finite, its half-width is not positive, or the background
    /// is not of the frame's size.
    pub fn refine(
        &mut self,
        frame: &Frame<'_>,
        finger: &Finger,
        polarity: Polarity,
        appearance: Option<&Appearance>,
        background: Option<&KnownBackground<'_>>,
    ) -> Result<Option<Refined>> {
        let image = frame.image();
        if let Some(known) = background {
            let (gray, behind) = ((image.width(), image.height()), (known.width(), known.height()));
            if gray != behind {
                return Err(Error::BackgroundSize { gray, background: behind });
            }
        }
        let Some(sketch) = Sketch::of(finger)? else { return Ok(None) };
        let Some(noise_grey) = self.noise.estimate(image, &sketch) else { return Ok(None) };
        let cue = appearance.map_or(Cue::Edges, Cue::HandEdges);
        let bisector = self.bisector.fit(frame, cue, polarity, noise_grey, &sketch)?;
        let start = bisector.map_or(sketch, |b| b.sketch);
        let photometric = self.photometric.fit(image, background, noise_grey, &start);
        Ok(self.believed(noise_grey, &start, bisector, photometric))
    }

    /// Decides which line counts.
    fn believed(
        &self,
        noise_grey: f64,
        start: &Sketch,
        bisector: Option<BisectorFit>,
        photometric: Option<PhotometricFit>,
    ) -> Option<Refined> {
        let believed = |p: &PhotometricFit| {
            let report = &p.report;
            report.converged
                && report.residual_grey <= self.options.max_residual * noise_grey
                && report.rejected <= self.options.max_rejected
        };
        let (source, sketch, covariance) = match (&photometric, &bisector) {
            (Some(p), _) if believed(p) => {
                (Source::Photometric, start.moved(&p.line), p.covariance)
            }
            (_, Some(b)) => (Source::Bisector, b.sketch, b.covariance),
            _ => return None,
        };
        let at = sketch.anchor_px;
        // Offset at the anchor: d + at · ϑ.
        let move_to = Matrix2::new(1.0, at, 0.0, 1.0);
        let angle_rad = sketch.along.y.atan2(sketch.along.x);
        Some(Refined {
            axis: Axis::of_finger(sketch.place(at, 0.0), angle_rad, sketch.tip_px - at),
            covariance: move_to * covariance * move_to.transpose(),
            half_width_px: sketch.half_width_at(at),
            taper: sketch.taper,
            source,
            noise_grey,
            bisector: bisector.map(|b| b.report),
            photometric: photometric.map(|p| p.report),
        })
    }
}
