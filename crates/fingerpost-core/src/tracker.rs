//! The life of a hand in one view: *acquiring*, *tracking*, *lost*.
//!
//! **Acquiring.** The template waits at its start pose until a hand is held up to it, and moulds
//! itself to finger and thumb. A fit counts only if it is *accepted* (below) and is about the size
//! of the template that waits; otherwise the template goes back to its start. It has *settled*
//! when, over [`AcquireOptions::settle_frames`] accepted frames in a row, no frame changed the
//! finger's half-width by more than [`AcquireOptions::settle_change`] of it: the hand may move
//! meanwhile, from any place that the waiting template reaches to any other. Then it is looked at
//! anew in its own colours, or in the grey levels of either flank where there are none;
//! [`Model::Ribbon`] is shortened where it reaches beyond the finger, and
//! [`Model::Paper`] deforms affinely once more and freezes the size.
//!
//! **Tracking.** Of the band model everything stays free, but what a hand cannot change is held
//! near its acquired value by a prior, which follows slowly. The finger comes first: its thumb is
//! fitted afterwards and does not turn it, and is left out once it has not been seen for a while.
//! Either flank counts from the tip on for as far as it agrees: behind may be a thumb that lies along
//! the finger.
//! The finger line comes from the pixels about the flanks where they can be believed
//! ([`crate::refine`]), else from the contour; the lines of the frames before have a say in it where
//! they tell it better, carried along by the finger's skin. It is told for one stretch of the finger,
//! whatever part of the flanks a frame shows, and its covariance counts how bent the finger is and how
//! the lines of its frames scatter. The paper's model keeps the settled
//! size; rigid motion and one shear remain (rigid motion alone where the template has no thumb:
//! nothing but the thumb shows the shear). A Kalman filter with constant velocity
//! ([`DynamicsOptions`]) foretells place and angle, what both models share, and how far along each
//! normal the edge may be. Where the edges there explain the hand badly, or by a motion that
//! surprises, it is sought all around.
//!
//! **Lost.** After [`TrackOptions::lose_after_frames`] frames without an accepted fit the hand is
//! lost. It is looked for where it last was, and followed again from the first fit there that
//! acquisition would accept; and where the template first waited, until a fit settles there.
//!
//! A fit is accepted when it is determined, enough of the visible contour has an edge that agrees
//! with it, and the residual offsets of those are small; see [`AcceptOptions`]. A frame whose fit
//! is not accepted yields no finger line.
//!
//! **Bent.** No straight line is the axis of a bent finger. Of a fit that is accepted by its edges
//! the two halves of the finger are looked at once more, each for itself ([`crate::refine::Bend`]).
//! Where they differ by more than 20° in the image, by two standard deviations more than that or in
//! the second such frame in a row, the fit is a [`Refusal::Misfit`]: a first frame that is not as sure
//! keeps its line, for blur and what is behind the finger bend flanks too. The hand stays in sight
//! without a line until its halves differ by less than 15° and its tip is seen; a frame whose halves do
//! not tell gives it back as well if it explains nearly all of the contour, and after a single bent
//! frame if it explains most of it. A view sees only what of a bend lies across its line of sight. The
//! paper's model is not looked at so.
//!
//! **Large.** A hand of the band model whose start pose promises a finger of 24 px across or more
//! is followed in a picture that is smaller than the frames by a whole factor, so that its finger is
//! 12 to 18 px wide there; what is told is told of the frame. Where a frame is sharp and its pixels
//! agree with a finger, the line is theirs.
//!
//! A frame goes through `acquire` or `follow`; the latter has `choose` try the places where
//! the hand may be. Each place is settled on by `settle`, the stages of the fit, and an accepted
//! one yields its line, and teaches what the hand looks like, in `tell`.
//!
//! Source: Cipolla, Hadfield & Hollinghurst 1994, section 3.2.

mod acquire;
mod choose;
mod convergence;
mod exposure;
mod flanks;
mod follow;
mod found;
mod hand;
mod length;
mod line;
mod looks;
mod mould;
mod neighbours;
mod normals;
mod options;
mod pace;
mod reduced;
mod sagitta;
mod scene;
mod seek;
mod settle;
mod shade;
mod shape;
mod sides;
mod skins;
mod standing;
mod steady;
mod tell;
mod track;
mod verdict;
mod worth;

