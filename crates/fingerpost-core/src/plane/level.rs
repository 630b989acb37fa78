//! The pixels of one pyramid level, and one least-squares step over them.

use nalgebra::{Matrix3, SMatrix, SVector, SymmetricEigen};

use super::elimination::{Derivatives, LightSums, SquareNormal, Sums, UNKNOWNS};
use super::hand_region::HandRegion;
use super::lens::RadialLens;
use crate::image::gray::GrayView;
use crate::numeric::simd::{Isa, Work};
use crate::{Error, Result};

/// Greatest relative change of a square's gain: a plain area in place of an edge fits with a change
/// of −1 and is not the plane.
const MAX_GAIN: f64 = 0.5;

/// Tukey's constant, 95 % efficient for normal errors, and the range of the residual scale. A
/// square that is an inlier only at a larger scale is not the plane.
const BIWEIGHT: f64 = 4.685;
const MIN_SCALE: f64 = 0.3;
const MAX_SCALE: f64 = 2.0;

/// Standard deviation of normal errors over their median absolute value.
const SIGMA_OVER_MEDIAN: f64 = 1.4826;

/// Rate of the running mean of a pixel's inlier indicator (its trust, 1 to 0), and the least trust
/// of a pixel that is expected to be an inlier.
const TRUST_RATE: f64 = 0.1;
const MIN_TRUST: f64 = 0.5;

/// Eigenvalues below this part of the largest one are not inverted.
const MIN_EIGENVALUE_RATIO: f64 = 1e-9;

/// Margin of the pixels that are interpolated \[px\].
const MARGIN_PX: f64 = 1.0;

pub(super) type Matrix8 = SMatrix<f64, UNKNOWNS, UNKNOWNS>;
pub(super) type Vector8 = SVector<f64, UNKNOWNS>;

/// Pixels of one level of the first image, ordered by square; all slices have one length.
#[derive(Debug, Clone, Copy)]
pub struct PlanePixels<'a> {
    /// Positions in the pinhole image at full resolution \[px\].
    pub positions_px: &'a [[f64; 2]],
    /// Grey levels of the smoothed level.
    pub levels: &'a [f64],
    /// Gradients by a position at full resolution \[levels/px\].
    pub gradients: &'a [[f64; 2]],
    /// Variances of the residuals of inliers \[levels²\], positive.
    pub variances: &'a [f64],
    /// The square of each, in ascending order.
    pub squares: &'a [usize],
}

/// Parameters common to all levels of a view.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct View {
    /// The view's distortion, if known.
    pub lens: Option<RadialLens>,
    /// From pixels at full resolution to coordinates of order 1, in which steps are computed: a
    /// scale and a shift.
    pub unit_from_px: Matrix3<f64>,
}

/// One pixel of a level.
#[derive(Debug, Clone, Copy)]
struct PlanePixel {
    position_px: [f64; 2],
    level: f64,
    /// One over the variance and the standard deviation of an inlier's residual.
    information: f64,
    inverse_sigma: f64,
    /// Squared gradient over the variance.
    position_information: f64,
    trust: f64,
    row: Derivatives,
}

/// Residual of a pixel in the present image, and its weight.
#[derive(Debug, Clone, Copy, Default)]
struct Seen {
    is_visible: bool,
    residual: f64,
    /// Residual without light \[standard deviations\]; infinite beyond [`MAX_GAIN`].
    error: f64,
    biweight: f64,
}

/// The chosen pixels of one level of the first image's pyramid.
#[derive(Debug, Clone)]
pub struct PlaneLevel {
    view: View,
    /// Size of the level's pixels over that at full resolution, at most 1.
    scale: f64,
    /// Information of the prior that keeps the accumulated step a similarity.
    prior: Matrix8,
    pixels: Vec<PlanePixel>,
    /// End of each square in `pixels`.
    ends: Vec<usize>,
    seen: Vec<Seen>,
    errors: Vec<f64>,
    normals: Vec<SquareNormal>,
}

/// A least-squares step, before it is applied.
#[derive(Debug, Clone, Copy)]
pub(super) struct Step {
    /// Entries of the step less the identity, in unit coordinates.
    pub entries: Vector8,
    /// Inverse of the normal matrix.
    inverse: Matrix8,
    /// Part of the information of the expected pixels that inliers have, and their number.
    pub inlier_share: f64,
    pub inliers: usize,
}

