//! The search along normals on rendered edges at known positions and on arbitrary bytes.

use crate::common::{Canvas, HalfPlane, Noise, Picture};
use fingerpost_core::appearance::histogram::HistogramModel;
use fingerpost_core::geometry::shape_space::PlacedSample;
use fingerpost_core::image::frame::ColourView;
use fingerpost_core::image::gray::GrayView;
use fingerpost_core::measure::edge::{
    Edge, EdgeMeasurement, MAX_HALF_LENGTH_PX, Miss, Polarity, Scale, SearchLine,
};
use fingerpost_core::measure::edge_search::{Cue, EdgeSearch, SearchOptions};
use fingerpost_core::nalgebra::{Point2, Vector2};
use fingerpost_core::numeric::simd::Isa;
use fingerpost_core::{Error, Frame};
use proptest::prelude::*;
use proptest::test_runner::{Config, RngSeed};
use std::f64::consts::{PI, TAU};

const BACKGROUND: f64 = 60.0;
const CONTRAST: f64 = 80.0;
/// Blur of the rendered edges [px]; with the pixel's own extent, 1/12 px², it makes one.
const BLUR_PX: f64 = 0.957_427;
const LENGTH_PX: f64 = 10.0;

fn config() -> Config {
    Config { rng_seed: RngSeed::Fixed(0x7365_6172), failure_persistence: None, ..Config::default() }
}

fn options() -> SearchOptions {
    SearchOptions { scale_px: 1.6, blur_px: 1.0, noise_grey: 2.0, min_contrast_grey: 12.0 }
}

fn line(position: Point2<f64>, normal: Vector2<f64>) -> SearchLine {
    SearchLine {
        sample: PlacedSample { position, normal },
        half_length_px: LENGTH_PX,
        polarity: Polarity::Bright,
    }
}

fn at_angle(angle_rad: f64) -> Vector2<f64> {
    Vector2::new(angle_rad.cos(), angle_rad.sin())
}

fn search_all(
    options: SearchOptions,
    image: GrayView<'_>,
    cue: Cue<'_>,
    scale: Scale,
    lines: &[SearchLine],
) -> Vec<EdgeMeasurement> {
    let mut found = Vec::new();
    let mut search = EdgeSearch::new(options).unwrap();
    search.search(&Frame::gray(image), cue, scale, lines, &mut found).unwrap();
    assert_eq!(found.len(), lines.len());
    found
}

fn search(image: GrayView<'_>, line: &SearchLine) -> EdgeMeasurement {
    search_all(options(), image, Cue::Edges, Scale::Fine, &[*line])[0]
}

/// A bright half-plane before a darker background, without noise.
fn picture(edge: &HalfPlane) -> Picture {
    let canvas = Canvas::new(64, 64, BACKGROUND).paint(edge, BACKGROUND + CONTRAST);
    canvas.blur(BLUR_PX).take(0.0, &mut Noise::new(0))
}

const CENTRE: Point2<f64> = Point2::new(31.3, 32.2);

#[test]
fn an_edge_is_found_at_any_angle_and_subpixel_position() {
    /// Interpolation between pixels and between the kernel's responses, and rounding to 8 bits.
    const OFFSET_TOLERANCE_PX: f64 = 0.04;
    /// The response is read at the pixel nearest to the edge, up to half a pixel from its peak.
    const CONTRAST_TOLERANCE: f64 = 0.05;
    for turn in 0..24 {
        let angle_rad = 0.1 + TAU * f64::from(turn) / 24.0;
        for step in 0..9 {
            let offset_px = f64::from(step) * 1.15 - 4.6;
            let picture = picture(&HalfPlane::beyond(CENTRE, angle_rad, offset_px));
            for scale in [Scale::Fine, Scale::Coarse] {
                let line = line(CENTRE, at_angle(angle_rad));
                let found = search_all(options(), picture.view(), Cue::Edges, scale, &[line])[0];
                let edge =
                    found.unwrap_or_else(|m| unreachable!("{m:?} at {angle_rad} {offset_px}"));
                let error = edge.offset_px - offset_px;
                assert!(error.abs() < OFFSET_TOLERANCE_PX, "{error} at {angle_rad}, {offset_px}");
                let contrast = edge.contrast_grey / CONTRAST - 1.0;
                assert!(contrast.abs() < CONTRAST_TOLERANCE, "{contrast}");
                assert_eq!(edge.separation, None);
            }
        }
    }
}

#[test]
fn along_a_row_of_pixels_the_offset_is_accurate_to_a_hundredth() {
    /// 0.01 px from the parabola, the rest from fixed-point arithmetic.
    const TOLERANCE_PX: f64 = 0.011;
    for k in 0..20 {
        let offset_px = f64::from(k) * 0.35 - 3.5;
        let at = Point2::new(30.0, 20.0);
        let picture = picture(&HalfPlane::beyond(at, 0.0, offset_px));
        let edge = search(picture.view(), &line(at, Vector2::x())).unwrap();
        assert!((edge.offset_px - offset_px).abs() < TOLERANCE_PX, "{edge:?} {offset_px}");
    }
}

