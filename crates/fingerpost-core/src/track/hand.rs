//! The hand as it is known: its shape, its looks, and what is usual of it.

use super::appearance::{AppearanceModel, EdgeCue, SearchModel};
use super::fit_result::FitResult;
use super::initialise::Kind;
use super::limbs::finger_samples;
use super::options::TrackerOptions;
use super::scene::Scene;
use super::shape::Shape;
use super::stage::{Fit, FitStage, SUPPORT_PX, SURE, StageEnd, Window};
use super::validation::BendState;
use crate::geometry::planar::AffineMap;
use crate::geometry::ribbon::{BandMeasure, RIBBON_DOF, Ribbon, RibbonVector};
use crate::geometry::shape_space::{PlacedSample, Pose, ShapeSpace};
use crate::geometry::template::{Part, Template, TemplateSample};
use crate::measure::edge::{Polarity, Scale};
use nalgebra::Vector2;

/// Part of a change of width or taper that is taken over per accepted frame.
const HELD_RATE: f64 = 0.05;
/// Where covers may give a hand edges that it does not have, the residual offsets' scale is at most so
/// many times the usual one and need not be below this \[px\]; the usual one follows slowly.
const USUAL_TIMES: f64 = 2.0;
const USUAL_LEAST_PX: f64 = 0.2;
const USUAL_RATE: f64 = 0.1;
/// An edge is its own only within so many of the largest scales of its residual offsets.
const OWN_SCALES: f64 = 1.5;
/// What is covered changes its dimensions by no more than this part of what it may while it is seen
/// whole. From one frame to the next a hand of constant size has hardly any change at all.
const COVERED_SLACK: f64 = 0.1;
/// What has not been seen whole for so many frames may be no hand that is covered in part, but none.
pub(super) const MOST_COVERED_FRAMES: usize = 90;

/// The template before it has seen a hand.
#[derive(Debug, Clone, Copy)]
pub(super) struct InitialTemplate {
    pub(super) map: AffineMap,
    pub(super) ribbon: RibbonVector,
    pub(super) measure: BandMeasure,
}

/// The hand as it is known now.
#[derive(Debug, Clone)]
pub(super) struct Hand {
    pub(super) shape: Shape,
    /// The band template when the hand was acquired; its widths and taper follow slowly.
    pub(super) acquired: RibbonVector,
    /// What the acquired hand shows.
    pub(super) kind: Kind,
    /// Where along its finger the samples stand: as far as that shows.
    pub(super) measure: BandMeasure,
    /// The planar template moulded to this hand; unused by the band model.
    pub(super) fitted: Vec<TemplateSample>,
    /// What it looks like, once it was seen.
    pub(super) appearance: Option<AppearanceModel>,
    /// The flank of its finger that is as dark as what is behind it, if it was acquired with one.
    pub(super) shaded: Option<Part>,
    /// Where it was when they were last learned \[px\], and the frames that it was tracked since.
    pub(super) taught_at_px: Vector2<f64>,
    pub(super) untaught_frames: usize,
    /// Frames in a row in which its thumb was not seen.
    pub(super) thumb_missed: usize,
    /// Whether its finger is straight, for how many frames in a row it has not been, and how often
    /// it has been since it was acquired.
    pub(super) bend_state: BendState,
    pub(super) bent_frames: usize,
    pub(super) straight_frames: usize,
    /// Whether it was found again in the last frame: how fast it moves is not known.
    pub(super) is_back: bool,
    /// Root mean square of its edges' residual offsets as it is seen usually \[px\]; infinite as
    /// long as that is not known.
    pub(super) usual_px: f64,
    /// Frames since nearly all of its contour was last explained.
    pub(super) partly_frames: usize,
    /// Whether something may cover it in part, for all that is known of it.
    pub(super) is_covered: bool,
}

/// A lost hand: where it was last, and what it showed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct LastKnown {
    pub(super) shape: Shape,
    pub(super) kind: Kind,
    pub(super) measure: BandMeasure,
}

