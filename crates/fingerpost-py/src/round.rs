//! `fingerpost._core.RoundFinger`.

use crate::arrays::point;
use crate::errors::invalid_input;
use crate::image::FrameArrays;
use crate::numbers::real;
use fingerpost_core::axis::RoundFinger;
use fingerpost_core::geometry::shape_space::Axis;
use pyo3::prelude::*;

/// The round body whose shading fits the image about an axis best.
#[pyclass(name = "RoundFinger", module = "fingerpost._core", frozen)]
pub struct PyRoundFinger(RoundFinger);

#[pymethods]
impl PyRoundFinger {
    /// Fits a body to the image about an axis.
    #[staticmethod]
    #[pyo3(signature = (image, anchor_px, tip_px, half_width_px, colour = None))]
    fn fit(
        py: Python<'_>,
        image: &Bound<'_, PyAny>,
        anchor_px: &Bound<'_, PyAny>,
        tip_px: &Bound<'_, PyAny>,
        half_width_px: &Bound<'_, PyAny>,
        colour: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<Option<Self>> {
        let arrays = FrameArrays::new(image, colour)?;
        let frame = arrays.frame()?;
        let (anchor, tip) = (point(anchor_px, "anchor_px")?, point(tip_px, "tip_px")?);
        let half_width_px = real(half_width_px, "half_width_px")?;
        let ahead = tip - anchor;
        let axis = Axis { anchor, tip, angle_rad: ahead.y.atan2(ahead.x) };
        let finger = py.detach(|| RoundFinger::fit(&frame, &axis, half_width_px));
        Ok(finger.map_err(invalid_input)?.map(Self))
    }

    /// Offset of the fitted axis from the anchor.
    #[getter]
    fn offset_px(&self) -> f64 {
        self.0.offset_px
    }

    /// Angle of the fitted axis minus that of the given one.
    #[getter]
    fn turn_rad(&self) -> f64 {
        self.0.turn_rad
    }

    /// Half-width at the anchor.
    #[getter]
    fn half_width_px(&self) -> f64 {
        self.0.half_width_px
    }

    /// Robust cost of the fit.
    #[getter]
    fn misfit(&self) -> f64 {
        self.0.misfit
    }

    /// The least such cost of a body about the given axis.
    #[getter]
    fn misfit_about_given(&self) -> f64 {
        self.0.misfit_about_given
    }

    fn __repr__(&self) -> String {
        let RoundFinger { offset_px, turn_rad, half_width_px, misfit, misfit_about_given } = self.0;
        format!(
            "RoundFinger(offset_px={offset_px:.2}, turn_rad={turn_rad:.3}, \
             half_width_px={half_width_px:.2}, misfit={misfit:.1}, \
             misfit_about_given={misfit_about_given:.1})"
        )
    }
}
