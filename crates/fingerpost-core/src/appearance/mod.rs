//! Models of what the hand and its background look like, and the images in which they differ most.

pub mod background;
pub mod discriminant;
pub mod histogram;