/// How far a convergence looks along the normals, and whether by the pixels' votes or by edges.
#[derive(Debug, Clone, Copy)]
pub(super) struct SearchPlan {
    pub(super) half_length_px: f64,
    /// As [`FitStage::edges_within_px`].
    pub(super) edges_within_px: f64,
    pub(super) edge_cue: EdgeCue,
    pub(super) scale: Scale,
    pub(super) window: Option<Window>,
    pub(super) rest: StageEnd,
    /// One sample in so many takes part.
    pub(super) every: usize,
    pub(super) own_only: bool,
}

impl InitialTemplate {
    /// What a hand would show that is just like the template.
    pub(super) fn kind(&self, options: &TrackerOptions) -> Kind {
        Kind { has_thumb: self.measure.side != 0.0, polarity: options.polarity }
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
        if self.kind.has_thumb { samples } else { finger_samples(samples) }
    }

    /// The planar template's samples: those moulded to this hand, or the waiting template's.
    pub(super) fn planar<'a>(&'a self, samples: &'a [TemplateSample]) -> &'a [TemplateSample] {
        if self.fitted.is_empty() { samples } else { &self.fitted }
    }

    /// What is kept of it where it is lost in this shape.
    pub(super) fn remembered(&self, shape: Shape) -> LastKnown {
        LastKnown { shape, kind: self.kind, measure: self.measure }
    }

    /// Lets the dimensions that a hand cannot change follow slowly: it may come nearer.
    pub(super) fn grow(&mut self) {
        if let Shape::Ribbon(x) = self.shape {
            for k in [3, 4, 8] {
                self.acquired[k] += HELD_RATE * (x[k] - self.acquired[k]);
            }
        }
    }

    /// By how much a finger of this half-width at its anchor \[px\] and taper is wider so far ahead of
    /// there \[px\], and more tapered, than the hand's is known to be.
    pub(super) fn shape_mismatch(
        &self,
        half_width_px: f64,
        taper: f64,
        ahead_px: f64,
    ) -> Vector2<f64> {
        let more_tapered = taper - self.acquired[4];
        Vector2::new(half_width_px - self.acquired[3] + ahead_px * more_tapered, more_tapered)
    }

    /// Leaves out a thumb that was not seen for so many frames: it would hide the finger.
    pub(super) fn count_thumb(&mut self, found: &FitResult, most_missed: usize) {
        let seen = found.fit.is_some_and(|f| f.shape.names.len() == RIBBON_DOF);
        self.thumb_missed = if seen { 0 } else { self.thumb_missed + 1 };
        if self.thumb_missed >= most_missed && matches!(self.shape, Shape::Ribbon(_)) {
            self.kind.has_thumb = false;
        }
    }

