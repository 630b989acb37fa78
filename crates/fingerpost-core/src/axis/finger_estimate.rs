//! The initial estimate of the finger, in a frame of its own.
//!
//! p runs along the finger from the middle of the stretch in use, q to its right, both in px.

use super::Stretch;
use crate::axis::{Finger, MAX_STRETCH_PX, WidthPrior};
use crate::{Error, Result};
use nalgebra::{Point2, Vector2};

/// The side σ of the right flank and of the left one: q of the flank is σ times the half-width.
pub(super) const SIDES: [f64; 2] = [1.0, -1.0];

/// Estimate of the finger.
#[derive(Debug, Clone, Copy)]
pub(super) struct FingerEstimate {
    /// The point p = q = 0.
    pub origin: Point2<f64>,
    /// Unit vector of p.
    pub along: Vector2<f64>,
    /// Half-width at p = 0 \[px\], positive, and its growth with p.
    pub half_width_px: f64,
    pub taper: f64,
    /// The stretch of each flank in use, in p.
    pub flanks: [Stretch; 2],
    /// p of the centre of the round end.
    pub round_end_px: Option<f64>,
    /// Half the length of finger in use \[px\], positive.
    pub half_length_px: f64,
    /// p of the anchor and of the tip of the axis that the estimate was made from.
    pub anchor_px: f64,
    pub tip_px: f64,
    /// The prior of a finger that may be covered, at p = 0.
    pub prior: Option<WidthPrior>,
}

impl FingerEstimate {
    /// The finger in its own frame; `None` if neither flank has a stretch in use or the taper
    /// closes the finger within it.
    ///
    /// # Errors
    /// When a number is not finite, the half-width not positive, or the stretch longer than
    /// [`MAX_STRETCH_PX`], which bounds the run time.
    pub fn of(finger: &Finger) -> Result<Option<Self>> {
        let Finger { axis, half_width_px, taper, flanks, round_end_px, prior } = finger;
        Error::finite("axis of the finger [px]", axis.anchor.coords.sum() + axis.tip.coords.sum())?;
        Error::finite("angle of the finger [rad]", axis.angle_rad)?;
        Error::within("half-width of the finger [px]", *half_width_px, "positive", |w| w > 0.0)?;
        Error::finite("taper of the finger", *taper)?;
        for flank in flanks {
            Error::finite("stretch of the flank [px]", flank.from_px + flank.to_px)?;
        }
        if let Some(end) = round_end_px {
            Error::finite("middle of the round end [px]", *end)?;
        }
        if let Some(prior) = prior {
            Error::finite("prior width of the finger [px]", prior.half_width_px + prior.taper)?;
            let [offset, angle] = prior.axis_sigmas;
            for sigma in [prior.half_width_sigma_px, prior.taper_sigma, offset, angle] {
                Error::within("prior standard deviation of the finger", sigma, "positive", |s| {
                    s > 0.0
                })?;
            }
        }
        let Stretch { from_px: from, to_px: to } = finger.stretch();
        if to <= from {
            return Ok(None);
        }
        Error::within("stretch of the finger [px]", to - from, "at most 65536", |length| {
            length <= MAX_STRETCH_PX
        })?;
        let (along, middle) = (axis.direction(), 0.5 * (from + to));
        let shift = |s: &Stretch| s.beside(middle);
        let estimate = Self {
            origin: axis.anchor + along * middle,
            along,
            half_width_px: half_width_px + taper * middle,
            taper: *taper,
            flanks: [shift(&flanks[0]), shift(&flanks[1])],
            round_end_px: round_end_px.map(|e| e - middle),
            half_length_px: 0.5 * (to - from),
            anchor_px: -middle,
            tip_px: along.dot(&(axis.tip - axis.anchor)) - middle,
            prior: prior.map(|g| WidthPrior {
                half_width_px: g.half_width_px + g.taper * middle,
                axis_sigmas: [g.axis_sigmas[0].hypot(g.axis_sigmas[1] * middle), g.axis_sigmas[1]],
                ..g
            }),
        };
        // A taper that closes the finger within the stretch describes no finger.
        let ends = [-estimate.half_length_px, estimate.half_length_px];
        Ok(ends.iter().all(|&p| estimate.half_width_at(p) > 0.0).then_some(estimate))
    }

    /// Unit vector of q.
    pub fn normal(&self) -> Vector2<f64> {
        Vector2::new(-self.along.y, self.along.x)
    }

    /// The point of the image at (p, q).
    pub fn place(&self, p: f64, q: f64) -> Point2<f64> {
        self.origin + self.along * p + self.normal() * q
    }

    pub fn half_width_at(&self, p: f64) -> f64 {
        self.half_width_px + self.taper * p
    }

    /// Radius of the round end, if there is one \[px\].
    pub fn end_radius_px(&self) -> Option<f64> {
        self.round_end_px.map(|e| self.half_width_at(e))
    }

    /// The estimate moved onto a line and a width given in its frame.
    pub fn moved(&self, line: &FlankLines) -> Self {
        let along = (self.along + self.normal() * line.slope).normalize();
        let origin = self.origin + self.normal() * line.offset_px;
        let FlankLines { half_width_px, taper, .. } = *line;
        Self { origin, along, half_width_px, taper, ..*self }
    }
}

/// The two flanks q = d + ϑ p ± (w₀ + w₁ p) in the frame of an estimate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct FlankLines {
    /// d \[px\] and ϑ \[rad\] of the bisector.
    pub offset_px: f64,
    pub slope: f64,
    /// w₀ \[px\] and w₁.
    pub half_width_px: f64,
    pub taper: f64,
}
