//! The pistol compared with its bands, and traced outlines in several poses.

use fingerpost_core::Error;
use fingerpost_core::geometry::bspline::{BSpline, Degree};
use fingerpost_core::geometry::contour::HandSide;
use fingerpost_core::geometry::planar::AffineMap;
use fingerpost_core::geometry::ribbon::ribbon_of;
use fingerpost_core::geometry::template::{
    HALF_LENGTH, Limb, OutlineAxis, Part, Proportions, Template, TemplateSample, Thumb,
    ThumbProportions,
};
use fingerpost_core::nalgebra::{Point2, SVector, Similarity2, Vector2};
use proptest::prelude::*;
use proptest::test_runner::{Config, RngSeed};

/// Greatest deviation of the spline from the exact outline of the usual hand, in finger lengths.
const OUTLINE_TOLERANCE: f64 = 0.002;
/// Enough samples to resolve the curve between two knots.
const DENSE: usize = 1500;
const ROUNDING: f64 = 1e-9;
const THUMBS: [Thumb; 3] = [Thumb::Left, Thumb::Right, Thumb::None];

fn config() -> Config {
    Config {
        cases: 64,
        rng_seed: RngSeed::Fixed(0x7465_6d70),
        failure_persistence: None,
        ..Config::default()
    }
}

/// An exact limb: the points at `half_width` from a spine.
struct Band {
    from: Point2<f64>,
    to: Point2<f64>,
    half_width: f64,
}

impl Band {
    fn finger(proportions: &Proportions) -> Self {
        let half_width = proportions.half_width;
        let to = Point2::new(HALF_LENGTH - half_width, 0.0);
        Self { from: Point2::new(-1.0, 0.0), to, half_width }
    }

    fn thumb(proportions: &Proportions) -> Option<Self> {
        let (side, thumb) = proportions.thumb?;
        let from = Point2::new(thumb.base, 0.0);
        let (sin, cos) = thumb.angle_rad.sin_cos();
        let along = Vector2::new(cos, side.sign() * sin);
        let to = from + along * (thumb.length - thumb.half_width);
        Some(Self { from, to, half_width: thumb.half_width })
    }

    fn along(&self) -> Vector2<f64> {
        (self.to - self.from).normalize()
    }

    /// Vector from the nearest point of the spine.
    fn radius(&self, at: &Point2<f64>) -> Vector2<f64> {
        let spine = self.to - self.from;
        let part = (at - self.from).dot(&spine) / spine.norm_squared();
        at - (self.from + spine * part.min(1.0))
    }

    fn deviation(&self, at: &Point2<f64>) -> f64 {
        (self.radius(at).norm() - self.half_width).abs()
    }
}

fn bands(template: &Template) -> (Band, Option<Band>) {
    let proportions = template.proportions().unwrap();
    (Band::finger(proportions), Band::thumb(proportions))
}

fn band(template: &Template, limb: Limb) -> Band {
    let (finger, thumb) = bands(template);
    match limb {
        Limb::Finger => finger,
        Limb::Thumb => thumb.unwrap(),
    }
}

fn end(template: &Template, at: impl Fn((f64, f64)) -> f64) -> Point2<f64> {
    let (spline, control_points) = template.outline();
    spline.evaluate(control_points, at(spline.domain())).unwrap().position
}

#[test]
fn the_outline_follows_finger_and_thumb() {
    for thumb in THUMBS {
        let template = Template::pistol(thumb).unwrap();
        for s in template.samples(DENSE).unwrap() {
            let band = band(&template, s.limb);
            assert!(band.deviation(&s.position) < OUTLINE_TOLERANCE, "{thumb:?} {s:?}");
            // On the limb's outer side, with the hand behind the contour.
            let out = band.radius(&s.position).normalize();
            assert!(s.normal.dot(&out) > 0.97, "{thumb:?} {s:?}");
        }
    }
}

