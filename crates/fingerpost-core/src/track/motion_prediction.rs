//! The motion prediction for the next frame.

use super::fit_result::FitResult;
use super::stage::Window;
use crate::Result;
use crate::solve::dynamics::{Dynamics, Innovation};
use nalgebra::{Matrix3, Vector3};

/// Standard deviations of (c_u, c_v, θ) that a fit's covariance does not include: the template
/// slides on a hand that differs from it \[px, px, rad\].
const MISFIT_SIGMAS: [f64; 3] = [0.5, 0.5, 0.01];

/// Prediction of the pose in the next frame.
#[derive(Debug, Clone, Copy)]
pub(super) struct MotionPrediction {
    pub(super) dynamics: Dynamics<3>,
    pub(super) time_s: f64,
    pub(super) window: Window,
}

impl MotionPrediction {
    /// The same with the uncertainty that an object covering the tip may have shifted the fit back
    /// along the finger by `by_px`.
    pub(super) fn with_occlusion_shift(mut self, by_px: f64) -> Self {
        let (sin, cos) = self.window.expected.vector[2].sin_cos();
        let by = Vector3::new(by_px * cos, by_px * sin, 0.0);
        self.dynamics = self.dynamics.unsure(&by);
        self.window.expected.covariance += by * by.transpose();
        self
    }

    /// The filter after a fit, and the innovation; `None` without a fit.
    pub(super) fn followed(
        &self,
        found: &FitResult,
    ) -> Result<Option<(Dynamics<3>, Option<Innovation<3>>)>> {
        let Some(fit) = found.fit else { return Ok(None) };
        let covariance = fit.shape.covariance.fixed_view::<3, 3>(0, 0) + misfit();
        let mut dynamics = self.dynamics;
        let innovation = dynamics.update(self.time_s, &found.shape.placement(), &covariance)?;
        Ok(Some((dynamics, innovation)))
    }
}

pub(super) fn misfit() -> Matrix3<f64> {
    Matrix3::from_diagonal(&Vector3::from(MISFIT_SIGMAS.map(|s| s * s)))
}
