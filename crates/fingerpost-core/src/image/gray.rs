//! A borrowed grey image.
//!
//! [`GrayView`] borrows 8-bit pixels row by row, with any stride, and never copies them: a frame
//! from a camera, a file or a `NumPy` array is sampled in place. The centre of the top-left pixel
//! is (0, 0), u runs right, v runs down; values between pixel centres are bilinear.
//!
//! There is no border policy. The image is defined on [0, width − 1] × [0, height − 1], the hull of
//! the pixel centres. Outside it the value is `None`, because extrapolated pixels would create
//! edges.

use std::fmt;
use std::ops::{Add, Mul, Sub};

use crate::{Error, Result};

/// A borrowed view of an 8-bit grey image.
///
/// ```
/// use fingerpost_core::GrayView;
///
/// // 3 × 2 pixels in rows of 4 bytes; the last row may end with its last pixel.
/// let bytes = [0, 10, 20, 255, 40, 50, 60];
/// let image = GrayView::new(&bytes, 3, 2, 4)?;
/// assert_eq!(image.pixel(2, 1), Some(60));
/// assert_eq!(image.sample_f64(0.5, 0.5), Some(25.0));
/// assert_eq!(image.sample_f64(2.1, 0.0), None);
/// # Ok::<(), fingerpost_core::Error>(())
/// ```
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct GrayView<'a> {
    /// Exactly the bytes from the first pixel to the last: (height − 1) · stride + width.
    data: &'a [u8],
    width: usize,
    height: usize,
    stride: usize,
}

impl<'a> GrayView<'a> {
    /// Maximum side in px: up to here every pixel coordinate is exact in `f32`.
    pub const MAX_SIDE: usize = 1 << f32::MANTISSA_DIGITS;

    /// A view of `width` × `height` pixels in `data`, `stride` bytes from one row to the next.
    ///
    /// The last row needs no padding; bytes after its last pixel are ignored.
    ///
    /// # Errors
    ///
    /// [`Error::EmptyImage`] and [`Error::ImageTooLarge`] unless both sides are in
    /// 1..=[`MAX_SIDE`](Self::MAX_SIDE), [`Error::StrideTooSmall`] if `stride < width`,
    /// [`Error::PixelsMissing`] if `data` is shorter than (height − 1) · stride + width.
    pub fn new(data: &'a [u8], width: usize, height: usize, stride: usize) -> Result<Self> {
        let data = pixel_data::<1>(data, width, height, stride)?;
        Ok(Self { data, width, height, stride })
    }

    /// Width in px, at least 1.
    #[must_use]
    #[inline]
    pub fn width(&self) -> usize {
        self.width
    }

    /// Height in px, at least 1.
    #[must_use]
    #[inline]
    pub fn height(&self) -> usize {
        self.height
    }

    /// Bytes from one row to the next, at least [`width`](Self::width).
    #[must_use]
    #[inline]
    pub fn stride(&self) -> usize {
        self.stride
    }