#[test]
fn it_begins_and_ends_at_the_given_proportions() {
    for thumb in THUMBS {
        let template = Template::pistol(thumb).unwrap();
        let Proportions { half_width, flank_start, thumb: proportions } =
            *template.proportions().unwrap();
        let outer = if thumb == Thumb::Left { half_width } else { -half_width };
        let start = Point2::new(flank_start, outer);
        assert!((end(&template, |d| d.0) - start).norm() < OUTLINE_TOLERANCE);
        let last = match (proportions, bands(&template).1) {
            (Some((side, thumb)), Some(band)) => {
                let (sin, cos) = thumb.angle_rad.sin_cos();
                let far = Vector2::new(-sin, side.sign() * cos) * thumb.half_width;
                band.to + (band.from - band.to) * thumb.far_flank + far
            }
            _ => Point2::new(flank_start, -outer),
        };
        assert!((end(&template, |d| d.1) - last).norm() < OUTLINE_TOLERANCE, "{thumb:?}");
    }
}

#[test]
fn the_axis_is_the_basis_vector_of_p() {
    for thumb in THUMBS {
        let template = Template::pistol(thumb).unwrap();
        let half_width = template.proportions().unwrap().half_width;
        let samples = template.samples(DENSE).unwrap();
        let finger: Vec<_> = samples.iter().filter(|s| s.limb == Limb::Finger).collect();
        let apex = finger.iter().map(|s| s.position.x).fold(f64::MIN, f64::max);
        assert!((apex - HALF_LENGTH).abs() < OUTLINE_TOLERANCE);
        for side in [-1.0, 1.0] {
            // Straight flanks parallel to p on both sides.
            let flank: Vec<_> = finger
                .iter()
                .filter(|s| s.position.y * side > 0.5 * half_width && s.position.x < 0.3)
                .collect();
            assert!(flank.len() > 20);
            for s in flank {
                assert!((s.position.y - side * half_width).abs() < OUTLINE_TOLERANCE, "{s:?}");
                assert!((s.normal - Vector2::new(0.0, side)).norm() < 0.1, "{s:?}");
            }
        }
    }
}

#[test]
fn left_is_the_mirror_of_right() {
    let [left, right] = [Thumb::Left, Thumb::Right].map(|t| Template::pistol(t).unwrap());
    assert_eq!((left.hand(), right.hand()), (HandSide::Left, HandSide::Right));
    assert_eq!((left.thumb(), right.thumb()), (Thumb::Left, Thumb::Right));
    let mirror = |v: &Vector2<f64>| Vector2::new(v.x, -v.y);
    let pairs = left.samples(200).unwrap().into_iter().zip(right.samples(200).unwrap());
    for (l, r) in pairs {
        assert!((mirror(&l.position.coords) - r.position.coords).norm() < ROUNDING);
        assert!((mirror(&l.normal) - r.normal).norm() < ROUNDING);
        assert_eq!(l.limb, r.limb);
        assert!((l.along - r.along).abs() < ROUNDING);
        // The mirror reverses q, the lateral axis of the finger; that of the thumb is towards the
        // tip.
        let across = if l.limb == Limb::Finger { mirror(&l.radial) } else { l.radial };
        assert!((across - r.radial).norm() < ROUNDING);
    }
    let (left, right) = (left.outline().1, right.outline().1);
    for (l, r) in left.iter().zip(right) {
        assert!((mirror(&l.coords) - r.coords).norm() < ROUNDING);
    }
}

#[test]
fn the_thumb_is_on_its_named_side() {
    // Pointing right in the image, u right and v down, left of the finger is up: q is negative.
    for (thumb, side) in [(Thumb::Left, -1.0), (Thumb::Right, 1.0)] {
        let samples = Template::pistol(thumb).unwrap().samples(200).unwrap();
        let apex = |s: &&TemplateSample| s.position.y * side > 0.5;
        assert!(samples.iter().filter(apex).all(|s| s.limb == Limb::Thumb));
        assert!(samples.iter().filter(apex).count() > 10);
    }
}

