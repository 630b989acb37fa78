//! Where a followed hand is: the ways to settle on it, each weighed by what tells for and against it.

use super::appearance::EdgeCue;
use super::fit_result::FitResult;
use super::fit_stages::Path;
use super::grid_search::ShiftScore;
use super::hand::SearchPlan;
use super::motion_prediction::MotionPrediction;
use super::options::TrackerOptions;
use super::scene::Scene;
use super::shape::Shape;
use super::silhouette::Shaft;
use super::stage::{SUPPORT_PX, SURE};
use super::tracker::ContourTracker;
use crate::Result;
use crate::geometry::planar::{Rigid, Translation};
use crate::geometry::template::Limb;
use crate::measure::edge::{MAX_HALF_LENGTH_PX, Scale};

/// A fit whose motion costs no more than this needs no second look from afar.
const UNSURPRISING: f64 = 0.1;
/// A contour of which less than this looks like the hand may be seen in another light.
const UNLIKE: f64 = 0.3;
/// What an edge counts that does not look like the hand inside, beside one that does: in a new light
/// none does.
const UNLIKE_WEIGHT: f64 = 0.1;
/// Most of a hand's edges look like it inside: where less than this part do, they may be another's.
const MOST: f64 = 0.7;
/// Once the votes have been sought, their changes are looked for this part of the way, for the hand
/// may have turned besides.
const APPROACHED_REACH: f64 = 0.5;
/// Turns of the hand that are sought \[rad\].
const GRID_TURNS_RAD: [f64; 3] = [0.0, -0.25, 0.25];

/// Where the hand was found.
pub(super) struct Selection {
    pub(super) found: FitResult,
    /// How far it may have been pushed back along its finger by what covers the tip \[px\].
    pub(super) pushed_px: f64,
    /// What its edges count, 0–1: all of them where most look like the hand inside.
    pub(super) likeness: f64,
}

/// One of the places where the hand may be.
struct Hypothesis {
    found: FitResult,
    path: Path,
    /// The part of the finger's contour whose edge is explained and looks like the hand inside; what goes
    /// on ahead of its tip has a contour too.
    own: f64,
    /// What its motion costs; ∞ if no hand can have become or moved to it, or it is no fit.
    cost: f64,
}

/// How a hand has moved to a place.
struct MotionCost {
    /// As [`Hypothesis::cost`].
    cost: f64,
    /// Whether a hand that moves as it did would hardly be there.
    surprises: bool,
}

impl Hypothesis {
    /// How well it explains the contour, less what its motion costs. Edges that do not look like the
    /// hand inside may be those of what covers it.
    fn score(&self) -> f64 {
        let others = (self.found.explained() - self.own).max(0.0);
        self.own + UNLIKE_WEIGHT * others - self.cost
    }
}

/// The best of the ways that were tried.
struct HypothesisRanking {
    best: Hypothesis,
    /// Whether it was the last one tried, so that its search need not be done again.
    is_last: bool,
    /// Of those that no hand can have become or moved to the one that explains its contour best, if that
    /// is as much as a hand that is sure shows.
    impossible: Option<Hypothesis>,
}

impl HypothesisRanking {
    fn starting_with(hypothesis: Hypothesis) -> Self {
        Self { best: hypothesis, is_last: true, impossible: None }
    }

    /// Takes a way into account that was tried next: of equals the last one is the best.
    fn or(&mut self, hypothesis: Hypothesis) {
        let is_better = hypothesis.score() >= self.best.score();
        let other = self.keep_better(hypothesis, is_better);
        let explained =
            self.impossible.as_ref().map_or(SURE, |hypothesis| hypothesis.found.explained());
        if other.cost.is_infinite() && other.found.explained() >= explained {
            self.impossible = Some(other);
        }
    }

    /// The same of a way that is or is not better; tells the other one.
    fn keep_better(&mut self, hypothesis: Hypothesis, is_better: bool) -> Hypothesis {
        self.is_last = is_better;
        if is_better { std::mem::replace(&mut self.best, hypothesis) } else { hypothesis }
    }
}

