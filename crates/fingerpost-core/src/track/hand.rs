//! The state of the hand: its shape, its appearance model, and its usual residuals.

use super::appearance::{AppearanceModel, EdgeCue, SearchModel};
use super::fit_result::FitResult;
use super::limbs::finger_samples;
use super::options::TrackerOptions;
use super::scene::Scene;
use super::shape::Shape;
use super::stage::{Fit, FitStage, SUPPORT_PX, SURE, SearchPlan};
use super::validation::BendState;
use crate::geometry::planar::AffineMap;
use crate::geometry::ribbon::{BandMeasure, RIBBON_DOF, Ribbon, RibbonVector};
use crate::geometry::shape_space::{PlacedSample, Pose, ShapeSpace};
use crate::geometry::template::{Part, Template, TemplateSample};
use crate::measure::edge::Polarity;
use crate::numeric::ablation::{Mechanism, is_off};
use nalgebra::Vector2;

/// Rate at which the acquired widths and taper follow the fit, per accepted frame.
const ACQUIRED_RATE: f64 = 0.05;
/// Largest scale of the residual offsets of a hand that may be covered, relative to its usual
/// scale. Edges of the covering object are not the hand's.
const USUAL_TIMES: f64 = 2.0;
/// Lower bound of that limit \[px\].
const USUAL_LEAST_PX: f64 = 0.2;
/// Rate at which the usual scale follows, per frame.
const USUAL_RATE: f64 = 0.1;
/// Distance from the fit within which an edge that matches the appearance model counts, in units of
/// the largest scale of its residual offsets.
const MATCHED_WITHIN_SCALES: f64 = 1.5;
/// Prior standard deviation of the dimensions of a covered hand, relative to that of a hand seen
/// whole. From one frame to the next a hand of constant size hardly changes.
const COVERED_SLACK: f64 = 0.1;
/// Frames without a whole view after which a partly seen hand may be no hand at all.
pub(super) const MOST_COVERED_FRAMES: usize = 90;

/// The initial template, before it was fitted to a hand.
#[derive(Debug, Clone, Copy)]
pub(super) struct InitialTemplate {
    pub(super) map: AffineMap,
    pub(super) ribbon: RibbonVector,
    pub(super) measure: BandMeasure,
}

/// Model of one hand: whether it shows a thumb, and the polarity of its edges.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct HandModel {
    pub(super) has_thumb: bool,
    pub(super) polarity: Polarity,
}

/// The present state of the hand.
#[derive(Debug, Clone)]
pub(super) struct Hand {
    pub(super) shape: Shape,
    /// The band template at acquisition; its widths and taper follow slowly.
    pub(super) acquired: RibbonVector,
    /// Whether it shows a thumb, and the polarity of its edges.
    pub(super) model: HandModel,
    /// Extent of the finger along which the samples lie.
    pub(super) measure: BandMeasure,
    /// The planar template fitted to this hand; unused by the band model.
    pub(super) fitted: Vec<TemplateSample>,
    /// Its appearance model, once learned.
    pub(super) appearance: Option<AppearanceModel>,
    /// The shaded flank of its finger, which in grey has no contrast to the background; `None` if
    /// it was acquired without one.
    pub(super) shaded: Option<Part>,
    /// Its place when the appearance model was last updated \[px\], and the frames tracked since.
    pub(super) learned_at_px: Vector2<f64>,
    pub(super) frames_since_learning: usize,
    /// Frames in a row in which the thumb was not seen.
    pub(super) thumb_missed: usize,
    /// Bend state of its finger, bent frames in a row, and straight frames since acquisition.
    pub(super) bend_state: BendState,
    pub(super) bent_frames: usize,
    pub(super) straight_frames: usize,
    /// Whether it was found again in the last frame, so that its velocity is unknown.
    pub(super) is_back: bool,
    /// Usual root mean square of its residual offsets \[px\]; infinite until known.
    pub(super) usual_px: f64,
    /// Frames since nearly all of its contour was last explained.
    pub(super) partly_frames: usize,
    /// Whether an object may cover part of it.
    pub(super) is_covered: bool,
}

