//! Planar shape spaces: the affine map and its subgroups.

use super::shape_space::{Axis, PlacedSample, Pose, ShapeSpace};
use super::template::{HALF_LENGTH, TemplateSample};
use crate::{Error, Result};
use nalgebra::Matrix2;
use nalgebra::Point2;
use nalgebra::Rotation2;
use nalgebra::SMatrix;
use nalgebra::SVector;
use nalgebra::Vector2;

/// (c): translation alone.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Translation {
    linear: Matrix2<f64>,
}

impl PlanarSpace<2> for Translation {
    fn through(map: &AffineMap) -> Result<(Self, SVector<f64, 2>)> {
        map.decompose()?;
        Ok((Self { linear: map.linear }, map.centre.coords))
    }
}

impl ShapeSpace<2> for Translation {
    const NAMES: [&'static str; 2] = ["c_u [px]", "c_v [px]"];
    type Pose = AffineMap;

    fn pose(&self, x: &SVector<f64, 2>) -> AffineMap {
        AffineMap { centre: Point2::from(*x), linear: self.linear }
    }

    fn normal_row(
        &self,
        _pose: &AffineMap,
        _sample: &TemplateSample,
        normal: &Vector2<f64>,
    ) -> SVector<f64, 2> {
        *normal
    }

    fn axis_jacobian(&self, pose: &AffineMap) -> SMatrix<f64, 2, 2> {
        rigid_axis_jacobian(&pose.direction())
    }
}

/// (c, θ): rigid motion in the image plane. Size and shear are frozen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rigid {
    size: Size,
    kappa: f64,
}

impl PlanarSpace<3> for Rigid {
    fn through(map: &AffineMap) -> Result<(Self, SVector<f64, 3>)> {
        let Decomposition { angle_rad, size, kappa } = map.decompose()?;
        Ok((Self { size, kappa }, SVector::from([map.centre.x, map.centre.y, angle_rad])))
    }
}

impl ShapeSpace<3> for Rigid {
    const NAMES: [&'static str; 3] = ["c_u [px]", "c_v [px]", "theta [rad]"];
    type Pose = AffineMap;

    fn pose(&self, x: &SVector<f64, 3>) -> AffineMap {
        composed([x[0], x[1]], x[2], self.size, self.kappa)
    }

    fn normal_row(
        &self,
        pose: &AffineMap,
        sample: &TemplateSample,
        normal: &Vector2<f64>,
    ) -> SVector<f64, 3> {
        SVector::from([normal.x, normal.y, pose.rotation_row(sample, normal)])
    }

    fn axis_jacobian(&self, pose: &AffineMap) -> SMatrix<f64, 2, 3> {
        rigid_axis_jacobian(&pose.direction())
    }
}

/// (c, θ, κ): rigid motion and one shear, the tracking space of the 1994 system.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RigidShear {
    size: Size,
}

impl PlanarSpace<4> for RigidShear {
    fn through(map: &AffineMap) -> Result<(Self, SVector<f64, 4>)> {
        let Decomposition { angle_rad, size, kappa } = map.decompose()?;
        Ok((Self { size }, SVector::from([map.centre.x, map.centre.y, angle_rad, kappa])))
    }
}

impl ShapeSpace<4> for RigidShear {
    const NAMES: [&'static str; 4] = ["c_u [px]", "c_v [px]", "theta [rad]", "kappa [px]"];
    type Pose = AffineMap;

    fn pose(&self, x: &SVector<f64, 4>) -> AffineMap {
        composed([x[0], x[1]], x[2], self.size, x[3])
    }

    fn normal_row(
        &self,
        pose: &AffineMap,
        sample: &TemplateSample,
        normal: &Vector2<f64>,
    ) -> SVector<f64, 4> {
        SVector::from([
            normal.x,
            normal.y,
            pose.rotation_row(sample, normal),
            pose.shear_row(sample, normal),
        ])
    }

    fn axis_jacobian(&self, pose: &AffineMap) -> SMatrix<f64, 2, 4> {
        rigid_axis_jacobian(&pose.direction())
    }
}

/// (c, θ, s): rigid motion and a common scale s of the frozen size; the space of a finger alone,
/// which determines neither shear nor length.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Similarity {
    size: Size,
    kappa: f64,
}

impl PlanarSpace<4> for Similarity {
    fn through(map: &AffineMap) -> Result<(Self, SVector<f64, 4>)> {
        let Decomposition { angle_rad, size, kappa } = map.decompose()?;
        Ok((Self { size, kappa }, SVector::from([map.centre.x, map.centre.y, angle_rad, 1.0])))
    }
}

