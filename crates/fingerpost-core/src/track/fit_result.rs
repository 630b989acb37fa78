//! The result of fitting one frame.

use super::appearance::EdgeCue;
use super::options::AcceptOptions;
use super::shape::Shape;
use super::stage::{Fit, max_residual_px};
use crate::geometry::planar::AffineMap;
use crate::geometry::ribbon::RibbonVector;

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

/// Result of fitting a contour: the shape reached, as a shape vector of one space, as the template
/// of one model, or as a [`Shape`] of either.
#[derive(Debug, Clone, Copy)]
pub(super) struct FitResult<T = Shape> {
    pub(super) shape: T,
    /// The last fit, if it was determined.
    pub(super) fit: Option<Fit>,
    pub(super) iterations: usize,
    /// For a stage that another continues, bound on the distance of the edges found from the shape
    /// \[px\]; infinite if too few were found, or without convergence.
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
    /// A shape that has not been fitted.
    pub(super) fn unfitted(shape: T) -> Self {
        Self { shape, fit: None, iterations: 0, edges_within_px: f64::INFINITY }
    }

    /// The same result with its shape expressed in another way.
    pub(super) fn map<U>(self, expressed: impl FnOnce(T) -> U) -> FitResult<U> {
        let Self { shape, fit, iterations, edges_within_px } = self;
        FitResult { shape: expressed(shape), fit, iterations, edges_within_px }
    }

    /// Explained fraction of the finger's visible samples, 0–1; 0 without a fit.
    pub(super) fn explains_finger(&self) -> f64 {
        self.fit.map_or(0.0, |f| f.support.of_finger())
    }

    /// Number of samples that the fit explains; 0 without a fit.
    pub(super) fn support(&self) -> usize {
        self.fit.map_or(0, |f| f.support.supported())
    }
}

impl From<FitResult<AffineMap>> for FitResult {
    fn from(found: FitResult<AffineMap>) -> Self {
        found.map(Shape::Planar)
    }
}

impl From<FitResult<RibbonVector>> for FitResult {
    fn from(found: FitResult<RibbonVector>) -> Self {
        // A band of negative width is no finger.
        let fit = found.fit.filter(|_| found.shape[3] > 0.0);
        FitResult { fit, ..found }.map(Shape::Ribbon)
    }
}
