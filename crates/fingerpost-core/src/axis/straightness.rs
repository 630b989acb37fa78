//! Straightness of a finger: the angle between the bisectors of its two halves.
//!
//! Both flanks of a bent finger turn in the same direction, and with them their bisector. A bulging
//! joint, a taper and a shaded limb leave the bisector in place. The halves are therefore fitted as
//! two straight fingers, and the angle between their axes is the bend. A half determines nothing if
//! its edges do not lie on two straight flanks at about the width of the finger: clutter, a thumb
//! or another finger beside it must not bend the finger.
//!
//! If the proximal half does not lie along the axis of the finger, it is searched for at several
//! turns about the joint. If both halves lie along it, a continuation beyond the round end is
//! searched for likewise. In these searches a pair of edges is weak evidence, so the pixels between
//! them must also resemble the hand.
//!
//! A bend towards the camera or away from it shortens the finger, and no view shows it.

use super::Stretch;
use super::bisector::{Bisector, BisectorFit, STATION_PX};
use super::finger_estimate::FingerEstimate;
use super::visible_flanks::VisibleFlanks;
use crate::Result;
use crate::axis::{BisectorOptions, BisectorReport, Finger};
use crate::geometry::shape_space::Axis;
use crate::image::frame::Frame;
use crate::measure::edge::Polarity;
use crate::measure::edge_search::Cue;
use crate::numeric::simd::Isa;
use nalgebra::Point2;

/// The deviation of a finger from straight, in the image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bend {
    /// Direction of the distal half minus that of the proximal half \[rad\].
    pub angle_rad: f64,
    /// Standard deviation, from the scatter of the edges of either half and its correlation
    /// \[rad\].
    pub sigma_rad: f64,
}

/// Half-length of the search across a half, and minimum number of edges on either flank: a bent
/// half is short and displaced \[px\].
const HALF_LENGTH_PX: f64 = 10.0;
const LEAST_EDGES: usize = 6;
/// Upper bound on the scatter of a half's edges about its flanks, in half-widths, or \[px\] if that
/// is more: skin is not smooth, and joints bulge.
const SCATTER: f64 = 0.1;
const SCATTER_PX: f64 = 0.25;
/// End of the proximal half and start of the distal half, about the middle joint, as fractions of
/// the finger from the knuckle.
const JOINT: [f64; 2] = [0.4, 0.5];
/// Minimum fraction of the places along the flanks that have an edge, and maximum fraction of those
/// that are off the line: a joint is not always in the middle.
const SEEN: f64 = 0.85;
const REJECTED: f64 = 0.35;
/// Maximum ratio of a half's width to that of the whole finger, and inverse of the minimum.
const WIDTH: f64 = 1.25;

/// Turns tried for the next part if a part does not lie along the whole finger, or if the finger
/// does not end with it \[rad\].
const TURNS_RAD: [f64; 4] = [0.45, -0.45, 0.9, -0.9];
/// Minimum mean log-likelihood ratio of the pixels between a part's flanks, as a fraction of its
/// neighbour's, and the lines along the part on which it is sampled \[half-widths\].
const HAND_PART: f64 = 0.6;
const ACROSS: [f64; 3] = [-0.6, 0.0, 0.6];
/// The joint of the proximal half is tried at these distances behind the start of the distal half;
/// from the joint, the proximal half extends over `BEHIND` \[half-widths\].
const JOINTS: [f64; 3] = [0.0, 1.2, 2.4];
const BEHIND: [f64; 2] = [-3.0, -0.6];
/// Stretch of a continuation of the finger, from the centre of the supposed round end
/// \[half-widths\].
const AHEAD: [f64; 2] = [0.8, 3.0];
/// Minimum visible fraction of the flanks of a finger that may be covered.
const MIN_VISIBLE_PART: f64 = 0.5;
/// Nominal image noise of the edge search; only the scatter of the edges is used \[grey levels\].
const NOISE_GREY: f64 = 1.0;

/// Measures bends; owns the buffers.
#[derive(Debug, Clone)]
pub(super) struct Straightness {
    bisector: Bisector,
    visible: VisibleFlanks,
}

