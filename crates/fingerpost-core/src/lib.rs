//! Track a pointing finger in an image with an active contour.
//!
//! A B-spline [`template`] of the index finger and the up-turned thumb waits in the image; at every
//! frame the tracker [`search`](mod@search)es for edges along the normals of the contour, [`fit`]s
//! the deformations that a [`shape_space`] allows by weighted least squares, and accepts or loses
//! the hand. One basis vector of the template lies along the index finger, so the fitted shape
//! vector gives the *finger line*, the image line that the finger points along, with its
//! covariance.
//!
//! The method is that of Cipolla, Hadfield & Hollinghurst, *Uncalibrated stereo vision with
//! pointing for a man–machine interface*, MVA 1994.
//!
//! Pixel (0, 0) is the centre of the top-left pixel; u runs right, v runs down; angles are in
//! radians from +u towards +v. Nothing here reads files, opens cameras, prints or panics.

pub mod appearance;
pub mod bspline;
pub mod contour;
mod error;
pub mod fit;
pub mod frame;
pub mod image;
pub mod search;
pub mod shape_space;
pub mod template;
pub mod tracker;

pub use error::{Error, Result};
pub use frame::Frame;
pub use image::GrayView;
pub use nalgebra;
