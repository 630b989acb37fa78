//! The start pose of a template, and the state of a tracker.

use nalgebra::Point2;

/// The start pose of the initial template.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StartPose {
    /// The finger's tip \[px\].
    pub tip_px: Point2<f64>,
    /// Direction of pointing \[rad\], from +u (right) towards +v (down).
    pub angle_rad: f64,
    /// Visible length of the index finger \[px\], positive.
    pub length_px: f64,
}

/// The state of a tracker.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Status {
    /// The template is at its start pose, or is being fitted to a hand that is held up to it.
    Acquiring,
    /// The hand is tracked.
    Tracking,
    /// The hand was tracked and is no longer found; it is searched for.
    Lost,
}
