//! Shape spaces: Jacobians compared with central differences, maps with their decomposition, and
//! the band template with the bands.

use fingerpost_core::Error;
use fingerpost_core::geometry::planar::{
    Affine, AffineMap, PlanarSpace, Rigid, RigidShear, Similarity, SimilarityShear, Translation,
};
use fingerpost_core::geometry::ribbon::{
    BandMeasure, RIBBON_DOF, Ribbon, RibbonPose, RibbonVector, ribbon_of,
};
use fingerpost_core::geometry::shape_space::{Axis, Pose, ShapeSpace};
use fingerpost_core::geometry::template::{
    HALF_LENGTH, Limb, Proportions, Template, TemplateSample, Thumb,
};
use fingerpost_core::nalgebra::{Matrix2, Point2, Rotation2, SMatrix, SVector, Vector2};
use proptest::prelude::*;
use proptest::test_runner::{Config, RngSeed, TestCaseResult};
use std::f64::consts::{FRAC_PI_2, PI};
use std::sync::LazyLock;

/// Tolerance of derivatives, relative to the largest velocity of a sample by the component.
const JACOBIAN_TOLERANCE: f64 = 1e-6;
/// Steps of the central differences, in a component's own unit, and their weights; the error of
/// this pair is of fourth order in the step.
const STEPS: [(f64, f64); 2] = [(1e-4, 8.0 / 12.0), (2e-4, -1.0 / 12.0)];
const ROUNDING: f64 = 1e-12;

fn config() -> Config {
    Config { rng_seed: RngSeed::Fixed(0x7368_6170), failure_persistence: None, ..Config::default() }
}

static PISTOL: LazyLock<[Vec<TemplateSample>; 2]> = LazyLock::new(|| {
    [Thumb::Left, Thumb::Right].map(|thumb| Template::pistol(thumb).unwrap().samples(30).unwrap())
});

fn pistol(side: f64) -> &'static [TemplateSample] {
    &PISTOL[usize::from(side > 0.0)]
}

/// Arbitrary angles, and those where atan2 jumps or a row has a zero.
fn angles() -> impl Strategy<Value = f64> {
    prop_oneof![
        -7.0..7.0,
        Just(PI),
        Just(-PI),
        Just(PI.next_down()),
        (-PI - 1e-6..-PI + 1e-6),
        Just(0.0),
        Just(FRAC_PI_2)
    ]
}

fn centres() -> impl Strategy<Value = Point2<f64>> {
    let coordinate = || prop_oneof![Just(0.0), -2000.0..2000.0];
    (coordinate(), coordinate()).prop_map(|(u, v)| Point2::new(u, v))
}

/// The parts of a decomposed map.
#[derive(Debug, Clone, Copy)]
struct Parts {
    centre: Point2<f64>,
    angle_rad: f64,
    alpha: f64,
    beta: f64,
    kappa: f64,
}

impl Parts {
    fn map(&self) -> AffineMap {
        let Self { centre, angle_rad, alpha, beta, kappa } = *self;
        let upper = Matrix2::new(alpha, kappa, 0.0, beta);
        AffineMap { centre, linear: Rotation2::new(angle_rad).into_inner() * upper }
    }
}

/// Fingers from tiny to larger than the image; shears up to a thumb that lies on the finger.
fn parts() -> impl Strategy<Value = Parts> {
    let scale = || prop_oneof![Just(0.5), 0.5..2.0, 20.0..400.0];
    let lean = prop_oneof![Just(0.0), -1.0..1.0, Just(30.0), Just(-30.0)];
    (centres(), angles(), scale(), scale(), lean).prop_map(
        |(centre, angle_rad, alpha, beta, lean)| Parts {
            centre,
            angle_rad,
            alpha,
            beta,
            kappa: lean * beta,
        },
    )
}

