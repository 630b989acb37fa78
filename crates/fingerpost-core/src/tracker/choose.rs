//! Where a followed hand is: the ways to settle on it, each weighed by what tells for and against it.

use super::ContourTracker;
use super::convergence::SUPPORT_PX;
use super::follow::Foretold;
use super::found::Found;
use super::hand::{Look, SURE};
use super::looks::{Lead, Shaft};
use super::options::TrackerOptions;
use super::scene::Scene;
use super::seek::Judged;
use super::settle::Path;
use super::shape::Shape;
use crate::Result;
use crate::search::{MAX_HALF_LENGTH_PX, Scale};
use crate::shape_space::{Rigid, Translation};
use crate::template::Limb;

/// A fit whose motion costs no more than this needs no second look from afar.
const UNSURPRISING: f64 = 0.1;
/// A contour of which less than this looks like the hand may be seen in another light.
const UNLIKE: f64 = 0.3;
/// What an edge counts that does not look like the hand inside, beside one that does: in a new light
/// none does.
const OTHERS_SAY: f64 = 0.1;
/// Most of a hand's edges look like it inside: where less than this part do, they may be another's.
const MOST: f64 = 0.7;
/// Once the votes have been sought, their changes are looked for this part of the way, for the hand
/// may have turned besides.
const SOUGHT: f64 = 0.5;
/// Turns of the hand that are sought \[rad\].
const SOUGHT_TURNS_RAD: [f64; 3] = [0.0, -0.25, 0.25];

/// Where the hand was found.
pub(super) struct Sought {
    pub(super) found: Found,
    /// How far it may have been pushed back along its finger by what covers the tip \[px\].
    pub(super) pushed_px: f64,
    /// What its edges count, 0–1: all of them where most look like the hand inside.
    pub(super) likeness: f64,
}

/// One of the places where the hand may be.
struct Way {
    found: Found,
    path: Path,
    /// The part of the finger's contour whose edge is explained and looks like the hand inside; what goes
    /// on ahead of its tip has a contour too.
    own: f64,
    /// What its motion costs; ∞ if no hand can have become or moved to it, or it is no fit.
    cost: f64,
}

/// How a hand has moved to a place.
struct Moved {
    /// As [`Way::cost`].
    cost: f64,
    /// Whether a hand that moves as it did would hardly be there.
    surprises: bool,
}

impl Way {
    /// How well it explains the contour, less what its motion costs. Edges that do not look like the
    /// hand inside may be those of what covers it.
    fn worth(&self) -> f64 {
        let others = (self.found.explained() - self.own).max(0.0);
        self.own + OTHERS_SAY * others - self.cost
    }
}

/// The best of the ways that were tried.
struct Choice {
    best: Way,
    /// Whether it was the last one tried, so that its search need not be done again.
    is_last: bool,
    /// Of those that no hand can have become or moved to the one that explains its contour best, if that
    /// is as much as a hand that is sure shows.
    impossible: Option<Way>,
}

impl Choice {
    fn of(way: Way) -> Self {
        Self { best: way, is_last: true, impossible: None }
    }

    /// Takes a way into account that was tried next: of equals the last one is the best.
    fn or(&mut self, way: Way) {
        let is_better = way.worth() >= self.best.worth();
        let other = self.settle_for(way, is_better);
        let explained = self.impossible.as_ref().map_or(SURE, |way| way.found.explained());
        if other.cost.is_infinite() && other.found.explained() >= explained {
            self.impossible = Some(other);
        }
    }

    /// The same of a way that is or is not better; tells the other one.
    fn settle_for(&mut self, way: Way, is_better: bool) -> Way {
        self.is_last = is_better;
        if is_better { std::mem::replace(&mut self.best, way) } else { way }
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
        foretold: Option<&Foretold>,
    ) -> Result<Sought> {
        let path = (predicted, Scale::Fine, foretold.map(|f| f.window), Lead::HandEdges);
        let near = self.settle(frame, path)?;
        let pushed_px = self.goes_on_px(frame, &near.shape)?;
        if self.is_plain(&near, foretold)? && pushed_px == 0.0 {
            return match foretold {
                Some(_) => Ok(Sought { found: near, pushed_px, likeness: 1.0 }),
                None => self.sought(frame, near, pushed_px),
            };
        }
        let foretold = foretold.map(|f| f.pushed(pushed_px));
        let foretold = foretold.as_ref();
        let uncovered =
            (near.fit.is_some() && pushed_px > 0.0).then(|| near.shape.ahead(pushed_px));
        let mut choice = Choice::of(self.weighed(frame, near, path, foretold)?);
        self.try_steady(frame, &mut choice, predicted, foretold)?;
        let reach_px = reach_px.min(MAX_HALF_LENGTH_PX as f64);
        let approached = self.approach(frame, predicted, reach_px)?;
        self.try_from_afar(frame, &mut choice, approached, foretold)?;
        // What covers the tip has pushed it back, for as many frames as it took.
        if let Some(from) = uncovered {
            let path = (from, Scale::Fine, None, Lead::HandEdges);
            choice.or(self.way(frame, path, foretold)?);
        }
        self.try_in_grey(frame, &mut choice, approached, foretold)?;
        self.try_in_another_light(frame, &mut choice, predicted, foretold)?;
        let Choice { best, is_last, impossible } = choice;
        // What no hand can have become or moved to is told as such, where no hand is left.
        let no_hand = best.found.explained() < self.options.track.accept.min_inliers;
        let found = match impossible.filter(|_| no_hand) {
            Some(way) => self.settle(frame, way.path)?,
            None if is_last => best.found,
            // Once more, so that the last search is that of the best.
            None => self.settle(frame, best.path)?,
        };
        self.sought(frame, found, pushed_px)
    }

