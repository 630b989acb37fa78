//! The solver compared with singular values, explicit normal equations and Monte Carlo.

use crate::common::Noise;
use fingerpost_core::Error;
use fingerpost_core::geometry::planar::{AffineMap, PlanarSpace, Rigid, RigidShear};
use fingerpost_core::geometry::shape_space::Pose;
use fingerpost_core::geometry::template::{Limb, TemplateSample};
use fingerpost_core::nalgebra::{DMatrix, DVector, Matrix2, Point2, SMatrix, SVector, Vector2};
use fingerpost_core::numeric::simd::Isa;
use fingerpost_core::solve::fit::{
    EquationBuffer, FitOptions, FitReport, Fitter, Loss, Outcome, Prior, Solve,
};
use proptest::prelude::*;
use proptest::test_runner::{Config, RngSeed};

/// Normal equations square the condition number of well-scaled rows, a few tens at most.
const TOLERANCE: f64 = 1e-9;

fn config() -> Config {
    Config { rng_seed: RngSeed::Fixed(0x6669_7474), failure_persistence: None, ..Config::default() }
}

/// The plain normal equations.
const PLAIN: FitOptions =
    FitOptions { loss: Loss::None, solve: Solve::Joint, max_iterations: 10, min_scale_px: 0.0 };
const TUKEY: Loss = Loss::Tukey { cutoff: 4.685 };

/// Equations as numbers, for both the solver and the oracle.
#[derive(Debug, Clone)]
struct System<const D: usize> {
    rows: Vec<SVector<f64, D>>,
    offsets_px: Vec<f64>,
    variances_px2: Vec<f64>,
}

impl<const D: usize> System<D> {
    /// Rows of size 1 and variances between 0.01 and 1, offsets that agree on `step`.
    fn exact(n: usize, step: &SVector<f64, D>, random: &mut Noise) -> Self {
        let rows: Vec<SVector<f64, D>> =
            (0..n).map(|_| SVector::from_fn(|_, _| random.normal())).collect();
        let offsets_px = rows.iter().map(|row| row.dot(step)).collect();
        let variances_px2 = (0..n).map(|_| 10_f64.powf(random.between(-2.0, 0.0))).collect();
        Self { rows, offsets_px, variances_px2 }
    }

    /// Adds `factor` standard deviations of noise.
    fn disturb(mut self, factor: f64, random: &mut Noise) -> Self {
        for (offset, variance) in self.offsets_px.iter_mut().zip(&self.variances_px2) {
            *offset += factor * variance.sqrt() * random.normal();
        }
        self
    }

    fn solve(&self, fitter: &mut Fitter, prior: Option<&Prior<D>>) -> FitReport<D> {
        let mut buffer = EquationBuffer::default();
        let mut equations = buffer.clear::<D>();
        for ((row, offset), variance) in
            self.rows.iter().zip(&self.offsets_px).zip(&self.variances_px2)
        {
            equations.push(row, *offset, *variance).unwrap();
        }
        assert_eq!(equations.len(), self.rows.len());
        fitter.solve(&equations, prior)
    }

    fn solve_with(&self, options: FitOptions) -> FitReport<D> {
        self.solve(&mut Fitter::new(options).unwrap(), None)
    }

    /// Weighted least squares by singular values, for the columns `unknowns` only.
    fn oracle(&self, unknowns: std::ops::Range<usize>, offsets_px: &[f64]) -> DVector<f64> {
        let weight = |i: usize| self.variances_px2[i].sqrt().recip();
        let a = DMatrix::from_fn(self.rows.len(), unknowns.len(), |i, j| {
            weight(i) * self.rows[i][unknowns.start + j]
        });
        let b = DVector::from_fn(self.rows.len(), |i, _| weight(i) * offsets_px[i]);
        a.svd(true, true).solve(&b, 1e-12).unwrap()
    }

    fn residuals(&self, step: &SVector<f64, D>) -> Vec<f64> {
        self.rows.iter().zip(&self.offsets_px).map(|(row, offset)| offset - row.dot(step)).collect()
    }

    /// Σ row rowᵀ / variance.
    fn information(&self) -> SMatrix<f64, D, D> {
        self.rows.iter().zip(&self.variances_px2).map(|(row, v)| row * row.transpose() / *v).sum()
    }

    fn chi_squared(&self, step: &SVector<f64, D>) -> f64 {
        self.residuals(step).iter().zip(&self.variances_px2).map(|(r, v)| r * r / v).sum()
    }
}

