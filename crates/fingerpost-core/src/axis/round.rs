//! The axis of a finger from its shading, where one of its flanks has no contrast.
//!
//! Before a table as bright as one side of the finger, a finger lit from the other side has an edge
//! at the terminator instead of the occluding contour. Both edges then lie on one half of the
//! finger, and so does their bisector. The shading across a round body determines its width and its
//! middle nevertheless.
//!
//! A [`RoundFinger`] is the straight, tapered body whose shading ([`shading`](super::shading)) fits
//! the profiles across the finger best. Its levels are eliminated (variable projection: Golub &
//! Pereyra 1973, The differentiation of pseudo-inverses and nonlinear least squares problems whose
//! variables separate). The remaining unknowns are the axis, the half-width and its taper, the
//! blur, and the direction of light at every profile. They are found by Levenberg–Marquardt with a
//! robust cost, from several initial bodies that share either flank with the given one, and once
//! more from the best of them.

use super::shading::{Section, SectionFit, ShadingProfile};
use crate::geometry::shape_space::Axis;
use crate::geometry::template::USUAL_HALF_WIDTH;
use crate::image::frame::Frame;
use crate::{Error, Result};
use nalgebra::{Cholesky, SMatrix, SVector};

/// Number of profiles along the finger, and distances of the first and the last behind the tip
/// \[units\].
const PROFILES: usize = 8;
const FIRST: f64 = 1.1;
const LAST: f64 = 6.0;

/// Prior of the growth of a finger's half-width towards the tip: mean and standard deviation.
const TAPER: [f64; 2] = [-0.05, 0.02];
/// Prior standard deviation of the logarithm of the blur, about 1 px.
const LOG_BLUR_SIGMA: f64 = 0.3;
/// Standard deviation of the change of the light's angle between neighbouring profiles: a finger is
/// no cylinder \[rad\].
const LIGHT_SIGMA_RAD: f64 = 0.3;
/// The residuals count as this many independent ones, because neighbours correlate.
const INDEPENDENT: f64 = 40.0;

/// Initial bodies: lateral offset and half-width \[given half-widths\].
const STARTS: [[f64; 2]; 7] =
    [[0.0, 1.0], [-0.25, 1.25], [0.25, 1.25], [-0.5, 1.5], [0.5, 1.5], [-0.8, 1.8], [0.8, 1.8]];
/// Initial directions of light \[rad\].
const FIRST_LIGHTS_RAD: [f64; 4] = [-1.3, -0.5, 0.5, 1.3];
/// Number of initial bodies that are optimised, those of least cost, and iterations for each.
const TRIED: usize = 3;
const ITERATIONS: usize = 6;
/// Iterations from the best of them.
const LAST_ITERATIONS: usize = 12;
/// Convergence: an iteration reduces the cost by less than this fraction.
const SETTLED: f64 = 1e-3;
/// Attempts with increasing damping per iteration.
const SHORTENED: usize = 4;

/// Unknowns: offset and slope of the axis, half-width and its growth, the logarithm of the blur,
/// and the light's angle at every profile.
const UNKNOWNS: usize = 5 + PROFILES;
const OFFSET: usize = 0;
const SLOPE: usize = 1;
const HALF_WIDTH: usize = 2;
const GROWTH: usize = 3;
const LOG_BLUR: usize = 4;
const LIGHT: usize = 5;
/// Bounds of each unknown; the last pair is that of every light.
const BOUNDS: [[f64; 2]; LIGHT + 1] =
    [[-1.3, 1.3], [-0.25, 0.25], [0.5, 2.2], [-0.3, 0.3], [-0.7, 1.5], [-2.2, 2.2]];
/// Lower bound on a section's half-width, whatever the taper \[units\].
const SLIMMEST: f64 = 0.2;

type RoundVector = SVector<f64, UNKNOWNS>;
type Matrix = SMatrix<f64, UNKNOWNS, UNKNOWNS>;