use crate::background::Background;
use crate::discriminant::DiscriminantImage;
use crate::dynamics::{Dynamics, Gate, chi_square_quantile};
use crate::frame::Frame;
use crate::refine::{RefineOptions, Refiner};
use crate::search::{MAX_HALF_LENGTH_PX, check_size};
use crate::shape_space::{AffineMap, BandMeasure, PlacedSample, RibbonVector, ribbon_of};
use crate::simd::Isa;
use crate::template::{HALF_LENGTH, Template, TemplateSample};
use crate::{Error, Result};
use convergence::Convergence;
use exposure::Exposure;
use hand::{Hand, MOST_COVERED_FRAMES, Remembered, Waiting};
pub use line::{FingerLine, LineSource};
use nalgebra::{Point2, Vector2};
pub use options::{
    AcceptOptions, AcquireOptions, DynamicsOptions, Model, TrackOptions, TrackerOptions,
};
use pace::Pace;
use reduced::{Picture, Reduction};
use sagitta::Sagitta;
use scene::Scene;
use seek::Seek;
use steady::Steady;
pub use track::{Diagnostics, MAX_DOF, SearchedLine, ShapeEstimate, Track};
use verdict::Posture;
pub use verdict::Refusal;
use worth::Worth;

/// Where the template waits for the hand.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StartPose {
    /// The finger's tip \[px\].
    pub tip_px: Point2<f64>,
    /// Direction of pointing \[rad\], from +u (right) towards +v (down).
    pub angle_rad: f64,
    /// Visible length of the index finger \[px\], positive.
    pub length_px: f64,
}

/// Where the tracker is in the life of a hand.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Status {
    /// The template waits, or moulds itself to a hand that is held up to it.
    Acquiring,
    /// The hand is followed.
    Tracking,
    /// The hand was followed and is gone; it is looked for.
    Lost,
}

/// Follows one hand in one view.
#[derive(Debug, Clone)]
pub struct ContourTracker {
    template: Template,
    options: TrackerOptions,
    samples: Vec<TemplateSample>,
    waiting: Waiting,
    convergence: Convergence,
    seek: Seek,
    gate: Gate,
    /// An innovation beyond this is no motion of a hand.
    surprise: f64,
    hand: Hand,
    phase: Phase,
    refiner: Refiner,
    /// How a tracked hand moves.
    dynamics: Option<Dynamics<3>>,
    pace: Pace,
    /// What the frames so far have told of its line, and of its bend.
    steady: Steady,
    sagitta: Sagitta,
    foreshortening: f64,
    worth: Worth,
    last_time_s: Option<f64>,
    /// Whether the template waits with a length that is longer than the finger, for all that is known.
    takes_length: bool,
    /// The light in which the hand's looks are known.
    exposure: Exposure,
    /// How much smaller than the frames the pictures are that the hand is followed in, the present
    /// one, and the frame itself as the hand's discriminant shows it.
    reduction: Reduction,
    picture: Picture,
    whole: DiscriminantImage,
}

/// The status, with what it has to remember.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Phase {
    /// `settled` accepted frames in a row.
    Acquiring { settled: usize },
    /// `missed` frames in a row without an accepted fit.
    Tracking { missed: usize },
    /// Where the hand was last, and what it showed; `settled` accepted frames in a row since.
    Lost { last: Remembered, settled: usize },
}

/// A hand that moves as foretold stays below what counts as a surprise with this probability.
const SURPRISE: f64 = 0.9999;
/// Half the width of the largest finger for which lengths and speeds in pixels are meant as they
/// are while it is followed \[px\]; those of a larger one grow with it.
const FOLLOWED_HALF_WIDTH_PX: f64 = 13.0;
/// Once votes have led the contour to the hand, its edges are looked for this far \[px\].
const NEAR_PX: f64 = 10.0;
/// What is known so well moves for no edge: standard deviation of each component \[px, rad, 1\].
const PINNED_SIGMA: f64 = 1e-4;

