//! Whether a fit is the hand that is followed: several signs together, for each alone misleads.
//!
//! Wedges on a printed mat and edges of a table can have as many edges that agree as a finger has.
//! But a hand keeps about its size and its looks, and moves from where it was by what its motion
//! foretells: the less likely the place of a fit, the more of the contour must agree with it. And
//! where it is foretold, edges that are not seen, in front of something alike or smeared, tell
//! less against it than edges that lie elsewhere.

use super::fit_result::{FitResult, Refusal};
use super::options::AcceptOptions;
use super::shape::Shape;
use super::stage::{Fit, SURE};
use crate::axis::Bend;
use crate::geometry::ribbon::RibbonVector;
use crate::geometry::template::Part;
use crate::solve::dynamics::Innovation;

/// A followed finger has grown or shrunk by no more than this factor since it was acquired, and its
/// taper has changed by no more than this: what it was acquired with follows slowly.
const WIDTH_CHANGE: f64 = 1.6;
const TAPER_CHANGE: f64 = 0.19;
/// An innovation so many times as large as one that surprises is no motion of a hand, even of one
/// that turns back in full motion; nor is a turn so many standard deviations from what was foretold.
const IMPOSSIBLE: f64 = 8.0;
const IMPOSSIBLE_TURN: f64 = 6.0;
/// Of a hand exactly where it was foretold, this part of the least agreement will do, if at most this
/// part of its contour has an edge elsewhere and this part of either flank agrees.
const PREDICTED_SHARE: f64 = 0.66;
const CONTRADICTED: f64 = 0.08;
/// The same where all that counts looks like the hand: what covers a hand has edges inside of it.
const CONTRADICTED_BY_COVER: f64 = 0.2;
const FLANK_SEEN: f64 = 0.25;
/// Of a hand that is covered in part, what is bare must lie where it goes on as it did and scatter no
/// more than usual; then this part of the least agreement will do, and the covariance tells the rest.
const COVERED_SHARE: f64 = 0.5;

/// A finger whose halves differ by more than this is bent \[rad\]: a line fitted to both would be
/// off the direction of either by half of it. Fingers that point straight in real footage have less
/// than 4° (device), 8° (desk) and 12° (mat, with motion blur) in 95 % of frames.
const BENT_RAD: f64 = 20.0 * RAD_PER_DEG;
/// One frame alone shows it for sure by so many standard deviations more than that.
const SURELY: f64 = 2.0;
/// One that was bent is straight again when its halves differ by less than this, its tip seen to at
/// least this part.
const STRAIGHT_RAD: f64 = 15.0 * RAD_PER_DEG;
const TIP_SEEN: f64 = 0.6;
/// One that was bent and leaves more than the rest of its contour unexplained has bent further, so
/// that one of its halves is not found.
const HALF_SEEN: f64 = 0.7;
const RAD_PER_DEG: f64 = std::f64::consts::PI / 180.0;

/// Whether a finger is straight, as far as it was seen.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum BendState {
    /// It is, or nothing shows that it is not.
    Straight,
    /// One frame showed it bent, but not for sure: blur and what is behind it bend flanks too.
    Uncertain,
    /// It is not, as a frame showed for sure, but none before: it yields no line, but where the next
    /// one does not show it, neither is it known to be bent.
    BentOnce,
    /// It is not, and yields no line.
    Bent,
}

impl BendState {
    /// After a frame whose fit shows this bend, if it tells one. A straight line lies well along
    /// either half of a bent finger, and what it leaves unexplained might be hidden: a finger that
    /// was seen to bend is straight again only when it is seen to be.
    pub fn after(self, bend: Option<&Bend>, found: &FitResult) -> Self {
        let Some(Bend { angle_rad, sigma_rad }) = bend else {
            return match self {
                Self::Bent if found.explained() < SURE => Self::Bent,
                Self::BentOnce if found.explained() < HALF_SEEN => Self::BentOnce,
                Self::BentOnce if found.explained() < SURE => Self::Uncertain,
                _ => Self::Straight,
            };
        };
        let angle_rad = angle_rad.abs();
        if angle_rad > BENT_RAD {
            return match self {
                Self::Straight if angle_rad - SURELY * sigma_rad > BENT_RAD => Self::BentOnce,
                Self::Straight => Self::Uncertain,
                _ => Self::Bent,
            };
        }
        let tip = found.fit.map_or(0.0, |fit| fit.support.of(Part::Tip));
        let stays = self.is_bent() && (angle_rad > STRAIGHT_RAD || tip < TIP_SEEN);
        if stays { self } else { Self::Straight }
    }

    /// Whether it yields no line.
    pub fn is_bent(self) -> bool {
        matches!(self, Self::BentOnce | Self::Bent)
    }
}

