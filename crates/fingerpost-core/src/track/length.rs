//! How long the finger is that a waiting template has settled on: no template reaches beyond it.
//!
//! A template waits with the length that somebody thought the finger would have. One that is too long
//! reaches beyond the knuckle: there it takes the edges of the fist, of the thumb's root or of what is
//! behind the hand for flanks, and the line with them, or the thumb for a part of a bent finger. So what
//! has settled becomes as short as its finger, as far as that shows in two ways: in its own colours,
//! hand between the flanks and none beside them, and by edges that go on along both flanks, straight
//! and with their taper. One that is too short stays so: whether a finger is bent is told by its halves,
//! and a template that grows beyond the knuckle would part it elsewhere than at its joint.

use super::acquire::with_thumb_of;
use super::appearance::EdgeCue;
use super::fit_result::FitResult;
use super::hand::SearchPlan;
use super::options::MIN_HALF_LENGTH_PX;
use super::scene::Scene;
use super::shape::Shape;
use super::silhouette::Shaft;
use super::tracker::ContourTracker;
use crate::Result;
use crate::geometry::ribbon::{BandMeasure, RIBBON_DOF, RibbonVector};
use crate::geometry::shape_space::{Pose, ShapeSpace};
use crate::geometry::template::{HALF_LENGTH, Limb, Proportions, TemplateSample};
use crate::measure::edge::MAX_HALF_LENGTH_PX;
use nalgebra::{Point2, Vector2};

/// No template is made shorter than this \[half-widths\]: it would tell no direction. The shortest
/// device on footage is 6.3 long.
const SHORTEST: f64 = 4.0;
/// One that is not longer or shorter by this factor than the finger is as long: of 30 views of a device
/// with templates of the right length, 25 are as long by their edges alone and all by both signs.
const AS_LONG: f64 = 1.1;
/// A finger stays as wide when its template is shortened, to within this factor: on footage it becomes
/// 0.84 to 1.10 times as wide. What becomes another finger altogether is none.
const SAME_WIDTH: f64 = 1.3;
/// The length is taken anew with the width and the looks of a template as long as it was before, at
/// most so often.
const ROUNDS: usize = 3;
/// A finger is looked at so far back from its tip \[half-widths\].
const BACK: f64 = 12.0;
/// So many places of either flank are looked at, this far apart \[half-widths\] and at least \[px\].
const STATIONS: usize = 40;
const STATION_WIDTHS: f64 = 0.25;
const STATION_PX: f64 = 1.0;
/// A flank goes on where an edge is as near to it as this part of the half-width, or \[px\], or so many
/// times as far as those that were fitted are on average. On footage these are 0.1 px (device) and 1 px
/// (desk) off; beyond the knuckle most are off by more, or missing.
const ALONG: f64 = 0.15;
const ALONG_PX: f64 = 1.0;
const ALONG_SCATTER: f64 = 3.0;
/// The edges of a template of another length are this near \[half-widths\].
const NEAR: f64 = 0.5;
/// It may take on another width and taper so many times as freely as while it is tracked.
const SLACK: f64 = 4.0;

impl ContourTracker {
    /// Shortens the settled template to its finger; tip and thumb stay where they are. False if it
    /// becomes another finger by that: then it has settled on none.
    pub(super) fn take_length(&mut self, frame: &Scene<'_>, settled: &FitResult) -> Result<bool> {
        let Some(proportions) = self.template.proportions().copied() else { return Ok(true) };
        let Some(mut fit) = settled.fit else { return Ok(true) };
        for _ in 0..ROUNDS {
            let Shape::Ribbon(x) = self.hand.shape else { break };
            let scatter_px = fit.residual_rms_px;
            let Some(length_px) = self.other_length(frame, &x, &proportions, scatter_px)? else {
                break;
            };
            let before = self.hand.clone();
            let found = self.resized(frame, &x, BandMeasure::of(&proportions, length_px))?;
            let change = self.hand.shape.width() / before.shape.width();
            let is_accepted = found.is_accepted(&self.options.acquire.accept);
            let Some(resized) = found.fit.filter(|_| is_accepted) else {
                self.hand = before;
                break;
            };
            if !(1.0 / SAME_WIDTH..=SAME_WIDTH).contains(&change) {
                return Ok(false);
            }
            fit = resized;
            self.hand.appearance = None;
            self.learn_appearance(frame, 1)?;
        }
        Ok(true)
    }

    /// How long the template should be \[px\]; none if it is as long as its finger, for all that shows.
    /// Colours or edges alone may be misled: what looks like the hand behind it, and what has edges in
    /// its place. It becomes no shorter than both have it, and no longer again than either.
    fn other_length(
        &mut self,
        frame: &Scene<'_>,
        x: &RibbonVector,
        proportions: &Proportions,
        scatter_px: f64,
    ) -> Result<Option<f64>> {
        let Proportions { half_width, flank_start, .. } = *proportions;
        let (half_width_px, now_px) = (x[3], self.hand.measure.length_px);
        let Some(shown_px) = self.shown_px(frame, x)? else { return Ok(None) };
        let flank_px = self.flanks_px(frame, x, HALF_LENGTH - half_width, scatter_px)?;
        let by_colours_px = shown_px / (HALF_LENGTH - flank_start);
        let by_edges_px = flank_px / (HALF_LENGTH - half_width - flank_start);
        let most_px = by_colours_px.max(by_edges_px).max(SHORTEST * half_width_px);
        let least_px = by_colours_px.min(by_edges_px).min(self.initial.measure.length_px);
        Ok(if now_px > AS_LONG * most_px {
            Some(most_px)
        } else {
            Some(least_px).filter(|px| *px > AS_LONG * now_px)
        })
    }

