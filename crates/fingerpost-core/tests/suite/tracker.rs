//! The tracker on rendered hands with known motion.

use crate::common::{BentFinger, Canvas, Hand, Noise, Picture, Shape, covered_part};
use fingerpost_core::geometry::planar::AffineMap;
use fingerpost_core::geometry::shape_space::{PlacedSample, Pose};
use fingerpost_core::geometry::template::{HALF_LENGTH, OutlineAxis, Template, Thumb};
use fingerpost_core::image::frame::ColourView;
use fingerpost_core::image::gray::GrayView;
use fingerpost_core::measure::edge::Polarity;
use fingerpost_core::measure::edge_search::SearchOptions;
use fingerpost_core::nalgebra::{Matrix2, Point2, Vector2};
use fingerpost_core::numeric::simd::Isa;
use fingerpost_core::solve::fit::{FitOptions, Loss};
use fingerpost_core::track::{
    AcceptOptions, AcquireOptions, ContourTracker, Diagnostics, FingerLine, LineSource, Model,
    Refusal, SearchedLine, StartPose, Status, Track, TrackOptions, TrackerOptions,
};
use fingerpost_core::{Error, Frame};
use proptest::prelude::*;
use proptest::test_runner::{Config, RngSeed};
use std::f64::consts::{PI, TAU};
use std::sync::OnceLock;

const WIDTH: usize = 200;
const HEIGHT: usize = 150;
const BACKGROUND: f64 = 60.0;
const HAND: f64 = 140.0;
/// Blur of the rendered edges [px]; with the pixel's own extent, 1/12 px², it makes one.
const BLUR_PX: f64 = 0.957_427;
const NOISE: f64 = 2.0;
const LENGTH_PX: f64 = 60.0;
const FRAME_S: f64 = 1.0 / 30.0;

const MODELS: [Model; 2] = [Model::Ribbon, Model::Paper];
const THUMBS: [Thumb; 3] = [Thumb::Left, Thumb::Right, Thumb::None];

fn config(cases: u32) -> Config {
    Config {
        cases,
        rng_seed: RngSeed::Fixed(0x7472_6163),
        failure_persistence: None,
        ..Config::default()
    }
}

/// Options for a bright hand; one polarity saves two thirds of the tests' time.
fn options(model: Model) -> TrackerOptions {
    TrackerOptions { model, polarity: Polarity::Bright, ..TrackerOptions::default() }
}

/// Step of a fast hand between frames; a waiting template reaches 20 px.
const FAST_PX: f64 = 26.0;
const START: StartPose =
    StartPose { tip_px: Point2::new(130.0, 60.0), angle_rad: -0.5, length_px: LENGTH_PX };

fn tracker(model: Model, thumb: Thumb) -> ContourTracker {
    ContourTracker::new(Template::pistol(thumb).unwrap(), &START, options(model)).unwrap()
}

/// A hand held up to the template with an operator's accuracy: a few pixels and degrees off.
fn held_up(thumb: Thumb) -> Hand {
    Hand::usual(thumb, START.tip_px + Vector2::new(2.5, -2.0), START.angle_rad + 0.05, LENGTH_PX)
}

/// The hand in frame `k`, swaying by up to 2.3 px and 1.9° per frame.
fn swaying(thumb: Thumb, k: usize) -> Hand {
    let at = k as f64;
    let tip = START.tip_px + Vector2::new(16.0 * (0.14 * at).sin(), 14.0 * (0.11 * at).sin());
    let angle_rad = START.angle_rad + 0.3 * (0.11 * at).sin();
    Hand::usual(thumb, tip, angle_rad, LENGTH_PX)
}

fn picture(hand: &Hand, noise: &mut Noise) -> Picture {
    let canvas = Canvas::new(WIDTH, HEIGHT, BACKGROUND).paint(hand, HAND);
    canvas.blur(BLUR_PX).take(NOISE, noise)
}

fn empty(noise: &mut Noise) -> Picture {
    Canvas::new(WIDTH, HEIGHT, BACKGROUND).take(NOISE, noise)
}

fn update(tracker: &mut ContourTracker, picture: &Picture, time_s: f64) -> Track {
    tracker.update(&picture.view().into(), time_s).unwrap()
}

/// Shows the tracker a still hand until it tracks; returns the time of the next frame.
fn acquire(tracker: &mut ContourTracker, hand: &Hand, noise: &mut Noise) -> f64 {
    for k in 0..6 {
        let time_s = f64::from(k) * FRAME_S;
        if update(tracker, &picture(hand, noise), time_s).status == Status::Tracking {
            return time_s + FRAME_S;
        }
    }
    unreachable!("not acquired: {hand:?}");
}

/// The angle from `a` to `b`, in (−π, π].
fn turn(a: f64, b: f64) -> f64 {
    let (sin, cos) = (b - a).sin_cos();
    sin.atan2(cos)
}

/// Error of a finger line.
#[derive(Debug, Clone, Copy)]
struct LineError {
    tip_px: f64,
    /// At the line's anchor, along its normal.
    offset_px: f64,
    angle_rad: f64,
}

impl LineError {
    fn of(line: &FingerLine, hand: &Hand) -> Self {
        Self {
            tip_px: (line.axis.tip - hand.tip_px).norm(),
            offset_px: hand.offset_px(&line.axis.anchor),
            angle_rad: turn(hand.angle_rad, line.axis.angle_rad),
        }
    }

    /// Squared error in units of the line's covariance, 2 on average if that is consistent.
    fn squared_mahalanobis(&self, line: &FingerLine) -> f64 {
        let e = Vector2::new(self.offset_px, self.angle_rad);
        e.dot(&(line.covariance.try_inverse().unwrap() * e))
    }
}

/// Mean squared error of a line in units of its covariance, 2 if that is exact: the covariance is
/// neither much too small nor uselessly large.
const CONSISTENT: std::ops::Range<f64> = 0.4..6.0;

#[test]
fn a_known_motion_is_followed() {
    // Root mean squares over the path, in the order of the models. The theoretical bound at this
    // contrast and noise is 0.006 px and 0.0003 rad; the contour samples 100 of its 280 px.
    const OFFSET_RMS_PX: [f64; 2] = [0.03, 0.04];
    const ANGLE_RMS_RAD: [f64; 2] = [0.0015, 0.003];
    const TIP_RMS_PX: [f64; 2] = [0.2, 0.2];
    for (m, model) in MODELS.into_iter().enumerate() {
        for thumb in THUMBS {
            let mut tracker = tracker(model, thumb);
            let mut noise = Noise::new(0x6d6f_7469);
            let mut squares = [0.0; 4];
            let mut count = 0.0;
            for k in 0..40 {
                let hand = swaying(thumb, k);
                let track = update(&mut tracker, &picture(&hand, &mut noise), k as f64 * FRAME_S);
                let Some(line) = track.finger_line else {
                    assert!(k < 4, "{model:?} {thumb:?}: lost in frame {k}: {track:?}");
                    continue;
                };
                assert_eq!(track.status, Status::Tracking);
                let error = LineError::of(&line, &hand);
                let ratio = error.squared_mahalanobis(&line);
                let LineError { offset_px, angle_rad, tip_px } = error;
                for (sum, e) in squares.iter_mut().zip([offset_px, angle_rad, tip_px, ratio.sqrt()])
                {
                    *sum += e * e;
                }
                count += 1.0;
            }
            let [offset, angle, tip, ratio] = squares.map(|sum: f64| (sum / count).sqrt());
            let what = format!("{model:?} {thumb:?}: {offset} px, {angle} rad, tip {tip} px");
            assert!(offset < OFFSET_RMS_PX[m] && angle < ANGLE_RMS_RAD[m], "{what}");
            assert!(tip < TIP_RMS_PX[m], "{what}");
            assert!(
                CONSISTENT.contains(&(ratio * ratio)),
                "{} instead of 2: {what}",
                ratio * ratio
            );
        }
    }
}

/// Half-length of the longest line of the last search \[px\].
fn longest_px(tracker: &ContourTracker) -> f64 {
    tracker.search_lines().map(|s| s.line.half_length_px).fold(0.0, f64::max)
}

#[test]
fn search_lines_are_short_for_a_still_hand_and_longer_for_a_leaning_thumb() {
    let (mut tracker, mut noise) = (tracker(Model::Paper, Thumb::Right), Noise::new(0x6c65_616e));
    let mut hand = held_up(Thumb::Right);
    let mut time_s = acquire(&mut tracker, &hand, &mut noise);
    for _ in 0..8 {
        let track = update(&mut tracker, &picture(&hand, &mut noise), time_s);
        assert_eq!((track.status, longest_px(&tracker)), (Status::Tracking, 5.0));
        time_s += FRAME_S;
    }
    // The end of the thumb jumps to and fro by 8 px; the finger is at rest.
    let thumb_rad = hand.thumb.as_ref().unwrap().angle_rad;
    let mut shears_px = [0.0; 2];
    for k in 0..6 {
        let leans = (k + 1) % 2;
        hand.thumb.as_mut().unwrap().angle_rad = thumb_rad + 0.25 * leans as f64;
        let track = update(&mut tracker, &picture(&hand, &mut noise), time_s);
        let error = LineError::of(&track.finger_line.unwrap(), &hand);
        assert!(error.offset_px.abs() < 0.2 && error.angle_rad.abs() < 0.01, "{k}: {error:?}");
        assert!(track.diagnostics.agreement > 0.8, "{k}: {:?}", track.diagnostics);
        let shear_px = track.shape.unwrap().vector[3];
        assert!(
            k < 2 || (shear_px - shears_px[leans]).abs() < 0.5,
            "{k}: {shear_px} {shears_px:?}"
        );
        shears_px[leans] = shear_px;
        time_s += FRAME_S;
    }
    assert!(shears_px[0] - shears_px[1] > 14.0, "{shears_px:?}");
}

