//! Extent of either flank that is the finger's: the part that agrees with the fit from the tip
//! backwards.
//!
//! A thumb along the finger hides the part of a flank next to the knuckle and has an edge of its
//! own there, as straight and as strong: a finger fitted to it is turned by some degrees. The part
//! next to the tip is hidden only by an occluder. So a flank counts from the tip backwards, as long
//! as more of its edges agree than not. A fit that leaves much of one flank unexplained, or fits it
//! much less precisely than the other, is repeated from the front.

use super::convergence::Convergence;
use super::fit_result::FitResult;
use super::options::MIN_HALF_LENGTH_PX;
use super::scene::Scene;
use super::stage::{Fit, FitStage, SearchPlan, StagePurpose};
use super::tracker::PINNED_SIGMA;
use crate::Result;
use crate::geometry::shape_space::ShapeSpace;
use crate::geometry::template::{Part, TemplateSample};
use crate::solve::fit::Prior;
use nalgebra::{SMatrix, SVector};

const FLANK_PARTS: [Part; 2] = [Part::LeftFlank, Part::RightFlank];
/// Least part of a flank's edges that agree from the tip on; below it the flank may be another
/// limb's. Of plain fingers nearly all edges agree; of one with a thumb along it, fitted to both,
/// hardly half.
const MOST: f64 = 0.75;
/// Ratio of the RMS residuals of the two flanks above which one may be another limb's in part, and
/// the least RMS for that \[px\]: a fit to a finger and a thumb agrees precisely with neither.
const LEANS: f64 = 2.0;
const LEANS_PX: f64 = 0.3;
/// Dimension of the finger alone with width and taper: a shape that only moves and turns cannot fit
/// a thumb as well.
const FINGER_DOF: usize = 5;

/// Extent of a flank by its edges.
#[derive(Debug, Clone, Copy)]
pub(super) struct FlankExtent {
    /// Positions along the finger from which it is visible, and from which it agrees with the fit,
    /// in units of the template.
    pub visible_from: f64,
    pub agrees_from: f64,
    /// Number of edges that agree minus those that do not, from there to the tip.
    agreeing: i32,
    /// Number of its edges.
    edges: i32,
}

impl FlankExtent {
    /// From a flank's samples from the tip on: the position of each, and the residual of its edge,
    /// if it has one. Edges with a residual below `within_px` agree; `None` without samples.
    fn of(from_tip: impl Iterator<Item = (f64, Option<f64>)>, within_px: f64) -> Option<Self> {
        let mut extent = None::<Self>;
        let mut sum = 0;
        for (along, abs_residual_px) in from_tip {
            sum += abs_residual_px.map_or(0, |px| balance(px, within_px));
            let start = Self { visible_from: along, agrees_from: along, agreeing: sum, edges: 0 };
            let extent = extent.get_or_insert(start);
            extent.visible_from = along;
            extent.edges += i32::from(abs_residual_px.is_some());
            if sum >= extent.agreeing {
                (extent.agrees_from, extent.agreeing) = (along, sum);
            }
        }
        extent
    }

    /// Whether less than the part [`MOST`] of it agrees.
    fn is_inconsistent(&self) -> bool {
        f64::from(self.agreeing) < MOST * f64::from(self.edges)
    }
}

impl Convergence {
    /// Extent of a flank whose residuals of the last fit are below `within_px`.
    pub fn extent(
        &self,
        samples: &[TemplateSample],
        flank: Part,
        within_px: f64,
    ) -> Option<FlankExtent> {
        let edges = || self.edges_along(samples, flank);
        // The outline runs along one flank to the tip and back along the other.
        let (first, last) = (edges().next()?.0, edges().next_back()?.0);
        if first < last {
            FlankExtent::of(edges().rev(), within_px)
        } else {
            FlankExtent::of(edges(), within_px)
        }
    }

    /// [`run`](Self::run) for the bands of a hand. If one flank of a finger alone may be another
    /// limb's in part, the finger is fitted by its front half, and then by the samples that agree
    /// with that. This fit is used if more edges agree with it from the tip on, or more precisely.
    pub fn run_bands<S: ShapeSpace<D>, const D: usize>(
        &mut self,
        scene: &Scene<'_>,
        space: &S,
        x: SVector<f64, D>,
        stage: &FitStage<'_>,
        prior: Option<&Prior<D>>,
    ) -> Result<FitResult<SVector<f64, D>>> {
        let found = self.run(scene, space, x, stage, prior)?;
        let Some(fit) = found.fit.filter(|_| D == FINGER_DOF) else { return Ok(found) };
        let samples = stage.samples;
        let is_inconsistent = self.inconsistent_flanks(samples, f64::INFINITY) > 0;
        if !is_inconsistent && !self.is_one_sided(samples) {
            return Ok(found);
        }
        let exact_px = LEANS_PX.max(fit.residual_rms_px / LEANS);
        let within_px = if is_inconsistent { f64::INFINITY } else { exact_px };
        let agreeing = self.agreeing_from_tip(samples, within_px);
        let from_front = self.run_from_front(scene, space, x, stage, prior)?;
        // If both flanks turn, the finger is bent.
        if from_front.fit.is_some()
            && (is_inconsistent || self.inconsistent_flanks(samples, within_px) <= 1)
            && self.agreeing_from_tip(samples, within_px) > agreeing
        {
            return Ok(from_front);
        }
        // Repeated, so that the last search belongs to the fit that is returned.
        self.run(scene, space, x, stage, prior)
    }

