//! The refiner on exact fingers: spheres of decreasing size along a line in space, seen by a
//! pinhole camera, whose axis projects to a line that is known up to rounding.

use crate::common::{BentFinger, Canvas, Noise, Picture, Shape, covered_part};
use fingerpost_core::appearance::histogram::HistogramModel;
use fingerpost_core::axis::Stretch;
use fingerpost_core::axis::{
    Finger, KnownBackground, MAX_STRETCH_PX, RefineOptions, Refined, Refiner, Source, WidthPrior,
};
use fingerpost_core::geometry::shape_space::Axis;
use fingerpost_core::measure::edge::Polarity;
use fingerpost_core::nalgebra::{Matrix2, Matrix4, Point2, Vector2, Vector3, Vector4};
use fingerpost_core::numeric::simd::Isa;
use fingerpost_core::{Error, Frame, GrayView};
use std::f64::consts::{PI, TAU};

const SIZE: usize = 128;
const TABLE: f64 = 70.0;

/// A sphere-swept cone before a pinhole camera.
#[derive(Debug, Clone, Copy)]
struct Cone {
    focal_px: f64,
    shift: Vector2<f64>,
    centres: [Vector3<f64>; 2],
    radii: [f64; 2],
}

/// Illumination of a finger.
#[derive(Debug, Clone, Copy)]
struct Light {
    contrast: f64,
    /// Lateral shading and limb darkening, as fractions of the contrast.
    side: f64,
    limb: f64,
    blur_px: f64,
}

const PLAIN: Light = Light { contrast: 80.0, side: 0.0, limb: 0.0, blur_px: 1.0 };

impl Cone {
    /// A rod of 16 mm diameter and 70–90 mm length at a distance of two metres, about 12 px wide,
    /// in any direction without strong foreshortening; `scale` magnifies it.
    fn random(noise: &mut Noise, taper: f64, scale: f64) -> Self {
        let focal_px = 1692.0 * scale;
        let z = noise.between(1850.0, 2050.0);
        let middle =
            Vector3::new(noise.between(-0.08, 0.08) * z, noise.between(-0.08, 0.08) * z, z);
        let (azimuth, tilt) = (noise.between(0.0, TAU), noise.between(-0.9, 0.9));
        let along =
            Vector3::new(azimuth.cos() * tilt.cos(), azimuth.sin() * tilt.cos(), tilt.sin());
        let length = noise.between(70.0, 90.0);
        let radii = [8.0, 8.0 * (1.0 - taper)];
        let centres = [middle - along * (0.5 * length), middle + along * (0.5 * length - radii[1])];
        let mut cone = Self { focal_px, shift: Vector2::zeros(), centres, radii };
        let half = 0.5 * SIZE as f64 * scale;
        let jitter = Vector2::new(noise.between(-0.5, 0.5), noise.between(-0.5, 0.5));
        cone.shift = Vector2::repeat(half) + jitter - cone.project(&middle).coords;
        cone
    }

    fn project(&self, x: &Vector3<f64>) -> Point2<f64> {
        Point2::from(Vector2::new(x.x, x.y) * (self.focal_px / x.z) + self.shift)
    }

    /// The ends of the projected axis.
    fn ends(&self) -> [Point2<f64>; 2] {
        self.centres.map(|c| self.project(&c))
    }

    fn half_widths(&self) -> [f64; 2] {
        [0, 1].map(|i| self.focal_px * self.radii[i] / self.centres[i].z)
    }

    /// Negative where the ray through a point of the image meets a sphere.
    fn outside(&self, at: Point2<f64>) -> f64 {
        let at = (at.coords - self.shift) / self.focal_px;
        let ray = Vector3::new(at.x, at.y, 1.0).normalize();
        let (a, b) = (self.centres[0].cross(&ray), (self.centres[1] - self.centres[0]).cross(&ray));
        let (r, dr) = (self.radii[0], self.radii[1] - self.radii[0]);
        let (q2, q1, q0) = (b.dot(&b) - dr * dr, 2.0 * (a.dot(&b) - r * dr), a.dot(&a) - r * r);
        let t = if q2 > 0.0 { (-0.5 * q1 / q2).clamp(0.0, 1.0) } else { 0.0 };
        q0 + t * (q1 + t * q2)
    }

    /// A tracker's estimate: the truth with errors of `error` px and `error` / 50 rad.
    fn estimated(&self, noise: &mut Noise, error: f64) -> Finger {
        let [p0, p1] = self.ends();
        let [w0, w1] = self.half_widths();
        let length = (p1 - p0).norm();
        let e = (p1 - p0) / length;
        let n = Vector2::new(-e.y, e.x);
        let anchor = p0 + e * (0.5 * length) + n * (error * noise.normal());
        let angle = e.y.atan2(e.x) + 0.02 * error * noise.normal();
        let stretch = Stretch { from_px: 1.0 - 0.5 * length, to_px: 0.5 * length + w1 };
        Finger {
            axis: Axis::of_finger(anchor, angle, 0.5 * length + w1),
            half_width_px: 0.5 * (w0 + w1) + 0.5 * error * noise.normal(),
            taper: (w1 - w0) / length,
            flanks: [stretch, stretch],
            round_end_px: Some(0.5 * length + error * noise.normal()),
            prior: None,
        }
    }

    /// Offset \[px\] and angle of an axis from the truth, the offset at the axis' own anchor.
    fn error(&self, axis: &Axis) -> Vector2<f64> {
        let [p0, p1] = self.ends();
        let e = (p1 - p0).normalize();
        let turn = axis.angle_rad - e.y.atan2(e.x);
        let at = p0 + e * (axis.anchor - p0).dot(&e);
        Vector2::new(axis.normal().dot(&(axis.anchor - at)), turn - (turn / TAU).round() * TAU)
    }

    /// The Cramér–Rao bound of offset and angle for two free straight flanks from end to end: an
    /// edge of contrast A and blur s under noise σ carries A² / (2 √π s σ²) per px.
    fn bound(&self, axis: &Axis, light: &Light, sigma: f64) -> Matrix2<f64> {
        let [p0, p1] = self.ends();
        let e = (p1 - p0).normalize();
        let blur = light.blur_px.hypot(1.0 / 12_f64.sqrt());
        let variance = sigma * sigma + 1.0 / 12.0;
        let density = light.contrast.powi(2) / (2.0 * PI.sqrt() * blur * variance);
        let (from, to) = ((p0 - axis.anchor).dot(&e), (p1 - axis.anchor).dot(&e));
        let mut information = Matrix4::zeros();
        let steps = 400;
        for k in 0..steps {
            let p = from + (to - from) * (f64::from(k) + 0.5) / f64::from(steps);
            for side in [1.0, -1.0] {
                let row = Vector4::new(side, side * p, 1.0, p);
                information += row * row.transpose() * (density * (to - from) / f64::from(steps));
            }
        }
        information.try_inverse().unwrap().fixed_view::<2, 2>(0, 0).into_owned()
    }

    /// Fraction of a square about a point that the finger covers.
    fn cover(&self, at: Point2<f64>, side: f64) -> f64 {
        let d = 1e-3;
        let slope =
            |v: Vector2<f64>| (self.outside(at + v * d) - self.outside(at - v * d)) / (2.0 * d);
        let normal = Vector2::new(slope(Vector2::x()), slope(Vector2::y()));
        let steep = normal.norm();
        covered_part(-self.outside(at) / steep / side, &(normal / steep))
    }

