//! Detection and fit of a shaded flank: a finger lit from one side, before a background as dark as
//! its other half.
//!
//! The acquisition fits the lit half of such a finger: only there does its brightness differ from
//! its surroundings, and a mixture of colours learned there separates light from shade. The
//! finger's chromaticity continues into the shade, up to the flank: light of one colour changes the
//! sum of the channels, not their ratios. After the acquisition, the chromaticities across either
//! flank are measured. Where they end beyond the fit, or where they alone show the flank, the
//! finger is fitted again and then tracked with that flank in chromaticity and the other in grey
//! levels. A camera records colours at half its resolution, so that they bleed over a step of
//! brightness into dark regions: they are used only where grey levels show no flank.

use super::acquire::with_thumb_of;
use super::appearance::AppearanceModel;
use super::fit_result::FitResult;
use super::fit_stages::ACQUISITION_SLACK;
use super::options::Model;
use super::scene::Scene;
use super::shape::Shape;
use super::stage::SearchPlan;
use super::tracker::ContourTracker;
use crate::Result;
use crate::appearance::discriminant::{Discriminant, Mixture};
use crate::geometry::ribbon::{RIBBON_DOF, RibbonVector};
use crate::geometry::shape_space::{Pose, ShapeSpace};
use crate::geometry::template::{Limb, Part, TemplateSample};
use crate::image::frame::{SidedPixel, chromaticity};
use crate::numeric::ablation::{Mechanism, is_off};
use nalgebra::{Point2, Vector2, Vector3};

/// The measured part of the finger: from the centre of its round end back, as a part of the
/// template's length, in steps of a pixel and at most this number of places. Further back the hand
/// is beside it.
const FRONT: f64 = 0.6;
const MOST_PLACES: f64 = 128.0;
/// Profile across it: from this distance inside the flank (nearly the other flank) \[half-widths\]
/// to this distance beyond it \[half-widths, plus px\]; the pixels after that are the background
/// \[px\].
const INSIDE: f64 = 1.7;
const BEYOND: f64 = 2.0;
const BEYOND_PX: f64 = 6.0;
const BEHIND_PX: i32 = 7;
/// Least separation of its chromaticity from the background's \[standard deviations\]; its likeness
/// to the finger (1: finger, 0: background) must be above the second value before its end, and
/// below the third after it. Of 142 shaded flanks on four films, 19 of 20 have at least 3.7, at
/// least 0.9 and at most 0.14.
const MIN_CHROMATIC_SEPARATION: f64 = 3.0;
const LIKE_FINGER: f64 = 0.65;
const LIKE_BEHIND: f64 = 0.25;
/// Upper limit of the distance in chromaticity of the region beyond the fit from the finger, as a
/// part of that of the background from the finger: it is the skin in the shade, and not another
/// object that differs from the background even more.
const SAME_CHROMATICITY: f64 = 0.35;
/// Length over which its colour bleeds beyond its end \[px\].
const BLEEDS_PX: i32 = 3;
/// Upper limits of a shaded flank's brightness, and of its difference from the background's, as
/// parts of the lit half's. The shaded flanks have 0.33 to 0.62, and 0.08 in the median. The shaded
/// flank of a finger before wood, which a mixture of colours shows, has 0.73.
const DARK: f64 = 0.65;
const AS_DARK: f64 = 0.15;
/// Number of pixels inside the fitted flank over which its brightness is measured.
const FLANK_PX: i32 = 4;
/// Least extension of the finger beyond the fit, if that is of the lit half \[px, half-widths\].
/// Colours of a fully lit finger bleed up to 5 px or 0.7 half-widths into black.
const MIN_EXTENSION_PX: f64 = 4.0;
const MIN_EXTENSION_HALF_WIDTHS: f64 = 0.8;
/// Number of fits up to the shaded flank, each with the appearance learned from the last one.
const ROUNDS: usize = 2;
/// Least increase of the half-width by the fit, as a part of the extension of the finger.
const WIDENS: f64 = 0.25;

/// A flank that grey levels do not show.
#[derive(Debug, Clone, Copy)]
struct ShadedFlank {
    flank: Part,
    /// Its distance beyond the fitted flank \[px\]; 0 if it is there.
    beyond_px: f64,
    /// Its brightness, as a part of the lit half's.
    brightness: f64,
}

