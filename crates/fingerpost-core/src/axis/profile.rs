//! Model of the grey levels near one flank, and its derivatives.
//!
//! A pixel lies y outside the edge of its flank. With blur s, depth z = −y / s and
//! Mₖ(z) = E\[(z + Z)₊ᵏ\], its grey level is
//!
//! ```text
//! I = β + (α − β) M₀(z) + l √(2 s / W) M½(z) + c (s / W) M₁(z)
//! α = a + a₁ p        β = B + b + b₁ p
//! ```
//!
//! a is the level of the finger at the flank and b that of the background; a₁ and b₁ are their
//! changes along the finger. A diffuse cylinder of half-width W adds l √(1 − (1 − depth/W)²) + c
//! depth / W for light from the camera and from the side; the model has the first term in l of its
//! expansion. B is the known background or zero. The background is known as the camera blurs it,
//! whereas the finger covers it before the blur: to second order in its derivatives B′, B″ outward,
//! E\[B(y + s Z); outside\] = B Φ(−z) + B′ s φ + ½ B″ s² z φ.
//!
//! Beyond e, the centre of the round end, the outline is a circle of radius R: with u = p − e the
//! distance is √(u² + (y + R)²) − R. Blur moves a curved edge inwards, by s² / 2R on the circle,
//! and by E\[(u + s Z)₊²\] / 2R − u₊² / 2R near its start.
//!
//! The profile of the blurred step is exact for a Gaussian point spread function on square pixels
//! up to its fourth moment, with s² the blur's variance plus 1/12 px².

#![expect(
    clippy::inline_always,
    reason = "what is inlined into a function with wider instructions is compiled for them"
)]
#![expect(
    clippy::needless_range_loop,
    reason = "lane by lane through many arrays at once is what the compiler turns into vectors"
)]

use super::blur::BlurTable;
use super::pixels::{Chunk, LANES, PixelLanes};

/// Derivatives of a pixel's grey level by the parameters of its block, and one more column for the
/// right side of the equations.
pub const COLUMNS: usize = 8;
/// By the position of the edge, outward \[grey levels / px\].
pub const EDGE: usize = 0;
/// By the inside level a, and by the background level b.
pub const INSIDE: usize = 1;
pub const OUTSIDE: usize = 2;
/// By the blur s \[grey levels / px\].
pub const BLUR: usize = 3;
/// By the slope c and by the limb l.
pub const RAMP: usize = 4;
pub const LIMB: usize = 5;
/// The right side: the residual of the pixel against the model \[grey levels\].
pub const RIGHT: usize = 6;
/// By the centre of the round end \[grey levels / px\]; zero clear of the end. The last column.
pub const END: usize = 7;

/// Parameters of the pixels of some blocks; those in lanes differ from block to block.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Profile {
    /// Edge at v = e₀ + e₁ p + e₂ p² \[px\].
    pub edge: PixelLanes,
    pub edge_change: [f32; 2],
    /// Blur s \[px\], positive.
    pub blur: f32,
    /// a, a₁ and b, b₁ \[grey levels, per px\].
    pub inside: PixelLanes,
    pub inside_change: f32,
    pub outside: PixelLanes,
    pub outside_change: f32,
    /// c and l \[grey levels\].
    pub ramp: f32,
    pub limb: f32,
    /// W \[px\], positive.
    pub half_width: PixelLanes,
}

/// Factors of the shading of some blocks: √(2 s / W) and 1 / W.
#[derive(Debug, Clone, Copy)]
pub struct Shading {
    root: PixelLanes,
    per_width: PixelLanes,
}

/// The round end of a finger.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RoundEnd {
    /// e \[px\].
    pub middle: f32,
    /// R \[px\], positive.
    pub radius: f32,
}

/// Distance before the round end beyond which its effect is negligible \[standard deviations of the
/// blur\].
pub const CLEAR: f64 = 4.5;
/// Lower bound on the distance from the centre of the round end, in radii: no direction is outward
/// there.
const LEAST_RANGE: f32 = 0.1;

