//! What a hand looks like: all that is learned from either side of its contour.

use super::flank_levels::FlankLevels;
use super::silhouette::{AHEAD, EDGE_PX, LIKE_HAND, Shaft, Silhouette};
use crate::Result;
use crate::appearance::discriminant::{Discriminant, DiscriminantImage, Mixture, region_about};
use crate::appearance::histogram::HistogramModel;
use crate::geometry::shape_space::PlacedSample;
use crate::geometry::template::Part;
use crate::image::frame::{Frame, SidedPixel};
use crate::measure::edge::Polarity;
use crate::measure::edge_search::Cue;

const REACH_PX: f64 = 14.0;
/// Ahead of the tip they are learned so many half-widths further, but no further than that \[px\].
const AHEAD_WIDTHS: f64 = 5.0;
const MOST_REACH_PX: f64 = 120.0;

/// A stretch of it that counts: so many steps.
const STRETCH: usize = 3;
/// That is a part of it, as of a pattern's band, if it votes for the hand by more than this part of what
/// the finger does, or without colours by anything. A finger whose shadow lies ahead of it, before a brown
/// table, was taken for a band by 0.27.
const GOES_ON: f64 = 0.3;
/// Where there is no edge, the hand is told from what is behind it by mean colours so far from the edge
/// \[px\]; if these differ by so much, in all channels together, something else is behind it than looks
/// know of \[grey levels\].
const BEHIND_PX: [f64; 2] = [2.0 * EDGE_PX, 10.0];
const INSIDE_PX: [f64; 2] = [EDGE_PX, 6.0];
const OTHER_COLOUR: f64 = 20.0;

/// What leads the contour.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum EdgeCue {
    /// The pixels' votes.
    LogRatio,
    /// Edges whose sides vote differently.
    HandEdges,
    /// The same of the grey image, whatever mixture of colours shows the hand best.
    GreyEdges,
    /// The strongest edge.
    AnyEdge,
}

/// How a search line sees the hand, by what is known of it.
#[derive(Debug, Clone, Copy)]
pub(super) struct SearchModel<'a> {
    /// What it was asked for.
    pub edge_cue: EdgeCue,
    pub cue: Cue<'a>,
    /// The mixture to search in place of the grey image.
    pub mixture: Option<&'a Mixture>,
    pub polarity: Polarity,
    /// How the grey image is searched beside the mixture, if it is.
    pub in_grey: Option<GreyCue<'a>>,
    /// The grey levels of a hand whose looks are colours.
    pub shades: Option<&'a HistogramModel>,
    /// The flanks of a hand whose looks are grey levels, if edges are to look like it.
    pub flank_levels: Option<&'a FlankLevels>,
}

/// How a search line sees in grey a hand whose looks are colours.
#[derive(Debug, Clone, Copy)]
pub(super) struct GreyCue<'a> {
    pub polarity: Polarity,
    pub colours: &'a HistogramModel,
    /// The flank that grey does not show, if there is one. The other one is lit: grey shows it
    /// sharply, where its colours bleed.
    pub shaded: Option<Part>,
}

impl SearchModel<'_> {
    /// Any edge of this polarity: all that can be looked for before a hand was seen.
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

    /// What lines of a part of the outline look for.
    pub fn cue_of(&self, part: Part) -> Cue<'_> {
        self.flank_levels
            .and_then(|flank_levels| flank_levels.of(part))
            .map_or(self.cue, Cue::HandEdges)
    }

    /// Whether an edge of a part of the outline is the hand's own in a frame that is `shown` as this
    /// sight shows it; any is where looks tell nothing.
    pub fn is_own_of(
        &self,
        part: Part,
        frame: &Frame<'_>,
        shown: &Frame<'_>,
        edge: &PlacedSample,
    ) -> bool {
        SearchModel { cue: self.cue_of(part), ..*self }.is_own(frame, shown, edge)
    }

    /// The same of an edge wherever it is on the outline.
    pub fn is_own(&self, frame: &Frame<'_>, shown: &Frame<'_>, edge: &PlacedSample) -> bool {
        self.cue.appearance().is_none_or(|appearance| {
            appearance.is_own_edge(shown, edge.position, edge.normal) && self.has_shade(frame, edge)
        })
    }

    /// The same of an edge of the grey image, by the colours on its two sides.
    pub fn is_own_in_grey(
        &self,
        in_grey: &GreyCue<'_>,
        frame: &Frame<'_>,
        edge: &PlacedSample,
    ) -> bool {
        in_grey.colours.is_own_edge(frame, edge.position, edge.normal)
            && self.has_shade(frame, edge)
    }

    /// Whether what is inside of an edge is as bright as the hand somewhere is. Bins of colour are so
    /// wide that what covers a hand may share them.
    fn has_shade(&self, frame: &Frame<'_>, edge: &PlacedSample) -> bool {
        self.shades.is_none_or(|shades| shades.has_shown(frame, edge.position, edge.normal))
    }
}