/// Zero step and covariance.
fn is_silent<const D: usize>(report: &FitReport<D>) -> bool {
    report.step.amax() == 0.0 && report.covariance.amax() == 0.0
}

fn options() -> impl Strategy<Value = FitOptions> {
    let loss = prop_oneof![
        Just(Loss::None),
        Just(TUKEY),
        (1.001..10.0).prop_map(|cutoff| Loss::Tukey { cutoff })
    ];
    let solve = prop_oneof![Just(Solve::Joint), Just(Solve::TwoStage)];
    (loss, solve, 1..12_usize, prop_oneof![Just(0.0), 0.0..1.0]).prop_map(
        |(loss, solve, max_iterations, min_scale_px)| FitOptions {
            loss,
            solve,
            max_iterations,
            min_scale_px,
        },
    )
}

#[test]
fn exact_offsets_give_the_exact_step() {
    fn check<const D: usize>(loss: Loss) {
        let mut random = Noise::new(D as u64);
        let step = SVector::<f64, D>::from_fn(|_, _| random.between(-5.0, 5.0));
        let system = System::exact(6 * D, &step, &mut random);
        let report = system.solve_with(FitOptions { loss, ..PLAIN });
        assert_eq!((report.outcome, report.rank), (Outcome::Determined, D));
        assert!((report.step - step).norm() < TOLERANCE, "{}", report.step);
        assert_eq!((report.equations, report.inliers), (6 * D, 6 * D));
        assert!(report.residual_rms_px < TOLERANCE);
    }
    for loss in [Loss::None, TUKEY] {
        check::<2>(loss);
        check::<3>(loss);
        check::<4>(loss);
        check::<6>(loss);
        check::<9>(loss);
    }
}

