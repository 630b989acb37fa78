//! Running mean of a quantity over frames.

/// A mean in which the latest values count at least at a given rate, so that it follows a slow
/// change.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct RunningMean {
    pub value: f64,
    /// Number of values, the prior included; a value that repeats earlier ones in part counts as
    /// its new part.
    pub count: f64,
}

impl RunningMean {
    /// Learns a value of which the part `freshness` is new, 0–1. The mean changes by that part of
    /// 1 / count, but at least of `min_rate`.
    pub fn learn(&mut self, value: f64, freshness: f64, min_rate: f64) {
        self.count += freshness;
        let rate = freshness * (1.0 / self.count).max(min_rate);
        self.value += rate * (value - self.value);
    }
}