impl ContourTracker {
    /// A tracker whose template waits at `start`.
    ///
    /// # Errors
    /// When the start pose or an option is not finite or outside its documented range, and
    /// [`Error::Unsupported`] for a traced outline with [`Model::Ribbon`]: only a pistol has bands.
    pub fn new(template: Template, start: &StartPose, options: TrackerOptions) -> Result<Self> {
        options.check()?;
        let reduction = Self::reduction(&template, start, &options);
        let start = &reduction.start(start);
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
        let waiting = Waiting { map, ribbon, measure };
        let hand = Hand {
            shape: waiting.shape(&template),
            acquired: ribbon,
            kind: waiting.kind(&options),
            measure,
            moulded: Vec::with_capacity(samples.len()),
            looks: None,
            shaded: None,
            taught_at_px: Vector2::zeros(),
            untaught_frames: 0,
            thumb_missed: 0,
            posture: Posture::Straight,
            bent_frames: 0,
            straight_frames: 0,
            is_back: false,
            usual_px: f64::INFINITY,
            partly_frames: MOST_COVERED_FRAMES,
            is_covered: false,
        };
        Ok(Self {
            convergence: Convergence::new(&options)?,
            seek: Seek::with_capacity(samples.len()),
            gate: options.gate(1.0)?,
            surprise: chi_square_quantile(SURPRISE, 3)?,
            phase: Phase::Acquiring { settled: 0 },
            refiner: Refiner::new(RefineOptions::default())?,
            dynamics: None,
            pace: Pace::unknown(),
            steady: Steady::new(),
            sagitta: Sagitta::default(),
            foreshortening: 1.0,
            worth: Worth::default(),
            last_time_s: None,
            exposure: Exposure::new(),
            takes_length: true,
            reduction,
            picture: Picture::default(),
            whole: DiscriminantImage::default(),
            template,
            options,
            samples,
            waiting,
            hand,
        })
    }

    /// A tracker whose hand is believed to be at `start` already, as a candidate of
    /// [`candidates`](crate::candidates) is: the first frame is fitted there at once, from the
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
    fn reduction(template: &Template, start: &StartPose, options: &TrackerOptions) -> Reduction {
        match template.proportions() {
            Some(p) if options.model == Model::Ribbon => {
                Reduction::of_finger(p.half_width * start.length_px)
            }
            _ => Reduction::NONE,
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
    /// [`EdgeSearch::search`](crate::search::EdgeSearch::search) takes; nothing else of a tracker
    /// that was made can be refused. A hand that is not there is no error but a [`Status`].
    pub fn update(&mut self, frame: &Frame<'_>, time_s: f64) -> Result<Track> {
        self.take(&Scene::new(frame, None), time_s)
    }

    /// Takes one frame before a background that has looked at it
    /// ([`Background::look`]): edges of the background are not taken for the hand's, and the finger
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

    fn take(&mut self, frame: &Scene<'_>, time_s: f64) -> Result<Track> {
        check_size(frame)?;
        let last = self.last_time_s.unwrap_or(f64::NEG_INFINITY);
        Error::finite("frame time [s]", time_s)?;
        Error::within("frame time [s]", time_s, "at or after the last frame's", |t| t >= last)?;
        self.last_time_s = Some(time_s);
        self.convergence.begin_frame();
        self.whole.clear();
        let reduction = self.reduction;
        if !reduction.is_smaller() {
            return self.look(frame, time_s);
        }
        // Taken out while the hand is followed in it.
        let mut picture = std::mem::take(&mut self.picture);
        let track = picture
            .of(frame, reduction)
            .and_then(|reduced| self.look(&frame.reduced(reduced, reduction), time_s));
        self.picture = picture;
        self.convergence.enlarge(reduction);
        track.map(|track| reduction.track(&track))
    }

    fn look(&mut self, frame: &Scene<'_>, time_s: f64) -> Result<Track> {
        self.relight(frame);
        match self.phase {
            Phase::Acquiring { settled } => self.acquire(frame, time_s, settled, None),
            Phase::Lost { last, settled } => self.recover(frame, time_s, settled, last),
            Phase::Tracking { missed } => self.follow(frame, time_s, missed),
        }
    }

    /// Takes what is known of colours over into the light of a frame.
    fn relight(&mut self, frame: &Frame<'_>) {
        let gain = self.exposure.changed(frame.image());
        if let (Some(gain), Some(looks)) = (gain, &mut self.hand.looks) {
            looks.relight(gain);
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
        let Self { hand, samples, reduction, .. } = self;
        hand.outline(&hand.shape, samples, |_, placed| {
            contour.push(reduction.sample(&placed));
        });
        contour
    }

    /// The last search: lines, what each one found, and whether that agrees with the fit.
    #[must_use]
    pub fn search_lines(&self) -> impl ExactSizeIterator<Item = SearchedLine<'_>> {
        self.convergence.search_lines()
    }

    /// How many times as large as a usual hand this one is seen: it moves so much farther.
    fn largeness(&self) -> f64 {
        (self.hand.acquired[3] / FOLLOWED_HALF_WIDTH_PX).max(1.0)
    }

    /// How far its edges are looked for from nearby \[px\]; no search line is longer than the longest.
    fn near_px(&self) -> f64 {
        (self.largeness() * NEAR_PX).min(MAX_HALF_LENGTH_PX as f64)
    }
}
