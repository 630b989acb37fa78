//! Initialisation: the initial template takes the dimensions of the hand that is held up to it.
//!
//! The finger is fitted first, alone, since the start pose determines it best. Several widths,
//! angles and polarities are tried, each fitted in stages (place, angle, then width and taper); the
//! one with the highest quality is kept. Without colours, start poses near the initial one that
//! search nearby edges only are tried as well, and a finger with soft flanks, as a shadow has,
//! scores lower. The thumb may lean in any direction and appear at any length: a grid of thumbs is
//! ranked by the edges near each, and the best are fitted together with the finger.

use super::appearance::{AppearanceModel, EdgeCue, SearchModel};
use super::convergence::Convergence;
use super::fit_result::FitResult;
use super::foreground_test::ForegroundTest;
use super::hand::HandModel;
use super::limbs::{THUMB_SIZES, finger_samples, thumb_samples};
use super::options::{MIN_HALF_LENGTH_PX, TrackerOptions};
use super::scene::Scene;
use super::separation::{NEARLY_ALL_EXPLAINED, stands_out};
use super::silhouette::{Shaft, Silhouette};
use super::stage::{FitStage, SearchPlan};
use crate::Result;
use crate::geometry::ribbon::{BandMeasure, RIBBON_DOF, Ribbon, RibbonVector};
use crate::geometry::shape_space::{Axis, Pose, ShapeSpace};
use crate::geometry::template::{Part, TemplateSample};
use crate::measure::edge::Polarity;
use crate::measure::edge_search::Cue;
use crate::numeric::ablation::{Mechanism, is_off};
use nalgebra::{Point2, Rotation2, Vector2};

/// Half-widths tried, relative to the initial template's.
const WIDTHS: [f64; 3] = [0.8, 1.2, 1.8];
/// Angles tried, relative to the initial template's \[rad\].
const ANGLES_RAD: [f64; 3] = [0.0, -0.35, 0.35];
/// Admissible tapers of a finger: it may narrow towards the tip, hardly widen. Fingers on 33
/// recordings have −0.13 to 0.03.
const TAPERS: std::ops::RangeInclusive<f64> = -0.2..=0.12;
/// Least explained fraction of each flank of a hand.
const FLANK_SEEN: f64 = 0.4;
/// Least explained fraction of its tip.
const TIP_SEEN: f64 = 0.4;
/// Factor by which a fit led by appearance must exceed the quality of one by edges: it may lose the
/// thumb.
const MIN_SCORE_GAIN: f64 = 1.1;
/// Iterations of learning the appearance of a finger and refitting by it.
const LED_ROUNDS: usize = 2;
/// Half-width of a finger below which search lines of the usual length reach across it and far
/// beyond \[px\].
const SLIM_PX: f64 = 4.0;
/// Range of the edge search near such a finger \[half-widths\].
const NEAR_WIDTHS: f64 = 2.0;
/// Number of hypotheses near the initial template that are fitted in a grey image.
pub(super) const CLOSE_FITTED: usize = 5;
/// Least fraction of their contour that they must explain: edges that are not nearby are not the
/// hand's.
const CLOSE_SEEN: f64 = 0.75;
/// Sharpness ([`Convergence::sharpness`]) below which a flank is more probably a shadow's.
const SHARP: f64 = 0.6;

/// Score, as a fraction of the contour, from which no further angles are tried.
const CLEAR: f64 = 0.9;
/// Least score × separation / (1 + separation) of a finger, as a fraction of the contour. The score
/// is reduced by distance from the initial template.
const LEAST_SCORE: f64 = 0.4;
/// Expected distance of a hand's tip from the initial template's, as a fraction of the finger's
/// length (one standard deviation).
const PLACE_SIGMA: f64 = 0.35;
/// The same of its angle \[rad\].
const ANGLE_SIGMA_RAD: f64 = 0.35;
/// Fraction of the contour that a finger at one standard deviation must explain in addition.
const DISTANCE_WEIGHT: f64 = 0.05;

/// The initial template and the options of the search around it.
pub(super) struct TemplateInitialiser<'a> {
    pub options: &'a TrackerOptions,
    pub samples: &'a [TemplateSample],
    pub initial: &'a RibbonVector,
    pub measure: BandMeasure,
}