/// Predictions of the model for some pixels.
#[derive(Debug, Clone, Copy)]
pub struct ProfilePrediction {
    pub grey: PixelLanes,
    /// The derivatives, by column; the column of the right side is filled later.
    pub columns: [PixelLanes; COLUMNS],
}

/// A pixel's distance outside its edge, and the derivatives of that distance.
#[derive(Default)]
struct Distance {
    y: PixelLanes,
    /// By the distance from the straight flank, by u and by s.
    by_flank: PixelLanes,
    by_u: PixelLanes,
    by_blur: PixelLanes,
    /// Derivatives of `by_flank`, the cosine of the outline's inclination.
    by_flank_twice: PixelLanes,
    by_flank_and_u: PixelLanes,
}

impl Profile {
    /// The factors common to all pixels of the blocks.
    #[inline(always)]
    pub fn shading(&self) -> Shading {
        let (mut root, mut per_width) = ([0.0; LANES], [0.0; LANES]);
        for i in 0..LANES {
            root[i] = (2.0 * self.blur / self.half_width[i]).sqrt();
            per_width[i] = 1.0 / self.half_width[i];
        }
        Shading { root, per_width }
    }

    /// The distance from the straight flank.
    #[inline(always)]
    fn beyond_flank(&self, chunk: &Chunk) -> PixelLanes {
        let [e1, e2] = self.edge_change;
        let mut y = [0.0; LANES];
        for i in 0..LANES {
            let p = chunk.p[i];
            y[i] = chunk.v[i] - (self.edge[i] + p * (e1 + p * e2));
        }
        y
    }

    /// The prediction for pixels clear of the round end.
    #[inline(always)]
    pub fn straight(
        &self,
        shading: &Shading,
        table: BlurTable,
        chunk: &Chunk,
    ) -> ProfilePrediction {
        let y = self.beyond_flank(chunk);
        let s = self.blur;
        let per_blur = 1.0 / s;
        let none = [0.0; LANES];
        let mut z = none;
        for i in 0..LANES {
            z[i] = -y[i] * per_blur;
        }
        let m = table.moments(&z);
        let (mut grey, mut by_edge, mut by_blur) = (none, none, none);
        let (mut by_outside, mut by_ramp, mut by_limb) = (none, none, none);
        for i in 0..LANES {
            let (root, per_width) = (shading.root[i], shading.per_width[i]);
            let (ramp, limb) = (self.ramp * per_width, self.limb * root);
            let (share, density, p) = (m.step[i], m.step_slope[i], chunk.p[i]);
            let (slope, curvature) = (chunk.background_slope[i], chunk.background_curvature[i]);
            let outside = chunk.background[i] + self.outside[i] + self.outside_change * p;
            let step = self.inside[i] + self.inside_change * p - outside;
            let rise = s * density - y[i] * share;
            let behind = slope * s + 0.5 * curvature * s * s * z[i];
            let by_z = limb * m.root_slope[i]
                + density
                    * (step - slope * s * z[i] + 0.5 * curvature * s * s * (1.0 - z[i] * z[i]));
            grey[i] = outside + step * share + density * behind + ramp * rise + limb * m.root[i];
            by_edge[i] = by_z * per_blur + ramp * share;
            by_blur[i] = (0.5 * limb * m.root[i] - by_z * z[i]) * per_blur
                + density * (ramp + slope + curvature * s * z[i]);
            by_outside[i] = 1.0 - share;
            by_ramp[i] = rise * per_width;
            by_limb[i] = m.root[i] * root;
        }
        let columns = [by_edge, m.step, by_outside, by_blur, by_ramp, by_limb, none, none];
        ProfilePrediction { grey, columns }
    }

