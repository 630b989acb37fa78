//! The filter compared with a dense implementation, simulated random walks, and tables.

use crate::common::Noise;
use fingerpost_core::Error;
use fingerpost_core::nalgebra::{
    Cholesky, DMatrix, DVector, Matrix1, SMatrix, Vector1, Vector2, Vector4,
};
use fingerpost_core::solve::dynamics::{
    Component, Course, Domain, Dynamics, Expectation, Gate, Innovation, Prediction,
    acceleration_density, chi_square_quantile,
};
use proptest::prelude::*;
use proptest::test_runner::{Config, RngSeed};
use std::f64::consts::PI;

const D: usize = 4;
type X = Vector4<f64>;
type P = SMatrix<f64, D, D>;

const LONGEST_GAP_S: f64 = 0.5;

/// Rounding of products and one inverse of 8 × 8 matrices with entries over eight decades.
const TOLERANCE: f64 = 1e-9;

fn config(cases: u32) -> Config {
    Config {
        cases,
        rng_seed: RngSeed::Fixed(0x6479_6e61),
        failure_persistence: None,
        ..Config::default()
    }
}

fn velocity(density: f64, first_sigma: f64, domain: Domain) -> Component {
    Component { course: Course::Velocity { density, first_sigma }, domain }
}

/// Centre, angle and a drifting width: px, px, rad, px.
fn hand() -> [Component; D] {
    let centre = velocity(2e5, 400.0, Domain::Line);
    let walk = Component { course: Course::Walk { density: 3.0 }, domain: Domain::Line };
    [centre, centre, velocity(40.0, 3.0, Domain::Circle), walk]
}

/// A well-conditioned covariance with approximately the given standard deviations.
fn covariance(sigmas: &X, noise: &mut Noise) -> P {
    let mixed = P::identity() + P::from_fn(|_, _| 0.3 * noise.normal());
    let scaled = P::from_diagonal(sigmas) * mixed;
    scaled * scaled.transpose()
}

const SEEN: X = X::new(0.3, 0.5, 0.01, 0.2);

/// The same filter in textbook form: one state of twice the size, process noise integrated
/// numerically, gain and update with full inverses.
struct Dense {
    components: [Component; D],
    time_s: f64,
    x: DVector<f64>,
    p: DMatrix<f64>,
}

impl Dense {
    fn start(components: [Component; D], time_s: f64, x: &X, r: &P) -> Self {
        let mut p = DMatrix::zeros(2 * D, 2 * D);
        p.view_mut((0, 0), (D, D)).copy_from(r);
        for (i, c) in components.iter().enumerate() {
            if let Course::Velocity { first_sigma, .. } = c.course {
                p[(D + i, D + i)] = first_sigma * first_sigma;
            }
        }
        let mut state = DVector::zeros(2 * D);
        state.rows_mut(0, D).copy_from(x);
        Self { components, time_s, x: state, p }
    }

    fn transition(t: f64) -> DMatrix<f64> {
        let mut f = DMatrix::identity(2 * D, 2 * D);
        for i in 0..D {
            f[(i, D + i)] = t;
        }
        f
    }

    /// ∫ F(s) L Lᵀ F(s)ᵀ ds over the interval; the integrand is quadratic, so Simpson's rule is
    /// exact.
    fn noise(&self, t: f64) -> DMatrix<f64> {
        let mut density = DMatrix::zeros(2 * D, 2 * D);
        for (i, c) in self.components.iter().enumerate() {
            match c.course {
                Course::Velocity { density: q, .. } => density[(D + i, D + i)] = q,
                Course::Walk { density: q } => density[(i, i)] = q,
            }
        }
        let at = |s: f64| Self::transition(s) * &density * Self::transition(s).transpose();
        (at(0.0) + at(t / 2.0) * 4.0 + at(t)) * (t / 6.0)
    }

    fn advance(&mut self, time_s: f64) {
        let t = time_s - self.time_s;
        let f = Self::transition(t);
        self.p = &f * &self.p * f.transpose() + self.noise(t);
        self.x = f * &self.x;
        self.x[2] = self.x[2].sin().atan2(self.x[2].cos());
        self.time_s = time_s;
    }

