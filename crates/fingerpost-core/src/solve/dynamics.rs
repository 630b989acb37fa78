//! How a hand moves between frames: a Kalman filter on the shape vector.
//!
//! Every component of the shape vector goes on by itself in one of two ways, between frames at any
//! interval T. With a *velocity*, which white acceleration of the density q \[unit²/s³\] changes:
//!
//! ```text
//! x' = x + T ẋ        Q = q · | T³/3  T²/2 |
//! ẋ' = ẋ                      | T²/2  T    |
//! ```
//!
//! As a *walk*, whose variance grows by q T (q in unit²/s). Both are exact for continuous time: two
//! intervals one after the other do to mean and covariance what their sum does. The filter predicts
//! the shape vector with its covariance; from it follow the length of a search line
//! ([`Expectation::search_length`]) and how surprising a fit is ([`Innovation`]).
//!
//! The covariance is kept in blocks of position and velocity and updated in Joseph's form, which
//! stays positive semi-definite under rounding. Nothing is allocated.
//!
//! Source: Bar-Shalom, Li & Kirubarajan, *Estimation with Applications to Tracking and Navigation*,
//! 2001: section 6.2 for the model, 5.2 and 5.4 for the filter and its consistency; Blake & Isard,
//! *Active Contours*, 1998, chapter 8, for the validation gate along the normals of a contour.

use crate::{Error, Result};
use nalgebra::{Cholesky, SMatrix, SVector};
use std::f64::consts::{PI, TAU};

/// How a component goes on by itself.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Course {
    /// It keeps its velocity, but for white acceleration.
    Velocity {
        /// Density q of the acceleration \[unit²/s³\], 0–1e12; see [`acceleration_density`].
        density: f64,
        /// Standard deviation of the velocity of what is seen for the first time \[unit/s\],
        /// 0–1e6; its mean is zero.
        first_sigma: f64,
    },
    /// It drifts without a velocity.
    Walk {
        /// Growth q of the variance \[unit²/s\], 0–1e12; 0 for what never changes.
        density: f64,
    },
}

/// What the values of a component are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Domain {
    /// Any number.
    Line,
    /// An angle \[rad\]: values that differ by 2π are the same; they come out in (−π, π].
    Circle,
}

/// One component of a shape vector.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Component {
    /// How it goes on.
    pub course: Course,
    /// What its values are.
    pub domain: Domain,
}

/// The density q = 2 a² τ \[unit²/s³\] of white acceleration that stands for one of root mean square
/// `a` \[unit/s²\] that keeps its direction for about τ = `lasts_s` (Singer's model; the two agree
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
/// // Something at 100 px that may move at some 500 px/s, seen to ± 0.5 px.
/// let course = Course::Velocity { density: 1e5, first_sigma: 500.0 };
/// let components = [Component { course, domain: Domain::Line }];
/// let seen = Matrix1::new(0.25);
/// let mut dynamics = Dynamics::start(components, 0.25, 0.0, &Vector1::new(100.0), &seen)?;
///
/// // A frame later it is at 106 px: no surprise, and the velocity is known from then on.
/// let innovation = dynamics.update(0.04, &Vector1::new(106.0), &seen)?.expect("no long gap");
/// assert!(innovation.normalised_square() < 1.0);
/// let Prediction::Expected(next) = dynamics.predict(0.08)? else { unreachable!() };
/// assert!((next.vector[0] - 112.0).abs() < 0.1);
///
/// // After a second nobody knows where it is.
/// assert!(matches!(dynamics.predict(1.04)?, Prediction::Lost { .. }));
/// # Ok::<(), fingerpost_core::Error>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Dynamics<const D: usize> {
    components: [Component; D],
    longest_gap_s: f64,
    /// When the state was true \[s\].
    time_s: f64,
    state: State<D>,
}

/// Mean and covariance of position and velocity; a walk has no velocity, and zeros in its place.
#[derive(Debug, Clone, Copy, PartialEq)]
struct State<const D: usize> {
    x: SVector<f64, D>,
    v: SVector<f64, D>,
    p_xx: SMatrix<f64, D, D>,
    p_xv: SMatrix<f64, D, D>,
    p_vv: SMatrix<f64, D, D>,
}

/// What is known before a frame is looked at.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Prediction<const D: usize> {
    /// The shape vector as it is expected.
    Expected(Expectation<D>),
    /// Too long ago: where the hand is now does not follow from where it was.
    Lost {
        /// How long it was not seen \[s\].
        gap_s: f64,
    },
}

/// A shape vector that is expected, and how sure that is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Expectation<const D: usize> {
    /// The mean.
    pub vector: SVector<f64, D>,
    /// Its covariance.
    pub covariance: SMatrix<f64, D, D>,
}

/// A fitted shape vector minus the one that was expected.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Innovation<const D: usize> {
    /// The difference; that of an angle is in (−π, π].
    pub vector: SVector<f64, D>,
    /// Its covariance, S: that of the expectation plus that of the fit.
    pub covariance: SMatrix<f64, D, D>,
    normalised_square: f64,
}