impl PlaneLevel {
    /// The pixels of a level `scale` times the size of the first image. `non_similarity_sigma` is
    /// the standard deviation, in unit coordinates, of the change between two images of those
    /// components of a homography that a similarity does not have.
    ///
    /// # Errors
    ///
    /// [`Error::OutOfRange`] for slices of different lengths, a variance, scale or standard
    /// deviation that is not positive, or squares that are not in order; [`Error::NotFinite`] for
    /// any number.
    pub fn new(
        pixels: &PlanePixels<'_>,
        scale: f64,
        non_similarity_sigma: f64,
        view: View,
    ) -> Result<Self> {
        check(pixels, scale, non_similarity_sigma)?;
        let squares = pixels.squares;
        let count = squares.len();
        let ends: Vec<usize> =
            (1..=count).filter(|&i| i == count || squares[i] != squares[i - 1]).collect();
        let pixel = |i: usize| {
            let ([gu, gv], variance) = (pixels.gradients[i], pixels.variances[i]);
            PlanePixel {
                position_px: pixels.positions_px[i],
                level: pixels.levels[i],
                information: 1.0 / variance,
                inverse_sigma: 1.0 / variance.sqrt(),
                position_information: (gu * gu + gv * gv) / variance,
                trust: 1.0,
                row: derivatives(pixels.positions_px[i], [gu, gv], &view.unit_from_px),
            }
        };
        Ok(Self {
            view,
            scale,
            prior: non_similarity() / (non_similarity_sigma * non_similarity_sigma),
            pixels: (0..count).map(pixel).collect(),
            seen: vec![Seen::default(); count],
            errors: Vec::with_capacity(count),
            normals: vec![SquareNormal::default(); ends.len()],
            ends,
        })
    }

    /// Size of the level's pixels over that at full resolution.
    pub(super) fn scale(&self) -> f64 {
        self.scale
    }

    /// From pixels at full resolution to unit coordinates.
    pub(super) fn unit_from_px(&self) -> Matrix3<f64> {
        self.view.unit_from_px
    }

    /// Number of its pixels.
    pub(super) fn len(&self) -> usize {
        self.pixels.len()
    }

    /// The least-squares step from a homography; `None` with fewer than `least` expected pixels in
    /// view, or without any information.
    ///
    /// `accumulated` is the step since the guess in unit coordinates, which the prior draws to a
    /// similarity.
    pub(super) fn step(
        &mut self,
        smooth: &GrayView<'_>,
        now_from_first: &Matrix3<f64>,
        accumulated: &Matrix3<f64>,
        hand: Option<&HandRegion>,
        least: f64,
    ) -> Option<Step> {
        Isa::detect().run(SamplePixels { level: self, smooth, now_from_first, hand });
        self.errors.clear();
        let expected = self.pixels.iter().zip(&self.seen);
        self.errors.extend(
            expected.filter(|(p, s)| s.is_visible && p.trust > MIN_TRUST).map(|(_, s)| s.error),
        );
        if self.errors.is_empty() || (self.errors.len() as f64) < least {
            return None;
        }
        let middle = self.errors.len() / 2;
        let (_, median, _) = self.errors.select_nth_unstable_by(middle, f64::total_cmp);
        let scale = (SIGMA_OVER_MEDIAN * *median).max(MIN_SCALE);
        Isa::detect().run(WeighPixels { level: self, cut: BIWEIGHT * scale });
        let (entries, inverse) = self.solved(accumulated)?;
        let (inlier_share, inliers) = self.inliers(BIWEIGHT * scale.min(MAX_SCALE));
        Some(Step { entries, inverse, inlier_share, inliers })
    }

    /// Solution and inverse of the normal equations; `None` without any information.
    fn solved(&self, accumulated: &Matrix3<f64>) -> Option<(Vector8, Matrix8)> {
        let mut matrix = self.prior;
        let deviation = accumulated - Matrix3::identity();
        let deviation = Vector8::from_fn(|k, _| deviation[(k / 3, k % 3)]);
        let mut right = self.prior * deviation;
        for normal in &self.normals {
            matrix += Matrix8::from_fn(|k, j| normal.matrix[k][j]);
            right += Vector8::from(normal.right);
        }
        let inverse = pseudo_inverse(&matrix)?;
        Some((inverse * right, inverse))
    }

