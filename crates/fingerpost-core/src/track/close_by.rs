//! Grey images: start poses near the initial template, ranked by the edges nearby.

use super::convergence::Convergence;
use super::initialise::{CLOSE_FITTED, TemplateInitialiser};
use super::options::MIN_HALF_LENGTH_PX;
use super::scene::Scene;
use crate::Result;
use crate::geometry::ribbon::RibbonVector;
use nalgebra::Vector2;

/// Offsets of start poses along the finger \[half-widths\]. Without colours, the strongest edge in
/// range is seldom the hand's; start poses near the initial one therefore search nearby edges only,
/// and the best are fitted.
const CLOSE_ALONG: [f64; 3] = [-1.0, 0.0, 1.0];
/// Offsets across the finger \[half-widths\].
const CLOSE_ACROSS: [f64; 3] = [-0.6, 0.0, 0.6];
/// Rotations \[rad\].
const CLOSE_ANGLES_RAD: [f64; 3] = [-0.12, 0.0, 0.12];
/// Half-widths, relative to the initial template's.
const CLOSE_WIDTHS: [f64; 2] = [0.85, 1.15];

impl TemplateInitialiser<'_> {
    /// The start poses, about the initial one rotated by `angle_rad`, with the greatest support by
    /// nearby edges.
    pub(super) fn close_by(
        &self,
        convergence: &mut Convergence,
        scene: &Scene<'_>,
        angle_rad: f64,
    ) -> Result<[RibbonVector; CLOSE_FITTED]> {
        let polarity = self.options.polarity;
        let mut best = [(0, self.turned(angle_rad)); CLOSE_FITTED];
        for turn_rad in CLOSE_ANGLES_RAD {
            let turned = self.turned(angle_rad + turn_rad);
            let ahead = Vector2::new(turned[2].cos(), turned[2].sin()) * turned[3];
            let lateral = Vector2::new(-ahead.y, ahead.x);
            for (along, across) in
                CLOSE_ALONG.into_iter().flat_map(|a| CLOSE_ACROSS.map(|b| (a, b)))
            {
                let by = ahead * along + lateral * across;
                for width in CLOSE_WIDTHS {
                    let mut x = turned;
                    (x[0], x[1], x[3]) = (x[0] + by.x, x[1] + by.y, width * x[3]);
                    let support =
                        self.support::<5>(convergence, scene, &x, MIN_HALF_LENGTH_PX, polarity)?;
                    let [.., last] = &mut best;
                    if support > last.0 {
                        *last = (support, x);
                        best.sort_unstable_by_key(|(support, _)| std::cmp::Reverse(*support));
                    }
                }
            }
        }
        Ok(best.map(|(_, x)| x))
    }
}
