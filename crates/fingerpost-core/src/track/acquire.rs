//! *Acquiring*, for the first time or after a loss: the initial template is fitted to a hand, the
//! fit settles, is refined with the hand's own appearance model, and is tracked from there.

use super::appearance::EdgeCue;
use super::axis_curvature::AxisCurvature;
use super::fit_result::{FitResult, Refusal};
use super::fit_stages::ACQUISITION_SLACK;
use super::foreground_test::ForegroundTest;
use super::hand::{LastKnown, MOST_COVERED_FRAMES};
use super::hypotheses::Selection;
use super::initialise::TemplateInitialiser;
use super::line_comparison::LineComparison;
use super::motion_prediction::misfit;
use super::motion_prior::MotionPrior;
use super::options::{AcceptOptions, AcquireOptions, Model};
use super::outcome::{Track, track};
use super::scene::Scene;
use super::separation::stands_out;
use super::shape::Shape;
use super::silhouette::Shaft;
use super::stage::SearchPlan;
use super::status::Status;
use super::tracker::{ContourTracker, LOST_REACH, NEAR_PX, Phase};
use super::validation::BendState;
use crate::Result;
use crate::geometry::planar::AffineMap;
use crate::geometry::ribbon::{RIBBON_DOF, RibbonVector};
use crate::geometry::shape_space::{Pose, ShapeSpace};
use crate::geometry::template::{Limb, Part};
use crate::measure::edge::Scale;
use crate::solve::dynamics::Dynamics;
use nalgebra::Vector2;

/// Iterations of learning the settled hand's colours and refitting it by them.
const COLOUR_REFIT_ROUNDS: usize = 3;
/// Largest rotation of the settled hand by the fit with its appearance model \[rad\]: the line must
/// not depend on the search model.
const MOST_TURNED_RAD: f64 = 0.2;
/// Largest lateral displacement by that fit, as a fraction of the half-width.
const MAX_LATERAL: f64 = 0.5;
/// Largest displacement by that fit, as a fraction of the template's length, unless the range of
/// the initial search is larger.
const MOST_SLID: f64 = 0.5;
/// Class separation and explained contour must both keep at least this fraction of their previous
/// values.
const KEPT_SEPARATION: f64 = 0.9;

impl ContourTracker {
    /// One frame of the search for a lost hand: at its last pose, then at the start pose.
    pub(super) fn recover(
        &mut self,
        scene: &Scene<'_>,
        time_s: f64,
        settled: usize,
        last: LastKnown,
    ) -> Result<Track> {
        let LastKnown { shape, model, measure } = last;
        let model_before = std::mem::replace(&mut self.hand.model, model);
        self.hand.measure = measure;
        let reach_px = LOST_REACH * self.largeness() * self.options.track.half_length_px;
        let accept = self.options.acquire.accept;
        let Selection { found, likeness, .. } = self.find(scene, shape, reach_px, None)?;
        let validation = self.validation(&accept, None);
        if let (Ok(()), Some(fit)) = (validation.judge(&found, likeness), &found.fit) {
            let min_inliers = validation.min_agreement(fit, likeness);
            let accept = AcceptOptions { min_inliers, ..accept };
            let bend = self.bend(scene, &found)?;
            let bend_state = self.hand.bend_state.after(bend.as_ref(), &found);
            if !bend_state.is_bent() {
                self.hand.shape = found.shape;
                self.start(time_s, &found, bend_state)?;
                self.hand.is_back = true;
                let track = self.tracked(scene, time_s, &found, &accept)?;
                return Ok(track.bent(bend.as_ref()));
            }
        }
        self.hand.model = model_before;
        self.hand.measure = self.initial.measure;
        self.acquire(scene, time_s, settled, Some(last))
    }