/// The round body whose shading fits the image about an axis best.
///
/// ```
/// use fingerpost_core::nalgebra::Point2;
/// use fingerpost_core::axis::RoundFinger;
/// use fingerpost_core::{Axis, Frame, GrayView};
///
/// // A round finger along u that tapers to its tip, 16 px wide and about v = 60 at u = 110, lit
/// // from above. Its lower flank is as dark as the table: only the upper 13 px are visible.
/// let pixel = |i: usize| {
///     let (u, v) = ((i % 160) as f64, (i / 160) as f64);
///     let y = (v - 60.0) / (8.0 - 0.05 * (u - 110.0));
///     if u > 140.0 || y.abs() > 1.0 {
///         return 60;
///     }
///     (60.0 + 150.0 * (0.9 * (1.0 - y * y).sqrt() - 0.4 * y).max(0.0)) as u8
/// };
/// let pixels: Vec<u8> = (0..160 * 120).map(pixel).collect();
/// let frame = Frame::gray(GrayView::new(&pixels, 160, 120, 160)?);
///
/// let seen = Axis::of_finger(Point2::new(110.0, 58.4), 0.0, 30.0);
/// let finger = RoundFinger::fit(&frame, &seen, 6.4)?.expect("it is all in the picture");
/// assert!((58.4 + finger.offset_px - 60.0).abs() < 0.5);
/// assert!((finger.half_width_px - 8.0).abs() < 0.5);
/// assert!(finger.misfit_about_given > 1.5 * finger.misfit);
/// # Ok::<(), fingerpost_core::Error>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RoundFinger {
    /// Offset of the fitted axis from the anchor of the given one, along the latter's normal
    /// \[px\].
    pub offset_px: f64,
    /// Angle of the fitted axis minus that of the given one \[rad\].
    pub turn_rad: f64,
    /// Half-width at the anchor \[px\].
    pub half_width_px: f64,
    /// Robust cost of the fit over all pixels of the profiles across the finger, dimensionless.
    pub misfit: f64,
    /// The least such cost of a body about the given axis.
    pub misfit_about_given: f64,
}

impl RoundFinger {
    /// Fits a body to the image about `axis`. `half_width_px` is the distance from the axis to the
    /// visible edges. `None` where the profiles are not entirely inside the image.
    ///
    /// # Errors
    /// When a number is not finite, the tip is the anchor, or the half-width is not positive.
    pub fn fit(frame: &Frame<'_>, axis: &Axis, half_width_px: f64) -> Result<Option<Self>> {
        Error::finite("angle of the finger [rad]", axis.angle_rad)?;
        Error::within("half-width of the finger [px]", half_width_px, "positive", |w| w > 0.0)?;
        let ahead_px = (axis.tip - axis.anchor).norm();
        Error::within("length of the finger's axis [px]", ahead_px, "positive", |l| l > 0.0)?;
        Ok(Self::fitted(frame, axis, ahead_px, half_width_px))
    }

    fn fitted(frame: &Frame<'_>, axis: &Axis, ahead_px: f64, half_width_px: f64) -> Option<Self> {
        // If only half of the finger is visible, the given width is too small: the unit is at least
        // twice the usual half-width for this length.
        let unit_px = half_width_px.max(2.0 * USUAL_HALF_WIDTH * ahead_px);
        let known = half_width_px / unit_px;
        let about =
            Self::best_start(&ObservedProfiles::of(frame, axis, ahead_px, unit_px, known)?, known)?;

        // Profiles about a laterally displaced axis end too near on one side; take them anew about
        // the fitted one.
        let (lateral, turn_rad) = (about[OFFSET], about[SLOPE].atan());
        let middle = axis.anchor + axis.normal() * (lateral * unit_px);
        let middle = Axis::of_finger(middle, axis.angle_rad + turn_rad, ahead_px);
        let observed = ObservedProfiles::of(frame, &middle, ahead_px, unit_px, about[HALF_WIDTH])?;
        let mut start = about;
        start.fixed_rows_mut::<2>(OFFSET).fill(0.0);
        let (_, mut given) = observed.first([0.0, known]);
        (given[OFFSET], given[SLOPE]) = (-lateral, -about[SLOPE]);
        let (misfit_about_given, given) = observed.minimise(given, LAST_ITERATIONS, Axes::Held);
        let (mut misfit, mut x) = observed.minimise(start, LAST_ITERATIONS, Axes::Free);
        if misfit_about_given < misfit {
            (misfit, x) = observed.minimise(given, LAST_ITERATIONS, Axes::Free);
        }
        Some(Self {
            offset_px: (lateral + x[OFFSET]) * unit_px,
            turn_rad: turn_rad + x[SLOPE].atan(),
            half_width_px: x[HALF_WIDTH] * unit_px,
            misfit,
            misfit_about_given,
        })
    }

