//! A captured frame: its grey image, and its colours where the camera has them.

use super::gray::{GrayView, pixel_data};
use crate::{Error, Result};
use nalgebra::{Point2, Vector2, Vector3};

/// A borrowed view of interleaved 8-bit colours: three channels, in an order that is the same in
/// all frames. Never copies.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ColourView<'a> {
    data: &'a [u8],
    width: usize,
    height: usize,
    stride: usize,
}

impl<'a> ColourView<'a> {
    /// A view of `width` × `height` pixels of three bytes, `stride` bytes from one row to the next.
    ///
    /// # Errors
    /// As for [`GrayView::new`], with rows of 3 · `width` bytes.
    pub fn new(data: &'a [u8], width: usize, height: usize, stride: usize) -> Result<Self> {
        pixel_data::<3>(data, width, height, stride)?;
        Ok(Self { data, width, height, stride })
    }

    /// Bytes from one row to the next.
    #[must_use]
    pub fn stride(&self) -> usize {
        self.stride
    }

    /// The bytes from the first pixel on, padding between rows included.
    pub(crate) fn data(&self) -> &'a [u8] {
        self.data
    }

    /// The grey levels (ITU-R BT.601 luma) of an image whose channels are blue, green and red, row
    /// after row without padding; bit-identical to OpenCV's conversion.
    ///
    /// ```
    /// use fingerpost_core::ColourView;
    /// let red = ColourView::new(&[0, 0, 255], 1, 1, 3)?;
    /// assert_eq!(red.luma(), [76]);
    /// # Ok::<(), fingerpost_core::Error>(())
    /// ```
    #[must_use]
    pub fn luma(&self) -> Vec<u8> {
        let levels = |row: &'a [u8]| row.chunks_exact(3).map(|p| luma(p[0], p[1], p[2]));
        (0..self.height).filter_map(|y| self.row(y)).flat_map(levels).collect()
    }

    /// Whether the channels differ anywhere by more than the rounding of videos. Images of a
    /// monochrome camera may have three equal channels.
    ///
    /// ```
    /// use fingerpost_core::ColourView;
    /// assert!(!ColourView::new(&[90, 91, 94], 1, 1, 3)?.has_colours());
    /// assert!(ColourView::new(&[90, 91, 95], 1, 1, 3)?.has_colours());
    /// # Ok::<(), fingerpost_core::Error>(())
    /// ```
    #[must_use]
    pub fn has_colours(&self) -> bool {
        let differs = |p: &[u8]| p[1].abs_diff(p[0]).max(p[1].abs_diff(p[2])) > SAME_GREY;
        (0..self.height).filter_map(|y| self.row(y)).any(|row| row.chunks_exact(3).any(differs))
    }

    /// The three channels of a pixel, if it lies in the image.
    #[must_use]
    pub fn pixel(&self, x: usize, y: usize) -> Option<[u8; 3]> {
        if x >= self.width || y >= self.height {
            return None;
        }
        let at = y * self.stride + 3 * x;
        self.data.get(at..at + 3)?.try_into().ok()
    }

    /// The bilinear values of the three channels at (u, v), as for [`GrayView::sample_f64`].
    #[must_use]
    pub fn sample_f64(&self, u: f64, v: f64) -> Option<[f64; 3]> {
        let (right, bottom) = ((self.width - 1) as f64, (self.height - 1) as f64);
        if !(u >= 0.0 && v >= 0.0 && u <= right && v <= bottom) {
            return None;
        }
        let (x, y) = (u as usize, v as usize);
        let (fraction_u, fraction_v) = (u - x as f64, v - y as f64);
        let mut channels = [0.0; 3];
        for (below, part_v) in [(0, 1.0 - fraction_v), (1, fraction_v)] {
            for (right, part_u) in [(0, 1.0 - fraction_u), (1, fraction_u)] {
                // The last column and the last row have no neighbour beyond; its weight is zero.
                let at = ((x + right).min(self.width - 1), (y + below).min(self.height - 1));
                for (channel, level) in channels.iter_mut().zip(self.pixel(at.0, at.1)?) {
                    *channel += part_u * part_v * f64::from(level);
                }
            }
        }
        Some(channels)
    }

    /// The bytes of row `y` without padding; `None` outside the image.
    #[must_use]
    pub fn row(&self, y: usize) -> Option<&'a [u8]> {
        if y < self.height { self.data.get(y * self.stride..)?.get(..3 * self.width) } else { None }
    }
}

/// Maximum difference of the channels of a grey image after a video has been decoded \[grey
/// levels\].
const SAME_GREY: u8 = 3;

