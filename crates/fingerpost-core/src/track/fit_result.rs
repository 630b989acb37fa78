//! The result of fitting one frame.

use super::appearance::EdgeCue;
use super::options::AcceptOptions;
use super::shape::Shape;
use super::stage::{Converged, Fit, max_residual_px};
use crate::geometry::planar::AffineMap;
use crate::geometry::ribbon::RIBBON_DOF;
/// Reason for refusing the fit of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Refusal {
    /// No fit was determined, or none that could be a finger.
    NoFit,
    /// It is much wider, slimmer or more tapered than the tracked hand.
    Size,
    /// Its motion is impossible for a hand.
    Motion,
    /// Too few edges agree with it.
    Agreement,
    /// The residual offsets of the agreeing edges are too large.
    Residual,
    /// It lies on a table that is known, or inside an object in front of that.
    Background,
    /// The finger is bent: no straight line is its axis.
    Misfit,
}

/// The fit of one frame.
pub(super) struct FitResult<T = Shape> {
    pub(super) shape: T,
    pub(super) fit: Option<Fit>,
    pub(super) iterations: usize,
    /// As [`Converged::edges_within_px`].
    pub(super) edges_within_px: f64,
}

impl FitResult {
    pub(super) fn is_accepted(&self, accept: &AcceptOptions) -> bool {
        self.refusal(accept).is_none()
    }

    /// Reason for refusing it by its edges alone; `None` if they suffice.
    pub(super) fn refusal(&self, accept: &AcceptOptions) -> Option<Refusal> {
        let Some(fit) = &self.fit else { return Some(Refusal::NoFit) };
        if fit.agreement < accept.min_inliers {
            Some(Refusal::Agreement)
        } else if fit.residual_rms_px > max_residual_px(accept, self.shape.width()) {
            Some(Refusal::Residual)
        } else {
            None
        }
    }

    /// The edge cue that shows the fit: edges of the image that separates the hand best, unless
    /// those of the grey image led to it.
    pub(super) fn edges(&self) -> EdgeCue {
        match self.fit {
            Some(Fit { edge_cue: EdgeCue::GreyEdges, .. }) => EdgeCue::GreyEdges,
            _ => EdgeCue::HandEdges,
        }
    }

    /// Explained fraction of the visible contour, 0–1.
    pub(super) fn explained(&self) -> f64 {
        self.fit.map_or(0.0, |f| f.support.share())
    }
}

impl<T> FitResult<T> {
    /// Explained fraction of the finger's contour, 0–1.
    pub(super) fn explains_finger(&self) -> f64 {
        self.fit.map_or(0.0, |f| f.support.of_finger())
    }
}

impl From<FitResult<AffineMap>> for FitResult {
    fn from(found: FitResult<AffineMap>) -> Self {
        let FitResult { shape, fit, iterations, edges_within_px } = found;
        Self { shape: Shape::Planar(shape), fit, iterations, edges_within_px }
    }
}

impl From<Converged<RIBBON_DOF>> for FitResult {
    fn from(found: Converged<RIBBON_DOF>) -> Self {
        let Converged { x, fit, iterations, edges_within_px } = found;
        // A band of negative width is no finger.
        let fit = fit.filter(|_| x[3] > 0.0);
        Self { shape: Shape::Ribbon(x), fit, iterations, edges_within_px }
    }
}
