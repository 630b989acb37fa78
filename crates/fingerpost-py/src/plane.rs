//! `fingerpost._core.PlaneRegistration`.

use crate::arrays::{matrix, point, points, same_length, table, vector};
use crate::errors::{in_use, invalid_input, wrong};
use crate::image::FrameArrays;
use crate::numbers::{count, real};
use fingerpost_core::nalgebra::{Matrix3, Point2};
use fingerpost_core::plane::{
    HandRegion, PlaneLevel, PlanePixels, PlaneRegistration, RadialLens, Registered, View,
};
use numpy::PyArray2;
use pyo3::prelude::*;

/// A lens as fx, fy, cx, cy, k1, k2 and the radius up to which its model is valid.
fn lens(value: &Bound<'_, PyAny>) -> PyResult<RadialLens> {
    let entries: Option<[f64; 7]> = value.extract().ok();
    let Some([fx, fy, cx, cy, k1, k2, max_radius]) = entries else {
        let right = "seven numbers: fx, fy, cx, cy, k1, k2 and the greatest radius";
        return Err(wrong("lens", value, right));
    };
    Ok(RadialLens { focal_px: [fx, fy], centre_px: [cx, cy], k: [k1, k2], max_radius })
}

fn segment(value: &Bound<'_, PyAny>) -> PyResult<HandRegion> {
    let entries: Option<[Bound<'_, PyAny>; 3]> = value.extract().ok();
    let Some([end, other, radius_px]) = &entries else {
        let right = "two ends (u, v) of a segment [px] and the radius around it [px]";
        return Err(wrong("hand", value, right));
    };
    let (end, other) = (point(end, "hand[0]")?, point(other, "hand[1]")?);
    let radius_px = real(radius_px, "hand[2]")?;
    Ok(HandRegion { ends_px: [[end.x, end.y], [other.x, other.y]], radius_px })
}

fn pairs(points: Vec<Point2<f64>>) -> Vec<[f64; 2]> {
    points.into_iter().map(|p| [p.x, p.y]).collect()
}

/// Chosen pixels of the working plane at one level of a first image's pyramid.
#[pyclass(name = "PlaneLevel", module = "fingerpost._core", frozen)]
pub struct PyPlaneLevel(PlaneLevel);

#[pymethods]
impl PyPlaneLevel {
    #[new]
    #[pyo3(signature = (
        positions_px, levels, gradients, variances, squares, *,
        scale, non_similarity_sigma, unit_from_px, lens = None
    ))]
    #[expect(clippy::too_many_arguments, reason = "the columns of one table, and their units")]
    fn new(
        positions_px: &Bound<'_, PyAny>,
        levels: &Bound<'_, PyAny>,
        gradients: &Bound<'_, PyAny>,
        variances: &Bound<'_, PyAny>,
        squares: &Bound<'_, PyAny>,
        scale: &Bound<'_, PyAny>,
        non_similarity_sigma: &Bound<'_, PyAny>,
        unit_from_px: &Bound<'_, PyAny>,
        lens: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<Self> {
        let view = View {
            lens: lens.map(self::lens).transpose()?,
            unit_from_px: matrix::<3, 3>(unit_from_px, "unit_from_px", "(3, 3)")?,
        };
        let squares = squares.try_iter()?.map(|square| count(&square?, "squares"));
        let pixels = PlanePixels {
            positions_px: &pairs(points(positions_px, "positions_px")?),
            levels: &vector(levels, "levels")?,
            gradients: &pairs(points(gradients, "gradients")?),
            variances: &vector(variances, "variances")?,
            squares: &squares.collect::<PyResult<Vec<_>>>()?,
        };
        let scale = real(scale, "scale")?;
        let sigma = real(non_similarity_sigma, "non_similarity_sigma")?;
        PlaneLevel::new(&pixels, scale, sigma, view).map(Self).map_err(invalid_input)
    }
}

/// The pose of the working plane in an image.
#[pyclass(name = "RegisteredPlane", module = "fingerpost._core", frozen)]
pub struct PyRegisteredPlane(Registered);

#[pymethods]
impl PyRegisteredPlane {
    /// Homography from undistorted pixels of the first image to those of this one.
    #[getter]
    fn now_from_first(&self, py: Python<'_>) -> PyResult<Py<PyArray2<f64>>> {
        let entries = self.0.now_from_first;
        table(py, (0..3).map(|k| [0, 1, 2].map(|j| entries[(k, j)])))
    }

    /// Covariance of the homography's error in unit coordinates.
    #[getter]
    fn step_covariance(&self, py: Python<'_>) -> PyResult<Py<PyArray2<f64>>> {
        let entries = self.0.step_covariance;
        table(py, (0..8).map(|k| [0, 1, 2, 3, 4, 5, 6, 7].map(|j| entries[(k, j)])))
    }

    /// Inliers' fraction of the information of the pixels expected to be inliers.
    #[getter]
    fn inlier_share(&self) -> f64 {
        self.0.inlier_share
    }

    /// Number of inliers among these pixels.
    #[getter]
    fn inliers(&self) -> usize {
        self.0.inliers
    }
}

/// Registers the working plane of a first image with later ones.
#[pyclass(name = "PlaneRegistration", module = "fingerpost._core")]
pub struct PyPlaneRegistration(PlaneRegistration);

#[pymethods]
impl PyPlaneRegistration {
    #[new]
    fn new(levels: Vec<PyRef<'_, PyPlaneLevel>>, points_px: &Bound<'_, PyAny>) -> PyResult<Self> {
        let levels = levels.into_iter().map(|level| level.0.clone()).collect();
        let points_px = pairs(points(points_px, "points_px")?);
        PlaneRegistration::new(levels, points_px).map(Self).map_err(invalid_input)
    }

    /// Registers an image.
    #[pyo3(signature = (smooth, guess, hand = None))]
    fn align(
        slf: &Bound<'_, Self>,
        py: Python<'_>,
        smooth: Vec<Bound<'_, PyAny>>,
        guess: &Bound<'_, PyAny>,
        hand: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<Option<PyRegisteredPlane>> {
        let guess: Matrix3<f64> = matrix(guess, "guess", "(3, 3)")?;
        let hand = hand.map(segment).transpose()?;
        let mut this = slf.try_borrow_mut().map_err(|_| in_use("PlaneRegistration"))?;
        let needed = this.0.levels();
        same_length("smooth", smooth.len(), "levels", needed)?;
        let arrays = smooth.into_iter().map(|image| FrameArrays::new(&image, None));
        let arrays = arrays.collect::<PyResult<Vec<_>>>()?;
        let images = arrays.iter().map(FrameArrays::levels).collect::<PyResult<Vec<_>>>()?;
        let registration = &mut this.0;
        let registered = py.detach(|| registration.align(&images, &guess, hand.as_ref()));
        Ok(registered.map(PyRegisteredPlane))
    }
}
