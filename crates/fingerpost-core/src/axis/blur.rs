//! Moments of the depth below a straight edge under a Gaussian blur.
//!
//! With Z standard normal and z the depth below the edge in standard deviations of the blur,
//!
//! ```text
//! M₀(z) = E[(z + Z)₊⁰] = Φ(z)                the fraction inside
//! M½(z) = E[(z + Z)₊^½]                       a round limb: brightness rises as the root of depth
//! M₁(z) = E[(z + Z)₊]  = z Φ(z) + φ(z)        a flat slope: brightness rises with depth
//! ```
//!
//! The table has M₀ and M½ and their slopes at knots. Both solve differential equations, M₀″ = −z
//! M₀′ and M½″ = ½ M½ − z M½′, so value and slope at the nearest knot determine the Taylor series
//! about it. The series ends at the cubic term. The returned slope is the derivative of the series,
//! so value and slope agree to rounding.

#![expect(
    clippy::inline_always,
    reason = "what is inlined into a function with wider instructions is compiled for them"
)]
#![expect(
    clippy::needless_range_loop,
    reason = "lane by lane through many arrays at once is what the compiler turns into vectors"
)]

use super::pixels::{LANES, PixelLanes};
use std::f64::consts::PI;
use std::sync::LazyLock;

/// Range of the table, −`REACH` ≤ z ≤ `DEPTH`: below it all moments are zero to 1e-9, above it the
/// functions equal their asymptotes to 1e-6.
const REACH: f32 = 6.0;
const DEPTH: f32 = 14.0;
/// Knots per unit of z. The error of the value is h⁴ / 384 times the fourth derivative, 4e-9; that
/// of the slope is h³ / 48 times it, 9e-7.
const KNOTS: f32 = 32.0;
/// Size of the table, a power of two so that no index needs a check. There is one knot more than
/// intervals between −`REACH` and `DEPTH`; the last one is repeated.
const SIZE: usize = 1024;
/// Added to a number below 2²², this leaves its nearest integer in the lowest bits.
const ROUNDING: f32 = 8_388_608.0;

static TABLE: LazyLock<Box<[Knot; SIZE]>> = LazyLock::new(|| {
    let mut knots = Box::new([Knot::default(); SIZE]);
    let last = ((REACH + DEPTH) * KNOTS) as usize;
    for (k, knot) in knots.iter_mut().enumerate() {
        let z = k.min(last) as f64 / f64::from(KNOTS) - f64::from(REACH);
        *knot = Exact::at(z).knot();
    }
    knots
});

/// M₀, M₀′, M½ and M½′ at one knot.
type Knot = [f32; 4];

/// M₀ and M½ and their derivatives at the depth of every lane.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Moments {
    pub step: PixelLanes,
    pub step_slope: PixelLanes,
    pub root: PixelLanes,
    pub root_slope: PixelLanes,
}

/// The table; the reference is taken once, so that its use needs no synchronisation.
#[derive(Debug, Clone, Copy)]
pub(super) struct BlurTable {
    knots: &'static [Knot; SIZE],
}

impl BlurTable {
    pub fn new() -> Self {
        Self { knots: &TABLE }
    }