    /// The prediction for pixels near the round end.
    #[inline(always)]
    pub fn round(
        &self,
        shading: &Shading,
        table: BlurTable,
        chunk: &Chunk,
        end: RoundEnd,
    ) -> ProfilePrediction {
        let from_flank = self.beyond_flank(chunk);
        let s = self.blur;
        let per_blur = 1.0 / s;
        let d = end.distance(table, &from_flank, &chunk.p, s);
        let none = [0.0; LANES];
        let mut z = none;
        for i in 0..LANES {
            z[i] = -d.y[i] * per_blur;
        }
        let m = table.moments(&z);
        let (mut grey, mut by_edge, mut by_blur, mut by_end) = (none, none, none, none);
        let (mut by_outside, mut by_ramp, mut by_limb) = (none, none, none);
        for i in 0..LANES {
            let (root, per_width) = (shading.root[i], shading.per_width[i]);
            let (ramp, limb) = (self.ramp * per_width, self.limb * root);
            let (share, density, p) = (m.step[i], m.step_slope[i], chunk.p[i]);
            let (slope, curvature) = (chunk.background_slope[i], chunk.background_curvature[i]);
            let outside = chunk.background[i] + self.outside[i] + self.outside_change * p;
            let step = self.inside[i] + self.inside_change * p - outside;
            // The ramp depends on the distance from the flank, whereas the blur acts along the
            // outline's normal.
            let blur_across = s * d.by_flank[i];
            let rise = blur_across * density - from_flank[i] * share;
            let behind = slope * s + 0.5 * curvature * s * s * z[i];
            let by_z = limb * m.root_slope[i]
                + density
                    * (step - slope * s * z[i] + 0.5 * curvature * s * s * (1.0 - z[i] * z[i])
                        - ramp * (from_flank[i] + blur_across * z[i]));
            let (by_y, by_blur_across) = (-by_z * per_blur, ramp * s * density);
            grey[i] = outside + step * share + density * behind + ramp * rise + limb * m.root[i];
            by_edge[i] = ramp * share - by_y * d.by_flank[i] - by_blur_across * d.by_flank_twice[i];
            by_blur[i] = 0.5 * limb * m.root[i] * per_blur
                + by_y * (d.by_blur[i] + z[i])
                + density * (ramp * d.by_flank[i] + slope + curvature * s * z[i]);
            by_end[i] = -(by_y * d.by_u[i] + by_blur_across * d.by_flank_and_u[i]);
            by_outside[i] = 1.0 - share;
            by_ramp[i] = rise * per_width;
            by_limb[i] = m.root[i] * root;
        }
        let columns = [by_edge, m.step, by_outside, by_blur, by_ramp, by_limb, none, by_end];
        ProfilePrediction { grey, columns }
    }
}

impl RoundEnd {
    #[inline(always)]
    fn distance(
        self,
        table: BlurTable,
        from_flank: &PixelLanes,
        p: &PixelLanes,
        s: f32,
    ) -> Distance {
        let radius = self.radius;
        let mut d = Distance::default();
        let mut depth = [0.0; LANES];
        for i in 0..LANES {
            depth[i] = (p[i] - self.middle) / s;
        }
        let end_moments = table.moments(&depth);
        for i in 0..LANES {
            let u = p[i] - self.middle;
            let (step, density) = (end_moments.step[i], end_moments.step_slope[i]);
            // E[(u + s Z)₊²], halved, and its derivative by u.
            let smooth = 0.5 * ((u * u + s * s) * step + u * s * density);
            let smooth_by_u = u * step + s * density;
            let sharp = u.max(0.0);
            let from_middle = from_flank[i] + radius;
            let range =
                (sharp * sharp + from_middle * from_middle).sqrt().max(LEAST_RANGE * radius);
            let cube = range * range * range;
            d.y[i] = range - radius + (smooth - 0.5 * sharp * sharp) / radius;
            d.by_flank[i] = from_middle / range;
            d.by_u[i] = sharp / range + (smooth_by_u - sharp) / radius;
            d.by_blur[i] = s * step / radius;
            d.by_flank_twice[i] = sharp * sharp / cube;
            d.by_flank_and_u[i] = -sharp * from_middle / cube;
        }
        d
    }
}

// The profile is private; the tests compare its derivatives with differences.
#[cfg(test)]
mod tests {
    use super::*;
    use std::array::from_fn;

    /// Step of the differences, and their tolerance: rounding of grey levels to single precision
    /// over the step, and its fourth power.
    const STEP: f32 = 0.05;
    const TOLERANCE: f32 = 4e-3;