    /// One frame of acquisition, for the first time or after a loss.
    pub(super) fn acquire(
        &mut self,
        scene: &Scene<'_>,
        time_s: f64,
        settled: usize,
        lost: Option<LastKnown>,
    ) -> Result<Track> {
        let AcquireOptions { accept, settle_frames, settle_change, .. } = self.options.acquire;
        let width_before = self.hand.shape.width();
        let (mut found, mut refusal) = self.search_initial(scene, settled)?;
        if refusal.is_some() && (1..settle_frames).contains(&settled) {
            // It has moved beyond the range of the edge search; the initial template is tried
            // again.
            (found, refusal) = self.search_initial(scene, 0)?;
        }
        let accepted = refusal.is_none();
        let change = (found.shape.width() / width_before - 1.0).abs();
        let settled = match (accepted, settled) {
            (false, _) => 0,
            (true, 0) => 1,
            (true, n) if change <= settle_change => n + 1,
            (true, _) => 1,
        };
        if accepted {
            self.hand.shape = found.shape;
        } else {
            self.hand.shape = self.initial.shape(&self.template);
            self.hand.model = self.initial.model(&self.options);
        }
        self.hand.measure = self.initial.measure;
        let mut misfit_bend = None;
        if settled >= settle_frames {
            let before = self.hand.clone();
            if let Some(acquired) = self.freeze(scene, &found)? {
                let bend = self.bend(scene, &acquired)?;
                let bend_state = BendState::Straight.after(bend.as_ref(), &acquired);
                if !bend_state.is_bent() {
                    let accept = self.options.track.accept;
                    self.start(time_s, &acquired, bend_state)?;
                    let track = self.tracked(scene, time_s, &acquired, &accept)?;
                    return Ok(track.bent(bend.as_ref()));
                }
                (refusal, misfit_bend) = (Some(Refusal::Misfit), bend);
                self.hand = before;
            } else {
                self.hand = before;
            }
        }
        let (phase, status) = lost
            .map_or((Phase::Acquiring { settled }, Status::Acquiring), |last| {
                (Phase::Lost { last, settled }, Status::Lost)
            });
        self.phase = phase;
        Ok(track(time_s, status, &found, &accept, refusal).bent(misfit_bend.as_ref()))
    }

    /// The fit without the background model, or, if that is refused, with it; and the reason for
    /// refusal.
    pub(super) fn search_initial(
        &mut self,
        scene: &Scene<'_>,
        settled: usize,
    ) -> Result<(FitResult, Option<Refusal>)> {
        let without_background = self.settled(&scene.without_background_in_search(), settled)?;
        if without_background.1.is_none() || scene.background_for_search().is_none() {
            return Ok(without_background);
        }
        self.settled(scene, settled)
    }

    /// The fit at the start pose, or from the last fit, and the reason for refusal. An object on
    /// the table is no hand, nor is the inside of a hand: a finger shows foreground inside its
    /// outline and less of it outside, where the background is known. A thumb may lie before the
    /// hand and is not tested.
    fn settled(
        &mut self,
        scene: &Scene<'_>,
        settled: usize,
    ) -> Result<(FitResult, Option<Refusal>)> {
        let found = self.initialise(scene, settled)?;
        let refusal = found.refusal(&self.options.acquire.accept);
        let is_table = || self.passes_foreground_test(scene, &found.shape) == Some(false);
        let refusal = refusal.or_else(|| is_table().then_some(Refusal::Background));
        Ok((found, refusal))
    }

    /// Result of the [foreground test](ForegroundTest) of the finger; `None` where the background
    /// is unknown.
    fn passes_foreground_test(&self, scene: &Scene<'_>, shape: &Shape) -> Option<bool> {
        let mut foreground_test =
            ForegroundTest::before(scene.background_for_validation()?, shape.width());
        self.hand.outline(shape, &self.samples, |part, placed| {
            if part != Part::Thumb {
                foreground_test.add(&placed);
            }
        });
        foreground_test.is_foreground()
    }

