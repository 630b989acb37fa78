//! Validation of a fit: whether it is the tracked hand, by several criteria, each insufficient
//! alone.
//!
//! Wedges on a printed mat and edges of a table can show as many agreeing edges as a finger does. A
//! hand, however, keeps its size and appearance approximately, and moves from its last place as its
//! motion predicts. The agreement required of a fit therefore grows as its place becomes less
//! likely. At the predicted place, missing edges, caused by blur or by a background similar to the
//! hand, are weaker evidence against the fit than edges found elsewhere.

use super::fit_result::{FitResult, Refusal};
use super::options::AcceptOptions;
use super::shape::Shape;
use super::stage::{Fit, SURE};
use crate::axis::Bend;
use crate::geometry::ribbon::RibbonVector;
use crate::geometry::template::Part;
use crate::solve::dynamics::Innovation;

/// Largest ratio of a tracked finger's half-width to the acquired one, or its inverse. The acquired
/// value follows the measurements slowly.
const WIDTH_CHANGE: f64 = 1.6;
/// Largest difference of its taper from the acquired one.
const TAPER_CHANGE: f64 = 0.19;
/// Normalised square of an innovation, relative to the gate, above which it is no motion of a hand,
/// not even of one that reverses at full speed.
const IMPOSSIBLE: f64 = 8.0;
/// Innovation of the angle, in standard deviations, above which it is no motion of a hand.
const IMPOSSIBLE_TURN_SIGMAS: f64 = 6.0;
/// Factor on the required agreement for a hand exactly at the predicted place, under the two
/// conditions below.
const PREDICTED_SHARE: f64 = 0.66;
/// Largest fraction of its contour with an edge that disagrees with the fit.
const CONTRADICTED: f64 = 0.08;
/// The same where only edges that match the appearance model count: an object that covers a hand
/// has edges inside its outline.
const CONTRADICTED_BY_COVER: f64 = 0.2;
/// Least fraction of each flank whose edges agree.
const FLANK_SEEN: f64 = 0.25;
/// Factor on the required agreement for a hand that is partly covered. Its visible part must lie
/// where a hand at constant velocity would, and its residuals must scatter no more than usual; the
/// covariance accounts for the rest.
const COVERED_SHARE: f64 = 0.5;

/// Angle between the halves of a finger above which it is bent \[rad\]: a line fitted to both is
/// off the direction of each by half of it. Fingers that point straight in real footage have less
/// than 4° (device), 8° (desk) and 12° (mat, with motion blur) in 95 % of frames.
const BENT_RAD: f64 = 20.0 * RAD_PER_DEG;
/// Standard deviations by which the angle of one frame must exceed that to establish the bend
/// alone.
const SURELY: f64 = 2.0;
/// Angle between the halves below which a bent finger is straight again \[rad\].
const STRAIGHT_RAD: f64 = 15.0 * RAD_PER_DEG;
/// Least explained fraction of the tip of such a finger.
const TIP_SEEN: f64 = 0.6;
/// Explained fraction of the contour below which a finger bent once has bent further, so that one
/// of its halves is not found.
const HALF_SEEN: f64 = 0.7;
const RAD_PER_DEG: f64 = std::f64::consts::PI / 180.0;

/// Evidence about whether a finger is straight.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum BendState {
    /// It is straight, or nothing shows that it is not.
    Straight,
    /// One frame showed it bent, without certainty: blur and background also bend flanks.
    Uncertain,
    /// One frame showed it bent with certainty, none before: it yields no line. If the next frame
    /// does not determine the bend, it is not known to be bent.
    BentOnce,
    /// It is bent and yields no line.
    Bent,
}

impl BendState {
    /// The state after a frame with this fit and bend, `None` if the flanks did not determine it. A
    /// straight line fits either half of a bent finger, and the part that it does not explain might
    /// be hidden: a finger that was seen to bend is straight again only when it is seen to be.
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
        let remains_bent = self.is_bent() && (angle_rad > STRAIGHT_RAD || tip < TIP_SEEN);
        if remains_bent { self } else { Self::Straight }
    }

    /// Whether it yields no line.
    pub fn is_bent(self) -> bool {
        matches!(self, Self::BentOnce | Self::Bent)
    }
}

/// The hand's reference values against which a fit is validated.
#[derive(Debug, Clone, Copy)]
pub(super) struct Validation<'a> {
    pub accept: AcceptOptions,
    /// The band template at acquisition.
    pub acquired: &'a RibbonVector,
    /// Innovation of the fit; `None` without a motion prediction.
    pub innovation: Option<InnovationCheck>,
    /// Largest residual scatter of a fit at its true place \[px\].
    pub most_scatter_px: f64,
}

