//! Estimation: robust weighted least squares, and the Kalman filter on shape vectors.

pub mod dynamics;
pub mod fit;
