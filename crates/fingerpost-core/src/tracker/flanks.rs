//! How much of either flank is the finger's: what agrees from the tip backwards.
//!
//! A thumb that lies along the finger hides the part of a flank that is next to the knuckle, and has an
//! edge of its own there, as straight and as strong: a finger that is fitted to it is turned by some
//! degrees. What is next to the tip is hidden by nothing but a cover. So a flank counts from the tip on,
//! for as long as more of its edges agree than not; and a fit that leaves much of a flank unexplained is
//! tried once more from the front.

use super::convergence::{Attempt, Converged, Convergence, Fit, MIN_HALF_LENGTH_PX, Rest};
use super::scene::Scene;
use crate::Result;
use crate::fit::Prior;
use crate::shape_space::ShapeSpace;
use crate::template::{Part, TemplateSample};
use nalgebra::{SMatrix, SVector};

const FLANKS: [Part; 2] = [Part::LeftFlank, Part::RightFlank];
/// A flank of whose edges a smaller part agrees from the tip on may be another limb's. Of plain fingers
/// nearly all do, and of one with a thumb along it that is fitted to both hardly half.
const MOST: f64 = 0.75;
/// The finger alone, with its width and taper: a shape that only moves and turns cannot lean on a thumb.
const FINGER_DOF: usize = 5;
/// So sure that no edge changes it \[px, rad, 1\].
const PINNED_SIGMA: f64 = 1e-4;

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
    /// Of a flank's samples from the tip on: where each is, and whether its edge agrees, if it has one.
    fn of(from_tip: impl Iterator<Item = (f64, Option<bool>)>) -> Option<Self> {
        let mut extent = None::<Self>;
        let mut sum = 0;
        for (along, agrees) in from_tip {
            sum += agrees.map_or(0, balance);
            let start = Self { visible_from: along, agrees_from: along, agreeing: sum, edges: 0 };
            let extent = extent.get_or_insert(start);
            extent.visible_from = along;
            extent.edges += i32::from(agrees.is_some());
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
    /// How much of a flank agrees with the last fit.
    pub fn extent(&self, samples: &[TemplateSample], flank: Part) -> Option<FlankExtent> {
        let edges = || self.edges_along(samples, flank);
        // The outline runs along one flank to the tip and back along the other.
        let (first, last) = (edges().next()?.0, edges().next_back()?.0);
        if first < last { FlankExtent::of(edges().rev()) } else { FlankExtent::of(edges()) }
    }

    /// [`run`](Self::run) for the bands of a hand. A finger alone of which a flank strays is fitted by its
    /// front half, and then by what agrees with that; this counts if more agrees from the tip on.
    pub fn run_bands<S: ShapeSpace<D>, const D: usize>(
        &mut self,
        frame: &Scene<'_>,
        space: &S,
        x: SVector<f64, D>,
        attempt: &Attempt<'_>,
        believed: Option<&Prior<D>>,
    ) -> Result<Converged<D>> {
        let found = self.run(frame, space, x, attempt, believed)?;
        if D != FINGER_DOF || found.fit.is_none() || !self.strays(attempt.samples) {
            return Ok(found);
        }
        let agreeing = self.agreeing_from_tip(attempt.samples);
        let from_front = self.run_from_front(frame, space, x, attempt, believed)?;
        if from_front.fit.is_some() && self.agreeing_from_tip(attempt.samples) > agreeing {
            return Ok(from_front);
        }
        // Once more, so that the last search is that of the best.
        self.run(frame, space, x, attempt, believed)
    }

    /// A finger by its front half, then by as much of its flanks as agrees with that; its support is that
    /// of all of it.
    fn run_from_front<S: ShapeSpace<D>, const D: usize>(
        &mut self,
        frame: &Scene<'_>,
        space: &S,
        x: SVector<f64, D>,
        attempt: &Attempt<'_>,
        believed: Option<&Prior<D>>,
    ) -> Result<Converged<D>> {
        let front = Attempt { samples: front(attempt.samples), rest: Rest::TakenOver, ..*attempt };
        let ahead = self.run(frame, space, x, &front, believed)?;
        let half_length_px = attempt.half_length_px.min(MIN_HALF_LENGTH_PX);
        let near = Attempt { half_length_px, window: None, ..*attempt };
        self.run(frame, space, ahead.x, &near, Some(&pinned(&ahead.x)))?;
        let agreeing = Attempt { samples: self.agreeing_samples(attempt.samples), ..near };
        let own = self.run(frame, space, ahead.x, &agreeing, believed)?;
        let whole = self.run(frame, space, own.x, &near, Some(&pinned(&own.x)))?;
        let fit = own.fit.zip(whole.fit).map(|(own, whole)| {
            let Fit { shape, axis, line_covariance, .. } = own;
            Fit { shape, axis, line_covariance, ..whole }
        });
        let iterations = ahead.iterations + own.iterations + whole.iterations;
        Ok(Converged { fit, iterations, ..own })
    }

    fn strays(&self, samples: &[TemplateSample]) -> bool {
        FLANKS.into_iter().filter_map(|flank| self.extent(samples, flank)).any(|e| e.strays())
    }

    /// By how many more edges agree than do not, of the tip and of either flank as far as it agrees.
    fn agreeing_from_tip(&self, samples: &[TemplateSample]) -> i32 {
        let flanks = FLANKS.into_iter().filter_map(|flank| self.extent(samples, flank));
        let tip = self.edges_along(samples, Part::Tip).filter_map(|(_, agrees)| agrees);
        flanks.map(|e| e.agreeing).sum::<i32>() + tip.map(balance).sum::<i32>()
    }

    /// The finger's samples without those behind where a flank agrees.
    fn agreeing_samples<'a>(&self, samples: &'a [TemplateSample]) -> &'a [TemplateSample] {
        let from =
            |flank| self.extent(samples, flank).map_or(f64::INFINITY, |extent| extent.agrees_from);
        let (left, right) = (from(Part::LeftFlank), from(Part::RightFlank));
        between(samples, |s| match s.part() {
            Part::LeftFlank => s.along >= left,
            Part::RightFlank => s.along >= right,
            Part::Tip | Part::Thumb => true,
        })
    }
}

/// What an edge adds to how many agree more than do not.
fn balance(agrees: bool) -> i32 {
    if agrees { 1 } else { -1 }
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
