//! B-splines: golden data (`../golden/generate_bspline.py`), defining properties, degenerate input.

use fingerpost_core::Error;
use fingerpost_core::geometry::bspline::{BSpline, Degree, Parametrization};
use fingerpost_core::nalgebra::{Matrix2, Point2, Vector2};
use proptest::prelude::*;
use proptest::test_runner::{Config, RngSeed};
use serde_json::Value;

/// Tolerance of the golden data, absolute and relative, for the golden curves are of size 1.
const ORACLE_TOLERANCE: f64 = 1e-10;

/// Rounding of a handful of operations on numbers of size 1.
const ROUNDING: f64 = 1e-13;

fn config() -> Config {
    Config { rng_seed: RngSeed::Fixed(0x6273_706c), failure_persistence: None, ..Config::default() }
}

mod golden {
    use super::*;

    fn cases(kind: &str) -> Vec<Value> {
        let text = include_str!("../golden/bspline.json");
        let golden: Value = serde_json::from_str(text).unwrap();
        golden[kind].as_array().unwrap().clone()
    }

    fn numbers(value: &Value) -> Vec<f64> {
        value.as_array().unwrap().iter().map(|x| x.as_f64().unwrap()).collect()
    }

    fn rows(value: &Value) -> Vec<Vec<f64>> {
        value.as_array().unwrap().iter().map(numbers).collect()
    }

    fn points(value: &Value) -> Vec<Point2<f64>> {
        rows(value).iter().map(|xy| Point2::new(xy[0], xy[1])).collect()
    }

    fn spline(case: &Value) -> BSpline {
        let degree = usize::try_from(case["degree"].as_u64().unwrap()).unwrap();
        let degree = Degree::try_from(degree).unwrap();
        let make = if case["closed"].as_bool().unwrap() { BSpline::closed } else { BSpline::open };
        make(degree, &numbers(&case["knots"])).unwrap()
    }

    #[track_caller]
    fn assert_close(actual: &[f64], expected: &[f64], what: &str, case: &Value) {
        assert_eq!(actual.len(), expected.len(), "{what} of {}", case["name"]);
        for (i, (a, e)) in actual.iter().zip(expected).enumerate() {
            let difference = (a - e).abs();
            assert!(
                difference <= ORACLE_TOLERANCE,
                "{what} of {}: {a} at {i} is {difference:e} from {e}",
                case["name"]
            );
        }
    }

    #[test]
    fn basis_functions() {
        for case in &cases("curves") {
            let spline = spline(case);
            for (t, expected) in numbers(&case["parameters"]).into_iter().zip(rows(&case["basis"]))
            {
                let row = spline.basis(t).unwrap();
                let mut all = vec![0.0; spline.control_point_count()];
                for (i, value) in row.indices().zip(row.values()) {
                    all[i] = *value;
                }
                assert_close(&all, &expected, &format!("basis at {t}"), case);
            }
        }
    }

    #[test]
    fn positions_and_derivatives() {
        for case in &cases("curves") {
            let (spline, control_points) = (spline(case), points(&case["control_points"]));
            for (k, t) in numbers(&case["parameters"]).into_iter().enumerate() {
                let point = spline.evaluate(&control_points, t).unwrap();
                for (what, actual) in [
                    ("positions", point.position.coords),
                    ("first_derivatives", point.first_derivative),
                    ("second_derivatives", point.second_derivative),
                ] {
                    let expected = &rows(&case[what])[k];
                    assert_close(actual.as_slice(), expected, &format!("{what} at {t}"), case);
                }
            }
        }
    }

    #[test]
    fn arc_lengths() {
        for case in &cases("curves") {
            let arc_length = spline(case).arc_length(&points(&case["control_points"])).unwrap();
            let length = case["length"].as_f64().unwrap();
            assert_close(&[arc_length.total()], &[length], "length", case);

            let expected = numbers(&case["equal_arc"]);
            let actual = arc_length.equally_spaced(expected.len()).unwrap();
            assert_close(&actual, &expected, "equal arc", case);
        }
    }

    #[test]
    fn fits() {
        for case in &cases("fits") {
            let parameters = numbers(&case["parameters"]);
            let outline = points(&case["outline"]);
            let fit = spline(case).fit(&outline, Parametrization::Given(&parameters)).unwrap();
            let flat = |points: &[Point2<f64>]| -> Vec<f64> {
                points.iter().flat_map(|point| [point.x, point.y]).collect()
            };
            let expected = points(&case["control_points"]);
            assert_close(&flat(&fit.control_points), &flat(&expected), "fit", case);
        }
    }
}