#[test]
fn the_covariance_of_a_hand_at_rest_is_consistent() {
    // Only the noise changes, so the errors must match the covariance.
    for model in MODELS {
        for thumb in [Thumb::Left, Thumb::None] {
            let hand = held_up(thumb);
            let canvas = Canvas::new(WIDTH, HEIGHT, BACKGROUND).paint(&hand, HAND).blur(BLUR_PX);
            let (mut tracker, mut noise) = (tracker(model, thumb), Noise::new(0x7265_7374));
            let ratios: Vec<_> = (0..40)
                .filter_map(|k| {
                    let picture = canvas.take(NOISE, &mut noise);
                    let line = update(&mut tracker, &picture, f64::from(k) * FRAME_S).finger_line?;
                    Some(LineError::of(&line, &hand).squared_mahalanobis(&line))
                })
                .collect();
            let mean = ratios.iter().sum::<f64>() / ratios.len() as f64;
            let what = format!("{mean} instead of 2 for {model:?}, {thumb:?}");
            assert!(ratios.len() > 30 && CONSISTENT.contains(&mean), "{what}");
        }
    }
}

#[test]
fn the_template_is_fitted_to_a_different_hand() {
    // Wider and tapered, with a thumb that is shorter, thinner and at a larger angle.
    for thumb in THUMBS {
        let mut hand = held_up(thumb);
        hand.half_width_px *= 1.25;
        hand.taper = -0.05;
        if let Some(thumb) = &mut hand.thumb {
            thumb.angle_rad += 0.2;
            thumb.length_px *= 0.9;
            thumb.half_width_px *= 0.85;
            thumb.root_px += 3.0;
        }
        let (mut tracker, mut noise) = (tracker(Model::Ribbon, thumb), Noise::new(0x6d6f_756c));
        let mut time_s = acquire(&mut tracker, &hand, &mut noise);
        for _ in 0..10 {
            let line =
                update(&mut tracker, &picture(&hand, &mut noise), time_s).finger_line.unwrap();
            time_s += FRAME_S;
            let error = LineError::of(&line, &hand);
            assert!(error.offset_px.abs() < 0.1 && error.angle_rad.abs() < 0.006, "{error:?}");
            assert!(error.tip_px < 0.5, "{error:?}");
        }
    }
}

#[test]
fn it_settles_after_the_configured_number_of_accepted_frames() {
    for model in MODELS {
        for settle_frames in [1, 2, 4] {
            let options = options(model);
            let acquire = AcquireOptions { settle_frames, ..options.acquire };
            let options = TrackerOptions { acquire, ..options };
            let template = Template::pistol(Thumb::None).unwrap();
            let mut tracker = ContourTracker::new(template, &START, options).unwrap();
            let (hand, mut noise) = (held_up(Thumb::None), Noise::new(0x7365_7474));
            for k in 1..=settle_frames {
                let track = update(&mut tracker, &picture(&hand, &mut noise), k as f64 * FRAME_S);
                let settled = k == settle_frames;
                let expected = if settled { Status::Tracking } else { Status::Acquiring };
                assert_eq!(track.status, expected, "{model:?}, frame {k} of {settle_frames}");
                assert!(track.diagnostics.accepted && track.shape.is_some());
                assert_eq!(track.finger_line.is_some(), settled, "no line before it is tracked");
            }
        }
    }
}

#[test]
fn the_hand_may_move_while_it_settles() {
    let (mut tracker, mut noise) = (tracker(Model::Ribbon, Thumb::Left), Noise::new(0x6d6f_7665));
    let statuses: Vec<_> = (0..4)
        .map(|k| {
            let step = Vector2::new(2.0, -1.5) * f64::from(k);
            let hand = Hand { tip_px: START.tip_px + step, ..held_up(Thumb::Left) };
            update(&mut tracker, &picture(&hand, &mut noise), f64::from(k) * FRAME_S).status
        })
        .collect();
    assert_eq!(statuses[2..], [Status::Tracking; 2]);
}

#[test]
fn a_frame_without_the_hand_restarts_the_settling() {
    for model in MODELS {
        let mut tracker = tracker(model, Thumb::None);
        let (hand, mut noise) = (held_up(Thumb::None), Noise::new(0x616e_6577));
        let shown = [true, false, true, true];
        for (k, shown) in shown.into_iter().enumerate() {
            let picture = if shown { picture(&hand, &mut noise) } else { empty(&mut noise) };
            let track = update(&mut tracker, &picture, k as f64 * FRAME_S);
            let tracking = k == 3;
            assert_eq!(track.status == Status::Tracking, tracking, "{model:?}, frame {k}");
            assert_eq!(track.diagnostics.accepted, shown, "{model:?}, frame {k}");
            if !shown {
                assert_eq!((track.shape, track.finger_line), (None, None));
            }
        }
    }
}

#[test]
fn a_hand_of_another_size_is_not_acquired() {
    for factor in [0.4, 2.6] {
        let mut hand = held_up(Thumb::None);
        hand.half_width_px *= factor;
        hand.length_px *= factor;
        let (mut tracker, mut noise) =
            (tracker(Model::Ribbon, Thumb::None), Noise::new(0x7369_7a65));
        for k in 0..4 {
            let track = update(&mut tracker, &picture(&hand, &mut noise), f64::from(k));
            assert_eq!((track.status, track.finger_line), (Status::Acquiring, None), "{factor}");
        }
    }
}

#[test]
fn a_template_waits_for_a_hand() {
    for model in MODELS {
        for thumb in THUMBS {
            let mut tracker = tracker(model, thumb);
            let (waiting, mut noise) = (tracker.contour(), Noise::new(0x7761_6974));
            for k in 0..3 {
                let track = update(&mut tracker, &empty(&mut noise), f64::from(k));
                assert_eq!(track.status, Status::Acquiring);
                assert_eq!((track.shape, track.finger_line), (None, None));
                assert!(!track.diagnostics.accepted);
                assert_eq!(track.time_s, f64::from(k));
                assert_eq!(tracker.contour(), waiting, "it stays where it waits");
            }
        }
    }
}

#[test]
fn it_waits_at_the_start_pose() {
    let map = AffineMap::upright(START.tip_px, START.angle_rad, START.length_px).unwrap();
    for model in MODELS {
        for thumb in THUMBS {
            let tracker = tracker(model, thumb);
            let samples = tracker.template().samples(tracker.options().samples).unwrap();
            let (contour, expected): (_, Vec<PlacedSample>) =
                (tracker.contour(), samples.iter().map(|s| map.place(s)).collect());
            // Samples next to the crotch may count as hidden by the other limb.
            assert!((expected.len() - 4..=expected.len()).contains(&contour.len()));
            for placed in contour {
                // Within the deviation of the template's spline from its bands.
                let near = |e: &PlacedSample| (e.position - placed.position).norm() < 0.2;
                assert!(expected.iter().any(near), "{model:?} {thumb:?} {placed:?}");
            }
        }
    }
}

/// Shows frames without the hand until the tracker is lost.
fn lose(tracker: &mut ContourTracker, time_s: &mut f64, noise: &mut Noise) {
    let lose_after = tracker.options().track.lose_after_frames;
    for missed in 1..=lose_after {
        let track = update(tracker, &empty(noise), *time_s);
        *time_s += FRAME_S;
        let expected = if missed < lose_after { Status::Tracking } else { Status::Lost };
        assert_eq!(track.status, expected, "{missed} of {lose_after} frames missed");
        assert_eq!((track.shape, track.finger_line), (None, None));
        assert!(!track.diagnostics.accepted);
    }
}

#[test]
fn a_vanished_hand_is_lost_in_time_and_found_again() {
    for model in MODELS {
        for (thumb, lose_after_frames) in [(Thumb::Right, 1), (Thumb::None, 3)] {
            let options = options(model);
            let track = TrackOptions { lose_after_frames, ..options.track };
            let options = TrackerOptions { track, ..options };
            let template = Template::pistol(thumb).unwrap();
            let mut tracker = ContourTracker::new(template, &START, options).unwrap();
            let (hand, mut noise) = (held_up(thumb), Noise::new(0x6c6f_7374));
            let mut time_s = acquire(&mut tracker, &hand, &mut noise);
            lose(&mut tracker, &mut time_s, &mut noise);
            for _ in 0..2 {
                let track = update(&mut tracker, &empty(&mut noise), time_s);
                time_s += FRAME_S;
                assert_eq!((track.status, track.finger_line), (Status::Lost, None));
            }
            // There is no line until a fit has settled again.
            let mut back = false;
            for _ in 0..5 {
                let track = update(&mut tracker, &picture(&hand, &mut noise), time_s);
                time_s += FRAME_S;
                back = track.status == Status::Tracking;
                assert_eq!(track.finger_line.is_some(), back);
                assert!(back || track.status == Status::Lost);
                if let Some(line) = track.finger_line {
                    let error = LineError::of(&line, &hand);
                    assert!(error.tip_px < 0.6 && error.angle_rad.abs() < 0.01, "{error:?}");
                }
            }
            assert!(back, "{model:?} {thumb:?}");
        }
    }
}

#[test]
fn a_lost_hand_is_found_at_its_last_place_and_at_the_template() {
    for model in MODELS {
        let thumb = Thumb::Left;
        let mut tracker = tracker(model, thumb);
        let (first, mut noise) = (held_up(thumb), Noise::new(0x7768_6572));
        let mut time_s = acquire(&mut tracker, &first, &mut noise);
        // The hand moves 45 px away from the waiting template and vanishes there.
        let (mut hand, mut names) = (first, None);
        for _ in 0..15 {
            hand.tip_px += Vector2::new(2.0, 2.236);
            let track = update(&mut tracker, &picture(&hand, &mut noise), time_s);
            time_s += FRAME_S;
            assert!(track.finger_line.is_some(), "{model:?} {track:?}");
            names = track.shape.map(|shape| shape.names);
        }
        for back in [hand, first] {
            lose(&mut tracker, &mut time_s, &mut noise);
            for _ in 0..2 {
                update(&mut tracker, &empty(&mut noise), time_s);
                time_s += FRAME_S;
            }
            let mut track = None;
            for _ in 0..5 {
                track = Some(update(&mut tracker, &picture(&back, &mut noise), time_s));
                time_s += FRAME_S;
            }
            let line = track.and_then(|track| track.finger_line).expect("found again");
            let error = LineError::of(&line, &back);
            assert!(error.tip_px < 0.6 && error.angle_rad.abs() < 0.01, "{model:?} {error:?}");
            let again = track.and_then(|track| track.shape).map(|shape| shape.names);
            assert_eq!(again, names, "{model:?}: the same hand, thumb and all");
        }
    }
}

