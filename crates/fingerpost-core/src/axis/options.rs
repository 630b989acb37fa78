//! Options of a refiner, their defaults and ranges.

use crate::axis::{BisectorReport, PhotometricReport, Source};
use crate::{Error, Result};

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
    pub min_edges: usize,
    /// At most this many searches, 1–20.
    pub max_passes: usize,
    /// Neighbouring edges share pixels and are interpolated alike: the covariance of independent ones
    /// is multiplied by this, at least 1.
    pub correlation: f64,
}

/// How the photometric line is found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PhotometricOptions {
    /// Pixels so far inside the edge are fitted \[px\], 2–20.
    pub inner_px: f64,
    /// Pixels so far outside the edge are fitted \[px\], 1–20: the farther, the likelier is something
    /// else behind them than next to the edge.
    pub outer_px: f64,
    /// The same before a known background, of which nothing misleads \[px\], 1–20.
    pub known_outer_px: f64,
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
    /// The line has settled when an iteration moves it less than this \[px\], positive, or by next to
    /// nothing in units of what it is uncertain by.
    pub tolerance_px: f64,
    /// At most this many iterations, 1–100.
    pub max_iterations: usize,
    /// How far background that changes from block to block, or a finger that has another level
    /// there, may shift the edge unseen, for a change as large as the contrast \[px\], 0–5.
    pub restlessness_px: f64,
}

/// Options of a [`Refiner`](super::Refiner).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RefineOptions {
    /// The bisector.
    pub bisector: BisectorOptions,
    /// The photometric line.
    pub photometric: PhotometricOptions,
    /// The photometric line counts if its pixels scatter by at most this many times the image's
    /// noise, at least 1. Skin, compression and what the model leaves out all scatter: sharp still
    /// pictures of real fingers have 4–8.
    pub max_residual: f64,
    /// And if at most this part of its pixels is rejected, 0–1.
    pub max_rejected: f64,
    /// And if its blocks count this much on average, 0–1.
    pub min_trusted: f64,
    /// And if the edge of neither flank scatters by more than this from block to block \[px\],
    /// positive: real fingers have 0.0–0.1, flanks that are none 0.1–0.4.
    pub max_edge_px: f64,
    /// And if the contrast of both flanks is at least this many times their pixels' scatter,
    /// positive.
    pub min_contrast: f64,
    /// A photometric line that does not count for what its pixels or edges scatter, or for its
    /// contrast, is unsure if the edge of neither flank scatters by more than this \[px\], positive,
    pub max_unsure_edge_px: f64,
    /// and if the contrast of both flanks is at least this many times their pixels' scatter,
    /// positive: a flank of no contrast may be anywhere.
    pub min_unsure_contrast: f64,
    /// The bisector counts if its edges scatter by at most this about the flanks \[px\], positive,
    pub max_edge_residual_px: f64,
    /// and if at most this part of them is rejected, 0–1.
    pub max_edges_rejected: f64,
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
                min_edges: 8,
                max_passes: 3,
                correlation: 1.2,
            },
            photometric: PhotometricOptions {
                inner_px: 5.0,
                outer_px: 2.0,
                known_outer_px: 2.5,
                cap: 0.5,
                block_px: 3.0,
                min_blocks: 4,
                cutoff: 6.0,
                blur_px: 1.1,
                bend_px: 0.5,
                change: 0.3,
                ramp: 1.0,
                limb: 0.3,
                tolerance_px: 2e-3,
                max_iterations: 25,
                restlessness_px: 1.0,
            },
            max_residual: 8.0,
            max_rejected: 0.1,
            min_trusted: 0.6,
            max_edge_px: 0.15,
            min_contrast: 10.0,
            max_unsure_edge_px: 1.0,
            min_unsure_contrast: 1.0,
            max_edge_residual_px: 0.25,
            max_edges_rejected: 0.2,
        }
    }
}

impl RefineOptions {
    /// Whether every option is finite and in its range.
    pub(super) fn check(&self) -> Result<()> {
        self.bisector.check()?;
        self.photometric.check()?;
        at_least("largest residual [noise]", self.max_residual, 1.0, "at least 1")?;
        within("largest rejected part", self.max_rejected, 0.0, 1.0, "0 to 1")?;
        within("least trusted part", self.min_trusted, 0.0, 1.0, "0 to 1")?;
        positive("largest scatter of a flank's edge [px]", self.max_edge_px)?;
        positive("least contrast [scatter]", self.min_contrast)?;
        positive("largest scatter of an unsure flank's edge [px]", self.max_unsure_edge_px)?;
        positive("least contrast of an unsure flank [scatter]", self.min_unsure_contrast)?;
        positive("largest scatter of the edges [px]", self.max_edge_residual_px)?;
        within("largest part of the edges rejected", self.max_edges_rejected, 0.0, 1.0, "0 to 1")
    }
}