/// The image in which a half is searched for, and the edge cue and polarity.
struct HalfSearch<'a> {
    frame: &'a Frame<'a>,
    cue: Cue<'a>,
    polarity: Polarity,
}

impl Straightness {
    pub fn new(options: BisectorOptions) -> Result<Self> {
        let (half_length_px, min_edges) = (HALF_LENGTH_PX, LEAST_EDGES);
        let bisector = Bisector::new(BisectorOptions { half_length_px, min_edges, ..options })?;
        Ok(Self { bisector, visible: VisibleFlanks::default() })
    }

    /// The same measurement for another instruction set.
    pub fn with_isa(self, isa: Isa) -> Self {
        Self { bisector: self.bisector.with_isa(isa), ..self }
    }

    /// The bend of the finger near the estimate `finger`; `None` if a half does not determine it.
    ///
    /// # Errors
    /// Those of [`FingerEstimate::of`], of either half.
    pub fn bend(
        &mut self,
        frame: &Frame<'_>,
        cue: Cue<'_>,
        polarity: Polarity,
        finger: &Finger,
    ) -> Result<Option<Bend>> {
        // The stretch where both flanks may be visible; on the round end no flank is straight.
        let [right, left] = finger.flanks;
        let end_px = finger.round_end_px.unwrap_or(f64::INFINITY);
        let to_px = right.to_px.min(left.to_px).min(end_px);
        let from_px = right.from_px.max(left.from_px);
        let [joint_px, middle_px] = JOINT.map(|part| from_px + part * (to_px - from_px));
        let knuckle = finger.flanks.map(|s| Stretch { to_px: joint_px, ..s });
        let tip = finger.flanks.map(|s| Stretch { from_px: middle_px.max(s.from_px), to_px });
        let search = HalfSearch { frame, cue, polarity };
        let Some(tip) = self.half(&search, &Finger { flanks: tip, ..*finger })? else {
            return Ok(None);
        };
        if let Some(knuckle) = self.half(&search, &Finger { flanks: knuckle, ..*finger })? {
            let along = bend(&knuckle, &tip);
            let ahead = self.ahead(&search, finger, &tip)?.map(|ahead| bend(&tip, &ahead));
            let is_larger = |ahead: &Bend| ahead.angle_rad.abs() > along.angle_rad.abs();
            return Ok(Some(ahead.filter(is_larger).unwrap_or(along)));
        }
        let from_px = -tip.estimate.half_length_px;
        for joint in JOINTS {
            let joint_px = from_px - joint * finger.half_width_px;
            let flanks = [BEHIND.map(|part| part * finger.half_width_px); 2]
                .map(|[from_px, to_px]| Stretch { from_px, to_px });
            if let Some(knuckle) = self.turned(&search, finger, &tip.estimate, joint_px, flanks)? {
                return Ok(Some(bend(&knuckle, &tip)));
            }
        }
        Ok(None)
    }

    /// The continuation of the finger beyond its round end, if there is one: a template that has
    /// slid back lies along the proximal part of a bent finger.
    fn ahead(
        &mut self,
        search: &HalfSearch<'_>,
        finger: &Finger,
        tip: &BisectorFit,
    ) -> Result<Option<BisectorFit>> {
        let (Some(end_px), Some(radius_px)) =
            (tip.estimate.round_end_px, tip.estimate.end_radius_px())
        else {
            return Ok(None);
        };
        let [from_px, to_px] = AHEAD.map(|part| part * radius_px);
        self.turned(search, finger, &tip.estimate, end_px, [Stretch { from_px, to_px }; 2])
    }

    /// One of the halves. If the finger may be covered in part, enough of the half must be visible.
    fn half(&mut self, search: &HalfSearch<'_>, half: &Finger) -> Result<Option<BisectorFit>> {
        // The prior of the width is that of a straight finger.
        let found = self.part(search, &Finger { prior: None, ..*half })?;
        let Some(found) = found else { return Ok(None) };
        if half.prior.is_none() {
            return Ok(Some(found));
        }
        // Visibility is measured at the fitted half: a bent half lies away from the searched place.
        let fitted = FingerEstimate { prior: half.prior, ..found.estimate };
        self.visible.measure(search.frame, search.cue.appearance(), &fitted);
        Ok((self.visible.least_part() >= MIN_VISIBLE_PART).then_some(found))
    }

