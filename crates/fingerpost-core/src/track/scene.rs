//! A frame, or the reduced image of it, with the model of its background.

use super::pyramid::PyramidLevel;
use crate::appearance::background::Background;
use crate::axis::KnownBackground;
use crate::image::frame::Frame;
use nalgebra::Point2;
use std::ops::Deref;

/// A frame and its background model, if that is known; it dereferences to the frame, or to the
/// reduced image of it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Scene<'a> {
    frame: Frame<'a>,
    background: Option<&'a Background>,
    /// Whether the background is used in the search for the hand, and not only in its validation.
    guides_search: bool,
    whole: Frame<'a>,
    pyramid_level: PyramidLevel,
}

impl<'a> Scene<'a> {
    /// A frame and its background, which is used only if its edges are in place
    /// ([`Background::is_exact`]).
    pub fn new(frame: &Frame<'a>, background: Option<&'a Background>) -> Self {
        let background = background.filter(|b| b.is_exact());
        Self {
            frame: *frame,
            background,
            guides_search: true,
            whole: *frame,
            pyramid_level: PyramidLevel::NONE,
        }
    }

    /// The same, with a reduced image in place of the frame.
    pub fn reduced<'b>(&self, picture: Frame<'b>, pyramid_level: PyramidLevel) -> Scene<'b>
    where
        'a: 'b,
    {
        Scene { frame: picture, pyramid_level, ..*self }
    }

    /// The same, with the background used in validation only.
    pub fn without_background_in_search(&self) -> Self {
        Self { guides_search: false, ..*self }
    }

    /// The frame at full resolution; `None` unless the scene shows a reduced image.
    pub fn whole(&self) -> Option<&Frame<'a>> {
        self.pyramid_level.is_smaller().then_some(&self.whole)
    }

    /// The background, if it is known and used in the search.
    pub fn background_for_search(&self) -> Option<SceneBackground<'_>> {
        self.background_for_validation().filter(|_| self.guides_search)
    }

    /// The background, if it is known, also if it is not used in the search.
    pub fn background_for_validation(&self) -> Option<SceneBackground<'_>> {
        self.background.map(|background| SceneBackground { background, scene: self })
    }
}

impl<'a> Deref for Scene<'a> {
    type Target = Frame<'a>;

    fn deref(&self) -> &Frame<'a> {
        &self.frame
    }
}

/// The background of a scene.
#[derive(Debug, Clone, Copy)]
pub(super) struct SceneBackground<'a> {
    background: &'a Background,
    scene: &'a Scene<'a>,
}

impl<'a> SceneBackground<'a> {
    /// Foreground probability of a place, 0–1; see [`Background::foreground`].
    pub fn foreground(self, at: Point2<f64>) -> Option<f64> {
        let Scene { pyramid_level, whole, .. } = self.scene;
        let at = pyramid_level.in_frame(at);
        self.background.foreground(whole, at.x, at.y)
    }

    /// The background model at full resolution.
    pub fn known_whole(self) -> KnownBackground<'a> {
        KnownBackground::from(self.background)
    }

    /// The same in the image that the scene shows.
    pub fn known(self) -> KnownBackground<'a> {
        self.known_whole().reduced(self.scene.pyramid_level.factor())
    }
}
