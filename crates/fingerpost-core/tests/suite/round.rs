//! Round fingers against bodies whose light is worked out from their normals, rendered by supersampling.

use crate::common::Noise;
use fingerpost_core::axis::RoundFinger;
use fingerpost_core::geometry::shape_space::Axis;
use fingerpost_core::image::frame::ColourView;
use fingerpost_core::nalgebra::{Point2, Vector2};
use fingerpost_core::{Error, Frame, GrayView};

const WIDTH: usize = 200;
const HEIGHT: usize = 160;
/// Samples of a pixel along either side.
const FINE: usize = 4;

/// A tapered round body with a round end, lit from one side and a little from everywhere.
#[derive(Debug, Clone, Copy)]
struct Body {
    tip: Point2<f64>,
    angle_rad: f64,
    /// Half its width, 30 px behind the tip, and its growth per px towards that.
    half_width_px: f64,
    taper: f64,
    /// 0 from where it is seen, positive from the side of its normal (−sin, cos).
    light_rad: f64,
    /// Its level without and with the whole of that light.
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
/// As dark as the side of the body that no light reaches.
const TABLE: f64 = 70.0;
const LENGTH_PX: f64 = 60.0;

impl Body {
    fn axis(&self) -> Axis {
        let (sin, cos) = self.angle_rad.sin_cos();
        let anchor = self.tip - Vector2::new(cos, sin) * (0.5 * LENGTH_PX);
        Axis { anchor, tip: self.tip, angle_rad: self.angle_rad }
    }

    /// The level of a point of the body; `None` beside it.
    fn level(&self, at: Point2<f64>) -> Option<f64> {
        let (axis, d) = (self.axis(), at - self.tip);
        let (p, q) = (d.dot(&axis.direction()), d.dot(&axis.normal()));
        let half_width = self.half_width_px + self.taper * (p + 30.0);
        // The end is half a disc, as bright as the body behind it.
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

    /// A picture of it: every pixel the mean of its samples, noise of one grey level added.
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

    /// What edges show of it before a table as dark as its dark side: the line between them, and half
    /// the way from one to the other. The light ends where it runs along the surface, at y = cos φ.
    fn lit_part(&self) -> (Axis, f64) {
        let hidden_px = self.half_width_px * (1.0 - self.light_rad.cos());
        self.seen(0.5 * hidden_px * self.light_rad.signum(), hidden_px)
    }

    /// A line `aside_px` off its axis, and half its width but for what is hidden of its whole width.
    fn seen(&self, aside_px: f64, hidden_px: f64) -> (Axis, f64) {
        let axis = self.axis();
        let moved = axis.normal() * aside_px;
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
fn half_a_finger_tells_where_its_axis_is_and_how_wide_it_is() {
    let mut noise = Noise::new(5);
    for light_rad in [-1.3, -1.1, -0.9, 0.9, 1.1, 1.3] {
        for angle_rad in [-0.7, 0.3, 2.0] {
            let mut body = Body { angle_rad, light_rad, ..BODY };
            // All of it in the picture, whatever its angle.
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
fn a_finger_whose_flanks_both_show_lies_between_them() {
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
fn a_flank_that_only_colours_show_is_seen() {
    // Of three channels that have one mean, two show the dark flank.
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
fn it_is_never_worse_than_the_body_about_the_given_axis() {
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
fn pictures_without_a_finger_have_finite_ones() {
    let (axis, half_width_px) = BODY.seen(0.0, 0.0);
    for pixels in [vec![0; WIDTH * HEIGHT], vec![255; WIDTH * HEIGHT]] {
        let finger = fit(&pixels, (axis, half_width_px));
        assert!(finger.misfit.is_finite() && finger.offset_px.is_finite(), "{finger:?}");
    }
}

#[test]
fn a_finger_that_is_not_all_in_the_picture_is_none() {
    let pixels = BODY.picture(TABLE, &mut Noise::new(1));
    for (u, v) in [(20.0, 80.0), (140.0, 8.0), (140.0, 155.0), (-500.0, 0.0), (1e9, 1e9)] {
        let axis = Axis::of_finger(Point2::new(u, v), 0.0, 30.0);
        assert_eq!(RoundFinger::fit(&frame(&pixels), &axis, 8.0).unwrap(), None, "{u}, {v}");
    }
}

#[test]
fn numbers_that_are_none_are_refused() {
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
