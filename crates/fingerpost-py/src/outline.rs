//! `fingerpost._core.edges_along` and `fit_line`.

use crate::arrays::{column, points, table, vector};
use crate::errors::{invalid_input, wrong};
use crate::image::FrameArrays;
use crate::numbers::real;
use fingerpost_core::measure::outline::{self, EdgePoint, EdgePolarity, LineFit};
use numpy::{PyArray1, PyArray2};
use pyo3::prelude::*;

/// Edges along a path, at most one for each stretch.
#[pyclass(name = "EdgePoints", module = "fingerpost._core", frozen)]
pub struct PyEdgePoints(Vec<EdgePoint>);

#[pymethods]
impl PyEdgePoints {
    fn __len__(&self) -> usize {
        self.0.len()
    }

    /// Positions of the edges, (N, 2).
    #[getter]
    fn position_px(&self, py: Python<'_>) -> PyResult<Py<PyArray2<f64>>> {
        table(py, self.0.iter().map(|edge| [edge.position.x, edge.position.y]))
    }

    /// Signed distances of the edges from the path, (N,).
    #[getter]
    fn offset_px(&self, py: Python<'_>) -> Py<PyArray1<f64>> {
        column(py, self.0.iter().map(|edge| edge.offset_px))
    }

    /// Steps across the edges, (N,).
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

/// The line with the largest consensus among edges.
#[pyclass(name = "LineFit", module = "fingerpost._core", frozen)]
pub struct PyLineFit(LineFit);

#[pymethods]
impl PyLineFit {
    /// A point of the line, in the middle of the inliers.
    #[getter]
    fn point_px(&self) -> (f64, f64) {
        (self.0.point.x, self.0.point.y)
    }

    /// Direction of the line, determined up to a half turn.
    #[getter]
    fn angle_rad(&self) -> f64 {
        self.0.angle_rad
    }

    /// Covariance of (offset, angle), (2, 2).
    #[getter]
    fn covariance(&self, py: Python<'_>) -> PyResult<Py<PyArray2<f64>>> {
        let c = &self.0.covariance;
        table(py, [[c[(0, 0)], c[(0, 1)]], [c[(1, 0)], c[(1, 1)]]])
    }

    /// Fraction of the edges that are inliers.
    #[getter]
    fn share(&self) -> f64 {
        self.0.share
    }

    /// Whether each edge is an inlier, (N,).
    #[getter]
    fn inliers(&self, py: Python<'_>) -> Py<PyArray1<bool>> {
        column(py, self.0.inliers.iter().copied())
    }

    /// Root mean square of the inliers' residuals.
    #[getter]
    fn rms_px(&self) -> f64 {
        self.0.rms_px
    }
}

/// Localises an edge along a path to a fraction of a pixel.
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

/// Fits the line with the largest consensus.
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
