//! Which deformations of the template are allowed, and how the image contour moves with them.
//!
//! A template point m = (p, q) lies at p along the index finger (towards the tip) and q across it;
//! the origin is the middle of the finger. In the image it stands at
//!
//! ```text
//! x = c + A m,    A = [a b] = R(θ) · [[α, κ], [0, β]]
//! ```
//!
//! so a = α R e₁ is the finger's basis vector, and the shear κ runs *along* the finger: the
//! finger's axis and flanks stay parallel to `a` and keep their distance while the thumb leans.
//! (A shear the other way would turn the index finger off its basis vector.) The spaces differ
//! in what of (c, θ, κ, α, β) is free; all share one trait and one kind of shape vector.
//! Every one has its first two components equal to the centre c.
//!
//! Source: Cipolla, Hadfield & Hollinghurst 1994, section 3.2; Blake & Isard, *Active Contours*,
//! chapter 4, for shape spaces.

use super::template::TemplateSample;
use nalgebra::{Point2, SMatrix, SVector, Vector2};

/// A sample of the contour placed in the image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlacedSample {
    /// Where the sample stands \[px\].
    pub position: Point2<f64>,
    /// Unit normal, pointing out of the hand. A band's is that of its spheres; a tapering flank is
    /// off it by the taper's angle, which moves no edge along it.
    pub normal: Vector2<f64>,
}

/// The finger's axis in the image, as a shape vector has it.
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

/// The template as one shape vector deforms it: everything that the samples share, worked out once.
pub trait Pose {
    /// Where a template sample stands in the image.
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
    /// What each component of the shape vector is, with its unit.
    const NAMES: [&'static str; D];

    /// The template in the image, deformed.
    type Pose: Pose;

    /// The pose that the shape vector `x` stands for.
    fn pose(&self, x: &SVector<f64, D>) -> Self::Pose;

    /// ∂(n·X)/∂x of a sample for the unit normal n that [`Pose::place`] gave it: how far each
    /// component moves the contour along that normal \[px per unit\].
    fn normal_row(
        &self,
        pose: &Self::Pose,
        sample: &TemplateSample,
        normal: &Vector2<f64>,
    ) -> SVector<f64, D>;

    /// ∂(offset, angle)/∂x of the axis at its anchor: the offset \[px\] along [`Axis::normal`],
    /// the angle in radians.
    fn axis_jacobian(&self, pose: &Self::Pose) -> SMatrix<f64, 2, D>;
}
