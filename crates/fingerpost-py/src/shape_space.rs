//! `fingerpost._core.ShapeSpace`: one class over the core's spaces, whose dimensions are constants
//! of their types.

use crate::arrays::{
    UNIT_TOLERANCE, column, flat_table, matrix, point, same_length, table, unit_vectors, vector,
};
use crate::errors::{InvalidInputError, invalid_input};
use crate::numbers::whole;
use crate::template::PyTemplate;
use crate::words::Word;
use fingerpost_core::geometry::planar::{
    Affine, AffineMap, PlanarSpace, Rigid, RigidShear, Similarity, SimilarityShear, Translation,
};
use fingerpost_core::geometry::ribbon::{BandMeasure, RIBBON_DOF, Ribbon, RibbonVector, ribbon_of};
use fingerpost_core::geometry::shape_space::{Axis, PlacedSample, Pose, ShapeSpace};
use fingerpost_core::geometry::template::{TemplateSample, Thumb};
use fingerpost_core::nalgebra::{SVector, Vector2};
use fingerpost_core::{Error, Result};
use numpy::{PyArray1, PyArray2, PyUntypedArrayMethods};
use pyo3::prelude::*;

/// The core's spaces.
enum Space {
    Translation(Translation),
    Rigid(Rigid),
    RigidShear(RigidShear),
    Similarity(Similarity),
    SimilarityShear(SimilarityShear),
    Affine(Affine),
    Ribbon2(Ribbon<2>),
    Ribbon3(Ribbon<3>),
    Ribbon4(Ribbon<4>),
    Ribbon5(Ribbon<5>),
    Ribbon9(Ribbon<RIBBON_DOF>),
}

/// `$body`, with `$space` as the space of its own type.
macro_rules! in_each {
    ($any:expr, $space:ident => $body:expr) => {
        match $any {
            Space::Translation($space) => $body,
            Space::Rigid($space) => $body,
            Space::RigidShear($space) => $body,
            Space::Similarity($space) => $body,
            Space::SimilarityShear($space) => $body,
            Space::Affine($space) => $body,
            Space::Ribbon2($space) => $body,
            Space::Ribbon3($space) => $body,
            Space::Ribbon4($space) => $body,
            Space::Ribbon5($space) => $body,
            Space::Ribbon9($space) => $body,
        }
    };
}

/// Refusal of shape vectors that describe no hand.
trait Sound<const D: usize>: ShapeSpace<D> {
    fn check(&self, x: &SVector<f64, D>, pose: &Self::Pose) -> Result<()>;
}

macro_rules! maps_neither_mirror_nor_flatten {
    ($($space:ty: $dof:literal),+) => {
        $(impl Sound<$dof> for $space {
            fn check(&self, _x: &SVector<f64, $dof>, map: &AffineMap) -> Result<()> {
                map.decompose().map(drop)
            }
        })+
    };
}
maps_neither_mirror_nor_flatten!(
    Translation: 2, Rigid: 3, RigidShear: 4, Similarity: 4, SimilarityShear: 5, Affine: 6
);

impl<const D: usize> Sound<D> for Ribbon<D> {
    fn check(&self, x: &SVector<f64, D>, _pose: &Self::Pose) -> Result<()> {
        let full = self.full(x);
        let half_widths = [("half_width [px]", full[3]), ("thumb_half_width [px]", full[8])];
        match half_widths.into_iter().find(|(_, half_width)| *half_width < 0.0) {
            Some((what, value)) => Err(Error::OutOfRange { what, value, right: "not negative" }),
            None => Ok(()),
        }
    }
}

/// The allowed deformations of a template.
#[pyclass(name = "ShapeSpace", module = "fingerpost._core", frozen)]
pub struct PyShapeSpace {
    space: Space,
    kind: &'static str,
    /// The thumb's side of a band template; `None` for planar spaces, which take any template.
    bands: Option<Thumb>,
}

/// A space, and the shape vector of the map that it was made from.
type Through = (PyShapeSpace, Py<PyArray1<f64>>);

#[pymethods]
impl PyShapeSpace {
    /// (c): translation alone.
    #[staticmethod]
    fn translation(
        py: Python<'_>,
        centre_px: &Bound<'_, PyAny>,
        linear_px: &Bound<'_, PyAny>,
    ) -> PyResult<Through> {
        planar(py, "translation", Space::Translation, centre_px, linear_px)
    }

