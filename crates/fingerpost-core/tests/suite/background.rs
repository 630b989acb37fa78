//! The background before a still camera: learning, foreground, light, shadows and motion.

use crate::common::Noise;
use fingerpost_core::appearance::background::CELL_PX;
use fingerpost_core::appearance::background::options::{BackgroundOptions, KeepOut};
use fingerpost_core::appearance::background::{Background, ForegroundMap};
use fingerpost_core::image::frame::ColourView;
use fingerpost_core::nalgebra::{Point2, Vector2};
use fingerpost_core::{Error, Frame, GrayView};

const WIDTH: usize = 96;
const HEIGHT: usize = 80;
const NOISE: f64 = 2.0;

/// Colours of a table with grain and square markings.
fn table(x: usize, y: usize) -> [f64; 3] {
    let grain = 8.0 * (0.7 * x as f64).sin();
    let mark = if (x / 16 + y / 16).is_multiple_of(2) { 40.0 } else { 0.0 };
    [70.0 + grain + mark, 90.0 + grain + mark, 110.0 + grain + mark]
}

/// A noisy frame of a scene under the light `gain`.
struct Shot {
    grey: Vec<u8>,
    colour: Vec<u8>,
}

impl Shot {
    fn of(scene: impl Fn(usize, usize) -> [f64; 3], gain: f64, noise: &mut Noise) -> Self {
        let (mut grey, mut colour) = (Vec::new(), Vec::new());
        for y in 0..HEIGHT {
            for x in 0..WIDTH {
                let pixel = scene(x, y);
                let mut take = |level: f64| (gain * level + NOISE * noise.normal()).round() as u8;
                grey.push(take(grey_of(pixel)));
                colour.extend(pixel.map(&mut take));
            }
        }
        Self { grey, colour }
    }

