//! The core's speed as ratios to the C limit of `limit/`, timed in turn on one core.
//!
//!     cargo bench -p fingerpost-benches --bench ratios
//!
//! The unit is the median time of one iteration of `limit_fixed` on a frame just written, timed in
//! the same round; a ratio is the median over the rounds. Without gcc, only times are printed.

#![expect(
    clippy::unwrap_used,
    clippy::print_stdout,
    reason = "a benchmark prints, and stops where something does not work"
)]

use fingerpost_benches::sequence::{NORMALS, Sequence};
use fingerpost_benches::{Iteration, Tracked, median};
use fingerpost_core::nalgebra::{Matrix3, Vector3};
use fingerpost_core::numeric::simd::Isa;
use fingerpost_core::{Frame, GrayView};
use std::env;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Instant;

const ROUNDS: usize = 5;
/// Set for the copy of this program that is bound to one core.
const PINNED: &str = "FINGERPOST_BENCH_PINNED";
/// Scale of a kernel with seven taps, like that of the C limit \[px\].
const SEVEN_TAPS_PX: f64 = 1.0;
/// Size of a cache line \[bytes\].
const CACHE_LINE_BYTES: usize = 64;

/// One line of the table.
struct Row {
    what: String,
    times_us: Vec<f64>,
    ratios: Vec<f64>,
    target: &'static str,
}

fn main() {
    if relaunched_on_one_core() {
        return;
    }
    let vga = Sequence::render([640, 480], 256, 1.0);
    let hd = Sequence::render([1920, 1080], 64, 2.25);
    let limit = Limit::build(&vga);
    let mut rows = Vec::new();
    let mut units_us = Vec::new();
    for _ in 0..ROUNDS {
        let unit_us = limit.as_ref().map(Limit::copied_us);
        units_us.extend(unit_us);
        for (i, (what, target, time_us)) in round(&vga, &hd).into_iter().enumerate() {
            if rows.len() <= i {
                rows.push(Row { what, target, times_us: Vec::new(), ratios: Vec::new() });
            }
            rows[i].times_us.push(time_us);
            rows[i].ratios.extend(unit_us.map(|unit_us| time_us / unit_us));
        }
    }
    if units_us.is_empty() {
        println!("no gcc: the C limit is left out, and there are no ratios");
    } else {
        println!("1x = {:.2} us, the C limit of one iteration", median(&mut units_us));
    }
    println!("{:<66} {:>9} {:>8} {:>9}", "", "us", "ratio", "to reach");
    for row in &mut rows {
        let ratio = if row.ratios.is_empty() {
            String::new()
        } else {
            format!("{:.2}x", median(&mut row.ratios))
        };
        let time_us = median(&mut row.times_us);
        println!("{:<66} {time_us:>9.2} {ratio:>8} {:>9}", row.what, row.target);
    }
    scaling(&vga);
}

/// The measurements of one round: name, goal, time \[µs\].
fn round(vga: &Sequence, hd: &Sequence) -> Vec<(String, &'static str, f64)> {
    let mut rows = Vec::new();
    for isa in Isa::available() {
        let target = match isa {
            Isa::Avx2 => "1.5x",
            Isa::Baseline => "2.5x",
            Isa::Scalar => "",
        };
        for (taps, scale_px) in [("7 taps", Some(SEVEN_TAPS_PX)), ("default", None)] {
            let mut iteration = Iteration::new(isa, vga.template(NORMALS), 20.0, scale_px);
            let (error_px, time_us) = (accuracy(vga, &mut iteration), copied(vga, &mut iteration));
            let target = if scale_px.is_some() { target } else { "" };
            let what =
                format!("one iteration, 100 x 20 px, {taps}, {isa} (error {error_px:.3} px)");
            rows.push((what, target, time_us));
        }
    }
    let mut iteration =
        Iteration::new(Isa::detect(), vga.template(NORMALS), 20.0, Some(SEVEN_TAPS_PX));
    let (place, search, fit) = stages(vga, &mut iteration);
    rows.push(("  of it: place".into(), "", place));
    rows.push(("  of it: search".into(), "", search));
    rows.push(("  of it: fit".into(), "", fit));
    rows.push(("one iteration, flushed frame".into(), "3x", flushed(vga, &mut iteration)));
    let mut large = Iteration::new(Isa::detect(), hd.template(NORMALS), 20.0, Some(SEVEN_TAPS_PX));
    rows.push((
        "one iteration, 1920 x 1080 (1.2 times its VGA time)".into(),
        "",
        copied(hd, &mut large),
    ));
    for (name, mut tracked) in Tracked::all() {
        rows.push((format!("converged frame, {name}"), "5x", tracked.update_us()));
    }
    rows
}

