//! Curves and their deformations: B-splines, contours with normals, templates, shape spaces.

pub mod bspline;
pub mod contour;
pub mod planar;
pub mod ribbon;
pub mod shape_space;
pub mod template;
