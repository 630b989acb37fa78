//! Detection of pointing hands in a single frame.

mod band;
pub mod candidates;
mod orientation;
