//! Options of a tracker, with defaults and ranges.

use crate::measure::edge::{MAX_HALF_LENGTH_PX, Polarity};
use crate::measure::edge_search::SearchOptions;
use crate::solve::dynamics::{Component, Course, Domain, Gate, acceleration_density};
use crate::solve::fit::FitOptions;
use crate::{Error, Result};

/// Least half-length of a search line \[px\].
pub(super) const MIN_HALF_LENGTH_PX: f64 = 5.0;

/// Model of the hand.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Model {
    /// The band template: finger and thumb with widths of their own.
    Ribbon,
    /// The planar template of 1994: affine during acquisition, then rigid with one shear.
    Paper,
}

/// Conditions for accepting a fit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AcceptOptions {
    /// Least fraction of the contour's visible samples whose edges agree with the fit, 0–1.
    pub min_inliers: f64,
    /// Largest root mean square of their residual offsets \[px\], positive; for large fingers a
    /// fifth of the half-width, if that is more.
    pub max_residual_px: f64,
}

/// Options of acquisition.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AcquireOptions {
    /// Half-length of the search lines \[px\], 1–128.
    pub half_length_px: f64,
    /// Conditions for accepting a fit.
    pub accept: AcceptOptions,
    /// Accepted frames in a row until the hand is acquired, at least 1.
    pub settle_frames: usize,
    /// Largest relative change of the finger's half-width from frame to frame, positive.
    pub settle_change: f64,
    /// Largest ratio of the hand's width to the initial template's, or its inverse, above 1.
    pub max_scale: f64,
}

/// Largest half-width of an initial template for which lengths in pixels apply unscaled \[px\]; for
/// a larger one they grow in proportion.
const UNSCALED_INITIAL_HALF_WIDTH_PX: f64 = 10.0;

impl AcquireOptions {
    /// Half-length of the edge search for an initial template of this half-width \[px\].
    pub(super) fn reach_px(&self, half_width_px: f64) -> f64 {
        let large = (half_width_px / UNSCALED_INITIAL_HALF_WIDTH_PX).max(1.0);
        (large * self.half_length_px).min(MAX_HALF_LENGTH_PX as f64)
    }
}

/// Options of tracking.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackOptions {
    /// Largest half-length of the search lines of a hand that moves as predicted \[px\], 1–128. If
    /// it is not found there, the search range grows by this length, and again for every frame
    /// without it.
    pub half_length_px: f64,
    /// Conditions for accepting a fit.
    pub accept: AcceptOptions,
    /// Frames in a row without an accepted fit until the hand is lost, at least 1.
    pub lose_after_frames: usize,
    /// Rate at which the appearance model follows the image, per accepted frame, 0–1.
    pub appearance_rate: f64,
    /// Motion model of the hand.
    pub dynamics: DynamicsOptions,
}

/// Motion model of a hand in the image: a Kalman filter with constant velocity.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DynamicsOptions {
    /// Root mean square acceleration along u and along v \[px/s²\], 1–1e5.
    pub acceleration_px_s2: f64,
    /// Root mean square angular acceleration of the finger \[rad/s²\], 0.01–1000.
    pub acceleration_rad_s2: f64,
    /// Correlation time of the acceleration \[s\], 0.001–1.
    pub acceleration_lasts_s: f64,
    /// Standard deviation of the initial speed along u and along v \[px/s\], 0–1e5.
    pub first_speed_px_s: f64,
    /// Standard deviation of the initial angular speed \[rad/s\], 0–100.
    pub first_speed_rad_s: f64,
    /// Probability with which the search along a normal reaches the hand's edge if the hand moves
    /// by this model, 0.5–0.999999.
    pub confidence: f64,
    /// Longest gap over which a hand is tracked; after a longer one it is acquired again \[s\],
    /// 0.001–60.
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
    /// Filter components (c_u, c_v, θ) of a hand `large` times the usual size.
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

/// Options of a [`ContourTracker`](super::ContourTracker), with defaults. For the band model,
/// lengths and speeds are in pixels of the image in which the hand is tracked: the frame, or, for a
/// finger at least 24 px across, the frame reduced by an integer factor.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackerOptions {
    /// Model of the hand.
    pub model: Model,
    /// Number of samples along the contour, 8–2000.
    pub samples: usize,
    /// Largest number of iterations (searches along the normals) per shape space and frame, 1–100.
    pub max_iterations: usize,
    /// Edge detection.
    pub search: SearchOptions,
    /// Polarity of edges: which side is the hand.
    pub polarity: Polarity,
    /// Robust least squares.
    pub fit: FitOptions,
    /// Factor on the covariance of the fit, at least 1: neighbouring edge measurements share
    /// pixels.
    pub correlation: f64,
    /// Whether the band model's finger line is refined by the flanks alone and combined with the
    /// lines of earlier frames; the paper's model is never refined.
    pub refine: bool,
    /// Options until the hand is acquired.
    pub acquire: AcquireOptions,
    /// Options from then on.
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
    /// Validation gate of the edge search for a tracked hand `large` times the usual size.
    pub(super) fn gate(&self, large: f64) -> Result<Gate> {
        let TrackOptions { half_length_px, dynamics, .. } = &self.track;
        let longest_px = (large * half_length_px).min(MAX_HALF_LENGTH_PX as f64);
        Gate::new(dynamics.confidence, MIN_HALF_LENGTH_PX.min(longest_px), longest_px)
    }

    /// Checks that every option is finite and in its range; search and fit check their own.
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