#[test]
fn the_polarity_is_respected() {
    // A bright band: along the normal, its far side is an edge of a bright hand and its near side,
    // the stronger one, of a dark hand.
    let far = HalfPlane::beyond(CENTRE, 0.0, 6.0);
    let near = HalfPlane::beyond(CENTRE, 0.0, -6.0);
    let canvas = Canvas::new(64, 64, 100.0).paint(&far, 180.0).paint(&near, 60.0);
    let picture = canvas.blur(BLUR_PX).take(0.0, &mut Noise::new(0));
    let found = |polarity| {
        search(picture.view(), &SearchLine { polarity, ..line(CENTRE, Vector2::x()) }).unwrap()
    };
    let (bright, dark) = (found(Polarity::Bright), found(Polarity::Dark));
    assert!((bright.offset_px - 6.0).abs() < 0.05 && (bright.contrast_grey - 80.0).abs() < 4.0);
    assert!((dark.offset_px + 6.0).abs() < 0.05 && (dark.contrast_grey + 120.0).abs() < 6.0);
    assert_eq!(found(Polarity::Unknown), dark);
    assert!(bright.contrast_grey > 0.0 && dark.contrast_grey < 0.0);
    // A stronger edge has a smaller variance.
    assert!(dark.variance_px2 < bright.variance_px2);
}

/// Means of the squared errors of the offsets and of the reported variances, at points one pixel
/// apart along edges at several subpixel positions.
fn scatter_and_claim(options: SearchOptions, scale: Scale, angle_rad: f64) -> (f64, f64) {
    const PICTURES: u64 = 40;
    let (middle, normal) = (Point2::new(50.0, 50.0), at_angle(angle_rad));
    let along = Vector2::new(-normal.y, normal.x);
    let lines: Vec<_> = (-30..=30).map(|t| line(middle + along * f64::from(t), normal)).collect();
    // The blur of the options includes the extent of a pixel.
    let blur_px = (options.blur_px.powi(2) - 1.0 / 12.0).sqrt();
    let mut noise = Noise::new(0x7661_7269);
    let (mut squares, mut claims, mut count) = (0.0, 0.0, 0.0);
    for offset_px in [0.0, 0.3, 0.5] {
        let edge = HalfPlane::beyond(middle, angle_rad, offset_px);
        let canvas = Canvas::new(100, 100, BACKGROUND).paint(&edge, BACKGROUND + CONTRAST);
        let canvas = canvas.blur(blur_px);
        for _ in 0..PICTURES {
            let picture = canvas.take(options.noise_grey, &mut noise);
            for edge in search_all(options, picture.view(), Cue::Edges, scale, &lines) {
                let edge = edge.unwrap();
                squares += (edge.offset_px - offset_px).powi(2);
                claims += edge.variance_px2;
                count += 1.0;
            }
        }
    }
    (squares / count, claims / count)
}

#[test]
fn the_variance_matches_monte_carlo() {
    // Normals along rows of pixels, one per row: no pixel is interpolated or used twice, as the
    // formula assumes. 7320 offsets determine their variance to 1.7 %.
    for (scale_px, blur_px, scale) in [
        (1.6, 1.0, Scale::Fine),
        (2.2, 1.0, Scale::Fine),
        (1.6, 1.5, Scale::Fine),
        (1.0, 1.0, Scale::Coarse),
    ] {
        let options = SearchOptions { scale_px, blur_px, ..options() };
        let (seen, claimed) = scatter_and_claim(options, scale, 0.0);
        assert!((seen / claimed - 1.0).abs() < 0.1, "{seen} {claimed} at {scale_px}, {blur_px}");
        let s = scale_px * if scale == Scale::Coarse { 2.5 } else { 1.0 };
        let ratio = options.noise_grey / CONTRAST;
        let formula = 0.75 * PI.sqrt() * ratio * ratio * s.hypot(blur_px).powi(6) / s.powi(5);
        assert!((claimed / formula - 1.0).abs() < 0.1, "{claimed} {formula}");
    }
}

#[test]
fn interpolation_only_reduces_the_variance() {
    // At other angles every sample is interpolated between pixels, which averages their noise.
    for angle_rad in [0.02, 0.4] {
        let (seen, claimed) = scatter_and_claim(options(), Scale::Fine, angle_rad);
        assert!((0.3..1.1).contains(&(seen / claimed)), "{seen} {claimed} at {angle_rad}");
    }
}

