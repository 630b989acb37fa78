//! What the fit to one frame came to.

use super::appearance::EdgeCue;
use super::options::AcceptOptions;
use super::shape::Shape;
use super::stage::{Converged, Fit, max_residual_px};
use crate::geometry::planar::AffineMap;
use crate::geometry::ribbon::RIBBON_DOF;
/// Why the fit of a frame does not count.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Refusal {
    /// No fit was determined, or none that could be a finger.
    NoFit,
    /// It is much wider, slimmer or more tapered than the hand that is followed.
    Size,
    /// No hand moves like that.
    Motion,
    /// Too few edges agree with it.
    Agreement,
    /// Those that agree lie too far from it.
    Residual,
    /// It lies on a table that is known, or inside of what stands before that.
    Background,
    /// The finger is bent: no straight line is its axis.
    Misfit,
}

/// What one frame's fit came to.
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

    /// Why its edges alone do not make it a hand.
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

    /// Which edges show what was found: those of the image in which the hand stands out best, unless
    /// only those of the grey one led to it.
    pub(super) fn edges(&self) -> EdgeCue {
        match self.fit {
            Some(Fit { edge_cue: EdgeCue::GreyEdges, .. }) => EdgeCue::GreyEdges,
            _ => EdgeCue::HandEdges,
        }
    }

    /// The part of the visible contour that the fit explains, 0–1.
    pub(super) fn explained(&self) -> f64 {
        self.fit.map_or(0.0, |f| f.support.share())
    }
}

impl<T> FitResult<T> {
    /// The same of the finger alone.
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
        // A band that is turned inside out is no finger.
        let fit = fit.filter(|_| x[3] > 0.0);
        Self { shape: Shape::Ribbon(x), fit, iterations, edges_within_px }
    }
}
