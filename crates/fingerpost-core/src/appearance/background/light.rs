//! Estimation of the change of light and of the camera's displacement since the background was
//! learned.

use super::options::Light;
use super::visit::CELL_PX;
use crate::appearance::background::{Background, EXACT_PX, Slope};
use crate::image::frame::Frame;
use nalgebra::Matrix2;
use nalgebra::Vector2;

/// Range of usable levels: beyond it they are clipped or lost in noise.
const DARKEST: f32 = 8.0;
const BRIGHTEST: f32 = 247.0;
/// Range of plausible gains.
const GAINS: std::ops::RangeInclusive<f64> = 0.1..=8.0;
/// Largest number of iterations of the light's fit; they stop after a change by less than this
/// \[grey levels\].
const LIGHT_FITS: usize = 4;
const LIGHT_SETTLED_GREY: f64 = 0.02;
/// Tukey's constant, times the ratio of standard deviation to median absolute deviation.
const TUKEY_MAD: f32 = 4.685 * 1.4826;
/// Consecutive frames of change after which the camera counts as moved: longer than a flash.
const MOVED_FRAMES: usize = 3;
/// Least change of the background over four pixels, around a pixel that shows a motion of the
/// camera \[grey levels\].
const INFORMATIVE_GREY: f32 = 12.0;
/// Least number of such pixels; with fewer, all pixels are used.
const MIN_INFORMATIVE: usize = 60;
/// Least gradient of the background at the pixels used to measure the displacement
/// \[grey levels / px\].
const STEEP_GREY_PX: f64 = 4.0;
/// Largest displacement that a residual may correspond to, apart from noise; larger residuals are
/// outliers \[px\].
const FARTHEST_SHIFT_PX: f64 = 1.0;
/// Largest number of iterations of the displacement's fit; they stop after a change by less than
/// this \[px\].
const SHIFT_FITS: usize = 3;
const SHIFT_SETTLED_PX: f64 = 1e-3;
/// Largest standard deviation of the displacement in a direction that counts as determined \[px\]:
/// along edges of one direction, as of boards and stripes, the fit is only noise.
const DETERMINED_PX: f64 = 0.04;
/// Consecutive frames of a displacement beyond [`EXACT_PX`] after which the background is learned
/// anew: the camera will not return.
const BUMPED_FRAMES: usize = 30;

impl Background {
    /// Fits gain and offset: first the median ratio, which tolerates outliers in half of the
    /// pixels, then least squares with Tukey's weights.
    pub(super) fn estimate_light(&mut self, frame: &Frame<'_>) {
        let Some(size) = self.size else { return };
        self.pairs.clear();
        for (x, y) in Self::grid(size) {
            let i = y * size.0 + x;
            let Some(now) = frame.image().pixel(x, y).map(f32::from) else { continue };
            let level = self.grey.level[i];
            let usable = |g: f32| (DARKEST..BRIGHTEST).contains(&g);
            if self.grey.seen[i] > 0 && usable(now) && usable(level) {
                self.pairs.push((level, now));
            }
        }
        if self.pairs.len() < MIN_INFORMATIVE {
            return;
        }
        self.ratios.clear();
        self.ratios.extend(self.pairs.iter().map(|(level, now)| now / level));
        let mut light = Light { gain: f64::from(median(&mut self.ratios)), offset_grey: 0.0 };
        let mut sigma = 0.0;
        for _ in 0..LIGHT_FITS {
            let residual = |(level, now): (f32, f32)| {
                now - light.gain as f32 * level - light.offset_grey as f32
            };
            self.ratios.clear();
            self.ratios.extend(self.pairs.iter().map(|&pair| residual(pair).abs()));
            let mad = median(&mut self.ratios);
            let scale = (TUKEY_MAD * mad).max(TUKEY_MAD * 0.5 * self.options.noise_grey as f32);
            sigma = 1.4826 * mad;
            let Some(next) = fit_light(&self.pairs, scale, residual) else { break };
            let moved = 255.0 * (next.gain - light.gain).abs()
                + (next.offset_grey - light.offset_grey).abs();
            light = next;
            if moved < LIGHT_SETTLED_GREY {
                break;
            }
        }
        if GAINS.contains(&light.gain) {
            self.light = light;
            // A residual beyond the noise of a pixel is light that varies over the image, or a
            // motion of the camera, which the limit keeps visible.
            let noise = (self.options.noise_grey * light.gain.max(1.0)) as f32;
            self.light_sigma = (sigma - noise).clamp(0.0, noise);
        }
    }

    /// Measures the part of changed pixels on the grid, and starts anew when the camera has moved.
    pub(super) fn notice_motion(&mut self, frame: &Frame<'_>) {
        let Some(size) = self.size else { return };
        if self.frames == 0 {
            return;
        }
        let reach = CELL_PX;
        let (mut informative, mut changed_informative, mut all, mut changed) =
            (0_usize, 0_usize, 0_usize, 0_usize);
        for (x, y) in Self::grid(size) {
            let i = y * size.0 + x;
            let Some(change) = self.change(frame, x, y, size.0) else { continue };
            let has_changed = usize::from(change.sigmas > self.options.changed_sigmas as f32);
            all += 1;
            changed += has_changed;
            let inside = x >= reach && y >= reach && x + reach < size.0 && y + reach < size.1;
            let level = |j: usize| self.grey.level[j];
            if inside
                && (level(i + reach) - level(i - reach))
                    .abs()
                    .max((level(i + reach * size.0) - level(i - reach * size.0)).abs())
                    > INFORMATIVE_GREY
            {
                informative += 1;
                changed_informative += has_changed;
            }
        }
        let share = |part: usize, whole: usize| part as f64 / whole.max(1) as f64;
        self.changed_share = if informative >= MIN_INFORMATIVE {
            share(changed_informative, informative)
        } else {
            share(changed, all)
        };
        if self.changed_share <= self.options.void_share {
            self.moved_frames = 0;
            return;
        }
        self.moved_frames += 1;
        if self.moved_frames >= MOVED_FRAMES {
            let (share, coloured) = (self.changed_share, !self.colour.is_empty());
            self.start(size, coloured);
            self.changed_share = share;
        }
    }

