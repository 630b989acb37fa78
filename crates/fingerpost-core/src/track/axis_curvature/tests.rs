//! The refinement makes the reports that are learned; here they are given.

use super::*;
use crate::track::LineSource;
use nalgebra::{Matrix2, Point2};

const HALF_PX: f64 = 30.0;
const RESIDUAL_GREY: f64 = 2.0;
const NOISE_GREY: f64 = 2.0;

fn refined(bend_px: f64, bend_sigma_px: f64, source: Source) -> Refined {
    let photometric = PhotometricReport {
        pixels: 900,
        blocks: 40,
        trusted: 1.0,
        rejected: 0.0,
        residual_grey: RESIDUAL_GREY,
        blur_px: 1.0,
        half_length_px: HALF_PX,
        bend_px,
        bend_sigma_px,
        contrast_grey: [1e9; 2],
        edge_px: [0.0; 2],
        iterations: 5,
        converged: true,
    };
    Refined {
        axis: Axis::of_finger(Point2::new(100.0, 80.0), 0.3, HALF_PX),
        covariance: Matrix2::identity(),
        stretch: Stretch { from_px: -HALF_PX, to_px: HALF_PX },
        half_width_px: 8.0,
        taper: 0.0,
        source,
        noise_grey: NOISE_GREY,
        bisector: None,
        photometric: Some(photometric),
    }
}

fn side_view(half_width_px: f64) -> FingerScale {
    FingerScale { half_width_px, foreshortening: 1.0 }
}

#[test]
fn a_bend_causes_a_bias_and_noise_causes_none() {
    let mut bent = AxisCurvature::default();
    assert!(bent.bend_bias().abs() < 1e-12);
    for _ in 0..5 {
        bent.learn(&refined(-0.5, 0.3, Source::Unsure), true);
    }
    assert!((bent.bend_bias() - BEND_BIAS * 0.4 / HALF_PX).abs() < 1e-9);

    let mut straight = AxisCurvature::default();
    for k in 0..40 {
        let noise = 0.3 * (2.3 * f64::from(k)).sin();
        straight.learn(&refined(noise, 0.3, Source::Photometric), true);
    }
    assert!(straight.bend_bias().abs() < 1e-12);
}

#[test]
fn a_faint_flank_moves_the_line_only_part_of_the_way_to_the_front() {
    let (curvature, half_width_px) = (2e-3, 7.0);
    let bend_px = curvature * HALF_PX * HALF_PX / 3.0;
    let turn = |faintest: f64, is_coloured: bool| {
        let observed = refined(bend_px, 0.0, Source::Unsure);
        let contrast_grey = [-1e9, faintest * HALF_RELIABLE_CONTRAST_RATIO * RESIDUAL_GREY];
        let photometric = observed.photometric.map(|p| PhotometricReport { contrast_grey, ..p });
        let mut axis_curvature = AxisCurvature::default();
        axis_curvature.learn(&Refined { photometric, ..observed }, is_coloured);
        let line = line_over(curvature, 9.0 * half_width_px, 0.0);
        axis_curvature.at_front(line, None, &side_view(half_width_px)).difference(&line.axis).y
    };
    let [whole, front] = [turn(1e9, false), turn(1e9, true)];
    assert!((front - whole).abs() > 0.01, "{whole} {front}");
    for (faintest, reliable_part) in [(0.0, 0.0), (1.0, 0.5), (-2.0, 16.0 / 17.0)] {
        let expected = whole + reliable_part * (front - whole);
        assert!((turn(faintest, true) - expected).abs() < 1e-9, "{faintest}");
    }
}

/// Weight of the bias of a faint flank with this contrast and this scatter of its pixels.
fn faintness(contrast_grey: f64, residual_grey: f64, is_coloured: bool) -> f64 {
    let observed = refined(0.0, 0.3, Source::Photometric);
    let contrast_grey = [-1e9, contrast_grey];
    let with_contrast = |p| PhotometricReport { residual_grey, contrast_grey, ..p };
    let mut axis_curvature = AxisCurvature::default();
    let photometric = observed.photometric.map(with_contrast);
    axis_curvature.learn(&Refined { photometric, ..observed }, is_coloured);
    assert!(axis_curvature.bend_bias().abs() < 1e-12);
    axis_curvature.faint_flank_bias() / FAINT_FLANK_BIAS
}