proptest! {
    #![proptest_config(config())]

    #[test]
    fn every_instruction_set_gives_the_same_bits(seed in any::<u64>(), n in 0..30_usize, noise in 0.0..20.0) {
        let mut random = Noise::new(seed);
        let truth = SVector::<f64, 6>::from_fn(|_, _| random.between(-3.0, 3.0));
        let system = System::exact(n, &truth, &mut random).disturb(noise, &mut random);
        let solved = |isa| {
            let mut fitter = Fitter::new(FitOptions { loss: TUKEY, ..PLAIN }).unwrap().with_isa(isa);
            let report = system.solve(&mut fitter, None);
            (report, fitter.weights().to_vec(), fitter.residuals().to_vec())
        };
        let reference = solved(Isa::Scalar);
        prop_assert_eq!(reference.2.len(), n);
        for isa in Isa::available() {
            prop_assert_eq!(&solved(isa), &reference, "{}", isa);
        }
    }

    #[test]
    fn plain_least_squares_matches_singular_values(seed in any::<u64>(), n in 8..60_usize, noise in 0.0..20.0) {
        let mut random = Noise::new(seed);
        let truth = SVector::<f64, 6>::from_fn(|_, _| random.between(-3.0, 3.0));
        let system = System::exact(n, &truth, &mut random).disturb(noise, &mut random);
        let mut fitter = Fitter::new(PLAIN).unwrap();
        let report = system.solve(&mut fitter, None);
        let (expected, information) = (system.oracle(0..6, &system.offsets_px), system.information());
        let inverse = information.try_inverse().unwrap();
        // With only a few rows more than unknowns, the condition may be bad.
        let tolerance = 1e-12 * information.norm() * inverse.norm();
        prop_assert_eq!(report.outcome, Outcome::Determined);
        prop_assert!((report.step - SVector::<f64, 6>::from_column_slice(expected.as_slice())).norm() <= tolerance * (1.0 + expected.norm()));
        prop_assert!((report.information - information).norm() <= 1e-12 * information.norm());
        // The variances are accepted unless the residuals are larger.
        let factor = (system.chi_squared(&report.step) / (n - 6) as f64).max(1.0);
        prop_assert!((report.covariance - inverse * factor).norm() <= tolerance * factor * inverse.norm());
        prop_assert_eq!(report.iterations, 1);
        prop_assert_eq!(report.inliers, n);
        let residuals = system.residuals(&report.step);
        for (given, expected) in fitter.residuals().iter().zip(&residuals) {
            prop_assert!((given - expected).abs() < 1e-9);
        }
        prop_assert!(fitter.weights().iter().all(|&w| w == 1.0));
        let rms = (residuals.iter().map(|r| r * r).sum::<f64>() / n as f64).sqrt();
        prop_assert!((report.residual_rms_px - rms).abs() < 1e-9);
    }

    #[test]
    fn a_prior_is_one_more_equation_per_component(seed in any::<u64>(), n in 0..12_usize) {
        const SIGMAS: [f64; 4] = [0.1, 1.0, 3.0, 0.5];
        let mut random = Noise::new(seed);
        let truth = SVector::<f64, 4>::from_fn(|_, _| random.between(-3.0, 3.0));
        let system = System::exact(n, &truth, &mut random).disturb(1.0, &mut random);
        let mean = SVector::<f64, 4>::from_fn(|_, _| random.between(-3.0, 3.0));
        let information = SMatrix::from_diagonal(&SVector::from(SIGMAS.map(|s| 1.0 / (s * s))));
        let report = system.solve(&mut Fitter::new(PLAIN).unwrap(), Some(&Prior { mean, information }));

        let mut with_prior = system.clone();
        for (i, sigma) in SIGMAS.iter().enumerate() {
            with_prior.rows.push(SVector::ith(i, 1.0));
            with_prior.offsets_px.push(mean[i]);
            with_prior.variances_px2.push(sigma * sigma);
        }
        let expected = with_prior.oracle(0..4, &with_prior.offsets_px);
        prop_assert_eq!((report.outcome, report.rank), (Outcome::Determined, 4));
        prop_assert!((report.step - SVector::<f64, 4>::from_column_slice(expected.as_slice())).norm() < 1e-7);
        prop_assert!((report.information - with_prior.information()).norm() < 1e-9 * report.information.norm());
        prop_assert_eq!(report.equations, n);
    }

    #[test]
    fn two_stages_solve_translation_and_then_the_rest(seed in any::<u64>(), n in 10..50_usize) {
        let mut random = Noise::new(seed);
        let truth = SVector::<f64, 5>::from_fn(|_, _| random.between(-3.0, 3.0));
        let system = System::exact(n, &truth, &mut random).disturb(0.3, &mut random);
        let report = system.solve_with(FitOptions { solve: Solve::TwoStage, ..PLAIN });
        let translation = system.oracle(0..2, &system.offsets_px);
        let first = SVector::<f64, 5>::from([translation[0], translation[1], 0.0, 0.0, 0.0]);
        let rest = system.oracle(2..5, &system.residuals(&first));
        let expected = first + SVector::from([0.0, 0.0, rest[0], rest[1], rest[2]]);
        prop_assert_eq!(report.outcome, Outcome::Determined);
        prop_assert!((report.step - expected).norm() < 1e-7, "{} {}", report.step, expected);
    }

    #[test]
    fn any_equations_have_a_report(
        seed in any::<u64>(),
        options in options(),
        n in 0..12_usize,
        scales in prop::array::uniform4(prop_oneof![Just(0.0), Just(1.0), 1e-6..1e6_f64]),
        (repeats, has_prior) in (any::<bool>(), any::<bool>()),
    ) {
        let mut random = Noise::new(seed);
        let mut system = System::<4>::exact(n, &SVector::zeros(), &mut random).disturb(30.0, &mut random);
        for row in &mut system.rows {
            row.component_mul_assign(&SVector::from(scales));
        }
        if repeats && n > 0 {
            let row = system.rows[0];
            system.rows.fill(row);
        }
        let prior = Prior { mean: SVector::repeat(0.5), information: SMatrix::identity() };
        let mut fitter = Fitter::new(options).unwrap();
        let report = system.solve(&mut fitter, has_prior.then_some(&prior));
        prop_assert!(report.iterations <= options.max_iterations);
        prop_assert!(report.rank <= 4 && report.inliers <= n && report.equations == n);
        prop_assert!(fitter.weights().iter().all(|w| (0.0..=1.0).contains(w)));
        prop_assert_eq!((fitter.weights().len(), fitter.residuals().len()), (n, n));
        match report.outcome {
            Outcome::Determined => {
                prop_assert_eq!(report.rank, 4);
                prop_assert!(report.step.iter().chain(&report.covariance).all(|x| x.is_finite()));
                prop_assert!(report.covariance.diagonal().iter().all(|&v| v > 0.0));
            }
            outcome => {
                prop_assert!(report.rank < 4 || outcome == Outcome::TooFewEquations);
                prop_assert_eq!(outcome == Outcome::TooFewEquations, n < 4 && !has_prior);
                prop_assert!(is_silent(&report));
                prop_assert_eq!(report.iterations, 0);
            }
        }
    }
}