#[test]
fn a_hand_with_a_hidden_thumb_is_followed_by_its_finger() {
    for (model, names) in [(Model::Ribbon, 5), (Model::Paper, 3)] {
        let (mut tracker, mut noise) = (tracker(model, Thumb::Left), Noise::new(0x7468_756d));
        let hand = held_up(Thumb::None);
        let mut time_s = acquire(&mut tracker, &hand, &mut noise);
        // At the start and after a loss.
        for _ in 0..2 {
            let mut track = None;
            for _ in 0..4 {
                track = Some(update(&mut tracker, &picture(&hand, &mut noise), time_s));
                time_s += FRAME_S;
            }
            let track = track.unwrap();
            let error = LineError::of(&track.finger_line.expect("tracked"), &hand);
            assert!(error.offset_px.abs() < 0.1 && error.angle_rad.abs() < 0.005, "{error:?}");
            assert_eq!(track.shape.unwrap().names.len(), names, "{model:?}");
            lose(&mut tracker, &mut time_s, &mut noise);
        }
    }
}

#[test]
fn a_folded_thumb_is_left_out_after_a_while() {
    let (mut tracker, mut noise) = (tracker(Model::Ribbon, Thumb::Left), Noise::new(0x666f_6c64));
    let mut time_s = acquire(&mut tracker, &held_up(Thumb::Left), &mut noise);
    let track = update(&mut tracker, &picture(&held_up(Thumb::Left), &mut noise), time_s);
    assert_eq!(track.shape.unwrap().names.len(), 9);
    let with_thumb = tracker.contour().len();
    let folded = held_up(Thumb::None);
    let patience = tracker.options().track.lose_after_frames;
    for k in 0..patience + 3 {
        time_s += FRAME_S;
        let track = update(&mut tracker, &picture(&folded, &mut noise), time_s);
        let error = LineError::of(&track.finger_line.expect("the finger is there"), &folded);
        assert!(error.offset_px.abs() < 0.15 && error.angle_rad.abs() < 0.01, "{k}: {error:?}");
        assert_eq!(track.shape.unwrap().names.len(), 5, "{k}");
        // The thumb is searched for a limited time, in case it returns.
        let out = k + 1 >= patience;
        assert_eq!(tracker.contour().len() < with_thumb, out, "{k}");
    }
}

#[test]
fn a_briefly_hidden_hand_is_tracked_on() {
    for model in MODELS {
        let (mut tracker, mut noise) = (tracker(model, Thumb::Left), Noise::new(0x6869_6465));
        let hand = held_up(Thumb::Left);
        let mut time_s = acquire(&mut tracker, &hand, &mut noise);
        for shown in [true, false, false, true, true] {
            let picture = if shown { picture(&hand, &mut noise) } else { empty(&mut noise) };
            let track = update(&mut tracker, &picture, time_s);
            time_s += FRAME_S;
            assert_eq!(track.status, Status::Tracking);
            assert_eq!(track.finger_line.is_some(), shown, "{model:?}");
        }
    }
}

/// Asserts that a resting hand is tracked at any frame intervals.
fn check_gaps(gaps_s: &[f64]) {
    for model in MODELS {
        let (mut tracker, mut noise) = (tracker(model, Thumb::Left), Noise::new(0x7061_7573));
        let hand = held_up(Thumb::Left);
        let mut time_s = acquire(&mut tracker, &hand, &mut noise);
        for gap_s in gaps_s {
            time_s += gap_s;
            let track = update(&mut tracker, &picture(&hand, &mut noise), time_s);
            let line = track.finger_line;
            assert!(line.is_some(), "{model:?}: not seen {gap_s} s after the last: {track:?}");
            assert!(LineError::of(&line.unwrap(), &hand).tip_px < 0.6, "{model:?}, {gap_s} s");
        }
    }
}

#[test]
fn a_pause_does_not_lose_a_resting_hand() {
    check_gaps(&[FRAME_S, 2.0, FRAME_S, FRAME_S, 60.0, FRAME_S, 3600.0]);
}

#[test]
fn frames_at_nearly_equal_times_do_not_lose_a_resting_hand() {
    // As drivers deliver frames after a delay.
    check_gaps(&[FRAME_S, 1e-6, FRAME_S, 0.0, FRAME_S, 1e-9, FRAME_S]);
}

/// A table cluttered with bars, some as wide as a finger, none as bright as the hand.
fn strewn(hand: &Hand, noise: &mut Noise) -> Picture {
    let mut canvas = Canvas::new(320, 200, BACKGROUND);
    let mut random = Noise::new(0x7374_7265);
    for _ in 0..14 {
        let at = Point2::new(random.between(0.0, 320.0), random.between(0.0, 200.0));
        let angle_rad = random.between(-PI, PI);
        let bar = Hand::usual(Thumb::None, at, angle_rad, random.between(30.0, 90.0));
        canvas = canvas.paint(&bar, random.between(20.0, 105.0));
    }
    canvas.paint(hand, HAND).blur(BLUR_PX).take(NOISE, noise)
}

#[test]
fn a_hand_that_reverses_at_full_speed_is_followed() {
    // 22 px and 0.1 rad per frame; at a reversal the hand is 44 px from its prediction.
    for model in MODELS {
        for thumb in [Thumb::Left, Thumb::None] {
            let at = |k: usize| {
                let phase = (k.max(5) - 5) % 14;
                let swing = phase.min(14 - phase) as f64;
                let tip = Point2::new(120.0 + 22.0 * swing, 120.0 - 4.0 * swing);
                Hand::usual(thumb, tip, -0.6 + 0.1 * swing, LENGTH_PX)
            };
            let Hand { tip_px, angle_rad, length_px, .. } = at(0);
            let start = StartPose { tip_px, angle_rad, length_px };
            let template = Template::pistol(thumb).unwrap();
            let mut tracker = ContourTracker::new(template, &start, options(model)).unwrap();
            let mut noise = Noise::new(0x7475_726e);
            for k in 0..40 {
                let hand = at(k);
                let track = update(&mut tracker, &strewn(&hand, &mut noise), k as f64 * FRAME_S);
                if k < 4 {
                    continue;
                }
                let what = format!("{model:?} {thumb:?}, frame {k}");
                let error = LineError::of(&track.finger_line.expect(&what), &hand);
                assert!(error.tip_px < 1.0 && error.angle_rad.abs() < 0.02, "{what}: {error:?}");
            }
        }
    }
}

#[test]
fn the_innovation_is_large_for_a_jump_and_small_for_uniform_motion() {
    let beyond = fingerpost_core::solve::dynamics::chi_square_quantile(0.9999, 3).unwrap();
    for model in MODELS {
        let (mut tracker, mut noise) = (tracker(model, Thumb::None), Noise::new(0x6a75_6d70));
        let hand = held_up(Thumb::None);
        let mut time_s = acquire(&mut tracker, &hand, &mut noise);
        let mut step = |offset: Vector2<f64>, after_s: f64| {
            let hand = Hand { tip_px: hand.tip_px + offset, ..hand };
            let track = update(&mut tracker, &picture(&hand, &mut noise), time_s + after_s);
            time_s += FRAME_S + after_s;
            assert!(track.finger_line.is_some());
            track.diagnostics.innovation
        };
        let velocity = Vector2::new(-3.0, 2.0);
        for k in 1..8 {
            let innovation = step(velocity * f64::from(k), 0.0).unwrap();
            assert!(k < 3 || innovation < 1.0, "{model:?}: {innovation}");
        }
        let jump = Vector2::new(-50.0, 35.0);
        assert!(step(jump, 0.0).unwrap() > beyond, "{model:?}");
        // After a long pause there is no prediction, hence no innovation.
        assert_eq!(step(jump, 2.0), None, "{model:?}");
        assert!(step(jump, 0.0).is_some());
    }
}

#[test]
fn earlier_times_are_refused() {
    let (mut tracker, mut noise) = (tracker(Model::Ribbon, Thumb::None), Noise::new(0x7469_6d65));
    let hand = held_up(Thumb::None);
    let shown = picture(&hand, &mut noise);
    let frame = Frame::gray(shown.view());
    for time_s in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
        let error = tracker.update(&frame, time_s).unwrap_err();
        assert!(matches!(error, Error::NotFinite { what: "frame time [s]", .. }), "{error}");
    }
    // A clock may start anywhere.
    let mut time_s = -1e6;
    for _ in 0..4 {
        update(&mut tracker, &shown, time_s);
        time_s += FRAME_S;
    }
    let error = tracker.update(&frame, time_s - 2.0 * FRAME_S).unwrap_err();
    assert!(
        matches!(error, Error::OutOfRange { what: "frame time [s]", value, .. } if value < time_s),
        "{error}"
    );
    assert!(error.to_string().contains("at or after the last frame's"), "{error}");
    // A refused frame has no effect; an equal time is accepted.
    for _ in 0..2 {
        assert!(update(&mut tracker, &shown, time_s).finger_line.is_some());
    }
}

#[test]
fn the_same_frames_give_the_same_bits() {
    for model in MODELS {
        let mut trackers = [(); 2].map(|()| Box::new(tracker(model, Thumb::Right)));
        let mut noise = Noise::new(0x7361_6d65);
        for k in 0..14 {
            let away = (8..11).contains(&k);
            let hand = swaying(Thumb::Right, k);
            let picture = if away { empty(&mut noise) } else { picture(&hand, &mut noise) };
            let [one, other] = trackers.each_mut().map(|t| update(t, &picture, k as f64 * FRAME_S));
            assert_eq!(one, other);
            assert_eq!(trackers[0].contour(), trackers[1].contour());
            // A copy of a tracker continues like the original.
            trackers[1] = trackers[0].clone();
        }
    }
}

