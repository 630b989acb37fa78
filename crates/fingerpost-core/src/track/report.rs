//! Result of an accepted frame: the finger line, from the pixels, the contour and earlier frames;
//! and learning of the hand's appearance from the frame.

use super::appearance::{AppearanceModel, EdgeCue};
use super::axis_curvature::{FingerScale, FrontLine};
use super::convergence::finger_region;
use super::fit_result::FitResult;
use super::line::FingerLine;
use super::line_filter::BandDimensions;
use super::options::{AcceptOptions, Model};
use super::outcome::{Track, track};
use super::scene::Scene;
use super::shape::Shape;
use super::status::Status;
use super::tracker::ContourTracker;
use crate::Result;
use crate::axis::Stretch;
use crate::axis::{Bend, Finger, MAX_STRETCH_PX, Refined, Source};
use crate::geometry::ribbon::{BandMeasure, RIBBON_DOF, RibbonVector};
use crate::geometry::shape_space::{Pose, ShapeSpace};
use crate::geometry::template::Part;
use crate::numeric::ablation::{Mechanism, is_off};

/// Distance beyond the place where another limb stops hiding a flank from which the flank is
/// refined \[px\].
const CROTCH_PX: f64 = 2.0;
/// Distance before the outline's beginning from which a flank that nothing hides is refined, in
/// units of the finger's length: pixels there that are not the finger's are rejected, and a longer
/// flank gives a more precise angle.
const BEYOND_OUTLINE: f64 = 0.07;
/// Both flanks are refined up to this part of the half-width beyond the centre of the tip's round
/// end.
const CAP: f64 = 0.7;

/// Edge blur above which the recorded frame is not refined \[px\]. At half the resolution an edge
/// with this blur or more is hardly more blurred, and as informative. The noise of such an image
/// may be as blurred as its edges, and is then correlated between pixels.
const SHARP_PX: f64 = 1.5;

/// Period of learning the appearance of a hand that stays in place, in frames; one frame then
/// counts as often. A hand that has moved by more than [`RELEARN_MIN_MOTION_HALF_WIDTHS`] is
/// learned at once: it is before another background, and its image is blurred by motion.
const LEARNING_PERIOD_FRAMES: usize = 3;
const RELEARN_MIN_MOTION_HALF_WIDTHS: f64 = 0.5;

/// Standard deviation of the bias of the line of a contour with a shaded flank, at its anchor
/// \[px\]; at either end it is twice as large. The shaded flank is measured from colours alone,
/// which a camera records at half the resolution, and the lit one from grey levels.
const SHADED_PX: f64 = 0.6;

/// Part of a finger's flanks that is used.
#[derive(Debug, Clone, Copy)]
enum Flanks {
    /// All that no other limb of the template hides: of a bent finger, half does not agree.
    Visible,
    /// The part that agrees with the fit, from the tip on.
    Agreeing,
}

impl ContourTracker {
    /// Result of a frame whose fit was accepted, with the finger line.
    pub(super) fn tracked(
        &mut self,
        scene: &Scene<'_>,
        time_s: f64,
        found: &FitResult,
        accept: &AcceptOptions,
    ) -> Result<Track> {
        let finger = match self.hand.shape {
            // No single image shows both flanks of a finger that is lit from one side.
            Shape::Ribbon(x) if self.options.refine && self.hand.shaded.is_none() => {
                self.finger_of(&x, found)?
            }
            _ => None,
        };
        let refined = match &finger {
            Some(finger) => self.refine(scene, finger, found)?,
            None => None,
        };
        let mut front = None;
        if let (Some(finger), Some(refined)) = (&finger, &refined)
            && is_uncovered(found)
        {
            self.axis_curvature.learn(refined, scene.colour().is_some());
            front = self.front_of(scene, finger, found, refined)?;
        }
        let finger_line = self.line_of(found, refined.as_ref());
        let finger_line = match self.hand.shape {
            Shape::Ribbon(x) if self.options.refine => finger_line.map(|line| {
                let length_px = self.hand.measure.length_px;
                let dimensions = BandDimensions { half_width_px: x[3], taper: x[4], length_px };
                // The bias due to a bend is common to all lines. It lowers this line's weight
                // against those of other frames; the part of it that the filter averages away is
                // restored.
                let bend_bias = self.axis_curvature.bend_bias().hypot(self.shade_bias(&line));
                let scale = self.finger_scale(x[3]);
                let line = self
                    .axis_curvature
                    .at_front(line, front.as_ref(), &scale)
                    .with_relative_bias(bend_bias);
                let filtered = self.line_filter.follow(scene.image(), time_s, line, &dimensions);
                let spread_ratio = (filtered.spread() / line.spread()).min(1.0);
                let restored_bias = bend_bias * (1.0 - spread_ratio).sqrt();
                // A bias that is equal in all frames must not affect the weights.
                filtered
                    .with_relative_bias(restored_bias.hypot(self.axis_curvature.faint_flank_bias()))
            }),
            _ => finger_line,
        };
        Ok(Track { finger_line, ..track(time_s, Status::Tracking, found, accept, None) })
    }

