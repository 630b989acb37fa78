//! Round fingers fitted to bodies shaded by their normals and rendered by supersampling.

use crate::common::Noise;
use fingerpost_core::axis::RoundFinger;
use fingerpost_core::geometry::shape_space::Axis;
use fingerpost_core::image::frame::ColourView;
use fingerpost_core::nalgebra::{Point2, Vector2};
use fingerpost_core::{Error, Frame, GrayView};

const WIDTH: usize = 200;
const HEIGHT: usize = 160;
/// Samples per pixel in each direction.
const FINE: usize = 4;

/// A tapered round body with a round end, under directional and ambient light.
#[derive(Debug, Clone, Copy)]
struct Body {
    tip: Point2<f64>,
    angle_rad: f64,
    /// Half the width 30 px behind the tip, and its growth per px towards the tip.
    half_width_px: f64,
    taper: f64,
    /// Direction of the light: 0 from the viewer, positive from the side of the normal (−sin, cos).
    light_rad: f64,
    /// Grey levels without and with the full directional light.
    levels: [f64; 2],
}

const BODY: Body = Body {
    tip: Point2::new(140.0, 90.0),
    angle_rad: 0.3,
    half_width_px: 8.0,
    taper: -0.05,
    light_rad: -0.9,
    levels: [70.0, 170.0],
};
/// As dark as the unlit side of the body.
const TABLE: f64 = 70.0;
const LENGTH_PX: f64 = 60.0;

impl Body {
    fn axis(&self) -> Axis {
        let (sin, cos) = self.angle_rad.sin_cos();
        let anchor = self.tip - Vector2::new(cos, sin) * (0.5 * LENGTH_PX);
        Axis { anchor, tip: self.tip, angle_rad: self.angle_rad }
    }

    /// Grey level at a point; `None` outside the body.
    fn level(&self, at: Point2<f64>) -> Option<f64> {
        let (axis, d) = (self.axis(), at - self.tip);
        let (p, q) = (d.dot(&axis.direction()), d.dot(&axis.normal()));
        let half_width = self.half_width_px + self.taper * (p + 30.0);
        // The end is a half disc, shaded like the body behind it.
        let beyond = (p + half_width).max(0.0);
        let y = q / half_width;
        let z_squared = 1.0 - y * y - (beyond / half_width).powi(2);
        if z_squared < 0.0 {
            return None;
        }
        let light = y * self.light_rad.sin() + z_squared.sqrt() * self.light_rad.cos();
        let [dark, lit] = self.levels;
        Some(dark + (lit - dark) * light.max(0.0))
    }

    /// A picture: every pixel is the mean of its samples, with noise of one grey level.
    fn picture(&self, table: f64, noise: &mut Noise) -> Vec<u8> {
        let sample = |x: usize, i: usize| x as f64 + (i as f64 + 0.5) / FINE as f64 - 0.5;
        let pixel = |k: usize| {
            let mut sum = 0.0;
            for i in 0..FINE * FINE {
                let at = Point2::new(sample(k % WIDTH, i % FINE), sample(k / WIDTH, i / FINE));
                sum += self.level(at).unwrap_or(table);
            }
            (sum / (FINE * FINE) as f64 + noise.normal()).round().clamp(0.0, 255.0) as u8
        };
        (0..WIDTH * HEIGHT).map(pixel).collect()
    }

    /// Axis and half-width of the part with visible edges before a table as dark as the unlit side.
    /// The light ends where it is tangential to the surface, at y = cos φ.
    fn lit_part(&self) -> (Axis, f64) {
        let hidden_px = self.half_width_px * (1.0 - self.light_rad.cos());
        self.seen(0.5 * hidden_px * self.light_rad.signum(), hidden_px)
    }

    /// A line at an offset from the axis, and half of the visible width.
    fn seen(&self, offset_px: f64, hidden_px: f64) -> (Axis, f64) {
        let axis = self.axis();
        let moved = axis.normal() * offset_px;
        let axis = Axis { anchor: axis.anchor + moved, tip: axis.tip + moved, ..axis };
        (axis, self.half_width_px - 0.5 * hidden_px)
    }
}

fn frame(pixels: &[u8]) -> Frame<'_> {
    Frame::gray(GrayView::new(pixels, WIDTH, HEIGHT, WIDTH).unwrap())
}

fn fit(pixels: &[u8], (axis, half_width_px): (Axis, f64)) -> RoundFinger {
    RoundFinger::fit(&frame(pixels), &axis, half_width_px).unwrap().expect("all in the picture")
}

#[test]
fn the_lit_half_of_a_finger_determines_its_axis_and_width() {
    let mut noise = Noise::new(5);
    for light_rad in [-1.3, -1.1, -0.9, 0.9, 1.1, 1.3] {
        for angle_rad in [-0.7, 0.3, 2.0] {
            let mut body = Body { angle_rad, light_rad, ..BODY };
            // The whole body is in the picture at any angle.
            body.tip = Point2::new(100.0, 80.0) + body.axis().direction() * 30.0;
            let (axis, shown_px) = body.lit_part();
            let finger = fit(&body.picture(TABLE, &mut noise), (axis, shown_px));
            let offset_px = (body.axis().anchor - axis.anchor).dot(&axis.normal());
            let what = format!("light {light_rad}, angle {angle_rad}, {offset_px}: {finger:?}");
            assert!((finger.offset_px - offset_px).abs() < 0.7, "{what}");
            assert!((finger.half_width_px - body.half_width_px).abs() < 0.8, "{what}");
            assert!(finger.turn_rad.abs() < 0.02, "{what}");
            assert!(finger.misfit_about_given > 1.3 * finger.misfit, "{what}");
        }
    }
}

