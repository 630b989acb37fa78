//! Least-squares fit of control points to an ordered outline.
//!
//! With a parameter assigned to every outline point, the control points that minimise the sum of
//! squared distances solve a linear system. It is solved by Householder QR instead of the normal
//! equations, which would square its condition number. The singular values of R show whether the
//! outline determines every control point.

use nalgebra::{DMatrix, Point2};

use crate::geometry::bspline::{BSpline, check_count, finite_point};
use crate::{Error, Result};

/// Assignment of parameters to the points of an outline.
///
/// Computed parameters cover the whole domain: from its start at the first point to its end at the
/// last point of an open curve, or back at the first of a closed one, whose first point need not be
/// repeated.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Parametrization<'a> {
    /// Proportional to the length of the polygon through the points. The usual choice for an
    /// outline traced at even steps.
    ChordLength,
    /// Proportional to the sums of the square roots of the polygon's sides: smoother where long and
    /// short sides meet at a sharp turn (Piegl and Tiller, equation 9.6).
    Centripetal,
    /// One parameter per outline point, in the domain, in any order.
    Given(&'a [f64]),
}

/// A least-squares fit and its quality. Made by [`BSpline::fit`].
#[derive(Debug, Clone, PartialEq)]
pub struct SplineFit {
    /// The control points of the fitted curve.
    pub control_points: Vec<Point2<f64>>,
    /// The parameter of every outline point.
    pub parameters: Vec<f64>,
    /// Root mean square of the distances between the outline's points and the curve at their
    /// parameters, in the outline's unit. The distance to the curve is at most this.
    pub rms_residual: f64,
    /// The largest of these distances.
    pub max_residual: f64,
    /// The condition number of the system, which bounds the relative error of the control points
    /// over that of the outline. It is a few units when the outline covers the knots evenly.
    pub condition: f64,
}

impl BSpline {
    /// The control points that minimise the sum of squared distances between each point of an
    /// ordered outline and the curve at its parameter.
    ///
    /// Repeated neighbours in the outline count as often as they occur.
    ///
    /// # Errors
    ///
    /// [`Error::TooFew`] for fewer outline points than control points, [`Error::NotFiniteAt`],
    /// [`Error::UnusableLength`] if all outline points coincide and parameters are to be computed,
    /// [`Error::WrongCount`], [`Error::NotFinite`] and [`Error::OutsideDomain`] for given
    /// parameters, [`Error::UndeterminedControlPoints`] if no outline point falls where some basis
    /// function needs one (the condition of Schoenberg and Whitney, to within rounding).
    /// ```
    /// use fingerpost_core::{BSpline, Degree, Parametrization};
    /// use fingerpost_core::nalgebra::Point2;
    ///
    /// // A circle of radius 50 px, seen at 60 points.
    /// let outline: Vec<_> = (0..60)
    ///     .map(|i| f64::from(i).to_radians() * 6.0)
    ///     .map(|angle| Point2::new(50.0 * angle.cos(), 50.0 * angle.sin()))
    ///     .collect();
    /// let circle = BSpline::closed_uniform(Degree::Cubic, 12)?;
    /// let fit = circle.fit(&outline, Parametrization::ChordLength)?;
    /// assert!(fit.max_residual < 0.02);
    /// # Ok::<(), fingerpost_core::Error>(())
    /// ```
    pub fn fit(
        &self,
        outline: &[Point2<f64>],
        parametrization: Parametrization<'_>,
    ) -> Result<SplineFit> {
        check_count("outline points", outline.len(), self.control_point_count())?;
        for i in 0..outline.len() {
            finite_point("outline point", outline, i)?;
        }
        let parameters = self.parametrize(outline, parametrization)?;
        let design = self.design_matrix(&parameters)?;
        let target = DMatrix::from_fn(outline.len(), 2, |i, axis| outline[i][axis]);

        let (solution, condition) = least_squares(design.clone(), target.clone())?;
        let residuals = design * &solution - target;
        let squares: Vec<f64> = residuals.row_iter().map(|row| row.norm_squared()).collect();
        let sum = Error::finite("the squared residual of a B-spline fit", squares.iter().sum())?;
        Ok(SplineFit {
            control_points: solution.row_iter().map(|row| Point2::new(row[0], row[1])).collect(),
            rms_residual: (sum / squares.len() as f64).sqrt(),
            max_residual: squares.iter().copied().fold(0.0, f64::max).sqrt(),
            parameters,
            condition,
        })
    }

    fn parametrize(
        &self,
        outline: &[Point2<f64>],
        parametrization: Parametrization<'_>,
    ) -> Result<Vec<f64>> {
        match parametrization {
            Parametrization::ChordLength => self.spread(outline, |chord| chord),
            Parametrization::Centripetal => self.spread(outline, f64::sqrt),
            Parametrization::Given(parameters) if parameters.len() == outline.len() => {
                Ok(parameters.to_vec())
            }
            Parametrization::Given(parameters) => Err(Error::WrongCount {
                what: "parameters",
                given: parameters.len(),
                needed: outline.len(),
            }),
        }
    }

    /// Parameters over the whole domain, with differences proportional to the weights of the
    /// chords.
    fn spread(&self, outline: &[Point2<f64>], weight: fn(f64) -> f64) -> Result<Vec<f64>> {
        let chord = |a: &Point2<f64>, b: &Point2<f64>| weight((b.x - a.x).hypot(b.y - a.y));
        let mut travelled = 0.0;
        let mut stations = vec![travelled];
        for pair in outline.windows(2) {
            travelled += chord(&pair[0], &pair[1]);
            stations.push(travelled);
        }
        if self.is_closed() {
            travelled += chord(&outline[outline.len() - 1], &outline[0]);
        }
        if !(travelled > 0.0 && travelled.is_finite()) {
            return Err(Error::UnusableLength { what: "outline", length: travelled });
        }
        let (start, end) = self.domain();
        let at = |station: f64| (start + (end - start) * (station / travelled)).min(end);
        Ok(stations.into_iter().map(at).collect())
    }

    /// The value of every basis function (columns) at every parameter (rows).
    fn design_matrix(&self, parameters: &[f64]) -> Result<DMatrix<f64>> {
        let mut design = DMatrix::zeros(parameters.len(), self.control_point_count());
        for (i, &t) in parameters.iter().enumerate() {
            let row = self.basis(t)?;
            for (j, &value) in row.indices().zip(row.values()) {
                design[(i, j)] = value;
            }
        }
        Ok(design)
    }
}

/// The x that minimises |design · x − target|, and the condition number of `design`, which has no
/// fewer rows than columns.
fn least_squares(design: DMatrix<f64>, mut target: DMatrix<f64>) -> Result<(DMatrix<f64>, f64)> {
    let (rows, columns) = design.shape();
    let qr = design.qr();
    qr.q_tr_mul(&mut target);
    let r = qr.unpack_r();

    let singular_values = r.singular_values();
    let (greatest, least) = (singular_values.max(), singular_values.min());
    let rounding = greatest * rows as f64 * f64::EPSILON;
    let rank = singular_values.iter().filter(|&&value| value > rounding).count();
    let undetermined = Error::UndeterminedControlPoints { rank, control_points: columns };
    if rank < columns {
        return Err(undetermined);
    }
    let solution = r.solve_upper_triangular(&target.rows(0, columns)).ok_or(undetermined)?;
    Ok((solution, greatest / least))
}