/// The weights of BT.601 in 2⁻¹⁵, rounded so that they add up to one.
const LUMA_SHIFT: u32 = 15;
const LUMA_BLUE: u32 = 3735;
const LUMA_GREEN: u32 = 19235;
const LUMA_RED: u32 = 9798;

fn luma(blue: u8, green: u8, red: u8) -> u8 {
    let sum =
        LUMA_BLUE * u32::from(blue) + LUMA_GREEN * u32::from(green) + LUMA_RED * u32::from(red);
    ((sum + (1 << (LUMA_SHIFT - 1))) >> LUMA_SHIFT) as u8
}

/// Sum of the channels of a chromaticity \[grey levels\], that of a middle grey.
pub(crate) const CHROMATICITY_SUM: f64 = 384.0;
/// Lower bound on the sum of the three channels \[grey levels\]: in darker pixels rounding would
/// dominate the chromaticity, so it is reduced in proportion.
const DARKEST_SUM: u32 = 24;

/// The chromaticity: the colour scaled to the brightness of a middle grey.
pub(crate) fn chromaticity(colour: [u8; 3]) -> Vector3<f64> {
    let sum = colour.iter().map(|&channel| u32::from(channel)).sum::<u32>();
    Vector3::from(colour.map(f64::from)) * (CHROMATICITY_SUM / f64::from(sum.max(DARKEST_SUM)))
}

/// The images that one view captured at one time.
#[derive(Debug, Clone, Copy)]
pub struct Frame<'a> {
    gray: GrayView<'a>,
    colour: Option<ColourView<'a>>,
}

impl<'a> Frame<'a> {
    /// A frame of a monochrome camera.
    #[must_use]
    pub fn gray(gray: GrayView<'a>) -> Self {
        Self { gray, colour: None }
    }

    /// A frame with its colours. Edges are measured in `gray`; `colour` distinguishes the hand from
    /// its background.
    ///
    /// # Errors
    /// [`Error::SizesDiffer`] when the two differ in size.
    pub fn coloured(gray: GrayView<'a>, colour: ColourView<'a>) -> Result<Self> {
        let (g, c) = ((gray.width(), gray.height()), (colour.width, colour.height));
        if g == c {
            Ok(Self { gray, colour: Some(colour) })
        } else {
            Err(Error::SizesDiffer { gray: g, colour: c })
        }
    }

    /// The grey image.
    #[must_use]
    pub fn image(&self) -> &GrayView<'a> {
        &self.gray
    }

    /// The colours.
    #[must_use]
    pub fn colour(&self) -> Option<&ColourView<'a>> {
        self.colour.as_ref()
    }
}

impl<'a> From<GrayView<'a>> for Frame<'a> {
    fn from(gray: GrayView<'a>) -> Self {
        Self::gray(gray)
    }
}

/// A pixel, which may lie outside the frame, and whether it belongs to the hand.
#[derive(Debug, Clone, Copy)]
pub(crate) struct SidedPixel {
    pub x: u32,
    pub y: u32,
    pub is_hand: bool,
}

impl SidedPixel {
    /// Its centre; coordinates left of the frame or above it wrap to values outside every frame.
    pub fn middle(&self) -> Point2<f64> {
        Point2::new(f64::from(self.x as i32), f64::from(self.y as i32))
    }

    /// The pixel nearest to a place; `None` outside all frames.
    #[inline]
    pub fn at(u: f64, v: f64, is_hand: bool) -> Option<Self> {
        // Through i32, to which a float converts in fewer instructions.
        let whole = |x: f64| (x + 0.5) as i32 as u32;
        (u > -0.5 && v > -0.5).then(|| Self { x: whole(u), y: whole(v), is_hand })
    }

    /// The pixels nearest to places 1 px apart on a ray, from a given distance from its origin on.
    /// Outside of all frames their coordinates are outside every frame.
    #[inline]
    pub fn along(
        from: Point2<f64>,
        direction: Vector2<f64>,
        first_px: f64,
        last_px: f64,
        is_hand: bool,
    ) -> impl ExactSizeIterator<Item = Self> + Clone {
        // Fixed point, 32.32: a negative number read as unsigned has the largest whole part.
        const ONE: f64 = (1_u64 << 32) as f64;
        let fixed = |x: f64| (x * ONE) as i64;
        let first = from + direction * first_px;
        let [mut x, mut y] = [first.x, first.y].map(|x| fixed(x + 0.5));
        let (dx, dy) = (fixed(direction.x), fixed(direction.y));
        let count = (last_px - first_px + 1.0).max(0.0) as u16;
        (0..count).map(move |_| {
            let pixel = Self { x: (x >> 32) as u32, y: (y >> 32) as u32, is_hand };
            (x, y) = (x.wrapping_add(dx), y.wrapping_add(dy));
            pixel
        })
    }
}
