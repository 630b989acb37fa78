//! `fingerpost._core.Appearance`.

use crate::arrays::{column, points};
use crate::errors::{InvalidInputError, in_use};
use crate::image::FrameArrays;
use crate::numbers::real;
use crate::words::{Side, Word};
use fingerpost_core::Frame;
use fingerpost_core::appearance::Appearance;
use numpy::PyArray1;
use pyo3::prelude::*;

/// What the hand looks like, and what does not.
#[pyclass(name = "Appearance", module = "fingerpost._core")]
pub struct PyAppearance(Appearance);

#[pymethods]
impl PyAppearance {
    #[new]
    #[pyo3(signature = (*, coloured))]
    fn new(coloured: bool) -> Self {
        Self(Appearance::new(coloured))
    }

    /// Whether it was made for colours.
    #[getter]
    fn is_coloured(slf: &Bound<'_, Self>) -> PyResult<bool> {
        Ok(Self::known(slf)?.0.is_coloured())
    }

    /// Counts pixels as the hand or as what is behind it.
    #[pyo3(signature = (image, position_px, side, *, colour = None))]
    fn observe(
        slf: &Bound<'_, Self>,
        py: Python<'_>,
        image: &Bound<'_, PyAny>,
        position_px: &Bound<'_, PyAny>,
        side: &Bound<'_, PyAny>,
        colour: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<()> {
        let arrays = FrameArrays::new(image, colour)?;
        let frame = arrays.frame()?;
        let positions = points(position_px, "position_px")?;
        let is_hand = matches!(Side::parse(side, "side")?, Side::Hand);
        let mut this = Self::changing(slf)?;
        this.for_frame(&frame)?;
        let appearance = &mut this.0;
        py.detach(|| {
            for at in positions {
                appearance.observe(&frame, at.x, at.y, is_hand);
            }
        });
        Ok(())
    }

    /// Works the votes out anew from what was observed.
    fn learn(slf: &Bound<'_, Self>, py: Python<'_>) -> PyResult<()> {
        let mut this = Self::changing(slf)?;
        let appearance = &mut this.0;
        py.detach(|| appearance.learn());
        Ok(())
    }

    /// Lets what was observed fade to a part of its weight.
    fn fade(slf: &Bound<'_, Self>, keep: &Bound<'_, PyAny>) -> PyResult<()> {
        let keep = real(keep, "keep")?;
        if !(0.0..=1.0).contains(&keep) {
            return Err(InvalidInputError::new_err(format!("keep is {keep}; it must be 0 to 1")));
        }
        Self::changing(slf)?.0.fade(keep as f32);
        Ok(())
    }

    /// Keeps the hand as it is known now for good.
    fn anchor(slf: &Bound<'_, Self>) -> PyResult<()> {
        Self::changing(slf)?.0.anchor();
        Ok(())
    }

    /// The votes of the pixels nearest to some positions.
    #[pyo3(signature = (image, position_px, *, colour = None))]
    fn vote(
        slf: &Bound<'_, Self>,
        py: Python<'_>,
        image: &Bound<'_, PyAny>,
        position_px: &Bound<'_, PyAny>,
        colour: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<Py<PyArray1<f32>>> {
        let arrays = FrameArrays::new(image, colour)?;
        let frame = arrays.frame()?;
        let positions = points(position_px, "position_px")?;
        let this = Self::known(slf)?;
        let appearance = this.for_frame(&frame)?;
        let votes: Vec<_> =
            py.detach(|| positions.iter().map(|p| appearance.vote(&frame, p.x, p.y)).collect());
        Ok(column(py, votes))
    }

    fn __repr__(slf: &Bound<'_, Self>) -> PyResult<String> {
        let coloured = if Self::known(slf)?.0.is_coloured() { "True" } else { "False" };
        Ok(format!("Appearance(coloured={coloured})"))
    }
}

impl PyAppearance {
    /// What is known, unless another thread is changing it.
    pub fn known<'py>(slf: &Bound<'py, Self>) -> PyResult<PyRef<'py, Self>> {
        slf.try_borrow().map_err(|_| in_use("Appearance"))
    }

    fn changing<'py>(slf: &Bound<'py, Self>) -> PyResult<PyRefMut<'py, Self>> {
        slf.try_borrow_mut().map_err(|_| in_use("Appearance"))
    }

    /// The appearance, if `frame` has what it looks at.
    pub fn for_frame(&self, frame: &Frame<'_>) -> PyResult<&Appearance> {
        if self.0.is_coloured() && frame.colour().is_none() {
            return Err(InvalidInputError::new_err(
                "an appearance made for colours is given and no colour; it votes on colours alone",
            ));
        }
        Ok(&self.0)
    }
}
