//! Candidates for hands: the true finger is among the first ones at any place, size and appearance.

use crate::common::{Canvas, HalfPlane, Hand, Noise, Picture};
use fingerpost_core::appearance::background::Background;
use fingerpost_core::appearance::background::options::BackgroundOptions;
use fingerpost_core::detect::candidates::{Candidate, FinderOptions, HandFinder};
use fingerpost_core::geometry::template::Thumb;
use fingerpost_core::image::frame::ColourView;
use fingerpost_core::nalgebra::{self, Point2};
use fingerpost_core::{Frame, GrayView};
use std::f64::consts::{PI, TAU};

const WIDTH: usize = 320;
const HEIGHT: usize = 240;
const TABLE: f64 = 70.0;

fn canvas() -> Canvas {
    Canvas::new(WIDTH, HEIGHT, TABLE)
}

/// A hand with its fist; a finger alone has two ends that resemble tips.
fn with_hand(canvas: Canvas, hand: &Hand, grey: f64) -> Canvas {
    let fist = Hand {
        tip_px: hand.tip_px - hand.direction() * (0.75 * hand.length_px),
        half_width_px: 0.35 * hand.length_px,
        thumb: None,
        ..*hand
    };
    canvas.paint(&fist, grey).paint(hand, grey)
}

fn finder() -> HandFinder {
    // The hand is large relative to the image.
    let options = FinderOptions { max_half_width: 0.05, ..FinderOptions::default() };
    HandFinder::new(options).unwrap()
}

fn found(picture: &Picture) -> Vec<Candidate> {
    finder().find(&picture.view().into(), None).to_vec()
}

/// Rank of the first candidate close enough to the hand for a fit to converge.
fn rank(candidates: &[Candidate], hand: &Hand) -> Option<usize> {
    candidates.iter().position(|c| {
        let turned = (c.angle_rad - hand.angle_rad + PI).rem_euclid(TAU) - PI;
        (c.tip_px - hand.tip_px).norm() < 1.5 * hand.half_width_px
            && turned.abs() < 0.3
            && (0.7..1.4).contains(&(c.half_width_px / hand.half_width_px))
    })
}

/// A hand of a random usual size at a random place in the image.
fn any_hand(thumb: Thumb, noise: &mut Noise) -> Hand {
    let length_px = noise.between(45.0, 90.0);
    let tip = Point2::new(noise.between(60.0, 260.0), noise.between(60.0, 180.0));
    Hand::usual(thumb, tip, noise.between(-PI, PI), length_px)
}

#[test]
fn a_finger_is_found_at_any_place_angle_and_size() {
    let mut noise = Noise::new(0x616e_7977);
    for k in 0..30 {
        let hand = any_hand(Thumb::None, &mut noise);
        for grey in [TABLE + 60.0, TABLE - 50.0] {
            let picture = with_hand(canvas(), &hand, grey).blur(0.9).take(2.0, &mut noise);
            let candidates = found(&picture);
            let place = rank(&candidates, &hand);
            assert!(place.is_some_and(|k| k < 3), "{k}, {grey}: {place:?} {hand:?} {candidates:?}");
        }
    }
}

#[test]
fn the_side_of_the_thumb_is_identified() {
    let mut noise = Noise::new(0x7468_756d);
    let mut correct = 0;
    for k in 0..20 {
        let thumb = if k % 2 == 0 { Thumb::Left } else { Thumb::Right };
        let hand = any_hand(thumb, &mut noise);
        let picture = with_hand(canvas(), &hand, 150.0).blur(0.9).take(2.0, &mut noise);
        let candidates = found(&picture);
        let place = rank(&candidates, &hand).expect("the finger is a candidate");
        assert!(place < 3, "{k}: {place}");
        correct += usize::from(candidates[place].thumb == thumb);
    }
    assert!(correct >= 17, "{correct} of 20");
}

#[test]
fn a_table_edge_behind_the_finger_does_not_prevent_detection() {
    let mut noise = Noise::new(0x6564_6765);
    for k in 0..20 {
        let hand = any_hand(Thumb::None, &mut noise);
        let edge = HalfPlane::beyond(hand.tip_px, noise.between(-PI, PI), -25.0);
        // The background is brighter than the finger on one side, darker on the other.
        let scene = with_hand(canvas().paint(&edge, 210.0), &hand, 140.0);
        let picture = scene.blur(0.9).take(2.0, &mut noise);
        let candidates = found(&picture);
        let place = rank(&candidates, &hand);
        assert!(place.is_some_and(|place| place < 4), "{k}: {place:?}");
    }
}

