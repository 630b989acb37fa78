//! The prior on the band template of a hand that has not been seen yet.

use super::initialise::TemplateInitialiser;
use crate::geometry::ribbon::{Ribbon, RibbonVector};
use crate::solve::fit::Prior;
use nalgebra::SMatrix;

/// Prior standard deviation of the half-widths, as a fraction of the finger's half-width.
const WIDTH_SIGMA: f64 = 0.4;

/// Prior standard deviation of the taper.
const TAPER_SIGMA: f64 = 0.08;

/// Prior standard deviation of the thumb's root and spine, as a fraction of the finger's length.
const THUMB_SIGMA: f64 = 0.3;

impl TemplateInitialiser<'_> {
    /// The prior of a hand about `from`: no information about place and angle, weak information
    /// about size.
    pub(super) fn initial_prior<const D: usize>(&self, from: &RibbonVector) -> Prior<D> {
        let thumb_px = THUMB_SIGMA * self.measure.length_px;
        let sigmas = [
            f64::INFINITY,
            f64::INFINITY,
            f64::INFINITY,
            WIDTH_SIGMA * from[3],
            TAPER_SIGMA,
            thumb_px,
            thumb_px,
            thumb_px,
            WIDTH_SIGMA * from[3],
        ];
        let mut information = SMatrix::<f64, D, D>::zeros();
        for (i, sigma) in sigmas.iter().take(D).enumerate() {
            information[(i, i)] = sigma.powi(-2);
        }
        let mut mean = Ribbon::<D>::free(from);
        // The prior of the taper is symmetric about zero, whatever an earlier fit gave.
        if D > 4 {
            mean[4] = 0.0;
        }
        Prior { mean, information }
    }
}