    /// The image by 4 × 4 samples per pixel, each weighted by the fraction that the finger covers.
    fn render(&self, light: &Light, scale: usize, behind: &dyn Fn(f64, f64) -> f64) -> Canvas {
        const FINE: usize = 4;
        let size = SIZE * scale;
        let [p0, p1] = self.ends();
        let [w0, w1] = self.half_widths();
        let (length, e) = ((p1 - p0).norm(), (p1 - p0).normalize());
        let step = 1.0 / FINE as f64;
        let place = |i: usize| (i as f64 + 0.5) * step - 0.5;
        // With a margin of one sample: if all neighbours are on one side, so is the sample.
        let wide = size * FINE + 2;
        let on_finger: Vec<bool> = (0..wide * wide)
            .map(|i| Point2::new(place(i % wide) - step, place(i / wide) - step))
            .map(|at| self.outside(at) < 0.0)
            .collect();
        let mut fine = Canvas::new(size * FINE, size * FINE, 0.0);
        for y in 0..size * FINE {
            for x in 0..size * FINE {
                let at = Point2::new(place(x), place(y));
                let near = (y..y + 3).flat_map(|j| &on_finger[j * wide + x..][..3]);
                let cover = match near.filter(|on| **on).count() {
                    0 => 0.0,
                    9 => 1.0,
                    _ => self.cover(at, step),
                };
                let d = at - p0;
                let (p, q) = (d.dot(&e), e.perp(&d));
                let part = (p / length).clamp(0.0, 1.0);
                let width = w0 + (w1 - w0) * part;
                let (across, beyond) = (q / width, (p - part * length) / width);
                let facing = (1.0 - across * across - beyond * beyond).max(0.0).sqrt();
                let shade = (1.0 + 0.5 * light.side * across.clamp(-1.0, 1.0))
                    * (1.0 - light.limb * (1.0 - facing));
                let back = behind(at.x, at.y);
                let front = TABLE + light.contrast * shade;
                fine.grey[y * size * FINE + x] = back + cover * (front - back);
            }
        }
        fine.shrink(FINE, light.blur_px * FINE as f64)
    }
}

fn flat(_: f64, _: f64) -> f64 {
    TABLE
}

/// A table cluttered with ellipses of up to ±`amplitude` grey levels.
fn clutter(noise: &mut Noise, amplitude: f64) -> impl Fn(f64, f64) -> f64 + use<> {
    let size = SIZE as f64;
    let shapes: Vec<_> = (0..30)
        .map(|_| {
            let long = noise.between(6.0, 20.0);
            let middle = Point2::new(noise.between(0.0, size), noise.between(0.0, size));
            let short = long * noise.between(0.4, 1.0);
            (
                middle,
                long,
                short,
                noise.between(0.0, PI).sin_cos(),
                noise.between(-amplitude, amplitude),
            )
        })
        .collect();
    move |u, v| {
        let hit = shapes.iter().rev().find(|(middle, long, short, (s, c), _)| {
            let d = Point2::new(u, v) - middle;
            let (along, across) = (d.x * c + d.y * s, d.y * c - d.x * s);
            d.norm_squared() < long * long
                && (along / long).powi(2) + (across / short).powi(2) < 1.0
        });
        TABLE + hit.map_or(0.0, |shape| shape.4)
    }
}

fn refiner() -> Refiner {
    Refiner::new(RefineOptions::default()).unwrap()
}

fn refine(refiner: &mut Refiner, picture: &Picture, finger: &Finger) -> Option<Refined> {
    refiner.refine(&Frame::gray(picture.view()), finger, Polarity::Unknown, None, None).unwrap()
}

/// Errors in relation to their reported covariances.
#[derive(Debug, Default)]
struct Score {
    count: f64,
    sum: Vector2<f64>,
    squares: Vector2<f64>,
    nees: Vector2<f64>,
    bound: Vector2<f64>,
    covered: f64,
}

impl Score {
    fn add(&mut self, error: Vector2<f64>, covariance: &Matrix2<f64>, bound: &Matrix2<f64>) {
        self.count += 1.0;
        self.sum += error;
        self.squares += error.component_mul(&error);
        self.nees += error.component_mul(&error).component_div(&covariance.diagonal());
        self.bound += error.component_mul(&error).component_div(&bound.diagonal());
        let distance = error.dot(&(covariance.try_inverse().unwrap() * error));
        self.covered += f64::from(u8::from(distance < 5.991));
    }

    fn rms_px(&self) -> f64 {
        (self.squares.x / self.count).sqrt()
    }

    fn rms_deg(&self) -> f64 {
        (self.squares.y / self.count).sqrt().to_degrees()
    }
}

/// Refines `poses` × `trials` fingers and scores the photometric lines.
fn photometric(
    seed: u64,
    [poses, trials]: [usize; 2],
    light: &Light,
    amplitude: f64,
    known: bool,
) -> Score {
    let (mut noise, mut refiner, mut score) = (Noise::new(seed), refiner(), Score::default());
    let sigma = 2.0;
    for _ in 0..poses {
        let cone = Cone::random(&mut noise, 0.1, 1.0);
        let behind = clutter(&mut noise, amplitude);
        let canvas = cone.render(light, 1, &behind);
        let away = Cone { centres: cone.centres.map(|c| c + Vector3::new(1e4, 0.0, 0.0)), ..cone };
        let empty = known.then(|| away.render(light, 1, &behind));
        for _ in 0..trials {
            let picture = canvas.take(sigma, &mut noise);
            let finger = cone.estimated(&mut noise, 0.3);
            let spread = sigma / 30_f64.sqrt();
            let learned: Option<Vec<f32>> = empty
                .as_ref()
                .map(|c| c.grey.iter().map(|g| (g + spread * noise.normal()) as f32).collect());
            let doubt = vec![spread as f32; SIZE * SIZE];
            let background =
                learned.as_ref().map(|m| KnownBackground::new(m, &doubt, SIZE, SIZE).unwrap());
            let frame = Frame::gray(picture.view());
            let refined = refiner
                .refine(&frame, &finger, Polarity::Unknown, None, background.as_ref())
                .unwrap();
            let Some(refined) = refined else { continue };
            if refined.source == Source::Photometric {
                let bound = cone.bound(&refined.axis, light, sigma);
                score.add(cone.error(&refined.axis), &refined.covariance, &bound);
            }
        }
    }
    score
}

#[test]
fn without_noise_the_error_is_small() {
    let (mut noise, mut refiner, mut score) = (Noise::new(1), refiner(), Score::default());
    for _ in 0..16 {
        let cone = Cone::random(&mut noise, 0.1, 1.0);
        let picture = cone.render(&PLAIN, 1, &flat).take(0.0, &mut noise);
        let refined = refine(&mut refiner, &picture, &cone.estimated(&mut noise, 0.3)).unwrap();
        assert_eq!(refined.source, Source::Photometric);
        score.add(cone.error(&refined.axis), &refined.covariance, &Matrix2::identity());
    }
    // Rounding to whole grey levels is noise of 0.29 grey levels.
    assert!(score.rms_px() < 0.004, "{} px", score.rms_px());
    assert!(score.rms_deg() < 0.005, "{}°", score.rms_deg());
}