/// B-splines of both degrees, open and closed, half of them with repeated knots.
/// `spans` are the distances between distinct knots.
fn splines(spans: impl Strategy<Value = f64>) -> impl Strategy<Value = BSpline> {
    let degree = prop_oneof![Just(Degree::Quadratic), Just(Degree::Cubic)];
    let knots = prop::collection::vec((spans, prop_oneof![Just(1_usize), 1..4_usize]), 5..9);
    (degree, any::<bool>(), -3.0..3.0, knots).prop_map(|(degree, closed, start, knots)| {
        let mut breaks = vec![start];
        let mut t = start;
        let inner = knots.len() - 1;
        for (i, (span, repeats)) in knots.into_iter().enumerate() {
            t += span;
            let repeats = if i == inner && !closed { 1 } else { repeats.min(degree as usize) };
            breaks.resize(breaks.len() + repeats, t);
        }
        let make = if closed { BSpline::closed } else { BSpline::open_clamped };
        make(degree, &breaks).unwrap()
    })
}

fn usual_splines() -> impl Strategy<Value = BSpline> {
    splines(0.1..2.0)
}

fn with_control_points(
    splines: impl Strategy<Value = BSpline>,
) -> impl Strategy<Value = (BSpline, Vec<Point2<f64>>)> {
    splines.prop_flat_map(|spline| {
        let coordinate = || prop_oneof![Just(0.0), -1.0..1.0_f64];
        let point = (coordinate(), coordinate()).prop_map(|(x, y)| Point2::new(x, y));
        let control_points = prop::collection::vec(point, spline.control_point_count());
        (Just(spline), control_points)
    })
}

fn curves() -> impl Strategy<Value = (BSpline, Vec<Point2<f64>>)> {
    with_control_points(usual_splines())
}

/// The parameter at a fraction of the domain.
fn at_fraction(spline: &BSpline, fraction: f64) -> f64 {
    let (start, end) = spline.domain();
    (start + (end - start) * fraction).min(end)
}

fn different_knots(spline: &BSpline) -> Vec<f64> {
    let (start, end) = spline.domain();
    let mut knots: Vec<f64> = spline.knots().to_vec();
    knots.retain(|knot| (start..=end).contains(knot));
    knots.dedup();
    knots
}

