//! Motion of a hand between frames: a Kalman filter on the shape vector.
//!
//! Every component of the shape vector evolves independently over an interval T, by one of two
//! models. With a *velocity*, changed by white acceleration of the density q \[unit²/s³\]:
//!
//! ```text
//! x' = x + T ẋ        Q = q · | T³/3  T²/2 |
//! ẋ' = ẋ                      | T²/2  T    |
//! ```
//!
//! As a *random walk*, whose variance grows by q T (q in unit²/s). Both are exact in continuous
//! time: two successive intervals give the mean and covariance of their sum. The filter predicts
//! the shape vector and its covariance. From these follow the half-length of a search line
//! ([`Expectation::search_length`]) and the innovation of a fit ([`Innovation`]).
//!
//! The covariance is stored in blocks of position and velocity and updated in Joseph's form, which
//! stays positive semi-definite under rounding. Nothing is allocated.
//!
//! Source: Bar-Shalom, Li & Kirubarajan, *Estimation with Applications to Tracking and Navigation*,
//! 2001: section 6.2 for the model, 5.2 and 5.4 for the filter and its consistency; Blake & Isard,
//! *Active Contours*, 1998, chapter 8, for the validation gate along the normals of a contour.

use crate::{Error, Result};
use nalgebra::{Cholesky, SMatrix, SVector};
use std::f64::consts::{PI, TAU};

/// Motion model of a component.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Course {
    /// Constant velocity with white acceleration.
    Velocity {
        /// Density q of the acceleration \[unit²/s³\], 0–1e12; see [`acceleration_density`].
        density: f64,
        /// Prior standard deviation of the velocity at the first measurement \[unit/s\], 0–1e6; its
        /// mean is zero.
        first_sigma: f64,
    },
    /// Random walk without a velocity.
    Walk {
        /// Growth q of the variance \[unit²/s\], 0–1e12; 0 for a constant.
        density: f64,
    },
}

/// Domain of a component's values.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Domain {
    /// Any number.
    Line,
    /// An angle \[rad\], modulo 2π; results are in (−π, π].
    Circle,
}

/// One component of a shape vector.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Component {
    /// Its motion model.
    pub course: Course,
    /// The domain of its values.
    pub domain: Domain,
}

/// The density q = 2 a² τ \[unit²/s³\] of the white acceleration equivalent to one of root mean
/// square `a` \[unit/s²\] with the correlation time τ = `lasts_s` (Singer's model; the two agree
/// over intervals longer than τ).
#[must_use]
pub fn acceleration_density(a: f64, lasts_s: f64) -> f64 {
    2.0 * a * a * lasts_s
}

/// A Kalman filter on a shape vector of `D` components.
///
/// ```
/// use fingerpost_core::solve::dynamics::{Component, Course, Domain, Dynamics, Prediction};
/// use fingerpost_core::nalgebra::{Matrix1, Vector1};
///
/// // An object at 100 px with a speed of up to about 500 px/s, measured to ± 0.5 px.
/// let course = Course::Velocity { density: 1e5, first_sigma: 500.0 };
/// let components = [Component { course, domain: Domain::Line }];
/// let seen = Matrix1::new(0.25);
/// let mut dynamics = Dynamics::start(components, 0.25, 0.0, &Vector1::new(100.0), &seen)?;
///
/// // A frame later it is at 106 px: a small innovation, which determines the velocity.
/// let innovation = dynamics.update(0.04, &Vector1::new(106.0), &seen)?.expect("no long gap");
/// assert!(innovation.normalised_square() < 1.0);
/// let Prediction::Expected(next) = dynamics.predict(0.08)? else { unreachable!() };
/// assert!((next.vector[0] - 112.0).abs() < 0.1);
///
/// // After a second the gap is too long for a prediction.
/// assert!(matches!(dynamics.predict(1.04)?, Prediction::Lost { .. }));
/// # Ok::<(), fingerpost_core::Error>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Dynamics<const D: usize> {
    components: [Component; D],
    longest_gap_s: f64,
    /// Time of the state \[s\].
    time_s: f64,
    state: State<D>,
}

/// Mean and covariance of position and velocity; a random walk has zeros in place of a velocity.
#[derive(Debug, Clone, Copy, PartialEq)]
struct State<const D: usize> {
    x: SVector<f64, D>,
    v: SVector<f64, D>,
    p_xx: SMatrix<f64, D, D>,
    p_xv: SMatrix<f64, D, D>,
    p_vv: SMatrix<f64, D, D>,
}

/// Prediction before a frame is measured.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Prediction<const D: usize> {
    /// The predicted shape vector.
    Expected(Expectation<D>),
    /// The gap is too long for a prediction.
    Lost {
        /// Time since the last measurement \[s\].
        gap_s: f64,
    },
}