#[test]
fn the_covariance_is_consistent_and_near_the_bound() {
    let score = photometric(2, [40, 8], &PLAIN, 0.0, false);
    let n = score.count;
    assert!(n > 316.0, "{n} of 320");
    // The standard error of a mean of χ² of 320 is 8 %.
    for nees in (score.nees / n).iter() {
        assert!((0.84..1.2).contains(nees), "NEES {}", score.nees / n);
    }
    // 95 % within three standard errors of 1.2 %.
    assert!((0.913..0.987).contains(&(score.covered / n)), "covered {}", score.covered / n);
    // Mean errors in units of their standard error.
    for bias in score.sum.component_div(&score.squares.map(f64::sqrt)).iter() {
        assert!(bias.abs() < 3.0, "bias {bias}");
    }
    // The information of the round end balances the loss by shading, so the bound is that of two
    // free flanks.
    let efficiency = n / score.bound.y;
    assert!((0.85..1.3).contains(&efficiency), "efficiency {efficiency}");
}

#[test]
fn the_bend_of_a_cylinder_is_consistent_with_its_standard_deviation() {
    let (mut noise, mut refiner) = (Noise::new(31), refiner());
    let (mut chi_squared, mut count) = (0.0, 0.0);
    for _ in 0..30 {
        let cone = Cone::random(&mut noise, 0.0, 1.0);
        let canvas = cone.render(&PLAIN, 1, &flat);
        for _ in 0..8 {
            let picture = canvas.take(2.0, &mut noise);
            let refined = refine(&mut refiner, &picture, &cone.estimated(&mut noise, 0.3)).unwrap();
            let report = refined.photometric.unwrap();
            chi_squared += (report.bend_px / report.bend_sigma_px).powi(2);
            count += 1.0;
        }
    }
    // The standard error of a mean of χ² of 240 is 9 %.
    let nees: f64 = chi_squared / count;
    assert!((0.75..1.25).contains(&nees), "NEES {nees}");
}

#[test]
fn sharp_and_soft_pictures_converge_in_a_few_iterations() {
    let (mut noise, mut refiner) = (Noise::new(12), refiner());
    let fingers = 8;
    // Greatest mean number of iterations.
    for (blur_px, most) in [(0.4, 4), (0.6, 4), (1.0, 6), (1.5, 6), (1.9, 7)] {
        let mut iterations = 0;
        for _ in 0..fingers {
            let cone = Cone::random(&mut noise, 0.1, 1.0);
            let picture = cone.render(&Light { blur_px, ..PLAIN }, 1, &flat).take(2.0, &mut noise);
            let refined = refine(&mut refiner, &picture, &cone.estimated(&mut noise, 0.3)).unwrap();
            let report = refined.photometric.unwrap();
            assert_eq!(refined.source, Source::Photometric, "blur {blur_px}");
            // A pixel's extent is equivalent to a blur of 1 / √12 px.
            let part = report.blur_px / blur_px.hypot(1.0 / 12_f64.sqrt());
            assert!((0.88..1.12).contains(&part), "{} px for {blur_px}", report.blur_px);
            iterations += report.iterations;
        }
        assert!(iterations <= most * fingers, "{iterations} iterations at {blur_px}");
    }
}

#[test]
fn lateral_light_and_a_dark_limb_cause_no_rotation() {
    let light = Light { side: 0.3, limb: 0.3, ..PLAIN };
    let score = photometric(3, [40, 4], &light, 0.0, false);
    let n = score.count;
    assert!(n > 156.0, "{n} of 160");
    assert!((score.sum.x / n).abs() < 0.01, "{} px", score.sum.x / n);
    assert!((0.75..1.35).contains(&(score.nees.y / n)), "NEES {}", score.nees / n);
    assert!(score.covered / n > 0.9, "covered {}", score.covered / n);
    assert!(score.rms_deg() < 0.03, "{}°", score.rms_deg());
}

#[test]
fn the_covariance_is_consistent_before_unknown_clutter() {
    for (amplitude, least, most_deg) in [(25.0, 0.8, 0.07), (50.0, 0.7, 0.14)] {
        let score = photometric(4, [100, 1], &PLAIN, amplitude, false);
        let n = score.count;
        assert!(n / 100.0 > least, "{n} of 100 at ±{amplitude}");
        assert!((0.4..1.7).contains(&(score.nees.y / n)), "±{amplitude}: {}", score.nees / n);
        assert!(score.covered / n > 0.86, "±{amplitude}: covered {}", score.covered / n);
        assert!(score.rms_deg() < most_deg, "±{amplitude}: {}°", score.rms_deg());
    }
}

#[test]
fn a_known_cluttered_background_costs_little_accuracy() {
    let score = photometric(5, [80, 1], &PLAIN, 50.0, true);
    let n = score.count;
    assert!(n > 72.0, "{n} of 80");
    assert!((0.6..1.6).contains(&(score.nees.y / n)), "NEES {}", score.nees / n);
    assert!(score.covered / n > 0.86, "covered {}", score.covered / n);
    assert!(score.rms_deg() < 0.035, "{}°", score.rms_deg());
}

/// Objects on a finger, in its own frame: p as a fraction of its length from the base, q lateral.
#[derive(Debug, Clone, Copy)]
enum Cover {
    /// A thumb along the near part of one flank.
    Thumb,
    /// A ring, wider than the finger.
    Ring,
    /// A nail on the inside of one flank.
    Nail,
    /// Dark creases across the finger.
    Creases,
    /// The edge of a sleeve, wider than the finger, at an angle.
    Sleeve,
    /// A joint that protrudes to one side.
    Joint,
}

impl Cover {
    /// Blends the object into a picture that is already blurred.
    fn lay(self, canvas: &mut Canvas, cone: &Cone, light: &Light, noise: &mut Noise) {
        const FINE: usize = 3;
        let [p0, p1] = cone.ends();
        let [w0, w1] = cone.half_widths();
        let (length, e) = ((p1 - p0).norm(), (p1 - p0).normalize());
        let side = if noise.between(0.0, 1.0) < 0.5 { 1.0 } else { -1.0 };
        let (a, b, c) =
            (noise.between(0.0, 1.0), noise.between(0.0, 1.0), noise.between(-1.0, 1.0));
        let finger = TABLE + light.contrast;
        let level = match self {
            Self::Thumb | Self::Joint => finger,
            Self::Ring => finger + 60.0 * c,
            Self::Nail => finger + 25.0,
            Self::Creases => finger - 40.0,
            Self::Sleeve => TABLE + 120.0 * c,
        };
        let covers = |p: f64, q: f64, half: f64| match self {
            Self::Thumb => p < 0.15 + 0.3 * a && (q - half).abs() < 1.0 + 4.0 * b,
            Self::Ring => (p - 0.2 - 0.3 * a).abs() < 0.05 && q.abs() < half + 0.3 + b,
            Self::Nail => p > 0.8 && q > 0.3 * half && q < half - 0.5,
            Self::Creases => {
                [0.3, 0.35, 0.65].iter().any(|at| (p - at - 0.1 * a).abs() < 0.01) && q.abs() < half
            }
            Self::Sleeve => {
                p < 0.1 + 0.2 * a + 0.04 * c * q / half && q.abs() < half + 1.0 + 3.0 * b
            }
            Self::Joint => {
                let beyond = (0.3 + 0.7 * b) * (-0.5 * ((p - 0.2 - 0.6 * a) / 0.06).powi(2)).exp();
                beyond > 0.02 && q > 0.0 && q < half + beyond
            }
        };
        let size = SIZE;
        let mut mask = Canvas::new(size * FINE, size * FINE, 0.0);
        for y in 0..size * FINE {
            for x in 0..size * FINE {
                let place = |i: usize| (i as f64 + 0.5) / FINE as f64 - 0.5;
                let d = Point2::new(place(x), place(y)) - p0;
                let (p, q) = (d.dot(&e) / length, side * e.perp(&d));
                let half = w0 + (w1 - w0) * p.clamp(0.0, 1.0);
                mask.grey[y * size * FINE + x] =
                    f64::from(u8::from(p > -0.3 && covers(p, q, half)));
            }
        }
        let mask = mask.blur(light.blur_px * FINE as f64);
        let mut parts = Canvas::new(size, size, 0.0);
        for (i, part) in mask.grey.iter().enumerate() {
            let (x, y) = (i % (size * FINE) / FINE, i / (size * FINE) / FINE);
            parts.grey[y * size + x] += part / (FINE * FINE) as f64;
        }
        for (grey, part) in canvas.grey.iter_mut().zip(&parts.grey) {
            // There is no edge between finger and thumb or joint.
            let joined = matches!(self, Self::Thumb | Self::Joint);
            let laid = *grey + part * (level - *grey);
            *grey = if joined { grey.max(TABLE + part * (level - TABLE)) } else { laid };
        }
    }
}

