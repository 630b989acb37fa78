//! Appearance model of a hand: all that is learned from the pixels on either side of its contour.

use super::flank_levels::FlankLevels;
use super::silhouette::{AHEAD, EDGE_PX, Shaft, Silhouette};
use crate::Result;
use crate::appearance::discriminant::{Discriminant, DiscriminantImage, Mixture, region_about};
use crate::appearance::histogram::HistogramModel;
use crate::geometry::shape_space::PlacedSample;
use crate::geometry::template::Part;
use crate::image::frame::{Frame, SidedPixel};
use crate::measure::edge::Polarity;
use crate::measure::edge_search::Cue;
use crate::numeric::ablation::{Mechanism, is_off};

const REACH_PX: f64 = 14.0;
/// Additional depth ahead of the tip from which outside pixels are learned \[half-widths\], and the
/// limit of the total \[px\].
const AHEAD_WIDTHS: f64 = 5.0;
const MOST_REACH_PX: f64 = 120.0;

/// Length of the segment of a finger that must be like the hand, in steps of [`Shaft::steps`].
const STRETCH: usize = 3;
/// Threshold of the mean log-likelihood ratio ahead of the tip, as a part of the finger's, above
/// which the finger is a band of a pattern that goes on; without colours it is 0. A finger with its
/// shadow ahead of it, before a brown table, was taken for a band at 0.27.
const MAX_RATIO_AHEAD: f64 = 0.3;

/// Cue of the contour's search lines.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum EdgeCue {
    /// Log-likelihood ratios of the pixels.
    LogRatio,
    /// Edges whose two sides differ in log-likelihood ratio.
    HandEdges,
    /// The same in the grey image, whatever mixture of colours shows the hand best.
    GreyEdges,
    /// The strongest edge.
    AnyEdge,
}

/// Model by which search lines measure the hand.
#[derive(Debug, Clone, Copy)]
pub(super) struct SearchModel<'a> {
    /// The requested cue.
    pub edge_cue: EdgeCue,
    pub cue: Cue<'a>,
    /// Mixture of colours to be searched in place of the grey image.
    pub mixture: Option<&'a Mixture>,
    pub polarity: Polarity,
    /// How the grey image is searched in addition to the mixture, if it is.
    pub in_grey: Option<GreyCue<'a>>,
    /// Grey levels of a hand with an appearance of colours.
    pub shades: Option<&'a HistogramModel>,
    /// Flanks of a hand with an appearance of grey levels, if edges must look like the hand.
    pub flank_levels: Option<&'a FlankLevels>,
}

/// How search lines measure, in the grey image, a hand with an appearance of colours.
#[derive(Debug, Clone, Copy)]
pub(super) struct GreyCue<'a> {
    pub polarity: Polarity,
    pub colours: &'a HistogramModel,
    /// The flank that is invisible in grey, if there is one. The other one is lit: grey shows it
    /// sharply, while its colours bleed.
    pub shaded: Option<Part>,
}