/// Time of one iteration from the truth, on a frame just written, as after decoding \[µs\].
fn copied(sequence: &Sequence, iteration: &mut Iteration) -> f64 {
    let mut pixels = sequence.frame(0).to_vec();
    let times = (0..sequence.truth.len()).map(|i| {
        pixels.copy_from_slice(sequence.frame(i));
        iteration.time_us(&frame(&pixels, sequence.size), &sequence.truth[i])
    });
    median(&mut times.collect::<Vec<_>>())
}

/// The same with the frame in no cache, as in the C limit.
fn flushed(sequence: &Sequence, iteration: &mut Iteration) -> f64 {
    let times = (0..sequence.truth.len()).map(|i| {
        flush(sequence.frame(i));
        iteration.time_us(&frame(sequence.frame(i), sequence.size), &sequence.truth[i])
    });
    median(&mut times.collect::<Vec<_>>())
}

#[cfg(target_arch = "x86_64")]
#[expect(unsafe_code, reason = "nothing else takes a frame, and a frame alone, out of the caches")]
fn flush(bytes: &[u8]) {
    use std::arch::x86_64::{_mm_clflush, _mm_mfence};
    for line in bytes.chunks(CACHE_LINE_BYTES) {
        // SAFETY: the address is that of a byte that may be read; flushing changes none.
        unsafe { _mm_clflush(line.as_ptr()) };
    }
    // SAFETY: every x86-64 processor has the instruction, which takes nothing.
    unsafe { _mm_mfence() };
}

/// Evicts everything from the caches by reading a large buffer.
#[cfg(not(target_arch = "x86_64"))]
fn flush(_: &[u8]) {
    let mut other = vec![1_u8; 64 << 20];
    other.iter_mut().step_by(CACHE_LINE_BYTES).for_each(|byte| *byte = byte.wrapping_add(1));
    std::hint::black_box(&other);
}

/// Median times of placing, searching and fitting \[µs\].
fn stages(sequence: &Sequence, iteration: &mut Iteration) -> (f64, f64, f64) {
    let mut pixels = sequence.frame(0).to_vec();
    let mut times = [const { Vec::new() }; 3];
    for (i, map) in sequence.truth.iter().enumerate() {
        pixels.copy_from_slice(sequence.frame(i));
        let frame = frame(&pixels, sequence.size);
        let starts = [
            Instant::now(),
            {
                iteration.place(map);
                Instant::now()
            },
            {
                iteration.search(&frame);
                Instant::now()
            },
            {
                iteration.fit(map);
                Instant::now()
            },
        ];
        for (times, pair) in times.iter_mut().zip(starts.windows(2)) {
            times.push((pair[1] - pair[0]).as_secs_f64() * 1e6);
        }
    }
    let [place, search, fit] = times.map(|mut times| median(&mut times));
    (place, search, fit)
}

/// Root mean square error of the contour, four iterations a frame from the frame before \[px\].
fn accuracy(sequence: &Sequence, iteration: &mut Iteration) -> f64 {
    let mut map = sequence.truth[0];
    let squares = (0..sequence.truth.len()).map(|i| {
        let frame = frame(sequence.frame(i), sequence.size);
        for _ in 0..4 {
            map = iteration.run(&frame, &map);
        }
        sequence.error_px(i, &map).powi(2)
    });
    (squares.sum::<f64>() / sequence.truth.len() as f64).sqrt()
}