#[test]
fn without_an_edge_there_is_no_offset() {
    let flat = Canvas::new(64, 64, 128.0).take(0.0, &mut Noise::new(0));
    for polarity in [Polarity::Bright, Polarity::Dark, Polarity::Unknown] {
        let line = SearchLine { polarity, ..line(CENTRE, Vector2::y()) };
        assert_eq!(search(flat.view(), &line), Err(Miss::NoContrast));
    }
    let wrong_way = picture(&HalfPlane::beyond(CENTRE, 0.0, 2.0));
    assert_eq!(search(wrong_way.view(), &line(CENTRE, -Vector2::x())), Err(Miss::NoContrast));
}

#[test]
fn the_minimum_contrast_is_a_threshold() {
    let picture = picture(&HalfPlane::beyond(CENTRE, 0.7, 1.0));
    let with = |min_contrast_grey| {
        let options = SearchOptions { min_contrast_grey, ..options() };
        let line = line(CENTRE, at_angle(0.7));
        search_all(options, picture.view(), Cue::Edges, Scale::Fine, &[line])[0]
    };
    assert!(with(0.9 * CONTRAST).is_ok());
    assert_eq!(with(1.05 * CONTRAST), Err(Miss::NoContrast));
}

#[test]
fn an_edge_beyond_the_line_is_not_reported_on_it() {
    let found_at = |offset_px| {
        let picture = picture(&HalfPlane::beyond(CENTRE, 0.4, offset_px));
        search(picture.view(), &line(CENTRE, at_angle(0.4)))
    };
    for offset_px in [-LENGTH_PX - 1.5, LENGTH_PX + 1.5] {
        assert_eq!(found_at(offset_px), Err(Miss::BeyondEnd));
    }
    for offset_px in [-LENGTH_PX - 9.0, LENGTH_PX + 9.0] {
        assert_eq!(found_at(offset_px), Err(Miss::NoContrast));
    }
}

#[test]
fn edges_are_found_within_the_length_of_the_line() {
    // A peak needs a neighbour on either side, so the outermost offset cannot be one.
    for (offset_px, half_length_px) in
        [(0.0, 1.0), (0.0, 0.3), (3.0, 4.0), (-3.0, 4.0), (6.0, 6.1), (-9.0, 10.0), (9.0, 10.0)]
    {
        let picture = picture(&HalfPlane::beyond(CENTRE, 0.4, offset_px));
        let at_length = |half_length_px| {
            search(picture.view(), &SearchLine { half_length_px, ..line(CENTRE, at_angle(0.4)) })
        };
        let found = at_length(half_length_px);
        assert!(
            found.is_ok_and(|e| (e.offset_px - offset_px).abs() < 0.05),
            "{found:?}, {offset_px} away within {half_length_px}"
        );
        if offset_px.abs() > 1.0 {
            assert!(at_length(offset_px.abs() - 1.0).is_err());
        }
    }
}

#[test]
fn a_sample_outside_the_image_is_a_miss() {
    let picture = picture(&HalfPlane::beyond(CENTRE, 0.0, 0.0));
    for (u, v) in
        [(-0.1, 30.0), (63.1, 30.0), (30.0, -0.1), (30.0, 63.1), (1e9, 1e9), (-1e300, 3.0)]
    {
        for angle_rad in [0.0, 1.0, PI] {
            let line = line(Point2::new(u, v), at_angle(angle_rad));
            assert_eq!(search(picture.view(), &line), Err(Miss::OutOfImage), "{u} {v}");
        }
    }
    // Inside, but too close to the border for three positions of the kernel.
    let line = line(Point2::new(2.0, 30.0), Vector2::x());
    assert_eq!(search(picture.view(), &line), Err(Miss::OutOfImage));
}

#[test]
fn near_the_border_only_the_visible_part_is_searched() {
    // The border is 9 px outward: the line loses its outer half.
    let at = Point2::new(54.0, 30.0);
    for offset_px in [-6.0, -2.5, 0.0, 2.0] {
        let picture = picture(&HalfPlane::beyond(at, 0.0, offset_px));
        let edge = search(picture.view(), &line(at, Vector2::x())).unwrap();
        assert!((edge.offset_px - offset_px).abs() < 0.02, "{edge:?}");
    }
    // The edge is visible, but the kernel would extend beyond the border.
    let picture = picture(&HalfPlane::beyond(at, 0.0, 6.5));
    assert!(search(picture.view(), &line(at, Vector2::x())).is_err());
}

/// The appearance model of a frame with known hand pixels.
fn learned(frame: &Frame<'_>, is_hand: impl Fn(usize, usize) -> bool) -> HistogramModel {
    let mut appearance = HistogramModel::new(frame.colour().is_some());
    for y in 0..frame.image().height() {
        for x in 0..frame.image().width() {
            appearance.observe(frame, x as f64, y as f64, is_hand(x, y));
        }
    }
    appearance.learn();
    appearance
}