/// Shape vectors of the whole band template, on either side.
fn ribbons() -> impl Strategy<Value = (RibbonVector, BandMeasure)> {
    let taper = prop_oneof![Just(0.0), -0.3..0.3];
    let spine = prop_oneof![Just(0.1), 0.5..2.0, 10.0..200.0];
    let finger = (centres(), angles(), 0.2..60.0, taper);
    let thumb = (-150.0..50.0, angles(), spine, 0.2..40.0);
    let measure = (5.0..300.0, -0.2..0.5, prop_oneof![Just(-1.0), Just(1.0)]).prop_map(
        |(length_px, round_end, side)| BandMeasure {
            length_px,
            round_end_px: round_end * length_px,
            side,
        },
    );
    let vector = (finger, thumb).prop_map(|((c, theta, w, tau), (root, turn, spine, w2))| {
        let spine: Vector2<f64> = Rotation2::new(turn) * Vector2::x() * spine;
        RibbonVector::from([c.x, c.y, theta, w, tau, root, spine.x, spine.y, w2])
    });
    (vector, measure)
}

/// The angle from `a` to `b`, in (−π, π].
fn turn(a: &Axis, b: &Axis) -> f64 {
    a.direction().perp(&b.direction()).atan2(a.direction().dot(&b.direction()))
}

/// The derivative of `change` between two poses with respect to component `i`.
fn central_difference<S: ShapeSpace<D>, const D: usize, V>(
    space: &S,
    x: &SVector<f64, D>,
    i: usize,
    change: impl Fn(&S::Pose, &S::Pose) -> V,
) -> V
where
    V: std::ops::Mul<f64, Output = V> + std::ops::Add<Output = V>,
{
    let [near, far] = STEPS.map(|(h, weight)| {
        let [before, after] = [-h, h].map(|h| {
            let mut moved = *x;
            moved[i] += h;
            space.pose(&moved)
        });
        change(&before, &after) * (weight / STEPS[0].0)
    });
    near + far
}

/// Compares all rows and the Jacobian of the axis with central differences.
fn check_jacobians<S: ShapeSpace<D>, const D: usize>(
    space: &S,
    x: &SVector<f64, D>,
    samples: &[TemplateSample],
) -> TestCaseResult {
    let pose = space.pose(x);
    let (axis, axis_jacobian) = (pose.axis(), space.axis_jacobian(&pose));
    for i in 0..D {
        let velocities: Vec<Vector2<f64>> = samples
            .iter()
            .map(|s| {
                central_difference(space, x, i, |before, after| {
                    after.place(s).position - before.place(s).position
                })
            })
            .collect();
        let fastest = velocities.iter().map(Vector2::norm).fold(0.0, f64::max);
        for (sample, velocity) in samples.iter().zip(&velocities) {
            let normal = pose.place(sample).normal;
            let analytic = space.normal_row(&pose, sample, &normal)[i];
            let numeric = velocity.dot(&normal);
            prop_assert!(
                (analytic - numeric).abs() <= JACOBIAN_TOLERANCE * fastest,
                "{}: {analytic} and not {numeric}, at {sample:?}",
                S::NAMES[i]
            );
        }
        let motion: Vector2<f64> = central_difference(space, x, i, |before, after| {
            let (before, after) = (before.axis(), after.axis());
            let offset = (after.anchor - before.anchor).dot(&axis.normal());
            Vector2::new(offset, turn(&before, &after))
        });
        for (analytic, numeric) in axis_jacobian.column(i).iter().zip(&motion) {
            prop_assert!(
                (analytic - numeric).abs() <= JACOBIAN_TOLERANCE * analytic.abs().max(1.0),
                "axis by {}: {analytic} and not {numeric}",
                S::NAMES[i]
            );
        }
    }
    Ok(())
}

/// A space `S` with the frozen size of one map, and a shape vector near or far from it.
fn member<S: PlanarSpace<D>, const D: usize>(
    frozen: &Parts,
    at: &Parts,
    scale: f64,
) -> (S, SVector<f64, D>) {
    let (space, _) = S::through(&frozen.map()).unwrap();
    let (_, mut x) = S::through(&at.map()).unwrap();
    if S::NAMES[D - 1].starts_with("scale") {
        x[D - 1] = scale;
    }
    (space, x)
}

