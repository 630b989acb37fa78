//! `fingerpost._core.sample_contour`.

use crate::arrays::{column, points, table};
use crate::bspline::PyBSpline;
use crate::errors::invalid_input;
use crate::numbers::count;
use crate::words::Word;
use fingerpost_core::geometry::contour::{self, HandSide};
use numpy::{PyArray1, PyArray2, PyUntypedArrayMethods};
use pyo3::prelude::*;

/// Samples of a contour at equal steps of arc length.
#[pyclass(name = "ContourSamples", module = "fingerpost._core", frozen, get_all)]
pub struct PyContourSamples {
    /// The curve's parameter.
    parameter: Py<PyArray1<f64>>,
    /// Length of the curve from its start.
    arc_length: Py<PyArray1<f64>>,
    /// Positions of the samples.
    position: Py<PyArray2<f64>>,
    /// Unit tangents in the direction of travel.
    tangent: Py<PyArray2<f64>>,
    /// Unit normals, out of the hand.
    normal: Py<PyArray2<f64>>,
}

#[pymethods]
impl PyContourSamples {
    fn __repr__(&self, py: Python<'_>) -> String {
        format!("ContourSamples({} samples)", self.position.bind(py).shape()[0])
    }
}

/// Samples a curve at equal steps of arc length, with tangents and outward normals.
#[pyfunction]
pub fn sample_contour(
    py: Python<'_>,
    spline: &PyBSpline,
    control_points: &Bound<'_, PyAny>,
    samples: &Bound<'_, PyAny>,
    hand: &Bound<'_, PyAny>,
) -> PyResult<PyContourSamples> {
    let control_points = points(control_points, "control_points")?;
    let (samples, hand) = (count(samples, "samples")?, HandSide::parse(hand, "hand")?);
    let samples = py
        .detach(|| contour::sample(&spline.0, &control_points, samples, hand))
        .map_err(invalid_input)?;
    Ok(PyContourSamples {
        parameter: column(py, samples.iter().map(|s| s.parameter)),
        arc_length: column(py, samples.iter().map(|s| s.arc_length)),
        position: table(py, samples.iter().map(|s| s.position.coords.into()))?,
        tangent: table(py, samples.iter().map(|s| s.tangent.into()))?,
        normal: table(py, samples.iter().map(|s| s.normal.into()))?,
    })
}