    fn update(&mut self, time_s: f64, x: &X, r: &P) -> (DVector<f64>, DMatrix<f64>, f64) {
        self.advance(time_s);
        let h = DMatrix::identity(D, 2 * D);
        let r = DMatrix::from_column_slice(D, D, r.as_slice());
        let mut nu = DVector::from_column_slice(x.as_slice()) - &h * &self.x;
        nu[2] = nu[2].sin().atan2(nu[2].cos());
        let s = &h * &self.p * h.transpose() + r;
        let inverse = s.clone().try_inverse().unwrap();
        let k = &self.p * h.transpose() * &inverse;
        self.x += &k * &nu;
        self.p = (DMatrix::identity(2 * D, 2 * D) - &k * h) * &self.p;
        let nis = (nu.transpose() * inverse * &nu)[0];
        (nu, s, nis)
    }
}

fn expected<const N: usize>(dynamics: &Dynamics<N>, time_s: f64) -> Expectation<N> {
    match dynamics.predict(time_s).unwrap() {
        Prediction::Expected(expectation) => expectation,
        Prediction::Lost { gap_s } => unreachable!("lost after {gap_s} s"),
    }
}

fn agree<'a>(
    ours: impl IntoIterator<Item = &'a f64>,
    theirs: impl IntoIterator<Item = &'a f64>,
    scale: f64,
) -> bool {
    ours.into_iter().zip(theirs).all(|(a, b)| (a - b).abs() <= TOLERANCE * scale)
}

#[test]
fn it_agrees_with_a_dense_filter() {
    let mut noise = Noise::new(0x6465_6e73);
    for _ in 0..40 {
        let start = X::new(200.0, 150.0, 0.2, 12.0);
        let r = covariance(&SEEN, &mut noise);
        let mut dynamics = Dynamics::start(hand(), LONGEST_GAP_S, 3.0, &start, &r).unwrap();
        let mut dense = Dense::start(hand(), 3.0, &start, &r);
        let mut time_s = 3.0;
        for k in 0..25 {
            time_s += if k % 7 == 3 { 0.0 } else { noise.between(0.001, 0.2) };
            let expectation = expected(&dynamics, time_s);
            let x = expectation.vector + X::from_fn(|i, _| 3.0 * SEEN[i] * noise.normal());
            let r = covariance(&SEEN, &mut noise);
            dense.advance(time_s);
            let p = dense.p.view((0, 0), (D, D)).into_owned();
            assert!(agree(&expectation.vector, dense.x.rows(0, D).iter(), 400.0), "frame {k}");
            assert!(agree(&expectation.covariance, &p, p.amax()), "frame {k}");

            let innovation = dynamics.update(time_s, &x, &r).unwrap().unwrap();
            let (nu, s, nis) = dense.update(time_s, &x, &r);
            assert!(agree(&innovation.vector, &nu, 400.0), "frame {k}");
            assert!(agree(&innovation.covariance, &s, s.amax()), "frame {k}");
            assert!((innovation.normalised_square() / nis - 1.0).abs() < 1e-6, "frame {k}");
            let speed = dense.x.rows(D, D).amax();
            assert!(agree(dynamics.velocity(), dense.x.rows(D, D).iter(), 1.0 + speed));
            assert_eq!((dynamics.time_s(), dynamics.velocity()[3]), (time_s, 0.0));
        }
    }
}

#[test]
fn an_interval_is_the_sum_of_its_parts() {
    // One step of the filter equals many small steps of the dense one.
    let mut noise = Noise::new(0x7061_7274);
    for parts in [1, 2, 3, 10, 37] {
        let (start, r) = (X::new(10.0, 20.0, -1.0, 5.0), covariance(&SEEN, &mut noise));
        let mut dynamics = Dynamics::start(hand(), LONGEST_GAP_S, 0.0, &start, &r).unwrap();
        let mut dense = Dense::start(hand(), 0.0, &start, &r);
        let seen = start + X::new(4.0, -3.0, 0.02, 0.1);
        dynamics.update(0.033, &seen, &r).unwrap();
        dense.update(0.033, &seen, &r);
        let mut cuts: Vec<_> = (1..parts).map(|_| noise.between(0.033, 0.4)).collect();
        cuts.sort_by(f64::total_cmp);
        cuts.iter().chain(&[0.4]).for_each(|&cut| dense.advance(cut));
        let whole = expected(&dynamics, 0.4);
        let p = dense.p.view((0, 0), (D, D)).into_owned();
        assert!(agree(&whole.vector, dense.x.rows(0, D).iter(), 100.0), "{parts}");
        assert!(agree(&whole.covariance, &p, p.amax()), "{parts}");
    }
}

