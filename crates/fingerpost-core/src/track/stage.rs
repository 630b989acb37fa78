//! One stage of a fit: its parameters and its result.

use super::appearance::{EdgeCue, SearchModel};
use super::estimate::ShapeEstimate;
use super::options::AcceptOptions;
use crate::geometry::shape_space::{Axis, PlacedSample};
use crate::geometry::template::{Part, TemplateSample};
use crate::measure::edge::Scale;
use crate::solve::dynamics::{Expectation, Gate};
use crate::solve::fit::Prior;
use nalgebra::{Matrix2, Vector3};

/// Explained fraction of the contour from which a fit needs no further hypotheses.
pub(super) const SURE: f64 = 0.85;
/// Largest motion of a sample below which a contour has converged \[px\]; the remaining motion is a
/// tenth of it.
const CONVERGED_PX: f64 = 0.05;

/// The same for a thumb \[px\].
const THUMB_CONVERGED_PX: f64 = 0.1;

/// The same for a stage that another shape space continues \[px\].
const TAKEN_OVER_PX: f64 = 1.0;

/// Largest admissible residual as a fraction of the half-width: motion blur grows with the size of
/// the finger.
const RESIDUAL_SHARE: f64 = 0.2;

/// Residual offset below which a sample supports a fit \[px\].
pub(super) const SUPPORT_PX: f64 = 1.5;

/// Standard deviation of edge displacements other than by translation and rotation of the hand
/// \[px\].
const BESIDES_PX: f64 = 1.0;

/// Parameters of one convergence.
#[derive(Debug, Clone, Copy)]
pub(super) struct FitStage<'a> {
    pub samples: &'a [TemplateSample],
    /// Search model: what the search lines look for, and in which image.
    pub search_model: SearchModel<'a>,
    pub plan: SearchPlan,
    /// Largest scale of the residual offsets near the hand's edges \[px\].
    pub max_scale_px: f64,
}

/// Range and kind of the search of one convergence, whatever the samples and the hand.
#[derive(Debug, Clone, Copy)]
pub(super) struct SearchPlan {
    /// Of the samples, every `every`-th takes part.
    pub every: usize,
    pub edge_cue: EdgeCue,
    pub scale: Scale,
    /// Largest half-length of a search line \[px\].
    pub half_length_px: f64,
    /// Bound on the distance of edges \[px\]: lines need be no longer, and the fit weighs their
    /// edges as on lines of `half_length_px`.
    pub edges_within_px: f64,
    /// Prediction that shortens the lines further, if the hand's motion is known.
    pub window: Option<Window>,
    pub purpose: StagePurpose,
    /// Whether only edges that match the appearance model inside count.
    pub matched_only: bool,
}

impl SearchPlan {
    /// The hand's edges on lines of this half-length, without a motion prediction.
    pub fn edges(half_length_px: f64) -> Self {
        Self {
            every: 1,
            edge_cue: EdgeCue::HandEdges,
            scale: Scale::Fine,
            half_length_px,
            edges_within_px: f64::INFINITY,
            window: None,
            purpose: StagePurpose::Reported,
            matched_only: false,
        }
    }
}

/// Purpose of a stage: the use of its contour once it has converged.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum StagePurpose {
    /// It is reported.
    Reported,
    /// Another shape space continues from it and converges itself: no fit is reported.
    TakenOver,
    /// It is reported; it is that of a thumb, whose exact place does not affect the finger line.
    Thumb,
}

impl StagePurpose {
    /// Largest motion of a sample at convergence \[px\].
    pub fn tolerance_px(self) -> f64 {
        match self {
            Self::Reported => CONVERGED_PX,
            Self::TakenOver => TAKEN_OVER_PX,
            Self::Thumb => THUMB_CONVERGED_PX,
        }
    }
}

/// Predicted pose of a hand, and the range of the edge search about it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Window {
    /// Predicted (c_u, c_v, θ).
    pub expected: Expectation<3>,
    pub gate: Gate,
    /// Half-length of the search lines once the hand is placed \[px\].
    pub near_px: f64,
    /// Whether edges that do not match the appearance model inside are attributed to a covering
    /// object.
    pub matched_only: bool,
}