#[test]
fn the_crotch_is_a_corner_where_the_flanks_meet() {
    for thumb in [Thumb::Left, Thumb::Right] {
        let template = Template::pistol(thumb).unwrap();
        let (spline, control_points) = template.outline();
        let knots = spline.knots();
        let inner = &knots[4..knots.len() - 4];
        let corners: Vec<f64> = inner.windows(3).filter(|k| k[2] <= k[0]).map(|k| k[0]).collect();
        let [corner] = corners[..] else { unreachable!("{corners:?}") };
        let at = |t| spline.evaluate(control_points, t).unwrap();
        let (before, after) = (at(corner - 1e-9), at(corner));
        assert!((before.position - after.position).norm() < 1e-6);
        let (finger, thumb) = bands(&template);
        let thumb = thumb.unwrap();
        assert!(finger.deviation(&after.position) < OUTLINE_TOLERANCE);
        assert!(thumb.deviation(&after.position) < OUTLINE_TOLERANCE);
        // The contour arrives down the finger and leaves up the thumb.
        assert!(before.first_derivative.normalize().x < -0.99);
        assert!(after.first_derivative.normalize().dot(&thumb.along()) > 0.99);
    }
}

#[test]
fn the_limb_changes_once_and_never_on_a_finger_alone() {
    for thumb in [Thumb::Left, Thumb::Right] {
        let samples = Template::pistol(thumb).unwrap().samples(100).unwrap();
        let changes = samples.windows(2).filter(|pair| pair[0].limb != pair[1].limb).count();
        assert_eq!((changes, samples[0].limb, samples[99].limb), (1, Limb::Finger, Limb::Thumb));
    }
    let alone = Template::pistol(Thumb::None).unwrap();
    assert_eq!(alone.thumb(), Thumb::None);
    assert!(alone.samples(100).unwrap().iter().all(|s| s.limb == Limb::Finger));
}

#[test]
fn every_sample_belongs_to_the_part_it_lies_on() {
    for thumb in THUMBS {
        let template = Template::pistol(thumb).unwrap();
        let half_width = template.proportions().unwrap().half_width;
        let round_end = HALF_LENGTH - half_width;
        let samples = template.samples(200).unwrap();
        for s in &samples {
            // The tip starts where the normal is more than 30° from that of the flank.
            let is_tip = s.position.x > round_end + 0.5 * half_width + OUTLINE_TOLERANCE;
            let is_flank = s.position.x < round_end + 0.5 * half_width - OUTLINE_TOLERANCE;
            match s.part() {
                Part::Thumb => assert_eq!(s.limb, Limb::Thumb),
                Part::Tip => assert!(s.limb == Limb::Finger && !is_flank, "{s:?}"),
                // Left of the pointing direction, in the image's axes, q is negative.
                Part::LeftFlank => assert!(s.position.y < 0.0 && !is_tip, "{s:?}"),
                Part::RightFlank => assert!(s.position.y > 0.0 && !is_tip, "{s:?}"),
            }
        }
        let parts = [Part::LeftFlank, Part::RightFlank, Part::Tip];
        assert!(parts.iter().all(|&part| samples.iter().filter(|s| s.part() == part).count() > 10));
        assert_eq!(samples.iter().any(|s| s.part() == Part::Thumb), thumb != Thumb::None);
    }
}

/// A sample's position reconstructed from its place on the limb's spine and its radial.
fn from_limb(template: &Template, s: &TemplateSample) -> Point2<f64> {
    let Proportions { half_width, thumb, .. } = *template.proportions().unwrap();
    match (s.limb, thumb) {
        (Limb::Thumb, Some((side, thumb))) => {
            let (sin, cos) = thumb.angle_rad.sin_cos();
            let along = Vector2::new(cos, side.sign() * sin);
            let facing = Vector2::new(sin, -side.sign() * cos);
            let spine = along * ((thumb.length - thumb.half_width) * s.along);
            let radial = along * s.radial.x + facing * s.radial.y;
            Point2::new(thumb.base, 0.0) + spine + radial * thumb.half_width
        }
        _ => Point2::new(s.along, 0.0) + s.radial * half_width,
    }
}

