//! Edge measurements along the normals of a contour.

pub mod edge;
pub mod edge_search;
pub mod outline;
mod stretch;