/// A hand of level 150 left of u = 33.4, a background of level 60, and stripes on both sides of the
/// hand's edge with stronger edges.
fn cluttered() -> Picture {
    let to = |u: f64| HalfPlane { through: Point2::new(u, 0.0), outward: Vector2::x() };
    let canvas = Canvas::new(64, 64, 60.0).paint(&to(46.0), 250.0).paint(&to(40.0), 60.0);
    let canvas = canvas.paint(&to(33.4), 150.0).paint(&to(26.0), 20.0).paint(&to(23.0), 150.0);
    canvas.blur(BLUR_PX).take(2.0, &mut Noise::new(0x636c_7574))
}

#[test]
fn the_edge_of_the_hand_is_distinguished_from_stronger_ones() {
    let picture = cluttered();
    let appearance = learned(&picture.view().into(), |x, _| x <= 33);
    for polarity in [Polarity::Bright, Polarity::Unknown] {
        let half_length_px = 14.0;
        let lines: Vec<_> = (8..56)
            .map(|y| SearchLine {
                half_length_px,
                polarity,
                ..line(Point2::new(31.0, f64::from(y)), Vector2::x())
            })
            .collect();
        let all = |cue| search_all(options(), picture.view(), cue, Scale::Fine, &lines);
        for edge in all(Cue::Edges) {
            assert!((edge.unwrap().offset_px - 2.4).abs() > 3.0, "the strongest is another's");
        }
        for edge in all(Cue::HandEdges(&appearance)) {
            let edge = edge.unwrap();
            assert!((edge.offset_px - 2.4).abs() < 0.2, "{edge:?}");
            assert!(edge.separation.unwrap() > 1.0);
        }
        for edge in all(Cue::LogRatio(&appearance)) {
            let edge = edge.unwrap();
            assert!((edge.offset_px - 2.4).abs() < 1.5, "{edge:?}");
            assert!(edge.separation.unwrap() > 1.0 && edge.variance_px2 >= 1.0);
        }
    }
}

/// Mean log-likelihood ratio of the pixels nearest to samples of a line, which are counted from its
/// inner end; coordinates are 16.16 fixed point.
fn mean_log_ratio(
    frame: &Frame<'_>,
    appearance: &HistogramModel,
    sample: &PlacedSample,
    first_px: f64,
    samples: std::ops::Range<i64>,
) -> f64 {
    let fixed = |x: f64| (x * 65536.0).round_ties_even() as i64;
    let first = sample.position + sample.normal * first_px;
    let count = samples.clone().count();
    let nearest = |start: f64, step: f64, i: i64| {
        let at = fixed(start) + fixed(step) * i;
        ((at + (1 << 15)) >> 16) as f64
    };
    let ratios = samples.map(|i| {
        let u = nearest(first.x, sample.normal.x, i);
        f64::from(appearance.log_ratio(frame, u, nearest(first.y, sample.normal.y, i)))
    });
    ratios.sum::<f64>() / count as f64
}

#[test]
fn separation_is_the_difference_of_mean_log_ratios() {
    let picture = cluttered();
    let frame = picture.view().into();
    let appearance = learned(&frame, |x, _| x <= 33);
    // The kernel of 1.6 px has a reach of 5 px, by which samples extend beyond the line's ends.
    let (half, reach) = (8, 5);
    let lines: Vec<_> = (0..600)
        .map(|i| SearchLine {
            half_length_px: half as f64,
            ..line(
                Point2::new(31.0 + 0.0137 * f64::from(i % 97), 16.0 + 0.0531 * f64::from(i)),
                at_angle(0.4 * f64::from(i).sin()),
            )
        })
        .collect();
    let found =
        search_all(options(), picture.view(), Cue::HandEdges(&appearance), Scale::Fine, &lines);
    let mut compared = 0;
    for (line, edge) in lines.iter().zip(&found) {
        let Ok(edge) = edge else { continue };
        let at = edge.offset_px.round() as i64 + half + reach;
        let first_px = -(half + reach) as f64;
        let mean = |samples| mean_log_ratio(&frame, &appearance, &line.sample, first_px, samples);
        let separation = mean(at - reach..at) - mean(at + 1..at + 1 + reach);
        assert!((edge.separation.unwrap() - separation).abs() < 1e-5, "{edge:?}: {separation}");
        compared += 1;
    }
    assert!(compared > 500, "{compared}");
}

