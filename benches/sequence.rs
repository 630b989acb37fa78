//! A moving finger with exact truth, the same images that the C limit tracks.
//!
//! A bright capsule before a dark background moves under a slowly varying affine map, with soft
//! edges, shading, a background gradient and pixel noise. Template coordinates are centred on the
//! capsule; pixel centres are integers.

use fingerpost_core::geometry::planar::AffineMap;
use fingerpost_core::geometry::template::{Limb, TemplateSample};
use fingerpost_core::nalgebra::{Matrix2, Point2, Vector2};
use std::f64::consts::{FRAC_PI_2, PI, TAU};
use std::path::Path;
use std::{fs, io};

const EDGE_BLUR_PX: f64 = 1.2;
const NOISE_GREY: f64 = 4.0;
const FOREGROUND_GREY: f64 = 190.0;
const BACKGROUND_GREY: f64 = 45.0;
/// Frames of one closed loop of the motion.
const LOOP: usize = 256;
/// Number of normals of the template that is written for the C limit.
pub const NORMALS: usize = 100;
/// Size of the pool of noise; every row starts at a random place in it.
const NOISE_POOL: usize = 1 << 17;

/// Frames, and the true map of the finger in each.
pub struct Sequence {
    /// Width and height in px.
    pub size: [usize; 2],
    /// Grey levels of all frames, row by row, without padding.
    pub pixels: Vec<u8>,
    /// The image from the template, frame by frame.
    pub truth: Vec<AffineMap>,
    capsule: Capsule,
}

/// All points within `radius` of the segment along x from −`half_length` to `half_length`.
#[derive(Debug, Clone, Copy)]
struct Capsule {
    radius: f64,
    half_length: f64,
}

impl Sequence {
    /// `count` frames of `size`; `scale` is the size of the finger, 1 for a VGA frame.
    #[must_use]
    pub fn render(size: [usize; 2], count: usize, scale: f64) -> Self {
        let capsule = Capsule { radius: 18.0 * scale, half_length: 75.0 * scale };
        let truth: Vec<_> = (0..count).map(|i| pose(i, scale, size)).collect();
        let mut noise = Noise::new();
        let mut pixels = Vec::with_capacity(count * size[0] * size[1]);
        for map in &truth {
            draw(&capsule, map, size, &mut noise, &mut pixels);
        }
        Self { size, pixels, truth, capsule }
    }

    /// The pixels of one frame.
    #[must_use]
    pub fn frame(&self, i: usize) -> &[u8] {
        let pixels = self.size[0] * self.size[1];
        &self.pixels[i * pixels..(i + 1) * pixels]
    }

    /// `count` samples at equal steps along the outline, each in the middle of its step.
    #[must_use]
    pub fn template(&self, count: usize) -> Vec<TemplateSample> {
        self.capsule.outline(count)
    }

    /// Root mean square of the distances between the outline of `found` and the true one, along the
    /// true normals \[px\].
    #[must_use]
    pub fn error_px(&self, frame: usize, found: &AffineMap) -> f64 {
        use fingerpost_core::geometry::shape_space::Pose;
        let truth = &self.truth[frame];
        let samples = self.template(NORMALS);
        let squares = samples.iter().map(|sample| {
            let right = truth.place(sample);
            right.normal.dot(&(found.transform(&sample.position) - right.position)).powi(2)
        });
        (squares.sum::<f64>() / samples.len() as f64).sqrt()
    }

    /// Writes the files that the C limit reads.
    ///
    /// # Errors
    /// When a file cannot be written.
    pub fn write(&self, directory: &Path, name: &str) -> io::Result<()> {
        let file = |suffix: &str| directory.join(format!("{name}.{suffix}"));
        let bytes = |numbers: Vec<f64>| -> Vec<u8> {
            numbers.into_iter().flat_map(f64::to_ne_bytes).collect()
        };
        let truth = self.truth.iter().flat_map(|AffineMap { linear: m, centre: c }| {
            [m[(0, 0)], m[(0, 1)], m[(1, 0)], m[(1, 1)], c.x, c.y]
        });
        let template = self.template(NORMALS);
        let template = template
            .iter()
            .flat_map(|TemplateSample { position: p, normal: n, .. }| [p.x, p.y, n.x, n.y]);
        let ([width, height], count) = (self.size, self.truth.len());
        let Capsule { radius, half_length } = self.capsule;
        let shape = format!("{count} {height} {width} {NORMALS} {radius} {half_length}\n");
        fs::write(file("u8"), &self.pixels)?;
        fs::write(file("truth"), bytes(truth.collect()))?;
        fs::write(file("tmpl"), bytes(template.collect()))?;
        fs::write(file("txt"), shape)
    }
}

/// The finger in frame `i`.
fn pose(i: usize, scale: f64, [width, height]: [usize; 2]) -> AffineMap {
    let u = TAU * i as f64 / LOOP as f64;
    let (sin, cos) = (0.35 + 0.30 * (2.0 * u).sin()).sin_cos();
    let size = 1.0 + 0.06 * (3.0 * u + 1.0).sin();
    let shear = 0.05 * (2.0 * u + 2.0).sin();
    let linear = size * Matrix2::new(cos, -sin, sin, cos) * Matrix2::new(1.0, shear, 0.0, 1.0);
    let centre = Point2::new(
        0.5 * width as f64 + 75.0 * scale * (2.0 * u).sin(),
        0.5 * height as f64 + 60.0 * scale * (3.0 * u + 0.7).sin(),
    );
    AffineMap { centre, linear }
}

