//! What the fit to one frame came to.

use super::convergence::{Converged, Fit, max_residual_px};
use super::looks::Lead;
use super::options::AcceptOptions;
use super::shape::Shape;
use super::verdict::Refusal;
use crate::shape_space::{AffineMap, RIBBON_DOF};

/// What one frame's fit came to.
pub(super) struct Found<T = Shape> {
    pub(super) shape: T,
    pub(super) fit: Option<Fit>,
    pub(super) iterations: usize,
    /// As [`Converged::edges_within_px`].
    pub(super) edges_within_px: f64,
}

impl Found {
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
    pub(super) fn edges(&self) -> Lead {
        match self.fit {
            Some(Fit { lead: Lead::GreyEdges, .. }) => Lead::GreyEdges,
            _ => Lead::HandEdges,
        }
    }

    /// The part of the visible contour that the fit explains, 0–1.
    pub(super) fn explained(&self) -> f64 {
        self.fit.map_or(0.0, |f| f.support.share())
    }
}

impl<T> Found<T> {
    /// The same of the finger alone.
    pub(super) fn explains_finger(&self) -> f64 {
        self.fit.map_or(0.0, |f| f.support.of_finger())
    }
}

impl From<Found<AffineMap>> for Found {
    fn from(found: Found<AffineMap>) -> Self {
        let Found { shape, fit, iterations, edges_within_px } = found;
        Self { shape: Shape::Planar(shape), fit, iterations, edges_within_px }
    }
}

impl From<Converged<RIBBON_DOF>> for Found {
    fn from(found: Converged<RIBBON_DOF>) -> Self {
        let Converged { x, fit, iterations, edges_within_px } = found;
        // A band that is turned inside out is no finger.
        let fit = fit.filter(|_| x[3] > 0.0);
        Self { shape: Shape::Ribbon(x), fit, iterations, edges_within_px }
    }
}