#[test]
fn log_ratios_locate_a_blurred_boundary() {
    // A ramp of 30 px between hand and background, in which no kernel finds an edge.
    let (width, height) = (96, 16);
    let ramp = |x: usize| (200.0 - 3.0 * (x as f64 - 33.0).clamp(0.0, 30.0)) as u8;
    let bytes = (0..width * height).map(|i| ramp(i % width)).collect();
    let picture = Picture { width, height, bytes };
    let appearance = learned(&picture.view().into(), |x, _| x < 48);
    for u in [40.0, 48.0, 56.0] {
        let line = SearchLine { half_length_px: 20.0, ..line(Point2::new(u, 8.0), Vector2::x()) };
        let options = SearchOptions { min_contrast_grey: 30.0, ..options() };
        let with = |cue| search_all(options, picture.view(), cue, Scale::Fine, &[line])[0];
        assert!(with(Cue::Edges).is_err());
        let edge = with(Cue::LogRatio(&appearance)).unwrap();
        assert!((u + edge.offset_px - 47.5).abs() < 2.0, "{edge:?}");
    }
}

#[test]
fn without_a_learned_hand_no_edge_is_reported() {
    let picture = picture(&HalfPlane::beyond(CENTRE, 0.0, 1.0));
    let unknown = HistogramModel::new(false);
    let line = line(CENTRE, Vector2::x());
    for cue in [Cue::HandEdges(&unknown), Cue::LogRatio(&unknown)] {
        let found = search_all(options(), picture.view(), cue, Scale::Fine, &[line])[0];
        assert!(found.is_err(), "{found:?}");
    }
}

#[test]
fn an_edge_without_contrast_is_not_reported() {
    // A flat area, then a falling edge along the normal, so no edge of a dark hand.
    let (width, height) = (64, 8);
    let bytes = (0..width * height).map(|i| if i % width < 40 { 150 } else { 60 }).collect();
    let picture = Picture { width, height, bytes };
    let options = SearchOptions { min_contrast_grey: 0.0, ..options() };
    for polarity in [Polarity::Bright, Polarity::Dark, Polarity::Unknown] {
        for normal in [Vector2::x(), -Vector2::x()] {
            for u in 20..45 {
                let line = SearchLine { polarity, ..line(Point2::new(f64::from(u), 4.0), normal) };
                let found =
                    search_all(options, picture.view(), Cue::Edges, Scale::Fine, &[line])[0];
                if let Ok(edge) = found {
                    assert!(edge.contrast_grey != 0.0 && edge.variance_px2.is_finite(), "{edge:?}");
                }
            }
        }
    }
}

#[test]
fn non_finite_lines_are_refused() {
    let picture = Canvas::new(16, 16, 50.0).take(0.0, &mut Noise::new(0));
    let frame = Frame::gray(picture.view());
    let mut search = EdgeSearch::new(options()).unwrap();
    let mut found = Vec::new();
    let good = line(Point2::new(8.0, 8.0), Vector2::x());
    let mut error = |line: SearchLine| {
        search.search(&frame, Cue::Edges, Scale::Fine, &[good, line], &mut found).unwrap_err()
    };
    for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
        for (position, normal, what) in [
            (Point2::new(bad, 8.0), Vector2::x(), "search position [px]"),
            (Point2::new(8.0, bad), Vector2::x(), "search position [px]"),
            (Point2::new(8.0, 8.0), Vector2::new(bad, 0.0), "search normal"),
            (Point2::new(8.0, 8.0), Vector2::new(0.0, bad), "search normal"),
        ] {
            let error = error(line(position, normal));
            assert!(matches!(error, Error::NotFinite { what: w, .. } if w == what), "{error}");
        }
        assert!(
            error(SearchLine { half_length_px: bad, ..good }).to_string().contains("half-length")
        );
    }
    for half_length_px in [0.0, -1.0, 128.5] {
        let error = error(SearchLine { half_length_px, ..good });
        assert_eq!(
            error.to_string(),
            format!(
                "search half-length [px] is {half_length_px}; it must be positive and at most 128"
            )
        );
    }
}

/// Options with one number set.
type Set = fn(f64) -> SearchOptions;

#[test]
fn an_image_beyond_fixed_point_is_refused() {
    let mut search = EdgeSearch::new(options()).unwrap();
    let mut refusal = |width: usize, height: usize, stride: usize| {
        let bytes = vec![0; (height - 1) * stride + width];
        let frame = Frame::gray(GrayView::new(&bytes, width, height, stride).unwrap());
        let found = search.search(&frame, Cue::Edges, Scale::Fine, &[], &mut Vec::new());
        found.err().map(|error| error.to_string())
    };
    for (width, height, stride) in [(32_767, 1, 32_767), (1, 32_767, 1), (2, 2, 131_071)] {
        assert_eq!(refusal(width, height, stride), None);
    }
    for (width, height) in [(32_768, 1), (1, 32_768)] {
        assert!(refusal(width, height, width).unwrap().contains("32767"));
    }
    let of_row = "row of the image [bytes] is 131072; it must be at most 131071";
    assert_eq!(refusal(2, 2, 131_072).unwrap(), of_row);
}

