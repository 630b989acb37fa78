//! Contour samples on circles and lines, whose arc length and normals are known.

use fingerpost_core::Error;
use fingerpost_core::geometry::bspline::{BSpline, Degree};
use fingerpost_core::geometry::contour::{ContourSample, HandSide, sample};
use fingerpost_core::nalgebra::{Point2, Rotation2, Vector2};
use proptest::prelude::*;
use proptest::test_runner::{Config, RngSeed};
use std::f64::consts::TAU;

/// Arc lengths are accurate to 10⁻¹⁰ of a curve's size.
const LENGTH_TOLERANCE: f64 = 1e-9;
const ROUNDING: f64 = 1e-12;

fn config() -> Config {
    Config { rng_seed: RngSeed::Fixed(0x636f_6e74), failure_persistence: None, ..Config::default() }
}

/// Open curves in general position.
fn curves() -> impl Strategy<Value = (BSpline, Vec<Point2<f64>>)> {
    let degree = prop_oneof![Just(Degree::Quadratic), Just(Degree::Cubic)];
    let point = (-50.0..50.0, -50.0..50.0).prop_map(|(u, v)| Point2::new(u, v));
    (degree, prop::collection::vec(point, 4..12)).prop_map(|(degree, control_points)| {
        (BSpline::open_uniform(degree, control_points.len()).unwrap(), control_points)
    })
}

fn sides() -> impl Strategy<Value = HandSide> {
    prop_oneof![Just(HandSide::Left), Just(HandSide::Right)]
}

/// A closed B-spline circle with the direction of travel towards growing angles, clockwise in the
/// image; its largest deviation from the radius.
fn circle(centre: Point2<f64>, radius: f64, n: usize) -> (BSpline, Vec<Point2<f64>>) {
    let spline = BSpline::closed_uniform(Degree::Cubic, n).unwrap();
    // At its knots, a uniform cubic B-spline contracts a regular polygon by this factor.
    let pull = (2.0 + (TAU / n as f64).cos()) / 3.0;
    let control_points = (0..n)
        .map(|i| centre + Rotation2::new(TAU * i as f64 / n as f64) * Vector2::x() * radius / pull);
    (spline, control_points.collect())
}

#[test]
fn a_circle_has_even_steps_and_radial_normals() {
    /// The spline's deviation from the circle: h⁴/720 of the radius for knots h apart.
    const CIRCLE_TOLERANCE: f64 = 1e-6;
    let (centre, radius, count) = (Point2::new(31.0, -7.0), 40.0, 77);
    let (spline, control_points) = circle(centre, radius, 64);
    for (hand, sign) in [(HandSide::Right, 1.0), (HandSide::Left, -1.0)] {
        let samples = sample(&spline, &control_points, count, hand).unwrap();
        assert_eq!(samples.len(), count);
        let step = TAU / count as f64;
        for (i, s) in samples.iter().enumerate() {
            let out = (s.position - centre) / radius;
            assert!((out.norm() - 1.0).abs() < CIRCLE_TOLERANCE);
            // Clockwise in the image the disc is to the right: then the normal is radial.
            assert!((s.normal - out * sign).norm() < 10.0 * CIRCLE_TOLERANCE);
            assert!(
                (s.arc_length / radius - (i as f64 + 0.5) * step).abs() < CIRCLE_TOLERANCE * 8.0
            );
            let next = (samples[(i + 1) % count].position - centre) / radius;
            assert!((out.perp(&next).atan2(out.dot(&next)) - step).abs() < CIRCLE_TOLERANCE);
        }
    }
}

#[test]
fn a_line_is_sampled_at_the_middles_of_its_steps() {
    // With uneven control points, equal arc lengths are not equal parameter steps.
    let spline = BSpline::open_uniform(Degree::Cubic, 6).unwrap();
    let (start, along) = (Point2::new(3.0, 5.0), Vector2::new(0.6, 0.8));
    let control_points = [0.0, 1.0, 2.0, 30.0, 31.0, 100.0].map(|s| start + along * s);
    for (hand, normal) in
        [(HandSide::Left, Vector2::new(-0.8, 0.6)), (HandSide::Right, Vector2::new(0.8, -0.6))]
    {
        let samples = sample(&spline, &control_points, 8, hand).unwrap();
        for (i, s) in samples.iter().enumerate() {
            let length = (i as f64 + 0.5) * 12.5;
            assert!((s.arc_length - length).abs() < LENGTH_TOLERANCE);
            assert!((s.position - (start + along * length)).norm() < 100.0 * LENGTH_TOLERANCE);
            assert!((s.tangent - along).norm() < ROUNDING);
            assert!((s.normal - normal).norm() < ROUNDING);
        }
    }
}

