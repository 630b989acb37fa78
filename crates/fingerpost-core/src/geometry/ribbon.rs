//! The band model: finger and thumb as bands with widths of their own.

use super::planar::{AffineMap, rigid_axis_jacobian};
use super::shape_space::{Axis, PlacedSample, Pose, ShapeSpace};
use super::template::{HALF_LENGTH, Limb, Proportions, TemplateSample, ThumbProportions};
use crate::{Error, Result};
use nalgebra::Point2;
use nalgebra::Rotation2;
use nalgebra::SMatrix;
use nalgebra::SVector;
use nalgebra::Vector2;

/// The band template: finger and thumb as spheres swept along two straight spines, each with its
/// own width in the image.
///
/// A planar map of a template scales the finger's width by the same factor as the thumb's length,
/// although the width of a finger is not foreshortened; that misfit turns the axis by degrees. Here
/// the finger's width and taper and the thumb's direction, length and width are independent, and
/// the axis is the spine: the silhouette of a surface of revolution is symmetric about it.
///
/// The shape vector begins with the finger's (c, θ, w, τ). `D` = 2, 3, 4 or 5 ends with the centre,
/// the angle, the half-width or the taper, so that a fit can free them in turn. `D` = 9 adds the
/// thumb's root, spine and half-width. With e the unit vector of pointing, n = (−e_v, e_u), s the
/// distance along the spine from the centre, ρ a unit vector and b⊥ the side of the thumb that
/// faces the fingertip:
///
/// ```text
/// finger:  X = c + s e + (w + τ s) N,        N = ρ₁ e + ρ₂ n
/// thumb:   X = c + r e + q b + w₂ N,         N = ρ₁ b̂ + ρ₂ b̂⊥
/// ```
///
/// Rows of the Jacobian (N is the normal, so everything along the contour drops out):
///
/// ```text
/// finger:  N_u  N_v  s ρ₂       1  s    0     0      0      0
/// thumb:   N_u  N_v  r (N·n)    0  0    N·e   q N_u  q N_v  1
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ribbon<const D: usize> {
    /// Values of the components that are not free.
    held: RibbonVector,
    measure: BandMeasure,
}

/// Parameters of a band template outside its shape vector.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BandMeasure {
    /// Pixels per unit of the template's p, positive.
    pub length_px: f64,
    /// Distance from the centre to the centre of the finger's round end \[px\].
    pub round_end_px: f64,
    /// +1 for a thumb on the right of the pointing direction, −1 for one on the left, 0 for none.
    pub side: f64,
}

impl BandMeasure {
    /// The parameters for a template of the given proportions, its finger `length_px` long.
    #[must_use]
    pub fn of(proportions: &Proportions, length_px: f64) -> Self {
        Self {
            length_px,
            round_end_px: (HALF_LENGTH - proportions.half_width) * length_px,
            side: proportions.thumb.as_ref().map_or(0.0, |(side, _)| side.sign()),
        }
    }

    /// The same finger, without a thumb unless `has_thumb`.
    #[must_use]
    pub fn with_thumb(&self, has_thumb: bool) -> Self {
        Self { side: if has_thumb { self.side } else { 0.0 }, ..*self }
    }
}

/// Components of the whole band template.
pub const RIBBON_DOF: usize = 9;

/// A shape vector of the whole band template.
pub type RibbonVector = SVector<f64, RIBBON_DOF>;

const RIBBON_NAMES: [&str; RIBBON_DOF] = [
    "c_u [px]",
    "c_v [px]",
    "theta [rad]",
    "half_width [px]",
    "taper [1]",
    "thumb_root [px]",
    "thumb_u [px]",
    "thumb_v [px]",
    "thumb_half_width [px]",
];

impl<const D: usize> Ribbon<D> {
    /// The space of the first `D` components about `held`, whose others are constant.
    ///
    /// # Errors
    /// When `held` is not finite or the length not positive.
    pub fn about(held: &RibbonVector, measure: &BandMeasure) -> Result<Self> {
        const { assert!(D >= 2 && D <= RIBBON_DOF, "a prefix of the band template") };
        Error::finite("band template", held.sum())?;
        Error::finite("middle of the round end [px]", measure.round_end_px)?;
        Error::within("finger length [px]", measure.length_px, "positive", |l| l > 0.0)?;
        Ok(Self { held: *held, measure: *measure })
    }

    /// All nine components.
    #[must_use]
    pub fn full(&self, x: &SVector<f64, D>) -> RibbonVector {
        let mut full = self.held;
        full.rows_mut(0, D).copy_from(x);
        full
    }

    /// The free components of `full`.
    #[must_use]
    pub fn free(full: &RibbonVector) -> SVector<f64, D> {
        full.fixed_rows::<D>(0).into_owned()
    }
}