    /// (c, θ): rigid motion; size and shear are frozen.
    #[staticmethod]
    fn rigid(
        py: Python<'_>,
        centre_px: &Bound<'_, PyAny>,
        linear_px: &Bound<'_, PyAny>,
    ) -> PyResult<Through> {
        planar(py, "rigid", Space::Rigid, centre_px, linear_px)
    }

    /// (c, θ, κ): rigid motion and one shear along the finger.
    #[staticmethod]
    fn rigid_shear(
        py: Python<'_>,
        centre_px: &Bound<'_, PyAny>,
        linear_px: &Bound<'_, PyAny>,
    ) -> PyResult<Through> {
        planar(py, "rigid_shear", Space::RigidShear, centre_px, linear_px)
    }

    /// (c, θ, s): rigid motion and a common scale.
    #[staticmethod]
    fn similarity(
        py: Python<'_>,
        centre_px: &Bound<'_, PyAny>,
        linear_px: &Bound<'_, PyAny>,
    ) -> PyResult<Through> {
        planar(py, "similarity", Space::Similarity, centre_px, linear_px)
    }

    /// (c, θ, κ, s): rigid motion, one shear and a common scale.
    #[staticmethod]
    fn similarity_shear(
        py: Python<'_>,
        centre_px: &Bound<'_, PyAny>,
        linear_px: &Bound<'_, PyAny>,
    ) -> PyResult<Through> {
        planar(py, "similarity_shear", Space::SimilarityShear, centre_px, linear_px)
    }

    /// (c, a, b): any affine map.
    #[staticmethod]
    fn affine(
        py: Python<'_>,
        centre_px: &Bound<'_, PyAny>,
        linear_px: &Bound<'_, PyAny>,
    ) -> PyResult<Through> {
        planar(py, "affine", Space::Affine, centre_px, linear_px)
    }

    /// The band template: finger and thumb as spheres swept along straight spines.
    #[staticmethod]
    fn ribbon(
        py: Python<'_>,
        template: &PyTemplate,
        centre_px: &Bound<'_, PyAny>,
        linear_px: &Bound<'_, PyAny>,
        dof: &Bound<'_, PyAny>,
    ) -> PyResult<Through> {
        let map = affine_map(centre_px, linear_px)?;
        let proportions = template.0.proportions().ok_or_else(|| {
            InvalidInputError::new_err("template is a traced outline; only a pistol has bands")
        })?;
        let bands = Bands {
            held: ribbon_of(proportions, &map),
            measure: BandMeasure::of(proportions, map.linear.column(0).norm()),
            thumb: template.0.thumb(),
        };
        match whole(dof, "dof")? {
            2 => bands.free(py, Space::Ribbon2),
            3 => bands.free(py, Space::Ribbon3),
            4 => bands.free(py, Space::Ribbon4),
            5 => bands.free(py, Space::Ribbon5),
            RIBBON_DOF if bands.thumb != Thumb::None => bands.free(py, Space::Ribbon9),
            other => Err(InvalidInputError::new_err(format!(
                "dof is {other}; it must be 2, 3, 4, 5 or, for a template with a thumb, {RIBBON_DOF}"
            ))),
        }
    }

