//! Reduced image in which a large hand is tracked.
//!
//! The deviations of a hand from its model, and the structures of its background, scale with its
//! size in the image: joints and nails, the shading of a flank, the grain of a table. For a finger
//! twice as wide, the edge residuals due to them are twice as large in pixels, and measurements
//! over a fixed number of pixels contain less of the edge. Therefore a large hand is tracked in an
//! image reduced by a whole factor, each pixel the mean of a square of pixels, in which its finger
//! has the usual width. The contour is insensitive to the small blur that this adds to a sharp
//! edge; the finger line is refined in the frame at full resolution, where its pixels agree with a
//! finger.

use super::estimate::{MAX_DOF, ShapeEstimate};
use super::line::FingerLine;
use super::outcome::{Diagnostics, Track};
use super::status::StartPose;
use crate::Result;
use crate::axis::{Finger, PhotometricReport, Refined, WidthPrior};
use crate::geometry::shape_space::{Axis, PlacedSample};
use crate::image::frame::{ColourView, Frame};
use crate::image::gray::GrayView;
use nalgebra::{Matrix2, Point2, SVector, Vector2};

/// Least half-width of a finger in a reduced image \[px\]. Hands of 12 to 13 px that were tracked
/// at full resolution took the shading along a flank for its edge: before wood their points were up
/// to three times as far off as in an image of half the size. In images of a smaller size still, a
/// hand was lost to the jaw of a gripper.
const MIN_REDUCED_HALF_WIDTH_PX: f64 = 6.0;

/// Reduction of the tracked image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct PyramidLevel {
    factor: usize,
}

impl PyramidLevel {
    /// No reduction.
    pub const NONE: Self = Self { factor: 1 };

    /// The level for a finger of this half-width in the frame.
    pub fn of_finger(half_width_px: f64) -> Self {
        let factor = (half_width_px / MIN_REDUCED_HALF_WIDTH_PX).floor();
        Self { factor: factor.max(1.0).min(f64::from(u8::MAX)) as usize }
    }

    /// Whether the image is reduced.
    pub fn is_smaller(self) -> bool {
        self.factor > 1
    }

    pub fn factor(self) -> usize {
        self.factor
    }

    /// Length of a pixel of the reduced image in pixels of the frame.
    pub fn px(self) -> f64 {
        self.factor as f64
    }

    /// Frame coordinate of the centre of the reduced image's first pixel.
    fn first_px(self) -> f64 {
        0.5 * (self.px() - 1.0)
    }

    /// Converts a point from the reduced image to the frame.
    pub fn in_frame(self, at: Point2<f64>) -> Point2<f64> {
        at.map(|c| c * self.px() + self.first_px())
    }

    fn in_picture(self, at: Point2<f64>) -> Point2<f64> {
        at.map(|c| (c - self.first_px()) / self.px())
    }

    /// Converts a start pose from the frame to the reduced image.
    pub fn start(self, start: &StartPose) -> StartPose {
        let (tip_px, length_px) = (self.in_picture(start.tip_px), start.length_px / self.px());
        StartPose { tip_px, length_px, ..*start }
    }

    /// Converts a sample from the reduced image to the frame.
    pub fn sample(self, sample: &PlacedSample) -> PlacedSample {
        PlacedSample { position: self.in_frame(sample.position), ..*sample }
    }

    /// Converts a finger from the reduced image to the frame.
    pub fn finger(self, finger: &Finger) -> Finger {
        let px = self.px();
        Finger {
            axis: self.axis(&finger.axis),
            half_width_px: px * finger.half_width_px,
            taper: finger.taper,
            flanks: finger.flanks.map(|stretch| stretch.scaled(px)),
            round_end_px: finger.round_end_px.map(|end| px * end),
            prior: finger.prior.map(|b| WidthPrior {
                half_width_px: px * b.half_width_px,
                half_width_sigma_px: px * b.half_width_sigma_px,
                axis_sigmas: [px * b.axis_sigmas[0], b.axis_sigmas[1]],
                ..b
            }),
        }
    }

    fn axis(self, axis: &Axis) -> Axis {
        let Axis { anchor, tip, angle_rad } = *axis;
        Axis { anchor: self.in_frame(anchor), tip: self.in_frame(tip), angle_rad }
    }

    /// Converts a refined line from the frame to the reduced image.
    pub fn refined(self, refined: &Refined) -> Refined {
        let part = 1.0 / self.px();
        let Refined { axis, stretch, .. } = *refined;
        let (anchor, tip) = (self.in_picture(axis.anchor), self.in_picture(axis.tip));
        Refined {
            axis: Axis { anchor, tip, ..axis },
            covariance: scaled(&refined.covariance, part),
            stretch: stretch.scaled(part),
            half_width_px: part * refined.half_width_px,
            photometric: refined.photometric.map(|report| PhotometricReport {
                half_length_px: part * report.half_length_px,
                bend_px: part * report.bend_px,
                bend_sigma_px: part * report.bend_sigma_px,
                ..report
            }),
            ..*refined
        }
    }