impl ContourTracker {
    /// Fits an acquired hand again if its finger is lit from one side, and stores the shaded flank.
    /// Otherwise the hand is left as it is.
    pub(super) fn find_shaded_flank(&mut self, scene: &Scene<'_>) -> Result<()> {
        if is_off(Mechanism::ShadedFlank) {
            return Ok(());
        }
        let (Shape::Ribbon(x), Model::Ribbon) = (self.hand.shape, self.options.model) else {
            return Ok(());
        };
        let left = self.shaded(scene, &x, Part::LeftFlank)?;
        let right = self.shaded(scene, &x, Part::RightFlank)?;
        let flanks = left.into_iter().chain(right);
        let Some(shaded) = flanks.min_by(|a, b| a.brightness.total_cmp(&b.brightness)) else {
            return Ok(());
        };
        let before = (self.hand.clone(), self.convergence.clone());
        if !self.fit_shaded_flank(scene, &x, &shaded)? {
            (self.hand, self.convergence) = before;
        }
        Ok(())
    }

    /// A flank, if it is shaded.
    fn shaded(
        &self,
        scene: &Scene<'_>,
        x: &RibbonVector,
        flank: Part,
    ) -> Result<Option<ShadedFlank>> {
        let Some(flank_profile) = self.flank_profile(scene, x, flank)? else { return Ok(None) };
        let shaded = flank_profile.shaded(x[3]);
        Ok(shaded.map(|(beyond_px, brightness)| ShadedFlank { flank, beyond_px, brightness }))
    }

    /// Profile of the frame across a flank; `None` without colours, where too little of it lies in
    /// the frame, or where the chromaticities are not separated.
    fn flank_profile(
        &self,
        scene: &Scene<'_>,
        x: &RibbonVector,
        flank: Part,
    ) -> Result<Option<FlankProfile>> {
        let Some(colours) = scene.colour() else { return Ok(None) };
        let (first, last) = FlankProfile::reach(x[3]);
        let mut pixels = Vec::new();
        self.outward(x, flank, |position, normal| {
            pixels.extend((first..).zip(SidedPixel::along(
                position,
                normal,
                f64::from(first),
                f64::from(last),
                false,
            )));
        })?;
        let mut discriminant = Discriminant::of_chromaticity();
        let sided: Vec<SidedPixel> = pixels
            .iter()
            .filter(|(out_px, _)| *out_px < 0 || *out_px > last - BEHIND_PX)
            .map(|(out_px, pixel)| SidedPixel { is_hand: *out_px < 0, ..*pixel })
            .collect();
        discriminant.observe_all(scene, &sided, 1.0);
        discriminant.learn();
        let Some(mixture) = discriminant
            .mixture()
            .copied()
            .filter(|_| discriminant.separation() >= MIN_CHROMATIC_SEPARATION)
        else {
            return Ok(None);
        };
        let mut flank_profile = FlankProfile::new(first, last);
        for (out_px, SidedPixel { x, y, .. }) in pixels {
            let (x, y) = (x as usize, y as usize);
            if let (Some(colour), Some(grey)) = (colours.pixel(x, y), scene.image().pixel(x, y)) {
                flank_profile.add(out_px, grey, colour, &mixture);
            }
        }
        Ok(Some(flank_profile))
    }

    /// Calls `each` with position and normal along the front of a flank, except where another limb
    /// hides it.
    fn outward(
        &self,
        x: &RibbonVector,
        flank: Part,
        mut each: impl FnMut(Point2<f64>, Vector2<f64>),
    ) -> Result<()> {
        let pose = self.ribbon::<RIBBON_DOF>(x)?.pose(x);
        let (length_px, round_end_px) =
            (self.hand.measure.length_px, self.hand.measure.round_end_px);
        let normal = Vector2::new(0.0, if flank == Part::RightFlank { 1.0 } else { -1.0 });
        let front_px = FRONT * length_px;
        let step_px = (front_px / MOST_PLACES).max(1.0);
        for place in 0..(front_px / step_px) as usize {
            let along = (round_end_px - place as f64 * step_px) / length_px;
            let (position, limb) = (Point2::new(along, 0.0), Limb::Finger);
            let sample = TemplateSample { position, normal, limb, along, radial: normal };
            let placed = pose.place(&sample);
            if !pose.is_hidden(&sample, &placed) {
                each(placed.position, placed.normal);
            }
        }
        Ok(())
    }

