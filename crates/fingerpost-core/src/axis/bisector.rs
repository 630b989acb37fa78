//! The bisector of the edges of the two flanks.
//!
//! The flanks q = d + ϑ p ± (w₀ + w₁ p) are fitted to edges measured across them: first per flank
//! the straight line with the largest consensus, then its inliers jointly by weighted least squares
//! with Tukey's biweight. The axis of a surface of revolution projects midway between its tangent
//! planes, so the bisector is the axis for any taper and perspective. Light from the side shifts
//! both edges in the same direction and biases the bisector; the photometric line models it.

use super::finger_estimate::{FingerEstimate, FlankLines, SIDES};
use super::visible_flanks::VisibleFlanks;
use crate::Result;
use crate::axis::{BisectorOptions, BisectorReport, WidthPrior};
use crate::geometry::shape_space::PlacedSample;
use crate::image::frame::Frame;
use crate::measure::edge::{EdgeMeasurement, Polarity, Scale, SearchLine};
use crate::measure::edge_search::{Cue, EdgeSearch, SearchOptions};
use crate::numeric::simd::Isa;
use crate::solve::fit::{EquationBuffer, FitOptions, Fitter, Loss, Outcome, Prior, Solve};
use nalgebra::{Matrix2, SMatrix, SVector};

/// Unknowns: d, ϑ, w₀, w₁.
const UNKNOWNS: usize = 4;
/// Damping of the steps of a finger without a prior, as standard deviations of one step: offset and
/// half-width \[px\], turn measured at the ends \[px\], taper.
const STEP_SIGMA_PX: f64 = 3.0;
const STEP_END_SIGMA_PX: f64 = 6.0;
const STEP_TAPER_SIGMA: f64 = 0.1;
/// Nominal image noise of the edge search \[grey levels\]; variances are scaled to the measured
/// noise.
const UNIT_NOISE_GREY: f64 = 1.0;
/// Lower bound on the robust scale of the residuals \[px\].
const LEAST_SCALE_PX: f64 = 0.01;
/// Half-length of the searches after the first pass \[px\].
const NEAR_PX: f64 = 3.0;
/// Convergence: no point of the finger's axis moves by more than this \[px\].
const SETTLED_PX: f64 = 0.02;
/// Distance between searches \[px\]; closer ones share pixels and add little information.
pub(super) const STATION_PX: f64 = 2.0;
/// Variance factor of the scatter that the background causes. Noise moves edges independently;
/// structure behind the finger moves runs of them together. Measured before ellipses of 6–20 px and
/// up to ±25 or ±50 grey levels.
const DISTURBED_RUN: f64 = 20.0;
/// Pairs of edges tried per flank in the consensus.
const TRIALS: usize = 48;

#[derive(Debug, Clone)]
pub(super) struct Bisector {
    options: BisectorOptions,
    search: EdgeSearch,
    fitter: Fitter,
    lines: Vec<SearchLine>,
    found: Vec<EdgeMeasurement>,
    flanks: [Vec<Station>; 2],
    equations: EquationBuffer,
}

/// An edge measurement across a flank.
#[derive(Debug, Clone, Copy)]
struct Station {
    p: f64,
    offset_px: f64,
    variance_px2: f64,
}

#[derive(Debug, Clone, Copy)]
pub(super) struct BisectorFit {
    pub estimate: FingerEstimate,
    /// Of d and ϑ at the estimate's origin.
    pub covariance: Matrix2<f64>,
    pub report: BisectorReport,
}

impl Bisector {
    pub fn new(options: BisectorOptions) -> Result<Self> {
        let fitter = Fitter::new(FitOptions {
            loss: Loss::Tukey { cutoff: options.cutoff },
            solve: Solve::Joint,
            max_iterations: 20,
            min_scale_px: LEAST_SCALE_PX,
        })?;
        let search = EdgeSearch::new(SearchOptions {
            scale_px: options.scale_px,
            blur_px: 1.0,
            noise_grey: UNIT_NOISE_GREY,
            min_contrast_grey: options.min_contrast_grey,
        })?;
        let (stations, capacity) = (Vec::with_capacity(256), 512);
        Ok(Self {
            options,
            search,
            fitter,
            lines: Vec::with_capacity(capacity),
            found: Vec::with_capacity(capacity),
            flanks: [stations.clone(), stations],
            equations: EquationBuffer::with_capacity(capacity, UNKNOWNS),
        })
    }

    /// The same fit for another instruction set.
    pub fn with_isa(self, isa: Isa) -> Self {
        Self { search: self.search.with_isa(isa), ..self }
    }

