//! Log-likelihood ratios of a learned appearance model; learning, fading and anchoring.

use fingerpost_core::appearance::histogram::HistogramModel;
use fingerpost_core::image::frame::{ColourView, Frame};
use fingerpost_core::image::gray::GrayView;
use proptest::prelude::*;
use proptest::test_runner::{Config, RngSeed};

/// Documented limit of the log-likelihood ratio.
const MAX_LOG_RATIO: f32 = 3.0;
const HAND: u8 = 160;
const BACKGROUND: u8 = 60;

fn config() -> Config {
    Config { rng_seed: RngSeed::Fixed(0x6170_7065), failure_persistence: None, ..Config::default() }
}

/// One pixel of every grey level, in a row.
fn levels() -> Vec<u8> {
    (0..=255).collect()
}

fn row(bytes: &[u8]) -> Frame<'_> {
    Frame::gray(GrayView::new(bytes, bytes.len(), 1, bytes.len()).unwrap())
}

/// A frame of one coloured pixel.
fn with_pixel<T>(colour: [u8; 3], then: impl FnOnce(&Frame<'_>) -> T) -> T {
    let gray = GrayView::new(&[128], 1, 1, 1).unwrap();
    then(&Frame::coloured(gray, ColourView::new(&colour, 1, 1, 3).unwrap()).unwrap())
}

/// A hand and a background of one grey level each.
fn two_levels() -> HistogramModel {
    let bytes = [HAND, BACKGROUND];
    let mut appearance = HistogramModel::new(false);
    for _ in 0..50 {
        appearance.observe(&row(&bytes), 0.0, 0.0, true);
        appearance.observe(&row(&bytes), 1.0, 0.0, false);
    }
    appearance.learn();
    appearance
}

fn ratio_of(appearance: &HistogramModel, level: u8) -> f32 {
    appearance.log_ratio(&row(&[level]), 0.0, 0.0)
}

#[test]
fn without_samples_the_ratio_is_zero() {
    for appearance in [HistogramModel::new(false), {
        let mut learned = HistogramModel::new(false);
        learned.learn();
        learned
    }] {
        assert!(levels().iter().all(|&level| ratio_of(&appearance, level) == 0.0));
    }
    // Nor has one class alone any information.
    let mut one_sided = HistogramModel::new(false);
    one_sided.observe(&row(&[HAND]), 0.0, 0.0, true);
    one_sided.learn();
    assert_eq!(ratio_of(&one_sided, HAND), 0.0);
}

#[test]
fn the_ratio_is_large_for_learned_levels_and_zero_for_others() {
    let appearance = two_levels();
    assert_eq!(ratio_of(&appearance, HAND), MAX_LOG_RATIO);
    assert_eq!(ratio_of(&appearance, BACKGROUND), -MAX_LOG_RATIO);
    for level in [0, 110, 255] {
        assert_eq!(ratio_of(&appearance, level), 0.0, "{level}");
    }
    // Noise keeps the sign: levels in neighbouring bins have similar ratios.
    for (level, side) in [(HAND + 7, 1.0), (HAND - 4, 1.0), (BACKGROUND + 7, -1.0)] {
        assert!(ratio_of(&appearance, level) * side > 1.0, "{level}");
    }
}

#[test]
fn ratios_change_only_with_learning() {
    let mut appearance = two_levels();
    for _ in 0..1000 {
        appearance.observe(&row(&[HAND]), 0.0, 0.0, false);
    }
    assert_eq!(ratio_of(&appearance, HAND), MAX_LOG_RATIO);
    appearance.learn();
    assert!(ratio_of(&appearance, HAND) < 0.1, "now as frequent behind the hand as on it");
}

#[test]
fn faded_samples_are_replaced_and_anchored_ones_stay() {
    let relearn = |mut appearance: HistogramModel| {
        appearance.fade(0.0);
        for _ in 0..50 {
            appearance.observe(&row(&[BACKGROUND]), 0.0, 0.0, true);
            appearance.observe(&row(&[HAND]), 0.0, 0.0, false);
        }
        appearance.learn();
        appearance
    };
    // A contour on the wrong side reverses the ratios.
    let forgot = relearn(two_levels());
    assert_eq!(ratio_of(&forgot, HAND), -MAX_LOG_RATIO);
    assert_eq!(ratio_of(&forgot, BACKGROUND), MAX_LOG_RATIO);
    // Those of an anchored hand keep half of their weight.
    let mut anchored = two_levels();
    anchored.anchor();
    let anchored = relearn(anchored);
    assert!(ratio_of(&anchored, HAND) > -1.0, "{}", ratio_of(&anchored, HAND));
}

#[test]
fn fading_keeps_the_ratio() {
    let mut faded = two_levels();
    faded.fade(0.25);
    faded.learn();
    let kept = two_levels();
    for level in levels() {
        assert!((ratio_of(&faded, level) - ratio_of(&kept, level)).abs() < 1e-4);
    }
}

/// Levels in a hand's and a background's range, scaled by the light.
fn spread(light: f32) -> HistogramModel {
    let mut appearance = HistogramModel::new(false);
    for k in 0..40_u8 {
        for (level, is_hand) in [(140 + k, true), (60 + k, false)] {
            let lit = (f32::from(level) * light).round() as u8;
            appearance.observe(&row(&[lit]), 0.0, 0.0, is_hand);
        }
    }
    appearance.learn();
    appearance
}

#[test]
fn relighting_preserves_the_ratios() {
    for light in [0.6, 0.9, 1.3] {
        let mut appearance = spread(1.0);
        appearance.relight(light);
        for level in (62..98).chain(142..178) {
            let lit = (level as f32 * light).round() as u8;
            let expected = ratio_of(&spread(light), lit);
            let ratio = ratio_of(&appearance, lit);
            assert!(
                (ratio - expected).abs() < 0.5,
                "light {light}, {level}: {ratio} for {expected}"
            );
        }
    }
}

#[test]
fn relighting_preserves_the_classes_of_colours() {
    let (skin, wood) = ([120, 140, 180], [60, 90, 140]);
    let mut appearance = HistogramModel::new(true);
    for _ in 0..50 {
        with_pixel(skin, |frame| appearance.observe(frame, 0.0, 0.0, true));
        with_pixel(wood, |frame| appearance.observe(frame, 0.0, 0.0, false));
    }
    appearance.learn();
    let dimmed = |colour: [u8; 3]| colour.map(|c| (f32::from(c) * 0.7).round() as u8);
    // The dimmed hand is as dark as the wood was before.
    assert!(with_pixel(dimmed(skin), |f| appearance.log_ratio(f, 0.0, 0.0)) < 1.0);
    appearance.relight(0.7);
    assert!(with_pixel(dimmed(skin), |f| appearance.log_ratio(f, 0.0, 0.0)) > 2.0);
    assert!(with_pixel(dimmed(wood), |f| appearance.log_ratio(f, 0.0, 0.0)) < -2.0);
}

#[test]
fn outside_the_frame_the_ratio_is_zero_and_nothing_is_observed() {
    let bytes = [HAND, BACKGROUND];
    let frame = row(&bytes);
    let mut appearance = two_levels();
    let before = appearance.clone();
    for (u, v) in [
        (-0.6, 0.0),
        (1.6, 0.0),
        (0.0, -0.6),
        (0.0, 0.6),
        (f64::NAN, 0.0),
        (0.0, f64::NAN),
        (f64::INFINITY, 0.0),
        (f64::NEG_INFINITY, 0.0),
        (0.0, 1e300),
        (-1e300, 0.0),
    ] {
        assert_eq!(appearance.log_ratio(&frame, u, v), 0.0, "{u} {v}");
        appearance.observe(&frame, u, v, true);
        appearance.observe(&frame, u, v, false);
    }
    assert_eq!(appearance, before);
    // The whole square of a border pixel is inside.
    assert_eq!(appearance.log_ratio(&frame, -0.49, 0.49), MAX_LOG_RATIO);
    assert_eq!(appearance.log_ratio(&frame, 0.51, -0.49), -MAX_LOG_RATIO);
}

#[test]
fn colours_of_equal_brightness_are_distinguished() {
    let (skin, table, wall) = ([200, 150, 120], [120, 150, 200], [30, 220, 30]);
    let mut appearance = HistogramModel::new(true);
    assert!(appearance.is_coloured() && !HistogramModel::new(false).is_coloured());
    for _ in 0..50 {
        with_pixel(skin, |frame| appearance.observe(frame, 0.0, 0.0, true));
        with_pixel(table, |frame| appearance.observe(frame, 0.0, 0.0, false));
    }
    appearance.learn();
    let ratio = |colour| with_pixel(colour, |frame| appearance.log_ratio(frame, 0.0, 0.0));
    assert_eq!((ratio(skin), ratio(table), ratio(wall)), (MAX_LOG_RATIO, -MAX_LOG_RATIO, 0.0));
    assert!(ratio([206, 146, 124]) > 1.0);
}

#[test]
fn a_frame_without_colours_does_not_affect_a_coloured_appearance() {
    let mut appearance = HistogramModel::new(true);
    let before = appearance.clone();
    appearance.observe(&row(&[HAND]), 0.0, 0.0, true);
    assert_eq!(appearance, before);
    assert_eq!(appearance.log_ratio(&row(&[HAND]), 0.0, 0.0), 0.0);
}

proptest! {
    #![proptest_config(config())]

    #[test]
    fn ratios_are_bounded_and_antisymmetric(
        hand in prop::collection::vec(any::<u8>(), 1..60),
        background in prop::collection::vec(any::<u8>(), 1..60),
        keep in 0.0..=1.0_f32,
    ) {
        let learned = |hand: &[u8], background: &[u8]| {
            let mut appearance = HistogramModel::new(false);
            for (levels, is_hand) in [(hand, true), (background, false)] {
                for x in 0..levels.len() {
                    appearance.observe(&row(levels), x as f64, 0.0, is_hand);
                }
            }
            appearance.fade(keep.max(0.01));
            appearance.learn();
            appearance
        };
        let (one, other) = (learned(&hand, &background), learned(&background, &hand));
        for level in levels() {
            let ratio = ratio_of(&one, level);
            prop_assert!(ratio.abs() <= MAX_LOG_RATIO);
            prop_assert!((ratio + ratio_of(&other, level)).abs() < 1e-4);
        }
        // On average, the hand's own levels have the greater ratio.
        let sum: f32 = hand.iter().map(|&level| ratio_of(&one, level)).sum();
        let against: f32 = background.iter().map(|&level| ratio_of(&one, level)).sum();
        prop_assert!(sum / hand.len() as f32 >= against / background.len() as f32 - 1e-3);
    }
}
