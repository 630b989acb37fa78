//! Options of the background model, and regions excluded from it.

use crate::{Error, Result};
use nalgebra::Point2;
use nalgebra::Vector2;
use std::ops::Range;

/// Options of the learning of a background and of the detection of changes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BackgroundOptions {
    /// Number of observations of a level from which its pixel is known, 1–200. While the background
    /// is new, every frame observes every pixel.
    pub learn_frames: usize,
    /// Learning rate of the running mean and variance for an observation that agrees, 0.001–1.
    pub rate: f64,
    /// Number of frames after which a new object becomes background, 4–1000.
    pub absorb_frames: usize,
    /// Least standard deviation of a pixel about its level \[grey levels\], 0.1–64.
    pub noise_grey: f64,
    /// Difference from its level, in standard deviations, beyond which a pixel has changed, 1–20.
    pub changed_sigmas: f64,
    /// Ratio of brightness in the deepest shadow, 0–1; 1 if there are no shadows.
    pub shadow_light: f64,
    /// Part of the pixels that would show a motion of the camera above which the background is
    /// discarded, if they have changed, 0–1.
    pub void_share: f64,
}

impl Default for BackgroundOptions {
    fn default() -> Self {
        Self {
            learn_frames: 8,
            rate: 0.1,
            absorb_frames: 120,
            noise_grey: 2.0,
            changed_sigmas: 4.0,
            shadow_light: 0.45,
            void_share: 0.5,
        }
    }
}

impl BackgroundOptions {
    pub(super) fn check(&self) -> Result<()> {
        let Self { learn_frames, rate, absorb_frames, noise_grey, .. } = *self;
        let Self { changed_sigmas, shadow_light, void_share, .. } = *self;
        Error::within("frames to learn a background", learn_frames as f64, "1 to 200", |n| {
            (1.0..=200.0).contains(&n)
        })?;
        Error::within("background rate", rate, "0.001 to 1", |r| (0.001..=1.0).contains(&r))?;
        Error::within("frames to absorb a change", absorb_frames as f64, "4 to 1000", |n| {
            (4.0..=1000.0).contains(&n)
        })?;
        Error::within("background noise [grey levels]", noise_grey, "0.1 to 64", |n| {
            (0.1..=64.0).contains(&n)
        })?;
        Error::within("sigmas of a change", changed_sigmas, "1 to 20", |n| {
            (1.0..=20.0).contains(&n)
        })?;
        for part in [shadow_light, void_share] {
            Error::within("shadow light and void share", part, "0 to 1", |p| {
                (0.0..=1.0).contains(&p)
            })?;
        }
        Ok(())
    }
}

/// A region that must not become background: all points within `radius_px` of the segment from
/// `from` to `to`, such as a hand behind its finger.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KeepOut {
    /// One end of the segment \[px\].
    pub from: Point2<f64>,
    /// The other end \[px\].
    pub to: Point2<f64>,
    /// Radius \[px\], positive.
    pub radius_px: f64,
}

impl KeepOut {
    pub(super) fn check(&self) -> Result<()> {
        let Self { from, to, radius_px } = self;
        Error::finite("keep-out segment [px]", from.x + from.y + to.x + to.y)?;
        Error::within("keep-out radius [px]", *radius_px, "positive", |r| r > 0.0)?;
        Ok(())
    }

    /// The columns of a row that lie within it: it is convex, so they are one range.
    pub(super) fn columns(&self, y: f64, width: usize) -> Range<usize> {
        let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
        let mut include = |x: f64| {
            low = low.min(x);
            high = high.max(x);
        };
        for end in [self.from, self.to] {
            let half = (self.radius_px * self.radius_px - (y - end.y) * (y - end.y)).sqrt();
            if half >= 0.0 {
                include(end.x - half);
                include(end.x + half);
            }
        }
        let along = self.to - self.from;
        if let Some(e) = along.try_normalize(0.0) {
            let n = Vector2::new(-e.y, e.x) * self.radius_px;
            let corners = [self.from + n, self.to + n, self.to - n, self.from - n];
            for (a, b) in corners.iter().zip(corners.iter().cycle().skip(1)) {
                if (a.y - y) * (b.y - y) < 0.0 {
                    include(a.x + (b.x - a.x) * (y - a.y) / (b.y - a.y));
                }
            }
        }
        if low > high {
            return 0..0;
        }
        let clip = |x: f64| x.clamp(0.0, width as f64) as usize;
        clip(low.ceil())..clip(high.floor() + 1.0)
    }
}

/// Light of a frame relative to that in which the background was learned: a pixel of level B there
/// has the level gain · B + offset in the frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Light {
    /// Gain, positive.
    pub gain: f64,
    /// Offset \[grey levels\].
    pub offset_grey: f64,
}

impl Light {
    pub(super) const UNCHANGED: Self = Self { gain: 1.0, offset_grey: 0.0 };
}