/// An innovation, place and angle relative to the prediction, as validation tests it.
#[derive(Debug, Clone, Copy)]
pub(super) struct InnovationCheck {
    /// Normalised square of the innovation, relative to the gate.
    innovation_over_gate: f64,
    /// Innovation of the angle, in its standard deviations.
    turn_sigmas: f64,
    /// Additional agreement required, as a fraction of the contour, relative to a hand at its
    /// likeliest place.
    placement_penalty: f64,
}

impl InnovationCheck {
    /// The check of an innovation; `innovation_gate` is the limit of its normalised square,
    /// `placement_penalty` is
    /// [`MotionPrior::placement_penalty`](super::motion_prior::MotionPrior::placement_penalty).
    pub fn of(innovation: &Innovation<3>, innovation_gate: f64, placement_penalty: f64) -> Self {
        Self {
            innovation_over_gate: innovation.normalised_square() / innovation_gate,
            turn_sigmas: innovation.vector[2].abs() / innovation.covariance[(2, 2)].sqrt(),
            placement_penalty,
        }
    }
}

impl Validation<'_> {
    /// Whether the hand can have changed and moved to this shape, irrespective of edges.
    ///
    /// # Errors
    /// [`Refusal::Size`] or [`Refusal::Motion`] if it cannot.
    pub fn is_possible(&self, shape: &Shape) -> Result<(), Refusal> {
        if let Shape::Ribbon(x) = shape {
            let width = (x[3] / self.acquired[3]).max(self.acquired[3] / x[3]);
            if !(width <= WIDTH_CHANGE && (x[4] - self.acquired[4]).abs() <= TAPER_CHANGE) {
                return Err(Refusal::Size);
            }
        }
        let impossible = |i: InnovationCheck| {
            i.innovation_over_gate > IMPOSSIBLE || i.turn_sigmas > IMPOSSIBLE_TURN_SIGMAS
        };
        if self.innovation.is_some_and(impossible) { Err(Refusal::Motion) } else { Ok(()) }
    }

    /// Whether the fit is the hand. `likeness`, 0–1, is the weight of its edges by appearance.
    ///
    /// # Errors
    /// The reason for refusal.
    pub fn judge(&self, found: &FitResult, likeness: f64) -> Result<(), Refusal> {
        let Some(fit) = &found.fit else { return Err(Refusal::NoFit) };
        self.is_possible(&found.shape)?;
        let accept =
            AcceptOptions { min_inliers: self.min_agreement(fit, likeness), ..self.accept };
        found.refusal(&accept).map_or(Ok(()), Err)
    }

    /// Required agreement: (share × `min_inliers` + placement penalty) / likeness. It may exceed 1.
    pub fn min_agreement(&self, fit: &Fit, likeness: f64) -> f64 {
        let penalty = self.innovation.map_or(0.0, |check| check.placement_penalty);
        (self.least_share(fit) * self.accept.min_inliers + penalty) / likeness
    }

    /// Factor on `min_inliers` at the likeliest place.
    fn least_share(&self, fit: &Fit) -> f64 {
        if fit.matched_only && fit.residual_rms_px <= self.most_scatter_px {
            return COVERED_SHARE;
        }
        let contradicted =
            (fit.counts.hits - fit.counts.inliers) as f64 / fit.counts.visible.max(1) as f64;
        let limit = if fit.matched_only { CONTRADICTED_BY_COVER } else { CONTRADICTED };
        let flanks = [Part::LeftFlank, Part::RightFlank].map(|part| fit.support.agreeing(part));
        let is_clear = contradicted <= limit && flanks.iter().all(|&f| f >= FLANK_SEEN);
        if self.innovation.is_some() && is_clear { PREDICTED_SHARE } else { 1.0 }
    }
}

#[cfg(test)]
mod tests {
    use super::{BENT_RAD, Bend, BendState, FitResult, RAD_PER_DEG};
    use crate::geometry::ribbon::RibbonVector;
    use crate::track::shape::Shape;

    #[test]
    fn one_uncertain_bent_frame_keeps_its_line() {
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
            // The second frame may be less certain.
            assert_eq!(after(BendState::Uncertain, side * 30.0, 10.0), BendState::Bent);
            assert_eq!(after(BendState::BentOnce, side * 30.0, 10.0), BendState::Bent);
        }
        assert!(BendState::BentOnce.is_bent() && !BendState::Uncertain.is_bent());
    }
}
