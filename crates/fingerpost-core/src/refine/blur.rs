//! Powers of depth below a straight edge, as a Gaussian blur leaves them.
//!
//! With Z standard normal and z the depth below the edge in standard deviations of the blur,
//!
//! ```text
//! M₀(z) = E[(z + Z)₊⁰] = Φ(z)                the share of what lies inside
//! M½(z) = E[(z + Z)₊^½]                       a round limb: brightness rises as the root of depth
//! M₁(z) = E[(z + Z)₊]  = z Φ(z) + φ(z)        a flat slope: brightness rises with depth
//! ```
//!
//! M₀ and M½ come from a table of cubic pieces, each with the exact value and slope at both ends.
//! The slope returned is the piece's own, so value and derivative agree to rounding.

#![expect(
    clippy::inline_always,
    reason = "what is inlined into a function with wider instructions is compiled for them"
)]

use std::f64::consts::PI;
use std::sync::LazyLock;

/// The table covers −`REACH` ≤ z ≤ `DEPTH`: before it everything is zero to 1e-9; behind it the
/// functions are their asymptotes to 1e-6.
const REACH: f32 = 6.0;
const DEPTH: f32 = 14.0;
/// Pieces per unit of z; the error of a piece is h⁴ / 384 times the fourth derivative, 6e-8.
const PIECES: f32 = 16.0;

static TABLE: LazyLock<Vec<Piece>> = LazyLock::new(|| {
    let knots = ((REACH + DEPTH) * PIECES) as usize;
    let at = |k: usize| Exact::at(k as f64 / f64::from(PIECES) - f64::from(REACH));
    let mut left = at(0);
    let pieces = (1..=knots).map(|k| {
        let right = at(k);
        let piece = Piece::between(&left, &right);
        left = right;
        piece
    });
    pieces.collect()
});

/// M₀ and M½ and their derivatives at one depth.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Moments {
    pub step: f32,
    pub step_slope: f32,
    pub root: f32,
    pub root_slope: f32,
}

/// The table, looked up once and then free of synchronisation.
#[derive(Debug, Clone, Copy)]
pub(super) struct BlurTable {
    pieces: &'static [Piece],
}

impl BlurTable {
    pub fn new() -> Self {
        Self { pieces: &TABLE }
    }

    /// M₀ and M½ at depth `z` \[standard deviations of the blur\].
    #[inline(always)]
    pub fn moments(self, z: f32) -> Moments {
        let x = (z + REACH) * PIECES;
        // Through i32, which a float becomes in one instruction; NaN becomes piece 0.
        let k = x as i32;
        match self.pieces.get(k as usize) {
            Some(piece) if x >= 0.0 => piece.at(x - k as f32),
            _ if z > 0.0 => {
                let (root, tail) = (z.sqrt(), 0.125 / (z * z));
                Moments {
                    step: 1.0,
                    step_slope: 0.0,
                    root: root * (1.0 - tail),
                    root_slope: (0.5 + 1.5 * tail) / root,
                }
            }
            _ => Moments { step: 0.0, step_slope: 0.0, root: 0.0, root_slope: 0.0 },
        }
    }
}

/// Two cubics in the fraction of the piece, lowest power first.
#[derive(Debug, Clone, Copy)]
struct Piece {
    step: [f32; 4],
    root: [f32; 4],
}

impl Piece {
    /// The Hermite cubics between two knots 1 / [`PIECES`] apart.
    fn between(left: &Exact, right: &Exact) -> Self {
        let hermite = |from: [f64; 2], to: [f64; 2]| {
            let pieces = f64::from(PIECES);
            let (rise, m0, m1) = (to[0] - from[0], from[1] / pieces, to[1] / pieces);
            [from[0], m0, 3.0 * rise - 2.0 * m0 - m1, m0 + m1 - 2.0 * rise].map(|c| c as f32)
        };
        Self { step: hermite(left.step, right.step), root: hermite(left.root, right.root) }
    }

    #[inline(always)]
    fn at(&self, t: f32) -> Moments {
        let value = |c: &[f32; 4]| c[0] + t * (c[1] + t * (c[2] + t * c[3]));
        let slope = |c: &[f32; 4]| (c[1] + t * (2.0 * c[2] + t * (3.0 * c[3]))) * PIECES;
        Moments {
            step: value(&self.step),
            step_slope: slope(&self.step),
            root: value(&self.root),
            root_slope: slope(&self.root),
        }
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
