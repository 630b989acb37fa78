//! Moulding: the waiting template takes the dimensions of the hand that is held up to it.
//!
//! The finger comes first, alone: it is what the waiting pose tells most about. Several widths,
//! angles and polarities try, each fitted in stages (place, angle, then width and taper), and the
//! one that explains most of its contour stays. Without colours, fingers close by that move to the
//! next edges alone try as well, and one whose flanks are soft, as a shadow's are, is worth less.
//! The thumb may lean anywhere and be seen at any length, so a grid of thumbs is judged by the edges
//! they lie on, and the best of them are fitted together with the finger.

use super::appearance::{AppearanceModel, EdgeCue, SearchModel};
use super::convergence::Convergence;
use super::foreground_test::ForegroundTest;
use super::limbs::{THUMB_SIZES, finger_samples, thumb_samples};
use super::options::{MIN_HALF_LENGTH_PX, TrackerOptions};
use super::scene::Scene;
use super::separation::{WHOLE, stands_out};
use super::silhouette::{Shaft, Silhouette};
use super::stage::{Converged, FitStage, StageEnd};
use crate::Result;
use crate::geometry::ribbon::{BandMeasure, RIBBON_DOF, Ribbon, RibbonVector};
use crate::geometry::shape_space::{Axis, Pose, ShapeSpace};
use crate::geometry::template::{Part, TemplateSample};
use crate::measure::edge::{Polarity, Scale};
use crate::measure::edge_search::Cue;
use crate::solve::fit::Prior;
use nalgebra::{Point2, Rotation2, SMatrix, Vector2};

/// Half-widths that try, in parts of the waiting template's.
const WIDTHS: [f64; 3] = [0.8, 1.2, 1.8];
/// Angles that try, from the waiting template's \[rad\].
const ANGLES_RAD: [f64; 3] = [0.0, -0.35, 0.35];
/// Tapers of a finger: it may get slimmer towards the tip, hardly stouter. Fingers on 33 recordings have
/// -0.13 to 0.03.
const TAPERS: std::ops::RangeInclusive<f64> = -0.2..=0.12;
/// What part of a flank, of the tip and of the thumb a fit has to explain before it is a hand.
const FLANK_SEEN: f64 = 0.4;
const TIP_SEEN: f64 = 0.4;
/// How many times as much the finger that looks lead to must be worth: its thumb may be lost.
const MIN_SCORE_GAIN: f64 = 1.1;
/// How often its looks lead a finger.
const LED_ROUNDS: usize = 2;
/// Half the width of a finger so slim that search lines of the usual length reach across it and far
/// beyond \[px\], and how far its edges are looked for from nearby \[half-widths\].
const SLIM_PX: f64 = 4.0;
const NEAR_WIDTHS: f64 = 2.0;
/// So many hypotheses close to the initial template are fitted in a grey image.
pub(super) const CLOSE_FITTED: usize = 5;
/// They explain this part of their contour at least: what they do not see is not a hand's.
const CLOSE_SEEN: f64 = 0.75;
/// A flank whose edges are less sharp than this ([`Convergence::sharpness`]) is rather that of a shadow.
const SHARP: f64 = 0.6;

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
const DISTANCE_WEIGHT: f64 = 0.05;

/// What is believed about a hand before it is seen, as standard deviations of the band template:
/// in parts of the finger's half-width, of 1 for the taper, and of the finger's length.
const WIDTH_SIGMA: f64 = 0.4;
const TAPER_SIGMA: f64 = 0.08;
const THUMB_SIGMA: f64 = 0.3;

/// The waiting hand and what is looked for around it.
pub(super) struct TemplateInitialiser<'a> {
    pub options: &'a TrackerOptions,
    pub samples: &'a [TemplateSample],
    pub initial: &'a RibbonVector,
    pub measure: BandMeasure,
}

/// A hand that was found: its band template, and what kind of hand it is.
pub(super) struct TemplateFit {
    pub hand: Converged<RIBBON_DOF>,
    pub kind: Kind,
}

