//! Rendered edges and hands with exact ground truth.
//!
//! A shape is painted by the area that it covers of each pixel. The image is then blurred by a
//! Gaussian, gets white noise and is rounded to 8 bits, as by a camera. A straight edge is rendered
//! at its exact position at any angle; an edge of radius r, to within 1/(24 r) px.

use fingerpost_core::geometry::template::{HALF_LENGTH, Proportions, Thumb};
use fingerpost_core::image::gray::GrayView;
use fingerpost_core::nalgebra::{Point2, Vector2};

/// White Gaussian noise: SplitMix64 with the Box–Muller transform.
#[derive(Debug, Clone)]
pub struct Noise {
    state: u64,
}

impl Noise {
    pub fn new(seed: u64) -> Self {
        Self { state: seed }
    }

    pub fn bits(&mut self) -> u64 {
        self.state = self.state.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.state ^ (self.state >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// Uniform in [0, 1).
    pub fn uniform(&mut self) -> f64 {
        (self.bits() >> 11) as f64 / (1_u64 << 53) as f64
    }

    /// Uniform in [low, high).
    pub fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.uniform()
    }

    /// Standard normal.
    pub fn normal(&mut self) -> f64 {
        let radius = (-2.0 * (1.0 - self.uniform()).ln()).sqrt();
        radius * (std::f64::consts::TAU * self.uniform()).cos()
    }
}

/// A region of the image plane whose boundary is nearly straight on the scale of a pixel.
pub trait Shape {
    /// Depth of a point inside the region, negative outside \[px\], and the outward unit normal.
    /// Near the boundary its magnitude is the distance to it; elsewhere it is at most that.
    fn depth(&self, at: Point2<f64>) -> (f64, Vector2<f64>);
}

/// The inner side of a straight line.
#[derive(Debug, Clone, Copy)]
pub struct HalfPlane {
    pub through: Point2<f64>,
    pub outward: Vector2<f64>,
}

impl HalfPlane {
    /// A half-plane with its edge `offset_px` outward from `at`, along the normal at `angle_rad`.
    pub fn beyond(at: Point2<f64>, angle_rad: f64, offset_px: f64) -> Self {
        let outward = Vector2::new(angle_rad.cos(), angle_rad.sin());
        Self { through: at + outward * offset_px, outward }
    }
}

impl Shape for HalfPlane {
    fn depth(&self, at: Point2<f64>) -> (f64, Vector2<f64>) {
        ((self.through - at).dot(&self.outward), self.outward)
    }
}

/// A band with a round end: a limb of the hand.
#[derive(Debug, Clone, Copy)]
struct Band {
    /// Centre of the round end.
    end: Point2<f64>,
    /// Unit vector towards the end.
    along: Vector2<f64>,
    length_px: f64,
    half_width_px: f64,
    /// Growth of the half-width per pixel towards the end.
    taper: f64,
}

impl Shape for Band {
    fn depth(&self, at: Point2<f64>) -> (f64, Vector2<f64>) {
        let (dx, dy) = (at.x - self.end.x, at.y - self.end.y);
        let s = dx * self.along.x + dy * self.along.y;
        let q = dx * -self.along.y + dy * self.along.x;
        let slope = self.taper.hypot(1.0);
        let flank = (self.half_width_px + self.taper * s - q.abs()) / slope;
        let (depth, ns, nq) = if s > 0.0 {
            let r = s.hypot(q);
            (self.half_width_px - r, s / r, q / r)
        } else if s + self.length_px < flank {
            (s + self.length_px, -1.0, 0.0)
        } else {
            (flank, -self.taper / slope, q.signum() / slope)
        };
        let (e, n) = (self.along, Vector2::new(-self.along.y, self.along.x));
        (depth, e * ns + n * nq)
    }
}

/// A hand with the geometry of the band template, to be found by a tracker.
#[derive(Debug, Clone, Copy)]
pub struct Hand {
    /// Apex of the index finger \[px\].
    pub tip_px: Point2<f64>,
    pub angle_rad: f64,
    pub length_px: f64,
    /// Half the width at the centre of the round tip \[px\].
    pub half_width_px: f64,
    /// Growth of the half-width per pixel towards the tip.
    pub taper: f64,
    pub thumb: Option<RenderedThumb>,
}

#[derive(Debug, Clone, Copy)]
pub struct RenderedThumb {
    /// +1 on the right of the pointing direction, −1 on the left.
    pub side: f64,
    /// From the apex of the finger back to the intersection of the axes \[px\].
    pub root_px: f64,
    /// Angle between the two axes.
    pub angle_rad: f64,
    /// From the intersection to the thumb's apex \[px\].
    pub length_px: f64,
    pub half_width_px: f64,
}

impl Hand {
    /// The hand of the usual template at this size.
    pub fn usual(thumb: Thumb, tip_px: Point2<f64>, angle_rad: f64, length_px: f64) -> Self {
        let proportions = Proportions::usual(thumb);
        let thumb = proportions.thumb.map(|(side, thumb)| RenderedThumb {
            side: side.sign(),
            root_px: (HALF_LENGTH - thumb.base) * length_px,
            angle_rad: thumb.angle_rad,
            length_px: thumb.length * length_px,
            half_width_px: thumb.half_width * length_px,
        });
        let half_width_px = proportions.half_width * length_px;
        Self { tip_px, angle_rad, length_px, half_width_px, taper: 0.0, thumb }
    }