/// A simulated hand that obeys the model: white acceleration in small steps.
struct Walker {
    x: X,
    v: X,
}

impl Walker {
    const STEPS: usize = 30;

    fn start(noise: &mut Noise) -> Self {
        let v = X::from(hand().map(|c| match c.course {
            Course::Velocity { first_sigma, .. } => first_sigma * noise.normal(),
            Course::Walk { .. } => 0.0,
        }));
        Self { x: X::new(300.0, 200.0, 3.0, 15.0), v }
    }

    fn walk(&mut self, interval_s: f64, noise: &mut Noise) {
        let dt = interval_s / Self::STEPS as f64;
        for _ in 0..Self::STEPS {
            let before = self.v;
            for (i, c) in hand().iter().enumerate() {
                match c.course {
                    Course::Velocity { density, .. } => {
                        self.v[i] += (density * dt).sqrt() * noise.normal();
                    }
                    Course::Walk { density } => self.x[i] += (density * dt).sqrt() * noise.normal(),
                }
            }
            self.x += (before + self.v) * (0.5 * dt);
        }
    }

    fn seen(&self, r: &P, noise: &mut Noise) -> X {
        let factor = Cholesky::new(*r).unwrap().l();
        self.x + factor * X::from_fn(|_, _| noise.normal())
    }
}

#[test]
fn the_covariances_are_consistent() {
    // The normalised squares of innovations and errors are D on average, in runs with irregular
    // frame times, some of them equal. The innovations of a run are independent; of its errors,
    // only the last is used.
    const RUNS: usize = 1500;
    const FRAMES: usize = 8;
    let mut noise = Noise::new(0x6e65_6573);
    let (mut nis, mut nees_fitted, mut nees_predicted) = (0.0, 0.0, 0.0);
    let mut within = 0;
    let limit = chi_square_quantile(0.99, D).unwrap();
    let nees = |e: &Expectation<D>, truth: &X| {
        let mut error = truth - e.vector;
        error[2] = error[2].sin().atan2(error[2].cos());
        error.dot(&Cholesky::new(e.covariance).unwrap().solve(&error))
    };
    for _ in 0..RUNS {
        let mut walker = Walker::start(&mut noise);
        let r = covariance(&SEEN, &mut noise);
        let first = walker.seen(&r, &mut noise);
        let mut dynamics = Dynamics::start(hand(), LONGEST_GAP_S, 0.0, &first, &r).unwrap();
        let mut time_s = 0.0;
        for k in 0..FRAMES {
            let interval_s = if k == 4 { 0.0 } else { noise.between(0.004, 0.1) };
            walker.walk(interval_s, &mut noise);
            time_s += interval_s;
            let r = covariance(&SEEN, &mut noise);
            let innovation =
                dynamics.update(time_s, &walker.seen(&r, &mut noise), &r).unwrap().unwrap();
            nis += innovation.normalised_square();
            within += usize::from(innovation.normalised_square() < limit);
        }
        nees_fitted += nees(&expected(&dynamics, time_s), &walker.x);
        walker.walk(0.05, &mut noise);
        nees_predicted += nees(&expected(&dynamics, time_s + 0.05), &walker.x);
    }
    // Four standard deviations of a mean of n variables χ²(D).
    let bound = |n: usize| 4.0 * (2.0 * D as f64 / n as f64).sqrt();
    let (runs, frames) = (RUNS as f64, (RUNS * FRAMES) as f64);
    assert!((nis / frames - D as f64).abs() < bound(RUNS * FRAMES), "{}", nis / frames);
    assert!((nees_fitted / runs - D as f64).abs() < bound(RUNS), "{}", nees_fitted / runs);
    assert!((nees_predicted / runs - D as f64).abs() < bound(RUNS), "{}", nees_predicted / runs);
    let part = within as f64 / frames;
    assert!((part - 0.99).abs() < 4.0 * (0.99 * 0.01 / frames).sqrt(), "{part}");
}