/// A predicted shape vector with its covariance.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Expectation<const D: usize> {
    /// The mean.
    pub vector: SVector<f64, D>,
    /// Its covariance.
    pub covariance: SMatrix<f64, D, D>,
}

/// A fitted shape vector minus the predicted one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Innovation<const D: usize> {
    /// The difference; that of an angle is in (−π, π].
    pub vector: SVector<f64, D>,
    /// Its covariance S, the sum of those of the prediction and the fit.
    pub covariance: SMatrix<f64, D, D>,
    normalised_square: f64,
}

impl<const D: usize> Innovation<D> {
    /// νᵀ S⁻¹ ν, the normalised innovation squared: χ² distributed with `D` degrees of freedom,
    /// mean `D`, if the hand moves according to the model; see [`chi_square_quantile`] for
    /// thresholds.
    #[must_use]
    pub fn normalised_square(&self) -> f64 {
        self.normalised_square
    }
}

impl<const D: usize> Dynamics<D> {
    /// A filter that starts with a measurement at `time_s`, with unknown velocity. Predictions are
    /// limited to intervals of `longest_gap_s`, 0.001–60.
    ///
    /// # Errors
    /// When a component's density or sigma or the gap is outside its documented range, when
    /// anything is not finite, and [`Error::NotPositiveDefinite`] for a covariance that is not
    /// positive definite.
    pub fn start(
        components: [Component; D],
        longest_gap_s: f64,
        time_s: f64,
        x: &SVector<f64, D>,
        covariance: &SMatrix<f64, D, D>,
    ) -> Result<Self> {
        components.iter().try_for_each(Component::check)?;
        Error::within("longest gap [s]", longest_gap_s, "0.001 to 60", |t| {
            (0.001..=60.0).contains(&t)
        })?;
        Error::finite("time [s]", time_s)?;
        check_measured(x, covariance)?;
        let state = State::first(&components, x, covariance);
        Ok(Self { components, longest_gap_s, time_s, state })
    }

    /// Time of the last measurement \[s\].
    #[must_use]
    pub fn time_s(&self) -> f64 {
        self.time_s
    }

    /// The velocity of each component \[unit/s\] at the last measurement; zero for a random walk.
    #[must_use]
    pub fn velocity(&self) -> &SVector<f64, D> {
        &self.state.v
    }

    /// The filter after a shape vector whose innovation is improbable. Either the velocity has
    /// changed from the given one to the present one, or the previous measurement was wrong. The
    /// two hypotheses are equally likely and are merged into the Gaussian of their mean and
    /// covariance.
    #[must_use]
    pub fn with_velocity_reset(mut self, velocity_before: &SVector<f64, D>) -> Self {
        let half = (self.state.v - velocity_before) * 0.5;
        self.state.v -= half;
        self.state.p_vv = symmetric(&(self.state.p_vv + half * half.transpose()));
        self
    }

    /// The filter if the last measurement may be off by about `by`, with either sign.
    #[must_use]
    pub fn unsure(mut self, by: &SVector<f64, D>) -> Self {
        self.state.p_xx = symmetric(&(self.state.p_xx + by * by.transpose()));
        self
    }

    /// The shape vector at a later time.
    ///
    /// # Errors
    /// When `time_s` is not finite or earlier than that of the last update.
    pub fn predict(&self, time_s: f64) -> Result<Prediction<D>> {
        Ok(self.at(time_s)?.map_or(
            Prediction::Lost { gap_s: time_s - self.time_s },
            |State { x: vector, p_xx: covariance, .. }| {
                Prediction::Expected(Expectation { vector, covariance })
            },
        ))
    }

    /// Updates the filter with the shape vector fitted at `time_s`, and returns the innovation.
    /// After a long gap, or an innovation too large for the arithmetic, the filter restarts and
    /// returns `None`.
    ///
    /// # Errors
    /// When `time_s` is not finite or earlier than that of the last update, `x` is not finite or
    /// the covariance not positive definite. The filter is unchanged then.
    pub fn update(
        &mut self,
        time_s: f64,
        x: &SVector<f64, D>,
        covariance: &SMatrix<f64, D, D>,
    ) -> Result<Option<Innovation<D>>> {
        check_measured(x, covariance)?;
        let expected = self.at(time_s)?;
        self.time_s = time_s;
        let updated = expected.and_then(|s| s.corrected(&self.components, x, covariance));
        let (state, innovation) = match updated {
            Some((state, innovation)) => (state, Some(innovation)),
            None => (State::first(&self.components, x, covariance), None),
        };
        self.state = state;
        Ok(innovation)
    }

