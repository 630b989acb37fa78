//! Moulding: the waiting template takes the dimensions of the hand that is held up to it.
//!
//! The finger comes first, alone: it is what the waiting pose tells most about. Several widths,
//! angles and polarities try, each fitted in stages (place, angle, then width and taper), and the
//! one that explains most of its contour stays. Without colours, fingers close by that move to the
//! next edges alone try as well, and one whose flanks are soft, as a shadow's are, is worth less.
//! The thumb may lean anywhere and be seen at any length, so a grid of thumbs is judged by the edges
//! they lie on, and the best of them are fitted together with the finger.

use super::convergence::{Attempt, Converged, Convergence, MIN_HALF_LENGTH_PX, Rest, Support};
use super::looks::{Lead, Looks, Shaft, Sight, Silhouette};
use super::options::TrackerOptions;
use super::scene::Scene;
use super::standing::Standing;
use crate::Result;
use crate::fit::Prior;
use crate::search::{Cue, MAX_HALF_LENGTH_PX, Polarity, Scale};
use crate::shape_space::{Axis, BandMeasure, Pose, RIBBON_DOF, Ribbon, RibbonVector, ShapeSpace};
use crate::template::{Limb, Part, TemplateSample};
use nalgebra::{Point2, Rotation2, SMatrix, Vector2};

/// Half-widths that try, in parts of the waiting template's.
const WIDTHS: [f64; 3] = [0.8, 1.2, 1.8];
/// Angles that try, from the waiting template's \[rad\].
const ANGLES_RAD: [f64; 3] = [0.0, -0.35, 0.35];
/// Roots of the thumb that try, in finger lengths from the finger's middle.
const THUMB_ROOTS: [f64; 4] = [-0.75, -0.6, -0.45, -0.3];
/// Angles between thumb and finger that try \[rad\].
const THUMB_ANGLES_RAD: [f64; 6] = [0.6, 0.85, 1.1, 1.35, 1.6, 1.85];
/// Lengths of the thumb that try, in finger lengths.
const THUMB_LENGTHS: [f64; 4] = [0.4, 0.6, 0.8, 1.0];
/// Tapers of a finger: it may get slimmer towards the tip, hardly stouter. Fingers on 33 recordings have
/// -0.13 to 0.03.
const TAPERS: std::ops::RangeInclusive<f64> = -0.2..=0.12;
/// Lengths that a fitted thumb may have, in finger lengths.
const THUMB_SIZES: std::ops::RangeInclusive<f64> = 0.2..=1.5;
/// What part of a flank, of the tip and of the thumb a fit has to explain before it is a hand.
const FLANK_SEEN: f64 = 0.4;
const TIP_SEEN: f64 = 0.4;
const THUMB_SEEN: f64 = 0.7;
/// How much the inside and the outside of a finger differ at least, as the mean of the pixels' votes:
/// fingers on footage of tables, papers and cloth do by 1.4 and more even in grey, false ones on
/// patterned cloth by up to 1.2.
const STANDS_OUT: f64 = 1.3;
/// The same of a finger that stands free of a table that is known: that tells them apart as well. Dark
/// hands before dark wood differ by 0.8 to 1.
const STANDS_OUT_FREE: f64 = 0.7;
/// The same of a finger that is seen whole, all around, to this part of its contour. Skin before wood of
/// its brightness differs by 0.4 to 0.6. Of 1560 templates beside the hands of 13 films this takes 2 more
/// for a finger (113 in all), and of 480 about the hands of 15 it finds 13 more (438).
const STANDS_OUT_WHOLE: f64 = 0.4;
const WHOLE: f64 = 0.7;
/// How many times as much the finger that looks lead to must be worth: its thumb may be lost.
const WORTH_THE_CHANGE: f64 = 1.1;
/// How often its looks lead a finger.
const LED_ROUNDS: usize = 2;
/// Half the width of a finger so slim that search lines of the usual length reach across it and far
/// beyond \[px\], and how far its edges are looked for from nearby \[half-widths\].
const SLIM_PX: f64 = 4.0;
const NEAR_WIDTHS: f64 = 2.0;
/// Where there are no colours, the strongest edge about is seldom the hand's: fingers about the waiting
/// one try as well that move to what is close by alone. So far along it and across it \[half-widths\],
/// turned by so much \[rad\] and of so many times its width; the likeliest of them are fitted.
const CLOSE_ALONG: [f64; 3] = [-1.0, 0.0, 1.0];
const CLOSE_ACROSS: [f64; 3] = [-0.6, 0.0, 0.6];
const CLOSE_ANGLES_RAD: [f64; 3] = [-0.12, 0.0, 0.12];
const CLOSE_WIDTHS: [f64; 2] = [0.85, 1.15];
const CLOSE_FITTED: usize = 5;
/// They explain this part of their contour at least: what they do not see is not a hand's.
const CLOSE_SEEN: f64 = 0.75;
/// A flank whose edges are less sharp than this ([`Convergence::sharpness`]) is rather that of a shadow.
const SHARP: f64 = 0.6;
/// What part of the thumb's contour has to be explained, counted with what the finger hides.
const THUMB_IN_SIGHT: f64 = 0.5;
/// How many of the thumbs are fitted.
const THUMBS_FITTED: usize = 4;
/// How far a thumb of the grid may be from the true one \[px per px of finger length\].
const THUMB_REACH: f64 = 0.12;

