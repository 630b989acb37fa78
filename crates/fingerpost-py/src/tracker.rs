//! `fingerpost._core.ContourTracker` and its results.

use crate::arrays::{column, flat_table, point, table};
use crate::background::PyBackground;
use crate::errors::{in_use, invalid_input};
use crate::image::FrameArrays;
use crate::numbers::real;
use crate::options::{Overlay, options, overlay_fields, overlay_words};
use crate::search::PySearchLines;
use crate::template::PyTemplate;
use crate::words::Word;
use fingerpost_core::Result;
use fingerpost_core::geometry::planar::AffineMap;
use fingerpost_core::geometry::shape_space::Axis;
use fingerpost_core::geometry::template::Template;
use fingerpost_core::track::{
    AcceptOptions, AcquireOptions, ContourTracker, Diagnostics, DynamicsOptions, FingerLine, Model,
    ShapeEstimate, StartPose, Track, TrackOptions, TrackerOptions,
};
use numpy::{PyArray1, PyArray2};
use pyo3::prelude::*;

overlay_fields!(AcceptOptions { min_inliers, max_residual_px });
overlay_fields!(AcquireOptions { half_length_px, accept, settle_frames, settle_change, max_scale });
overlay_fields!(TrackOptions {
    half_length_px,
    accept,
    lose_after_frames,
    appearance_rate,
    dynamics,
});
overlay_fields!(DynamicsOptions {
    acceleration_px_s2,
    acceleration_rad_s2,
    acceleration_lasts_s,
    first_speed_px_s,
    first_speed_rad_s,
    confidence,
    longest_gap_s,
});
overlay_fields!(TrackerOptions {
    model,
    samples,
    max_iterations,
    search,
    polarity,
    fit,
    correlation,
    refine,
    acquire,
    track,
});

overlay_words!(Model);

/// The start pose of the initial template.
#[pyclass(name = "StartPose", module = "fingerpost", frozen, eq)]
#[derive(PartialEq)]
pub struct PyStartPose {
    start: StartPose,
    /// The map of the undeformed template.
    map: AffineMap,
}

#[pymethods]
impl PyStartPose {
    #[new]
    fn new(
        tip_px: &Bound<'_, PyAny>,
        angle_rad: &Bound<'_, PyAny>,
        length_px: &Bound<'_, PyAny>,
    ) -> PyResult<Self> {
        Self::at(StartPose {
            tip_px: point(tip_px, "tip_px")?,
            angle_rad: real(angle_rad, "angle_rad")?,
            length_px: real(length_px, "length_px")?,
        })
    }

    /// The finger's tip.
    #[getter]
    fn tip_px(&self) -> (f64, f64) {
        (self.start.tip_px.x, self.start.tip_px.y)
    }

    /// Direction of pointing.
    #[getter]
    fn angle_rad(&self) -> f64 {
        self.start.angle_rad
    }

    /// Visible length of the index finger.
    #[getter]
    fn length_px(&self) -> f64 {
        self.start.length_px
    }

    /// Image of the template's origin, the middle of the finger.
    #[getter]
    fn centre_px(&self, py: Python<'_>) -> Py<PyArray1<f64>> {
        column(py, self.map.centre.iter().copied())
    }

    /// Images of the template's basis vectors, as columns.
    #[getter]
    fn linear_px(&self, py: Python<'_>) -> PyResult<Py<PyArray2<f64>>> {
        flat_table(py, self.map.linear.transpose().as_slice().to_vec(), 2)
    }

    fn __repr__(&self) -> String {
        let StartPose { tip_px, angle_rad, length_px } = &self.start;
        format!(
            "StartPose(tip_px=({}, {}), angle_rad={angle_rad}, length_px={length_px})",
            tip_px.x, tip_px.y
        )
    }
}

impl PyStartPose {
    /// The start pose, or the error that its values are invalid.
    pub fn at(start: StartPose) -> PyResult<Self> {
        let StartPose { tip_px, angle_rad, length_px } = start;
        let map = AffineMap::upright(tip_px, angle_rad, length_px).map_err(invalid_input)?;
        Ok(Self { start, map })
    }
}