fn check_planar<S: PlanarSpace<D>, const D: usize>(
    frozen: &Parts,
    at: &Parts,
    scale: f64,
) -> TestCaseResult {
    let (space, x) = member::<S, D>(frozen, at, scale);
    check_jacobians(&space, &x, pistol(1.0))?;

    // In a planar space the row is valid for any direction, not only the normal.
    let (pose, direction) = (space.pose(&x), Vector2::new(0.6, -0.8));
    for sample in pistol(1.0) {
        let row = space.normal_row(&pose, sample, &direction);
        let [along_u, along_v] =
            [Vector2::x(), Vector2::y()].map(|axis| space.normal_row(&pose, sample, &axis));
        let sum = along_u * direction.x + along_v * direction.y;
        prop_assert!((row - sum).norm() <= ROUNDING * (along_u.norm() + along_v.norm()));
    }

    // Round trip through a map.
    let map = at.map();
    let (space, x) = S::through(&map).unwrap();
    let again = space.pose(&x);
    prop_assert!((again.centre - map.centre).norm() <= ROUNDING * map.centre.coords.norm());
    prop_assert!((again.linear - map.linear).norm() <= ROUNDING * map.linear.norm());
    prop_assert_eq!([x[0], x[1]], [map.centre.x, map.centre.y]);
    Ok(())
}

fn check_ribbon<const D: usize>(full: &RibbonVector, measure: &BandMeasure) -> TestCaseResult {
    let space = Ribbon::<D>::about(full, measure).unwrap();
    let x = Ribbon::<D>::free(full);
    prop_assert_eq!(space.full(&x), *full);
    let moved = x + SVector::<f64, D>::repeat(0.25);
    let mut expected = *full;
    for i in 0..D {
        expected[i] = moved[i];
    }
    prop_assert_eq!(space.full(&moved), expected);
    check_jacobians(&space, &x, pistol(measure.side))
}