    /// Scale of the finger in this view, for a half-width.
    fn finger_scale(&self, half_width_px: f64) -> FingerScale {
        FingerScale { half_width_px, foreshortening: self.foreshortening }
    }

    /// Difference of the line of the front from that of the whole, from the pixels of the front's
    /// flanks alone, where these are more precise than the curvature of the whole.
    fn front_of(
        &mut self,
        scene: &Scene<'_>,
        finger: &Finger,
        found: &FitResult,
        whole: &Refined,
    ) -> Result<Option<FrontLine>> {
        if whole.source == Source::Bisector {
            return Ok(None);
        }
        let scale = self.finger_scale(finger.half_width_px);
        let Some(far_px) = self.axis_curvature.front_to_measure(whole, &scale) else {
            return Ok(None);
        };
        let ends_px = (finger.axis.tip - finger.axis.anchor).norm() - far_px;
        let flanks = finger.flanks.map(|s| Stretch { from_px: s.from_px.max(ends_px), ..s });
        let front = self.refine(scene, &Finger { flanks, ..*finger }, found)?;
        let front = front.filter(|front| front.source != Source::Bisector);
        Ok(front.map(|front| {
            FrontLine::beside(&FingerLine::of_pixels(&front), &FingerLine::of_pixels(whole))
        }))
    }

    /// Bias due to a shaded flank, as a part of the half-length. It is systematic: averaging over
    /// frames does not reduce it.
    fn shade_bias(&self, line: &FingerLine) -> f64 {
        self.hand.shaded.map_or(0.0, |_| SHADED_PX / line.half_length_px)
    }

    /// The finger line from the contour and the pixels of a frame, or from the one that is trusted.
    fn line_of(&mut self, found: &FitResult, refined: Option<&Refined>) -> Option<FingerLine> {
        let contour = self.by_contour(found)?;
        let Some(refined) = refined else { return Some(contour) };
        let pixels = FingerLine::of_pixels(refined);
        // Where the pixels agree with the model of a finger only in part, the contour has other
        // information than two visible flanks: the hand's colours and its width. For a partly
        // covered finger either estimate may be biased: if they contradict each other, neither is
        // trusted alone.
        Some(match refined.source {
            Source::Photometric if self.hand.is_covered && pixels.contradicts(&contour) => {
                pixels.joined(&contour)
            }
            Source::Photometric => pixels,
            Source::Unsure => self.by_both(found, refined, pixels)?,
            Source::Bisector => contour.with_disagreement(&refined.axis),
        })
    }

    /// The line from contour and pixels where neither is trusted alone. Their difference is learned
    /// from frames in which no object may cover the hand.
    fn by_both(
        &mut self,
        found: &FitResult,
        refined: &Refined,
        pixels: FingerLine,
    ) -> Option<FingerLine> {
        let contour = contour_line(found)?;
        let Refined { half_width_px, taper, stretch, .. } = *refined;
        if is_uncovered(found) {
            self.line_comparison.learn(&contour, &pixels, half_width_px);
        }
        let (pixels, contour) =
            (self.line_comparison.scaled(pixels), self.line_comparison.bias_corrected(contour));
        let unlike = self.hand.shape_mismatch(half_width_px, taper, stretch.middle_px());
        // The hand's width and taper are known from contours.
        let expected = pixels.covariance + contour.covariance;
        Some(pixels.joined(&contour).with_shape_mismatch(&unlike, &expected))
    }

