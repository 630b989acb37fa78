//! Frames without allocation: those of a waiting template, of a tracked hand and of an absent hand.
//! Only the few frames in which a template is fitted to a hand and settles may allocate.

use crate::common::{Canvas, Hand, Noise, Picture};
use fingerpost_core::Frame;
use fingerpost_core::appearance::background::options::BackgroundOptions;
use fingerpost_core::appearance::background::{Background, ForegroundMap};
use fingerpost_core::axis::Stretch;
use fingerpost_core::axis::{Finger, RefineOptions, Refiner, Source};
use fingerpost_core::geometry::shape_space::Axis;
use fingerpost_core::geometry::template::{Template, Thumb};
use fingerpost_core::image::frame::ColourView;
use fingerpost_core::measure::edge::Polarity;
use fingerpost_core::nalgebra::Point2;
use fingerpost_core::track::{ContourTracker, Model, StartPose, Status, TrackerOptions};
use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::hint::black_box;

/// The system's allocator with a count of allocations per thread, for the test harness has threads
/// of its own.
struct Counting;

thread_local! {
    static ALLOCATIONS: Cell<usize> = const { Cell::new(0) };
}

fn count_one() {
    // In an ending thread, the counter no longer exists.
    let _ = ALLOCATIONS.try_with(|n| n.set(n.get() + 1));
}

