//! The tracker of one view: its state, and the update by one frame.

use super::axis_curvature::AxisCurvature;
use super::convergence::Convergence;
use super::exposure::Exposure;
use super::grid_search::GridSearch;
use super::hand::{Hand, InitialTemplate, LastKnown, MOST_COVERED_FRAMES};
use super::line_comparison::LineComparison;
use super::line_filter::LineFilter;
use super::motion_prior::MotionPrior;
use super::pyramid::{PyramidLevel, ReducedImage};
use super::scene::Scene;
use super::validation::BendState;
use crate::appearance::background::Background;
use crate::appearance::discriminant::DiscriminantImage;
use crate::axis::{RefineOptions, Refiner};
use crate::geometry::planar::AffineMap;
use crate::geometry::ribbon::{BandMeasure, RibbonVector, ribbon_of};
use crate::geometry::shape_space::PlacedSample;
use crate::geometry::template::{HALF_LENGTH, Template, TemplateSample};
use crate::image::frame::Frame;
use crate::measure::edge::MAX_HALF_LENGTH_PX;
use crate::measure::edge_search::check_size;
use crate::numeric::ablation::{Mechanism, is_off};
use crate::numeric::simd::Isa;
use crate::solve::dynamics::{Dynamics, Gate, chi_square_quantile};
use crate::{Error, Result};
use nalgebra::Vector2;

use super::normals::SearchedLine;
use super::options::{Model, TrackerOptions};
use super::outcome::Track;
use super::status::{StartPose, Status};

/// Tracks one hand in one view.
///
/// - *Acquiring*: the initial template waits at its start pose and is fitted to the hand that is
///   held up to it, until its size has settled.
/// - *Tracking*: every frame is searched where a Kalman filter predicts the hand. Frames whose fit
///   is not accepted have no finger line; [`Diagnostics`](super::Diagnostics) give the reason.
/// - *Lost*: after [`TrackOptions::lose_after_frames`](super::TrackOptions::lose_after_frames) such
///   frames in a row. The hand is searched for at its last pose and at the start pose.
///
/// Nothing is allocated while a hand is tracked.
#[derive(Debug, Clone)]
pub struct ContourTracker {
    pub(super) template: Template,
    pub(super) options: TrackerOptions,
    pub(super) samples: Vec<TemplateSample>,
    pub(super) initial: InitialTemplate,
    pub(super) convergence: Convergence,
    pub(super) grid_search: GridSearch,
    pub(super) gate: Gate,
    /// Limit of the normalised square of an innovation, χ² of [`INNOVATION_GATE_PROBABILITY`].
    pub(super) innovation_gate: f64,
    pub(super) hand: Hand,
    pub(super) phase: Phase,
    pub(super) refiner: Refiner,
    /// Motion filter of a tracked hand; `None` before the first acquisition.
    pub(super) dynamics: Option<Dynamics<3>>,
    pub(super) motion_prior: MotionPrior,
    /// Estimates of the finger line and of its axis curvature over the frames.
    pub(super) line_filter: LineFilter,
    pub(super) axis_curvature: AxisCurvature,
    pub(super) foreshortening: f64,
    pub(super) line_comparison: LineComparison,
    pub(super) last_time_s: Option<f64>,
    /// Whether the initial template may be longer than the finger, so that acquisition measures the
    /// length.
    pub(super) takes_length: bool,
    /// Exposure of the reference frame, to which that of every frame is compared.
    pub(super) exposure: Exposure,
    /// Reduction factor from the frames to the images in which the hand is tracked, the present
    /// reduced image, and the full frame as the hand's discriminant shows it.
    pub(super) pyramid_level: PyramidLevel,
    pub(super) picture: ReducedImage,
    pub(super) whole: DiscriminantImage,
}

/// The status with its data.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Phase {
    /// `settled` accepted frames in a row.
    Acquiring { settled: usize },
    /// `missed` frames in a row without an accepted fit.
    Tracking { missed: usize },
    /// Pose and model of the hand when last seen; `settled` accepted frames in a row since.
    Lost { last: LastKnown, settled: usize },
}

/// Probability with which the normalised square of the innovation of a hand that moves as predicted
/// stays below the gate (χ², 3 degrees of freedom).
pub(super) const INNOVATION_GATE_PROBABILITY: f64 = 0.9999;
/// Largest half-width of a tracked finger for which lengths and speeds in pixels apply unscaled
/// \[px\]; for a larger finger they grow in proportion.
pub(super) const UNSCALED_TRACKED_HALF_WIDTH_PX: f64 = 13.0;
/// Search range of a hand that is lost, or was until the last frame, relative to that of a tracked
/// hand.
pub(super) const LOST_REACH: f64 = 2.0;
/// Half-length of the edge search after the log-likelihood ratios of pixels have placed the contour
/// \[px\].
pub(super) const NEAR_PX: f64 = 10.0;
/// Standard deviation of a component that edges must not move \[px, rad, 1\].
pub(super) const PINNED_SIGMA: f64 = 1e-4;

