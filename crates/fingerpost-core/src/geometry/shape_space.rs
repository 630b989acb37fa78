//! Shape spaces: the allowed deformations of the template, and the motion of the image contour
//! under them.
//!
//! A template point m = (p, q) lies at p along the index finger (towards the tip) and q across it;
//! the origin is the middle of the finger. Its image is
//!
//! ```text
//! x = c + A m,    A = [a b] = R(θ) · [[α, κ], [0, β]]
//! ```
//!
//! so a = α R e₁ is the finger's basis vector, and the shear κ runs *along* the finger: the
//! finger's axis and flanks stay parallel to `a` at a constant distance while the thumb leans. (The
//! other shear would turn the index finger away from its basis vector.) The spaces differ in the
//! free components of (c, θ, κ, α, β); all share one trait and one kind of shape vector. The first
//! two components are always the centre c.
//!
//! Source: Cipolla, Hadfield & Hollinghurst 1994, section 3.2; Blake & Isard, *Active Contours*,
//! chapter 4, for shape spaces.

use super::template::TemplateSample;
use nalgebra::{Point2, SMatrix, SVector, Vector2};

/// A sample of the contour placed in the image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlacedSample {
    /// Position of the sample \[px\].
    pub position: Point2<f64>,
    /// Unit normal, pointing out of the hand. On a band it is that of its spheres; it deviates from
    /// the normal of a tapering flank by the taper's angle, which does not move an edge along it.
    pub normal: Vector2<f64>,
}

/// The finger's axis in the image for a shape vector.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Axis {
    /// A point of the axis: the middle of the visible finger \[px\].
    pub anchor: Point2<f64>,
    /// The end of the axis at the finger's apex \[px\].
    pub tip: Point2<f64>,
    /// Direction of pointing \[rad\], from +u towards +v, in (−π, π].
    pub angle_rad: f64,
}

impl Axis {
    /// The axis of a finger whose tip lies `ahead_px` from the anchor; the angle may be any.
    #[must_use]
    pub fn of_finger(anchor: Point2<f64>, angle_rad: f64, ahead_px: f64) -> Self {
        let (sin, cos) = angle_rad.sin_cos();
        let tip = anchor + Vector2::new(cos, sin) * ahead_px;
        Self { anchor, tip, angle_rad: sin.atan2(cos) }
    }

    /// Unit vector of pointing.
    #[must_use]
    pub fn direction(&self) -> Vector2<f64> {
        let (sin, cos) = self.angle_rad.sin_cos();
        Vector2::new(cos, sin)
    }

    /// Unit normal n = (−sin, cos) of the axis; offsets of the finger line are positive along it.
    #[must_use]
    pub fn normal(&self) -> Vector2<f64> {
        let (sin, cos) = self.angle_rad.sin_cos();
        Vector2::new(-sin, cos)
    }
}

/// The template deformed by one shape vector; quantities common to all samples are computed once.
pub trait Pose {
    /// Position of a template sample in the image, with its normal.
    fn place(&self, sample: &TemplateSample) -> PlacedSample;

    /// The finger's axis.
    fn axis(&self) -> Axis;

    /// Whether a placed sample lies inside another limb of the hand, where there is no edge.
    fn is_hidden(&self, _sample: &TemplateSample, _placed: &PlacedSample) -> bool {
        false
    }
}

/// An allowed family of deformations with `D` degrees of freedom.
pub trait ShapeSpace<const D: usize> {
    /// Name of each component of the shape vector, with its unit.
    const NAMES: [&'static str; D];

    /// The deformed template in the image.
    type Pose: Pose;

    /// The pose for the shape vector `x`.
    fn pose(&self, x: &SVector<f64, D>) -> Self::Pose;

    /// ∂(n·X)/∂x of a sample for the unit normal n given by [`Pose::place`]: motion of the contour
    /// along that normal per component \[px per unit\].
    fn normal_row(
        &self,
        pose: &Self::Pose,
        sample: &TemplateSample,
        normal: &Vector2<f64>,
    ) -> SVector<f64, D>;

    /// ∂(offset, angle)/∂x of the axis at its anchor: the offset \[px\] along [`Axis::normal`], the
    /// angle in radians.
    fn axis_jacobian(&self, pose: &Self::Pose) -> SMatrix<f64, 2, D>;
}