impl SearchModel<'_> {
    /// Any edge of this polarity: the only cue before a hand was seen.
    pub fn unknown(polarity: Polarity) -> Self {
        let (edge_cue, cue) = (EdgeCue::AnyEdge, Cue::Edges);
        Self {
            edge_cue,
            cue,
            mixture: None,
            polarity,
            in_grey: None,
            shades: None,
            flank_levels: None,
        }
    }

    /// Cue of the lines of a part of the outline.
    pub fn cue_of(&self, part: Part) -> Cue<'_> {
        self.flank_levels
            .and_then(|flank_levels| flank_levels.of(part))
            .map_or(self.cue, Cue::HandEdges)
    }

    /// Whether an edge of a part of the outline matches the appearance model; `search_frame` is the
    /// frame in this search model's mixture. Without such a model every edge does.
    pub fn matches_appearance_on(
        &self,
        part: Part,
        frame: &Frame<'_>,
        search_frame: &Frame<'_>,
        edge: &PlacedSample,
    ) -> bool {
        SearchModel { cue: self.cue_of(part), ..*self }.matches_appearance(
            frame,
            search_frame,
            edge,
        )
    }

    /// The same for an edge on any part of the outline.
    pub fn matches_appearance(
        &self,
        frame: &Frame<'_>,
        search_frame: &Frame<'_>,
        edge: &PlacedSample,
    ) -> bool {
        self.cue.appearance().is_none_or(|appearance| {
            appearance.matches_edge(search_frame, edge.position, edge.normal)
                && self.has_shade(frame, edge)
        })
    }

    /// The same for an edge of the grey image, by the colours on its two sides.
    pub fn matches_in_grey(
        &self,
        in_grey: &GreyCue<'_>,
        frame: &Frame<'_>,
        edge: &PlacedSample,
    ) -> bool {
        in_grey.colours.matches_edge(frame, edge.position, edge.normal)
            && self.has_shade(frame, edge)
    }

    /// Whether the inside of an edge has a grey level that was observed on the hand. Bins of colour
    /// are so wide that an occluder may share them.
    fn has_shade(&self, frame: &Frame<'_>, edge: &PlacedSample) -> bool {
        self.shades.is_none_or(|shades| shades.has_shown(frame, edge.position, edge.normal))
    }
}

/// The appearance model of one hand.
#[derive(Debug, Clone)]
pub(super) struct AppearanceModel {
    /// Of colours, or of grey levels in a grey image.
    plain: HistogramModel,
    discriminant: Discriminant,
    /// Of grey levels in the discriminant's image: it keeps the fine shades that the coarse bins of
    /// three channels lose.
    mixed: HistogramModel,
    /// Whether `mixed` separates hand and background better than `plain`.
    finer: bool,
    /// Of grey levels, in addition to colours.
    shades: Option<HistogramModel>,
    /// Of each flank separately, if requested.
    flank_levels: Option<FlankLevels>,
    /// The pixels of one frame.
    pixels: Vec<SidedPixel>,
    /// The flank that is as dark as the background, if there is one; see
    /// [`find_shaded_flank`](super::ContourTracker::find_shaded_flank).
    shaded: Option<Part>,
}

impl AppearanceModel {
    pub fn new(coloured: bool) -> Self {
        Self {
            plain: HistogramModel::new(coloured),
            discriminant: Discriminant::default(),
            mixed: HistogramModel::new(false),
            finer: false,
            shades: coloured.then(|| HistogramModel::new(false)),
            flank_levels: None,
            pixels: Vec::new(),
            shaded: None,
        }
    }

    /// The same for a finger that is lit from one side, if it is: of chromaticities, which do not
    /// change where the surface turns from the light.
    pub fn with_shaded(self, shaded: Option<Part>) -> Self {
        match shaded {
            Some(_) => Self { discriminant: Discriminant::of_chromaticity(), shaded, ..self },
            None => self,
        }
    }

    /// The same, and of each flank separately if there are no colours.
    pub fn with_flank_levels(self) -> Self {
        if is_off(Mechanism::FlankLevels) {
            return self;
        }
        let flank_levels = (!self.is_coloured()).then(FlankLevels::new);
        Self { flank_levels, ..self }
    }

    /// Reserves space for the pixels of a contour of this number of samples.
    pub fn reserve(&mut self, samples: usize) {
        let pixels = samples * (REACH_PX + MOST_REACH_PX) as usize;
        self.pixels.reserve(pixels);
        self.flank_levels.iter_mut().for_each(|flank_levels| flank_levels.reserve(pixels));
    }

    /// Forgets everything.
    pub fn forget(&mut self) {
        self.plain.fade(0.0);
        self.discriminant.forget();
        self.mixed.fade(0.0);
        self.finer = false;
        self.shades.iter_mut().for_each(|shades| shades.fade(0.0));
        self.flank_levels.iter_mut().for_each(FlankLevels::forget);
    }

