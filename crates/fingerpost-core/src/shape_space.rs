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

use crate::template::{HALF_LENGTH, Limb, Proportions, TemplateSample, ThumbProportions};
use crate::{Error, Result};
use nalgebra::{Matrix2, Point2, Rotation2, SMatrix, SVector, Vector2};

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

/// The image of the template under x = c + \[a b\] m: what every planar shape vector stands for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AffineMap {
    /// Image of the template's origin, the middle of the finger \[px\].
    pub centre: Point2<f64>,
    /// \[a b\]: images of the basis vectors along and across the finger \[px\].
    pub linear: Matrix2<f64>,
}

impl AffineMap {
    /// The undeformed template of finger length `length_px`, its axis's tip at `tip`, pointing
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

    /// Where the map puts a template point.
    #[must_use]
    pub fn transform(&self, m: &Point2<f64>) -> Point2<f64> {
        self.centre + self.linear * m.coords
    }

    /// θ, and the frozen size that remains: A = R(θ) [[α, κ], [0, β]].
    ///
    /// # Errors
    /// When the map mirrors or flattens the template (det A ≤ 0): a hand cannot do that in an
    /// image, the thumb's side belongs to the template.
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

impl Pose for AffineMap {
    fn place(&self, sample: &TemplateSample) -> PlacedSample {
        let m = &self.linear;
        let n = &sample.normal;
        // Normals go with the cofactor matrix of A; a positive determinant keeps them outward.
        let normal =
            Vector2::new(m[(1, 1)] * n.x - m[(1, 0)] * n.y, m[(0, 0)] * n.y - m[(0, 1)] * n.x);
        PlacedSample { position: self.transform(&sample.position), normal: normal / normal.norm() }
    }

    fn axis(&self) -> Axis {
        let a = self.linear.column(0);
        Axis { anchor: self.centre, tip: self.centre + a * HALF_LENGTH, angle_rad: a.y.atan2(a.x) }
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

/// ∂(offset, angle)/∂(c, θ, …) of an axis along e; the third component, if any, is its angle.
fn rigid_axis_jacobian<const D: usize>(e: &Vector2<f64>) -> SMatrix<f64, 2, D> {
    let mut j = SMatrix::<f64, 2, D>::zeros();
    j[(0, 0)] = -e.y;
    j[(0, 1)] = e.x;
    if D > 2 {
        j[(1, 2)] = 1.0;
    }
    j
}

/// The size that tracking holds fixed \[px per template unit\]: α along the finger, β across.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Size {
    /// Scale along the finger, positive.
    pub alpha: f64,
    /// Scale across the finger, positive.
    pub beta: f64,
}

/// An [`AffineMap`]'s linear part as R(θ) · [[α, κ], [0, β]].
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
    /// The space through `map`, and the shape vector that stands for it there: what the space
    /// holds fixed is frozen at the map's values.
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

/// (c): the template moves and nothing else.
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
/// which has nothing to show a shear or a length.
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

/// The band template: finger and thumb as spheres swept along two straight spines, each band as wide
/// as the image shows it.
///
/// A planar map of a template widens a finger by the same factor that it stretches the thumb,
/// although a finger keeps its width when it is foreshortened; that misfit turns the axis by
/// degrees. Here the finger's width and taper and the thumb's direction, length and width are free
/// of one another, and the axis is the spine: the silhouette of a surface of revolution.
///
/// The shape vector begins with the finger's (c, θ, w, τ); `D` = 2, 3, 4 or 5 stops after the
/// centre, the angle, the half-width or the taper, so that a fit can free them in turn. `D` = 9 adds
/// the thumb's root, spine and half-width. With e the unit vector of pointing, n = (−e_v, e_u), s
/// the distance along the spine from the centre, ρ a unit vector and b⊥ the side of the thumb that
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
    /// Where the rest of the shape vector is held.
    held: RibbonVector,
    measure: BandMeasure,
}

/// What a band template's shape vector leaves open: where along the finger the samples stand.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BandMeasure {
    /// Pixels per unit of the template's p, positive.
    pub length_px: f64,
    /// Distance from the centre to the middle of the finger's round end \[px\].
    pub round_end_px: f64,
    /// +1 for a thumb on the right of the pointing direction, −1 for one on the left, 0 for none.
    pub side: f64,
}

impl BandMeasure {
    /// That of a template of the given proportions, its finger `length_px` long.
    #[must_use]
    pub fn of(proportions: &Proportions, length_px: f64) -> Self {
        Self {
            length_px,
            round_end_px: (HALF_LENGTH - proportions.half_width) * length_px,
            side: proportions.thumb.as_ref().map_or(0.0, |(side, _)| side.sign()),
        }
    }

    /// The same finger, its thumb left out unless `has_thumb`.
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
    /// The space of the first `D` components about `held`, whose others stay as they are.
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

/// The band template as one shape vector deforms it.
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

    /// Half the finger's width at the distance `s` along its spine.
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
