//! Localisation of a tracked hand: hypotheses about its pose, each fitted, scored and ranked.

use super::appearance::EdgeCue;
use super::fit_result::FitResult;
use super::fit_stages::Path;
use super::grid_search::ShiftScore;
use super::motion_prediction::MotionPrediction;
use super::options::TrackerOptions;
use super::scene::Scene;
use super::shape::Shape;
use super::silhouette::Shaft;
use super::stage::{SUPPORT_PX, SURE, SearchPlan};
use super::tracker::ContourTracker;
use crate::Result;
use crate::geometry::planar::{Rigid, Translation};
use crate::geometry::template::Limb;
use crate::measure::edge::{MAX_HALF_LENGTH_PX, Scale};
use crate::numeric::ablation::{Mechanism, is_off};

/// Ranking penalty above which a motion is improbable, as a fraction of the contour.
const IMPROBABLE_PENALTY: f64 = 0.1;
/// Score below which a change of light is tried as a hypothesis.
const UNLIKE: f64 = 0.3;
/// Weight of an edge whose inside does not match the appearance model, relative to one that
/// matches. It is positive because in a new light no edge matches.
const UNLIKE_WEIGHT: f64 = 0.1;
/// Expected fraction of the hand's explained edges whose inside matches the appearance model; with
/// a smaller fraction the edges may be another object's, and count less in proportion.
const MOST: f64 = 0.7;
/// Range of the search along normals after the grid search, as a fraction of the grid's range: the
/// hand may also have turned.
const APPROACHED_REACH: f64 = 0.5;
/// Rotations of the grid search \[rad\].
const GRID_TURNS_RAD: [f64; 3] = [0.0, -0.25, 0.25];

/// The selected hypothesis.
pub(super) struct Selection {
    pub(super) found: FitResult,
    /// Distance by which an object that covers the tip may have shifted the fit back along the
    /// finger \[px\].
    pub(super) occlusion_shift_px: f64,
    /// Weight of its edges, 0–1: 1 where the inside of most matches the appearance model.
    pub(super) likeness: f64,
}

/// A hypothesis about the hand's pose, after its fit.
struct Hypothesis {
    found: FitResult,
    path: Path,
    /// Fraction of the finger's contour whose edges are explained and match the appearance model
    /// inside, divided by 1 + d / finger length, where d is the distance that the hand extends
    /// beyond the tip.
    matched: f64,
    /// Penalty on its motion ([`MotionPrior::ranking_penalty`]); ∞ if the hand cannot have changed
    /// or moved to it, or without a fit.
    ///
    /// [`MotionPrior::ranking_penalty`]: super::motion_prior::MotionPrior::ranking_penalty
    ranking_penalty: f64,
}

/// The motion from the last frame to a fit.
struct RankedMotion {
    /// As [`Hypothesis::ranking_penalty`].
    ranking_penalty: f64,
    /// Whether the motion is improbable, by its ranking penalty or by the gate of the innovation.
    is_improbable: bool,
}

impl Hypothesis {
    /// Score: matched + [`UNLIKE_WEIGHT`] (explained − matched) − ranking penalty. Edges whose
    /// inside does not match the appearance model may be those of an occluding object.
    fn score(&self) -> f64 {
        let unmatched = (self.found.explained() - self.matched).max(0.0);
        self.matched + UNLIKE_WEIGHT * unmatched - self.ranking_penalty
    }
}

/// The best of the hypotheses evaluated until now.
struct HypothesisRanking {
    best: Hypothesis,
    /// Whether the best was fitted last, so that its search need not be repeated.
    is_last: bool,
    /// Among hypotheses outside the motion gate, the one with the greatest contour support, if that
    /// is at least [`SURE`].
    impossible: Option<Hypothesis>,
}

impl HypothesisRanking {
    fn starting_with(hypothesis: Hypothesis) -> Self {
        Self { best: hypothesis, is_last: true, impossible: None }
    }

    /// Adds the next hypothesis; of equal scores the last one is the best.
    fn add(&mut self, hypothesis: Hypothesis) {
        let is_better = hypothesis.score() >= self.best.score();
        let other = self.keep_better(hypothesis, is_better);
        let explained =
            self.impossible.as_ref().map_or(SURE, |hypothesis| hypothesis.found.explained());
        if other.ranking_penalty.is_infinite() && other.found.explained() >= explained {
            self.impossible = Some(other);
        }
    }

    /// Adds a hypothesis that is or is not better than the best, and returns the worse one.
    fn keep_better(&mut self, hypothesis: Hypothesis, is_better: bool) -> Hypothesis {
        self.is_last = is_better;
        if is_better { std::mem::replace(&mut self.best, hypothesis) } else { hypothesis }
    }
}

