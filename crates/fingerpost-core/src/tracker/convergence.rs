//! Gauss–Newton in one shape space: measure, linearise, solve, move, until nothing moves.

use super::hand::SURE;
use super::looks::{Contour, Lead, Looks, Shaft, Sight, Silhouette};
use super::neighbours::alike;
use super::normals::{KERNEL_REACH_PX, Normals, at_edge};
use super::options::{AcceptOptions, TrackerOptions};
use super::reduced::Reduction;
use super::scene::Scene;
use super::{MAX_DOF, SearchedLine, ShapeEstimate};
use crate::Result;
use crate::discriminant::{DiscriminantImage, Mixture, region_about};
use crate::dynamics::{Expectation, Gate};
use crate::fit::{EquationBuffer, Equations, FitReport, Fitter, Outcome, Prior};
use crate::frame::{Frame, SidedPixel};
use crate::refine::Finger;
use crate::search::{EdgeMeasurement, Miss, Polarity, Scale, SearchLine};
use crate::shape_space::{Axis, PlacedSample, Pose, ShapeSpace};
use crate::simd::Isa;
use crate::template::{Part, TemplateSample};
use nalgebra::{Matrix2, Point2, SMatrix, SVector, Vector3};

/// A contour has converged when no sample moves further than this \[px\]: what is left is a tenth.
const CONVERGED_PX: f64 = 0.05;
const THUMB_RESTS_PX: f64 = 0.1;
const TAKEN_OVER_PX: f64 = 1.0;
/// What the search lines shrink by once a step stays well inside them, and how short they get.
const SHRINK: f64 = 0.7;
pub(super) const MIN_HALF_LENGTH_PX: f64 = 5.0;
/// Within a window, the next lines need be no longer than this many steps.
const LEFT: f64 = 3.0;
/// Beyond that length the residual offsets' scale is not taken below this part of it: only a few
/// samples at the tip tell how far the finger has slid along itself, and must be heard.
const FAR_SCALE: f64 = 0.2;
/// Motion smears a large finger as it does a small one, in proportion: residual offsets up to this part
/// of its half-width are no reason to refuse it.
const RESIDUAL_SHARE: f64 = 0.2;
/// A sample supports a fit when its residual offset is below this \[px\].
pub(super) const SUPPORT_PX: f64 = 1.5;
/// How sharp the edges of a flank are is told by how much of the change across them, so far to either
/// side, is there already this near \[px\].
const NEAR_EDGE_PX: [f64; 2] = [1.0, 2.0];
const ABOUT_EDGE_PX: [f64; 2] = [5.0, 6.0];
/// What a hand does besides moving and turning shifts its edges by this, as a standard deviation
/// \[px\].
const BESIDES_PX: f64 = 1.0;

/// What is behind a hand where it shows no edge counts as if it had been seen in so many frames, if the
/// frame teaches nothing else: about as many are remembered.
pub(super) const UNSEEN_FRAMES: f64 = 5.0;

/// How one convergence searches.
#[derive(Debug, Clone, Copy)]
pub(super) struct Attempt<'a> {
    /// The samples that take part: every one, or one in so many.
    pub samples: &'a [TemplateSample],
    pub every: usize,
    /// What the search lines look for, and in which image.
    pub sight: Sight<'a>,
    pub scale: Scale,
    /// The longest search line.
    pub half_length_px: f64,
    /// No edge is expected further away than this \[px\]: lines need be no longer, and the fit takes
    /// those that they find as it would take them on longer ones.
    pub edges_within_px: f64,
    /// What shortens the lines further, if the hand's motion is known.
    pub window: Option<Window>,
    pub rest: Rest,
    /// Whether edges count alone that look like the hand inside.
    pub own_only: bool,
    /// The residual offsets' scale near the hand's edges is at most this \[px\].
    pub most_scale_px: f64,
}

/// What becomes of a contour that has come to rest.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Rest {
    /// It is told.
    Told,
    /// Another shape space takes over and converges itself: no fit is told.
    TakenOver,
    /// It is told; no finger line depends on where exactly it is, which is a thumb's.
    Thumb,
}

impl Rest {
    /// It rests when no sample moves further than this \[px\].
    fn px(self) -> f64 {
        match self {
            Self::Told => CONVERGED_PX,
            Self::TakenOver => TAKEN_OVER_PX,
            Self::Thumb => THUMB_RESTS_PX,
        }
    }
}