    /// The part of the finger that is turned against `other` about a joint and whose pixels
    /// resemble the hand. The stretches are relative to the joint.
    fn turned(
        &mut self,
        search: &HalfSearch<'_>,
        finger: &Finger,
        other: &FingerEstimate,
        joint_px: f64,
        flanks: [Stretch; 2],
    ) -> Result<Option<BisectorFit>> {
        let Some(appearance) = search.cue.appearance() else { return Ok(None) };
        let log_ratio =
            |part: &FingerEstimate| appearance.mean_log_ratio(search.frame, between_flanks(part));
        let least = HAND_PART * log_ratio(other);
        let (joint, half_width_px) = (other.place(joint_px, 0.0), other.half_width_at(joint_px));
        if half_width_px <= 0.0 {
            // A taper that closes the finger before its joint describes no finger.
            return Ok(None);
        }
        for turn_rad in TURNS_RAD {
            let angle_rad = other.along.y.atan2(other.along.x) + turn_rad;
            let axis = Axis::of_finger(joint, angle_rad, 0.0);
            let (round_end_px, prior) = (None, None);
            let part = Finger { axis, half_width_px, flanks, round_end_px, prior, ..*finger };
            let Some(estimate) = FingerEstimate::of(&part)? else { continue };
            if least <= 0.0 || log_ratio(&estimate) <= 0.0 {
                continue;
            }
            let found = self.part(search, &part)?;
            if let Some(found) = found.filter(|found| log_ratio(&found.estimate) > least) {
                return Ok(Some(found));
            }
        }
        Ok(None)
    }

    /// The bisector of a part of a finger, if its flanks are those of a finger.
    fn part(&mut self, search: &HalfSearch<'_>, part: &Finger) -> Result<Option<BisectorFit>> {
        if part.flanks.iter().any(|s| s.length_px() <= 0.0) {
            return Ok(None);
        }
        let Some(estimate) = FingerEstimate::of(part)? else { return Ok(None) };
        let HalfSearch { frame, cue, polarity } = *search;
        let fit = self.bisector.fit(
            frame,
            cue,
            polarity,
            NOISE_GREY,
            &estimate,
            &VisibleFlanks::default(),
        )?;
        Ok(fit.filter(|fit| is_finger(&estimate, fit)))
    }
}

/// The bend from the proximal part to the distal one.
fn bend(knuckle: &BisectorFit, tip: &BisectorFit) -> Bend {
    let (from, to) = (knuckle.estimate.along, tip.estimate.along);
    let variance = knuckle.covariance[(1, 1)] + tip.covariance[(1, 1)];
    Bend { angle_rad: from.perp(&to).atan2(from.dot(&to)), sigma_rad: variance.sqrt() }
}

/// Sample points between the flanks.
fn between_flanks(part: &FingerEstimate) -> impl Iterator<Item = Point2<f64>> {
    let stations = (2.0 * part.half_length_px / STATION_PX) as usize;
    (0..=stations).flat_map(move |i| {
        let p = i as f64 * STATION_PX - part.half_length_px;
        ACROSS.map(|across| part.place(p, across * part.half_width_at(p)))
    })
}

/// Whether fitted flanks are those of a finger like the estimate.
fn is_finger(estimate: &FingerEstimate, fit: &BisectorFit) -> bool {
    let BisectorReport { edges, rejected, residual_px } = fit.report;
    let places: f64 = estimate.flanks.iter().map(|s| s.length_px() / STATION_PX).sum();
    let width = fit.estimate.half_width_px / estimate.half_width_px;
    edges as f64 >= SEEN * places
        && rejected <= REJECTED
        && residual_px <= SCATTER_PX.max(SCATTER * estimate.half_width_px)
        && (1.0 / WIDTH..=WIDTH).contains(&width)
}