#[test]
fn the_gate_keeps_the_stated_fraction_of_edges() {
    const EDGES: usize = 40_000;
    let mut noise = Noise::new(0x6761_7465);
    for confidence in [0.5, 0.9, 0.99, 0.999] {
        let gate = Gate::new(confidence, 1e-9, 1e9).unwrap();
        let mut kept = 0.0;
        for _ in 0..EDGES / 40 {
            let expectation = Expectation {
                vector: X::zeros(),
                covariance: covariance(&X::new(3.0, 2.0, 0.05, 0.5), &mut noise),
            };
            let factor = Cholesky::new(expectation.covariance).unwrap().l();
            let row = X::new(noise.normal(), noise.normal(), 40.0 * noise.normal(), 1.0);
            let sigma_px = noise.between(0.05, 2.0);
            let length_px = expectation.search_length(&row, sigma_px * sigma_px, &gate);
            for _ in 0..40 {
                let moved = factor * X::from_fn(|_, _| noise.normal());
                let offset_px = row.dot(&moved) + sigma_px * noise.normal();
                kept += f64::from(offset_px.abs() < length_px);
            }
        }
        let part = kept / EDGES as f64;
        let sigma = (confidence * (1.0 - confidence) / EDGES as f64).sqrt();
        assert!((part - confidence).abs() < 4.0 * sigma, "{part} of {confidence}");
    }
}

#[test]
fn search_lines_stay_within_their_limits() {
    let gate = Gate::new(0.9973, 5.0, 30.0).unwrap();
    assert!((gate.sigmas() - 3.0).abs() < 1e-4);
    let length = |sigma_px: f64| {
        let covariance = Matrix1::new(sigma_px * sigma_px);
        Expectation { vector: Vector1::zeros(), covariance }.search_length(
            &Vector1::new(1.0),
            0.0,
            &gate,
        )
    };
    assert_eq!([0.0, 1.0, 1e3, 1e150].map(length), [5.0, 5.0, 30.0, 30.0]);
    assert!((length(4.0) - 4.0 * gate.sigmas()).abs() < 1e-12);
    for (confidence, shortest_px, longest_px) in [
        (0.4, 1.0, 2.0),
        (1.0, 1.0, 2.0),
        (f64::NAN, 1.0, 2.0),
        (0.9, 0.0, 2.0),
        (0.9, 3.0, 2.0),
        (0.9, 1.0, f64::INFINITY),
    ] {
        assert!(Gate::new(confidence, shortest_px, longest_px).is_err());
    }
}

#[test]
fn a_uniform_motion_is_recovered() {
    // Without noise, the velocity and the prediction are exact at any frame times.
    let (centre, turn) = (Vector2::new(350.0, -210.0), 4.0);
    let at = |t: f64| X::new(100.0 + centre.x * t, 300.0 + centre.y * t, 0.3 + turn * t, 14.0);
    let r = P::identity() * 1e-6;
    let mut dynamics = Dynamics::start(hand(), LONGEST_GAP_S, 0.0, &at(0.0), &r).unwrap();
    let mut noise = Noise::new(0x7374_6561);
    let mut time_s = 0.0;
    for _ in 0..20 {
        time_s += noise.between(0.005, 0.1);
        dynamics.update(time_s, &at(time_s), &r).unwrap();
    }
    let velocity = X::new(centre.x, centre.y, turn, 0.0);
    assert!((dynamics.velocity() - velocity).amax() < 1e-2, "{}", dynamics.velocity());
    let ahead = expected(&dynamics, time_s + 0.1).vector - at(time_s + 0.1);
    assert!(ahead.xy().norm() < 1e-2);
    assert!(ahead[2].sin().abs() < 1e-4, "modulo a turn: {ahead}");
}

