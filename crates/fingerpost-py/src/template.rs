//! `fingerpost._core.Template`.

use crate::arrays::{point, points, table};
use crate::bspline::{PyBSpline, check_fit_size};
use crate::errors::{InvalidInputError, invalid_input};
use crate::numbers::count;
use crate::options::{Overlay, overlay_fields};
use crate::words::Word;
use fingerpost_core::geometry::contour::HandSide;
use fingerpost_core::geometry::template::{
    OutlineAxis, Proportions, TRACED_CONTROL_POINTS, Template, TemplateSample, Thumb,
    ThumbProportions,
};
use fingerpost_core::track::TrackerOptions;
use numpy::PyArray2;
use pyo3::prelude::*;

overlay_fields!(Proportions { half_width, flank_start, thumb });
overlay_fields!(ThumbProportions { base, angle_rad, length, half_width, far_flank });

/// Options change the proportions of a thumb, not its presence or its side.
impl Overlay for Option<(HandSide, ThumbProportions)> {
    fn overlay(&mut self, value: &Bound<'_, PyAny>, path: &str) -> PyResult<()> {
        match self {
            Some((_, thumb)) => thumb.overlay(value, path),
            None if value.is_none() => Ok(()),
            None => Err(InvalidInputError::new_err(format!(
                "{path} is given; a finger alone has no thumb to give proportions to"
            ))),
        }
    }

    fn entry<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        match self {
            Some((_, thumb)) => thumb.entry(py),
            None => Ok(py.None().into_bound(py)),
        }
    }
}

/// The B-spline rest shape of the pointing hand, with its pointing axis.
#[pyclass(name = "Template", module = "fingerpost", frozen, eq)]
#[derive(Clone, PartialEq)]
pub struct PyTemplate(pub Template);

#[pymethods]
impl PyTemplate {
    /// Index finger and up-turned thumb, or the finger alone.
    #[staticmethod]
    #[pyo3(
        signature = (thumb = None, *, proportions = None),
        text_signature = "(thumb='left', *, proportions=None)"
    )]
    fn pistol(
        py: Python<'_>,
        thumb: Option<&Bound<'_, PyAny>>,
        proportions: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<Self> {
        let thumb = thumb.map_or(Ok(Thumb::Left), |thumb| Thumb::parse(thumb, "thumb"))?;
        let mut usual = Proportions::usual(thumb);
        if let Some(differing) = proportions {
            usual.overlay(differing, "proportions")?;
        }
        py.detach(|| Template::with_proportions(&usual)).map(Self).map_err(invalid_input)
    }

    /// A template from a traced outline and its pointing axis.
    #[staticmethod]
    #[pyo3(signature = (outline, *, knuckle, tip, hand, control_points = None))]
    fn from_outline(
        py: Python<'_>,
        outline: &Bound<'_, PyAny>,
        knuckle: &Bound<'_, PyAny>,
        tip: &Bound<'_, PyAny>,
        hand: &Bound<'_, PyAny>,
        control_points: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<Self> {
        let outline = points(outline, "outline")?;
        let axis = OutlineAxis { knuckle: point(knuckle, "knuckle")?, tip: point(tip, "tip")? };
        let hand = HandSide::parse(hand, "hand")?;
        let control_points =
            control_points.map_or(Ok(TRACED_CONTROL_POINTS), |n| count(n, "control_points"))?;
        check_fit_size(outline.len(), control_points)?;
        py.detach(|| Template::from_outline(&outline, &axis, hand, control_points))
            .map(Self)
            .map_err(invalid_input)
    }

    /// Side of the thumb seen along the pointing direction.
    #[getter]
    fn thumb(&self) -> &'static str {
        self.0.thumb().word()
    }

    /// Side of the outline's direction of travel on which the hand lies.
    #[getter]
    fn hand(&self) -> &'static str {
        self.0.hand().word()
    }

    /// All proportions of a pistol; None for a traced outline.
    #[getter]
    fn proportions<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyAny>>> {
        self.0.proportions().map(|proportions| proportions.entry(py)).transpose()
    }

    /// B-spline basis of the outline.
    #[getter]
    fn spline(&self) -> PyBSpline {
        PyBSpline(self.0.outline().0.clone())
    }

    /// Control points of the outline.
    #[getter]
    fn control_points(&self, py: Python<'_>) -> PyResult<Py<PyArray2<f64>>> {
        table(py, self.0.outline().1.iter().map(|p| p.coords.into()))
    }

    /// Samples the outline at equal steps of arc length.
    #[pyo3(signature = (samples = None))]
    fn outline(
        &self,
        py: Python<'_>,
        samples: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<Py<PyArray2<f64>>> {
        table(py, self.samples(py, samples)?.iter().map(|s| s.position.coords.into()))
    }

    fn __repr__(&self) -> String {
        let (kind, control_points) = (self.kind(), self.0.outline().1.len());
        format!("Template({kind}, thumb='{}', {control_points} control points)", self.thumb())
    }
}

impl PyTemplate {
    /// Description of its origin.
    pub fn kind(&self) -> &'static str {
        if self.0.proportions().is_some() { "pistol" } else { "traced outline" }
    }

    /// Samples of the outline; `None` for a tracker's default number.
    pub fn samples(
        &self,
        py: Python<'_>,
        samples: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<Vec<TemplateSample>> {
        let usual = TrackerOptions::default().samples;
        let samples = samples.map_or(Ok(usual), |n| count(n, "samples"))?;
        py.detach(|| self.0.samples(samples)).map_err(invalid_input)
    }
}