    /// Whether it was learned from colours.
    pub fn is_coloured(&self) -> bool {
        self.plain.is_coloured()
    }

    /// Keeps the present model of the hand permanently.
    pub fn anchor(&mut self) {
        self.plain.anchor();
        self.discriminant.anchor();
        self.mixed.anchor();
        self.shades.iter_mut().for_each(HistogramModel::anchor);
        self.flank_levels.iter_mut().for_each(FlankLevels::anchor);
    }

    /// Adapts the model to light that is `gain` times as bright. The discriminant's image is
    /// invariant except for its noise, and so are the levels in it.
    pub fn relight(&mut self, gain: f64) {
        self.plain.relight(gain as f32);
        self.discriminant.relight(gain);
        self.shades.iter_mut().for_each(|shades| shades.relight(gain as f32));
        self.flank_levels.iter_mut().for_each(|flank_levels| flank_levels.relight(gain as f32));
    }

    /// Learns from the pixels of a frame on either side of a finger's contour, `times` times;
    /// earlier observations keep the part `keep` of their weight.
    pub fn learn(
        &mut self,
        frame: &Frame<'_>,
        image: &mut DiscriminantImage,
        contour: &[PlacedSample],
        finger: &Silhouette,
        (keep, times): (f64, f64),
    ) -> Result<()> {
        self.gather(contour, finger, AHEAD_WIDTHS);
        if self.pixels.is_empty() {
            return Ok(());
        }
        self.plain.fade(keep as f32);
        self.discriminant.fade(keep);
        self.plain.observe_all(frame, &self.pixels, times);
        self.discriminant.observe_all(frame, &self.pixels, times);
        self.plain.learn();
        if let Some(flank_levels) = &mut self.flank_levels {
            flank_levels.learn(frame, contour, finger, &self.plain, (keep, times));
        }
        if let Some(shades) = &mut self.shades {
            shades.fade(keep as f32);
            shades.observe_all(frame, &self.pixels, times);
            shades.learn();
        }
        // The discriminant image that the frame was searched in already exists.
        let searched = self.discriminant.mixture().copied();
        self.discriminant.learn();
        if let Some(mixture) = searched.as_ref().or(self.discriminant.mixture()) {
            let mixed_frame = image.of(
                frame,
                mixture,
                region_about(self.pixels.iter().map(|p| (p.middle(), 0.0))),
            )?;
            self.mixed.fade(keep as f32);
            self.mixed.observe_all(&mixed_frame, &self.pixels, times);
            self.mixed.learn();
        }
        self.finer = self.mixed.separation() > self.plain.separation();
        Ok(())
    }

    /// Forgets everything, and returns the separation of the pixels inside and outside of a
    /// finger's contour in one frame, [`HistogramModel::separation`], 0–6; 0 if the object is not a
    /// whole finger along its `shaft`.
    pub fn finger_separation(
        &mut self,
        frame: &Frame<'_>,
        contour: &[PlacedSample],
        finger: &Silhouette,
        shaft: Option<&Shaft>,
    ) -> f64 {
        self.gather(contour, finger, 0.0);
        self.plain.fade(0.0);
        self.plain.observe_all(frame, &self.pixels, 1.0);
        self.plain.learn();
        if shaft.is_some_and(|shaft| !self.is_whole(frame, contour, shaft)) {
            return 0.0;
        }
        self.plain.separation()
    }

