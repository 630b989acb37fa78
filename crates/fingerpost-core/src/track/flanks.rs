//! How much of either flank is the finger's: what agrees from the tip backwards.
//!
//! A thumb that lies along the finger hides the part of a flank that is next to the knuckle, and has an
//! edge of its own there, as straight and as strong: a finger that is fitted to it is turned by some
//! degrees. What is next to the tip is hidden by nothing but a cover. So a flank counts from the tip on,
//! for as long as more of its edges agree than not; and a fit that leaves much of one flank unexplained,
//! or fits it far less exactly than the other, is tried once more from the front.

use super::convergence::Convergence;
use super::options::MIN_HALF_LENGTH_PX;
use super::scene::Scene;
use super::stage::{Converged, Fit, FitStage, StageEnd};
use super::tracker::PINNED_SIGMA;
use crate::Result;
use crate::geometry::shape_space::ShapeSpace;
use crate::geometry::template::{Part, TemplateSample};
use crate::solve::fit::Prior;
use nalgebra::{SMatrix, SVector};

const FLANK_PARTS: [Part; 2] = [Part::LeftFlank, Part::RightFlank];
/// A flank of whose edges a smaller part agrees from the tip on may be another limb's. Of plain fingers
/// nearly all do, and of one with a thumb along it that is fitted to both hardly half.
const MOST: f64 = 0.75;
/// A flank whose edges are so many times as far from the fit as the other's, and at least so far \[px\],
/// may be another limb's in part: a fit that leans on both halves agrees with neither exactly.
const LEANS: f64 = 2.0;
const LEANS_PX: f64 = 0.3;
/// The finger alone, with its width and taper: a shape that only moves and turns cannot lean on a thumb.
const FINGER_DOF: usize = 5;

/// What the edges of a flank tell.
#[derive(Debug, Clone, Copy)]
pub(super) struct FlankExtent {
    /// From where along the finger it is visible, and from where on it agrees with the fit, in units of
    /// the template.
    pub visible_from: f64,
    pub agrees_from: f64,
    /// By how many more edges agree from there to the tip than do not.
    agreeing: i32,
    /// Its edges.
    edges: i32,
}

impl FlankExtent {
    /// Of a flank's samples from the tip on: where each is, and how far its edge is from the fit, if it
    /// has one. Edges agree that are nearer than `within_px`.
    fn of(from_tip: impl Iterator<Item = (f64, Option<f64>)>, within_px: f64) -> Option<Self> {
        let mut extent = None::<Self>;
        let mut sum = 0;
        for (along, left_px) in from_tip {
            sum += left_px.map_or(0, |px| balance(px, within_px));
            let start = Self { visible_from: along, agrees_from: along, agreeing: sum, edges: 0 };
            let extent = extent.get_or_insert(start);
            extent.visible_from = along;
            extent.edges += i32::from(left_px.is_some());
            if sum >= extent.agreeing {
                (extent.agrees_from, extent.agreeing) = (along, sum);
            }
        }
        extent
    }

    /// Whether much of it does not agree.
    fn strays(&self) -> bool {
        f64::from(self.agreeing) < MOST * f64::from(self.edges)
    }
}

impl Convergence {
    /// How much of a flank agrees with the last fit to within so much.
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

    /// [`run`](Self::run) for the bands of a hand. A finger alone one of whose flanks may be another
    /// limb's in part is fitted by its front half, and then by what agrees with that; this counts if more
    /// of the finger agrees with it from the tip on, or more exactly.
    pub fn run_bands<S: ShapeSpace<D>, const D: usize>(
        &mut self,
        frame: &Scene<'_>,
        space: &S,
        x: SVector<f64, D>,
        stage: &FitStage<'_>,
        believed: Option<&Prior<D>>,
    ) -> Result<Converged<D>> {
        let found = self.run(frame, space, x, stage, believed)?;
        let Some(fit) = found.fit.filter(|_| D == FINGER_DOF) else { return Ok(found) };
        let samples = stage.samples;
        let strays = self.straying(samples, f64::INFINITY) > 0;
        if !strays && !self.leans(samples) {
            return Ok(found);
        }
        let exact_px = LEANS_PX.max(fit.residual_rms_px / LEANS);
        let within_px = if strays { f64::INFINITY } else { exact_px };
        let agreeing = self.agreeing_from_tip(samples, within_px);
        let from_front = self.run_from_front(frame, space, x, stage, believed)?;
        // Where both flanks turn, the finger is bent.
        if from_front.fit.is_some()
            && (strays || self.straying(samples, within_px) <= 1)
            && self.agreeing_from_tip(samples, within_px) > agreeing
        {
            return Ok(from_front);
        }
        // Once more, so that the last search is that of the best.
        self.run(frame, space, x, stage, believed)
    }

