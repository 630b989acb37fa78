//! The pixels of a short stretch of an edge, and the edge in them: the maximum of |R|, where
//! `R(x) = Σ I(s) K(s − x)` correlates them with the derivative of a Gaussian at x.

/// σ of the derivative of a Gaussian \[px\]: about the blur of a camera's edge, which is optimal,
/// and wide enough to be sampled by pixels (aliasing is below 10⁻¹²).
pub(super) const KERNEL_SIGMA_PX: f64 = 1.2;

/// Reach of the kernel, in σ: it has fallen to 10⁻⁴ of its peak.
pub(super) const KERNEL_REACH: f64 = 4.5;

/// Newton steps to the maximum of |R|; it converges within two from the nearest whole pixel.
const NEWTON_STEPS: usize = 4;

/// Whole pixels that the kernel reaches to either side.
const KERNEL_REACH_PX: i32 = 6;

/// The pixels of one stretch.
#[derive(Default)]
pub(super) struct Stretch {
    /// Distance from the path along the scan, and grey level.
    pub pixels: Vec<(f64, f64)>,
    /// First pixel of each row or column.
    pub starts: Vec<usize>,
}

impl Stretch {
    pub fn clear(&mut self) {
        self.pixels.clear();
        self.starts.clear();
    }

    /// Its rows or columns.
    fn scans(&self) -> impl Iterator<Item = &[(f64, f64)]> {
        let ends = self.starts.iter().skip(1).copied().chain([self.pixels.len()]);
        self.starts.iter().zip(ends).filter_map(|(&start, end)| self.pixels.get(start..end))
    }

    pub fn mean(&self) -> f64 {
        self.pixels.iter().map(|(_, level)| level).sum::<f64>() / self.pixels.len() as f64
    }

    /// R at the whole numbers from −`steps` to `steps`, normalised as [`response`].
    ///
    /// The pixels of a scan lie at whole distances from each other, so that the kernel has the same
    /// values at all these places.
    pub fn responses(&self, mean: f64, steps: i32) -> Vec<f64> {
        let mut sums = vec![(0.0, 0.0); 2 * steps.unsigned_abs() as usize + 1];
        for scan in self.scans() {
            let Some(&(start, _)) = scan.first() else { continue };
            let part = start - start.floor();
            for tap in -KERNEL_REACH_PX..KERNEL_REACH_PX {
                let z = (part + f64::from(tap)) / KERNEL_SIGMA_PX;
                if z.abs() >= KERNEL_REACH {
                    continue;
                }
                let gauss = (-0.5 * z * z).exp();
                let (value, height) = (z * gauss, 0.5 * z.abs() * gauss);
                let first = tap - steps - start.floor() as i32;
                for (k, (sum, scale)) in sums.iter_mut().enumerate() {
                    let at = usize::try_from(first + k as i32).ok();
                    if let Some((_, level)) = at.and_then(|at| scan.get(at)) {
                        *sum += (level - mean) * value;
                        *scale += height;
                    }
                }
            }
        }
        sums.iter().map(|&(sum, scale)| if scale > 0.0 { sum / scale } else { 0.0 }).collect()
    }
}

/// R at x, normalised to the step of grey levels there.
fn response(pixels: &[(f64, f64)], mean: f64, x: f64) -> f64 {
    let (mut sum, mut scale) = (0.0, 0.0);
    for (s, level) in pixels {
        let z = (s - x) / KERNEL_SIGMA_PX;
        if z.abs() < KERNEL_REACH {
            let gauss = (-0.5 * z * z).exp();
            sum += (level - mean) * z * gauss;
            scale += 0.5 * z.abs() * gauss;
        }
    }
    if scale > 0.0 { sum / scale } else { 0.0 }
}

/// The maximum of |R| near x: position, height, and standard deviation for noise of 1 grey level.
pub(super) fn summit(pixels: &[(f64, f64)], mean: f64, from: f64) -> Option<(f64, f64, f64)> {
    let mut x = from;
    let mut sigma = 0.0;
    for _ in 0..NEWTON_STEPS {
        let (mut slope, mut curvature, mut squares) = (0.0, 0.0, 0.0);
        for (s, level) in pixels {
            let z = (s - x) / KERNEL_SIGMA_PX;
            if z.abs() < KERNEL_REACH {
                let gauss = (-0.5 * z * z).exp();
                let by_x = (z * z - 1.0) * gauss;
                slope += (level - mean) * by_x;
                curvature += (level - mean) * z * (z * z - 3.0) * gauss;
                squares += by_x * by_x;
            }
        }
        let step = -KERNEL_SIGMA_PX * slope / curvature;
        if !step.is_finite() || (x + step - from).abs() > 1.0 {
            return None;
        }
        x += step;
        sigma = KERNEL_SIGMA_PX * squares.sqrt() / curvature.abs();
    }
    Some((x, response(pixels, mean, x), sigma))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    pub fn responses_at_whole_numbers_are_those_of_the_kernel() {
        let mut stretch = Stretch::default();
        for (row, start) in [-14.3, -13.0, -12.9].into_iter().enumerate() {
            stretch.starts.push(stretch.pixels.len());
            let level = |i: usize| ((i * i + 7 * row) % 83) as f64;
            stretch.pixels.extend((0..28).map(|i| (start + i as f64, level(i))));
        }
        let mean = stretch.mean();
        for (x, value) in (-7..=7).zip(stretch.responses(mean, 7)) {
            let expected = response(&stretch.pixels, mean, f64::from(x));
            assert!((value - expected).abs() < 1e-9 * (1.0 + expected.abs()));
        }
    }
}
