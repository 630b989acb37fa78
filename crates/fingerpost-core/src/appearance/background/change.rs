//! Difference of pixels from the background, one at a time or in parallel for a row of cells.

#![expect(
    clippy::inline_always,
    reason = "what is inlined into a function with wider instructions is compiled for them"
)]

use super::options::{BackgroundOptions, Light};
use super::visit::CELL_PX;
use crate::numeric::simd::{Work, each};

/// Largest change of chromaticity (a channel as a part of the sum of the channels) in a shadow,
/// apart from noise.
const SHADOW_HUE: f32 = 0.025;
/// Noise of a channel as a multiple of that of the grey level.
const COLOUR_NOISE: f32 = 1.5;
/// Least ratio of brightness of a shadow without colours, where a darker one might be a hand.
const GREY_SHADOW_LIGHT: f32 = 0.8;
/// Factor on the foreground probability of a pixel that a shadow would explain: a hand in a dark
/// glove resembles one.
const SHADOW_FOREGROUND: f32 = 0.6;
/// Range over which the foreground probability rises from 0 to 1, in parts of
/// [`BackgroundOptions::changed_sigmas`].
const RAMP: (f32, f32) = (0.6, 1.4);

/// Difference of a pixel from its background.
pub(super) struct Change {
    /// In standard deviations.
    pub sigmas: f32,
    /// Whether a shadow would explain it.
    is_shadow: bool,
}

/// The constants of a frame's comparison with the background.
#[derive(Debug, Clone, Copy)]
pub(super) struct Comparison {
    gain: f32,
    offset_grey: f32,
    light_sigma: f32,
    noise_grey: f32,
    changed_sigmas: f32,
    shadow_light: f32,
}

impl Comparison {
    /// Comparison in a light, whose fit has this standard deviation beyond the noise.
    pub(super) fn new(options: &BackgroundOptions, light: Light, light_sigma: f32) -> Self {
        Self {
            gain: light.gain as f32,
            offset_grey: light.offset_grey as f32,
            light_sigma,
            noise_grey: options.noise_grey as f32,
            changed_sigmas: options.changed_sigmas as f32,
            shadow_light: options.shadow_light as f32,
        }
    }

    /// Difference of a pixel of level `now` from a known level with a variance; `colours` are those
    /// of the background and of the frame.
    #[inline(always)]
    pub(super) fn change(
        &self,
        (level, variance): (f32, f32),
        now: f32,
        colours: Option<([f32; 3], [f32; 3])>,
    ) -> Change {
        let Self { gain, offset_grey: offset, noise_grey: noise, .. } = *self;
        let grey = gain * level + offset;
        let sigma = variance.max(noise * noise).sqrt() * gain.max(1.0) + self.light_sigma;
        let mut sigmas = (now - grey).abs() / sigma;
        let mut light = now / grey.max(1.0);
        let mut deepest = self.shadow_light.max(GREY_SHADOW_LIGHT);
        let mut hue = 0.0;
        if let Some((known, now)) = colours {
            let expected: [f32; 3] = each(|c| gain * known[c] + offset);
            let sum = |[a, b, c]: [f32; 3]| (a + b + c).max(1.0);
            let (sum_expected, sum_now) = (sum(expected), sum(now));
            for (a, b) in expected.into_iter().zip(now) {
                sigmas = sigmas.max((b - a).abs() / (COLOUR_NOISE * sigma));
                hue = f32::max(hue, (a / sum_expected - b / sum_now).abs());
            }
            hue -= COLOUR_NOISE * sigma / sum_now;
            light = sum_now / sum_expected;
            deepest = self.shadow_light;
        }
        let is_shadow = hue < SHADOW_HUE && light >= deepest && light < 1.0;
        Change { sigmas, is_shadow }
    }

    /// Foreground probability for the difference of a pixel, 0–1.
    #[inline(always)]
    pub(super) fn likelihood(&self, change: &Change) -> f32 {
        let part = change.sigmas / self.changed_sigmas;
        let likely = ((part - RAMP.0) / (RAMP.1 - RAMP.0)).clamp(0.0, 1.0);
        if change.is_shadow { SHADOW_FOREGROUND * likely } else { likely }
    }
}

/// Foreground probabilities of the cells of a row, 0–255; 0 where the background is unknown. The
/// slices begin with the row's first pixel or cell.
pub(super) struct ForegroundRow<'a> {
    pub comparison: Comparison,
    /// Number of observations from which a pixel is known.
    pub known_from: u8,
    pub level: &'a [f32],
    pub variance: &'a [f32],
    pub seen: &'a [u8],
    pub now: &'a [u8],
    /// Colours of the cells, and the channels of the frame's pixels; both empty without colours.
    pub colour: &'a [[f32; 3]],
    pub now_in_colour: &'a [u8],
    pub cells: &'a mut [u8],
}

/// Cells compared at once.
const LANES: usize = 32;

impl Work for ForegroundRow<'_> {
    #[inline(always)]
    fn run(self) {
        let has_colours = !self.colour.is_empty() && !self.now_in_colour.is_empty();
        let Self { comparison, level, variance, seen, now, colour, now_in_colour, .. } = self;
        let cells = self.cells.chunks_mut(LANES).enumerate();
        for (cells, first) in cells.map(|(k, cells)| (cells, k * LANES)) {
            // The last cells repeat the row's last one.
            let last = first + cells.len() - 1;
            let cell = |j: usize| (first + j).min(last);
            let pixel = |j: usize| CELL_PX * cell(j);
            let level: [f32; LANES] = each(|j| level[pixel(j)]);
            let variance: [f32; LANES] = each(|j| variance[pixel(j)]);
            let seen: [u8; LANES] = each(|j| seen[pixel(j)]);
            let now: [f32; LANES] = each(|j| f32::from(now[pixel(j)]));
            let mut likely = [0.0; LANES];
            if has_colours {
                let mut known = [[0.0; LANES]; 3];
                let mut shown = [[0.0; LANES]; 3];
                for j in 0..LANES {
                    let levels = &now_in_colour[3 * pixel(j)..][..3];
                    for c in 0..3 {
                        known[c][j] = colour[cell(j)][c];
                        shown[c][j] = f32::from(levels[c]);
                    }
                }
                for (j, likely) in likely.iter_mut().enumerate() {
                    let colours = (each(|c| known[c][j]), each(|c| shown[c][j]));
                    let change = comparison.change((level[j], variance[j]), now[j], Some(colours));
                    *likely = comparison.likelihood(&change);
                }
            } else {
                for (j, likely) in likely.iter_mut().enumerate() {
                    let change = comparison.change((level[j], variance[j]), now[j], None);
                    *likely = comparison.likelihood(&change);
                }
            }
            for ((cell, likely), seen) in cells.iter_mut().zip(likely).zip(seen) {
                let is_known = u8::from(seen >= self.known_from);
                *cell = is_known * (255.0 * likely) as u8;
            }
        }
    }
}
