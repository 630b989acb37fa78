//! What a visit of a pixel teaches, side by side for many pixels of a row.

#![expect(
    clippy::inline_always,
    reason = "what is inlined into a function with wider instructions is compiled for them"
)]

use crate::simd::Work;

/// The constants of a frame's visits.
#[derive(Debug, Clone, Copy)]
pub(super) struct Learning {
    /// Gain and offset of the frame's light.
    pub gain: f32,
    pub offset_grey: f32,
    /// Least part that a visit takes over.
    pub rate: f32,
    /// Least variance \[grey levels²\].
    pub noise2: f32,
    /// A level that is farther off than this many standard deviations, squared, has changed.
    pub sigmas2: f32,
    /// Most visits that are counted.
    pub most_seen: u8,
}

/// What a pixel shows at a visit.
#[derive(Debug, Clone, Copy)]
pub(super) struct Visit {
    /// How far its level has changed, in the light of the background \[grey levels\].
    change: f32,
    /// Whether it is the first of a level.
    starts: bool,
    /// Whether it is close to the level.
    agrees: bool,
    /// The part of the change that is taken over if it is the first or agrees.
    part: f32,
}

impl Visit {
    /// The part of a change that the visit takes over, if any.
    pub fn part(&self) -> Option<f32> {
        (self.starts || self.agrees).then_some(self.part)
    }
}

impl Learning {
    /// A level in the light of the background.
    #[inline(always)]
    pub fn in_its_light(&self, now: u8) -> f32 {
        (f32::from(now) - self.offset_grey) / self.gain
    }

    #[inline(always)]
    pub fn visit(&self, level: f32, variance: f32, seen: u8, now: u8) -> Visit {
        let change = self.in_its_light(now) - level;
        let starts = seen == 0;
        let agrees = change * change <= self.sigmas2 * variance.max(self.noise2);
        // The first level of a pixel, or another one that has outlasted it.
        let part = if starts { 1.0 } else { self.rate.max(1.0 / (1.0 + f32::from(seen))) };
        Visit { change, starts, agrees, part }
    }
}

/// One visit of every pixel of a part of a row.
pub(super) struct Visits<'a> {
    pub learning: Learning,
    pub level: &'a mut [f32],
    pub variance: &'a mut [f32],
    pub seen: &'a mut [u8],
    pub now: &'a [u8],
}

impl Work for Visits<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { learning, level, variance, seen, now } = self;
        let Learning { rate, noise2, most_seen, .. } = learning;
        for (((level, variance), seen), now) in level.iter_mut().zip(variance).zip(seen).zip(now) {
            // Without branches: what does not count is worked out as well.
            let Visit { change, starts, agrees, part } =
                learning.visit(*level, *variance, *seen, *now);
            let learns = starts | agrees;
            let spread = *variance + rate * (change * change - *variance);
            let known = if starts { noise2 } else { spread };
            *variance = if learns { known } else { *variance };
            *level = if learns { *level + part * change } else { *level };
            let more = seen.saturating_add(1).min(most_seen);
            *seen = if learns { more } else { seen.saturating_sub(1) };
        }
    }
}