#[expect(unsafe_code, reason = "an allocator is unsafe to implement; this one only counts")]
// SAFETY: every call is forwarded unchanged to the system's allocator.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count_one();
        unsafe { System.alloc(layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        count_one();
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        count_one();
        unsafe { System.realloc(pointer, layout, size) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static COUNTING: Counting = Counting;

/// Number of allocations of `work`, and its result.
fn allocations<T>(work: impl FnOnce() -> T) -> (usize, T) {
    let before = ALLOCATIONS.get();
    let result = work();
    (ALLOCATIONS.get() - before, result)
}

const WIDTH: usize = 200;
const HEIGHT: usize = 150;
const FRAMES: usize = 8;

fn scene(thumb: Thumb, k: usize, noise: &mut Noise) -> Picture {
    scene_of(1, thumb, k, noise)
}

/// A picture `times` as large, with a hand `times` as large.
fn scene_of(times: usize, thumb: Thumb, k: usize, noise: &mut Noise) -> Picture {
    let (k, px) = (k as f64, times as f64);
    let tip = Point2::new(130.0 + 12.0 * (0.4 * k).sin(), 75.0 + 9.0 * (0.3 * k).sin()) * px;
    let hand = Hand::usual(thumb, tip, -0.5 + 0.2 * (0.35 * k).sin(), 60.0 * px);
    let canvas = Canvas::new(times * WIDTH, times * HEIGHT, 60.0).paint(&hand, 140.0);
    canvas.blur(0.96).take(2.0, noise)
}

fn empty(noise: &mut Noise) -> Picture {
    Canvas::new(WIDTH, HEIGHT, 60.0).take(2.0, noise)
}

fn tracker(model: Model, thumb: Thumb) -> ContourTracker {
    tracker_of(1, model, thumb)
}

fn tracker_of(times: usize, model: Model, thumb: Thumb) -> ContourTracker {
    let px = times as f64;
    let tip_px = Point2::new(131.0, 76.0) * px;
    let start = StartPose { tip_px, angle_rad: -0.5, length_px: 60.0 * px };
    let options = TrackerOptions { model, polarity: Polarity::Bright, ..TrackerOptions::default() };
    ContourTracker::new(Template::pistol(thumb).unwrap(), &start, options).unwrap()
}

/// A frame of the picture with colours that are a function of its grey levels.
fn with_colours<T>(picture: &Picture, then: impl FnOnce(&Frame<'_>) -> T) -> T {
    let bytes: Vec<u8> = picture.bytes.iter().flat_map(|&g| [g, g / 2, 255 - g]).collect();
    let colours = ColourView::new(&bytes, picture.width, picture.height, 3 * picture.width);
    then(&Frame::coloured(picture.view(), colours.unwrap()).unwrap())
}

fn check(model: Model, thumb: Thumb, coloured: bool) {
    let mut tracker = tracker(model, thumb);
    let mut noise = Noise::new(0x616c_6c6f);
    let mut time_s = 0.0;
    let mut update = |picture: &Picture| {
        time_s += 1.0 / 30.0;
        let mut update = |frame: &Frame<'_>| allocations(|| tracker.update(frame, time_s).unwrap());
        if coloured { with_colours(picture, update) } else { update(&picture.view().into()) }
    };
    let what = format!("{model:?}, {thumb:?}, coloured {coloured}");

    let pictures: Vec<_> = (0..6 + FRAMES).map(|k| scene(thumb, k, &mut noise)).collect();
    let statuses: Vec<_> = pictures[..6].iter().map(|picture| update(picture).1.status).collect();
    assert_eq!(statuses[5], Status::Tracking, "{what}");
    for picture in &pictures[6..] {
        let (count, track) = update(picture);
        assert!(track.finger_line.is_some(), "{what}");
        assert_eq!(count, 0, "while tracking: {what}");
    }
    // The hand leaves; the tracker misses it, then loses it.
    let pictures: Vec<_> = (0..FRAMES).map(|_| empty(&mut noise)).collect();
    let away: Vec<_> = pictures.iter().map(update).collect();
    assert_eq!(away[FRAMES - 1].1.status, Status::Lost, "{what}");
    assert!(away.iter().all(|(count, _)| *count == 0), "while it is away: {what}");
}

#[test]
fn an_allocation_is_counted() {
    assert_eq!(allocations(|| black_box(Box::new(7))).0, 1);
    assert_eq!(allocations(|| black_box(Vec::<u8>::with_capacity(1000))).0, 1);
    assert_eq!(allocations(|| black_box(7)).0, 0);
}

#[test]
fn the_band_model() {
    for thumb in [Thumb::Left, Thumb::Right, Thumb::None] {
        check(Model::Ribbon, thumb, false);
    }
}

#[test]
fn the_model_of_the_paper() {
    for thumb in [Thumb::Left, Thumb::Right, Thumb::None] {
        check(Model::Paper, thumb, false);
    }
}

#[test]
fn coloured_frames() {
    check(Model::Ribbon, Thumb::Left, true);
    check(Model::Paper, Thumb::None, true);
}

#[test]
fn a_large_hand_followed_at_a_pyramid_level() {
    let mut tracker = tracker_of(2, Model::Ribbon, Thumb::Left);
    let mut noise = Noise::new(0x6c61_7267);
    for k in 0..6 + FRAMES {
        let picture = scene_of(2, Thumb::Left, k, &mut noise);
        let time_s = k as f64 / 30.0;
        let (count, track) =
            with_colours(&picture, |frame| allocations(|| tracker.update(frame, time_s).unwrap()));
        assert!(k < 6 || (track.finger_line.is_some() && count == 0), "frame {k}: {count}");
    }
}

#[test]
fn a_waiting_template() {
    for (model, thumb) in [(Model::Ribbon, Thumb::Left), (Model::Paper, Thumb::None)] {
        let mut tracker = tracker(model, thumb);
        let mut noise = Noise::new(0x7761_6974);
        for k in 0..3 {
            let picture = empty(&mut noise);
            let frame = Frame::gray(picture.view());
            let (count, track) = allocations(|| tracker.update(&frame, f64::from(k)).unwrap());
            assert_eq!((count, track.status), (0, Status::Acquiring), "{model:?}, {thumb:?}");
        }
    }
}

#[test]
fn refining_an_axis() {
    let mut noise = Noise::new(0x7265_6669);
    let (angle, half_width_px) = (-0.5, 6.9);
    let stretch = Stretch { from_px: -20.0, to_px: 26.0 };
    let mut refiner = Refiner::new(RefineOptions::default()).unwrap();
    for k in 0..12 {
        let tip = Point2::new(130.0, 75.0 + 0.3 * f64::from(k));
        let hand = Hand::usual(Thumb::None, tip, angle, 60.0);
        let picture = Canvas::new(WIDTH, HEIGHT, 60.0).paint(&hand, 140.0).blur(0.96);
        let picture = picture.take(2.0, &mut noise);
        let axis = Axis::of_finger(tip - hand.direction() * 30.0, angle, 30.0);
        let finger = Finger {
            axis,
            half_width_px,
            taper: 0.0,
            flanks: [stretch; 2],
            round_end_px: Some(30.0 - half_width_px),
            prior: None,
        };
        let frame = Frame::gray(picture.view());
        let (count, refined) =
            allocations(|| refiner.refine(&frame, &finger, Polarity::Bright, None, None).unwrap());
        assert_eq!(refined.unwrap().source, Source::Photometric);
        // The table of the blur is computed once.
        assert!(k == 0 || count == 0, "{count} allocations in frame {k}");
    }
}

#[test]
fn a_learned_background() {
    for coloured in [false, true] {
        let mut background = Background::new(BackgroundOptions::default()).unwrap();
        let mut map = ForegroundMap::default();
        let mut noise = Noise::new(0x6261_636b);
        for k in 0..20 {
            let picture = empty(&mut noise);
            let mut observe = |frame: &Frame<'_>| {
                let (count, ()) = allocations(|| {
                    background.observe(frame, &[]).unwrap();
                    background.foreground_map(frame, &mut map);
                });
                assert!(k == 0 || count == 0, "coloured {coloured}, frame {k}");
            };
            if coloured {
                with_colours(&picture, observe);
            } else {
                observe(&picture.view().into());
            }
        }
    }
}