#[test]
fn a_faint_flank_causes_a_bias_even_of_a_straight_line() {
    let texture_grey: f64 = 6.0;
    let residual_grey = (texture_grey.powi(2) + NOISE_AT_MOST * NOISE_GREY.powi(2)).sqrt();
    for is_coloured in [true, false] {
        let faintness =
            |times: f64| faintness(times * FAINT * texture_grey, residual_grey, is_coloured);
        assert!((faintness(0.0) - 1.0).abs() < 1e-12);
        assert!((faintness(-1.0) - 0.5).abs() < 1e-9);
        assert!((faintness(1.5) - 0.04).abs() < 0.005);
        assert!(faintness(3.0) < 1e-3);
    }
    assert!(AxisCurvature::default().faint_flank_bias().abs() < 1e-12);
}

#[test]
fn noise_makes_no_flank_faint() {
    for times in [0.5, 1.0, 1.09] {
        assert!(faintness(5.0 * NOISE_GREY, times * NOISE_GREY, true) < 0.05);
    }
}

#[test]
fn no_bend_is_learned_from_pixels_that_disagree_with_the_model() {
    let mut axis_curvature = AxisCurvature::default();
    axis_curvature.learn(&refined(5.0, 0.1, Source::Bisector), true);
    assert!(axis_curvature.bend_bias().abs() < 1e-12);
}

/// Middle \[px from the medial line's vertex, towards the tip\] and slope of the least-squares line
/// over a segment of y = κ x² / 2.
fn least_squares(curvature: f64, middle_px: f64, half_px: f64) -> [f64; 2] {
    let (mut sums, count) = ([0.0; 3], 2001);
    for k in 0..count {
        let t = 2.0 * f64::from(k) / f64::from(count - 1) - 1.0;
        let medial = 0.5 * curvature * (middle_px + t * half_px).powi(2);
        sums = [sums[0] + medial, sums[1] + t * medial, sums[2] + t * t];
    }
    [sums[0] / f64::from(count), sums[1] / (sums[2] * half_px)]
}

/// The finger line of a segment from `far_px` to `near_px` behind the tip at (200, 0), of a finger
/// that points along +u and has the vertex of its bend at the tip.
fn line_over(curvature: f64, far_px: f64, near_px: f64) -> FingerLine {
    let (middle_px, half_px) = (-0.5 * (far_px + near_px), 0.5 * (far_px - near_px));
    let [offset_px, slope] = least_squares(curvature, middle_px, half_px);
    let anchor = Point2::new(200.0 + middle_px, offset_px);
    FingerLine {
        axis: Axis::of_finger(anchor, slope, -middle_px),
        half_length_px: half_px,
        stretch: Stretch::about(0.0, half_px),
        covariance: Matrix2::identity(),
        source: LineSource::Pixels,
    }
}

#[test]
fn lines_of_different_segments_are_expressed_for_one() {
    let (curvature, half_width_px) = (2e-3, 7.0);
    let mut bent = AxisCurvature::default();
    bent.learn(&refined(curvature * HALF_PX * HALF_PX / 3.0, 0.0, Source::Photometric), true);
    for foreshortening in [1.0, 0.8] {
        let scale = FingerScale { half_width_px, foreshortening };
        let far_px = FRONT_SEGMENT.far_half_widths * foreshortening * half_width_px;
        let near_px = FRONT_SEGMENT.near_half_widths * half_width_px;
        let expected = line_over(curvature, far_px, near_px);
        for (more_far_px, more_near_px) in [(0.0, 0.0), (7.0, 1.0), (4.0, 4.0), (9.0, -1.0)] {
            let line = line_over(curvature, far_px + more_far_px, near_px + more_near_px);
            let mut axis_curvature = bent;
            let at_front = axis_curvature.at_front(line, None, &scale);
            let difference = at_front.difference(&expected.expressed_beside(&at_front).axis);
            assert!(difference.x.abs() < 2e-3 && difference.y.abs() < 2e-5, "{difference}");
            // A straight finger has one line.
            let straight = AxisCurvature::default().at_front(line, None, &scale);
            assert_eq!(straight.axis.anchor, line.axis.anchor);
            assert!((straight.axis.angle_rad - line.axis.angle_rad).abs() < 1e-15);
        }
    }
}

