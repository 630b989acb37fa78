//! Update of the background by an observation of its pixels, in parallel for many pixels of a row.

#![expect(
    clippy::inline_always,
    reason = "what is inlined into a function with wider instructions is compiled for them"
)]

use crate::numeric::simd::Work;
/// Pixels from one cell of the foreground map to the next.
pub const CELL_PX: usize = 2;

/// The constants of a frame's update.
#[derive(Debug, Clone, Copy)]
pub(super) struct BackgroundLearning {
    /// One over the gain of the frame's light, and its offset.
    pub per_gain: f32,
    pub offset_grey: f32,
    /// Least learning rate.
    pub rate: f32,
    /// Least variance \[grey levels²\].
    pub noise2: f32,
    /// Squared number of standard deviations beyond which a level has changed.
    pub sigmas2: f32,
    /// Upper limit of the count of observations.
    pub most_seen: u8,
}

impl BackgroundLearning {
    /// A level in the light of the background.
    #[inline(always)]
    fn in_its_light(&self, now: u8) -> f32 {
        (f32::from(now) - self.offset_grey) * self.per_gain
    }
}

/// One observation of every pixel of a part of a row, and of its cells of colour.
pub(super) struct Visits<'a> {
    pub learning: BackgroundLearning,
    pub level: &'a mut [f32],
    pub variance: &'a mut [f32],
    pub seen: &'a mut [u8],
    pub now: &'a [u8],
    /// The first pixel that begins a cell; that cell and the following ones; and the channels of
    /// the pixels from there on. Empty in a row without colours.
    pub first: usize,
    pub colour: &'a mut [[f32; 3]],
    pub now_in_colour: &'a [u8],
}

/// Pixels processed at once: whole cells.
const AT_ONCE: usize = 64;

impl Work for Visits<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { learning, level, variance, seen, now, first, colour, now_in_colour } = self;
        let BackgroundLearning { rate, noise2, sigmas2, most_seen, .. } = learning;
        let mut cells = colour.iter_mut().zip(now_in_colour.chunks(3 * CELL_PX));
        let levels = level.chunks_mut(AT_ONCE).zip(variance.chunks_mut(AT_ONCE));
        let observations = seen.chunks_mut(AT_ONCE).zip(now.chunks(AT_ONCE));
        for ((level, variance), (seen, now)) in levels.zip(observations) {
            // Learning rate of every pixel: 0 if it disagrees.
            let mut pixel_rates = [0.0; AT_ONCE];
            let pixels = level.iter_mut().zip(variance).zip(seen).zip(now).zip(&mut pixel_rates);
            for ((((level, variance), seen), now), stored_rate) in pixels {
                // Without branches, by factors that are 0 or 1: both alternatives are computed.
                let change = learning.in_its_light(*now) - *level;
                let known = if *variance > noise2 { *variance } else { noise2 };
                let starts = u8::from(*seen == 0);
                let learns = starts | u8::from(change * change <= sigmas2 * known);
                let (start_factor, learn_factor) = (f32::from(starts), f32::from(learns));
                // Rate 1 at the first level of a pixel, or at the level that replaces it.
                let mean = 1.0 / (1.0 + f32::from(*seen));
                let pixel_rate = learn_factor * if mean > rate { mean } else { rate };
                *stored_rate = pixel_rate;
                *level += pixel_rate * change;
                let spread = *variance + rate * (change * change - *variance);
                *variance += learn_factor * (spread + start_factor * (noise2 - spread) - *variance);
                *seen = seen.saturating_add(learns).saturating_sub(1 - learns).min(most_seen);
            }
            // A cell's colour is that of its first pixel.
            for (pixel_rate, (known, now)) in
                pixel_rates.iter().skip(first).step_by(CELL_PX).zip(&mut cells)
            {
                for (known, &now) in known.iter_mut().zip(now) {
                    *known += pixel_rate * (learning.in_its_light(now) - *known);
                }
            }
        }
    }
}
