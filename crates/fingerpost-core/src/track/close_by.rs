//! Grey images: hypotheses close to the initial template, ranked by the edges nearby.

use super::convergence::Convergence;
use super::initialise::{CLOSE_FITTED, TemplateInitialiser};
use super::options::MIN_HALF_LENGTH_PX;
use super::scene::Scene;
use crate::Result;
use crate::geometry::ribbon::RibbonVector;
use nalgebra::Vector2;

/// Where there are no colours, the strongest edge about is seldom the hand's: fingers about the waiting
/// one try as well that move to what is close by alone. So far along it and across it \[half-widths\],
/// turned by so much \[rad\] and of so many times its width; the likeliest of them are fitted.
const CLOSE_ALONG: [f64; 3] = [-1.0, 0.0, 1.0];
const CLOSE_ACROSS: [f64; 3] = [-0.6, 0.0, 0.6];
const CLOSE_ANGLES_RAD: [f64; 3] = [-0.12, 0.0, 0.12];
const CLOSE_WIDTHS: [f64; 2] = [0.85, 1.15];

impl TemplateInitialiser<'_> {
    /// Of the fingers about the waiting one, turned by so much, those that have most edges close by.
    pub(super) fn close_by(
        &self,
        convergence: &mut Convergence,
        frame: &Scene<'_>,
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
                        self.support::<5>(convergence, frame, &x, MIN_HALF_LENGTH_PX, polarity)?;
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
