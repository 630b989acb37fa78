//! The filter is private to the crate; the truth is the rendered pose.

use super::*;
use crate::axis::{RenderedFinger, Stretch};
use crate::track::LineSource;

const DIMENSIONS: BandDimensions =
    BandDimensions { half_width_px: 8.0, taper: 0.0, length_px: 60.0 };

/// A line with the error `deviation` and the standard deviations `sigmas`.
fn line(rendered: &RenderedFinger, deviation: [f64; 2], sigmas: [f64; 2]) -> FingerLine {
    let axis = rendered.axis();
    let anchor = axis.anchor + axis.normal() * deviation[0];
    FingerLine {
        axis: Axis::of_finger(anchor, axis.angle_rad + deviation[1], 30.0),
        half_length_px: 30.0,
        stretch: Stretch::about(0.0, 30.0),
        covariance: Matrix2::from_diagonal(&Vector2::from(sigmas.map(|s| s * s))),
        source: LineSource::Contour,
    }
}

fn rendered(k: usize, step_px: f64, texture: f64) -> RenderedFinger {
    let k = k as f64;
    let tip = [100.0 + step_px * 9.0 * (0.5 * k).sin(), 70.0 + step_px * 4.0 * (0.3 * k).cos()];
    let stripes_px = 0.7 * k;
    let angle_rad = 0.4 + 0.02 * step_px * (0.2 * k).sin();
    RenderedFinger {
        texture,
        stripes_px,
        noise: 2.0,
        seed: 7 + k as u64,
        ..RenderedFinger::at(tip, angle_rad)
    }
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
    rendered: &RenderedFinger,
    deviation: [f64; 2],
    sigmas: [f64; 2],
) -> [f64; 2] {
    let line = line(rendered, deviation, sigmas);
    let filtered =
        rendered.show(|image| line_filter.follow(image, k as f64 / 25.0, line, &DIMENSIONS));
    [filtered.axis.angle_rad - rendered.angle_rad, filtered.covariance[(1, 1)].sqrt()]
}

/// The same for `frames` frames.
fn followed(frames: usize, step_px: f64, texture: f64, sigmas: [f64; 2]) -> Vec<[f64; 2]> {
    let mut line_filter = LineFilter::new();
    let deviation = |k| if step_px > 0.0 { error(k) } else { error(0) };
    (0..frames)
        .map(|k| follow(&mut line_filter, k, &rendered(k, step_px, texture), deviation(k), sigmas))
        .collect()
}

fn rms(values: impl ExactSizeIterator<Item = f64>) -> f64 {
    let count = values.len() as f64;
    (values.map(|v| v * v).sum::<f64>() / count).sqrt()
}

#[test]
fn the_lines_of_a_moving_finger_are_averaged() {
    let filtered = followed(60, 1.0, 20.0, [0.15, 0.01]);
    let alone = rms((20..60).map(|k| error(k)[1]));
    let combined = rms(filtered[20..].iter().map(|t| t[0]));
    assert!(combined < 0.5 * alone, "{combined} of {alone}");
    // The reported standard deviation agrees with the error.
    let sigma = rms(filtered[20..].iter().map(|t| t[1]));
    assert!(combined < 1.3 * sigma && sigma < 0.6 * 0.01, "{combined} {sigma}");
}

#[test]
fn the_common_error_of_a_resting_finger_is_not_averaged_away() {
    let filtered = followed(60, 0.0, 20.0, [0.15, 0.01]);
    for [angle_error, sigma] in filtered {
        assert!((angle_error - error(0)[1]).abs() < 1e-9 && (sigma - 0.01).abs() < 1e-9);
    }
}

#[test]
fn independent_errors_of_a_resting_finger_are_averaged_away() {
    let mut line_filter = LineFilter::new();
    let (common, sigmas) = ([0.1, 0.007], [0.2, 0.014]);
    let independent = |k: usize| error(k).map(|component| 0.7 * component);
    let deviation = |k: usize| [common[0] + independent(k)[0], common[1] + independent(k)[1]];
    let filtered: Vec<_> = (0..40)
        .map(|k| follow(&mut line_filter, k, &rendered(k, 0.0, 20.0), deviation(k), sigmas))
        .collect();
    let alone = rms((20..40).map(|k| independent(k)[1]));
    let combined = rms(filtered[20..].iter().map(|t| t[0] - common[1]));
    assert!(combined < 0.3 * alone, "{combined} of {alone}");
    // The reported standard deviation agrees with the remaining error.
    let (error, sigma) = (rms(filtered[20..].iter().map(|t| t[0])), filtered[39][1]);
    assert!((0.5..1.3).contains(&(error / sigma)), "{error} {sigma}");
}

