//! The learned background of a static camera.

use crate::appearance::background::Background;
use crate::image::gray::GrayView;
use crate::{Error, Result};
use nalgebra::Vector2;

/// A borrowed view of a learned background: the mean grey level of every pixel and its variance. It
/// is made from two maps, or from a [`Background`] under the illumination of its last frame.
///
/// ```
/// use fingerpost_core::axis::KnownBackground;
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
    /// A pixel is the mean of a square of `factor` × `factor` recorded pixels; width of the
    /// recorded images.
    factor: usize,
    recorded_width: usize,
}

/// Source of the levels.
#[derive(Debug, Clone, Copy)]
enum Levels<'a> {
    Maps { mean_grey: &'a [f32], sigma_grey: &'a [f32] },
    Learned(&'a Background),
}

impl<'a> From<&'a Background> for KnownBackground<'a> {
    fn from(learned: &'a Background) -> Self {
        let (width, height) = learned.size();
        Self {
            levels: Levels::Learned(learned),
            image: None,
            width,
            height,
            factor: 1,
            recorded_width: width,
        }
    }
}

impl<'a> KnownBackground<'a> {
    /// A background of `width` × `height` pixels, row by row without padding: the mean grey level
    /// \[0–255\] and the standard deviation of that mean \[grey levels, not negative\]. A pixel
    /// never observed without the hand has an infinite standard deviation, and is not used.
    ///
    /// # Errors
    /// When a side is zero or a slice does not have `width` · `height` numbers. The numbers
    /// themselves are checked where they are used: a pixel whose mean is not finite, or whose
    /// standard deviation is negative or not finite, counts as never observed.
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
        Ok(Self {
            levels: Levels::Maps { mean_grey, sigma_grey },
            image: None,
            width,
            height,
            factor: 1,
            recorded_width: width,
        })
    }

    /// The same as the background of `image`: the refined frame may be another image of the scene,
    /// such as a linear combination of its colours, with other levels.
    #[must_use]
    pub fn behind(self, image: GrayView<'a>) -> Self {
        Self { image: Some(image), ..self }
    }

    /// The same at a size reduced by a whole factor.
    pub(crate) fn reduced(self, factor: usize) -> Self {
        let factor = factor.min(self.width).min(self.height).max(1);
        let (width, height) = (self.width / factor, self.height / factor);
        Self { width, height, factor, ..self }
    }

    /// The image it is the background of, if that is not the refined frame.
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
    /// `None` where it is unknown, or on the border, where it has no derivatives.
    pub(super) fn local(&self, x: usize, y: usize, n: Vector2<f64>) -> Option<[f32; 4]> {
        let [[a, b, c], [d, e, f], [g, h, k]] = self.about(x, y)?;
        let variance = self.variance(x, y)?;
        let (u, v) = (n.x as f32, n.y as f32);
        let slope = 0.5 * (u * (f - d) + v * (h - b));
        let curvature =
            u * u * (f - 2.0 * e + d) + v * v * (h - 2.0 * e + b) + 0.5 * u * v * (k - c - g + a);
        (e + slope + curvature).is_finite().then_some([e, slope, curvature, variance])
    }

    /// Level and variance of a pixel, if they are known.
    pub(super) fn level(&self, x: usize, y: usize) -> Option<[f32; 2]> {
        let [_, [_, level, _], _] = self.about(x, y)?;
        Some([level, self.variance(x, y)?]).filter(|_| level.is_finite())
    }

    /// The 3 × 3 levels about a pixel, row by row; `None` on the border and where one was never
    /// observed.
    fn about(&self, x: usize, y: usize) -> Option<[[f32; 3]; 3]> {
        if x == 0 || y == 0 || x + 1 >= self.width || y + 1 >= self.height {
            return None;
        }
        match self.levels {
            _ if self.factor > 1 => self.means_about(x, y),
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

    /// The same at a reduced size.
    fn means_about(&self, x: usize, y: usize) -> Option<[[f32; 3]; 3]> {
        let mut means = [[0.0; 3]; 3];
        for (v, row) in (y - 1..).zip(&mut means) {
            for (u, mean) in (x - 1..).zip(row) {
                *mean = self.mean(u, v, |u, v| self.recorded_level(u, v))?;
            }
        }
        Some(means)
    }

    /// The mean over the square of recorded pixels that a pixel of the reduced size covers.
    fn mean(&self, x: usize, y: usize, of: impl Fn(usize, usize) -> Option<f32>) -> Option<f32> {
        let mut sum = 0.0;
        for v in y * self.factor..(y + 1) * self.factor {
            for u in x * self.factor..(x + 1) * self.factor {
                sum += of(u, v)?;
            }
        }
        Some(sum / (self.factor * self.factor) as f32)
    }

    /// Level of a recorded pixel, if it is known.
    fn recorded_level(&self, x: usize, y: usize) -> Option<f32> {
        match self.levels {
            Levels::Learned(background) => background.level(x, y),
            Levels::Maps { mean_grey, .. } => mean_grey.get(y * self.recorded_width + x).copied(),
        }
    }

    /// Variance of a pixel inside the image; `None` where it was never observed.
    fn variance(&self, x: usize, y: usize) -> Option<f32> {
        if self.factor == 1 {
            return self.recorded_variance(x, y);
        }
        let mean = self.mean(x, y, |u, v| self.recorded_variance(u, v))?;
        Some(mean / (self.factor * self.factor) as f32)
    }

    /// Variance of a recorded pixel.
    fn recorded_variance(&self, x: usize, y: usize) -> Option<f32> {
        match self.levels {
            Levels::Learned(background) => Some(background.variance(x, y) as f32),
            Levels::Maps { sigma_grey, .. } => {
                let sigma = *sigma_grey.get(y * self.recorded_width + x)?;
                (sigma >= 0.0 && sigma.is_finite()).then_some(sigma * sigma)
            }
        }
    }
}

// Reduced sizes are private to the crate.
#[cfg(test)]
#[expect(clippy::unwrap_used, reason = "a test may panic")]
mod tests {
    use super::*;

    #[test]
    fn a_reduced_background_has_the_means_of_squares_of_pixels() {
        let (width, height) = (11, 9);
        let mut mean: Vec<f32> = (0..99).map(|i: i32| (7 * i % 31) as f32).collect();
        let sigma: Vec<f32> = (0..99).map(|i: i32| 0.1 * (i % 5) as f32).collect();
        mean[5 * width + 7] = f32::NAN;
        let known = KnownBackground::new(&mean, &sigma, width, height).unwrap().reduced(2);
        assert_eq!((known.width(), known.height()), (5, 4));
        let over = |of: &dyn Fn(usize) -> f32, x: usize, y: usize| {
            let at = |u: usize, v: usize| of((2 * y + v) * width + 2 * x + u);
            0.25 * (at(0, 0) + at(1, 0) + at(0, 1) + at(1, 1))
        };
        let [level, variance] = known.level(1, 1).unwrap();
        assert!((level - over(&|i| mean[i], 1, 1)).abs() < 1e-5);
        assert!((variance - 0.25 * over(&|i| sigma[i] * sigma[i], 1, 1)).abs() < 1e-6);
        let [at, slope, ..] = known.local(1, 1, Vector2::new(0.0, 1.0)).unwrap();
        assert!((at - level).abs() < 1e-6);
        let below = over(&|i| mean[i], 1, 2) - over(&|i| mean[i], 1, 0);
        assert!((slope - 0.5 * below).abs() < 1e-5);
        // On the border there are no derivatives, and one pixel is unknown.
        assert_eq!(known.level(0, 1), None);
        assert_eq!(known.level(3, 2), None);
    }
}