#[test]
fn objects_on_a_finger_are_rejected_or_included_in_the_covariance() {
    // Minimum number of accepted photometric lines; a joint may make the fit fail.
    for (kind, least) in [
        (Cover::Thumb, 8.0),
        (Cover::Ring, 11.0),
        (Cover::Nail, 11.0),
        (Cover::Creases, 11.0),
        (Cover::Sleeve, 9.0),
        (Cover::Joint, 3.0),
    ] {
        let (mut noise, mut refiner, mut score) = (Noise::new(11), refiner(), Score::default());
        for _ in 0..14 {
            let cone = Cone::random(&mut noise, 0.1, 1.0);
            let mut canvas = cone.render(&PLAIN, 1, &flat);
            kind.lay(&mut canvas, &cone, &PLAIN, &mut noise);
            let finger = cone.estimated(&mut noise, 0.3);
            let picture = canvas.take(2.0, &mut noise);
            let refined = refine(&mut refiner, &picture, &finger);
            let Some(refined) = refined.filter(|r| r.source == Source::Photometric) else {
                continue;
            };
            let bound = cone.bound(&refined.axis, &PLAIN, 2.0);
            score.add(cone.error(&refined.axis), &refined.covariance, &bound);
        }
        assert!(score.count >= least, "{kind:?}: {score:?}");
        assert!(score.covered / score.count >= 0.85, "{kind:?}: {score:?}");
        assert!(score.nees.y / score.count < 1.6, "{kind:?}: {score:?}");
        assert!(score.rms_deg() < 0.12, "{kind:?}: {score:?}");
    }
}

/// An oblique finger in the middle of the picture, with an exact estimate.
fn plain() -> (Cone, Finger, Noise) {
    let mut noise = Noise::new(6);
    let cone = Cone::random(&mut noise, 0.1, 1.0);
    let finger = cone.estimated(&mut noise, 0.0);
    (cone, finger, noise)
}

/// Asserts that a refined line is near the truth in terms of its covariance.
fn assert_consistent(cone: &Cone, refined: Option<&Refined>, what: &str) {
    let Some(refined) = refined else { return };
    let error = cone.error(&refined.axis);
    let distance = error.dot(&(refined.covariance.try_inverse().unwrap() * error));
    assert!(distance < 20.0, "{what}: off by {error} with {}: {refined:?}", refined.covariance);
}

#[test]
fn moving_the_anchor_does_not_change_the_line() {
    let (cone, finger, mut noise) = plain();
    let picture = cone.render(&PLAIN, 1, &flat).take(2.0, &mut noise);
    let here = refine(&mut refiner(), &picture, &finger).unwrap();
    let along = 7.5;
    let shift = |s: Stretch| Stretch { from_px: s.from_px - along, to_px: s.to_px - along };
    let anchor = finger.axis.anchor + finger.axis.direction() * along;
    let ahead = (finger.axis.tip - anchor).norm();
    let moved = Finger {
        axis: Axis::of_finger(anchor, finger.axis.angle_rad, ahead),
        half_width_px: finger.half_width_px + finger.taper * along,
        flanks: finger.flanks.map(shift),
        round_end_px: finger.round_end_px.map(|e| e - along),
        ..finger
    };
    let there = refine(&mut refiner(), &picture, &moved).unwrap();
    let d = there.axis.anchor - here.axis.anchor;
    assert!((d - here.axis.direction() * along).norm() < 1e-4, "{d}");
    assert!((there.axis.tip - here.axis.tip).norm() < 1e-4);
    assert!((there.half_width_px - here.half_width_px - here.taper * along).abs() < 1e-4);
    let transport = Matrix2::new(1.0, along, 0.0, 1.0);
    let expected = transport * here.covariance * transport.transpose();
    assert!((there.covariance - expected).norm() < 1e-3 * expected.norm());
}

#[test]
fn the_line_of_a_bent_finger_is_its_least_squares_line() {
    const FINE: usize = 4;
    let (mut noise, half_curvature) = (Noise::new(13), 3e-4);
    let (e, anchor) = (Vector2::new(0.8, 0.6), Point2::new(63.3, 64.2));
    let n = Vector2::new(-e.y, e.x);
    let mut fine = Canvas::new(SIZE * FINE, SIZE * FINE, TABLE);
    for (i, grey) in fine.grey.iter_mut().enumerate() {
        let place = |i: usize| (i as f64 + 0.5) / FINE as f64 - 0.5;
        let d = Point2::new(place(i % (SIZE * FINE)), place(i / (SIZE * FINE))) - anchor;
        let (p, q) = (d.dot(&e), d.dot(&n));
        if (q - half_curvature * p * p).abs() < 7.0 {
            *grey += 80.0;
        }
    }
    let fine = fine.blur(FINE as f64);
    let mut canvas = Canvas::new(SIZE, SIZE, 0.0);
    for (i, grey) in fine.grey.iter().enumerate() {
        let (x, y) = (i % (SIZE * FINE) / FINE, i / (SIZE * FINE) / FINE);
        canvas.grey[y * SIZE + x] += grey / (FINE * FINE) as f64;
    }
    let picture = canvas.take(0.5, &mut noise);
    let whole = Stretch { from_px: -30.0, to_px: 30.0 };
    for (flanks, middle_px, half_px) in [
        ([whole, whole], 0.0, 30.0),
        ([Stretch { from_px: 0.0, ..whole }; 2], 15.0, 15.0),
        // Between the stretches of both flanks, whose middles are 0 and 10.
        ([whole, Stretch { from_px: -10.0, ..whole }], 5.0, 25.0),
    ] {
        let axis = Axis::of_finger(anchor, e.y.atan2(e.x), 40.0);
        let finger = Finger {
            axis,
            half_width_px: 7.0,
            taper: 0.0,
            flanks,
            round_end_px: None,
            prior: None,
        };
        let refined = refine(&mut refiner(), &picture, &finger).unwrap();
        assert_eq!(refined.source, Source::Photometric);
        let Stretch { from_px, to_px } = refined.stretch;
        let (middle, half) = (0.5 * (from_px + to_px), 0.5 * (to_px - from_px));
        assert!((middle - middle_px).abs() < 3.0, "{:?}", refined.stretch);
        assert!((half - half_px).abs() < 3.0, "{:?}", refined.stretch);
        for p in [middle - half / 3_f64.sqrt(), middle + half / 3_f64.sqrt()] {
            let on_line = refined.axis.anchor + refined.axis.direction() * p - anchor;
            let (p, q) = (on_line.dot(&e), on_line.dot(&n));
            assert!(
                (q - half_curvature * p * p).abs() < 0.02,
                "{p}: {q} and {}",
                half_curvature * p * p
            );
        }
    }
}

