//! What the hand looks like, and what does not: two histograms of colour (or of grey levels) and
//! the logarithm of their ratio.
//!
//! An edge alone does not say whose edge it is. A pixel whose colour is frequent on the hand and
//! rare behind it speaks for the hand with log(p_hand / p_background); the contour runs where
//! these votes change from one side to the other. The histograms are learned from either side of
//! contours that were accepted, and forget slowly, so that they follow the light.
//!
//! Source: Ronfard 1994 and Bibby & Reid 2008 for region statistics along a contour.

use crate::frame::Frame;

/// Bins per colour channel, and bins of a grey histogram: 16 and 4 grey levels wide.
const COLOUR_BINS: usize = 16;
const GRAY_BINS: usize = 64;
/// A vote counts for no more than this: a colour never seen on one side proves little.
const MAX_VOTE: f32 = 3.0;
/// Every bin starts with this part of an even distribution.
const PRIOR_WEIGHT: f32 = 0.5;

/// Learned colours of the hand and of what is behind it.
#[derive(Debug, Clone, PartialEq)]
pub struct Appearance {
    bins_per_axis: usize,
    axes: usize,
    hand: Vec<f32>,
    /// The hand as it was when it was acquired; see [`Appearance::anchor`].
    anchor: Vec<f32>,
    background: Vec<f32>,
    votes: Vec<f32>,
    scratch: Vec<f32>,
}

impl Appearance {
    /// An appearance that has seen nothing: every pixel votes for neither side.
    #[must_use]
    pub fn new(coloured: bool) -> Self {
        let (bins_per_axis, axes) = if coloured { (COLOUR_BINS, 3) } else { (GRAY_BINS, 1) };
        let bins = bins_per_axis.pow(axes as u32);
        let zeros = || vec![0.0; bins];
        Self {
            bins_per_axis,
            axes,
            hand: zeros(),
            anchor: zeros(),
            background: zeros(),
            votes: zeros(),
            scratch: zeros(),
        }
    }

    /// Whether it was made for colours.
    #[must_use]
    pub fn is_coloured(&self) -> bool {
        self.axes == 3
    }

    /// Lets what was learned fade to a part `keep` of its weight, 0–1.
    pub fn fade(&mut self, keep: f32) {
        for bin in self.hand.iter_mut().chain(&mut self.background) {
            *bin *= keep;
        }
    }

    /// Keeps the hand as it is known now for good: it counts as much as all that is learned later,
    /// so that a contour that has drifted cannot talk the hand's colours away.
    pub fn anchor(&mut self) {
        self.anchor.copy_from_slice(&self.hand);
    }

    /// Counts the pixel at (x, y), if it lies in the frame, as the hand or as what is behind it.
    pub fn observe(&mut self, frame: &Frame<'_>, x: f64, y: f64, is_hand: bool) {
        if let Some(bin) = self.bin(frame, x, y) {
            let side = if is_hand { &mut self.hand } else { &mut self.background };
            side[bin] += 1.0;
        }
    }

    /// Works the votes out anew from the histograms, each smoothed by (1 2 1)/4 along every axis.
    pub fn learn(&mut self) {
        let totals = [
            self.hand.iter().chain(&self.anchor).sum::<f32>(),
            self.background.iter().sum::<f32>(),
        ];
        if totals.iter().any(|&t| t <= 0.0) {
            self.votes.fill(0.0);
            return;
        }
        // How much a bin would hold of an even distribution keeps empty bins from shouting.
        let even = PRIOR_WEIGHT / self.votes.len() as f32;
        self.smooth(true);
        for (vote, hand) in self.votes.iter_mut().zip(&self.scratch) {
            *vote = (hand / totals[0] + even).ln();
        }
        self.smooth(false);
        for (vote, background) in self.votes.iter_mut().zip(&self.scratch) {
            *vote = (*vote - (background / totals[1] + even).ln()).clamp(-MAX_VOTE, MAX_VOTE);
        }
    }

    /// The vote of the pixel nearest to (u, v): positive for the hand, negative for what is behind
    /// it, in ±3; zero outside the frame.
    #[must_use]
    pub fn vote(&self, frame: &Frame<'_>, u: f64, v: f64) -> f32 {
        self.bin(frame, u, v).map_or(0.0, |bin| self.votes[bin])
    }

    fn bin(&self, frame: &Frame<'_>, u: f64, v: f64) -> Option<usize> {
        if !(u > -0.5 && v > -0.5) {
            return None;
        }
        let (x, y) = ((u + 0.5) as usize, (v + 0.5) as usize);
        if self.is_coloured() {
            let [a, b, c] = frame.colour()?.pixel(x, y)?.map(|c| usize::from(c) >> 4);
            Some((a * COLOUR_BINS + b) * COLOUR_BINS + c)
        } else {
            Some(usize::from(frame.image().pixel(x, y)?) >> 2)
        }
    }

    /// Puts one side's histogram, smoothed, into `scratch`.
    fn smooth(&mut self, hand: bool) {
        self.scratch.copy_from_slice(if hand { &self.hand } else { &self.background });
        if hand {
            for (bin, anchor) in self.scratch.iter_mut().zip(&self.anchor) {
                *bin += anchor;
            }
        }
        let (n, total) = (self.bins_per_axis, self.scratch.len());
        for axis in 0..self.axes {
            let stride = n.pow(axis as u32);
            for start in (0..total).filter(|i| (i / stride) % n == 0) {
                let mut before = self.scratch[start];
                for k in 0..n {
                    let i = start + k * stride;
                    let here = self.scratch[i];
                    let after = if k + 1 < n { self.scratch[i + stride] } else { here };
                    self.scratch[i] = 0.25 * (before + after) + 0.5 * here;
                    before = here;
                }
            }
        }
    }
}