    /// The finger fitted by its front half, then by the part of its flanks that agrees with that;
    /// its support is that of the whole finger.
    fn run_from_front<S: ShapeSpace<D>, const D: usize>(
        &mut self,
        scene: &Scene<'_>,
        space: &S,
        x: SVector<f64, D>,
        stage: &FitStage<'_>,
        prior: Option<&Prior<D>>,
    ) -> Result<FitResult<SVector<f64, D>>> {
        let plan = SearchPlan { purpose: StagePurpose::TakenOver, ..stage.plan };
        let front = FitStage { samples: front(stage.samples), plan, ..*stage };
        let ahead = self.run(scene, space, x, &front, prior)?;
        let half_length_px = stage.plan.half_length_px.min(MIN_HALF_LENGTH_PX);
        let plan = SearchPlan { half_length_px, window: None, ..stage.plan };
        let near = FitStage { plan, ..*stage };
        self.run(scene, space, ahead.shape, &near, Some(&pinned(&ahead.shape)))?;
        let agreeing = FitStage { samples: self.agreeing_samples(stage.samples), ..near };
        let refitted = self.run(scene, space, ahead.shape, &agreeing, prior)?;
        let whole =
            self.run(scene, space, refitted.shape, &near, Some(&pinned(&refitted.shape)))?;
        let fit = refitted.fit.zip(whole.fit).map(|(refitted, whole)| {
            let Fit { shape, axis, line_covariance, .. } = refitted;
            Fit { shape, axis, line_covariance, ..whole }
        });
        let iterations = ahead.iterations + refitted.iterations + whole.iterations;
        Ok(FitResult { fit, iterations, ..refitted })
    }

    /// Number of flanks that leave much unexplained within `within_px`.
    fn inconsistent_flanks(&self, samples: &[TemplateSample], within_px: f64) -> usize {
        self.extents(samples, within_px).filter(FlankExtent::is_inconsistent).count()
    }

    /// Whether one flank is fitted much less precisely than the other.
    fn is_one_sided(&self, samples: &[TemplateSample]) -> bool {
        let [left, right] = FLANK_PARTS.map(|flank| self.rms_px(samples, flank));
        left.max(right) > (LEANS * left.min(right)).max(LEANS_PX)
    }

    /// RMS residual of the agreeing edges of a part of the outline \[px\].
    fn rms_px(&self, samples: &[TemplateSample], part: Part) -> f64 {
        let edges = self.edges_along(samples, part).filter_map(|(_, px)| px);
        let (square, count) = edges
            .filter(|px| px.is_finite())
            .fold((0.0, 0), |(square, count), px| (square + px * px, count + 1));
        (square / f64::from(count.max(1))).sqrt()
    }

    /// Number of edges that agree minus those that do not, of the tip and of the agreeing extent of
    /// either flank.
    fn agreeing_from_tip(&self, samples: &[TemplateSample], within_px: f64) -> i32 {
        let tip = self.edges_along(samples, Part::Tip).filter_map(|(_, px)| px);
        let flanks = self.extents(samples, within_px).map(|extent| extent.agreeing);
        flanks.sum::<i32>() + tip.map(|px| balance(px, within_px)).sum::<i32>()
    }

    /// The finger's samples without those behind the agreeing extent of a flank.
    fn agreeing_samples<'a>(&self, samples: &'a [TemplateSample]) -> &'a [TemplateSample] {
        let from = FLANK_PARTS.map(|flank| {
            let extent = self.extent(samples, flank, f64::INFINITY);
            extent.map_or(f64::INFINITY, |extent| extent.agrees_from)
        });
        between(samples, |s| match s.part() {
            Part::LeftFlank => s.along >= from[0],
            Part::RightFlank => s.along >= from[1],
            Part::Tip | Part::Thumb => true,
        })
    }

    fn extents(
        &self,
        samples: &[TemplateSample],
        within_px: f64,
    ) -> impl Iterator<Item = FlankExtent> {
        FLANK_PARTS.into_iter().filter_map(move |flank| self.extent(samples, flank, within_px))
    }
}

/// Contribution of an edge to the number that agree minus those that do not.
fn balance(abs_residual_px: f64, within_px: f64) -> i32 {
    if abs_residual_px < within_px { 1 } else { -1 }
}

/// Prior that fixes a shape vector.
fn pinned<const D: usize>(x: &SVector<f64, D>) -> Prior<D> {
    let information = SMatrix::from_diagonal_element(PINNED_SIGMA.powi(-2));
    Prior { mean: *x, information }
}

/// The finger's samples that are nearer to its tip than to the beginning of its flanks.
fn front(samples: &[TemplateSample]) -> &[TemplateSample] {
    let ends = samples.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(from, to), s| {
        (from.min(s.along), to.max(s.along))
    });
    let middle = 0.5 * (ends.0 + ends.1);
    between(samples, |s| s.along >= middle)
}

/// The samples from the first to the last for which `counts` holds.
fn between(
    samples: &[TemplateSample],
    counts: impl Fn(&TemplateSample) -> bool,
) -> &[TemplateSample] {
    let from = samples.iter().position(&counts).unwrap_or(0);
    let to = samples.iter().rposition(&counts).map_or(samples.len(), |last| last + 1);
    &samples[from..to]
}