    /// Converts a track from the reduced image to the frame.
    pub fn track(self, track: &Track) -> Track {
        let px = self.px();
        let Diagnostics { residual_rms_px, max_residual_px, .. } = track.diagnostics;
        Track {
            shape: track.shape.map(|shape| self.shape(&shape)),
            finger_line: track.finger_line.map(|line| FingerLine {
                axis: self.axis(&line.axis),
                half_length_px: px * line.half_length_px,
                stretch: line.stretch.scaled(px),
                covariance: scaled(&line.covariance, px),
                ..line
            }),
            diagnostics: Diagnostics {
                residual_rms_px: px * residual_rms_px,
                max_residual_px: px * max_residual_px,
                ..track.diagnostics
            },
            ..*track
        }
    }

    /// Converts a shape vector: its first two components are a position, and those named "\[px\]"
    /// are lengths.
    fn shape(self, shape: &ShapeEstimate) -> ShapeEstimate {
        let mut units = SVector::<f64, MAX_DOF>::repeat(1.0);
        for (unit, _) in units.iter_mut().zip(shape.names).filter(|(_, n)| n.ends_with("[px]")) {
            *unit = self.px();
        }
        let mut vector = shape.vector.component_mul(&units);
        vector[0] += self.first_px();
        vector[1] += self.first_px();
        let covariance = shape.covariance.component_mul(&(units * units.transpose()));
        ShapeEstimate { vector, covariance, ..*shape }
    }
}

/// Covariance of (offset, angle) with the offset scaled by `px`.
fn scaled(covariance: &Matrix2<f64>, px: f64) -> Matrix2<f64> {
    let unit = Matrix2::from_diagonal(&Vector2::new(px, 1.0));
    unit * covariance * unit
}

/// Pixels of the reduced image, kept from frame to frame, so that nothing is allocated.
#[derive(Debug, Clone, Default)]
pub(super) struct ReducedImage {
    gray: Vec<u8>,
    colour: Vec<u8>,
    sums: Vec<u16>,
}

impl ReducedImage {
    /// The reduced frame; an incomplete square at the right or lower border is left out.
    ///
    /// # Errors
    /// None, except for a frame that was never made.
    pub fn of(&mut self, frame: &Frame<'_>, pyramid_level: PyramidLevel) -> Result<Frame<'_>> {
        let Self { gray, colour, sums } = self;
        let image = frame.image();
        let factor = pyramid_level.factor.min(image.width()).min(image.height());
        let (width, height) = (image.width() / factor, image.height() / factor);
        reduce::<1>(gray, sums, factor, (width, height), |y| image.row(y));
        let view = GrayView::new(gray, width, height, width)?;
        let Some(colours) = frame.colour() else { return Ok(Frame::gray(view)) };
        reduce::<3>(colour, sums, factor, (width, height), |y| colours.row(y));
        Frame::coloured(view, ColourView::new(colour, width, height, 3 * width)?)
    }
}

/// Means over squares of `factor` × `factor` pixels in each of `CHANNELS` channels.
fn reduce<'a, const CHANNELS: usize>(
    pixels: &mut Vec<u8>,
    sums: &mut Vec<u16>,
    factor: usize,
    (width, height): (usize, usize),
    row: impl Fn(usize) -> Option<&'a [u8]>,
) {
    pixels.resize(CHANNELS * width * height, 0);
    sums.resize(CHANNELS * width * factor, 0);
    for (y, reduced) in pixels.chunks_exact_mut(CHANNELS * width).enumerate() {
        sums.fill(0);
        for y in y * factor..(y + 1) * factor {
            for (sum, &grey) in sums.iter_mut().zip(row(y).unwrap_or_default()) {
                *sum += u16::from(grey);
            }
        }
        // With a constant factor, the division of a mean takes an instruction or two.
        match factor {
            2 => means::<CHANNELS>(reduced, sums, 2),
            3 => means::<CHANNELS>(reduced, sums, 3),
            _ => means::<CHANNELS>(reduced, sums, factor),
        }
    }
}

/// Means of a row of squares, from the sums of their columns.
#[expect(clippy::inline_always, reason = "where the factor is a constant, it is compiled as one")]
#[inline(always)]
fn means<const CHANNELS: usize>(reduced: &mut [u8], sums: &[u16], factor: usize) {
    let squares = sums.chunks_exact(CHANNELS * factor);
    let area = (factor * factor) as u32;
    for (pixel, square) in reduced.chunks_exact_mut(CHANNELS).zip(squares) {
        for (c, mean) in pixel.iter_mut().enumerate() {
            let mut sum = area / 2;
            for k in 0..factor {
                sum += u32::from(square[k * CHANNELS + c]);
            }
            *mean = (sum / area) as u8;
        }
    }
}
