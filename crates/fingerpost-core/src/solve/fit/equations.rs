//! Weighted linear equations, stored in groups of lanes.

use crate::numeric::simd::each;
use crate::{Error, Result};
use nalgebra::SVector;

/// Number of equations processed together, and of residual sizes counted together.
pub(super) const LANES: usize = 4;

/// One number of each of them.
pub(super) type Lanes = [f64; LANES];

/// A group of equations, lane by lane.
pub(super) struct Group<'a, const D: usize> {
    pub(super) rows: &'a [Lanes; D],
    pub(super) offsets_px: &'a Lanes,
}

impl<const D: usize> Group<'_, D> {
    /// Motion of each sample along its normal by a step \[px\].
    #[inline(always)]
    pub(super) fn moved_by(&self, step: &SVector<f64, D>) -> Lanes {
        let mut moved = [0.0; LANES];
        for i in 0..D {
            moved = each(|j| moved[j] + self.rows[i][j] * step[i]);
        }
        moved
    }
}

/// Storage for equations of any number of unknowns, reused from solve to solve.
#[derive(Debug, Clone, Default)]
pub struct EquationBuffer {
    count: usize,
    /// Row components of `LANES` equations, component by component; then of the next ones. Lanes
    /// without an equation have zeros, a zero offset and a variance of one.
    rows: Vec<Lanes>,
    pub(super) offsets_px: Vec<Lanes>,
    pub(super) variances_px2: Vec<Lanes>,
}

impl EquationBuffer {
    /// A buffer that holds `equations` equations of `unknowns` unknowns without allocating.
    #[must_use]
    pub fn with_capacity(equations: usize, unknowns: usize) -> Self {
        let groups = equations.div_ceil(LANES);
        Self {
            count: 0,
            rows: Vec::with_capacity(groups * unknowns),
            offsets_px: Vec::with_capacity(groups),
            variances_px2: Vec::with_capacity(groups),
        }
    }

    /// Empties the buffer for equations of `D` unknowns.
    pub fn clear<const D: usize>(&mut self) -> Equations<'_, D> {
        self.count = 0;
        self.rows.clear();
        self.offsets_px.clear();
        self.variances_px2.clear();
        Equations(self)
    }

    /// Makes room for the next equations. (Separate, so that [`Equations::push`] is inlined.)
    #[inline(always)]
    fn begin_group<const D: usize>(&mut self) {
        self.rows.extend_from_slice(&[[0.0; LANES]; D]);
        self.offsets_px.push([0.0; LANES]);
        self.variances_px2.push([1.0; LANES]);
    }
}

/// Refuses an equation with numbers that are not finite, or without a positive variance.
#[cold]
fn check(sum_of_row: f64, offset_px: f64, variance_px2: f64) -> Result<()> {
    Error::finite("offset [px]", offset_px)?;
    Error::finite("row of the Jacobian", sum_of_row)?;
    Error::within("variance [px²]", variance_px2, "positive", |v| v > 0.0)?;
    Ok(())
}

/// Linear equations for the step: row · δ = offset ± √variance.
#[derive(Debug)]
pub struct Equations<'a, const D: usize>(pub(super) &'a mut EquationBuffer);

impl<const D: usize> Equations<'_, D> {
    /// Adds an equation: `row` = ∂(n·X)/∂x, the measured offset along the normal \[px\] and its
    /// variance \[px²\], positive.
    ///
    /// # Errors
    /// When a number is not finite or the variance not positive; nothing is added then.
    #[inline(always)]
    pub fn push(&mut self, row: &SVector<f64, D>, offset_px: f64, variance_px2: f64) -> Result<()> {
        if !((offset_px + row.sum()).is_finite() && variance_px2 > 0.0 && variance_px2 <= f64::MAX)
        {
            check(row.sum(), offset_px, variance_px2)?;
        }
        let buffer = &mut *self.0;
        let lane = buffer.count % LANES;
        if lane == 0 {
            buffer.begin_group::<D>();
        }
        if let (Some(rows), Some(offsets_px), Some(variances_px2)) = (
            buffer.rows.last_chunk_mut::<D>(),
            buffer.offsets_px.last_mut(),
            buffer.variances_px2.last_mut(),
        ) {
            for i in 0..D {
                rows[i][lane] = row[i];
            }
            offsets_px[lane] = offset_px;
            variances_px2[lane] = variance_px2;
            buffer.count += 1;
        }
        Ok(())
    }

    /// Number of equations.
    #[must_use]
    pub fn len(&self) -> usize {
        self.0.count
    }

    /// Whether there are no equations.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.0.count == 0
    }

    /// Largest motion of a sample of the contour along its normal by `step` \[px\].
    #[must_use]
    pub fn largest_motion(&self, step: &SVector<f64, D>) -> f64 {
        // Lanes without an equation do not move.
        let moved = self.groups().map(|group| group.moved_by(step));
        moved.flatten().fold(0.0, |most, moved| moved.abs().max(most))
    }

    #[inline(always)]
    pub(super) fn groups(&self) -> impl Iterator<Item = Group<'_, D>> {
        let rows = self.0.rows.as_chunks::<D>().0.iter();
        rows.zip(&self.0.offsets_px).map(|(rows, offsets_px)| Group { rows, offsets_px })
    }
}
