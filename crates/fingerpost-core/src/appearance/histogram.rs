//! Colour (or grey-level) histograms of the hand and of its background, and their log-likelihood
//! ratio.
//!
//! An edge alone does not show whose edge it is. A pixel of a colour that is frequent on the hand
//! and rare behind it has a positive log-likelihood ratio log(p_hand / p_background); the contour
//! runs where the sign changes. The histograms are learned from either side of accepted contours,
//! with exponential forgetting, so that they follow the light.
//!
//! Source: Ronfard 1994 and Bibby & Reid 2008 for region statistics along a contour.

#![expect(
    clippy::inline_always,
    reason = "what is inlined into a function with wider instructions is compiled for them"
)]

use crate::image::frame::{Frame, SidedPixel};
use crate::image::gray::GrayView;
use crate::numeric::logarithm::ln;
use crate::numeric::simd::{Isa, Work};
use nalgebra::{Point2, Vector2};
use std::array::from_fn;

/// Bins per colour channel: 16 grey levels wide.
const COLOUR_BINS: usize = 16;
/// Bins of a grey histogram: 4 grey levels wide.
const GRAY_BINS: usize = 64;
/// Limit of a pixel's log-likelihood ratio: a colour never seen on one side is weak evidence.
const MAX_LOG_RATIO: f32 = 3.0;
/// Prior of every bin, as a part of a uniform distribution.
const PRIOR_WEIGHT: f32 = 0.5;
/// Distances from an edge at which its inside and its outside are sampled \[px\], and the least
/// mean log-likelihood ratio for the hand inside, and for the background outside. The outside is
/// sampled further away because motion blurs the hand more than the lens does.
pub(crate) const INSIDE_PX: [f64; 3] = [2.0, 3.0, 4.0];
const OUTSIDE_PX: [f64; 3] = [4.0, 6.0, 8.0];
const INSIDE_LOG_RATIO: f64 = 0.5;
const BEHIND_LOG_RATIO: f64 = 0.25;

/// Log-likelihood ratios are stored in units of one over this.
pub(crate) const LOG_RATIO_UNIT: f32 = 1024.0;

/// Log-likelihood ratio of every bin; of a grey histogram, the first 64.
pub(crate) type LogRatio = [i16; COLOUR_BINS.pow(3)];

/// Learned colours of the hand and of its background.
#[derive(Debug, Clone, PartialEq)]
pub struct HistogramModel {
    coloured: bool,
    hand: Histogram,
    /// Histogram of the hand at acquisition; see [`HistogramModel::anchor`].
    anchor: Histogram,
    background: Histogram,
    /// Log-likelihood ratio of every bin, in units of 1/1024.
    log_ratios: Box<LogRatio>,
    /// The smoothed histograms of hand and background.
    smooth: [Vec<f32>; 2],
}

/// Weight of the observations in every bin.
#[derive(Debug, PartialEq)]
struct Histogram {
    bins: Vec<f32>,
    total: f64,
}

impl Clone for Histogram {
    fn clone(&self) -> Self {
        Self { bins: self.bins.clone(), total: self.total }
    }

    fn clone_from(&mut self, other: &Self) {
        self.bins.clone_from(&other.bins);
        self.total = other.total;
    }
}

impl Histogram {
    fn empty(bins: usize) -> Self {
        Self { bins: vec![0.0; bins], total: 0.0 }
    }

    fn fade(&mut self, keep: f32) {
        for bin in &mut self.bins {
            *bin *= keep;
        }
        self.total *= f64::from(keep);
    }

