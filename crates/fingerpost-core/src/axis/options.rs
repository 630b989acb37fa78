//! Options of a refiner, their defaults and ranges.

use crate::axis::{BisectorReport, PhotometricReport, Source};
use crate::{Error, Result};

/// Options of the bisector fit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BisectorOptions {
    /// Scale of the derivative of Gaussian of the edge search \[px\], 0.5–8.
    pub scale_px: f64,
    /// Half-length of the searches across the flanks \[px\], 1–128; they end at the axis at the
    /// latest.
    pub half_length_px: f64,
    /// Minimum contrast of an edge \[grey levels\], 0–255.
    pub min_contrast_grey: f64,
    /// Scale of the truncated residual in the consensus \[px\], positive; edges within twice this
    /// remain.
    pub consensus_px: f64,
    /// Tukey's cutoff \[robust standard deviations\], above 1.
    pub cutoff: f64,
    /// Minimum number of edges on either flank, at least 6.
    pub min_edges: usize,
    /// Maximum number of searches, 1–20.
    pub max_passes: usize,
    /// Factor on the covariance of independent edges, at least 1: neighbouring edges share pixels
    /// and interpolation errors.
    pub correlation: f64,
}

/// Options of the photometric fit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PhotometricOptions {
    /// Depth of the fitted strip inside the edge \[px\], 2–20.
    pub inner_px: f64,
    /// Width of the fitted strip outside the edge \[px\], 1–20. Farther out the background is more
    /// likely to differ from that at the edge.
    pub outer_px: f64,
    /// The same before a known background, which has no such error \[px\], 1–20.
    pub known_outer_px: f64,
    /// Extent of the fitted part of the round end, from its centre, in radii, 0–0.9.
    pub cap: f64,
    /// Length of a block \[px\], 1–20.
    pub block_px: f64,
    /// Minimum number of blocks on either flank, at least 3.
    pub min_blocks: usize,
    /// Tukey's cutoff \[standard deviations of a pixel\], above 1.
    pub cutoff: f64,
    /// Prior mean of the blur's standard deviation \[px\], 0.3–8; the prior's own standard
    /// deviation is 1 px.
    pub blur_px: f64,
    /// Prior standard deviation of the bend and of the bulge of fingers \[px\], positive.
    pub bend_px: f64,
    /// Prior standard deviation of the change of level between the middle of the stretch and its
    /// end, as a fraction of the contrast, positive.
    pub change: f64,
    /// Prior standard deviation of the level that light from the side adds in the middle of the
    /// finger, as a fraction of the contrast, positive.
    pub ramp: f64,
    /// Prior standard deviation of the level that light from the camera adds there, which falls off
    /// towards the limb as the root of the depth, as a fraction of the contrast, positive.
    pub limb: f64,
    /// The fit has converged when an iteration moves the flanks by less than this \[px\], positive,
    /// or when the step is negligible in units of its covariance.
    pub tolerance_px: f64,
    /// Maximum number of iterations, 1–100.
    pub max_iterations: usize,
    /// Undetected shift of the edge by a change of the background's level from block to block, or
    /// by a deviation of the finger's level, if the change equals the contrast \[px\], 0–5.
    pub restlessness_px: f64,
}

/// Options of the refinement of a finger's axis from its flanks.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RefineOptions {
    /// The bisector.
    pub bisector: BisectorOptions,
    /// The photometric line.
    pub photometric: PhotometricOptions,
    /// Acceptance of the photometric line: maximum standard deviation of its pixels, in units of
    /// the image noise, at least 1. Skin, compression and deviations from the model all contribute:
    /// sharp still images of real fingers have 4–8.
    pub max_residual: f64,
    /// Acceptance of the photometric line: maximum fraction of rejected pixels, 0–1.
    pub max_rejected: f64,
    /// Acceptance of the photometric line: minimum mean weight of the blocks, 0–1.
    pub min_trusted: f64,
    /// Acceptance of the photometric line: maximum standard deviation of either flank's edge from
    /// block to block \[px\], positive. Real fingers have 0.0–0.1, other edges 0.1–0.4.
    pub max_edge_px: f64,
    /// Acceptance of the photometric line: minimum contrast of both flanks, in standard deviations
    /// of their pixels, positive.
    pub min_contrast: f64,
    /// A photometric line that fails for the scatter of its pixels or edges, or for its contrast,
    /// is unsure if the edge of neither flank scatters by more than this \[px\], positive,
    pub max_unsure_edge_px: f64,
    /// and if both flanks have at least this contrast, in standard deviations of their pixels,
    /// positive: a flank without contrast has no position.
    pub min_unsure_contrast: f64,
    /// The bisector is accepted if its edges scatter by at most this about the flanks \[px\],
    /// positive,
    pub max_edge_residual_px: f64,
    /// and if at most this fraction of them is rejected, 0–1.
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
    /// Checks that every option is finite and in its range.
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
    /// Whether the photometric line is accepted alone.
    pub(super) fn accepts_photometric(&self, report: &PhotometricReport, noise_grey: f64) -> bool {
        let scatter = report.residual_grey;
        report.converged
            && scatter <= self.max_residual * noise_grey
            && report.rejected <= self.max_rejected
            && report.trusted >= self.min_trusted
            && report.edge_px.iter().all(|edge| *edge <= self.max_edge_px)
            && contrasts(report, self.min_contrast)
    }

    /// The rating of a photometric line: accepted alone, unsure, or rejected (`None`).
    pub(super) fn source_of(&self, report: &PhotometricReport, noise_grey: f64) -> Option<Source> {
        if self.accepts_photometric(report, noise_grey) {
            return Some(Source::Photometric);
        }
        let is_unsure = report.converged
            && report.rejected <= self.max_rejected
            && report.trusted >= self.min_trusted
            && report.edge_px.iter().all(|edge| *edge <= self.max_unsure_edge_px)
            && contrasts(report, self.min_unsure_contrast);
        is_unsure.then_some(Source::Unsure)
    }

    /// Whether the bisector is accepted.
    pub(super) fn accepts_bisector(&self, report: &BisectorReport) -> bool {
        report.residual_px <= self.max_edge_residual_px
            && report.rejected <= self.max_edges_rejected
    }
}

/// Whether both flanks have at least this contrast, in standard deviations of their pixels.
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