impl ContourTracker {
    /// The hand about a predicted shape. Its edges are usually near and sharp; when they explain
    /// the contour badly, or by a motion that surprises, it may have gone on as it did and be covered
    /// in part, or have gone elsewhere. What explains the contour best by edges that look like the hand
    /// counts, less what its motion costs.
    pub(super) fn find(
        &mut self,
        frame: &Scene<'_>,
        predicted: Shape,
        reach_px: f64,
        prediction: Option<&MotionPrediction>,
    ) -> Result<Selection> {
        let path = (predicted, Scale::Fine, prediction.map(|f| f.window), EdgeCue::HandEdges);
        let near = self.fit_stages(frame, path)?;
        let pushed_px = self.goes_on_px(frame, &near.shape)?;
        if self.is_plain(&near, prediction)? && pushed_px == 0.0 {
            return match prediction {
                Some(_) => Ok(Selection { found: near, pushed_px, likeness: 1.0 }),
                None => self.selection(frame, near, pushed_px),
            };
        }
        let prediction = prediction.map(|f| f.pushed(pushed_px));
        let prediction = prediction.as_ref();
        let uncovered =
            (near.fit.is_some() && pushed_px > 0.0).then(|| near.shape.ahead(pushed_px));
        let mut ranking =
            HypothesisRanking::starting_with(self.evaluated(frame, near, path, prediction)?);
        self.try_constant_velocity(frame, &mut ranking, predicted, prediction)?;
        let reach_px = reach_px.min(MAX_HALF_LENGTH_PX as f64);
        let approached = self.approach(frame, predicted, reach_px)?;
        self.try_from_afar(frame, &mut ranking, approached, prediction)?;
        // What covers the tip has pushed it back, for as many frames as it took.
        if let Some(from) = uncovered {
            let path = (from, Scale::Fine, None, EdgeCue::HandEdges);
            ranking.or(self.evaluate_path(frame, path, prediction)?);
        }
        self.try_in_grey(frame, &mut ranking, approached, prediction)?;
        self.try_in_another_light(frame, &mut ranking, predicted, prediction)?;
        let HypothesisRanking { best, is_last, impossible } = ranking;
        // What no hand can have become or moved to is told as such, where no hand is left.
        let no_hand = best.found.explained() < self.options.track.accept.min_inliers;
        let found = match impossible.filter(|_| no_hand) {
            Some(hypothesis) => self.fit_stages(frame, hypothesis.path)?,
            None if is_last => best.found,
            // Once more, so that the last search is that of the best.
            None => self.fit_stages(frame, best.path)?,
        };
        self.selection(frame, found, pushed_px)
    }

    /// A hand that was seen whole lately may be covered in part and go on as it did.
    fn try_constant_velocity(
        &mut self,
        frame: &Scene<'_>,
        ranking: &mut HypothesisRanking,
        predicted: Shape,
        prediction: Option<&MotionPrediction>,
    ) -> Result<()> {
        if let Some(prediction) = prediction
            && self.hand.is_known_whole()
        {
            let path = self.constant_velocity_path(predicted, prediction, EdgeCue::HandEdges);
            ranking.or(self.evaluate_path(frame, path, Some(prediction))?);
        }
        Ok(())
    }

    /// To where a hand is that goes on as it did.
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

    /// Where the votes have led, a larger kernel sees edges that motion has smeared.
    fn try_from_afar(
        &mut self,
        frame: &Scene<'_>,
        ranking: &mut HypothesisRanking,
        approached: Shape,
        prediction: Option<&MotionPrediction>,
    ) -> Result<()> {
        let smeared = self.evaluate_path(
            frame,
            (approached, Scale::Coarse, None, EdgeCue::HandEdges),
            prediction,
        )?;
        let sharp = (smeared.found.shape, Scale::Fine, None, EdgeCue::HandEdges);
        ranking.or(smeared);
        ranking.or(self.evaluate_path(frame, sharp, prediction)?);
        Ok(())
    }