/// Where a hand that moved on is expected, and how far from there its edges are looked for.
#[derive(Debug, Clone, Copy)]
pub(super) struct Window {
    /// (c_u, c_v, θ).
    pub expected: Expectation<3>,
    pub gate: Gate,
    /// How far they are looked for once the hand is placed \[px\].
    pub near_px: f64,
    /// Whether what does not look like the hand inside of an edge is taken for what covers it.
    pub own_only: bool,
}

impl Window {
    /// What a hand that goes on as it did is believed to do; nothing is of any other.
    pub fn belief(&self) -> Option<Prior<3>> {
        let Expectation { vector, covariance } = self.expected;
        let information = covariance.try_inverse().filter(|_| self.own_only)?;
        Some(Prior { mean: vector, information })
    }

    /// How far to look along the normal of a sample: it moves with the hand, and a little besides.
    fn length(&self, placed: &PlacedSample) -> f64 {
        let PlacedSample { position, normal } = placed;
        let arm = position.coords - self.expected.vector.xy();
        let row = Vector3::new(normal.x, normal.y, arm.perp(normal));
        self.expected.search_length(&row, BESIDES_PX * BESIDES_PX, &self.gate)
    }
}

/// Where the template came to rest.
#[derive(Debug, Clone, Copy)]
pub(super) struct Converged<const D: usize> {
    pub x: SVector<f64, D>,
    /// The last fit, if it was determined.
    pub fit: Option<Fit>,
    pub iterations: usize,
    /// No edge that was found is further from here than this, for a stage that takes over \[px\];
    /// infinite where too few were found to tell, or it did not come to rest.
    pub edges_within_px: f64,
}

impl<const D: usize> Converged<D> {
    pub fn at(x: SVector<f64, D>) -> Self {
        Self { x, fit: None, iterations: 0, edges_within_px: f64::INFINITY }
    }

    /// The part of the finger's visible samples that the fit explains, 0–1; nothing without a fit.
    pub fn explains_finger(&self) -> f64 {
        self.fit.map_or(0.0, |f| f.support.of_finger())
    }

    /// Samples that the fit explains; none without a fit.
    pub fn support(&self) -> usize {
        self.fit.map_or(0, |f| f.support.supported())
    }
}

/// A determined fit, whatever its shape space.
#[derive(Debug, Clone, Copy)]
pub(super) struct Fit {
    pub shape: ShapeEstimate,
    pub axis: Axis,
    pub line_covariance: Matrix2<f64>,
    /// What became of the samples, those of a thumb that was fitted afterwards included.
    pub seen: Seen,
    /// The part of the samples that were fitted whose edges agree with the fit, 0–1.
    pub agreement: f64,
    pub support: Support,
    pub residual_rms_px: f64,
    pub rank: usize,
    /// Whether edges counted alone that look like the hand inside.
    pub own_only: bool,
    /// What led to its edges, and whether its looks told which of them are the hand's.
    pub lead: Lead,
    pub by_looks: bool,
}

/// What became of the samples of a search.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Seen {
    /// Those that no other limb hides.
    pub visible: usize,
    /// Those that found an edge.
    pub hits: usize,
    /// Those whose edge agrees with the fit.
    pub inliers: usize,
}

/// How many samples of each part of the outline a fit explains, and how many there are.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Support {
    supported: [usize; 4],
    agreeing: [usize; 4],
    visible: [usize; 4],
}

impl Support {
    pub fn supported(&self) -> usize {
        self.supported.iter().sum()
    }

    /// The part of all visible samples that is explained, 0–1.
    pub fn share(&self) -> f64 {
        self.supported() as f64 / self.visible.iter().sum::<usize>().max(1) as f64
    }

    /// The same of one part of the outline; nothing of what is not visible is explained.
    pub fn of(&self, part: Part) -> f64 {
        self.supported[part as usize] as f64 / self.visible[part as usize].max(1) as f64
    }

    /// The part of the visible samples of one part of the outline whose edges agree with the fit, 0–1:
    /// those of a smeared one scatter.
    pub fn agreeing(&self, part: Part) -> f64 {
        self.agreeing[part as usize] as f64 / self.visible[part as usize].max(1) as f64
    }