    /// How far back from its tip the finger shows in its own colours, on either side \[px\]; none where
    /// those are not to be seen.
    fn shown_px(&mut self, frame: &Scene<'_>, x: &RibbonVector) -> Result<Option<f64>> {
        let axis = self.ribbon::<RIBBON_DOF>(x)?.pose(x).axis();
        let shaft = Shaft { axis, half_width_px: x[3], length_px: BACK * x[3] };
        let search_model = self.hand.search_model(frame, EdgeCue::LogRatio, self.options.polarity);
        let Some(appearance) = search_model.cue.appearance() else { return Ok(None) };
        let shown =
            self.convergence.shown_about(frame, search_model.mixture, shaft.corners(), 1.0)?;
        let [right, left] = shaft.shows_px(&shown, appearance);
        Ok(Some(right.min(left)))
    }

    /// How far back from its round end, which is there along the template, both flanks of the finger
    /// have edges \[px\]. What a thumb hides of them tells nothing.
    fn flanks_px(
        &mut self,
        frame: &Scene<'_>,
        x: &RibbonVector,
        round_end: f64,
        scatter_px: f64,
    ) -> Result<f64> {
        let step_px = (STATION_WIDTHS * x[3]).max(STATION_PX);
        let step = step_px / self.hand.measure.length_px;
        let samples: [TemplateSample; 2 * STATIONS] = std::array::from_fn(|i| {
            station(round_end - step * (i % STATIONS) as f64, i < STATIONS)
        });
        let within_px = (ALONG * x[3]).max(ALONG_PX).max(ALONG_SCATTER * scatter_px);
        let plan = SearchPlan::edges(near_px(x, within_px));
        let space = self.ribbon::<RIBBON_DOF>(x)?;
        let stage = self.hand.stage(&samples, frame, plan, self.options.polarity);
        let (mut sums, mut best, mut ends_px) = ([0.0; 2], [0.0; 2], [0.0; 2]);
        for (i, offset_px) in self.convergence.offsets(frame, &space, x, &stage)? {
            let (flank, back_px) = (i / STATIONS, step_px * ((i % STATIONS) as f64 + 0.5));
            let goes_on = offset_px.is_some_and(|px| px.abs() <= within_px);
            sums[flank] += if goes_on { 1.0 } else { -1.0 };
            if sums[flank] > best[flank] {
                (best[flank], ends_px[flank]) = (sums[flank], back_px);
            }
        }
        Ok(ends_px[0].min(ends_px[1]))
    }

    /// The finger by a template of another measure about the same tip.
    fn resized(
        &mut self,
        frame: &Scene<'_>,
        x: &RibbonVector,
        measure: BandMeasure,
    ) -> Result<FitResult> {
        let from = supported_by(x, &self.hand.measure, &measure);
        (self.hand.measure, self.hand.acquired) = (measure, from);
        let held = self.held::<5>(&from, SLACK);
        let plan = SearchPlan::edges(near_px(x, MIN_HALF_LENGTH_PX));
        let finger = self.run_ribbon::<5>(frame, &from, Limb::Finger, plan, Some(&held))?;
        self.hand.shape = Shape::Ribbon(with_thumb_of(&from, &finger.x));
        Ok(finger.into())
    }
}

/// A place on the right flank or the left one, so far along the template.
fn station(along: f64, is_right: bool) -> TemplateSample {
    let normal = Vector2::new(0.0, if is_right { 1.0 } else { -1.0 });
    let (position, limb) = (Point2::new(along, 0.0), Limb::Finger);
    TemplateSample { position, normal, limb, along, radial: normal }
}

/// How far the edges of a template of another length are looked for \[px\]: so far at least, and no
/// farther than the longest search line.
fn near_px(x: &RibbonVector, least_px: f64) -> f64 {
    (NEAR * x[3]).max(least_px).clamp(MIN_HALF_LENGTH_PX, MAX_HALF_LENGTH_PX as f64)
}

/// A hand by a template of another measure: the middle of its round end stays where it is.
fn supported_by(x: &RibbonVector, from: &BandMeasure, to: &BandMeasure) -> RibbonVector {
    let ahead_px = from.round_end_px - to.round_end_px;
    let mut moved = *x;
    moved[0] += ahead_px * x[2].cos();
    moved[1] += ahead_px * x[2].sin();
    moved[3] += ahead_px * x[4];
    moved[5] -= ahead_px;
    moved
}

#[cfg(test)]
mod tests {
    use super::{MAX_HALF_LENGTH_PX, MIN_HALF_LENGTH_PX, NEAR, RibbonVector, near_px};

    #[test]
    fn edges_are_looked_for_no_farther_than_the_longest_search_line() {
        let hand = |half_width_px: f64| {
            let mut x = RibbonVector::zeros();
            x[3] = half_width_px;
            x
        };
        let longest_px = MAX_HALF_LENGTH_PX as f64;
        assert!((near_px(&hand(1.0), 0.0) - MIN_HALF_LENGTH_PX).abs() < 1e-12);
        assert!((near_px(&hand(40.0), 3.0) - NEAR * 40.0).abs() < 1e-12);
        assert!((near_px(&hand(40.0), 90.0) - 90.0).abs() < 1e-12);
        // A hand that fills the picture, and edges that scatter as far as the options allow.
        for far in [near_px(&hand(1e3), 0.0), near_px(&hand(10.0), 3e4)] {
            assert!((far - longest_px).abs() < 1e-12, "{far}");
        }
    }
}