#[test]
fn two_stages_equal_the_joint_solve_only_without_correlation() {
    let truth = SVector::<f64, 3>::from([2.0, -1.0, 0.4]);
    let at_right_angles = |n: usize| {
        // Normals around a circle, and a third column that is orthogonal to both.
        let rows = (0..n).map(|i| {
            let angle = std::f64::consts::TAU * i as f64 / n as f64;
            SVector::from([angle.cos(), angle.sin(), (2.0 * angle).sin() * 10.0])
        });
        let rows: Vec<SVector<f64, 3>> = rows.collect();
        let offsets_px = rows.iter().map(|row| row.dot(&truth)).collect();
        System { variances_px2: vec![0.04; n], offsets_px, rows }
    };
    let two_stage = FitOptions { solve: Solve::TwoStage, ..PLAIN };
    let mut system = at_right_angles(24).disturb(1.0, &mut Noise::new(2));
    let (joint, staged) = (system.solve_with(PLAIN), system.solve_with(two_stage));
    assert!((joint.step - staged.step).norm() < TOLERANCE);

    // A rotation about a point beside the contour correlates with translation.
    for row in &mut system.rows {
        row[2] += 8.0 * row[0];
    }
    system.offsets_px = system.rows.iter().map(|row| row.dot(&truth)).collect();
    let (joint, staged) = (system.solve_with(PLAIN), system.solve_with(two_stage));
    assert!((joint.step - truth).norm() < TOLERANCE);
    assert!((staged.step - truth).norm() > 0.5, "{}", staged.step);
    assert!(system.chi_squared(&staged.step) > system.chi_squared(&joint.step) + 1.0);
}

#[test]
fn tukey_ignores_gross_errors_and_plain_least_squares_does_not() {
    const SIGMA: f64 = 0.2;
    let truth = SVector::<f64, 4>::from([3.0, -2.0, 0.5, 1.0]);
    let (n, gross) = (200, 60);
    let mut worst_plain: f64 = 0.0;
    for seed in 0..20 {
        let mut random = Noise::new(0x7475_6b65 + seed);
        let mut system = System::exact(n, &truth, &mut random);
        system.variances_px2.fill(SIGMA * SIGMA);
        let mut system = system.disturb(1.0, &mut random);
        for offset in &mut system.offsets_px[..gross] {
            *offset += random.between(5.0, 25.0);
        }
        let mut fitter = Fitter::new(FitOptions::default()).unwrap();
        let robust = system.solve(&mut fitter, None);
        let error = robust.step - truth;
        // Four standard deviations of the 140 good ones.
        assert!(error.norm() < 4.0 * (4.0 * SIGMA * SIGMA / 140.0).sqrt(), "{seed}: {error}");
        assert!(fitter.weights()[..gross].iter().all(|&w| w == 0.0));
        assert!((n - gross - 6..=n - gross).contains(&robust.inliers), "{}", robust.inliers);
        assert!((0.7..1.3).contains(&(robust.residual_rms_px / SIGMA)));
        worst_plain = worst_plain.max((system.solve_with(PLAIN).step - truth).norm());
    }
    assert!(worst_plain > 1.0, "{worst_plain}");
}

/// Tukey's estimate as the fitter defines it, reweighted until convergence.
fn reweighted<const D: usize>(system: &System<D>) -> (SVector<f64, D>, SMatrix<f64, D, D>) {
    let mean_variance = system.variances_px2.iter().sum::<f64>() / system.rows.len() as f64;
    let mut weights = vec![1.0; system.rows.len()];
    let (mut step, mut information) = (SVector::zeros(), SMatrix::zeros());
    let mut misfit = 0.0;
    for sweep in 0..200 {
        information = SMatrix::zeros();
        let mut right = SVector::<f64, D>::zeros();
        for (i, row) in system.rows.iter().enumerate() {
            let precision = weights[i] / (system.variances_px2[i] + misfit);
            information += precision * row * row.transpose();
            right += precision * system.offsets_px[i] * row;
        }
        step = information.try_inverse().unwrap() * right;
        let residuals = system.residuals(&step);
        let mut sizes: Vec<_> = residuals.iter().map(|r| r.abs()).collect();
        sizes.sort_by(f64::total_cmp);
        let scale = 1.4826 * sizes[sizes.len() / 2];
        misfit = (scale * scale - mean_variance).max(0.0);
        let limit = 4.685 * scale * if sweep == 0 { 3.0 } else { 1.0 };
        for (weight, r) in weights.iter_mut().zip(residuals) {
            *weight = (1.0 - (r / limit).powi(2)).max(0.0).powi(2);
        }
    }
    (step, information)
}