/// A finger that explains this part of its contour is clear enough to look no further.
const CLEAR: f64 = 0.9;
/// One that explains less than this part of it, after what its distance from the waiting template and
/// what is alike beside it cost, is none.
const LEAST_SCORE: f64 = 0.4;
/// How far from the waiting template a hand is expected: its tip, in parts of the finger's length,
/// and its angle. A finger at one sigma has to explain this part of the contour more than one in
/// place.
const PLACE_SIGMA: f64 = 0.35;
const ANGLE_SIGMA_RAD: f64 = 0.35;
const DISTANCE_SAY: f64 = 0.05;

/// What is believed about a hand before it is seen, as standard deviations of the band template:
/// in parts of the finger's half-width, of 1 for the taper, and of the finger's length.
const WIDTH_SIGMA: f64 = 0.4;
const TAPER_SIGMA: f64 = 0.08;
const THUMB_SIGMA: f64 = 0.3;

/// The waiting hand and what is looked for around it.
pub(super) struct Mould<'a> {
    pub options: &'a TrackerOptions,
    pub samples: &'a [TemplateSample],
    pub waiting: &'a RibbonVector,
    pub measure: BandMeasure,
}

/// A hand that was found: its band template, and what kind of hand it is.
pub(super) struct Moulded {
    pub hand: Converged<RIBBON_DOF>,
    pub kind: Kind,
}

/// The finger that is worth most of those that were tried.
struct Best {
    finger: Converged<RIBBON_DOF>,
    polarity: Polarity,
    worth: f64,
}

/// Whether a hand shows a thumb, and which side of its edges is the hand.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Kind {
    pub has_thumb: bool,
    pub polarity: Polarity,
}

