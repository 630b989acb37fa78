//! A guard against slower code that is independent of clocks: instructions of fixed workloads,
//! counted by valgrind and compared with `instructions.txt`. `make test` runs it.
//!
//!     make instructions            # check
//!     make instructions RECORD=1   # store the counts
//!
//! Every workload runs with two numbers of repetitions; the difference of the counts excludes the
//! set-up.

#![expect(
    clippy::unwrap_used,
    clippy::print_stdout,
    reason = "a check prints, and stops where something does not work"
)]

use fingerpost_benches::sequence::Sequence;
use fingerpost_benches::{Iteration, Tracked};
use fingerpost_core::appearance::histogram::HistogramModel;
use fingerpost_core::numeric::simd::Isa;
use fingerpost_core::track::Model;
use fingerpost_core::{Frame, GrayView};
use std::collections::BTreeMap;
use std::path::Path;
use std::process::{Command, ExitCode};
use std::{env, fs};

/// Tolerated relative change: compiler versions differ by a few per cent, mistakes cost more.
const TOLERANCE: f64 = 0.1;
const FEW: usize = 4;
const MORE: usize = 12;
/// Frames that trackers follow to and fro; under valgrind, drawing is slower than tracking.
const FRAMES: usize = 3;

/// The workloads; all but the first two need AVX2.
const WORKLOADS: [&str; 6] =
    ["iteration-scalar", "iteration-sse2", "iteration-avx2", "learn-colours", "paper", "bands"];

fn main() -> ExitCode {
    let arguments: Vec<String> = env::args().skip(1).collect();
    if let [workload, count] = arguments.as_slice()
        && let Ok(count) = count.parse()
    {
        work(workload, count);
        return ExitCode::SUCCESS;
    }
    if Command::new("valgrind").arg("--version").output().is_err() {
        println!("valgrind is missing; on Debian: apt-get install valgrind");
        // It exists for few other systems.
        return if cfg!(target_os = "linux") { ExitCode::FAILURE } else { ExitCode::SUCCESS };
    }
    let stored = Path::new(env!("CARGO_MANIFEST_DIR")).join("instructions.txt");
    let counted: Vec<_> = workloads().map(|name| (name, instructions(name))).collect();
    if arguments.iter().any(|argument| argument == "record") {
        let lines = counted.iter().map(|(name, count)| format!("{name} {count}\n"));
        fs::write(stored, lines.collect::<String>()).unwrap();
        return ExitCode::SUCCESS;
    }
    check(&counted, &fs::read_to_string(stored).unwrap())
}

fn workloads() -> impl Iterator<Item = &'static str> {
    let available = if Isa::Avx2.is_available() { WORKLOADS.len() } else { 2 };
    WORKLOADS.into_iter().take(available)
}

/// Prints the change of every workload relative to the stored count; fails if one exceeds the
/// tolerance.
fn check(counted: &[(&str, u64)], stored: &str) -> ExitCode {
    let stored: BTreeMap<_, u64> = stored
        .lines()
        .filter_map(|line| line.split_once(' '))
        .map(|(name, count)| (name, count.parse().unwrap()))
        .collect();
    let mut result = ExitCode::SUCCESS;
    for &(name, count) in counted {
        let change = count as f64 / stored[name] as f64 - 1.0;
        let note = if change > TOLERANCE {
            result = ExitCode::FAILURE;
            "too many"
        } else if change < -TOLERANCE {
            "fewer: record them"
        } else {
            ""
        };
        println!("{name:<18} {count:>9} instructions {:>+6.1} % {note}", 100.0 * change);
    }
    if result == ExitCode::FAILURE {
        println!(
            "slower by more than {:.0} %: find out why, or record what is worth it by \
             `make instructions RECORD=1`",
            100.0 * TOLERANCE
        );
    }
    result
}

/// The instructions of one workload.
fn instructions(workload: &str) -> u64 {
    let total = |count: usize| -> u64 {
        let output = Command::new("valgrind")
            .args(["--tool=callgrind", "--callgrind-out-file=/dev/null"])
            .arg(env::current_exe().unwrap())
            .args([workload, &count.to_string()])
            .output()
            .unwrap();
        let report = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.success(), "{workload}: {report}");
        let (_, collected) = report.split_once("Collected :").unwrap();
        collected.split_whitespace().next().unwrap().parse().unwrap()
    };
    (total(MORE) - total(FEW)) / (MORE - FEW) as u64
}

fn work(workload: &str, count: usize) {
    match workload {
        "iteration-scalar" => iterate(Isa::Scalar, count),
        "iteration-sse2" => iterate(Isa::Baseline, count),
        "iteration-avx2" => iterate(Isa::Avx2, count),
        "learn-colours" => learn(count),
        "paper" => follow(Model::Paper, count),
        "bands" => follow(Model::Ribbon, count),
        other => unreachable!("{other} is no workload"),
    }
}

/// One iteration of 100 normals of ±20 px.
fn iterate(isa: Isa, count: usize) {
    let sequence = Sequence::render([320, 240], 1, 0.5);
    let image = GrayView::new(sequence.frame(0), 320, 240, 320).unwrap();
    let mut iteration = Iteration::new(isa, sequence.template(100), 20.0, None);
    for _ in 0..count {
        iteration.run(&Frame::gray(image), &sequence.truth[0]);
    }
}

/// Updates of the log-likelihood ratios of all colours.
fn learn(count: usize) {
    let (gray, colours) = ([128; 2], [200, 150, 120, 60, 70, 80]);
    let image = GrayView::new(&gray, 2, 1, 2).unwrap();
    let colours = fingerpost_core::image::frame::ColourView::new(&colours, 2, 1, 6).unwrap();
    let frame = Frame::coloured(image, colours).unwrap();
    let mut appearance = HistogramModel::new(true);
    for (u, is_hand) in [(0.0, true), (1.0, false)] {
        appearance.observe(&frame, u, 0.0, is_hand);
    }
    for _ in 0..count {
        appearance.learn();
    }
}

/// Whole frames of a tracker that follows a hand.
fn follow(model: Model, count: usize) {
    let mut tracked = Tracked::new(model, FRAMES);
    for i in 0..count {
        // To and fro: 0, 1, 2, 1, 0 …
        let at = i % (2 * FRAMES - 2);
        tracked.update(at.min(2 * FRAMES - 2 - at));
    }
}