#[test]
fn an_empty_table_has_no_candidates() {
    let mut noise = Noise::new(0x656d_7074);
    let edge = HalfPlane::beyond(Point2::new(160.0, 120.0), 0.4, 0.0);
    for picture in
        [canvas().take(2.0, &mut noise), canvas().paint(&edge, 180.0).take(2.0, &mut noise)]
    {
        assert_eq!(found(&picture), []);
    }
}

#[test]
fn new_foreground_ranks_first() {
    let mut noise = Noise::new(0x636f_6d65);
    let pen = Hand::usual(Thumb::None, Point2::new(50.0, 205.0), 3.0, 60.0);
    let hand = Hand::usual(Thumb::None, Point2::new(200.0, 140.0), 0.7, 60.0);
    let before = with_hand(canvas(), &pen, 190.0);
    let mut background = Background::new(BackgroundOptions::default()).unwrap();
    for _ in 0..12 {
        let picture = before.clone().blur(0.9).take(2.0, &mut noise);
        background.observe(&picture.view().into(), &[]).unwrap();
    }
    let picture = with_hand(before, &hand, 110.0).blur(0.9).take(2.0, &mut noise);
    background.observe(&picture.view().into(), &[]).unwrap();
    let mut finder = finder();
    let candidates = finder.find(&picture.view().into(), Some(&background)).to_vec();
    assert_eq!(rank(&candidates, &hand), Some(0), "{candidates:?}");
    assert!(candidates[0].foreground > 0.9);
    let there = rank(&candidates, &pen).expect("the pen is a candidate");
    assert!(candidates[there].foreground < 0.1);
    // Without the background, the pen ranks at least as high, for its contrast is greater.
    assert!(rank(&found(&picture), &pen).is_some_and(|place| place < 2));
}

#[test]
fn a_finger_is_found_by_colour_without_contrast_in_grey() {
    let mut noise = Noise::new(0x636f_6c6f);
    let hand = Hand::usual(Thumb::None, Point2::new(180.0, 130.0), 2.0, 70.0);
    let flat = canvas().take(1.0, &mut noise);
    let shape = canvas().paint(&hand, TABLE + 60.0).blur(0.9).take(2.0, &mut noise);
    let bytes: Vec<u8> =
        shape.bytes.iter().flat_map(|&g| [140 - (g / 2).min(140), 70, g]).collect();
    let colours = ColourView::new(&bytes, WIDTH, HEIGHT, 3 * WIDTH).unwrap();
    assert_eq!(found(&flat), []);
    let mut finder = finder();
    let candidates = finder.find(&Frame::coloured(flat.view(), colours).unwrap(), None);
    assert_eq!(rank(candidates, &hand), Some(0), "{candidates:?}");
    assert!((candidates[0].colour[2] - 130.0).abs() < 8.0, "{:?}", candidates[0].colour);
}

#[test]
fn images_of_any_size_are_searched() {
    let mut finder = finder();
    let mut noise = Noise::new(0x7369_7a65);
    for (width, height) in [(1, 1), (2, 1), (3, 40), (17, 9), (641, 3), (97, 131)] {
        let pixels: Vec<u8> = (0..width * height).map(|_| noise.bits() as u8).collect();
        let frame = Frame::gray(GrayView::new(&pixels, width, height, width).unwrap());
        for candidate in finder.find(&frame, None) {
            assert!(candidate.length_px > 0.0 && candidate.half_width_px > 0.0);
            assert!((0.0..=1.0).contains(&candidate.score), "{candidate:?}");
        }
    }
}

#[test]
fn the_likeness_is_greatest_at_the_finger() {
    let mut noise = Noise::new(0x6c69_6b65);
    for k in 0..20 {
        let hand = any_hand(Thumb::None, &mut noise);
        let picture = with_hand(canvas(), &hand, 150.0).blur(0.9).take(2.0, &mut noise);
        let frame: Frame<'_> = picture.view().into();
        let w = hand.half_width_px;
        let likeness = |tip, turn| HandFinder::likeness(&frame, tip, hand.angle_rad + turn, w);
        let along = hand.direction();
        let here = likeness(hand.tip_px, 0.0).unwrap().unwrap();
        assert!(here > 0.9, "{k}: {here}");
        let lateral = nalgebra::Vector2::new(-along.y, along.x);
        for (tip, turn) in [
            (hand.tip_px - along * (4.0 * w), 0.0),
            (hand.tip_px + lateral * w, 0.0),
            (hand.tip_px + along * (6.0 * w), 0.0),
            (hand.tip_px - along * (2.0 * w), PI),
        ] {
            let there = likeness(tip, turn).unwrap().unwrap();
            assert!(there < 0.8 * here, "{k}: {there} of {here}");
        }
    }
}

