//! What a tracker tells of one frame.

use super::estimate::ShapeEstimate;
use super::fit_result::{FitResult, Refusal};
use super::line::FingerLine;
use super::options::AcceptOptions;
use super::stage::{EdgeCounts, max_residual_px};
use super::status::Status;
use crate::axis::Bend;

/// Why a frame went the way it did.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Diagnostics {
    /// Samples of the contour that no other limb hides.
    pub visible: usize,
    /// Those that found an edge.
    pub hits: usize,
    /// Edges that agree with the fit.
    pub inliers: usize,
    /// The part of the finger's visible samples (of the contour's, for the paper's model) whose
    /// edges agree with the fit, 0–1: a thumb, which bends, does not count.
    pub agreement: f64,
    /// The least agreement with which the frame's fit counted; above 1 where none would have done.
    pub min_agreement: f64,
    /// Root mean square of the residual offsets of those \[px\].
    pub residual_rms_px: f64,
    /// The largest with which the frame's fit counted \[px\].
    pub max_residual_px: f64,
    /// Directions of the shape space that the measurements determine.
    pub rank: usize,
    /// Searches along the normals in the last shape space.
    pub iterations: usize,
    /// Whether the fit was determined and accepted.
    pub accepted: bool,
    /// Why it was not.
    pub refusal: Option<Refusal>,
    /// How much place and angle of a fit surprise, as the square of the innovation in units of its
    /// covariance: 3 on average for a hand that moves as [`dynamics`](super::TrackOptions::dynamics) says. None
    /// where nothing foretold them.
    pub innovation: Option<f64>,
    /// How much the finger is bent, as the image shows it: the direction of the half with the tip
    /// minus that of the half with the knuckle \[rad\]. None where the flanks do not tell.
    pub bend_rad: Option<f64>,
}

/// What one frame told.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Track {
    /// When the frame was captured \[s\].
    pub time_s: f64,
    /// Where the tracker is after it.
    pub status: Status,
    /// The fitted shape, if the frame's fit was accepted.
    pub shape: Option<ShapeEstimate>,
    /// The finger line, if the hand is tracked and the frame's fit was accepted.
    pub finger_line: Option<FingerLine>,
    /// Why.
    pub diagnostics: Diagnostics,
}

impl Track {
    /// The same where the flanks have told this of the finger's bend.
    pub(super) fn bent(mut self, bend: Option<&Bend>) -> Self {
        self.diagnostics.bend_rad = bend.map(|b| b.angle_rad);
        self
    }
}

/// The story of one frame whose fit was judged by `accept`, but for the finger line.
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
