//! Gauss–Newton in one shape space: measure, linearise, solve, update, until convergence.

use super::appearance::{AppearanceModel, EdgeCue, SearchModel};
use super::design_effect::design_effect;
use super::estimate::{MAX_DOF, ShapeEstimate};
use super::fit_result::FitResult;
use super::normals::{Normals, SURROUNDINGS_PX, SearchedLine, at_edge};
use super::options::{MIN_HALF_LENGTH_PX, TrackerOptions};
use super::pyramid::PyramidLevel;
use super::scene::Scene;
use super::silhouette::{Shaft, Silhouette};
use super::stage::{EdgeCounts, Fit, FitStage, SUPPORT_PX, SURE, StagePurpose, Support};
use crate::Result;
use crate::appearance::discriminant::{DiscriminantImage, Mixture, region_about};
use crate::axis::Finger;
use crate::geometry::shape_space::{PlacedSample, Pose, ShapeSpace};
use crate::geometry::template::{Part, TemplateSample};
use crate::image::frame::{Frame, SidedPixel};
use crate::measure::edge::{EdgeMeasurement, Polarity, SearchLine};
use crate::numeric::ablation::{Mechanism, is_off};
use crate::numeric::simd::Isa;
use crate::solve::fit::{EquationBuffer, Equations, FitReport, Fitter, Outcome, Prior};
use nalgebra::{Point2, SMatrix, SVector};

/// Factor by which the search lines shrink once a step is shorter than half their half-length.
const SHRINK: f64 = 0.7;
/// Bound on the motion that remains until convergence, in units of the last step: within a window,
/// the half-length of the next search lines.
const MAX_REMAINING_STEPS: f64 = 3.0;
/// Lower bound of the residual offsets' scale, as a fraction of the half-length beyond
/// [`MIN_HALF_LENGTH_PX`]: only a few samples at the tip determine how far the finger has slid
/// along itself, and must keep their weight.
const FAR_SCALE: f64 = 0.2;
/// Least robust weight of an edge by which appearance, separation and sharpness are measured. It is
/// stricter than that of an inlier of the fit, 0.1, which is only counted: the pixels beside these
/// edges are taken for those of the hand and of its background.
const LEARNED_MIN_WEIGHT: f64 = 0.5;
/// Sharpness of a flank: the grey-level difference across its edges at these distances to either
/// side, relative to that at [`ABOUT_EDGE_PX`] \[px\].
const NEAR_EDGE_PX: [f64; 2] = [1.0, 2.0];
/// Distances at which the full grey-level difference is measured \[px\].
const ABOUT_EDGE_PX: [f64; 2] = [5.0, 6.0];

/// The stages of one view and the buffers between them.
#[derive(Debug, Clone)]
pub(super) struct Convergence {
    /// The last search.
    normals: Normals,
    fitter: Fitter,
    max_iterations: usize,
    correlation: f64,
    /// Indices of the samples that no other limb hides, in the order of the search lines.
    visible: Vec<usize>,
    /// Absolute residual of the edge of each line \[px\]; infinite where it does not agree with the
    /// fit, or without a fit.
    abs_residuals_px: Vec<f64>,
    equations: EquationBuffer,
    /// Edges that agree with the fit, and whether each matches the appearance model inside.
    agreeing: Vec<PlacedSample>,
    matches: Vec<bool>,
    /// Residual offsets of the agreeing edges along the contour, with their part of the outline.
    agreeing_residuals: Vec<(Part, f64)>,
    /// Appearance models of an unknown hand: one for evaluating separation, and one for leading the
    /// search, `None` while lent.
    unknown: AppearanceModel,
    leading: Option<AppearanceModel>,
    /// The present frame as the hand's discriminant shows it.
    image: DiscriminantImage,
}

impl Convergence {
    pub fn new(options: &TrackerOptions) -> Result<Self> {
        let mut leading = AppearanceModel::new(false).with_flank_levels();
        leading.reserve(options.samples);
        Ok(Self {
            normals: Normals::new(options)?,
            fitter: Fitter::new(options.fit)?,
            max_iterations: options.max_iterations,
            correlation: options.correlation,
            visible: Vec::with_capacity(options.samples),
            abs_residuals_px: Vec::with_capacity(options.samples),
            equations: EquationBuffer::with_capacity(options.samples, MAX_DOF),
            agreeing: Vec::with_capacity(options.samples),
            matches: Vec::with_capacity(options.samples),
            agreeing_residuals: Vec::with_capacity(options.samples),
            unknown: AppearanceModel::new(false),
            leading: Some(leading),
            image: DiscriminantImage::default(),
        })
    }