    /// A hand that was seen whole lately may be covered in part and go on as it did.
    fn try_steady(
        &mut self,
        frame: &Scene<'_>,
        choice: &mut Choice,
        predicted: Shape,
        foretold: Option<&Foretold>,
    ) -> Result<()> {
        if let Some(foretold) = foretold
            && self.hand.is_known_whole()
        {
            let path = self.steadily(predicted, foretold, Lead::HandEdges);
            choice.or(self.way(frame, path, Some(foretold))?);
        }
        Ok(())
    }

    /// To where a hand is that goes on as it did.
    fn steadily(&self, predicted: Shape, foretold: &Foretold, lead: Lead) -> Path {
        (predicted, Scale::Fine, Some(self.pace.steady(&foretold.window)), lead)
    }

    /// Where the votes have led, a larger kernel sees edges that motion has smeared.
    fn try_from_afar(
        &mut self,
        frame: &Scene<'_>,
        choice: &mut Choice,
        approached: Shape,
        foretold: Option<&Foretold>,
    ) -> Result<()> {
        let smeared =
            self.way(frame, (approached, Scale::Coarse, None, Lead::HandEdges), foretold)?;
        let sharp = (smeared.found.shape, Scale::Fine, None, Lead::HandEdges);
        choice.or(smeared);
        choice.or(self.way(frame, sharp, foretold)?);
        Ok(())
    }

    /// Where the best shows less than a hand must show to be acquired, the mixture of colours that tells
    /// the hand from most of what was behind it may not tell it from what is behind it now: in the grey
    /// image the hand has an edge before what is darker and before what is lighter, and is believed to be
    /// there if it shows as much as a followed hand must. One that is lit from one side shows less there.
    fn try_in_grey(
        &mut self,
        frame: &Scene<'_>,
        choice: &mut Choice,
        approached: Shape,
        foretold: Option<&Foretold>,
    ) -> Result<()> {
        let TrackerOptions { acquire, track, .. } = &self.options;
        let (enough, least) = (acquire.accept.min_inliers, track.accept.min_inliers);
        let is_mixed = self.hand.is_mixed() && self.hand.shaded.is_none();
        if is_mixed && choice.best.worth() < enough {
            let grey =
                self.way(frame, (approached, Scale::Fine, None, Lead::GreyEdges), foretold)?;
            let is_better = grey.worth() > choice.best.worth().max(least);
            choice.settle_for(grey, is_better);
        }
        Ok(())
    }

    /// Where nothing looks like the hand and all its edges are in their place, the light has changed.
    fn try_in_another_light(
        &mut self,
        frame: &Scene<'_>,
        choice: &mut Choice,
        predicted: Shape,
        foretold: Option<&Foretold>,
    ) -> Result<()> {
        if let Some(foretold) = foretold
            && choice.best.worth() < UNLIKE
        {
            let path = self.steadily(predicted, foretold, Lead::AnyEdge);
            let relit = self.way(frame, path, Some(foretold))?;
            let is_better = self.is_plain(&relit.found, Some(foretold))?;
            choice.settle_for(relit, is_better);
        }
        Ok(())
    }

    /// What the last search has found. Edges that do not look like the hand count less, unless looks did
    /// not lead to them.
    fn sought(&mut self, frame: &Scene<'_>, found: Found, pushed_px: f64) -> Result<Sought> {
        let most = MOST * found.explained();
        let by_looks = found.fit.is_some_and(|fit| fit.by_looks);
        let likeness = if by_looks && most > 0.0 {
            (self.own_share(frame, found.edges(), SUPPORT_PX)? / most).clamp(OTHERS_SAY, 1.0)
        } else {
            1.0
        };
        Ok(Sought { found, pushed_px, likeness })
    }

    /// A way to settle, tried.
    fn way(&mut self, frame: &Scene<'_>, path: Path, foretold: Option<&Foretold>) -> Result<Way> {
        let found = self.settle(frame, path)?;
        self.weighed(frame, found, path, foretold)
    }