impl ShapeSpace<4> for Similarity {
    const NAMES: [&'static str; 4] = ["c_u [px]", "c_v [px]", "theta [rad]", "scale [1]"];
    type Pose = AffineMap;

    fn pose(&self, x: &SVector<f64, 4>) -> AffineMap {
        let size = Size { alpha: x[3] * self.size.alpha, beta: x[3] * self.size.beta };
        composed([x[0], x[1]], x[2], size, x[3] * self.kappa)
    }

    fn normal_row(
        &self,
        pose: &AffineMap,
        sample: &TemplateSample,
        normal: &Vector2<f64>,
    ) -> SVector<f64, 4> {
        let e = pose.direction();
        let (p, q) = (sample.position.x, sample.position.y);
        let along = self.size.alpha * p + self.kappa * q;
        SVector::from([
            normal.x,
            normal.y,
            pose.rotation_row(sample, normal),
            along * normal.dot(&e) + self.size.beta * q * e.perp(normal),
        ])
    }

    fn axis_jacobian(&self, pose: &AffineMap) -> SMatrix<f64, 2, 4> {
        rigid_axis_jacobian(&pose.direction())
    }
}

/// (c, θ, κ, s): rigid motion, one shear and a common scale s of the frozen size.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SimilarityShear {
    size: Size,
}

impl PlanarSpace<5> for SimilarityShear {
    fn through(map: &AffineMap) -> Result<(Self, SVector<f64, 5>)> {
        let Decomposition { angle_rad, size, kappa } = map.decompose()?;
        Ok((Self { size }, SVector::from([map.centre.x, map.centre.y, angle_rad, kappa, 1.0])))
    }
}

impl ShapeSpace<5> for SimilarityShear {
    const NAMES: [&'static str; 5] =
        ["c_u [px]", "c_v [px]", "theta [rad]", "kappa [px]", "scale [1]"];
    type Pose = AffineMap;

    fn pose(&self, x: &SVector<f64, 5>) -> AffineMap {
        let size = Size { alpha: x[4] * self.size.alpha, beta: x[4] * self.size.beta };
        composed([x[0], x[1]], x[2], size, x[3])
    }

    fn normal_row(
        &self,
        pose: &AffineMap,
        sample: &TemplateSample,
        normal: &Vector2<f64>,
    ) -> SVector<f64, 5> {
        let e = pose.direction();
        let (p, q) = (sample.position.x, sample.position.y);
        let per_scale = self.size.alpha * p * normal.dot(&e) + self.size.beta * q * e.perp(normal);
        SVector::from([
            normal.x,
            normal.y,
            pose.rotation_row(sample, normal),
            pose.shear_row(sample, normal),
            per_scale,
        ])
    }

    fn axis_jacobian(&self, pose: &AffineMap) -> SMatrix<f64, 2, 5> {
        rigid_axis_jacobian(&pose.direction())
    }
}

/// (c, a, b): any affine map, the acquisition space of the 1994 system.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Affine;

impl PlanarSpace<6> for Affine {
    fn through(map: &AffineMap) -> Result<(Self, SVector<f64, 6>)> {
        map.decompose()?;
        let m = &map.linear;
        let x = [map.centre.x, map.centre.y, m[(0, 0)], m[(1, 0)], m[(0, 1)], m[(1, 1)]];
        Ok((Self, SVector::from(x)))
    }
}

impl ShapeSpace<6> for Affine {
    const NAMES: [&'static str; 6] =
        ["c_u [px]", "c_v [px]", "a_u [px]", "a_v [px]", "b_u [px]", "b_v [px]"];
    type Pose = AffineMap;

    fn pose(&self, x: &SVector<f64, 6>) -> AffineMap {
        AffineMap { centre: Point2::new(x[0], x[1]), linear: Matrix2::new(x[2], x[4], x[3], x[5]) }
    }

    fn normal_row(
        &self,
        _pose: &AffineMap,
        sample: &TemplateSample,
        n: &Vector2<f64>,
    ) -> SVector<f64, 6> {
        let (p, q) = (sample.position.x, sample.position.y);
        SVector::from([n.x, n.y, p * n.x, p * n.y, q * n.x, q * n.y])
    }

    fn axis_jacobian(&self, pose: &AffineMap) -> SMatrix<f64, 2, 6> {
        let e = pose.direction();
        let length = pose.linear.column(0).norm();
        let mut j = SMatrix::<f64, 2, 6>::zeros();
        (j[(0, 0)], j[(0, 1)]) = (-e.y, e.x);
        (j[(1, 2)], j[(1, 3)]) = (-e.y / length, e.x / length);
        j
    }
}

/// The image of the template under x = c + \[a b\] m, for every planar shape vector.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AffineMap {
    /// Image of the template's origin, the middle of the finger \[px\].
    pub centre: Point2<f64>,
    /// \[a b\]: images of the basis vectors along and across the finger \[px\].
    pub linear: Matrix2<f64>,
}

impl AffineMap {
    /// The undeformed template of finger length `length_px`, with its axis's tip at `tip`, pointing
    /// along `angle_rad`.
    ///
    /// # Errors
    /// When a value is not finite or the length is not positive.
    pub fn upright(tip: Point2<f64>, angle_rad: f64, length_px: f64) -> Result<Self> {
        for (what, value) in
            [("tip u [px]", tip.x), ("tip v [px]", tip.y), ("angle [rad]", angle_rad)]
        {
            Error::finite(what, value)?;
        }
        Error::within("finger length [px]", length_px, "positive", |l| l > 0.0)?;
        Error::finite("middle of the finger [px]", tip.coords.sum() - length_px)?;
        let linear = Rotation2::new(angle_rad).into_inner() * length_px;
        Ok(Self { centre: tip - linear.column(0) * HALF_LENGTH, linear })
    }