    fn chunk(p: f32, v: f32, slope: f32) -> Chunk {
        let mut chunk = Chunk::default();
        for i in 0..LANES {
            let along = i as f32 / LANES as f32;
            chunk.p[i] = p + 3.0 * along;
            chunk.v[i] = v - 4.0 + 7.0 * ((5 * i) % LANES) as f32 / LANES as f32;
            chunk.background[i] = 40.0 + 20.0 * along;
            chunk.background_slope[i] = slope * (along - 0.5);
            chunk.background_curvature[i] = 0.5 * slope * along;
        }
        chunk
    }

    fn profile() -> Profile {
        Profile {
            edge: from_fn(|i| 8.0 + 0.03 * i as f32),
            edge_change: [-0.01, 1e-4],
            blur: 1.1,
            inside: from_fn(|i| 150.0 - i as f32),
            inside_change: 0.1,
            outside: from_fn(|i| 3.0 + 0.5 * i as f32),
            outside_change: -0.05,
            ramp: 25.0,
            limb: 40.0,
            half_width: from_fn(|i| 8.2 + 0.02 * i as f32),
        }
    }

    fn perturbed(
        profile: &Profile,
        mut end: RoundEnd,
        feature: usize,
        by: f32,
    ) -> (Profile, RoundEnd) {
        let mut profile = *profile;
        match feature {
            EDGE => profile.edge = profile.edge.map(|e| e + by),
            BLUR => profile.blur += by,
            END => end.middle += by,
            INSIDE => profile.inside = profile.inside.map(|a| a + by),
            OUTSIDE => profile.outside = profile.outside.map(|b| b + by),
            RAMP => profile.ramp += by,
            _ => profile.limb += by,
        }
        (profile, end)
    }

    /// Five-point central differences of every feature at every pixel.
    fn check(p: f32, predict: impl Fn(&Profile, RoundEnd, &Chunk) -> ProfilePrediction) {
        let (profile, end) = (profile(), RoundEnd { middle: 25.0, radius: 7.8 });
        for slope in [0.0, 6.0] {
            let chunk = chunk(p, 8.0, slope);
            let analytic = predict(&profile, end, &chunk).columns;
            for (feature, analytic) in analytic.iter().enumerate().filter(|f| f.0 != RIGHT) {
                let at = |steps: f32| {
                    let (profile, end) = perturbed(&profile, end, feature, steps * STEP);
                    predict(&profile, end, &chunk).grey
                };
                let [far_below, below, above, far_above] = [-2.0, -1.0, 1.0, 2.0].map(at);
                for i in 0..LANES {
                    let near = 8.0 * (above[i] - below[i]);
                    let difference = (near - (far_above[i] - far_below[i])) / (12.0 * STEP);
                    let error = (analytic[i] - difference).abs();
                    assert!(
                        error < TOLERANCE * (1.0 + analytic[i].abs()),
                        "feature {feature}, pixel {i} at p = {p}: {} and {difference}",
                        analytic[i]
                    );
                }
            }
        }
    }

    #[test]
    fn derivatives_on_the_straight_flank_match_differences() {
        for p in [-30.0, 0.0, 12.0] {
            check(p, |profile, _, chunk| {
                profile.straight(&profile.shading(), BlurTable::new(), chunk)
            });
        }
    }

    #[test]
    fn derivatives_near_the_round_end_match_differences() {
        // Not across its centre, where the second derivative of the outline is discontinuous.
        for p in [18.0, 21.5, 25.2, 27.5] {
            check(p, |profile, end, chunk| {
                profile.round(&profile.shading(), BlurTable::new(), chunk, end)
            });
        }
    }

    #[test]
    fn far_from_the_round_end_both_models_agree() {
        let (profile, end) = (profile(), RoundEnd { middle: 25.0, radius: 7.8 });
        let chunk = chunk(-10.0, 8.0, 3.0);
        let shading = profile.shading();
        let straight = profile.straight(&shading, BlurTable::new(), &chunk);
        let round = profile.round(&shading, BlurTable::new(), &chunk, end);
        for i in 0..LANES {
            assert!((straight.grey[i] - round.grey[i]).abs() < 1e-3);
            assert!((straight.columns[EDGE][i] - round.columns[EDGE][i]).abs() < 1e-3);
        }
    }
}