/// The finger that is worth most of those that were tried.
struct Best {
    finger: Converged<RIBBON_DOF>,
    polarity: Polarity,
    quality: f64,
}

/// Whether a hand shows a thumb, and which side of its edges is the hand.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Kind {
    pub has_thumb: bool,
    pub polarity: Polarity,
}

impl TemplateInitialiser<'_> {
    /// The hand at the waiting template, if the image shows one. The thumb counts only where it is
    /// seen well: the finger is found and followed without it, and a thumb in the wrong place
    /// would turn it.
    pub fn find(&self, convergence: &mut Convergence, frame: &Scene<'_>) -> Result<TemplateFit> {
        let samples = finger_samples(self.samples).len() as f64;
        let mut best = Best {
            finger: Converged::at(*self.initial),
            polarity: self.options.polarity,
            quality: 0.0,
        };
        for angle_rad in ANGLES_RAD {
            let initial = self.turned(angle_rad);
            for &polarity in self.hypotheses() {
                for width in WIDTHS {
                    let mut from = initial;
                    from[3] *= width;
                    let fitted_finger = self.finger(convergence, frame, &from, polarity)?;
                    self.consider(&mut best, convergence, frame, &fitted_finger, polarity)?;
                }
            }
            let polarity = self.options.polarity;
            if frame.colour().is_none() {
                for from in self.close_by(convergence, frame, angle_rad)? {
                    let half_px = MIN_HALF_LENGTH_PX;
                    let fitted_finger =
                        self.bands::<5>(convergence, frame, &from, &initial, half_px, polarity)?;
                    if fitted_finger.explains_finger() >= CLOSE_SEEN {
                        self.consider(&mut best, convergence, frame, &fitted_finger, polarity)?;
                    }
                }
            }
            let led = self.inside(convergence, frame, &initial, polarity)?;
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
            return Ok(TemplateFit { hand: finger, kind });
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
        fitted_finger: &Converged<RIBBON_DOF>,
        polarity: Polarity,
    ) -> Result<()> {
        if !self.is_plausible(fitted_finger, false) {
            return Ok(());
        }
        let (finger, separation) =
            self.by_appearance(convergence, frame, fitted_finger, polarity)?;
        let score = self.score(&finger) / finger_samples(self.samples).len() as f64;
        let is_hand = self.stands_out(frame, &finger.x, (separation, score))
            && (score >= WHOLE || score * separation / (1.0 + separation) > LEAST_SCORE);
        if is_hand {
            let quality = self.quality(convergence, frame, &finger.x, (score, separation));
            if quality > best.quality {
                *best = Best { finger, polarity, quality };
            }
        }
        Ok(())
    }

    /// What a finger is worth that explains such a part of its contour in the last search and is told so
    /// well from what is beside it. Without colours, a finger and its shadow together are told from paper
    /// better than the finger alone: how well they are says less, and the shadow's edges are soft.
    fn quality(
        &self,
        convergence: &mut Convergence,
        frame: &Scene<'_>,
        x: &RibbonVector,
        (explained, separation): (f64, f64),
    ) -> f64 {
        if frame.colour().is_some() {
            return explained * separation;
        }
        let samples = finger_samples(self.samples).len();
        let sharpness = convergence.sharpness(samples, frame, &Silhouette::of_band(x));
        explained * separation.sqrt() * (sharpness / SHARP).min(1.0).powi(2)
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
    ) -> Result<TemplateFit> {
        let reach_px = (self.options.acquire.reach_px(self.initial[3]) / 2.0).max(1.0);
        let near_px = (NEAR_WIDTHS * from[3]).max(MIN_HALF_LENGTH_PX).min(reach_px);
        let least = self.options.acquire.accept.min_inliers;
        let (_, led_score) =
            self.judged(convergence, frame, from, kind, EdgeCue::LogRatio, reach_px)?;
        let mut edges = self.judged(convergence, frame, from, kind, EdgeCue::AnyEdge, reach_px)?;
        let mut searched_px = reach_px;
        if from[3] <= SLIM_PX && edges.0.hand.fit.is_none_or(|fit| fit.agreement < least) {
            searched_px = near_px;
            edges = self.judged(convergence, frame, from, kind, EdgeCue::AnyEdge, near_px)?;
        }
        if frame.colour().is_none() {
            let close_px = MIN_HALF_LENGTH_PX;
            let close = self.judged(convergence, frame, from, kind, EdgeCue::AnyEdge, close_px)?;
            edges = if close.0.hand.explains_finger() >= CLOSE_SEEN && close.1 >= edges.1 {
                close
            } else {
                // Once more, so that the last search is that of the best.
                self.judged(convergence, frame, from, kind, EdgeCue::AnyEdge, searched_px)?
            };
        }
        if led_score > MIN_SCORE_GAIN * edges.1 {
            // Once more, so that the last search is that of the best.
            edges = self.judged(convergence, frame, from, kind, EdgeCue::LogRatio, reach_px)?;
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
        edge_cue: EdgeCue,
        half_px: f64,
    ) -> Result<(TemplateFit, f64)> {
        let Kind { has_thumb, polarity } = kind;
        let has_thumb = has_thumb && edge_cue == EdgeCue::AnyEdge;
        let fitted_finger = if edge_cue == EdgeCue::LogRatio {
            self.inside(convergence, frame, from, polarity)?
        } else if has_thumb {
            self.whole(convergence, frame, from, half_px, polarity)?
        } else {
            self.bands::<5>(convergence, frame, from, from, half_px, polarity)?
        };
        let none = |x| TemplateFit { hand: Converged::at(x), kind };
        if !self.is_plausible(&fitted_finger, has_thumb) {
            return Ok((none(fitted_finger.x), 0.0));
        }
        let (hand, separation) =
            self.by_appearance(convergence, frame, &fitted_finger, polarity)?;
        let explained = hand.explains_finger();
        let Some(fit) =
            hand.fit.filter(|_| self.stands_out(frame, &hand.x, (separation, explained)))
        else {
            return Ok((none(hand.x), 0.0));
        };
        let quality = self.quality(convergence, frame, &hand.x, (explained, separation));
        // A thumb of a finger that was elsewhere is none.
        let has_thumb = has_thumb && fit.shape.names.len() == RIBBON_DOF;
        Ok((TemplateFit { hand, kind: Kind { has_thumb, polarity } }, quality))
    }

    /// Whether a fit is a hand of about the size that was waited for, seen on both flanks, at the
    /// tip and at the thumb if it has one.
    pub(super) fn is_plausible(
        &self,
        fitted_finger: &Converged<RIBBON_DOF>,
        has_thumb: bool,
    ) -> bool {
        let Some(fit) = fitted_finger.fit else { return false };
        let (x, limit) = (&fitted_finger.x, self.options.acquire.max_scale);
        let ratio = x[3] / self.initial[3];
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
    fn by_appearance(
        &self,
        convergence: &mut Convergence,
        frame: &Scene<'_>,
        fitted_finger: &Converged<RIBBON_DOF>,
        polarity: Polarity,
    ) -> Result<(Converged<RIBBON_DOF>, f64)> {
        let samples = finger_samples(self.samples);
        let separation = self.finger_separation(convergence, frame, &fitted_finger.x);
        let (mut x, mut best) = (fitted_finger.x, (*fitted_finger, separation));
        let mut appearance = convergence.lend_appearance(frame);
        let reach_px = self.options.acquire.reach_px(self.initial[3]);
        for _ in 0..LED_ROUNDS {
            let silhouette = Silhouette::of_band(&x);
            convergence.teach(&mut appearance, samples.len(), frame, &silhouette, (0.0, 1.0))?;
            let led =
                self.led(convergence, frame, &appearance, (&x, &fitted_finger.x), polarity)?;
            if led.fit.is_none() {
                break;
            }
            x = led.x;
            let separation = self.finger_separation(convergence, frame, &x);
            let away_px = (x.fixed_rows::<2>(0) - fitted_finger.x.fixed_rows::<2>(0)).norm();
            let quality = best.0.explains_finger() * best.1;
            let is_better = led.explains_finger() * separation > MIN_SCORE_GAIN * quality;
            if is_better && away_px <= reach_px && self.is_plausible(&led, false) {
                best = (led, separation);
            }
        }
        convergence.take_back(appearance);
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
        let mut appearance = convergence.lend_appearance(frame);
        // First it only moves and turns: its width is that of what has been inside.
        let reach_px = self.options.acquire.reach_px(self.initial[3]);
        let mut led = Converged::at(*from);
        if self.teach_at(convergence, frame, &mut appearance, from)?
            && let Some(log_ratios) = appearance.search_model(frame, EdgeCue::LogRatio, polarity)
        {
            led = self.explained::<3>(convergence, frame, (from, from), reach_px, log_ratios)?;
        }
        if led.fit.is_some() && self.teach_at(convergence, frame, &mut appearance, &led.x)? {
            led = self.led(convergence, frame, &appearance, (&led.x, from), polarity)?;
        }
        convergence.take_back(appearance);
        Ok(led)
    }

    /// Shows looks that know nothing yet what is inside of a finger and what is not, if that differs.
    fn teach_at(
        &self,
        convergence: &mut Convergence,
        frame: &Scene<'_>,
        appearance: &mut AppearanceModel,
        x: &RibbonVector,
    ) -> Result<bool> {
        let pose =
            Ribbon::<5>::about(x, &self.measure.with_thumb(false))?.pose(&Ribbon::<5>::free(x));
        let contour = finger_samples(self.samples).iter().map(|sample| pose.place(sample));
        convergence.teach_at(appearance, frame, contour, &Silhouette::of_band(x))
    }

    /// Where looks lead from a silhouette: by votes from afar, then by the edges that look like it,
    /// and in the end by edges alone, as any other: what looks lead to is no more of a hand for that.
    fn led(
        &self,
        convergence: &mut Convergence,
        frame: &Scene<'_>,
        appearance: &AppearanceModel,
        (from, believed): (&RibbonVector, &RibbonVector),
        polarity: Polarity,
    ) -> Result<Converged<RIBBON_DOF>> {
        let reach_px = self.options.acquire.reach_px(self.initial[3]);
        let near_px = MIN_HALF_LENGTH_PX;
        let mut led = Converged::at(*from);
        let Some(log_ratios) = appearance.search_model(frame, EdgeCue::LogRatio, polarity) else {
            return Ok(led);
        };
        let Some(edges) = appearance.search_model(frame, EdgeCue::HandEdges, polarity) else {
            return Ok(led);
        };
        // Of looks that one frame has shown, grey edges gain nothing.
        let edges = SearchModel { in_grey: None, ..edges };
        let edges_alone = SearchModel { cue: Cue::Edges, ..edges };
        for (half_px, search_model) in
            [(reach_px, log_ratios), (near_px, edges), (near_px, edges_alone)]
        {
            led =
                self.explained::<5>(convergence, frame, (&led.x, believed), half_px, search_model)?;
            if led.fit.is_none() {
                break;
            }
        }
        Ok(led)
    }

    /// How well the finger that was fitted last stands out; see [`AppearanceModel::finger_separation`].
    fn finger_separation(
        &self,
        convergence: &mut Convergence,
        frame: &Scene<'_>,
        x: &RibbonVector,
    ) -> f64 {
        let samples = finger_samples(self.samples).len();
        let shaft = Shaft::of_band(x, self.measure.length_px);
        convergence.finger_separation(samples, frame, &Silhouette::of_band(x), Some(&shaft))
    }

    /// Whether a finger stands out that is told so well from what is beside it, and so much of whose
    /// contour is explained.
    fn stands_out(
        &self,
        frame: &Scene<'_>,
        x: &RibbonVector,
        (separation, explained): (f64, f64),
    ) -> bool {
        stands_out(separation, explained, || {
            let space = Ribbon::<5>::about(x, &self.measure.with_thumb(false)).ok()?;
            let pose = space.pose(&Ribbon::<5>::free(x));
            let mut foreground_test = ForegroundTest::before(frame.table()?, x[3]);
            for sample in finger_samples(self.samples) {
                foreground_test.add(&pose.place(sample));
            }
            foreground_test.is_free()
        })
    }

    /// How well a finger explains its contour, less what its distance from the waiting pose costs:
    /// the operator holds the hand up to the template, not beside it.
    fn score(&self, fitted_finger: &Converged<RIBBON_DOF>) -> f64 {
        let tip = |x: &RibbonVector| {
            Axis::of_finger(Point2::new(x[0], x[1]), x[2], 0.5 * self.measure.length_px).tip
        };
        let away = (tip(&fitted_finger.x) - tip(self.initial)).norm()
            / (PLACE_SIGMA * self.measure.length_px);
        let turned = (fitted_finger.x[2] - self.initial[2]) / ANGLE_SIGMA_RAD;
        let visible = finger_samples(self.samples).len() as f64;
        fitted_finger.support() as f64 - DISTANCE_WEIGHT * visible * (away * away + turned * turned)
    }

    /// What the edges of a waiting template may look like. A hand before an even background has
    /// edges of one polarity, and is easier to find when only those are looked at.
    pub(super) fn hypotheses(&self) -> &'static [Polarity] {
        match self.options.polarity {
            Polarity::Bright => &[Polarity::Bright],
            Polarity::Dark => &[Polarity::Dark],
            Polarity::Unknown => &[Polarity::Bright, Polarity::Dark, Polarity::Unknown],
        }
    }

    /// The waiting hand, turned about its fingertip.
    pub(super) fn turned(&self, angle_rad: f64) -> RibbonVector {
        let mut x = *self.initial;
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
        let half_px = self.options.acquire.reach_px(self.initial[3]);
        let moved = self.bands::<2>(convergence, frame, from, from, half_px, polarity)?;
        let turned = self.bands::<3>(convergence, frame, &moved.x, from, half_px, polarity)?;
        self.bands::<5>(convergence, frame, &turned.x, from, half_px, polarity)
    }

    /// Finger and thumb together.
    pub(super) fn whole(
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
        let search_model = SearchModel::unknown(polarity);
        self.explained::<D>(convergence, frame, (x, believed), half_length_px, search_model)
    }

    /// The same by what is known of the hand.
    fn explained<const D: usize>(
        &self,
        convergence: &mut Convergence,
        frame: &Scene<'_>,
        (x, believed): (&RibbonVector, &RibbonVector),
        half_length_px: f64,
        search_model: SearchModel<'_>,
    ) -> Result<Converged<RIBBON_DOF>> {
        let has_thumb = D > 5;
        let samples = if has_thumb { self.samples } else { finger_samples(self.samples) };
        let stage = stage(samples, search_model, half_length_px);
        let space = Ribbon::<D>::about(x, &self.measure.with_thumb(has_thumb))?;
        let prior = (D > 3).then(|| self.belief::<D>(believed));
        let start = Ribbon::<D>::free(x);
        let fitted_finger = convergence.run_bands(frame, &space, start, &stage, prior.as_ref())?;
        let Converged { x, fit, iterations, edges_within_px } = fitted_finger;
        Ok(Converged { x: space.full(&x), fit, iterations, edges_within_px })
    }

    /// Samples of the finger, or of the thumb if the shape space has one, that lie within reach of an
    /// edge, and near it all alike: an edge found half the reach away counts half.
    pub(super) fn support<const D: usize>(
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
        let stage = stage(samples, SearchModel::unknown(polarity), reach_px);
        let x = Ribbon::<D>::free(x);
        let offsets = convergence.offsets(frame, &space, &x, &stage)?.filter_map(|(_, px)| px);
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

/// A search by some samples of a hand of which no motion is known yet.
fn stage<'a>(
    samples: &'a [TemplateSample],
    search_model: SearchModel<'a>,
    half_length_px: f64,
) -> FitStage<'a> {
    FitStage {
        samples,
        search_model,
        scale: Scale::Fine,
        half_length_px,
        edges_within_px: f64::INFINITY,
        window: None,
        rest: StageEnd::Reported,
        every: 1,
        own_only: false,
        most_scale_px: f64::INFINITY,
    }
}