    /// The bytes from the first pixel to the last, padding between rows included: pixel (x, y) is
    /// `data()[y * stride() + x]`, and the length is (height − 1) · stride + width.
    #[must_use]
    #[inline]
    pub fn data(&self) -> &'a [u8] {
        self.data
    }

    /// The pixel in column `x` of row `y`; `None` outside the image.
    #[must_use]
    #[inline]
    pub fn pixel(&self, x: usize, y: usize) -> Option<u8> {
        // y < height comes first: it keeps y · stride from overflowing.
        if x < self.width && y < self.height {
            self.data.get(y * self.stride + x).copied()
        } else {
            None
        }
    }

    /// The pixels of row `y` without padding; `None` outside the image.
    #[must_use]
    #[inline]
    pub fn row(&self, y: usize) -> Option<&'a [u8]> {
        // y < height comes first: it keeps y · stride from overflowing.
        if y < self.height { self.data.get(y * self.stride..)?.get(..self.width) } else { None }
    }

    /// Whether (u, v) lies in the image and at least `margin` px away from the hull of its pixel
    /// centres: u ∈ [margin, width − 1 − margin], v likewise.
    ///
    /// A negative margin widens the image. `false` where anything is NaN.
    ///
    /// ```
    /// # let pixels = [0; 64];
    /// # let image = fingerpost_core::image::gray::GrayView::new(&pixels, 8, 8, 8)?;
    /// assert!(image.contains(7.0, 3.5, 0.0)); // 8 × 8 px
    /// assert!(!image.contains(7.0, 3.5, 1.0));
    /// # Ok::<(), fingerpost_core::Error>(())
    /// ```
    #[must_use]
    #[inline]
    pub fn contains(&self, u: f64, v: f64, margin: f64) -> bool {
        let (right, bottom) = ((self.width - 1) as f64, (self.height - 1) as f64);
        u >= margin && v >= margin && u <= right - margin && v <= bottom - margin
    }

    /// The bilinear value at (u, v), in grey levels 0..=255.
    ///
    /// `None` outside [0, width − 1] × [0, height − 1] and for NaN. At a pixel centre it equals
    /// that pixel exactly. Elsewhere it is rounded in `f32`, to about 10⁻⁵ grey levels plus the
    /// effect of rounding the coordinates (10⁻⁴ px at u = 2000).
    #[must_use]
    #[inline]
    pub fn sample_f32(&self, u: f32, v: f32) -> Option<f32> {
        let (right, bottom) = ((self.width - 1) as f32, (self.height - 1) as f32);
        if !(u >= 0.0 && v >= 0.0 && u <= right && v <= bottom) {
            return None;
        }
        let (x, y) = self.cell(u as i32, v as i32);
        Some(bilinear(self.corners(x, y)?, u - x as f32, v - y as f32))
    }

    /// The bilinear value at (u, v), in grey levels 0..=255, as [`sample_f32`](Self::sample_f32)
    /// but rounded in `f64`.
    #[must_use]
    #[inline]
    pub fn sample_f64(&self, u: f64, v: f64) -> Option<f64> {
        if !self.contains(u, v, 0.0) {
            return None;
        }
        let (x, y) = self.cell(u as i32, v as i32);
        Some(bilinear(self.corners(x, y)?, u - x as f64, v - y as f64))
    }

    /// The top-left corner of the cell of four pixels that holds pixel (x, y): the last column and
    /// the last row close the cell before them. (`i32` holds [`MAX_SIDE`](Self::MAX_SIDE), and a
    /// float converts to it in a single instruction, unlike to `usize`.)
    #[inline]
    fn cell(&self, x: i32, y: i32) -> (usize, usize) {
        let (last_x, last_y) = (self.width.saturating_sub(2), self.height.saturating_sub(2));
        ((x as usize).min(last_x), (y as usize).min(last_y))
    }

    /// The pixels at (x, y), (x + 1, y), (x, y + 1), (x + 1, y + 1). In an image of one column or
    /// one row, where the fraction is 0, the existing pixel stands for both.
    #[inline]
    fn corners(&self, x: usize, y: usize) -> Option<[u8; 4]> {
        let right = usize::from(self.width > 1);
        let below = if self.height > 1 { self.stride } else { 0 };
        let pixels = self.data.get(y * self.stride + x..)?;
        Some([
            *pixels.first()?,
            *pixels.get(right)?,
            *pixels.get(below)?,
            *pixels.get(below + right)?,
        ])
    }
}

/// The bytes of an image with pixels of `BYTES` bytes each, from the first pixel to the last.
///
/// # Errors
///
/// Those of [`GrayView::new`], with rows of the width times `BYTES` bytes.
pub(crate) fn pixel_data<const BYTES: usize>(
    data: &[u8],
    width: usize,
    height: usize,
    stride: usize,
) -> Result<&[u8]> {
    if width == 0 || height == 0 {
        return Err(Error::EmptyImage { width, height });
    }
    let limit = GrayView::MAX_SIDE;
    if width.max(height) > limit {
        return Err(Error::ImageTooLarge { width, height, limit });
    }
    if stride < BYTES * width {
        return Err(Error::StrideTooSmall { stride, width, pixel_bytes: BYTES });
    }
    let (given, pixel_bytes) = (data.len(), BYTES);
    (height - 1)
        .checked_mul(stride)
        .and_then(|rows| rows.checked_add(BYTES * width))
        .and_then(|needed| data.get(..needed))
        .ok_or(Error::PixelsMissing { given, width, height, stride, pixel_bytes })
}

impl fmt::Debug for GrayView<'_> {
    /// The shape only; the pixels would fill the screen.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("GrayView")
            .field("width", &self.width)
            .field("height", &self.height)
            .field("stride", &self.stride)
            .finish_non_exhaustive()
    }
}

/// Bilinear interpolation between four pixels, row by row; `s` and `t` in [0, 1] run right and
/// down. This form is exact at all four corners.
#[inline]
fn bilinear<T>(corners: [u8; 4], s: T, t: T) -> T
where
    T: Copy + From<u8> + Add<Output = T> + Sub<Output = T> + Mul<Output = T>,
{
    let [top_left, top_right, bottom_left, bottom_right] = corners.map(T::from);
    let top = top_left + s * (top_right - top_left);
    let bottom = bottom_left + s * (bottom_right - bottom_left);
    top + t * (bottom - top)
}