    /// M₀ and M½ at depths `z` \[standard deviations of the blur\].
    #[inline(always)]
    pub fn moments(self, z: &PixelLanes) -> Moments {
        let none = [0.0; LANES];
        let (mut index, mut at_knot, mut from_knot) = ([0_u32; LANES], none, none);
        for i in 0..LANES {
            // NaN becomes the first knot.
            let inside = if z[i] > -REACH { z[i] } else { -REACH };
            let inside = if inside < DEPTH { inside } else { DEPTH };
            let rounded = (inside + REACH) * KNOTS + ROUNDING;
            index[i] = rounded.to_bits();
            at_knot[i] = (rounded - ROUNDING) * (1.0 / KNOTS) - REACH;
            from_knot[i] = inside - at_knot[i];
        }
        let mut m = Moments { step: none, step_slope: none, root: none, root_slope: none };
        for i in 0..LANES {
            let knot = self.knots[index[i] as usize % SIZE];
            [m.step[i], m.step_slope[i], m.root[i], m.root_slope[i]] = knot;
        }
        for i in 0..LANES {
            let (z, t) = (at_knot[i], from_knot[i]);
            let (density, curve) = (m.step_slope[i], z * z - 1.0);
            m.step[i] += density * t * (1.0 + t * (curve * t * (1.0 / 6.0) - 0.5 * z));
            m.step_slope[i] = density * (1.0 + t * (0.5 * curve * t - z));
            let (root, slope) = (m.root[i], m.root_slope[i]);
            let second = 0.5 * root - z * slope;
            let third = -0.5 * slope - z * second;
            m.root[i] = root + t * (slope + t * (0.5 * second + t * (1.0 / 6.0) * third));
            m.root_slope[i] = slope + t * (second + 0.5 * t * third);
        }
        // Without a shortcut, which would prevent vectorisation.
        let mut any_deep = false;
        for z in z {
            any_deep |= *z > DEPTH;
        }
        if any_deep {
            for i in 0..LANES {
                let (root, tail) = (z[i].sqrt(), 0.125 / (z[i] * z[i]));
                let deep = z[i] > DEPTH;
                m.root[i] = if deep { root * (1.0 - tail) } else { m.root[i] };
                m.root_slope[i] = if deep { (0.5 + 1.5 * tail) / root } else { m.root_slope[i] };
            }
        }
        m
    }
}

/// Value and slope of M₀ and M½, to rounding.
struct Exact {
    step: [f64; 2],
    root: [f64; 2],
}

impl Exact {
    fn at(z: f64) -> Self {
        Self { step: [normal_cdf(z), normal_pdf(z)], root: root_moment(z) }
    }

    fn knot(&self) -> Knot {
        let ([step, density], [root, slope]) = (self.step, self.root);
        [step, density, root, slope].map(|m| m as f32)
    }
}

fn normal_pdf(z: f64) -> f64 {
    (-0.5 * z * z).exp() / (2.0 * PI).sqrt()
}

/// Φ(z) = ½ + φ(z) (z + z³/3 + z⁵/(3·5) + …), all terms of one sign.
fn normal_cdf(z: f64) -> f64 {
    let (mut term, mut sum, mut odd) = (z, z, 1.0);
    while term.abs() > 1e-17 * sum.abs() {
        odd += 2.0;
        term *= z * z / odd;
        sum += term;
    }
    0.5 + normal_pdf(z) * sum
}

/// M½(z) = ∫ √x φ(x − z) dx over x > 0, and its derivative ∫ φ(x − z) / (2√x) dx. With x = v² both
/// integrands are smooth, and the trapezium rule converges faster than any power of the step.
fn root_moment(z: f64) -> [f64; 2] {
    const STEP: f64 = 1.0 / 128.0;
    let end = (z + 10.0).max(1.0).sqrt();
    let (mut value, mut slope) = (0.0, 0.5 * normal_pdf(z));
    for k in 1..=(end / STEP) as usize {
        let x = (k as f64 * STEP).powi(2);
        let density = normal_pdf(x - z);
        value += 2.0 * x * density;
        slope += density;
    }
    [value * STEP, slope * STEP]
}

// The table is private; the tests compare it with the integrals it is computed from.
#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_series_between_knots_agrees_with_the_integrals() {
        let table = BlurTable::new();
        for k in 0..500 {
            // From below the table to above it, at varying fractions of a step.
            let z: PixelLanes =
                std::array::from_fn(|i| -6.5 + 0.0431 * k as f32 + 0.0057 * i as f32);
            let found = table.moments(&z);
            for i in 0..LANES {
                let Exact { step, root } = Exact::at(f64::from(z[i]));
                let pairs = [
                    (found.step[i], step[0], 2e-7),
                    (found.step_slope[i], step[1], 2e-6),
                    (found.root[i], root[0], 2e-5),
                    (found.root_slope[i], root[1], 1e-5),
                ];
                for (found, exact, within) in pairs {
                    assert!(
                        (f64::from(found) - exact).abs() < within,
                        "{found} {exact} at {}",
                        z[i]
                    );
                }
            }
        }
    }

    #[test]
    fn a_nan_depth_counts_as_outside() {
        let found = BlurTable::new().moments(&[f32::NAN; LANES]);
        assert!(found.step.iter().chain(&found.root).all(|m| m.abs() < 1e-8));
    }
}
