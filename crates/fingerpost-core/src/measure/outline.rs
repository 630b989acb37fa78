//! Straight edges of outlines, such as the sides of a sheet of paper: localisation to a fraction of
//! a pixel over their whole length, and robust lines through them.
//!
//! [`edges_along`] follows a path near the edge. The pixels of a short stretch of it, each at its
//! own distance s from the path, are correlated with the derivative of a Gaussian at x, `R(x) = Σ
//! I(s) K(s − x)`; the edge is the maximum of |R|, as in
//! [`edge_search`](mod@crate::measure::edge_search). The kernel is shifted instead of the pixels:
//! without interpolation no position in the pixel grid is preferred. [`fit_line`] finds the line
//! with the largest consensus and refines it by iterated least squares with biweights (Huber &
//! Ronchetti 2009, section 7.6 for the covariance).

use nalgebra::{Matrix2, Point2, Vector2};

use super::stretch::{KERNEL_REACH, KERNEL_SIGMA_PX, Stretch, summit};
use crate::image::gray::GrayView;
use crate::{Error, Result};

/// Minimum number of stretches of a path, and their maximum length \[px\].
const STRETCHES: f64 = 32.0;
const LONGEST_STRETCH_PX: f64 = 8.0;

/// Inlier threshold of the distance from a line: \[px\], in median standard deviations if that is
/// more, and its upper bound \[px\].
const AGREES_PX: f64 = 0.75;
const AGREES_SIGMAS: f64 = 5.0;
const MOST_AGREES_PX: f64 = 2.0;

/// Maximum number of points between which lines are tried.
const MOST_TRIED: usize = 40;

/// Tukey's constant, 95 % efficient for normal errors.
const BIWEIGHT: f64 = 4.685;

/// Lower bound on the scale of the residuals relative to the given one, for exact lines.
const LEAST_SCALE: f64 = 1e-3;

/// Pixel noise \[levels\], and roughness of cut edges \[px\]. Only their ratio matters, for the
/// weights; the scale of the residuals is measured.
const NOISE_LEVELS: f64 = 2.0;
const ROUGHNESS_PX: f64 = 0.03;

const MOST_ITERATIONS: usize = 20;

/// Maximum lag in the estimate of the residuals' correlation.
const MOST_LAGS: usize = 12;

/// Minimum number of points for a line and a scale.
const LEAST_POINTS: usize = 5;

/// Sign of the step across a path. The normal of the path is its direction turned by +90°, from +u
/// towards +v.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum EdgePolarity {
    /// Brighter on the side of the normal.
    Rising,
    /// Darker there.
    Falling,
    /// Either.
    Any,
}

impl EdgePolarity {
    fn strength(self, response: f64) -> f64 {
        match self {
            Self::Rising => response,
            Self::Falling => -response,
            Self::Any => response.abs(),
        }
    }
}

/// The edge of one stretch.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EdgePoint {
    /// Position \[px\].
    pub position: Point2<f64>,
    /// Distance from the path, along the normal \[px\].
    pub offset_px: f64,
    /// Step of grey levels across the edge, positive if it rises along the normal.
    pub contrast: f64,
    /// Standard deviation of the offset, from noise of 2 grey levels and the roughness of cut edges
    /// \[px\].
    pub sigma_px: f64,
}

/// A line through edges.
#[derive(Debug, Clone, PartialEq)]
pub struct LineFit {
    /// A point of the line, in the middle of its edges \[px\].
    pub point: Point2<f64>,
    /// Its direction \[rad\], from the first edge towards the last.
    pub angle_rad: f64,
    /// Covariance of the offset at the point along the normal \[px\] and the angle \[rad\].
    pub covariance: Matrix2<f64>,
    /// Fraction of the edges that are inliers, 0 to 1.
    pub share: f64,
    /// Whether each edge is an inlier.
    pub inliers: Vec<bool>,
    /// Root mean square of the inliers' residuals \[px\].
    pub rms_px: f64,
}

