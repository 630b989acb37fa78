//! The story of an accepted frame: the finger line, from pixels and contour and the frames before,
//! and what the frame teaches of the hand.

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
use crate::axis::{Bend, Finger, MAX_STRETCH_PX, Refined, Source, Stretch};
use crate::geometry::ribbon::{BandMeasure, RIBBON_DOF, RibbonVector};
use crate::geometry::shape_space::{Pose, ShapeSpace};
use crate::geometry::template::Part;

/// Flanks are refined from so far beyond where another limb hides them \[px\].
const CROTCH_PX: f64 = 2.0;
/// A flank that nothing hides is refined from so much before the outline's beginning, in units of
/// the finger's length: what is no finger there is found out, and a longer flank gives a surer
/// angle.
const BEYOND_OUTLINE: f64 = 0.07;
/// Both go round the tip to this part of the half-width beyond the middle of its round end.
const CAP: f64 = 0.7;

/// A picture of half the size blurs an edge that is blurred by this \[px\] or more by hardly more, and
/// tells as much of it; but the noise of such a picture may be as blurred as its edges, and no longer
/// independent from pixel to pixel.
const SHARP_PX: f64 = 1.5;

/// Looks change slowly where a hand stays: one frame in so many teaches them, and counts as often.
/// One that has moved by more than this part of its half-width is before something else, and smeared.
const FRAMES_A_LESSON: usize = 3;
const STAYS: f64 = 0.5;

/// A shaded flank is known from colours alone, which a camera records at half its resolution, and the lit
/// one from grey levels: the contour may be so far aside, and turned by that over half the line's length
/// \[px\].
const SHADED_PX: f64 = 0.6;

/// How much of the flanks of a finger counts.
#[derive(Debug, Clone, Copy)]
enum Flanks {
    /// All that no other limb of the template hides: of a bent finger half does not agree.
    Visible,
    /// As much as agrees with the fit from the tip on.
    Agreeing,
}

impl ContourTracker {
    /// The story of a frame whose fit was accepted, with the finger line.
    pub(super) fn tracked(
        &mut self,
        frame: &Scene<'_>,
        time_s: f64,
        found: &FitResult,
        accept: &AcceptOptions,
    ) -> Result<Track> {
        let finger = match self.hand.shape {
            // No one image shows both flanks of a finger that is lit from one side.
            Shape::Ribbon(x) if self.options.refine && self.hand.shaded.is_none() => {
                self.finger_of(&x, found)?
            }
            _ => None,
        };
        let refined = match &finger {
            Some(finger) => self.refine(frame, finger, found)?,
            None => None,
        };
        let mut front = None;
        if let (Some(finger), Some(refined)) = (&finger, &refined)
            && has_own_pixels(found)
        {
            self.axis_curvature.learn(refined, frame.colour().is_some());
            front = self.front_of(frame, finger, found, refined)?;
        }
        let finger_line = self.line_of(found, refined.as_ref());
        let finger_line = match self.hand.shape {
            Shape::Ribbon(x) if self.options.refine => finger_line.map(|line| {
                let length_px = self.hand.measure.length_px;
                let shown = BandDimensions { half_width_px: x[3], taper: x[4], length_px };
                // A bend does the same to all lines. It makes one count less beside those of other frames,
                // and as much of it as these average away is put back.
                let bend_bias = self.axis_curvature.bend_bias().hypot(self.shade_bias(&line));
                let seen = self.finger_scale(x[3]);
                let line = self
                    .axis_curvature
                    .at_front(line, front.as_ref(), &seen)
                    .with_relative_bias(bend_bias);
                let filtered = self.line_filter.follow(frame.image(), time_s, line, &shown);
                let left = (filtered.spread() / line.spread()).min(1.0);
                let restored_bias = bend_bias * (1.0 - left).sqrt();
                // What is the same in all frames has no say in how they are weighed.
                filtered
                    .with_relative_bias(restored_bias.hypot(self.axis_curvature.faint_flank_bias()))
            }),
            _ => finger_line,
        };
        Ok(Track { finger_line, ..track(time_s, Status::Tracking, found, accept, None) })
    }

    /// How the view shows a finger of such a half-width.
    fn finger_scale(&self, half_width_px: f64) -> FingerScale {
        FingerScale { half_width_px, foreshortening: self.foreshortening }
    }

    /// How the line of the front lies to that of the whole, by the pixels of its flanks alone, where
    /// these tell more than the bend of the whole.
    fn front_of(
        &mut self,
        frame: &Scene<'_>,
        finger: &Finger,
        found: &FitResult,
        whole: &Refined,
    ) -> Result<Option<FrontLine>> {
        if whole.source == Source::Bisector {
            return Ok(None);
        }
        let seen = self.finger_scale(finger.half_width_px);
        let Some(far_px) = self.axis_curvature.front_to_measure(whole, &seen) else {
            return Ok(None);
        };
        let ends_px = (finger.axis.tip - finger.axis.anchor).norm() - far_px;
        let flanks = finger.flanks.map(|s| Stretch { from_px: s.from_px.max(ends_px), ..s });
        let front = self.refine(frame, &Finger { flanks, ..*finger }, found)?;
        let front = front.filter(|front| front.source != Source::Bisector);
        Ok(front.map(|front| {
            FrontLine::beside(&FingerLine::of_pixels(&front), &FingerLine::of_pixels(whole))
        }))
    }