#[test]
fn a_doubted_velocity_is_the_old_one_or_the_new_one() {
    let r = P::from_diagonal(&SEEN.component_mul(&SEEN));
    let at = |u: f64| X::new(u, 300.0, 0.3, 14.0);
    let mut dynamics = Dynamics::start(hand(), LONGEST_GAP_S, 0.0, &at(100.0), &r).unwrap();
    dynamics.update(0.04, &at(100.0), &r).unwrap();
    let before = *dynamics.velocity();
    dynamics.update(0.08, &at(150.0), &r).unwrap();
    let (jumped, doubting) = (dynamics, dynamics.with_velocity_reset(&before));
    assert!(jumped.velocity().x > 500.0, "{}", jumped.velocity());
    let after_s = 0.04;
    let half = 0.5 * (jumped.velocity() - before);
    let [sure, unsure] = [jumped, doubting].map(|d| expected(&d, 0.08 + after_s));
    assert!((sure.vector - unsure.vector - half * after_s).amax() < TOLERANCE);
    // The spread of two equally likely velocities is half their difference.
    let spread = half * half.transpose() * after_s.powi(2);
    assert!((unsure.covariance - sure.covariance - spread).amax() < 1e-6);
}

#[test]
fn an_additional_uncertainty_increases_the_covariance() {
    let r = P::from_diagonal(&SEEN.component_mul(&SEEN));
    let dynamics = Dynamics::start(hand(), LONGEST_GAP_S, 0.0, &X::zeros(), &r).unwrap();
    let by = X::new(3.0, -4.0, 0.0, 0.0);
    let [sure, unsure] = [dynamics, dynamics.unsure(&by)].map(|d| expected(&d, 0.1));
    assert_eq!(sure.vector, unsure.vector);
    let spread = by * by.transpose();
    assert!((unsure.covariance - sure.covariance - spread).amax() < 1e-9 * spread.amax());
}

#[test]
fn angles_wrap_around() {
    let components = [velocity(10.0, 5.0, Domain::Circle)];
    let r = Matrix1::new(1e-6);
    for turn in [4.0, -4.0] {
        let x = |k: usize| Vector1::new(2.5 * f64::signum(turn) + 0.1 * turn * k as f64);
        let mut dynamics = Dynamics::start(components, 0.5, 0.0, &x(0), &r).unwrap();
        for k in 1..40 {
            let time_s = 0.1 * k as f64;
            // Full rotations in the measurement are no motion.
            let seen = x(k).add_scalar(2.0 * PI * (k % 3) as f64);
            let innovation = dynamics.update(time_s, &seen, &r).unwrap().unwrap();
            assert!(k < 4 || innovation.vector.amax() < 0.01, "{k}: {}", innovation.vector);
            let angle = expected(&dynamics, time_s + 0.1).vector[0];
            assert!(angle > -PI && angle <= PI, "{angle}");
        }
        assert!((dynamics.velocity()[0] - turn).abs() < 0.01, "{}", dynamics.velocity());
    }
    // A half rotation is exactly +π.
    let half = Dynamics::start(components, 0.5, 0.0, &Vector1::new(-PI), &r).unwrap();
    assert_eq!(expected(&half, 0.0).vector[0], PI);
}

#[test]
fn a_long_gap_is_a_loss() {
    let r = P::identity();
    let start = X::new(1.0, 2.0, 0.5, 3.0);
    let mut dynamics = Dynamics::start(hand(), LONGEST_GAP_S, 10.0, &start, &r).unwrap();
    dynamics.update(10.1, &(start + X::new(30.0, 0.0, 0.0, 0.0)), &r).unwrap();
    assert!(matches!(dynamics.predict(10.6).unwrap(), Prediction::Expected(_)));
    for gap_s in [0.75, 1e3, 1e300] {
        let Prediction::Lost { gap_s: reported_s } = dynamics.predict(10.1 + gap_s).unwrap() else {
            unreachable!("after {gap_s} s")
        };
        assert!((reported_s / gap_s - 1.0).abs() < 1e-12);
    }
    // The next measurement is a new start, with its covariance, at rest with unknown velocity.
    let again = X::new(500.0, -20.0, 1.0, 4.0);
    assert_eq!(dynamics.update(20.0, &again, &r).unwrap(), None);
    assert_eq!(dynamics, Dynamics::start(hand(), LONGEST_GAP_S, 20.0, &again, &r).unwrap());
}

