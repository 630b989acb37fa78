//! The stages of one frame: search along 100 normals of ±20 px, fit, a whole iteration, and whole
//! updates of a tracker that follows a hand; then background learning and the detection of
//! candidates. Frames are taken in turn, so that each is cold in cache.
//!
//!     cargo bench -p fingerpost-benches

#![expect(
    clippy::unwrap_used,
    reason = "a benchmark: its groups document themselves, and a failure should stop it"
)]

use criterion::{BenchmarkId, Criterion, criterion_group, criterion_main};
use fingerpost_benches::{Scene, frames};
use fingerpost_core::appearance::background::Background;
use fingerpost_core::appearance::background::options::BackgroundOptions;
use fingerpost_core::detect::candidates::{FinderOptions, HandFinder};
use fingerpost_core::geometry::planar::{Affine, AffineMap, PlanarSpace, RigidShear};
use fingerpost_core::geometry::shape_space::{Pose, ShapeSpace};
use fingerpost_core::geometry::template::{Template, TemplateSample, Thumb};
use fingerpost_core::image::frame::Frame;
use fingerpost_core::image::gray::GrayView;
use fingerpost_core::measure::edge::{Polarity, Scale, SearchLine};
use fingerpost_core::measure::edge_search::{Cue, EdgeSearch, SearchOptions};
use fingerpost_core::nalgebra::SVector;
use fingerpost_core::solve::fit::{EquationBuffer, FitOptions, Fitter};
use fingerpost_core::track::{ContourTracker, Model, Status, TrackerOptions};
use std::hint::black_box;

const NORMALS: usize = 100;
const HALF_LENGTH_PX: f64 = 20.0;
const SIZES: [(&str, [usize; 2], usize); 2] =
    [("640x480", [640, 480], 64), ("1920x1080", [1920, 1080], 16)];

fn view(scene: &Scene) -> Frame<'_> {
    let [width, height] = scene.size;
    Frame::gray(GrayView::new(&scene.pixels, width, height, width).unwrap())
}

fn lines<S: ShapeSpace<D>, const D: usize>(
    pose: &S::Pose,
    samples: &[TemplateSample],
) -> Vec<SearchLine> {
    let line = |sample| SearchLine {
        sample: pose.place(sample),
        half_length_px: HALF_LENGTH_PX,
        polarity: Polarity::Bright,
    };
    samples.iter().map(line).collect()
}

/// Search, fit and a whole iteration in one shape space.
fn iteration<S: PlanarSpace<D>, const D: usize>(c: &mut Criterion, name: &str) {
    let samples = Template::pistol(Thumb::Right).unwrap().samples(NORMALS).unwrap();
    for (size, pixels, count) in SIZES {
        let scenes = frames(pixels, count);
        let start = &scenes[0].pose;
        let map = AffineMap::upright(start.tip_px, start.angle_rad, start.length_px).unwrap();
        let (space, x) = S::through(&map).unwrap();
        let mut search = EdgeSearch::new(SearchOptions::default()).unwrap();
        let mut fitter = Fitter::new(FitOptions::default()).unwrap();
        let mut buffer = EquationBuffer::with_capacity(NORMALS, D);
        let mut measurements = Vec::with_capacity(NORMALS);
        let mut turn = scenes.iter().cycle();

        let placed = lines::<S, D>(&space.pose(&x), &samples);
        c.bench_function(&format!("search/{name}/{size}"), |b| {
            b.iter(|| {
                let frame = view(turn.next().unwrap());
                search.search(&frame, Cue::Edges, Scale::Fine, &placed, &mut measurements).unwrap();
                black_box(measurements.len())
            });
        });
        c.bench_function(&format!("fit/{name}/{size}"), |b| {
            b.iter(|| {
                black_box(solve(
                    &space,
                    &x,
                    &samples,
                    &placed,
                    &measurements,
                    &mut buffer,
                    &mut fitter,
                ))
            });
        });
        c.bench_function(&format!("iteration/{name}/{size}"), |b| {
            b.iter(|| {
                let frame = view(turn.next().unwrap());
                let pose = space.pose(&x);
                let placed: Vec<_> = lines::<S, D>(&pose, &samples);
                search.search(&frame, Cue::Edges, Scale::Fine, &placed, &mut measurements).unwrap();
                black_box(solve(
                    &space,
                    &x,
                    &samples,
                    &placed,
                    &measurements,
                    &mut buffer,
                    &mut fitter,
                ))
            });
        });
    }
}

fn solve<S: ShapeSpace<D>, const D: usize>(
    space: &S,
    x: &SVector<f64, D>,
    samples: &[TemplateSample],
    placed: &[SearchLine],
    measurements: &[fingerpost_core::measure::edge::EdgeMeasurement],
    buffer: &mut EquationBuffer,
    fitter: &mut Fitter,
) -> SVector<f64, D> {
    let pose = space.pose(x);
    let mut equations = buffer.clear::<D>();
    for ((sample, line), found) in samples.iter().zip(placed).zip(measurements) {
        if let Ok(edge) = found {
            let row = space.normal_row(&pose, sample, &line.sample.normal);
            equations.push(&row, edge.offset_px, edge.variance_px2).unwrap();
        }
    }
    fitter.solve(&equations, None).step
}

/// Whole updates of a tracker that has acquired the hand.
fn updates(c: &mut Criterion) {
    let mut group = c.benchmark_group("update");
    for (name, model) in [("paper", Model::Paper), ("ribbon", Model::Ribbon)] {
        for (size, pixels, count) in SIZES {
            let scenes = frames(pixels, count);
            let options = TrackerOptions { model, ..TrackerOptions::default() };
            let template = Template::pistol(Thumb::Right).unwrap();
            let mut tracker = ContourTracker::new(template, &scenes[0].pose, options).unwrap();
            let mut time_s = 0.0;
            let mut status = Status::Acquiring;
            for _ in 0..10 {
                status = tracker.update(&view(&scenes[0]), time_s).unwrap().status;
            }
            assert_eq!(status, Status::Tracking, "{name} {size}: the hand is not acquired");
            let mut turn = scenes.iter().cycle();
            group.bench_function(BenchmarkId::new(name, size), |b| {
                b.iter(|| {
                    time_s += 0.04;
                    let track = tracker.update(&view(turn.next().unwrap()), time_s).unwrap();
                    assert_eq!(track.status, Status::Tracking);
                    black_box(track)
                });
            });
        }
    }
    group.finish();
}

/// The work for a view without a hand: learning its background, and detecting candidates.
fn finding(c: &mut Criterion) {
    for (size, pixels, count) in SIZES {
        let scenes = frames(pixels, count);
        let mut background = Background::new(BackgroundOptions::default()).unwrap();
        for _ in 0..20 {
            background.observe(&view(&scenes[0]), &[]).unwrap();
        }
        let mut turn = scenes.iter().cycle();
        c.bench_function(&format!("background/{size}"), |b| {
            b.iter(|| background.observe(&view(turn.next().unwrap()), &[]).unwrap());
        });
        let mut finder = HandFinder::new(FinderOptions::default()).unwrap();
        c.bench_function(&format!("candidates/{size}"), |b| {
            b.iter(|| black_box(finder.find(&view(turn.next().unwrap()), Some(&background)).len()));
        });
    }
}

fn stages(c: &mut Criterion) {
    iteration::<Affine, 6>(c, "affine");
    iteration::<RigidShear, 4>(c, "rigid_shear");
    updates(c);
    finding(c);
}

criterion_group!(benches, stages);
criterion_main!(benches);
