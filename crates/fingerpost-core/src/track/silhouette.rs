//! The outline of a finger and its shaft, as far as colours are sampled along them.

use crate::appearance::histogram::HistogramModel;
use crate::geometry::ribbon::RibbonVector;
use crate::geometry::shape_space::{Axis, PlacedSample};
use crate::image::frame::Frame;
use nalgebra::{Point2, Vector2};
/// What looks like the hand votes for it by this much on average.
pub(super) const LIKE_HAND: f64 = 1.0;
/// An edge is a flank's if its normal points aside by this much at least.
const MIN_LATERAL: f64 = 0.7;

/// A finger is looked at in steps along its length of this part of its half-width and at least \[px\],
/// and in so many places across it, up to this part of the half-width from its axis.
const STEP_WIDTHS: f64 = 1.0 / 8.0;

const LEAST_STEP_PX: f64 = 1.0;

const PLACES: usize = 5;

const ACROSS: f64 = 0.6;

/// What is beside a flank is looked at so far from the edge's own pixels \[half-widths\].
const BESIDE: [f64; 3] = [0.2, 0.4, 0.6];

/// What lies ahead of its tip is looked at this far \[half-widths\].
pub(super) const AHEAD: f64 = 3.0;

/// The edge itself, this far to either side, is of neither colour; looks are learned up to that
/// far from it \[px\].
pub(super) const EDGE_PX: f64 = 2.0;

/// A finger as far as its looks are concerned.
#[derive(Debug, Clone, Copy)]
pub(super) struct Silhouette {
    /// Unit vector of pointing.
    pub ahead: Vector2<f64>,
    pub half_width_px: f64,
}

impl Silhouette {
    /// The edge itself, this far to either side, is of neither colour \[px\].
    pub const EDGE_PX: f64 = EDGE_PX;

    /// That of a band template.
    pub fn of_band(x: &RibbonVector) -> Self {
        Self { ahead: Vector2::new(x[2].cos(), x[2].sin()), half_width_px: x[3] }
    }

    /// Of these edges those of its left flank and those of its right one, by where their normals point.
    pub fn flanks<'a>(
        &self,
        edges: &'a [PlacedSample],
    ) -> [impl Iterator<Item = &'a PlacedSample> + use<'a>; 2] {
        let left = Vector2::new(self.ahead.y, -self.ahead.x);
        [left, -left]
            .map(|side| edges.iter().filter(move |edge| edge.normal.dot(&side) > MIN_LATERAL))
    }
}

/// A finger as far as it has to show that it is of one piece, and ends.
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

    /// The places across it, so far ahead of its tip.
    fn across(&self, ahead_px: f64) -> impl Iterator<Item = Point2<f64>> + use<> {
        let Self { axis, half_width_px, .. } = *self;
        let (direction, normal) = (axis.direction(), axis.normal());
        let places = (0..PLACES).map(|i| 2.0 * i as f64 / (PLACES - 1) as f64 - 1.0);
        places.map(move |across| {
            axis.tip + direction * ahead_px + normal * (across * ACROSS * half_width_px)
        })
    }

    /// The mean vote there.
    pub fn log_ratio(&self, frame: &Frame<'_>, appearance: &HistogramModel, ahead_px: f64) -> f64 {
        appearance.mean_log_ratio(frame, self.across(ahead_px))
    }

    /// Where what lies ahead of it is looked at.
    pub fn places_ahead(&self) -> impl Iterator<Item = Point2<f64>> {
        [self.half_width_px, self.length_px].into_iter().flat_map(|ahead_px| self.across(ahead_px))
    }

    /// How far back from its tip a finger shows, on its right and on its left \[px\]: hand between its
    /// flanks and none beside them, at most as far as it is long. Behind its knuckle is no hand, or more
    /// of it on either side.
    pub fn shows_px(&self, frame: &Frame<'_>, appearance: &HistogramModel) -> [f64; 2] {
        [1.0, -1.0].map(|side| {
            let (mut sum, mut best, mut end_px) = (0.0, 0.0, 0.0);
            for back_px in self.steps(self.half_width_px, self.length_px) {
                let beside = appearance.mean_log_ratio(frame, self.beside(-back_px, side));
                // No place says more than another: what is told is how many of them are a finger's.
                sum += self.log_ratio(frame, appearance, -back_px).min(-beside).clamp(-1.0, 1.0);
                if sum > best {
                    (best, end_px) = (sum, back_px);
                }
            }
            end_px
        })
    }

    /// Places beside a flank, so far ahead of the tip.
    fn beside(&self, ahead_px: f64, side: f64) -> impl Iterator<Item = Point2<f64>> + use<> {
        let Self { axis, half_width_px, .. } = *self;
        BESIDE.into_iter().map(move |out| {
            let across_px = half_width_px * (1.0 + out) + EDGE_PX;
            axis.tip + axis.direction() * ahead_px + axis.normal() * (side * across_px)
        })
    }

    /// The corners of where it is looked at, and beside.
    pub fn corners(&self) -> impl Iterator<Item = Point2<f64>> {
        [self.half_width_px, -self.length_px]
            .into_iter()
            .flat_map(|ahead_px| self.beside(ahead_px, 1.0).chain(self.beside(ahead_px, -1.0)))
    }

    /// How far ahead of its tip the hand goes on \[px\], beyond what may lie across it: to the end of
    /// the stretch that looks most like it, if that is as long as half the finger is wide.
    pub fn goes_on_px(&self, frame: &Frame<'_>, appearance: &HistogramModel) -> f64 {
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
