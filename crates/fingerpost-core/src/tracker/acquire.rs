//! *Acquiring*, for the first time or after a loss: a hand at the waiting template is moulded,
//! settled on, looked at anew in its own colours, and followed from there.

use super::choose::Sought;
use super::follow::misfit;
use super::found::Found;
use super::hand::{Look, MOST_COVERED_FRAMES, Remembered};
use super::looks::{Lead, Shaft};
use super::mould::{Mould, stands_out};
use super::options::{AcceptOptions, AcquireOptions, Model};
use super::pace::Pace;
use super::sagitta::Sagitta;
use super::scene::Scene;
use super::shape::Shape;
use super::standing::Standing;
use super::track::{Track, track};
use super::verdict::{Posture, Refusal};
use super::worth::Worth;
use super::{ContourTracker, NEAR_PX, Phase, Status};
use crate::Result;
use crate::dynamics::Dynamics;
use crate::search::Scale;
use crate::shape_space::{AffineMap, Pose, RIBBON_DOF, RibbonVector, ShapeSpace};
use crate::template::{Limb, Part};
use nalgebra::Vector2;

/// A hand that is lost, or was until the last frame, is looked for this much further than a tracked one.
pub(super) const LOST_REACH: f64 = 2.0;
/// How often the settled hand is looked at anew in its own colours, and how much more freely than
/// while it is tracked.
const BED_IN_ROUNDS: usize = 3;
const BED_IN_SLACK: f64 = 4.0;
/// A hand that settled has turned by no more than this once its looks are known \[rad\], and slid
/// aside by no more than this part of its half-width: the line does not hang on how it is looked for.
const MOST_TURNED_RAD: f64 = 0.2;
const MOST_ASIDE: f64 = 0.5;
/// And it has slid by no more than this part of the template's length, or what the template reaches.
const MOST_SLID: f64 = 0.5;
/// By these edges, its inside is still told from its outside and its contour is explained to this part
/// of how well they were.
const STILL_TOLD: f64 = 0.9;

impl ContourTracker {
    /// One frame of looking for a lost hand: where it was last, then at the waiting template.
    pub(super) fn recover(
        &mut self,
        frame: &Scene<'_>,
        time_s: f64,
        settled: usize,
        last: Remembered,
    ) -> Result<Track> {
        let Remembered { shape, kind, measure } = last;
        let settling = std::mem::replace(&mut self.hand.kind, kind);
        self.hand.measure = measure;
        let reach_px = LOST_REACH * self.largeness() * self.options.track.half_length_px;
        let accept = self.options.acquire.accept;
        let Sought { found, likeness, .. } = self.find(frame, shape, reach_px, None)?;
        let known = self.known(&accept, None);
        if let (Ok(()), Some(fit)) = (known.judge(&found, likeness), &found.fit) {
            let min_inliers = known.min_agreement(fit, likeness);
            let accept = AcceptOptions { min_inliers, ..accept };
            let bend = self.bend(frame, &found)?;
            let posture = self.hand.posture.after(bend.as_ref(), &found);
            if !posture.is_bent() {
                self.hand.shape = found.shape;
                self.start(time_s, &found, posture)?;
                self.hand.is_back = true;
                let track = self.tracked(frame, time_s, &found, &accept)?;
                return Ok(track.bent(bend.as_ref()));
            }
        }
        self.hand.kind = settling;
        self.hand.measure = self.waiting.measure;
        self.acquire(frame, time_s, settled, Some(last))
    }

