//! Variance of unit weight of a sequence of comparisons.
//!
//! A covariance accounts for the errors that scatter within one image. Others show where two
//! estimates are compared: if their covariances are right, χ² per degree of freedom is 1 on
//! average. Where it is more, all covariances are scaled by it, as in any least-squares adjustment.

use super::running_mean::RunningMean;

/// Weight of the prior, in comparisons.
pub(super) const PRIOR_COMPARISONS: f64 = 8.0;
/// Least rate at which a comparison that is wholly new changes an estimate.
pub(super) const MIN_COMPARISON_RATE: f64 = 0.05;

/// χ² per degree of freedom, averaged over comparisons, with a prior of 1.
#[derive(Debug, Clone, Copy)]
pub(super) struct VarianceFactor(RunningMean);

impl Default for VarianceFactor {
    fn default() -> Self {
        Self(RunningMean { value: 1.0, count: PRIOR_COMPARISONS })
    }
}

impl VarianceFactor {
    /// Learns from a comparison with this χ² per degree of freedom, of which the part `freshness`
    /// is new, 0–1.
    pub fn learn(&mut self, reduced_chi_squared: f64, freshness: f64) {
        self.0.learn(reduced_chi_squared, freshness, MIN_COMPARISON_RATE);
    }

    /// Factor by which covariances are scaled, at least 1.
    pub fn inflation(&self) -> f64 {
        self.0.value.max(1.0)
    }
}
