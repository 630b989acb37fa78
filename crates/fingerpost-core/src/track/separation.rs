//! Whether a finger differs enough from what is beside it.

/// How much the inside and the outside of a finger differ at least, as the mean of the pixels' votes:
/// fingers on footage of tables, papers and cloth do by 1.4 and more even in grey, false ones on
/// patterned cloth by up to 1.2.
pub(super) const STANDS_OUT: f64 = 1.3;

/// The same of a finger that stands free of a table that is known: that tells them apart as well. Dark
/// hands before dark wood differ by 0.8 to 1.
pub(super) const STANDS_OUT_FREE: f64 = 0.7;

/// The same of a finger that is seen whole, all around, to this part of its contour. Skin before wood of
/// its brightness differs by 0.4 to 0.6. Of 1560 templates beside the hands of 13 films this takes 2 more
/// for a finger (113 in all), and of 480 about the hands of 15 it finds 13 more (438).
pub(super) const STANDS_OUT_WHOLE: f64 = 0.4;
pub(super) const WHOLE: f64 = 0.7;

/// Whether a finger stands out that is told so well from what is beside it ([`AppearanceModel::finger_separation`]), and
/// so much of whose contour is explained, and which may stand free of the table, if that is known.
pub(super) fn stands_out(
    separation: f64,
    explained: f64,
    is_free: impl FnOnce() -> Option<bool>,
) -> bool {
    separation >= STANDS_OUT
        || (separation >= STANDS_OUT_WHOLE && explained >= WHOLE)
        || (separation >= STANDS_OUT_FREE && is_free() == Some(true))
}

#[cfg(test)]
mod tests;