    /// The same, corrected by the mean difference of the pixels' lines, with the covariance scaled
    /// and extended by the mismatch of its width and taper.
    fn by_contour(&self, found: &FitResult) -> Option<FingerLine> {
        let line = self.line_comparison.bias_corrected(contour_line(found)?);
        let expected = line.covariance;
        Some(match found.shape {
            Shape::Ribbon(x) => {
                line.with_shape_mismatch(&self.hand.shape_mismatch(x[3], x[4], 0.0), &expected)
            }
            Shape::Planar(_) => line,
        })
    }

    /// The finger, with the agreeing part of its flanks; of a covered hand, all visible flanks.
    fn finger_of(&self, x: &RibbonVector, found: &FitResult) -> Result<Option<Finger>> {
        // An occluder may lie over the middle of a flank; the refinement excludes its pixels.
        let flanks = if is_uncovered(found) { Flanks::Agreeing } else { Flanks::Visible };
        self.finger(x, found, flanks)
    }

    /// The finger line refined from its flanks; `None` if they are not trusted.
    fn refine(
        &mut self,
        scene: &Scene<'_>,
        finger: &Finger,
        found: &FitResult,
    ) -> Result<Option<Refined>> {
        if let Some(refined) = self.refine_whole(scene, finger, found.edges())? {
            return Ok(Some(refined));
        }
        let search_model = self.hand.search_model(scene, found.edges(), self.options.polarity);
        let search_frame = self.convergence.shown(scene, search_model.mixture, finger)?;
        let appearance = search_model.cue.appearance();
        // The background model has grey levels, whatever mixture of colours shows the hand best.
        let behind = scene.background_for_search();
        let known = behind.as_ref().map(|b| b.known().behind(*scene.image()));
        self.refiner.refine(
            &search_frame,
            finger,
            search_model.polarity,
            appearance,
            known.as_ref(),
        )
    }

    /// The same in the frame at full resolution, if a reduced image is tracked; `None` unless its
    /// pixels agree with a finger and are sharp enough to add information.
    fn refine_whole(
        &mut self,
        scene: &Scene<'_>,
        finger: &Finger,
        edges: EdgeCue,
    ) -> Result<Option<Refined>> {
        if is_off(Mechanism::FullResolution) {
            return Ok(None);
        }
        let (Some(whole), pyramid_level) = (scene.whole(), self.pyramid_level) else {
            return Ok(None);
        };
        let finger = pyramid_level.finger(finger);
        let search_model = self.hand.search_model(scene, edges, self.options.polarity);
        let search_frame =
            self.whole.shown(whole, search_model.mixture, || finger_region(&finger))?;
        let appearance = search_model.cue.appearance();
        let behind = scene.background_for_search();
        let known = behind.as_ref().map(|b| b.known_whole().behind(*whole.image()));
        let refined = self.refiner.refine(
            &search_frame,
            &finger,
            search_model.polarity,
            appearance,
            known.as_ref(),
        )?;
        let adds_detail = |refined: &Refined| {
            let is_sharp = refined.photometric.is_some_and(|report| report.blur_px <= SHARP_PX);
            refined.source == Source::Photometric && is_sharp
        };
        Ok(refined.filter(adds_detail).map(|refined| pyramid_level.refined(&refined)))
    }

    /// The finger of the band template, with the given part of both flanks.
    fn finger(
        &self,
        x: &RibbonVector,
        found: &FitResult,
        flanks: Flanks,
    ) -> Result<Option<Finger>> {
        let BandMeasure { length_px, round_end_px, .. } = self.hand.measure;
        let (half_width_px, taper) = (x[3], x[4]);
        let stretch = |flank| {
            let extent = self.convergence.extent(&self.samples, flank, f64::INFINITY)?;
            let from = match flanks {
                Flanks::Visible => extent.visible_from,
                Flanks::Agreeing => extent.agrees_from,
            };
            let whole = self.samples.iter().filter(|s| s.part() == flank).all(|s| s.along >= from);
            Some(Stretch {
                from_px: if whole {
                    (from - BEYOND_OUTLINE) * length_px
                } else {
                    from * length_px + CROTCH_PX
                },
                to_px: round_end_px + CAP * half_width_px,
            })
        };
        let (Some(right), Some(left)) = (stretch(Part::RightFlank), stretch(Part::LeftFlank))
        else {
            return Ok(None);
        };
        let flanks = [right, left];
        let axis = self.ribbon::<RIBBON_DOF>(x)?.pose(x).axis();
        let prior = self.by_contour(found).and_then(|line| self.width_prior(&line.covariance));
        let round_end_px = Some(round_end_px);
        let finger = Finger { axis, half_width_px, taper, flanks, round_end_px, prior };
        // A template may be longer than any image; such a finger is not refined from pixels.
        let is_longest = self.pyramid_level.px() * finger.stretch().length_px() > MAX_STRETCH_PX;
        Ok((!is_longest).then_some(finger))
    }

