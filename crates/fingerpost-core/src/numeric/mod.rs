//! Arithmetic with bit-identical results under every instruction set.

pub(crate) mod ablation;
pub(crate) mod logarithm;
pub mod simd;