#[test]
fn a_finger_with_two_visible_flanks_lies_between_them() {
    let mut noise = Noise::new(7);
    for light_rad in [-0.9, 0.0, 0.5] {
        for table in [20.0, 220.0] {
            let body = Body { light_rad, ..BODY };
            let finger = fit(&body.picture(table, &mut noise), body.seen(0.0, 0.0));
            let what = format!("light {light_rad}, table {table}: {finger:?}");
            assert!(finger.offset_px.abs() < 0.2, "{what}");
            assert!(finger.turn_rad.abs() < 0.01, "{what}");
            assert!((finger.half_width_px - body.half_width_px).abs() < 0.4, "{what}");
        }
    }
}

#[test]
fn a_flank_visible_in_colour_only_is_found() {
    // Two of three channels with equal means have contrast at the dark flank.
    let mut noise = Noise::new(11);
    let channels = [[40.0, 110.0], [100.0, 30.0], [70.0, 70.0]].map(|[dark, table]| {
        Body { levels: [dark, dark + 100.0], ..BODY }.picture(table, &mut noise)
    });
    let colours: Vec<u8> =
        (0..WIDTH * HEIGHT).flat_map(|k| [0, 1, 2].map(|c: usize| channels[c][k])).collect();
    let colour = ColourView::new(&colours, WIDTH, HEIGHT, 3 * WIDTH).unwrap();
    let grey = BODY.picture(TABLE, &mut noise);
    let frame =
        Frame::coloured(GrayView::new(&grey, WIDTH, HEIGHT, WIDTH).unwrap(), colour).unwrap();
    let (axis, half_width_px) = BODY.seen(-2.5, 5.0);
    let finger = RoundFinger::fit(&frame, &axis, half_width_px).unwrap().unwrap();
    assert!((finger.offset_px - 2.5).abs() < 0.15, "{finger:?}");
    assert!((finger.half_width_px - BODY.half_width_px).abs() < 0.3, "{finger:?}");
}

#[test]
fn the_fit_is_never_worse_than_the_body_about_the_given_axis() {
    let mut noise = Noise::new(13);
    for k in 0..40 {
        let body = Body {
            light_rad: noise.between(-1.5, 1.5),
            taper: noise.between(-0.1, 0.05),
            levels: [noise.between(0.0, 120.0), noise.between(120.0, 250.0)],
            ..BODY
        };
        let pixels = body.picture(noise.between(0.0, 255.0), &mut noise);
        let seen = body.seen(noise.between(-4.0, 4.0), noise.between(0.0, 7.0));
        let finger = fit(&pixels, seen);
        let numbers = [finger.offset_px, finger.turn_rad, finger.half_width_px, finger.misfit];
        assert!(numbers.iter().all(|x| x.is_finite()), "{k}: {finger:?}");
        assert!(finger.half_width_px > 0.0 && finger.misfit >= 0.0, "{k}: {finger:?}");
        assert!(finger.misfit <= finger.misfit_about_given, "{k}: {finger:?}");
        assert_eq!(finger, fit(&pixels, seen), "{k}: the same pixels, the same finger");
    }
}

#[test]
fn pictures_without_a_finger_give_finite_results() {
    let (axis, half_width_px) = BODY.seen(0.0, 0.0);
    for pixels in [vec![0; WIDTH * HEIGHT], vec![255; WIDTH * HEIGHT]] {
        let finger = fit(&pixels, (axis, half_width_px));
        assert!(finger.misfit.is_finite() && finger.offset_px.is_finite(), "{finger:?}");
    }
}

#[test]
fn a_finger_partly_outside_the_picture_gives_none() {
    let pixels = BODY.picture(TABLE, &mut Noise::new(1));
    for (u, v) in [(20.0, 80.0), (140.0, 8.0), (140.0, 155.0), (-500.0, 0.0), (1e9, 1e9)] {
        let axis = Axis::of_finger(Point2::new(u, v), 0.0, 30.0);
        assert_eq!(RoundFinger::fit(&frame(&pixels), &axis, 8.0).unwrap(), None, "{u}, {v}");
    }
}

#[test]
fn invalid_numbers_are_refused() {
    let pixels = BODY.picture(TABLE, &mut Noise::new(1));
    let (axis, half_width_px) = BODY.seen(0.0, 0.0);
    let refused = |axis: Axis, half_width_px: f64| {
        RoundFinger::fit(&frame(&pixels), &axis, half_width_px).unwrap_err()
    };
    for half_width_px in [0.0, -3.0] {
        assert!(matches!(refused(axis, half_width_px), Error::OutOfRange { .. }));
    }
    assert!(matches!(refused(axis, f64::NAN), Error::NotFinite { .. }));
    let nowhere = Axis { anchor: Point2::new(f64::NAN, 0.0), ..axis };
    assert!(matches!(refused(nowhere, half_width_px), Error::NotFinite { .. }));
    let pointless = Axis { tip: axis.anchor, ..axis };
    assert!(matches!(refused(pointless, half_width_px), Error::OutOfRange { .. }));
    let unturned = Axis { angle_rad: f64::INFINITY, ..axis };
    assert!(matches!(refused(unturned, half_width_px), Error::NotFinite { .. }));
}