impl ContourTracker {
    /// A tracker whose initial template is placed at `start`.
    ///
    /// # Errors
    /// When the start pose or an option is not finite or outside its documented range, and
    /// [`Error::Unsupported`] for a traced outline with [`Model::Ribbon`]: only a pistol template
    /// has bands.
    pub fn new(template: Template, start: &StartPose, options: TrackerOptions) -> Result<Self> {
        options.check()?;
        let pyramid_level = Self::pyramid_level(&template, start, &options);
        let start = &pyramid_level.start(start);
        let map = AffineMap::upright(start.tip_px, start.angle_rad, start.length_px)?;
        let length_px = start.length_px;
        let (ribbon, measure) = match template.proportions() {
            Some(p) => (ribbon_of(p, &map), BandMeasure::of(p, length_px)),
            None if options.model == Model::Paper => {
                let round_end_px = HALF_LENGTH * length_px;
                (RibbonVector::zeros(), BandMeasure { length_px, round_end_px, side: 0.0 })
            }
            None => {
                return Err(Error::Unsupported {
                    what: "the band model",
                    needs: "a pistol template; a traced outline is tracked by the paper's model",
                });
            }
        };
        let samples = template.samples(options.samples)?;
        let initial = InitialTemplate { map, ribbon, measure };
        let hand = Hand {
            shape: initial.shape(&template),
            acquired: ribbon,
            model: initial.model(&options),
            measure,
            fitted: Vec::with_capacity(samples.len()),
            appearance: None,
            shaded: None,
            learned_at_px: Vector2::zeros(),
            frames_since_learning: 0,
            thumb_missed: 0,
            bend_state: BendState::Straight,
            bent_frames: 0,
            straight_frames: 0,
            is_back: false,
            usual_px: f64::INFINITY,
            partly_frames: MOST_COVERED_FRAMES,
            is_covered: false,
        };
        Ok(Self {
            convergence: Convergence::new(&options)?,
            grid_search: GridSearch::with_capacity(samples.len()),
            gate: options.gate(1.0)?,
            innovation_gate: chi_square_quantile(INNOVATION_GATE_PROBABILITY, 3)?,
            phase: Phase::Acquiring { settled: 0 },
            refiner: Refiner::new(RefineOptions::default())?,
            dynamics: None,
            motion_prior: MotionPrior::unknown(),
            line_filter: LineFilter::new(),
            axis_curvature: AxisCurvature::default(),
            foreshortening: 1.0,
            line_comparison: LineComparison::default(),
            last_time_s: None,
            exposure: Exposure::new(),
            takes_length: true,
            pyramid_level,
            picture: ReducedImage::default(),
            whole: DiscriminantImage::default(),
            template,
            options,
            samples,
            initial,
            hand,
        })
    }

    /// A tracker of a hand that is already at `start`, such as a
    /// [`Candidate`](crate::Candidate). The first frame is fitted there directly, from
    /// the template's own width, and keeps its length; a tracker made by [`new`](Self::new) would
    /// try several places, angles and widths. If that frame shows no hand there, acquisition starts
    /// as with `new`.
    ///
    /// # Errors
    /// Those of [`new`](Self::new).
    pub fn at_hand(template: Template, start: &StartPose, options: TrackerOptions) -> Result<Self> {
        let mut tracker = Self::new(template, start, options)?;
        tracker.phase = Phase::Acquiring { settled: 1 };
        tracker.takes_length = false;
        Ok(tracker)
    }

    /// A hand of the band model is reduced to the usual size; a hand of the paper's model, whose
    /// line is not refined, is tracked at its own size.
    pub(super) fn pyramid_level(
        template: &Template,
        start: &StartPose,
        options: &TrackerOptions,
    ) -> PyramidLevel {
        if is_off(Mechanism::PyramidLevel) {
            return PyramidLevel::NONE;
        }
        match template.proportions() {
            Some(p) if options.model == Model::Ribbon => {
                PyramidLevel::of_finger(p.half_width * start.length_px)
            }
            _ => PyramidLevel::NONE,
        }
    }

    /// The same tracker with another instruction set than the processor's widest: slower, with
    /// bit-identical results.
    #[must_use]
    #[doc(hidden)]
    pub fn with_isa(self, isa: Isa) -> Self {
        let convergence = self.convergence.with_isa(isa);
        Self { convergence, refiner: self.refiner.with_isa(isa), ..self }
    }

    /// The foreshortening of the finger in this view; see
    /// [`set_foreshortening`](Self::set_foreshortening).
    #[must_use]
    pub fn foreshortening(&self) -> f64 {
        self.foreshortening
    }

    /// Sets the foreshortening of the finger in this view, 0–1: the sine of the angle between the
    /// finger and the ray to its tip, which other views determine; 1 if unknown. The line is
    /// reported for the distal segment, whose length is derived from the finger's width; unlike
    /// length, width is not foreshortened.
    ///
    /// # Errors
    /// When it is not above 0 and at most 1.
    pub fn set_foreshortening(&mut self, foreshortening: f64) -> Result<()> {
        if !(foreshortening > 0.0 && foreshortening <= 1.0) {
            let right = "above 0 and at most 1";
            return Err(Error::OutOfRange { what: "foreshortening", value: foreshortening, right });
        }
        self.foreshortening = foreshortening;
        Ok(())
    }

