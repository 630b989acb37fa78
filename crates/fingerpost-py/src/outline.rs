//! `fingerpost._core.edges_along` and `fit_line`.

use crate::arrays::{column, points, table, vector};
use crate::errors::{invalid_input, wrong};
use crate::image::FrameArrays;
use crate::numbers::real;
use fingerpost_core::measure::outline::{self, EdgePoint, EdgePolarity, LineFit};
use numpy::{PyArray1, PyArray2};
use pyo3::prelude::*;

/// The edges along a path, one per stretch that has one.
#[pyclass(name = "EdgePoints", module = "fingerpost._core", frozen)]
pub struct PyEdgePoints(Vec<EdgePoint>);

#[pymethods]
impl PyEdgePoints {
    fn __len__(&self) -> usize {
        self.0.len()
    }

    /// Where they are, (N, 2).
    #[getter]
    fn position_px(&self, py: Python<'_>) -> PyResult<Py<PyArray2<f64>>> {
        table(py, self.0.iter().map(|edge| [edge.position.x, edge.position.y]))
    }

    /// Their distances from the path, (N,).
    #[getter]
    fn offset_px(&self, py: Python<'_>) -> Py<PyArray1<f64>> {
        column(py, self.0.iter().map(|edge| edge.offset_px))
    }

    /// The steps of grey levels across them, (N,).
    #[getter]
    fn contrast(&self, py: Python<'_>) -> Py<PyArray1<f64>> {
        column(py, self.0.iter().map(|edge| edge.contrast))
    }

    /// Standard deviations of the distances, (N,).
    #[getter]
    fn sigma_px(&self, py: Python<'_>) -> Py<PyArray1<f64>> {
        column(py, self.0.iter().map(|edge| edge.sigma_px))
    }
}

/// A line through edges.
#[pyclass(name = "LineFit", module = "fingerpost._core", frozen)]
pub struct PyLineFit(LineFit);

#[pymethods]
impl PyLineFit {
    /// A point in the middle of its edges.
    #[getter]
    fn point_px(&self) -> (f64, f64) {
        (self.0.point.x, self.0.point.y)
    }

    /// Its direction.
    #[getter]
    fn angle_rad(&self) -> f64 {
        self.0.angle_rad
    }

    /// Covariance of offset and angle, (2, 2).
    #[getter]
    fn covariance(&self, py: Python<'_>) -> PyResult<Py<PyArray2<f64>>> {
        let c = &self.0.covariance;
        table(py, [[c[(0, 0)], c[(0, 1)]], [c[(1, 0)], c[(1, 1)]]])
    }

    /// The part of the edges that lie on it.
    #[getter]
    fn share(&self) -> f64 {
        self.0.share
    }

    /// Which edges lie on it, (N,).
    #[getter]
    fn inliers(&self, py: Python<'_>) -> Py<PyArray1<bool>> {
        column(py, self.0.inliers.iter().copied())
    }

    /// Root mean square of their residuals.
    #[getter]
    fn rms_px(&self) -> f64 {
        self.0.rms_px
    }
}

/// Locates an edge along a path.
#[pyfunction]
#[pyo3(signature = (image, path_px, reach_px, polarity, least_contrast))]
pub fn edges_along(
    py: Python<'_>,
    image: &Bound<'_, PyAny>,
    path_px: &Bound<'_, PyAny>,
    reach_px: &Bound<'_, PyAny>,
    polarity: &Bound<'_, PyAny>,
    least_contrast: &Bound<'_, PyAny>,
) -> PyResult<PyEdgePoints> {
    let arrays = FrameArrays::new(image, None)?;
    let gray = *arrays.frame()?.image();
    let path = points(path_px, "path_px")?;
    let reach_px = real(reach_px, "reach_px")?;
    let least_contrast = real(least_contrast, "least_contrast")?;
    let polarity = match polarity.extract::<i32>() {
        Ok(0) => EdgePolarity::Any,
        Ok(1) => EdgePolarity::Rising,
        Ok(-1) => EdgePolarity::Falling,
        _ => return Err(wrong("polarity", polarity, "-1, 0 or 1")),
    };
    let edges =
        py.detach(|| outline::edges_along(&gray, &path, reach_px, polarity, least_contrast));
    edges.map(PyEdgePoints).map_err(invalid_input)
}

/// Fits the line that most edges lie on.
#[pyfunction]
pub fn fit_line(
    py: Python<'_>,
    points_px: &Bound<'_, PyAny>,
    sigmas_px: &Bound<'_, PyAny>,
) -> PyResult<Option<PyLineFit>> {
    let points = points(points_px, "points_px")?;
    let sigmas = vector(sigmas_px, "sigmas_px")?;
    let line = py.detach(|| outline::fit_line(&points, &sigmas)).map_err(invalid_input)?;
    Ok(line.map(PyLineFit))
}