impl Window {
    /// Prior on (c_u, c_v, θ) of a hand at constant velocity; `None` for any other window, or for a
    /// singular covariance.
    pub fn prior(&self) -> Option<Prior<3>> {
        let Expectation { vector, covariance } = self.expected;
        let information = covariance.try_inverse().filter(|_| self.matched_only)?;
        Some(Prior { mean: vector, information })
    }

    /// Half-length of the search along the normal of a sample, which moves with the hand and by
    /// [`BESIDES_PX`] in addition \[px\].
    pub fn length(&self, placed: &PlacedSample) -> f64 {
        let PlacedSample { position, normal } = placed;
        let arm = position.coords - self.expected.vector.xy();
        let row = Vector3::new(normal.x, normal.y, arm.perp(normal));
        self.expected.search_length(&row, BESIDES_PX * BESIDES_PX, &self.gate)
    }
}

/// A determined fit in any shape space.
#[derive(Debug, Clone, Copy)]
pub(super) struct Fit {
    pub shape: ShapeEstimate,
    pub axis: Axis,
    pub line_covariance: Matrix2<f64>,
    /// Sample counts, including those of a thumb that was fitted afterwards.
    pub counts: EdgeCounts,
    /// Fraction of the fitted samples whose edges agree with the fit, 0–1.
    pub agreement: f64,
    pub support: Support,
    pub residual_rms_px: f64,
    pub rank: usize,
    /// Whether only edges that match the appearance model inside counted.
    pub matched_only: bool,
    /// The edge cue, and whether the appearance model selected the edges.
    pub edge_cue: EdgeCue,
    pub by_appearance: bool,
}

/// Sample counts of a search.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct EdgeCounts {
    /// Samples that no other limb hides.
    pub visible: usize,
    /// Visible samples on whose search line an edge was found.
    pub hits: usize,
    /// Samples whose edge agrees with the fit.
    pub inliers: usize,
}

/// Sample counts for each part of the outline: explained by the fit (residual offset below
/// [`SUPPORT_PX`]), agreeing with it (inliers of the robust fit), and visible.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Support {
    pub supported: [usize; 4],
    pub agreeing: [usize; 4],
    pub visible: [usize; 4],
}

impl Support {
    pub fn supported(&self) -> usize {
        self.supported.iter().sum()
    }

    /// Explained fraction of all visible samples, 0–1.
    pub fn share(&self) -> f64 {
        self.supported() as f64 / self.visible.iter().sum::<usize>().max(1) as f64
    }

    /// Explained fraction of one part of the outline, 0–1; 0 if it is not visible.
    pub fn of(&self, part: Part) -> f64 {
        self.supported[part as usize] as f64 / self.visible[part as usize].max(1) as f64
    }

    /// Fraction of the visible samples of one part of the outline whose edges agree with the fit,
    /// 0–1. The edges of a blurred part scatter, so that this may exceed the explained fraction.
    pub fn agreeing(&self, part: Part) -> f64 {
        self.agreeing[part as usize] as f64 / self.visible[part as usize].max(1) as f64
    }

    /// Explained fraction of the finger's visible samples, 0–1.
    pub fn of_finger(&self) -> f64 {
        let parts = [Part::LeftFlank, Part::RightFlank, Part::Tip].map(|part| part as usize);
        let sum = |counts: &[usize; 4]| parts.iter().map(|&part| counts[part]).sum::<usize>();
        sum(&self.supported) as f64 / sum(&self.visible).max(1) as f64
    }

    /// Number of explained samples of a part of the outline.
    pub fn count(&self, part: Part) -> usize {
        self.supported[part as usize]
    }
}

/// Largest admissible residual for a finger of this half-width \[px\].
pub(super) fn max_residual_px(accept: &AcceptOptions, half_width_px: f64) -> f64 {
    accept.max_residual_px.max(RESIDUAL_SHARE * half_width_px)
}
