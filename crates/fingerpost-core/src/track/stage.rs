//! One stage of a fit: what it searches with, and what it comes to.

use super::appearance::{EdgeCue, SearchModel};
use super::estimate::ShapeEstimate;
use super::options::AcceptOptions;
use crate::geometry::shape_space::{Axis, PlacedSample};
use crate::geometry::template::{Part, TemplateSample};
use crate::measure::edge::Scale;
use crate::solve::dynamics::{Expectation, Gate};
use crate::solve::fit::Prior;
use nalgebra::{Matrix2, SVector, Vector3};
/// A fit that explains this part of the contour needs no second look from afar.
pub(super) const SURE: f64 = 0.85;
/// A contour has converged when no sample moves further than this \[px\]: what is left is a tenth.
const CONVERGED_PX: f64 = 0.05;

const THUMB_RESTS_PX: f64 = 0.1;

const TAKEN_OVER_PX: f64 = 1.0;

/// Motion smears a large finger as it does a small one, in proportion: residual offsets up to this part
/// of its half-width are no reason to refuse it.
const RESIDUAL_SHARE: f64 = 0.2;

/// A sample supports a fit when its residual offset is below this \[px\].
pub(super) const SUPPORT_PX: f64 = 1.5;

/// What a hand does besides moving and turning shifts its edges by this, as a standard deviation
/// \[px\].
const BESIDES_PX: f64 = 1.0;

/// How one convergence searches.
#[derive(Debug, Clone, Copy)]
pub(super) struct FitStage<'a> {
    /// The samples that take part: every one, or one in so many.
    pub samples: &'a [TemplateSample],
    pub every: usize,
    /// What the search lines look for, and in which image.
    pub search_model: SearchModel<'a>,
    pub scale: Scale,
    /// The longest search line.
    pub half_length_px: f64,
    /// No edge is expected further away than this \[px\]: lines need be no longer, and the fit takes
    /// those that they find as it would take them on longer ones.
    pub edges_within_px: f64,
    /// What shortens the lines further, if the hand's motion is known.
    pub window: Option<Window>,
    pub rest: StageEnd,
    /// Whether edges count alone that look like the hand inside.
    pub own_only: bool,
    /// The residual offsets' scale near the hand's edges is at most this \[px\].
    pub most_scale_px: f64,
}

/// What becomes of a contour that has come to rest.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum StageEnd {
    /// It is told.
    Reported,
    /// Another shape space takes over and converges itself: no fit is told.
    TakenOver,
    /// It is told; no finger line depends on where exactly it is, which is a thumb's.
    Thumb,
}

impl StageEnd {
    /// It rests when no sample moves further than this \[px\].
    pub fn px(self) -> f64 {
        match self {
            Self::Reported => CONVERGED_PX,
            Self::TakenOver => TAKEN_OVER_PX,
            Self::Thumb => THUMB_RESTS_PX,
        }
    }
}

/// Where a hand that moved on is expected, and how far from there its edges are looked for.
#[derive(Debug, Clone, Copy)]
pub(super) struct Window {
    /// (c_u, c_v, θ).
    pub expected: Expectation<3>,
    pub gate: Gate,
    /// How far they are looked for once the hand is placed \[px\].
    pub near_px: f64,
    /// Whether what does not look like the hand inside of an edge is taken for what covers it.
    pub own_only: bool,
}

impl Window {
    /// What a hand that goes on as it did is believed to do; nothing is of any other.
    pub fn belief(&self) -> Option<Prior<3>> {
        let Expectation { vector, covariance } = self.expected;
        let information = covariance.try_inverse().filter(|_| self.own_only)?;
        Some(Prior { mean: vector, information })
    }