    pub fn direction(&self) -> Vector2<f64> {
        Vector2::new(self.angle_rad.cos(), self.angle_rad.sin())
    }

    /// Signed distance of a point from the axis, positive along (−sin θ, cos θ) \[px\].
    pub fn offset_px(&self, at: &Point2<f64>) -> f64 {
        self.direction().perp(&(at - self.tip_px))
    }
}

impl Shape for Hand {
    fn depth(&self, at: Point2<f64>) -> (f64, Vector2<f64>) {
        let along = self.direction();
        let end = self.tip_px - along * self.half_width_px;
        // The finger extends beyond the knuckle, like a fist.
        let length_px = 1.3 * self.length_px;
        let Self { half_width_px, taper, .. } = *self;
        let finger = Band { end, along, length_px, half_width_px, taper }.depth(at);
        let Some(thumb) = self.thumb else { return finger };
        let (sin, cos) = (self.angle_rad + thumb.side * thumb.angle_rad).sin_cos();
        let (root, up) = (self.tip_px - along * thumb.root_px, Vector2::new(cos, sin));
        let length_px = thumb.length_px - thumb.half_width_px;
        let half_width_px = thumb.half_width_px;
        let end = root + up * length_px;
        let thumb = Band { end, along: up, length_px, half_width_px, taper: 0.0 }.depth(at);
        if thumb.0 > finger.0 { thumb } else { finger }
    }
}

/// A finger of two parts, bent at the joint.
#[derive(Debug, Clone, Copy)]
pub struct BentFinger {
    /// Intersection of the axes of the two parts \[px\].
    pub joint_px: Point2<f64>,
    /// Direction of the knuckle part, and the rotation of the tip part relative to it.
    pub angle_rad: f64,
    pub bend_rad: f64,
    /// From the joint to the apex \[px\].
    pub length_px: f64,
    pub half_width_px: f64,
}

impl BentFinger {
    /// The same finger with another bend and an unchanged knuckle part.
    pub fn bent(self, bend_rad: f64) -> Self {
        Self { bend_rad, ..self }
    }

    /// The apex of the tip \[px\].
    pub fn tip_px(&self) -> Point2<f64> {
        let (sin, cos) = (self.angle_rad + self.bend_rad).sin_cos();
        self.joint_px + Vector2::new(cos, sin) * self.length_px
    }
}

impl Shape for BentFinger {
    fn depth(&self, at: Point2<f64>) -> (f64, Vector2<f64>) {
        let Self { joint_px, angle_rad, bend_rad, length_px, half_width_px } = *self;
        let part = |end: Point2<f64>, angle_rad: f64, length_px: f64| {
            let along = Vector2::new(angle_rad.cos(), angle_rad.sin());
            Band { end, along, length_px, half_width_px, taper: 0.0 }.depth(at)
        };
        let length_px = length_px - half_width_px;
        let (sin, cos) = (angle_rad + bend_rad).sin_cos();
        let end = joint_px + Vector2::new(cos, sin) * length_px;
        let tip = part(end, angle_rad + bend_rad, length_px);
        let knuckle = part(joint_px, angle_rad, 2.0 * length_px);
        if knuckle.0 > tip.0 { knuckle } else { tip }
    }
}

/// An image before digitisation.
#[derive(Debug, Clone)]
pub struct Canvas {
    width: usize,
    height: usize,
    pub grey: Vec<f64>,
}

impl Canvas {
    pub fn new(width: usize, height: usize, grey: f64) -> Self {
        Self { width, height, grey: vec![grey; width * height] }
    }