#[test]
fn samples_are_reconstructed_from_their_place_on_a_limb() {
    for thumb in THUMBS {
        let template = Template::pistol(thumb).unwrap();
        for s in template.samples(DENSE).unwrap() {
            assert!((s.radial.norm() - 1.0).abs() < ROUNDING);
            let distance = (from_limb(&template, &s) - s.position).norm();
            assert!(distance < OUTLINE_TOLERANCE, "{thumb:?} {s:?}");
        }
    }
}

/// Pistols of all proportions whose thumb leaves a crotch.
fn proportions() -> impl Strategy<Value = Proportions> {
    let side = prop_oneof![Just(HandSide::Left), Just(HandSide::Right)];
    let thumb = (-1.0..0.0, 0.5..2.0, 0.3..2.0, 0.08..0.2, 0.0..1.0).prop_map(
        |(base, angle_rad, length, half_width, far_flank)| ThumbProportions {
            base,
            angle_rad,
            length,
            half_width,
            far_flank,
        },
    );
    (0.08..0.2, -0.5..0.2, prop::option::of((side, thumb)))
        .prop_map(|(half_width, flank_start, thumb)| Proportions { half_width, flank_start, thumb })
        .prop_filter("a crotch", |p| Template::with_proportions(p).is_ok())
}

proptest! {
    #![proptest_config(config())]

    #[test]
    fn any_pistol_follows_its_bands(proportions in proportions()) {
        /// Tips that are slimmer than usual have fewer knots.
        const TOLERANCE: f64 = 0.004;
        let template = Template::with_proportions(&proportions).unwrap();
        prop_assert_eq!(template.proportions(), Some(&proportions));
        for s in template.samples(DENSE / 5).unwrap() {
            prop_assert!(band(&template, s.limb).deviation(&s.position) < TOLERANCE, "{:?}", s);
            prop_assert!((from_limb(&template, &s) - s.position).norm() < TOLERANCE, "{:?}", s);
        }
    }

    #[test]
    fn fitting_to_its_own_shape_vector_reproduces_the_pistol(
        hand in proportions(),
        waiting in proportions(),
        (u, v, angle_rad, length_px) in (-1e3..1e3, -1e3..1e3, -4.0..4.0, 5.0..500.0),
    ) {
        // A fit keeps the side and the extent of the flanks, which it cannot determine.
        let thumb = match (hand.thumb, waiting.thumb) {
            (Some((_, thumb)), Some((side, own))) => {
                Some((side, ThumbProportions { far_flank: own.far_flank, ..thumb }))
            }
            _ => None,
        };
        let expected = Proportions { flank_start: waiting.flank_start, thumb, ..hand };
        let map = AffineMap::upright(Point2::new(u, v), angle_rad, length_px).unwrap();
        let (x, waiting) = (ribbon_of(&expected, &map), Template::with_proportions(&waiting));
        let fitted = waiting.unwrap().fitted(&x, length_px, hand.thumb.is_some()).unwrap();
        let found = fitted.proportions().unwrap();
        prop_assert!((found.half_width - expected.half_width).abs() < ROUNDING);
        prop_assert_eq!(found.flank_start, expected.flank_start);
        prop_assert_eq!(found.thumb.is_some(), expected.thumb.is_some());
        if let (Some((side, found)), Some((expected_side, expected))) = (found.thumb, expected.thumb) {
            prop_assert_eq!(side, expected_side);
            prop_assert_eq!(found.far_flank, expected.far_flank);
            for (found, expected) in [
                (found.base, expected.base),
                (found.angle_rad, expected.angle_rad),
                (found.length, expected.length),
                (found.half_width, expected.half_width),
            ] {
                prop_assert!((found - expected).abs() < ROUNDING, "{} {}", found, expected);
            }
        }
    }

    #[test]
    fn a_traced_outline_is_the_same_in_any_pose_and_unit(
        (u, v, angle, scale) in (-1e3..1e3, -1e3..1e3, -4.0..4.0, 1e-2..1e4),
    ) {
        let traced = traced_finger();
        let at_rest = Template::from_outline(&traced, &axis_at_rest(), HandSide::Left, 12).unwrap();
        let pose = Similarity2::new(Vector2::new(u, v), angle, scale);
        let moved: Vec<_> = traced.iter().map(|m| pose * m).collect();
        let OutlineAxis { knuckle, tip } = axis_at_rest();
        let axis = OutlineAxis { knuckle: pose * knuckle, tip: pose * tip };
        let template = Template::from_outline(&moved, &axis, HandSide::Left, 12).unwrap();
        for (a, b) in template.outline().1.iter().zip(at_rest.outline().1) {
            prop_assert!((a - b).norm() < 1e-6, "{} {}", a, b);
        }
    }
}