impl Capsule {
    /// Distance from the outline, negative inside.
    fn distance(&self, at: Vector2<f64>) -> f64 {
        let Self { radius, half_length } = *self;
        (at.x - at.x.clamp(-half_length, half_length)).hypot(at.y) - radius
    }

    fn outline(&self, count: usize) -> Vec<TemplateSample> {
        let Self { radius, half_length } = *self;
        let (straight, cap) = (2.0 * half_length, PI * radius);
        let step = 2.0 * (straight + cap) / count as f64;
        let sample = |i| {
            let s = (i as f64 + 0.5) * step;
            let (foot, angle) = if s < straight {
                (s - half_length, FRAC_PI_2)
            } else if s < straight + cap {
                (half_length, FRAC_PI_2 - (s - straight) / radius)
            } else if s < 2.0 * straight + cap {
                (half_length - (s - straight - cap), -FRAC_PI_2)
            } else {
                (-half_length, -FRAC_PI_2 - (s - 2.0 * straight - cap) / radius)
            };
            let normal = Vector2::new(angle.cos(), angle.sin());
            let position = Point2::new(foot, 0.0) + radius * normal;
            TemplateSample { position, normal, limb: Limb::Finger, along: 0.0, radial: normal }
        };
        (0..count).map(sample).collect()
    }
}

fn draw(
    capsule: &Capsule,
    map: &AffineMap,
    [width, height]: [usize; 2],
    noise: &mut Noise,
    pixels: &mut Vec<u8>,
) {
    let inverse = map.linear.try_inverse().unwrap_or_else(Matrix2::identity);
    // Only the neighbourhood of the shape needs the distance.
    let reach = (capsule.half_length + 2.0 * capsule.radius) * 1.3 + 10.0;
    for y in 0..height {
        let disturbed = noise.row(width);
        for (x, disturbance) in disturbed.iter().enumerate() {
            let (u, v) = (x as f64, y as f64);
            let mut grey = BACKGROUND_GREY + 12.0 * (u / width as f64) + 8.0 * (v / height as f64);
            let from_centre = Point2::new(u, v) - map.centre;
            if from_centre.amax() < reach {
                let d = signed_distance(capsule, &inverse, inverse * from_centre);
                let depth = (1.0 + d / capsule.radius).clamp(0.0, 1.0);
                // Shading of a round body: a darker rim, without a slope at the edge itself.
                let shade = FOREGROUND_GREY - 25.0 * depth * depth * (3.0 - 2.0 * depth);
                grey += normal_cdf(-d / EDGE_BLUR_PX) * (shade - grey);
            }
            pixels.push((grey + disturbance).round() as u8);
        }
    }
}

/// Distance from the moved capsule's outline, negative inside, to first order \[px\].
fn signed_distance(capsule: &Capsule, inverse: &Matrix2<f64>, at: Vector2<f64>) -> f64 {
    const STEP: f64 = 1e-3;
    let slope =
        |by: Vector2<f64>| (capsule.distance(at + by) - capsule.distance(at - by)) / (2.0 * STEP);
    let gradient = Vector2::new(slope(Vector2::x() * STEP), slope(Vector2::y() * STEP));
    capsule.distance(at) / (inverse.transpose() * gradient).norm().max(1e-9)
}

/// Normal cumulative distribution at `z`: Zelen & Severo's approximation, to 10⁻⁷.
fn normal_cdf(z: f64) -> f64 {
    let t = 1.0 / (1.0 + 0.231_641_9 * z.abs());
    let series = [1.330_274_429, -1.821_255_978, 1.781_477_937, -0.356_563_782, 0.319_381_530]
        .iter()
        .fold(0.0, |sum, c| t * (sum + c));
    let above = (-0.5 * z * z).exp() / TAU.sqrt() * series;
    if z > 0.0 { 1.0 - above } else { above }
}

/// White noise: a pool of normal numbers (Box & Muller), and the generator of places in it.
struct Noise {
    pool: Vec<f64>,
    state: u64,
}

impl Noise {
    fn new() -> Self {
        let mut noise = Self { pool: Vec::new(), state: 7 };
        noise.pool = (0..NOISE_POOL)
            .map(|_| {
                let radius = (-2.0 * (1.0 - noise.uniform()).ln()).sqrt();
                NOISE_GREY * radius * (TAU * noise.uniform()).cos()
            })
            .collect();
        noise
    }

    /// SplitMix64, in [0, 1).
    fn uniform(&mut self) -> f64 {
        self.state = self.state.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.state ^ (self.state >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 11) as f64 / (1_u64 << 53) as f64
    }

    fn row(&mut self, width: usize) -> &[f64] {
        let start = (self.uniform() * (NOISE_POOL - width) as f64) as usize;
        &self.pool[start..start + width]
    }
}