    /// Fits the finger up to its shaded flank. False if the colours are not separated, a fit is
    /// rejected or the finger does not widen.
    fn fit_shaded_flank(
        &mut self,
        scene: &Scene<'_>,
        settled: &RibbonVector,
        shaded: &ShadedFlank,
    ) -> Result<bool> {
        self.hand.shape = Shape::Ribbon(widened(settled, shaded));
        self.hand.shaded = Some(shaded.flank);
        if !self.learn_about_outline(scene)? {
            return Ok(false);
        }
        let plan = SearchPlan::edges(self.options.acquire.reach_px(self.initial.ribbon[3]));
        for _ in 0..ROUNDS {
            let Shape::Ribbon(x) = self.hand.shape else { return Ok(false) };
            self.hand.acquired = x;
            let prior = self.tracked_prior::<5>(&x, ACQUISITION_SLACK);
            let finger = self.run_ribbon::<5>(scene, &x, Limb::Finger, plan, Some(&prior))?;
            if !FitResult::from(finger).is_accepted(&self.options.acquire.accept) {
                return Ok(false);
            }
            self.hand.shape = Shape::Ribbon(with_thumb_of(&x, &finger.shape));
            self.hand.appearance = None;
            self.learn_appearance(scene, 1)?;
        }
        let least_px = settled[3] + WIDENS * shaded.beyond_px;
        Ok(shaded.beyond_px <= 0.0 || self.hand.shape.width() > least_px)
    }

    /// Learns the pixels inside and outside of the finger's outline, whether it has edges or not.
    /// False if their colours are not separated.
    fn learn_about_outline(&mut self, scene: &Scene<'_>) -> Result<bool> {
        let mut outline = Vec::new();
        self.hand.outline(&self.hand.shape, &self.samples, |part, placed| {
            if part != Part::Thumb {
                outline.push(placed);
            }
        });
        let silhouette = self.hand.shape.silhouette();
        let coloured = scene.colour().is_some();
        let mut appearance =
            AppearanceModel::new(coloured).with_flank_levels().with_shaded(self.hand.shaded);
        let is_separated =
            self.convergence.learn_at(&mut appearance, scene, outline.into_iter(), &silhouette)?;
        self.hand.appearance = Some(appearance);
        Ok(is_separated && self.hand.is_mixed())
    }
}

/// A finger extended beyond one of its flanks.
fn widened(x: &RibbonVector, shaded: &ShadedFlank) -> RibbonVector {
    let half_px = 0.5 * shaded.beyond_px;
    let lateral_px = if shaded.flank == Part::RightFlank { half_px } else { -half_px };
    let (sin, cos) = x[2].sin_cos();
    let mut wide = *x;
    wide[0] -= lateral_px * sin;
    wide[1] += lateral_px * cos;
    wide[3] += half_px;
    wide
}

/// Sums over the pixels at one distance outward from a flank, or means.
#[derive(Debug, Clone, Copy, Default)]
struct ShadeMeans {
    count: f64,
    grey: f64,
    chromaticity: Vector3<f64>,
    /// Likeness to the finger: grey level in the mixture that shows it best.
    like: f64,
}

/// Profile across a flank, from the finger outwards, pixel by pixel.
#[derive(Debug, Clone)]
struct FlankProfile {
    /// Distance outward of the first sums \[px\]; negative inside.
    first: i32,
    sums: Vec<ShadeMeans>,
}

impl FlankProfile {
    /// First and last distance outward from a flank for a finger of this half-width \[px\].
    fn reach(half_width_px: f64) -> (i32, i32) {
        let beyond = (BEYOND * half_width_px + BEYOND_PX).ceil() as i32;
        (-(INSIDE * half_width_px) as i32, beyond + BEHIND_PX)
    }

    fn new(first: i32, last: i32) -> Self {
        Self { first, sums: vec![ShadeMeans::default(); (last - first + 1).max(0) as usize] }
    }

