//! The patch is private to the crate; the tests compare its poses with the rendered finger.

use super::*;
use nalgebra::Point2;

pub(crate) const WIDTH: usize = 160;
pub(crate) const HEIGHT: usize = 120;
const LENGTH_PX: f64 = 60.0;
const HALF_WIDTH_PX: f64 = 8.0;

/// A rendered finger of 60 × 16 px before stripes.
#[derive(Clone, Copy)]
pub(crate) struct RenderedFinger {
    pub tip: Point2<f64>,
    pub angle_rad: f64,
    /// Amplitude of the shading across it and the creases along it \[grey levels\]; 0 for a uniform
    /// finger.
    pub texture: f64,
    pub gain: f64,
    /// Angle of its hand relative to it, about the finger's middle; `None` without a hand.
    pub hand_rad: Option<f64>,
    /// Phase of the stripes behind it \[px\].
    pub stripes_px: f64,
    pub noise: f64,
    /// Correlation length of the noise to every side \[px\].
    pub spread_px: usize,
    pub seed: u64,
}

impl RenderedFinger {
    pub(crate) fn at(tip: [f64; 2], angle_rad: f64) -> Self {
        let tip = Point2::from(tip);
        let [texture, gain, stripes_px, noise] = [20.0, 1.0, 0.0, 0.0];
        let (hand_rad, spread_px, seed) = (None, 0, 1);
        Self { tip, angle_rad, texture, gain, hand_rad, stripes_px, noise, spread_px, seed }
    }

    pub(crate) fn axis(&self) -> Axis {
        let back = Axis::of_finger(self.tip, self.angle_rad, 0.0).direction() * 30.0;
        Axis::of_finger(self.tip - back, self.angle_rad, 30.0)
    }

    fn level(&self, x: f64, y: f64) -> f64 {
        let axis = self.axis();
        let from_tip = Point2::new(x, y) - self.tip;
        let (s, d) = (from_tip.dot(&axis.direction()), from_tip.dot(&axis.normal()));
        let outside = d.hypot((s + HALF_WIDTH_PX).max(0.0)) - HALF_WIDTH_PX;
        let depth = (1.0 - (d / HALF_WIDTH_PX).powi(2)).max(0.0).sqrt();
        let texture = self.texture(depth, s, d);
        let behind = 90.0 + 15.0 * (0.4 * (x - 0.5 * y) + self.stripes_px).sin();
        let behind = self.hand(x, y).map_or(behind, |[hand, outside]| {
            behind + (hand - behind) / (1.0 + (2.0 * outside).exp())
        });
        behind + (texture - behind) / (1.0 + (2.0 * outside).exp())
    }

    fn texture(&self, depth: f64, s: f64, d: f64) -> f64 {
        let crease = (0.31 * s + 0.4 * d).sin() + (0.17 * s - 0.25 * d).cos();
        140.0 + self.texture * (depth + 0.5 * crease)
    }

    /// Level of the hand, from 52 px behind the tip and 44 px across, and the distance of a place
    /// outside it.
    fn hand(&self, x: f64, y: f64) -> Option<[f64; 2]> {
        let axis = Axis { angle_rad: self.angle_rad + self.hand_rad?, ..self.axis() };
        let from_middle = Point2::new(x, y) - axis.anchor;
        let (s, d) = (from_middle.dot(&axis.direction()), from_middle.dot(&axis.normal()));
        Some([self.texture(0.5, 1.3 * s, 0.7 * d), (s + 22.0).max(d.abs() - 22.0)])
    }

    pub(crate) fn bytes(&self) -> Vec<u8> {
        let noise = self.unit_noise();
        (0..WIDTH * HEIGHT)
            .map(|i| {
                let level = self.level((i % WIDTH) as f64, (i / WIDTH) as f64);
                (self.gain * level + self.noise * noise[i]).round().clamp(0.0, 255.0) as u8
            })
            .collect()
    }

    /// Noise of unit variance, averaged over its correlation length.
    fn unit_noise(&self) -> Vec<f64> {
        let mut state = self.seed;
        let mut normal = || {
            // Sum of uniforms from a linear congruential generator.
            (0..12).fold(-6.0, |sum, _| {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
                sum + (state >> 40) as f64 / f64::from(1 << 24)
            })
        };
        let white: Vec<f64> = (0..WIDTH * HEIGHT).map(|_| normal()).collect();
        let across = 2 * self.spread_px + 1;
        let first = self.spread_px * (WIDTH + 1);
        let spread = |i: usize| {
            let rows = (0..across).map(|row| i + white.len() - first + row * WIDTH);
            let pixels = rows.flat_map(|row| (row..row + across).map(|k| k % white.len()));
            pixels.map(|k| white[k]).sum::<f64>() / across as f64
        };
        (0..white.len()).map(spread).collect()
    }