    /// How far to look along the normal of a sample: it moves with the hand, and a little besides.
    pub fn length(&self, placed: &PlacedSample) -> f64 {
        let PlacedSample { position, normal } = placed;
        let arm = position.coords - self.expected.vector.xy();
        let row = Vector3::new(normal.x, normal.y, arm.perp(normal));
        self.expected.search_length(&row, BESIDES_PX * BESIDES_PX, &self.gate)
    }
}

/// Where the template came to rest.
#[derive(Debug, Clone, Copy)]
pub(super) struct Converged<const D: usize> {
    pub x: SVector<f64, D>,
    /// The last fit, if it was determined.
    pub fit: Option<Fit>,
    pub iterations: usize,
    /// No edge that was found is further from here than this, for a stage that takes over \[px\];
    /// infinite where too few were found to tell, or it did not come to rest.
    pub edges_within_px: f64,
}

impl<const D: usize> Converged<D> {
    pub fn at(x: SVector<f64, D>) -> Self {
        Self { x, fit: None, iterations: 0, edges_within_px: f64::INFINITY }
    }

    /// The part of the finger's visible samples that the fit explains, 0–1; nothing without a fit.
    pub fn explains_finger(&self) -> f64 {
        self.fit.map_or(0.0, |f| f.support.of_finger())
    }

    /// Samples that the fit explains; none without a fit.
    pub fn support(&self) -> usize {
        self.fit.map_or(0, |f| f.support.supported())
    }
}

/// A determined fit, whatever its shape space.
#[derive(Debug, Clone, Copy)]
pub(super) struct Fit {
    pub shape: ShapeEstimate,
    pub axis: Axis,
    pub line_covariance: Matrix2<f64>,
    /// What became of the samples, those of a thumb that was fitted afterwards included.
    pub counts: EdgeCounts,
    /// The part of the samples that were fitted whose edges agree with the fit, 0–1.
    pub agreement: f64,
    pub support: Support,
    pub residual_rms_px: f64,
    pub rank: usize,
    /// Whether edges counted alone that look like the hand inside.
    pub own_only: bool,
    /// What led to its edges, and whether its looks told which of them are the hand's.
    pub edge_cue: EdgeCue,
    pub by_appearance: bool,
}

/// What became of the samples of a search.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct EdgeCounts {
    /// Those that no other limb hides.
    pub visible: usize,
    /// Those that found an edge.
    pub hits: usize,
    /// Those whose edge agrees with the fit.
    pub inliers: usize,
}

/// How many samples of each part of the outline a fit explains, and how many there are.
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

    /// The part of all visible samples that is explained, 0–1.
    pub fn share(&self) -> f64 {
        self.supported() as f64 / self.visible.iter().sum::<usize>().max(1) as f64
    }

    /// The same of one part of the outline; nothing of what is not visible is explained.
    pub fn of(&self, part: Part) -> f64 {
        self.supported[part as usize] as f64 / self.visible[part as usize].max(1) as f64
    }

    /// The part of the visible samples of one part of the outline whose edges agree with the fit, 0–1:
    /// those of a smeared one scatter.
    pub fn agreeing(&self, part: Part) -> f64 {
        self.agreeing[part as usize] as f64 / self.visible[part as usize].max(1) as f64
    }

    /// The part of the finger's visible samples that is explained, 0–1.
    pub fn of_finger(&self) -> f64 {
        let parts = [Part::LeftFlank, Part::RightFlank, Part::Tip].map(|part| part as usize);
        let sum = |counts: &[usize; 4]| parts.iter().map(|&part| counts[part]).sum::<usize>();
        sum(&self.supported) as f64 / sum(&self.visible).max(1) as f64
    }

    /// How many samples of a part of the outline are explained.
    pub fn count(&self, part: Part) -> usize {
        self.supported[part as usize]
    }
}

/// How large the residual offsets of a finger of this half-width may be \[px\].
pub(super) fn max_residual_px(accept: &AcceptOptions, half_width_px: f64) -> f64 {
    accept.max_residual_px.max(RESIDUAL_SHARE * half_width_px)
}