impl<const D: usize> Innovation<D> {
    /// νᵀ S⁻¹ ν, the innovation squared in units of its covariance: χ² distributed with `D` degrees
    /// of freedom, `D` on average, as long as the hand moves as the model says; see
    /// [`chi_square_quantile`] for what is too much.
    #[must_use]
    pub fn normalised_square(&self) -> f64 {
        self.normalised_square
    }
}

impl<const D: usize> Dynamics<D> {
    /// A filter that starts with what is seen at `time_s`; it moves with unknown velocity.
    /// Predictions reach `longest_gap_s` far, 0.001–60.
    ///
    /// # Errors
    /// When a component's density or sigma or the gap is outside its documented range, anything is
    /// not finite, and [`Error::NotPositiveDefinite`] for a covariance that is none.
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

    /// When the shape vector was last seen \[s\].
    #[must_use]
    pub fn time_s(&self) -> f64 {
        self.time_s
    }

    /// The velocity of each component \[unit/s\] when it was last seen; zero for a walk.
    #[must_use]
    pub fn velocity(&self) -> &SVector<f64, D> {
        &self.state.v
    }

    /// The filter after a shape vector that surprised: it may have come there by a velocity that has
    /// changed from the given one to the present, or have been taken for another one before. As
    /// likely the one as the other, they are joined into the Gaussian of their mean and covariance.
    #[must_use]
    pub fn with_velocity_reset(mut self, velocity_before: &SVector<f64, D>) -> Self {
        let half = (self.state.v - velocity_before) * 0.5;
        self.state.v -= half;
        self.state.p_vv = symmetric(&(self.state.p_vv + half * half.transpose()));
        self
    }

    /// The filter when what was seen last may be off by about `by`, one way or the other.
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

    /// Takes the shape vector that was fitted at `time_s` and tells how much it surprises: nothing
    /// can after a long gap, which the filter starts anew from, as it does from a surprise so great
    /// that numbers fail.
    ///
    /// # Errors
    /// When `time_s` is not finite or earlier than that of the last update, `x` is not finite or
    /// the covariance not positive definite. The filter is as it was then.
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

    /// The state at a later time, unless that is too late.
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

    /// The value of this component that stands for `x`.
    fn principal(&self, x: f64) -> f64 {
        match self.domain {
            Domain::Line => x,
            Domain::Circle => PI - (PI - x).rem_euclid(TAU),
        }
    }
}

impl<const D: usize> State<D> {
    /// What is seen for the first time.
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

    /// After a measurement of the position; None where numbers fail. Joseph's form,
    /// P' = (1 − K H) P (1 − K H)ᵀ + K R Kᵀ, for H = \[1 0\].
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
        let kept = SMatrix::identity() - k_x;
        let noise = r * k_v.transpose();
        let to_v = p_xv - p_xx * k_v.transpose();
        let state = Self {
            x: principal(components, &(x + k_x * vector)),
            v: v + k_v * vector,
            p_xx: symmetric(&(kept * p_xx * kept.transpose() + k_x * r * k_x.transpose())),
            p_xv: kept * to_v + k_x * noise,
            p_vv: symmetric(
                &(p_vv - k_v * p_xv - p_xv.transpose() * k_v.transpose()
                    + k_v * (p_xx * k_v.transpose() + noise)),
            ),
        };
        let normalised_square = vector.dot(&factor.solve(&vector));
        let sound = normalised_square.is_finite() && state.x.sum().is_finite();
        sound.then_some((state, Innovation { vector, covariance, normalised_square }))
    }
}

/// Where an edge is looked for: a validation gate, and the limits of the search.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Gate {
    sigmas: f64,
    shortest_px: f64,
    longest_px: f64,
}

impl Gate {
    /// A gate that keeps an edge which moves as expected with this probability, 0.5–0.999999, in
    /// search lines of `shortest_px` to `longest_px`, positive.
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

    /// The longest search line \[px\].
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
    /// Half-length of the search line of a sample that the shape vector moves by `row` =
    /// ∂(n·X)/∂x along its normal, whose edge is then found with the variance `variance_px2`:
    /// γ √(row P rowᵀ + variance), within the gate's limits \[px\].
    #[must_use]
    pub fn search_length(&self, row: &SVector<f64, D>, variance_px2: f64, gate: &Gate) -> f64 {
        let variance = row.dot(&(self.covariance * row)) + variance_px2;
        (gate.sigmas * variance.max(0.0).sqrt()).clamp(gate.shortest_px, gate.longest_px)
    }
}

/// The value that a χ² variable of 1–100 `degrees` of freedom stays below with this `probability`,
/// above 0 and at most 0.999999.
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
        // The quantiles of the least probabilities are less than the least number.
        if middle <= low || middle >= high {
            break;
        }
        if chi_square_cdf(middle, degrees) < probability { low = middle } else { high = middle }
    }
    Ok(0.5 * (low + high))
}

const QUANTILE_TOLERANCE: f64 = 1e-12;

/// P(χ² ≤ x) = e^(−h) Σₙ h^(a+n) / Γ(a+n+1) with h = x/2, a = degrees/2: the series of the incomplete
/// gamma function, whose terms are all positive.
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
