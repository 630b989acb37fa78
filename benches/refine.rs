//! Refinement of the finger's axis, with unknown and known background, and the fit of a round
//! finger by its shading, on frames that are cold in cache.
//!
//!     cargo bench -p fingerpost-benches --bench refine

#![expect(
    clippy::unwrap_used,
    reason = "a benchmark: its groups document themselves, and a failure should stop it"
)]

use criterion::{BenchmarkId, Criterion, criterion_group, criterion_main};
use fingerpost_benches::{Scene, frames};
use fingerpost_core::axis::Stretch;
use fingerpost_core::axis::{Finger, KnownBackground, RefineOptions, Refiner, RoundFinger, Source};
use fingerpost_core::geometry::shape_space::Axis;
use fingerpost_core::image::frame::Frame;
use fingerpost_core::image::gray::GrayView;
use fingerpost_core::measure::edge::Polarity;
use std::hint::black_box;

const SIZES: [(&str, [usize; 2], usize); 2] =
    [("640x480", [640, 480], 64), ("1920x1080", [1920, 1080], 16)];
/// Level and noise of the table in the scenes \[grey levels\].
const TABLE_GREY: f32 = 60.0;
const TABLE_SIGMA_GREY: f32 = 0.5;

/// The finger of a scene as estimated by a tracker: displaced by a third of a pixel.
fn finger(scene: &Scene) -> Finger {
    let pose = &scene.pose;
    let half_width_px = 0.115 * pose.length_px;
    let round_end_px = 0.5 * pose.length_px - half_width_px;
    let tip = Axis::of_finger(pose.tip_px, pose.angle_rad, 0.0);
    let anchor = pose.tip_px - tip.direction() * (0.5 * pose.length_px) + tip.normal() * 0.3;
    let to_px = round_end_px + 0.5 * half_width_px;
    // The thumb covers the root of the right flank.
    let right = Stretch { from_px: -0.15 * pose.length_px, to_px };
    let left = Stretch { from_px: -0.4 * pose.length_px, to_px };
    Finger {
        axis: Axis::of_finger(anchor, pose.angle_rad + 0.005, 0.5 * pose.length_px),
        half_width_px: half_width_px + 0.2,
        taper: 0.0,
        flanks: [right, left],
        round_end_px: Some(round_end_px),
        prior: None,
    }
}

fn refinements(c: &mut Criterion) {
    let mut group = c.benchmark_group("refine");
    for (size, [width, height], count) in SIZES {
        let scenes = frames([width, height], count);
        let (mean, sigma) =
            (vec![TABLE_GREY; width * height], vec![TABLE_SIGMA_GREY; width * height]);
        let background = KnownBackground::new(&mean, &sigma, width, height).unwrap();
        for (name, known) in [("unknown_background", None), ("known_background", Some(&background))]
        {
            let mut refiner = Refiner::new(RefineOptions::default()).unwrap();
            let mut turn = scenes.iter().cycle();
            group.bench_function(BenchmarkId::new(name, size), |b| {
                b.iter(|| {
                    let scene = turn.next().unwrap();
                    let view = GrayView::new(&scene.pixels, width, height, width).unwrap();
                    let finger = finger(scene);
                    let refined =
                        refiner.refine(&Frame::gray(view), &finger, Polarity::Bright, None, known);
                    let refined = refined.unwrap().unwrap();
                    assert_eq!(refined.source, Source::Photometric);
                    black_box(refined)
                });
            });
        }
        let mut turn = scenes.iter().cycle();
        group.bench_function(BenchmarkId::new("round_finger", size), |b| {
            b.iter(|| {
                let scene = turn.next().unwrap();
                let view = GrayView::new(&scene.pixels, width, height, width).unwrap();
                let Finger { axis, half_width_px, .. } = finger(scene);
                let round = RoundFinger::fit(&Frame::gray(view), &axis, half_width_px);
                black_box(round.unwrap().unwrap())
            });
        });
    }
    group.finish();
}

criterion_group!(benches, refinements);
criterion_main!(benches);