/// The band template's shape vector for a template of the given proportions, undeformed at `map`.
#[must_use]
pub fn ribbon_of(proportions: &Proportions, map: &AffineMap) -> RibbonVector {
    let a = map.linear.column(0);
    let (length_px, e) = (a.norm(), a.normalize());
    let mut x = RibbonVector::zeros();
    (x[0], x[1], x[2]) = (map.centre.x, map.centre.y, e.y.atan2(e.x));
    x[3] = proportions.half_width * length_px;
    if let Some((side, thumb)) = &proportions.thumb {
        let ThumbProportions { base, angle_rad, length, half_width, .. } = thumb;
        let turned = Rotation2::new(side.sign() * angle_rad) * e;
        let spine = turned * ((length - half_width) * length_px);
        (x[5], x[6], x[7], x[8]) = (base * length_px, spine.x, spine.y, half_width * length_px);
    }
    x
}

/// The band template deformed by one shape vector.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RibbonPose {
    x: RibbonVector,
    measure: BandMeasure,
    e: Vector2<f64>,
    /// Unit vector of the thumb, and its side towards the fingertip.
    thumb: [Vector2<f64>; 2],
}

impl RibbonPose {
    fn centre(&self) -> Point2<f64> {
        Point2::new(self.x[0], self.x[1])
    }

    fn normal(&self) -> Vector2<f64> {
        Vector2::new(-self.e.y, self.e.x)
    }

    fn spine_of_thumb(&self) -> Vector2<f64> {
        Vector2::new(self.x[6], self.x[7])
    }

    /// Distance from the centre to the finger's apex: the far side of its round end.
    fn apex(&self) -> f64 {
        self.measure.round_end_px + self.half_width(self.measure.round_end_px)
    }

    /// Half-width of the finger at the distance `s` along its spine.
    fn half_width(&self, s: f64) -> f64 {
        self.x[3] + self.x[4] * s
    }
}

impl Pose for RibbonPose {
    fn place(&self, sample: &TemplateSample) -> PlacedSample {
        let radial = sample.radial;
        match sample.limb {
            Limb::Finger => {
                let s = self.measure.length_px * sample.along;
                let normal = self.e * radial.x + self.normal() * radial.y;
                let position = self.centre() + self.e * s + normal * self.half_width(s);
                PlacedSample { position, normal }
            }
            Limb::Thumb => {
                let normal = self.thumb[0] * radial.x + self.thumb[1] * radial.y;
                let root = self.centre() + self.e * self.x[5];
                let position = root + self.spine_of_thumb() * sample.along + normal * self.x[8];
                PlacedSample { position, normal }
            }
        }
    }

    fn axis(&self) -> Axis {
        Axis::of_finger(self.centre(), self.x[2], self.apex())
    }

    fn is_hidden(&self, sample: &TemplateSample, placed: &PlacedSample) -> bool {
        if self.measure.side == 0.0 {
            return false;
        }
        let d = placed.position - self.centre();
        match sample.limb {
            Limb::Thumb => {
                let s = d.dot(&self.e);
                s < self.apex() && self.normal().dot(&d).abs() < self.half_width(s)
            }
            Limb::Finger => {
                let d = d - self.e * self.x[5];
                let q = d.dot(&self.thumb[0]);
                q > 0.0
                    && q < self.spine_of_thumb().norm()
                    && self.thumb[1].dot(&d).abs() < self.x[8]
            }
        }
    }
}

impl<const D: usize> ShapeSpace<D> for Ribbon<D> {
    const NAMES: [&'static str; D] = {
        let mut names = [""; D];
        let mut i = 0;
        while i < D {
            names[i] = RIBBON_NAMES[i];
            i += 1;
        }
        names
    };
    type Pose = RibbonPose;

    fn pose(&self, x: &SVector<f64, D>) -> RibbonPose {
        let full = self.full(x);
        let (sin, cos) = full[2].sin_cos();
        let spine = Vector2::new(full[6], full[7]);
        let length = spine.norm();
        let along = if length > 0.0 { spine / length } else { Vector2::zeros() };
        let facing = Vector2::new(along.y, -along.x) * self.measure.side;
        RibbonPose {
            x: full,
            measure: self.measure,
            e: Vector2::new(cos, sin),
            thumb: [along, facing],
        }
    }

    fn normal_row(
        &self,
        pose: &RibbonPose,
        sample: &TemplateSample,
        n: &Vector2<f64>,
    ) -> SVector<f64, D> {
        let row = match sample.limb {
            Limb::Finger => {
                let s = self.measure.length_px * sample.along;
                [n.x, n.y, s * pose.normal().dot(n), 1.0, s, 0.0, 0.0, 0.0, 0.0]
            }
            Limb::Thumb => {
                let (root, q) = (pose.x[5], sample.along);
                let turn = root * pose.normal().dot(n);
                [n.x, n.y, turn, 0.0, 0.0, pose.e.dot(n), q * n.x, q * n.y, 1.0]
            }
        };
        SVector::<f64, D>::from_column_slice(&row[..D])
    }

    fn axis_jacobian(&self, pose: &RibbonPose) -> SMatrix<f64, 2, D> {
        rigid_axis_jacobian(&pose.e)
    }
}
