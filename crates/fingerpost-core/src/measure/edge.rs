//! What is searched along the normals of a contour, and what is found.

use crate::geometry::shape_space::PlacedSample;

/// Which side of an edge is the hand.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Polarity {
    /// The hand is brighter than what is behind it.
    Bright,
    /// The hand is darker than what is behind it.
    Dark,
    /// Not known: either will do.
    Unknown,
}

/// How large a kernel looks for edges.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Scale {
    /// [`SearchOptions::scale_px`]: places a sharp edge best.
    Fine,
    /// Two and a half times that: sees an edge that motion has smeared.
    Coarse,
}

/// One line to search: a placed contour sample, how far to look and what to look for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SearchLine {
    /// The sample and its outward normal.
    pub sample: PlacedSample,
    /// Offsets −L … +L are searched \[px\]; rounded up to a whole pixel.
    pub half_length_px: f64,
    /// Which side of the edge is the hand.
    pub polarity: Polarity,
}

/// Why a search line found no edge.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Miss {
    /// Too little of the line lies inside the image.
    OutOfImage,
    /// No response of the right polarity reaches the least contrast.
    NoContrast,
    /// The response still rises where the line ends: the edge, if any, lies beyond.
    BeyondEnd,
}

/// An edge found along a search line.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Edge {
    /// Signed distance along the outward normal \[px\].
    pub offset_px: f64,
    /// Contrast, hand minus background \[grey levels\]; its sign is the polarity found.
    pub contrast_grey: f64,
    /// Variance of the offset \[px²\] from image noise alone.
    pub variance_px2: f64,
    /// How the pixels on either side vote, if the hand's appearance is known: the mean vote inside
    /// minus the mean vote outside. Near zero the edge is not the hand's.
    pub separation: Option<f64>,
}

/// What one search line yields: an edge, or why there is none. A miss is never an offset of zero.
pub type EdgeMeasurement = Result<Edge, Miss>;

/// The longest half-length of a search line \[px\].
pub const MAX_HALF_LENGTH_PX: usize = 128;