    /// Whether every segment of a finger is more like its inside than like its sides, and the
    /// region ahead of its tip is not: a band of a pattern is crossed by other bands, and goes on
    /// behind them. A finger may be shorter than its template: it is tested up to the end of its
    /// visible contour.
    fn is_whole(&self, frame: &Frame<'_>, contour: &[PlacedSample], shaft: &Shaft) -> bool {
        let Shaft { axis, half_width_px, length_px } = *shaft;
        let log_ratio = |ahead_px: f64| shaft.log_ratio(frame, &self.plain, ahead_px);
        let mut stretch = [0.0; STRETCH];
        let behind =
            contour.iter().map(|sample| (axis.tip - sample.position).dot(&axis.direction()));
        let visible_px = behind.fold(0.0, f64::max).min(length_px) - 0.5 * half_width_px;
        let mut inside = 0.0;
        let back = shaft.steps(half_width_px, visible_px).zip(1..);
        for (back_px, steps) in back {
            let mean_ratio = log_ratio(-back_px);
            stretch[steps % STRETCH] = mean_ratio;
            if steps >= STRETCH && stretch.iter().sum::<f64>() < 0.0 {
                return false;
            }
            // Running mean.
            inside += (mean_ratio - inside) / steps as f64;
        }
        let limit = if self.is_coloured() { MAX_RATIO_AHEAD * inside } else { 0.0 };
        let ahead = shaft.steps(2.0 * EDGE_PX, AHEAD * half_width_px);
        ahead.map(|ahead_px| log_ratio(ahead_px) - limit).sum::<f64>() <= 0.0
    }

    /// Whether a mixture of colours shows the hand better than the grey image.
    pub fn is_mixed(&self) -> bool {
        self.discriminant.mixture().is_some()
    }

    /// Search model for a frame; `None` if the frame has no colours and only those are known.
    pub fn search_model(
        &self,
        frame: &Frame<'_>,
        edge_cue: EdgeCue,
        polarity: Polarity,
    ) -> Option<SearchModel<'_>> {
        let coloured = frame.colour().is_some();
        if self.is_coloured() && !coloured {
            return None;
        }
        let mixture = self.discriminant.mixture().filter(|_| coloured);
        let finer = mixture.is_some() && self.finer;
        let known = if finer { &self.mixed } else { &self.plain };
        // In the discriminant's image the hand is the brighter side.
        let in_mixture = if mixture.is_some() { Polarity::Bright } else { polarity };
        let in_grey = GreyCue { polarity, colours: &self.plain, shaded: self.shaded };
        let (cue, mixture, polarity) = match edge_cue {
            EdgeCue::LogRatio => (Cue::LogRatio(known), mixture.filter(|_| finer), in_mixture),
            EdgeCue::HandEdges => (Cue::HandEdges(known), mixture, in_mixture),
            EdgeCue::GreyEdges => (Cue::HandEdges(&self.plain), None, polarity),
            EdgeCue::AnyEdge => (Cue::Edges, mixture, in_mixture),
        };
        let in_grey = (edge_cue == EdgeCue::HandEdges && mixture.is_some()).then_some(in_grey);
        let flank_levels = self.flank_levels.as_ref().filter(|_| edge_cue == EdgeCue::HandEdges);
        Some(SearchModel {
            edge_cue,
            cue,
            mixture,
            polarity,
            in_grey,
            shades: self.shades.as_ref(),
            flank_levels,
        })
    }

    /// Collects the pixels on either side of a contour, and `ahead_widths` half-widths more ahead
    /// of the tip.
    fn gather(&mut self, contour: &[PlacedSample], finger: &Silhouette, ahead_widths: f64) {
        let depth_px = (2.0 * finger.half_width_px - EDGE_PX).clamp(3.0, REACH_PX);
        self.pixels.clear();
        for PlacedSample { position, normal } in contour {
            // No part of the hand lies ahead of a fingertip, and the hand may move there next.
            let ahead_px = normal.dot(&finger.ahead).max(0.0) * ahead_widths * finger.half_width_px;
            let outer_px = (REACH_PX + ahead_px).min(MOST_REACH_PX);
            let inside = SidedPixel::along(*position, -normal, EDGE_PX, depth_px, true);
            self.pixels.extend(inside);
            let outside = SidedPixel::along(*position, *normal, 2.0 * EDGE_PX, outer_px, false);
            self.pixels.extend(outside);
        }
    }
}