#[test]
fn a_refiner_has_no_state_between_frames() {
    let (cone, finger, mut noise) = plain();
    let canvas = cone.render(&PLAIN, 1, &flat);
    let pictures = [(); 2].map(|()| canvas.take(2.0, &mut noise));
    let mut used = refiner();
    let first = refine(&mut used, &pictures[0], &finger);
    refine(&mut used, &pictures[1], &finger);
    assert_eq!(refine(&mut used, &pictures[0], &finger), first);
    assert_eq!(refine(&mut refiner(), &pictures[0], &finger), first);
    assert_eq!(first.unwrap().source, Source::Photometric);
}

#[test]
fn every_instruction_set_gives_the_same_bits() {
    let (cone, finger, mut noise) = plain();
    let picture = cone.render(&PLAIN, 1, &flat).take(2.0, &mut noise);
    let expected = refine(&mut refiner(), &picture, &finger);
    for isa in Isa::available() {
        assert_eq!(refine(&mut refiner().with_isa(isa), &picture, &finger), expected, "{isa}");
    }
}

#[test]
fn without_a_finger_there_is_no_line() {
    let (cone, finger, mut noise) = plain();
    let mut refiner = refiner();
    let empty = Canvas::new(SIZE, SIZE, TABLE).take(2.0, &mut noise);
    assert_eq!(refine(&mut refiner, &empty, &finger), None, "an empty table");
    let black = Canvas::new(SIZE, SIZE, 0.0).take(0.0, &mut noise);
    assert_eq!(refine(&mut refiner, &black, &finger), None, "a covered lens");
    let snow = Canvas::new(SIZE, SIZE, 128.0).take(40.0, &mut noise);
    assert_eq!(refine(&mut refiner, &snow, &finger), None, "snow");
    let picture = cone.render(&PLAIN, 1, &flat).take(2.0, &mut noise);
    let far = Axis { anchor: finger.axis.anchor + Vector2::new(500.0, 0.0), ..finger.axis };
    assert_eq!(refine(&mut refiner, &picture, &Finger { axis: far, ..finger }), None, "outside");
    let hidden = Stretch { from_px: 0.0, to_px: 0.0 };
    for flanks in [[hidden, finger.flanks[1]], [finger.flanks[0], hidden], [hidden; 2]] {
        assert_eq!(
            refine(&mut refiner, &picture, &Finger { flanks, ..finger }),
            None,
            "{flanks:?}"
        );
    }
    let closed = Finger { taper: -1.0, ..finger };
    assert_eq!(refine(&mut refiner, &picture, &closed), None, "a taper that closes the finger");
}

#[test]
fn difficult_pictures_give_a_consistent_line_or_none() {
    let (cone, finger, mut noise) = plain();
    let mut refiner = refiner();
    let mut check = |canvas: &Canvas, what: &str| {
        let mut found = 0;
        for _ in 0..12 {
            let picture = canvas.take(2.0, &mut noise);
            let refined = refine(&mut refiner, &picture, &finger);
            assert_consistent(&cone, refined.as_ref(), what);
            found += usize::from(refined.is_some());
        }
        found
    };
    let lit = |contrast: f64| Light { contrast, ..PLAIN };
    assert_eq!(check(&cone.render(&lit(25.0), 1, &flat), "low contrast"), 12);
    check(&cone.render(&lit(12.0), 1, &flat), "hardly any contrast");
    assert_eq!(check(&cone.render(&lit(-50.0), 1, &flat), "a dark finger"), 12);
    check(&cone.render(&lit(230.0), 1, &flat), "a saturated finger");
    let dark_limb = Light { limb: 1.0, ..PLAIN };
    check(&cone.render(&dark_limb, 1, &flat), "limbs as dark as the table");
    let normal = finger.axis.normal();
    let half = |u: f64, v: f64| {
        let side = normal.dot(&(Point2::new(u, v) - finger.axis.anchor));
        if side > 0.0 { TABLE + PLAIN.contrast } else { TABLE }
    };
    check(&cone.render(&PLAIN, 1, &half), "one flank before its own colour");
}

#[test]
fn a_finger_partly_outside_the_picture_is_measured_where_visible() {
    let (cone, finger, mut noise) = plain();
    let canvas = cone.render(&PLAIN, 1, &flat);
    let (mut refiner, mut found) = (refiner(), 0);
    for keep in [100, 80, 70, 64, 58, 50] {
        let whole = canvas.take(2.0, &mut noise);
        let bytes = whole.bytes.chunks(SIZE).flat_map(|row| &row[..keep]).copied().collect();
        let cut = Picture { width: keep, height: SIZE, bytes };
        let refined = refine(&mut refiner, &cut, &finger);
        assert_consistent(&cone, refined.as_ref(), &format!("{keep} columns"));
        found += usize::from(refined.is_some());
    }
    assert!(found >= 2, "{found}");
}

#[test]
fn small_and_large_fingers_are_refined() {
    let mut refiner = refiner();
    for (seed, scale, trials, least) in [(7, 0.5, 12, 0), (8, 4.0, 2, 2)] {
        let mut noise = Noise::new(seed);
        let mut found = 0;
        for _ in 0..trials {
            let cone = Cone::random(&mut noise, 0.1, scale);
            let picture = cone.render(&PLAIN, scale.ceil() as usize, &flat).take(2.0, &mut noise);
            let finger = cone.estimated(&mut noise, 0.2);
            let refined = refine(&mut refiner, &picture, &finger);
            assert_consistent(&cone, refined.as_ref(), &format!("scale {scale}"));
            found += usize::from(refined.is_some_and(|r| r.source == Source::Photometric));
        }
        assert!(found >= least, "{found} of {trials} at {scale}");
    }
}

