//! The core from outside, a file for each of its modules.
//!
//! One program and not one for each file: the solvers of `nalgebra`, which every file's matrices
//! need, are built once.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, missing_docs)]
#![allow(clippy::float_cmp, reason = "where a value is exact, it is compared as such")]

mod allocations;
mod appearance;
mod background;
mod bspline;
mod candidates;
mod common;
mod contour;
mod discriminant;
mod dynamics;
mod fit;
mod image;
mod outline;
mod refine;
mod round;
mod search;
mod shape_space;
mod template;
mod tracker;