proptest! {
    #![proptest_config(config())]

    #[test]
    fn the_basis_is_a_partition_of_unity(
        // Spans of very different size.
        spline in prop_oneof![
            splines(prop_oneof![Just(1e-8), 0.1..2.0]),
            splines(prop_oneof![Just(1e-2), Just(1e6)]),
        ],
        fraction in prop_oneof![Just(0.0), Just(1.0), 0.0..=1.0],
    ) {
        let row = spline.basis(at_fraction(&spline, fraction)).unwrap();
        prop_assert!(row.values().iter().all(|&value| value >= 0.0));
        prop_assert!((row.values().iter().sum::<f64>() - 1.0).abs() < ROUNDING);
        for derivatives in [row.first_derivatives(), row.second_derivatives()] {
            let size: f64 = derivatives.iter().map(|value| value.abs()).sum();
            prop_assert!(derivatives.iter().sum::<f64>().abs() <= ROUNDING * size);
        }
    }

    #[test]
    fn the_indices_of_a_row_are_consecutive_control_points(
        spline in usual_splines(),
        fraction in 0.0..=1.0,
    ) {
        let row = spline.basis(at_fraction(&spline, fraction)).unwrap();
        let n = spline.control_point_count();
        let indices: Vec<usize> = row.indices().collect();
        prop_assert_eq!(indices.len(), spline.degree().order());
        prop_assert_eq!(indices[0], row.first());
        for pair in indices.windows(2) {
            prop_assert!(pair[1] == pair[0] + 1 || (spline.is_closed() && pair == [n - 1, 0]));
        }
        prop_assert!(indices.iter().all(|&i| i < n));
    }

    #[test]
    fn derivatives_match_central_differences((spline, control_points) in curves()) {
        // Inside a span the curve is a polynomial of degree 3 at most. Two central differences
        // extrapolated to step 0 equal its first derivative, one equals its second, up to rounding.
        for pair in different_knots(&spline).windows(2) {
            let (t, step) = (0.5 * (pair[0] + pair[1]), 0.2 * (pair[1] - pair[0]));
            let position = |t| spline.evaluate(&control_points, t).unwrap().position.coords;
            let slope = |h: f64| (position(t + h) - position(t - h)) / (2.0 * h);
            let first = (slope(step) * 4.0 - slope(2.0 * step)) / 3.0;
            let second = (position(t + step) - position(t) * 2.0 + position(t - step)) / step.powi(2);
            let here = spline.evaluate(&control_points, t).unwrap();
            prop_assert!((here.first_derivative - first).norm() < 1e-11);
            prop_assert!((here.second_derivative - second).norm() < 1e-10);
        }
    }

    #[test]
    fn an_affine_map_commutes_with_the_curve(
        (spline, control_points) in curves(),
        (a, b, c, d) in (-3.0..3.0, -3.0..3.0, -3.0..3.0, -3.0..3.0),
        (u, v) in (-100.0..100.0, -100.0..100.0),
        fraction in 0.0..=1.0,
    ) {
        let (matrix, shift) = (Matrix2::new(a, b, c, d), Vector2::new(u, v));
        let mapped: Vec<_> = control_points.iter().map(|point| matrix * point + shift).collect();
        let t = at_fraction(&spline, fraction);
        let before = spline.evaluate(&control_points, t).unwrap();
        let after = spline.evaluate(&mapped, t).unwrap();
        prop_assert!((after.position - (matrix * before.position + shift)).norm() < 1e-12);
        let difference = after.first_derivative - matrix * before.first_derivative;
        prop_assert!(difference.norm() < 1e-9);
        let difference = after.second_derivative - matrix * before.second_derivative;
        prop_assert!(difference.norm() < 1e-7);
    }

    #[test]
    fn each_repeat_of_a_knot_removes_one_derivative((spline, control_points) in curves()) {
        let (start, end) = spline.domain();
        let period = end - start;
        let is_at = |knot: f64, other: f64| {
            let apart = (knot - other).abs();
            apart < 1e-9 || (spline.is_closed() && (apart - period).abs() < 1e-9)
        };
        for &knot in different_knots(&spline).iter().rev() {
            let at_end = knot >= end;
            if knot <= start || (at_end && !spline.is_closed()) {
                continue; // the start of a closed curve is tested at its end
            }
            let repeats = spline.knots().iter().filter(|&&other| is_at(knot, other)).count()
                - usize::from(at_end); // the seam is in the list at both ends
            let smooth = spline.degree() as usize - repeats;
            let left = spline.evaluate(&control_points, knot.next_down()).unwrap();
            let right = spline.evaluate(&control_points, knot).unwrap();
            // At the knot itself, derivatives are those from the right.
            let beyond = spline.evaluate(&control_points, knot.next_up()).unwrap();
            prop_assert!((beyond.first_derivative - right.first_derivative).norm() < 1e-9);
            prop_assert!((beyond.second_derivative - right.second_derivative).norm() < 1e-8);
            prop_assert!((left.position - right.position).norm() < 1e-9);
            if smooth >= 1 {
                prop_assert!((left.first_derivative - right.first_derivative).norm() < 1e-9);
            }
            if smooth >= 2 {
                prop_assert!((left.second_derivative - right.second_derivative).norm() < 1e-8);
            }
        }
    }

    #[test]
    fn a_closed_curve_is_periodic(
        (spline, control_points) in curves().prop_filter("closed", |(s, _)| s.is_closed()),
        fraction in prop_oneof![Just(0.0), 0.0..1.0],
        periods in -5..5_i32,
    ) {
        let t = at_fraction(&spline, fraction);
        let (start, end) = spline.domain();
        let here = spline.evaluate(&control_points, t).unwrap();
        let again = t + f64::from(periods) * (end - start);
        let again = spline.evaluate(&control_points, again).unwrap();
        prop_assert!((here.position - again.position).norm() < 1e-11);
    }

    #[test]
    fn a_seam_repeated_at_the_start_is_one_repeated_at_the_end(
        (start, end) in (-3.0..3.0, 4.0..9.0),
        fraction in 0.0..1.0,
    ) {
        let at_start = [start, start, 3.1, 3.2, 3.6, end];
        let at_end = [start, 3.1, 3.2, 3.6, end, end];
        let [at_start, at_end] =
            [at_start, at_end].map(|knots| BSpline::closed(Degree::Quadratic, &knots).unwrap());
        let t = at_fraction(&at_start, fraction);
        let one_later: Vec<_> =
            at_start.basis(t).unwrap().indices().map(|i| (i + 4) % 5).collect();
        prop_assert_eq!(at_end.basis(t).unwrap().indices().collect::<Vec<_>>(), one_later);
        let values = |spline: &BSpline| spline.basis(t).unwrap().values().to_vec();
        for (a, b) in values(&at_start).iter().zip(values(&at_end)) {
            prop_assert!((a - b).abs() < ROUNDING);
        }
    }

    #[test]
    fn a_clamped_curve_starts_and_ends_at_a_control_point(
        (spline, control_points) in curves().prop_filter("open", |(s, _)| !s.is_closed()),
    ) {
        let (start, end) = spline.domain();
        let at = |t| spline.evaluate(&control_points, t).unwrap().position;
        prop_assert_eq!(at(start), control_points[0]);
        prop_assert_eq!(at(end), control_points[control_points.len() - 1]);
    }

    #[test]
    fn a_fit_recovers_a_spline((spline, control_points) in curves()) {
        let parameters: Vec<f64> = different_knots(&spline)
            .windows(2)
            .flat_map(|pair| [0.03, 0.25, 0.5, 0.75, 0.97].map(|x| pair[0] + x * (pair[1] - pair[0])))
            .collect();
        let outline = sample(&spline, &control_points, &parameters);
        let fit = spline.fit(&outline, Parametrization::Given(&parameters)).unwrap();
        let tolerance = ROUNDING * fit.condition;
        for (found, truth) in fit.control_points.iter().zip(&control_points) {
            prop_assert!((found - truth).norm() <= tolerance, "condition {}", fit.condition);
        }
        prop_assert!(fit.condition < 1e4);
        prop_assert!(fit.max_residual < ROUNDING);
        prop_assert_eq!(fit.parameters, parameters);
    }

    #[test]
    fn a_fit_commutes_with_similarities_and_reports_its_own_residuals(
        spline in usual_splines(),
        jitter in prop::collection::vec(-0.05..0.05_f64, 60),
        (turn, scale) in (0.0..6.0_f64, 0.1..100.0_f64),
        (u, v) in (-100.0..100.0, -100.0..100.0),
    ) {
        let outline: Vec<_> = (0..30)
            .map(|i| {
                let angle = f64::from(i).to_radians() * 12.0;
                Point2::new(angle.cos() + jitter[2 * i as usize], angle.sin() + jitter[2 * i as usize + 1])
            })
            .collect();
        let similarity = Matrix2::new(turn.cos(), -turn.sin(), turn.sin(), turn.cos()) * scale;
        let map = |point: &Point2<f64>| similarity * point + Vector2::new(u, v);
        let mapped: Vec<_> = outline.iter().map(map).collect();
        for parametrization in [Parametrization::ChordLength, Parametrization::Centripetal] {
            // 30 points do not determine all of these splines, and some only badly.
            let fit = match spline.fit(&outline, parametrization) {
                Err(Error::UndeterminedControlPoints { .. }) => continue,
                fit => fit.unwrap(),
            };
            if fit.condition > 1e3 {
                continue;
            }
            let fit_of_mapped = spline.fit(&mapped, parametrization).unwrap();
            // Rounding also moves the parameters; its effect grows with the square of the
            // condition.
            let tolerance = 1e-12 * fit.condition.powi(2) * (scale + u.abs() + v.abs());
            for (a, b) in fit.control_points.iter().zip(&fit_of_mapped.control_points) {
                prop_assert!((map(a) - b).norm() < tolerance);
            }
            let found = sample(&spline, &fit.control_points, &fit.parameters);
            let distances: Vec<f64> =
                found.iter().zip(&outline).map(|(a, b)| (a - b).norm()).collect();
            let rms = (distances.iter().map(|d| d * d).sum::<f64>() / 30.0).sqrt();
            prop_assert!((rms - fit.rms_residual).abs() < 1e-12 * fit.condition);
            let max = distances.iter().copied().fold(0.0, f64::max);
            prop_assert!((max - fit.max_residual).abs() < 1e-12 * fit.condition);
        }
    }

    #[test]
    fn equal_arc_lengths_are_equal((spline, control_points) in curves(), count in 2..12_usize) {
        let arc_length = match spline.arc_length(&control_points) {
            Ok(arc_length) => arc_length,
            Err(error) => {
                // Control points are often zero, sometimes all of them.
                prop_assert!(control_points.iter().all(|point| *point == control_points[0]));
                prop_assert_eq!(error, Error::UnusableLength { what: "control polygon", length: 0.0 });
                return Ok(());
            }
        };
        let mut parameters = arc_length.equally_spaced(count).unwrap();
        prop_assert_eq!(parameters.len(), count);
        let (start, end) = spline.domain();
        if spline.is_closed() {
            parameters.push(end);
        }
        prop_assert_eq!((parameters[0], parameters[parameters.len() - 1]), (start, end));
        let step = arc_length.total() / (parameters.len() - 1) as f64;
        for pair in parameters.windows(2) {
            let measured = polygon_length(&spline, &control_points, pair[0], pair[1]);
            prop_assert!((measured - step).abs() < 5e-4 * arc_length.total());
        }
    }

    #[test]
    fn any_knots_make_a_finite_basis_or_a_typed_error(
        mut knots in prop::collection::vec(
            prop_oneof![
                4 => (0..4_i32).prop_map(f64::from),
                1 => any::<f64>(),
                1 => prop::sample::select(vec![1e-300, 1e-90, 1.0 + 1e-9, 1.0 + 1e-11, 1e99, 1e300]),
            ],
            0..14,
        ),
        sorted in prop::bool::weighted(0.9),
        closed in any::<bool>(),
        cubic in any::<bool>(),
        fraction in 0.0..=1.0,
    ) {
        if sorted {
            knots.sort_by(f64::total_cmp);
        }
        let degree = if cubic { Degree::Cubic } else { Degree::Quadratic };
        let make = if closed { BSpline::closed } else { BSpline::open };
        if let Ok(spline) = make(degree, &knots) {
            prop_assert_eq!(spline.knots(), &knots[..]);
            let row = spline.basis(at_fraction(&spline, fraction)).unwrap();
            prop_assert!((row.values().iter().sum::<f64>() - 1.0).abs() < ROUNDING);
            let derivatives = row.first_derivatives().iter().chain(row.second_derivatives());
            prop_assert!(derivatives.copied().all(f64::is_finite));
        }
    }
}