/// Localises an edge along a path.
///
/// Each stretch of the path gives the strongest edge within reach, or none. Rows or columns are
/// scanned, whichever cross the path more steeply. Parts of the path outside the image, or within
/// the kernel's reach of its border, give none.
///
/// # Arguments
///
/// - `path`: the corners of a polyline, 2 or more \[px\]; a part without length has no edges.
/// - `reach_px`: maximum distance of an edge from the path, 0.5 to 100 \[px\].
/// - `least_contrast`: minimum step of an edge \[grey levels\].
///
/// # Errors
///
/// [`Error::OutOfRange`] for another reach, [`Error::NotFinite`] for a path or contrast that is not
/// finite.
pub fn edges_along(
    image: &GrayView<'_>,
    path: &[Point2<f64>],
    reach_px: f64,
    polarity: EdgePolarity,
    least_contrast: f64,
) -> Result<Vec<EdgePoint>> {
    if !(0.5..=100.0).contains(&reach_px) {
        return Err(Error::OutOfRange { what: "reach_px", value: reach_px, right: "0.5 to 100" });
    }
    let numbers = path.iter().flat_map(|p| [p.x, p.y]).chain([least_contrast]);
    if let Some(value) = numbers.into_iter().find(|value| !value.is_finite()) {
        return Err(Error::NotFinite { what: "path [px] or least_contrast", value });
    }
    let length: f64 = path.windows(2).map(|ends| (ends[1] - ends[0]).norm()).sum();
    let stretch_px = (length / STRETCHES).clamp(1.0, LONGEST_STRETCH_PX);
    let mut edges = Vec::new();
    for ends in path.windows(2) {
        let scan = Scan::new(image, ends[0], ends[1], reach_px);
        scan.edges(stretch_px, polarity, least_contrast, &mut edges);
    }
    Ok(edges)
}

/// Rows or columns across a straight part of a path.
struct Scan<'a> {
    image: &'a GrayView<'a>,
    from: Point2<f64>,
    along: Vector2<f64>,
    length_px: f64,
    /// Whether columns are scanned: the path runs along rows.
    by_columns: bool,
    /// Reach along the scan \[px\].
    reach_px: f64,
}

impl<'a> Scan<'a> {
    fn new(image: &'a GrayView<'a>, from: Point2<f64>, to: Point2<f64>, reach_px: f64) -> Self {
        let length_px = (to - from).norm();
        let along = (to - from) / length_px.max(f64::MIN_POSITIVE);
        let by_columns = along.x.abs() >= along.y.abs();
        let steepness = if by_columns { along.x.abs() } else { along.y.abs() };
        let reach_px = reach_px / steepness.max(0.5);
        Self { image, from, along, length_px, by_columns, reach_px }
    }

    /// The path's coordinate that selects a scan, and its change per px along the path.
    fn axis(&self) -> (f64, f64) {
        if self.by_columns { (self.from.x, self.along.x) } else { (self.from.y, self.along.y) }
    }

    /// Appends the edge of every stretch.
    fn edges(
        &self,
        stretch_px: f64,
        polarity: EdgePolarity,
        least_contrast: f64,
        edges: &mut Vec<EdgePoint>,
    ) {
        if self.length_px < 1e-9 {
            return;
        }
        let count = (self.length_px / stretch_px).ceil().min(1e5);
        let mut stretch = Stretch::default();
        for k in 0..count as usize {
            let from_px = k as f64 * self.length_px / count;
            let to_px = (k + 1) as f64 * self.length_px / count;
            if let Some(middle_px) = self.gather(from_px, to_px, &mut stretch)
                && let Some(edge) = self.edge(&stretch, middle_px, polarity, least_contrast)
            {
                edges.push(edge);
            }
        }
    }

    /// Collects the pixels of a stretch; returns the mean position of its scans along the path, if
    /// there are any.
    fn gather(&self, from_px: f64, to_px: f64, stretch: &mut Stretch) -> Option<f64> {
        stretch.clear();
        let (begin, step) = self.axis();
        let (a, b) = (begin + step * from_px, begin + step * to_px);
        let (low, high) = if a < b { (a, b) } else { (b, a) };
        let last = if self.by_columns { self.image.width() } else { self.image.height() } as f64;
        let (first, end) = (low.ceil().max(0.0), high.min(last));
        let (mut scans, mut middle_px) = (0.0, 0.0);
        let mut at = first;
        // Half open: the scan on a border belongs to the next stretch.
        while at < end {
            let along_px = (at - begin) / step;
            if self.scan(at as usize, along_px, stretch) {
                scans += 1.0;
                middle_px += along_px;
            }
            at += 1.0;
        }
        (scans > 0.0).then(|| middle_px / scans)
    }