#[test]
fn a_line_cuts_the_medial_line_where_its_segment_implies() {
    let (curvature, half_width_px) = (5e-4, 7.0);
    let bend_px = curvature * HALF_PX * HALF_PX / 3.0;
    let line = line_over(curvature, 66.0, 3.0);
    // Moved all of the way, or part of it for a bend that may be noise or shade.
    for (sigma_px, faintest) in [(0.0, 1e9), (0.0, 1.0), (0.7 * bend_px, 1e9), (9.0, 1e9)] {
        let observed = refined(bend_px, sigma_px, Source::Photometric);
        let contrast_grey = [1e9, faintest * HALF_RELIABLE_CONTRAST_RATIO * RESIDUAL_GREY];
        let photometric = observed.photometric.map(|p| PhotometricReport { contrast_grey, ..p });
        let mut axis_curvature = AxisCurvature::default();
        axis_curvature.learn(&Refined { photometric, ..observed }, true);
        let at_front = axis_curvature.at_front(line, None, &side_view(half_width_px));
        let cut_px = at_front.stretch.length_px() / 12.0_f64.sqrt();
        for along_px in [-1.0, 1.0].map(|s| at_front.stretch.middle_px() + s * cut_px) {
            let Point2 { coords, .. } = at_front.axis.anchor + at_front.axis.direction() * along_px;
            // The vertex of the bend is the tip.
            let medial = 0.5 * curvature * (coords.x - 200.0).powi(2);
            assert!((coords.y - medial).abs() < 3e-4, "{sigma_px} {faintest}: {coords}");
        }
    }
    // Without a known bend, the line is reported for the segment it was measured on.
    let at_front = AxisCurvature::default().at_front(line, None, &side_view(half_width_px));
    assert!((at_front.stretch.length_px() - 63.0).abs() < 1e-9, "{:?}", at_front.stretch);
    assert!(at_front.stretch.middle_px().abs() < 1e-9, "{:?}", at_front.stretch);
}

/// The state after one measurement of a finger whose bend turns its line by `turn_rad` from the
/// whole to the front, in an image with colours or without, and the measurement.
fn bent(turn_rad: f64, sigma_px: f64, is_coloured: bool) -> (AxisCurvature, Refined) {
    // A segment of 60 px is 20.8 px longer than the front of a finger with a half-width of 7 px.
    let curvature = turn_rad / (0.5 * (2.0 * HALF_PX - 5.6 * 7.0));
    let observed = refined(curvature * HALF_PX * HALF_PX / 3.0, sigma_px, Source::Photometric);
    let mut axis_curvature = AxisCurvature::default();
    axis_curvature.learn(&observed, is_coloured);
    (axis_curvature, Refined { covariance: Matrix2::identity() * 1e-6, ..observed })
}

#[test]
fn the_front_is_measured_where_its_bend_exceeds_the_noise() {
    let front_px = |(axis_curvature, observed): &(AxisCurvature, Refined)| {
        axis_curvature.front_to_measure(observed, &side_view(7.0))
    };
    assert_eq!(front_px(&bent(0.01, 0.0, true)), Some(5.6 * 7.0));
    assert_eq!(front_px(&bent(-0.01, 0.0, true)), Some(5.6 * 7.0));
    // No measurement for a bend of 0, one that may be shade, or one that may be noise.
    assert_eq!(front_px(&bent(0.001, 0.0, true)), None);
    assert_eq!(front_px(&bent(0.01, 0.0, false)), None);
    assert_eq!(front_px(&bent(0.01, 1.0, true)), None);
    // Nor where the short segment is less precise, or nothing lies behind it.
    let (axis_curvature, observed) = bent(0.01, 0.0, true);
    let noisy = Refined { covariance: Matrix2::identity() * 0.02_f64.powi(2), ..observed };
    assert_eq!(axis_curvature.front_to_measure(&noisy, &side_view(7.0)), None);
    assert_eq!(axis_curvature.front_to_measure(&observed, &side_view(11.0)), None);
}