impl RefineOptions {
    /// Whether the photometric line is that of a finger.
    pub(super) fn believes_pixels(&self, report: &PhotometricReport, noise_grey: f64) -> bool {
        let scatter = report.residual_grey;
        report.converged
            && scatter <= self.max_residual * noise_grey
            && report.rejected <= self.max_rejected
            && report.trusted >= self.min_trusted
            && report.edge_px.iter().all(|edge| *edge <= self.max_edge_px)
            && contrasts(report, self.min_contrast)
    }

    /// What a photometric line is worth, if anything.
    pub(super) fn tells(&self, report: &PhotometricReport, noise_grey: f64) -> Option<Source> {
        if self.believes_pixels(report, noise_grey) {
            return Some(Source::Photometric);
        }
        let is_unsure = report.converged
            && report.rejected <= self.max_rejected
            && report.trusted >= self.min_trusted
            && report.edge_px.iter().all(|edge| *edge <= self.max_unsure_edge_px)
            && contrasts(report, self.min_unsure_contrast);
        is_unsure.then_some(Source::Unsure)
    }

    /// Whether the edges are those of two straight flanks.
    pub(super) fn believes_edges(&self, report: &BisectorReport) -> bool {
        report.residual_px <= self.max_edge_residual_px
            && report.rejected <= self.max_edges_rejected
    }
}

/// Whether both flanks contrast by so many times what their pixels scatter.
fn contrasts(report: &PhotometricReport, least: f64) -> bool {
    report.contrast_grey.iter().all(|c| c.abs() >= least * report.residual_grey)
}

impl BisectorOptions {
    fn check(&self) -> Result<()> {
        within("bisector's scale [px]", self.scale_px, 0.5, 8.0, "0.5 to 8")?;
        within("bisector's half-length [px]", self.half_length_px, 1.0, 128.0, "1 to 128")?;
        within(
            "bisector's contrast [grey levels]",
            self.min_contrast_grey,
            0.0,
            255.0,
            "0 to 255",
        )?;
        positive("bisector's consensus [px]", self.consensus_px)?;
        Error::within("bisector's Tukey cutoff", self.cutoff, "above 1", |c| c > 1.0)?;
        at_least("bisector's least edges", self.min_edges as f64, 6.0, "at least 6")?;
        within("bisector's passes", self.max_passes as f64, 1.0, 20.0, "1 to 20")?;
        at_least("bisector's correlation", self.correlation, 1.0, "at least 1")
    }
}

impl PhotometricOptions {
    fn check(&self) -> Result<()> {
        within("inner strip [px]", self.inner_px, 2.0, 20.0, "2 to 20")?;
        within("outer strip [px]", self.outer_px, 1.0, 20.0, "1 to 20")?;
        within("known outer strip [px]", self.known_outer_px, 1.0, 20.0, "1 to 20")?;
        within("part of the round end", self.cap, 0.0, 0.9, "0 to 0.9")?;
        within("length of a block [px]", self.block_px, 1.0, 20.0, "1 to 20")?;
        at_least("least blocks of a flank", self.min_blocks as f64, 3.0, "at least 3")?;
        Error::within("photometric Tukey cutoff", self.cutoff, "above 1", |c| c > 1.0)?;
        within("expected blur [px]", self.blur_px, 0.3, 8.0, "0.3 to 8")?;
        positive("bend of fingers [px]", self.bend_px)?;
        positive("change of brightness", self.change)?;
        positive("slope of shading", self.ramp)?;
        positive("limb of shading", self.limb)?;
        within("restlessness [px]", self.restlessness_px, 0.0, 5.0, "0 to 5")?;
        positive("tolerance [px]", self.tolerance_px)?;
        within("most iterations", self.max_iterations as f64, 1.0, 100.0, "1 to 100")
    }
}

fn within(
    what: &'static str,
    value: f64,
    least: f64,
    most: f64,
    right: &'static str,
) -> Result<()> {
    Error::within(what, value, right, |v| (least..=most).contains(&v)).map(|_| ())
}

fn at_least(what: &'static str, value: f64, least: f64, right: &'static str) -> Result<()> {
    Error::within(what, value, right, |v| v >= least).map(|_| ())
}

fn positive(what: &'static str, value: f64) -> Result<()> {
    Error::within(what, value, "positive", |v| v > 0.0).map(|_| ())
}