#[test]
fn invalid_numbers_are_refused() {
    let (_, finger, _) = plain();
    let picture = Canvas::new(SIZE, SIZE, TABLE).take(0.0, &mut Noise::new(0));
    let frame = Frame::gray(picture.view());
    let mut refiner = refiner();
    let mut refused = |finger: Finger| {
        refiner.refine(&frame, &finger, Polarity::Unknown, None, None).unwrap_err()
    };
    let axis = Axis { anchor: Point2::new(f64::NAN, 0.0), ..finger.axis };
    assert!(matches!(refused(Finger { axis, ..finger }), Error::NotFinite { .. }));
    let axis = Axis { angle_rad: f64::INFINITY, ..finger.axis };
    assert!(matches!(refused(Finger { axis, ..finger }), Error::NotFinite { .. }));
    for half_width_px in [0.0, -3.0] {
        let error = refused(Finger { half_width_px, ..finger });
        assert!(
            matches!(error, Error::OutOfRange { value, .. } if value.to_bits() == half_width_px.to_bits())
        );
    }
    assert!(matches!(refused(Finger { taper: f64::NAN, ..finger }), Error::NotFinite { .. }));
    let prior = WidthPrior {
        half_width_px: 7.0,
        taper: 0.0,
        half_width_sigma_px: 0.1,
        taper_sigma: 0.01,
        axis_sigmas: [0.2, 0.01],
    };
    for prior in [
        WidthPrior { half_width_px: f64::NAN, ..prior },
        WidthPrior { taper: f64::INFINITY, ..prior },
        WidthPrior { half_width_sigma_px: 0.0, ..prior },
        WidthPrior { taper_sigma: -0.1, ..prior },
        WidthPrior { axis_sigmas: [0.0, 0.01], ..prior },
        WidthPrior { axis_sigmas: [0.2, f64::NAN], ..prior },
    ] {
        refused(Finger { prior: Some(prior), ..finger });
    }
    let end = Finger { round_end_px: Some(f64::NAN), ..finger };
    assert!(matches!(refused(end), Error::NotFinite { .. }));
    let stretch = Stretch { from_px: f64::NAN, to_px: 1.0 };
    let flanks = [stretch, finger.flanks[1]];
    assert!(matches!(refused(Finger { flanks, ..finger }), Error::NotFinite { .. }));
}

#[test]
fn an_excessive_stretch_is_refused() {
    let (_, finger, _) = plain();
    let picture = Canvas::new(SIZE, SIZE, TABLE).take(0.0, &mut Noise::new(0));
    let frame = Frame::gray(picture.view());
    let mut refiner = refiner();
    let mut measure = |flanks: [Stretch; 2]| {
        let finger = Finger { flanks, ..finger };
        (
            refiner.refine(&frame, &finger, Polarity::Unknown, None, None),
            refiner.bend(&frame, &finger, Polarity::Unknown, None),
        )
    };
    let stretch = |from_px, to_px| Stretch { from_px, to_px };
    let most = stretch(20.0 - MAX_STRETCH_PX, 20.0);
    assert!(measure([most; 2]).0.is_ok() && measure([most; 2]).1.is_ok());
    // Either flank, or both together.
    let [near, far] = [stretch(0.0, 20.0), stretch(-9e4, -8e4)];
    for flanks in [[stretch(-1e8, 20.0), near], [near, stretch(-66e3, 20.0)], [far, near]] {
        let refused = measure(flanks).0.unwrap_err();
        let what = "stretch of the finger [px]";
        assert!(matches!(refused, Error::OutOfRange { what: w, .. } if w == what), "{refused}");
    }
    let refused = measure([stretch(-1e8, 20.0); 2]).1.unwrap_err();
    assert!(matches!(refused, Error::OutOfRange { .. }), "{refused}");
}

#[test]
fn a_background_must_have_the_size_of_the_frame() {
    let (_, finger, _) = plain();
    let numbers = [1.0_f32; 12];
    assert!(matches!(
        KnownBackground::new(&numbers, &numbers[1..], 4, 3),
        Err(Error::WrongCount { given: 11, needed: 12, .. })
    ));
    assert!(KnownBackground::new(&[], &[], 0, 3).is_err());
    let small = KnownBackground::new(&numbers, &numbers, 4, 3).unwrap();
    let picture = Canvas::new(SIZE, SIZE, TABLE).take(0.0, &mut Noise::new(0));
    let frame = Frame::gray(picture.view());
    let refined = refiner().refine(&frame, &finger, Polarity::Unknown, None, Some(&small));
    assert_eq!(
        refined.unwrap_err(),
        Error::BackgroundSize { gray: (SIZE, SIZE), background: (4, 3) }
    );
    let levels = vec![1.0_f32; SIZE * SIZE];
    let known = KnownBackground::new(&levels, &levels, SIZE, SIZE).unwrap();
    let elsewhere = GrayView::new(&[0; 12], 4, 3, 4).unwrap();
    let behind = known.behind(elsewhere);
    let refined = refiner().refine(&frame, &finger, Polarity::Unknown, None, Some(&behind));
    assert_eq!(
        refined.unwrap_err(),
        Error::BackgroundSize { gray: (SIZE, SIZE), background: (4, 3) }
    );
}

#[test]
fn a_background_may_be_behind_another_picture_of_the_scene() {
    let waves = |u: f64, v: f64| TABLE + 60.0 * (u / 4.0).sin() * (v / 5.0).cos();
    let (cone, finger, mut noise) = plain();
    let picture = cone.render(&PLAIN, 1, &|u, v| waves(u, v)).take(2.0, &mut noise);
    let level = |i: usize| waves((i % SIZE) as f64, (i / SIZE) as f64) as f32;
    let (mean, sigma) = ((0..SIZE * SIZE).map(level).collect::<Vec<_>>(), vec![0.4; SIZE * SIZE]);
    let known = KnownBackground::new(&mean, &sigma, SIZE, SIZE).unwrap();
    // In the refined picture the bisector finds the finger, but contrast and noise allow no
    // photometric line.
    let faint = Light { contrast: 12.0, ..PLAIN };
    let mixture = cone.render(&faint, 1, &flat).take(3.0, &mut noise);
    let frame = Frame::gray(mixture.view());
    let refine = |background: &KnownBackground<'_>| {
        let refined = refiner().refine(&frame, &finger, Polarity::Unknown, None, Some(background));
        refined.unwrap().filter(|r| r.source == Source::Photometric)
    };
    assert_eq!(refine(&known), None);
    let refined = refine(&known.behind(picture.view())).unwrap();
    let [offset_px, angle_rad] = cone.error(&refined.axis).into();
    assert!(f64::abs(offset_px) < 0.05, "{offset_px} px");
    assert!(f64::abs(angle_rad) < 0.002, "{angle_rad} rad");
    // The reported noise is that of the picture used for the line.
    assert!((1.6..2.6).contains(&refined.noise_grey), "{}", refined.noise_grey);
}

/// Shifts rows alternately, as through frosted glass, by more than the roughness of real flanks.
fn torn(canvas: &Canvas) -> Canvas {
    let mut torn = canvas.clone();
    for (y, row) in torn.grey.chunks_exact_mut(SIZE).enumerate() {
        let shift_px = 0.6 * (y as f64 * 0.8).sin();
        let at = |x: usize| canvas.grey[y * SIZE + x.clamp(0, SIZE - 1)];
        for (x, grey) in row.iter_mut().enumerate().take(SIZE - 1).skip(1) {
            let next = if shift_px > 0.0 { at(x + 1) } else { at(x - 1) };
            *grey = at(x) + f64::abs(shift_px) * (next - at(x));
        }
    }
    torn
}

#[test]
fn a_line_from_uneven_flanks_is_reported_as_unsure() {
    let (cone, finger, mut noise) = plain();
    let torn = torn(&cone.render(&PLAIN, 1, &flat));
    let picture = torn.take(2.0, &mut noise);
    let refined = refine(&mut refiner(), &picture, &finger).unwrap();
    assert_eq!(refined.source, Source::Unsure, "{:?}", refined.photometric);
    let [offset_px, angle_rad] = cone.error(&refined.axis).into();
    assert!(f64::abs(offset_px) < 0.3 && f64::abs(angle_rad) < 0.02, "{offset_px} {angle_rad}");
    let strict = RefineOptions { max_unsure_edge_px: 1e-3, ..RefineOptions::default() };
    let refined = refine(&mut Refiner::new(strict).unwrap(), &picture, &finger);
    assert!(refined.is_none_or(|r| r.source == Source::Bisector));
}