fn sample(spline: &BSpline, control_points: &[Point2<f64>], at: &[f64]) -> Vec<Point2<f64>> {
    at.iter().map(|&t| spline.evaluate(control_points, t).unwrap().position).collect()
}

/// Length of a polygon with many corners on the curve, including its knots: an independent
/// measure of arc length, accurate to 5 · 10⁻⁴.
fn polygon_length(spline: &BSpline, control_points: &[Point2<f64>], from: f64, to: f64) -> f64 {
    const SIDES: u32 = 100; // per knot span
    let mut breaks = different_knots(spline);
    breaks.retain(|knot| (from..to).contains(knot));
    breaks.insert(0, from);
    breaks.push(to);
    let corners: Vec<f64> = breaks
        .windows(2)
        .flat_map(|pair| {
            (0..=SIDES).map(move |k| (pair[0], pair[1], f64::from(k) / f64::from(SIDES)))
        })
        .map(|(start, end, x)| (start + (end - start) * x).min(end))
        .collect();
    let corners = sample(spline, control_points, &corners);
    corners.windows(2).map(|pair| (pair[1] - pair[0]).norm()).sum()
}

fn on_a_line<const N: usize>(u: [f64; N]) -> [Point2<f64>; N] {
    u.map(|u| Point2::new(u, 0.0))
}