#[test]
fn options_out_of_range_are_refused() {
    let refused = |options: SearchOptions| EdgeSearch::new(options).unwrap_err().to_string();
    let ranges: [(&str, Set, f64, f64); 4] = [
        ("search scale [px]", |x| SearchOptions { scale_px: x, ..options() }, 0.5, 8.0),
        ("edge blur [px]", |x| SearchOptions { blur_px: x, ..options() }, 0.0, 8.0),
        ("image noise [grey levels]", |x| SearchOptions { noise_grey: x, ..options() }, 0.1, 64.0),
        (
            "least contrast [grey levels]",
            |x| SearchOptions { min_contrast_grey: x, ..options() },
            0.0,
            255.0,
        ),
    ];
    for (what, with, low, high) in ranges {
        for x in [low, high] {
            let options = with(x);
            assert_eq!(*EdgeSearch::new(options).unwrap().options(), options);
        }
        for x in [low.next_down(), high.next_up()] {
            assert_eq!(refused(with(x)), format!("{what} is {x}; it must be {low} to {high}"));
        }
        for x in [f64::NAN, f64::INFINITY] {
            assert_eq!(refused(with(x)), format!("{what} is {x}; it must be finite"));
        }
    }
    assert!(EdgeSearch::new(SearchOptions::default()).is_ok());
}

#[test]
fn a_search_has_no_state_between_calls() {
    let picture = cluttered();
    let frame = Frame::gray(picture.view());
    let appearance = learned(&picture.view().into(), |x, _| x <= 33);
    let mut search = EdgeSearch::new(options()).unwrap();
    let lines: Vec<_> =
        (0..64).map(|y| line(Point2::new(31.0, f64::from(y)), Vector2::x())).collect();
    let (mut first, mut again) = (Vec::new(), vec![Err(Miss::NoContrast); 3]);
    search.search(&frame, Cue::Edges, Scale::Fine, &lines, &mut first).unwrap();
    search.search(&frame, Cue::LogRatio(&appearance), Scale::Coarse, &lines, &mut again).unwrap();
    search.search(&frame, Cue::Edges, Scale::Fine, &lines, &mut again).unwrap();
    assert_eq!(first, again);
}

#[test]
fn large_strides_give_the_same_bits() {
    let close = cluttered();
    let Picture { width, height, .. } = close;
    let along = |k: u32| line(CENTRE + at_angle(f64::from(k)), at_angle(f64::from(3 * k)));
    let lines: Vec<_> = (0..40).map(along).collect();
    let expected = search_all(options(), close.view(), Cue::Edges, Scale::Fine, &lines);
    assert!(expected.iter().any(Result::is_ok));
    // Only the first stride fits in 16 bits with a sign.
    for stride in [32_767, 32_768, 100_000] {
        let mut bytes = vec![0; (height - 1) * stride + width];
        for (row, far) in close.bytes.chunks_exact(width).zip(bytes.chunks_mut(stride)) {
            far[..width].copy_from_slice(row);
        }
        let frame = Frame::gray(GrayView::new(&bytes, width, height, stride).unwrap());
        for isa in Isa::available() {
            let mut found = Vec::new();
            let mut search = EdgeSearch::new(options()).unwrap().with_isa(isa);
            search.search(&frame, Cue::Edges, Scale::Fine, &lines, &mut found).unwrap();
            assert_eq!(found, expected, "{isa}, {stride}");
        }
    }
}

/// Arbitrary bytes: noise, uniform, or black and white.
fn pictures() -> impl Strategy<Value = Picture> {
    let side = || prop_oneof![Just(1_usize), 1..40_usize];
    let byte = prop_oneof![Just(0_u8), Just(255_u8), any::<u8>()];
    (side(), side(), any::<bool>(), byte.clone()).prop_flat_map(
        move |(width, height, flat, value)| {
            let bytes = if flat { Just(value).boxed() } else { byte.clone().boxed() };
            prop::collection::vec(bytes, width * height).prop_map(move |bytes| Picture {
                width,
                height,
                bytes,
            })
        },
    )
}

/// Coordinates on a border, inside, outside and far away.
fn coordinates() -> impl Strategy<Value = f64> {
    prop_oneof![
        Just(0.0),
        Just(-0.0),
        (0..40).prop_map(f64::from),
        -5.0..45.0,
        prop_oneof![Just(1e12), Just(-1e300), Just(f64::MAX / 4.0), Just(f64::MIN_POSITIVE)],
    ]
}

/// Unit vectors, half of them along the axes, and some invalid ones.
fn normals() -> impl Strategy<Value = Vector2<f64>> {
    prop_oneof![
        (0..4).prop_map(|quarter| at_angle(f64::from(quarter) * PI / 2.0)),
        (0..4).prop_map(|k| [Vector2::x(), Vector2::y(), -Vector2::x(), -Vector2::y()][k as usize]),
        (0.0..TAU).prop_map(at_angle),
        (coordinates(), coordinates()).prop_map(|(u, v)| Vector2::new(u, v)),
    ]
}