    pub(crate) fn show<T>(&self, sample: impl FnOnce(&GrayView<'_>) -> T) -> T {
        sample(&GrayView::new(&self.bytes(), WIDTH, HEIGHT, WIDTH).unwrap())
    }
}

fn drawn_patch(rendered: &RenderedFinger) -> TexturePatch {
    let mut texture = TexturePatch::empty(Area::Finger);
    let has_enough_cells =
        rendered.show(|image| texture.draw(image, &rendered.axis(), HALF_WIDTH_PX, 0.0, LENGTH_PX));
    assert!(has_enough_cells);
    texture
}

/// Error of a pose against the rendered finger: offset at its anchor and angle.
fn pose_error(texture_pose: &TexturePose, rendered: &RenderedFinger) -> [f64; 2] {
    let truth = rendered.axis();
    [
        truth.normal().dot(&(texture_pose.axis.anchor - truth.anchor)),
        texture_pose.axis.angle_rad - truth.angle_rad,
    ]
}

#[test]
fn the_texture_is_found_after_motion_in_another_light() {
    let mut texture = drawn_patch(&RenderedFinger::at([110.0, 70.0], 0.4));
    for (tip, angle_rad, gain) in
        [([110.0, 70.0], 0.4, 1.0), ([112.3, 68.4], 0.43, 1.0), ([90.2, 80.9], 0.9, 0.8)]
    {
        let rendered = RenderedFinger { gain, ..RenderedFinger::at(tip, angle_rad) };
        let near = RenderedFinger::at([tip[0] + 0.5, tip[1] - 1.0], angle_rad - 0.02).axis();
        let texture_pose = rendered.show(|image| texture.find(image, &near)).unwrap();
        let [offset_px, angle] = pose_error(&texture_pose, &rendered);
        assert!(offset_px.abs() < 0.08 && angle.abs() < 0.003, "{tip:?}: {offset_px} {angle}");
        assert!((f64::from(texture_pose.gain) - gain).abs() < 0.05, "{}", texture_pose.gain);
    }
}

#[test]
fn the_texture_is_found_in_four_tenths_of_the_light() {
    let mut texture = drawn_patch(&RenderedFinger::at([110.0, 70.0], 0.4));
    let rendered = RenderedFinger { gain: 0.4, ..RenderedFinger::at([112.3, 68.4], 0.43) };
    let near = RenderedFinger::at([112.8, 67.4], 0.41).axis();
    let texture_pose = rendered.show(|image| texture.find(image, &near)).unwrap();
    let [offset_px, angle] = pose_error(&texture_pose, &rendered);
    assert!(offset_px.abs() < 0.08 && angle.abs() < 0.003, "{offset_px} {angle}");
    assert!((texture_pose.gain - 0.4).abs() < 0.05, "{}", texture_pose.gain);
}

#[test]
fn no_row_of_a_patch_is_wider_than_its_finger() {
    // The shorter a finger is in cells, the nearer its last row is to where a hand would begin.
    for half_width_px in [1.5, 3.0, 8.0, 20.0] {
        for length in [1.0, 3.0, 5.0, 12.0] {
            let rendered = RenderedFinger::at([110.0, 70.0], 0.4);
            let mut texture = TexturePatch::empty(Area::Finger);
            let length_px = length * half_width_px;
            rendered.show(|i| texture.draw(i, &rendered.axis(), half_width_px, 0.0, length_px));
            let widest = texture.used.iter().map(|[from, to]| to - from).max().unwrap();
            let limit = 2.0 * ACROSS * half_width_px / texture.across_px + 1.0;
            assert!(widest as f64 <= limit, "{half_width_px} {length}: {widest} {limit}");
        }
    }
}

#[test]
fn the_variance_grows_as_the_texture_fades() {
    let angle_sigma = |texture: f64| {
        let rendered =
            RenderedFinger { texture, noise: 2.0, ..RenderedFinger::at([110.0, 70.0], 0.4) };
        let mut texture = drawn_patch(&rendered);
        let again = RenderedFinger { seed: 2, ..rendered };
        let texture_pose = again.show(|image| texture.find(image, &rendered.axis())).unwrap();
        texture_pose.covariance[(1, 1)].sqrt()
    };
    let [strong, weak] = [40.0, 10.0].map(angle_sigma);
    assert!(strong < weak && weak < 0.03, "{strong} {weak}");
}

/// Squared errors due to noise, of offset and angle, in units of the reported variances.
fn error_to_variance_ratios(noise: f64, spread_px: usize) -> [f64; 2] {
    let rendered = RenderedFinger { noise, spread_px, ..RenderedFinger::at([110.0, 70.0], 0.4) };
    let mut texture = drawn_patch(&RenderedFinger { noise: 0.0, ..rendered });
    let (mut squares, mut variances) = ([0.0; 2], [0.0; 2]);
    for seed in 1..=60 {
        let rendered = RenderedFinger { seed, ..rendered };
        let texture_pose = rendered.show(|image| texture.find(image, &rendered.axis())).unwrap();
        for (k, error) in pose_error(&texture_pose, &rendered).into_iter().enumerate() {
            squares[k] += error * error;
            variances[k] += texture_pose.covariance[(k, k)];
        }
    }
    [0, 1].map(|k| squares[k] / variances[k])
}

#[test]
fn the_covariance_matches_errors_by_white_noise() {
    for ratio in error_to_variance_ratios(3.0, 0) {
        assert!((0.7..1.0).contains(&ratio), "{ratio}");
    }
}

#[test]
fn the_covariance_covers_errors_by_correlated_noise() {
    for ratio in error_to_variance_ratios(3.0, 1) {
        assert!((0.7..1.3).contains(&ratio), "{ratio}");
    }
}

#[test]
fn conditioning_on_an_angle_equals_a_measurement_of_it() {
    let axis = Axis::of_finger(Point2::new(40.0, 30.0), 0.3, 20.0);
    let covariance = Matrix2::new(0.04, 0.002, 0.002, 4e-4);
    let texture_pose = TexturePose { axis, covariance, gain: 1.0, offset: 0.0 };
    // A further measurement of the angle alone, of the same variance, halves the angle's.
    let (other_rad, other_variance) = (0.33, 4e-4);
    let gain = covariance.column(1) / (covariance[(1, 1)] + other_variance);
    let step = gain * (other_rad - axis.angle_rad);
    let expected = covariance - gain * covariance.row(1);
    let conditioned = texture_pose.turned_to(axis.angle_rad + step.y, expected[(1, 1)]);
    assert!((conditioned.covariance - expected).norm() < 1e-12, "{}", conditioned.covariance);
    let moved = axis.normal().dot(&(conditioned.axis.anchor - axis.anchor));
    assert!((moved - step.x).abs() < 1e-12, "{moved} {}", step.x);
    assert!((conditioned.axis.angle_rad - 0.315).abs() < 1e-12);
    assert!(((conditioned.axis.tip - conditioned.axis.anchor).norm() - 20.0).abs() < 1e-9);
}

#[test]
fn another_texture_is_not_found() {
    let rendered = RenderedFinger::at([110.0, 70.0], 0.4);
    let mut texture = drawn_patch(&rendered);
    for other_tip in [[150.0, 20.0], [40.0, 20.0], [400.0, 300.0]] {
        let elsewhere = RenderedFinger::at(other_tip, -1.2);
        assert!(
            elsewhere.show(|image| texture.find(image, &rendered.axis())).is_none(),
            "{other_tip:?}"
        );
    }
    assert!(rendered.show(|image| texture.find(image, &rendered.axis())).is_some());
    let outside = RenderedFinger::at([-200.0, 70.0], 0.4).axis();
    assert!(rendered.show(|image| texture.find(image, &outside)).is_none());
}

#[test]
fn cells_that_show_the_background_get_a_large_variance() {
    let mut texture = drawn_patch(&RenderedFinger::at([110.0, 70.0], 0.4));
    for k in 1..30 {
        let stripes_px = f64::from(k);
        let rendered =
            RenderedFinger { stripes_px, noise: 1.0, ..RenderedFinger::at([110.0, 70.0], 0.4) };
        let texture_pose = rendered.show(|image| texture.find(image, &rendered.axis())).unwrap();
        texture.learn(&texture_pose);
    }
    let row = texture.rows / 2;
    let [from, to] = texture.used[row];
    let variance = |column: usize| texture.variance[row * texture.columns + column];
    let inside = variance(usize::midpoint(from, to));
    assert!(variance(from) > 4.0 * inside && variance(to - 1) > 4.0 * inside);
}