    fn with<T>(&self, coloured: bool, then: impl FnOnce(&Frame<'_>) -> T) -> T {
        let grey = GrayView::new(&self.grey, WIDTH, HEIGHT, WIDTH).unwrap();
        if !coloured {
            return then(&Frame::gray(grey));
        }
        let colour = ColourView::new(&self.colour, WIDTH, HEIGHT, 3 * WIDTH).unwrap();
        then(&Frame::coloured(grey, colour).unwrap())
    }
}

fn grey_of([b, g, r]: [f64; 3]) -> f64 {
    0.114 * b + 0.587 * g + 0.299 * r
}

const HAND_COLOUR: [f64; 3] = [110.0, 140.0, 200.0];

/// A square of skin of 24 px, its left edge at `left`.
fn with_hand(left: usize) -> impl Fn(usize, usize) -> [f64; 3] {
    move |x, y| {
        if (left..left + 24).contains(&x) && (30..54).contains(&y) {
            HAND_COLOUR
        } else {
            table(x, y)
        }
    }
}

fn learned(coloured: bool, frames: usize, noise: &mut Noise) -> Background {
    let mut background = Background::new(BackgroundOptions::default()).unwrap();
    for _ in 0..frames {
        let shot = Shot::of(table, 1.0, noise);
        shot.with(coloured, |f| background.observe(f, &[])).unwrap();
    }
    background
}

fn map_of(background: &Background, shot: &Shot, coloured: bool) -> ForegroundMap {
    let mut map = ForegroundMap::default();
    shot.with(coloured, |f| background.foreground_map(f, &mut map));
    map
}

/// Mean likelihood of foreground inside and outside a region.
fn shares(map: &ForegroundMap, inside: impl Fn(usize, usize) -> bool) -> (f64, f64) {
    let mut sums = [(0.0, 0.0); 2];
    for (i, &cell) in map.cells.iter().enumerate() {
        let side = usize::from(inside(i % map.width * map.step, i / map.width * map.step));
        sums[side].0 += f64::from(cell) / 255.0;
        sums[side].1 += 1.0;
    }
    (sums[1].0 / sums[1].1, sums[0].0 / sums[0].1)
}

fn in_hand(left: usize) -> impl Fn(usize, usize) -> bool {
    move |x, y| (left..left + 24).contains(&x) && (30..54).contains(&y)
}

#[test]
fn the_level_is_the_mean_with_its_uncertainty() {
    let mut noise = Noise::new(0x6c65_7665);
    let background = learned(false, 40, &mut noise);
    assert!(background.is_known());
    let mut squares = (0.0, 0.0);
    for y in 0..HEIGHT {
        for x in 0..WIDTH {
            let expected = background.expected(x as f64, y as f64).unwrap();
            let error = expected.grey - grey_of(table(x, y));
            squares.0 += error * error;
            squares.1 += expected.sigma_grey * expected.sigma_grey;
        }
    }
    // The reported variance is the true one to within a third.
    let ratio: f64 = squares.0 / squares.1;
    assert!((0.67..1.5).contains(&ratio), "{ratio}");
    assert!((squares.1 / (WIDTH * HEIGHT) as f64).sqrt() < NOISE / 2.0);
}

#[test]
fn levels_are_interpolated_bilinearly_and_undefined_outside() {
    let ramp: Vec<u8> = (0..64 * 32).map(|i| (2 * (i % 64)) as u8).collect();
    let mut background = Background::new(BackgroundOptions::default()).unwrap();
    for _ in 0..9 {
        let view = GrayView::new(&ramp, 64, 32, 64).unwrap();
        background.observe(&Frame::gray(view), &[]).unwrap();
    }
    for (u, v) in [(0.0, 0.0), (10.25, 3.5), (63.0, 31.0), (62.9, 30.1)] {
        let expected = background.expected(u, v).unwrap();
        assert!((expected.grey - 2.0 * u).abs() < 1e-3, "{u} {v}: {expected:?}");
    }
    for (u, v) in [(-0.1, 3.0), (63.1, 3.0), (3.0, 31.1), (f64::NAN, 3.0)] {
        assert_eq!(background.expected(u, v), None);
    }
}

#[test]
fn a_passing_hand_is_foreground_and_not_learned() {
    for coloured in [false, true] {
        let mut noise = Noise::new(0x7061_7373);
        let mut background = learned(coloured, 12, &mut noise);
        for k in 0..60 {
            let shot = Shot::of(with_hand(k), 1.0, &mut noise);
            shot.with(coloured, |f| background.observe(f, &[])).unwrap();
            let (hand, table) = shares(&map_of(&background, &shot, coloured), in_hand(k));
            assert!(hand > 0.8, "coloured {coloured}, frame {k}: {hand}");
            assert!(table < 0.01, "coloured {coloured}, frame {k}: {table}");
        }
        let expected = background.expected(60.0, 40.0).unwrap();
        assert!((expected.grey - grey_of(table(60, 40))).abs() < 2.0, "{expected:?}");
    }
}

#[test]
fn a_hand_in_the_first_frames_leaves_no_lasting_ghost() {
    let mut noise = Noise::new(0x6768_6f73);
    let mut background = Background::new(BackgroundOptions::default()).unwrap();
    let mut last = None;
    for k in 0..30 {
        let shot = if k < 3 {
            Shot::of(with_hand(30), 1.0, &mut noise)
        } else {
            Shot::of(table, 1.0, &mut noise)
        };
        shot.with(true, |f| background.observe(f, &[])).unwrap();
        last = Some(shot);
    }
    let (ghost, _) = shares(&map_of(&background, &last.unwrap(), true), in_hand(30));
    assert!(ghost < 0.05, "{ghost}");
}

#[test]
fn a_new_object_is_absorbed_after_a_fixed_time_at_any_age_of_the_background() {
    let absorb = BackgroundOptions::default().absorb_frames;
    for frames in [20, absorb, 2 * absorb] {
        let mut noise = Noise::new(0x7075_7464);
        let mut background = learned(true, frames, &mut noise);
        let mut seen = Vec::new();
        for _ in 0..2 * absorb {
            let shot = Shot::of(with_hand(40), 1.0, &mut noise);
            shot.with(true, |f| background.observe(f, &[])).unwrap();
            seen.push(shares(&map_of(&background, &shot, true), in_hand(40)).0);
        }
        // A background of few frames changes sooner.
        let kept = if frames < absorb { 10 } else { absorb * 2 / 3 };
        assert!(seen[kept] > 0.9, "after {frames}: {}", seen[kept]);
        let late = absorb + absorb / 3;
        assert!(seen[late] < 0.05, "after {frames}: {}", seen[late]);
    }
}

#[test]
fn a_forgotten_region_is_relearned_at_once() {
    let mut noise = Noise::new(0x666f_7267);
    let mut background = learned(true, 2 * BackgroundOptions::default().absorb_frames, &mut noise);
    let part =
        KeepOut { from: Point2::new(20.0, 30.0), to: Point2::new(60.0, 48.0), radius_px: 9.0 };
    background.forget(&part).unwrap();
    assert_eq!(background.expected(40.0, 39.0), None);
    // Every fourth pair of rows is visited four times.
    for _ in 0..16 {
        let shot = Shot::of(table, 1.0, &mut noise);
        shot.with(true, |f| background.observe(f, &[])).unwrap();
    }
    assert!(background.expected(40.0, 39.0).is_some());
}

#[test]
fn images_of_odd_sizes_are_learned_outside_the_kept_out_region() {
    for (width, height) in [(1, 1), (7, 5), (33, 3)] {
        let (grey, colour) = (vec![90; width * height], vec![80; 3 * width * height]);
        let end = Point2::new(width as f64, height as f64);
        for kept_px in [0.6, 3.0, 100.0] {
            let keep_out = KeepOut { from: end, to: end, radius_px: kept_px };
            let mut background = Background::new(BackgroundOptions::default()).unwrap();
            let view = GrayView::new(&grey, width, height, width).unwrap();
            let colours = ColourView::new(&colour, width, height, 3 * width).unwrap();
            let frame = Frame::coloured(view, colours).unwrap();
            for _ in 0..12 {
                background.observe(&frame, &[keep_out]).unwrap();
            }
            let known = background.expected(0.0, 0.0).is_some();
            assert_eq!(known, end.coords.norm() > kept_px, "{width} × {height}, {kept_px} px");
        }
    }
}

#[test]
fn a_kept_out_hand_is_never_learned() {
    let mut noise = Noise::new(0x6b65_6570);
    let keep_out =
        KeepOut { from: Point2::new(20.0, 30.0), to: Point2::new(60.5, 48.2), radius_px: 11.3 };
    let mut background = Background::new(BackgroundOptions::default()).unwrap();
    for _ in 0..40 {
        let shot = Shot::of(with_hand(30), 1.0, &mut noise);
        shot.with(true, |f| background.observe(f, &[keep_out])).unwrap();
    }
    let along = keep_out.to - keep_out.from;
    // Forgetting the region later has the same effect.
    let mut forgotten = learned(true, 40, &mut noise);
    forgotten.forget(&keep_out).unwrap();
    for y in 0..HEIGHT {
        for x in 0..WIDTH {
            let d = Point2::new(x as f64, y as f64) - keep_out.from;
            let part = (d.dot(&along) / along.norm_squared()).clamp(0.0, 1.0);
            let distance = (d - along * part).norm();
            if (distance - keep_out.radius_px).abs() > 1e-6 {
                let known = background.expected(x as f64, y as f64).is_some();
                assert_eq!(known, distance > keep_out.radius_px, "({x}, {y})");
                assert_eq!(forgotten.expected(x as f64, y as f64).is_some(), known, "({x}, {y})");
            }
        }
    }
}

#[test]
fn nothing_is_learned_in_the_union_of_regions() {
    let mut noise = Noise::new(0x756e_696f);
    let disc = |u: f64, v: f64, radius_px: f64| {
        let at = Point2::new(u, v);
        KeepOut { from: at, to: at, radius_px }
    };
    // Apart, overlapping, one within another, across the edge, and outside the image.
    let discs = [
        disc(70.3, 20.6, 6.2),
        disc(20.2, 30.1, 9.7),
        disc(31.4, 33.8, 8.1),
        disc(19.1, 29.3, 3.4),
        disc(-1.2, 2.3, 5.3),
        disc(-40.0, -40.0, 7.0),
    ];
    let mut background = Background::new(BackgroundOptions::default()).unwrap();
    for _ in 0..12 {
        let shot = Shot::of(table, 1.0, &mut noise);
        shot.with(true, |f| background.observe(f, &discs)).unwrap();
    }
    for y in 0..HEIGHT {
        for x in 0..WIDTH {
            let place = Point2::new(x as f64, y as f64);
            let outside = discs.iter().all(|d| (place - d.from).norm() > d.radius_px);
            assert_eq!(background.expected(place.x, place.y).is_some(), outside, "({x}, {y})");
        }
    }
}

#[test]
fn the_light_may_drop_by_forty_percent_during_a_hand() {
    for coloured in [false, true] {
        let mut noise = Noise::new(0x6c69_6768);
        let mut background = learned(coloured, 12, &mut noise);
        for k in 0..10 {
            let shot = Shot::of(with_hand(20 + k), 0.6, &mut noise);
            shot.with(coloured, |f| background.observe(f, &[])).unwrap();
            let light = background.light();
            assert!((light.gain - 0.6).abs() < 0.02, "{light:?}");
            assert!(light.offset_grey.abs() < 2.0, "{light:?}");
            let (hand, table) = shares(&map_of(&background, &shot, coloured), in_hand(20 + k));
            assert!(hand > 0.8 && table < 0.01, "coloured {coloured}: {hand} {table}");
        }
        let expected = background.expected(5.0, 5.0).unwrap();
        assert!((expected.grey - 0.6 * grey_of(table(5, 5))).abs() < 1.5, "{expected:?}");
    }
}

#[test]
fn a_shadow_is_distinguished_from_a_hand_by_its_hue() {
    let mut noise = Noise::new(0x7368_6164);
    let background = learned(true, 12, &mut noise);
    let shaded =
        |x: usize, y: usize| table(x, y).map(|c| if in_hand(20)(x, y) { 0.6 * c } else { c });
    let shot = Shot::of(shaded, 1.0, &mut noise);
    let (shadow, _) = shares(&map_of(&background, &shot, true), in_hand(20));
    // A hand as dark as the shadow, but of another colour.
    let dark = |x: usize, y: usize| {
        let [b, g, r] = table(x, y);
        if in_hand(20)(x, y) { [0.45 * b, 0.55 * g, 0.75 * r] } else { [b, g, r] }
    };
    let shot = Shot::of(dark, 1.0, &mut noise);
    let (hand, _) = shares(&map_of(&background, &shot, true), in_hand(20));
    assert!(shadow < 0.65, "{shadow}");
    assert!(hand > 0.9, "{hand}");
}

#[test]
fn a_moving_camera_voids_the_background_and_a_still_one_relearns_it() {
    let mut noise = Noise::new(0x6d6f_7665);
    let mut background = learned(false, 20, &mut noise);
    let moved = |k: usize| move |x: usize, y: usize| table(x + 3 * k, y + k);
    for k in 1..6 {
        let shot = Shot::of(moved(k), 1.0, &mut noise);
        shot.with(false, |f| background.observe(f, &[])).unwrap();
        assert!(!background.is_known(), "frame {k}: {}", background.changed_share());
        assert_eq!(shares(&map_of(&background, &shot, false), |_, y| y < 40), (0.0, 0.0));
    }
    for _ in 0..20 {
        let shot = Shot::of(moved(5), 1.0, &mut noise);
        shot.with(false, |f| background.observe(f, &[])).unwrap();
    }
    assert!(background.is_known());
    let expected = background.expected(30.0, 30.0).unwrap();
    assert!((expected.grey - grey_of(table(45, 35))).abs() < 2.0, "{expected:?}");
}

#[test]
fn looking_then_learning_equals_observing() {
    let mut noise = Noise::new(0x6c6f_6f6b);
    let mut looked = learned(false, 20, &mut noise);
    let mut observed = looked.clone();
    for k in 0..8 {
        let shot = Shot::of(with_hand(10 + k), 0.8, &mut noise);
        let before = looked.expected(5.0, 5.0).unwrap();
        shot.with(false, |f| looked.look(f));
        assert!((looked.light().gain - 0.8).abs() < 0.02);
        // The expected level is the known one under the light of this frame.
        let now = looked.expected(5.0, 5.0).unwrap();
        assert!(k > 0 || (now.grey - 0.8 * before.grey).abs() < 2.0, "{before:?} {now:?}");
        shot.with(false, |f| looked.learn(f, &[])).unwrap();
        shot.with(false, |f| observed.observe(f, &[])).unwrap();
        assert_eq!(looked.expected(50.3, 30.6), observed.expected(50.3, 30.6));
    }
}

#[test]
fn a_subpixel_shift_is_detected_and_learned() {
    // Gradients of 8 grey levels per pixel, smooth enough for any subpixel shift.
    let waves = |du: f64| {
        move |x: usize, y: usize| {
            let (u, v) = (x as f64 + du, y as f64 - 0.5 * du);
            [120.0 + 40.0 * (u / 5.0).sin() + 40.0 * (v / 5.0).cos(); 3]
        }
    };
    let mut noise = Noise::new(0x6275_6d70);
    let mut background = Background::new(BackgroundOptions::default()).unwrap();
    let mut show = |du: f64, background: &mut Background| {
        let shot = Shot::of(waves(du), 1.0, &mut noise);
        shot.with(false, |f| background.observe(f, &[])).unwrap();
    };
    for _ in 0..30 {
        show(0.0, &mut background);
    }
    assert!(background.is_exact(), "{:?}", background.shift_px());
    for du in [0.3, -0.4, 0.6] {
        let mut bumped = background.clone();
        show(du, &mut bumped);
        let shift = bumped.shift_px().unwrap();
        // The scene moves opposite to the camera; the estimate is linear in the gradient.
        assert!((shift.x + du).abs() < 0.1 && (shift.y - 0.5 * du).abs() < 0.1, "{du}: {shift:?}");
        assert!(!bumped.is_exact());
        for _ in 0..60 {
            show(du, &mut bumped);
        }
        assert!(bumped.is_exact(), "{du}: {:?}", bumped.shift_px());
    }
}

#[test]
fn parallel_edges_determine_no_shift_along_them() {
    // Vertical and oblique stripes; only the shift across them is observable.
    for (per_px, tilt) in [(0.2, 0.0), (0.3, 0.0), (0.25, 0.35)] {
        let stripes = |du: f64| {
            move |x: usize, y: usize| {
                [110.0 + 40.0 * (per_px * (x as f64 + du + tilt * y as f64)).sin(); 3]
            }
        };
        let mut noise = Noise::new(0x6261_7273);
        let mut background = Background::new(BackgroundOptions::default()).unwrap();
        let mut show = |du: f64, background: &mut Background| {
            let shot = Shot::of(stripes(du), 1.0, &mut noise);
            shot.with(false, |f| background.observe(f, &[])).unwrap();
        };
        for k in 0..300 {
            show(0.0, &mut background);
            if background.is_known() {
                assert!(background.is_exact(), "{per_px}, frame {k}: {:?}", background.shift_px());
            }
        }
        show(0.5, &mut background);
        let shift = background.shift_px().unwrap();
        // The stripes move opposite to the camera; only the component across them is observable.
        let across = Vector2::new(1.0, tilt) / (1.0 + tilt * tilt);
        assert!((shift + 0.5 * across).norm() < 0.1, "{per_px}: {shift:?}");
        assert!(!background.is_exact());
    }
}

#[test]
fn a_uniform_background_determines_no_shift() {
    let mut background = Background::new(BackgroundOptions::default()).unwrap();
    let pixels = [90; 64 * 48];
    for _ in 0..20 {
        let frame = Frame::gray(GrayView::new(&pixels, 64, 48, 64).unwrap());
        background.observe(&frame, &[]).unwrap();
    }
    assert_eq!(background.shift_px(), None);
    assert!(background.is_exact());
}

#[test]
fn a_single_bright_frame_is_no_motion() {
    let mut noise = Noise::new(0x666c_6173);
    let mut background = learned(false, 20, &mut noise);
    let flash = Shot::of(|x, y| [((x * 37 + y * 91) % 200) as f64; 3], 1.0, &mut noise);
    flash.with(false, |f| background.observe(f, &[])).unwrap();
    for _ in 0..2 {
        let shot = Shot::of(table, 1.0, &mut noise);
        shot.with(false, |f| background.observe(f, &[])).unwrap();
    }
    assert!(background.is_known());
    let expected = background.expected(30.0, 30.0).unwrap();
    assert!((expected.grey - grey_of(table(30, 30))).abs() < 3.0, "{expected:?}");
}

#[test]
fn the_map_covers_images_of_any_size() {
    for (width, height) in [(1, 1), (2, 1), (7, 5), (33, 1)] {
        let pixels = vec![90; width * height];
        let mut background = Background::new(BackgroundOptions::default()).unwrap();
        let mut map = ForegroundMap::default();
        for _ in 0..20 {
            let frame = Frame::gray(GrayView::new(&pixels, width, height, width).unwrap());
            background.observe(&frame, &[]).unwrap();
            background.foreground_map(&frame, &mut map);
        }
        assert_eq!((map.width, map.height), (width.div_ceil(CELL_PX), height.div_ceil(CELL_PX)));
        assert!(map.cells.iter().all(|&c| c == 0));
        assert!((background.expected(0.0, 0.0).unwrap().grey - 90.0).abs() < 1e-3);
    }
}

#[test]
fn a_new_image_size_restarts_the_learning() {
    let mut noise = Noise::new(0x7369_7a65);
    let mut background = learned(false, 20, &mut noise);
    let pixels = [10; 30];
    background.observe(&Frame::gray(GrayView::new(&pixels, 6, 5, 6).unwrap()), &[]).unwrap();
    assert!(!background.is_known());
    assert_eq!(background.expected(20.0, 20.0), None);
}

#[test]
fn options_out_of_range_are_refused() {
    let usual = BackgroundOptions::default();
    for wrong in [
        BackgroundOptions { learn_frames: 0, ..usual },
        BackgroundOptions { rate: 0.0, ..usual },
        BackgroundOptions { absorb_frames: 3, ..usual },
        BackgroundOptions { noise_grey: f64::NAN, ..usual },
        BackgroundOptions { changed_sigmas: 0.5, ..usual },
        BackgroundOptions { shadow_light: 1.1, ..usual },
        BackgroundOptions { void_share: -0.1, ..usual },
    ] {
        assert!(Background::new(wrong).is_err(), "{wrong:?}");
    }
    let mut background = Background::new(usual).unwrap();
    let pixels = [10; 30];
    let frame = Frame::gray(GrayView::new(&pixels, 6, 5, 6).unwrap());
    let at = Point2::new(1.0, 1.0);
    let keep_out = KeepOut { from: at, to: at, radius_px: 0.0 };
    let refused = background.observe(&frame, &[keep_out]);
    assert!(matches!(refused, Err(Error::OutOfRange { .. })), "{refused:?}");
    let keep_out = KeepOut { from: at, to: Point2::new(f64::NAN, 0.0), radius_px: 2.0 };
    assert!(background.observe(&frame, &[keep_out]).is_err());
}