    /// The part of the finger's visible samples that is explained, 0–1.
    pub fn of_finger(&self) -> f64 {
        let parts = [Part::LeftFlank, Part::RightFlank, Part::Tip].map(|part| part as usize);
        let sum = |counts: &[usize; 4]| parts.iter().map(|&part| counts[part]).sum::<usize>();
        sum(&self.supported) as f64 / sum(&self.visible).max(1) as f64
    }

    /// How many samples of a part of the outline are explained.
    pub fn count(&self, part: Part) -> usize {
        self.supported[part as usize]
    }
}

/// How large the residual offsets of a finger of this half-width may be \[px\].
pub(super) fn max_residual_px(accept: &AcceptOptions, half_width_px: f64) -> f64 {
    accept.max_residual_px.max(RESIDUAL_SHARE * half_width_px)
}

/// The stages of one view and the buffers between them.
#[derive(Debug, Clone)]
pub(super) struct Convergence {
    /// What was searched last.
    normals: Normals,
    fitter: Fitter,
    max_iterations: usize,
    correlation: f64,
    /// Which samples are not hidden by another limb: the line of each, in order.
    visible: Vec<usize>,
    /// How far the edge of each line is from the fit to them \[px\], infinite where it does not agree with
    /// it; none does without a fit.
    left_px: Vec<f64>,
    equations: EquationBuffer,
    /// Where edges agree with the fit, and which of them look like the hand inside; where none was found.
    agreeing: Vec<PlacedSample>,
    own: Vec<bool>,
    unseen: Vec<PlacedSample>,
    /// Residual offsets of those along the contour, part by part of the outline.
    left_over: Vec<(Part, f64)>,
    /// Looks of a hand of which nothing is known: those that are judged, and those that lead, unless they
    /// are lent.
    unknown: Looks,
    leading: Option<Looks>,
    /// The present frame as the hand's discriminant shows it.
    image: DiscriminantImage,
}

impl Convergence {
    pub fn new(options: &TrackerOptions) -> Result<Self> {
        let mut leading = Looks::new(false).with_sides();
        leading.reserve(options.samples);
        Ok(Self {
            normals: Normals::new(options)?,
            fitter: Fitter::new(options.fit)?,
            max_iterations: options.max_iterations,
            correlation: options.correlation,
            visible: Vec::with_capacity(options.samples),
            left_px: Vec::with_capacity(options.samples),
            equations: EquationBuffer::with_capacity(options.samples, MAX_DOF),
            agreeing: Vec::with_capacity(options.samples),
            own: Vec::with_capacity(options.samples),
            unseen: Vec::with_capacity(options.samples),
            left_over: Vec::with_capacity(options.samples),
            unknown: Looks::new(false),
            leading: Some(leading),
            image: DiscriminantImage::default(),
        })
    }

    /// The same stages with another instruction set.
    pub fn with_isa(self, isa: Isa) -> Self {
        Self { normals: self.normals.with_isa(isa), fitter: self.fitter.with_isa(isa), ..self }
    }

    /// Forgets the last frame.
    pub fn begin_frame(&mut self) {
        self.image.clear();
    }

