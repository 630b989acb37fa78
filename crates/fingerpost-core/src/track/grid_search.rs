//! From afar: which pose, of many, has what looks like the hand inside and what does not outside.
//!
//! A search along normals leads the contour to the hand if most of its lines cross the hand's edge
//! and little else. A hand that turned round between two frames is beyond that, however long the
//! lines are; its pixels still vote for it. A grid of poses, as fine as the finger is wide, is judged
//! by the votes on either side of the contour: too coarse to place it, fine enough to find it.

use crate::appearance::histogram::HistogramModel;
use crate::geometry::shape_space::PlacedSample;
use crate::image::frame::Frame;
use nalgebra::{Point2, Vector2};

/// Distance between the poses of the grid, in parts of the finger's half-width.
const SPACING: f64 = 0.6;
/// At most this many poses lie between the middle of the grid and its border.
const MOST_STEPS: f64 = 12.0;
/// Pixels are judged at half the finger's half-width on either side of the contour, but not in its
/// blurred edge \[px\].
const CLEARANCE_PX: f64 = 3.0;

/// A contour to judge: pixels inside and outside of it.
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

/// A place that was judged.
#[derive(Debug, Clone, Copy)]
pub(super) struct ShiftScore {
    /// How far the contour was moved there \[px\].
    pub by_px: Vector2<f64>,
    /// Mean vote inside minus mean vote outside.
    pub separation: f32,
}

impl GridSearch {
    pub fn with_capacity(samples: usize) -> Self {
        Self { half_width_px: 0.0, pairs: Vec::with_capacity(samples) }
    }

    /// Forgets the contour; the next one's finger is `half_width_px` wide on either side.
    pub fn clear(&mut self, half_width_px: f64) {
        self.half_width_px = half_width_px;
        self.pairs.clear();
    }

    /// Adds a sample of the contour.
    pub fn push(&mut self, sample: &PlacedSample) {
        let PlacedSample { position, normal } = sample;
        let away = normal * (0.5 * self.half_width_px).max(CLEARANCE_PX);
        self.pairs.push(Pair { inside: position - away, outside: position + away });
    }

    /// The pixels that judge the contour where it is.
    pub fn pixels(&self) -> impl Iterator<Item = Point2<f64>> {
        self.pairs.iter().flat_map(|pair| [pair.inside, pair.outside])
    }

    /// Where the contour separates the hand best, moved by at most `reach_px` along u and v.
    pub fn best(
        &self,
        frame: &Frame<'_>,
        appearance: &HistogramModel,
        reach_px: f64,
    ) -> ShiftScore {
        let spacing_px = SPACING * self.half_width_px.max(CLEARANCE_PX);
        let steps = (reach_px / spacing_px).ceil().clamp(1.0, MOST_STEPS) as i32;
        let step_px = reach_px / f64::from(steps);
        let mut best = self.judge(frame, appearance, Vector2::zeros());
        for i in -steps..=steps {
            for j in -steps..=steps {
                let by_px = Vector2::new(f64::from(i), f64::from(j)) * step_px;
                let judged = self.judge(frame, appearance, by_px);
                if judged.separation > best.separation {
                    best = judged;
                }
            }
        }
        best
    }

    fn judge(
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
