//! Foreground test of a contour against a known background.

use super::scene::SceneBackground;
use crate::geometry::shape_space::PlacedSample;
use crate::numeric::ablation::{Mechanism, is_off};

/// Distance inside and outside of the outline at which the foreground is sampled \[half-widths\].
const SAMPLED_HALF_WIDTHS: f64 = 0.4;
/// Lower bound of that distance \[px\].
const MIN_SAMPLED_PX: f64 = 3.0;
/// Least mean foreground probability inside.
const MIN_FOREGROUND_INSIDE: f64 = 0.5;
/// Least difference of the mean foreground probability inside from that outside, where a shadow may
/// be taken for foreground too.
const MIN_FOREGROUND_CONTRAST: f64 = 0.2;

/// Foreground probabilities inside and outside of an outline.
pub(super) struct ForegroundTest<'a> {
    behind: SceneBackground<'a>,
    away_px: f64,
    /// Sums and numbers of the known samples, inside and outside.
    sides: [(f64, f64); 2],
}

impl<'a> ForegroundTest<'a> {
    /// Without samples yet, for a finger of this half-width.
    pub fn before(behind: SceneBackground<'a>, half_width_px: f64) -> Self {
        let away_px = (SAMPLED_HALF_WIDTHS * half_width_px).max(MIN_SAMPLED_PX);
        Self { behind, away_px, sides: [(0.0, 0.0); 2] }
    }

    /// Adds one place of the outline.
    pub fn add(&mut self, placed: &PlacedSample) {
        for ((sum, count), px) in self.sides.iter_mut().zip([-self.away_px, self.away_px]) {
            let at = placed.position + placed.normal * px;
            if let Some(likely) = self.behind.foreground(at) {
                *sum += likely;
                *count += 1.0;
            }
        }
    }

    /// Whether the outline is that of an object before the background; `None` if its inside is
    /// unknown.
    pub fn is_foreground(&self) -> Option<bool> {
        if is_off(Mechanism::ForegroundTest) {
            return None;
        }
        let [inside, outside] = self.sides.map(|(sum, count)| (count > 0.0).then(|| sum / count));
        let inside = inside?;
        let is_visible = outside.is_none_or(|around| around <= inside - MIN_FOREGROUND_CONTRAST);
        Some(inside >= MIN_FOREGROUND_INSIDE && is_visible)
    }
}
