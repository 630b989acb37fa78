//! A frame, and what its camera shows where no hand is.

use crate::background::Background;
use crate::frame::Frame;
use std::ops::Deref;

/// A frame before a background that may be known; otherwise it is the frame.
#[derive(Debug, Clone, Copy)]
pub(super) struct Scene<'a> {
    frame: Frame<'a>,
    background: Option<&'a Background>,
}

impl<'a> Scene<'a> {
    /// A frame and its background, which counts only where its edges are.
    pub fn new(frame: &Frame<'a>, background: Option<&'a Background>) -> Self {
        Self { frame: *frame, background: background.filter(|b| b.is_exact()) }
    }

    /// The frame alone.
    pub fn alone(&self) -> Self {
        Self { background: None, ..*self }
    }

    /// What is behind the hand, if that is known.
    pub fn background(&self) -> Option<&'a Background> {
        self.background
    }
}

impl<'a> Deref for Scene<'a> {
    type Target = Frame<'a>;

    fn deref(&self) -> &Frame<'a> {
        &self.frame
    }
}