    /// The body of least cost among those optimised from the best initial ones.
    fn best_start(observed: &ObservedProfiles, known: f64) -> Option<RoundVector> {
        let mut starts = STARTS.map(|start| observed.first(start.map(|part| part * known)));
        starts.sort_by(|one, other| one.0.total_cmp(&other.0));
        let optimised =
            starts.iter().take(TRIED).map(|s| observed.minimise(s.1, ITERATIONS, Axes::Free));
        optimised.min_by(|one, other| one.0.total_cmp(&other.0)).map(|(_, x)| x)
    }
}

/// Whether the axis is an unknown.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Axes {
    Free,
    Held,
}

/// The best levels of a body, and its cost.
struct BodyFit {
    sections: [SectionFit; PROFILES],
    cost: f64,
}

impl BodyFit {
    /// Before the first fit.
    fn none() -> Self {
        Self { sections: std::array::from_fn(|_| SectionFit::none()), cost: f64::INFINITY }
    }
}

/// Profiles across an axis, in units of about a half-width.
struct ObservedProfiles {
    profiles: [(f64, ShadingProfile); PROFILES],
    /// Number of residuals that count as one independent residual; the prior is multiplied by it.
    redundancy: f64,
}

impl ObservedProfiles {
    /// The profiles across an axis, for a finger of `half_width` units.
    fn of(
        frame: &Frame<'_>,
        axis: &Axis,
        ahead_px: f64,
        unit_px: f64,
        half_width: f64,
    ) -> Option<Self> {
        let profile = |j: usize| {
            let behind = FIRST + (LAST - FIRST) * j as f64 / (PROFILES - 1) as f64;
            let p = ahead_px / unit_px - behind;
            ShadingProfile::of(frame, axis, p, unit_px).map(|profile| (p, profile))
        };
        let mut profiles = [profile(0)?; PROFILES];
        for (j, known) in profiles.iter_mut().enumerate().skip(1) {
            *known = profile(j)?;
        }
        let mut observed = Self { profiles, redundancy: 1.0 };
        observed.redundancy = (observed.first([0.0, half_width]).0 / INDEPENDENT).max(1.0);
        Some(observed)
    }

    /// The cost of a body of given offset and half-width under the best of the initial lights, and
    /// its unknowns.
    fn first(&self, [offset, half_width]: [f64; 2]) -> (f64, RoundVector) {
        let mut body = BodyFit::none();
        let trials = FIRST_LIGHTS_RAD.map(|light| {
            let mut x = RoundVector::from_element(light);
            (x[OFFSET], x[SLOPE]) = (offset, 0.0);
            (x[HALF_WIDTH], x[GROWTH]) = (half_width, TAPER[0]);
            x[LOG_BLUR] = 0.0;
            self.fit(&x, &mut body);
            (body.cost, x)
        });
        trials.iter().fold(trials[0], |best, &one| if one.0 < best.0 { one } else { best })
    }

    /// Minimises the cost from x; returns the least cost found and its unknowns.
    fn minimise(&self, mut x: RoundVector, iterations: usize, axes: Axes) -> (f64, RoundVector) {
        let (mut best, mut next) = (BodyFit::none(), BodyFit::none());
        self.fit(&x, &mut best);
        let mut damping = 1e-2;
        for _ in 0..iterations {
            let (mut hessian, mut gradient) = self.linearised(&x, &best);
            if axes == Axes::Held {
                for k in [OFFSET, SLOPE] {
                    hessian.row_mut(k).fill(0.0);
                    hessian.column_mut(k).fill(0.0);
                    (hessian[(k, k)], gradient[k]) = (1.0, 0.0);
                }
            }
            let before = best.cost;
            for _ in 0..SHORTENED {
                let mut damped = hessian;
                for k in 0..UNKNOWNS {
                    damped[(k, k)] += damping * hessian[(k, k)] + 1e-9;
                }
                let Some(factor) = Cholesky::new(damped) else { break };
                let there = bounded(x - factor.solve(&gradient));
                self.fit(&there, &mut next);
                if next.cost < best.cost {
                    x = there;
                    std::mem::swap(&mut best, &mut next);
                    damping *= 0.2;
                    break;
                }
                damping *= 8.0;
            }
            if before - best.cost < SETTLED * before {
                break;
            }
        }
        (best.cost, x)
    }

