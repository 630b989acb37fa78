//! Where a template waits, and where its hand is in its life.

use nalgebra::Point2;

/// Where the template waits for the hand.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StartPose {
    /// The finger's tip \[px\].
    pub tip_px: Point2<f64>,
    /// Direction of pointing \[rad\], from +u (right) towards +v (down).
    pub angle_rad: f64,
    /// Visible length of the index finger \[px\], positive.
    pub length_px: f64,
}

/// Where the tracker is in the life of a hand.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Status {
    /// The template waits, or moulds itself to a hand that is held up to it.
    Acquiring,
    /// The hand is followed.
    Tracking,
    /// The hand was followed and is gone; it is looked for.
    Lost,
}
