//! Whether what was found stands free of a table that is known.

use super::scene::Behind;
use crate::geometry::shape_space::PlacedSample;

/// What stands free of the table is foreground this far inside its outline, in parts of its
/// half-width and at least \[px\]: to this part at least, and by so much more than as far outside,
/// where the shadow that it throws may be taken for foreground too.
const INSIDE_PART: f64 = 0.4;
const INSIDE_PX: f64 = 3.0;
const FREE_SHARE: f64 = 0.5;
const FREE_CONTRAST: f64 = 0.2;

/// How like foreground the inside and the outside of an outline are.
pub(super) struct ForegroundTest<'a> {
    behind: Behind<'a>,
    away_px: f64,
    /// Sums and numbers of what is known, inside and outside.
    flank_levels: [(f64, f64); 2],
}

impl<'a> ForegroundTest<'a> {
    /// Of an outline of which nothing has been seen yet, about a finger of such a half-width.
    pub fn before(behind: Behind<'a>, half_width_px: f64) -> Self {
        let away_px = (INSIDE_PART * half_width_px).max(INSIDE_PX);
        Self { behind, away_px, flank_levels: [(0.0, 0.0); 2] }
    }

    /// Takes one more place of the outline into account.
    pub fn add(&mut self, placed: &PlacedSample) {
        for ((sum, count), px) in self.flank_levels.iter_mut().zip([-self.away_px, self.away_px]) {
            let at = placed.position + placed.normal * px;
            if let Some(likely) = self.behind.foreground(at) {
                *sum += likely;
                *count += 1.0;
            }
        }
    }

    /// Whether it is the outline of what stands free; `None` where its inside is not known.
    pub fn is_free(&self) -> Option<bool> {
        let [inside, outside] =
            self.flank_levels.map(|(sum, count)| (count > 0.0).then(|| sum / count));
        let inside = inside?;
        let is_visible = outside.is_none_or(|around| around <= inside - FREE_CONTRAST);
        Some(inside >= FREE_SHARE && is_visible)
    }
}
