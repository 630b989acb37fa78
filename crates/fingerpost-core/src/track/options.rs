//! Options of a tracker, their defaults and ranges.

use crate::measure::edge::{MAX_HALF_LENGTH_PX, Polarity};
use crate::measure::edge_search::SearchOptions;
use crate::solve::dynamics::{Component, Course, Domain, Gate, acceleration_density};
use crate::solve::fit::FitOptions;
use crate::{Error, Result};

/// The shortest half-length of a search line \[px\].
pub(super) const MIN_HALF_LENGTH_PX: f64 = 5.0;

/// Which model of the hand is tracked.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Model {
    /// The band template: finger and thumb with widths of their own
    /// ([`Ribbon`](crate::geometry::shape_space::Ribbon)).
    Ribbon,
    /// The planar template of 1994: affine until the hand is acquired, then rigid with one shear.
    Paper,
}

/// When a fit counts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AcceptOptions {
    /// Least part of the contour's visible samples whose edges agree with the fit, 0–1.
    pub min_inliers: f64,
    /// Largest root mean square of their residual offsets \[px\], positive; a fifth of the finger's
    /// half-width if that is more.
    pub max_residual_px: f64,
}

/// The template's patience while it waits for the hand.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AcquireOptions {
    /// Half-length of the search lines \[px\], 1–128.
    pub half_length_px: f64,
    /// When a fit counts.
    pub accept: AcceptOptions,
    /// Accepted frames in a row until the hand is acquired, at least 1.
    pub settle_frames: usize,
    /// Largest change of the finger's half-width from frame to frame, in parts of it, positive.
    pub settle_change: f64,
    /// The hand is between 1 / this and this times as wide as the waiting pistol, above 1.
    pub max_scale: f64,
}

/// Half the width of the largest finger for which lengths in pixels are meant as they are while it is
/// waited for \[px\]; those of a larger one grow with it.
const LARGEST_HALF_WIDTH_PX: f64 = 10.0;

impl AcquireOptions {
    /// How far a waiting finger of this half-width looks for edges \[px\].
    pub(super) fn reach_px(&self, half_width_px: f64) -> f64 {
        let large = (half_width_px / LARGEST_HALF_WIDTH_PX).max(1.0);
        (large * self.half_length_px).min(MAX_HALF_LENGTH_PX as f64)
    }
}

/// How the hand is followed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackOptions {
    /// Longest half-length of the search lines of a hand that moves as expected \[px\], 1–128. A
    /// hand that is not found there is sought this much further, and for every frame without it
    /// once more.
    pub half_length_px: f64,
    /// When a fit counts.
    pub accept: AcceptOptions,
    /// Frames in a row without an accepted fit until the hand is lost, at least 1.
    pub lose_after_frames: usize,
    /// How fast the known appearance follows what is seen: part taken over per accepted frame,
    /// 0–1.
    pub appearance_rate: f64,
    /// How the hand moves.
    pub dynamics: DynamicsOptions,
}

/// How a hand moves in the image between frames: a Kalman filter with constant velocity predicts
/// it, see [`Dynamics`](crate::solve::dynamics::Dynamics).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DynamicsOptions {
    /// Typical (root mean square) acceleration along u and along v \[px/s²\], 1–1e5.
    pub acceleration_px_s2: f64,
    /// The same of the finger's angle \[rad/s²\], 0.01–1000.
    pub acceleration_rad_s2: f64,
    /// How long an acceleration keeps its direction \[s\], 0.001–1.
    pub acceleration_lasts_s: f64,
    /// Typical speed along u and along v of a hand that is first seen \[px/s\], 0–1e5.
    pub first_speed_px_s: f64,
    /// The same of the finger's angle \[rad/s\], 0–100.
    pub first_speed_rad_s: f64,
    /// Probability with which the search along a normal reaches the hand's edge if the hand moves
    /// like this, 0.5–0.999999.
    pub confidence: f64,
    /// A hand unseen for longer than this is not followed but found again \[s\], 0.001–60.
    pub longest_gap_s: f64,
}

impl Default for DynamicsOptions {
    fn default() -> Self {
        Self {
            acceleration_px_s2: 4000.0,
            acceleration_rad_s2: 25.0,
            acceleration_lasts_s: 0.03,
            first_speed_px_s: 300.0,
            first_speed_rad_s: 2.0,
            confidence: 0.95,
            longest_gap_s: 0.25,
        }
    }
}

impl DynamicsOptions {
    /// Of (c_u, c_v, θ) of a hand so many times as large as usual.
    pub(super) fn components(&self, large: f64) -> [Component; 3] {
        let component = |acceleration, first_sigma, domain| Component {
            course: Course::Velocity {
                density: acceleration_density(acceleration, self.acceleration_lasts_s),
                first_sigma,
            },
            domain,
        };
        let place =
            component(large * self.acceleration_px_s2, large * self.first_speed_px_s, Domain::Line);
        let angle = component(self.acceleration_rad_s2, self.first_speed_rad_s, Domain::Circle);
        [place, place, angle]
    }