#[test]
fn a_traced_outline_is_tracked_by_the_paper_s_model() {
    // As if traced around a hand with its thumb, at another place in another image.
    let elsewhere = AffineMap::upright(Point2::new(400.0, 300.0), 2.0, 140.0).unwrap();
    let pistol = Template::pistol(Thumb::Left).unwrap();
    let outline: Vec<_> =
        pistol.samples(400).unwrap().iter().map(|s| elsewhere.transform(&s.position)).collect();
    let on_axis = |p| elsewhere.transform(&Point2::new(p, 0.0));
    let axis = OutlineAxis { knuckle: on_axis(-HALF_LENGTH), tip: on_axis(HALF_LENGTH) };
    let traced = Template::from_outline(&outline, &axis, pistol.hand(), 40).unwrap();

    let refused = ContourTracker::new(traced.clone(), &START, options(Model::Ribbon)).unwrap_err();
    assert!(matches!(refused, Error::Unsupported { what: "the band model", .. }), "{refused}");

    let mut tracker = ContourTracker::new(traced, &START, options(Model::Paper)).unwrap();
    let mut noise = Noise::new(0x7472_6163);
    for k in 0..25 {
        let hand = swaying(Thumb::Left, k);
        let track = update(&mut tracker, &picture(&hand, &mut noise), k as f64 * FRAME_S);
        if k > 4 {
            let line = track.finger_line.expect("tracked");
            let error = LineError::of(&line, &hand);
            assert!(error.offset_px.abs() < 0.15 && error.angle_rad.abs() < 0.008, "{error:?}");
            assert!(error.tip_px < 0.6, "{error:?}");
        }
    }
}

#[test]
fn the_fields_of_a_track_are_consistent() {
    for (model, thumb, names) in [
        (Model::Ribbon, Thumb::Left, 9),
        (Model::Ribbon, Thumb::None, 5),
        (Model::Paper, Thumb::Right, 4),
        (Model::Paper, Thumb::None, 3),
    ] {
        let (mut tracker, mut noise) = (tracker(model, thumb), Noise::new(0x7374_6f72));
        let hand = held_up(thumb);
        let time_s = acquire(&mut tracker, &hand, &mut noise);
        let track = update(&mut tracker, &picture(&hand, &mut noise), time_s);
        let (shape, line, diagnostics) =
            (track.shape.unwrap(), track.finger_line.unwrap(), track.diagnostics);
        assert_eq!(track.time_s, time_s);
        assert_eq!((shape.names.len(), diagnostics.rank), (names, names), "{model:?} {thumb:?}");
        assert!(shape.vector.iter().skip(names).all(|&x| x == 0.0));
        let covariance = shape.covariance;
        for i in 0..covariance.nrows() {
            for j in 0..covariance.ncols() {
                let used = i < names && j < names;
                assert!(used || covariance[(i, j)] == 0.0);
                assert!((covariance[(i, j)] - covariance[(j, i)]).abs() < 1e-9);
            }
        }
        assert!((0..names).all(|i| covariance[(i, i)] > 0.0));
        // The line passes through the centre in the shape vector; refinement by the pixels moves it
        // by less than the contour's error.
        let (near_px, near_rad) = match line.source {
            LineSource::Contour => (1e-9, 1e-9),
            LineSource::Pixels | LineSource::Both => (0.2, 0.01),
        };
        assert_eq!(line.source == LineSource::Pixels, model == Model::Ribbon, "{thumb:?}");
        let centre = Point2::new(shape.vector[0], shape.vector[1]);
        assert!((centre - line.axis.anchor).dot(&line.axis.normal()).abs() < near_px);
        assert!(turn(shape.vector[2], line.axis.angle_rad).abs() < near_rad);
        if line.source == LineSource::Contour {
            assert!((covariance[(2, 2)] - line.covariance[(1, 1)]).abs() < 1e-12);
        } else {
            assert!(line.covariance[(1, 1)] < covariance[(2, 2)], "refined in vain");
        }

        assert!(diagnostics.accepted && diagnostics.iterations >= 1);
        assert!(diagnostics.inliers <= diagnostics.hits && diagnostics.hits <= diagnostics.visible);
        assert!(
            diagnostics.visible <= tracker.options().samples
                && diagnostics.inliers > diagnostics.visible / 2
        );
        assert!(diagnostics.residual_rms_px > 0.0 && diagnostics.residual_rms_px < 0.5);
        assert_eq!(tracker.search_lines().len(), diagnostics.visible);
        assert_eq!(tracker.search_lines().filter(|s| s.found.is_ok()).count(), diagnostics.hits);
        assert_eq!(tracker.search_lines().filter(|s| s.agrees).count(), diagnostics.inliers);
        assert!(tracker.search_lines().all(|s| s.found.is_ok() || !s.agrees));
        assert!(
            diagnostics.agreement >= diagnostics.min_agreement && diagnostics.min_agreement > 0.0
        );
        assert!(diagnostics.residual_rms_px <= diagnostics.max_residual_px);
        // The contour is at the edge of the hand.
        let contour = tracker.contour();
        assert_eq!(contour.len(), diagnostics.visible);
        for placed in contour {
            let (depth, outward) = hand.depth(placed.position);
            assert!(depth.abs() < 0.6, "{model:?} {thumb:?} {depth} at {placed:?}");
            assert!(depth.abs() > 0.5 || placed.normal.dot(&outward) > 0.8, "{placed:?}");
        }
    }
}

#[test]
fn a_dark_hand_and_one_of_unknown_polarity() {
    for (polarity, hand_grey) in
        [(Polarity::Dark, 20.0), (Polarity::Unknown, 20.0), (Polarity::Unknown, 220.0)]
    {
        let options = TrackerOptions { polarity, ..options(Model::Ribbon) };
        let template = Template::pistol(Thumb::None).unwrap();
        let mut tracker = ContourTracker::new(template, &START, options).unwrap();
        let (hand, mut noise) = (held_up(Thumb::None), Noise::new(0x6461_726b));
        let canvas = Canvas::new(WIDTH, HEIGHT, 120.0).paint(&hand, hand_grey).blur(BLUR_PX);
        let mut line = None;
        for k in 0..5 {
            line = update(&mut tracker, &canvas.take(NOISE, &mut noise), f64::from(k)).finger_line;
        }
        assert!(LineError::of(&line.unwrap(), &hand).tip_px < 0.4, "{polarity:?}");
    }
}

#[test]
fn colours_may_come_and_go() {
    for model in MODELS {
        let (mut tracker, mut noise) = (tracker(model, Thumb::Left), Noise::new(0x636f_6c6f));
        for k in 0..12 {
            let hand = swaying(Thumb::Left, k);
            let picture = picture(&hand, &mut noise);
            let bytes: Vec<u8> =
                picture.bytes.iter().flat_map(|&g| [g, g / 2 + 30, 255 - g]).collect();
            let colours = ColourView::new(&bytes, WIDTH, HEIGHT, 3 * WIDTH).unwrap();
            let frame = match k % 3 {
                0 => Frame::gray(picture.view()),
                _ => Frame::coloured(picture.view(), colours).unwrap(),
            };
            let track = tracker.update(&frame, k as f64 * FRAME_S).unwrap();
            assert!(k < 4 || track.finger_line.is_some(), "{model:?}, frame {k}");
        }
    }
}

#[test]
fn every_instruction_set_tracks_a_recording_to_the_same_bits() {
    for model in MODELS {
        let mut noise = Noise::new(0x6269_7473);
        let film: Vec<_> =
            (0..12).map(|k| picture(&swaying(Thumb::Right, k), &mut noise)).collect();
        let tracked = |isa| {
            let mut tracker = tracker(model, Thumb::Right).with_isa(isa);
            let times = (0..).map(|k| f64::from(k) * FRAME_S);
            film.iter().zip(times).map(|(p, t)| update(&mut tracker, p, t)).collect::<Vec<_>>()
        };
        let reference = tracked(Isa::Scalar);
        assert!(reference.iter().filter(|track| track.finger_line.is_some()).count() >= 8);
        for isa in Isa::available() {
            assert_eq!(tracked(isa), reference, "{model:?} {isa}");
        }
    }
}

#[test]
fn frames_may_change_their_size() {
    for model in MODELS {
        let (mut tracker, mut noise) = (tracker(model, Thumb::Left), Noise::new(0x6672_616d));
        let hand = held_up(Thumb::Left);
        let time_s = acquire(&mut tracker, &hand, &mut noise);
        for (k, (width, height)) in [(1, 1), (1, 400), (400, 1), (100, 80)].into_iter().enumerate()
        {
            let odd = Canvas::new(width, height, HAND).take(NOISE, &mut noise);
            update(&mut tracker, &odd, time_s + k as f64 * FRAME_S);
        }
        let track = update(&mut tracker, &picture(&hand, &mut noise), time_s + 1.0);
        assert!(track.finger_line.is_some(), "{model:?} {track:?}");
    }
}

#[test]
fn a_start_pose_outside_the_image_waits_there() {
    let shown = picture(&held_up(Thumb::Left), &mut Noise::new(0x6f75_7473));
    for model in MODELS {
        for (u, v) in [(-500.0, 60.0), (130.0, 1e5), (1e9, -1e9)] {
            let start = StartPose { tip_px: Point2::new(u, v), ..START };
            let template = Template::pistol(Thumb::Left).unwrap();
            let mut tracker = ContourTracker::new(template, &start, options(model)).unwrap();
            for k in 0..2 {
                let track = update(&mut tracker, &shown, f64::from(k));
                assert_eq!((track.status, track.diagnostics.hits), (Status::Acquiring, 0));
            }
        }
    }
}

#[test]
fn a_minimum_contrast_of_zero_is_no_error() {
    // With a minimum contrast of zero there are edges everywhere, in a picture of two flat halves
    // even where the gradient is nearly zero.
    let bytes: Vec<u8> =
        (0..WIDTH * HEIGHT).map(|i| if i % WIDTH < 110 { 150 } else { 60 }).collect();
    let picture = Picture { width: WIDTH, height: HEIGHT, bytes };
    for polarity in [Polarity::Bright, Polarity::Dark, Polarity::Unknown] {
        let search = SearchOptions { min_contrast_grey: 0.0, ..SearchOptions::default() };
        let options = TrackerOptions { search, polarity, ..options(Model::Ribbon) };
        let template = Template::pistol(Thumb::None).unwrap();
        let mut tracker = ContourTracker::new(template, &START, options).unwrap();
        let track = tracker.update(&picture.view().into(), 0.0);
        assert!(track.is_ok(), "{polarity:?}: {track:?}");
    }
}

