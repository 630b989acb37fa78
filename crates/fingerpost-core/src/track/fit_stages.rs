//! The stages of a fit near the hand: the free components of each model, fitted in turn.

use super::appearance::EdgeCue;
use super::fit_result::FitResult;
use super::limbs::finger_samples;
use super::scene::Scene;
use super::shape::Shape;
use super::stage::{Fit, SearchPlan, StagePurpose, Window};
use super::tracker::{ContourTracker, PINNED_SIGMA};
use crate::Result;
use crate::axis::WidthPrior;
use crate::geometry::planar::{
    Affine, AffineMap, PlanarSpace, Rigid, RigidShear, Similarity, Translation,
};
use crate::geometry::ribbon::{RIBBON_DOF, Ribbon, RibbonVector};
use crate::geometry::template::{Limb, Part};
use crate::measure::edge::Scale;
use crate::solve::fit::Prior;
use nalgebra::{Matrix2, SMatrix, SVector};

/// Prior standard deviation of the half-widths of a tracked hand, as a fraction of the acquired
/// ones.
const TRACKED_WIDTH_SIGMA: f64 = 0.06;
/// Prior standard deviation of its taper.
const TRACKED_TAPER_SIGMA: f64 = 0.03;
/// Prior standard deviation of the thumb's root and spine, as a fraction of the finger's length:
/// the thumb may move, and foreshortening moves its root.
const TRACKED_THUMB_SIGMA: f64 = 0.1;
/// Factor by which the prior on the dimensions of a hand being acquired is wider than in tracking:
/// the fit that they come from was made without its appearance model, at another length or before
/// its shaded flank was found.
pub(super) const ACQUISITION_SLACK: f64 = 4.0;
/// Largest ratio of a thumb's length or half-width to the acquired one, or its inverse.
const THUMB_CHANGE: f64 = 1.7;
/// Least explained fraction of a thumb.
const THUMB_SEEN: f64 = 0.4;
/// Every how many samples take part in placing and rotating the paper's template, before all
/// determine its shear. Bands use all samples, which also determine the width; with half of them,
/// one frame in thirty of a fast hand would be missed.
const ENOUGH_TO_TURN: usize = 2;

/// Path of a fit: initial shape, kernel scale, window of the prediction, and edge cue.
pub(super) type Path = (Shape, Scale, Option<Window>, EdgeCue);

impl ContourTracker {
    /// Fits all components that the model leaves free in a tracked hand, by edges near `from` or
    /// within the window. The paper's model fits the shear only with a thumb, which determines it;
    /// the band model fits the finger under the prior, then the thumb.
    pub(super) fn fit_stages(
        &mut self,
        scene: &Scene<'_>,
        (from, scale, window, edge_cue): Path,
    ) -> Result<FitResult> {
        let near_px = window.map_or(self.near_px(), |w| w.near_px);
        let matched_only = window.is_some_and(|w| w.matched_only);
        let plan = SearchPlan { edge_cue, scale, matched_only, ..SearchPlan::edges(near_px) };
        let first = match window {
            Some(Window { gate, .. }) => {
                SearchPlan { window, half_length_px: gate.longest_px(), ..plan }
            }
            None => plan,
        };
        let placement_plan = SearchPlan { purpose: StagePurpose::TakenOver, ..first };
        Ok(match from {
            Shape::Planar(map) if self.determines_shear() => {
                let near = SearchPlan { every: ENOUGH_TO_TURN, ..placement_plan };
                let turned = self.planar::<Rigid, 3>(scene, map, near)?;
                // Bands search the full range: shortened lines gave less accurate points on grey
                // footage.
                let within = SearchPlan { edges_within_px: turned.edges_within_px, ..plan };
                self.planar::<RigidShear, 4>(scene, turned.shape, within)?.into()
            }
            Shape::Planar(map) => self.planar::<Rigid, 3>(scene, map, first)?.into(),
            Shape::Ribbon(x) => {
                let placement_prior = window.and_then(|w| w.prior());
                let turned = self.run_ribbon::<3>(
                    scene,
                    &x,
                    Limb::Finger,
                    placement_plan,
                    placement_prior.as_ref(),
                )?;
                let slack = if matched_only { self.hand.slack() } else { 1.0 };
                let mut prior = self.tracked_prior::<5>(&x, slack);
                if let Some(Prior { mean, information }) = placement_prior {
                    prior.mean.fixed_rows_mut::<3>(0).copy_from(&mean);
                    prior.information.fixed_view_mut::<3, 3>(0, 0).copy_from(&information);
                }
                let finger =
                    self.run_ribbon::<5>(scene, &turned.shape, Limb::Finger, plan, Some(&prior))?;
                match &finger.fit {
                    Some(fit) if self.hand.model.has_thumb => {
                        self.fit_thumb(scene, &finger, fit, plan)?.into()
                    }
                    _ => finger.into(),
                }
            }
        })
    }