#[test]
fn a_knot_repeated_degree_times_is_a_corner() {
    for (degree, breaks) in [
        (Degree::Quadratic, &[0.0, 1.0, 2.0, 2.0, 3.0][..]),
        (Degree::Cubic, &[0.0, 1.0, 2.0, 2.0, 2.0, 3.0]),
    ] {
        let spline = BSpline::open_clamped(degree, breaks).unwrap();
        // Only one basis function is non-zero at the knot; there the polygon turns left.
        let corner = spline.basis(2.0).unwrap().first();
        let polygon: Vec<_> = (0..spline.control_point_count())
            .map(|i| Point2::new(i.min(corner) as f64, i.saturating_sub(corner) as f64))
            .collect();
        let before = spline.evaluate(&polygon, 2.0_f64.next_down()).unwrap();
        let after = spline.evaluate(&polygon, 2.0).unwrap();
        assert_eq!(after.position, polygon[corner]);
        assert!((before.position - after.position).norm() < ROUNDING);
        assert!((before.first_derivative.normalize() - Vector2::x()).norm() < ROUNDING);
        assert!((after.first_derivative.normalize() - Vector2::y()).norm() < ROUNDING);
    }
}

#[test]
fn computed_parameters_follow_the_chords() {
    // Chords 0, 9 and 16, and 25 back to the start; square roots 0, 3, 4 and 5.
    let outline = [(0.0, 0.0), (0.0, 0.0), (9.0, 0.0), (9.0, -16.0)];
    let back = (9.0_f64.powi(2) + 16.0_f64.powi(2)).sqrt();
    let outline = outline.map(|(u, v)| Point2::new(u, v));
    let open = BSpline::open_uniform(Degree::Quadratic, 3).unwrap();
    let closed = BSpline::closed_uniform(Degree::Quadratic, 3).unwrap();
    for (spline, parametrization, stations, total) in [
        (&open, Parametrization::ChordLength, [0.0, 0.0, 9.0, 25.0], 25.0),
        (&open, Parametrization::Centripetal, [0.0, 0.0, 3.0, 7.0], 7.0),
        (&closed, Parametrization::ChordLength, [0.0, 0.0, 9.0, 25.0], 25.0 + back),
        (&closed, Parametrization::Centripetal, [0.0, 0.0, 3.0, 7.0], 7.0 + back.sqrt()),
    ] {
        let (_, end) = spline.domain();
        let fit = spline.fit(&outline, parametrization).unwrap();
        for (parameter, station) in fit.parameters.iter().zip(stations) {
            assert!((parameter - end * station / total).abs() < ROUNDING);
        }
    }
}

#[test]
fn the_first_point_of_a_closed_outline_may_be_repeated_at_its_end() {
    let mut outline: Vec<_> = (0..20)
        .map(|i| f64::from(i).to_radians() * 18.0)
        .map(|angle| Point2::new(3.0 * angle.cos(), 2.0 * angle.sin()))
        .collect();
    let spline = BSpline::closed_uniform(Degree::Cubic, 6).unwrap();
    let once = spline.fit(&outline, Parametrization::ChordLength).unwrap();
    outline.push(outline[0]);
    let twice = spline.fit(&outline, Parametrization::ChordLength).unwrap();
    assert_eq!(twice.parameters[..20], once.parameters);
    // The point now has double weight and moves the curve slightly.
    assert!((twice.max_residual / once.max_residual - 1.0).abs() < 0.1);
}