    /// A finger by its front half, then by as much of its flanks as agrees with that; its support is that
    /// of all of it.
    fn run_from_front<S: ShapeSpace<D>, const D: usize>(
        &mut self,
        frame: &Scene<'_>,
        space: &S,
        x: SVector<f64, D>,
        stage: &FitStage<'_>,
        believed: Option<&Prior<D>>,
    ) -> Result<Converged<D>> {
        let front = FitStage { samples: front(stage.samples), rest: StageEnd::TakenOver, ..*stage };
        let ahead = self.run(frame, space, x, &front, believed)?;
        let half_length_px = stage.half_length_px.min(MIN_HALF_LENGTH_PX);
        let near = FitStage { half_length_px, window: None, ..*stage };
        self.run(frame, space, ahead.x, &near, Some(&pinned(&ahead.x)))?;
        let agreeing = FitStage { samples: self.agreeing_samples(stage.samples), ..near };
        let own = self.run(frame, space, ahead.x, &agreeing, believed)?;
        let whole = self.run(frame, space, own.x, &near, Some(&pinned(&own.x)))?;
        let fit = own.fit.zip(whole.fit).map(|(own, whole)| {
            let Fit { shape, axis, line_covariance, .. } = own;
            Fit { shape, axis, line_covariance, ..whole }
        });
        let iterations = ahead.iterations + own.iterations + whole.iterations;
        Ok(Converged { fit, iterations, ..own })
    }

    /// How many flanks leave much unexplained to within so much.
    fn straying(&self, samples: &[TemplateSample], within_px: f64) -> usize {
        self.extents(samples, within_px).filter(FlankExtent::strays).count()
    }

    /// Whether one flank is fitted far less exactly than the other.
    fn leans(&self, samples: &[TemplateSample]) -> bool {
        let [left, right] = FLANK_PARTS.map(|flank| self.rms_px(samples, flank));
        left.max(right) > (LEANS * left.min(right)).max(LEANS_PX)
    }

    /// Root mean square of how far the agreeing edges of a part of the outline are from the fit \[px\].
    fn rms_px(&self, samples: &[TemplateSample], part: Part) -> f64 {
        let edges = self.edges_along(samples, part).filter_map(|(_, px)| px);
        let (square, count) = edges
            .filter(|px| px.is_finite())
            .fold((0.0, 0), |(square, count), px| (square + px * px, count + 1));
        (square / f64::from(count.max(1))).sqrt()
    }

    /// By how many more edges agree than do not, of the tip and of either flank as far as it agrees.
    fn agreeing_from_tip(&self, samples: &[TemplateSample], within_px: f64) -> i32 {
        let tip = self.edges_along(samples, Part::Tip).filter_map(|(_, px)| px);
        let flanks = self.extents(samples, within_px).map(|extent| extent.agreeing);
        flanks.sum::<i32>() + tip.map(|px| balance(px, within_px)).sum::<i32>()
    }

    /// The finger's samples without those behind where a flank agrees.
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

/// What an edge so far from the fit adds to how many agree to within so much more than do not.
fn balance(left_px: f64, within_px: f64) -> i32 {
    if left_px < within_px { 1 } else { -1 }
}

/// A shape vector that stays what it is.
fn pinned<const D: usize>(x: &SVector<f64, D>) -> Prior<D> {
    let information = SMatrix::from_diagonal_element(PINNED_SIGMA.powi(-2));
    Prior { mean: *x, information }
}

/// The finger's samples that are nearer to its tip than to where its flanks begin.
fn front(samples: &[TemplateSample]) -> &[TemplateSample] {
    let ends = samples.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(from, to), s| {
        (from.min(s.along), to.max(s.along))
    });
    let middle = 0.5 * (ends.0 + ends.1);
    between(samples, |s| s.along >= middle)
}

/// The samples from the first to the last that count.
fn between(
    samples: &[TemplateSample],
    counts: impl Fn(&TemplateSample) -> bool,
) -> &[TemplateSample] {
    let from = samples.iter().position(&counts).unwrap_or(0);
    let to = samples.iter().rposition(&counts).map_or(samples.len(), |last| last + 1);
    &samples[from..to]
}