proptest! {
    #![proptest_config(config())]

    #[test]
    fn planar_spaces(frozen in parts(), at in parts(), scale in prop_oneof![Just(0.01), 0.1..4.0]) {
        check_planar::<Translation, 2>(&frozen, &at, scale)?;
        check_planar::<Rigid, 3>(&frozen, &at, scale)?;
        check_planar::<RigidShear, 4>(&frozen, &at, scale)?;
        check_planar::<Similarity, 4>(&frozen, &at, scale)?;
        check_planar::<SimilarityShear, 5>(&frozen, &at, scale)?;
        check_planar::<Affine, 6>(&frozen, &at, scale)?;
    }

    #[test]
    fn band_spaces((full, measure) in ribbons()) {
        check_ribbon::<2>(&full, &measure)?;
        check_ribbon::<3>(&full, &measure)?;
        check_ribbon::<4>(&full, &measure)?;
        check_ribbon::<5>(&full, &measure)?;
        check_ribbon::<RIBBON_DOF>(&full, &measure)?;
    }

    #[test]
    fn a_space_moves_only_what_it_frees(frozen in parts(), at in parts(), scale in 0.1..4.0) {
        let parts = |map: &AffineMap| map.decompose().unwrap();
        let (then, rest) = (parts(&frozen.map()), Matrix2::zeros());
        let size = frozen.alpha + frozen.beta + frozen.kappa.abs();
        let close = |a: f64, b: f64| (a - b).abs() <= ROUNDING * size.max(scale * size);

        let (space, x) = member::<Translation, 2>(&frozen, &at, scale);
        prop_assert_eq!(space.pose(&x).linear - frozen.map().linear, rest);

        let (space, x) = member::<Rigid, 3>(&frozen, &at, scale);
        let now = parts(&space.pose(&x));
        prop_assert!(close(now.size.alpha, then.size.alpha) && close(now.size.beta, then.size.beta));
        prop_assert!(close(now.kappa, then.kappa));

        let (space, x) = member::<RigidShear, 4>(&frozen, &at, scale);
        let now = parts(&space.pose(&x));
        prop_assert!(close(now.size.alpha, then.size.alpha) && close(now.size.beta, then.size.beta));

        let (space, x) = member::<Similarity, 4>(&frozen, &at, scale);
        let now = parts(&space.pose(&x));
        prop_assert!(close(now.size.alpha, scale * then.size.alpha));
        prop_assert!(close(now.size.beta, scale * then.size.beta));
        prop_assert!(close(now.kappa, scale * then.kappa));

        let (space, x) = member::<SimilarityShear, 5>(&frozen, &at, scale);
        let now = parts(&space.pose(&x));
        prop_assert!(close(now.size.alpha, scale * then.size.alpha));
        prop_assert!(close(now.size.beta, scale * then.size.beta));
    }

    #[test]
    fn decompose_recovers_the_parts(parts in parts()) {
        let found = parts.map().decompose().unwrap();
        let size = parts.alpha + parts.beta + parts.kappa.abs();
        prop_assert!((found.size.alpha - parts.alpha).abs() < ROUNDING * size);
        prop_assert!((found.size.beta - parts.beta).abs() < ROUNDING * size);
        prop_assert!((found.kappa - parts.kappa).abs() < ROUNDING * size);
        let off = (found.angle_rad - parts.angle_rad) / (2.0 * PI);
        prop_assert!((off - off.round()).abs() < ROUNDING);
        prop_assert!(found.angle_rad > -PI - ROUNDING && found.angle_rad <= PI);
    }

    #[test]
    fn the_shear_preserves_axis_and_flanks(parts in parts(), lean in -3.0..3.0_f64) {
        let (space, mut x) = RigidShear::through(&parts.map()).unwrap();
        let upright = space.pose(&x);
        x[3] += lean * parts.beta;
        let leaning = space.pose(&x);
        let (axis, sheared) = (upright.axis(), leaning.axis());
        let size = parts.alpha + parts.beta + parts.kappa.abs() + parts.centre.coords.norm();
        prop_assert!(turn(&axis, &sheared).abs() < ROUNDING);
        prop_assert_eq!(axis.anchor, sheared.anchor);
        prop_assert!((axis.tip - sheared.tip).norm() < ROUNDING * size);
        for q in [-0.115, 0.0, 0.115, 0.8] {
            for p in [-0.3, 0.4] {
                let at = |map: &AffineMap| (map.transform(&Point2::new(p, q)) - axis.anchor).dot(&axis.normal());
                prop_assert!((at(&upright) - q * parts.beta).abs() < 1e-9 * size);
                prop_assert!((at(&leaning) - q * parts.beta).abs() < 1e-9 * size);
            }
        }
        // The shear moves the thumb along the finger, in proportion to its distance from the axis.
        let thumb = Point2::new(-0.3, 0.7);
        let moved: Vector2<f64> = leaning.transform(&thumb) - upright.transform(&thumb);
        let expected = axis.direction() * (0.7 * lean * parts.beta);
        prop_assert!((moved - expected).norm() < 1e-9 * size);
    }

    #[test]
    fn planar_normals_are_unit_outward_and_perpendicular_to_the_contour(parts in parts(), side in prop_oneof![Just(-1.0), Just(1.0)]) {
        let map = parts.map();
        let back = map.linear.try_inverse().unwrap();
        for s in pistol(side) {
            let placed = map.place(s);
            prop_assert_eq!(placed.position, map.transform(&s.position));
            prop_assert!((placed.normal.norm() - 1.0).abs() < ROUNDING);
            let tangent = (map.linear * Vector2::new(-s.normal.y, s.normal.x)).normalize();
            // A thumb that lies on the finger makes the map ill-conditioned.
            let condition = map.linear.norm() * back.norm();
            prop_assert!(placed.normal.dot(&tangent).abs() < ROUNDING * condition);
            prop_assert!((back * placed.normal).dot(&s.normal) > 0.0);
        }
    }

    #[test]
    fn the_tip_of_the_band_is_the_apex_of_its_round_end((full, measure) in ribbons()) {
        let pose = Ribbon::<RIBBON_DOF>::about(&full, &measure).unwrap().pose(&full);
        let (axis, end) = (pose.axis(), measure.round_end_px);
        prop_assert_eq!(axis.anchor, Point2::new(full[0], full[1]));
        let apex = axis.anchor + axis.direction() * (end + full[3] + full[4] * end);
        prop_assert!((axis.tip - apex).norm() < 1e-9);
        prop_assert!((axis.direction() - Vector2::new(full[2].cos(), full[2].sin())).norm() < ROUNDING);
    }

    #[test]
    fn band_normals_are_unit_and_outward((full, measure) in ribbons()) {
        let pose = Ribbon::<RIBBON_DOF>::about(&full, &measure).unwrap().pose(&full);
        for s in pistol(measure.side) {
            let placed = pose.place(s);
            prop_assert!((placed.normal.norm() - 1.0).abs() < ROUNDING);
            // The sample is at one half-width from its point on the spine.
            let (spine, half_width) = spine_point(&full, measure.length_px, s);
            let expected = spine + placed.normal * half_width;
            prop_assert!((placed.position - expected).norm() < 1e-9 * (1.0 + expected.coords.norm()));
        }
    }

    #[test]
    fn the_axis_is_independent_of_full_rotations(
        anchor in centres(), angle_rad in angles(), turns in -3..4_i32, ahead_px in 1.0..500.0,
    ) {
        let axis = Axis::of_finger(anchor, angle_rad, ahead_px);
        prop_assert!(axis.angle_rad > -PI - ROUNDING && axis.angle_rad <= PI);
        prop_assert!(axis.direction().dot(&axis.normal()).abs() < ROUNDING);
        prop_assert!((axis.direction().perp(&axis.normal()) - 1.0).abs() < ROUNDING);
        let tip = anchor + axis.direction() * ahead_px;
        prop_assert!((axis.tip - tip).norm() < 1e-9);
        let again = Axis::of_finger(anchor, angle_rad + f64::from(turns) * 2.0 * PI, ahead_px);
        prop_assert!(turn(&axis, &again).abs() < ROUNDING * 10.0);
    }

    #[test]
    fn upright_maps_place_the_tip_at_the_given_point(tip in centres(), angle_rad in angles(), length_px in 0.5..500.0) {
        let axis = AffineMap::upright(tip, angle_rad, length_px).unwrap().axis();
        prop_assert!((axis.tip - tip).norm() < 1e-9);
        prop_assert!((axis.direction() - Vector2::new(angle_rad.cos(), angle_rad.sin())).norm() < ROUNDING);
        prop_assert!(((axis.tip - axis.anchor).norm() - HALF_LENGTH * length_px).abs() < 1e-9);
    }
}