#[test]
fn a_hand_as_large_as_a_large_image_is_no_error() {
    // Search lines are limited to 128 px, but a hand may be ten times as large.
    let start = StartPose { tip_px: Point2::new(1200.0, 190.0), angle_rad: 0.0, length_px: 1100.0 };
    let hand = Hand::usual(Thumb::Left, start.tip_px, start.angle_rad, start.length_px);
    let canvas = Canvas::new(1250, 380, BACKGROUND).paint(&hand, HAND).blur(BLUR_PX);
    let picture = canvas.take(NOISE, &mut Noise::new(0x6c61_7267));
    let template = Template::pistol(Thumb::Left).unwrap();
    let mut tracker = ContourTracker::new(template, &start, options(Model::Ribbon)).unwrap();
    for k in 0..2 {
        let track = tracker.update(&picture.view().into(), f64::from(k) * FRAME_S);
        assert!(track.is_ok(), "{track:?}");
    }
}

/// The picture of a finger much larger than the longest search lines, and its start pose.
fn vast() -> (Picture, StartPose) {
    let start =
        StartPose { tip_px: Point2::new(1650.0, 450.0), angle_rad: 0.02, length_px: 1500.0 };
    let tip_px = start.tip_px + Vector2::new(-3.0, -4.0);
    let hand = Hand::usual(Thumb::None, tip_px, 0.0, start.length_px);
    let canvas = Canvas::new(1900, 900, BACKGROUND).paint(&hand, HAND).blur(BLUR_PX);
    (canvas.take(NOISE, &mut Noise::new(0x7661_7374)), start)
}

#[test]
fn the_loss_of_a_vast_hand_is_a_status_and_no_error() {
    let (picture, start) = vast();
    let empty = Picture { bytes: vec![60; picture.bytes.len()], ..picture.clone() };
    for model in MODELS {
        let options = options(model);
        let track = TrackOptions { lose_after_frames: 2, ..options.track };
        let options = TrackerOptions { track, ..options };
        let template = Template::pistol(Thumb::None).unwrap();
        let mut tracker = ContourTracker::new(template, &start, options).unwrap();
        let shown = [&picture, &picture, &picture, &empty, &empty, &empty].into_iter().enumerate();
        let statuses =
            shown.map(|(k, picture)| update(&mut tracker, picture, k as f64 * FRAME_S).status);
        let statuses: Vec<_> = statuses.collect();
        let left = [Status::Tracking, Status::Tracking, Status::Lost, Status::Lost];
        assert_eq!(statuses[2..], left, "{model:?}");
    }
}

/// Sets one of a tracker's options.
type Set = fn(&mut TrackerOptions, f64);

#[test]
fn options_out_of_range_are_refused_with_their_value() {
    let ranges: [(&str, Set, &[f64]); 21] = [
        ("contour samples", |o, x| o.samples = x as usize, &[0.0, 7.0, 2001.0]),
        ("most iterations", |o, x| o.max_iterations = x as usize, &[0.0, 101.0]),
        ("correlation of neighbours", |o, x| o.correlation = x, &[0.99, -1.0]),
        (
            "search half-length [px]",
            |o, x| o.acquire.half_length_px = x,
            &[0.0, 0.99, 128.5, -20.0],
        ),
        ("search half-length [px]", |o, x| o.track.half_length_px = x, &[0.0, 0.99, 128.5]),
        ("least inliers", |o, x| o.acquire.accept.min_inliers = x, &[-0.1, 1.1]),
        ("least inliers", |o, x| o.track.accept.min_inliers = x, &[-0.1, 1.1]),
        ("largest residual [px]", |o, x| o.acquire.accept.max_residual_px = x, &[0.0, -2.0]),
        ("largest residual [px]", |o, x| o.track.accept.max_residual_px = x, &[0.0, -2.0]),
        ("settle change", |o, x| o.acquire.settle_change = x, &[0.0, -0.1]),
        ("largest scale", |o, x| o.acquire.max_scale = x, &[1.0, 0.5]),
        ("frames in a row", |o, x| o.acquire.settle_frames = x as usize, &[0.0]),
        ("frames in a row", |o, x| o.track.lose_after_frames = x as usize, &[0.0]),
        ("appearance rate", |o, x| o.track.appearance_rate = x, &[-0.1, 1.5]),
        (
            "acceleration [px/s²]",
            |o, x| o.track.dynamics.acceleration_px_s2 = x,
            &[0.0, -1.0, 100_001.0],
        ),
        ("acceleration [rad/s²]", |o, x| o.track.dynamics.acceleration_rad_s2 = x, &[0.0, 1001.0]),
        ("acceleration lasts [s]", |o, x| o.track.dynamics.acceleration_lasts_s = x, &[0.0, 1.5]),
        ("first speed [px/s]", |o, x| o.track.dynamics.first_speed_px_s = x, &[-1.0, 100_001.0]),
        ("first speed [rad/s]", |o, x| o.track.dynamics.first_speed_rad_s = x, &[-1.0, 101.0]),
        ("confidence of the gate", |o, x| o.track.dynamics.confidence = x, &[0.0, 0.49, 1.0]),
        ("longest gap [s]", |o, x| o.track.dynamics.longest_gap_s = x, &[0.0, 61.0]),
    ];
    let refusal = |set: Set, x: f64| {
        let mut options = TrackerOptions::default();
        set(&mut options, x);
        let template = Template::pistol(Thumb::None).unwrap();
        ContourTracker::new(template, &START, options).err().map(|error| error.to_string())
    };
    for (what, set, values) in ranges {
        for &value in values {
            let message = refusal(set, value).expect(what);
            assert!(message.starts_with(&format!("{what} is {value}; it must be ")), "{message}");
        }
        let counts = ["contour samples", "most iterations", "frames in a row"];
        if !counts.contains(&what) {
            for value in [f64::NAN, f64::INFINITY] {
                let message = refusal(set, value).expect(what);
                assert_eq!(message, format!("{what} is {value}; it must be finite"));
            }
        }
    }
    // The options of the stages below are checked as well.
    let search: Set = |o, x| o.search.scale_px = x;
    let fit: Set = |o, x| o.fit = FitOptions { loss: Loss::Tukey { cutoff: x }, ..o.fit };
    assert!(refusal(search, 0.4).unwrap().starts_with("search scale [px] is 0.4"));
    assert!(refusal(fit, 0.5).unwrap().starts_with("Tukey cutoff [robust sigma] is 0.5"));
}

/// A picture with every pixel enlarged to a square of `times` × `times`.
fn magnified(picture: &Picture, times: usize) -> Picture {
    let (width, height) = (times * picture.width, times * picture.height);
    let at = |i: usize| picture.bytes[i / width / times * picture.width + i % width / times];
    Picture { width, height, bytes: (0..width * height).map(at).collect() }
}

#[test]
fn an_enlarged_hand_is_followed_equally() {
    // The half-width is 6.4 px; at three times that, the tracker uses a picture a third as large.
    let usually = StartPose { length_px: 56.0, ..START };
    for (times, thumb) in [(2, Thumb::Left), (3, Thumb::None)] {
        let px = times as f64;
        let place = |p: Point2<f64>| p.map(|c| px * c + 0.5 * (px - 1.0));
        let length_px = px * usually.length_px;
        let start = StartPose { tip_px: place(START.tip_px), length_px, ..START };
        let tracker = |start: &StartPose| {
            let template = Template::pistol(thumb).unwrap();
            ContourTracker::new(template, start, options(Model::Ribbon)).unwrap()
        };
        let (mut large, mut usual) = (tracker(&start), tracker(&usually));
        assert_eq!(large.contour().len(), usual.contour().len());
        let mut noise = Noise::new(23);
        let mut lines = 0;
        for k in 0..12 {
            let (picture, time_s) = (picture(&swaying(thumb, k), &mut noise), k as f64 * FRAME_S);
            let expected = update(&mut usual, &picture, time_s);
            let track = update(&mut large, &magnified(&picture, times), time_s);
            assert_eq!(track.status, expected.status);
            for (at, expected) in large.contour().iter().zip(usual.contour()) {
                assert!((at.position - place(expected.position)).norm() < 1e-6, "frame {k}");
            }
            for (at, expected) in large.search_lines().zip(usual.search_lines()) {
                assert!(
                    (at.line.sample.position - place(expected.line.sample.position)).norm() < 1e-6
                );
                assert_eq!(at.line.half_length_px, px * expected.line.half_length_px);
                let offset = |found: &SearchedLine<'_>| found.found.ok().map(|e| e.offset_px);
                assert_eq!(offset(&at), offset(&expected).map(|offset_px| px * offset_px));
                assert_eq!(at.agrees, expected.agrees);
            }
            let (diagnostics, usually) = (&track.diagnostics, &expected.diagnostics);
            assert!((diagnostics.residual_rms_px - px * usually.residual_rms_px).abs() < 1e-9);
            assert_eq!(diagnostics.max_residual_px, px * usually.max_residual_px);
            if let (Some(shape), Some(expected)) = (track.shape, expected.shape) {
                assert!(
                    (shape.vector.xy() - place(expected.vector.xy().into()).coords).norm() < 1e-6
                );
                // Angle and taper do not scale.
                for (i, unit) in [(2, 1.0), (3, px), (4, 1.0)] {
                    assert!((shape.vector[i] - unit * expected.vector[i]).abs() < 1e-9);
                    let sigmas = [&shape, &expected].map(|s| s.covariance[(i, i)].sqrt());
                    assert!((sigmas[0] - unit * sigmas[1]).abs() < 1e-9);
                }
            }
            let (Some(line), Some(expected)) = (track.finger_line, expected.finger_line) else {
                continue;
            };
            lines += 1;
            assert!((line.axis.anchor - place(expected.axis.anchor)).norm() < 1e-6);
            assert!((line.axis.tip - place(expected.axis.tip)).norm() < 1e-6);
            assert!((line.axis.angle_rad - expected.axis.angle_rad).abs() < 1e-9);
            assert!((line.half_length_px - px * expected.half_length_px).abs() < 1e-6);
            let unit = Matrix2::new(px, 0.0, 0.0, 1.0);
            let covariance = unit * expected.covariance * unit;
            assert!((line.covariance - covariance).norm() < 1e-9 * covariance.norm());
            assert_eq!(line.source, expected.source);
        }
        assert!(lines >= 10, "{lines}");
    }
}

