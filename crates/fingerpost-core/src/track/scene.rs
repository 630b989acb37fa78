//! A frame, and what its camera shows where no hand is.

use super::pyramid::PyramidLevel;
use crate::appearance::background::Background;
use crate::axis::KnownBackground;
use crate::image::frame::Frame;
use nalgebra::Point2;
use std::ops::Deref;

/// A frame before a background that may be known; otherwise it is the frame, or the picture that it is
/// reduced to.
#[derive(Debug, Clone, Copy)]
pub(super) struct Scene<'a> {
    frame: Frame<'a>,
    background: Option<&'a Background>,
    /// Whether the background has a say in where the hand is, and does not only judge it.
    leads: bool,
    whole: Frame<'a>,
    pyramid_level: PyramidLevel,
}

impl<'a> Scene<'a> {
    /// A frame and its background, which counts only where its edges are.
    pub fn new(frame: &Frame<'a>, background: Option<&'a Background>) -> Self {
        let background = background.filter(|b| b.is_exact());
        Self {
            frame: *frame,
            background,
            leads: true,
            whole: *frame,
            pyramid_level: PyramidLevel::NONE,
        }
    }

    /// The same, to be looked at in a smaller picture.
    pub fn reduced<'b>(&self, picture: Frame<'b>, pyramid_level: PyramidLevel) -> Scene<'b>
    where
        'a: 'b,
    {
        Scene { frame: picture, pyramid_level, ..*self }
    }

    /// The frame, to be looked at alone.
    pub fn alone(&self) -> Self {
        Self { leads: false, ..*self }
    }

    /// The frame as it was recorded, where it is looked at in a smaller picture.
    pub fn whole(&self) -> Option<&Frame<'a>> {
        self.pyramid_level.is_smaller().then_some(&self.whole)
    }

    /// What is behind the hand, if that is known and has a say in where the hand is.
    pub fn background(&self) -> Option<Behind<'_>> {
        self.table().filter(|_| self.leads)
    }

    /// What is behind the hand, if that is known: it judges what was found, in a frame alone as well.
    pub fn table(&self) -> Option<Behind<'_>> {
        self.background.map(|background| Behind { background, scene: self })
    }
}

impl<'a> Deref for Scene<'a> {
    type Target = Frame<'a>;

    fn deref(&self) -> &Frame<'a> {
        &self.frame
    }
}

/// What is behind the hand.
#[derive(Debug, Clone, Copy)]
pub(super) struct Behind<'a> {
    background: &'a Background,
    scene: &'a Scene<'a>,
}

impl<'a> Behind<'a> {
    /// How likely a place is foreground, 0–1; see [`Background::foreground`].
    pub fn foreground(self, at: Point2<f64>) -> Option<f64> {
        let Scene { pyramid_level, whole, .. } = self.scene;
        let at = pyramid_level.in_frame(at);
        self.background.foreground(whole, at.x, at.y)
    }

    /// What is known of it in the frame as it was recorded.
    pub fn known_whole(self) -> KnownBackground<'a> {
        KnownBackground::from(self.background)
    }

    /// The same in the picture that is looked at.
    pub fn known(self) -> KnownBackground<'a> {
        self.known_whole().reduced(self.scene.pyramid_level.factor())
    }
}