    /// The state at a later time; `None` after the longest gap.
    fn at(&self, time_s: f64) -> Result<Option<State<D>>> {
        let last = self.time_s;
        Error::within("time [s]", time_s, "at or after that of the last update", |t| t >= last)?;
        let interval_s = time_s - last;
        Ok((interval_s <= self.longest_gap_s)
            .then(|| self.state.after(&self.components, interval_s)))
    }
}

impl Component {
    fn check(&self) -> Result<()> {
        let (Course::Velocity { density, .. } | Course::Walk { density }) = self.course;
        Error::within("density of the process noise", density, "0 to 1e12", |q| {
            (0.0..=1e12).contains(&q)
        })?;
        if let Course::Velocity { first_sigma, .. } = self.course {
            Error::within("sigma of the first velocity", first_sigma, "0 to 1e6", |s| {
                (0.0..=1e6).contains(&s)
            })?;
        }
        Ok(())
    }

    /// The principal value of `x` in this component's domain.
    fn principal(&self, x: f64) -> f64 {
        match self.domain {
            Domain::Line => x,
            Domain::Circle => PI - (PI - x).rem_euclid(TAU),
        }
    }
}

impl<const D: usize> State<D> {
    /// The state at a first measurement.
    fn first(
        components: &[Component; D],
        x: &SVector<f64, D>,
        covariance: &SMatrix<f64, D, D>,
    ) -> Self {
        let speed_variance = SVector::from(components.map(|c| match c.course {
            Course::Velocity { first_sigma, .. } => first_sigma * first_sigma,
            Course::Walk { .. } => 0.0,
        }));
        Self {
            x: principal(components, x),
            v: SVector::zeros(),
            p_xx: symmetric(covariance),
            p_xv: SMatrix::zeros(),
            p_vv: SMatrix::from_diagonal(&speed_variance),
        }
    }

    /// An interval T later: P' = F P Fᵀ + Q.
    fn after(&self, components: &[Component; D], t: f64) -> Self {
        let Self { x, v, p_xx, p_xv, p_vv } = self;
        let mut later = Self {
            x: principal(components, &(x + v * t)),
            v: *v,
            p_xx: symmetric(&(p_xx + (p_xv + p_xv.transpose()) * t + p_vv * (t * t))),
            p_xv: p_xv + p_vv * t,
            p_vv: *p_vv,
        };
        for (i, component) in components.iter().enumerate() {
            let at = (i, i);
            match component.course {
                Course::Velocity { density: q, .. } => {
                    later.p_xx[at] += q * t * t * t / 3.0;
                    later.p_xv[at] += q * t * t / 2.0;
                    later.p_vv[at] += q * t;
                }
                Course::Walk { density: q } => later.p_xx[at] += q * t,
            }
        }
        later
    }

    /// After a measurement of the position; `None` if the arithmetic fails. Joseph's form, P' = (1
    /// − K H) P (1 − K H)ᵀ + K R Kᵀ, for H = \[1 0\].
    fn corrected(
        &self,
        components: &[Component; D],
        measured: &SVector<f64, D>,
        r: &SMatrix<f64, D, D>,
    ) -> Option<(Self, Innovation<D>)> {
        let Self { x, v, p_xx, p_xv, p_vv } = self;
        let vector = principal(components, &(measured - x));
        let covariance = symmetric(&(p_xx + r));
        let factor = Cholesky::new(covariance)?;
        let (k_x, k_v) = (factor.solve(p_xx).transpose(), factor.solve(p_xv).transpose());
        let complement = SMatrix::identity() - k_x;
        let noise = r * k_v.transpose();
        let to_v = p_xv - p_xx * k_v.transpose();
        let state = Self {
            x: principal(components, &(x + k_x * vector)),
            v: v + k_v * vector,
            p_xx: symmetric(
                &(complement * p_xx * complement.transpose() + k_x * r * k_x.transpose()),
            ),
            p_xv: complement * to_v + k_x * noise,
            p_vv: symmetric(
                &(p_vv - k_v * p_xv - p_xv.transpose() * k_v.transpose()
                    + k_v * (p_xx * k_v.transpose() + noise)),
            ),
        };
        let normalised_square = vector.dot(&factor.solve(&vector));
        let is_finite = normalised_square.is_finite() && state.x.sum().is_finite();
        is_finite.then_some((state, Innovation { vector, covariance, normalised_square }))
    }
}

/// Validation gate of the edge search, with bounds on its half-length.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Gate {
    sigmas: f64,
    shortest_px: f64,
    longest_px: f64,
}