/// Prints the time of an iteration by number and length of the lines, with the constants of a
/// linear model, and by number of views.
fn scaling(vga: &Sequence) {
    println!("\none iteration, {}, 7 taps [us]", Isa::detect());
    print!("{:>8}", "normals");
    let half_lengths_px = [5.0, 10.0, 20.0, 40.0, 80.0];
    for half_length_px in half_lengths_px {
        print!("{:>9}", format!("±{half_length_px} px"));
    }
    println!();
    let mut normal = (Matrix3::zeros(), Vector3::zeros());
    for normals in [25, 50, 100, 200, 400, 800] {
        print!("{normals:>8}");
        for half_length_px in half_lengths_px {
            let samples = vga.template(normals);
            let mut iteration =
                Iteration::new(Isa::detect(), samples, half_length_px, Some(SEVEN_TAPS_PX));
            let time_us = copied(vga, &mut iteration);
            print!("{time_us:>9.2}");
            // Divided by the time: the fit minimises relative errors.
            let lines = normals as f64;
            let row = Vector3::new(1.0, lines, lines * (2.0 * half_length_px + 1.0)) / time_us;
            normal = (normal.0 + row * row.transpose(), normal.1 + row);
        }
        println!();
    }
    if let Some(inverse) = normal.0.try_inverse() {
        let [once_us, line_us, pixel_us] = (inverse * normal.1).into();
        println!(
            "  about {once_us:.1} us + {:.1} ns a normal + {:.2} ns a pixel of a normal",
            1e3 * line_us,
            1e3 * pixel_us
        );
    }
    println!("\nviews, one iteration each, on one core [us]");
    for views in 1..=8 {
        println!("{views:>8}{:>9.2}", of_views(vga, views));
    }
}

/// Time of one iteration of each view, on frames just written; the views are some frames apart
/// \[µs\].
fn of_views(sequence: &Sequence, views: usize) -> f64 {
    const APART: usize = 8;
    let samples = sequence.template(NORMALS);
    let isa = Isa::detect();
    let mut all: Vec<_> = (0..views)
        .map(|_| Iteration::new(isa, samples.clone(), 20.0, Some(SEVEN_TAPS_PX)))
        .collect();
    let mut pixels: Vec<_> = (0..views).map(|_| sequence.frame(0).to_vec()).collect();
    let times = (0..sequence.truth.len()).map(|i| {
        let at = |view: usize| (i + APART * view) % sequence.truth.len();
        for (view, pixels) in pixels.iter_mut().enumerate() {
            pixels.copy_from_slice(sequence.frame(at(view)));
        }
        let start = Instant::now();
        for (view, iteration) in all.iter_mut().enumerate() {
            let frame = frame(&pixels[view], sequence.size);
            std::hint::black_box(iteration.run(&frame, &sequence.truth[at(view)]));
        }
        start.elapsed().as_secs_f64() * 1e6
    });
    median(&mut times.collect::<Vec<_>>())
}

fn frame(pixels: &[u8], [width, height]: [usize; 2]) -> Frame<'_> {
    Frame::gray(GrayView::new(pixels, width, height, width).unwrap())
}

/// The compiled C limit and its frames.
struct Limit {
    program: PathBuf,
    directory: PathBuf,
}

impl Drop for Limit {
    fn drop(&mut self) {
        // On failure the files stay in the temporary directory.
        let _ = std::fs::remove_dir_all(&self.directory);
    }
}

impl Limit {
    /// Compiles the limit for this processor; `None` if that fails.
    fn build(vga: &Sequence) -> Option<Self> {
        let directory = env::temp_dir().join(format!("fingerpost-limit-{}", std::process::id()));
        std::fs::create_dir_all(&directory).unwrap();
        let limit = Self { program: directory.join("limit"), directory };
        let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("limit/limit.c");
        let compiled = Command::new("gcc")
            .args(["-O3", "-ffast-math", "-DLB=16", "-march=native", "-o"])
            .args([&limit.program, &source])
            .arg("-lm")
            .status();
        compiled.is_ok_and(|status| status.success()).then_some(())?;
        vga.write(&limit.directory, "finger_vga").unwrap();
        Some(limit)
    }

    /// `copied_us` of `limit_fixed`.
    fn copied_us(&self) -> f64 {
        let mut run = Command::new(&self.program);
        let output = run.arg(&self.directory).args(["finger_vga", "1"]).output().unwrap();
        let output = String::from_utf8(output.stdout).unwrap();
        let line = output.lines().find(|line| line.contains("limit_fixed")).unwrap();
        let (_, value) = line.split_once("\"copied_us\":").unwrap();
        value.split(',').next().unwrap().parse().unwrap()
    }
}

/// Runs this program again on one core, if `taskset` is available; returns whether it did.
fn relaunched_on_one_core() -> bool {
    if env::var_os(PINNED).is_some() {
        return false;
    }
    let core = env::var("CORE").unwrap_or_else(|_| "1".into());
    let program = env::current_exe().unwrap();
    let mut run = Command::new("taskset");
    run.args(["-c", &core]).arg(program).env(PINNED, "1");
    let pinned = run.status().is_ok_and(|status| status.success());
    if !pinned {
        println!("no taskset: not bound to one core");
    }
    pinned
}
