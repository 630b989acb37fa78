//! The region of an image that shows a hand and not the plane.

/// Region of a hand: the points within a radius of a segment.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HandRegion {
    /// Its ends \[px\].
    pub ends_px: [[f64; 2]; 2],
    /// Radius about it \[px\].
    pub radius_px: f64,
}

impl HandRegion {
    /// Whether a point lies in it.
    #[inline(always)]
    pub(super) fn contains(&self, [u, v]: [f64; 2]) -> bool {
        let [[a, b], [c, d]] = self.ends_px;
        let (along, across) = (c - a, d - b);
        let length2 = (along * along + across * across).max(f64::MIN_POSITIVE);
        let part = (((u - a) * along + (v - b) * across) / length2).clamp(0.0, 1.0);
        let (du, dv) = (u - a - part * along, v - b - part * across);
        du * du + dv * dv <= self.radius_px * self.radius_px
    }
}