    /// The last search, what each line found, and whether that agrees with the fit.
    pub fn search_lines(&self) -> impl ExactSizeIterator<Item = SearchedLine<'_>> {
        let searched = self.normals.lines().iter().zip(self.normals.found());
        let found = searched.zip(&self.left_px);
        found.map(|((line, found), px)| SearchedLine { line, found, agrees: px.is_finite() })
    }

    /// Tells the last search of a picture in its frame.
    pub fn enlarge(&mut self, reduction: Reduction) {
        self.normals.enlarge(reduction);
    }

    /// Shows the finger's samples of the last search whose edges agree with the fit, each moved to
    /// its edge, and those without an edge, to the looks of the hand; see [`Looks::learn`]. The finger's
    /// are the first `samples` of all. A thumb may be lit quite differently, and it is the finger that
    /// points.
    pub fn teach(
        &mut self,
        looks: &mut Looks,
        samples: usize,
        frame: &Scene<'_>,
        finger: &Silhouette,
        weights: (f64, f64),
    ) -> Result<()> {
        if looks.is_coloured() {
            self.image.reserve(frame);
        }
        self.gather_agreeing(samples);
        self.leave_out_covered(looks, frame)?;
        self.gather_unseen(samples);
        let contour = Contour { edges: &self.agreeing, unseen: &self.unseen };
        looks.learn(frame, &mut self.image, &contour, finger, weights)
    }

    /// The same of those without an edge alone, of a hand that something may cover elsewhere.
    pub fn teach_unseen(
        &mut self,
        looks: &mut Looks,
        samples: usize,
        frame: &Scene<'_>,
        finger: &Silhouette,
    ) -> Result<()> {
        self.gather_unseen(samples);
        let contour = Contour { edges: &[], unseen: &self.unseen };
        looks.learn(frame, &mut self.image, &contour, finger, (1.0, UNSEEN_FRAMES))
    }

    /// Looks that know nothing yet, to be [given back](Self::take_back).
    pub fn lend_looks(&mut self, frame: &Frame<'_>) -> Looks {
        let coloured = frame.colour().is_some();
        let kept = self.leading.take().filter(|looks| looks.is_coloured() == coloured);
        let mut looks = kept.unwrap_or_else(|| Looks::new(coloured).with_sides());
        looks.forget();
        looks
    }

    /// Keeps looks that were lent.
    pub fn take_back(&mut self, looks: Looks) {
        self.leading = Some(looks);
    }

    /// Shows a contour to looks where it is placed, whatever edges are there; they forget all else.
    /// Tells whether what is inside of it differs at all from what is outside.
    pub fn teach_at(
        &mut self,
        looks: &mut Looks,
        frame: &Scene<'_>,
        contour: impl Iterator<Item = PlacedSample>,
        finger: &Silhouette,
    ) -> Result<bool> {
        self.agreeing.clear();
        self.agreeing.extend(contour);
        if looks.told_apart(frame, &self.agreeing, finger, None) <= 0.0 {
            return Ok(false);
        }
        looks.forget();
        let contour = Contour { edges: &self.agreeing, unseen: &[] };
        looks.learn(frame, &mut self.image, &contour, finger, (0.0, 1.0))?;
        Ok(true)
    }

    /// How well the inside of a finger of which nothing is known differs from its outside, by the edges
    /// of the last search that agree; see [`Looks::told_apart`].
    pub fn told_apart(
        &mut self,
        samples: usize,
        frame: &Scene<'_>,
        finger: &Silhouette,
        shaft: Option<&Shaft>,
    ) -> f64 {
        self.gather_agreeing(samples);
        let coloured = frame.colour().is_some();
        if self.unknown.is_coloured() != coloured {
            self.unknown = Looks::new(coloured);
        }
        self.unknown.told_apart(frame, &self.agreeing, finger, shaft)
    }

    /// How sharp the edges of the last search that agree are on the flank where they are softer, 0–1: 0.8
    /// where a step is blurred by 1 px, 0.5 by 2 px and 0.35 by 4 px.
    pub fn sharpness(&mut self, samples: usize, frame: &Frame<'_>, finger: &Silhouette) -> f64 {
        self.gather_agreeing(samples);
        let [left, right] = finger.flanks(&self.agreeing).map(|edges| {
            let (mut near, mut about) = (0.0, 0.0);
            for edge in edges {
                let [step, change] =
                    [NEAR_EDGE_PX, ABOUT_EDGE_PX].map(|px| change_across(frame, edge, px));
                if let (Some(step), Some(change)) = (step, change) {
                    near += step * change.signum();
                    about += change.abs();
                }
            }
            if about > 0.0 { (near / about).clamp(0.0, 1.0) } else { 1.0 }
        });
        left.min(right)
    }

    /// Of the finger's samples of the last search, the first `samples` of all, those whose edges agree
    /// with the fit, each moved to its edge.
    fn gather_agreeing(&mut self, samples: usize) {
        self.agreeing.clear();
        let hits = self.visible.iter().zip(self.normals.lines()).zip(self.normals.found());
        let agreeing = hits
            .filter_map(|((&i, line), found)| found.as_ref().ok().map(|edge| (i, line, edge)))
            .zip(self.fitter.weights())
            .filter(|&((i, ..), &weight)| i < samples && weight > 0.5)
            .map(|((_, line, edge), _)| at_edge(line, edge));
        self.agreeing.extend(agreeing);
    }

    /// Of the finger's samples of the last search, the first `samples` of all, those on whose lines there
    /// is no edge.
    fn gather_unseen(&mut self, samples: usize) {
        self.unseen.clear();
        let searched = self.visible.iter().zip(self.normals.lines()).zip(self.normals.found());
        let unseen = searched
            .filter(|&((&i, _), found)| i < samples && matches!(found, Err(Miss::NoContrast)))
            .map(|((_, line), _)| line.sample);
        self.unseen.extend(unseen);
    }

    /// Of the agreeing edges, forgets those that do not look like the hand inside, as long as most do:
    /// they are those of what covers it. In another light none looks like it did.
    fn leave_out_covered(&mut self, looks: &Looks, frame: &Scene<'_>) -> Result<()> {
        let Some(sight) = looks.sight(frame, Lead::HandEdges, Polarity::Unknown) else {
            return Ok(());
        };
        let edges = self.agreeing.iter().map(|edge| (edge.position, KERNEL_REACH_PX));
        let shown = self.image.shown(frame, sight.mixture, || region_about(edges))?;
        self.own.clear();
        self.own.extend(self.agreeing.iter().map(|edge| sight.is_own(frame, &shown, edge)));
        if 2 * self.own.iter().filter(|&&own| own).count() >= self.agreeing.len() {
            let mut own = self.own.iter();
            self.agreeing.retain(|_| own.next().is_some_and(|&own| own));
        }
        Ok(())
    }

    /// Where along its limb each visible sample of a part of the outline is in the last search, in units
    /// of the template, and how far its edge is from the fit \[px\]: infinitely, if it does not agree.
    /// None without an edge.
    pub fn edges_along(
        &self,
        samples: &[TemplateSample],
        part: Part,
    ) -> impl DoubleEndedIterator<Item = (f64, Option<f64>)> {
        let told = self.normals.found().iter().zip(&self.left_px);
        let searched = self.visible.iter().zip(told);
        searched.filter_map(move |(&i, (found, &px))| {
            let sample = samples.get(i).filter(|s| s.part() == part)?;
            Some((sample.along, found.is_ok().then_some(px)))
        })
    }

    /// The frame about a finger, as a mixture shows it.
    pub fn shown<'a>(
        &'a mut self,
        frame: &Frame<'a>,
        mixture: Option<&Mixture>,
        finger: &Finger,
    ) -> Result<Frame<'a>> {
        self.image.shown(frame, mixture, || finger_region(finger))
    }

    /// The frame about some pixels, as a mixture shows it.
    pub fn shown_about<'a>(
        &'a mut self,
        frame: &Frame<'a>,
        mixture: Option<&Mixture>,
        pixels: impl Iterator<Item = Point2<f64>>,
        reach_px: f64,
    ) -> Result<Frame<'a>> {
        self.image.shown(frame, mixture, || region_about(pixels.map(|p| (p, reach_px))))
    }

    /// From `x`, where the image takes it in this space. `believed` is a prior on the shape vector
    /// itself.
    pub fn run<S: ShapeSpace<D>, const D: usize>(
        &mut self,
        frame: &Scene<'_>,
        space: &S,
        x: SVector<f64, D>,
        attempt: &Attempt<'_>,
        believed: Option<&Prior<D>>,
    ) -> Result<Converged<D>> {
        let mut half_length_px = attempt.half_length_px;
        let mut at = Converged::at(x);
        let mut last = None;
        while at.iterations < self.max_iterations {
            at.iterations += 1;
            let pose = space.pose(&at.x);
            let searched_px = half_length_px.min(attempt.edges_within_px);
            self.measure(frame, &pose, attempt, searched_px)?;
            let prior = believed.map(|b| Prior { mean: b.mean - at.x, information: b.information });
            let samples = self.visible.iter().map(|&i| &attempt.samples[i]);
            let measured = samples.zip(self.normals.lines()).zip(self.normals.found());
            let equations = linearise(space, &pose, measured, &mut self.equations)?;
            let far_px = (half_length_px - MIN_HALF_LENGTH_PX).max(0.0) * FAR_SCALE;
            let least_px = self.fitter.options().min_scale_px.max(far_px);
            let scales_px = (least_px, attempt.most_scale_px);
            let fit = self.fitter.solve_with_scale(&equations, prior.as_ref(), scales_px);
            if fit.outcome != Outcome::Determined {
                return Ok(Converged { fit: None, ..at });
            }
            let moved_px = equations.largest_motion(&fit.step);
            at.x += fit.step;
            last = Some(fit);
            if moved_px < attempt.rest.px() {
                at.edges_within_px = self.edges_within_px(moved_px);
                break;
            }
            if moved_px < half_length_px / 2.0 {
                let shrunk_px = half_length_px * SHRINK;
                // In its window, one step brings the contour most of the way.
                let left_px = attempt.window.map_or(shrunk_px, |_| LEFT * moved_px);
                half_length_px = shrunk_px.min(left_px).max(MIN_HALF_LENGTH_PX);
            }
        }
        if attempt.rest != Rest::TakenOver {
            self.mark_agreeing();
            at.fit = last.map(|fit| self.summarise(space, &at.x, &fit, attempt));
        }
        Ok(at)
    }

    /// No edge that the last search found is further than this from its solution, whose step moved the
    /// contour so far; infinite where so many lines found none that theirs may be beyond them.
    fn edges_within_px(&self, moved_px: f64) -> f64 {
        let residuals = self.fitter.residuals();
        if (residuals.len() as f64) < SURE * self.normals.lines().len() as f64 {
            return f64::INFINITY;
        }
        let furthest_px = residuals.iter().fold(0.0, |px: f64, r| px.max(r.abs()));
        (furthest_px + LEFT * moved_px).max(MIN_HALF_LENGTH_PX)
    }

    /// As how many edge measurements that are independent the last ones count once.
    fn alike(&mut self, samples: &[TemplateSample]) -> f64 {
        let Self { visible, normals, fitter, left_over, .. } = self;
        let hits = visible.iter().zip(normals.found()).filter(|(_, found)| found.is_ok());
        let told = hits.zip(fitter.residuals()).zip(fitter.agreeing());
        let agreeing = told.filter(|(_, agrees)| *agrees);
        left_over.clear();
        left_over.extend(agreeing.map(|(((&i, _), &px), _)| (samples[i].part(), px)));
        alike(left_over)
    }

    /// The samples of the contour at `x` that nothing hides, in order, and the offsets of the edges that
    /// they find, without fitting anything.
    pub fn sought<S: ShapeSpace<D>, const D: usize>(
        &mut self,
        frame: &Scene<'_>,
        space: &S,
        x: &SVector<f64, D>,
        attempt: &Attempt<'_>,
    ) -> Result<impl Iterator<Item = (usize, Option<f64>)>> {
        self.measure(frame, &space.pose(x), attempt, attempt.half_length_px)?;
        let offsets = self.normals.found().iter().map(|found| Some(found.as_ref().ok()?.offset_px));
        Ok(self.visible.iter().copied().zip(offsets))
    }

    /// Searches the image along the normals of the contour as `pose` places it.
    fn measure<P: Pose>(
        &mut self,
        frame: &Scene<'_>,
        pose: &P,
        attempt: &Attempt<'_>,
        half_length_px: f64,
    ) -> Result<()> {
        self.visible.clear();
        self.normals.clear();
        for (i, sample) in attempt.samples.iter().enumerate().step_by(attempt.every) {
            let placed = pose.place(sample);
            if !pose.is_hidden(sample, &placed) {
                self.visible.push(i);
                let line = SearchLine {
                    sample: placed,
                    half_length_px: attempt
                        .window
                        .map_or(half_length_px, |w| w.length(&placed).min(half_length_px)),
                    polarity: attempt.sight.polarity,
                };
                self.normals.push(sample.part(), line);
            }
        }
        self.left_px.clear();
        self.left_px.resize(self.visible.len(), f64::INFINITY);
        let Attempt { sight, scale, own_only, .. } = attempt;
        let shown = self.image.shown(frame, sight.mixture, || self.normals.region())?;
        self.normals.search(frame, &shown, sight, *scale, *own_only)
    }

    /// The part of the visible contour of the first `samples` whose edges the last fit explains to
    /// within so much, and which look like the hand inside, 0–1.
    pub fn own_share(
        &mut self,
        frame: &Scene<'_>,
        sight: &Sight<'_>,
        samples: usize,
        within_px: f64,
    ) -> Result<f64> {
        let shown = self.image.shown(frame, sight.mixture, || self.normals.region())?;
        let mut residuals = self.fitter.residuals().iter();
        let (mut own, mut visible) = (0_usize, 0_usize);
        for (line, (&i, found)) in self.visible.iter().zip(self.normals.found()).enumerate() {
            let is_near = found.is_ok() && residuals.next().is_some_and(|r| r.abs() < within_px);
            if i < samples {
                visible += 1;
                own += usize::from(is_near && self.normals.is_own(line, frame, &shown, sight));
            }
        }
        Ok(own as f64 / visible.max(1) as f64)
    }

    /// Notes how far edges are from the last solution, if they agree with it.
    fn mark_agreeing(&mut self) {
        let hits = self.left_px.iter_mut().zip(self.normals.found()).filter(|(_, m)| m.is_ok());
        let fitted = self.fitter.residuals().iter().zip(self.fitter.agreeing());
        for ((left_px, _), (residual_px, agrees)) in hits.zip(fitted) {
            if agrees {
                *left_px = residual_px.abs();
            }
        }
    }

    /// Which samples the last solution explains: those whose edge it leaves close by.
    fn support(&self, samples: &[TemplateSample]) -> Support {
        let mut support = Support::default();
        let mut fitted = self.fitter.residuals().iter().zip(self.fitter.agreeing());
        for (&i, found) in self.visible.iter().zip(self.normals.found()) {
            let part = samples[i].part() as usize;
            support.visible[part] += 1;
            if let Some((residual_px, agrees)) = found.as_ref().ok().and_then(|_| fitted.next()) {
                support.supported[part] += usize::from(residual_px.abs() < SUPPORT_PX);
                support.agreeing[part] += usize::from(agrees);
            }
        }
        support
    }

    fn summarise<S: ShapeSpace<D>, const D: usize>(
        &mut self,
        space: &S,
        x: &SVector<f64, D>,
        fit: &FitReport<D>,
        attempt: &Attempt<'_>,
    ) -> Fit {
        // Counted already: that neighbours share pixels.
        let alike = (self.alike(attempt.samples) / self.correlation).max(1.0);
        let covariance = fit.covariance * self.correlation;
        let pose = space.pose(x);
        let j = space.axis_jacobian(&pose);
        let mut shape = ShapeEstimate {
            names: &S::NAMES,
            vector: SVector::zeros(),
            covariance: SMatrix::zeros(),
        };
        shape.vector.rows_mut(0, D).copy_from(x);
        shape.covariance.view_mut((0, 0), (D, D)).copy_from(&covariance);
        Fit {
            shape,
            axis: pose.axis(),
            line_covariance: j * covariance * j.transpose() * alike,
            seen: Seen { visible: self.visible.len(), hits: fit.equations, inliers: fit.inliers },
            agreement: fit.inliers as f64 / self.visible.len().max(1) as f64,
            support: self.support(attempt.samples),
            residual_rms_px: fit.residual_rms_px,
            rank: fit.rank,
            own_only: attempt.own_only,
            lead: attempt.sight.lead,
            by_looks: attempt.sight.cue.appearance().is_some(),
        }
    }
}