/// Actual and reported standard deviation of the finger line's angle \[rad\] for sharp pictures of
/// a hand of a given length.
fn angle_of_large(length_px: f64) -> [f64; 2] {
    const HANDS: usize = 12;
    let (size, tip) = (length_px * 2.6, Point2::new(length_px * 2.0, length_px * 0.8));
    let mut noise = Noise::new(5);
    let (mut squares, mut variances) = (0.0, 0.0);
    for k in 0..HANDS {
        let angle_rad = START.angle_rad + 0.03 * k as f64;
        let hand = Hand::usual(Thumb::None, tip, angle_rad, length_px);
        let start = StartPose { tip_px: tip, angle_rad, length_px };
        let template = Template::pistol(Thumb::None).unwrap();
        let mut tracker = ContourTracker::new(template, &start, options(Model::Ribbon)).unwrap();
        let canvas = Canvas::new(size as usize, size as usize, BACKGROUND).paint(&hand, HAND);
        let canvas = canvas.blur(BLUR_PX);
        let tracks = [0, 1]
            .map(|k| update(&mut tracker, &canvas.take(NOISE, &mut noise), f64::from(k) * FRAME_S));
        let line = tracks[1].finger_line.expect("a large hand");
        assert_eq!(line.source, LineSource::Pixels);
        squares += LineError::of(&line, &hand).angle_rad.powi(2);
        variances += line.covariance[(1, 1)];
    }
    [squares, variances].map(|sum| (sum / HANDS as f64).sqrt())
}

#[test]
fn a_sharp_picture_of_a_large_hand_is_used_at_full_resolution() {
    // The standard deviation goes with the length of the flanks to the power of −3/2; from means of
    // 2 × 2 pixels it would be larger by an eighth.
    let [usual, large] = [60.0, 120.0].map(angle_of_large);
    assert!(large[0] < 0.5 * usual[0], "{large:?} {usual:?}");
    assert!(large[1] < 0.37 * usual[1], "{large:?} {usual:?}");
    assert!((0.5..2.0).contains(&(large[0] / large[1])), "{large:?}");
}

#[test]
fn an_invalid_start_pose_is_refused() {
    let refusal = |start: StartPose| {
        let template = Template::pistol(Thumb::Left).unwrap();
        ContourTracker::new(template, &start, TrackerOptions::default()).unwrap_err().to_string()
    };
    for length_px in [0.0, -60.0] {
        let message = refusal(StartPose { length_px, ..START });
        assert_eq!(message, format!("finger length [px] is {length_px}; it must be positive"));
    }
    for bad in [f64::NAN, f64::INFINITY] {
        for start in [
            StartPose { tip_px: Point2::new(bad, 0.0), ..START },
            StartPose { tip_px: Point2::new(0.0, bad), ..START },
            StartPose { angle_rad: bad, ..START },
            StartPose { length_px: bad, ..START },
        ] {
            let message = refusal(start);
            assert!(message.ends_with(&format!("is {bad}; it must be finite")), "{message}");
        }
    }
}

/// Small pictures of any bytes, of noise and of black and white.
fn pictures() -> impl Strategy<Value = Picture> {
    let side = || prop_oneof![Just(1_usize), 1..48_usize];
    let byte = prop_oneof![Just(0_u8), Just(255_u8), any::<u8>()];
    (side(), side()).prop_flat_map(move |(width, height)| {
        prop::collection::vec(byte.clone(), width * height).prop_map(move |bytes| Picture {
            width,
            height,
            bytes,
        })
    })
}

fn starts() -> impl Strategy<Value = StartPose> {
    let coordinate = || prop_oneof![0.0..48.0, -50.0..100.0, Just(1e6), Just(-1e9)];
    let length = prop_oneof![Just(0.01), 0.5..5.0, 5.0..80.0, Just(500.0), Just(1e6)];
    (coordinate(), coordinate(), -7.0..7.0, length).prop_map(|(u, v, angle_rad, length_px)| {
        StartPose { tip_px: Point2::new(u, v), angle_rad, length_px }
    })
}

/// Options that accept nearly anything, so that every state is reached.
fn any_options() -> impl Strategy<Value = TrackerOptions> {
    let model = prop_oneof![Just(Model::Ribbon), Just(Model::Paper)];
    let polarity =
        prop_oneof![Just(Polarity::Bright), Just(Polarity::Dark), Just(Polarity::Unknown)];
    let accept = || {
        prop_oneof![Just(0.0), 0.0..0.5]
            .prop_map(|min_inliers| AcceptOptions { min_inliers, max_residual_px: 50.0 })
    };
    let counts = (8..20_usize, 1..4_usize, 1..3_usize, 1..3_usize);
    let lengths = (prop_oneof![Just(1.0), 1.0..25.0, Just(128.0)], 1.0..30.0);
    (model, polarity, counts, lengths, (accept(), accept())).prop_map(
        |(model, polarity, counts, lengths, (waiting, tracking))| {
            let (samples, max_iterations, settle_frames, lose_after_frames) = counts;
            let usual = TrackerOptions::default();
            TrackerOptions {
                model,
                polarity,
                samples,
                max_iterations,
                acquire: AcquireOptions {
                    half_length_px: lengths.0,
                    accept: waiting,
                    settle_frames,
                    settle_change: 10.0,
                    max_scale: 20.0,
                },
                track: TrackOptions {
                    half_length_px: lengths.1,
                    accept: tracking,
                    lose_after_frames,
                    ..usual.track
                },
                ..usual
            }
        },
    )
}

/// [`vast`], rendered once.
static VAST: OnceLock<(Picture, StartPose)> = OnceLock::new();

/// Shows the tracker one more frame and checks that its result is valid.
fn check_any(tracker: &mut ContourTracker, picture: &Picture, coloured: bool, k: usize) -> Status {
    let Picture { width, height, bytes } = picture;
    let gray = GrayView::new(bytes, *width, *height, *width).unwrap();
    let colours: Vec<u8> = if coloured {
        bytes.iter().flat_map(|&g| [g, 255 - g, g / 3]).collect()
    } else {
        Vec::new()
    };
    let frame = if coloured {
        let colours = ColourView::new(&colours, *width, *height, 3 * width).unwrap();
        Frame::coloured(gray, colours).unwrap()
    } else {
        Frame::gray(gray)
    };
    let track = tracker.update(&frame, k as f64 * FRAME_S).unwrap();
    assert!(track.finger_line.is_none() || track.status == Status::Tracking);
    if let Some(FingerLine { axis, covariance, .. }) = track.finger_line {
        assert!(axis.angle_rad > -PI - 1e-12 && axis.angle_rad <= PI, "{axis:?}");
        assert!(axis.tip.iter().chain(axis.anchor.iter()).all(|x| x.is_finite()), "{axis:?}");
        assert!(covariance.iter().all(|x| x.is_finite()), "{covariance}");
        assert!(covariance[(0, 0)] > 0.0 && covariance[(1, 1)] > 0.0, "{covariance}");
    }
    let (diagnostics, samples) = (track.diagnostics, tracker.options().samples);
    assert!(
        diagnostics.inliers <= diagnostics.visible && diagnostics.visible <= samples,
        "{diagnostics:?}"
    );
    assert!(tracker.contour().len() <= samples);
    track.status
}

proptest! {
    #![proptest_config(config(96))]

    #[test]
    fn any_bytes_from_any_start_give_a_valid_result(
        pictures in prop::collection::vec(pictures(), 1..5),
        start in starts(),
        options in any_options(),
        thumb in prop_oneof![Just(Thumb::Left), Just(Thumb::Right), Just(Thumb::None)],
        coloured in any::<bool>(),
    ) {
        let template = Template::pistol(thumb).unwrap();
        let mut tracker = ContourTracker::new(template, &start, options).unwrap();
        for (k, picture) in pictures.iter().enumerate() {
            check_any(&mut tracker, picture, coloured, k);
        }
    }

    #[test]
    fn any_bytes_after_a_hand_give_a_valid_result(
        pictures in prop::collection::vec(pictures(), 1..10),
        options in any_options(),
        thumb in prop_oneof![Just(Thumb::Left), Just(Thumb::None)],
        coloured in any::<bool>(),
    ) {
        // With such permissive options the tracker follows anything.
        let start = StartPose { tip_px: Point2::new(62.0, 22.0), angle_rad: -0.3, length_px: 40.0 };
        let hand = Hand::usual(thumb, start.tip_px, start.angle_rad, start.length_px);
        let shown = Canvas::new(80, 64, BACKGROUND).paint(&hand, HAND).blur(BLUR_PX);
        let shown = shown.take(NOISE, &mut Noise::new(0x666f_6c6c));
        let acquire = AcquireOptions { half_length_px: 10.0, ..options.acquire };
        let options = TrackerOptions {
            samples: 40,
            max_iterations: 4,
            polarity: Polarity::Bright,
            acquire,
            ..options
        };
        let template = Template::pistol(thumb).unwrap();
        let mut tracker = ContourTracker::new(template, &start, options).unwrap();
        let mut k = 0;
        while check_any(&mut tracker, &shown, coloured, k) != Status::Tracking {
            k += 1;
            prop_assert!(k < 10, "the hand itself is no problem");
        }
        for picture in &pictures {
            k += 1;
            check_any(&mut tracker, picture, coloured, k);
        }
    }
}

proptest! {
    #![proptest_config(config(24))]

    #[test]
    fn any_bytes_after_a_vast_hand_give_a_valid_result(
        pictures in prop::collection::vec((pictures(), 1..60_usize), 1..6),
        options in any_options(),
    ) {
        let (shown, start) = VAST.get_or_init(vast);
        let usual = TrackerOptions::default();
        let options = TrackerOptions {
            // The other model follows large hands at a reduced size.
            model: Model::Paper,
            polarity: Polarity::Bright,
            samples: usual.samples,
            max_iterations: usual.max_iterations,
            acquire: usual.acquire,
            ..options
        };
        let template = Template::pistol(Thumb::None).unwrap();
        let mut tracker = ContourTracker::new(template, start, options).unwrap();
        let mut k = 0;
        while check_any(&mut tracker, shown, false, k) != Status::Tracking {
            k += 1;
            prop_assert!(k < 10, "the hand itself is no problem");
        }
        for (picture, times) in &pictures {
            k += 1;
            check_any(&mut tracker, &magnified(picture, *times), false, k);
        }
    }
}