    /// How far a line may be off for a shaded flank, as a part of what it is measured on: not for noise,
    /// so it is no less for many frames.
    fn shade_bias(&self, line: &FingerLine) -> f64 {
        self.hand.shaded.map_or(0.0, |_| SHADED_PX / line.half_length_px)
    }

    /// The finger line by both looks at a frame, or by the one that can be believed.
    fn line_of(&mut self, found: &FitResult, refined: Option<&Refined>) -> Option<FingerLine> {
        let contour = self.by_contour(found)?;
        let Some(refined) = refined else { return Some(contour) };
        let pixels = FingerLine::of_pixels(refined);
        // Where the pixels agree with a finger only so far, the contour knows other things than two
        // bare flanks tell: the hand's colours, and its width. Of a finger that is covered in part
        // either may be misled, and where they contradict each other, neither is believed alone.
        Some(match refined.source {
            Source::Photometric if self.hand.is_covered && pixels.contradicts(&contour) => {
                pixels.joined(&contour)
            }
            Source::Photometric => pixels,
            Source::Unsure => self.by_both(found, refined, pixels)?,
            Source::Bisector => contour.with_disagreement(&refined.axis),
        })
    }

    /// The line by contour and pixels where neither is believed alone. What they differ by is learned
    /// of a hand's own pixels.
    fn by_both(
        &mut self,
        found: &FitResult,
        refined: &Refined,
        pixels: FingerLine,
    ) -> Option<FingerLine> {
        let contour = self.contour_line(found)?;
        let Refined { half_width_px, taper, stretch, .. } = *refined;
        if has_own_pixels(found) {
            self.variance_factor.learn(&contour, &pixels, half_width_px);
        }
        let (pixels, contour) =
            (self.variance_factor.scaled(pixels), self.variance_factor.bias_corrected(contour));
        let unlike = self.hand.shape_mismatch(half_width_px, taper, stretch.middle_px());
        // The hand's width and taper are known from contours.
        let expected = pixels.covariance + contour.covariance;
        Some(pixels.joined(&contour).with_shape_mismatch(&unlike, &expected))
    }

    /// The line of a fit's contour, as far as what covers it may have led it astray.
    fn contour_line(&self, found: &FitResult) -> Option<FingerLine> {
        let fit = found.fit.as_ref()?;
        let line = FingerLine::of_contour(&fit.axis, &fit.line_covariance);
        Some(line.with_bias(self.hand.unusual_px(fit)))
    }

    /// The same where the pixels of all frames have it, as sure as such lines are and as its width
    /// allows.
    fn by_contour(&self, found: &FitResult) -> Option<FingerLine> {
        let line = self.variance_factor.bias_corrected(self.contour_line(found)?);
        let expected = line.covariance;
        Some(match found.shape {
            Shape::Ribbon(x) => {
                line.with_shape_mismatch(&self.hand.shape_mismatch(x[3], x[4], 0.0), &expected)
            }
            Shape::Planar(_) => line,
        })
    }

    /// The finger as far as its flanks show.
    fn finger_of(&self, x: &RibbonVector, found: &FitResult) -> Result<Option<Finger>> {
        // What covers a hand may lie over the middle of a flank; its own pixels are told otherwise.
        let flanks = if has_own_pixels(found) { Flanks::Agreeing } else { Flanks::Visible };
        self.finger(x, found, flanks)
    }

    /// The finger by its flanks alone; none if they cannot be believed.
    fn refine(
        &mut self,
        frame: &Scene<'_>,
        finger: &Finger,
        found: &FitResult,
    ) -> Result<Option<Refined>> {
        if let Some(refined) = self.refine_whole(frame, finger, found.edges())? {
            return Ok(Some(refined));
        }
        let search_model = self.hand.search_model(frame, found.edges(), self.options.polarity);
        let shown = self.convergence.shown(frame, search_model.mixture, finger)?;
        let appearance = search_model.cue.appearance();
        // What is known of the background are grey levels, whatever mixture shows the hand best.
        let behind = frame.background();
        let known = behind.as_ref().map(|b| b.known().behind(*frame.image()));
        self.refiner.refine(&shown, finger, search_model.polarity, appearance, known.as_ref())
    }