#[test]
fn two_measurements_at_one_time_are_averaged() {
    let r = P::identity();
    let start = X::new(1.0, 2.0, 0.5, 3.0);
    let mut dynamics = Dynamics::start(hand(), LONGEST_GAP_S, 1.0, &start, &r).unwrap();
    assert_eq!(expected(&dynamics, 1.0), Expectation { vector: start, covariance: r });
    // Two measurements at one time have twice the information of one.
    let innovation: Innovation<D> = dynamics.update(1.0, &(start * 2.0), &r).unwrap().unwrap();
    assert_eq!((innovation.vector, innovation.covariance), (start, r * 2.0));
    let Expectation { vector, covariance } = expected(&dynamics, 1.0);
    assert!((vector - start * 1.5).amax() < 1e-12 && (covariance - r * 0.5).amax() < 1e-12);
}

#[test]
fn invalid_input_is_refused_without_effect() {
    let (r, x) = (P::identity(), X::new(1.0, 2.0, 0.5, 3.0));
    let mut dynamics = Dynamics::start(hand(), LONGEST_GAP_S, 1.0, &x, &r).unwrap();
    let before = dynamics;
    for time_s in [0.999, f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
        assert!(dynamics.predict(time_s).is_err() && dynamics.update(time_s, &x, &r).is_err());
    }
    assert!(matches!(dynamics.predict(0.5), Err(Error::OutOfRange { value: 0.5, .. })));
    let mut nowhere = x;
    nowhere[2] = f64::NAN;
    assert!(matches!(dynamics.update(2.0, &nowhere, &r), Err(Error::NotFinite { .. })));
    let singular = P::from_diagonal(&X::new(1.0, 1.0, 0.0, 1.0));
    let indefinite = P::from_diagonal(&X::new(1.0, 1.0, -1.0, 1.0));
    for covariance in [singular, indefinite, P::zeros()] {
        let refused = dynamics.update(2.0, &x, &covariance);
        assert!(matches!(refused, Err(Error::NotPositiveDefinite { .. })), "{refused:?}");
        assert!(Dynamics::start(hand(), LONGEST_GAP_S, 1.0, &x, &covariance).is_err());
    }
    assert!(dynamics.update(2.0, &x, &(r * f64::INFINITY)).is_err());
    assert_eq!(dynamics, before);

    for gap_s in [0.0, -1.0, 61.0, f64::NAN] {
        assert!(Dynamics::start(hand(), gap_s, 1.0, &x, &r).is_err());
    }
    for course in [
        Course::Walk { density: -1.0 },
        Course::Walk { density: f64::NAN },
        Course::Velocity { density: 1e13, first_sigma: 1.0 },
        Course::Velocity { density: 1.0, first_sigma: -1.0 },
    ] {
        let mut components = hand();
        components[1].course = course;
        assert!(Dynamics::start(components, LONGEST_GAP_S, 1.0, &x, &r).is_err(), "{course:?}");
    }
}

#[test]
fn a_density_matches_accelerations_of_finite_duration() {
    // Variance of the velocity after a time much longer than τ, for simulated accelerations that
    // keep their direction for exponentially distributed times of mean τ.
    let (a, lasts_s, interval_s) = (20.0, 0.05, 5.0);
    let mut noise = Noise::new(0x7369_6e67);
    let runs = 4000;
    let sum: f64 = (0..runs)
        .map(|_| {
            let (mut t, mut v) = (0.0, 0.0);
            while t < interval_s {
                let lasts = (-lasts_s * noise.uniform().max(1e-300).ln()).min(interval_s - t);
                v += a * noise.normal() * lasts;
                t += lasts;
            }
            v * v
        })
        .sum();
    let ratio = sum / f64::from(runs) / (acceleration_density(a, lasts_s) * interval_s);
    assert!((ratio - 1.0).abs() < 4.0 * (2.0 / f64::from(runs)).sqrt() + 0.01, "{ratio}");
}