    /// Appends the pixels of one row or column; false if it ends within the kernel's reach.
    fn scan(&self, at: usize, along_px: f64, stretch: &mut Stretch) -> bool {
        let centre = self.from + self.along * along_px;
        let centre = if self.by_columns { centre.y } else { centre.x };
        let reach = self.reach_px + KERNEL_REACH * KERNEL_SIGMA_PX;
        let (low, high) = ((centre - reach).floor(), (centre + reach).ceil());
        let last = if self.by_columns { self.image.height() } else { self.image.width() } as f64;
        if low < 0.0 || high > last - 1.0 {
            return false;
        }
        stretch.starts.push(stretch.pixels.len());
        for other in low as usize..=high as usize {
            let (x, y) = if self.by_columns { (at, other) } else { (other, at) };
            let Some(level) = self.image.pixel(x, y) else { return false };
            stretch.pixels.push((other as f64 - centre, f64::from(level)));
        }
        true
    }

    /// The strongest edge of the pixels of a stretch.
    fn edge(
        &self,
        stretch: &Stretch,
        middle_px: f64,
        polarity: EdgePolarity,
        least_contrast: f64,
    ) -> Option<EdgePoint> {
        // Coordinates along the scan increase with the normal or against it.
        let steepness = if self.by_columns { self.along.x } else { -self.along.y };
        let sign = steepness.signum();
        let mean = stretch.mean();
        let steps = self.reach_px.floor() as i32;
        let top = (-steps..=steps)
            .zip(stretch.responses(mean, steps))
            .map(|(x, response)| (f64::from(x), polarity.strength(sign * response)))
            .max_by(|a, b| a.1.total_cmp(&b.1))?;
        let (x, contrast, sigma) = summit(&stretch.pixels, mean, top.0)?;
        let contrast = sign * contrast;
        if polarity.strength(contrast) < least_contrast || x.abs() > self.reach_px + 0.5 {
            return None;
        }
        let across = if self.by_columns { Vector2::new(0.0, x) } else { Vector2::new(x, 0.0) };
        Some(EdgePoint {
            position: self.from + self.along * middle_px + across,
            offset_px: x * steepness,
            contrast,
            sigma_px: (NOISE_LEVELS * sigma * steepness).hypot(ROUGHNESS_PX),
        })
    }
}

/// Fits the line with the largest consensus; `None` for fewer than five points, or without
/// consensus.
///
/// The covariance is estimated from the residuals. Correlated residuals of neighbours, as on a
/// rough or bent edge, reduce the effective number of edges.
///
/// # Arguments
///
/// - `sigmas_px`: the standard deviation of each point, > 0, up to one common factor.
///
/// # Errors
///
/// [`Error::OutOfRange`] for a standard deviation that is not positive, or another number of them;
/// [`Error::NotFinite`] for points that are not finite.
pub fn fit_line(points: &[Point2<f64>], sigmas_px: &[f64]) -> Result<Option<LineFit>> {
    if points.len() != sigmas_px.len() {
        let value = sigmas_px.len() as f64;
        return Err(Error::OutOfRange { what: "sigmas_px", value, right: "one of each point" });
    }
    if let Some(&value) = sigmas_px.iter().find(|&&sigma| !(sigma > 0.0 && sigma.is_finite())) {
        return Err(Error::OutOfRange { what: "sigma_px", value, right: "positive and finite" });
    }
    if let Some(value) = points.iter().flat_map(|p| [p.x, p.y]).find(|value| !value.is_finite()) {
        return Err(Error::NotFinite { what: "points [px]", value });
    }
    if points.len() < LEAST_POINTS {
        return Ok(None);
    }
    let agrees_px = agrees_px(sigmas_px);
    let Some((at, along)) = best_line(points, agrees_px) else { return Ok(None) };
    Ok(solve(points, sigmas_px, at, along, agrees_px))
}