#[test]
fn a_known_background_improves_the_line_from_uneven_flanks() {
    let (mut noise, mut refiner) = (Noise::new(17), refiner());
    let (mut count, mut squares) = (0, [0.0; 2]);
    for _ in 0..40 {
        let cone = Cone::random(&mut noise, 0.1, 1.0);
        let behind = clutter(&mut noise, 50.0);
        let away = Cone { centres: cone.centres.map(|c| c + Vector3::new(1e4, 0.0, 0.0)), ..cone };
        let picture = torn(&cone.render(&PLAIN, 1, &behind)).take(2.0, &mut noise);
        let empty = torn(&away.render(&PLAIN, 1, &behind));
        let mean: Vec<f32> = empty.grey.iter().map(|g| *g as f32).collect();
        let sigma = vec![0.4; SIZE * SIZE];
        let background = KnownBackground::new(&mean, &sigma, SIZE, SIZE).unwrap();
        let (frame, finger) = (Frame::gray(picture.view()), cone.estimated(&mut noise, 0.3));
        let mut refine = |background| {
            refiner.refine(&frame, &finger, Polarity::Unknown, None, background).unwrap()
        };
        let (Some(known), Some(alone)) = (refine(Some(&background)), refine(None)) else {
            continue;
        };
        if [known.source, alone.source] != [Source::Unsure; 2] {
            continue;
        }
        count += 1;
        for (sum, refined) in squares.iter_mut().zip([known, alone]) {
            *sum += cone.error(&refined.axis).y.powi(2);
        }
    }
    let [known, alone] = squares;
    assert!(count >= 10, "{count} fingers");
    assert!(4.0 * known < alone, "{known} rad² against {alone}");
}

#[test]
fn an_unseen_background_is_not_used() {
    let (cone, finger, mut noise) = plain();
    let picture = cone.render(&PLAIN, 1, &flat).take(2.0, &mut noise);
    let (mean, unseen) = (vec![TABLE as f32; SIZE * SIZE], vec![f32::INFINITY; SIZE * SIZE]);
    let background = KnownBackground::new(&mean, &unseen, SIZE, SIZE).unwrap();
    let frame = Frame::gray(picture.view());
    let refine =
        |background| refiner().refine(&frame, &finger, Polarity::Unknown, None, background);
    assert_eq!(refine(Some(&background)).unwrap(), refine(None).unwrap());
}

/// Refines a finger before the background `shown`, with `known` as the known background.
fn before(
    shown: &dyn Fn(f64, f64) -> f64,
    known: Option<&dyn Fn(f64, f64) -> f64>,
) -> (Cone, Option<Refined>) {
    let (cone, finger, mut noise) = plain();
    let picture = cone.render(&PLAIN, 1, &|u, v| shown(u, v)).take(2.0, &mut noise);
    let mean: Option<Vec<f32>> = known.map(|level| {
        let at = |i: usize| level((i % SIZE) as f64, (i / SIZE) as f64) as f32;
        (0..SIZE * SIZE).map(at).collect()
    });
    let sigma = vec![0.4; SIZE * SIZE];
    let background = mean.as_ref().map(|m| KnownBackground::new(m, &sigma, SIZE, SIZE).unwrap());
    let frame = Frame::gray(picture.view());
    let refined =
        refiner().refine(&frame, &finger, Polarity::Unknown, None, background.as_ref()).unwrap();
    (cone, refined)
}

#[test]
fn a_known_background_may_lie_in_a_shadow() {
    let waves = |u: f64, v: f64| TABLE + 25.0 * (u / 4.0).sin() * (v / 5.0).cos();
    let lit = before(&waves, Some(&waves));
    let shaded = before(&|u, v| 0.7 * waves(u, v), Some(&waves));
    for (cone, refined) in [lit, shaded] {
        let refined = refined.unwrap();
        assert_eq!(refined.source, Source::Photometric);
        let [offset_px, angle_rad] = cone.error(&refined.axis).into();
        assert!(f64::abs(offset_px) < 0.05, "{offset_px} px");
        assert!(f64::abs(angle_rad) < 0.002, "{angle_rad} rad");
    }
}

#[test]
fn a_wrong_background_is_not_used() {
    let stripes = |u: f64, _: f64| if u.rem_euclid(12.0) < 6.0 { 40.0 } else { 130.0 };
    let flat_behind = |_: f64, _: f64| TABLE;
    let (_, known) = before(&flat_behind, Some(&stripes));
    let (_, unknown) = before(&flat_behind, None);
    assert_eq!(known, unknown);
}

#[test]
fn options_out_of_range_are_refused() {
    let refused = |change: &dyn Fn(&mut RefineOptions)| {
        let mut options = RefineOptions::default();
        change(&mut options);
        Refiner::new(options).unwrap_err();
    };
    refused(&|o| o.max_residual = 0.5);
    refused(&|o| o.max_rejected = f64::NAN);
    refused(&|o| o.max_unsure_edge_px = 0.0);
    refused(&|o| o.min_unsure_contrast = 0.0);
    refused(&|o| o.bisector.scale_px = 0.0);
    refused(&|o| o.bisector.min_edges = 2);
    refused(&|o| o.bisector.correlation = 0.5);
    refused(&|o| o.photometric.inner_px = 1.0);
    refused(&|o| o.photometric.cap = 1.0);
    refused(&|o| o.photometric.known_outer_px = 0.0);
    refused(&|o| o.photometric.block_px = 0.0);
    refused(&|o| o.photometric.cutoff = 1.0);
    refused(&|o| o.photometric.bend_px = 0.0);
    refused(&|o| o.photometric.max_iterations = 0);
}

/// A finger of about 14 px, bent in its middle, and the estimate of a tracker that follows its tip.
fn bent_finger(bend_rad: f64, noise: &mut Noise) -> (BentFinger, Finger) {
    let middle = 0.5 * SIZE as f64;
    let finger = BentFinger {
        joint_px: Point2::new(middle + noise.uniform(), middle + noise.uniform()),
        angle_rad: noise.between(0.0, TAU),
        bend_rad,
        length_px: 36.0,
        half_width_px: 7.0,
    };
    // The estimate is a line through both parts at a small bend, and along the tip part at a large
    // one.
    let lag = if bend_rad.abs() < 0.4 { 0.5 } else { 0.0 };
    let angle_rad = finger.angle_rad + (1.0 - lag) * bend_rad;
    let axis = Axis::of_finger(finger.joint_px, angle_rad, 36.0);
    let stretch = Stretch { from_px: -25.0, to_px: 31.0 };
    let flanks = [stretch; 2];
    let estimated = Finger {
        axis,
        half_width_px: 7.2,
        taper: 0.0,
        flanks,
        round_end_px: Some(29.0),
        prior: None,
    };
    (finger, estimated)
}

/// The appearance model of the hand before a uniform background.
fn learned(frame: &Frame<'_>, finger: &BentFinger) -> HistogramModel {
    let mut appearance = HistogramModel::new(false);
    for (x, y) in (0..SIZE).flat_map(|y| (0..SIZE).map(move |x| (x, y))) {
        let (x, y) = (x as f64, y as f64);
        let (depth, _) = finger.depth(Point2::new(x, y));
        if depth.abs() > 2.0 {
            appearance.observe(frame, x, y, depth > 0.0);
        }
    }
    appearance.learn();
    appearance
}

