//! Design effect of a contour's residuals: the loss of information by their autocorrelation.
//!
//! A finger deviates from its template: a knuckle, a nail, a shaded segment of a flank displace the
//! edges of many neighbouring samples to one side. Such samples are not independent, and a
//! covariance that assumes so is far too small. The variance of a mean of n residuals with
//! autocorrelation ρ_k is 1 + 2 Σ (1 − k / n) ρ_k times that of n independent ones. With a
//! triangular window of fixed width in place of 1 − k / n, the poorly estimated correlations of
//! distant neighbours have no effect, and the factor cannot become negative.
//!
//! Source: Newey & West 1987, A simple, positive semi-definite, heteroskedasticity and
//! autocorrelation consistent covariance matrix.

use crate::geometry::template::Part;
use crate::numeric::ablation::{Mechanism, is_off};

/// Width of the window as a part of the contour: pairs at larger distances are few, and a deviation
/// common to half a flank is absorbed by the fit.
const WITHIN: f64 = 0.1;

/// Number of residuals that carry the information of one independent residual, at least 1, for the
/// residuals of a contour in their order \[px\], each with its part of the outline.
pub(super) fn design_effect(residuals: &[(Part, f64)]) -> f64 {
    if is_off(Mechanism::DesignEffect) {
        return 1.0;
    }
    let square: f64 = residuals.iter().map(|(_, r)| r * r).sum();
    if square <= 0.0 {
        return 1.0;
    }
    let window = (WITHIN * residuals.len() as f64).round() as usize + 1;
    // Two residuals share more windows, the nearer they are: the triangular weight.
    let parts = residuals.chunk_by(|(part, _), (next, _)| part == next);
    let window_squares: f64 = parts.map(|part| squared_sums(part, window)).sum();
    (window_squares / (window as f64 * square)).max(1.0)
}

/// Squares of the sums over `window` neighbours, added over all positions of the window that
/// overlap the part; beyond its ends the residuals are 0.
fn squared_sums(part: &[(Part, f64)], window: usize) -> f64 {
    let mut sum = 0.0;
    let mut squares = 0.0;
    let mut push = |step: f64| {
        sum += step;
        squares += sum * sum;
    };
    let within = window.min(part.len());
    part[..within].iter().for_each(|(_, last)| push(*last));
    (within..window).for_each(|_| push(0.0));
    part.iter().zip(&part[within..]).for_each(|((_, first), (_, last))| push(last - first));
    part[part.len() - within..].iter().for_each(|(_, first)| push(-first));
    squares
}

#[cfg(test)]
mod tests {
    use super::*;

    const COUNT: usize = 60;
    const DRAWS: usize = 400;

    /// Noise with the correlation `rho` of neighbours, along two flanks; the same for the same
    /// seed.
    fn flanks(rho: f64, seed: usize) -> Vec<(Part, f64)> {
        let mut state = 0x9E37_79B9_7F4A_7C15_u64.wrapping_mul(seed as u64 + 1);
        let mut uniform = || {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            (state >> 11) as f64 / (1_u64 << 53) as f64 - 0.5
        };
        let mut last = 0.0;
        let mut draw = |i: usize| {
            let fresh: f64 = (0..6).map(|_| uniform()).sum();
            let keep = if i.is_multiple_of(COUNT / 2) { 0.0 } else { rho };
            last = keep * last + (1.0 - keep * keep).sqrt() * fresh;
            last
        };
        let part = |i| if i < COUNT / 2 { Part::LeftFlank } else { Part::RightFlank };
        (0..COUNT).map(|i| (part(i), draw(i))).collect()
    }

    /// Variance of the mean of the residuals, in units of that of independent ones.
    fn observed(rho: f64) -> f64 {
        let means = (0..DRAWS).map(|seed| {
            let sum: f64 = flanks(rho, seed).iter().map(|(_, r)| r).sum();
            sum / COUNT as f64
        });
        // Six uniform numbers of variance 1/12.
        means.map(|mean| mean * mean).sum::<f64>() / DRAWS as f64 * COUNT as f64 / 0.5
    }

    fn estimated(rho: f64) -> f64 {
        (0..DRAWS).map(|seed| design_effect(&flanks(rho, seed))).sum::<f64>() / DRAWS as f64
    }

    #[test]
    fn independent_residuals_have_a_design_effect_near_one() {
        assert!((observed(0.0) - 1.0).abs() < 0.15, "{}", observed(0.0));
        assert!(estimated(0.0) < 1.3, "{}", estimated(0.0));
    }

    #[test]
    fn the_design_effect_of_correlated_residuals_matches_the_variance_of_their_mean() {
        for rho in [0.4, 0.7] {
            let ratio = estimated(rho) / observed(rho);
            assert!(
                (0.6..=1.1).contains(&ratio),
                "ρ {rho}: {} of {}",
                estimated(rho),
                observed(rho)
            );
        }
    }

    #[test]
    fn the_design_effect_is_at_least_one() {
        let jagged: Vec<_> =
            (0..COUNT).map(|i| (Part::Tip, if i % 2 == 0 { 1.0 } else { -1.0 })).collect();
        for residuals in [&[], &[(Part::Tip, 0.0); 30][..], &jagged] {
            assert!((design_effect(residuals) - 1.0).abs() < 1e-12);
        }
    }
}