/// A hand that was found: its band template, and its model.
pub(super) struct TemplateFit {
    pub hand: FitResult<RibbonVector>,
    pub model: HandModel,
}

/// The finger with the highest quality until now.
struct Best {
    finger: FitResult<RibbonVector>,
    polarity: Polarity,
    quality: f64,
}

impl TemplateInitialiser<'_> {
    /// The hand at the initial template, if the image shows one. The thumb counts only where most
    /// of it is seen: the finger is found and tracked without it, and a misplaced thumb would turn
    /// the finger.
    pub fn find(&self, convergence: &mut Convergence, scene: &Scene<'_>) -> Result<TemplateFit> {
        let samples = finger_samples(self.samples).len() as f64;
        let mut best = Best {
            finger: FitResult::unfitted(*self.initial),
            polarity: self.options.polarity,
            quality: 0.0,
        };
        for angle_rad in ANGLES_RAD {
            let initial = self.turned(angle_rad);
            for &polarity in self.hypotheses() {
                for width in WIDTHS {
                    let mut from = initial;
                    from[3] *= width;
                    let fitted_finger = self.finger(convergence, scene, &from, polarity)?;
                    self.consider(&mut best, convergence, scene, &fitted_finger, polarity)?;
                }
            }
            let polarity = self.options.polarity;
            if scene.colour().is_none() && !is_off(Mechanism::CloseBy) {
                for from in self.close_by(convergence, scene, angle_rad)? {
                    let half_px = MIN_HALF_LENGTH_PX;
                    let fitted_finger =
                        self.bands::<5>(convergence, scene, &from, &initial, half_px, polarity)?;
                    if fitted_finger.explains_finger() >= CLOSE_SEEN {
                        self.consider(&mut best, convergence, scene, &fitted_finger, polarity)?;
                    }
                }
            }
            let by_silhouette = self.fit_by_silhouette(convergence, scene, &initial, polarity)?;
            self.consider(&mut best, convergence, scene, &by_silhouette, polarity)?;
            // The other angles serve a hand that is held up at a wrong angle.
            if self.score(&best.finger) >= CLEAR * samples {
                break;
            }
        }
        let Best { finger, polarity: finger_polarity, .. } = best;
        if finger.fit.is_some() && self.measure.side != 0.0 {
            let (hand, polarity) = self.thumb(convergence, scene, &finger.shape)?;
            if hand.fit.is_some() {
                let model = HandModel { has_thumb: true, polarity };
                // Repeated, so that the last search is that of the best fit.
                return self.refit(convergence, scene, &hand.shape, model);
            }
        }
        let model = HandModel { has_thumb: false, polarity: finger_polarity };
        if finger.fit.is_none() {
            return Ok(TemplateFit { hand: finger, model });
        }
        self.refit(convergence, scene, &finger.shape, model)
    }

    /// Replaces the best finger by the one fitted last, or by the one that its appearance leads to,
    /// if that has a higher quality.
    fn consider(
        &self,
        best: &mut Best,
        convergence: &mut Convergence,
        scene: &Scene<'_>,
        fitted_finger: &FitResult<RibbonVector>,
        polarity: Polarity,
    ) -> Result<()> {
        if !self.is_plausible(fitted_finger, false) {
            return Ok(());
        }
        let (finger, separation) =
            self.by_appearance(convergence, scene, fitted_finger, polarity)?;
        let score = self.score(&finger) / finger_samples(self.samples).len() as f64;
        let is_hand = self.stands_out(scene, &finger.shape, (separation, score))
            && (score >= NEARLY_ALL_EXPLAINED
                || score * separation / (1.0 + separation) > LEAST_SCORE);
        if is_hand {
            let quality = self.quality(convergence, scene, &finger.shape, (score, separation));
            if quality > best.quality {
                *best = Best { finger, polarity, quality };
            }
        }
        Ok(())
    }

    /// Quality of a finger that explains the fraction `explained` of its contour in the last
    /// search: `explained` × `separation` with colours, else `explained` × √`separation` ×
    /// min(sharpness / [`SHARP`], 1)². Without colours, a finger together with its shadow separates
    /// better from paper than the finger alone, so that separation is less informative; the
    /// shadow's edges are soft.
    fn quality(
        &self,
        convergence: &mut Convergence,
        scene: &Scene<'_>,
        x: &RibbonVector,
        (explained, separation): (f64, f64),
    ) -> f64 {
        if scene.colour().is_some() {
            return explained * separation;
        }
        let samples = finger_samples(self.samples).len();
        let sharpness = convergence.sharpness(samples, scene, &Silhouette::of_band(x));
        explained * separation.sqrt() * (sharpness / SHARP).min(1.0).powi(2)
    }

    /// Refits the whole hand from an earlier fit: by the edges near it, or the finger by the
    /// appearance of its inside, whichever has the higher quality. A pattern has edges anywhere,
    /// and for a slim finger the edges of the opposite flank and of the fist are within reach. If
    /// too few edges agree with a slim finger, it is searched once more at short range; without
    /// colours every finger is.
    pub fn refit(
        &self,
        convergence: &mut Convergence,
        scene: &Scene<'_>,
        from: &RibbonVector,
        model: HandModel,
    ) -> Result<TemplateFit> {
        let reach_px = (self.options.acquire.reach_px(self.initial[3]) / 2.0).max(1.0);
        let near_px = (NEAR_WIDTHS * from[3]).max(MIN_HALF_LENGTH_PX).min(reach_px);
        let least = self.options.acquire.accept.min_inliers;
        let (_, appearance_quality) =
            self.rated_fit(convergence, scene, from, model, EdgeCue::LogRatio, reach_px)?;
        let mut edges =
            self.rated_fit(convergence, scene, from, model, EdgeCue::AnyEdge, reach_px)?;
        let mut searched_px = reach_px;
        if from[3] <= SLIM_PX && edges.0.hand.fit.is_none_or(|fit| fit.agreement < least) {
            searched_px = near_px;
            edges = self.rated_fit(convergence, scene, from, model, EdgeCue::AnyEdge, near_px)?;
        }
        if scene.colour().is_none() {
            let close_px = MIN_HALF_LENGTH_PX;
            let close =
                self.rated_fit(convergence, scene, from, model, EdgeCue::AnyEdge, close_px)?;
            edges = if close.0.hand.explains_finger() >= CLOSE_SEEN && close.1 >= edges.1 {
                close
            } else {
                // Repeated, so that the last search is that of the best fit.
                self.rated_fit(convergence, scene, from, model, EdgeCue::AnyEdge, searched_px)?
            };
        }
        if appearance_quality > MIN_SCORE_GAIN * edges.1 {
            // Repeated, so that the last search is that of the best fit.
            edges = self.rated_fit(convergence, scene, from, model, EdgeCue::LogRatio, reach_px)?;
        }
        Ok(edges.0)
    }

    /// A fit near an earlier one, by the appearance of its inside or by edges, with its
    /// [quality](Self::quality); 0 if it is no hand.
    fn rated_fit(
        &self,
        convergence: &mut Convergence,
        scene: &Scene<'_>,
        from: &RibbonVector,
        model: HandModel,
        edge_cue: EdgeCue,
        half_px: f64,
    ) -> Result<(TemplateFit, f64)> {
        let HandModel { has_thumb, polarity } = model;
        let has_thumb = has_thumb && edge_cue == EdgeCue::AnyEdge;
        let fitted_finger = if edge_cue == EdgeCue::LogRatio {
            self.fit_by_silhouette(convergence, scene, from, polarity)?
        } else if has_thumb {
            self.whole(convergence, scene, from, half_px, polarity)?
        } else {
            self.bands::<5>(convergence, scene, from, from, half_px, polarity)?
        };
        let none = |x| TemplateFit { hand: FitResult::unfitted(x), model };
        if !self.is_plausible(&fitted_finger, has_thumb) {
            return Ok((none(fitted_finger.shape), 0.0));
        }
        let (hand, separation) =
            self.by_appearance(convergence, scene, &fitted_finger, polarity)?;
        let explained = hand.explains_finger();
        let Some(fit) =
            hand.fit.filter(|_| self.stands_out(scene, &hand.shape, (separation, explained)))
        else {
            return Ok((none(hand.shape), 0.0));
        };
        let quality = self.quality(convergence, scene, &hand.shape, (explained, separation));
        // Appearance may have moved the finger and dropped the thumb.
        let has_thumb = has_thumb && fit.shape.names.len() == RIBBON_DOF;
        Ok((TemplateFit { hand, model: HandModel { has_thumb, polarity } }, quality))
    }

    /// Whether a fit is a hand of about the expected size, seen on both flanks, at the tip and, if
    /// it has one, at the thumb.
    pub(super) fn is_plausible(
        &self,
        fitted_finger: &FitResult<RibbonVector>,
        has_thumb: bool,
    ) -> bool {
        let Some(fit) = fitted_finger.fit else { return false };
        let (x, limit) = (&fitted_finger.shape, self.options.acquire.max_scale);
        let ratio = x[3] / self.initial[3];
        let thumb = Vector2::new(x[6], x[7]).norm() / self.measure.length_px;
        TAPERS.contains(&x[4])
            && (1.0 / limit..=limit).contains(&ratio)
            && fit.support.of(Part::LeftFlank) >= FLANK_SEEN
            && fit.support.of(Part::RightFlank) >= FLANK_SEEN
            && fit.support.of(Part::Tip) >= TIP_SEEN
            && (!has_thumb || (THUMB_SIZES.contains(&thumb) && self.shows_thumb(&fit.support)))
    }

    /// The finger fitted last, or the one that its appearance leads to if that has a higher product
    /// of explained contour and separation; with its separation. One flank of a finger before a
    /// pattern may have been fitted to the pattern.
    fn by_appearance(
        &self,
        convergence: &mut Convergence,
        scene: &Scene<'_>,
        fitted_finger: &FitResult<RibbonVector>,
        polarity: Polarity,
    ) -> Result<(FitResult<RibbonVector>, f64)> {
        let samples = finger_samples(self.samples);
        let separation = self.finger_separation(convergence, scene, &fitted_finger.shape);
        let (mut x, mut best) = (fitted_finger.shape, (*fitted_finger, separation));
        let mut appearance = convergence.lend_appearance(scene);
        let reach_px = self.options.acquire.reach_px(self.initial[3]);
        for _ in 0..LED_ROUNDS {
            let silhouette = Silhouette::of_band(&x);
            convergence.learn_from_fit(
                &mut appearance,
                samples.len(),
                scene,
                &silhouette,
                (0.0, 1.0),
            )?;
            let refitted = self.fit_by_appearance(
                convergence,
                scene,
                &appearance,
                (&x, &fitted_finger.shape),
                polarity,
            )?;
            if refitted.fit.is_none() {
                break;
            }
            x = refitted.shape;
            let separation = self.finger_separation(convergence, scene, &x);
            let displacement_px =
                (x.fixed_rows::<2>(0) - fitted_finger.shape.fixed_rows::<2>(0)).norm();
            let quality = best.0.explains_finger() * best.1;
            let is_better = refitted.explains_finger() * separation > MIN_SCORE_GAIN * quality;
            if is_better && displacement_px <= reach_px && self.is_plausible(&refitted, false) {
                best = (refitted, separation);
            }
        }
        convergence.take_back(appearance);
        Ok(best)
    }

    /// The finger that the appearance of the inside of a silhouette leads to. The hand is held up
    /// to the template, so that most of the silhouette's pixels belong to the hand, even where the
    /// edges nearby do not.
    fn fit_by_silhouette(
        &self,
        convergence: &mut Convergence,
        scene: &Scene<'_>,
        from: &RibbonVector,
        polarity: Polarity,
    ) -> Result<FitResult<RibbonVector>> {
        let mut appearance = convergence.lend_appearance(scene);
        // First it only moves and turns: its width is that of the pixels taken for inside.
        let reach_px = self.options.acquire.reach_px(self.initial[3]);
        let mut fitted = FitResult::unfitted(*from);
        if self.learn_at(convergence, scene, &mut appearance, from)?
            && let Some(log_ratios) = appearance.search_model(scene, EdgeCue::LogRatio, polarity)
        {
            fitted =
                self.bands_with_model::<3>(convergence, scene, (from, from), reach_px, log_ratios)?;
        }
        if fitted.fit.is_some()
            && self.learn_at(convergence, scene, &mut appearance, &fitted.shape)?
        {
            fitted = self.fit_by_appearance(
                convergence,
                scene,
                &appearance,
                (&fitted.shape, from),
                polarity,
            )?;
        }
        convergence.take_back(appearance);
        Ok(fitted)
    }

    /// An empty appearance model learns the inside and the outside of a finger; false if these do
    /// not differ.
    fn learn_at(
        &self,
        convergence: &mut Convergence,
        scene: &Scene<'_>,
        appearance: &mut AppearanceModel,
        x: &RibbonVector,
    ) -> Result<bool> {
        let pose =
            Ribbon::<5>::about(x, &self.measure.with_thumb(false))?.pose(&Ribbon::<5>::free(x));
        let contour = finger_samples(self.samples).iter().map(|sample| pose.place(sample));
        convergence.learn_at(appearance, scene, contour, &Silhouette::of_band(x))
    }

    /// The fit that an appearance model leads to: by log-likelihood ratios from afar, then by edges
    /// that match the model, finally by edges alone, as for any other fit: appearance is no
    /// evidence for a hand.
    fn fit_by_appearance(
        &self,
        convergence: &mut Convergence,
        scene: &Scene<'_>,
        appearance: &AppearanceModel,
        (from, prior_mean): (&RibbonVector, &RibbonVector),
        polarity: Polarity,
    ) -> Result<FitResult<RibbonVector>> {
        let reach_px = self.options.acquire.reach_px(self.initial[3]);
        let near_px = MIN_HALF_LENGTH_PX;
        let mut fitted = FitResult::unfitted(*from);
        let Some(log_ratios) = appearance.search_model(scene, EdgeCue::LogRatio, polarity) else {
            return Ok(fitted);
        };
        let Some(edges) = appearance.search_model(scene, EdgeCue::HandEdges, polarity) else {
            return Ok(fitted);
        };
        // For an appearance model learned from one frame, grey edges gain nothing.
        let edges = SearchModel { in_grey: None, ..edges };
        let edges_alone = SearchModel { cue: Cue::Edges, ..edges };
        for (half_px, search_model) in
            [(reach_px, log_ratios), (near_px, edges), (near_px, edges_alone)]
        {
            fitted = self.bands_with_model::<5>(
                convergence,
                scene,
                (&fitted.shape, prior_mean),
                half_px,
                search_model,
            )?;
            if fitted.fit.is_none() {
                break;
            }
        }
        Ok(fitted)
    }

    /// Separation of the finger that was fitted last; see [`AppearanceModel::finger_separation`].
    fn finger_separation(
        &self,
        convergence: &mut Convergence,
        scene: &Scene<'_>,
        x: &RibbonVector,
    ) -> f64 {
        let samples = finger_samples(self.samples).len();
        let shaft = Shaft::of_band(x, self.measure.length_px);
        convergence.finger_separation(samples, scene, &Silhouette::of_band(x), Some(&shaft))
    }

    /// Whether a finger with this separation and explained fraction of its contour stands out; see
    /// [`stands_out`].
    fn stands_out(
        &self,
        scene: &Scene<'_>,
        x: &RibbonVector,
        (separation, explained): (f64, f64),
    ) -> bool {
        stands_out(separation, explained, || {
            let space = Ribbon::<5>::about(x, &self.measure.with_thumb(false)).ok()?;
            let pose = space.pose(&Ribbon::<5>::free(x));
            let mut foreground_test =
                ForegroundTest::before(scene.background_for_validation()?, x[3]);
            for sample in finger_samples(self.samples) {
                foreground_test.add(&pose.place(sample));
            }
            foreground_test.is_foreground()
        })
    }

    /// Number of explained samples, less a penalty that is quadratic in the distance from the start
    /// pose: the operator holds the hand up to the template, not beside it.
    fn score(&self, fitted_finger: &FitResult<RibbonVector>) -> f64 {
        let tip = |x: &RibbonVector| {
            Axis::of_finger(Point2::new(x[0], x[1]), x[2], 0.5 * self.measure.length_px).tip
        };
        let distance = (tip(&fitted_finger.shape) - tip(self.initial)).norm()
            / (PLACE_SIGMA * self.measure.length_px);
        let turned = (fitted_finger.shape[2] - self.initial[2]) / ANGLE_SIGMA_RAD;
        let visible = finger_samples(self.samples).len() as f64;
        fitted_finger.support() as f64
            - DISTANCE_WEIGHT * visible * (distance * distance + turned * turned)
    }

    /// Edge polarities to try. A hand before an even background has edges of one polarity, and is
    /// easier to find when only those are searched.
    pub(super) fn hypotheses(&self) -> &'static [Polarity] {
        match self.options.polarity {
            Polarity::Bright => &[Polarity::Bright],
            Polarity::Dark => &[Polarity::Dark],
            Polarity::Unknown => &[Polarity::Bright, Polarity::Dark, Polarity::Unknown],
        }
    }

    /// The initial template, rotated about its fingertip.
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

    /// Fits the finger alone: translation, then rotation, then width and taper.
    fn finger(
        &self,
        convergence: &mut Convergence,
        scene: &Scene<'_>,
        from: &RibbonVector,
        polarity: Polarity,
    ) -> Result<FitResult<RibbonVector>> {
        let half_px = self.options.acquire.reach_px(self.initial[3]);
        let moved = self.bands::<2>(convergence, scene, from, from, half_px, polarity)?;
        let turned = self.bands::<3>(convergence, scene, &moved.shape, from, half_px, polarity)?;
        self.bands::<5>(convergence, scene, &turned.shape, from, half_px, polarity)
    }

    /// Fits finger and thumb together.
    pub(super) fn whole(
        &self,
        convergence: &mut Convergence,
        scene: &Scene<'_>,
        from: &RibbonVector,
        half_length_px: f64,
        polarity: Polarity,
    ) -> Result<FitResult<RibbonVector>> {
        self.bands::<RIBBON_DOF>(convergence, scene, from, from, half_length_px, polarity)
    }

    /// Fits the first `D` components of the band template's shape vector, from `x`; `prior_mean` is
    /// the mean of the prior. For `D` up to 5 only the finger is fitted, and no thumb hides any of
    /// it.
    fn bands<const D: usize>(
        &self,
        convergence: &mut Convergence,
        scene: &Scene<'_>,
        x: &RibbonVector,
        prior_mean: &RibbonVector,
        half_length_px: f64,
        polarity: Polarity,
    ) -> Result<FitResult<RibbonVector>> {
        let search_model = SearchModel::unknown(polarity);
        self.bands_with_model::<D>(
            convergence,
            scene,
            (x, prior_mean),
            half_length_px,
            search_model,
        )
    }

    /// The same with a search model of the hand.
    fn bands_with_model<const D: usize>(
        &self,
        convergence: &mut Convergence,
        scene: &Scene<'_>,
        (x, prior_mean): (&RibbonVector, &RibbonVector),
        half_length_px: f64,
        search_model: SearchModel<'_>,
    ) -> Result<FitResult<RibbonVector>> {
        let has_thumb = D > 5;
        let samples = if has_thumb { self.samples } else { finger_samples(self.samples) };
        let stage = stage(samples, search_model, half_length_px);
        let space = Ribbon::<D>::about(x, &self.measure.with_thumb(has_thumb))?;
        let prior = (D > 3).then(|| self.initial_prior::<D>(prior_mean));
        let start = Ribbon::<D>::free(x);
        let fitted_finger = convergence.run_bands(scene, &space, start, &stage, prior.as_ref())?;
        Ok(fitted_finger.map(|x| space.full(&x)))
    }

    /// Support of the finger, or of the thumb if the shape space has one: the sum over its samples
    /// of 1000 (1 − |d| / r) for an edge at offset d within the range r = `reach_px`.
    pub(super) fn support<const D: usize>(
        &self,
        convergence: &mut Convergence,
        scene: &Scene<'_>,
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
        let offsets = convergence.offsets(scene, &space, &x, &stage)?.filter_map(|(_, px)| px);
        Ok(offsets.map(|d| (1000.0 * (1.0 - (d / reach_px).abs()).max(0.0)) as u64).sum())
    }
}

/// A search by some samples of a hand without a motion prediction.
fn stage<'a>(
    samples: &'a [TemplateSample],
    search_model: SearchModel<'a>,
    half_length_px: f64,
) -> FitStage<'a> {
    let plan = SearchPlan { edge_cue: search_model.edge_cue, ..SearchPlan::edges(half_length_px) };
    FitStage { samples, search_model, plan, max_scale_px: f64::INFINITY }
}
