//! A natural logarithm without tables or branches, which vectorises in lanes.

/// ln x of a normal positive x, to 2 · 10⁻⁷ of max(1, |ln x|).
///
/// x = 2ᵉ m with m in [√½, √2), and ln m = 2 artanh s with s = (m − 1)/(m + 1): |s| < 0.172, so the
/// remainder after four terms of the series is below 4 · 10⁻⁸.
#[inline(always)]
pub(crate) fn ln(x: f32) -> f32 {
    const ROOT_HALF: i32 = 0x3f35_04f3;
    let bits = x.to_bits() as i32 - ROOT_HALF;
    let exponent = bits >> 23;
    let m = f32::from_bits(((bits & 0x007f_ffff) + ROOT_HALF) as u32);
    let s = (m - 1.0) / (m + 1.0);
    let q = s * s;
    let series = 1.0 + q * (1.0 / 3.0 + q * (0.2 + q * (1.0 / 7.0)));
    exponent as f32 * std::f32::consts::LN_2 + 2.0 * s * series
}

#[cfg(test)]
mod tests {
    use super::ln;

    #[test]
    fn the_result_is_the_natural_logarithm() {
        let mut x = 1e-30_f32;
        while x < 1e30 {
            let exact = f64::from(x).ln();
            let error = (f64::from(ln(x)) - exact).abs();
            assert!(error <= 2e-7 * exact.abs().max(1.0), "{error} at {x}");
            x *= 1.000_7;
        }
        assert!(ln(1.0) == 0.0);
    }
}
