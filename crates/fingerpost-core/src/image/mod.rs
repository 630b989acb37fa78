//! Borrowed images, grey and colour, and a frame made of both.

pub mod frame;
pub mod gray;