    /// The bisector near the estimate, or `None` if the flanks are not visible.
    ///
    /// # Errors
    /// When the estimate cannot be searched along.
    pub fn fit(
        &mut self,
        frame: &Frame<'_>,
        cue: Cue<'_>,
        polarity: Polarity,
        noise_grey: f64,
        estimate: &FingerEstimate,
        visible: &VisibleFlanks,
    ) -> Result<Option<BisectorFit>> {
        let mut at = *estimate;
        // The search of one flank must not reach the other.
        let mut half_length_px = self.options.half_length_px.min(at.half_width_px.max(2.0));
        let mut last = None;
        for pass in 0..self.options.max_passes {
            self.measure(frame, cue, polarity, noise_grey, &at, half_length_px)?;
            for (flank, stations) in self.flanks.iter_mut().enumerate() {
                stations.retain(|s| visible.flank(flank).is_visible(s.p));
            }
            if pass == 0 {
                for stations in &mut self.flanks {
                    consensus(stations, self.options.consensus_px);
                }
            }
            if self.flanks.iter().any(|f| f.len() < self.options.min_edges) {
                return Ok(None);
            }
            let Some(solution) = self.solve(&at, estimate)? else { return Ok(None) };
            let step = solution.step;
            let moved = step[0].abs() + at.half_length_px * step[1].abs();
            at = at.moved(&FlankLines {
                offset_px: step[0],
                slope: step[1],
                half_width_px: at.half_width_px + step[2],
                taper: at.taper + step[3],
            });
            let Solution { covariance, report, .. } = solution;
            last = Some(BisectorFit { estimate: at, covariance, report });
            half_length_px = half_length_px.min(NEAR_PX);
            if pass > 0 && moved < SETTLED_PX {
                break;
            }
        }
        Ok(last)
    }

    /// Measures the edges across both flanks.
    fn measure(
        &mut self,
        frame: &Frame<'_>,
        cue: Cue<'_>,
        polarity: Polarity,
        noise_grey: f64,
        at: &FingerEstimate,
        half_length_px: f64,
    ) -> Result<()> {
        let normal = at.normal();
        let variance = (noise_grey / UNIT_NOISE_GREY).powi(2);
        for (stations, (side, flank)) in
            self.flanks.iter_mut().zip(SIDES.into_iter().zip(at.flanks))
        {
            // On the round end no flank is straight.
            let to = at.round_end_px.map_or(flank.to_px, |e| flank.to_px.min(e - 1.0));
            let length = to - flank.from_px;
            let count = if length > 0.0 { (length / STATION_PX) as usize + 1 } else { 0 };
            let abscissae = (0..count).map(|k| flank.from_px + STATION_PX * k as f64);
            self.lines.clear();
            self.lines.extend(abscissae.clone().map(|p| SearchLine {
                sample: PlacedSample {
                    position: at.place(p, side * at.half_width_at(p)),
                    normal: normal * side,
                },
                half_length_px,
                polarity,
            }));
            self.search.search(frame, cue, Scale::Fine, &self.lines, &mut self.found)?;
            stations.clear();
            stations.extend(abscissae.zip(&self.found).filter_map(|(p, found)| {
                let edge = found.as_ref().ok()?;
                let variance_px2 = edge.variance_px2 * variance;
                Some(Station { p, offset_px: edge.offset_px, variance_px2 })
            }));
        }
        Ok(())
    }

    /// The step from `at` by the edge measurements and the finger's prior about the estimate.
    /// Without a prior, a term about `at` damps the step instead, and does not pull the line to the
    /// estimate.
    fn solve(
        &mut self,
        at: &FingerEstimate,
        estimate: &FingerEstimate,
    ) -> Result<Option<Solution>> {
        let mut equations = self.equations.clear::<UNKNOWNS>();
        for (stations, side) in self.flanks.iter().zip(SIDES) {
            for s in stations {
                equations.push(&row(side, s), s.offset_px, s.variance_px2)?;
            }
        }
        let width_prior = at.prior.unwrap_or(WidthPrior {
            half_width_px: at.half_width_px,
            taper: at.taper,
            half_width_sigma_px: STEP_SIGMA_PX,
            taper_sigma: STEP_TAPER_SIGMA,
            axis_sigmas: [STEP_SIGMA_PX, STEP_END_SIGMA_PX / at.half_length_px],
        });
        let [offset_sigma_px, slope_sigma] = width_prior.axis_sigmas;
        let sigma = [
            offset_sigma_px,
            slope_sigma,
            width_prior.half_width_sigma_px,
            width_prior.taper_sigma,
        ];
        let (lateral_px, turned) = at.prior.map_or((0.0, 0.0), |_| {
            let lateral = estimate.origin - at.origin;
            (at.normal().dot(&lateral), at.along.perp(&estimate.along))
        });
        let (width_change_px, taper_change) =
            (width_prior.half_width_px - at.half_width_px, width_prior.taper - at.taper);
        let prior = Prior {
            mean: SVector::from([lateral_px, turned, width_change_px, taper_change]),
            information: SMatrix::from_diagonal(&SVector::from(sigma.map(|s| s.powi(-2)))),
        };
        let fit = self.fitter.solve(&equations, Some(&prior));
        if fit.outcome != Outcome::Determined {
            return Ok(None);
        }
        Ok(self.sandwich().map(|(covariance, rejected)| Solution {
            step: fit.step,
            covariance,
            report: BisectorReport {
                edges: fit.equations,
                rejected,
                residual_px: fit.residual_scale_px,
            },
        }))
    }