proptest! {
    #![proptest_config(config(24))]

    #[test]
    fn a_hand_is_found_from_any_direction(angle_rad in 0.0..TAU, off_px in (-4.0..4.0, -4.0..4.0)) {
        for model in MODELS {
            // In the middle, so that the whole hand is in the image.
            let middle = Point2::new(100.0, 75.0);
            let ahead = Vector2::new(angle_rad.cos(), angle_rad.sin()) * (0.5 * LENGTH_PX);
            let start = StartPose { tip_px: middle + ahead, angle_rad, length_px: LENGTH_PX };
            let tip = start.tip_px + Vector2::new(off_px.0, off_px.1);
            let hand = Hand::usual(Thumb::None, tip, angle_rad, LENGTH_PX);
            let template = Template::pistol(Thumb::None).unwrap();
            let mut tracker = ContourTracker::new(template, &start, options(model)).unwrap();
            let mut noise = Noise::new(0x616e_7964);
            let time_s = acquire(&mut tracker, &hand, &mut noise);
            let line = update(&mut tracker, &picture(&hand, &mut noise), time_s).finger_line;
            let error = LineError::of(&line.unwrap(), &hand);
            prop_assert!(error.tip_px < 0.4 && error.angle_rad.abs() < 0.005, "{:?}", error);
        }
    }
}

#[test]
fn implausible_changes_between_frames_are_refused() {
    let other = |hand: &Hand, refusal: Refusal| match refusal {
        // Like a print, a cable or a second finger under the tip.
        Refusal::Motion => Hand { angle_rad: hand.angle_rad + 0.7, ..*hand },
        _ => Hand { half_width_px: 2.2 * hand.half_width_px, ..*hand },
    };
    for refusal in [Refusal::Motion, Refusal::Size] {
        let mut tracker = tracker(Model::Ribbon, Thumb::None);
        let mut noise = Noise::new(0x7665_7264);
        let hand = held_up(Thumb::None);
        let mut time_s = acquire(&mut tracker, &hand, &mut noise);
        let mut refusals = Vec::new();
        for k in 0..5 {
            let shown = if k < 3 { hand } else { other(&hand, refusal) };
            let track = update(&mut tracker, &picture(&shown, &mut noise), time_s);
            time_s += FRAME_S;
            assert_eq!(track.finger_line.is_some(), k < 3, "{refusal:?}, frame {k}: {track:?}");
            refusals.extend(track.diagnostics.refusal);
        }
        assert!(refusals.contains(&refusal), "{refusals:?}");
    }
}

#[test]
fn a_hand_too_fast_to_follow_between_frames_is_acquired() {
    let mut tracker = tracker(Model::Ribbon, Thumb::None);
    let mut noise = Noise::new(0x6661_7374);
    let lateral = Vector2::new(-START.angle_rad.sin(), START.angle_rad.cos());
    let acquired = (-3..=0).any(|k| {
        let tip = START.tip_px + lateral * ((f64::from(k) + 0.5) * FAST_PX);
        let hand = Hand::usual(Thumb::None, tip, START.angle_rad, LENGTH_PX);
        let time_s = f64::from(k + 3) * FRAME_S;
        let line = update(&mut tracker, &picture(&hand, &mut noise), time_s).finger_line;
        line.is_some_and(|line| (line.axis.tip - tip).norm() < 0.5)
    });
    assert!(acquired);
}

#[test]
fn a_thumb_along_the_finger_does_not_rotate_its_line() {
    for (waiting, side) in [(Thumb::None, 1.0), (Thumb::None, -1.0), (Thumb::Right, 1.0)] {
        for angle_deg in [15.0, 20.0, 30.0, 40.0_f64] {
            let mut hand = held_up(Thumb::Right);
            if let Some(thumb) = &mut hand.thumb {
                (thumb.side, thumb.angle_rad) = (side, angle_deg.to_radians());
                thumb.length_px = 0.6 * LENGTH_PX;
            }
            let (mut tracker, mut noise) =
                (tracker(Model::Ribbon, waiting), Noise::new(0x616c_6f6e));
            let mut time_s = acquire(&mut tracker, &hand, &mut noise);
            for _ in 0..5 {
                let track = update(&mut tracker, &picture(&hand, &mut noise), time_s);
                time_s += FRAME_S;
                let line = track.finger_line.unwrap();
                let error = LineError::of(&line, &hand);
                let what = format!("{waiting:?}, {angle_deg}° to {side}: {error:?}");
                assert!(error.angle_rad.abs() < 0.012 && error.offset_px.abs() < 0.3, "{what}");
                assert!(error.squared_mahalanobis(&line) < 20.0, "{what}");
            }
        }
    }
}

/// A finger aligned with the waiting template, with its joint in the middle.
fn pointing() -> BentFinger {
    let ahead = Vector2::new(START.angle_rad.cos(), START.angle_rad.sin());
    let length_px = 0.5 * LENGTH_PX;
    BentFinger {
        joint_px: START.tip_px - ahead * length_px,
        angle_rad: START.angle_rad,
        bend_rad: 0.0,
        length_px,
        half_width_px: 0.115 * LENGTH_PX,
    }
}

fn picture_of(finger: &BentFinger, noise: &mut Noise) -> Picture {
    let canvas = Canvas::new(WIDTH, HEIGHT, BACKGROUND).paint(finger, HAND);
    canvas.blur(BLUR_PX).take(NOISE, noise)
}

#[test]
fn a_tip_is_found_again_after_an_occluder_has_displaced_the_template() {
    const THICK_PX: f64 = 14.0;
    const BAR: f64 = BACKGROUND - 25.0;
    let hand = held_up(Thumb::None);
    let mut tracker = tracker(Model::Ribbon, Thumb::None);
    let mut noise = Noise::new(0x7075_7368);
    let start_s = acquire(&mut tracker, &hand, &mut noise);
    for k in 0..38 {
        // The bar's near side, behind the tip: the bar approaches from ahead, crosses the tip and
        // moves on.
        let behind_px = 2.5 * f64::from(k) - 40.0;
        let mut canvas = Canvas::new(WIDTH, HEIGHT, BACKGROUND).paint(&hand, HAND);
        for (i, grey) in canvas.grey.iter_mut().enumerate() {
            let at = Point2::new((i % WIDTH) as f64, (i / WIDTH) as f64);
            let back_px = (hand.tip_px - at).dot(&hand.direction());
            if (behind_px - THICK_PX..behind_px).contains(&back_px) {
                *grey = BAR;
            }
        }
        let picture = canvas.blur(BLUR_PX).take(NOISE, &mut noise);
        let track = update(&mut tracker, &picture, start_s + f64::from(k) * FRAME_S);
        assert_eq!(track.status, Status::Tracking, "{k}: {:?}", track.diagnostics);
        if let Some(line) = track.finger_line {
            let error = LineError::of(&line, &hand);
            assert!(error.angle_rad.abs() < 0.1, "{k}: {error:?}");
            // As soon as more of the finger is visible ahead of the bar than behind it.
            if behind_px - THICK_PX > 0.4 * LENGTH_PX {
                assert!(error.tip_px < 3.0, "{k}: {error:?}");
            }
        }
    }
    assert!(tracker.status() == Status::Tracking);
}

#[test]
fn a_bent_finger_is_a_misfit_until_it_is_straight_again() {
    // The bend increases from frame to frame, is held, and decreases.
    for (thumb, step_deg, most) in
        [(Thumb::None, 5.0, 10), (Thumb::None, -5.0, 10), (Thumb::Left, 12.0, 5)]
    {
        let mut tracker = tracker(Model::Ribbon, thumb);
        let (mut noise, mut refusals) = (Noise::new(0x6265_6e64), Vec::new());
        let straight = [0; 30];
        let up = (0..most).chain([most; 6]).chain((0..most).rev());
        let steps: Vec<i32> = straight.into_iter().chain(up).chain([0; 4]).collect();
        for (k, &n) in steps.iter().enumerate() {
            let bend_rad = (step_deg * f64::from(n)).to_radians();
            let finger = pointing().bent(bend_rad);
            let track = update(&mut tracker, &picture_of(&finger, &mut noise), k as f64 * FRAME_S);
            let diagnostics = track.diagnostics;
            let case = format!("frame {k}, {:.0} deg: {diagnostics:?}", bend_rad.to_degrees());
            if k < 6 {
                continue;
            }
            assert_eq!(track.status, Status::Tracking, "{case}");
            // After a bend, the line may be missing for one more frame.
            let before_rad = (step_deg * f64::from(steps[k - 1])).to_radians();
            let is_straight = if refusals.is_empty() {
                bend_rad.abs() < 0.18
            } else {
                bend_rad.abs().max(before_rad.abs()) < 0.1
            };
            if is_straight {
                assert!(track.finger_line.is_some() && diagnostics.refusal.is_none(), "{case}");
            }
            if bend_rad.abs() > 0.42 {
                assert!(track.finger_line.is_none() && track.shape.is_none(), "{case}");
                refusals.extend(diagnostics.refusal);
            }
            if let Some(measured_rad) = diagnostics.bend_rad {
                assert!((measured_rad - bend_rad).abs() < 0.06, "{case}");
            }
        }
        let misfits = refusals.iter().filter(|&&r| r == Refusal::Misfit).count();
        assert!(misfits + 3 >= refusals.len() && misfits > 6, "{refusals:?}");
        let last = picture_of(&pointing(), &mut noise);
        let line = update(&mut tracker, &last, 2.0).finger_line.unwrap();
        assert!(turn(START.angle_rad, line.axis.angle_rad).abs() < 0.003, "{line:?}");
        assert!((line.axis.tip - pointing().tip_px()).norm() < 0.5, "{line:?}");
    }
}

#[test]
fn a_bent_finger_is_not_acquired() {
    let mut tracker = tracker(Model::Ribbon, Thumb::None);
    let mut noise = Noise::new(0x7761_6974);
    let mut refusals = Vec::new();
    for k in 0..10 {
        let finger = pointing().bent(0.42);
        let track = update(&mut tracker, &picture_of(&finger, &mut noise), f64::from(k) * FRAME_S);
        assert!(track.finger_line.is_none(), "frame {k}: {track:?}");
        let Diagnostics { refusal, bend_rad, .. } = track.diagnostics;
        // Only the bend that causes a refusal is reported.
        assert_eq!(bend_rad.is_some(), refusal == Some(Refusal::Misfit), "frame {k}: {track:?}");
        assert!(bend_rad.is_none_or(|rad| (rad - 0.42).abs() < 0.06), "{bend_rad:?}");
        refusals.extend(refusal);
    }
    assert!(refusals.contains(&Refusal::Misfit), "{refusals:?}");
    for k in 10..14 {
        update(&mut tracker, &picture_of(&pointing(), &mut noise), f64::from(k) * FRAME_S);
    }
    assert_eq!(tracker.status(), Status::Tracking);
}

