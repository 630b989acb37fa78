//! `fingerpost._core.EdgeSearch` and the search lines of it or of a tracker.

use crate::arrays::{column, points, same_length, table, unit_vectors, vector};
use crate::errors::invalid_input;
use crate::image::FrameArrays;
use crate::numbers::real;
use crate::options::{Overlay, options, overlay_fields, overlay_words};
use crate::words::Word;
use fingerpost_core::geometry::shape_space::PlacedSample;
use fingerpost_core::measure::edge::{Edge, EdgeMeasurement, Polarity, Scale, SearchLine};
use fingerpost_core::measure::edge_search::{Cue, EdgeSearch, SearchOptions};
use numpy::{PyArray1, PyArray2, PyArrayMethods, PyFixedUnicode, PyUntypedArrayMethods};
use pyo3::prelude::*;

overlay_fields!(SearchOptions { scale_px, blur_px, noise_grey, min_contrast_grey });
overlay_words!(Polarity);

/// Searches for edges along the normals of a contour.
#[pyclass(name = "EdgeSearch", module = "fingerpost._core", frozen)]
pub struct PyEdgeSearch(EdgeSearch);

#[pymethods]
impl PyEdgeSearch {
    #[new]
    #[pyo3(signature = (options = None))]
    fn new(options: Option<&Bound<'_, PyAny>>) -> PyResult<Self> {
        EdgeSearch::new(self::options(options)?).map(Self).map_err(invalid_input)
    }

    /// Every option in force.
    #[getter]
    fn options<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        self.0.options().entry(py)
    }

    /// Searches along every line.
    #[pyo3(
        signature = (
            image, position_px, normal, half_length_px, polarity, *,
            scale = None
        ),
        text_signature = "($self, image, position_px, normal, half_length_px, polarity, *, \
                          scale='fine')"
    )]
    #[expect(clippy::too_many_arguments, reason = "they are keywords in Python")]
    fn search(
        &self,
        py: Python<'_>,
        image: &Bound<'_, PyAny>,
        position_px: &Bound<'_, PyAny>,
        normal: &Bound<'_, PyAny>,
        half_length_px: &Bound<'_, PyAny>,
        polarity: &Bound<'_, PyAny>,
        scale: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<PySearchLines> {
        let arrays = FrameArrays::new(image, None)?;
        let frame = arrays.frame()?;
        let lines = lines(position_px, normal, half_length_px, polarity)?;
        let scale = scale.map_or(Ok(Scale::Fine), |scale| Scale::parse(scale, "scale"))?;
        // A copy for each call, so that several threads may search at once; its buffers are a few
        // kilobytes.
        let mut search = self.0.clone();
        let mut found = Vec::with_capacity(lines.len());
        py.detach(|| search.search(&frame, Cue::Edges, scale, &lines, &mut found))
            .map_err(invalid_input)?;
        PySearchLines::new(py, lines.iter().zip(&found), None)
    }

    fn __repr__(&self, py: Python<'_>) -> PyResult<String> {
        Ok(format!("EdgeSearch({})", self.options(py)?))
    }
}

fn lines(
    position_px: &Bound<'_, PyAny>,
    normal: &Bound<'_, PyAny>,
    half_length_px: &Bound<'_, PyAny>,
    polarity: &Bound<'_, PyAny>,
) -> PyResult<Vec<SearchLine>> {
    let positions = points(position_px, "position_px")?;
    let normals = unit_vectors(normal, "normal")?;
    same_length("normal", normals.len(), "positions", positions.len())?;
    let half_lengths_px = if half_length_px.len().is_ok() {
        vector(half_length_px, "half_length_px")?
    } else {
        vec![real(half_length_px, "half_length_px")?; positions.len()]
    };
    same_length("half_length_px", half_lengths_px.len(), "positions", positions.len())?;
    let polarity = Polarity::parse(polarity, "polarity")?;
    let samples = positions.into_iter().zip(normals);
    Ok(samples
        .zip(half_lengths_px)
        .map(|((position, normal), half_length_px)| SearchLine {
            sample: PlacedSample { position, normal },
            half_length_px,
            polarity,
        })
        .collect())
}

/// Search lines with their edge measurements.
#[pyclass(name = "SearchLines", module = "fingerpost._core", frozen, get_all)]
pub struct PySearchLines {
    /// Intersections of the lines with the contour.
    position_px: Py<PyArray2<f64>>,
    /// Unit vectors along the lines, out of the hand.
    normal: Py<PyArray2<f64>>,
    /// Search range of each line to either side.
    half_length_px: Py<PyArray1<f64>>,
    /// Signed distance of the edge along the normal; NaN for a miss.
    offset_px: Py<PyArray1<f64>>,
    /// Contrast of the edge, hand minus background; NaN for a miss.
    contrast_grey: Py<PyArray1<f64>>,
    /// Variance of the offset; NaN for a miss.
    variance_px2: Py<PyArray1<f64>>,
    /// Mean log-likelihood ratio inside minus outside; NaN for a miss or without an appearance
    /// model.
    separation: Py<PyArray1<f64>>,
    /// Whether the edge agrees with the tracker's fit; None for lines of an `EdgeSearch`.
    agrees: Option<Py<PyArray1<bool>>>,
    /// Reason for the absence of an edge; empty where there is one.
    miss: Py<PyArray1<MissWord>>,
}

/// A word for a miss, at most as long as "out-of-image".
type MissWord = PyFixedUnicode<12>;

impl PySearchLines {
    /// The lines and their measurements, column by column.
    pub fn new<'a>(
        py: Python<'_>,
        searched: impl Iterator<Item = (&'a SearchLine, &'a EdgeMeasurement)> + Clone,
        agrees: Option<Vec<bool>>,
    ) -> PyResult<Self> {
        let lines = searched.clone().map(|(line, _)| line);
        let found = searched.map(|(_, found)| found);
        let of_edge = |value: fn(&Edge) -> f64| {
            column(py, found.clone().map(|f| f.as_ref().map_or(f64::NAN, value)))
        };
        Ok(Self {
            position_px: table(py, lines.clone().map(|l| l.sample.position.coords.into()))?,
            normal: table(py, lines.clone().map(|l| l.sample.normal.into()))?,
            half_length_px: column(py, lines.map(|l| l.half_length_px)),
            offset_px: of_edge(|e| e.offset_px),
            contrast_grey: of_edge(|e| e.contrast_grey),
            variance_px2: of_edge(|e| e.variance_px2),
            separation: of_edge(|e| e.separation.unwrap_or(f64::NAN)),
            agrees: agrees.map(|agrees| column(py, agrees)),
            miss: column(py, found.map(|f| fixed_unicode(f.err().map_or("", Word::word)))),
        })
    }
}

#[pymethods]
impl PySearchLines {
    fn __len__(&self, py: Python<'_>) -> usize {
        self.position_px.bind(py).shape()[0]
    }

    fn __repr__(&self, py: Python<'_>) -> PyResult<String> {
        let offsets = self.offset_px.bind(py).readonly();
        let hits = offsets.as_slice()?.iter().filter(|offset| !offset.is_nan()).count();
        Ok(format!("SearchLines({} lines, {hits} edges)", self.__len__(py)))
    }
}

fn fixed_unicode<const N: usize>(word: &str) -> PyFixedUnicode<N> {
    let mut characters = [0; N];
    for (slot, character) in characters.iter_mut().zip(word.chars()) {
        *slot = character.into();
    }
    PyFixedUnicode(characters)
}