#[test]
fn a_finger_that_comes_to_rest_is_averaged_over_the_frames_since() {
    let mut line_filter = LineFilter::new();
    for k in 0..20 {
        follow(&mut line_filter, k, &rendered(k, 1.0, 20.0), error(k), [0.15, 0.01]);
    }
    // At rest, a frame is more precise than the filtered line.
    let resting = |k: usize| RenderedFinger { seed: 7 + k as u64, ..rendered(20, 1.0, 20.0) };
    let independent = |k: usize| error(k).map(|component| 0.3 * component);
    let filtered: Vec<_> = (20..60)
        .map(|k| follow(&mut line_filter, k, &resting(k), independent(k), [0.06, 0.004]))
        .collect();
    let alone = rms((40..60).map(|k| independent(k)[1]));
    let combined = rms(filtered[20..].iter().map(|t| t[0]));
    assert!(combined < 0.5 * alone, "{combined} of {alone}");
}

#[test]
fn a_line_more_certain_than_the_texture_is_unchanged() {
    let filtered = followed(40, 1.0, 20.0, [1e-3, 1e-4]);
    for (k, [angle_error, _]) in filtered.into_iter().enumerate() {
        assert!((angle_error - error(k)[1]).abs() < 1e-3, "{k}: {angle_error}");
    }
}

#[test]
fn hidden_texture_leaves_the_line_unchanged_and_is_learned_anew() {
    let mut line_filter = LineFilter::new();
    let outside = RenderedFinger::at([400.0, 300.0], 0.4);
    for k in 0..20 {
        let rendered = rendered(k, 1.0, 20.0);
        let displayed = if (8..12).contains(&k) { outside } else { rendered };
        let line = line(&rendered, error(k), [0.15, 0.01]);
        let filtered =
            displayed.show(|image| line_filter.follow(image, k as f64 / 25.0, line, &DIMENSIONS));
        if (8..12).contains(&k) {
            assert_eq!(filtered, line);
        }
    }
    assert!(line_filter.state.is_some_and(|state| state.missed == 0));
    for k in 20..20 + MOST_MISSED {
        let line = line(&rendered(k, 1.0, 20.0), error(k), [0.15, 0.01]);
        assert_eq!(
            outside.show(|image| line_filter.follow(image, k as f64 / 25.0, line, &DIMENSIONS)),
            line
        );
    }
    assert!(line_filter.state.is_none());
}

#[test]
fn lines_that_scatter_beyond_their_variances_are_inflated() {
    let filtered = followed(60, 1.0, 20.0, [0.15, 0.01]);
    let overconfident = followed(60, 1.0, 20.0, [0.05, 0.0033]);
    let sigma = |filtered: &[[f64; 2]]| rms(filtered[30..].iter().map(|t| t[1]));
    let angle_error = rms(overconfident[30..].iter().map(|t| t[0]));
    assert!(angle_error < 1.5 * sigma(&overconfident), "{angle_error} {}", sigma(&overconfident));
    assert!(
        sigma(&overconfident) > 0.5 * sigma(&filtered),
        "{} {}",
        sigma(&overconfident),
        sigma(&filtered)
    );
}

#[test]
fn an_outlier_hardly_moves_the_line_and_inflates_its_covariance() {
    let mut line_filter = LineFilter::new();
    let mut follow = |k, deviation| {
        follow(&mut line_filter, k, &rendered(k, 1.0, 20.0), deviation, [0.15, 0.01])
    };
    let before = (0..20).map(|k| follow(k, error(k))).last();
    let [angle_error, sigma] = follow(20, [0.5, 0.09]);
    assert!(angle_error.abs() < 0.03, "{angle_error}");
    assert!(before.is_some_and(|[_, before]| sigma > 1.2 * before), "{before:?} {sigma}");
}