impl ContourTracker {
    /// Finds the hand near a predicted shape. Its edges are usually near and sharp. If they explain
    /// too little of the contour, or the motion is improbable, the hand may have continued as
    /// before and be partly covered, or may be elsewhere; further hypotheses are then tried. The
    /// hypothesis with the highest [score](Hypothesis::score) is selected.
    pub(super) fn find(
        &mut self,
        scene: &Scene<'_>,
        predicted: Shape,
        reach_px: f64,
        prediction: Option<&MotionPrediction>,
    ) -> Result<Selection> {
        let path = (predicted, Scale::Fine, prediction.map(|f| f.window), EdgeCue::HandEdges);
        let near = self.fit_stages(scene, path)?;
        let occlusion_shift_px = self.extension_beyond_tip_px(scene, &near.shape)?;
        if self.is_sufficient(&near, prediction)? && occlusion_shift_px == 0.0 {
            return match prediction {
                Some(_) => Ok(Selection { found: near, occlusion_shift_px, likeness: 1.0 }),
                None => self.selection(scene, &near, occlusion_shift_px),
            };
        }
        let prediction = prediction.map(|f| f.with_occlusion_shift(occlusion_shift_px));
        let prediction = prediction.as_ref();
        let uncovered = (near.fit.is_some() && occlusion_shift_px > 0.0)
            .then(|| near.shape.ahead(occlusion_shift_px));
        let mut ranking =
            HypothesisRanking::starting_with(self.evaluated(scene, &near, path, prediction)?);
        self.try_constant_velocity(scene, &mut ranking, predicted, prediction)?;
        let reach_px = reach_px.min(MAX_HALF_LENGTH_PX as f64);
        let approached = self.approach(scene, predicted, reach_px)?;
        self.try_from_afar(scene, &mut ranking, approached, prediction)?;
        // An object that covers the tip may have shifted the fit back over several frames.
        if let Some(from) = uncovered {
            let path = (from, Scale::Fine, None, EdgeCue::HandEdges);
            ranking.add(self.evaluate_path(scene, path, prediction)?);
        }
        self.try_in_grey(scene, &mut ranking, approached, prediction)?;
        self.try_in_another_light(scene, &mut ranking, predicted, prediction)?;
        let HypothesisRanking { best, is_last, impossible } = ranking;
        // A hypothesis outside the motion gate is reported as such, if no other explains the
        // contour.
        let no_hand = best.found.explained() < self.options.track.accept.min_inliers;
        let found = match impossible.filter(|_| no_hand) {
            Some(hypothesis) => self.fit_stages(scene, hypothesis.path)?,
            None if is_last => best.found,
            // Repeated, so that the last search is that of the best hypothesis.
            None => self.fit_stages(scene, best.path)?,
        };
        self.selection(scene, &found, occlusion_shift_px)
    }

    /// A hand whose whole contour was seen recently may be partly covered and continue at its
    /// velocity.
    fn try_constant_velocity(
        &mut self,
        scene: &Scene<'_>,
        ranking: &mut HypothesisRanking,
        predicted: Shape,
        prediction: Option<&MotionPrediction>,
    ) -> Result<()> {
        if is_off(Mechanism::ConstantVelocity) {
            return Ok(());
        }
        if let Some(prediction) = prediction
            && self.hand.is_known_whole()
        {
            let path = self.constant_velocity_path(predicted, prediction, EdgeCue::HandEdges);
            ranking.add(self.evaluate_path(scene, path, Some(prediction))?);
        }
        Ok(())
    }

    /// The path to the hand at constant velocity.
    fn constant_velocity_path(
        &self,
        predicted: Shape,
        prediction: &MotionPrediction,
        edge_cue: EdgeCue,
    ) -> Path {
        (
            predicted,
            Scale::Fine,
            Some(self.motion_prior.constant_velocity(&prediction.window)),
            edge_cue,
        )
    }

    /// From the result of the log-likelihood ratios, a wider kernel finds edges that motion has
    /// blurred.
    fn try_from_afar(
        &mut self,
        scene: &Scene<'_>,
        ranking: &mut HypothesisRanking,
        approached: Shape,
        prediction: Option<&MotionPrediction>,
    ) -> Result<()> {
        if is_off(Mechanism::Approach) {
            return Ok(());
        }
        let blurred = self.evaluate_path(
            scene,
            (approached, Scale::Coarse, None, EdgeCue::HandEdges),
            prediction,
        )?;
        let sharp_path = (blurred.found.shape, Scale::Fine, None, EdgeCue::HandEdges);
        ranking.add(blurred);
        ranking.add(self.evaluate_path(scene, sharp_path, prediction)?);
        Ok(())
    }

