//! Grey levels of a finger's two flanks, learned separately.
//!
//! A lamp lights one side of a finger and leaves the other in the shade: the levels of one flank
//! are those of the table, of paper or of the finger's shadow beside the other. Without colours, an
//! edge of a flank is recognised by the levels that this flank has shown.
//!
//! Source: Cootes & Taylor 1993, for grey levels modelled separately at each part of a contour.

use super::silhouette::Silhouette;
use crate::appearance::histogram::HistogramModel;
use crate::geometry::shape_space::PlacedSample;
use crate::geometry::template::Part;
use crate::image::frame::{Frame, SidedPixel};

/// Depth inside of a flank up to which its levels are learned: the reach of the fine kernel \[px\],
/// or this part of the half-width if that is more.
const DEPTH_PX: f64 = 5.0;
const DEPTH_WIDTHS: f64 = 0.6;
/// Separation of a flank's levels from the background's above which it is used
/// ([`HistogramModel::separation`]).
const KNOWN: f64 = 1.0;

/// Grey levels of the left and the right flank of a finger.
#[derive(Debug, Clone)]
pub(super) struct FlankLevels {
    flanks: [LevelsOfFlank; 2],
    /// The pixels of one frame.
    pixels: Vec<SidedPixel>,
}

#[derive(Debug, Clone)]
struct LevelsOfFlank {
    levels: HistogramModel,
    is_known: bool,
}

impl FlankLevels {
    pub fn new() -> Self {
        let flank = LevelsOfFlank { levels: HistogramModel::new(false), is_known: false };
        Self { flanks: [flank.clone(), flank], pixels: Vec::new() }
    }

    /// Reserves space for this number of pixels.
    pub fn reserve(&mut self, pixels: usize) {
        self.pixels.reserve(pixels);
    }

    /// Forgets everything.
    pub fn forget(&mut self) {
        for flank in &mut self.flanks {
            flank.levels.fade(0.0);
            flank.is_known = false;
        }
    }

    /// Keeps the present model of the flanks permanently.
    pub fn anchor(&mut self) {
        self.flanks.iter_mut().for_each(|flank| flank.levels.anchor());
    }

    /// Adapts the model to light that is `gain` times as bright.
    pub fn relight(&mut self, gain: f32) {
        self.flanks.iter_mut().for_each(|flank| flank.levels.relight(gain));
    }

    /// Learns from the pixels inside of the edges of either flank in a frame, `times` times,
    /// against the background of the `whole` finger's model; earlier observations keep the part
    /// `keep` of their weight.
    pub fn learn(
        &mut self,
        frame: &Frame<'_>,
        edges: &[PlacedSample],
        finger: &Silhouette,
        whole: &HistogramModel,
        (keep, times): (f64, f64),
    ) {
        let depth_px = (DEPTH_WIDTHS * finger.half_width_px).max(DEPTH_PX);
        for (flank, edges) in self.flanks.iter_mut().zip(finger.flanks(edges)) {
            self.pixels.clear();
            self.pixels.extend(edges.flat_map(|PlacedSample { position, normal }| {
                SidedPixel::along(*position, -normal, Silhouette::EDGE_PX, depth_px, true)
            }));
            flank.levels.fade(keep as f32);
            flank.levels.observe_all(frame, &self.pixels, times);
            flank.levels.learn_before(whole);
            flank.is_known = flank.levels.separation() > KNOWN;
        }
    }

    /// Levels of a part of the outline; `None` if they are not separated from the background, and
    /// for tip and thumb.
    pub fn of(&self, part: Part) -> Option<&HistogramModel> {
        let [left, right] = &self.flanks;
        let flank = match part {
            Part::LeftFlank => left,
            Part::RightFlank => right,
            Part::Tip | Part::Thumb => return None,
        };
        flank.is_known.then_some(&flank.levels)
    }
}

// The model of a flank is private to the tracker.
#[cfg(test)]
#[expect(clippy::unwrap_used, reason = "a test may panic")]
mod tests {
    use super::*;
    use crate::image::gray::GrayView;
    use nalgebra::{Point2, Vector2};

    const SIDE: usize = 60;
    /// Flanks of a finger that points up, and the table: a lamp on the left lights the finger from
    /// 170 down to 110, and the table is as bright as its middle.
    const FLANKS: [usize; 2] = [20, 40];
    const TABLE: u8 = 140;

    fn image_of(level: impl Fn(usize) -> u8) -> Vec<u8> {
        // Noise of one level, so that a flank has several levels.
        let pixel = |i: usize| level(i % SIDE) + (7 * i / SIDE + 3 * i) as u8 % 3;
        (0..SIDE * SIDE).map(pixel).collect()
    }

    fn learn_frame(flank_levels: &mut FlankLevels, pixels: &[u8]) {
        let frame = Frame::gray(GrayView::new(pixels, SIDE, SIDE, SIDE).unwrap());
        let finger = Silhouette { ahead: -Vector2::y(), half_width_px: 10.0 };
        let edge = |x: usize, normal: f64, y: usize| PlacedSample {
            position: Point2::new(x as f64 - 0.5, y as f64),
            normal: Vector2::new(normal, 0.0),
        };
        let [left, right] = FLANKS;
        let edges: Vec<_> =
            (5..55).flat_map(|y| [edge(left, -1.0, y), edge(right, 1.0, y)]).collect();
        let behind = |e: &PlacedSample| SidedPixel::along(e.position, e.normal, 4.0, 14.0, false);
        let mut whole = HistogramModel::new(false);
        whole.observe_all(&frame, &edges.iter().flat_map(behind).collect::<Vec<_>>(), 1.0);
        flank_levels.learn(&frame, &edges, &finger, &whole, (0.5, 1.0));
    }

    #[test]
    fn each_flank_is_recognised_by_its_own_levels() {
        let [left, right] = FLANKS;
        let pixels = image_of(|x| match x {
            _ if x < left || x >= right => TABLE,
            _ => (170 - 3 * (x - left)) as u8,
        });
        let mut flank_levels = FlankLevels::new();
        assert!(flank_levels.of(Part::LeftFlank).is_none(), "nothing is known yet");
        learn_frame(&mut flank_levels, &pixels);
        let levels: Vec<u8> = (0..=u8::MAX).collect();
        let frame = Frame::gray(GrayView::new(&levels, 256, 1, 256).unwrap());
        let log_ratio = |part: Part, level: u8| {
            flank_levels.of(part).unwrap().log_ratio(&frame, f64::from(level), 0.0)
        };
        for (part, own, other) in [(Part::LeftFlank, 165, 115), (Part::RightFlank, 115, 165)] {
            assert!(log_ratio(part, own) > 1.0, "{part:?}");
            assert!(log_ratio(part, TABLE + 1) < -1.0, "{part:?}: the table");
            assert!(log_ratio(part, other) < 0.5, "{part:?}: the other flank");
        }
        assert!(flank_levels.of(Part::Tip).is_none() && flank_levels.of(Part::Thumb).is_none());
    }

    #[test]
    fn a_flank_as_bright_as_the_table_has_no_model() {
        let [left, right] = FLANKS;
        let pixels = image_of(|x| if (left + 10..right).contains(&x) { 90 } else { TABLE });
        let mut flank_levels = FlankLevels::new();
        learn_frame(&mut flank_levels, &pixels);
        assert!(
            flank_levels.of(Part::LeftFlank).is_none()
                && flank_levels.of(Part::RightFlank).is_some()
        );
        flank_levels.forget();
        assert!(flank_levels.of(Part::RightFlank).is_none());
    }
}