    /// The hand at the start pose, or near the fit of an earlier frame.
    fn initialise(&mut self, scene: &Scene<'_>, settled: usize) -> Result<FitResult> {
        let initialise = TemplateInitialiser {
            options: &self.options,
            samples: &self.samples,
            initial: &self.initial.ribbon,
            measure: self.initial.measure,
        };
        let initialised = match self.hand.shape {
            _ if self.template.proportions().is_none() => {
                let half_length_px = self.options.acquire.reach_px(self.initial.ribbon[3]);
                return self.affine(scene, self.initial.map, half_length_px);
            }
            Shape::Ribbon(x) if settled > 0 => {
                initialise.refit(&mut self.convergence, scene, &x, self.hand.model)?
            }
            _ => initialise.find(&mut self.convergence, scene)?,
        };
        self.hand.model = initialised.model;
        Ok(initialised.hand.into())
    }

    /// Fixes the settled hand's dimensions and appearance, from which tracking starts. `None` if
    /// they are not those of one finger, or if the paper's template cannot take them on or explains
    /// too little.
    fn freeze(&mut self, scene: &Scene<'_>, settled: &FitResult) -> Result<Option<FitResult>> {
        self.hand.shaded = None;
        self.refit_in_colours(scene, settled)?;
        self.find_shaded_flank(scene)?;
        let takes_length = self.takes_length && self.options.model == Model::Ribbon;
        if takes_length && !self.take_length(scene, settled)? {
            return Ok(None);
        }
        let ahead_px = self.initial.measure.round_end_px - self.hand.measure.round_end_px;
        if let Some(appearance) = &mut self.hand.appearance {
            appearance.anchor();
        }
        let frozen = match (self.hand.shape, self.options.model) {
            (Shape::Ribbon(x), Model::Ribbon) => {
                self.hand.acquired = x;
                self.fit_stages(scene, (self.hand.shape, Scale::Fine, None, EdgeCue::HandEdges))?
            }
            (Shape::Ribbon(x), Model::Paper) => {
                self.hand.acquired = x;
                let length_px = self.hand.measure.length_px;
                // A thumb nearly parallel to the finger makes no pistol template; the finger is
                // then used alone.
                let with_thumb = self.hand.model.has_thumb;
                let pistol = self.template.fitted(&x, length_px, with_thumb);
                self.hand.model.has_thumb = with_thumb && pistol.is_ok();
                let Ok(template) = pistol.or_else(|_| self.template.fitted(&x, length_px, false))
                else {
                    return Ok(None);
                };
                self.hand.fitted = template.samples(self.options.samples)?;
                let tip = self.ribbon::<RIBBON_DOF>(&x)?.pose(&x).axis().tip;
                self.affine(scene, AffineMap::upright(tip, x[2], length_px)?, NEAR_PX)?
            }
            (Shape::Planar(map), _) => self.affine(scene, map, NEAR_PX)?,
        };
        // The refit of a resting hand does not slide along the background.
        let displacement = frozen.shape.placement() - settled.shape.ahead(ahead_px).placement();
        let length_px = self.initial.measure.length_px;
        let most_px =
            self.options.acquire.reach_px(self.initial.ribbon[3]).max(MOST_SLID * length_px);
        let (sin, cos) = settled.shape.placement()[2].sin_cos();
        let lateral_px = (displacement.y * cos - displacement.x * sin).abs();
        // A hand that has left the shade has become wider on one side.
        let widened_px =
            self.hand.shaded.map_or(0.0, |_| frozen.shape.width() - settled.shape.width());
        let is_in_place = displacement.xy().norm() <= most_px
            && lateral_px <= MAX_LATERAL * settled.shape.width() + widened_px.max(0.0)
            && displacement[2].sin().abs() <= MOST_TURNED_RAD;
        let accepted = is_in_place
            && frozen.is_accepted(&self.options.track.accept)
            && stands_out(self.finger_separation(scene), frozen.explains_finger(), || {
                self.passes_foreground_test(scene, &frozen.shape)
            });
        if accepted {
            self.hand.shape = frozen.shape;
        }
        Ok(accepted.then_some(frozen))
    }