impl Mould<'_> {
    /// The hand at the waiting template, if the image shows one. The thumb counts only where it is
    /// seen well: the finger is found and followed without it, and a thumb in the wrong place
    /// would turn it.
    pub fn find(&self, convergence: &mut Convergence, frame: &Scene<'_>) -> Result<Moulded> {
        let samples = finger_samples(self.samples).len() as f64;
        let mut best = Best {
            finger: Converged::at(*self.waiting),
            polarity: self.options.polarity,
            worth: 0.0,
        };
        for angle_rad in ANGLES_RAD {
            let waiting = self.turned(angle_rad);
            for &polarity in self.hypotheses() {
                for width in WIDTHS {
                    let mut from = waiting;
                    from[3] *= width;
                    let found = self.finger(convergence, frame, &from, polarity)?;
                    self.consider(&mut best, convergence, frame, &found, polarity)?;
                }
            }
            let polarity = self.options.polarity;
            if frame.colour().is_none() {
                for from in self.close_by(convergence, frame, angle_rad)? {
                    let half_px = MIN_HALF_LENGTH_PX;
                    let found =
                        self.bands::<5>(convergence, frame, &from, &waiting, half_px, polarity)?;
                    if found.explains_finger() >= CLOSE_SEEN {
                        self.consider(&mut best, convergence, frame, &found, polarity)?;
                    }
                }
            }
            let led = self.inside(convergence, frame, &waiting, polarity)?;
            self.consider(&mut best, convergence, frame, &led, polarity)?;
            // The other angles are for a hand that is held up badly turned.
            if self.score(&best.finger) >= CLEAR * samples {
                break;
            }
        }
        let Best { finger, polarity: finger_polarity, .. } = best;
        if finger.fit.is_some() && self.measure.side != 0.0 {
            let (hand, polarity) = self.thumb(convergence, frame, &finger.x)?;
            if hand.fit.is_some() {
                let kind = Kind { has_thumb: true, polarity };
                // Once more, so that the last search is that of the best.
                return self.refit(convergence, frame, &hand.x, kind);
            }
        }
        let kind = Kind { has_thumb: false, polarity: finger_polarity };
        if finger.fit.is_none() {
            return Ok(Moulded { hand: finger, kind });
        }
        self.refit(convergence, frame, &finger.x, kind)
    }

    /// Takes the finger that was fitted last, or the one that its looks lead to, for the best so far
    /// if it is: what explains most of its contour and stands out most.
    fn consider(
        &self,
        best: &mut Best,
        convergence: &mut Convergence,
        frame: &Scene<'_>,
        found: &Converged<RIBBON_DOF>,
        polarity: Polarity,
    ) -> Result<()> {
        if !self.is_plausible(found, false) {
            return Ok(());
        }
        let (finger, told) = self.by_looks(convergence, frame, found, polarity)?;
        let score = self.score(&finger) / finger_samples(self.samples).len() as f64;
        let is_hand = self.stands_out(frame, &finger.x, (told, score))
            && (score >= WHOLE || score * told / (1.0 + told) > LEAST_SCORE);
        if is_hand {
            let worth = self.worth(convergence, frame, &finger.x, (score, told));
            if worth > best.worth {
                *best = Best { finger, polarity, worth };
            }
        }
        Ok(())
    }

    /// What a finger is worth that explains such a part of its contour in the last search and is told so
    /// well from what is beside it. Without colours, a finger and its shadow together are told from paper
    /// better than the finger alone: how well they are says less, and the shadow's edges are soft.
    fn worth(
        &self,
        convergence: &mut Convergence,
        frame: &Scene<'_>,
        x: &RibbonVector,
        (explained, told): (f64, f64),
    ) -> f64 {
        if frame.colour().is_some() {
            return explained * told;
        }
        let samples = finger_samples(self.samples).len();
        let sharpness = convergence.sharpness(samples, frame, &Silhouette::of_band(x));
        explained * told.sqrt() * (sharpness / SHARP).min(1.0).powi(2)
    }

    /// Of the fingers about the waiting one, turned by so much, those that have most edges close by.
    fn close_by(
        &self,
        convergence: &mut Convergence,
        frame: &Scene<'_>,
        angle_rad: f64,
    ) -> Result<[RibbonVector; CLOSE_FITTED]> {
        let polarity = self.options.polarity;
        let mut best = [(0, self.turned(angle_rad)); CLOSE_FITTED];
        for turn_rad in CLOSE_ANGLES_RAD {
            let turned = self.turned(angle_rad + turn_rad);
            let ahead = Vector2::new(turned[2].cos(), turned[2].sin()) * turned[3];
            let aside = Vector2::new(-ahead.y, ahead.x);
            for (along, across) in
                CLOSE_ALONG.into_iter().flat_map(|a| CLOSE_ACROSS.map(|b| (a, b)))
            {
                let by = ahead * along + aside * across;
                for width in CLOSE_WIDTHS {
                    let mut x = turned;
                    (x[0], x[1], x[3]) = (x[0] + by.x, x[1] + by.y, width * x[3]);
                    let support =
                        self.support::<5>(convergence, frame, &x, MIN_HALF_LENGTH_PX, polarity)?;
                    let [.., last] = &mut best;
                    if support > last.0 {
                        *last = (support, x);
                        best.sort_unstable_by_key(|(support, _)| std::cmp::Reverse(*support));
                    }
                }
            }
        }
        Ok(best.map(|(_, x)| x))
    }

    /// From an earlier fit, all of the hand at once: by the edges about it, or the finger that what is
    /// inside of it leads to, whichever is worth more. A pattern's edges are anywhere, and of a slim
    /// finger's the other flank's and the fist's are within reach as well: where they are taken for its
    /// own, it is looked at once more from nearby; and so is every finger without colours.
    pub fn refit(
        &self,
        convergence: &mut Convergence,
        frame: &Scene<'_>,
        from: &RibbonVector,
        kind: Kind,
    ) -> Result<Moulded> {
        let reach_px = (self.options.acquire.reach_px(self.waiting[3]) / 2.0).max(1.0);
        let near_px = (NEAR_WIDTHS * from[3]).max(MIN_HALF_LENGTH_PX).min(reach_px);
        let least = self.options.acquire.accept.min_inliers;
        let (_, led_worth) = self.judged(convergence, frame, from, kind, Lead::Votes, reach_px)?;
        let mut edges = self.judged(convergence, frame, from, kind, Lead::AnyEdge, reach_px)?;
        let mut searched_px = reach_px;
        if from[3] <= SLIM_PX && edges.0.hand.fit.is_none_or(|fit| fit.agreement < least) {
            searched_px = near_px;
            edges = self.judged(convergence, frame, from, kind, Lead::AnyEdge, near_px)?;
        }
        if frame.colour().is_none() {
            let close_px = MIN_HALF_LENGTH_PX;
            let close = self.judged(convergence, frame, from, kind, Lead::AnyEdge, close_px)?;
            edges = if close.0.hand.explains_finger() >= CLOSE_SEEN && close.1 >= edges.1 {
                close
            } else {
                // Once more, so that the last search is that of the best.
                self.judged(convergence, frame, from, kind, Lead::AnyEdge, searched_px)?
            };
        }
        if led_worth > WORTH_THE_CHANGE * edges.1 {
            // Once more, so that the last search is that of the best.
            edges = self.judged(convergence, frame, from, kind, Lead::Votes, reach_px)?;
        }
        Ok(edges.0)
    }

    /// A hand about an earlier fit, by what is inside of that or by edges, and what it is worth: how much
    /// of its contour it explains times how well it stands out.
    fn judged(
        &self,
        convergence: &mut Convergence,
        frame: &Scene<'_>,
        from: &RibbonVector,
        kind: Kind,
        lead: Lead,
        half_px: f64,
    ) -> Result<(Moulded, f64)> {
        let Kind { has_thumb, polarity } = kind;
        let has_thumb = has_thumb && lead == Lead::AnyEdge;
        let found = if lead == Lead::Votes {
            self.inside(convergence, frame, from, polarity)?
        } else if has_thumb {
            self.whole(convergence, frame, from, half_px, polarity)?
        } else {
            self.bands::<5>(convergence, frame, from, from, half_px, polarity)?
        };
        let none = |x| Moulded { hand: Converged::at(x), kind };
        if !self.is_plausible(&found, has_thumb) {
            return Ok((none(found.x), 0.0));
        }
        let (hand, told) = self.by_looks(convergence, frame, &found, polarity)?;
        let explained = hand.explains_finger();
        let Some(fit) = hand.fit.filter(|_| self.stands_out(frame, &hand.x, (told, explained)))
        else {
            return Ok((none(hand.x), 0.0));
        };
        let worth = self.worth(convergence, frame, &hand.x, (explained, told));
        // A thumb of a finger that was elsewhere is none.
        let has_thumb = has_thumb && fit.shape.names.len() == RIBBON_DOF;
        Ok((Moulded { hand, kind: Kind { has_thumb, polarity } }, worth))
    }

    /// Whether a fit is a hand of about the size that was waited for, seen on both flanks, at the
    /// tip and at the thumb if it has one.
    fn is_plausible(&self, found: &Converged<RIBBON_DOF>, has_thumb: bool) -> bool {
        let Some(fit) = found.fit else { return false };
        let (x, limit) = (&found.x, self.options.acquire.max_scale);
        let ratio = x[3] / self.waiting[3];
        let thumb = Vector2::new(x[6], x[7]).norm() / self.measure.length_px;
        TAPERS.contains(&x[4])
            && (1.0 / limit..=limit).contains(&ratio)
            && fit.support.of(Part::LeftFlank) >= FLANK_SEEN
            && fit.support.of(Part::RightFlank) >= FLANK_SEEN
            && fit.support.of(Part::Tip) >= TIP_SEEN
            && (!has_thumb || (THUMB_SIZES.contains(&thumb) && self.shows_thumb(&fit.support)))
    }

    /// The finger that was fitted last, or the one that its looks lead to where these tell its inside
    /// from its outside better, and how well they do: one flank of a finger before a pattern may have
    /// been the pattern's.
    fn by_looks(
        &self,
        convergence: &mut Convergence,
        frame: &Scene<'_>,
        found: &Converged<RIBBON_DOF>,
        polarity: Polarity,
    ) -> Result<(Converged<RIBBON_DOF>, f64)> {
        let samples = finger_samples(self.samples);
        let told = self.told_apart(convergence, frame, &found.x);
        let (mut x, mut best) = (found.x, (*found, told));
        let mut looks = convergence.lend_looks(frame);
        let reach_px = self.options.acquire.reach_px(self.waiting[3]);
        for _ in 0..LED_ROUNDS {
            let silhouette = Silhouette::of_band(&x);
            convergence.teach(&mut looks, samples.len(), frame, &silhouette, (0.0, 1.0))?;
            let led = self.led(convergence, frame, &looks, (&x, &found.x), polarity)?;
            if led.fit.is_none() {
                break;
            }
            x = led.x;
            let told = self.told_apart(convergence, frame, &x);
            let away_px = (x.fixed_rows::<2>(0) - found.x.fixed_rows::<2>(0)).norm();
            let worth = best.0.explains_finger() * best.1;
            let is_better = led.explains_finger() * told > WORTH_THE_CHANGE * worth;
            if is_better && away_px <= reach_px && self.is_plausible(&led, false) {
                best = (led, told);
            }
        }
        convergence.take_back(looks);
        Ok(best)
    }

    /// The finger that the looks of what is inside of a silhouette lead to: it is held up to the
    /// template, and most of what that covers is of it where the edges nearby are not.
    fn inside(
        &self,
        convergence: &mut Convergence,
        frame: &Scene<'_>,
        from: &RibbonVector,
        polarity: Polarity,
    ) -> Result<Converged<RIBBON_DOF>> {
        let mut looks = convergence.lend_looks(frame);
        // First it only moves and turns: its width is that of what has been inside.
        let reach_px = self.options.acquire.reach_px(self.waiting[3]);
        let mut led = Converged::at(*from);
        if self.teach_at(convergence, frame, &mut looks, from)?
            && let Some(votes) = looks.sight(frame, Lead::Votes, polarity)
        {
            led = self.seen::<3>(convergence, frame, (from, from), reach_px, votes)?;
        }
        if led.fit.is_some() && self.teach_at(convergence, frame, &mut looks, &led.x)? {
            led = self.led(convergence, frame, &looks, (&led.x, from), polarity)?;
        }
        convergence.take_back(looks);
        Ok(led)
    }

    /// Shows looks that know nothing yet what is inside of a finger and what is not, if that differs.
    fn teach_at(
        &self,
        convergence: &mut Convergence,
        frame: &Scene<'_>,
        looks: &mut Looks,
        x: &RibbonVector,
    ) -> Result<bool> {
        let pose =
            Ribbon::<5>::about(x, &self.measure.with_thumb(false))?.pose(&Ribbon::<5>::free(x));
        let contour = finger_samples(self.samples).iter().map(|sample| pose.place(sample));
        convergence.teach_at(looks, frame, contour, &Silhouette::of_band(x))
    }

    /// Where looks lead from a silhouette: by votes from afar, then by the edges that look like it,
    /// and in the end by edges alone, as any other: what looks lead to is no more of a hand for that.
    fn led(
        &self,
        convergence: &mut Convergence,
        frame: &Scene<'_>,
        looks: &Looks,
        (from, believed): (&RibbonVector, &RibbonVector),
        polarity: Polarity,
    ) -> Result<Converged<RIBBON_DOF>> {
        let reach_px = self.options.acquire.reach_px(self.waiting[3]);
        let near_px = MIN_HALF_LENGTH_PX;
        let mut led = Converged::at(*from);
        let Some(votes) = looks.sight(frame, Lead::Votes, polarity) else { return Ok(led) };
        let Some(edges) = looks.sight(frame, Lead::HandEdges, polarity) else { return Ok(led) };
        // Of looks that one frame has shown, grey edges gain nothing.
        let edges = Sight { in_grey: None, ..edges };
        let edges_alone = Sight { cue: Cue::Edges, ..edges };
        for (half_px, sight) in [(reach_px, votes), (near_px, edges), (near_px, edges_alone)] {
            led = self.seen::<5>(convergence, frame, (&led.x, believed), half_px, sight)?;
            if led.fit.is_none() {
                break;
            }
        }
        Ok(led)
    }

    /// How well the finger that was fitted last stands out; see [`Looks::told_apart`].
    fn told_apart(
        &self,
        convergence: &mut Convergence,
        frame: &Scene<'_>,
        x: &RibbonVector,
    ) -> f64 {
        let samples = finger_samples(self.samples).len();
        let shaft = Shaft::of_band(x, self.measure.length_px);
        convergence.told_apart(samples, frame, &Silhouette::of_band(x), Some(&shaft))
    }

    /// Whether a finger stands out that is told so well from what is beside it, and so much of whose
    /// contour is explained.
    fn stands_out(
        &self,
        frame: &Scene<'_>,
        x: &RibbonVector,
        (told, explained): (f64, f64),
    ) -> bool {
        stands_out(told, explained, || {
            let space = Ribbon::<5>::about(x, &self.measure.with_thumb(false)).ok()?;
            let pose = space.pose(&Ribbon::<5>::free(x));
            let mut standing = Standing::before(frame.table()?, x[3]);
            for sample in finger_samples(self.samples) {
                standing.see(&pose.place(sample));
            }
            standing.is_free()
        })
    }

    /// Whether a fit explains enough of the thumb's contour, and not because the finger hides it.
    fn shows_thumb(&self, support: &Support) -> bool {
        let all = thumb_samples(self.samples).len() as f64;
        support.of(Part::Thumb) >= THUMB_SEEN
            && support.count(Part::Thumb) as f64 >= THUMB_IN_SIGHT * all
    }

    /// How well a finger explains its contour, less what its distance from the waiting pose costs:
    /// the operator holds the hand up to the template, not beside it.
    fn score(&self, found: &Converged<RIBBON_DOF>) -> f64 {
        let tip = |x: &RibbonVector| {
            Axis::of_finger(Point2::new(x[0], x[1]), x[2], 0.5 * self.measure.length_px).tip
        };
        let away =
            (tip(&found.x) - tip(self.waiting)).norm() / (PLACE_SIGMA * self.measure.length_px);
        let turned = (found.x[2] - self.waiting[2]) / ANGLE_SIGMA_RAD;
        let visible = finger_samples(self.samples).len() as f64;
        found.support() as f64 - DISTANCE_SAY * visible * (away * away + turned * turned)
    }

    /// What the edges of a waiting template may look like. A hand before an even background has
    /// edges of one polarity, and is easier to find when only those are looked at.
    fn hypotheses(&self) -> &'static [Polarity] {
        match self.options.polarity {
            Polarity::Bright => &[Polarity::Bright],
            Polarity::Dark => &[Polarity::Dark],
            Polarity::Unknown => &[Polarity::Bright, Polarity::Dark, Polarity::Unknown],
        }
    }

    /// The waiting hand, turned about its fingertip.
    fn turned(&self, angle_rad: f64) -> RibbonVector {
        let mut x = *self.waiting;
        let half = 0.5 * self.measure.length_px;
        let direction = |a: f64| Vector2::new(a.cos(), a.sin());
        let back = (direction(x[2]) - direction(x[2] + angle_rad)) * half;
        let spine = Rotation2::new(angle_rad) * Vector2::new(x[6], x[7]);
        x[0] += back.x;
        x[1] += back.y;
        x[2] += angle_rad;
        (x[6], x[7]) = (spine.x, spine.y);
        x
    }

    /// The finger alone: it moves, turns, then takes its width and taper.
    fn finger(
        &self,
        convergence: &mut Convergence,
        frame: &Scene<'_>,
        from: &RibbonVector,
        polarity: Polarity,
    ) -> Result<Converged<RIBBON_DOF>> {
        let half_px = self.options.acquire.reach_px(self.waiting[3]);
        let moved = self.bands::<2>(convergence, frame, from, from, half_px, polarity)?;
        let turned = self.bands::<3>(convergence, frame, &moved.x, from, half_px, polarity)?;
        self.bands::<5>(convergence, frame, &turned.x, from, half_px, polarity)
    }

    /// Finger and thumb together.
    fn whole(
        &self,
        convergence: &mut Convergence,
        frame: &Scene<'_>,
        from: &RibbonVector,
        half_length_px: f64,
        polarity: Polarity,
    ) -> Result<Converged<RIBBON_DOF>> {
        self.bands::<RIBBON_DOF>(convergence, frame, from, from, half_length_px, polarity)
    }

    /// One prefix of the band template's shape vector, from `x`; `believed` is the hand that the
    /// prior is about. Up to the taper it is the finger alone, and no thumb hides anything of it.
    fn bands<const D: usize>(
        &self,
        convergence: &mut Convergence,
        frame: &Scene<'_>,
        x: &RibbonVector,
        believed: &RibbonVector,
        half_length_px: f64,
        polarity: Polarity,
    ) -> Result<Converged<RIBBON_DOF>> {
        let sight = Sight::unknown(polarity);
        self.seen::<D>(convergence, frame, (x, believed), half_length_px, sight)
    }

    /// The same by what is known of the hand.
    fn seen<const D: usize>(
        &self,
        convergence: &mut Convergence,
        frame: &Scene<'_>,
        (x, believed): (&RibbonVector, &RibbonVector),
        half_length_px: f64,
        sight: Sight<'_>,
    ) -> Result<Converged<RIBBON_DOF>> {
        let has_thumb = D > 5;
        let samples = if has_thumb { self.samples } else { finger_samples(self.samples) };
        let attempt = attempt(samples, sight, half_length_px);
        let space = Ribbon::<D>::about(x, &self.measure.with_thumb(has_thumb))?;
        let prior = (D > 3).then(|| self.belief::<D>(believed));
        let start = Ribbon::<D>::free(x);
        let found = convergence.run_bands(frame, &space, start, &attempt, prior.as_ref())?;
        let Converged { x, fit, iterations, edges_within_px } = found;
        Ok(Converged { x: space.full(&x), fit, iterations, edges_within_px })
    }

    /// The thumb of a finger that was found: the grid's best, fitted with the finger.
    fn thumb(
        &self,
        convergence: &mut Convergence,
        frame: &Scene<'_>,
        finger: &RibbonVector,
    ) -> Result<(Converged<RIBBON_DOF>, Polarity)> {
        let reach_px = (THUMB_REACH * self.measure.length_px).clamp(1.0, MAX_HALF_LENGTH_PX as f64);
        let mut tried = Vec::new();
        for &polarity in self.hypotheses() {
            for from in self.thumbs(finger) {
                let support =
                    self.support::<RIBBON_DOF>(convergence, frame, &from, reach_px, polarity)?;
                tried.push((support, polarity, from));
            }
        }
        tried.sort_by_key(|(support, ..)| std::cmp::Reverse(*support));
        let mut best = (Converged::at(*finger), self.options.polarity);
        for (_, polarity, from) in tried.into_iter().take(THUMBS_FITTED) {
            let found = self.whole(convergence, frame, &from, reach_px, polarity)?;
            if found.support() > best.0.support() && self.is_plausible(&found, true) {
                best = (found, polarity);
            }
        }
        Ok(best)
    }

    /// Every thumb of the grid on a finger.
    fn thumbs(&self, finger: &RibbonVector) -> impl Iterator<Item = RibbonVector> {
        let (finger, length_px, side) = (*finger, self.measure.length_px, self.measure.side);
        THUMB_ROOTS.into_iter().flat_map(move |root| {
            THUMB_ANGLES_RAD.into_iter().flat_map(move |angle_rad| {
                THUMB_LENGTHS.into_iter().map(move |length| {
                    let mut x = finger;
                    let (sin, cos) = (finger[2] + side * angle_rad).sin_cos();
                    let spine = Vector2::new(cos, sin) * (length * length_px);
                    (x[5], x[6], x[7]) = (root * length_px, spine.x, spine.y);
                    x[8] = 0.9 * finger[3];
                    x
                })
            })
        })
    }

    /// Samples of the finger, or of the thumb if the shape space has one, that lie within reach of an
    /// edge, and near it all alike: an edge found half the reach away counts half.
    fn support<const D: usize>(
        &self,
        convergence: &mut Convergence,
        frame: &Scene<'_>,
        x: &RibbonVector,
        reach_px: f64,
        polarity: Polarity,
    ) -> Result<u64> {
        let has_thumb = D > 5;
        let space = Ribbon::<D>::about(x, &self.measure.with_thumb(has_thumb))?;
        let samples =
            if has_thumb { thumb_samples(self.samples) } else { finger_samples(self.samples) };
        let attempt = attempt(samples, Sight::unknown(polarity), reach_px);
        let x = Ribbon::<D>::free(x);
        let offsets = convergence.sought(frame, &space, &x, &attempt)?.filter_map(|(_, px)| px);
        Ok(offsets.map(|d| (1000.0 * (1.0 - (d / reach_px).abs()).max(0.0)) as u64).sum())
    }

    /// The prior of a hand about `from`: nothing about place and angle, a little about its size.
    fn belief<const D: usize>(&self, from: &RibbonVector) -> Prior<D> {
        let thumb_px = THUMB_SIGMA * self.measure.length_px;
        let sigmas = [
            f64::INFINITY,
            f64::INFINITY,
            f64::INFINITY,
            WIDTH_SIGMA * from[3],
            TAPER_SIGMA,
            thumb_px,
            thumb_px,
            thumb_px,
            WIDTH_SIGMA * from[3],
        ];
        let mut information = SMatrix::<f64, D, D>::zeros();
        for (i, sigma) in sigmas.iter().take(D).enumerate() {
            information[(i, i)] = sigma.powi(-2);
        }
        let mut mean = Ribbon::<D>::free(from);
        // A taper is as likely one way as the other, whatever an earlier fit made of it.
        if D > 4 {
            mean[4] = 0.0;
        }
        Prior { mean, information }
    }
}

