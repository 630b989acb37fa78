//! `fingerpost._core.HandFinder` and its candidates.

use crate::arrays::point;
use crate::background::PyBackground;
use crate::errors::{in_use, invalid_input};
use crate::image::FrameArrays;
use crate::numbers::real;
use crate::options::{Overlay, options, overlay_fields};
use crate::tracker::PyStartPose;
use crate::words::Word;
use fingerpost_core::detect::candidates::{Candidate, FinderOptions, HandFinder};
use fingerpost_core::track::StartPose;
use pyo3::prelude::*;

overlay_fields!(FinderOptions { min_half_width, max_half_width, min_gradient_grey, candidates });

/// Detects candidates for pointing hands in an image.
#[pyclass(name = "HandFinder", module = "fingerpost._core")]
pub struct PyHandFinder(HandFinder);

#[pymethods]
impl PyHandFinder {
    #[new]
    #[pyo3(signature = (options = None))]
    fn new(options: Option<&Bound<'_, PyAny>>) -> PyResult<Self> {
        HandFinder::new(self::options(options)?).map(Self).map_err(invalid_input)
    }

    /// Finds the candidates in a frame, the most likely first.
    #[pyo3(signature = (image, colour = None, *, background = None))]
    fn find(
        slf: &Bound<'_, Self>,
        py: Python<'_>,
        image: &Bound<'_, PyAny>,
        colour: Option<&Bound<'_, PyAny>>,
        background: Option<&Bound<'_, PyBackground>>,
    ) -> PyResult<Vec<PyCandidate>> {
        let arrays = FrameArrays::new(image, colour)?;
        let frame = arrays.frame()?;
        let background = background.map(PyBackground::at_rest).transpose()?;
        let background = background.as_ref().map(|b| &b.0);
        let mut this = slf.try_borrow_mut().map_err(|_| in_use("HandFinder"))?;
        let finder = &mut this.0;
        Ok(py.detach(|| finder.find(&frame, background).iter().map(|&c| PyCandidate(c)).collect()))
    }

    /// Likeness of a band to a finger by the contrast with its surroundings.
    #[staticmethod]
    #[pyo3(signature = (image, tip_px, angle_rad, half_width_px, colour = None))]
    fn likeness(
        py: Python<'_>,
        image: &Bound<'_, PyAny>,
        tip_px: &Bound<'_, PyAny>,
        angle_rad: &Bound<'_, PyAny>,
        half_width_px: &Bound<'_, PyAny>,
        colour: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<Option<f64>> {
        let arrays = FrameArrays::new(image, colour)?;
        let frame = arrays.frame()?;
        let tip = point(tip_px, "tip_px")?;
        let angle_rad = real(angle_rad, "angle_rad")?;
        let half_width_px = real(half_width_px, "half_width_px")?;
        py.detach(|| HandFinder::likeness(&frame, tip, angle_rad, half_width_px))
            .map_err(invalid_input)
    }

    /// Every option in force.
    #[getter]
    fn options<'py>(slf: &Bound<'py, Self>, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        slf.try_borrow().map_err(|_| in_use("HandFinder"))?.0.options().entry(py)
    }
}

/// A possible pointing hand.
#[pyclass(name = "Candidate", module = "fingerpost._core", frozen)]
pub struct PyCandidate(Candidate);

#[pymethods]
impl PyCandidate {
    /// The start pose of a template for it.
    #[getter]
    fn start(&self) -> PyResult<PyStartPose> {
        let Candidate { tip_px, angle_rad, length_px, .. } = self.0;
        PyStartPose::at(StartPose { tip_px, angle_rad, length_px })
    }

    /// Half the finger's width.
    #[getter]
    fn half_width_px(&self) -> f64 {
        self.0.half_width_px
    }

    /// Side of a second band that may be its thumb.
    #[getter]
    fn thumb(&self) -> &'static str {
        self.0.thumb.word()
    }

    /// Mean colour of its inside.
    #[getter]
    fn colour(&self) -> (f64, f64, f64) {
        self.0.colour.into()
    }

    /// Mean foreground probability of its inside.
    #[getter]
    fn foreground(&self) -> f64 {
        self.0.foreground
    }

    /// Likeness to a finger by shape and colours alone.
    #[getter]
    fn score(&self) -> f64 {
        self.0.score
    }

    fn __repr__(&self) -> String {
        let Candidate { tip_px, angle_rad, length_px, half_width_px, foreground, score, .. } =
            self.0;
        format!(
            "Candidate(tip_px=({:.1}, {:.1}), angle_rad={angle_rad:.3}, length_px={length_px:.1}, \
             half_width_px={half_width_px:.1}, thumb='{}', foreground={foreground:.2}, \
             score={score:.3})",
            tip_px.x,
            tip_px.y,
            self.thumb()
        )
    }
}