    /// Robust covariance of d and ϑ, E\[ψ²\] / E\[ψ′\]² (Σ w row rowᵀ / Σ w)⁻¹ / n, with the
    /// correlation of neighbours; and the fraction of edges with zero weight.
    fn sandwich(&self) -> Option<(Matrix2<f64>, f64)> {
        let (weights, residuals) = (self.fitter.weights(), self.fitter.residuals());
        let n = weights.len() as f64;
        let mut information = SMatrix::<f64, UNKNOWNS, UNKNOWNS>::zeros();
        let (mut sum, mut psi_squared, mut psi_slope, mut rejected) = (0.0, 0.0, 0.0, 0.0);
        let stations =
            self.flanks.iter().zip(SIDES).flat_map(|(f, side)| f.iter().map(move |s| row(side, s)));
        for ((row, &w), &r) in stations.zip(weights).zip(residuals) {
            sum += w;
            psi_squared += (w * r).powi(2);
            // ψ(r) = r (1 − t²)², w = (1 − t²)²: ψ′ = (1 − t²)(1 − 5 t²).
            let root_weight = w.sqrt();
            psi_slope += root_weight * (5.0 * root_weight - 4.0);
            rejected += f64::from(u8::from(w <= 0.0));
            information.ger(w, &row, &row, 1.0);
        }
        let kappa = psi_slope / sum;
        let freedom = n / (n - UNKNOWNS as f64);
        let scatter = freedom * psi_squared / sum / (kappa * kappa);
        let measured = self.flanks.iter().flatten().map(|s| s.variance_px2).sum::<f64>() / n;
        let disturbed = (scatter - self.options.correlation * measured).max(0.0);
        let variance = self.options.correlation * scatter + DISTURBED_RUN * disturbed;
        if !(variance > 0.0 && kappa > 0.0) {
            return None;
        }
        let covariance = information.try_inverse()? * variance;
        Some((covariance.fixed_view::<2, 2>(0, 0).into_owned(), rejected / n))
    }
}

struct Solution {
    step: SVector<f64, UNKNOWNS>,
    covariance: Matrix2<f64>,
    report: BisectorReport,
}

/// Derivatives of the outward position of a flank's edge by d, ϑ, w₀, w₁.
fn row(side: f64, station: &Station) -> SVector<f64, UNKNOWNS> {
    SVector::from([side, side * station.p, 1.0, station.p])
}

/// Keeps the edges near the straight line with the least truncated squared residual.
fn consensus(stations: &mut Vec<Station>, within_px: f64) {
    let n = stations.len();
    if n < 6 {
        return;
    }
    let third = n / 3;
    let cost = |offset: f64, slope: f64| -> f64 {
        let truncated =
            |s: &Station| ((s.offset_px - offset - slope * s.p) / within_px).powi(2).min(1.0);
        stations.iter().map(truncated).sum()
    };
    // The candidates are the estimate's own line, then lines through an edge of the first third and
    // one of the last third, in a fixed order that covers both thirds.
    let (mut best, mut line) = (cost(0.0, 0.0), (0.0, 0.0));
    for k in 0..TRIALS {
        // A cost below one leaves no edge outside the truncation: a better line would keep the same
        // edges.
        if best < 1.0 {
            return;
        }
        let (s, t) = (&stations[(k * 7) % third], &stations[n - 1 - (k * 13 / 3) % third]);
        let slope = (t.offset_px - s.offset_px) / (t.p - s.p);
        let offset = s.offset_px - slope * s.p;
        let cost = cost(offset, slope);
        if cost < best {
            (best, line) = (cost, (offset, slope));
        }
    }
    let (offset, slope) = line;
    stations.retain(|s| (s.offset_px - offset - slope * s.p).abs() < 2.0 * within_px);
}