#[test]
fn a_bend_is_measured_correctly() {
    let mut noise = Noise::new(0x6265_6e64);
    let mut refiner = refiner();
    for bend_deg in [-60.0, -45.0, -25.0, -15.0, -5.0, 0.0, 3.0, 10.0, 20.0, 30.0, 50.0, 65.0] {
        for _ in 0..4 {
            let (finger, estimated) = bent_finger(f64::to_radians(bend_deg), &mut noise);
            let canvas = Canvas::new(SIZE, SIZE, TABLE).paint(&finger, TABLE + 80.0).blur(0.96);
            let picture = canvas.take(2.0, &mut noise);
            let frame = Frame::gray(picture.view());
            let appearance = learned(&frame, &finger);
            let bend = refiner
                .bend(&frame, &estimated, Polarity::Bright, Some(&appearance))
                .unwrap()
                .unwrap();
            let error_deg = bend.angle_rad.to_degrees() - bend_deg;
            assert!(error_deg.abs() < 3.0, "{error_deg} at {bend_deg}: {bend:?}");
            assert!((0.0..0.1).contains(&bend.sigma_rad), "{bend:?}");
        }
    }
}

#[test]
fn straight_fingers_have_no_bend_under_any_light() {
    let mut noise = Noise::new(0x7374_7261);
    let mut refiner = refiner();
    let lit = Light { side: 0.3, limb: 0.3, ..PLAIN };
    for (taper, light) in [(0.0, PLAIN), (0.2, PLAIN), (0.1, lit)] {
        for _ in 0..8 {
            let cone = Cone::random(&mut noise, taper, 1.0);
            let picture = cone.render(&light, 1, &|_, _| TABLE).take(2.0, &mut noise);
            let estimated = cone.estimated(&mut noise, 0.3);
            let frame = Frame::gray(picture.view());
            let bend = refiner.bend(&frame, &estimated, Polarity::Bright, None).unwrap().unwrap();
            assert!(bend.angle_rad.abs() < 0.03, "{bend:?} of {cone:?}");
        }
    }
}

#[test]
fn a_finger_with_a_hidden_half_has_no_bend() {
    let mut noise = Noise::new(0x6869_6465);
    let mut refiner = refiner();
    for bend_rad in [0.0, 0.4] {
        let (finger, estimated) = bent_finger(bend_rad, &mut noise);
        // A disc before the knuckle half, as bright as the finger and larger.
        let back = Vector2::new(finger.angle_rad.cos(), finger.angle_rad.sin()) * 16.0;
        let disc = BentFinger {
            joint_px: finger.joint_px - back,
            bend_rad: 0.0,
            length_px: 14.1,
            half_width_px: 14.0,
            ..finger
        };
        let canvas = Canvas::new(SIZE, SIZE, TABLE).paint(&finger, 150.0).paint(&disc, 150.0);
        let picture = canvas.blur(0.96).take(2.0, &mut noise);
        let frame = Frame::gray(picture.view());
        let bend = refiner.bend(&frame, &estimated, Polarity::Bright, None).unwrap();
        assert_eq!(bend, None, "{bend_rad}");
    }
}

/// An occluding disc.
struct Disc {
    middle: Point2<f64>,
    radius_px: f64,
}

impl Shape for Disc {
    fn depth(&self, at: Point2<f64>) -> (f64, Vector2<f64>) {
        let from_middle = at - self.middle;
        let away = from_middle.norm();
        (self.radius_px - away, from_middle / away.max(f64::MIN_POSITIVE))
    }
}

/// A disc before the right (1) or the left (−1) flank of a straight finger.
fn disc_over(finger: &BentFinger, side: f64, along_px: f64, radius_px: f64) -> Disc {
    let (sin, cos) = finger.angle_rad.sin_cos();
    let offset = Vector2::new(-sin, cos) * (side * (finger.half_width_px + 1.0));
    Disc { middle: finger.joint_px + Vector2::new(cos, sin) * along_px + offset, radius_px }
}

#[test]
fn a_partly_occluded_finger_is_refined_by_its_visible_stretches() {
    let mut noise = Noise::new(0x6261_7265);
    let mut refiner = refiner();
    let [mut bare, mut all, mut nees] = [0.0; 3];
    let mut count = 0.0;
    for cover in [20.0, TABLE + 75.0, 200.0, 235.0] {
        for k in 0..12 {
            let (finger, estimated) = bent_finger(0.0, &mut noise);
            let discs = [1.0, -1.0].map(|side| {
                let along_px = side * noise.between(4.0, 16.0);
                disc_over(&finger, side, along_px, noise.between(8.0, 11.0))
            });
            let canvas = Canvas::new(SIZE, SIZE, TABLE).paint(&finger, TABLE + 80.0);
            let whole = canvas.clone().blur(0.96).take(2.0, &mut noise);
            let appearance = learned(&Frame::gray(whole.view()), &finger);
            let picture = discs.iter().fold(canvas, |canvas, disc| canvas.paint(disc, cover));
            let picture = picture.blur(0.96).take(2.0, &mut noise);
            let frame = Frame::gray(picture.view());
            let prior = Some(WidthPrior {
                half_width_px: 7.0 + 0.04 * noise.normal(),
                taper: 0.003 * noise.normal(),
                half_width_sigma_px: 0.04,
                taper_sigma: 0.003,
                axis_sigmas: [0.5, 0.02],
            });
            let mut turned = |finger_of: &Finger| {
                let refined =
                    refiner.refine(&frame, finger_of, Polarity::Bright, Some(&appearance), None);
                refined.unwrap().map(|r| ((r.axis.angle_rad - finger.angle_rad).sin(), r))
            };
            let (turn, refined) = turned(&Finger { prior, ..estimated }).unwrap();
            assert_eq!(refined.source, Source::Photometric, "{cover} {k}");
            let (bare_here, sigma2) = (turn * turn, refined.covariance[(1, 1)]);
            assert!(bare_here < 25.0 * sigma2, "{cover} {k}: {turn} {}", sigma2.sqrt());
            all += turned(&estimated).map_or(0.0, |(turn, _)| turn * turn);
            (bare, nees, count) = (bare + bare_here, nees + bare_here / sigma2, count + 1.0);
        }
    }
    assert!(bare < 0.1 * all, "{} {}", (bare / count).sqrt(), (all / count).sqrt());
    assert!((0.5..2.0).contains(&(nees / count)), "{}", nees / count);
}

#[test]
fn a_taper_that_closes_the_finger_is_no_error() {
    let mut noise = Noise::new(0x7461_7065);
    let mut refiner = refiner();
    let (finger, estimated) = bent_finger(1.0, &mut noise);
    let picture = Canvas::new(SIZE, SIZE, TABLE).paint(&finger, 150.0).take(2.0, &mut noise);
    let frame = Frame::gray(picture.view());
    let appearance = learned(&frame, &finger);
    for taper in [-0.22, -0.15, 0.15, 0.22, 0.27] {
        let tapered = Finger { taper, ..estimated };
        assert!(
            refiner.bend(&frame, &tapered, Polarity::Bright, Some(&appearance)).is_ok(),
            "{taper}"
        );
    }
}
