//! The bare stretches of a finger that something covers in part.
//!
//! What lies on a finger, or beside it and looks like it, has edges as good as the finger's own. But
//! where a flank is bare, what is inside of it looks like the hand and what is outside like what has
//! been behind that; the rest is left out, with what is next to it.

use super::sketch::{SIDES, Sketch};
use crate::appearance::histogram::HistogramModel;
use crate::image::frame::Frame;

/// From one look at a flank to the next \[px\].
const STEP_PX: f64 = 1.0;
/// What is this near to a place that is covered is not bare \[px\]: a block of pixels, and the reach
/// of the kernels that find edges.
const MARGIN_PX: f64 = 3.0;

/// Where the flanks of a sketch are covered.
#[derive(Debug, Clone, Default)]
pub(super) struct VisibleFlanks {
    /// The places that were looked at and are not bare, in p.
    covered: [Vec<f64>; 2],
    /// How many were looked at.
    refined: [usize; 2],
}

/// One of the flanks, as far as it is bare.
#[derive(Debug, Clone, Copy)]
pub(super) struct VisibleFlank<'a> {
    /// 0 right, 1 left.
    pub index: usize,
    covered: &'a [f64],
}

impl VisibleFlanks {
    /// Looks along the flanks of a sketch, if its finger may be covered; all of another one is bare.
    pub fn measure(
        &mut self,
        frame: &Frame<'_>,
        appearance: Option<&HistogramModel>,
        sketch: &Sketch,
    ) {
        self.covered.iter_mut().for_each(Vec::clear);
        self.refined = [0; 2];
        let Some(appearance) = appearance.filter(|_| sketch.belief.is_some()) else { return };
        let (e, n) = (sketch.along, sketch.normal());
        let flanks = self.covered.iter_mut().zip(&mut self.refined);
        for (((covered, count), side), flank) in flanks.zip(SIDES).zip(sketch.flanks) {
            let mut p = flank.from_px;
            while p <= flank.to_px {
                let into_end = sketch.round_end_px.map_or(0.0, |end| (p - end).max(0.0));
                let radius = sketch.half_width_at(p - into_end);
                let across = (radius * radius - into_end * into_end).max(0.0).sqrt();
                let normal = (e * into_end + n * (side * across)) / radius;
                if !appearance.is_own_edge(frame, sketch.place(p, side * across), normal) {
                    covered.push(p);
                }
                *count += 1;
                p += STEP_PX;
            }
        }
    }

    /// The part of the places that were looked at that is bare, on the flank where it is less, 0–1.
    pub fn least_part(&self) -> f64 {
        let parts = self.covered.iter().zip(self.refined);
        let visible = parts.map(|(covered, all)| 1.0 - covered.len() as f64 / all.max(1) as f64);
        visible.fold(1.0, f64::min)
    }

    /// One of the flanks: 0 right, 1 left.
    pub fn flank(&self, index: usize) -> VisibleFlank<'_> {
        VisibleFlank { index, covered: &self.covered[index] }
    }
}

impl VisibleFlank<'_> {
    /// Whether some of it is not bare.
    pub fn is_partly_covered(&self) -> bool {
        !self.covered.is_empty()
    }

    /// Whether it is bare about p.
    pub fn is_visible(&self, p: f64) -> bool {
        self.covered.iter().all(|covered| (covered - p).abs() > MARGIN_PX)
    }
}
