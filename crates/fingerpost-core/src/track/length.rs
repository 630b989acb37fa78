//! Length of the finger on which an initial template has settled: the template is shortened to it.
//!
//! The length of an initial template is an assumption. A template that is too long reaches beyond
//! the knuckle: there it takes the edges of the fist, of the thumb's root or of the background for
//! flanks, which biases the line, or takes the thumb for a part of a bent finger. Therefore the
//! settled template is shortened to its finger, which is measured in two ways: by the hand's
//! colours, present between the flanks and absent beside them, and by edges that continue along
//! both flanks, straight and with their taper. A template that is too short is kept: the bend of a
//! finger is measured by its halves, and a template that grows beyond the knuckle would be divided
//! elsewhere than at the finger's joint.

use super::acquire::with_thumb_of;
use super::appearance::EdgeCue;
use super::fit_result::FitResult;
use super::fit_stages::ACQUISITION_SLACK;
use super::options::MIN_HALF_LENGTH_PX;
use super::scene::Scene;
use super::shape::Shape;
use super::silhouette::Shaft;
use super::stage::SearchPlan;
use super::tracker::ContourTracker;
use crate::Result;
use crate::geometry::ribbon::{BandMeasure, RIBBON_DOF, RibbonVector};
use crate::geometry::shape_space::{Pose, ShapeSpace};
use crate::geometry::template::{HALF_LENGTH, Limb, Proportions, TemplateSample};
use crate::measure::edge::MAX_HALF_LENGTH_PX;
use crate::numeric::ablation::{Mechanism, is_off};
use nalgebra::{Point2, Vector2};

/// Least length of a template \[half-widths\]: a shorter one has no direction. The shortest device
/// on footage is 6.3 long.
const SHORTEST: f64 = 4.0;
/// Ratio of template to finger, or of finger to template, up to which the lengths count as equal.
/// Of 30 views of a device with templates of the right length, 25 are within it by their edges
/// alone, and all by colours and edges.
const AS_LONG: f64 = 1.1;
/// Largest ratio of the widths before and after the template is shortened, either way. On footage
/// the width changes by a factor of 0.84 to 1.10. A larger change is another object.
const SAME_WIDTH: f64 = 1.3;
/// Largest number of measurements of the length; each uses the width and appearance of the template
/// of the previous length.
const ROUNDS: usize = 3;
/// Distance back from the tip up to which a finger is measured \[half-widths\].
const BACK: f64 = 12.0;
/// Number of places on either flank, and their spacing \[half-widths\], at least \[px\].
const STATIONS: usize = 40;
const STATION_WIDTHS: f64 = 0.25;
const STATION_PX: f64 = 1.0;
/// Largest distance of an edge by which a flank continues: as a part of the half-width, \[px\], or
/// as a multiple of the RMS residual of the fit, whichever is largest. On footage the edges are 0.1
/// px (device) and 1 px (desk) off; beyond the knuckle most are off by more, or missing.
const ALONG: f64 = 0.15;
const ALONG_PX: f64 = 1.0;
const ALONG_SCATTER: f64 = 3.0;
/// Search distance for the edges of a template of another length \[half-widths\].
const NEAR: f64 = 0.5;

impl ContourTracker {
    /// Shortens the settled template to its finger; tip and thumb keep their places. False if the
    /// width changes by more than [`SAME_WIDTH`]: then it has not settled on a finger.
    pub(super) fn take_length(&mut self, scene: &Scene<'_>, settled: &FitResult) -> Result<bool> {
        if is_off(Mechanism::TemplateLength) {
            return Ok(true);
        }
        let Some(proportions) = self.template.proportions().copied() else { return Ok(true) };
        let Some(mut fit) = settled.fit else { return Ok(true) };
        for _ in 0..ROUNDS {
            let Shape::Ribbon(x) = self.hand.shape else { break };
            let scatter_px = fit.residual_rms_px;
            let Some(length_px) = self.corrected_length(scene, &x, &proportions, scatter_px)?
            else {
                break;
            };
            let before = self.hand.clone();
            let found = self.resized(scene, &x, BandMeasure::of(&proportions, length_px))?;
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
            self.learn_appearance(scene, 1)?;
        }
        Ok(true)
    }

    /// Corrected length of the template \[px\]; `None` if its present length agrees with the
    /// measurements. Colours alone may be biased by objects like the hand behind it, edges alone by
    /// other edges in its place. The template is shortened at most to the longer of the two, and
    /// lengthened again at most to the shorter and to its initial length.
    fn corrected_length(
        &mut self,
        scene: &Scene<'_>,
        x: &RibbonVector,
        proportions: &Proportions,
        scatter_px: f64,
    ) -> Result<Option<f64>> {
        let Proportions { half_width, flank_start, .. } = *proportions;
        let (half_width_px, present_px) = (x[3], self.hand.measure.length_px);
        let Some(visible_px) = self.visible_length_px(scene, x)? else { return Ok(None) };
        let flank_px = self.flanks_px(scene, x, HALF_LENGTH - half_width, scatter_px)?;
        let by_colours_px = visible_px / (HALF_LENGTH - flank_start);
        let by_edges_px = flank_px / (HALF_LENGTH - half_width - flank_start);
        let most_px = by_colours_px.max(by_edges_px).max(SHORTEST * half_width_px);
        let least_px = by_colours_px.min(by_edges_px).min(self.initial.measure.length_px);
        Ok(if present_px > AS_LONG * most_px {
            Some(most_px)
        } else {
            Some(least_px).filter(|px| *px > AS_LONG * present_px)
        })
    }