    /// Tries the grey image where the best hypothesis scores below the acquisition threshold. The
    /// mixture of colours that separates the hand from most of its past background may not separate
    /// it from the present one. In the grey image a hand has an edge both before a darker and
    /// before a lighter background. The hypothesis must reach the tracking threshold. It is skipped
    /// for a hand lit from one side, which shows less in grey.
    fn try_in_grey(
        &mut self,
        scene: &Scene<'_>,
        ranking: &mut HypothesisRanking,
        approached: Shape,
        prediction: Option<&MotionPrediction>,
    ) -> Result<()> {
        if is_off(Mechanism::GreyHypothesis) {
            return Ok(());
        }
        let TrackerOptions { acquire, track, .. } = &self.options;
        let (acquire_inliers, track_inliers) =
            (acquire.accept.min_inliers, track.accept.min_inliers);
        let is_mixed = self.hand.is_mixed() && self.hand.shaded.is_none();
        if is_mixed && ranking.best.score() < acquire_inliers {
            let grey = self.evaluate_path(
                scene,
                (approached, Scale::Fine, None, EdgeCue::GreyEdges),
                prediction,
            )?;
            let is_better = grey.score() > ranking.best.score().max(track_inliers);
            ranking.keep_better(grey, is_better);
        }
        Ok(())
    }

    /// Where nothing matches the appearance model but all edges are in place, the light has
    /// changed.
    fn try_in_another_light(
        &mut self,
        scene: &Scene<'_>,
        ranking: &mut HypothesisRanking,
        predicted: Shape,
        prediction: Option<&MotionPrediction>,
    ) -> Result<()> {
        if is_off(Mechanism::RelitHypothesis) {
            return Ok(());
        }
        if let Some(prediction) = prediction
            && ranking.best.score() < UNLIKE
        {
            let path = self.constant_velocity_path(predicted, prediction, EdgeCue::AnyEdge);
            let relit = self.evaluate_path(scene, path, Some(prediction))?;
            let is_better = self.is_sufficient(&relit.found, Some(prediction))?;
            ranking.keep_better(relit, is_better);
        }
        Ok(())
    }

    /// The result of the last search with the weight of its edges. If the appearance model selected
    /// the edges, those that do not match it count less.
    fn selection(
        &mut self,
        scene: &Scene<'_>,
        found: &FitResult,
        occlusion_shift_px: f64,
    ) -> Result<Selection> {
        let expected = MOST * found.explained();
        let by_appearance = found.fit.is_some_and(|fit| fit.by_appearance);
        let likeness = if by_appearance && expected > 0.0 {
            (self.matched_share(scene, found.edges(), SUPPORT_PX)? / expected)
                .clamp(UNLIKE_WEIGHT, 1.0)
        } else {
            1.0
        };
        Ok(Selection { found: *found, occlusion_shift_px, likeness })
    }

    /// Fits and evaluates a hypothesis.
    fn evaluate_path(
        &mut self,
        scene: &Scene<'_>,
        path: Path,
        prediction: Option<&MotionPrediction>,
    ) -> Result<Hypothesis> {
        let found = self.fit_stages(scene, path)?;
        self.evaluated(scene, &found, path, prediction)
    }

    /// The result of the last search with its appearance share and ranking penalty.
    fn evaluated(
        &mut self,
        scene: &Scene<'_>,
        found: &FitResult,
        path: Path,
        prediction: Option<&MotionPrediction>,
    ) -> Result<Hypothesis> {
        let ranking_penalty = match found.fit {
            Some(_) => self.motion(found, prediction)?.ranking_penalty,
            None => f64::INFINITY,
        };
        let extension =
            self.extension_beyond_tip_px(scene, &found.shape)? / self.hand.measure.length_px;
        let matched = self.matched_share(scene, found.edges(), self.hand.matched_within_px())?
            / (1.0 + extension);
        Ok(Hypothesis { found: *found, path, matched, ranking_penalty })
    }

    /// Fraction of the finger's contour whose edges are within `within_px` of the last fit and
    /// match the appearance model inside, 0–1.
    fn matched_share(&mut self, scene: &Scene<'_>, edges: EdgeCue, within_px: f64) -> Result<f64> {
        let samples = self.hand.fingers(&self.samples);
        let search_model = self.hand.search_model(scene, edges, self.options.polarity);
        self.convergence.matched_share(scene, &search_model, samples, within_px)
    }