/// Grey levels and colours of a hand lit on one side of its finger's axis; the other side has two
/// fifths of the light.
fn half_lit(hand: &Hand, skin: [f64; 3], table: [f64; 3], noise: &mut Noise) -> (Picture, Vec<u8>) {
    let lateral = nalgebra::Vector2::new(-hand.direction().y, hand.direction().x);
    let dark_side = HalfPlane::beyond(hand.tip_px, lateral.y.atan2(lateral.x) + PI, 0.0);
    let channels = [0, 1, 2].map(|c| {
        let [lit, dark] = [1.0, 0.4]
            .map(|light| with_hand(Canvas::new(WIDTH, HEIGHT, table[c]), hand, light * skin[c]));
        let shade = Canvas::new(WIDTH, HEIGHT, 0.0).paint(&dark_side, 1.0);
        let mut both = lit;
        for ((level, dark), part) in both.grey.iter_mut().zip(&dark.grey).zip(&shade.grey) {
            *level += part * (dark - *level);
        }
        both.blur(0.9).take(2.0, noise).bytes
    });
    let [b, g, r] = channels;
    let colours = b.iter().zip(&g).zip(&r).flat_map(|((&b, &g), &r)| [b, g, r]).collect();
    (Picture { width: WIDTH, height: HEIGHT, bytes: g }, colours)
}

#[test]
fn a_half_lit_finger_is_detected_by_its_chromaticity() {
    const HAND_COLOUR: [f64; 3] = [90.0, 110.0, 160.0];
    let mut noise = Noise::new(0x6861_6c66);
    for k in 0..20 {
        let hand = any_hand(Thumb::None, &mut noise);
        let likeness = |table: [f64; 3], noise: &mut Noise| {
            let (picture, colours) = half_lit(&hand, HAND_COLOUR, table, noise);
            let colour = ColourView::new(&colours, WIDTH, HEIGHT, 3 * WIDTH).unwrap();
            let frame = Frame::coloured(picture.view(), colour).unwrap();
            HandFinder::likeness(&frame, hand.tip_px, hand.angle_rad, hand.half_width_px)
                .unwrap()
                .unwrap()
        };
        let before_brown = likeness([41.0, 46.0, 54.0], &mut noise);
        assert!(before_brown > 0.85, "{k}: {before_brown}");
        // Before a table of the shaded skin's colour, only one flank is visible.
        let before_skin = likeness(HAND_COLOUR.map(|c| 0.4 * c), &mut noise);
        assert!(before_skin < 0.8 * before_brown, "{k}: {before_skin} of {before_brown}");
    }
}

#[test]
fn a_band_outside_the_image_has_no_likeness() {
    let picture = canvas().take(2.0, &mut Noise::new(0x6f75_7473));
    let frame: Frame<'_> = picture.view().into();
    let outside = Point2::new(-100.0, 40.0);
    assert_eq!(HandFinder::likeness(&frame, outside, 0.0, 6.0).unwrap(), None);
    let tip = Point2::new(100.0, 100.0);
    for (tip, angle_rad, half_width_px) in
        [(Point2::new(f64::NAN, 0.0), 0.0, 6.0), (tip, f64::INFINITY, 6.0), (tip, 0.0, 0.0)]
    {
        assert!(HandFinder::likeness(&frame, tip, angle_rad, half_width_px).is_err());
    }
}

#[test]
fn the_number_of_candidates_is_limited() {
    let mut noise = Noise::new(0x6d61_6e79);
    let options = FinderOptions { candidates: 2, ..FinderOptions::default() };
    let pixels: Vec<u8> = (0..WIDTH * HEIGHT)
        .map(|i| {
            if (i % WIDTH / 12 + i / WIDTH / 30).is_multiple_of(2) {
                60
            } else {
                160 + noise.bits() as u8 % 8
            }
        })
        .collect();
    let mut finder = HandFinder::new(options).unwrap();
    let frame = Frame::gray(GrayView::new(&pixels, WIDTH, HEIGHT, WIDTH).unwrap());
    assert!(finder.find(&frame, None).len() <= 2);
}

#[test]
fn options_out_of_range_are_refused() {
    let usual = FinderOptions::default();
    for wrong in [
        FinderOptions { min_half_width: 0.001, ..usual },
        FinderOptions { max_half_width: usual.min_half_width, ..usual },
        FinderOptions { max_half_width: f64::NAN, ..usual },
        FinderOptions { min_gradient_grey: 0.0, ..usual },
        FinderOptions { candidates: 0, ..usual },
    ] {
        assert!(HandFinder::new(wrong).is_err(), "{wrong:?}");
    }
}
