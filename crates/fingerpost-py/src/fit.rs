//! `fingerpost._core.Fitter`: dispatches the number of unknowns to a constant of the core.

use crate::arrays::{column, flat_table, matrix, rows, same_length, vector};
use crate::errors::{InvalidInputError, invalid_input, wrong};
use crate::numbers::real;
use crate::options::{Overlay, options, overlay_fields, overlay_words};
use crate::words::Word;
use fingerpost_core::Error;
use fingerpost_core::nalgebra::{DMatrix, SMatrix, SVector};
use fingerpost_core::solve::fit::{
    EquationBuffer, FitOptions, FitReport, Fitter, Loss, Outcome, Prior, Solve,
};
use numpy::{PyArray1, PyArray2};
use pyo3::prelude::*;

overlay_fields!(FitOptions { loss, solve, max_iterations, min_scale_px });
overlay_words!(Solve);

impl Overlay for Loss {
    fn overlay(&mut self, value: &Bound<'_, PyAny>, path: &str) -> PyResult<()> {
        *self = match (value.extract::<&str>(), real(value, path)) {
            (Ok("none"), _) => Self::None,
            (_, Ok(cutoff)) => Self::Tukey { cutoff },
            _ => return Err(wrong(path, value, "\"none\" or Tukey's cutoff in robust sigmas")),
        };
        Ok(())
    }

    fn entry<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        match self {
            Self::None => Ok("none".into_pyobject(py)?.into_any()),
            Self::Tukey { cutoff } => cutoff.entry(py),
        }
    }
}

/// Tolerance of the symmetry and of the least eigenvalue of a prior's information, relative to its
/// largest entry: rounding errors of the caller's computation.
const ROUNDING: f64 = 1e-9;

/// `$body`, with the value of `$unknowns` as the constant `$D`.
macro_rules! with_unknowns {
    ($unknowns:expr, $D:ident => $body:expr, else $other:expr) => {
        with_unknowns!(@ $unknowns, $D, $body, $other, 1 2 3 4 5 6 7 8 9)
    };
    (@ $unknowns:expr, $D:ident, $body:expr, $other:expr, $($number:literal)+) => {
        match $unknowns {
            $($number => {
                const $D: usize = $number;
                $body
            })+
            _ => $other,
        }
    };
}

/// Weighted least squares for the step of a shape vector.
#[pyclass(name = "Fitter", module = "fingerpost._core", frozen)]
pub struct PyFitter(Fitter);

#[pymethods]
impl PyFitter {
    #[new]
    #[pyo3(signature = (options = None))]
    fn new(options: Option<&Bound<'_, PyAny>>) -> PyResult<Self> {
        Fitter::new(self::options(options)?).map(Self).map_err(invalid_input)
    }

    /// Every option in force.
    #[getter]
    fn options<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        self.0.options().entry(py)
    }

    /// Finds the step that minimises the robust loss of the equations and the prior.
    #[pyo3(signature = (rows, offset_px, variance_px2, *, prior = None))]
    fn solve(
        &self,
        py: Python<'_>,
        rows: &Bound<'_, PyAny>,
        offset_px: &Bound<'_, PyAny>,
        variance_px2: &Bound<'_, PyAny>,
        prior: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<PyFitReport> {
        let (rows, unknowns) = self::rows(rows, "rows")?;
        let (offsets_px, variances_px2) =
            (vector(offset_px, "offset_px")?, vector(variance_px2, "variance_px2")?);
        with_unknowns!(unknowns, D => {
            let equations = rows.len() / D;
            same_length("offset_px", offsets_px.len(), "rows", equations)?;
            same_length("variance_px2", variances_px2.len(), "rows", equations)?;
            let prior = prior.map(self::prior::<D>).transpose()?;
            // A copy for each call, so that several threads may solve at once; its buffers are a
            // few kilobytes.
            let mut fitter = self.0.clone();
            let report = py.detach(|| {
                let mut buffer = EquationBuffer::with_capacity(equations, D);
                let mut equations = buffer.clear::<D>();
                for (i, row) in rows.chunks_exact(D).enumerate() {
                    let row = SVector::from_column_slice(row);
                    equations.push(&row, offsets_px[i], variances_px2[i])?;
                }
                Ok(fitter.solve(&equations, prior.as_ref()))
            });
            PyFitReport::new(py, &report.map_err(invalid_input)?, &fitter)
        }, else Err(InvalidInputError::new_err(format!(
            "rows has {unknowns} columns, one for each unknown; 1 to 9 can be solved for"
        ))))
    }

    fn __repr__(&self, py: Python<'_>) -> PyResult<String> {
        Ok(format!("Fitter({})", self.options(py)?))
    }
}

