//! An estimated shape vector of any shape space.

use crate::geometry::ribbon::RIBBON_DOF;
use nalgebra::{SMatrix, SVector};

/// Dimension of the largest shape space.
pub const MAX_DOF: usize = RIBBON_DOF;

/// A shape vector with its covariance and the names of its components.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ShapeEstimate {
    /// Name and unit of each component.
    pub names: &'static [&'static str],
    /// The shape vector; components from `names.len()` on are zero.
    pub vector: SVector<f64, MAX_DOF>,
    /// Its covariance; rows and columns from `names.len()` on are zero.
    pub covariance: SMatrix<f64, MAX_DOF, MAX_DOF>,
}