#[test]
fn reweighting_converges_to_a_small_part_of_a_sigma() {
    let mut random = Noise::new(0x7365_7474);
    let (mut sweeps, mut squares) = (0, 0.0);
    for k in 0..200 {
        let truth = SVector::<f64, 5>::from_fn(|_, _| random.between(-3.0, 3.0));
        let mut system = System::exact(60, &truth, &mut random);
        system.variances_px2.fill(0.04);
        let mut system = system.disturb(1.0, &mut random);
        for offset in system.offsets_px.iter_mut().take(k % 10) {
            *offset += random.between(0.5, 10.0);
        }
        let report = system.solve_with(FitOptions { loss: TUKEY, max_iterations: 100, ..PLAIN });
        let (settled, information) = reweighted(&system);
        let left = report.step - settled;
        let sigmas = (left.dot(&(information * left)) / 5.0).sqrt();
        assert!(sigmas < 0.2, "{sigmas} sigma after {} sweeps", report.iterations);
        squares += sigmas * sigmas;
        sweeps += report.iterations;
    }
    // On average a thousandth of the variance, after few sweeps.
    assert!(squares <= 200.0 * 0.001, "{squares}");
    assert!(sweeps <= 200 * 5, "{sweeps} sweeps for 200 fits");
}

#[test]
fn the_residual_scale_is_the_median_deviation() {
    let mut random = Noise::new(5);
    let truth = SVector::<f64, 2>::from([1.0, 2.0]);
    let mut system = System::exact(4001, &truth, &mut random);
    system.variances_px2.fill(0.25);
    let mut system = system.disturb(1.0, &mut random);
    for (k, offset) in system.offsets_px.iter_mut().enumerate() {
        *offset += if k % 20 == 0 { 1000.0 } else { 0.0 };
    }
    // One gross error in twenty hardly changes the median.
    let scale = system.solve_with(FitOptions { loss: TUKEY, ..PLAIN }).residual_scale_px;
    assert!((scale / 0.5 - 1.0).abs() < 0.1, "{scale}");
}

#[test]
fn the_least_scale_is_a_variance_that_all_equations_share() {
    const MISFIT_PX: f64 = 0.7;
    let mut random = Noise::new(0x6c65_6173);
    let mut system = System::exact(40, &SVector::<f64, 3>::repeat(1.0), &mut random);
    system = system.disturb(1.0, &mut random);
    let report = system.solve_with(FitOptions { min_scale_px: MISFIT_PX, ..PLAIN });
    for variance in &mut system.variances_px2 {
        *variance += MISFIT_PX * MISFIT_PX;
    }
    let expected = system.solve_with(PLAIN);
    assert!((report.step - expected.step).norm() < TOLERANCE);
    assert!((report.information - expected.information).norm() < TOLERANCE);
}

#[test]
fn excess_scatter_is_shared_by_all_equations() {
    // Measurements of very different variance of a hand that differs from the template.
    const MISFIT_PX: f64 = 1.0;
    let mut random = Noise::new(0x6d69_7366);
    let mut system = System::exact(400, &SVector::<f64, 3>::repeat(1.0), &mut random);
    for (k, variance) in system.variances_px2.iter_mut().enumerate() {
        *variance = if k % 2 == 0 { 1e-6 } else { 1e-2 };
    }
    for offset in &mut system.offsets_px {
        *offset += MISFIT_PX * random.normal();
    }
    let report = system.solve_with(FitOptions { loss: TUKEY, ..PLAIN });
    system.variances_px2.fill(MISFIT_PX * MISFIT_PX);
    let even = system.solve_with(FitOptions { loss: TUKEY, ..PLAIN });
    let sigma = even.covariance.diagonal().map(f64::sqrt);
    assert!((report.step - even.step).component_div(&sigma).amax() < 0.2);
    assert!(relative_error(&even.covariance, &report.covariance) < 0.2);
}

#[test]
fn a_fit_with_zero_residuals_is_valid() {
    // Every residual is exactly zero, and the minimum scale is zero.
    for loss in [Loss::None, TUKEY] {
        let mut system = System::exact(20, &SVector::<f64, 3>::zeros(), &mut Noise::new(19));
        let report = system.solve_with(FitOptions { loss, ..PLAIN });
        assert_eq!((report.outcome, report.rank), (Outcome::Determined, 3), "{loss:?}");
        assert_eq!(report.step.amax(), 0.0);
        // More than half of the residuals are zero; the others are gross errors.
        system.offsets_px[4] = 5.0;
        let report = system.solve_with(FitOptions { loss, ..PLAIN });
        assert_eq!((report.outcome, report.rank), (Outcome::Determined, 3), "{loss:?}");
    }
}