    /// Moves the observations to levels `gain` times as high, with linear interpolation between
    /// bins.
    fn relight(&mut self, gain: f32, before: &mut [f32]) {
        let (axes, side) =
            if self.bins.len() == GRAY_BINS { (1, GRAY_BINS) } else { (3, COLOUR_BINS) };
        let moved: [(usize, f32); GRAY_BINS] = from_fn(|i| {
            let at = ((i as f32 + 0.5) * gain - 0.5).clamp(0.0, (side - 1) as f32);
            let below = (at as usize).min(side - 2);
            (below, at - below as f32)
        });
        before.copy_from_slice(&self.bins);
        self.bins.fill(0.0);
        for (bin, &weight) in before.iter().enumerate().filter(|(_, weight)| **weight > 0.0) {
            // Along every axis, a share goes to the lower and to the upper one of two bins.
            for corner in 0..1_usize << axes {
                let (mut place, mut share, mut stride, mut remaining) = (0, weight, 1, bin);
                for axis in 0..axes {
                    let (below, part) = moved[remaining % side];
                    let upper = (corner >> axis) & 1;
                    place += (below + upper) * stride;
                    share *= if upper == 1 { part } else { 1.0 - part };
                    (remaining, stride) = (remaining / side, stride * side);
                }
                self.bins[place] += share;
            }
        }
    }
}

impl HistogramModel {
    /// A model without observations: every log-likelihood ratio is 0.
    #[must_use]
    pub fn new(coloured: bool) -> Self {
        let bins = if coloured { COLOUR_BINS.pow(3) } else { GRAY_BINS };
        Self {
            coloured,
            hand: Histogram::empty(bins),
            anchor: Histogram::empty(bins),
            background: Histogram::empty(bins),
            log_ratios: Box::new([0; _]),
            smooth: from_fn(|_| vec![0.0; bins]),
        }
    }

    /// Whether it is a model of colours.
    #[must_use]
    pub fn is_coloured(&self) -> bool {
        self.coloured
    }

    /// Scales the weight of the observations by `keep`, 0–1.
    pub fn fade(&mut self, keep: f32) {
        self.hand.fade(keep);
        self.background.fade(keep);
    }

    /// Adapts the model to light that is `gain` times as bright.
    pub fn relight(&mut self, gain: f32) {
        for histogram in [&mut self.hand, &mut self.anchor, &mut self.background] {
            histogram.relight(gain, &mut self.smooth[0]);
        }
        self.learn();
    }

    /// Keeps the present model of the hand permanently: it counts as much as all later
    /// observations, so that a contour that has drifted cannot replace the hand's colours.
    pub fn anchor(&mut self) {
        self.anchor.clone_from(&self.hand);
    }

    /// Adds the pixel at (x, y), if it lies in the frame, to the hand or to the background.
    pub fn observe(&mut self, frame: &Frame<'_>, x: f64, y: f64, is_hand: bool) {
        self.observe_all(frame, SidedPixel::at(x, y, is_hand).as_slice(), 1.0);
    }

    /// Adds pixels, all of which lie in the frame, with the weight `times`.
    pub(crate) fn observe_all(&mut self, frame: &Frame<'_>, pixels: &[SidedPixel], times: f64) {
        if !self.coloured {
            return self.observe_grey(frame.image(), pixels, times);
        }
        let Some(colours) = frame.colour() else { return };
        let mut counts = [0_u32; 2];
        let weight = times as f32;
        for &SidedPixel { x, y, is_hand } in pixels {
            let side = if is_hand { &mut self.hand } else { &mut self.background };
            let bin = colours.pixel(x as usize, y as usize).map(colour_bin);
            if let Some(bin_weight) = bin.and_then(|bin| side.bins.get_mut(bin)) {
                *bin_weight += weight;
                counts[usize::from(is_hand)] += 1;
            }
        }
        self.background.total += times * f64::from(counts[0]);
        self.hand.total += times * f64::from(counts[1]);
    }

    /// The same for grey levels; their bins are few, so they are counted separately first.
    fn observe_grey(&mut self, image: &GrayView<'_>, pixels: &[SidedPixel], times: f64) {
        let mut counts = [[0_u32; GRAY_BINS]; 2];
        for &SidedPixel { x, y, is_hand } in pixels {
            if let Some(grey) = image.pixel(x as usize, y as usize) {
                counts[usize::from(is_hand)][grey_bin(grey)] += 1;
            }
        }
        for (side, counts) in [&mut self.background, &mut self.hand].into_iter().zip(&counts) {
            for (bin_weight, &count) in side.bins.iter_mut().zip(counts) {
                *bin_weight += (times * f64::from(count)) as f32;
            }
            side.total += times * f64::from(counts.iter().sum::<u32>());
        }
    }

