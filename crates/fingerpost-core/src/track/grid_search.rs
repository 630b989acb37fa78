//! Coarse localisation: the pose, on a grid, that best separates hand pixels inside the contour
//! from background pixels outside.
//!
//! A search along normals leads the contour to the hand if most of its lines cross the hand's edge
//! and few others. A hand that rotated between two frames may be out of its range, however long the
//! lines are, but its pixels still have high log-likelihood ratios. The poses of the grid are
//! scored by the log-likelihood ratios on either side of the contour. They are at most [`SPACING`]
//! half-widths apart, or 1 / [`MOST_STEPS`] of the range if that is more, which bounds the run
//! time. This is too coarse to fit the contour and fine enough to initialise the fit.

use crate::appearance::histogram::HistogramModel;
use crate::geometry::shape_space::PlacedSample;
use crate::image::frame::Frame;
use nalgebra::{Point2, Vector2};

/// Largest spacing of the grid, as a fraction of the finger's half-width, that being at least
/// [`CLEARANCE_PX`]; exceeded where [`MOST_STEPS`] is reached.
const SPACING: f64 = 0.6;
/// Largest number of steps from the middle of the grid to its border.
const MOST_STEPS: f64 = 12.0;
/// Pixels are sampled at half the finger's half-width on either side of the contour, but at least
/// this far from it, outside its blurred edge \[px\].
const CLEARANCE_PX: f64 = 3.0;

/// A contour to score: pixels inside and outside of it.
#[derive(Debug, Clone)]
pub(super) struct GridSearch {
    half_width_px: f64,
    pairs: Vec<Pair>,
}

#[derive(Debug, Clone, Copy)]
struct Pair {
    inside: Point2<f64>,
    outside: Point2<f64>,
}

/// The score of a displacement.
#[derive(Debug, Clone, Copy)]
pub(super) struct ShiftScore {
    /// Displacement of the contour \[px\].
    pub by_px: Vector2<f64>,
    /// Mean log-likelihood ratio inside minus that outside.
    pub separation: f32,
}

impl GridSearch {
    pub fn with_capacity(samples: usize) -> Self {
        Self { half_width_px: 0.0, pairs: Vec::with_capacity(samples) }
    }

    /// Removes the contour; the next one's finger has the half-width `half_width_px`.
    pub fn clear(&mut self, half_width_px: f64) {
        self.half_width_px = half_width_px;
        self.pairs.clear();
    }

    /// Adds a sample of the contour.
    pub fn push(&mut self, sample: &PlacedSample) {
        let PlacedSample { position, normal } = sample;
        let offset = normal * (0.5 * self.half_width_px).max(CLEARANCE_PX);
        self.pairs.push(Pair { inside: position - offset, outside: position + offset });
    }

    /// The pixels that score the contour in its present place.
    pub fn pixels(&self) -> impl Iterator<Item = Point2<f64>> {
        self.pairs.iter().flat_map(|pair| [pair.inside, pair.outside])
    }

    /// The best-scoring displacement, by at most `reach_px` along u and v.
    pub fn best(
        &self,
        frame: &Frame<'_>,
        appearance: &HistogramModel,
        reach_px: f64,
    ) -> ShiftScore {
        let spacing_px = SPACING * self.half_width_px.max(CLEARANCE_PX);
        let steps = (reach_px / spacing_px).ceil().clamp(1.0, MOST_STEPS) as i32;
        let step_px = reach_px / f64::from(steps);
        let mut best = self.score(frame, appearance, Vector2::zeros());
        for i in -steps..=steps {
            for j in -steps..=steps {
                let by_px = Vector2::new(f64::from(i), f64::from(j)) * step_px;
                let candidate = self.score(frame, appearance, by_px);
                if candidate.separation > best.separation {
                    best = candidate;
                }
            }
        }
        best
    }

    fn score(
        &self,
        frame: &Frame<'_>,
        appearance: &HistogramModel,
        by_px: Vector2<f64>,
    ) -> ShiftScore {
        let log_ratio =
            |at: &Point2<f64>| appearance.log_ratio(frame, at.x + by_px.x, at.y + by_px.y);
        let sum: f32 =
            self.pairs.iter().map(|pair| log_ratio(&pair.inside) - log_ratio(&pair.outside)).sum();
        ShiftScore { by_px, separation: sum / self.pairs.len().max(1) as f32 }
    }
}