    /// Inliers among the expected pixels: their part of the information, and their number.
    fn inliers(&self, cut: f64) -> (f64, usize) {
        let (mut expected_information, mut inlier_information, mut count) = (0.0, 0.0, 0);
        for (pixel, seen) in self.pixels.iter().zip(&self.seen) {
            if seen.is_visible && pixel.trust > MIN_TRUST {
                expected_information += pixel.position_information;
                if seen.error < cut {
                    inlier_information += pixel.position_information;
                    count += 1;
                }
            }
        }
        (inlier_information / expected_information, count)
    }

    /// Covariance of a step's entries, clustered: errors within a square correlate.
    pub(super) fn covariance(&self, step: &Step) -> Matrix8 {
        let mut middle = self.prior;
        for normal in &self.normals {
            let matrix = Matrix8::from_fn(|k, j| normal.matrix[k][j]);
            let score = Vector8::from(normal.right) - matrix * step.entries;
            middle += score * score.transpose();
        }
        step.inverse * middle * step.inverse
    }

    /// Updates the trust of the visible pixels by whether they are inliers of the last step.
    pub(super) fn learn(&mut self) {
        for (pixel, seen) in self.pixels.iter_mut().zip(&self.seen) {
            if seen.is_visible {
                let is_inlier = f64::from(u8::from(seen.biweight > 0.0));
                pixel.trust += TRUST_RATE * (is_inlier - pixel.trust);
            }
        }
    }
}

/// Samples the pixels in the present image, and eliminates the light from their residuals.
struct SamplePixels<'a> {
    level: &'a mut PlaneLevel,
    smooth: &'a GrayView<'a>,
    now_from_first: &'a Matrix3<f64>,
    hand: Option<&'a HandRegion>,
}

impl Work for SamplePixels<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { level, smooth, now_from_first, hand } = self;
        let h = now_from_first;
        let rows = [0, 1, 2].map(|k| [h[(k, 0)], h[(k, 1)], h[(k, 2)]]);
        let mut start = 0;
        for &end in &level.ends {
            let pixels = &level.pixels[start..end];
            let seen = &mut level.seen[start..end];
            let mut light = LightSums::default();
            for (pixel, seen) in pixels.iter().zip(seen.iter_mut()) {
                let [u, v] = pixel.position_px;
                let [x, y, z] = [0, 1, 2].map(|k| rows[k][0] * u + rows[k][1] * v + rows[k][2]);
                let ideal_px = if z > 0.0 { [x / z, y / z] } else { [f64::NAN; 2] };
                let place_px = level.view.lens.map_or(ideal_px, |lens| lens.distort(ideal_px));
                let sampled = interpolate_level(smooth, place_px, level.scale)
                    .filter(|_| hand.is_none_or(|hand| !hand.contains(place_px)));
                seen.is_visible = sampled.is_some();
                seen.residual = sampled.map_or(0.0, |sampled| sampled - pixel.level);
                let weight = if seen.is_visible { pixel.trust * pixel.information } else { 0.0 };
                light.add(weight, pixel.level, seen.residual);
            }
            let (level_mean, residual_mean, gain) = light.solved();
            for (pixel, seen) in pixels.iter().zip(seen) {
                let residual = seen.residual - residual_mean - gain * (pixel.level - level_mean);
                let error = residual.abs() * pixel.inverse_sigma;
                seen.error = if gain.abs() < MAX_GAIN { error } else { f64::INFINITY };
            }
            start = end;
        }
    }
}

/// Weighs the pixels by Tukey's biweight, and sums the normal equations of each square.
struct WeighPixels<'a> {
    level: &'a mut PlaneLevel,
    cut: f64,
}

impl Work for WeighPixels<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { level, cut } = self;
        let mut start = 0;
        for (&end, normal) in level.ends.iter().zip(&mut level.normals) {
            let mut sums = Sums::default();
            for (pixel, seen) in level.pixels[start..end].iter().zip(&mut level.seen[start..end]) {
                seen.biweight = 0.0;
                if seen.is_visible && seen.error < cut {
                    let part = seen.error / cut;
                    let root_weight = 1.0 - part * part;
                    seen.biweight = root_weight * root_weight;
                    let weight = pixel.trust * pixel.information * seen.biweight;
                    sums.add(weight, pixel.level, seen.residual, &pixel.row);
                }
            }
            *normal = sums.eliminated();
            start = end;
        }
    }
}