    /// Blends `grey` into every pixel by the area that the shape covers of it.
    pub fn paint(mut self, shape: &impl Shape, grey: f64) -> Self {
        for (y, row) in self.grey.chunks_exact_mut(self.width).enumerate() {
            let mut x = 0;
            while x < row.len() {
                let (depth, outward) = shape.depth(Point2::new(x as f64, y as f64));
                // 1/√2 is the greatest distance of a pixel's points from its centre.
                let clear = depth.abs() - std::f64::consts::FRAC_1_SQRT_2;
                if clear < 0.0 {
                    row[x] += covered_part(depth, &outward) * (grey - row[x]);
                    x += 1;
                } else {
                    // The boundary is at least this many pixels away.
                    let end = (x + 1 + clear as usize).min(row.len());
                    if depth > 0.0 {
                        row[x..end].fill(grey);
                    }
                    x = end;
                }
            }
        }
        self
    }

    /// Gaussian blur; the border repeats.
    pub fn blur(self, sigma_px: f64) -> Self {
        self.shrink(1, sigma_px)
    }

    /// Gaussian blur, then the mean of every `factor` × `factor` pixels; the border repeats.
    pub fn shrink(&self, factor: usize, sigma_px: f64) -> Self {
        let reach = (4.0 * sigma_px).ceil() as usize;
        let weight = |k: usize| (-0.5 * (k.abs_diff(reach) as f64 / sigma_px).powi(2)).exp();
        let sum: f64 = (0..=2 * reach).map(weight).sum();
        // Weight of each pixel in the mean of `factor` blurred pixels.
        let mut weights = vec![0.0; 2 * reach + factor];
        for first in 0..factor {
            for k in 0..=2 * reach {
                weights[first + k] += weight(k) / sum / factor as f64;
            }
        }
        // The result is transposed; two passes restore the orientation.
        let shrink_lines = |grey: &[f64], length: usize| -> Vec<f64> {
            let mut padded = vec![0.0; length + 2 * reach];
            let mut columns = vec![0.0; grey.len() / factor];
            for (line, of_line) in grey.chunks_exact(length).enumerate() {
                padded[..reach].fill(of_line[0]);
                padded[reach..][..length].copy_from_slice(of_line);
                padded[reach + length..].fill(of_line[length - 1]);
                for i in 0..length / factor {
                    let under = padded[i * factor..].iter().zip(&weights);
                    columns[i * (grey.len() / length) + line] = under.map(|(g, w)| g * w).sum();
                }
            }
            columns
        };
        let (width, height) = (self.width / factor, self.height / factor);
        let columns = shrink_lines(&self.grey, self.width);
        Self { width, height, grey: shrink_lines(&columns, self.height) }
    }

    /// The digitised picture with noise.
    pub fn take(&self, sigma_grey: f64, noise: &mut Noise) -> Picture {
        let bytes = self.grey.iter().map(|g| (g + sigma_grey * noise.normal()).round() as u8);
        Picture { width: self.width, height: self.height, bytes: bytes.collect() }
    }
}

/// Covered area of the unit square centred at a point, for a half-plane with its edge at distance
/// `depth`: the convolution of a step with a box along each axis.
pub fn covered_part(depth: f64, outward: &Vector2<f64>) -> f64 {
    let (u, v) = (outward.x.abs(), outward.y.abs());
    let (long, short) = (u.max(v), u.min(v));
    // The second box is too narrow for the division.
    if short < 1e-6 {
        return (depth / long + 0.5).clamp(0.0, 1.0);
    }
    let ramp = |x: f64| 0.5 * x.max(0.0).powi(2);
    let (outer, inner) = (0.5 * (long + short), 0.5 * (long - short));
    let sum = ramp(depth + outer) - ramp(depth + inner) - ramp(depth - inner) + ramp(depth - outer);
    sum / (long * short)
}

/// An 8-bit grey picture.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Picture {
    pub width: usize,
    pub height: usize,
    pub bytes: Vec<u8>,
}

impl Picture {
    pub fn view(&self) -> GrayView<'_> {
        GrayView::new(&self.bytes, self.width, self.height, self.width).unwrap()
    }
}
