//! Outline and shaft of a finger, for the sampling of colours along them.

use crate::appearance::histogram::HistogramModel;
use crate::geometry::ribbon::RibbonVector;
use crate::geometry::shape_space::{Axis, PlacedSample};
use crate::image::frame::Frame;
use nalgebra::{Point2, Vector2};
/// Mean log-likelihood ratio at and above which pixels are like the hand.
const LIKE_HAND: f64 = 1.0;
/// Least lateral component of the normal of a flank's edge, the sine of its angle to the finger's
/// direction.
const MIN_LATERAL: f64 = 0.7;

/// Sampling of a finger: step along its length, as a part of its half-width and at least \[px\];
/// number of places across it, and their limit as a part of the half-width from its axis.
const STEP_WIDTHS: f64 = 1.0 / 8.0;

const LEAST_STEP_PX: f64 = 1.0;

const PLACES: usize = 5;

const ACROSS: f64 = 0.6;

/// Distances beside a flank at which its surroundings are sampled, from the end of the edge's own
/// pixels \[half-widths\].
const BESIDE: [f64; 3] = [0.2, 0.4, 0.6];

/// Distance ahead of the tip up to which it is sampled \[half-widths\].
pub(super) const AHEAD: f64 = 3.0;

/// Half the width of an edge's mixed pixels, which belong to neither side and are not learned
/// \[px\].
pub(super) const EDGE_PX: f64 = 2.0;

/// Direction and width of a finger, for the learning of its appearance.
#[derive(Debug, Clone, Copy)]
pub(super) struct Silhouette {
    /// Unit vector of the pointing direction.
    pub ahead: Vector2<f64>,
    pub half_width_px: f64,
}

impl Silhouette {
    /// Half the width of an edge's mixed pixels \[px\].
    pub const EDGE_PX: f64 = EDGE_PX;

    /// That of a band template.
    pub fn of_band(x: &RibbonVector) -> Self {
        Self { ahead: Vector2::new(x[2].cos(), x[2].sin()), half_width_px: x[3] }
    }

    /// The edges of the left flank and those of the right one, by the directions of their normals.
    pub fn flanks<'a>(
        &self,
        edges: &'a [PlacedSample],
    ) -> [impl Iterator<Item = &'a PlacedSample> + use<'a>; 2] {
        let left = Vector2::new(self.ahead.y, -self.ahead.x);
        [left, -left]
            .map(|side| edges.iter().filter(move |edge| edge.normal.dot(&side) > MIN_LATERAL))
    }
}

/// A finger's shaft, for the tests whether it is in one piece and where it ends.
#[derive(Debug, Clone, Copy)]
pub(super) struct Shaft {
    pub axis: Axis,
    pub half_width_px: f64,
    pub length_px: f64,
}

impl Shaft {
    /// That of a band template of this length.
    pub fn of_band(x: &RibbonVector, length_px: f64) -> Self {
        let axis = Axis::of_finger(Point2::new(x[0], x[1]), x[2], 0.5 * length_px);
        Self { axis, half_width_px: x[3], length_px }
    }

    fn step_px(&self) -> f64 {
        (STEP_WIDTHS * self.half_width_px).max(LEAST_STEP_PX)
    }

    /// Places along it in steps \[px ahead of its tip\].
    pub fn steps(&self, from_px: f64, to_px: f64) -> impl Iterator<Item = f64> + use<> {
        let step_px = self.step_px();
        let count = ((to_px - from_px) / step_px).max(0.0) as usize;
        (0..count).map(move |i| from_px + i as f64 * step_px)
    }

    /// Places across it, `ahead_px` ahead of its tip.
    fn across(&self, ahead_px: f64) -> impl Iterator<Item = Point2<f64>> + use<> {
        let Self { axis, half_width_px, .. } = *self;
        let (direction, normal) = (axis.direction(), axis.normal());
        let places = (0..PLACES).map(|i| 2.0 * i as f64 / (PLACES - 1) as f64 - 1.0);
        places.map(move |across| {
            axis.tip + direction * ahead_px + normal * (across * ACROSS * half_width_px)
        })
    }

    /// Mean log-likelihood ratio there.
    pub fn log_ratio(&self, frame: &Frame<'_>, appearance: &HistogramModel, ahead_px: f64) -> f64 {
        appearance.mean_log_ratio(frame, self.across(ahead_px))
    }

    /// Places ahead of its tip that are sampled.
    pub fn places_ahead(&self) -> impl Iterator<Item = Point2<f64>> {
        [self.half_width_px, self.length_px].into_iter().flat_map(|ahead_px| self.across(ahead_px))
    }

    /// Length of the visible finger from its tip back, on its right and on its left \[px\]: the
    /// hand between its flanks and not beside them, limited to its own length. Behind the knuckle
    /// is no hand, or more hand on either side.
    pub fn shows_px(&self, frame: &Frame<'_>, appearance: &HistogramModel) -> [f64; 2] {
        [1.0, -1.0].map(|side| {
            let (mut sum, mut best, mut end_px) = (0.0, 0.0, 0.0);
            for back_px in self.steps(self.half_width_px, self.length_px) {
                let beside = appearance.mean_log_ratio(frame, self.beside(-back_px, side));
                // Each place counts at most 1, so that the sum is the number of places like a
                // finger minus the others.
                sum += self.log_ratio(frame, appearance, -back_px).min(-beside).clamp(-1.0, 1.0);
                if sum > best {
                    (best, end_px) = (sum, back_px);
                }
            }
            end_px
        })
    }

    /// Places beside a flank, `ahead_px` ahead of the tip.
    fn beside(&self, ahead_px: f64, side: f64) -> impl Iterator<Item = Point2<f64>> + use<> {
        let Self { axis, half_width_px, .. } = *self;
        BESIDE.into_iter().map(move |out| {
            let across_px = half_width_px * (1.0 + out) + EDGE_PX;
            axis.tip + axis.direction() * ahead_px + axis.normal() * (side * across_px)
        })
    }

    /// Corners of the region that is sampled, on it and beside it.
    pub fn corners(&self) -> impl Iterator<Item = Point2<f64>> {
        [self.half_width_px, -self.length_px]
            .into_iter()
            .flat_map(|ahead_px| self.beside(ahead_px, 1.0).chain(self.beside(ahead_px, -1.0)))
    }

    /// Length by which the hand continues ahead of its tip \[px\], beyond an occluder across it: up
    /// to the end of the segment with the largest sum of log-likelihood ratios; 0 if that is less
    /// than the sum over half the finger's width of hand.
    pub fn extension_beyond_tip_px(&self, frame: &Frame<'_>, appearance: &HistogramModel) -> f64 {
        let (mut sum, mut best, mut end_px) = (0.0_f64, 0.0, 0.0);
        for ahead_px in self.steps(self.half_width_px, self.length_px) {
            sum = sum.max(0.0) + self.log_ratio(frame, appearance, ahead_px) * self.step_px();
            if sum > best {
                (best, end_px) = (sum, ahead_px);
            }
        }
        if best >= LIKE_HAND * self.half_width_px { end_px } else { 0.0 }
    }
}