/// The level at a position at full resolution, in an image `scale` times its size; `None` at its
/// border.
#[inline(always)]
fn interpolate_level(smooth: &GrayView<'_>, [u, v]: [f64; 2], scale: f64) -> Option<f64> {
    let (u, v) = ((u + 0.5) * scale - 0.5, (v + 0.5) * scale - 0.5);
    let (right, bottom) = (smooth.width() as f64 - 2.0, smooth.height() as f64 - 2.0);
    if !(u >= MARGIN_PX && v >= MARGIN_PX && u <= right && v <= bottom) {
        return None;
    }
    let (column, row) = (u as usize, v as usize);
    let (p, q) = (u - column as f64, v - row as f64);
    let (data, at) = (smooth.data(), row * smooth.stride() + column);
    let (above, below) = (data.get(at..at + 2)?, data.get(at + smooth.stride()..)?.get(..2)?);
    let mix = |pair: &[u8]| f64::from(pair[0]) + p * (f64::from(pair[1]) - f64::from(pair[0]));
    let (above, below) = (mix(above), mix(below));
    Some(above + q * (below - above))
}

/// Derivatives of a pixel's level by the entries of a step but the last.
fn derivatives([u, v]: [f64; 2], [gu, gv]: [f64; 2], unit_from_px: &Matrix3<f64>) -> Derivatives {
    let m = unit_from_px;
    let (x, y) = (m[(0, 0)] * u + m[(0, 2)], m[(1, 1)] * v + m[(1, 2)]);
    let (gx, gy) = (gu / m[(0, 0)], gv / m[(1, 1)]);
    let radial = -(gx * x + gy * y);
    [gx * x, gx * y, gx, gy * x, gy * y, gy, radial * x, radial * y]
}

/// Information of the four combinations of entries that vanish in a similarity, of unit variance:
/// h₀₀ − h₁₁, h₀₁ + h₁₀, h₂₀ and h₂₁.
fn non_similarity() -> Matrix8 {
    let mut information = Matrix8::zeros();
    for (k, j, product) in [(0, 4, -1.0), (1, 3, 1.0)] {
        (information[(k, k)], information[(j, j)]) = (1.0, 1.0);
        (information[(k, j)], information[(j, k)]) = (product, product);
    }
    (information[(6, 6)], information[(7, 7)]) = (1.0, 1.0);
    information
}

/// Pseudo-inverse of a symmetric matrix, its unknowns brought to one scale; `None` if one of them
/// has no information.
fn pseudo_inverse(matrix: &Matrix8) -> Option<Matrix8> {
    let scale = matrix.diagonal().map(f64::sqrt);
    if !scale.iter().all(|&s| s > 0.0 && s.is_finite()) {
        return None;
    }
    let scaled = Matrix8::from_fn(|k, j| matrix[(k, j)] / (scale[k] * scale[j]));
    let SymmetricEigen { eigenvectors, eigenvalues } = SymmetricEigen::new(scaled);
    let least = MIN_EIGENVALUE_RATIO * eigenvalues.max();
    let inverse = eigenvalues.map(|value| if value > least { 1.0 / value } else { 0.0 });
    let inverse = eigenvectors * Matrix8::from_diagonal(&inverse) * eigenvectors.transpose();
    Some(Matrix8::from_fn(|k, j| inverse[(k, j)] / (scale[k] * scale[j])))
}

/// Refuses invalid pixels of a level.
fn check(pixels: &PlanePixels<'_>, scale: f64, non_similarity_sigma: f64) -> Result<()> {
    let count = pixels.squares.len();
    let lengths = [
        ("number of positions", pixels.positions_px.len()),
        ("number of levels", pixels.levels.len()),
        ("number of gradients", pixels.gradients.len()),
        ("number of variances", pixels.variances.len()),
    ];
    for (what, length) in lengths {
        if length != count {
            let right = "as large as the number of squares' entries";
            return Err(Error::OutOfRange { what, value: length as f64, right });
        }
    }
    if !pixels.squares.is_sorted() {
        let right = "ascending";
        return Err(Error::OutOfRange { what: "order of squares", value: f64::NAN, right });
    }
    let positive = [("scale of the level", scale), ("non-similarity sigma", non_similarity_sigma)];
    let variances = pixels.variances.iter().map(|&variance| ("variance [levels²]", variance));
    for (what, value) in positive.into_iter().chain(variances) {
        if !(value > 0.0 && value.is_finite()) {
            return Err(Error::OutOfRange { what, value, right: "positive and finite" });
        }
    }
    let pairs = pixels.positions_px.iter().chain(pixels.gradients).flatten();
    match pairs.chain(pixels.levels).find(|value| !value.is_finite()) {
        Some(&value) => Err(Error::NotFinite { what: "a position, gradient or level", value }),
        None => Ok(()),
    }
}
