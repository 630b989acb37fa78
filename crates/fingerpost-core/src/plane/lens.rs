//! Radial distortion of a view (Brown 1971): a direction m with r = |m| is shown at
//! m (1 + k₁ r² + k₂ r⁴), up to the radius at which the model folds back.

/// Pinhole and radial distortion of one view.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RadialLens {
    /// Focal lengths \[px\], positive.
    pub focal_px: [f64; 2],
    /// Principal point \[px\].
    pub centre_px: [f64; 2],
    /// Coefficients k₁ and k₂.
    pub k: [f64; 2],
    /// Radius |m| from which on the model does not hold; infinite if it nowhere folds back.
    pub max_radius: f64,
}

impl RadialLens {
    /// The distorted position of a point of the pinhole image \[px\]; NaN beyond `max_radius`.
    #[inline(always)]
    pub(super) fn distort(&self, [u, v]: [f64; 2]) -> [f64; 2] {
        let ([fx, fy], [cx, cy]) = (self.focal_px, self.centre_px);
        let (x, y) = ((u - cx) / fx, (v - cy) / fy);
        let r2 = x * x + y * y;
        if r2 < self.max_radius * self.max_radius {
            let stretch = 1.0 + r2 * (self.k[0] + r2 * self.k[1]);
            [x * stretch * fx + cx, y * stretch * fy + cy]
        } else {
            [f64::NAN; 2]
        }
    }
}