#[test]
fn one_sample_is_in_the_middle() {
    let spline = BSpline::open_uniform(Degree::Quadratic, 3).unwrap();
    let arch = [(0.0, 0.0), (1.0, 4.0), (2.0, 0.0)].map(|(u, v)| Point2::new(u, v));
    let samples = sample(&spline, &arch, 1, HandSide::Right).unwrap();
    let [middle] = samples.as_slice() else { unreachable!("{} samples", samples.len()) };
    assert!((middle.position - Point2::new(1.0, 2.0)).norm() < LENGTH_TOLERANCE);
    assert!((middle.normal - -Vector2::y()).norm() < LENGTH_TOLERANCE);
}

#[test]
fn the_hand_is_to_the_right_when_travelling_towards_plus_u_with_it_below() {
    let towards_u = Vector2::x();
    assert_eq!(HandSide::Right.outward(&towards_u), -Vector2::y());
    assert_eq!(HandSide::Left.outward(&towards_u), Vector2::y());
    // The sign is that of the rotation from the direction of travel to the hand.
    for hand in [HandSide::Left, HandSide::Right] {
        assert_eq!(towards_u.perp(&-hand.outward(&towards_u)).signum(), hand.sign());
    }
}

proptest! {
    #![proptest_config(config())]

    #[test]
    fn steps_are_equal_and_directions_unit((spline, control_points) in curves(), count in 1..40_usize, hand in sides()) {
        let total = spline.arc_length(&control_points).unwrap().total();
        let samples = sample(&spline, &control_points, count, hand).unwrap();
        prop_assert_eq!(samples.len(), count);
        let mut end = 0.0;
        for (i, s) in samples.iter().enumerate() {
            let ContourSample { parameter, arc_length, position, tangent, normal } = *s;
            prop_assert!((arc_length - (i as f64 + 0.5) * total / count as f64).abs() < LENGTH_TOLERANCE * total);
            prop_assert!(parameter > end, "parameters rise");
            end = parameter;
            let point = spline.evaluate(&control_points, parameter).unwrap();
            prop_assert_eq!(position, point.position);
            prop_assert!((tangent.norm() - 1.0).abs() < ROUNDING);
            prop_assert!((normal.norm() - 1.0).abs() < ROUNDING);
            prop_assert!(tangent.dot(&point.first_derivative) > 0.0);
            prop_assert!(tangent.perp(&point.first_derivative).abs() <= ROUNDING * point.first_derivative.norm());
            // With the hand on the right of the direction of travel, outward is left.
            prop_assert!((tangent.perp(&normal) + hand.sign()).abs() < ROUNDING);
        }
        prop_assert!(end < spline.domain().1, "none on the end");
    }

    #[test]
    fn the_other_side_only_reverses_the_normals((spline, control_points) in curves(), count in 1..20_usize) {
        let left = sample(&spline, &control_points, count, HandSide::Left).unwrap();
        let right = sample(&spline, &control_points, count, HandSide::Right).unwrap();
        for (l, r) in left.iter().zip(&right) {
            prop_assert_eq!(ContourSample { normal: -l.normal, ..*l }, *r);
        }
    }
}

#[test]
fn invalid_arguments_are_refused() {
    let spline = BSpline::open_uniform(Degree::Quadratic, 3).unwrap();
    let line = [0.0, 1.0, 2.0].map(|u| Point2::new(u, 0.0));
    assert_eq!(
        sample(&spline, &line, 0, HandSide::Left),
        Err(Error::TooFew { what: "contour samples", given: 0, needed: 1 })
    );
    assert_eq!(
        sample(&spline, &line[..2], 5, HandSide::Left),
        Err(Error::WrongCount { what: "control points", given: 2, needed: 3 })
    );
    let nan = [line[0], Point2::new(1.0, f64::NAN), line[2]];
    assert!(matches!(
        sample(&spline, &nan, 5, HandSide::Left),
        Err(Error::NotFiniteAt { what: "control point", index: 1, value }) if value.is_nan()
    ));
    assert!(matches!(
        sample(&spline, &[line[0]; 3], 5, HandSide::Left),
        Err(Error::UnusableLength { length: 0.0, .. })
    ));
}

#[test]
fn a_stopping_curve_has_no_tangent() {
    // The curve runs to u = 1 and back; in the middle its speed is zero.
    let spline = BSpline::open_uniform(Degree::Quadratic, 3).unwrap();
    let there_and_back = [0.0, 2.0, 0.0].map(|u| Point2::new(u, 0.0));
    assert!(matches!(
        sample(&spline, &there_and_back, 1, HandSide::Left),
        Err(Error::UnusableLength { what: "contour's tangent", .. })
    ));
    assert_eq!(sample(&spline, &there_and_back, 2, HandSide::Left).unwrap().len(), 2);
}