    /// One frame of acquisition, for the first time or after a loss.
    pub(super) fn acquire(
        &mut self,
        frame: &Scene<'_>,
        time_s: f64,
        settled: usize,
        lost: Option<Remembered>,
    ) -> Result<Track> {
        let AcquireOptions { accept, settle_frames, settle_change, .. } = self.options.acquire;
        let width_before = self.hand.shape.width();
        let (mut found, mut refusal) = self.seen(frame, settled)?;
        if refusal.is_some() && (1..settle_frames).contains(&settled) {
            // It has moved on farther than edges lead: the template still waits there.
            (found, refusal) = self.seen(frame, 0)?;
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
            self.hand.shape = self.waiting.shape(&self.template);
            self.hand.kind = self.waiting.kind(&self.options);
        }
        self.hand.measure = self.waiting.measure;
        let mut misfit_bend = None;
        if settled >= settle_frames {
            let before = self.hand.clone();
            if let Some(acquired) = self.freeze(frame, &found)? {
                let bend = self.bend(frame, &acquired)?;
                let posture = Posture::Straight.after(bend.as_ref(), &acquired);
                if !posture.is_bent() {
                    let accept = self.options.track.accept;
                    self.start(time_s, &acquired, posture)?;
                    let track = self.tracked(frame, time_s, &acquired, &accept)?;
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

    /// What is found without what is known of the background, or else with it, and why it is no hand.
    pub(super) fn seen(
        &mut self,
        frame: &Scene<'_>,
        settled: usize,
    ) -> Result<(Found, Option<Refusal>)> {
        let alone = self.settled(&frame.alone(), settled)?;
        if alone.1.is_none() || frame.background().is_none() {
            return Ok(alone);
        }
        self.settled(frame, settled)
    }

    /// What is found at the waiting template or where it was, and why it is no hand. What lies on the
    /// table is none, nor is the inside of a hand: a finger shows foreground inside its outline and
    /// less of it outside, as far as what is behind it is known. A thumb may lie before the hand.
    fn settled(&mut self, frame: &Scene<'_>, settled: usize) -> Result<(Found, Option<Refusal>)> {
        let found = self.mould(frame, settled)?;
        let refusal = found.refusal(&self.options.acquire.accept);
        let is_table = || self.stands_free(frame, &found.shape) == Some(false);
        let refusal = refusal.or_else(|| is_table().then_some(Refusal::Background));
        Ok((found, refusal))
    }

    /// Whether a finger stands free of the table; `None` where that is not known.
    fn stands_free(&self, frame: &Scene<'_>, shape: &Shape) -> Option<bool> {
        let mut standing = Standing::before(frame.table()?, shape.width());
        self.hand.outline(shape, &self.samples, |part, placed| {
            if part != Part::Thumb {
                standing.see(&placed);
            }
        });
        standing.is_free()
    }

    /// The hand at the waiting template, or where an earlier frame has found it.
    fn mould(&mut self, frame: &Scene<'_>, settled: usize) -> Result<Found> {
        let mould = Mould {
            options: &self.options,
            samples: &self.samples,
            waiting: &self.waiting.ribbon,
            measure: self.waiting.measure,
        };
        let moulded = match self.hand.shape {
            _ if self.template.proportions().is_none() => {
                let half_length_px = self.options.acquire.reach_px(self.waiting.ribbon[3]);
                return self.affine(frame, self.waiting.map, half_length_px);
            }
            Shape::Ribbon(x) if settled > 0 => {
                mould.refit(&mut self.convergence, frame, &x, self.hand.kind)?
            }
            _ => mould.find(&mut self.convergence, frame)?,
        };
        self.hand.kind = moulded.kind;
        Ok(moulded.hand.into())
    }

    /// Keeps the settled hand's dimensions and looks: tracking starts from them. None if they are not
    /// those of one finger, or the paper's template cannot take them on or explains them badly.
    fn freeze(&mut self, frame: &Scene<'_>, settled: &Found) -> Result<Option<Found>> {
        self.hand.shaded = None;
        self.bed_in(frame, settled)?;
        self.leave_shade(frame)?;
        let takes_length = self.takes_length && self.options.model == Model::Ribbon;
        if takes_length && !self.take_length(frame, settled)? {
            return Ok(None);
        }
        let ahead_px = self.waiting.measure.round_end_px - self.hand.measure.round_end_px;
        if let Some(looks) = &mut self.hand.looks {
            looks.anchor();
        }
        let frozen = match (self.hand.shape, self.options.model) {
            (Shape::Ribbon(x), Model::Ribbon) => {
                self.hand.acquired = x;
                self.settle(frame, (self.hand.shape, Scale::Fine, None, Lead::HandEdges))?
            }
            (Shape::Ribbon(x), Model::Paper) => {
                self.hand.acquired = x;
                let length_px = self.hand.measure.length_px;
                // A thumb that the image shows nearly along the finger makes no pistol; the finger
                // does without it.
                let with_thumb = self.hand.kind.has_thumb;
                let pistol = self.template.moulded(&x, length_px, with_thumb);
                self.hand.kind.has_thumb = with_thumb && pistol.is_ok();
                let Ok(template) = pistol.or_else(|_| self.template.moulded(&x, length_px, false))
                else {
                    return Ok(None);
                };
                self.hand.moulded = template.samples(self.options.samples)?;
                let tip = self.ribbon::<RIBBON_DOF>(&x)?.pose(&x).axis().tip;
                self.affine(frame, AffineMap::upright(tip, x[2], length_px)?, NEAR_PX)?
            }
            (Shape::Planar(map), _) => self.affine(frame, map, NEAR_PX)?,
        };
        // A hand that stays has not slid along what is behind it.
        let slid = frozen.shape.placement() - settled.shape.ahead(ahead_px).placement();
        let length_px = self.waiting.measure.length_px;
        let most_px =
            self.options.acquire.reach_px(self.waiting.ribbon[3]).max(MOST_SLID * length_px);
        let (sin, cos) = settled.shape.placement()[2].sin_cos();
        let aside_px = (slid.y * cos - slid.x * sin).abs();
        // One that has left the shade has become wider on one side.
        let widened_px =
            self.hand.shaded.map_or(0.0, |_| frozen.shape.width() - settled.shape.width());
        let stays = slid.xy().norm() <= most_px
            && aside_px <= MOST_ASIDE * settled.shape.width() + widened_px.max(0.0)
            && slid[2].sin().abs() <= MOST_TURNED_RAD;
        let accepted = stays
            && frozen.is_accepted(&self.options.track.accept)
            && stands_out(self.told_apart(frame), frozen.explains_finger(), || {
                self.stands_free(frame, &frozen.shape)
            });
        if accepted {
            self.hand.shape = frozen.shape;
        }
        Ok(accepted.then_some(frozen))
    }

    /// Learns what the settled hand looks like, and looks at it once more in the mixture of colours
    /// that shows it best: a shaded flank or the tip, which grey may have hidden, comes out now.
    fn bed_in(&mut self, frame: &Scene<'_>, settled: &Found) -> Result<()> {
        let mut explained_before = settled.explains_finger();
        let mut told = self.told_apart(frame);
        for _ in 0..BED_IN_ROUNDS {
            self.hand.looks = None;
            self.learn_looks(frame, 1)?;
            let (Shape::Ribbon(x), true) = (self.hand.shape, self.hand.is_mixed()) else {
                return Ok(());
            };
            let half_length_px = self.options.acquire.reach_px(self.waiting.ribbon[3]);
            let look = Look { lead: Lead::AnyEdge, ..Look::edges(half_length_px) };
            let turned = self.run_ribbon::<3>(frame, &x, Limb::Finger, look, None)?;
            self.hand.acquired = x;
            let held = self.held::<5>(&x, BED_IN_SLACK);
            let finger = self.run_ribbon::<5>(frame, &turned.x, Limb::Finger, look, Some(&held))?;
            let found = Found::from(finger);
            if found.is_accepted(&self.options.acquire.accept) {
                self.hand.shape = Shape::Ribbon(with_thumb_of(&x, &finger.x));
                let now = self.told_apart(frame);
                let explained = found.explains_finger();
                if now < STILL_TOLD * told || explained < STILL_TOLD * explained_before {
                    self.hand.shape = Shape::Ribbon(x);
                    return Ok(());
                }
                (told, explained_before) = (now, explained);
            }
        }
        Ok(())
    }

    /// How well the last search's contour tells the inside of the finger from its outside.
    pub(super) fn told_apart(&mut self, frame: &Scene<'_>) -> f64 {
        let Self { hand, samples, convergence, .. } = self;
        let shaft = match &hand.shape {
            Shape::Ribbon(x) => Some(Shaft::of_band(x, hand.measure.length_px)),
            Shape::Planar(_) => None,
        };
        convergence.told_apart(
            hand.fingers(samples),
            frame,
            &hand.shape.silhouette(),
            shaft.as_ref(),
        )
    }

    /// A hand that was found is followed from here.
    fn start(&mut self, time_s: f64, found: &Found, posture: Posture) -> Result<()> {
        let large = self.largeness();
        self.gate = self.options.gate(large)?;
        let options = &self.options.track.dynamics;
        let (components, gap_s) = (options.components(large), options.longest_gap_s);
        let at = found.shape.placement();
        self.dynamics = Some(Dynamics::start(components, gap_s, time_s, &at, &misfit())?);
        self.pace = Pace::unknown();
        self.steady.forget();
        self.sagitta = Sagitta::default();
        self.worth = Worth::default();
        self.hand.usual_px = found.fit.map_or(f64::INFINITY, |fit| fit.residual_rms_px);
        self.hand.partly_frames = MOST_COVERED_FRAMES;
        self.hand.is_covered = false;
        self.hand.count_partly(found);
        self.hand.thumb_missed = 0;
        self.hand.posture = posture;
        self.hand.is_back = false;
        (self.hand.bent_frames, self.hand.straight_frames) = (0, 0);
        self.phase = Phase::Tracking { missed: 0 };
        Ok(())
    }
}

/// A finger that was fitted alone, its thumb where that of the hand was.
pub(super) fn with_thumb_of(hand: &RibbonVector, finger: &RibbonVector) -> RibbonVector {
    let slid = finger.fixed_rows::<2>(0) - hand.fixed_rows::<2>(0);
    let mut together = *finger;
    together[5] -= slid.dot(&Vector2::new(hand[2].cos(), hand[2].sin()));
    together
}