    /// Updates the tracker by one frame, captured at `time_s`, and returns the estimate for it.
    ///
    /// # Errors
    /// When `time_s` is not finite or before the last frame's, or the frame is larger than
    /// [`EdgeSearch::search`](crate::measure::edge_search::EdgeSearch::search) accepts; a tracker
    /// that was constructed has no other errors. The absence of the hand is a [`Status`], not an
    /// error.
    pub fn update(&mut self, frame: &Frame<'_>, time_s: f64) -> Result<Track> {
        self.take(&Scene::new(frame, None), time_s)
    }

    /// Updates the tracker by one frame, which the background model has measured before by
    /// [`Background::look`]. Edges of the background are not taken for the hand's, and the finger
    /// line is fitted against the known background. Background pixels that the frame contradicts do
    /// not count. A hand that was present while the background was learned is part of it.
    ///
    /// # Errors
    /// Those of [`update`](Self::update), and when the background was learned from images of
    /// another size.
    pub fn update_before(
        &mut self,
        frame: &Frame<'_>,
        background: &Background,
        time_s: f64,
    ) -> Result<Track> {
        let gray = (frame.image().width(), frame.image().height());
        if background.size() != gray {
            return Err(Error::BackgroundSize { gray, background: background.size() });
        }
        self.take(&Scene::new(frame, Some(background)), time_s)
    }

    pub(super) fn take(&mut self, scene: &Scene<'_>, time_s: f64) -> Result<Track> {
        check_size(scene)?;
        let last = self.last_time_s.unwrap_or(f64::NEG_INFINITY);
        Error::finite("frame time [s]", time_s)?;
        Error::within("frame time [s]", time_s, "at or after the last frame's", |t| t >= last)?;
        self.last_time_s = Some(time_s);
        self.convergence.begin_frame();
        self.whole.clear();
        let pyramid_level = self.pyramid_level;
        if !pyramid_level.is_smaller() {
            return self.measure(scene, time_s);
        }
        // Moved out, since `measure` borrows it together with `self`.
        let mut picture = std::mem::take(&mut self.picture);
        let track = picture
            .of(scene, pyramid_level)
            .and_then(|reduced| self.measure(&scene.reduced(reduced, pyramid_level), time_s));
        self.picture = picture;
        self.convergence.enlarge(pyramid_level);
        track.map(|track| pyramid_level.track(&track))
    }

    pub(super) fn measure(&mut self, scene: &Scene<'_>, time_s: f64) -> Result<Track> {
        self.relight(scene);
        match self.phase {
            Phase::Acquiring { settled } => self.acquire(scene, time_s, settled, None),
            Phase::Lost { last, settled } => self.recover(scene, time_s, settled, last),
            Phase::Tracking { missed } => self.follow(scene, time_s, missed),
        }
    }

    /// Adapts the appearance model to the exposure of a frame.
    pub(super) fn relight(&mut self, frame: &Frame<'_>) {
        if is_off(Mechanism::Exposure) {
            return;
        }
        let gain = self.exposure.changed(frame.image());
        if let (Some(gain), Some(appearance)) = (gain, &mut self.hand.appearance) {
            appearance.relight(gain);
        }
    }

    /// The template.
    #[must_use]
    pub fn template(&self) -> &Template {
        &self.template
    }

    /// The options in force.
    #[must_use]
    pub fn options(&self) -> &TrackerOptions {
        &self.options
    }

    /// The state after the last frame.
    #[must_use]
    pub fn status(&self) -> Status {
        match self.phase {
            Phase::Acquiring { .. } => Status::Acquiring,
            Phase::Tracking { .. } => Status::Tracking,
            Phase::Lost { .. } => Status::Lost,
        }
    }

    /// The contour in the image after the last frame, or at the start pose.
    #[must_use]
    pub fn contour(&self) -> Vec<PlacedSample> {
        let mut contour = Vec::with_capacity(self.samples.len());
        let Self { hand, samples, pyramid_level, .. } = self;
        hand.outline(&hand.shape, samples, |_, placed| {
            contour.push(pyramid_level.sample(&placed));
        });
        contour
    }

    /// The last search: the lines, the edge measurement of each, and whether it agrees with the
    /// fit.
    #[must_use]
    pub fn search_lines(&self) -> impl ExactSizeIterator<Item = SearchedLine<'_>> {
        self.convergence.search_lines()
    }

    /// Size of this hand relative to the largest usual one, at least 1; its motion in pixels scales
    /// with it.
    pub(super) fn largeness(&self) -> f64 {
        (self.hand.acquired[3] / UNSCALED_TRACKED_HALF_WIDTH_PX).max(1.0)
    }

    /// Half-length of the edge search near the hand \[px\], at most that of the longest search
    /// line.
    pub(super) fn near_px(&self) -> f64 {
        (self.largeness() * NEAR_PX).min(MAX_HALF_LENGTH_PX as f64)
    }
}