/// What is known of the hand before its fit is judged.
#[derive(Debug, Clone, Copy)]
pub(super) struct Validation<'a> {
    pub accept: AcceptOptions,
    /// The band template as the hand was acquired.
    pub acquired: &'a RibbonVector,
    /// How the fit differs from what its motion foretold; None where nothing did.
    pub motion: Option<Motion>,
    /// What its edges scatter at most about a fit in its place \[px\].
    pub most_scatter_px: f64,
}

/// How place and angle differ from those foretold.
#[derive(Debug, Clone, Copy)]
pub(super) struct Motion {
    /// The innovation's normalised square, in units of one that surprises.
    surprise: f64,
    /// That of the angle alone, in its standard deviations.
    turn: f64,
    /// How much more of the contour must agree, in parts of it, than of a hand where it must be.
    unlikely: f64,
}

impl Motion {
    /// Where a normalised square above `surprise` is no motion that was foretold; see
    /// [`MotionPrior::unlikely`](super::pace::Pace::unlikely).
    pub fn of(innovation: &Innovation<3>, surprise: f64, unlikely: f64) -> Self {
        Self {
            surprise: innovation.normalised_square() / surprise,
            turn: innovation.vector[2].abs() / innovation.covariance[(2, 2)].sqrt(),
            unlikely,
        }
    }
}

impl Validation<'_> {
    /// Whether a hand can have become and moved to what was found, whatever edges say.
    pub fn is_possible(&self, shape: &Shape) -> Result<(), Refusal> {
        if let Shape::Ribbon(x) = shape {
            let width = (x[3] / self.acquired[3]).max(self.acquired[3] / x[3]);
            if !(width <= WIDTH_CHANGE && (x[4] - self.acquired[4]).abs() <= TAPER_CHANGE) {
                return Err(Refusal::Size);
            }
        }
        let impossible = |m: Motion| m.surprise > IMPOSSIBLE || m.turn > IMPOSSIBLE_TURN;
        if self.motion.is_some_and(impossible) { Err(Refusal::Motion) } else { Ok(()) }
    }

    /// Whether it is the hand, and if not, why; its edges look like the hand to this part, 0–1.
    pub fn judge(&self, found: &FitResult, likeness: f64) -> Result<(), Refusal> {
        let Some(fit) = &found.fit else { return Err(Refusal::NoFit) };
        self.is_possible(&found.shape)?;
        let accept =
            AcceptOptions { min_inliers: self.min_agreement(fit, likeness), ..self.accept };
        found.refusal(&accept).map_or(Ok(()), Err)
    }

    /// How much of the contour must agree. It may be more than there is.
    pub fn min_agreement(&self, fit: &Fit, likeness: f64) -> f64 {
        let unlikely = self.motion.map_or(0.0, |motion| motion.unlikely);
        (self.least_share(fit) * self.accept.min_inliers + unlikely) / likeness
    }

    /// The part of the least agreement that will do in the likeliest place.
    fn least_share(&self, fit: &Fit) -> f64 {
        if fit.own_only && fit.residual_rms_px <= self.most_scatter_px {
            return COVERED_SHARE;
        }
        let contradicted =
            (fit.counts.hits - fit.counts.inliers) as f64 / fit.counts.visible.max(1) as f64;
        let most = if fit.own_only { CONTRADICTED_BY_COVER } else { CONTRADICTED };
        let flanks = [Part::LeftFlank, Part::RightFlank].map(|part| fit.support.agreeing(part));
        let is_clear = contradicted <= most && flanks.iter().all(|&f| f >= FLANK_SEEN);
        if self.motion.is_some() && is_clear { PREDICTED_SHARE } else { 1.0 }
    }
}

#[cfg(test)]
mod tests {
    use super::{BENT_RAD, Bend, BendState, FitResult, RAD_PER_DEG};
    use crate::geometry::ribbon::RibbonVector;
    use crate::track::shape::Shape;

    #[test]
    fn one_frame_that_is_not_sure_of_a_bend_takes_no_line_away() {
        let found = FitResult {
            shape: Shape::Ribbon(RibbonVector::zeros()),
            fit: None,
            iterations: 1,
            edges_within_px: 1.0,
        };
        let after = |bend_state: BendState, angle_deg: f64, sigma_deg: f64| {
            let [angle_rad, sigma_rad] = [angle_deg, sigma_deg].map(|deg| deg * RAD_PER_DEG);
            assert!(angle_rad.abs() > BENT_RAD);
            bend_state.after(Some(&Bend { angle_rad, sigma_rad }), &found)
        };
        for side in [-1.0, 1.0] {
            assert_eq!(after(BendState::Straight, side * 30.0, 4.0), BendState::BentOnce);
            assert_eq!(after(BendState::Straight, side * 30.0, 10.0), BendState::Uncertain);
            // A second one need not be as sure.
            assert_eq!(after(BendState::Uncertain, side * 30.0, 10.0), BendState::Bent);
            assert_eq!(after(BendState::BentOnce, side * 30.0, 10.0), BendState::Bent);
        }
        assert!(BendState::BentOnce.is_bent() && !BendState::Uncertain.is_bent());
    }
}
