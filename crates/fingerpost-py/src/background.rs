//! `fingerpost._core.Background`.

use crate::arrays::{column, flat_table, point, points, table};
use crate::errors::{in_use, invalid_input, wrong};
use crate::image::FrameArrays;
use crate::numbers::real;
use crate::options::{Overlay, options, overlay_fields};
use fingerpost_core::appearance::background::options::{BackgroundOptions, KeepOut};
use fingerpost_core::appearance::background::{Background, ForegroundMap};
use fingerpost_core::nalgebra::Point2;
use numpy::{PyArray1, PyArray2};
use pyo3::prelude::*;

overlay_fields!(BackgroundOptions {
    learn_frames,
    rate,
    absorb_frames,
    noise_grey,
    changed_sigmas,
    shadow_light,
    void_share,
});

/// Two ends of a segment, and the radius around it.
fn part(value: &Bound<'_, PyAny>, what: &str) -> PyResult<KeepOut> {
    let entries: Option<[Bound<'_, PyAny>; 3]> = value.extract().ok();
    let Some([from, to, radius_px]) = &entries else {
        let right = "two ends (u, v) of a segment [px] and the radius around it [px]";
        return Err(wrong(what, value, right));
    };
    Ok(KeepOut {
        from: point(from, &format!("{what}[0]"))?,
        to: point(to, &format!("{what}[1]"))?,
        radius_px: real(radius_px, &format!("{what}[2]"))?,
    })
}

/// Regions that are kept out; none by default.
fn parts(value: Option<&Bound<'_, PyAny>>) -> PyResult<Vec<KeepOut>> {
    let Some(value) = value else { return Ok(Vec::new()) };
    let regions =
        value.try_iter().map_err(|_| wrong("keep_out", value, "a sequence of regions"))?;
    regions.enumerate().map(|(k, region)| part(&region?, &format!("keep_out[{k}]"))).collect()
}

/// Background model of a static camera.
#[pyclass(name = "Background", module = "fingerpost._core")]
pub struct PyBackground(pub Background);

#[pymethods]
impl PyBackground {
    #[new]
    #[pyo3(signature = (options = None))]
    fn new(options: Option<&Bound<'_, PyAny>>) -> PyResult<Self> {
        Background::new(self::options(options)?).map(Self).map_err(invalid_input)
    }

    /// Processes one frame.
    #[pyo3(signature = (image, colour = None, *, keep_out = None))]
    fn observe(
        slf: &Bound<'_, Self>,
        py: Python<'_>,
        image: &Bound<'_, PyAny>,
        colour: Option<&Bound<'_, PyAny>>,
        keep_out: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<()> {
        let arrays = FrameArrays::new(image, colour)?;
        let frame = arrays.frame()?;
        let keep_out = parts(keep_out)?;
        let mut this = slf.try_borrow_mut().map_err(|_| in_use("Background"))?;
        let background = &mut this.0;
        py.detach(|| background.observe(&frame, &keep_out)).map_err(invalid_input)
    }

    /// Processes a frame without learning from it.
    #[pyo3(signature = (image, colour = None))]
    fn look(
        slf: &Bound<'_, Self>,
        py: Python<'_>,
        image: &Bound<'_, PyAny>,
        colour: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<()> {
        let arrays = FrameArrays::new(image, colour)?;
        let frame = arrays.frame()?;
        let mut this = slf.try_borrow_mut().map_err(|_| in_use("Background"))?;
        let background = &mut this.0;
        py.detach(|| background.look(&frame));
        Ok(())
    }

    /// Learns from the frame that `look` processed last.
    #[pyo3(signature = (image, colour = None, *, keep_out = None))]
    fn learn(
        slf: &Bound<'_, Self>,
        py: Python<'_>,
        image: &Bound<'_, PyAny>,
        colour: Option<&Bound<'_, PyAny>>,
        keep_out: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<()> {
        let arrays = FrameArrays::new(image, colour)?;
        let frame = arrays.frame()?;
        let keep_out = parts(keep_out)?;
        let mut this = slf.try_borrow_mut().map_err(|_| in_use("Background"))?;
        let background = &mut this.0;
        py.detach(|| background.learn(&frame, &keep_out)).map_err(invalid_input)
    }

    /// Discards the observations of a region.
    fn forget(slf: &Bound<'_, Self>, part: &Bound<'_, PyAny>) -> PyResult<()> {
        let part = self::part(part, "part")?;
        let mut this = slf.try_borrow_mut().map_err(|_| in_use("Background"))?;
        this.0.forget(&part).map_err(invalid_input)
    }

    /// Discards all observations.
    fn clear(slf: &Bound<'_, Self>) -> PyResult<()> {
        slf.try_borrow_mut().map_err(|_| in_use("Background"))?.0.clear();
        Ok(())
    }

    /// Whether it was observed long enough to separate the foreground.
    #[getter]
    fn is_known(slf: &Bound<'_, Self>) -> PyResult<bool> {
        Ok(Self::at_rest(slf)?.0.is_known())
    }

    /// Whether it is known and not displaced in the last frame.
    #[getter]
    fn is_exact(slf: &Bound<'_, Self>) -> PyResult<bool> {
        Ok(Self::at_rest(slf)?.0.is_exact())
    }

    /// Displacement of the last frame from the background.
    #[getter]
    fn shift_px(slf: &Bound<'_, Self>) -> PyResult<Option<(f64, f64)>> {
        Ok(Self::at_rest(slf)?.0.shift_px().map(|shift| (shift.x, shift.y)))
    }

    /// Gain and offset of the last frame's light.
    #[getter]
    fn light(slf: &Bound<'_, Self>) -> PyResult<(f64, f64)> {
        let light = Self::at_rest(slf)?.0.light();
        Ok((light.gain, light.offset_grey))
    }

    /// Changed fraction of the pixels that would show a motion of the camera.
    #[getter]
    fn changed_share(slf: &Bound<'_, Self>) -> PyResult<f64> {
        Ok(Self::at_rest(slf)?.0.changed_share())
    }

    /// Every option in force.
    #[getter]
    fn options<'py>(slf: &Bound<'py, Self>, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        Self::at_rest(slf)?.0.options().entry(py)
    }

    /// Expected grey levels at some positions, and their standard deviations.
    fn expected(
        slf: &Bound<'_, Self>,
        py: Python<'_>,
        position_px: &Bound<'_, PyAny>,
    ) -> PyResult<Py<PyArray2<f64>>> {
        let positions = points(position_px, "position_px")?;
        let this = Self::at_rest(slf)?;
        let expected = positions.iter().map(|p| {
            let expected = this.0.expected(p.x, p.y);
            expected.map_or([f64::NAN; 2], |e| [e.grey, e.sigma_grey])
        });
        table(py, expected)
    }

    /// Foreground probability at some positions of a frame.
    #[pyo3(signature = (image, position_px, colour = None))]
    fn foreground(
        slf: &Bound<'_, Self>,
        py: Python<'_>,
        image: &Bound<'_, PyAny>,
        position_px: &Bound<'_, PyAny>,
        colour: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<Py<PyArray1<f64>>> {
        let arrays = FrameArrays::new(image, colour)?;
        let frame = arrays.frame()?;
        let positions = points(position_px, "position_px")?;
        let background = &Self::at_rest(slf)?.0;
        let likelihood = |p: &Point2<f64>| background.foreground(&frame, p.x, p.y);
        Ok(column(py, positions.iter().map(|p| likelihood(p).unwrap_or(f64::NAN))))
    }

    /// Foreground probability of every second pixel of every second row.
    #[pyo3(signature = (image, colour = None))]
    fn foreground_map(
        slf: &Bound<'_, Self>,
        py: Python<'_>,
        image: &Bound<'_, PyAny>,
        colour: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<Py<PyArray2<u8>>> {
        let arrays = FrameArrays::new(image, colour)?;
        let frame = arrays.frame()?;
        let this = Self::at_rest(slf)?;
        let background = &this.0;
        let map = py.detach(|| {
            let mut map = ForegroundMap::default();
            background.foreground_map(&frame, &mut map);
            map
        });
        flat_table(py, map.cells, map.width)
    }

    fn __repr__(slf: &Bound<'_, Self>) -> PyResult<String> {
        let this = Self::at_rest(slf)?;
        let known = if this.0.is_known() { "True" } else { "False" };
        Ok(format!("Background(is_known={known})"))
    }
}

impl PyBackground {
    /// The background, unless another thread is changing it.
    pub fn at_rest<'py>(slf: &Bound<'py, Self>) -> PyResult<PyRef<'py, Self>> {
        slf.try_borrow().map_err(|_| in_use("Background"))
    }
}