    /// Starts anew after a lasting displacement of the camera.
    pub(super) fn notice_bump(&mut self) {
        let bumped = self.shift_px.is_some_and(|shift| shift.norm() > EXACT_PX);
        self.bumped_frames = if bumped { self.bumped_frames + 1 } else { 0 };
        if let Some(size) = self.size
            && self.bumped_frames >= BUMPED_FRAMES
        {
            let (share, coloured) = (self.changed_share, !self.colour.is_empty());
            self.start(size, coloured);
            self.changed_share = share;
        }
    }

    /// Fits the displacement that best explains the frame at the background's edges, now = gain · B
    /// + offset − ∇(gain · B) · shift, with Tukey's weights.
    pub(super) fn measure_shift(&mut self, frame: &Frame<'_>) {
        self.shift_px = None;
        let Some((width, height)) = self.size else { return };
        if self.frames == 0 {
            return;
        }
        self.slopes.clear();
        let changed = self.options.changed_sigmas * self.options.noise_grey;
        for (x, y) in Self::grid((width, height)) {
            let Some(now) = frame.image().pixel(x, y) else { continue };
            let Some([[_, above, _], [left, centre, right], [_, below, _]]) = self.about(x, y)
            else {
                continue;
            };
            let by_px = Vector2::new(f64::from(right - left), f64::from(below - above)) / 2.0;
            if by_px.norm_squared() > STEEP_GREY_PX * STEEP_GREY_PX {
                let residual = f64::from(now) - f64::from(centre);
                let per_most = 1.0 / (changed + by_px.norm() * FARTHEST_SHIFT_PX);
                self.slopes.push(Slope { by_px, residual, per_most });
            }
        }
        if self.slopes.len() < MIN_INFORMATIVE {
            return;
        }
        let least = (self.options.noise_grey / DETERMINED_PX).powi(2);
        let mut shift = Vector2::<f64>::zeros();
        for _ in 0..SHIFT_FITS {
            let (mut information, mut right) = (Matrix2::zeros(), Vector2::zeros());
            for Slope { by_px, residual, per_most } in &self.slopes {
                let r = (residual + by_px.dot(&shift)) * per_most;
                let weight = (1.0 - (r * r).min(1.0)).powi(2);
                information += by_px * by_px.transpose() * weight;
                right -= by_px * (residual * weight);
            }
            let Some(inverse) = inverse_where_determined(&information, least) else { return };
            let last_shift = shift;
            shift = inverse * right;
            if (shift - last_shift).norm() < SHIFT_SETTLED_PX {
                break;
            }
        }
        self.shift_px = Some(shift);
    }
}

/// Least squares with Tukey's weights about the last residuals. The offset is estimated only where
/// the levels vary enough to separate it from the gain. `None` if less than a tenth of the weight
/// is left.
fn fit_light(
    pairs: &[(f32, f32)],
    scale: f32,
    residual: impl Fn((f32, f32)) -> f32,
) -> Option<Light> {
    let (mut w0, mut wb, mut wi, mut wbb, mut wbi) = (0.0_f64, 0.0, 0.0, 0.0, 0.0);
    for &(level, now) in pairs {
        let r = residual((level, now)) / scale;
        if r.abs() < 1.0 {
            let w = f64::from((1.0 - r * r) * (1.0 - r * r));
            let (b, i) = (f64::from(level), f64::from(now));
            w0 += w;
            wb += w * b;
            wi += w * i;
            wbb += w * b * b;
            wbi += w * b * i;
        }
    }
    if w0 < 0.1 * pairs.len() as f64 {
        return None;
    }
    let spread = wbb - wb * wb / w0;
    if spread / w0 > LEVELS_SPREAD * LEVELS_SPREAD {
        let gain = (wbi - wb * wi / w0) / spread;
        return Some(Light { gain, offset_grey: (wi - gain * wb) / w0 });
    }
    Some(Light { gain: wbi / wbb, offset_grey: 0.0 })
}

/// Least standard deviation of the levels at which gain and offset are separable \[grey levels\].
const LEVELS_SPREAD: f64 = 20.0;

/// Inverse of an information matrix in the directions in which its eigenvalue exceeds `least`, and
/// 0 in the others; `None` without such a direction.
fn inverse_where_determined(information: &Matrix2<f64>, least: f64) -> Option<Matrix2<f64>> {
    let eigen = information.symmetric_eigen();
    let is_determined = |k: usize| eigen.eigenvalues[k] > least.max(f64::MIN_POSITIVE);
    match (is_determined(0), is_determined(1)) {
        (false, false) => None,
        (true, true) => information.try_inverse(),
        (first, _) => {
            let k = usize::from(!first);
            let direction = eigen.eigenvectors.column(k).into_owned();
            Some(direction * direction.transpose() / eigen.eigenvalues[k])
        }
    }
}

/// The median of values, which are reordered; 0 for none.
fn median(values: &mut [f32]) -> f32 {
    let middle = values.len() / 2;
    if values.is_empty() {
        return 0.0;
    }
    *values.select_nth_unstable_by(middle, f32::total_cmp).1
}