/// The inlier threshold \[px\].
fn agrees_px(sigmas_px: &[f64]) -> f64 {
    let mut sigmas = sigmas_px.to_vec();
    sigmas.sort_unstable_by(f64::total_cmp);
    (AGREES_SIGMAS * sigmas[sigmas.len() / 2]).clamp(AGREES_PX, MOST_AGREES_PX)
}

/// The line through two of the points with the least truncated squared residual.
fn best_line(points: &[Point2<f64>], agrees_px: f64) -> Option<(Point2<f64>, Vector2<f64>)> {
    let stride = points.len().div_ceil(MOST_TRIED);
    let tried: Vec<_> = points.iter().step_by(stride).collect();
    let mut best = None;
    let mut least = f64::INFINITY;
    for (i, a) in tried.iter().enumerate() {
        for b in &tried[i + 1..] {
            let length = (*b - *a).norm();
            if length < 2.0 * agrees_px {
                continue;
            }
            let along = (*b - *a) / length;
            let misfit: f64 =
                points.iter().map(|p| (across(along, p - *a) / agrees_px).powi(2).min(1.0)).sum();
            if misfit < least {
                (least, best) = (misfit, Some((**a, along)));
            }
        }
    }
    best
}

/// Component of a vector along the normal of a direction, which is turned by +90° from it.
fn across(along: Vector2<f64>, v: Vector2<f64>) -> f64 {
    along.x * v.y - along.y * v.x
}

/// A point in the frame of the line: abscissa, distance, standard deviation and weight.
struct Entry {
    x: f64,
    y: f64,
    sigma: f64,
    weight: f64,
}

/// Refines a line with a large consensus by iterated least squares.
fn solve(
    points: &[Point2<f64>],
    sigmas_px: &[f64],
    at: Point2<f64>,
    along: Vector2<f64>,
    agrees_px: f64,
) -> Option<LineFit> {
    let mut entries: Vec<_> = points
        .iter()
        .zip(sigmas_px)
        .map(|(p, &sigma)| {
            let y = across(along, p - at);
            let weight = f64::from(u8::from(y.abs() < agrees_px));
            Entry { x: along.dot(&(p - at)), y, sigma, weight }
        })
        .collect();
    let (mut offset, mut slope, mut scale) = (0.0, 0.0, 1.0);
    for k in 0..MOST_ITERATIONS {
        let before = (offset, slope);
        (offset, slope) = weighted(&entries)?;
        scale = reweigh(&mut entries, offset, slope, agrees_px)?;
        if k > 0 && (offset - before.0).abs() < 1e-6 && (slope - before.1).abs() < 1e-9 {
            break;
        }
    }
    report(&entries, at, along, (offset, slope, scale))
}

/// The weighted least-squares line: its offset at x = 0 and its slope.
fn weighted(entries: &[Entry]) -> Option<(f64, f64)> {
    let (mut n, mut sx, mut sy, mut sxx, mut sxy) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for e in entries {
        let w = e.weight / (e.sigma * e.sigma);
        n += w;
        sx += w * e.x;
        sy += w * e.y;
        sxx += w * e.x * e.x;
        sxy += w * e.x * e.y;
    }
    let determinant = n * sxx - sx * sx;
    if determinant.is_nan() || determinant <= 1e-12 * n * sxx {
        return None;
    }
    let slope = (n * sxy - sx * sy) / determinant;
    Some(((sy - slope * sx) / n, slope))
}

/// Sets the biweights from the residuals; returns their scale.
fn reweigh(entries: &mut [Entry], offset: f64, slope: f64, agrees_px: f64) -> Option<f64> {
    let residual = |e: &Entry| e.y - offset - slope * e.x;
    let mut near: Vec<f64> = entries
        .iter()
        .filter(|e| residual(e).abs() < agrees_px)
        .map(|e| (residual(e) / e.sigma).abs())
        .collect();
    if near.len() < LEAST_POINTS {
        return None;
    }
    near.sort_unstable_by(f64::total_cmp);
    // Two degrees of freedom are spent on the line.
    let dof_factor = near.len() as f64 / (near.len() as f64 - 2.0);
    let scale = (1.4826 * near[near.len() / 2] * dof_factor.sqrt()).max(LEAST_SCALE);
    for e in entries.iter_mut() {
        let z = residual(e) / (e.sigma * scale * BIWEIGHT);
        e.weight = if z.abs() < 1.0 { (1.0 - z * z).powi(2) } else { 0.0 };
    }
    Some(scale)
}

