//! Detection of changes of light: a lamp, a cloud, a camera's exposure control.
//!
//! The colours of a hand are learned in one light. A slow adaptation follows a slow change only
//! while the contour is visible on both sides. If the light drops faster, skin resembles the wood
//! of before, its edges are rejected, and nothing is learned that could correct this. Therefore the
//! change of light is estimated from the whole image: the median ratio of its pixels' brightness to
//! that of before, which tolerates outliers in half of them.

use crate::image::gray::GrayView;

/// Columns and rows of the grid of compared pixels.
const GRID: [usize; 2] = [24, 18];
/// Least ratio, or inverse ratio, of brightness that counts as a change of light. Colours differ by
/// more, and neither noise nor a moving camera changes the median by this factor.
const BRIGHTER: f32 = 1.0618;
/// Range of usable levels: beyond it they are clipped, or mostly noise.
const LEVELS: std::ops::RangeInclusive<u8> = 12..=243;
/// Least part of the grid's pixels with usable levels.
const ENOUGH: f64 = 0.25;

/// The image brightness of the reference frame: the first one, and after a change of light the
/// frame in which it was noticed. Learning does not replace it: colours that were learned while the
/// light drifted within the limit are adapted by the ratio to the reference as well.
#[derive(Debug, Clone)]
pub(super) struct Exposure {
    size: (usize, usize),
    grid: Vec<u8>,
    now: Vec<u8>,
    ratios: Vec<f64>,
}

impl Exposure {
    pub fn new() -> Self {
        let pixels = GRID[0] * GRID[1];
        Self {
            size: (0, 0),
            grid: Vec::with_capacity(pixels),
            now: Vec::with_capacity(pixels),
            ratios: Vec::with_capacity(pixels),
        }
    }

    /// Ratio of a frame's brightness to that of the last reference, if it counts as a change of
    /// light; the frame then becomes the reference.
    pub fn changed(&mut self, image: &GrayView<'_>) -> Option<f64> {
        let size = (image.width(), image.height());
        let [columns, rows] = GRID;
        self.now.clear();
        for row in 0..rows {
            let y = (2 * row + 1) * size.1 / (2 * rows);
            let pixels = image.row(y).unwrap_or_default();
            let place = |column: usize| (2 * column + 1) * size.0 / (2 * columns);
            let levels = (0..columns).map(|column| pixels.get(place(column)).copied().unwrap_or(0));
            self.now.extend(levels);
        }
        if self.grid.is_empty() || self.size != size {
            self.size = size;
            std::mem::swap(&mut self.grid, &mut self.now);
            return None;
        }
        let usable_pairs = || {
            let pairs = self.grid.iter().zip(&self.now);
            pairs.filter(|&(then, now)| LEVELS.contains(then) && LEVELS.contains(now))
        };
        // Counting decides whether the median shows a change; only then it is computed.
        let (mut count, mut brighter, mut darker) = (0, 0, 0);
        for (&then, &now) in self.grid.iter().zip(&self.now) {
            let is_usable = LEVELS.contains(&then) & LEVELS.contains(&now);
            let (then, now) = (f32::from(then), f32::from(now));
            count += u32::from(is_usable);
            brighter += u32::from(is_usable) * u32::from(now >= BRIGHTER * then);
            darker += u32::from(is_usable) * u32::from(now <= then / BRIGHTER);
        }
        // For an even number, the upper of the two middle values.
        let is_changed = 2 * brighter >= count || 2 * darker > count;
        if !is_changed || f64::from(count) < ENOUGH * (columns * rows) as f64 {
            return None;
        }
        self.ratios.clear();
        self.ratios.extend(usable_pairs().map(|(&then, &now)| f64::from(now) / f64::from(then)));
        let middle = self.ratios.len() / 2;
        let (_, &mut gain, _) = self.ratios.select_nth_unstable_by(middle, f64::total_cmp);
        std::mem::swap(&mut self.grid, &mut self.now);
        Some(gain)
    }
}

#[cfg(test)]
#[expect(clippy::unwrap_used, reason = "a test may panic")]
mod tests {
    use super::*;

    const SIZE: (usize, usize) = (120, 90);

    fn texture(i: usize) -> f64 {
        60.0 + ((i * 7919) % 101) as f64
    }

    fn changed(exposure: &mut Exposure, level: impl Fn(usize) -> f64) -> Option<f64> {
        let pixels: Vec<u8> = (0..SIZE.0 * SIZE.1).map(|i| level(i).round() as u8).collect();
        exposure.changed(&GrayView::new(&pixels, SIZE.0, SIZE.1, SIZE.0).unwrap())
    }

    #[test]
    fn a_change_of_light_is_reported_once_it_matters() {
        let mut exposure = Exposure::new();
        assert_eq!(changed(&mut exposure, texture), None);
        assert_eq!(changed(&mut exposure, |i| 0.97 * texture(i)), None);
        let gain = changed(&mut exposure, |i| 0.7 * texture(i)).unwrap();
        assert!((gain - 0.7).abs() < 0.01, "{gain}");
        assert_eq!(changed(&mut exposure, |i| 0.71 * texture(i)), None);
        // A slow change adds up.
        let gains: Vec<f64> = (1..=20)
            .filter_map(|k| changed(&mut exposure, |i| (0.7 + 0.02 * f64::from(k)) * texture(i)))
            .collect();
        let product: f64 = gains.iter().product();
        assert!(gains.len() >= 4 && (product - 1.1 / 0.7).abs() < 0.1, "{gains:?}");
    }

    #[test]
    fn an_occluder_of_less_than_half_the_image_is_no_change_of_light() {
        let mut exposure = Exposure::new();
        changed(&mut exposure, texture);
        let covered = |i: usize| if i % SIZE.0 < SIZE.0 * 2 / 5 { 30.0 } else { texture(i) };
        assert_eq!(changed(&mut exposure, covered), None);
    }

    #[test]
    fn a_black_frame_gives_no_exposure() {
        let mut exposure = Exposure::new();
        changed(&mut exposure, texture);
        assert_eq!(changed(&mut exposure, |_| 0.0), None);
    }
}