/// A lost hand: its last shape, model and finger extent.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct LastKnown {
    pub(super) shape: Shape,
    pub(super) model: HandModel,
    pub(super) measure: BandMeasure,
}

impl InitialTemplate {
    /// The model of a hand that equals the template.
    pub(super) fn model(&self, options: &TrackerOptions) -> HandModel {
        HandModel { has_thumb: self.measure.side != 0.0, polarity: options.polarity }
    }

    pub(super) fn shape(&self, template: &Template) -> Shape {
        match template.proportions() {
            Some(_) => Shape::Ribbon(self.ribbon),
            None => Shape::Planar(self.map),
        }
    }
}

impl Hand {
    /// The band template's samples that take part: the finger's, and the thumb's if it is seen.
    pub(super) fn bands<'a>(&self, samples: &'a [TemplateSample]) -> &'a [TemplateSample] {
        if self.model.has_thumb { samples } else { finger_samples(samples) }
    }

    /// The planar template's samples: those fitted to this hand, or the initial template's.
    pub(super) fn planar<'a>(&'a self, samples: &'a [TemplateSample]) -> &'a [TemplateSample] {
        if self.fitted.is_empty() { samples } else { &self.fitted }
    }

    /// The data retained of it if it is lost in this shape.
    pub(super) fn remembered(&self, shape: Shape) -> LastKnown {
        LastKnown { shape, model: self.model, measure: self.measure }
    }

    /// Lets the widths and the taper follow the fit slowly: the hand may come nearer.
    pub(super) fn grow(&mut self) {
        if let Shape::Ribbon(x) = self.shape {
            for k in [3, 4, 8] {
                self.acquired[k] += ACQUIRED_RATE * (x[k] - self.acquired[k]);
            }
        }
    }

    /// (Δw, Δτ): by how much a finger of half-width `half_width_px` at its anchor and of this taper
    /// is wider than the acquired one, `ahead_px` ahead of the anchor \[px\], and more tapered.
    pub(super) fn shape_mismatch(
        &self,
        half_width_px: f64,
        taper: f64,
        ahead_px: f64,
    ) -> Vector2<f64> {
        if is_off(Mechanism::ShapeMismatch) {
            return Vector2::zeros();
        }
        let more_tapered = taper - self.acquired[4];
        Vector2::new(half_width_px - self.acquired[3] + ahead_px * more_tapered, more_tapered)
    }

    /// Leaves out a thumb that was not seen for `most_missed` frames: it would hide the finger.
    pub(super) fn count_thumb(&mut self, found: &FitResult, most_missed: usize) {
        let is_thumb_seen = found.fit.is_some_and(|f| f.shape.names.len() == RIBBON_DOF);
        self.thumb_missed = if is_thumb_seen { 0 } else { self.thumb_missed + 1 };
        if self.thumb_missed >= most_missed && matches!(self.shape, Shape::Ribbon(_)) {
            self.model.has_thumb = false;
        }
    }

    /// Calls `each` for the hand's samples as a shape places them, except those that another limb
    /// hides.
    pub(super) fn outline(
        &self,
        shape: &Shape,
        samples: &[TemplateSample],
        mut each: impl FnMut(Part, PlacedSample),
    ) {
        match shape {
            Shape::Planar(map) => {
                self.planar(samples).iter().for_each(|s| each(s.part(), map.place(s)));
            }
            Shape::Ribbon(x) => {
                let measure = self.measure.with_thumb(self.model.has_thumb);
                if let Ok(space) = Ribbon::<RIBBON_DOF>::about(x, &measure) {
                    let pose = space.pose(x);
                    let placed = self.bands(samples).iter().map(|s| (s, pose.place(s)));
                    let visible = placed.filter(|(s, p)| !pose.is_hidden(s, p));
                    visible.for_each(|(s, p)| each(s.part(), p));
                }
            }
        }
    }

    /// Number of its samples on the finger; these come first.
    pub(super) fn fingers(&self, samples: &[TemplateSample]) -> usize {
        match self.shape {
            Shape::Ribbon(_) => finger_samples(samples).len(),
            Shape::Planar(_) => finger_samples(self.planar(samples)).len(),
        }
    }

    /// The search stage of these samples, with the search model of the hand.
    pub(super) fn stage<'a>(
        &'a self,
        samples: &'a [TemplateSample],
        scene: &Scene<'_>,
        plan: SearchPlan,
        polarity: Polarity,
    ) -> FitStage<'a> {
        let search_model = self.search_model(scene, plan.edge_cue, polarity);
        let max_scale_px = if plan.matched_only { self.max_scale_px() } else { f64::INFINITY };
        FitStage { samples, search_model, plan, max_scale_px }
    }

    /// Whether it was seen whole within [`MOST_COVERED_FRAMES`]. One that never was may be no hand;
    /// its motion is not constrained.
    pub(super) fn is_known_whole(&self) -> bool {
        self.partly_frames < MOST_COVERED_FRAMES
    }

    /// Whether a fit explains nearly all of its contour, by edges that scatter as usual.
    pub(super) fn is_whole(&self, found: &FitResult) -> bool {
        let scatters_as_usual = |fit: &Fit| fit.residual_rms_px <= self.max_scale_px();
        found.explained() >= SURE && found.fit.as_ref().is_some_and(scatters_as_usual)
    }

    /// Whether the last accepted fit has representative residuals: it is that of a whole hand, or
    /// of one that was never seen whole.
    pub(super) fn has_usual_residuals(&self) -> bool {
        self.partly_frames == 0 || !self.is_known_whole()
    }

    /// Records whether an object may cover it in this fit.
    pub(super) fn note_covered(&mut self, found: &FitResult) {
        self.is_covered = self.is_known_whole() && !self.is_whole(found);
    }

    /// Counts the frames since an accepted fit explained nearly all of its contour.
    pub(super) fn count_partly(&mut self, found: &FitResult) {
        self.partly_frames =
            if self.is_whole(found) { 0 } else { self.partly_frames.saturating_add(1) };
    }

    /// Updates the usual residual scale by an accepted fit, unless an object may cover a hand that
    /// is known whole: some of its edges are the object's.
    pub(super) fn learn_usual(&mut self, found: &FitResult) {
        if let Some(fit) = found.fit.filter(|_| self.has_usual_residuals()) {
            self.usual_px += USUAL_RATE * (fit.residual_rms_px - self.usual_px);
        }
    }

    /// Largest residual scatter of a fit at its true place \[px\].
    pub(super) fn max_scale_px(&self) -> f64 {
        (USUAL_TIMES * self.usual_px).max(USUAL_LEAST_PX)
    }

    /// Largest distance of a matching edge from a fit at its true place \[px\].
    pub(super) fn matched_within_px(&self) -> f64 {
        (MATCHED_WITHIN_SCALES * self.max_scale_px()).min(SUPPORT_PX)
    }

    /// Slack of the prior on its dimensions, relative to that of a hand seen whole. An object that
    /// covers it makes it neither wider nor slimmer, but the dimensions may change the longer that
    /// lasts.
    pub(super) fn slack(&self) -> f64 {
        let covered_part = self.partly_frames as f64 / MOST_COVERED_FRAMES as f64;
        (COVERED_SLACK + (1.0 - COVERED_SLACK) * covered_part).min(1.0)
    }

    /// The search model of the hand in a frame.
    pub(super) fn search_model(
        &self,
        scene: &Scene<'_>,
        edge_cue: EdgeCue,
        polarity: Polarity,
    ) -> SearchModel<'_> {
        let known =
            self.appearance.as_ref().and_then(|l| l.search_model(scene, edge_cue, polarity));
        known.unwrap_or(SearchModel::unknown(polarity))
    }

    /// Whether a mixture of colours separates it better than the grey image.
    pub(super) fn is_mixed(&self) -> bool {
        self.appearance.as_ref().is_some_and(AppearanceModel::is_mixed)
    }

    /// Whether its appearance model applies to this frame: a model of colours needs a colour frame.
    pub(super) fn is_shown_in(&self, scene: &Scene<'_>) -> bool {
        self.appearance.as_ref().is_some_and(|l| !l.is_coloured() || scene.colour().is_some())
    }
}