    /// The same stages with another instruction set.
    pub fn with_isa(self, isa: Isa) -> Self {
        Self { normals: self.normals.with_isa(isa), fitter: self.fitter.with_isa(isa), ..self }
    }

    /// Discards the last frame.
    pub fn begin_frame(&mut self) {
        self.image.clear();
    }

    /// The last search: the lines, the edge measurement of each, and whether it agrees with the
    /// fit.
    pub fn search_lines(&self) -> impl ExactSizeIterator<Item = SearchedLine<'_>> {
        let searched = self.normals.lines().iter().zip(self.normals.found());
        let found = searched.zip(&self.abs_residuals_px);
        found.map(|((line, found), px)| SearchedLine { line, found, agrees: px.is_finite() })
    }

    /// Converts the last search from the reduced image to its frame.
    pub fn enlarge(&mut self, pyramid_level: PyramidLevel) {
        self.normals.enlarge(pyramid_level);
    }

    /// Updates the appearance model by the finger's samples of the last search: those whose edges
    /// agree with the fit, each moved to its edge; see [`AppearanceModel::learn`]. The finger's
    /// samples are the first `samples` of all. The thumb is excluded: it may be lit differently,
    /// and the finger determines the line.
    pub fn learn_from_fit(
        &mut self,
        appearance: &mut AppearanceModel,
        samples: usize,
        scene: &Scene<'_>,
        finger: &Silhouette,
        weights: (f64, f64),
    ) -> Result<()> {
        if appearance.is_coloured() {
            self.image.reserve(scene);
        }
        self.gather_agreeing(samples);
        self.leave_out_covered(appearance, scene)?;
        appearance.learn(scene, &mut self.image, &self.agreeing, finger, weights)
    }

    /// An empty appearance model, to be [returned](Self::take_back).
    pub fn lend_appearance(&mut self, frame: &Frame<'_>) -> AppearanceModel {
        let coloured = frame.colour().is_some();
        let kept = self.leading.take().filter(|appearance| appearance.is_coloured() == coloured);
        let mut appearance =
            kept.unwrap_or_else(|| AppearanceModel::new(coloured).with_flank_levels());
        appearance.forget();
        appearance
    }

    /// Takes back the appearance model that was lent.
    pub fn take_back(&mut self, appearance: AppearanceModel) {
        self.leading = Some(appearance);
    }

    /// Relearns an appearance model from a contour as placed, whatever edges are there. Returns
    /// false, and leaves the model unchanged, if the inside of the contour does not differ from the
    /// outside.
    pub fn learn_at(
        &mut self,
        appearance: &mut AppearanceModel,
        scene: &Scene<'_>,
        contour: impl Iterator<Item = PlacedSample>,
        finger: &Silhouette,
    ) -> Result<bool> {
        self.agreeing.clear();
        self.agreeing.extend(contour);
        if appearance.finger_separation(scene, &self.agreeing, finger, None) <= 0.0 {
            return Ok(false);
        }
        appearance.forget();
        appearance.learn(scene, &mut self.image, &self.agreeing, finger, (0.0, 1.0))?;
        Ok(true)
    }

    /// Separation of the inside of a finger from its outside, without prior appearance, by the
    /// agreeing edges of the last search; see [`AppearanceModel::finger_separation`].
    pub fn finger_separation(
        &mut self,
        samples: usize,
        scene: &Scene<'_>,
        finger: &Silhouette,
        shaft: Option<&Shaft>,
    ) -> f64 {
        self.gather_agreeing(samples);
        let coloured = scene.colour().is_some();
        if self.unknown.is_coloured() != coloured {
            self.unknown = AppearanceModel::new(coloured);
        }
        self.unknown.finger_separation(scene, &self.agreeing, finger, shaft)
    }

    /// Sharpness of the agreeing edges of the last search on the softer flank, 0–1: 0.8 for a step
    /// blurred by 1 px, 0.5 by 2 px and 0.35 by 4 px.
    pub fn sharpness(&mut self, samples: usize, frame: &Frame<'_>, finger: &Silhouette) -> f64 {
        self.gather_agreeing(samples);
        let [left, right] = finger.flanks(&self.agreeing).map(|edges| {
            let (mut near_change, mut full_change) = (0.0, 0.0);
            for edge in edges {
                let [step, change] =
                    [NEAR_EDGE_PX, ABOUT_EDGE_PX].map(|px| change_across(frame, edge, px));
                if let (Some(step), Some(change)) = (step, change) {
                    near_change += step * change.signum();
                    full_change += change.abs();
                }
            }
            if full_change > 0.0 { (near_change / full_change).clamp(0.0, 1.0) } else { 1.0 }
        });
        left.min(right)
    }

    /// Collects the finger's samples of the last search, the first `samples` of all, whose edges
    /// agree closely with the fit ([`LEARNED_MIN_WEIGHT`]), each moved to its edge.
    fn gather_agreeing(&mut self, samples: usize) {
        self.agreeing.clear();
        let hits = self.visible.iter().zip(self.normals.lines()).zip(self.normals.found());
        let agreeing = hits
            .filter_map(|((&i, line), found)| found.as_ref().ok().map(|edge| (i, line, edge)))
            .zip(self.fitter.weights())
            .filter(|&((i, ..), &weight)| i < samples && weight > LEARNED_MIN_WEIGHT)
            .map(|((_, line, edge), _)| at_edge(line, edge));
        self.agreeing.extend(agreeing);
    }

    /// Discards the agreeing edges that do not match the appearance model inside, unless these are
    /// the majority: they are a covering object's. After a change of light no edge matches.
    fn leave_out_covered(&mut self, appearance: &AppearanceModel, scene: &Scene<'_>) -> Result<()> {
        if is_off(Mechanism::OccluderEdges) {
            return Ok(());
        }
        let Some(search_model) =
            appearance.search_model(scene, EdgeCue::HandEdges, Polarity::Unknown)
        else {
            return Ok(());
        };
        let edges = self.agreeing.iter().map(|edge| (edge.position, SURROUNDINGS_PX));
        let search_frame = self.image.shown(scene, search_model.mixture, || region_about(edges))?;
        self.matches.clear();
        self.matches.extend(
            self.agreeing
                .iter()
                .map(|edge| search_model.matches_appearance(scene, &search_frame, edge)),
        );
        if 2 * self.matches.iter().filter(|&&is_match| is_match).count() >= self.agreeing.len() {
            let mut matches = self.matches.iter();
            self.agreeing.retain(|_| matches.next().is_some_and(|&is_match| is_match));
        }
        Ok(())
    }

    /// For each visible sample of one part of the outline in the last search, its position along
    /// the limb in units of the template, and the absolute residual of its edge \[px\]: infinite if
    /// it does not agree, `None` without an edge.
    pub fn edges_along(
        &self,
        samples: &[TemplateSample],
        part: Part,
    ) -> impl DoubleEndedIterator<Item = (f64, Option<f64>)> {
        let measured = self.normals.found().iter().zip(&self.abs_residuals_px);
        let searched = self.visible.iter().zip(measured);
        searched.filter_map(move |(&i, (found, &px))| {
            let sample = samples.get(i).filter(|s| s.part() == part)?;
            Some((sample.along, found.is_ok().then_some(px)))
        })
    }

    /// The frame near a finger, as a mixture shows it.
    pub fn shown<'a>(
        &'a mut self,
        frame: &Frame<'a>,
        mixture: Option<&Mixture>,
        finger: &Finger,
    ) -> Result<Frame<'a>> {
        self.image.shown(frame, mixture, || finger_region(finger))
    }

    /// The frame near some pixels, as a mixture shows it.
    pub fn shown_about<'a>(
        &'a mut self,
        frame: &Frame<'a>,
        mixture: Option<&Mixture>,
        pixels: impl Iterator<Item = Point2<f64>>,
        reach_px: f64,
    ) -> Result<Frame<'a>> {
        self.image.shown(frame, mixture, || region_about(pixels.map(|p| (p, reach_px))))
    }

    /// Gauss–Newton from `x` in this space. `prior` is on the shape vector itself.
    ///
    /// The fit is `None` if a step is not determined, and for a stage that another continues.
    pub fn run<S: ShapeSpace<D>, const D: usize>(
        &mut self,
        scene: &Scene<'_>,
        space: &S,
        x: SVector<f64, D>,
        stage: &FitStage<'_>,
        prior: Option<&Prior<D>>,
    ) -> Result<FitResult<SVector<f64, D>>> {
        let plan = &stage.plan;
        let mut half_length_px = plan.half_length_px;
        let mut at = FitResult::unfitted(x);
        let mut last = None;
        while at.iterations < self.max_iterations {
            at.iterations += 1;
            let pose = space.pose(&at.shape);
            let searched_px = half_length_px.min(plan.edges_within_px);
            self.measure(scene, &pose, stage, searched_px)?;
            let step_prior =
                prior.map(|p| Prior { mean: p.mean - at.shape, information: p.information });
            let samples = self.visible.iter().map(|&i| &stage.samples[i]);
            let measured = samples.zip(self.normals.lines()).zip(self.normals.found());
            let equations = linearise(space, &pose, measured, &mut self.equations)?;
            let far_px = (half_length_px - MIN_HALF_LENGTH_PX).max(0.0) * FAR_SCALE;
            let least_px = self.fitter.options().min_scale_px.max(far_px);
            let scales_px = (least_px, stage.max_scale_px);
            let fit = self.fitter.solve_with_scale(&equations, step_prior.as_ref(), scales_px);
            if fit.outcome != Outcome::Determined {
                return Ok(FitResult { fit: None, ..at });
            }
            let moved_px = equations.largest_motion(&fit.step);
            at.shape += fit.step;
            last = Some(fit);
            if moved_px < plan.purpose.tolerance_px() {
                at.edges_within_px = self.edges_within_px(moved_px);
                break;
            }
            if moved_px < half_length_px / 2.0 {
                let shrunk_px = half_length_px * SHRINK;
                // Within the window, one step brings the contour most of the way.
                let remaining_px =
                    plan.window.map_or(shrunk_px, |_| MAX_REMAINING_STEPS * moved_px);
                half_length_px = shrunk_px.min(remaining_px).max(MIN_HALF_LENGTH_PX);
            }
        }
        if plan.purpose != StagePurpose::TakenOver {
            self.mark_agreeing();
            at.fit = last.map(|fit| self.summarise(space, &at.shape, &fit, stage));
        }
        Ok(at)
    }

    /// Bound on the distance of the edges of the last search from its solution, whose step moved
    /// the contour by `moved_px`; infinite if too many lines found none, since their edges may lie
    /// beyond them.
    fn edges_within_px(&self, moved_px: f64) -> f64 {
        let residuals = self.fitter.residuals();
        if (residuals.len() as f64) < SURE * self.normals.lines().len() as f64 {
            return f64::INFINITY;
        }
        let furthest_px = residuals.iter().fold(0.0, |px: f64, r| px.max(r.abs()));
        (furthest_px + MAX_REMAINING_STEPS * moved_px).max(MIN_HALF_LENGTH_PX)
    }

    /// Design effect: number of correlated edge measurements that carry the information of one
    /// independent measurement.
    fn design_effect(&mut self, samples: &[TemplateSample]) -> f64 {
        let Self { visible, normals, fitter, agreeing_residuals, .. } = self;
        let hits = visible.iter().zip(normals.found()).filter(|(_, found)| found.is_ok());
        let measured = hits.zip(fitter.residuals()).zip(fitter.agreeing());
        let agreeing = measured.filter(|(_, agrees)| *agrees);
        agreeing_residuals.clear();
        agreeing_residuals.extend(agreeing.map(|(((&i, _), &px), _)| (samples[i].part(), px)));
        design_effect(agreeing_residuals)
    }

    /// The visible samples of the contour at `x`, in order, and the offsets of their edges \[px\],
    /// without a fit.
    pub fn offsets<S: ShapeSpace<D>, const D: usize>(
        &mut self,
        scene: &Scene<'_>,
        space: &S,
        x: &SVector<f64, D>,
        stage: &FitStage<'_>,
    ) -> Result<impl Iterator<Item = (usize, Option<f64>)>> {
        self.measure(scene, &space.pose(x), stage, stage.plan.half_length_px)?;
        let offsets = self.normals.found().iter().map(|found| Some(found.as_ref().ok()?.offset_px));
        Ok(self.visible.iter().copied().zip(offsets))
    }

    /// Searches the image along the normals of the contour as placed by `pose`.
    fn measure<P: Pose>(
        &mut self,
        scene: &Scene<'_>,
        pose: &P,
        stage: &FitStage<'_>,
        half_length_px: f64,
    ) -> Result<()> {
        let FitStage { samples, search_model, plan, .. } = stage;
        self.visible.clear();
        self.normals.clear();
        for (i, sample) in samples.iter().enumerate().step_by(plan.every) {
            let placed = pose.place(sample);
            if !pose.is_hidden(sample, &placed) {
                self.visible.push(i);
                let line = SearchLine {
                    sample: placed,
                    half_length_px: plan
                        .window
                        .map_or(half_length_px, |w| w.length(&placed).min(half_length_px)),
                    polarity: search_model.polarity,
                };
                self.normals.push(sample.part(), line);
            }
        }
        self.abs_residuals_px.clear();
        self.abs_residuals_px.resize(self.visible.len(), f64::INFINITY);
        let search_frame =
            self.image.shown(scene, search_model.mixture, || self.normals.region())?;
        self.normals.search(scene, &search_frame, search_model, plan.scale, plan.matched_only)
    }

    /// Fraction of the visible contour of the first `samples` whose edges are within `within_px` of
    /// the last fit and match the appearance model inside, 0–1.
    pub fn matched_share(
        &mut self,
        scene: &Scene<'_>,
        search_model: &SearchModel<'_>,
        samples: usize,
        within_px: f64,
    ) -> Result<f64> {
        let search_frame =
            self.image.shown(scene, search_model.mixture, || self.normals.region())?;
        let mut residuals = self.fitter.residuals().iter();
        let (mut matched, mut visible) = (0_usize, 0_usize);
        for (line, (&i, found)) in self.visible.iter().zip(self.normals.found()).enumerate() {
            let is_near = found.is_ok() && residuals.next().is_some_and(|r| r.abs() < within_px);
            if i < samples {
                visible += 1;
                matched += usize::from(
                    is_near
                        && self.normals.matches_appearance(
                            line,
                            scene,
                            &search_frame,
                            search_model,
                        ),
                );
            }
        }
        Ok(matched as f64 / visible.max(1) as f64)
    }

    /// Records the absolute residuals of the edges that agree with the last solution.
    fn mark_agreeing(&mut self) {
        let hits =
            self.abs_residuals_px.iter_mut().zip(self.normals.found()).filter(|(_, m)| m.is_ok());
        let fitted = self.fitter.residuals().iter().zip(self.fitter.agreeing());
        for ((abs_residual_px, _), (residual_px, agrees)) in hits.zip(fitted) {
            if agrees {
                *abs_residual_px = residual_px.abs();
            }
        }
    }

    /// Samples that the last solution explains: those with a residual offset below [`SUPPORT_PX`].
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
        stage: &FitStage<'_>,
    ) -> Fit {
        // The covariance already includes the correlation of neighbours by shared pixels.
        let design_effect = (self.design_effect(stage.samples) / self.correlation).max(1.0);
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
            line_covariance: j * covariance * j.transpose() * design_effect,
            counts: EdgeCounts {
                visible: self.visible.len(),
                hits: fit.equations,
                inliers: fit.inliers,
            },
            agreement: fit.inliers as f64 / self.visible.len().max(1) as f64,
            support: self.support(stage.samples),
            residual_rms_px: fit.residual_rms_px,
            rank: fit.rank,
            matched_only: stage.plan.matched_only,
            edge_cue: stage.search_model.edge_cue,
            by_appearance: stage.search_model.cue.appearance().is_some(),
        }
    }
}

/// Grey-level difference across an edge, inside minus outside, as the mean over the distances `px`
/// to either side; `None` if one of these places is outside of the image.
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

/// One equation for every edge found.
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

/// Image region in which a finger is refined.
pub(super) fn finger_region(finger: &Finger) -> [f64; 4] {
    let (axis, reach) = (finger.axis, 2.0 * finger.half_width_px + SURROUNDINGS_PX);
    let from = finger.flanks[0].from_px.min(finger.flanks[1].from_px);
    let ends = [axis.tip, axis.anchor + axis.direction() * from];
    region_about(ends.iter().map(|end| (*end, reach)))
}