    /// Computes the log-likelihood ratios from the histograms, each smoothed by (1 2 1)/4 along
    /// every axis.
    pub fn learn(&mut self) {
        let totals = [self.hand.total + self.anchor.total, self.background.total];
        if totals.iter().any(|&t| t <= 0.0) {
            self.log_ratios.fill(0);
            self.smooth.iter_mut().for_each(|side| side.fill(0.0));
            return;
        }
        let [hand, background] = &mut self.smooth;
        for ((smooth, new), anchored) in hand.iter_mut().zip(&self.hand.bins).zip(&self.anchor.bins)
        {
            *smooth = new + anchored;
        }
        background.copy_from_slice(&self.background.bins);
        Isa::detect().run(Learning {
            coloured: self.coloured,
            parts: totals.map(|total| total.recip() as f32),
            smooth: &mut self.smooth,
            log_ratios: &mut *self.log_ratios,
        });
    }

    /// The same with the background of another model of the same kind in place of its own.
    pub(crate) fn learn_before(&mut self, other: &Self) {
        self.background.clone_from(&other.background);
        self.learn();
    }

    /// Separation: mean log-likelihood ratio of the hand's observations minus that of the
    /// background's, 0–6.
    #[must_use]
    pub fn separation(&self) -> f64 {
        let mean = |sides: &[&Histogram]| {
            let weighted = sides.iter().flat_map(|h| h.bins.iter().zip(&*self.log_ratios));
            let sum: f64 = weighted.map(|(n, v)| f64::from(*n) * f64::from(*v)).sum();
            let total: f64 = sides.iter().map(|h| h.total).sum();
            if total > 0.0 { sum / total } else { 0.0 }
        };
        let difference = mean(&[&self.hand, &self.anchor]) - mean(&[&self.background]);
        difference / f64::from(LOG_RATIO_UNIT)
    }

    /// Log-likelihood ratio of the pixel nearest to (u, v): positive for the hand, negative for the
    /// background, within ±3, in steps of 1/1024; 0 outside the frame.
    #[must_use]
    pub fn log_ratio(&self, frame: &Frame<'_>, u: f64, v: f64) -> f32 {
        self.bin(frame, u, v).map_or(0.0, |bin| f32::from(self.log_ratios[bin]) / LOG_RATIO_UNIT)
    }

    /// Mean log-likelihood ratio of some places.
    pub(crate) fn mean_log_ratio(
        &self,
        frame: &Frame<'_>,
        places: impl IntoIterator<Item = Point2<f64>>,
    ) -> f64 {
        let (mut sum, mut count) = (0.0, 0.0);
        for place in places {
            sum += f64::from(self.log_ratio(frame, place.x, place.y));
            count += 1.0;
        }
        sum / count
    }

    /// Whether the inside of an edge is like the hand, and its outside, in the direction of the
    /// unit vector `normal`, like the background: an occluder of the hand has edges as well.
    pub(crate) fn matches_edge(
        &self,
        frame: &Frame<'_>,
        edge: Point2<f64>,
        normal: Vector2<f64>,
    ) -> bool {
        let mean = |outward_px: [f64; 3]| {
            self.mean_log_ratio(frame, outward_px.map(|px| edge + normal * px))
        };
        mean(INSIDE_PX.map(|px| -px)) >= INSIDE_LOG_RATIO && mean(OUTSIDE_PX) <= -BEHIND_LOG_RATIO
    }

    /// Whether most of the sampled pixels inside of an edge have levels or colours that were
    /// observed on the hand with more weight than the uniform prior of a bin.
    pub(crate) fn has_shown(
        &self,
        frame: &Frame<'_>,
        edge: Point2<f64>,
        normal: Vector2<f64>,
    ) -> bool {
        let [hand, _] = &self.smooth;
        let uniform =
            PRIOR_WEIGHT * (self.hand.total + self.anchor.total) as f32 / hand.len() as f32;
        let is_known = |px: &&f64| {
            let inside = edge - normal * **px;
            self.bin(frame, inside.x, inside.y).is_some_and(|bin| hand[bin] > uniform)
        };
        2 * INSIDE_PX.iter().filter(is_known).count() > INSIDE_PX.len()
    }