    /// Fits the levels of a body. Its cost is the robust misfit to the profiles, plus the prior.
    fn fit(&self, x: &RoundVector, body: &mut BodyFit) {
        let prior: f64 = expectations(x).map(|e| 0.5 * (e.differs / e.sigma).powi(2)).sum();
        body.cost = self.redundancy * prior;
        for (j, ((p, profile), fit)) in self.profiles.iter().zip(&mut body.sections).enumerate() {
            profile.fit(&section(x, j, *p), fit);
            body.cost += fit.cost;
        }
    }

    /// Normal equations of the cost: the matrix and the gradient.
    fn linearised(&self, x: &RoundVector, body: &BodyFit) -> (Matrix, RoundVector) {
        let (mut hessian, mut gradient) = (Matrix::zeros(), RoundVector::zeros());
        for (j, ((p, profile), fit)) in self.profiles.iter().zip(&body.sections).enumerate() {
            let p = *p;
            let equations = profile.normal_equations(&section(x, j, p), fit);
            // The unknown, the number of the section that it changes, and the derivative.
            let derivatives = [
                (OFFSET, 0, 1.0),
                (SLOPE, 0, p),
                (HALF_WIDTH, 1, 1.0),
                (GROWTH, 1, p),
                (LIGHT + j, 2, 1.0),
                (LOG_BLUR, 3, 1.0),
            ];
            for (k, a, by) in derivatives {
                gradient[k] += by * equations.gradient[a];
                for (l, b, other_by) in derivatives {
                    hessian[(k, l)] += by * other_by * equations.matrix[a][b];
                }
            }
        }
        for PriorTerm { of, less, differs, sigma } in expectations(x) {
            let information = self.redundancy / (sigma * sigma);
            for (k, sign) in [(Some(of), 1.0), (less, -1.0)] {
                let Some(k) = k else { continue };
                gradient[k] += sign * information * differs;
                for (l, other_sign) in [(Some(of), 1.0), (less, -1.0)] {
                    let Some(l) = l else { continue };
                    hessian[(k, l)] += sign * other_sign * information;
                }
            }
        }
        (hessian, gradient)
    }
}

/// The section at profile `j`, p units ahead of the anchor.
fn section(x: &RoundVector, j: usize, p: f64) -> Section {
    Section {
        middle: x[OFFSET] + x[SLOPE] * p,
        half_width: (x[HALF_WIDTH] + x[GROWTH] * p).max(SLIMMEST),
        light_rad: x[LIGHT + j],
        log_blur: x[LOG_BLUR],
    }
}

/// A term of the prior: the difference of an unknown, minus another one if given, from its mean.
struct PriorTerm {
    of: usize,
    less: Option<usize>,
    differs: f64,
    sigma: f64,
}

fn expectations(x: &RoundVector) -> impl Iterator<Item = PriorTerm> {
    let taper = (GROWTH, x[GROWTH] - TAPER[0], TAPER[1]);
    let blur = (LOG_BLUR, x[LOG_BLUR], LOG_BLUR_SIGMA);
    let independent = [taper, blur];
    let independent =
        independent.map(|(of, differs, sigma)| PriorTerm { of, less: None, differs, sigma });
    independent.into_iter().chain((LIGHT + 1..UNKNOWNS).map(|k| PriorTerm {
        of: k,
        less: Some(k - 1),
        differs: x[k] - x[k - 1],
        sigma: LIGHT_SIGMA_RAD,
    }))
}

fn bounded(mut x: RoundVector) -> RoundVector {
    for (k, entry) in x.iter_mut().enumerate() {
        let [low, high] = BOUNDS[k.min(LIGHT)];
        *entry = entry.clamp(low, high);
    }
    x
}