#[test]
fn small_residuals_do_not_shrink_the_covariance() {
    let mut random = Noise::new(7);
    let system = System::exact(50, &SVector::<f64, 3>::zeros(), &mut random);
    let report = system.disturb(0.01, &mut random).solve_with(PLAIN);
    let expected = report.information.try_inverse().unwrap();
    assert!((report.covariance - expected).norm() < TOLERANCE * expected.norm());
}

/// Covariance of vectors about their mean.
fn scatter<const D: usize>(steps: &[SVector<f64, D>]) -> SMatrix<f64, D, D> {
    let mean = steps.iter().sum::<SVector<f64, D>>() / steps.len() as f64;
    let sum: SMatrix<f64, D, D> = steps.iter().map(|s| (s - mean) * (s - mean).transpose()).sum();
    sum / (steps.len() - 1) as f64
}

/// The largest relative error of the variance in any direction.
fn relative_error<const D: usize>(claimed: &SMatrix<f64, D, D>, seen: &SMatrix<f64, D, D>) -> f64 {
    let whiten = claimed.cholesky().unwrap().l().try_inverse().unwrap();
    let whitened = whiten * seen * whiten.transpose();
    let whitened = DMatrix::from_column_slice(D, D, whitened.as_slice());
    whitened.symmetric_eigenvalues().iter().map(|v| (v - 1.0).abs()).fold(0.0, f64::max)
}

#[test]
fn the_covariance_matches_monte_carlo() {
    /// Three standard deviations of a variance from this many samples are 4 %.
    const DRAWS: usize = 12_000;
    let mut random = Noise::new(0x636f_7661);
    let truth = SVector::<f64, 3>::from([1.0, -2.0, 0.3]);
    let exact = System::exact(30, &truth, &mut random);
    let mut fitter = Fitter::new(PLAIN).unwrap();
    // Noise of the stated variances, and twice that, to be detected from the residuals.
    for factor in [1.0, 2.0] {
        let mut claimed = SMatrix::<f64, 3, 3>::zeros();
        let steps: Vec<_> = (0..DRAWS)
            .map(|_| {
                let report = exact.clone().disturb(factor, &mut random).solve(&mut fitter, None);
                claimed += report.covariance / DRAWS as f64;
                report.step
            })
            .collect();
        let seen = scatter(&steps);
        if factor == 1.0 {
            let from_information = exact.information().try_inverse().unwrap();
            assert!(relative_error(&from_information, &seen) < 0.05);
            // Large residuals increase the covariance, small ones do not decrease it.
            assert!(relative_error(&claimed, &seen) < 0.15);
        } else {
            assert!(relative_error(&claimed, &seen) < 0.05, "{claimed} {seen}");
        }
        let mean = steps.iter().sum::<SVector<f64, 3>>() / DRAWS as f64;
        let bias = (mean - truth).dot(&(seen.try_inverse().unwrap() * (mean - truth)));
        assert!(bias < 16.0 / DRAWS as f64, "{mean}");
    }
}

#[test]
fn fewer_equations_than_unknowns_are_reported() {
    let mut random = Noise::new(11);
    for n in 0..4 {
        let system = System::exact(n, &SVector::<f64, 4>::repeat(1.0), &mut random);
        let report = system.solve_with(FitOptions::default());
        assert_eq!(report.outcome, Outcome::TooFewEquations);
        assert_eq!((report.equations, report.rank, report.iterations), (n, 0, 0));
        assert!(is_silent(&report));
    }
}

/// Straight flanks at q = ±0.1 without a tip.
fn flanks() -> Vec<TemplateSample> {
    let sample = |p: f64, side: f64| TemplateSample {
        position: Point2::new(p, 0.1 * side),
        normal: Vector2::new(0.0, side),
        limb: Limb::Finger,
        along: p,
        radial: Vector2::new(0.0, side),
    };
    (0..20).flat_map(|i| [-1.0, 1.0].map(|side| sample(f64::from(i) * 0.04 - 0.4, side))).collect()
}

fn tip() -> TemplateSample {
    TemplateSample {
        position: Point2::new(0.5, 0.0),
        normal: Vector2::x(),
        limb: Limb::Finger,
        along: 0.4,
        radial: Vector2::x(),
    }
}