    /// Distance that the hand extends beyond the tip of a finger, by the appearance model \[px\]; 0
    /// where that is unknown.
    fn extension_beyond_tip_px(&mut self, scene: &Scene<'_>, shape: &Shape) -> Result<f64> {
        if is_off(Mechanism::UncoveredTip) {
            return Ok(0.0);
        }
        let Shape::Ribbon(x) = shape else { return Ok(0.0) };
        let shaft = Shaft::of_band(x, self.hand.measure.length_px);
        let search_model = self.hand.search_model(scene, EdgeCue::LogRatio, self.options.polarity);
        let Some(appearance) = search_model.cue.appearance() else { return Ok(0.0) };
        let search_frame =
            self.convergence.shown_about(scene, search_model.mixture, shaft.places_ahead(), 1.0)?;
        Ok(shaft.extension_beyond_tip_px(&search_frame, appearance))
    }

    /// Whether a fit needs no further hypotheses: it explains nearly all of the contour, and its
    /// motion is not improbable.
    fn is_sufficient(
        &self,
        found: &FitResult,
        prediction: Option<&MotionPrediction>,
    ) -> Result<bool> {
        Ok(self.hand.is_whole(found) && !self.motion(found, prediction)?.is_improbable)
    }

    /// The ranking penalty of the motion to a fit, and whether it is improbable.
    fn motion(
        &self,
        found: &FitResult,
        prediction: Option<&MotionPrediction>,
    ) -> Result<RankedMotion> {
        let followed = prediction.map(|f| f.followed(found)).transpose()?.flatten();
        let innovation = followed.as_ref().and_then(|(_, innovation)| innovation.as_ref());
        let possible =
            self.validation(&self.options.track.accept, innovation).is_possible(&found.shape);
        let ranking_penalty = match (possible, innovation) {
            (Err(_), _) => f64::INFINITY,
            (Ok(()), Some(i)) if self.hand.is_known_whole() => self.motion_prior.ranking_penalty(i),
            _ => 0.0,
        };
        let is_improbable = ranking_penalty > IMPROBABLE_PENALTY
            || innovation.is_some_and(|i| i.normalised_square() > self.innovation_gate);
        Ok(RankedMotion { ranking_penalty, is_improbable })
    }

    /// Coarse localisation. If the appearance model applies, a grid search over the log-likelihood
    /// ratios of pixels comes first. Then the template translates, then rotates as well, along the
    /// normals.
    fn approach(&mut self, scene: &Scene<'_>, from: Shape, reach_px: f64) -> Result<Shape> {
        let (from, plan) = if self.hand.is_shown_in(scene) {
            let plan = SearchPlan {
                edge_cue: EdgeCue::LogRatio,
                ..SearchPlan::edges(APPROACHED_REACH * reach_px)
            };
            (self.grid_search(scene, from, reach_px)?, plan)
        } else {
            (from, SearchPlan::edges(reach_px))
        };
        Ok(match from {
            Shape::Planar(map) => {
                let moved = self.planar::<Translation, 2>(scene, map, plan)?;
                Shape::Planar(self.planar::<Rigid, 3>(scene, moved.shape, plan)?.shape)
            }
            Shape::Ribbon(x) => {
                let moved = self.run_ribbon::<2>(scene, &x, Limb::Thumb, plan, None)?;
                Shape::Ribbon(
                    self.run_ribbon::<3>(scene, &moved.shape, Limb::Finger, plan, None)?.shape,
                )
            }
        })
    }

    /// The pose near another that best separates hand from background pixels.
    fn grid_search(&mut self, scene: &Scene<'_>, about: Shape, reach_px: f64) -> Result<Shape> {
        let Self { hand, samples, grid_search, convergence, options, .. } = self;
        let search_model = hand.search_model(scene, EdgeCue::LogRatio, options.polarity);
        let Some(appearance) = search_model.cue.appearance() else { return Ok(about) };
        let mut best = (f32::NEG_INFINITY, about);
        for turn_rad in GRID_TURNS_RAD {
            let mut placement = about.placement();
            placement[2] += turn_rad;
            grid_search.clear(hand.acquired[3]);
            let turned = about.placed(&placement);
            hand.outline(&turned, samples, |_, placed| grid_search.push(&placed));
            let search_frame = convergence.shown_about(
                scene,
                search_model.mixture,
                grid_search.pixels(),
                reach_px,
            )?;
            let ShiftScore { by_px, separation } =
                grid_search.best(&search_frame, appearance, reach_px);
            if separation > best.0 {
                placement[0] += by_px.x;
                placement[1] += by_px.y;
                best = (separation, about.placed(&placement));
            }
        }
        Ok(best.1)
    }
}