/// A sample's point on the spine of its limb, and the half-width there.
fn spine_point(x: &RibbonVector, length_px: f64, s: &TemplateSample) -> (Point2<f64>, f64) {
    let e = Vector2::new(x[2].cos(), x[2].sin());
    let centre = Point2::new(x[0], x[1]);
    match s.limb {
        Limb::Finger => {
            let along_px = s.along * length_px;
            (centre + e * along_px, x[3] + x[4] * along_px)
        }
        Limb::Thumb => (centre + e * x[5] + Vector2::new(x[6], x[7]) * s.along, x[8]),
    }
}

fn ribbon_at_rest(
    thumb: Thumb,
    map: &AffineMap,
) -> (RibbonVector, RibbonPose, Vec<TemplateSample>) {
    let template = Template::pistol(thumb).unwrap();
    let proportions = template.proportions().unwrap();
    let x = ribbon_of(proportions, map);
    let measure = BandMeasure::of(proportions, map.linear.column(0).norm());
    let pose = Ribbon::<RIBBON_DOF>::about(&x, &measure).unwrap().pose(&x);
    (x, pose, template.samples(300).unwrap())
}

#[test]
fn the_undeformed_band_template_is_the_pistol() {
    // Deviation of the pistol's spline from its bands, in finger lengths.
    const OUTLINE_TOLERANCE: f64 = 0.002;
    let length_px = 90.0;
    let map = AffineMap::upright(Point2::new(200.0, 150.0), 2.1, length_px).unwrap();
    for thumb in [Thumb::Left, Thumb::Right, Thumb::None] {
        let (_, pose, samples) = ribbon_at_rest(thumb, &map);
        let (a, b) = (map.axis(), pose.axis());
        assert!((a.anchor - b.anchor).norm() < 1e-9 && (a.tip - b.tip).norm() < 1e-9);
        assert!(turn(&a, &b).abs() < ROUNDING);
        for s in &samples {
            let (planar, band) = (map.place(s), pose.place(s));
            let distance = (planar.position - band.position).norm() / length_px;
            assert!(distance < OUTLINE_TOLERANCE, "{thumb:?} {s:?}");
            assert!(planar.normal.dot(&band.normal) > 0.97, "{thumb:?} {s:?}");
            assert!(!map.is_hidden(s, &planar));
        }
    }
}