/// Points along the outline of a finger alone, the hand to the left of their order.
fn traced_finger() -> Vec<Point2<f64>> {
    let finger = Template::pistol(Thumb::None).unwrap();
    finger.samples(150).unwrap().iter().rev().map(|s| s.position).collect()
}

fn axis_at_rest() -> OutlineAxis {
    OutlineAxis { knuckle: Point2::new(-HALF_LENGTH, 0.0), tip: Point2::new(HALF_LENGTH, 0.0) }
}

#[test]
fn a_traced_outline_keeps_its_shape_and_its_axis() {
    let template = Template::from_outline(&traced_finger(), &axis_at_rest(), HandSide::Left, 24);
    let template = template.unwrap();
    assert_eq!((template.thumb(), template.hand()), (Thumb::None, HandSide::Left));
    assert_eq!(template.proportions(), None);
    let finger = Band::finger(&Proportions::usual(Thumb::None));
    for s in template.samples(200).unwrap() {
        assert!(finger.deviation(&s.position) < 2.0 * OUTLINE_TOLERANCE, "{s:?}");
        assert!(s.normal.dot(&finger.radius(&s.position)) > 0.0, "{s:?}");
        // The whole outline counts as finger, with the axis as its spine.
        assert_eq!((s.limb, s.along, s.radial), (Limb::Finger, s.position.x, s.normal));
    }
    let unfitted = template.fitted(&SVector::zeros(), 100.0, true);
    assert!(matches!(
        unfitted,
        Err(Error::Unsupported { what: "a template fitted to a hand", .. })
    ));
}

#[test]
fn an_outline_or_axis_without_extent_is_refused() {
    let (outline, axis) = (traced_finger(), axis_at_rest());
    let from = |outline: &[Point2<f64>], axis: &OutlineAxis, n| {
        Template::from_outline(outline, axis, HandSide::Left, n).unwrap_err()
    };
    assert_eq!(
        from(&outline, &axis, 3),
        Error::TooFew { what: "control points", given: 3, needed: 4 }
    );
    assert_eq!(
        from(&outline[..9], &axis, 10),
        Error::TooFew { what: "outline points", given: 9, needed: 10 }
    );
    assert_eq!(
        from(&outline[..10], &axis, usize::MAX),
        Error::TooFew { what: "outline points", given: 10, needed: usize::MAX }
    );
    assert_eq!(from(&[], &axis, 4), Error::TooFew { what: "outline points", given: 0, needed: 4 });
    for tip in [axis.knuckle, Point2::new(f64::NAN, 0.0), Point2::new(f64::INFINITY, 0.0)] {
        let none = OutlineAxis { tip, ..axis };
        let error = from(&outline, &none, 8);
        assert!(matches!(error, Error::UnusableLength { what: "template's axis", .. }), "{error}");
    }
    let mut broken = outline.clone();
    broken[7].y = f64::NAN;
    assert!(matches!(
        from(&broken, &axis, 8),
        Error::NotFiniteAt { what: "outline point", index: 7, .. }
    ));
    assert!(matches!(
        from(&vec![outline[0]; 50], &axis, 8),
        Error::UnusableLength { what: "outline", length: 0.0 }
    ));
    let template = Template::pistol(Thumb::None).unwrap();
    assert!(matches!(template.samples(0), Err(Error::TooFew { needed: 1, .. })));
}