/// Whether a finger stands out that is told so well from what is beside it ([`Looks::told_apart`]), and
/// so much of whose contour is explained, and which may stand free of the table, if that is known.
pub(super) fn stands_out(
    told: f64,
    explained: f64,
    is_free: impl FnOnce() -> Option<bool>,
) -> bool {
    told >= STANDS_OUT
        || (told >= STANDS_OUT_WHOLE && explained >= WHOLE)
        || (told >= STANDS_OUT_FREE && is_free() == Some(true))
}

/// A search by some samples of a hand of which no motion is known yet.
fn attempt<'a>(
    samples: &'a [TemplateSample],
    sight: Sight<'a>,
    half_length_px: f64,
) -> Attempt<'a> {
    Attempt {
        samples,
        sight,
        scale: Scale::Fine,
        half_length_px,
        edges_within_px: f64::INFINITY,
        window: None,
        rest: Rest::Told,
        every: 1,
        own_only: false,
        most_scale_px: f64::INFINITY,
    }
}

/// The outline runs along the finger first, then along the thumb.
pub(super) fn finger_samples(samples: &[TemplateSample]) -> &[TemplateSample] {
    &samples[..crotch(samples)]
}

fn thumb_samples(samples: &[TemplateSample]) -> &[TemplateSample] {
    &samples[crotch(samples)..]
}

fn crotch(samples: &[TemplateSample]) -> usize {
    samples.iter().position(|s| s.limb == Limb::Thumb).unwrap_or(samples.len())
}

// What stands out is decided here, between measurements that are tested with the tracker.
#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_stands_free_need_not_differ_as_much() {
        assert!(stands_out(STANDS_OUT, 0.0, || unreachable!("it stands out anyway")));
        for told in [STANDS_OUT_FREE, 1.0] {
            assert!(stands_out(told, 0.0, || Some(true)));
            assert!(!stands_out(told, 0.0, || Some(false)));
            // Of a table that is not known nothing stands free.
            assert!(!stands_out(told, 0.0, || None));
        }
        assert!(!stands_out(0.99 * STANDS_OUT_FREE, 0.0, || Some(true)));
    }

    #[test]
    fn what_is_seen_whole_need_differ_even_less() {
        assert!(stands_out(STANDS_OUT_WHOLE, WHOLE, || unreachable!("it stands out anyway")));
        assert!(!stands_out(STANDS_OUT_WHOLE, 0.99 * WHOLE, || Some(true)));
        assert!(!stands_out(0.99 * STANDS_OUT_WHOLE, 1.0, || Some(true)));
    }
}
