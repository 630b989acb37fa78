//! Registration of the working plane in the images of a camera that moves.
//!
//! Pixels of the first image that lie on the plane are aligned with the present image by a
//! homography: iterated least squares on grey levels over its eight entries, with the gradients of
//! the first image (inverse compositional: Baker & Matthews 2004), from coarse pyramid levels to
//! the full resolution. The pixels come in small squares. Each has a free gain and offset, because
//! the soft shadow of a hand crosses most of them; Tukey's biweight rejects pixels where the plane
//! is covered.
//!
//! [`PlaneLevel`] holds the pixels of one pyramid level, [`PlaneRegistration`] aligns all of them.

#![expect(
    clippy::inline_always,
    reason = "what is inlined into a function with wider instructions is compiled for them"
)]

mod elimination;
mod hand_region;
mod lens;
mod level;
mod registration;

pub use hand_region::HandRegion;
pub use lens::RadialLens;
pub use level::{PlaneLevel, PlanePixels, View};
pub use registration::{PlaneRegistration, Registered};
