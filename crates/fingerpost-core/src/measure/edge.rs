//! Search lines along the normals of a contour, and the edge measurements they yield.

use crate::geometry::shape_space::PlacedSample;

/// Sign of the hand's contrast.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Polarity {
    /// The hand is brighter than its background.
    Bright,
    /// The hand is darker than its background.
    Dark,
    /// Unknown: both signs are accepted.
    Unknown,
}

/// Scale of the edge kernel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Scale {
    /// [`SearchOptions::scale_px`](crate::measure::edge_search::SearchOptions::scale_px): localises
    /// a sharp edge best.
    Fine,
    /// Two and a half times that: responds to edges under motion blur.
    Coarse,
}

/// A line to search: a placed contour sample, the half-length and the polarity of the edge.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SearchLine {
    /// The sample and its outward normal.
    pub sample: PlacedSample,
    /// Offsets −L … +L are searched \[px\]; L is rounded up to a whole pixel.
    pub half_length_px: f64,
    /// Polarity of the edge.
    pub polarity: Polarity,
}

/// Why a search line has no edge measurement.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Miss {
    /// Too little of the line lies inside the image.
    OutOfImage,
    /// No response of the right polarity reaches the minimum contrast.
    NoContrast,
    /// The response still rises at the end of the line: the edge, if any, lies beyond.
    BeyondEnd,
}

/// An edge on a search line.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Edge {
    /// Signed distance along the outward normal \[px\].
    pub offset_px: f64,
    /// Contrast, hand minus background \[grey levels\]; its sign is the measured polarity.
    pub contrast_grey: f64,
    /// Variance of the offset \[px²\] from image noise alone.
    pub variance_px2: f64,
    /// Mean log-likelihood ratio of the pixels inside minus that outside, if the hand's appearance
    /// model is known. Near zero the edge is not the hand's.
    pub separation: Option<f64>,
}

/// The measurement of one search line: an edge, or the reason for its absence. A miss is never an
/// offset of zero.
pub type EdgeMeasurement = Result<Edge, Miss>;

/// Maximum half-length of a search line \[px\].
pub const MAX_HALF_LENGTH_PX: usize = 128;