#[test]
fn band_normals_are_perpendicular_to_the_contour_of_an_untapered_hand() {
    // Direction error of the chord between a sample's neighbours at the start of a round tip.
    const CHORD_TOLERANCE: f64 = 0.02;
    let map = AffineMap::upright(Point2::new(200.0, 150.0), -0.7, 90.0).unwrap();
    for thumb in [Thumb::Left, Thumb::Right, Thumb::None] {
        let (_, pose, samples) = ribbon_at_rest(thumb, &map);
        for [before, at, after] in samples.windows(3).filter_map(|w| <[_; 3]>::try_from(w).ok()) {
            if before.limb == after.limb {
                let chord = pose.place(&after).position - pose.place(&before).position;
                let along = pose.place(&at).normal.dot(&chord.normalize()).abs();
                assert!(along < CHORD_TOLERANCE, "{along} at {at:?}");
            }
        }
    }
}

#[test]
fn samples_inside_the_other_limb_are_hidden() {
    let map = AffineMap::upright(Point2::new(150.0, 100.0), 0.0, 100.0).unwrap();
    for (thumb, side) in [(Thumb::Left, -1.0), (Thumb::Right, 1.0)] {
        let (mut x, _, samples) = ribbon_at_rest(thumb, &map);
        // A perpendicular thumb with its root in the middle of the finger.
        let (root, w, w2) = (10.0, 20.0, x[8]);
        (x[3], x[5], x[6], x[7]) = (w, root, 0.0, side * 70.0);
        let measure = BandMeasure { length_px: 100.0, round_end_px: 30.0, side };
        let pose = Ribbon::<RIBBON_DOF>::about(&x, &measure).unwrap().pose(&x);
        let mut hidden = [0, 0];
        for s in &samples {
            let placed = pose.place(s);
            let d = placed.position - Point2::new(x[0], x[1]);
            let inside = match s.limb {
                Limb::Finger => (d.x - root).abs() < w2 && d.y * side > 0.0,
                Limb::Thumb => d.y.abs() < w,
            };
            assert_eq!(pose.is_hidden(s, &placed), inside, "{s:?} at {d}");
            hidden[usize::from(s.limb == Limb::Thumb)] += usize::from(inside);
        }
        assert!(hidden.iter().all(|&n| n > 2), "{hidden:?}");
    }
}

#[test]
fn at_rest_only_the_crotch_may_hide() {
    let map = AffineMap::upright(Point2::new(150.0, 100.0), 1.0, 100.0).unwrap();
    for thumb in [Thumb::Left, Thumb::Right, Thumb::None] {
        let (_, pose, samples) = ribbon_at_rest(thumb, &map);
        let crotch = samples.iter().position(|s| s.limb == Limb::Thumb).unwrap_or(samples.len());
        for (i, s) in samples.iter().enumerate() {
            if pose.is_hidden(s, &pose.place(s)) {
                assert!(i.abs_diff(crotch) < 4, "{thumb:?} {s:?}");
            }
        }
    }
}

#[test]
fn a_hand_without_a_thumb_hides_nothing() {
    let map = AffineMap::upright(Point2::new(150.0, 100.0), 1.0, 100.0).unwrap();
    let (x, pose, samples) = ribbon_at_rest(Thumb::None, &map);
    assert_eq!(x.fixed_rows::<4>(5), SMatrix::<f64, 4, 1>::zeros());
    assert!(samples.iter().all(|s| !pose.is_hidden(s, &pose.place(s))));
}

#[test]
fn a_map_that_mirrors_or_flattens_is_refused() {
    let map = |linear| AffineMap { centre: Point2::origin(), linear };
    let refused = |linear: Matrix2<f64>| {
        let map = map(linear);
        let error = map.decompose().unwrap_err();
        // Nor is there a space through it.
        assert!(Translation::through(&map).is_err() && Rigid::through(&map).is_err());
        assert!(RigidShear::through(&map).is_err() && Similarity::through(&map).is_err());
        assert!(SimilarityShear::through(&map).is_err() && Affine::through(&map).is_err());
        error
    };
    for linear in [
        Matrix2::new(50.0, 0.0, 0.0, -50.0),
        Matrix2::new(0.0, 50.0, 50.0, 0.0),
        Matrix2::new(50.0, 100.0, 0.0, 0.0),
    ] {
        let error = refused(linear);
        assert!(
            matches!(error, Error::OutOfRange { what: "scale across the finger β [px]", value, .. } if value <= 0.0),
            "{error}"
        );
    }
    assert!(matches!(
        refused(Matrix2::new(0.0, 1.0, 0.0, 1.0)),
        Error::OutOfRange { what: "finger scale α [px]", value: 0.0, .. }
    ));
    for i in 0..4 {
        for value in [f64::NAN, f64::INFINITY] {
            let mut linear = Matrix2::identity() * 50.0;
            linear[i] = value;
            assert!(matches!(refused(linear), Error::NotFinite { .. }), "{linear}");
        }
    }
}