    /// Name of the constructor.
    #[getter]
    fn kind(&self) -> &'static str {
        self.kind
    }

    /// Name and unit of each component of the shape vector.
    #[getter]
    fn names(&self) -> Vec<&'static str> {
        in_each!(&self.space, space => names_of(space)).to_vec()
    }

    /// Degrees of freedom D.
    #[getter]
    fn dof(&self) -> usize {
        in_each!(&self.space, space => names_of(space)).len()
    }

    /// Deforms the template and places it in the image.
    #[pyo3(signature = (shape_vector, template, samples = None))]
    fn place(
        &self,
        py: Python<'_>,
        shape_vector: &Bound<'_, PyAny>,
        template: &PyTemplate,
        samples: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<PyPlacedContour> {
        let x = vector(shape_vector, "shape_vector")?;
        let samples = self.samples(py, template, samples)?;
        let placed = py
            .detach(|| in_each!(&self.space, space => placed(space, &x, &samples)))
            .map_err(invalid_input)?;
        Ok(PyPlacedContour {
            position_px: table(py, placed.iter().map(|(p, _)| p.position.coords.into()))?,
            normal: table(py, placed.iter().map(|(p, _)| p.normal.into()))?,
            hidden: column(py, placed.iter().map(|(_, hidden)| *hidden)),
        })
    }

    /// Derivatives of the contour's motion along its normals by the shape vector.
    #[pyo3(signature = (shape_vector, template, samples = None, *, normal = None))]
    fn normal_rows(
        &self,
        py: Python<'_>,
        shape_vector: &Bound<'_, PyAny>,
        template: &PyTemplate,
        samples: Option<&Bound<'_, PyAny>>,
        normal: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<Py<PyArray2<f64>>> {
        let x = vector(shape_vector, "shape_vector")?;
        let samples = self.samples(py, template, samples)?;
        let normals = normal.map(|normal| unit_vectors(normal, "normal")).transpose()?;
        let normals = normals.as_deref();
        if let Some(normals) = normals {
            same_length("normal", normals.len(), "samples", samples.len())?;
        }
        let rows = py
            .detach(|| in_each!(&self.space, space => normal_rows(space, &x, &samples, normals)))
            .map_err(invalid_input)?;
        flat_table(py, rows, self.dof())
    }

    /// The finger's axis in the image.
    fn axis(&self, shape_vector: &Bound<'_, PyAny>) -> PyResult<PyAxis> {
        let x = vector(shape_vector, "shape_vector")?;
        in_each!(&self.space, space => posed(space, &x).map(|(_, pose)| PyAxis(pose.axis())))
            .map_err(invalid_input)
    }

    /// Derivatives of the axis by the shape vector.
    fn axis_jacobian(
        &self,
        py: Python<'_>,
        shape_vector: &Bound<'_, PyAny>,
    ) -> PyResult<Py<PyArray2<f64>>> {
        let x = vector(shape_vector, "shape_vector")?;
        let rows = in_each!(&self.space, space => axis_jacobian(space, &x));
        flat_table(py, rows.map_err(invalid_input)?, self.dof())
    }

    fn __repr__(&self) -> String {
        format!("ShapeSpace.{}({})", self.kind, self.names().join(", "))
    }
}

impl PyShapeSpace {
    fn samples(
        &self,
        py: Python<'_>,
        template: &PyTemplate,
        samples: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<Vec<TemplateSample>> {
        let Some(thumb) = self.bands else { return template.samples(py, samples) };
        if template.0.proportions().is_some() && template.0.thumb() == thumb {
            return template.samples(py, samples);
        }
        Err(InvalidInputError::new_err(format!(
            "template is a {} with thumb={:?}; this band template is of a pistol with thumb={:?}",
            template.kind(),
            template.0.thumb().word(),
            thumb.word()
        )))
    }
}

/// A band template before its free components are chosen.
struct Bands {
    held: RibbonVector,
    measure: BandMeasure,
    thumb: Thumb,
}

impl Bands {
    fn free<const D: usize>(
        &self,
        py: Python<'_>,
        wrap: fn(Ribbon<D>) -> Space,
    ) -> PyResult<Through> {
        let space = Ribbon::<D>::about(&self.held, &self.measure).map_err(invalid_input)?;
        let space = PyShapeSpace { space: wrap(space), kind: "ribbon", bands: Some(self.thumb) };
        Ok((space, column(py, Ribbon::<D>::free(&self.held).iter().copied())))
    }
}

fn affine_map(centre_px: &Bound<'_, PyAny>, linear_px: &Bound<'_, PyAny>) -> PyResult<AffineMap> {
    let centre = point(centre_px, "centre_px")?;
    let linear = matrix::<2, 2>(linear_px, "linear_px", "(2, 2)")?;
    if let Some(&value) = centre.iter().find(|c| !c.is_finite()) {
        return Err(invalid_input(Error::NotFinite { what: "centre_px", value }));
    }
    let map = AffineMap { centre, linear };
    map.decompose().map_err(invalid_input)?;
    Ok(map)
}

fn planar<S: PlanarSpace<D>, const D: usize>(
    py: Python<'_>,
    kind: &'static str,
    wrap: fn(S) -> Space,
    centre_px: &Bound<'_, PyAny>,
    linear_px: &Bound<'_, PyAny>,
) -> PyResult<Through> {
    let map = affine_map(centre_px, linear_px)?;
    let (space, x) = S::through(&map).map_err(invalid_input)?;
    let space = PyShapeSpace { space: wrap(space), kind, bands: None };
    Ok((space, column(py, x.iter().copied())))
}

fn names_of<S: ShapeSpace<D>, const D: usize>(_space: &S) -> &'static [&'static str] {
    const { &S::NAMES }
}

/// The shape vector, checked, and its pose.
fn posed<S: Sound<D>, const D: usize>(space: &S, x: &[f64]) -> Result<(SVector<f64, D>, S::Pose)> {
    if x.len() != D {
        let what = "components of the shape vector";
        return Err(Error::WrongCount { what, given: x.len(), needed: D });
    }
    if let Some(index) = x.iter().position(|component| !component.is_finite()) {
        let what = "component of the shape vector";
        return Err(Error::NotFiniteAt { what, index, value: x[index] });
    }
    let x = SVector::from_column_slice(x);
    let pose = space.pose(&x);
    space.check(&x, &pose)?;
    Ok((x, pose))
}

/// The placed samples, and whether another limb hides each.
fn placed<S: Sound<D>, const D: usize>(
    space: &S,
    x: &[f64],
    samples: &[TemplateSample],
) -> Result<Vec<(PlacedSample, bool)>> {
    let (_, pose) = posed(space, x)?;
    samples
        .iter()
        .map(|sample| {
            let placed = pose.place(sample);
            // A thumb of zero length has no direction, and one of subnormal length a rounded one.
            let value = placed.normal.norm();
            if (value - 1.0).abs() <= UNIT_TOLERANCE {
                Ok((placed, pose.is_hidden(sample, &placed)))
            } else {
                let (what, right) = ("length of a normal of the placed contour", "1");
                Err(Error::OutOfRange { what, value, right })
            }
        })
        .collect()
}

/// Rows of the Jacobian for the given normals, or for those of the placed contour.
fn normal_rows<S: Sound<D>, const D: usize>(
    space: &S,
    x: &[f64],
    samples: &[TemplateSample],
    normals: Option<&[Vector2<f64>]>,
) -> Result<Vec<f64>> {
    let (_, pose) = posed(space, x)?;
    let placed = placed(space, x, samples)?;
    let normal = |i: usize| normals.map_or(placed[i].0.normal, |normals| normals[i]);
    let rows = samples.iter().enumerate().map(|(i, s)| space.normal_row(&pose, s, &normal(i)));
    Ok(rows.flat_map(|row| row.data.0[0]).collect())
}

fn axis_jacobian<S: Sound<D>, const D: usize>(space: &S, x: &[f64]) -> Result<Vec<f64>> {
    let (_, pose) = posed(space, x)?;
    let jacobian = space.axis_jacobian(&pose);
    Ok(jacobian.row_iter().flat_map(|row| row.iter().copied().collect::<Vec<_>>()).collect())
}

/// The template's outline in the image.
#[pyclass(name = "PlacedContour", module = "fingerpost._core", frozen, get_all)]
pub struct PyPlacedContour {
    /// Positions of the samples.
    position_px: Py<PyArray2<f64>>,
    /// Unit normals, out of the hand.
    normal: Py<PyArray2<f64>>,
    /// Whether the sample lies inside another limb.
    hidden: Py<PyArray1<bool>>,
}

#[pymethods]
impl PyPlacedContour {
    fn __repr__(&self, py: Python<'_>) -> String {
        format!("PlacedContour({} samples)", self.position_px.bind(py).shape()[0])
    }
}

/// The finger's axis in the image.
#[pyclass(name = "Axis", module = "fingerpost._core", frozen)]
pub struct PyAxis(Axis);

#[pymethods]
impl PyAxis {
    /// A point of the axis: the middle of the visible finger.
    #[getter]
    fn anchor_px(&self) -> (f64, f64) {
        (self.0.anchor.x, self.0.anchor.y)
    }

    /// The end of the axis at the finger's apex.
    #[getter]
    fn tip_px(&self) -> (f64, f64) {
        (self.0.tip.x, self.0.tip.y)
    }

    /// Direction of pointing.
    #[getter]
    fn angle_rad(&self) -> f64 {
        self.0.angle_rad
    }

    fn __repr__(&self) -> String {
        let Axis { anchor, tip, angle_rad } = self.0;
        format!(
            "Axis(anchor_px=({:.3}, {:.3}), tip_px=({:.3}, {:.3}), angle_rad={angle_rad:.5})",
            anchor.x, anchor.y, tip.x, tip.y
        )
    }
}