    /// Where the best shows less than a hand must show to be acquired, the mixture of colours that tells
    /// the hand from most of what was behind it may not tell it from what is behind it now: in the grey
    /// image the hand has an edge before what is darker and before what is lighter, and is believed to be
    /// there if it shows as much as a followed hand must. One that is lit from one side shows less there.
    fn try_in_grey(
        &mut self,
        frame: &Scene<'_>,
        ranking: &mut HypothesisRanking,
        approached: Shape,
        prediction: Option<&MotionPrediction>,
    ) -> Result<()> {
        let TrackerOptions { acquire, track, .. } = &self.options;
        let (enough, least) = (acquire.accept.min_inliers, track.accept.min_inliers);
        let is_mixed = self.hand.is_mixed() && self.hand.shaded.is_none();
        if is_mixed && ranking.best.score() < enough {
            let grey = self.evaluate_path(
                frame,
                (approached, Scale::Fine, None, EdgeCue::GreyEdges),
                prediction,
            )?;
            let is_better = grey.score() > ranking.best.score().max(least);
            ranking.keep_better(grey, is_better);
        }
        Ok(())
    }

    /// Where nothing looks like the hand and all its edges are in their place, the light has changed.
    fn try_in_another_light(
        &mut self,
        frame: &Scene<'_>,
        ranking: &mut HypothesisRanking,
        predicted: Shape,
        prediction: Option<&MotionPrediction>,
    ) -> Result<()> {
        if let Some(prediction) = prediction
            && ranking.best.score() < UNLIKE
        {
            let path = self.constant_velocity_path(predicted, prediction, EdgeCue::AnyEdge);
            let relit = self.evaluate_path(frame, path, Some(prediction))?;
            let is_better = self.is_plain(&relit.found, Some(prediction))?;
            ranking.keep_better(relit, is_better);
        }
        Ok(())
    }

    /// What the last search has found. Edges that do not look like the hand count less, unless looks did
    /// not lead to them.
    fn selection(
        &mut self,
        frame: &Scene<'_>,
        found: FitResult,
        pushed_px: f64,
    ) -> Result<Selection> {
        let most = MOST * found.explained();
        let by_appearance = found.fit.is_some_and(|fit| fit.by_appearance);
        let likeness = if by_appearance && most > 0.0 {
            (self.own_share(frame, found.edges(), SUPPORT_PX)? / most).clamp(UNLIKE_WEIGHT, 1.0)
        } else {
            1.0
        };
        Ok(Selection { found, pushed_px, likeness })
    }

    /// A way to settle, tried.
    fn evaluate_path(
        &mut self,
        frame: &Scene<'_>,
        path: Path,
        prediction: Option<&MotionPrediction>,
    ) -> Result<Hypothesis> {
        let found = self.fit_stages(frame, path)?;
        self.evaluated(frame, found, path, prediction)
    }

    /// What was found in the last search, and what tells for and against it.
    fn evaluated(
        &mut self,
        frame: &Scene<'_>,
        found: FitResult,
        path: Path,
        prediction: Option<&MotionPrediction>,
    ) -> Result<Hypothesis> {
        let cost = match found.fit {
            Some(_) => self.motion(&found, prediction)?.cost,
            None => f64::INFINITY,
        };
        let beyond = self.goes_on_px(frame, &found.shape)? / self.hand.measure.length_px;
        let own = self.own_share(frame, found.edges(), self.hand.own_within_px())? / (1.0 + beyond);
        Ok(Hypothesis { found, path, own, cost })
    }

    /// The part of the finger's contour whose edge the last search has found and explains to within so
    /// much, and looks like the hand inside.
    fn own_share(&mut self, frame: &Scene<'_>, edges: EdgeCue, within_px: f64) -> Result<f64> {
        let samples = self.hand.fingers(&self.samples);
        let search_model = self.hand.search_model(frame, edges, self.options.polarity);
        self.convergence.own_share(frame, &search_model, samples, within_px)
    }