    /// Image of a template point.
    #[must_use]
    pub fn transform(&self, m: &Point2<f64>) -> Point2<f64> {
        self.centre + self.linear * m.coords
    }

    /// θ, and the remaining size and shear: A = R(θ) [[α, κ], [0, β]].
    ///
    /// # Errors
    /// When the map mirrors or flattens the template (det A ≤ 0). The image of a hand is never
    /// mirrored: the thumb's side belongs to the template.
    pub fn decompose(&self) -> Result<Decomposition> {
        let (a, b) = (self.linear.column(0), self.linear.column(1));
        let alpha = Error::within("finger scale α [px]", a.norm(), "positive", |s| s > 0.0)?;
        let e = a / alpha;
        let kappa = Error::finite("shear κ [px]", e.dot(&b))?;
        let beta =
            Error::within("scale across the finger β [px]", e.perp(&b), "positive", |s| s > 0.0)?;
        Ok(Decomposition { angle_rad: e.y.atan2(e.x), size: Size { alpha, beta }, kappa })
    }
}

impl AffineMap {
    /// Unit vector along the finger.
    fn direction(&self) -> Vector2<f64> {
        self.linear.column(0).normalize()
    }

    /// The normal displacement per radian about the centre: −n_u d_v + n_v d_u, d = A m.
    fn rotation_row(&self, sample: &TemplateSample, normal: &Vector2<f64>) -> f64 {
        (self.linear * sample.position.coords).perp(normal)
    }

    /// The normal displacement per unit of κ: q (n · R e₁).
    fn shear_row(&self, sample: &TemplateSample, normal: &Vector2<f64>) -> f64 {
        sample.position.y * normal.dot(&self.direction())
    }
}

impl Pose for AffineMap {
    fn place(&self, sample: &TemplateSample) -> PlacedSample {
        let m = &self.linear;
        let n = &sample.normal;
        // Normals transform by the cofactor matrix of A; a positive determinant keeps them outward.
        let normal =
            Vector2::new(m[(1, 1)] * n.x - m[(1, 0)] * n.y, m[(0, 0)] * n.y - m[(0, 1)] * n.x);
        PlacedSample { position: self.transform(&sample.position), normal: normal / normal.norm() }
    }

    fn axis(&self) -> Axis {
        let a = self.linear.column(0);
        Axis { anchor: self.centre, tip: self.centre + a * HALF_LENGTH, angle_rad: a.y.atan2(a.x) }
    }
}

/// ∂(offset, angle)/∂(c, θ, …) of an axis along e; the third component, if any, is its angle.
pub(super) fn rigid_axis_jacobian<const D: usize>(e: &Vector2<f64>) -> SMatrix<f64, 2, D> {
    let mut j = SMatrix::<f64, 2, D>::zeros();
    j[(0, 0)] = -e.y;
    j[(0, 1)] = e.x;
    if D > 2 {
        j[(1, 2)] = 1.0;
    }
    j
}

/// The size that is frozen in tracking \[px per template unit\]: α along the finger, β across.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Size {
    /// Scale along the finger, positive.
    pub alpha: f64,
    /// Scale across the finger, positive.
    pub beta: f64,
}

/// The linear part of an [`AffineMap`] as R(θ) · [[α, κ], [0, β]].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Decomposition {
    /// θ, in (−π, π].
    pub angle_rad: f64,
    /// α and β.
    pub size: Size,
    /// κ, the shear along the finger \[px per template unit\].
    pub kappa: f64,
}

/// A shape space whose every member is a planar affine map of the template.
pub trait PlanarSpace<const D: usize>: ShapeSpace<D, Pose = AffineMap> + Sized {
    /// The space through `map`, and the shape vector of `map` in it. Components outside the space
    /// are frozen at the map's values.
    ///
    /// # Errors
    /// When the map mirrors or flattens the template; see [`AffineMap::decompose`].
    fn through(map: &AffineMap) -> Result<(Self, SVector<f64, D>)>;
}

fn composed(centre: [f64; 2], angle_rad: f64, size: Size, kappa: f64) -> AffineMap {
    let upper = Matrix2::new(size.alpha, kappa, 0.0, size.beta);
    AffineMap {
        centre: Point2::from(centre),
        linear: Rotation2::new(angle_rad).into_inner() * upper,
    }
}