    /// The pixels of `frame` with their log-likelihood ratios.
    pub(crate) fn log_ratio_image<'a>(&'a self, frame: &Frame<'a>) -> LogRatioImage<'a> {
        let image = frame.image();
        let pixels = match (self.coloured, frame.colour()) {
            (false, _) => BinnedPixels::Gray(image.data(), image.stride()),
            (true, Some(colour)) => BinnedPixels::Colour(colour.data(), colour.stride()),
            (true, None) => BinnedPixels::Nobody,
        };
        LogRatioImage { pixels, log_ratios: &self.log_ratios }
    }

    fn bin(&self, frame: &Frame<'_>, u: f64, v: f64) -> Option<usize> {
        let SidedPixel { x, y, .. } = SidedPixel::at(u, v, true)?;
        let (x, y) = (x as usize, y as usize);
        if self.coloured {
            frame.colour()?.pixel(x, y).map(colour_bin)
        } else {
            frame.image().pixel(x, y).map(grey_bin)
        }
    }
}

fn colour_bin(colour: [u8; 3]) -> usize {
    let [a, b, c] = colour.map(|c| usize::from(c) >> 4);
    (a * COLOUR_BINS + b) * COLOUR_BINS + c
}

fn grey_bin(grey: u8) -> usize {
    usize::from(grey) >> 2
}

/// An image's pixels, and the log-likelihood ratios of their bins.
#[derive(Debug, Clone, Copy)]
pub(crate) struct LogRatioImage<'a> {
    pub pixels: BinnedPixels<'a>,
    /// Log-likelihood ratio of every bin.
    pub log_ratios: &'a LogRatio,
}

/// Source of a pixel's bin.
#[derive(Debug, Clone, Copy)]
pub(crate) enum BinnedPixels<'a> {
    /// Grey levels and the bytes from one row to the next: 64 bins.
    Gray(&'a [u8], usize),
    /// Three channels and the bytes from one row to the next: 16 bins each.
    Colour(&'a [u8], usize),
    /// A model of colours and a frame without them: no log-likelihood ratios.
    Nobody,
}

/// Computation of log-likelihood ratios from two histograms.
struct Learning<'a> {
    coloured: bool,
    /// One over the weight of either histogram.
    parts: [f32; 2],
    smooth: &'a mut [Vec<f32>; 2],
    log_ratios: &'a mut [i16],
}

impl Work for Learning<'_> {
    #[inline(always)]
    fn run(self) {
        for bins in &mut *self.smooth {
            if self.coloured {
                smooth_rows::<COLOUR_BINS>(bins);
                for plane in bins.chunks_exact_mut(COLOUR_BINS * COLOUR_BINS) {
                    smooth_across::<COLOUR_BINS>(plane);
                }
                smooth_across::<{ COLOUR_BINS * COLOUR_BINS }>(bins);
            } else {
                smooth_rows::<GRAY_BINS>(bins);
            }
        }
        // The uniform prior limits the ratios of bins with few observations.
        let uniform = PRIOR_WEIGHT / self.smooth[0].len() as f32;
        let [hand, background] = &*self.smooth;
        let [per_hand, per_background] = self.parts;
        for ((stored, hand), background) in self.log_ratios.iter_mut().zip(hand).zip(background) {
            let log_ratio =
                ln(hand * per_hand + uniform) - ln(background * per_background + uniform);
            let steps = LOG_RATIO_UNIT * log_ratio.clamp(-MAX_LOG_RATIO, MAX_LOG_RATIO);
            // Rounded half away from zero, so that the ratio is symmetric in both classes.
            *stored = (steps + 0.5_f32.copysign(steps)) as i32 as i16;
        }
    }
}

/// (1 2 1)/4 along rows of `N` bins; the ends repeat.
#[inline(always)]
fn smooth_rows<const N: usize>(bins: &mut [f32]) {
    for row in bins.as_chunks_mut::<N>().0 {
        let before = *row;
        for i in 1..N - 1 {
            row[i] = 0.25 * (before[i - 1] + before[i + 1]) + 0.5 * before[i];
        }
        row[0] = 0.25 * (before[0] + before[1]) + 0.5 * before[0];
        row[N - 1] = 0.25 * (before[N - 2] + before[N - 1]) + 0.5 * before[N - 1];
    }
}