#[test]
fn an_outline_that_does_not_determine_all_control_points_is_refused() {
    let circle: Vec<_> = (0..40)
        .map(|i| f64::from(i).to_radians() * 9.0)
        .map(|angle| Point2::new(angle.cos(), angle.sin()))
        .collect();
    let refused = |spline: BSpline, parameters: &[f64]| {
        let error = spline.fit(&circle, Parametrization::Given(parameters)).unwrap_err();
        let Error::UndeterminedControlPoints { rank, control_points } = error else {
            unreachable!("{error}")
        };
        assert_eq!(control_points, spline.control_point_count());
        rank
    };
    // All in [0, 4) of [0, 8): the functions that start at 4 or later have no data.
    let half: Vec<f64> = (0..40).map(|i| f64::from(i) * 0.1).collect();
    assert_eq!(refused(BSpline::open_uniform(Degree::Cubic, 11).unwrap(), &half), 7);
    assert_eq!(refused(BSpline::closed_uniform(Degree::Cubic, 8).unwrap(), &half), 7);
    // Every function has data, but three places do not determine six coefficients.
    let places: Vec<f64> = (0..40).map(|i| f64::from(i % 3) * 1.2 + 0.3).collect();
    assert_eq!(refused(BSpline::open_uniform(Degree::Cubic, 6).unwrap(), &places), 3);
    assert_eq!(refused(BSpline::open_uniform(Degree::Quadratic, 3).unwrap(), &[0.5; 40]), 1);
}

#[test]
fn the_arc_length_of_a_cusp_is_exact() {
    // Speed is 3 |w| √(1 + w²) with w = 1 − 2t, so that the length to
    // t ≤ ½ is (2√2 − (1 + w²)^{3/2}) / 2, and the cusp lies in the middle.
    let spline = BSpline::open_uniform(Degree::Cubic, 4).unwrap();
    let cusp = [(0.0, 0.0), (1.0, 1.0), (0.0, 1.0), (1.0, 0.0)].map(|(u, v)| Point2::new(u, v));
    let length_to = |t: f64| 0.5 * (8.0_f64.sqrt() - (1.0 + (1.0 - 2.0 * t).powi(2)).powf(1.5));
    let arc_length = spline.arc_length(&cusp).unwrap();
    assert!((arc_length.total() - 2.0 * length_to(0.5)).abs() < 1e-10);
    for s in [0.0, 0.01, 0.5, 0.9, 0.914] {
        assert!((length_to(arc_length.parameter_at(s).unwrap()) - s).abs() < 1e-10);
        let mirrored = arc_length.parameter_at(arc_length.total() - s).unwrap();
        assert!((length_to(1.0 - mirrored) - s).abs() < 1e-10);
    }
    assert!((arc_length.equally_spaced(3).unwrap()[1] - 0.5).abs() < 1e-5);
}

#[test]
fn the_arc_length_of_a_reversing_or_stopping_curve() {
    // u = 2t(1 − t): half a unit forward and back.
    let spline = BSpline::open_uniform(Degree::Quadratic, 3).unwrap();
    let arc_length = spline.arc_length(&on_a_line([0.0, 1.0, 0.0])).unwrap();
    assert!((arc_length.total() - 1.0).abs() < 1e-10);
    let t = arc_length.parameter_at(0.375).unwrap();
    assert!((2.0 * t * (1.0 - t) - 0.375).abs() < 1e-10 && t < 0.5);

    // Three equal control points stop a quadratic curve for the whole span [1, 2].
    let spline = BSpline::open_uniform(Degree::Quadratic, 5).unwrap();
    let halting = on_a_line([0.0, 1.0, 1.0, 1.0, 2.0]);
    let arc_length = spline.arc_length(&halting).unwrap();
    assert!((arc_length.total() - 2.0).abs() < 1e-10);
    let place =
        |s| spline.evaluate(&halting, arc_length.parameter_at(s).unwrap()).unwrap().position.x;
    for s in [0.0, 0.3, 1.0, 1.7, 2.0] {
        assert!((place(s) - s).abs() < 1e-10, "{s}");
    }
}

#[test]
fn the_arc_length_of_a_closed_curve_is_periodic() {
    let spline = BSpline::closed_uniform(Degree::Cubic, 4).unwrap();
    let square = [(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)].map(|(u, v)| Point2::new(u, v));
    let arc_length = spline.arc_length(&square).unwrap();
    // Four equal sides, one knot span each.
    let parameters = arc_length.equally_spaced(8).unwrap();
    for (k, parameter) in parameters.into_iter().enumerate() {
        assert!((parameter - 0.5 * k as f64).abs() < 1e-9);
    }
    for turns in [-3.0, 1.0] {
        let s = (0.375 + turns) * arc_length.total();
        assert!((arc_length.parameter_at(s).unwrap() - 1.5).abs() < 1e-9);
    }
}