    /// What was found in the last search, and what tells for and against it.
    fn weighed(
        &mut self,
        frame: &Scene<'_>,
        found: Found,
        path: Path,
        foretold: Option<&Foretold>,
    ) -> Result<Way> {
        let cost = match found.fit {
            Some(_) => self.motion(&found, foretold)?.cost,
            None => f64::INFINITY,
        };
        let beyond = self.goes_on_px(frame, &found.shape)? / self.hand.measure.length_px;
        let own = self.own_share(frame, found.edges(), self.hand.own_within_px())? / (1.0 + beyond);
        Ok(Way { found, path, own, cost })
    }

    /// The part of the finger's contour whose edge the last search has found and explains to within so
    /// much, and looks like the hand inside.
    fn own_share(&mut self, frame: &Scene<'_>, edges: Lead, within_px: f64) -> Result<f64> {
        let samples = self.hand.fingers(&self.samples);
        let sight = self.hand.sight(frame, edges, self.options.polarity);
        self.convergence.own_share(frame, &sight, samples, within_px)
    }

    /// How far the hand goes on ahead of the tip of a finger \[px\], for all that looks tell.
    fn goes_on_px(&mut self, frame: &Scene<'_>, shape: &Shape) -> Result<f64> {
        let Shape::Ribbon(x) = shape else { return Ok(0.0) };
        let shaft = Shaft::of_band(x, self.hand.measure.length_px);
        let sight = self.hand.sight(frame, Lead::Votes, self.options.polarity);
        let Some(looks) = sight.cue.appearance() else { return Ok(0.0) };
        let shown =
            self.convergence.shown_about(frame, sight.mixture, shaft.places_ahead(), 1.0)?;
        Ok(shaft.goes_on_px(&shown, looks))
    }

    /// Whether a fit leaves nothing to ask: nearly all of the contour is explained, where a hand would
    /// be that goes on as it did.
    fn is_plain(&self, found: &Found, foretold: Option<&Foretold>) -> Result<bool> {
        Ok(self.hand.is_whole(found) && !self.motion(found, foretold)?.surprises)
    }

    /// What the way to a fit costs, and whether it surprises.
    fn motion(&self, found: &Found, foretold: Option<&Foretold>) -> Result<Moved> {
        let followed = foretold.map(|f| f.followed(found)).transpose()?.flatten();
        let innovation = followed.as_ref().and_then(|(_, innovation)| innovation.as_ref());
        let possible = self.known(&self.options.track.accept, innovation).is_possible(&found.shape);
        let cost = match (possible, innovation) {
            (Err(_), _) => f64::INFINITY,
            (Ok(()), Some(i)) if self.hand.is_known_whole() => self.pace.cost(i),
            _ => 0.0,
        };
        let surprises = cost > UNSURPRISING
            || innovation.is_some_and(|i| i.normalised_square() > self.surprise);
        Ok(Moved { cost, surprises })
    }

    /// From afar: by the votes of pixels, if they are known, to about the right place; then the
    /// template moves, then turns, until it covers what looks like the hand.
    fn approach(&mut self, frame: &Scene<'_>, from: Shape, reach_px: f64) -> Result<Shape> {
        let (from, look) = if self.hand.votes_in(frame) {
            let look = Look { lead: Lead::Votes, ..Look::edges(SOUGHT * reach_px) };
            (self.seek(frame, from, reach_px)?, look)
        } else {
            (from, Look::edges(reach_px))
        };
        Ok(match from {
            Shape::Planar(map) => {
                let moved = self.planar::<Translation, 2>(frame, map, look)?;
                Shape::Planar(self.planar::<Rigid, 3>(frame, moved.shape, look)?.shape)
            }
            Shape::Ribbon(x) => {
                let moved = self.run_ribbon::<2>(frame, &x, Limb::Thumb, look, None)?;
                Shape::Ribbon(self.run_ribbon::<3>(frame, &moved.x, Limb::Finger, look, None)?.x)
            }
        })
    }

    /// The pose about another that looks most like the hand.
    fn seek(&mut self, frame: &Scene<'_>, about: Shape, reach_px: f64) -> Result<Shape> {
        let Self { hand, samples, seek, convergence, options, .. } = self;
        let sight = hand.sight(frame, Lead::Votes, options.polarity);
        let Some(appearance) = sight.cue.appearance() else { return Ok(about) };
        let mut best = (f32::NEG_INFINITY, about);
        for turn_rad in SOUGHT_TURNS_RAD {
            let mut placement = about.placement();
            placement[2] += turn_rad;
            seek.clear(hand.acquired[3]);
            let turned = about.placed(&placement);
            hand.outline(&turned, samples, |_, placed| seek.push(&placed));
            let shown = convergence.shown_about(frame, sight.mixture, seek.pixels(), reach_px)?;
            let Judged { by_px, separation } = seek.best(&shown, appearance, reach_px);
            if separation > best.0 {
                placement[0] += by_px.x;
                placement[1] += by_px.y;
                best = (separation, about.placed(&placement));
            }
        }
        Ok(best.1)
    }
}