impl Gate {
    /// A gate that contains an edge of a hand that moves as predicted with this probability,
    /// 0.5–0.999999, for half-lengths of `shortest_px` to `longest_px`, positive.
    ///
    /// # Errors
    /// When a value is not finite or out of its range, or the longest is less than the shortest.
    pub fn new(confidence: f64, shortest_px: f64, longest_px: f64) -> Result<Self> {
        Error::within("confidence of the gate", confidence, "0.5 to 0.999999", |p| {
            (0.5..=0.999_999).contains(&p)
        })?;
        Error::within("shortest search line [px]", shortest_px, "positive", |l| l > 0.0)?;
        Error::within("longest search line [px]", longest_px, "at least the shortest", |l| {
            l >= shortest_px
        })?;
        let sigmas = chi_square_quantile(confidence, 1)?.sqrt();
        Ok(Self { sigmas, shortest_px, longest_px })
    }

    /// Maximum half-length of a search line \[px\].
    #[must_use]
    pub fn longest_px(&self) -> f64 {
        self.longest_px
    }

    /// Half-width of the gate \[standard deviations\].
    #[must_use]
    pub fn sigmas(&self) -> f64 {
        self.sigmas
    }
}

impl<const D: usize> Expectation<D> {
    /// Half-length of the search line of a sample: γ √(row P rowᵀ + variance), within the gate's
    /// bounds \[px\]. `row` = ∂(n·X)/∂x is the sample's motion along its normal, and `variance_px2`
    /// the variance of the edge measurement.
    #[must_use]
    pub fn search_length(&self, row: &SVector<f64, D>, variance_px2: f64, gate: &Gate) -> f64 {
        let variance = row.dot(&(self.covariance * row)) + variance_px2;
        (gate.sigmas * variance.max(0.0).sqrt()).clamp(gate.shortest_px, gate.longest_px)
    }
}

/// The quantile of the χ² distribution with 1–100 `degrees` of freedom at `probability`, above 0
/// and at most 0.999999.
///
/// # Errors
/// When the probability or the degrees of freedom are out of range.
pub fn chi_square_quantile(probability: f64, degrees: usize) -> Result<f64> {
    Error::within("probability", probability, "above 0 and at most 0.999999", |p| {
        p > 0.0 && p <= 0.999_999
    })?;
    Error::within("degrees of freedom", degrees as f64, "1 to 100", |d| {
        (1.0..=100.0).contains(&d)
    })?;
    // Six standard deviations of the most skewed of them are 24 + 6 √(2 d) above the mean.
    let (mut low, mut high) = (0.0, 2.0 * degrees as f64 + 50.0);
    while high - low > QUANTILE_TOLERANCE * high {
        let middle = 0.5 * (low + high);
        // Quantiles of the smallest probabilities underflow.
        if middle <= low || middle >= high {
            break;
        }
        if chi_square_cdf(middle, degrees) < probability { low = middle } else { high = middle }
    }
    Ok(0.5 * (low + high))
}

const QUANTILE_TOLERANCE: f64 = 1e-12;

/// P(χ² ≤ x) = e^(−h) Σₙ h^(a+n) / Γ(a+n+1) with h = x/2, a = degrees/2: the series of the
/// incomplete gamma function, whose terms are all positive.
fn chi_square_cdf(x: f64, degrees: usize) -> f64 {
    let h = 0.5 * x;
    // h^a / Γ(a + 1), from a = 0 or a = 1/2 up.
    let (mut a, mut term) =
        if degrees.is_multiple_of(2) { (0.0, 1.0) } else { (0.5, 2.0 * (h / PI).sqrt()) };
    while 2.0 * a < degrees as f64 {
        a += 1.0;
        term *= h / a;
    }
    let mut sum = term;
    while term > f64::EPSILON * sum {
        a += 1.0;
        term *= h / a;
        sum += term;
    }
    (-h).exp() * sum
}

fn check_measured<const D: usize>(
    x: &SVector<f64, D>,
    covariance: &SMatrix<f64, D, D>,
) -> Result<()> {
    Error::finite("shape vector", x.sum())?;
    Error::finite("covariance of the shape vector", covariance.sum())?;
    let what = "covariance of the shape vector";
    Cholesky::new(symmetric(covariance)).map(|_| ()).ok_or(Error::NotPositiveDefinite { what })
}

fn principal<const D: usize>(components: &[Component; D], x: &SVector<f64, D>) -> SVector<f64, D> {
    SVector::from_fn(|i, _| components[i].principal(x[i]))
}

fn symmetric<const D: usize>(m: &SMatrix<f64, D, D>) -> SMatrix<f64, D, D> {
    (m + m.transpose()) * 0.5
}