#[test]
fn arc_length_is_invariant_to_position_and_scale() {
    let spline = BSpline::open_clamped(Degree::Cubic, &[0.0, 1e-7, 1.0, 1.0, 5.0]).unwrap();
    // Multiples of 2⁻⁴, so that the shifts and scales below are exact.
    let curve: Vec<_> = [(0, 0), (5, 9), (-3, 2), (8, 8), (1, -6), (0, 7), (2, 2)]
        .map(|(u, v)| Point2::new(f64::from(u) / 16.0, f64::from(v) / 16.0))
        .into();
    let arc_length = spline.arc_length(&curve).unwrap();
    let parameters = arc_length.equally_spaced(7).unwrap();
    for (scale, shift) in [(1.0, 1e9), (2.0_f64.powi(900), 0.0), (2.0_f64.powi(-900), 0.0)] {
        let moved: Vec<_> = curve.iter().map(|point| (point * scale).map(|x| x + shift)).collect();
        let moved = spline.arc_length(&moved).unwrap();
        assert!((moved.total() / scale - arc_length.total()).abs() < 1e-10);
        for (a, b) in moved.equally_spaced(7).unwrap().iter().zip(&parameters) {
            assert!((a - b).abs() < 1e-8);
        }
    }
}

#[test]
fn invalid_knots_are_refused() {
    let quadratic = |knots: &[f64]| BSpline::open(Degree::Quadratic, knots).unwrap_err();
    let closed = |knots: &[f64]| BSpline::closed(Degree::Quadratic, knots).unwrap_err();
    let too_few = |what, given, needed| Error::TooFew { what, given, needed };
    assert_eq!(Degree::try_from(4), Err(Error::UnsupportedDegree { degree: 4 }));
    assert_eq!(quadratic(&[0.0, 0.0, 0.0, 1.0, 1.0]), too_few("knots", 5, 6));
    assert_eq!(closed(&[0.0, 1.0, 2.0]), too_few("knots", 3, 4));
    assert_eq!(BSpline::open_clamped(Degree::Cubic, &[0.0]), Err(too_few("breaks", 1, 2)));
    assert_eq!(BSpline::open_clamped(Degree::Cubic, &[]), Err(too_few("breaks", 0, 2)));
    let points = || too_few("control points", 3, 4);
    assert_eq!(BSpline::open_uniform(Degree::Cubic, 3), Err(points()));
    assert_eq!(BSpline::closed_uniform(Degree::Cubic, 3), Err(points()));
    // The number of control points is limited to bound the memory.
    let most = 1 << 20;
    assert_eq!(BSpline::open_uniform(Degree::Quadratic, most).unwrap().control_point_count(), most);
    for n in [most + 1, usize::MAX - 1, usize::MAX] {
        let too_many = Err(Error::OutOfRange {
            what: "number of control points",
            value: n as f64,
            right: "at most 1048576",
        });
        assert_eq!(BSpline::open_uniform(Degree::Cubic, n), too_many);
        assert_eq!(BSpline::closed_uniform(Degree::Quadratic, n), too_many);
    }

    assert!(matches!(
        quadratic(&[0.0, 0.0, 0.0, f64::NAN, 1.0, 1.0, 1.0]),
        Error::NotFiniteAt { what: "knot", index: 3, value } if value.is_nan()
    ));
    assert_eq!(
        closed(&[0.0, 1.0, 2.0, f64::INFINITY]),
        Error::NotFiniteAt { what: "knot", index: 3, value: f64::INFINITY }
    );
    assert_eq!(
        quadratic(&[0.0, 0.0, 0.0, 2.0, 1.0, 3.0, 3.0, 3.0]),
        Error::KnotsDecrease { index: 4, knot: 1.0, previous: 2.0 }
    );
    let often =
        |knot, multiplicity, allowed| Error::KnotMultiplicity { knot, multiplicity, allowed };
    assert_eq!(quadratic(&[0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0]), often(0.0, 4, 3));
    assert_eq!(quadratic(&[0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 2.0, 2.0, 2.0]), often(1.0, 3, 2));
    assert_eq!(quadratic(&[0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0]), often(1.0, 4, 3));
    // Twice at the start and once more as the end of the period: three times on the curve.
    assert_eq!(closed(&[0.0, 0.0, 1.0, 2.0, 2.0]), often(0.0, 3, 2));
    assert_eq!(
        BSpline::open(Degree::Cubic, &[0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 2.0, 2.0]),
        Err(Error::EmptyDomain { start: 1.0, end: 1.0 })
    );
    assert!(matches!(
        quadratic(&[0.0, 0.0, 0.0, 1.0, 1.0 + 1e-12, 2.0, 2.0, 2.0]),
        Error::KnotSpan { start: 1.0, least, .. } if (least - 2e-10).abs() < 1e-24
    ));
    assert!(matches!(
        quadratic(&[-1e300, -1e300, -1e300, 1e300, 1e300, 1e300]),
        Error::KnotSpan { greatest: 1e100, .. }
    ));
}

