//! The tracker of one view: its state, and what it does with a frame.

use super::axis_curvature::AxisCurvature;
use super::convergence::Convergence;
use super::exposure::Exposure;
use super::grid_search::GridSearch;
use super::hand::{Hand, InitialTemplate, LastKnown, MOST_COVERED_FRAMES};
use super::line_filter::LineFilter;
use super::motion_prior::MotionPrior;
use super::pyramid::{PyramidLevel, ReducedImage};
use super::scene::Scene;
use super::validation::BendState;
use super::variance_factor::VarianceFactor;
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
use crate::numeric::simd::Isa;
use crate::solve::dynamics::{Dynamics, Gate, chi_square_quantile};
use crate::{Error, Result};
use nalgebra::Vector2;

use super::normals::SearchedLine;
use super::options::{Model, TrackerOptions};
use super::outcome::Track;
use super::status::{StartPose, Status};

/// Follows one hand in one view.
#[derive(Debug, Clone)]
pub struct ContourTracker {
    pub(super) template: Template,
    pub(super) options: TrackerOptions,
    pub(super) samples: Vec<TemplateSample>,
    pub(super) initial: InitialTemplate,
    pub(super) convergence: Convergence,
    pub(super) grid_search: GridSearch,
    pub(super) gate: Gate,
    /// An innovation beyond this is no motion of a hand.
    pub(super) surprise: f64,
    pub(super) hand: Hand,
    pub(super) phase: Phase,
    pub(super) refiner: Refiner,
    /// How a tracked hand moves.
    pub(super) dynamics: Option<Dynamics<3>>,
    pub(super) motion_prior: MotionPrior,
    /// What the frames so far have told of its line, and of its bend.
    pub(super) line_filter: LineFilter,
    pub(super) axis_curvature: AxisCurvature,
    pub(super) foreshortening: f64,
    pub(super) variance_factor: VarianceFactor,
    pub(super) last_time_s: Option<f64>,
    /// Whether the template waits with a length that is longer than the finger, for all that is known.
    pub(super) takes_length: bool,
    /// The light in which the hand's looks are known.
    pub(super) exposure: Exposure,
    /// How much smaller than the frames the pictures are that the hand is followed in, the present
    /// one, and the frame itself as the hand's discriminant shows it.
    pub(super) pyramid_level: PyramidLevel,
    pub(super) picture: ReducedImage,
    pub(super) whole: DiscriminantImage,
}

/// The status, with what it has to remember.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Phase {
    /// `settled` accepted frames in a row.
    Acquiring { settled: usize },
    /// `missed` frames in a row without an accepted fit.
    Tracking { missed: usize },
    /// Where the hand was last, and what it showed; `settled` accepted frames in a row since.
    Lost { last: LastKnown, settled: usize },
}

/// A hand that moves as foretold stays below what counts as a surprise with this probability.
pub(super) const SURPRISE: f64 = 0.9999;
/// Half the width of the largest finger for which lengths and speeds in pixels are meant as they
/// are while it is followed \[px\]; those of a larger one grow with it.
pub(super) const FOLLOWED_HALF_WIDTH_PX: f64 = 13.0;
/// A hand that is lost, or was until the last frame, is looked for this much further than a tracked one.
pub(super) const LOST_REACH: f64 = 2.0;
/// Once votes have led the contour to the hand, its edges are looked for this far \[px\].
pub(super) const NEAR_PX: f64 = 10.0;
/// What is known so well moves for no edge: standard deviation of each component \[px, rad, 1\].
pub(super) const PINNED_SIGMA: f64 = 1e-4;

impl ContourTracker {
    /// A tracker whose template waits at `start`.
    ///
    /// # Errors
    /// When the start pose or an option is not finite or outside its documented range, and
    /// [`Error::Unsupported`] for a traced outline with [`Model::Ribbon`]: only a pistol has bands.
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
            kind: initial.kind(&options),
            measure,
            fitted: Vec::with_capacity(samples.len()),
            appearance: None,
            shaded: None,
            taught_at_px: Vector2::zeros(),
            untaught_frames: 0,
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
            surprise: chi_square_quantile(SURPRISE, 3)?,
            phase: Phase::Acquiring { settled: 0 },
            refiner: Refiner::new(RefineOptions::default())?,
            dynamics: None,
            motion_prior: MotionPrior::unknown(),
            line_filter: LineFilter::new(),
            axis_curvature: AxisCurvature::default(),
            foreshortening: 1.0,
            variance_factor: VarianceFactor::default(),
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

    /// A tracker whose hand is believed to be at `start` already, as a candidate of
    /// [`candidates`](crate::detect::candidates) is: the first frame is fitted there at once, from the
    /// template's own width, where a template that waits would try several places, angles and
    /// widths, and keeps its length. When that frame shows no hand there, the template waits.
    ///
    /// # Errors
    /// Those of [`new`](Self::new).
    pub fn at_hand(template: Template, start: &StartPose, options: TrackerOptions) -> Result<Self> {
        let mut tracker = Self::new(template, start, options)?;
        tracker.phase = Phase::Acquiring { settled: 1 };
        tracker.takes_length = false;
        Ok(tracker)
    }