fn lines() -> impl Strategy<Value = SearchLine> {
    let polarity =
        prop_oneof![Just(Polarity::Bright), Just(Polarity::Dark), Just(Polarity::Unknown)];
    let half_length =
        prop_oneof![Just(f64::MIN_POSITIVE), 0.01..40.0, Just(MAX_HALF_LENGTH_PX as f64)];
    (coordinates(), coordinates(), normals(), half_length, polarity).prop_map(
        |(u, v, normal, half_length_px, polarity)| SearchLine {
            sample: PlacedSample { position: Point2::new(u, v), normal },
            half_length_px,
            polarity,
        },
    )
}

/// Lines of equal length and polarity, as in a contour, more than are processed in parallel, and
/// arbitrary lines among them.
fn batches() -> impl Strategy<Value = Vec<SearchLine>> {
    let near = || prop_oneof![2.0..38.0, (0..40).prop_map(f64::from)];
    let uniform = (lines(), prop::collection::vec((near(), near(), normals()), 1..40));
    let uniform = uniform.prop_map(|(line, samples)| {
        let samples = samples.into_iter().map(|(u, v, normal)| {
            let sample = PlacedSample { position: Point2::new(u, v), normal };
            SearchLine { sample, half_length_px: line.half_length_px.min(12.0), ..line }
        });
        samples.collect::<Vec<_>>()
    });
    let some = prop_oneof![uniform, prop::collection::vec(lines(), 1..5)];
    prop::collection::vec(some, 1..4).prop_map(|some| some.concat())
}

/// The picture's bytes, each repeated `channels` times and perturbed except the first, in rows
/// separated by `padding` random bytes.
fn padded(picture: &Picture, channels: usize, padding: usize, seed: u64) -> Vec<u8> {
    let mut noise = Noise::new(seed);
    let mut bytes = Vec::new();
    for row in picture.bytes.chunks_exact(picture.width) {
        for &byte in row {
            bytes.push(byte);
            bytes.extend((1..channels).map(|_| byte.wrapping_add(noise.between(0.0, 80.0) as u8)));
        }
        bytes.extend((0..padding).map(|_| noise.between(0.0, 256.0) as u8));
    }
    bytes.truncate(bytes.len() - padding);
    bytes
}

fn any_options() -> impl Strategy<Value = SearchOptions> {
    let scale = prop_oneof![Just(0.5), 0.5..8.0, Just(8.0)];
    (scale, 0.0..8.0, 0.1..64.0, prop_oneof![0.5..40.0, Just(255.0)]).prop_map(
        |(scale_px, blur_px, noise_grey, min_contrast_grey)| SearchOptions {
            scale_px,
            blur_px,
            noise_grey,
            min_contrast_grey,
        },
    )
}

fn check(edge: &Edge, line: &SearchLine, options: &SearchOptions, by_log_ratio: bool) {
    assert!(edge.offset_px.abs() <= line.half_length_px.ceil() + 0.5, "{edge:?} {line:?}");
    assert!(edge.variance_px2 > 0.0 && edge.variance_px2.is_finite(), "{edge:?}");
    if by_log_ratio {
        return;
    }
    // Rounding of the response at the threshold.
    assert!(edge.contrast_grey.abs() >= options.min_contrast_grey * (1.0 - 1e-6), "{edge:?}");
    match line.polarity {
        Polarity::Bright => assert!(edge.contrast_grey > 0.0),
        Polarity::Dark => assert!(edge.contrast_grey < 0.0),
        Polarity::Unknown => {}
    }
}

/// Offset and contrast of the edge near an offset \[px\], in floating point.
fn in_floating_point(
    image: GrayView<'_>,
    line: &SearchLine,
    scale: Scale,
    near_px: f64,
) -> [f64; 2] {
    let options = options();
    let scale_px = options.scale_px * if scale == Scale::Coarse { 2.5 } else { 1.0 };
    let PlacedSample { position, normal } = line.sample;
    let grey = |k: i32| {
        let at = position + normal * f64::from(k);
        image.sample_f64(at.x, at.y).unwrap()
    };
    let reach = (3.0 * scale_px).ceil() as i32;
    let weight = |k: i32| f64::from(k) * (-0.5 * (f64::from(k) / scale_px).powi(2)).exp();
    let sum: f64 = (1..=reach).map(weight).sum();
    let response = |k: i32| -> f64 {
        (1..=reach).map(|i| weight(i) / sum * (grey(k - i) - grey(k + i))).sum()
    };
    let middle = near_px.round() as i32;
    // A peak halfway between two pixels may be rounded to the other one.
    let at =
        (middle - 1..=middle + 1).max_by(|a, b| response(*a).total_cmp(&response(*b))).unwrap();
    let [before, here, after] = [at - 1, at, at + 1].map(response);
    let offset_px = f64::from(at) + 0.5 * (before - after) / (before - 2.0 * here + after);
    [offset_px, here * scale_px.hypot(options.blur_px) / scale_px]
}