#[test]
fn a_non_finite_start_is_refused() {
    let upright = |u, v, angle, length| {
        AffineMap::upright(Point2::new(u, v), angle, length).unwrap_err().to_string()
    };
    assert!(upright(f64::NAN, 0.0, 0.0, 1.0).starts_with("tip u [px] is NaN"));
    assert!(upright(0.0, f64::INFINITY, 0.0, 1.0).starts_with("tip v [px] is inf"));
    assert!(upright(0.0, 0.0, f64::NAN, 1.0).starts_with("angle [rad] is NaN"));
    assert!(upright(0.0, 0.0, 0.0, f64::NAN).starts_with("finger length [px] is NaN"));
    assert!(
        upright(0.0, 0.0, 0.0, 0.0).starts_with("finger length [px] is 0; it must be positive")
    );
    assert!(upright(0.0, 0.0, 0.0, -3.5).starts_with("finger length [px] is -3.5"));
}

#[test]
fn a_non_finite_band_template_is_refused() {
    let proportions = Proportions::usual(Thumb::Left);
    let hand = ribbon_of(&proportions, &AffineMap::upright(Point2::origin(), 0.0, 50.0).unwrap());
    let measure = BandMeasure::of(&proportions, 50.0);
    assert!(Ribbon::<RIBBON_DOF>::about(&hand, &measure).is_ok());
    for i in 0..RIBBON_DOF {
        let mut broken = hand;
        broken[i] = f64::NAN;
        let error = Ribbon::<RIBBON_DOF>::about(&broken, &measure).unwrap_err();
        assert!(matches!(error, Error::NotFinite { what: "band template", .. }), "{error}");
    }
    for length_px in [0.0, -1.0] {
        let error = Ribbon::<2>::about(&hand, &BandMeasure { length_px, ..measure }).unwrap_err();
        assert!(matches!(error, Error::OutOfRange { value, .. } if value == length_px), "{error}");
    }
    for broken in [
        BandMeasure { length_px: f64::NAN, ..measure },
        BandMeasure { round_end_px: f64::INFINITY, ..measure },
    ] {
        let error = Ribbon::<2>::about(&hand, &broken).unwrap_err();
        assert!(matches!(error, Error::NotFinite { .. }), "{error}");
    }
}

#[test]
fn the_measure_is_that_of_the_template() {
    for (thumb, side) in [(Thumb::Left, -1.0), (Thumb::Right, 1.0), (Thumb::None, 0.0)] {
        let measure = BandMeasure::of(&Proportions::usual(thumb), 200.0);
        assert_eq!((measure.length_px, measure.side), (200.0, side));
        assert!((measure.round_end_px - 77.0).abs() < ROUNDING, "(½ − 0.115) · 200");
        assert_eq!(measure.with_thumb(true), measure);
        assert_eq!(measure.with_thumb(false), BandMeasure { side: 0.0, ..measure });
    }
}

#[test]
fn the_first_components_have_the_same_names_everywhere() {
    fn names<S: ShapeSpace<D>, const D: usize>() -> [&'static str; D] {
        assert_eq!(S::NAMES[..2], ["c_u [px]", "c_v [px]"]);
        assert!(S::NAMES.iter().all(|name| name.ends_with(']')), "a unit each");
        S::NAMES
    }
    names::<Translation, 2>();
    names::<Similarity, 4>();
    names::<SimilarityShear, 5>();
    names::<Affine, 6>();
    assert_eq!(names::<Rigid, 3>()[2], "theta [rad]");
    assert_eq!(names::<RigidShear, 4>()[2], "theta [rad]");
    let whole = names::<Ribbon<RIBBON_DOF>, RIBBON_DOF>();
    assert_eq!(names::<Ribbon<2>, 2>(), whole[..2]);
    assert_eq!(names::<Ribbon<3>, 3>(), whole[..3]);
    assert_eq!(names::<Ribbon<5>, 5>(), whole[..5]);
}
