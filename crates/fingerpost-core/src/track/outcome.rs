//! The result of one frame.

use super::estimate::ShapeEstimate;
use super::fit_result::{FitResult, Refusal};
use super::line::FingerLine;
use super::options::AcceptOptions;
use super::stage::{EdgeCounts, max_residual_px};
use super::status::Status;
use crate::axis::Bend;

/// Diagnostics of one frame.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Diagnostics {
    /// Contour samples that no other limb hides.
    pub visible: usize,
    /// Visible samples on whose search line an edge was found.
    pub hits: usize,
    /// Edges that agree with the fit.
    pub inliers: usize,
    /// Fraction of the finger's visible samples (the contour's, for the paper's model) whose edges
    /// agree with the fit, 0–1. The thumb does not count, because it bends.
    pub agreement: f64,
    /// The smallest agreement with which the frame's fit would be accepted; above 1 if none would.
    pub min_agreement: f64,
    /// Root mean square of the residual offsets of the inliers \[px\].
    pub residual_rms_px: f64,
    /// The largest such residual with which the frame's fit would be accepted \[px\].
    pub max_residual_px: f64,
    /// Rank of the information matrix: directions of the shape space that the measurements
    /// determine.
    pub rank: usize,
    /// Iterations (searches along the normals) in the last shape space.
    pub iterations: usize,
    /// Whether the fit was determined and accepted.
    pub accepted: bool,
    /// Why the fit was refused; `None` if it was accepted.
    pub refusal: Option<Refusal>,
    /// Normalised square of the innovation of place and angle: 3 on average for a hand that moves
    /// as [`dynamics`](super::TrackOptions::dynamics) states. `None` without a prediction.
    pub innovation: Option<f64>,
    /// Bend of the finger in the image: direction of the half with the tip minus that of the half
    /// with the knuckle \[rad\]. `None` where the flanks do not determine it.
    pub bend_rad: Option<f64>,
}

/// The estimate of one frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Track {
    /// When the frame was captured \[s\].
    pub time_s: f64,
    /// State of the tracker after the frame.
    pub status: Status,
    /// The fitted shape, if the frame's fit was accepted.
    pub shape: Option<ShapeEstimate>,
    /// The finger line, if the hand is tracked and the frame's fit was accepted.
    pub finger_line: Option<FingerLine>,
    /// Diagnostics of the fit.
    pub diagnostics: Diagnostics,
}

impl Track {
    /// The same with the bend that the flanks gave.
    pub(super) fn bent(mut self, bend: Option<&Bend>) -> Self {
        self.diagnostics.bend_rad = bend.map(|b| b.angle_rad);
        self
    }
}

/// The result of one frame whose fit was validated by `accept`, without the finger line.
pub(super) fn track(
    time_s: f64,
    status: Status,
    found: &FitResult,
    accept: &AcceptOptions,
    refusal: Option<Refusal>,
) -> Track {
    let accepted = refusal.is_none();
    let counts = found.fit.map_or(EdgeCounts::default(), |f| f.counts);
    Track {
        time_s,
        status,
        shape: found.fit.filter(|_| accepted).map(|f| f.shape),
        finger_line: None,
        diagnostics: Diagnostics {
            hits: counts.hits,
            iterations: found.iterations,
            accepted,
            refusal,
            visible: counts.visible,
            inliers: counts.inliers,
            agreement: found.fit.map_or(0.0, |f| f.agreement),
            min_agreement: accept.min_inliers,
            max_residual_px: max_residual_px(accept, found.shape.width()),
            residual_rms_px: found.fit.map_or(0.0, |f| f.residual_rms_px),
            rank: found.fit.map_or(0, |f| f.rank),
            innovation: None,
            bend_rad: None,
        },
    }
}