#[test]
fn a_line_of_the_distal_segment_replaces_the_bend() {
    let (mut axis_curvature, _) = bent(0.01, 0.0, true);
    let half_width_px = 7.0;
    let (far_px, near_px) = (
        FRONT_SEGMENT.far_half_widths * half_width_px,
        FRONT_SEGMENT.near_half_widths * half_width_px,
    );
    // A knuckle turns the line of the whole, not that of the front: no parabola does so.
    let whole = line_over(0.0, 66.0, near_px).moved(&Vector2::new(0.7, 0.05));
    let straight = line_over(0.0, far_px, near_px);
    let front = FrontLine::beside(&straight, &whole);
    let at_front = axis_curvature.at_front(whole, Some(&front), &side_view(half_width_px));
    let difference = at_front.difference(&straight.expressed_beside(&at_front).axis);
    assert!(difference.x.abs() < 1e-2 && difference.y.abs() < 1e-3, "{difference}");
    assert!(
        (at_front.stretch.length_px() - (far_px - near_px)).abs() < 0.1,
        "{:?}",
        at_front.stretch
    );
    // Its covariance is the sum of both.
    let beside = straight.expressed_beside(&whole).covariance;
    assert!((at_front.covariance - whole.covariance - beside).norm() < 1e-6 * beside.norm());
}

#[test]
fn a_front_without_length_has_a_segment_of_2_px() {
    let mut axis_curvature = AxisCurvature::default();
    axis_curvature.learn(&refined(0.6, 0.0, Source::Photometric), true);
    // At this foreshortening the front ends before it begins.
    let scale = FingerScale { half_width_px: 7.0, foreshortening: 0.01 };
    let at_front = axis_curvature.at_front(line_over(2e-3, 66.0, 3.0), None, &scale);
    assert!((at_front.stretch.length_px() - 2.0).abs() < 1e-9, "{:?}", at_front.stretch);
}

#[test]
fn a_short_segment_is_not_extrapolated_beyond_its_limit() {
    let (curvature, half_width_px) = (2e-3, 7.0);
    let mut axis_curvature = AxisCurvature::default();
    axis_curvature
        .learn(&refined(curvature * HALF_PX * HALF_PX / 3.0, 0.0, Source::Photometric), true);
    let near_px = FRONT_SEGMENT.near_half_widths * half_width_px;
    // A segment that is always visible of this hand is the one the line is reported for.
    let short = line_over(curvature, 30.0, near_px);
    let difference =
        axis_curvature.at_front(short, None, &side_view(half_width_px)).difference(&short.axis);
    assert!(difference.norm() < 1e-12, "{difference}");
    // In a frame that shows less, the line is moved by a part of that.
    let shorter = line_over(curvature, 12.0, near_px);
    let turn = axis_curvature
        .at_front(shorter, None, &side_view(half_width_px))
        .difference(&shorter.axis)
        .y;
    let limit = curvature * FRONT_SEGMENT.max_shift_part * shorter.half_length_px;
    assert!((turn.abs() - limit).abs() < 1e-9, "{turn} {limit}");
}

#[test]
fn the_bend_bias_is_that_of_a_shifted_segment() {
    let (bend_px, shift_px) = (0.6, BEND_BIAS * HALF_PX / 3.0_f64.sqrt());
    let curvature = 3.0 * bend_px / (HALF_PX * HALF_PX);
    let [turned, straight] =
        [shift_px, 0.0].map(|middle_px| least_squares(curvature, middle_px, HALF_PX)[1]);
    let mut axis_curvature = AxisCurvature::default();
    axis_curvature.learn(&refined(bend_px, 0.0, Source::Photometric), true);
    let sigma = axis_curvature.bend_bias() * 3.0_f64.sqrt();
    assert!(((turned - straight) / sigma - 1.0).abs() < 1e-3, "{turned} {straight} {sigma}");
}
