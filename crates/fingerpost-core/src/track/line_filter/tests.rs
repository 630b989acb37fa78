//! The filter is private to the crate; the truth is the painted pose.

use super::*;
use crate::axis::{Painted, Stretch};
use crate::track::LineSource;

const SHOWN: BandDimensions = BandDimensions { half_width_px: 8.0, taper: 0.0, length_px: 60.0 };

/// A line with the error `off` and the standard deviations `sigmas`.
fn line(painted: &Painted, off: [f64; 2], sigmas: [f64; 2]) -> FingerLine {
    let axis = painted.axis();
    let anchor = axis.anchor + axis.normal() * off[0];
    FingerLine {
        axis: Axis::of_finger(anchor, axis.angle_rad + off[1], 30.0),
        half_length_px: 30.0,
        stretch: Stretch::about(0.0, 30.0),
        covariance: Matrix2::from_diagonal(&Vector2::from(sigmas.map(|s| s * s))),
        source: LineSource::Contour,
    }
}

fn painted(k: usize, step_px: f64, texture: f64) -> Painted {
    let k = k as f64;
    let tip = [100.0 + step_px * 9.0 * (0.5 * k).sin(), 70.0 + step_px * 4.0 * (0.3 * k).cos()];
    let stripes_px = 0.7 * k;
    let angle_rad = 0.4 + 0.02 * step_px * (0.2 * k).sin();
    Painted { texture, stripes_px, noise: 2.0, seed: 7 + k as u64, ..Painted::at(tip, angle_rad) }
}

/// Error of frame `k`, different in every frame, with RMS about (0.15 px, 0.01 rad).
fn error(k: usize) -> [f64; 2] {
    let k = k as f64;
    [0.2 * (2.3 * k).sin(), 0.014 * (2.9 * k + 1.0).sin()]
}

/// Error of the angle and its reported standard deviation in frame `k`.
fn follow(
    line_filter: &mut LineFilter,
    k: usize,
    painted: &Painted,
    off: [f64; 2],
    sigmas: [f64; 2],
) -> [f64; 2] {
    let line = line(painted, off, sigmas);
    let filtered = painted.show(|image| line_filter.follow(image, k as f64 / 25.0, line, &SHOWN));
    [filtered.axis.angle_rad - painted.angle_rad, filtered.covariance[(1, 1)].sqrt()]
}

/// The same for `frames` frames.
fn followed(frames: usize, step_px: f64, texture: f64, sigmas: [f64; 2]) -> Vec<[f64; 2]> {
    let mut line_filter = LineFilter::new();
    let off = |k| if step_px > 0.0 { error(k) } else { error(0) };
    (0..frames)
        .map(|k| follow(&mut line_filter, k, &painted(k, step_px, texture), off(k), sigmas))
        .collect()
}

fn rms(values: impl ExactSizeIterator<Item = f64>) -> f64 {
    let count = values.len() as f64;
    (values.map(|v| v * v).sum::<f64>() / count).sqrt()
}

#[test]
fn the_lines_of_a_moving_finger_are_told_together() {
    let filtered = followed(60, 1.0, 20.0, [0.15, 0.01]);
    let alone = rms((20..60).map(|k| error(k)[1]));
    let combined = rms(filtered[20..].iter().map(|t| t[0]));
    assert!(combined < 0.5 * alone, "{combined} of {alone}");
    // The reported standard deviation agrees with the error.
    let sigma = rms(filtered[20..].iter().map(|t| t[1]));
    assert!(combined < 1.3 * sigma && sigma < 0.6 * 0.01, "{combined} {sigma}");
}

#[test]
fn the_error_of_a_resting_finger_is_not_averaged_to_nothing() {
    let filtered = followed(60, 0.0, 20.0, [0.15, 0.01]);
    for [off, sigma] in filtered {
        assert!((off - error(0)[1]).abs() < 1e-9 && (sigma - 0.01).abs() < 1e-9);
    }
}

