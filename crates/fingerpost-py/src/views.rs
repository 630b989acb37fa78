//! `fingerpost._core.update_views`.

use crate::background::PyBackground;
use crate::errors::{InvalidInputError, in_use, invalid_input};
use crate::image::FrameArrays;
use crate::numbers::real;
use crate::tracker::{PyContourTracker, PyTrack};
use crate::words::Word;
use fingerpost_core::track::views::{Schedule, ViewUpdate};
use pyo3::prelude::*;
use pyo3::types::PyTuple;

/// A tracker, grey levels, time of capture and, if there are any, colours and a background.
type View<'py> = (
    Bound<'py, PyContourTracker>,
    Bound<'py, PyAny>,
    Bound<'py, PyAny>,
    Option<Bound<'py, PyAny>>,
    Option<Bound<'py, PyBackground>>,
);

/// Updates the trackers of all views by one frame each.
#[pyfunction]
#[expect(clippy::needless_pass_by_value, reason = "pyo3 extracts sequences by value")]
#[pyo3(signature = (views, *, schedule = None))]
pub fn update_views<'py>(
    py: Python<'py>,
    views: Vec<Bound<'py, PyTuple>>,
    schedule: Option<&Bound<'py, PyAny>>,
) -> PyResult<Vec<Bound<'py, PyAny>>> {
    let schedule = schedule.map(|word| Schedule::parse(word, "schedule")).transpose()?;
    let schedule = schedule.unwrap_or_default();
    let views = views.iter().enumerate().map(|(k, view)| entries(k, view));
    let views = views.collect::<PyResult<Vec<_>>>()?;
    let mut taken: Vec<_> = views.iter().map(Taken::new).collect();
    let mut updates = Vec::with_capacity(taken.len());
    let refused: Vec<_> = taken
        .iter_mut()
        .map(|view| match view {
            Ok(view) => view.update().map(|update| updates.push(update)).err(),
            Err(error) => Some(error.clone_ref(py)),
        })
        .collect();
    let mut tracks =
        py.detach(|| fingerpost_core::track::views::update_views(updates, schedule)).into_iter();
    let results = refused.into_iter().filter_map(|refusal| match refusal {
        Some(error) => Some(Err(error)),
        None => tracks.next().map(|track| track.map_err(invalid_input)),
    });
    results
        .map(|result| match result {
            Ok(track) => Ok(Bound::new(py, PyTrack(track))?.into_any()),
            Err(error) => Ok(error.into_value(py).into_bound(py).into_any()),
        })
        .collect()
}

/// The entries of a view, or the error that their number is wrong.
fn entries<'py>(k: usize, view: &Bound<'py, PyTuple>) -> PyResult<View<'py>> {
    match view.len() {
        5 => view.extract(),
        n => Err(InvalidInputError::new_err(format!(
            "views[{k}] has {n} entries; a tracker, an image, its time, its colours or None and \
             its background or None are needed"
        ))),
    }
}

/// A view whose tracker and images are borrowed for one call.
struct Taken<'py> {
    tracker: PyRefMut<'py, PyContourTracker>,
    arrays: FrameArrays<'py>,
    background: Option<PyRef<'py, PyBackground>>,
    time_s: f64,
}

impl<'py> Taken<'py> {
    fn new((tracker, image, time_s, colour, background): &View<'py>) -> PyResult<Self> {
        Ok(Self {
            arrays: FrameArrays::new(image, colour.as_ref())?,
            background: background.as_ref().map(PyBackground::at_rest).transpose()?,
            time_s: real(time_s, "time_s")?,
            tracker: tracker.try_borrow_mut().map_err(|_| in_use("ContourTracker"))?,
        })
    }

    fn update(&mut self) -> PyResult<ViewUpdate<'_>> {
        let Self { tracker, arrays, background, time_s } = self;
        let (frame, background) = (arrays.frame()?, background.as_ref().map(|b| &b.0));
        Ok(ViewUpdate { tracker: &mut tracker.0, frame, background, time_s: *time_s })
    }
}