    /// The paper's acquisition: the template translates, rotates, then deforms affinely. A finger
    /// alone, which determines neither length nor shear, only scales.
    pub(super) fn affine(
        &mut self,
        scene: &Scene<'_>,
        from: AffineMap,
        half_length_px: f64,
    ) -> Result<FitResult> {
        let plan = SearchPlan::edges(half_length_px);
        let moved = self.planar::<Translation, 2>(scene, from, plan)?;
        let turned = self.planar::<Rigid, 3>(scene, moved.shape, plan)?;
        Ok(if self.determines_shear() {
            self.planar::<Affine, 6>(scene, turned.shape, plan)?.into()
        } else {
            self.planar::<Similarity, 4>(scene, turned.shape, plan)?.into()
        })
    }

    /// Fits one planar shape space; a fit that mirrors or flattens the template is discarded.
    pub(super) fn planar<S: PlanarSpace<D>, const D: usize>(
        &mut self,
        scene: &Scene<'_>,
        from: AffineMap,
        plan: SearchPlan,
    ) -> Result<FitResult<AffineMap>> {
        let Ok((space, x)) = S::through(&from) else {
            return Ok(FitResult::unfitted(from));
        };
        let samples = self.hand.planar(&self.samples);
        let stage = self.hand.stage(samples, scene, plan, self.options.polarity);
        let found = self.convergence.run(scene, &space, x, &stage, None)?;
        let found = found.map(|x| space.pose(&x));
        let is_valid = found.shape.decompose().is_ok();
        Ok(if is_valid { found } else { FitResult { shape: from, fit: None, ..found } })
    }

    /// Whether the planar template has a thumb that determines length and shear; a traced outline
    /// is assumed to be more than a finger.
    fn determines_shear(&self) -> bool {
        self.hand.model.has_thumb || self.template.proportions().is_none()
    }

    /// Fits the thumb of a fitted finger. A thumb bends and leans; it must not turn the finger,
    /// whose line and covariance stay unchanged.
    fn fit_thumb(
        &mut self,
        scene: &Scene<'_>,
        finger: &FitResult<RibbonVector>,
        fit: &Fit,
        plan: SearchPlan,
    ) -> Result<FitResult<RibbonVector>> {
        let mut prior = self.tracked_prior::<RIBBON_DOF>(&finger.shape, 1.0);
        // The finger is held fixed while the thumb is fitted.
        for i in 0..5 {
            prior.mean[i] = finger.shape[i];
            prior.information[(i, i)] = PINNED_SIGMA.powi(-2);
        }
        let plan = SearchPlan { purpose: StagePurpose::Thumb, ..plan };
        let whole = self.run_ribbon(scene, &finger.shape, Limb::Thumb, plan, Some(&prior))?;
        let Some(with_thumb) = whole.fit else { return Ok(*finger) };
        if !self.is_thumb(&whole.shape, &with_thumb) {
            // The thumb keeps its place.
            return Ok(FitResult {
                fit: Some(Fit { counts: with_thumb.counts, ..*fit }),
                ..*finger
            });
        }
        let mut shape = with_thumb.shape;
        for i in 0..5 {
            shape.vector[i] = finger.shape[i];
        }
        shape
            .covariance
            .view_mut((0, 0), (5, 5))
            .copy_from(&fit.shape.covariance.view((0, 0), (5, 5)));
        let iterations = finger.iterations + whole.iterations;
        Ok(FitResult {
            shape: shape.vector,
            fit: Some(Fit { shape, rank: with_thumb.rank, counts: with_thumb.counts, ..*fit }),
            iterations,
            ..whole
        })
    }