#[test]
fn a_parameter_outside_the_domain_is_refused() {
    let spline = BSpline::open_uniform(Degree::Quadratic, 4).unwrap();
    for parameter in [0.0_f64.next_down(), 2.0_f64.next_up()] {
        assert_eq!(
            spline.basis(parameter),
            Err(Error::OutsideDomain { parameter, start: 0.0, end: 2.0 })
        );
    }
    let closed = BSpline::closed_uniform(Degree::Quadratic, 4).unwrap();
    for spline in [spline, closed] {
        for parameter in [f64::NAN, f64::INFINITY] {
            assert!(matches!(spline.basis(parameter), Err(Error::NotFinite { .. })));
        }
    }
}

#[test]
fn invalid_control_points_are_refused() {
    let spline = BSpline::open_uniform(Degree::Quadratic, 3).unwrap();
    let wrong_count = Error::WrongCount { what: "control points", given: 2, needed: 3 };
    let two = on_a_line([0.0, 1.0]);
    assert_eq!(spline.evaluate(&two, 0.5), Err(wrong_count.clone()));
    assert_eq!(spline.arc_length(&two), Err(wrong_count));
    let infinite = on_a_line([0.0, 1.0, f64::INFINITY]);
    let not_finite = Error::NotFiniteAt { what: "control point", index: 2, value: f64::INFINITY };
    assert_eq!(spline.evaluate(&infinite, 0.5), Err(not_finite.clone()));
    assert_eq!(spline.arc_length(&infinite), Err(not_finite));
    for (u, length) in [([7.0; 3], 0.0), ([-1.5e308, 1.5e308, 0.0], f64::INFINITY)] {
        assert_eq!(
            spline.arc_length(&on_a_line(u)),
            Err(Error::UnusableLength { what: "control polygon", length })
        );
    }
    assert!(matches!(
        spline.arc_length(&on_a_line([0.0, 8e307, 0.0])),
        Err(Error::UnusableLength { what: "curve", .. })
    ));
}

#[test]
fn lengths_off_the_curve_and_too_few_samples_are_refused() {
    let line = on_a_line([0.0, 1.0, 2.0]);
    let open = BSpline::open_uniform(Degree::Quadratic, 3).unwrap().arc_length(&line).unwrap();
    assert!(matches!(open.parameter_at(-1e-9), Err(Error::OutOfRange { .. })));
    assert!(matches!(open.parameter_at(2.1), Err(Error::OutOfRange { value: 2.1, .. })));
    assert!(matches!(open.parameter_at(f64::NAN), Err(Error::NotFinite { .. })));
    let closed = BSpline::closed_uniform(Degree::Quadratic, 3).unwrap().arc_length(&line).unwrap();
    assert!(matches!(closed.parameter_at(f64::NAN), Err(Error::NotFinite { .. })));
    let too_few = |given, needed| Error::TooFew { what: "samples of a curve", given, needed };
    assert_eq!(open.equally_spaced(1), Err(too_few(1, 2)));
    assert_eq!(open.equally_spaced(0), Err(too_few(0, 2)));
    assert_eq!(closed.equally_spaced(0), Err(too_few(0, 1)));
    assert_eq!(closed.equally_spaced(1), Ok(vec![0.0]));
}

#[test]
fn outlines_that_cannot_be_fitted_are_refused() {
    let spline = BSpline::open_uniform(Degree::Quadratic, 3).unwrap();
    let fit = |outline: &[Point2<f64>], parametrization| {
        spline.fit(outline, parametrization).unwrap_err()
    };
    let chords = Parametrization::ChordLength;
    assert_eq!(
        fit(&on_a_line([0.0, 1.0]), chords),
        Error::TooFew { what: "outline points", given: 2, needed: 3 }
    );
    assert!(matches!(
        fit(&on_a_line([0.0, 1.0, f64::NAN, 2.0]), chords),
        Error::NotFiniteAt { what: "outline point", index: 2, value } if value.is_nan()
    ));
    for (u, length) in [([4.0; 4], 0.0), ([-1.5e308, 1.5e308, 0.0, 1.0], f64::INFINITY)] {
        assert_eq!(fit(&on_a_line(u), chords), Error::UnusableLength { what: "outline", length });
    }
    let line = on_a_line([0.0, 1.0, 2.0]);
    assert_eq!(
        fit(&line, Parametrization::Given(&[0.0, 1.0])),
        Error::WrongCount { what: "parameters", given: 2, needed: 3 }
    );
    assert_eq!(
        fit(&line, Parametrization::Given(&[0.0, 0.5, 1.5])),
        Error::OutsideDomain { parameter: 1.5, start: 0.0, end: 1.0 }
    );
    assert!(matches!(
        fit(&line, Parametrization::Given(&[0.0, f64::NAN, 1.0])),
        Error::NotFinite { .. }
    ));
    assert!(matches!(
        fit(&on_a_line([0.0, 1e300, 0.0, 1e300, 0.0]), chords),
        Error::NotFinite { .. }
    ));
}