    /// The hand's samples where a shape puts them, but for those that another limb hides.
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
                let measure = self.measure.with_thumb(self.kind.has_thumb);
                if let Ok(space) = Ribbon::<RIBBON_DOF>::about(x, &measure) {
                    let pose = space.pose(x);
                    let placed = self.bands(samples).iter().map(|s| (s, pose.place(s)));
                    let seen = placed.filter(|(s, p)| !pose.is_hidden(s, p));
                    seen.for_each(|(s, p)| each(s.part(), p));
                }
            }
        }
    }

    /// How many of its samples are the finger's: the first ones.
    pub(super) fn fingers(&self, samples: &[TemplateSample]) -> usize {
        match self.shape {
            Shape::Ribbon(_) => finger_samples(samples).len(),
            Shape::Planar(_) => finger_samples(self.planar(samples)).len(),
        }
    }

    /// A search for these samples by what is known of the hand.
    pub(super) fn stage<'a>(
        &'a self,
        samples: &'a [TemplateSample],
        frame: &Scene<'_>,
        plan: SearchPlan,
        polarity: Polarity,
    ) -> FitStage<'a> {
        let SearchPlan {
            half_length_px,
            edges_within_px,
            scale,
            edge_cue,
            window,
            rest,
            every,
            own_only,
        } = plan;
        let search_model = self.search_model(frame, edge_cue, polarity);
        let most_scale_px = if own_only { self.most_scale_px() } else { f64::INFINITY };
        FitStage {
            samples,
            every,
            search_model,
            scale,
            half_length_px,
            edges_within_px,
            window,
            rest,
            own_only,
            most_scale_px,
        }
    }

    /// Whether it was seen whole of late: what never was may be none, and moves as it likes.
    pub(super) fn is_known_whole(&self) -> bool {
        self.partly_frames < MOST_COVERED_FRAMES
    }

    /// Whether a fit explains nearly all of its contour, by edges that scatter as usual.
    pub(super) fn is_whole(&self, found: &FitResult) -> bool {
        let scatters_as_usual = |fit: &Fit| fit.residual_rms_px <= self.most_scale_px();
        found.explained() >= SURE && found.fit.as_ref().is_some_and(scatters_as_usual)
    }

    /// Whether the last fit that counts is that of all of a hand, or of one that was never seen whole.
    pub(super) fn shows_what_is_usual(&self) -> bool {
        self.partly_frames == 0 || !self.is_known_whole()
    }

    /// Notes whether something may cover it where it was found.
    pub(super) fn note_covered(&mut self, found: &FitResult) {
        self.is_covered = self.is_known_whole() && !self.is_whole(found);
    }

    /// Notes whether a fit that counts explains nearly all of its contour.
    pub(super) fn count_partly(&mut self, found: &FitResult) {
        self.partly_frames =
            if self.is_whole(found) { 0 } else { self.partly_frames.saturating_add(1) };
    }

    /// Takes over what the edges of a fit that counts scatter. What covers a hand that is known
    /// whole has edges that are not its own.
    pub(super) fn learn_usual(&mut self, found: &FitResult) {
        if let Some(fit) = found.fit.filter(|_| self.shows_what_is_usual()) {
            self.usual_px += USUAL_RATE * (fit.residual_rms_px - self.usual_px);
        }
    }

    /// By how much the edges of a fit scatter more than is usual, as a standard deviation \[px\]:
    /// a hand that is known whole does not, but what covers it.
    pub(super) fn unusual_px(&self, fit: &Fit) -> f64 {
        if self.shows_what_is_usual() {
            return 0.0;
        }
        (fit.residual_rms_px.powi(2) - self.most_scale_px().powi(2)).max(0.0).sqrt()
    }

    /// What its edges scatter at most about a fit in its place \[px\].
    pub(super) fn most_scale_px(&self) -> f64 {
        (USUAL_TIMES * self.usual_px).max(USUAL_LEAST_PX)
    }

    /// An edge may be its own only this near to a fit in its place \[px\].
    pub(super) fn own_within_px(&self) -> f64 {
        (OWN_SCALES * self.most_scale_px()).min(SUPPORT_PX)
    }

    /// How freely its dimensions change, in parts of how freely they do while all of it is seen: what
    /// covers it makes it neither wider nor slimmer, but the longer it lasts the more they may have
    /// changed.
    pub(super) fn slack(&self) -> f64 {
        let since = self.partly_frames as f64 / MOST_COVERED_FRAMES as f64;
        (COVERED_SLACK + (1.0 - COVERED_SLACK) * since).min(1.0)
    }

    /// How to look for it in a frame.
    pub(super) fn search_model(
        &self,
        frame: &Scene<'_>,
        edge_cue: EdgeCue,
        polarity: Polarity,
    ) -> SearchModel<'_> {
        let known =
            self.appearance.as_ref().and_then(|l| l.search_model(frame, edge_cue, polarity));
        known.unwrap_or(SearchModel::unknown(polarity))
    }

    /// Whether a mixture of colours shows it better than the grey image.
    pub(super) fn is_mixed(&self) -> bool {
        self.appearance.as_ref().is_some_and(AppearanceModel::is_mixed)
    }

    /// Whether its looks are known so far that this frame can show them.
    pub(super) fn is_shown_in(&self, frame: &Scene<'_>) -> bool {
        self.appearance.as_ref().is_some_and(|l| !l.is_coloured() || frame.colour().is_some())
    }
}

impl SearchPlan {
    pub(super) fn edges(half_length_px: f64) -> Self {
        Self {
            half_length_px,
            edges_within_px: f64::INFINITY,
            edge_cue: EdgeCue::HandEdges,
            scale: Scale::Fine,
            window: None,
            rest: StageEnd::Reported,
            every: 1,
            own_only: false,
        }
    }
}