    /// How far the hand goes on ahead of the tip of a finger \[px\], for all that looks tell.
    fn goes_on_px(&mut self, frame: &Scene<'_>, shape: &Shape) -> Result<f64> {
        let Shape::Ribbon(x) = shape else { return Ok(0.0) };
        let shaft = Shaft::of_band(x, self.hand.measure.length_px);
        let search_model = self.hand.search_model(frame, EdgeCue::LogRatio, self.options.polarity);
        let Some(appearance) = search_model.cue.appearance() else { return Ok(0.0) };
        let shown =
            self.convergence.shown_about(frame, search_model.mixture, shaft.places_ahead(), 1.0)?;
        Ok(shaft.goes_on_px(&shown, appearance))
    }

    /// Whether a fit leaves nothing to ask: nearly all of the contour is explained, where a hand would
    /// be that goes on as it did.
    fn is_plain(&self, found: &FitResult, prediction: Option<&MotionPrediction>) -> Result<bool> {
        Ok(self.hand.is_whole(found) && !self.motion(found, prediction)?.surprises)
    }

    /// What the way to a fit costs, and whether it surprises.
    fn motion(
        &self,
        found: &FitResult,
        prediction: Option<&MotionPrediction>,
    ) -> Result<MotionCost> {
        let followed = prediction.map(|f| f.followed(found)).transpose()?.flatten();
        let innovation = followed.as_ref().and_then(|(_, innovation)| innovation.as_ref());
        let possible =
            self.validation(&self.options.track.accept, innovation).is_possible(&found.shape);
        let cost = match (possible, innovation) {
            (Err(_), _) => f64::INFINITY,
            (Ok(()), Some(i)) if self.hand.is_known_whole() => self.motion_prior.cost(i),
            _ => 0.0,
        };
        let surprises = cost > UNSURPRISING
            || innovation.is_some_and(|i| i.normalised_square() > self.surprise);
        Ok(MotionCost { cost, surprises })
    }

    /// From afar: by the votes of pixels, if they are known, to about the right place; then the
    /// template moves, then turns, until it covers what looks like the hand.
    fn approach(&mut self, frame: &Scene<'_>, from: Shape, reach_px: f64) -> Result<Shape> {
        let (from, plan) = if self.hand.is_shown_in(frame) {
            let plan = SearchPlan {
                edge_cue: EdgeCue::LogRatio,
                ..SearchPlan::edges(APPROACHED_REACH * reach_px)
            };
            (self.grid_search(frame, from, reach_px)?, plan)
        } else {
            (from, SearchPlan::edges(reach_px))
        };
        Ok(match from {
            Shape::Planar(map) => {
                let moved = self.planar::<Translation, 2>(frame, map, plan)?;
                Shape::Planar(self.planar::<Rigid, 3>(frame, moved.shape, plan)?.shape)
            }
            Shape::Ribbon(x) => {
                let moved = self.run_ribbon::<2>(frame, &x, Limb::Thumb, plan, None)?;
                Shape::Ribbon(self.run_ribbon::<3>(frame, &moved.x, Limb::Finger, plan, None)?.x)
            }
        })
    }

    /// The pose about another that looks most like the hand.
    fn grid_search(&mut self, frame: &Scene<'_>, about: Shape, reach_px: f64) -> Result<Shape> {
        let Self { hand, samples, grid_search, convergence, options, .. } = self;
        let search_model = hand.search_model(frame, EdgeCue::LogRatio, options.polarity);
        let Some(appearance) = search_model.cue.appearance() else { return Ok(about) };
        let mut best = (f32::NEG_INFINITY, about);
        for turn_rad in GRID_TURNS_RAD {
            let mut placement = about.placement();
            placement[2] += turn_rad;
            grid_search.clear(hand.acquired[3]);
            let turned = about.placed(&placement);
            hand.outline(&turned, samples, |_, placed| grid_search.push(&placed));
            let shown = convergence.shown_about(
                frame,
                search_model.mixture,
                grid_search.pixels(),
                reach_px,
            )?;
            let ShiftScore { by_px, separation } = grid_search.best(&shown, appearance, reach_px);
            if separation > best.0 {
                placement[0] += by_px.x;
                placement[1] += by_px.y;
                best = (separation, about.placed(&placement));
            }
        }
        Ok(best.1)
    }
}
