//! The model is private to the tracker; the truth is the painted image.

use super::super::convergence::UNSEEN_FRAMES;
use super::*;
use crate::image::frame::ColourView;
use crate::image::gray::GrayView;
use nalgebra::{Point2, Vector2};

const SIDE: usize = 80;
/// Column at which the hand ends \[px\]: before paper above, before another background below.
const EDGE: f64 = 40.0;
const HAND_COLOUR: [f64; 3] = [124.0, 139.0, 175.0];
const PAPER: [f64; 3] = [191.0, 184.0, 178.0];
const WOOD: [f64; 3] = [104.0, 124.0, 141.0];
const BLUE: [f64; 3] = [170.0, 90.0, 60.0];

/// Number of frames before paper, and the weight that earlier frames keep in each.
const SEEN_FRAMES: usize = 30;
const KEEP: f64 = 0.8;

/// Models of a hand after many frames before paper, and after one more frame in which its lower
/// half, of the colour `inside` before the colour `behind`, has no edge.
fn models_before_and_after(inside: [f64; 3], behind: [f64; 3]) -> [AppearanceModel; 2] {
    let colour_at = |i: usize| {
        let (x, y) = (i % SIDE, i / SIDE);
        let below = 2 * y >= SIDE;
        let colour = match (x < EDGE as usize, below) {
            (true, false) => HAND_COLOUR,
            (true, true) => inside,
            (false, false) => PAPER,
            (false, true) => behind,
        };
        // Shades vary, and the noise of each channel is independent.
        let shade = 1.0 - 0.03 * ((3 * x + 7 * y) % 11) as f64;
        let noise = |k: usize| ((5 * x + 3 * y + 4 * k * (x + 1)) % 7) as f64 - 3.0;
        [0, 1, 2].map(|k| (shade * colour[k] + noise(k)) as u8)
    };
    let colours: Vec<[u8; 3]> = (0..SIDE * SIDE).map(colour_at).collect();
    let greys: Vec<u8> = colours.iter().map(|[_, g, _]| *g).collect();
    let gray = GrayView::new(&greys, SIDE, SIDE, SIDE).unwrap();
    let colour = ColourView::new(colours.as_flattened(), SIDE, SIDE, 3 * SIDE).unwrap();
    let frame = Frame::coloured(gray, colour).unwrap();
    let at = |y: usize| PlacedSample {
        position: Point2::new(EDGE - 0.5, y as f64),
        normal: Vector2::x(),
    };
    let edges: Vec<_> = (4..SIDE / 2 - 2).map(at).collect();
    let unseen: Vec<_> = (SIDE / 2 + 2..SIDE - 4).map(at).collect();
    let finger = Silhouette { ahead: Vector2::y(), half_width_px: 8.0 };
    let mut image = DiscriminantImage::default();
    let mut before = AppearanceModel::new(true);
    let contour = Contour { edges: &edges, unseen: &[] };
    for _ in 0..SEEN_FRAMES {
        before.learn(&frame, &mut image, &contour, &finger, (KEEP, 1.0)).unwrap();
    }
    let mut after = before.clone();
    let contour = Contour { edges: &[], unseen: &unseen };
    after.learn(&frame, &mut image, &contour, &finger, (1.0, UNSEEN_FRAMES)).unwrap();
    [before, after]
}

/// Difference of brightness between skin and wood in the mixture \[grey levels\].
fn contrast(appearance: &AppearanceModel) -> f64 {
    let colours = [HAND_COLOUR, WOOD].map(|colour| colour.map(|c| c as u8));
    let gray = GrayView::new(&[0; 2], 2, 1, 2).unwrap();
    let colour = ColourView::new(colours.as_flattened(), 2, 1, 6).unwrap();
    let frame = Frame::coloured(gray, colour).unwrap();
    let mut image = DiscriminantImage::default();
    let mixture = appearance.discriminant.mixture().unwrap();
    let mixed_frame = image.of(&frame, mixture, [0.0, 2.0, 0.0, 1.0]).unwrap();
    let [skin, wood] = [0, 1].map(|x| f64::from(mixed_frame.image().pixel(x, 0).unwrap()));
    skin - wood
}

#[test]
fn the_background_is_learned_where_the_hand_has_no_edge() {
    let [before, after] = models_before_and_after(HAND_COLOUR, WOOD);
    // The threshold of an edge is half of the least contrast of a hand.
    assert!(contrast(&before) < 9.0, "{}", contrast(&before));
    assert!(contrast(&after) >= 17.0, "{}", contrast(&after));
    assert!(after.plain.separation() > 2.0);
}

#[test]
fn nothing_is_learned_before_another_hand_or_from_an_occluder() {
    for (inside, behind) in [(HAND_COLOUR, HAND_COLOUR), (BLUE, WOOD), (BLUE, BLUE)] {
        let [before, after] = models_before_and_after(inside, behind);
        assert_eq!(after.discriminant.mixture(), before.discriminant.mixture());
        assert_eq!(after.plain, before.plain);
    }
}