    fn check(&self) -> Result<()> {
        let Self { acceleration_px_s2, acceleration_rad_s2, acceleration_lasts_s, .. } = *self;
        let Self { first_speed_px_s, first_speed_rad_s, confidence, longest_gap_s, .. } = *self;
        for (what, value, right, range) in [
            ("acceleration [px/s²]", acceleration_px_s2, "1 to 1e5", 1.0..=1e5),
            ("acceleration [rad/s²]", acceleration_rad_s2, "0.01 to 1000", 0.01..=1e3),
            ("acceleration lasts [s]", acceleration_lasts_s, "0.001 to 1", 0.001..=1.0),
            ("first speed [px/s]", first_speed_px_s, "0 to 1e5", 0.0..=1e5),
            ("first speed [rad/s]", first_speed_rad_s, "0 to 100", 0.0..=100.0),
            ("confidence of the gate", confidence, "0.5 to 0.999999", 0.5..=0.999_999),
            ("longest gap [s]", longest_gap_s, "0.001 to 60", 0.001..=60.0),
        ] {
            Error::within(what, value, right, |v| range.contains(&v))?;
        }
        Ok(())
    }
}

/// Options of a [`ContourTracker`](super::ContourTracker), with their defaults. Lengths and speeds of the
/// band model are in pixels of the picture in which the hand is followed: of the frame, or where its
/// finger is 24 px across or more, of one that is smaller by a whole factor.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackerOptions {
    /// What is tracked.
    pub model: Model,
    /// Samples along the contour, 8–2000.
    pub samples: usize,
    /// Searches along the normals per shape space and frame at most, 1–100.
    pub max_iterations: usize,
    /// What an edge is.
    pub search: SearchOptions,
    /// Which side of an edge is the hand.
    pub polarity: Polarity,
    /// How offsets become a step.
    pub fit: FitOptions,
    /// Neighbouring edge measurements share pixels: the covariance of the fit is multiplied by
    /// this, at least 1.
    pub correlation: f64,
    /// Whether the band model's finger line is refined by the flanks alone
    /// ([`Refiner`](crate::axis::Refiner)) and told with those of the frames before; the paper's
    /// never is.
    pub refine: bool,
    /// Until the hand is acquired.
    pub acquire: AcquireOptions,
    /// From then on.
    pub track: TrackOptions,
}

impl Default for TrackerOptions {
    fn default() -> Self {
        Self {
            model: Model::Ribbon,
            samples: 100,
            max_iterations: 12,
            search: SearchOptions::default(),
            polarity: Polarity::Unknown,
            fit: FitOptions::default(),
            correlation: 1.5,
            refine: true,
            acquire: AcquireOptions {
                half_length_px: 20.0,
                accept: AcceptOptions { min_inliers: 0.65, max_residual_px: 1.5 },
                settle_frames: 2,
                settle_change: 0.1,
                max_scale: 2.0,
            },
            track: TrackOptions {
                half_length_px: 30.0,
                accept: AcceptOptions { min_inliers: 0.5, max_residual_px: 2.0 },
                lose_after_frames: 5,
                appearance_rate: 0.2,
                dynamics: DynamicsOptions::default(),
            },
        }
    }
}

impl TrackerOptions {
    /// How far the edges of a tracked hand so many times as large as usual are looked for.
    pub(super) fn gate(&self, large: f64) -> Result<Gate> {
        let TrackOptions { half_length_px, dynamics, .. } = &self.track;
        let longest_px = (large * half_length_px).min(MAX_HALF_LENGTH_PX as f64);
        Gate::new(dynamics.confidence, MIN_HALF_LENGTH_PX.min(longest_px), longest_px)
    }

    /// Whether every option is finite and in its range; search and fit check their own.
    pub(super) fn check(&self) -> Result<()> {
        let Self { samples, max_iterations, correlation, acquire, track, .. } = self;
        Error::within("contour samples", *samples as f64, "8 to 2000", |n| {
            (8.0..=2000.0).contains(&n)
        })?;
        Error::within("most iterations", *max_iterations as f64, "1 to 100", |n| {
            (1.0..=100.0).contains(&n)
        })?;
        Error::within("correlation of neighbours", *correlation, "at least 1", |c| c >= 1.0)?;
        for half in [acquire.half_length_px, track.half_length_px] {
            Error::within("search half-length [px]", half, "1 to 128", |l| {
                (1.0..=MAX_HALF_LENGTH_PX as f64).contains(&l)
            })?;
        }
        for accept in [&acquire.accept, &track.accept] {
            Error::within("least inliers", accept.min_inliers, "0 to 1", |p| {
                (0.0..=1.0).contains(&p)
            })?;
            Error::within("largest residual [px]", accept.max_residual_px, "positive", |r| {
                r > 0.0
            })?;
        }
        Error::within("settle change", acquire.settle_change, "positive", |c| c > 0.0)?;
        Error::within("largest scale", acquire.max_scale, "above 1", |s| s > 1.0)?;
        for frames in [acquire.settle_frames, track.lose_after_frames] {
            Error::within("frames in a row", frames as f64, "at least 1", |n| n >= 1.0)?;
        }
        Error::within("appearance rate", track.appearance_rate, "0 to 1", |r| {
            (0.0..=1.0).contains(&r)
        })?;
        track.dynamics.check()
    }
}