    /// Bend of the finger of an accepted fit, from its flanks; `None` for the model of 1994 and for
    /// flanks that do not show it.
    pub(super) fn bend(&mut self, scene: &Scene<'_>, found: &FitResult) -> Result<Option<Bend>> {
        if is_off(Mechanism::BendState) {
            return Ok(None);
        }
        let Shape::Ribbon(x) = found.shape else { return Ok(None) };
        let Some(finger) = self.finger(&x, found, Flanks::Visible)? else { return Ok(None) };
        let search_model = self.hand.search_model(scene, found.edges(), self.options.polarity);
        let search_frame = self.convergence.shown(scene, search_model.mixture, &finger)?;
        self.refiner.bend(
            &search_frame,
            &finger,
            search_model.polarity,
            search_model.cue.appearance(),
        )
    }

    /// Learns the hand's appearance from an accepted fit, every [`LEARNING_PERIOD_FRAMES`] frames.
    /// If the fit was not found by appearance, the light has changed: the model is replaced.
    pub(super) fn update_appearance(&mut self, scene: &Scene<'_>, found: &FitResult) -> Result<()> {
        let is_relit =
            self.hand.is_shown_in(scene) && found.fit.is_some_and(|fit| !fit.by_appearance);
        let place = self.hand.shape.placement().xy();
        let moved_px = (place - self.hand.learned_at_px).norm();
        let is_in_place = moved_px <= RELEARN_MIN_MOTION_HALF_WIDTHS * self.hand.acquired[3];
        self.hand.frames_since_learning += 1;
        if is_relit {
            self.hand.appearance = None;
        } else if self.hand.is_shown_in(scene)
            && is_in_place
            && self.hand.frames_since_learning < LEARNING_PERIOD_FRAMES
        {
            return Ok(());
        }
        self.learn_appearance(scene, self.hand.frames_since_learning)?;
        (self.hand.learned_at_px, self.hand.frames_since_learning) = (place, 0);
        if let Some(appearance) = self.hand.appearance.as_mut().filter(|_| is_relit) {
            appearance.anchor();
        }
        Ok(())
    }

    /// Learns the pixels on either side of the contour of the last accepted fit, with the weight of
    /// `frames` frames.
    pub(super) fn learn_appearance(&mut self, scene: &Scene<'_>, frames: usize) -> Result<()> {
        let coloured = scene.colour().is_some();
        let known = self.hand.appearance.as_ref().map(AppearanceModel::is_coloured);
        if known == Some(true) && !coloured {
            return Ok(());
        }
        if known != Some(coloured) {
            self.hand.appearance = None;
        }
        let (samples, finger) = (self.hand.fingers(&self.samples), self.hand.shape.silhouette());
        let keep = (1.0 - self.options.track.appearance_rate).powi(frames as i32);
        // The tracker of 1994 models the finger as a whole.
        let shaded = self.hand.shaded;
        let appearance = self.hand.appearance.get_or_insert_with(|| match self.options.model {
            Model::Ribbon => AppearanceModel::new(coloured).with_flank_levels().with_shaded(shaded),
            Model::Paper => AppearanceModel::new(coloured),
        });
        self.convergence.learn_from_fit(appearance, samples, scene, &finger, (keep, frames as f64))
    }
}

/// Whether the pixels about the flanks are the hand's: an occluder has other pixels.
fn is_uncovered(found: &FitResult) -> bool {
    !found.fit.is_some_and(|fit| fit.matched_only)
}

/// The line of a fit's contour.
fn contour_line(found: &FitResult) -> Option<FingerLine> {
    let fit = found.fit.as_ref()?;
    Some(FingerLine::of_contour(&fit.axis, &fit.line_covariance))
}