    /// Learns the settled hand's appearance and refits the hand in the mixture of colours that
    /// separates it best. A shaded flank or the tip, which may have had no contrast in grey, can
    /// appear now.
    fn refit_in_colours(&mut self, scene: &Scene<'_>, settled: &FitResult) -> Result<()> {
        let mut explained_before = settled.explains_finger();
        let mut separation_before = self.finger_separation(scene);
        for _ in 0..COLOUR_REFIT_ROUNDS {
            self.hand.appearance = None;
            self.learn_appearance(scene, 1)?;
            let (Shape::Ribbon(x), true) = (self.hand.shape, self.hand.is_mixed()) else {
                return Ok(());
            };
            let half_length_px = self.options.acquire.reach_px(self.initial.ribbon[3]);
            let plan =
                SearchPlan { edge_cue: EdgeCue::AnyEdge, ..SearchPlan::edges(half_length_px) };
            let turned = self.run_ribbon::<3>(scene, &x, Limb::Finger, plan, None)?;
            self.hand.acquired = x;
            let prior = self.tracked_prior::<5>(&x, ACQUISITION_SLACK);
            let finger =
                self.run_ribbon::<5>(scene, &turned.shape, Limb::Finger, plan, Some(&prior))?;
            let found = FitResult::from(finger);
            if found.is_accepted(&self.options.acquire.accept) {
                self.hand.shape = Shape::Ribbon(with_thumb_of(&x, &finger.shape));
                let now = self.finger_separation(scene);
                let explained = found.explains_finger();
                if now < KEPT_SEPARATION * separation_before
                    || explained < KEPT_SEPARATION * explained_before
                {
                    self.hand.shape = Shape::Ribbon(x);
                    return Ok(());
                }
                (separation_before, explained_before) = (now, explained);
            }
        }
        Ok(())
    }

    /// Separation of the finger's inside from its outside along the contour of the last search.
    pub(super) fn finger_separation(&mut self, scene: &Scene<'_>) -> f64 {
        let Self { hand, samples, convergence, .. } = self;
        let shaft = match &hand.shape {
            Shape::Ribbon(x) => Some(Shaft::of_band(x, hand.measure.length_px)),
            Shape::Planar(_) => None,
        };
        convergence.finger_separation(
            hand.fingers(samples),
            scene,
            &hand.shape.silhouette(),
            shaft.as_ref(),
        )
    }

    /// Starts tracking from a fit.
    fn start(&mut self, time_s: f64, found: &FitResult, bend_state: BendState) -> Result<()> {
        let large = self.largeness();
        self.gate = self.options.gate(large)?;
        let options = &self.options.track.dynamics;
        let (components, gap_s) = (options.components(large), options.longest_gap_s);
        let at = found.shape.placement();
        self.dynamics = Some(Dynamics::start(components, gap_s, time_s, &at, &misfit())?);
        self.motion_prior = MotionPrior::unknown();
        self.line_filter.forget();
        self.axis_curvature = AxisCurvature::default();
        self.line_comparison = LineComparison::default();
        self.hand.usual_px = found.fit.map_or(f64::INFINITY, |fit| fit.residual_rms_px);
        self.hand.partly_frames = MOST_COVERED_FRAMES;
        self.hand.is_covered = false;
        self.hand.count_partly(found);
        self.hand.thumb_missed = 0;
        self.hand.bend_state = bend_state;
        self.hand.is_back = false;
        (self.hand.bent_frames, self.hand.straight_frames) = (0, 0);
        self.phase = Phase::Tracking { missed: 0 };
        Ok(())
    }
}

/// A finger that was fitted alone, with the thumb where that of the hand was.
pub(super) fn with_thumb_of(hand: &RibbonVector, finger: &RibbonVector) -> RibbonVector {
    let displacement = finger.fixed_rows::<2>(0) - hand.fixed_rows::<2>(0);
    let mut combined = *finger;
    combined[5] -= displacement.dot(&Vector2::new(hand[2].cos(), hand[2].sin()));
    combined
}