#[test]
fn chi_square_quantiles_of_very_small_probabilities() {
    for probability in [1e-200, 1e-308, f64::MIN_POSITIVE, 5e-324] {
        for degrees in [1, 2, 3, 100] {
            let quantile = chi_square_quantile(probability, degrees).unwrap();
            assert!((0.0..1.0).contains(&quantile), "{probability}, {degrees}: {quantile}");
        }
        // With two degrees of freedom, P(χ² ≤ x) = 1 − e^(−x / 2).
        let quantile = chi_square_quantile(probability, 2).unwrap();
        assert!((quantile - 2.0 * probability).abs() <= 1e-9 * probability + 5e-324);
    }
}

#[test]
#[expect(clippy::unreadable_literal, reason = "the table's digits, as they were printed")]
fn chi_square_quantiles_match_tables() {
    // SciPy 1.17, scipy.stats.chi2.ppf.
    for (probability, degrees, quantile) in [
        (0.95, 1, 3.841458820694124),
        (0.5, 1, 0.454936423119572),
        (0.999999, 1, 23.92812697687947),
        (0.01, 2, 0.020100671707002873),
        (0.95, 2, 5.991464547107979),
        (0.95, 3, 7.814727903251179),
        (0.99, 3, 11.344866730144373),
        (0.999, 9, 27.877164871256568),
        (0.95, 100, 124.34211340400407),
        (0.999999, 100, 182.12677711942618),
        (1e-06, 1, 1.5707963267957187e-12),
        (1e-06, 100, 46.50133071589314),
    ] {
        let ours = chi_square_quantile(probability, degrees).unwrap();
        assert!((ours / quantile - 1.0).abs() < 1e-9, "{ours} for {probability}, {degrees}");
    }
    for (probability, degrees) in [(0.0, 3), (1.0, 3), (f64::NAN, 3), (0.9, 0), (0.9, 101)] {
        assert!(chi_square_quantile(probability, degrees).is_err());
    }
}

/// Frames at random times with small or large covariances, of hands from still to fast.
fn film() -> impl Strategy<Value = ([Component; D], Vec<(f64, f64, u64)>)> {
    let exponent = -6.0..11.0_f64;
    let frame = (prop_oneof![Just(0.0), 1e-9..1e-6, 1e-3..0.49_f64], -10.0..4.0_f64, any::<u64>());
    (prop::array::uniform4((exponent, any::<bool>())), prop::collection::vec(frame, 1..60))
        .prop_map(|(densities, frames)| {
            let components = densities.map(|(exponent, walks)| {
                let density = 10_f64.powf(exponent);
                if walks {
                    Component { course: Course::Walk { density }, domain: Domain::Line }
                } else {
                    velocity(density, density.sqrt(), Domain::Line)
                }
            });
            (components, frames)
        })
}

proptest! {
    #![proptest_config(config(200))]

    #[test]
    fn covariances_stay_positive_semidefinite((components, frames) in film()) {
        let r = |exponent: f64, noise: &mut Noise| {
            covariance(&X::repeat(10_f64.powf(0.5 * exponent)), noise)
        };
        let mut noise = Noise::new(1);
        let start = X::zeros();
        let mut dynamics =
            Dynamics::start(components, LONGEST_GAP_S, 0.0, &start, &r(0.0, &mut noise)).unwrap();
        let mut time_s = 0.0;
        for (interval_s, exponent, seed) in frames {
            let mut noise = Noise::new(seed);
            time_s += interval_s;
            let Expectation { vector, .. } = expected(&dynamics, time_s);
            let x = vector + X::from_fn(|_, _| 10.0 * noise.normal());
            if let Some(i) = dynamics.update(time_s, &x, &r(exponent, &mut noise)).unwrap() {
                prop_assert!(i.normalised_square() >= 0.0);
            }
            for ahead_s in [0.0, 0.01, 0.99 * LONGEST_GAP_S] {
                let Expectation { covariance: p, .. } = expected(&dynamics, time_s + ahead_s);
                prop_assert_eq!(p, p.transpose());
                // Correlation matrix: unit diagonal, no negative eigenvalue.
                let own = p.diagonal().map(|d| 1.0 / d.sqrt());
                prop_assert!(own.iter().all(|s| s.is_finite()), "{}", p);
                let least = p.component_mul(&(own * own.transpose())).symmetric_eigenvalues().min();
                prop_assert!(least > -1e-7, "{} in {}", least, p);
            }
        }
    }
}