/// A contour as far as it teaches looks.
#[derive(Debug, Clone, Copy)]
pub(super) struct Contour<'a> {
    /// Where its edges are.
    pub edges: &'a [PlacedSample],
    /// Where the hand is known to end, without an edge: what is behind it there is perhaps not known yet.
    pub unseen: &'a [PlacedSample],
}

/// The looks of one hand.
#[derive(Debug, Clone)]
pub(super) struct AppearanceModel {
    /// Of colours, or of grey levels where there are none.
    plain: HistogramModel,
    discriminant: Discriminant,
    /// Of grey levels in the discriminant's image: what its fine shades tell is lost among the
    /// coarse bins of three channels.
    mixed: HistogramModel,
    /// Whether that tells hand and background apart better than `plain`.
    finer: bool,
    /// Of grey levels, beside colours.
    shades: Option<HistogramModel>,
    /// Of either flank, if it is to be known for itself.
    flank_levels: Option<FlankLevels>,
    /// The pixels of one frame.
    pixels: Vec<SidedPixel>,
    /// The flank that is as dark as what is behind it, if there is one; see
    /// [`find_shaded_flank`](super::ContourTracker::leave_shade).
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

    /// The same of a finger that is lit from one side, if it is: of chromaticities, which do not show
    /// where it turns from the light.
    pub fn with_shaded(self, shaded: Option<Part>) -> Self {
        match shaded {
            Some(_) => Self { discriminant: Discriminant::of_chromaticity(), shaded, ..self },
            None => self,
        }
    }

    /// The same, of each flank for itself as well where there are no colours.
    pub fn with_flank_levels(self) -> Self {
        let flank_levels = (!self.is_coloured()).then(FlankLevels::new);
        Self { flank_levels, ..self }
    }

    /// Makes room for what a contour of so many samples shows.
    pub fn reserve(&mut self, samples: usize) {
        let pixels = samples * (REACH_PX + MOST_REACH_PX) as usize;
        self.pixels.reserve(pixels);
        self.flank_levels.iter_mut().for_each(|flank_levels| flank_levels.reserve(pixels));
    }

    /// Forgets all.
    pub fn forget(&mut self) {
        self.plain.fade(0.0);
        self.discriminant.forget();
        self.mixed.fade(0.0);
        self.finer = false;
        self.shades.iter_mut().for_each(|shades| shades.fade(0.0));
        self.flank_levels.iter_mut().for_each(FlankLevels::forget);
    }

    /// Whether they were learned from colours.
    pub fn is_coloured(&self) -> bool {
        self.plain.is_coloured()
    }

    /// Keeps the hand as it is known now for good.
    pub fn anchor(&mut self) {
        self.plain.anchor();
        self.discriminant.anchor();
        self.mixed.anchor();
        self.shades.iter_mut().for_each(HistogramModel::anchor);
        self.flank_levels.iter_mut().for_each(FlankLevels::anchor);
    }

    /// Takes all over into light that is `gain` times as bright. The discriminant's image stays as
    /// it is but for its noise, and so do the levels in it.
    pub fn relight(&mut self, gain: f64) {
        self.plain.relight(gain as f32);
        self.discriminant.relight(gain);
        self.shades.iter_mut().for_each(|shades| shades.relight(gain as f32));
        self.flank_levels.iter_mut().for_each(|flank_levels| flank_levels.relight(gain as f32));
    }

    /// Takes over what a frame shows on either side of a finger's contour, `times` times; what was
    /// known keeps a part `keep` of its weight.
    pub fn learn(
        &mut self,
        frame: &Frame<'_>,
        image: &mut DiscriminantImage,
        contour: &Contour<'_>,
        finger: &Silhouette,
        (keep, times): (f64, f64),
    ) -> Result<()> {
        self.gather(contour.edges, finger, AHEAD_WIDTHS);
        self.gather_behind(frame, contour.unseen);
        if self.pixels.is_empty() {
            return Ok(());
        }
        self.plain.fade(keep as f32);
        self.discriminant.fade(keep);
        self.plain.observe_all(frame, &self.pixels, times);
        self.discriminant.observe_all(frame, &self.pixels, times);
        self.plain.learn();
        if let Some(flank_levels) = &mut self.flank_levels {
            flank_levels.learn(frame, contour.edges, finger, &self.plain, (keep, times));
        }
        if let Some(shades) = &mut self.shades {
            shades.fade(keep as f32);
            shades.observe_all(frame, &self.pixels, times);
            shades.learn();
        }
        // The image that the frame was searched in is there already.
        let searched = self.discriminant.mixture().copied();
        self.discriminant.learn();
        if let Some(mixture) = searched.as_ref().or(self.discriminant.mixture()) {
            let shown = image.of(
                frame,
                mixture,
                region_about(self.pixels.iter().map(|p| (p.middle(), 0.0))),
            )?;
            self.mixed.fade(keep as f32);
            self.mixed.observe_all(&shown, &self.pixels, times);
            self.mixed.learn();
        }
        self.finer = self.mixed.separation() > self.plain.separation();
        Ok(())
    }