/// Tracks one hand in one view.
#[pyclass(name = "ContourTracker", module = "fingerpost")]
pub struct PyContourTracker(pub ContourTracker);

/// A constructor of the core's tracker.
type Make = fn(Template, &StartPose, TrackerOptions) -> Result<ContourTracker>;

impl PyContourTracker {
    fn made(
        py: Python<'_>,
        make: Make,
        template: &PyTemplate,
        start: &PyStartPose,
        options: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<Self> {
        let options: TrackerOptions = self::options(options)?;
        let template = template.0.clone();
        py.detach(|| make(template, &start.start, options)).map(Self).map_err(invalid_input)
    }
}

#[pymethods]
impl PyContourTracker {
    #[new]
    #[pyo3(signature = (template, start, options = None))]
    fn new(
        py: Python<'_>,
        template: &PyTemplate,
        start: &PyStartPose,
        options: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<Self> {
        Self::made(py, ContourTracker::new, template, start, options)
    }

    /// A tracker of a hand that is already at `start`.
    #[staticmethod]
    #[pyo3(signature = (template, start, options = None))]
    fn at_hand(
        py: Python<'_>,
        template: &PyTemplate,
        start: &PyStartPose,
        options: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<Self> {
        Self::made(py, ContourTracker::at_hand, template, start, options)
    }

    /// Updates the tracker by one frame, and returns the estimate for it.
    #[pyo3(signature = (image, time_s, colour = None, *, background = None))]
    fn update(
        slf: &Bound<'_, Self>,
        py: Python<'_>,
        image: &Bound<'_, PyAny>,
        time_s: &Bound<'_, PyAny>,
        colour: Option<&Bound<'_, PyAny>>,
        background: Option<&Bound<'_, PyBackground>>,
    ) -> PyResult<PyTrack> {
        let arrays = match colour {
            Some(_) => FrameArrays::new(image, colour)?,
            None => FrameArrays::alone(image)?,
        };
        let frame = arrays.frame()?;
        let time_s = real(time_s, "time_s")?;
        let background = background.map(PyBackground::at_rest).transpose()?;
        let known = background.as_ref().map(|b| &b.0);
        let mut this = slf.try_borrow_mut().map_err(|_| in_use("ContourTracker"))?;
        let tracker = &mut this.0;
        py.detach(|| match known {
            Some(known) => tracker.update_before(&frame, known, time_s),
            None => tracker.update(&frame, time_s),
        })
        .map(PyTrack)
        .map_err(invalid_input)
    }

    /// The template.
    #[getter]
    fn template(slf: &Bound<'_, Self>) -> PyResult<PyTemplate> {
        Ok(PyTemplate(Self::at_rest(slf)?.0.template().clone()))
    }

    /// Every option in force.
    #[getter]
    fn options<'py>(slf: &Bound<'py, Self>, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        Self::at_rest(slf)?.0.options().entry(py)
    }

    /// Foreshortening of the finger in this view.
    #[getter]
    fn foreshortening(slf: &Bound<'_, Self>) -> PyResult<f64> {
        Ok(Self::at_rest(slf)?.0.foreshortening())
    }

    #[setter]
    fn set_foreshortening(
        slf: &Bound<'_, Self>,
        foreshortening: &Bound<'_, PyAny>,
    ) -> PyResult<()> {
        let foreshortening = real(foreshortening, "foreshortening")?;
        let mut this = slf.try_borrow_mut().map_err(|_| in_use("ContourTracker"))?;
        this.0.set_foreshortening(foreshortening).map_err(invalid_input)
    }

    /// The contour after the last frame, or at the start pose.
    fn contour(slf: &Bound<'_, Self>, py: Python<'_>) -> PyResult<Py<PyArray2<f64>>> {
        let contour = Self::at_rest(slf)?.0.contour();
        table(py, contour.iter().map(|s| s.position.coords.into()))
    }

    /// The last search along the normals.
    fn search_lines(slf: &Bound<'_, Self>, py: Python<'_>) -> PyResult<PySearchLines> {
        let this = Self::at_rest(slf)?;
        let searched: Vec<_> = this.0.search_lines().collect();
        let agrees = searched.iter().map(|s| s.agrees).collect();
        PySearchLines::new(py, searched.iter().map(|s| (s.line, s.found)), Some(agrees))
    }

    fn __repr__(slf: &Bound<'_, Self>) -> PyResult<String> {
        let this = Self::at_rest(slf)?;
        let TrackerOptions { model, samples, .. } = this.0.options();
        let thumb = this.0.template().thumb().word();
        Ok(format!("ContourTracker(model='{}', thumb='{thumb}', samples={samples})", model.word()))
    }
}

impl PyContourTracker {
    /// The tracker, unless another thread is updating it.
    fn at_rest<'py>(slf: &Bound<'py, Self>) -> PyResult<PyRef<'py, Self>> {
        slf.try_borrow().map_err(|_| in_use("ContourTracker"))
    }
}

