//! `fingerpost._core.BSpline` and its results.

use crate::arrays::{column, flat_table, points, table, vector};
use crate::errors::{InvalidInputError, invalid_input, wrong};
use crate::numbers::{count, whole};
use fingerpost_core::geometry::bspline::{ArcLength, BSpline, BasisRow, Degree, Parametrization};
use numpy::{PyArray1, PyArray2, PyUntypedArrayMethods};
use pyo3::prelude::*;

/// Maximum size of a least-squares fit: outline points times control points.
const MAX_FIT_NUMBERS: usize = 1 << 24;

/// A B-spline basis: degree, knots, open or closed.
#[pyclass(name = "BSpline", module = "fingerpost._core", frozen, eq)]
#[derive(PartialEq)]
pub struct PyBSpline(pub BSpline);

#[pymethods]
impl PyBSpline {
    /// An open B-spline on a full knot vector.
    #[staticmethod]
    fn open(degree: &Bound<'_, PyAny>, knots: &Bound<'_, PyAny>) -> PyResult<Self> {
        let (degree, knots) = (degree_of(degree)?, vector(knots, "knots")?);
        BSpline::open(degree, &knots).map(Self).map_err(invalid_input)
    }

    /// An open B-spline that starts at its first control point and ends at its last.
    #[staticmethod]
    fn open_clamped(degree: &Bound<'_, PyAny>, breaks: &Bound<'_, PyAny>) -> PyResult<Self> {
        let (degree, breaks) = (degree_of(degree)?, vector(breaks, "breaks")?);
        BSpline::open_clamped(degree, &breaks).map(Self).map_err(invalid_input)
    }

    /// An open, clamped B-spline with knots one apart.
    #[staticmethod]
    fn open_uniform(
        degree: &Bound<'_, PyAny>,
        control_points: &Bound<'_, PyAny>,
    ) -> PyResult<Self> {
        let (degree, n) = (degree_of(degree)?, count(control_points, "control_points")?);
        BSpline::open_uniform(degree, n).map(Self).map_err(invalid_input)
    }

    /// A closed B-spline on the knots of one period.
    #[staticmethod]
    fn closed(degree: &Bound<'_, PyAny>, knots: &Bound<'_, PyAny>) -> PyResult<Self> {
        let (degree, knots) = (degree_of(degree)?, vector(knots, "knots")?);
        BSpline::closed(degree, &knots).map(Self).map_err(invalid_input)
    }

    /// A closed B-spline with knots one apart.
    #[staticmethod]
    fn closed_uniform(
        degree: &Bound<'_, PyAny>,
        control_points: &Bound<'_, PyAny>,
    ) -> PyResult<Self> {
        let (degree, n) = (degree_of(degree)?, count(control_points, "control_points")?);
        BSpline::closed_uniform(degree, n).map(Self).map_err(invalid_input)
    }

    /// Degree of the polynomial pieces: 2 or 3.
    #[getter]
    fn degree(&self) -> usize {
        self.0.degree() as usize
    }

    /// Whether the curve is closed.
    #[getter]
    fn is_closed(&self) -> bool {
        self.0.is_closed()
    }

    /// Number of control points of the curve.
    #[getter]
    fn control_point_count(&self) -> usize {
        self.0.control_point_count()
    }

    /// The knots in the form taken by `open` or `closed`.
    #[getter]
    fn knots(&self, py: Python<'_>) -> Py<PyArray1<f64>> {
        column(py, self.0.knots().iter().copied())
    }

    /// First and last parameter of the curve.
    #[getter]
    fn domain(&self) -> (f64, f64) {
        self.0.domain()
    }

    /// The non-zero basis functions at each parameter.
    fn basis(&self, py: Python<'_>, parameters: &Bound<'_, PyAny>) -> PyResult<PyBasisRows> {
        let parameters = vector(parameters, "parameters")?;
        let rows = py
            .detach(|| parameters.iter().map(|&t| self.0.basis(t)).collect::<Result<Vec<_>, _>>());
        PyBasisRows::new(py, &rows.map_err(invalid_input)?, self.0.degree())
    }