    /// Forgets all, and tells how well what one frame shows inside of a finger's contour differs from
    /// what it shows outside of it: [`HistogramModel::separation`], 0–6, and nothing of what is no finger
    /// along its `shaft`.
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

    /// Whether every stretch of a finger looks rather like its inside than like what is beside it, and
    /// what lies ahead of its tip does not: a band of a pattern is crossed by others, and goes on
    /// behind them. A finger may be shorter than its template: it is looked at as far back as its
    /// contour is seen.
    fn is_whole(&self, frame: &Frame<'_>, contour: &[PlacedSample], shaft: &Shaft) -> bool {
        let Shaft { axis, half_width_px, length_px } = *shaft;
        let log_ratio = |ahead_px: f64| shaft.log_ratio(frame, &self.plain, ahead_px);
        let mut stretch = [0.0; STRETCH];
        let behind = contour.iter().map(|seen| (axis.tip - seen.position).dot(&axis.direction()));
        let seen_px = behind.fold(0.0, f64::max).min(length_px) - 0.5 * half_width_px;
        let mut inside = 0.0;
        let back = shaft.steps(half_width_px, seen_px).zip(1..);
        for (back_px, steps) in back {
            let likely = log_ratio(-back_px);
            stretch[steps % STRETCH] = likely;
            if steps >= STRETCH && stretch.iter().sum::<f64>() < 0.0 {
                return false;
            }
            // The mean of all so far.
            inside += (likely - inside) / steps as f64;
        }
        let most = if self.is_coloured() { GOES_ON * inside } else { 0.0 };
        let ahead = shaft.steps(2.0 * EDGE_PX, AHEAD * half_width_px);
        ahead.map(|ahead_px| log_ratio(ahead_px) - most).sum::<f64>() <= 0.0
    }

    /// Whether a mixture of colours shows the hand better than the grey image.
    pub fn is_mixed(&self) -> bool {
        self.discriminant.mixture().is_some()
    }

    /// How to look for the hand in a frame; none if it shows no colours and only these are known.
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

    /// Adds pixels of what is behind a hand that ends where there is no edge: the mixture that tells the
    /// hand from what was behind it elsewhere may not tell it from this. It is no more of the hand if it
    /// is of another colour than the inside, which must look like the hand: what covers that does not.
    fn gather_behind(&mut self, frame: &Frame<'_>, unseen: &[PlacedSample]) {
        let Some(colours) = frame.colour() else { return };
        for PlacedSample { position, normal } in unseen {
            let along = |[from_px, to_px]: [f64; 2], way: f64| {
                SidedPixel::along(*position, normal * way, from_px, to_px, false)
            };
            let inside = along(INSIDE_PX, -1.0);
            let differ = colours.mean(inside.clone()).zip(colours.mean(along(BEHIND_PX, 1.0)));
            let differ = differ.is_some_and(|(a, b)| (a - b).norm() >= OTHER_COLOUR);
            let places = inside.map(|pixel| pixel.middle());
            if differ && self.plain.mean_log_ratio(frame, places) >= LIKE_HAND {
                self.pixels.extend(along([2.0 * EDGE_PX, REACH_PX], 1.0));
            }
        }
    }

    /// Pixels on either side of a contour, and so many half-widths more ahead of the tip.
    fn gather(&mut self, contour: &[PlacedSample], finger: &Silhouette, ahead_widths: f64) {
        let depth_px = (2.0 * finger.half_width_px - EDGE_PX).clamp(3.0, REACH_PX);
        self.pixels.clear();
        for PlacedSample { position, normal } in contour {
            // Ahead of a fingertip there is nothing of the hand, and it may go there next.
            let ahead_px = normal.dot(&finger.ahead).max(0.0) * ahead_widths * finger.half_width_px;
            let outer_px = (REACH_PX + ahead_px).min(MOST_REACH_PX);
            let inside = SidedPixel::along(*position, -normal, EDGE_PX, depth_px, true);
            self.pixels.extend(inside);
            let outside = SidedPixel::along(*position, *normal, 2.0 * EDGE_PX, outer_px, false);
            self.pixels.extend(outside);
        }
    }
}

#[cfg(test)]
#[expect(clippy::unwrap_used, reason = "a test may panic")]
mod tests;