/// The estimate of one frame.
#[pyclass(name = "Track", module = "fingerpost._core", frozen)]
pub struct PyTrack(pub Track);

#[pymethods]
impl PyTrack {
    /// Time of capture of the frame.
    #[getter]
    fn time_s(&self) -> f64 {
        self.0.time_s
    }

    /// State of the tracker after the frame.
    #[getter]
    fn status(&self) -> &'static str {
        self.0.status.word()
    }

    /// The finger line, if the hand is tracked and the fit was accepted.
    #[getter]
    fn finger_line(&self) -> Option<PyFingerLine> {
        self.0.finger_line.map(PyFingerLine)
    }

    /// Name and unit of each component of the shape vector.
    #[getter]
    fn shape_names(&self) -> Vec<&'static str> {
        self.0.shape.map_or_else(Vec::new, |s| s.names.to_vec())
    }

    /// The fitted shape, if the fit was accepted.
    #[getter]
    fn shape_vector(&self, py: Python<'_>) -> Option<Py<PyArray1<f64>>> {
        let ShapeEstimate { names, vector, .. } = self.0.shape?;
        Some(column(py, vector.iter().take(names.len()).copied()))
    }

    /// Covariance of the shape vector.
    #[getter]
    fn shape_covariance(&self, py: Python<'_>) -> PyResult<Option<Py<PyArray2<f64>>>> {
        let Some(ShapeEstimate { names, covariance, .. }) = self.0.shape else { return Ok(None) };
        let n = names.len();
        let entries = (0..n).flat_map(|i| (0..n).map(move |j| covariance[(i, j)]));
        flat_table(py, entries.collect(), n).map(Some)
    }

    /// Diagnostics of the frame's fit.
    #[getter]
    fn diagnostics(&self) -> PyDiagnostics {
        PyDiagnostics(self.0.diagnostics)
    }

    fn __repr__(&self) -> String {
        let Track { time_s, finger_line, .. } = &self.0;
        let line = finger_line.map_or_else(|| "None".to_owned(), |l| PyFingerLine(l).__repr__());
        format!("Track(time_s={time_s}, status='{}', finger_line={line})", self.status())
    }
}

/// The image line that the finger points along.
#[pyclass(name = "FingerLine", module = "fingerpost._core", frozen)]
pub struct PyFingerLine(FingerLine);

#[pymethods]
impl PyFingerLine {
    /// The point to which the covariance refers: the midpoint of the measured segment.
    #[getter]
    fn anchor_px(&self) -> (f64, f64) {
        (self.0.axis.anchor.x, self.0.axis.anchor.y)
    }

    /// The finger's apex, on the line.
    #[getter]
    fn tip_px(&self) -> (f64, f64) {
        (self.0.axis.tip.x, self.0.axis.tip.y)
    }

    /// Direction of pointing.
    #[getter]
    fn angle_rad(&self) -> f64 {
        self.0.axis.angle_rad
    }

