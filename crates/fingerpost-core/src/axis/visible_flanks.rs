//! The visible stretches of a partly covered finger.
//!
//! An object on a finger, or beside it with similar pixels, has edges as good as the finger's own.
//! Where a flank is visible, the pixels inside resemble the hand and those outside the background.
//! All other places are left out, with a margin.

use super::finger_estimate::{FingerEstimate, SIDES};
use crate::appearance::histogram::HistogramModel;
use crate::image::frame::Frame;

/// Distance between tests along a flank \[px\].
const STEP_PX: f64 = 1.0;
/// Margin about a covered place \[px\]: a block of pixels, and the reach of the edge kernels.
const MARGIN_PX: f64 = 3.0;

/// The covered places along the flanks of an estimate.
#[derive(Debug, Clone, Default)]
pub(super) struct VisibleFlanks {
    /// The tested places that are covered, in p.
    covered: [Vec<f64>; 2],
    /// Number of tested places.
    tested: [usize; 2],
}

/// The visibility of one flank.
#[derive(Debug, Clone, Copy)]
pub(super) struct VisibleFlank<'a> {
    /// 0 right, 1 left.
    pub index: usize,
    covered: &'a [f64],
}

impl VisibleFlanks {
    /// Tests the flanks of an estimate, if its finger may be covered; otherwise all of it counts as
    /// visible.
    pub fn measure(
        &mut self,
        frame: &Frame<'_>,
        appearance: Option<&HistogramModel>,
        estimate: &FingerEstimate,
    ) {
        self.covered.iter_mut().for_each(Vec::clear);
        self.tested = [0; 2];
        let Some(appearance) = appearance.filter(|_| estimate.prior.is_some()) else { return };
        let (e, n) = (estimate.along, estimate.normal());
        let flanks = self.covered.iter_mut().zip(&mut self.tested);
        for (((covered, count), side), flank) in flanks.zip(SIDES).zip(estimate.flanks) {
            let mut p = flank.from_px;
            while p <= flank.to_px {
                let into_end = estimate.round_end_px.map_or(0.0, |end| (p - end).max(0.0));
                let radius = estimate.half_width_at(p - into_end);
                let across = (radius * radius - into_end * into_end).max(0.0).sqrt();
                let normal = (e * into_end + n * (side * across)) / radius;
                if !appearance.matches_edge(frame, estimate.place(p, side * across), normal) {
                    covered.push(p);
                }
                *count += 1;
                p += STEP_PX;
            }
        }
    }

    /// Visible fraction of the tested places, on the flank where it is smaller, 0–1.
    pub fn least_part(&self) -> f64 {
        let parts = self.covered.iter().zip(self.tested);
        let visible = parts.map(|(covered, all)| 1.0 - covered.len() as f64 / all.max(1) as f64);
        visible.fold(1.0, f64::min)
    }

    /// One of the flanks: 0 right, 1 left.
    pub fn flank(&self, index: usize) -> VisibleFlank<'_> {
        VisibleFlank { index, covered: &self.covered[index] }
    }
}

impl VisibleFlank<'_> {
    /// Whether a part of it is covered.
    pub fn is_partly_covered(&self) -> bool {
        !self.covered.is_empty()
    }

    /// Whether it is visible about p.
    pub fn is_visible(&self, p: f64) -> bool {
        self.covered.iter().all(|covered| (covered - p).abs() > MARGIN_PX)
    }
}
