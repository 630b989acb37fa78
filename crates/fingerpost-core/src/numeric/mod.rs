//! Arithmetic that gives the same bits under every instruction set.

pub(crate) mod logarithm;
pub mod simd;