/// Mean and information of a prior, checked.
fn prior<const D: usize>(given: &Bound<'_, PyAny>) -> PyResult<Prior<D>> {
    let (mean, information) = given
        .extract::<(Bound<'_, PyAny>, Bound<'_, PyAny>)>()
        .map_err(|_| wrong("prior", given, "a tuple (mean, information)"))?;
    let mean = matrix::<D, 1>(&mean, "prior mean", &format!("({D},)"))?;
    let information = matrix::<D, D>(&information, "prior information", &format!("({D}, {D})"))?;
    if let Some(&value) = mean.iter().chain(information.iter()).find(|value| !value.is_finite()) {
        return Err(invalid_input(Error::NotFinite { what: "prior", value }));
    }
    let slack = ROUNDING * information.amax();
    let asymmetry = (information - information.transpose()).amax();
    let eigenvalues = DMatrix::from_column_slice(D, D, information.as_slice());
    let least = eigenvalues.symmetric_eigenvalues().min();
    if asymmetry > slack || least < -slack {
        return Err(InvalidInputError::new_err(format!(
            "prior information is asymmetric by {asymmetry} and its least eigenvalue is {least}; \
             it must be symmetric without negative eigenvalues"
        )));
    }
    Ok(Prior { mean, information })
}

/// The result of a fit and its quality.
#[pyclass(name = "FitReport", module = "fingerpost._core", frozen, get_all)]
pub struct PyFitReport {
    /// Whether the step is determined.
    outcome: &'static str,
    /// The step; None unless determined.
    step: Option<Py<PyArray1<f64>>>,
    /// Covariance of the step; None unless determined.
    covariance: Option<Py<PyArray2<f64>>>,
    /// Weighted sum of the equations' information, plus the prior's.
    information: Py<PyArray2<f64>>,
    /// Number of directions of the shape space that the information determines.
    rank: usize,
    /// Number of solutions until the weights converged.
    iterations: usize,
    /// Number of equations.
    equations: usize,
    /// Number of equations with more than a tenth of their full weight.
    inliers: usize,
    /// Root mean square of the inliers' residual offsets.
    residual_rms_px: f64,
    /// Robust standard deviation of the residual offsets.
    residual_scale_px: f64,
    /// Residual offset of every equation.
    residual_px: Py<PyArray1<f64>>,
    /// Robust weight of every equation.
    weight: Py<PyArray1<f64>>,
}

impl PyFitReport {
    fn new<const D: usize>(
        py: Python<'_>,
        report: &FitReport<D>,
        fitter: &Fitter,
    ) -> PyResult<Self> {
        let determined = report.outcome == Outcome::Determined;
        let square = |m: &SMatrix<f64, D, D>| flat_table(py, m.as_slice().to_vec(), D);
        Ok(Self {
            outcome: report.outcome.word(),
            step: determined.then(|| column(py, report.step.iter().copied())),
            covariance: determined.then(|| square(&report.covariance)).transpose()?,
            information: square(&report.information)?,
            rank: report.rank,
            iterations: report.iterations,
            equations: report.equations,
            inliers: report.inliers,
            residual_rms_px: report.residual_rms_px,
            residual_scale_px: report.residual_scale_px,
            residual_px: column(py, fitter.residuals().iter().copied()),
            weight: column(py, fitter.weights().iter().copied()),
        })
    }
}

#[pymethods]
impl PyFitReport {
    fn __repr__(&self) -> String {
        format!(
            "FitReport(outcome='{}', rank={}, inliers={} of {}, residual_rms_px={:.4}, iterations={})",
            self.outcome,
            self.rank,
            self.inliers,
            self.equations,
            self.residual_rms_px,
            self.iterations,
        )
    }
}