proptest! {
    #![proptest_config(config())]

    #[test]
    fn any_line_through_any_picture_has_a_valid_result(
        picture in pictures(),
        lines in prop::collection::vec(lines(), 1..20),
        options in any_options(),
        coarse in any::<bool>(),
    ) {
        let appearance = learned(&picture.view().into(), |x, y| (x + y) % 2 == 0);
        let scale = if coarse { Scale::Coarse } else { Scale::Fine };
        for cue in [Cue::Edges, Cue::HandEdges(&appearance), Cue::LogRatio(&appearance)] {
            let found = search_all(options, picture.view(), cue, scale, &lines);
            for (line, found) in lines.iter().zip(&found) {
                if let Ok(edge) = found {
                    check(edge, line, &options, matches!(cue, Cue::LogRatio(_)));
                }
            }
        }
    }

    #[test]
    fn a_flat_picture_has_no_edges(
        (width, height) in (1..40_usize, 1..40_usize),
        value in any::<u8>(),
        lines in prop::collection::vec(lines(), 1..20),
        options in any_options(),
    ) {
        // Nor where a line leaves the image, for nothing is read beyond the border.
        let picture = Picture { width, height, bytes: vec![value; width * height] };
        for found in search_all(options, picture.view(), Cue::Edges, Scale::Fine, &lines) {
            prop_assert!(found.is_err(), "{:?}", found);
        }
    }

    #[test]
    fn every_instruction_set_gives_the_same_bits(
        picture in pictures(),
        padding in 0..7_usize,
        seed in any::<u64>(),
        lines in batches(),
        options in any_options(),
        coarse in any::<bool>(),
    ) {
        let scale = if coarse { Scale::Coarse } else { Scale::Fine };
        let (gray, colours) = (padded(&picture, 1, padding, seed), padded(&picture, 3, padding, seed));
        let (Picture { width, height, .. }, stride) = (picture, padding);
        let image = GrayView::new(&gray, width, height, width + stride).unwrap();
        let colours = ColourView::new(&colours, width, height, 3 * width + stride).unwrap();
        for frame in [Frame::gray(image), Frame::coloured(image, colours).unwrap()] {
            let appearance = learned(&frame, |x, y| (x + y) % 2 == 0);
            for cue in [Cue::Edges, Cue::HandEdges(&appearance), Cue::LogRatio(&appearance)] {
                let found = |isa| {
                    let mut found = Vec::new();
                    let mut search = EdgeSearch::new(options).unwrap().with_isa(isa);
                    search.search(&frame, cue, scale, &lines, &mut found).unwrap();
                    found
                };
                let reference = found(Isa::Scalar);
                for isa in Isa::available() {
                    prop_assert_eq!(&found(isa), &reference, "{}", isa);
                }
            }
        }
    }

    #[test]
    fn fixed_point_matches_floating_point(
        (angle_rad, offset_px, contrast) in (0.0..TAU, -6.0..6.0, 20.0..180.0),
        seed in any::<u64>(),
    ) {
        /// Quantisation of coordinates to 1/256 and 1/128 px. That of levels, to 1/128 grey level, has
        /// an effect in proportion to the offset's standard deviation.
        const OFFSET_TOLERANCE_PX: f64 = 0.004;
        const OFFSET_TOLERANCE_SIGMA: f64 = 0.2;
        const CONTRAST_TOLERANCE_GREY: f64 = 0.5;
        let edge = HalfPlane::beyond(CENTRE, angle_rad, offset_px);
        let canvas = Canvas::new(64, 64, 40.0).paint(&edge, 40.0 + contrast).blur(BLUR_PX);
        let picture = canvas.take(2.0, &mut Noise::new(seed));
        for scale in [Scale::Fine, Scale::Coarse] {
            let line = line(CENTRE, at_angle(angle_rad));
            let found = search_all(options(), picture.view(), Cue::Edges, scale, &[line])[0];
            if let Ok(edge) = found {
                let exact = in_floating_point(picture.view(), &line, scale, edge.offset_px);
                let [offset_px, contrast_grey] = exact;
                let tolerance_px =
                    OFFSET_TOLERANCE_PX + OFFSET_TOLERANCE_SIGMA * edge.variance_px2.sqrt();
                prop_assert!(
                    (edge.offset_px - offset_px).abs() < tolerance_px,
                    "{edge:?} {exact:?}"
                );
                prop_assert!(
                    (edge.contrast_grey - contrast_grey).abs() < CONTRAST_TOLERANCE_GREY,
                    "{edge:?} {exact:?}"
                );
            }
        }
    }
}
