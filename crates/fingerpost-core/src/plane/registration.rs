//! Alignment of all levels, from the coarsest to the full resolution.

use nalgebra::{Matrix3, SMatrix};

use super::hand_region::HandRegion;
use super::level::{PlaneLevel, Step};
use crate::image::gray::GrayView;
use crate::{Error, Result};

/// Greatest number of iterations; greatest motion of a reference point in the last one, at full
/// resolution and at reduced levels \[px\]; least determinant of a step, below which it nearly
/// folds the plane.
const MAX_ITERATIONS: usize = 10;
const CONVERGENCE_PX: f64 = 0.03;
const COARSE_CONVERGENCE_PX: f64 = 0.4;
const MIN_DETERMINANT: f64 = 0.1;

/// Least number of expected pixels at full resolution; in proportion to the scale at other levels.
const MIN_EXPECTED: f64 = 150.0;

/// The pose of the plane in an image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Registered {
    /// Homography from the pinhole's pixels of the first image to those of the present one \[px\].
    pub now_from_first: Matrix3<f64>,
    /// Covariance of the entries but the last of a step before it, in unit coordinates, row by row.
    pub step_covariance: SMatrix<f64, 8, 8>,
    /// Part of the information of the expected pixels that inliers have.
    pub inlier_share: f64,
    /// Number of inliers among the expected pixels.
    pub inliers: usize,
}

/// Registers the plane of a first image with later ones.
#[derive(Debug, Clone)]
pub struct PlaneRegistration {
    /// From full resolution down.
    levels: Vec<PlaneLevel>,
    unit_from_px: Matrix3<f64>,
    px_from_unit: Matrix3<f64>,
    /// Points of the first image at which accuracy is required.
    points_px: Vec<[f64; 2]>,
}

impl PlaneRegistration {
    /// Levels of one view from full resolution down, and the points of the first pinhole image at
    /// which accuracy is required \[px\].
    ///
    /// # Errors
    ///
    /// [`Error::OutOfRange`] without any level, or for a singular `unit_from_px`.
    pub fn new(levels: Vec<PlaneLevel>, points_px: Vec<[f64; 2]>) -> Result<Self> {
        let Some(unit_from_px) = levels.first().map(PlaneLevel::unit_from_px) else {
            let right = "1 or more";
            return Err(Error::OutOfRange { what: "number of levels", value: 0.0, right });
        };
        let Some(px_from_unit) = unit_from_px.try_inverse() else {
            let (what, value) = ("determinant of unit_from_px", unit_from_px.determinant());
            return Err(Error::OutOfRange { what, value, right: "different from 0" });
        };
        Ok(Self { levels, unit_from_px, px_from_unit, points_px })
    }

    /// Number of its levels.
    #[must_use]
    pub fn levels(&self) -> usize {
        self.levels.len()
    }

    /// Registers an image, given by its smoothed pyramid from full resolution down, from a first
    /// guess that is accurate to a few pixels; `None` where too little of the plane is visible.
    pub fn align(
        &mut self,
        smooth: &[GrayView<'_>],
        guess: &Matrix3<f64>,
        hand: Option<&HandRegion>,
    ) -> Option<Registered> {
        let mut motion = AlignedSoFar { now_from_first: *guess, gone: Matrix3::identity() };
        let mut last = None;
        for k in (0..self.levels.len().min(smooth.len())).rev() {
            let step = self.align_level(k, &smooth[k], &mut motion, hand)?;
            self.levels[k].learn();
            last = Some(step);
        }
        let step = last?;
        Some(Registered {
            now_from_first: motion.now_from_first,
            step_covariance: self.levels[0].covariance(&step),
            inlier_share: step.inlier_share,
            inliers: step.inliers,
        })
    }

    /// Iterates at one level; returns the last step.
    fn align_level(
        &mut self,
        k: usize,
        smooth: &GrayView<'_>,
        motion: &mut AlignedSoFar,
        hand: Option<&HandRegion>,
    ) -> Option<Step> {
        let convergence_px = if k == 0 { CONVERGENCE_PX } else { COARSE_CONVERGENCE_PX };
        let mut last = None;
        for _ in 0..MAX_ITERATIONS {
            let level = &mut self.levels[k];
            let least = MIN_EXPECTED * level.scale();
            if (level.len() as f64) < least {
                return None;
            }
            let accumulated = motion.gone / motion.gone[(2, 2)];
            let step = level.step(smooth, &motion.now_from_first, &accumulated, hand, least)?;
            let moved_px = self.apply(&step, motion)?;
            last = Some(step);
            if moved_px < convergence_px {
                break;
            }
        }
        last
    }

    /// Applies a step; returns the greatest motion of a point \[px\], or `None` if it folds the
    /// plane.
    fn apply(&self, step: &Step, motion: &mut AlignedSoFar) -> Option<f64> {
        let mut by = Matrix3::identity();
        for (k, entry) in step.entries.iter().enumerate() {
            by[(k / 3, k % 3)] += entry;
        }
        // False for NaN as well.
        let keeps_side = by.determinant() >= MIN_DETERMINANT;
        let back = by.try_inverse().filter(|_| keeps_side)?;
        let back_px = self.px_from_unit * back * self.unit_from_px;
        motion.gone *= back;
        motion.now_from_first *= back_px;
        motion.now_from_first /= motion.now_from_first[(2, 2)];
        if !motion.now_from_first.iter().all(|entry| entry.is_finite()) {
            return None;
        }
        let moved_px = |&[u, v]: &[f64; 2]| {
            let moved = back_px * nalgebra::Vector3::new(u, v, 1.0);
            (moved.x / moved.z - u).abs().max((moved.y / moved.z - v).abs())
        };
        Some(self.points_px.iter().map(moved_px).fold(0.0, f64::max))
    }
}

/// The current estimate of the plane's motion.
struct AlignedSoFar {
    now_from_first: Matrix3<f64>,
    /// Accumulated step since the guess, in unit coordinates.
    gone: Matrix3<f64>,
}