    /// Half the length of the segment that the line was measured on.
    #[getter]
    fn half_length_px(&self) -> f64 {
        self.0.half_length_px
    }

    /// Start and end of the segment that the line is reported for, relative to the anchor.
    #[getter]
    fn stretch_px(&self) -> (f64, f64) {
        (self.0.stretch.from_px, self.0.stretch.to_px)
    }

    /// Covariance of (offset, angle).
    #[getter]
    fn covariance(&self, py: Python<'_>) -> PyResult<Py<PyArray2<f64>>> {
        flat_table(py, self.0.covariance.transpose().as_slice().to_vec(), 2)
    }

    /// The measurements that the line was estimated from.
    #[getter]
    fn source(&self) -> &'static str {
        self.0.source.word()
    }

    fn __repr__(&self) -> String {
        let FingerLine { axis: Axis { anchor, tip, angle_rad }, covariance, .. } = &self.0;
        format!(
            "FingerLine(anchor_px=({:.2}, {:.2}), tip_px=({:.2}, {:.2}), \
             angle_rad={angle_rad:.4} ± {:.4}, offset_px=0 ± {:.3})",
            anchor.x,
            anchor.y,
            tip.x,
            tip.y,
            covariance[(1, 1)].sqrt(),
            covariance[(0, 0)].sqrt(),
        )
    }
}

/// Diagnostics of one frame.
#[pyclass(name = "Diagnostics", module = "fingerpost._core", frozen)]
pub struct PyDiagnostics(Diagnostics);

#[pymethods]
impl PyDiagnostics {
    /// Number of contour samples that no other limb hides.
    #[getter]
    fn visible(&self) -> usize {
        self.0.visible
    }

    /// Number of visible samples on whose search line an edge was found.
    #[getter]
    fn hits(&self) -> usize {
        self.0.hits
    }

    /// Number of edges that agree with the fit.
    #[getter]
    fn inliers(&self) -> usize {
        self.0.inliers
    }

    /// Fraction of the finger's visible samples whose edges agree with the fit.
    #[getter]
    fn agreement(&self) -> f64 {
        self.0.agreement
    }

    /// The least agreement at which the fit would be accepted; above 1 if there is none.
    #[getter]
    fn min_agreement(&self) -> f64 {
        self.0.min_agreement
    }

    /// Root mean square of the residual offsets of the inliers.
    #[getter]
    fn residual_rms_px(&self) -> f64 {
        self.0.residual_rms_px
    }

    /// The largest such residual at which the fit would be accepted.
    #[getter]
    fn max_residual_px(&self) -> f64 {
        self.0.max_residual_px
    }

    /// Number of directions of the shape space that the measurements determine.
    #[getter]
    fn rank(&self) -> usize {
        self.0.rank
    }

    /// Number of searches along the normals in the last shape space.
    #[getter]
    fn iterations(&self) -> usize {
        self.0.iterations
    }

    /// Whether the fit was determined and accepted.
    #[getter]
    fn accepted(&self) -> bool {
        self.0.accepted
    }

    /// Reason for refusing the fit.
    #[getter]
    fn refusal(&self) -> Option<&'static str> {
        self.0.refusal.map(Word::word)
    }

    /// Normalised square of the innovation of position and angle.
    #[getter]
    fn innovation(&self) -> Option<f64> {
        self.0.innovation
    }

    /// Bend of the finger in the image.
    #[getter]
    fn bend_rad(&self) -> Option<f64> {
        self.0.bend_rad
    }

    fn __repr__(&self) -> String {
        let Diagnostics { visible, hits, inliers, residual_rms_px, rank, iterations, .. } = self.0;
        let accepted = if self.0.accepted { "True" } else { "False" };
        let innovation = self.0.innovation.map_or("None".to_owned(), |i| format!("{i:.2}"));
        format!(
            "Diagnostics(accepted={accepted}, visible={visible}, hits={hits}, inliers={inliers}, \
             residual_rms_px={residual_rms_px:.3}, rank={rank}, iterations={iterations}, \
             innovation={innovation})"
        )
    }
}