    /// Position and derivatives of the curve at each parameter.
    fn evaluate(
        &self,
        py: Python<'_>,
        control_points: &Bound<'_, PyAny>,
        parameters: &Bound<'_, PyAny>,
    ) -> PyResult<PyCurvePoints> {
        let control_points = points(control_points, "control_points")?;
        let parameters = vector(parameters, "parameters")?;
        let curve = py.detach(|| {
            let point = |&t| self.0.evaluate(&control_points, t);
            parameters.iter().map(point).collect::<Result<Vec<_>, _>>()
        });
        let curve = curve.map_err(invalid_input)?;
        Ok(PyCurvePoints {
            position: table(py, curve.iter().map(|c| c.position.coords.into()))?,
            first_derivative: table(py, curve.iter().map(|c| c.first_derivative.into()))?,
            second_derivative: table(py, curve.iter().map(|c| c.second_derivative.into()))?,
        })
    }

    /// Fits control points to an ordered outline by linear least squares.
    fn fit(
        &self,
        py: Python<'_>,
        outline: &Bound<'_, PyAny>,
        parametrization: &Bound<'_, PyAny>,
    ) -> PyResult<PySplineFit> {
        let outline = points(outline, "outline")?;
        check_fit_size(outline.len(), self.0.control_point_count())?;
        let given: Vec<f64>;
        let parametrization = match parametrization.extract::<&str>() {
            Ok("chord-length") => Parametrization::ChordLength,
            Ok("centripetal") => Parametrization::Centripetal,
            Ok(_) => {
                let right = "\"chord-length\", \"centripetal\" or an array of parameters";
                return Err(wrong("parametrization", parametrization, right));
            }
            Err(_) => {
                given = vector(parametrization, "parametrization")?;
                Parametrization::Given(&given)
            }
        };
        let fit = py.detach(|| self.0.fit(&outline, parametrization)).map_err(invalid_input)?;
        Ok(PySplineFit {
            control_points: table(py, fit.control_points.iter().map(|p| p.coords.into()))?,
            parameters: column(py, fit.parameters),
            rms_residual: fit.rms_residual,
            max_residual: fit.max_residual,
            condition: fit.condition,
        })
    }

    /// Measures the length along the curve.
    fn arc_length(
        &self,
        py: Python<'_>,
        control_points: &Bound<'_, PyAny>,
    ) -> PyResult<PyArcLength> {
        let control_points = points(control_points, "control_points")?;
        py.detach(|| self.0.arc_length(&control_points)).map(PyArcLength).map_err(invalid_input)
    }

    fn __repr__(&self) -> String {
        let Self(spline) = self;
        let (start, end) = spline.domain();
        format!(
            "BSpline(degree={}, {}, control_point_count={}, domain=({start}, {end}))",
            spline.degree() as usize,
            if spline.is_closed() { "closed" } else { "open" },
            spline.control_point_count(),
        )
    }
}

/// The non-zero basis functions at some parameters of a B-spline.
#[pyclass(name = "BasisRows", module = "fingerpost._core", frozen, get_all)]
pub struct PyBasisRows {
    /// Indices of the control points that act there.
    indices: Py<PyArray2<i64>>,
    /// Their weights.
    values: Py<PyArray2<f64>>,
    /// First derivatives of the weights.
    first_derivatives: Py<PyArray2<f64>>,
    /// Second derivatives of the weights.
    second_derivatives: Py<PyArray2<f64>>,
}

impl PyBasisRows {
    fn new(py: Python<'_>, rows: &[BasisRow], degree: Degree) -> PyResult<Self> {
        let weights = |of: fn(&BasisRow) -> &[f64]| {
            let flat = rows.iter().flat_map(|row| of(row).iter().copied()).collect();
            flat_table(py, flat, degree.order())
        };
        let indices = rows.iter().flat_map(|row| row.indices().map(|i| i as i64)).collect();
        Ok(Self {
            indices: flat_table(py, indices, degree.order())?,
            values: weights(BasisRow::values)?,
            first_derivatives: weights(BasisRow::first_derivatives)?,
            second_derivatives: weights(BasisRow::second_derivatives)?,
        })
    }
}

