//! Mechanisms that can be switched off, to measure the contribution of each (`benches/ablate.py`).
//!
//! The feature `ablation` is never shipped. Without it `is_off` is the constant `false`, and the
//! compiler removes the test.

/// A mechanism of the tracker.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Mechanism {
    /// Averaging the finger line over frames, relative to the texture of the skin.
    LineFilter,
    /// Expressing the line for the distal segment, by the curvature of the medial line.
    AxisCurvature,
    /// A photometric fit of the distal segment alone.
    FrontLine,
    /// The bias that the bend may have.
    BendBias,
    /// The bias of a flank of low contrast.
    FaintFlankBias,
    /// The variance factor of contour and pixels, and the contour's bias.
    VarianceFactor,
    /// The photometric fit in the full frame of a hand that is followed in a reduced one.
    FullResolution,
    /// Following large hands in a reduced image.
    PyramidLevel,
    /// Chromaticity for a flank in the shade.
    ShadedFlank,
    /// Histograms of each flank in monochrome.
    FlankLevels,
    /// Fisher's discriminant image.
    Discriminant,
    /// The hypothesis by grey edges.
    GreyHypothesis,
    /// The hypothesis by any edge, in a light that has changed.
    RelitHypothesis,
    /// The hypothesis of constant velocity.
    ConstantVelocity,
    /// The hypotheses by log-likelihood ratios from a distance.
    Approach,
    /// The hypothesis of a tip that was occluded.
    UncoveredTip,
    /// Rejecting bent fingers.
    BendState,
    /// Following changes of exposure.
    Exposure,
    /// Finding the length of the finger when a hand is acquired.
    TemplateLength,
    /// The prior on how smoothly a hand moves.
    MotionPrior,
    /// Leaving edges of occluders out of what the appearance learns.
    OccluderEdges,
    /// The design effect of correlated edges.
    DesignEffect,
    /// Templates close by in monochrome.
    CloseBy,
    /// Widths and tapers that differ from the hand's.
    ShapeMismatch,
    /// The test of a finger against the known background.
    ForegroundTest,
}

/// Whether a mechanism is switched off.
#[cfg(not(feature = "ablation"))]
pub(crate) const fn is_off(_mechanism: Mechanism) -> bool {
    false
}

/// Whether the environment variable `FINGERPOST_OFF` names a mechanism.
#[cfg(feature = "ablation")]
pub(crate) fn is_off(mechanism: Mechanism) -> bool {
    use std::sync::LazyLock;
    static OFF: LazyLock<String> =
        LazyLock::new(|| std::env::var("FINGERPOST_OFF").unwrap_or_default());
    *OFF == format!("{mechanism:?}")
}