/// Measurements of samples of a contour that has moved by `step`, with a variance of 0.01 px².
fn seen<S: PlanarSpace<D>, const D: usize>(
    map: &AffineMap,
    samples: &[TemplateSample],
    step: &SVector<f64, D>,
) -> System<D> {
    let (space, x) = S::through(map).unwrap();
    let pose = space.pose(&x);
    let rows: Vec<_> =
        samples.iter().map(|s| space.normal_row(&pose, s, &pose.place(s).normal)).collect();
    let offsets_px = rows.iter().map(|row| row.dot(step)).collect();
    System { offsets_px, variances_px2: vec![0.01; rows.len()], rows }
}

#[test]
fn flanks_alone_do_not_determine_the_slide_along_the_finger() {
    for angle_rad in [0.0, 0.3, -2.0] {
        let map = AffineMap::upright(Point2::new(200.0, 100.0), angle_rad, 100.0).unwrap();
        let step = SVector::<f64, 3>::from([1.0, 0.5, 0.02]);
        let report = seen::<Rigid, 3>(&map, &flanks(), &step).solve_with(FitOptions::default());
        assert_eq!((report.outcome, report.rank), (Outcome::Undetermined, 2), "{angle_rad}");
        assert!(is_silent(&report));
        // The information matrix shows the direction.
        let along = map.linear.column(0).normalize();
        let slide = SVector::<f64, 3>::from([along.x, along.y, 0.0]);
        assert!((report.information * slide).norm() < TOLERANCE * report.information.norm());

        let sheared = seen::<RigidShear, 4>(&map, &flanks(), &SVector::zeros());
        assert_eq!(sheared.solve_with(PLAIN).rank, 2, "nor do they show the shear");

        // One sample of the tip is enough.
        let mut samples = flanks();
        samples.push(tip());
        let report = seen::<Rigid, 3>(&map, &samples, &step).solve_with(FitOptions::default());
        assert_eq!((report.outcome, report.rank), (Outcome::Determined, 3));
        assert!((report.step - step).norm() < 1e-7, "{}", report.step);
    }
}

#[test]
fn a_prior_determines_what_the_equations_do_not() {
    let map = AffineMap::upright(Point2::new(200.0, 100.0), 0.3, 100.0).unwrap();
    let axis = map.axis();
    let (along, across) = (axis.direction(), axis.normal());
    let truth = SVector::<f64, 3>::from([across.x * 1.5, across.y * 1.5, 0.02]);
    let system = seen::<Rigid, 3>(&map, &flanks(), &truth);
    let (sigma_px, slide_px) = (5.0, -3.0);
    let slide = SVector::<f64, 3>::from([along.x, along.y, 0.0]);
    let prior = Prior {
        mean: slide * slide_px,
        information: slide * slide.transpose() / (sigma_px * sigma_px),
    };
    let report = system.solve(&mut Fitter::new(FitOptions::default()).unwrap(), Some(&prior));
    assert_eq!((report.outcome, report.rank), (Outcome::Determined, 3));
    // The edges determine the step across the finger, the prior the one along it.
    assert!((report.step - (truth + slide * slide_px)).norm() < 1e-7, "{}", report.step);
    let variance = slide.dot(&(report.covariance * slide));
    assert!((variance / (sigma_px * sigma_px) - 1.0).abs() < 1e-9, "{variance}");

    // A prior without information on the slide leaves it undetermined.
    let idle = Prior { information: SMatrix::zeros(), ..prior };
    let report = system.solve(&mut Fitter::new(FitOptions::default()).unwrap(), Some(&idle));
    assert_eq!((report.outcome, report.rank), (Outcome::Undetermined, 2));
}

#[test]
fn a_prior_alone_is_sufficient() {
    let mean = SVector::<f64, 2>::from([3.0, -4.0]);
    let prior = Prior { mean, information: Matrix2::new(2.0, 0.5, 0.5, 1.0) };
    let nothing = System { rows: vec![], offsets_px: vec![], variances_px2: vec![] };
    let report = nothing.solve(&mut Fitter::new(FitOptions::default()).unwrap(), Some(&prior));
    assert_eq!(report.outcome, Outcome::Determined);
    assert!((report.step - mean).norm() < TOLERANCE);
    let expected = prior.information.try_inverse().unwrap();
    assert!((report.covariance - expected).norm() < TOLERANCE);
}