    /// Whether a fitted thumb is valid: its length and width are near the acquired ones, and it is
    /// seen. A misplaced thumb would hide the finger.
    fn is_thumb(&self, x: &RibbonVector, fit: &Fit) -> bool {
        let spine = |x: &RibbonVector| x.fixed_rows::<2>(6).norm();
        let acquired = &self.hand.acquired;
        let within = |ratio: f64| (1.0 / THUMB_CHANGE..=THUMB_CHANGE).contains(&ratio);
        within(spine(x) / spine(acquired))
            && within(x[8] / acquired[8])
            && fit.support.of(Part::Thumb) >= THUMB_SEEN
    }

    /// Fits the first `D` components of the band template's shape vector, by the samples of the
    /// finger, or of the whole hand down to the thumb.
    pub(super) fn run_ribbon<const D: usize>(
        &mut self,
        scene: &Scene<'_>,
        from: &RibbonVector,
        down_to: Limb,
        plan: SearchPlan,
        prior: Option<&Prior<D>>,
    ) -> Result<FitResult<RibbonVector>> {
        let space = self.ribbon::<D>(from)?;
        let samples = match down_to {
            Limb::Finger => finger_samples(&self.samples),
            Limb::Thumb => self.hand.bands(&self.samples),
        };
        let stage = self.hand.stage(samples, scene, plan, self.options.polarity);
        let x = Ribbon::<D>::free(from);
        let found = self.convergence.run_bands(scene, &space, x, &stage, prior)?;
        Ok(found.map(|x| space.full(&x)))
    }

    pub(super) fn ribbon<const D: usize>(&self, about: &RibbonVector) -> Result<Ribbon<D>> {
        Ribbon::about(about, &self.hand.measure.with_thumb(self.hand.model.has_thumb))
    }

    /// Prior on the width of a finger that an object may cover; `None` of one that is not covered.
    pub(super) fn width_prior(&self, line_covariance: &Matrix2<f64>) -> Option<WidthPrior> {
        let (acquired, slack) = (&self.hand.acquired, self.hand.slack());
        self.hand.is_covered.then(|| WidthPrior {
            half_width_px: acquired[3],
            taper: acquired[4],
            half_width_sigma_px: slack * TRACKED_WIDTH_SIGMA * acquired[3],
            taper_sigma: slack * TRACKED_TAPER_SIGMA,
            axis_sigmas: [0, 1].map(|i| line_covariance[(i, i)].sqrt()),
        })
    }

    /// Prior on the components that a hand cannot change: widths and taper about the acquired ones,
    /// the thumb about its last place.
    pub(super) fn tracked_prior<const D: usize>(
        &self,
        last: &RibbonVector,
        slack: f64,
    ) -> Prior<D> {
        let acquired = &self.hand.acquired;
        let thumb_px = TRACKED_THUMB_SIGMA * self.hand.measure.length_px;
        let expected = [
            (0.0, f64::INFINITY),
            (0.0, f64::INFINITY),
            (0.0, f64::INFINITY),
            (acquired[3], TRACKED_WIDTH_SIGMA * acquired[3]),
            (acquired[4], TRACKED_TAPER_SIGMA),
            (last[5], thumb_px),
            (last[6], thumb_px),
            (last[7], thumb_px),
            (acquired[8], TRACKED_WIDTH_SIGMA * acquired[8]),
        ];
        let mut prior = Prior { mean: SVector::zeros(), information: SMatrix::zeros() };
        for (i, (mean, sigma)) in expected.iter().take(D).enumerate() {
            prior.mean[i] = *mean;
            prior.information[(i, i)] = (slack * sigma).powi(-2);
        }
        prior
    }
}