    /// Length from its tip back over which the finger shows its own colours, the shorter of both
    /// sides \[px\]; `None` without an appearance.
    fn visible_length_px(&mut self, scene: &Scene<'_>, x: &RibbonVector) -> Result<Option<f64>> {
        let axis = self.ribbon::<RIBBON_DOF>(x)?.pose(x).axis();
        let shaft = Shaft { axis, half_width_px: x[3], length_px: BACK * x[3] };
        let search_model = self.hand.search_model(scene, EdgeCue::LogRatio, self.options.polarity);
        let Some(appearance) = search_model.cue.appearance() else { return Ok(None) };
        let search_frame =
            self.convergence.shown_about(scene, search_model.mixture, shaft.corners(), 1.0)?;
        let [right, left] = shaft.shows_px(&search_frame, appearance);
        Ok(Some(right.min(left)))
    }

    /// Length back from the middle of its round end, at `round_end` along the template, over which
    /// both flanks have edges \[px\]. Places that a thumb hides do not count.
    fn flanks_px(
        &mut self,
        scene: &Scene<'_>,
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
        let stage = self.hand.stage(&samples, scene, plan, self.options.polarity);
        let (mut sums, mut best, mut ends_px) = ([0.0; 2], [0.0; 2], [0.0; 2]);
        for (i, offset_px) in self.convergence.offsets(scene, &space, x, &stage)? {
            let (flank, back_px) = (i / STATIONS, step_px * ((i % STATIONS) as f64 + 0.5));
            let is_on_flank = offset_px.is_some_and(|px| px.abs() <= within_px);
            sums[flank] += if is_on_flank { 1.0 } else { -1.0 };
            if sums[flank] > best[flank] {
                (best[flank], ends_px[flank]) = (sums[flank], back_px);
            }
        }
        Ok(ends_px[0].min(ends_px[1]))
    }

    /// The finger fitted by a template of another length about the same tip.
    fn resized(
        &mut self,
        scene: &Scene<'_>,
        x: &RibbonVector,
        measure: BandMeasure,
    ) -> Result<FitResult> {
        let from = with_length(x, &self.hand.measure, &measure);
        (self.hand.measure, self.hand.acquired) = (measure, from);
        let prior = self.tracked_prior::<5>(&from, ACQUISITION_SLACK);
        let plan = SearchPlan::edges(near_px(x, MIN_HALF_LENGTH_PX));
        let finger = self.run_ribbon::<5>(scene, &from, Limb::Finger, plan, Some(&prior))?;
        self.hand.shape = Shape::Ribbon(with_thumb_of(&from, &finger.shape));
        Ok(finger.into())
    }
}

/// A place on the right flank or the left one, at `along` on the template.
fn station(along: f64, is_right: bool) -> TemplateSample {
    let normal = Vector2::new(0.0, if is_right { 1.0 } else { -1.0 });
    let (position, limb) = (Point2::new(along, 0.0), Limb::Finger);
    TemplateSample { position, normal, limb, along, radial: normal }
}

/// Search distance for the edges of a template of another length \[px\]: at least `least_px`, at
/// most the longest search line.
fn near_px(x: &RibbonVector, least_px: f64) -> f64 {
    (NEAR * x[3]).max(least_px).clamp(MIN_HALF_LENGTH_PX, MAX_HALF_LENGTH_PX as f64)
}

/// Shape vector of a template of another length: the centre of its round end keeps its place.
fn with_length(x: &RibbonVector, from: &BandMeasure, to: &BandMeasure) -> RibbonVector {
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
    fn the_search_distance_is_at_most_the_longest_search_line() {
        let hand = |half_width_px: f64| {
            let mut x = RibbonVector::zeros();
            x[3] = half_width_px;
            x
        };
        let longest_px = MAX_HALF_LENGTH_PX as f64;
        assert!((near_px(&hand(1.0), 0.0) - MIN_HALF_LENGTH_PX).abs() < 1e-12);
        assert!((near_px(&hand(40.0), 3.0) - NEAR * 40.0).abs() < 1e-12);
        assert!((near_px(&hand(40.0), 90.0) - 90.0).abs() < 1e-12);
        // A hand that fills the image, and edges that scatter as far as the options allow.
        for search_px in [near_px(&hand(1e3), 0.0), near_px(&hand(10.0), 3e4)] {
            assert!((search_px - longest_px).abs() < 1e-12, "{search_px}");
        }
    }
}
