//! The thumb of a hand that is held up: a grid of thumbs, of which the best are fitted.

use super::convergence::Convergence;
use super::fit_result::FitResult;
use super::initialise::TemplateInitialiser;
use super::limbs::thumb_samples;
use super::scene::Scene;
use super::stage::Support;
use crate::Result;
use crate::geometry::ribbon::{RIBBON_DOF, RibbonVector};
use crate::geometry::template::Part;
use crate::measure::edge::{MAX_HALF_LENGTH_PX, Polarity};
use nalgebra::Vector2;

/// Thumb roots tried, in finger lengths from the finger's middle.
const THUMB_ROOTS: [f64; 4] = [-0.75, -0.6, -0.45, -0.3];

/// Angles tried between thumb and finger \[rad\].
const THUMB_ANGLES_RAD: [f64; 6] = [0.6, 0.85, 1.1, 1.35, 1.6, 1.85];

/// Thumb lengths tried, in finger lengths.
const THUMB_LENGTHS: [f64; 4] = [0.4, 0.6, 0.8, 1.0];

/// Least explained fraction of the thumb's visible samples.
const THUMB_SEEN: f64 = 0.7;

/// Least explained fraction of all of the thumb's samples, including those that the finger hides.
const MIN_VISIBLE_THUMB: f64 = 0.5;

/// Number of thumbs that are fitted.
const THUMBS_FITTED: usize = 4;

/// Largest distance of the best thumb of the grid from the true one \[px per px of finger length\].
const THUMB_REACH: f64 = 0.12;

impl TemplateInitialiser<'_> {
    /// Whether a fit explains enough of the thumb's contour, and not because the finger hides the
    /// rest.
    pub(super) fn shows_thumb(&self, support: &Support) -> bool {
        let all = thumb_samples(self.samples).len() as f64;
        support.of(Part::Thumb) >= THUMB_SEEN
            && support.count(Part::Thumb) as f64 >= MIN_VISIBLE_THUMB * all
    }

    /// The thumb of a finger that was found: the best of the grid, fitted with the finger.
    pub(super) fn thumb(
        &self,
        convergence: &mut Convergence,
        scene: &Scene<'_>,
        finger: &RibbonVector,
    ) -> Result<(FitResult<RibbonVector>, Polarity)> {
        let reach_px = (THUMB_REACH * self.measure.length_px).clamp(1.0, MAX_HALF_LENGTH_PX as f64);
        let mut tried = Vec::new();
        for &polarity in self.hypotheses() {
            for from in self.thumbs(finger) {
                let support =
                    self.support::<RIBBON_DOF>(convergence, scene, &from, reach_px, polarity)?;
                tried.push((support, polarity, from));
            }
        }
        tried.sort_by_key(|(support, ..)| std::cmp::Reverse(*support));
        let mut best = (FitResult::unfitted(*finger), self.options.polarity);
        for (_, polarity, from) in tried.into_iter().take(THUMBS_FITTED) {
            let fitted_finger = self.whole(convergence, scene, &from, reach_px, polarity)?;
            if fitted_finger.support() > best.0.support() && self.is_plausible(&fitted_finger, true)
            {
                best = (fitted_finger, polarity);
            }
        }
        Ok(best)
    }

    /// Every thumb of the grid on a finger.
    fn thumbs(&self, finger: &RibbonVector) -> impl Iterator<Item = RibbonVector> {
        let (finger, length_px, side) = (*finger, self.measure.length_px, self.measure.side);
        THUMB_ROOTS.into_iter().flat_map(move |root| {
            THUMB_ANGLES_RAD.into_iter().flat_map(move |angle_rad| {
                THUMB_LENGTHS.into_iter().map(move |length| {
                    let mut x = finger;
                    let (sin, cos) = (finger[2] + side * angle_rad).sin_cos();
                    let spine = Vector2::new(cos, sin) * (length * length_px);
                    (x[5], x[6], x[7]) = (root * length_px, spine.x, spine.y);
                    x[8] = 0.9 * finger[3];
                    x
                })
            })
        })
    }
}