/// Sets one of a pistol's numbers.
type Set = fn(&mut Proportions, f64);

fn thumb(proportions: &mut Proportions) -> &mut ThumbProportions {
    &mut proportions.thumb.as_mut().unwrap().1
}

#[test]
fn every_proportion_has_its_range() {
    let ranges: [(&str, Set, f64, f64); 7] = [
        ("finger half-width", |p, x| p.half_width = x, 0.03, 0.4),
        ("flank start", |p, x| p.flank_start = x, -0.5, 0.3),
        ("thumb base", |p, x| thumb(p).base = x, -1.0, 0.5),
        ("thumb angle [rad]", |p, x| thumb(p).angle_rad = x, 0.5, 2.0),
        ("thumb length", |p, x| thumb(p).length = x, 0.3, 2.0),
        ("thumb half-width", |p, x| thumb(p).half_width = x, 0.03, 0.4),
        ("far flank", |p, x| thumb(p).far_flank = x, 0.0, 1.0),
    ];
    for (what, set, low, high) in ranges {
        let error_at = |x: f64| {
            let mut proportions = Proportions::usual(Thumb::Right);
            set(&mut proportions, x);
            Template::with_proportions(&proportions).err()
        };
        for x in [low.next_down(), high.next_up(), -1e300, 1e300] {
            let error = error_at(x).expect(what);
            assert!(
                matches!(error, Error::OutOfRange { what: w, value, .. } if w == what && value == x),
                "{error}"
            );
            assert!(error.to_string().contains(&x.to_string()), "{error}");
        }
        for x in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
            let error = error_at(x).expect(what);
            assert!(matches!(error, Error::NotFinite { what: w, .. } if w == what), "{error}");
        }
        // The limits belong to the range, though they may leave no crotch.
        for x in [low, high] {
            let error = error_at(x);
            assert!(!matches!(&error, Some(Error::OutOfRange { what: w, .. }) if *w == what));
        }
    }
}

#[test]
fn a_thumb_that_leaves_no_crotch_is_refused() {
    let with = |change: &dyn Fn(&mut Proportions)| {
        let mut proportions = Proportions::usual(Thumb::Left);
        change(&mut proportions);
        Template::with_proportions(&proportions).unwrap_err()
    };
    let above = with(&|p| thumb(p).base = 0.45);
    assert!(matches!(above, Error::OutOfRange { what: "crotch", .. }), "{above}");
    let inside = with(&|p| (thumb(p).length, p.half_width) = (0.3, 0.3));
    assert!(
        matches!(inside, Error::OutOfRange { what: "thumb length beyond the crotch", .. }),
        "{inside}"
    );
    let late = with(&|p| (p.flank_start, p.half_width) = (0.25, 0.3));
    assert!(matches!(late, Error::OutOfRange { what: "flank start", .. }), "{late}");
}

#[test]
fn a_thumb_without_a_spine_is_refused() {
    // A thumb no longer than its round end would have no direction.
    for length in [0.4, 0.35] {
        let mut proportions = Proportions::usual(Thumb::Right);
        proportions.half_width = 0.03;
        *thumb(&mut proportions) = ThumbProportions {
            base: -0.5,
            angle_rad: 2.0,
            length,
            half_width: 0.4,
            far_flank: 0.5,
        };
        let refused = Template::with_proportions(&proportions);
        assert!(matches!(refused, Err(Error::OutOfRange { .. })), "{length}");
    }
}

#[test]
fn the_outline_is_a_clamped_cubic() {
    for thumb in THUMBS {
        let template = Template::pistol(thumb).unwrap();
        let (spline, control_points) = template.outline();
        let spline: &BSpline = spline;
        assert_eq!((spline.degree(), spline.is_closed()), (Degree::Cubic, false));
        assert_eq!(spline.control_point_count(), control_points.len());
        assert_eq!(end(&template, |d| d.0), control_points[0]);
    }
}