#[test]
fn a_frame_that_acquires_or_recovers_a_hand_reports_its_bend() {
    let mut tracker = tracker(Model::Ribbon, Thumb::None);
    let mut noise = Noise::new(0x746f_6c64);
    let finger = pointing().bent(0.1);
    let mut time_s = 0.0;
    for _ in 0..2 {
        let mut track = update(&mut tracker, &picture_of(&finger, &mut noise), time_s);
        while track.status != Status::Tracking {
            time_s += FRAME_S;
            assert!(time_s < 2.0, "{track:?}");
            track = update(&mut tracker, &picture_of(&finger, &mut noise), time_s);
        }
        let diagnostics = track.diagnostics;
        assert!(track.finger_line.is_some(), "{diagnostics:?}");
        assert!(
            diagnostics.bend_rad.is_some_and(|rad| (rad - 0.1).abs() < 0.06),
            "{diagnostics:?}"
        );
        time_s += FRAME_S;
        lose(&mut tracker, &mut time_s, &mut noise);
    }
}

#[test]
fn a_recovered_hand_reports_the_required_agreement() {
    // Only the part next to the knuckle is unchanged; the edges of the front have less weight.
    let mut tracker = tracker(Model::Ribbon, Thumb::None);
    let (hand, mut noise) = (held_up(Thumb::None), Noise::new(0x6167_7265));
    let mut time_s = acquire(&mut tracker, &hand, &mut noise);
    lose(&mut tracker, &mut time_s, &mut noise);
    let behind = Hand { tip_px: hand.tip_px - hand.direction() * (0.3 * LENGTH_PX), ..hand };
    let canvas = Canvas::new(WIDTH, HEIGHT, BACKGROUND).paint(&hand, 220.0).paint(&behind, HAND);
    let shown = canvas.blur(BLUR_PX).take(NOISE, &mut noise);
    let track = update(&mut tracker, &shown, time_s);
    let diagnostics = track.diagnostics;
    assert!(track.finger_line.is_some(), "{track:?}");
    let usual = tracker.options().acquire.accept.min_inliers;
    assert!(
        usual + 0.05 < diagnostics.min_agreement
            && diagnostics.min_agreement <= diagnostics.agreement,
        "{diagnostics:?}"
    );
}

#[test]
fn a_finger_bent_for_longer_than_it_was_straight_is_lost() {
    let mut tracker = tracker(Model::Ribbon, Thumb::None);
    let mut noise = Noise::new(0x7374_6179);
    let mut time_s = 0.0;
    let mut show = |bend_rad: f64| {
        time_s += FRAME_S;
        let picture = picture_of(&pointing().bent(bend_rad), &mut noise);
        update(&mut tracker, &picture, time_s)
    };
    let straight = (0..10).filter(|_| show(0.0).finger_line.is_some()).count();
    let bent = (0..40).take_while(|_| show(0.5).status == Status::Tracking).count();
    assert!((straight - 1..=straight).contains(&bent), "{straight} frames, then {bent}");
    assert!(show(0.0).finger_line.is_some());
}

/// An occluding disc.
struct Disc {
    centre: Point2<f64>,
    radius_px: f64,
}

impl Shape for Disc {
    fn depth(&self, at: Point2<f64>) -> (f64, Vector2<f64>) {
        let away = at - self.centre;
        let distance = away.norm();
        (self.radius_px - distance, away / distance.max(f64::MIN_POSITIVE))
    }
}

#[test]
fn suddenly_occluding_discs_do_not_rotate_the_line_of_a_still_hand() {
    let hand = held_up(Thumb::None);
    let (along, across) =
        (hand.direction(), Vector2::new(-hand.angle_rad.sin(), hand.angle_rad.cos()));
    let disc = |behind: f64, lateral: f64, radius: f64| Disc {
        centre: hand.tip_px + (along * -behind + across * lateral) * hand.half_width_px,
        radius_px: radius * hand.half_width_px,
    };
    // Over the tip and both flanks, brighter and darker than the finger.
    let layouts = [
        [(disc(0.5, 0.3, 1.3), 225.0), (disc(4.5, -1.0, 1.0), 110.0)],
        [(disc(0.8, -0.9, 1.4), 110.0), (disc(3.5, 1.2, 1.1), 30.0)],
        [(disc(1.2, 1.0, 1.5), 225.0), (disc(5.5, 1.0, 1.2), 225.0)],
    ];
    for (which, discs) in layouts.iter().enumerate() {
        let mut tracker = tracker(Model::Ribbon, Thumb::None);
        let mut noise = Noise::new(0x6469_7363);
        let mut time_s = acquire(&mut tracker, &hand, &mut noise);
        let mut reported = 0;
        for k in 0..22 {
            let mut canvas = Canvas::new(WIDTH, HEIGHT, BACKGROUND).paint(&hand, HAND);
            if k >= 10 {
                for (disc, grey) in discs {
                    canvas = canvas.paint(disc, *grey);
                }
            }
            let picture = canvas.blur(BLUR_PX).take(NOISE, &mut noise);
            let line = update(&mut tracker, &picture, time_s).finger_line;
            time_s += FRAME_S;
            let Some(line) = line.filter(|_| k >= 10) else { continue };
            reported += 1;
            let turned = turn(hand.angle_rad, line.axis.angle_rad);
            assert!(turned.abs() < 0.02, "layout {which}, frame {k}: {turned}");
        }
        assert!(reported >= 10, "layout {which}: {reported}");
    }
}

#[test]
fn a_sudden_drop_of_light_does_not_lose_the_hand() {
    for thumb in THUMBS {
        let mut tracker = tracker(Model::Ribbon, thumb);
        let mut noise = Noise::new(0x6c69_6768);
        let mut time_s = acquire(&mut tracker, &swaying(thumb, 0), &mut noise);
        for k in 1..24 {
            let hand = swaying(thumb, k);
            let light = if k < 12 { 1.0 } else { 0.6 };
            let canvas = Canvas::new(WIDTH, HEIGHT, light * BACKGROUND).paint(&hand, light * HAND);
            let picture = canvas.blur(BLUR_PX).take(NOISE, &mut noise);
            let line = update(&mut tracker, &picture, time_s).finger_line;
            time_s += FRAME_S;
            let error = LineError::of(&line.unwrap(), &hand);
            assert!(error.tip_px < 1.0 && error.angle_rad.abs() < 0.02, "{thumb:?} {k}: {error:?}");
        }
    }
}

const PAPER: f64 = 200.0;

impl Canvas {
    /// Paints a finger lit from its left, with linear shading from level `lit` at that flank to
    /// `shaded` at the other.
    fn paint_lit(mut self, finger: &Hand, [lit, shaded]: [f64; 2]) -> Self {
        for (i, grey) in self.grey.iter_mut().enumerate() {
            let at = Point2::new((i % WIDTH) as f64, (i / WIDTH) as f64);
            let (depth, outward) = finger.depth(at);
            let across = (finger.offset_px(&at) / finger.half_width_px).clamp(-1.0, 1.0);
            let level = lit + (shaded - lit) * 0.5 * (across + 1.0);
            *grey += covered_part(depth, &outward) * (level - *grey);
        }
        self
    }
}

/// A waiting tracker for edges of either polarity.
fn waiting_in_grey() -> ContourTracker {
    let options = TrackerOptions::default();
    ContourTracker::new(Template::pistol(Thumb::None).unwrap(), &START, options).unwrap()
}

#[test]
fn a_soft_shadow_beside_a_finger_does_not_bias_its_line() {
    for distance_px in [16.0, 18.0, 20.0] {
        let hand = held_up(Thumb::None);
        let lateral = Vector2::new(-hand.angle_rad.sin(), hand.angle_rad.cos());
        let shadow = Hand { tip_px: hand.tip_px + lateral * distance_px, ..hand };
        let table = Canvas::new(WIDTH, HEIGHT, PAPER).paint(&shadow, 130.0).blur(3.5);
        let scene = table.paint_lit(&hand, [170.0, 135.0]).blur(BLUR_PX);
        let mut tracker = waiting_in_grey();
        let mut noise = Noise::new(0x736f_6674);
        for k in 0..6 {
            let picture = scene.take(NOISE, &mut noise);
            let line = update(&mut tracker, &picture, f64::from(k) * FRAME_S).finger_line;
            if k > 0 {
                let error = LineError::of(&line.unwrap(), &hand);
                assert!(error.offset_px.abs() < 0.3 && error.angle_rad.abs() < 0.01, "{error:?}");
            }
        }
    }
}

/// A sheet of printed text.
fn printed(noise: &mut Noise) -> Canvas {
    let mut sheet = Canvas::new(WIDTH, HEIGHT, PAPER);
    for row in (3..HEIGHT - 4).step_by(14) {
        let mut from = noise.between(0.0, 10.0);
        while from < WIDTH as f64 {
            let to = from + noise.between(5.0, 18.0);
            for line in row..row + 4 {
                sheet.grey[line * WIDTH..][from as usize..(to as usize).min(WIDTH)].fill(80.0);
            }
            from = to + 4.0;
        }
    }
    sheet.blur(0.7)
}

#[test]
fn in_grey_print_under_a_finger_does_not_prevent_acquisition() {
    // The edges of the print are stronger than the finger's and within the reach of the template.
    let hand = held_up(Thumb::None);
    let acquired = (0..12).filter(|seed| {
        let mut noise = Noise::new(0x7072_696e + seed);
        let scene = printed(&mut noise).paint_lit(&hand, [160.0, 130.0]).blur(BLUR_PX);
        let mut tracker = waiting_in_grey();
        let track = (0..6)
            .map(|k| update(&mut tracker, &scene.take(NOISE, &mut noise), f64::from(k) * FRAME_S));
        let error = track.last().unwrap().finger_line.map(|line| LineError::of(&line, &hand));
        error.is_some_and(|e| e.offset_px.abs() < 0.5 && e.angle_rad.abs() < 0.02)
    });
    // With the search over long distances alone it was one of these scenes.
    let acquired = acquired.count();
    assert!(acquired >= 7, "{acquired}");
}