#[pymethods]
impl PyBasisRows {
    fn __repr__(&self, py: Python<'_>) -> String {
        let shape = self.values.bind(py).shape();
        format!("BasisRows({} parameters, {} weights each)", shape[0], shape[1])
    }
}

/// Points of a curve with their derivatives by the parameter.
#[pyclass(name = "CurvePoints", module = "fingerpost._core", frozen, get_all)]
pub struct PyCurvePoints {
    /// Positions.
    position: Py<PyArray2<f64>>,
    /// Along the tangent, in the direction of increasing parameter.
    first_derivative: Py<PyArray2<f64>>,
    /// The component across the tangent determines the curvature.
    second_derivative: Py<PyArray2<f64>>,
}

#[pymethods]
impl PyCurvePoints {
    fn __repr__(&self, py: Python<'_>) -> String {
        format!("CurvePoints({} points)", self.position.bind(py).shape()[0])
    }
}

/// A least-squares fit of a B-spline and its quality.
#[pyclass(name = "SplineFit", module = "fingerpost._core", frozen, get_all)]
pub struct PySplineFit {
    /// The control points of the fitted curve.
    control_points: Py<PyArray2<f64>>,
    /// The parameter of every outline point.
    parameters: Py<PyArray1<f64>>,
    /// Root mean square distance between outline points and the curve.
    rms_residual: f64,
    /// The largest of these distances.
    max_residual: f64,
    /// Condition number of the system.
    condition: f64,
}

#[pymethods]
impl PySplineFit {
    fn __repr__(&self, py: Python<'_>) -> String {
        format!(
            "SplineFit({} control points, rms_residual={:.3e}, max_residual={:.3e}, \
             condition={:.3})",
            self.control_points.bind(py).shape()[0],
            self.rms_residual,
            self.max_residual,
            self.condition,
        )
    }
}

/// The arc length along one curve.
#[pyclass(name = "ArcLength", module = "fingerpost._core", frozen)]
pub struct PyArcLength(ArcLength);

#[pymethods]
impl PyArcLength {
    /// The length of the whole curve.
    #[getter]
    fn total(&self) -> f64 {
        self.0.total()
    }

    /// The parameter at each length from the start.
    fn parameter_at(
        &self,
        py: Python<'_>,
        lengths: &Bound<'_, PyAny>,
    ) -> PyResult<Py<PyArray1<f64>>> {
        let lengths = vector(lengths, "lengths")?;
        let parameters = py.detach(|| {
            lengths.iter().map(|&s| self.0.parameter_at(s)).collect::<Result<Vec<_>, _>>()
        });
        Ok(column(py, parameters.map_err(invalid_input)?))
    }

    /// Parameters at equal steps of arc length.
    fn equally_spaced(
        &self,
        py: Python<'_>,
        samples: &Bound<'_, PyAny>,
    ) -> PyResult<Py<PyArray1<f64>>> {
        let samples = count(samples, "samples")?;
        let parameters = py.detach(|| self.0.equally_spaced(samples)).map_err(invalid_input)?;
        Ok(column(py, parameters))
    }

    fn __repr__(&self) -> String {
        format!("ArcLength(total={})", self.0.total())
    }
}

fn degree_of(value: &Bound<'_, PyAny>) -> PyResult<Degree> {
    Degree::try_from(whole(value, "degree")?).map_err(invalid_input)
}

/// Refuses a fit before it takes all memory.
pub fn check_fit_size(outline_points: usize, control_points: usize) -> PyResult<()> {
    if outline_points.checked_mul(control_points).is_some_and(|n| n <= MAX_FIT_NUMBERS) {
        return Ok(());
    }
    Err(InvalidInputError::new_err(format!(
        "{outline_points} outline points for {control_points} control points; their product may \
         not exceed {MAX_FIT_NUMBERS}"
    )))
}