#[test]
fn the_rank_does_not_depend_on_units() {
    let mut random = Noise::new(13);
    let truth = SVector::<f64, 4>::repeat(1.0);
    let mut system = System::exact(30, &truth, &mut random);
    let units = SVector::<f64, 4>::from([1.0, 1e-7, 1e5, 1e-3]);
    for row in &mut system.rows {
        row.component_mul_assign(&units);
    }
    let report = system.solve_with(FitOptions::default());
    assert_eq!((report.outcome, report.rank), (Outcome::Determined, 4));
    let step = report.step.component_mul(&units);
    assert!((step - truth).norm() < 1e-6, "{step}");

    // Two linearly dependent components.
    for row in &mut system.rows {
        row[3] = row[2] * 1e-4;
    }
    let report = system.solve_with(FitOptions::default());
    assert_eq!((report.outcome, report.rank), (Outcome::Undetermined, 3));
}

#[test]
fn non_finite_equations_are_refused_and_not_added() {
    let mut buffer = EquationBuffer::with_capacity(4, 3);
    let mut equations = buffer.clear::<3>();
    let row = SVector::<f64, 3>::from([1.0, 2.0, 3.0]);
    for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
        let error = equations.push(&row, bad, 1.0).unwrap_err();
        assert!(matches!(error, Error::NotFinite { what: "offset [px]", .. }), "{error}");
        for i in 0..3 {
            let mut broken = row;
            broken[i] = bad;
            let error = equations.push(&broken, 0.0, 1.0).unwrap_err();
            assert!(matches!(error, Error::NotFinite { what: "row of the Jacobian", .. }));
        }
        assert!(equations.push(&row, 0.0, bad).is_err());
    }
    for variance in [0.0, -0.0, -1.0] {
        let error = equations.push(&row, 0.0, variance).unwrap_err();
        assert!(
            matches!(error, Error::OutOfRange { what: "variance [px²]", value, .. } if value == variance)
        );
    }
    assert!(equations.is_empty());
    equations.push(&row, 0.0, 1e-3).unwrap();
    assert_eq!((equations.len(), equations.is_empty()), (1, false));
}

#[test]
fn options_out_of_range_are_refused() {
    let refused = |options: FitOptions| Fitter::new(options).unwrap_err().to_string();
    for cutoff in [1.0, 0.0, -3.0] {
        let message = refused(FitOptions { loss: Loss::Tukey { cutoff }, ..PLAIN });
        assert_eq!(message, format!("Tukey cutoff [robust sigma] is {cutoff}; it must be above 1"));
    }
    let nan = FitOptions { loss: Loss::Tukey { cutoff: f64::NAN }, ..PLAIN };
    assert!(refused(nan).contains("must be finite"));
    for max_iterations in [0, 101] {
        let message = refused(FitOptions { max_iterations, ..PLAIN });
        assert_eq!(message, format!("most iterations is {max_iterations}; it must be 1 to 100"));
    }
    for min_scale_px in [-0.1, 10.5] {
        let message = refused(FitOptions { min_scale_px, ..PLAIN });
        assert!(message.contains(&min_scale_px.to_string()), "{message}");
    }
    assert!(refused(FitOptions { min_scale_px: f64::NAN, ..PLAIN }).contains("NaN"));
    let options = FitOptions { loss: Loss::Tukey { cutoff: 2.0 }, ..PLAIN };
    assert_eq!(*Fitter::new(options).unwrap().options(), options);
}

#[test]
fn a_solver_has_no_state_between_fits() {
    let mut random = Noise::new(17);
    let small = System::exact(9, &SVector::<f64, 2>::repeat(2.0), &mut random);
    let large = System::exact(90, &SVector::<f64, 6>::repeat(-1.0), &mut random);
    let large = large.disturb(2.0, &mut random);
    let mut used = Fitter::new(FitOptions::default()).unwrap();
    let first = large.solve(&mut used, None);
    let mut fresh = Fitter::new(FitOptions::default()).unwrap();
    assert_eq!(small.solve(&mut used, None), small.solve(&mut fresh, None));
    assert_eq!(used.residuals().len(), 9);
    assert_eq!(large.solve(&mut used, None), first);
}

#[test]
fn the_largest_motion_is_that_of_the_sample_that_moves_most() {
    let mut buffer = EquationBuffer::default();
    let mut equations = buffer.clear::<2>();
    let step = SVector::from([2.0, -1.0]);
    assert_eq!(equations.largest_motion(&step), 0.0);
    for row in [[1.0, 0.0], [0.0, 5.0], [1.0, 2.0]] {
        equations.push(&SVector::from(row), 0.0, 1.0).unwrap();
    }
    assert_eq!(equations.largest_motion(&step), 5.0);
}
