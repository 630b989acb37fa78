//! Whether a finger differs enough from its surroundings.

/// Least separation of a finger: mean log-likelihood ratio of pixels inside minus that of pixels
/// outside. Fingers on footage of tables, papers and cloth have 1.4 and more even in grey, false
/// ones on patterned cloth up to 1.2.
pub(super) const MIN_SEPARATION: f64 = 1.3;

/// The same for a finger that passes the foreground test against a known table, which separates
/// them as well. Dark hands before dark wood have 0.8 to 1.
pub(super) const MIN_SEPARATION_OF_FOREGROUND: f64 = 0.7;

/// The same for a finger that explains at least the fraction [`NEARLY_ALL_EXPLAINED`] of its
/// contour. Skin before wood of its brightness has 0.4 to 0.6. Of 1560 templates beside the hands
/// of 13 films this accepts 2 more as fingers (113 in all); of 480 near the hands of 15 films it
/// finds 13 more (438).
pub(super) const MIN_SEPARATION_IF_EXPLAINED: f64 = 0.4;
/// Least explained fraction of the contour for [`MIN_SEPARATION_IF_EXPLAINED`].
pub(super) const NEARLY_ALL_EXPLAINED: f64 = 0.7;

/// Whether a finger stands out from its surroundings, by its separation
/// ([`AppearanceModel::finger_separation`](super::appearance::AppearanceModel::finger_separation)),
/// the explained fraction of its contour, and the foreground test, `None` where the table is
/// unknown.
pub(super) fn stands_out(
    separation: f64,
    explained: f64,
    is_foreground: impl FnOnce() -> Option<bool>,
) -> bool {
    separation >= MIN_SEPARATION
        || (separation >= MIN_SEPARATION_IF_EXPLAINED && explained >= NEARLY_ALL_EXPLAINED)
        || (separation >= MIN_SEPARATION_OF_FOREGROUND && is_foreground() == Some(true))
}

#[cfg(test)]
mod tests;