/// The same from row to row.
#[inline(always)]
fn smooth_across<const N: usize>(bins: &mut [f32]) {
    let rows = bins.as_chunks_mut::<N>().0;
    let mut before = rows[0];
    for i in 0..rows.len() {
        let here = rows[i];
        let after = *rows.get(i + 1).unwrap_or(&here);
        rows[i] = from_fn(|j| 0.25 * (before[j] + after[j]) + 0.5 * here[j]);
        before = here;
    }
}

#[cfg(test)]
mod tests {
    use super::{COLOUR_BINS, GRAY_BINS, HistogramModel, Learning};
    use crate::error::Result;
    use crate::image::frame::Frame;
    use crate::image::gray::GrayView;
    use crate::numeric::simd::Isa;
    use nalgebra::{Point2, Vector2};
    use std::array::from_fn;

    #[test]
    fn levels_of_the_hand_are_tested_inside_of_the_edge() -> Result<()> {
        // The hand from 150 to 165 before a dark table; 158 lies between observed levels, 250
        // belongs to an occluder.
        let learned = [&[150_u8, 151, 152, 153, 161, 162, 163, 164][..], &[40; 8]].concat();
        let frame = Frame::gray(GrayView::new(&learned, learned.len(), 1, learned.len())?);
        let mut levels = HistogramModel::new(false);
        let has_shown = |levels: &HistogramModel, inside: [u8; 3], outside: u8| -> Result<bool> {
            let [two, three, four] = inside;
            let row = [outside, outside, outside, two, three, four, outside];
            let frame = Frame::gray(GrayView::new(&row, row.len(), 1, row.len())?);
            Ok(levels.has_shown(&frame, Point2::new(1.0, 0.0), Vector2::new(-1.0, 0.0)))
        };
        levels.learn();
        assert!(!has_shown(&levels, [152; 3], 40)?, "nothing was seen");
        for x in 0..learned.len() {
            levels.observe(&frame, x as f64, 0.0, x < 8);
        }
        levels.learn();
        assert!(has_shown(&levels, [152; 3], 40)? && has_shown(&levels, [152; 3], 250)?);
        assert!(has_shown(&levels, [158; 3], 40)?, "levels next to those seen");
        assert!(!has_shown(&levels, [250; 3], 40)? && !has_shown(&levels, [40; 3], 152)?);
        assert!(
            has_shown(&levels, [250, 152, 162], 40)? && !has_shown(&levels, [250, 250, 162], 40)?
        );
        levels.fade(1e-6);
        levels.learn();
        assert!(has_shown(&levels, [152; 3], 40)?, "how much was seen does not matter");
        levels.fade(0.0);
        levels.learn();
        assert!(!has_shown(&levels, [152; 3], 40)?, "nothing is left");
        Ok(())
    }

    #[test]
    fn every_instruction_set_learns_the_same_log_ratios() {
        for (coloured, bins) in [(false, GRAY_BINS), (true, COLOUR_BINS.pow(3))] {
            let log_ratios = |isa: Isa| {
                // Mostly empty, as histograms are.
                let bin =
                    |i: usize, side: usize| ((i * (7 + 4 * side) % 31) as f32 - 25.0).max(0.0);
                let mut smooth = from_fn(|side| (0..bins).map(|i| bin(i, side)).collect());
                let mut log_ratios = vec![0; bins];
                let (parts, smooth) = ([0.01, 0.02], &mut smooth);
                isa.run(Learning { coloured, parts, smooth, log_ratios: &mut log_ratios });
                log_ratios
            };
            let reference = log_ratios(Isa::Scalar);
            assert!(reference.iter().any(|&v| v > 500) && reference.iter().any(|&v| v < -500));
            for isa in Isa::available() {
                assert_eq!(log_ratios(isa), reference, "{isa}");
            }
        }
    }
}