/// The result for a converged line.
fn report(
    entries: &[Entry],
    at: Point2<f64>,
    along: Vector2<f64>,
    (offset, slope, scale): (f64, f64, f64),
) -> Option<LineFit> {
    let z: Vec<f64> =
        entries.iter().map(|e| (e.y - offset - slope * e.x) / (e.sigma * scale)).collect();
    let inliers: Vec<bool> = entries.iter().map(|e| e.weight > 0.0).collect();
    let count = inliers.iter().filter(|&&is| is).count() as f64;
    // ψ and its derivative, of the biweight.
    let psi: Vec<f64> = entries.iter().zip(&z).map(|(e, z)| z * e.weight).collect();
    let slopes: Vec<f64> = z.iter().map(|z| biweight_slope(z / BIWEIGHT)).collect();
    let by_z = slopes.iter().sum::<f64>() / count;
    let scatter = slopes.iter().zip(&inliers).filter(|(_, is)| **is);
    let scatter = scatter.map(|(slope, _)| (slope - by_z).powi(2)).sum::<f64>() / count;
    // Corrections for few points: Huber's factor for weights, and the variance of Student's
    // distribution.
    let small_sample_factor =
        (1.0 + 2.0 / count * scatter / by_z.powi(2)).powi(2) * (count - 2.0) / (count - 4.0);
    let (mut n, mut sx) = (0.0, 0.0);
    for e in entries.iter().filter(|e| e.weight > 0.0) {
        n += e.sigma.powi(-2);
        sx += e.x / e.sigma.powi(2);
    }
    let middle = sx / n;
    let spread: f64 =
        entries.iter().filter(|e| e.weight > 0.0).map(|e| ((e.x - middle) / e.sigma).powi(2)).sum();
    let squares = psi.iter().map(|psi| psi * psi).sum::<f64>() / (count - 2.0);
    let variance = scale * scale * squares / by_z.max(0.1).powi(2)
        * small_sample_factor
        * redundancy(&psi, &inliers);
    let angle = slope.atan();
    let cos = angle.cos();
    let residual_px = |k: usize| z[k] * entries[k].sigma * scale;
    let rms_px =
        ((0..z.len()).filter(|&k| inliers[k]).map(|k| residual_px(k).powi(2)).sum::<f64>() / count)
            .sqrt();
    let normal = Vector2::new(-along.y, along.x);
    (count > 4.0 && variance.is_finite() && spread > 0.0).then(|| LineFit {
        point: at + along * middle + normal * (offset + slope * middle),
        angle_rad: along.y.atan2(along.x) + angle,
        covariance: Matrix2::new(
            variance / n * cos * cos,
            0.0,
            0.0,
            variance / spread * cos.powi(4),
        ),
        share: count / entries.len() as f64,
        inliers,
        rms_px,
    })
}

/// The derivative of ψ(z) = z (1 − z²)², z in units of the biweight's constant.
fn biweight_slope(z: f64) -> f64 {
    let square = z * z;
    if square < 1.0 { (1.0 - square) * (1.0 - 5.0 * square) } else { 0.0 }
}

/// Variance factor of correlated edges: 1 + 2 Σ ρ over lags, up to the first insignificant
/// correlation.
fn redundancy(psi: &[f64], inliers: &[bool]) -> f64 {
    let values: Vec<f64> =
        psi.iter().zip(inliers).filter(|(_, is)| **is).map(|(v, _)| *v).collect();
    let count = values.len() as f64;
    let squares: f64 = values.iter().map(|v| v * v).sum();
    let mut factor = 1.0;
    for lag in 1..=MOST_LAGS.min(values.len() / 4) {
        let sum: f64 = values.iter().zip(&values[lag..]).map(|(a, b)| a * b).sum();
        let correlation = sum / squares.max(f64::MIN_POSITIVE);
        if correlation < 2.0 / count.sqrt() {
            break;
        }
        factor += 2.0 * correlation;
    }
    factor
}