/// By how many grey levels what is inside of an edge differs from what is outside, the mean of so far to
/// either side; none where that is outside of the image.
fn change_across(frame: &Frame<'_>, edge: &PlacedSample, px: [f64; 2]) -> Option<f64> {
    let level = |px: f64| {
        let at = SidedPixel::at(
            edge.position.x + edge.normal.x * px,
            edge.position.y + edge.normal.y * px,
            true,
        )?;
        frame.image().pixel(at.x as usize, at.y as usize).map(f64::from)
    };
    let [first, second] = px.map(|px| Some(level(-px)? - level(px)?));
    Some(0.5 * (first? + second?))
}

/// One equation for every edge that a search found.
fn linearise<'a, S: ShapeSpace<D>, const D: usize>(
    space: &S,
    pose: &S::Pose,
    measured: impl Iterator<Item = ((&'a TemplateSample, &'a SearchLine), &'a EdgeMeasurement)>,
    buffer: &'a mut EquationBuffer,
) -> Result<Equations<'a, D>> {
    let mut equations = buffer.clear::<D>();
    for ((sample, line), measurement) in measured {
        if let Ok(edge) = measurement {
            let row = space.normal_row(pose, sample, &line.sample.normal);
            equations.push(&row, edge.offset_px, edge.variance_px2)?;
        }
    }
    Ok(equations)
}

/// The part of the image that a finger is refined in.
pub(super) fn finger_region(finger: &Finger) -> [f64; 4] {
    let (axis, reach) = (finger.axis, 2.0 * finger.half_width_px + KERNEL_REACH_PX);
    let from = finger.flanks[0].from_px.min(finger.flanks[1].from_px);
    let ends = [axis.tip, axis.anchor + axis.direction() * from];
    region_about(ends.iter().map(|end| (*end, reach)))
}