    fn add(&mut self, out_px: i32, grey: u8, colour: [u8; 3], mixture: &Mixture) {
        if let Some(sums) = self.sums.get_mut((out_px - self.first) as usize) {
            sums.count += 1.0;
            sums.grey += f64::from(grey);
            sums.chromaticity += chromaticity(colour);
            sums.like += f64::from(mixture.of(colour));
        }
    }

    /// Means over distances outward from `from_px` to `to_px`, exclusive; `None` without pixels.
    fn mean(&self, from_px: i32, to_px: i32) -> Option<ShadeMeans> {
        let at = |px: i32| (px - self.first).clamp(0, self.sums.len() as i32) as usize;
        let means = self.sums.get(at(from_px)..at(to_px))?;
        let sum = means.iter().fold(ShadeMeans::default(), |sum, means| ShadeMeans {
            count: sum.count + means.count,
            grey: sum.grey + means.grey,
            chromaticity: sum.chromaticity + means.chromaticity,
            like: sum.like + means.like,
        });
        (sum.count > 0.0).then(|| ShadeMeans {
            count: sum.count,
            grey: sum.grey / sum.count,
            chromaticity: sum.chromaticity / sum.count,
            like: sum.like / sum.count,
        })
    }

    /// Means over the finger, and over the background.
    fn sides(&self) -> Option<(ShadeMeans, ShadeMeans)> {
        let behind = self.behind();
        Some((self.mean(self.first, 0)?, self.mean(behind, behind + BEHIND_PX)?))
    }

    /// Distance at which the pixels of the background begin \[px outward\].
    fn behind(&self) -> i32 {
        self.first + self.sums.len() as i32 - BEHIND_PX
    }

    /// Likeness to the finger of the chromaticities between two distances: 0 for the background, 1
    /// for the finger.
    fn like(&self, from_px: i32, to_px: i32) -> Option<f64> {
        let (inside, outside) = self.sides()?;
        Some((self.mean(from_px, to_px)?.like - outside.like) / (inside.like - outside.like))
    }

    /// Distance outward at which the finger's chromaticity ends \[px\]: the change point that best
    /// separates likeness before from unlikeness after it; `None` if the two sides do not pass
    /// [`LIKE_FINGER`] and [`LIKE_BEHIND`].
    fn end(&self, half_width_px: f64) -> Option<i32> {
        let middle = -half_width_px as i32;
        let (mut sum, mut best, mut end) = (0.0, f64::NEG_INFINITY, middle);
        for out_px in middle..self.behind() {
            sum += self.like(out_px, out_px + 1)?.clamp(0.0, 1.0) - 0.5;
            if sum > best {
                (best, end) = (sum, out_px + 1);
            }
        }
        let ends = self.like(middle, end)? > LIKE_FINGER
            && self.like(end + BLEEDS_PX, self.behind()).is_none_or(|after| after < LIKE_BEHIND);
        ends.then_some(end)
    }

    /// Distance of a shaded flank beyond the fitted one \[px\], and its brightness as a part of the
    /// lit half's; `None` if the flank is not shaded.
    fn shaded(&self, half_width_px: f64) -> Option<(f64, f64)> {
        let end = self.end(half_width_px)?;
        let is_beyond_fit =
            f64::from(end) > MIN_EXTENSION_PX.max(MIN_EXTENSION_HALF_WIDTHS * half_width_px);
        let (from, to) = if is_beyond_fit { (2, end - 1) } else { (-FLANK_PX, -1) };
        let beyond_end = end + BLEEDS_PX;
        let (inside, outside) = self.sides()?;
        let lit_grey = self.mean(self.first, -(0.9 * half_width_px) as i32)?.grey;
        let flank = self.mean(from, to)?;
        let behind = self.mean(beyond_end, beyond_end + FLANK_PX)?.grey;
        let is_hidden =
            flank.grey < DARK * lit_grey && (flank.grey - behind).abs() < AS_DARK * lit_grey;
        let class_distance = (inside.chromaticity - outside.chromaticity).norm();
        let is_finger =
            (inside.chromaticity - flank.chromaticity).norm() < SAME_CHROMATICITY * class_distance;
        let beyond_px = if is_beyond_fit { f64::from(end) } else { 0.0 };
        (is_hidden && is_finger).then_some((beyond_px, flank.grey / lit_grey))
    }
}