    /// The same in the frame as it was recorded, where that is followed in a smaller picture: none
    /// unless its pixels agree with a finger, and are sharp enough to tell more than the picture's.
    fn refine_whole(
        &mut self,
        frame: &Scene<'_>,
        finger: &Finger,
        edges: EdgeCue,
    ) -> Result<Option<Refined>> {
        let (Some(whole), pyramid_level) = (frame.whole(), self.pyramid_level) else {
            return Ok(None);
        };
        let finger = pyramid_level.finger(finger);
        let search_model = self.hand.search_model(frame, edges, self.options.polarity);
        let shown = self.whole.shown(whole, search_model.mixture, || finger_region(&finger))?;
        let appearance = search_model.cue.appearance();
        let behind = frame.background();
        let known = behind.as_ref().map(|b| b.known_whole().behind(*whole.image()));
        let refined = self.refiner.refine(
            &shown,
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

    /// The finger that the band template stands for, by so much of both its flanks.
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
        let belief = self.by_contour(found).and_then(|line| self.belief(&line.covariance));
        let round_end_px = Some(round_end_px);
        let finger = Finger { axis, half_width_px, taper, flanks, round_end_px, belief };
        // A template may be longer than any picture; no line of such a finger is told by its pixels.
        let is_longest = self.pyramid_level.px() * finger.stretch().length_px() > MAX_STRETCH_PX;
        Ok((!is_longest).then_some(finger))
    }

    /// How the finger of a fit that counts is bent, if its flanks tell; never of the paper's model.
    pub(super) fn bend(&mut self, frame: &Scene<'_>, found: &FitResult) -> Result<Option<Bend>> {
        let Shape::Ribbon(x) = found.shape else { return Ok(None) };
        let Some(finger) = self.finger(&x, found, Flanks::Visible)? else { return Ok(None) };
        let search_model = self.hand.search_model(frame, found.edges(), self.options.polarity);
        let shown = self.convergence.shown(frame, search_model.mixture, &finger)?;
        self.refiner.bend(&shown, &finger, search_model.polarity, search_model.cue.appearance())
    }

    /// Takes over what a fit that counts shows of the hand, now and then. Where its looks did not lead
    /// to it, the light has changed: it looks as it looks now.
    pub(super) fn update_appearance(&mut self, frame: &Scene<'_>, found: &FitResult) -> Result<()> {
        let is_relit =
            self.hand.is_shown_in(frame) && found.fit.is_some_and(|fit| !fit.by_appearance);
        let place = self.hand.shape.placement().xy();
        let stays = (place - self.hand.taught_at_px).norm() <= STAYS * self.hand.acquired[3];
        self.hand.untaught_frames += 1;
        if is_relit {
            self.hand.appearance = None;
        } else if self.hand.is_shown_in(frame)
            && stays
            && self.hand.untaught_frames < FRAMES_A_LESSON
        {
            return Ok(());
        }
        self.learn_appearance(frame, self.hand.untaught_frames)?;
        (self.hand.taught_at_px, self.hand.untaught_frames) = (place, 0);
        if let Some(appearance) = self.hand.appearance.as_mut().filter(|_| is_relit) {
            appearance.anchor();
        }
        Ok(())
    }

    /// Takes over what the last accepted fit saw on either side of the contour, for so many frames.
    pub(super) fn learn_appearance(&mut self, frame: &Scene<'_>, frames: usize) -> Result<()> {
        let coloured = frame.colour().is_some();
        let known = self.hand.appearance.as_ref().map(AppearanceModel::is_coloured);
        if known == Some(true) && !coloured {
            return Ok(());
        }
        if known != Some(coloured) {
            self.hand.appearance = None;
        }
        let (samples, finger) = (self.hand.fingers(&self.samples), self.hand.shape.silhouette());
        let keep = (1.0 - self.options.track.appearance_rate).powi(frames as i32);
        // The tracker of 1994 knows the finger as a whole.
        let shaded = self.hand.shaded;
        let appearance = self.hand.appearance.get_or_insert_with(|| match self.options.model {
            Model::Ribbon => AppearanceModel::new(coloured).with_flank_levels().with_shaded(shaded),
            Model::Paper => AppearanceModel::new(coloured),
        });
        self.convergence.teach(appearance, samples, frame, &finger, (keep, frames as f64))
    }

    /// Takes over what is behind a hand where the last accepted fit saw no edge. What covers the hand
    /// elsewhere teaches nothing.
    pub(super) fn learn_behind(&mut self, frame: &Scene<'_>) -> Result<()> {
        let (samples, finger) = (self.hand.fingers(&self.samples), self.hand.shape.silhouette());
        self.hand.appearance.as_mut().map_or(Ok(()), |appearance| {
            self.convergence.teach_unseen(appearance, samples, frame, &finger)
        })
    }
}

/// Whether the pixels about the flanks are the hand's: what covers a hand has pixels of its own.
fn has_own_pixels(found: &FitResult) -> bool {
    !found.fit.is_some_and(|fit| fit.own_only)
}
