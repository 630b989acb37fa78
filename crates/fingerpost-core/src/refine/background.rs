//! What a camera that does not move sees where the hand is not.

use crate::background::Background;
use crate::image::GrayView;
use crate::{Error, Result};
use nalgebra::Vector2;

/// A borrowed view of a learned background: the mean grey level of every pixel and how sure it is.
/// It is made from two maps, or from a [`Background`] as it stands in the light of its last frame.
///
/// ```
/// use fingerpost_core::refine::KnownBackground;
///
/// let (mean, sigma) = ([80.0_f32; 12], [0.4_f32; 12]);
/// let background = KnownBackground::new(&mean, &sigma, 4, 3)?;
/// assert_eq!((background.width(), background.height()), (4, 3));
/// # Ok::<(), fingerpost_core::Error>(())
/// ```
#[derive(Debug, Clone, Copy)]
pub struct KnownBackground<'a> {
    levels: Levels<'a>,
    image: Option<GrayView<'a>>,
    width: usize,
    height: usize,
}

/// Where the levels come from.
#[derive(Debug, Clone, Copy)]
enum Levels<'a> {
    Maps { mean_grey: &'a [f32], sigma_grey: &'a [f32] },
    Learned(&'a Background),
}

impl<'a> From<&'a Background> for KnownBackground<'a> {
    fn from(learned: &'a Background) -> Self {
        let (width, height) = learned.size();
        Self { levels: Levels::Learned(learned), image: None, width, height }
    }
}

impl<'a> KnownBackground<'a> {
    /// A background of `width` × `height` pixels, row by row without padding: the mean grey level
    /// \[0–255\] and the standard deviation of that mean \[grey levels, not negative\]. A pixel that
    /// was never seen without the hand has an infinite standard deviation, and is not used.
    ///
    /// # Errors
    /// When a side is zero or a slice is not of `width` · `height` numbers. The numbers themselves
    /// are looked at where they are used: a pixel whose mean is not finite, or whose standard
    /// deviation is negative or not finite, counts as never seen.
    pub fn new(
        mean_grey: &'a [f32],
        sigma_grey: &'a [f32],
        width: usize,
        height: usize,
    ) -> Result<Self> {
        if width == 0 || height == 0 {
            return Err(Error::EmptyImage { width, height });
        }
        let needed = width.saturating_mul(height);
        for (what, given) in [
            ("mean grey levels of the background", mean_grey.len()),
            ("standard deviations of the background", sigma_grey.len()),
        ] {
            if given != needed {
                return Err(Error::WrongCount { what, given, needed });
            }
        }
        Ok(Self { levels: Levels::Maps { mean_grey, sigma_grey }, image: None, width, height })
    }

    /// The same, behind what `image` shows: where the refined frame is another picture of the scene,
    /// such as a mixture of its colours, its levels are not those of the background.
    #[must_use]
    pub fn behind(self, image: GrayView<'a>) -> Self {
        Self { image: Some(image), ..self }
    }

    /// The picture that it is the background of, if that is not the refined frame.
    pub(super) fn image(&self) -> Option<&GrayView<'a>> {
        self.image.as_ref()
    }

    /// Width in px.
    #[must_use]
    pub fn width(&self) -> usize {
        self.width
    }

    /// Height in px.
    #[must_use]
    pub fn height(&self) -> usize {
        self.height
    }

    /// Level, first and second derivative along the unit vector `n`, and variance of a pixel;
    /// `None` where it is not known, or on the border, where it has no derivatives.
    pub(super) fn local(&self, x: usize, y: usize, n: Vector2<f64>) -> Option<[f32; 4]> {
        let [[a, b, c], [d, e, f], [g, h, k]] = self.about(x, y)?;
        let doubt = self.doubt(x, y)?;
        let (u, v) = (n.x as f32, n.y as f32);
        let slope = 0.5 * (u * (f - d) + v * (h - b));
        let curvature =
            u * u * (f - 2.0 * e + d) + v * v * (h - 2.0 * e + b) + 0.5 * u * v * (k - c - g + a);
        (e + slope + curvature).is_finite().then_some([e, slope, curvature, doubt])
    }

    /// Level and variance of a pixel, if they are known.
    pub(super) fn level(&self, x: usize, y: usize) -> Option<[f32; 2]> {
        let [_, [_, level, _], _] = self.about(x, y)?;
        Some([level, self.doubt(x, y)?]).filter(|_| level.is_finite())
    }

    /// The levels about a pixel, row by row; `None` on the border and where one was never seen.
    fn about(&self, x: usize, y: usize) -> Option<[[f32; 3]; 3]> {
        if x == 0 || y == 0 || x + 1 >= self.width || y + 1 >= self.height {
            return None;
        }
        match self.levels {
            Levels::Learned(background) => background.about(x, y),
            Levels::Maps { mean_grey, .. } => {
                let row = |y: usize| {
                    let from = y * self.width + x - 1;
                    mean_grey.get(from..from + 3)?.try_into().ok()
                };
                Some([row(y - 1)?, row(y)?, row(y + 1)?])
            }
        }
    }

    /// Variance of a pixel inside the image; `None` where it was never seen.
    fn doubt(&self, x: usize, y: usize) -> Option<f32> {
        match self.levels {
            Levels::Learned(background) => Some(background.doubt(x, y) as f32),
            Levels::Maps { sigma_grey, .. } => {
                let sigma = *sigma_grey.get(y * self.width + x)?;
                (sigma >= 0.0 && sigma.is_finite()).then_some(sigma * sigma)
            }
        }
    }
}
