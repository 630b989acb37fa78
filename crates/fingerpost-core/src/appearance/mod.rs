//! Appearance models of the hand and its background, and the images in which they differ most.

pub mod background;
pub mod discriminant;
pub mod histogram;