#[test]
fn what_is_new_in_every_frame_of_a_resting_finger_is_averaged_away() {
    let mut line_filter = LineFilter::new();
    let (common, sigmas) = ([0.1, 0.007], [0.2, 0.014]);
    let own = |k: usize| error(k).map(|off| 0.7 * off);
    let off = |k: usize| [common[0] + own(k)[0], common[1] + own(k)[1]];
    let filtered: Vec<_> = (0..40)
        .map(|k| follow(&mut line_filter, k, &painted(k, 0.0, 20.0), off(k), sigmas))
        .collect();
    let alone = rms((20..40).map(|k| own(k)[1]));
    let combined = rms(filtered[20..].iter().map(|t| t[0] - common[1]));
    assert!(combined < 0.3 * alone, "{combined} of {alone}");
    // The reported standard deviation agrees with the remaining error.
    let (error, sigma) = (rms(filtered[20..].iter().map(|t| t[0])), filtered[39][1]);
    assert!((0.5..1.3).contains(&(error / sigma)), "{error} {sigma}");
}

#[test]
fn a_finger_that_comes_to_rest_is_told_by_the_frames_since() {
    let mut line_filter = LineFilter::new();
    for k in 0..20 {
        follow(&mut line_filter, k, &painted(k, 1.0, 20.0), error(k), [0.15, 0.01]);
    }
    // At rest, a frame is more precise than the filtered line.
    let still = |k: usize| Painted { seed: 7 + k as u64, ..painted(20, 1.0, 20.0) };
    let own = |k: usize| error(k).map(|off| 0.3 * off);
    let filtered: Vec<_> =
        (20..60).map(|k| follow(&mut line_filter, k, &still(k), own(k), [0.06, 0.004])).collect();
    let alone = rms((40..60).map(|k| own(k)[1]));
    let combined = rms(filtered[20..].iter().map(|t| t[0]));
    assert!(combined < 0.5 * alone, "{combined} of {alone}");
}

#[test]
fn a_line_that_is_surer_than_the_skin_stays_as_it_is() {
    let filtered = followed(40, 1.0, 20.0, [1e-3, 1e-4]);
    for (k, [off, _]) in filtered.into_iter().enumerate() {
        assert!((off - error(k)[1]).abs() < 1e-3, "{k}: {off}");
    }
}

#[test]
fn skin_that_is_out_of_sight_leaves_the_line_alone_and_is_learned_anew() {
    let mut line_filter = LineFilter::new();
    let away = Painted::at([400.0, 300.0], 0.4);
    for k in 0..20 {
        let painted = painted(k, 1.0, 20.0);
        let shown = if (8..12).contains(&k) { away } else { painted };
        let line = line(&painted, error(k), [0.15, 0.01]);
        let filtered = shown.show(|image| line_filter.follow(image, k as f64 / 25.0, line, &SHOWN));
        if (8..12).contains(&k) {
            assert_eq!(filtered, line);
        }
    }
    assert!(line_filter.state.is_some_and(|state| state.missed == 0));
    for k in 20..20 + MOST_MISSED {
        let line = line(&painted(k, 1.0, 20.0), error(k), [0.15, 0.01]);
        assert_eq!(
            away.show(|image| line_filter.follow(image, k as f64 / 25.0, line, &SHOWN)),
            line
        );
    }
    assert!(line_filter.state.is_none());
}

#[test]
fn lines_that_scatter_by_more_than_they_say_are_told_to() {
    let filtered = followed(60, 1.0, 20.0, [0.15, 0.01]);
    let boasting = followed(60, 1.0, 20.0, [0.05, 0.0033]);
    let sigma = |filtered: &[[f64; 2]]| rms(filtered[30..].iter().map(|t| t[1]));
    let off = rms(boasting[30..].iter().map(|t| t[0]));
    assert!(off < 1.5 * sigma(&boasting), "{off} {}", sigma(&boasting));
    assert!(sigma(&boasting) > 0.5 * sigma(&filtered), "{} {}", sigma(&boasting), sigma(&filtered));
}

#[test]
fn a_line_that_contradicts_those_before_is_doubted_and_so_are_they() {
    let mut line_filter = LineFilter::new();
    let mut follow =
        |k, off| follow(&mut line_filter, k, &painted(k, 1.0, 20.0), off, [0.15, 0.01]);
    let usual = (0..20).map(|k| follow(k, error(k))).last();
    let [off, sigma] = follow(20, [0.5, 0.09]);
    assert!(off.abs() < 0.03, "{off}");
    assert!(usual.is_some_and(|[_, usual]| sigma > 1.2 * usual), "{usual:?} {sigma}");
}