    /// Hands of the band model are followed at the usual size; one of the paper's, which is not
    /// refined, at its own.
    pub(super) fn pyramid_level(
        template: &Template,
        start: &StartPose,
        options: &TrackerOptions,
    ) -> PyramidLevel {
        match template.proportions() {
            Some(p) if options.model == Model::Ribbon => {
                PyramidLevel::of_finger(p.half_width * start.length_px)
            }
            _ => PyramidLevel::NONE,
        }
    }

    /// The same tracker with another instruction set than the processor's widest: slower, with the
    /// same results to the last bit.
    #[must_use]
    pub fn with_isa(self, isa: Isa) -> Self {
        let convergence = self.convergence.with_isa(isa);
        Self { convergence, refiner: self.refiner.with_isa(isa), ..self }
    }

    /// By how much the view shows the finger shorter than it is; see
    /// [`set_foreshortening`](Self::set_foreshortening).
    #[must_use]
    pub fn foreshortening(&self) -> f64 {
        self.foreshortening
    }

    /// Tells by how much the view shows the finger shorter than it is: the sine of the angle between
    /// the finger and the ray to its tip, which other views know; 1 if nobody tells. A finger's front,
    /// which its line is told for, is known by its width, and that is not foreshortened.
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

    /// Takes one frame, captured at `time_s`, and tells where the hand is.
    ///
    /// # Errors
    /// When `time_s` is not finite or before the last frame's, or the frame is larger than
    /// [`EdgeSearch::search`](crate::measure::edge_search::EdgeSearch::search) takes; nothing else of a tracker
    /// that was made can be refused. A hand that is not there is no error but a [`Status`].
    pub fn update(&mut self, frame: &Frame<'_>, time_s: f64) -> Result<Track> {
        self.take(&Scene::new(frame, None), time_s)
    }

    /// Takes one frame before a background that has looked at it
    /// ([`Background::measure`]): edges of the background are not taken for the hand's, and the finger
    /// line is measured before what is known to be behind it. What the frame contradicts does not
    /// count. A hand that has stood there while the background was learned is part of it.
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

    pub(super) fn take(&mut self, frame: &Scene<'_>, time_s: f64) -> Result<Track> {
        check_size(frame)?;
        let last = self.last_time_s.unwrap_or(f64::NEG_INFINITY);
        Error::finite("frame time [s]", time_s)?;
        Error::within("frame time [s]", time_s, "at or after the last frame's", |t| t >= last)?;
        self.last_time_s = Some(time_s);
        self.convergence.begin_frame();
        self.whole.clear();
        let pyramid_level = self.pyramid_level;
        if !pyramid_level.is_smaller() {
            return self.measure(frame, time_s);
        }
        // Taken out while the hand is followed in it.
        let mut picture = std::mem::take(&mut self.picture);
        let track = picture
            .of(frame, pyramid_level)
            .and_then(|reduced| self.measure(&frame.reduced(reduced, pyramid_level), time_s));
        self.picture = picture;
        self.convergence.enlarge(pyramid_level);
        track.map(|track| pyramid_level.track(&track))
    }

    pub(super) fn measure(&mut self, frame: &Scene<'_>, time_s: f64) -> Result<Track> {
        self.relight(frame);
        match self.phase {
            Phase::Acquiring { settled } => self.acquire(frame, time_s, settled, None),
            Phase::Lost { last, settled } => self.recover(frame, time_s, settled, last),
            Phase::Tracking { missed } => self.follow(frame, time_s, missed),
        }
    }

    /// Takes what is known of colours over into the light of a frame.
    pub(super) fn relight(&mut self, frame: &Frame<'_>) {
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

    /// Where the tracker is after the last frame.
    #[must_use]
    pub fn status(&self) -> Status {
        match self.phase {
            Phase::Acquiring { .. } => Status::Acquiring,
            Phase::Tracking { .. } => Status::Tracking,
            Phase::Lost { .. } => Status::Lost,
        }
    }

    /// The contour as it stands in the image after the last frame, or where it waits.
    #[must_use]
    pub fn contour(&self) -> Vec<PlacedSample> {
        let mut contour = Vec::with_capacity(self.samples.len());
        let Self { hand, samples, pyramid_level, .. } = self;
        hand.outline(&hand.shape, samples, |_, placed| {
            contour.push(pyramid_level.sample(&placed));
        });
        contour
    }

    /// The last search: lines, what each one found, and whether that agrees with the fit.
    #[must_use]
    pub fn search_lines(&self) -> impl ExactSizeIterator<Item = SearchedLine<'_>> {
        self.convergence.search_lines()
    }

    /// How many times as large as a usual hand this one is seen: it moves so much farther.
    pub(super) fn largeness(&self) -> f64 {
        (self.hand.acquired[3] / FOLLOWED_HALF_WIDTH_PX).max(1.0)
    }

    /// How far its edges are looked for from nearby \[px\]; no search line is longer than the longest.
    pub(super) fn near_px(&self) -> f64 {
        (self.largeness() * NEAR_PX).min(MAX_HALF_LENGTH_PX as f64)
    }
}
