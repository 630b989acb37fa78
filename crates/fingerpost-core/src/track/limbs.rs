//! The samples of finger and thumb in a template, and where they meet.

use crate::geometry::template::{Limb, TemplateSample};

/// Admissible lengths of a fitted thumb, in finger lengths.
pub(super) const THUMB_SIZES: std::ops::RangeInclusive<f64> = 0.2..=1.5;

pub(super) fn thumb_samples(samples: &[TemplateSample]) -> &[TemplateSample] {
    &samples[crotch(samples)..]
}

pub(super) fn crotch(samples: &[TemplateSample]) -> usize {
    samples.iter().position(|s| s.limb == Limb::Thumb).unwrap_or(samples.len())
}

/// The outline runs along the finger first, then along the thumb.
pub(super) fn finger_samples(samples: &[TemplateSample]) -> &[TemplateSample] {
    &samples[..crotch(samples)]
}
