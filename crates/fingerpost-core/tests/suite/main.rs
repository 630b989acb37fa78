//! Integration tests of the core, one file per module.
//!
//! They form one program, so that the solvers of `nalgebra`, which every file uses, are compiled
//! once.
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
