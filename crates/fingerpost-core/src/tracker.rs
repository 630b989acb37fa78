//! The life of a hand in one view: *acquiring*, *tracking*, *lost*.
//!
//! **Acquiring.** The template waits at its start pose until a hand is held up to it, and moulds
//! itself to finger and thumb. A fit counts only if it is *accepted* (below) and is about the size
//! of the template that waits; otherwise the template goes back to its start. It has *settled*
//! when, over [`AcquireOptions::settle_frames`] accepted frames in a row, no frame changed the
//! finger's half-width by more than [`AcquireOptions::settle_change`] of it: the hand may move
//! meanwhile, from any place that the waiting template reaches to any other. Then it is looked at
//! anew in its own colours, and [`Model::Paper`] deforms affinely once more and freezes the size.
//!
//! **Tracking.** Of the band model everything stays free, but what a hand cannot change is held
//! near its acquired value by a prior, which follows slowly. The finger comes first: its thumb is
//! fitted afterwards and does not turn it, and is left out once it has not been seen for a while.
//! The finger line comes from the pixels about the flanks where they can be believed
//! ([`crate::refine`]), else from the contour; the lines of the frames before have a say in it where
//! they tell it better, carried along by the finger's skin. The paper's model keeps the settled
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
//! the two halves of the finger are looked at once more, each for itself ([`crate::refine::Bend`]);
//! where they differ by more than 20° in the image, the fit is a [`Refusal::Misfit`]. The
//! hand stays in sight without a line, and has one again in a frame or two that show the finger
//! straight. A view sees only what of a bend lies across its line of sight. The paper's model is
//! not looked at so.
//!
//! Source: Cipolla, Hadfield & Hollinghurst 1994, section 3.2.

mod convergence;
mod exposure;
mod line;
mod looks;
mod mould;
mod neighbours;
mod options;
mod pace;
mod scene;
mod seek;
mod steady;
mod verdict;

use crate::background::Background;
use crate::dynamics::{Dynamics, Gate, Innovation, Prediction, chi_square_quantile};
use crate::fit::Prior;
use crate::frame::Frame;
use crate::refine::{
    Bend, Finger, KnownBackground, RefineOptions, Refined, Refiner, Source, Stretch,
};
use crate::search::{EdgeMeasurement, MAX_HALF_LENGTH_PX, Polarity, Scale, SearchLine, check_size};
use crate::shape_space::{
    Affine, AffineMap, BandMeasure, PlacedSample, PlanarSpace, Pose, RIBBON_DOF, Ribbon,
    RibbonVector, Rigid, RigidShear, ShapeSpace, Similarity, Translation, ribbon_of,
};
use crate::simd::Isa;
use crate::template::{HALF_LENGTH, Limb, Part, Template, TemplateSample};
use crate::{Error, Result};
use convergence::{
    Attempt, CONVERGED_PX, Converged, Convergence, Fit, Seen, TAKEN_OVER_PX, Window,
    max_residual_px,
};
use exposure::Exposure;
pub use line::{FingerLine, LineSource};
use looks::{Lead, Looks, Sight, Silhouette};
use mould::{Kind, Mould, STANDS_OUT, finger_samples};
use nalgebra::{Matrix3, Point2, Rotation2, SMatrix, SVector, Vector2, Vector3};
pub use options::{
    AcceptOptions, AcquireOptions, DynamicsOptions, Model, TrackOptions, TrackerOptions,
};
use pace::Pace;
use scene::Scene;
use seek::{Judged, Seek};
use steady::{Shown, Steady};
pub use verdict::Refusal;
use verdict::{Known, Motion, Posture};

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

/// Components of the largest shape space.
pub const MAX_DOF: usize = RIBBON_DOF;

/// A shape vector, its covariance and what its components are.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ShapeEstimate {
    /// Name and unit of each component.
    pub names: &'static [&'static str],
    /// The shape vector; components from `names.len()` on are zero.
    pub vector: SVector<f64, MAX_DOF>,
    /// Its covariance; rows and columns from `names.len()` on are zero.
    pub covariance: SMatrix<f64, MAX_DOF, MAX_DOF>,
}

/// Why a frame went the way it did.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Diagnostics {
    /// Samples of the contour that no other limb hides.
    pub visible: usize,
    /// Those that found an edge.
    pub hits: usize,
    /// Edges that agree with the fit.
    pub inliers: usize,
    /// The part of the finger's visible samples (of the contour's, for the paper's model) whose
    /// edges agree with the fit, 0–1: a thumb, which bends, does not count.
    pub agreement: f64,
    /// The least agreement with which the frame's fit counted.
    pub min_agreement: f64,
    /// Root mean square of the residual offsets of those \[px\].
    pub residual_rms_px: f64,
    /// The largest with which the frame's fit counted \[px\].
    pub max_residual_px: f64,
    /// Directions of the shape space that the measurements determine.
    pub rank: usize,
    /// Searches along the normals in the last shape space.
    pub iterations: usize,
    /// Whether the fit was determined and accepted.
    pub accepted: bool,
    /// Why it was not.
    pub refusal: Option<Refusal>,
    /// How much place and angle of a fit surprise, as the square of the innovation in units of its
    /// covariance: 3 on average for a hand that moves as [`TrackOptions::dynamics`] says. None
    /// where nothing foretold them.
    pub innovation: Option<f64>,
    /// How much the finger is bent, as the image shows it: the direction of the half with the tip
    /// minus that of the half with the knuckle \[rad\]. None where the flanks do not tell.
    pub bend_rad: Option<f64>,
}

/// A line of the last search, and what became of it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SearchedLine<'a> {
    /// Where was looked.
    pub line: &'a SearchLine,
    /// The edge, or why there is none.
    pub found: &'a EdgeMeasurement,
    /// Whether the edge agrees with the fit, that is, counts among [`Diagnostics::inliers`].
    pub agrees: bool,
}

/// What one frame told.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Track {
    /// When the frame was captured \[s\].
    pub time_s: f64,
    /// Where the tracker is after it.
    pub status: Status,
    /// The fitted shape, if the frame's fit was accepted.
    pub shape: Option<ShapeEstimate>,
    /// The finger line, if the hand is tracked and the frame's fit was accepted.
    pub finger_line: Option<FingerLine>,
    /// Why.
    pub diagnostics: Diagnostics,
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
    /// What the frames so far have told of its line.
    steady: Steady,
    last_time_s: Option<f64>,
    /// The light in which the hand's looks are known.
    exposure: Exposure,
}

/// The template before it has seen a hand.
#[derive(Debug, Clone, Copy)]
struct Waiting {
    map: AffineMap,
    ribbon: RibbonVector,
    measure: BandMeasure,
}

/// The hand as it is known now.
#[derive(Debug, Clone)]
struct Hand {
    shape: Shape,
    /// The band template when the hand was acquired; its widths and taper follow slowly.
    acquired: RibbonVector,
    /// What the acquired hand shows.
    kind: Kind,
    /// The planar template moulded to this hand; unused by the band model.
    moulded: Vec<TemplateSample>,
    /// What it looks like, once it was seen.
    looks: Option<Looks>,
    /// Frames in a row in which its thumb was not seen.
    thumb_missed: usize,
    /// Whether its finger is straight, for how many frames in a row it has not been, and how often
    /// it has been since it was acquired.
    posture: Posture,
    bent_frames: usize,
    straight_frames: usize,
    /// Root mean square of its edges' residual offsets as it is seen usually \[px\]; infinite as
    /// long as that is not known.
    usual_px: f64,
    /// Frames since nearly all of its contour was last explained.
    partly_frames: usize,
}

/// What the contour in the image is made from.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Shape {
    Ribbon(RibbonVector),
    Planar(AffineMap),
}

/// The status, with what it has to remember.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Phase {
    /// `settled` accepted frames in a row.
    Acquiring { settled: usize },
    /// `missed` frames in a row without an accepted fit.
    Tracking { missed: usize },
    /// Where the hand was last, and what it showed; `settled` accepted frames in a row since.
    Lost { last: (Shape, Kind), settled: usize },
}

/// What the last frames foretell of the next one.
#[derive(Debug, Clone, Copy)]
struct Foretold {
    dynamics: Dynamics<3>,
    time_s: f64,
    window: Window,
}

impl Foretold {
    /// The filter after a fit, and the innovation; None without a fit.
    fn followed(&self, found: &Found) -> Result<Option<(Dynamics<3>, Option<Innovation<3>>)>> {
        let Some(fit) = found.fit else { return Ok(None) };
        let seen = fit.shape.covariance.fixed_view::<3, 3>(0, 0) + misfit();
        let mut dynamics = self.dynamics;
        let innovation = dynamics.update(self.time_s, &found.shape.placement(), &seen)?;
        Ok(Some((dynamics, innovation)))
    }
}

fn misfit() -> Matrix3<f64> {
    Matrix3::from_diagonal(&Vector3::from(MISFIT_SIGMAS.map(|s| s * s)))
}

/// How far a convergence looks along the normals, and whether by the pixels' votes or by edges.
#[derive(Debug, Clone, Copy)]
struct Look {
    half_length_px: f64,
    lead: Lead,
    scale: Scale,
    window: Option<Window>,
    rest_px: f64,
    own_only: bool,
}

impl Look {
    fn edges(half_length_px: f64) -> Self {
        Self {
            half_length_px,
            lead: Lead::HandEdges,
            scale: Scale::Fine,
            window: None,
            rest_px: CONVERGED_PX,
            own_only: false,
        }
    }
}

impl Hand {
    /// The band template's samples that take part: the finger's, and the thumb's if it is seen.
    fn bands<'a>(&self, samples: &'a [TemplateSample]) -> &'a [TemplateSample] {
        if self.kind.has_thumb { samples } else { finger_samples(samples) }
    }

    /// The planar template's samples: those moulded to this hand, or the waiting template's.
    fn planar<'a>(&'a self, samples: &'a [TemplateSample]) -> &'a [TemplateSample] {
        if self.moulded.is_empty() { samples } else { &self.moulded }
    }

    /// Lets the dimensions that a hand cannot change follow slowly: it may come nearer.
    fn grow(&mut self) {
        if let Shape::Ribbon(x) = self.shape {
            for k in [3, 4, 8] {
                self.acquired[k] += HELD_RATE * (x[k] - self.acquired[k]);
            }
        }
    }

    /// Leaves out a thumb that was not seen for so many frames: it would hide the finger.
    fn count_thumb(&mut self, found: &Found, most_missed: usize) {
        let seen = found.fit.is_some_and(|f| f.shape.names.len() == RIBBON_DOF);
        self.thumb_missed = if seen { 0 } else { self.thumb_missed + 1 };
        if self.thumb_missed >= most_missed && matches!(self.shape, Shape::Ribbon(_)) {
            self.kind.has_thumb = false;
        }
    }

    /// The hand's samples where a shape puts them, but for those that another limb hides.
    fn outline(
        &self,
        shape: &Shape,
        samples: &[TemplateSample],
        measure: &BandMeasure,
        mut each: impl FnMut(Part, PlacedSample),
    ) {
        match shape {
            Shape::Planar(map) => {
                self.planar(samples).iter().for_each(|s| each(s.part(), map.place(s)));
            }
            Shape::Ribbon(x) => {
                let measure = measure.with_thumb(self.kind.has_thumb);
                if let Ok(space) = Ribbon::<RIBBON_DOF>::about(x, &measure) {
                    let pose = space.pose(x);
                    let placed = self.bands(samples).iter().map(|s| (s, pose.place(s)));
                    let seen = placed.filter(|(s, p)| !pose.is_hidden(s, p));
                    seen.for_each(|(s, p)| each(s.part(), p));
                }
            }
        }
    }

    /// How many of its samples are the finger's: the first ones.
    fn fingers(&self, samples: &[TemplateSample]) -> usize {
        match self.shape {
            Shape::Ribbon(_) => finger_samples(samples).len(),
            Shape::Planar(_) => finger_samples(self.planar(samples)).len(),
        }
    }

    /// A search for these samples by what is known of the hand.
    fn attempt<'a>(
        &'a self,
        samples: &'a [TemplateSample],
        frame: &Scene<'_>,
        look: Look,
        polarity: Polarity,
    ) -> Attempt<'a> {
        let Look { half_length_px, scale, lead, window, rest_px, own_only } = look;
        let sight = self.sight(frame, lead, polarity);
        let most_scale_px = if own_only { self.most_scale_px() } else { f64::INFINITY };
        Attempt { samples, sight, scale, half_length_px, window, rest_px, own_only, most_scale_px }
    }

    /// Whether it was seen whole of late: what never was may be none, and moves as it likes.
    fn is_known_whole(&self) -> bool {
        self.partly_frames < MOST_COVERED_FRAMES
    }

    /// Notes whether a fit that counts explains nearly all of its contour.
    fn count_partly(&mut self, found: &Found) {
        let is_whole = found.explained() >= SURE;
        self.partly_frames = if is_whole { 0 } else { self.partly_frames.saturating_add(1) };
    }

    /// Takes over what the edges of a fit that counts scatter. What covers a hand that is known
    /// whole has edges that are not its own.
    fn learn_usual(&mut self, found: &Found) {
        if let Some(fit) = found.fit.filter(|_| self.partly_frames == 0 || !self.is_known_whole()) {
            self.usual_px += USUAL_RATE * (fit.residual_rms_px - self.usual_px);
        }
    }

    /// By how much the edges of a fit scatter more than is usual, as a standard deviation \[px\]:
    /// a hand that is known whole does not, but what covers it.
    fn unusual_px(&self, fit: &Fit) -> f64 {
        if self.partly_frames == 0 || !self.is_known_whole() {
            return 0.0;
        }
        (fit.residual_rms_px.powi(2) - self.most_scale_px().powi(2)).max(0.0).sqrt()
    }

    /// What its edges scatter at most about a fit in its place \[px\].
    fn most_scale_px(&self) -> f64 {
        (USUAL_TIMES * self.usual_px).max(USUAL_LEAST_PX)
    }

    /// How to look for it in a frame.
    fn sight(&self, frame: &Scene<'_>, lead: Lead, polarity: Polarity) -> Sight<'_> {
        let known = self.looks.as_ref().and_then(|l| l.sight(frame, lead, polarity));
        known.unwrap_or(Sight::unknown(polarity))
    }

    /// Whether a mixture of colours shows it better than the grey image.
    fn is_mixed(&self) -> bool {
        self.looks.as_ref().is_some_and(Looks::is_mixed)
    }

    /// Whether its looks are known so far that this frame can show them.
    fn votes_in(&self, frame: &Scene<'_>) -> bool {
        self.looks.as_ref().is_some_and(|l| !l.is_coloured() || frame.colour().is_some())
    }
}

/// What one frame's fit came to.
struct Found<T = Shape> {
    shape: T,
    fit: Option<Fit>,
    iterations: usize,
}

/// How a hand is settled on: from which shape, at which scale, in which window.
type Path = (Shape, Scale, Option<Window>);

/// One of the places where the hand may be.
struct Way {
    found: Found,
    path: Path,
    /// The part of the finger's contour whose edge is explained and looks like the hand inside.
    own: f64,
    /// What its motion costs; ∞ if no hand can have become or moved to it, or it is no fit.
    cost: f64,
}

/// How a hand has moved to a place.
struct Moved {
    /// As [`Way::cost`].
    cost: f64,
    /// Whether a hand that moves as it did would hardly be there.
    surprises: bool,
}

impl Way {
    /// How well it explains the contour, less what its motion costs. Edges that do not look like the
    /// hand inside may be those of what covers it.
    fn worth(&self) -> f64 {
        let others = (self.found.explained() - self.own).max(0.0);
        self.own + OTHERS_SAY * others - self.cost
    }
}

impl Found {
    fn is_accepted(&self, accept: &AcceptOptions) -> bool {
        self.refusal(accept).is_none()
    }

    /// Why its edges alone do not make it a hand.
    fn refusal(&self, accept: &AcceptOptions) -> Option<Refusal> {
        let Some(fit) = &self.fit else { return Some(Refusal::NoFit) };
        if fit.agreement < accept.min_inliers {
            Some(Refusal::Agreement)
        } else if fit.residual_rms_px > max_residual_px(accept, self.shape.width()) {
            Some(Refusal::Residual)
        } else {
            None
        }
    }

    /// The part of the visible contour that the fit explains, 0–1.
    fn explained(&self) -> f64 {
        self.fit.map_or(0.0, |f| f.support.share())
    }
}

impl From<Found<AffineMap>> for Found {
    fn from(found: Found<AffineMap>) -> Self {
        let Found { shape, fit, iterations } = found;
        Self { shape: Shape::Planar(shape), fit, iterations }
    }
}

impl From<Converged<RIBBON_DOF>> for Found {
    fn from(found: Converged<RIBBON_DOF>) -> Self {
        let Converged { x, fit, iterations } = found;
        // A band that is turned inside out is no finger.
        Self { shape: Shape::Ribbon(x), fit: fit.filter(|_| x[3] > 0.0), iterations }
    }
}

/// How far what a hand cannot change may stray while it is tracked: standard deviations of the
/// band template, in parts of the finger's half-width, of 1 for the taper, and of its length. The
/// thumb may move, and foreshortening moves its root.
const HELD_WIDTH_SIGMA: f64 = 0.06;
const HELD_TAPER_SIGMA: f64 = 0.03;
const HELD_THUMB_SIGMA: f64 = 0.1;
/// Part of a change of these that is taken over per accepted frame.
const HELD_RATE: f64 = 0.05;
/// A thumb has grown or shrunk by no more than this factor since the hand was acquired, and this
/// part of it is explained.
const THUMB_CHANGE: f64 = 1.7;
const THUMB_SEEN: f64 = 0.4;
/// No finger line depends on where exactly the thumb is: it is at rest when no sample moves further
/// than this \[px\].
const THUMB_RESTS_PX: f64 = 0.1;
/// Where covers may give a hand edges that it does not have, the residual offsets' scale is at most so
/// many times the usual one and need not be below this \[px\]; the usual one follows slowly.
const USUAL_TIMES: f64 = 2.0;
const USUAL_LEAST_PX: f64 = 0.2;
const USUAL_RATE: f64 = 0.1;
/// While the thumb is fitted, the finger stays within this of where it is \[px, rad, 1\].
const PINNED_SIGMA: f64 = 1e-4;

/// How often the settled hand is looked at anew in its own colours, and how much more freely than
/// while it is tracked.
const BED_IN_ROUNDS: usize = 3;
const BED_IN_SLACK: f64 = 4.0;
/// So much it has turned at most when it is known \[rad\].
const MOST_TURNED_RAD: f64 = 0.3;
/// And by no more than this part of the template's length, or what the template reaches.
const MOST_SLID: f64 = 0.5;
/// By these edges, its inside is still told from its outside to this part of how well it was.
const STILL_TOLD: f64 = 0.8;

/// Flanks are refined from so far beyond where another limb hides them \[px\].
const CROTCH_PX: f64 = 2.0;
/// A flank that nothing hides is refined from so much before the outline's beginning, in units of
/// the finger's length: what is no finger there is found out, and a longer flank gives a surer
/// angle.
const BEYOND_OUTLINE: f64 = 0.07;
/// Both go round the tip to this part of the half-width beyond the middle of its round end.
const CAP: f64 = 0.7;

/// What a fit's covariance does not know of: how far the template slides on a hand that is not
/// quite like it, standard deviations of (c_u, c_v, θ) \[px, px, rad\].
const MISFIT_SIGMAS: [f64; 3] = [0.5, 0.5, 0.01];
/// A hand that moves as foretold stays below what counts as a surprise with this probability.
const SURPRISE: f64 = 0.9999;
/// Once the votes have been sought, their changes are looked for this part of the way, for the hand
/// may have turned besides.
const SOUGHT: f64 = 0.5;
/// Turns of the hand that are sought \[rad\].
const SOUGHT_TURNS_RAD: [f64; 3] = [0.0, -0.25, 0.25];

/// What stands free of the table is foreground this far inside its outline, in parts of its
/// half-width and at least \[px\]: to this part at least, and by so much more than as far outside,
/// where the shadow that it throws may be taken for foreground too.
const FREE_PART: f64 = 0.4;
const FREE_PX: f64 = 3.0;
const FREE_SHARE: f64 = 0.5;
const FREE_CONTRAST: f64 = 0.2;

/// What has not been seen whole for so many frames may be no hand that is covered in part, but none.
const MOST_COVERED_FRAMES: usize = 90;
/// A hand whose finger is bent in more frames in a row than this is lost.
const MOST_BENT_FRAMES: usize = 30;

/// Half the width of the largest finger for which lengths and speeds in pixels are meant as they
/// are while it is followed \[px\]; those of a larger one grow with it.
const FOLLOWED_HALF_WIDTH_PX: f64 = 13.0;

/// A lost hand is looked for this much further than a tracked one.
const LOST_REACH: f64 = 2.0;
/// A fit that explains this part of the contour needs no second look from afar.
const SURE: f64 = 0.85;
/// Nor does one whose motion costs no more than this.
const UNSURPRISING: f64 = 0.1;
/// A contour of which less than this looks like the hand may be seen in another light.
const UNLIKE: f64 = 0.3;
/// What an edge counts that does not look like the hand inside, beside one that does: in a new light
/// none does.
const OTHERS_SAY: f64 = 0.1;
/// An edge is the hand's own only within so many of the largest scales of its residual offsets.
const OWN_SCALES: f64 = 1.5;
/// Once votes have led the contour to the hand, its edges are looked for this far \[px\].
const NEAR_PX: f64 = 10.0;

impl ContourTracker {
    /// A tracker whose template waits at `start`.
    ///
    /// # Errors
    /// When the start pose or an option is not finite or outside its documented range, and
    /// [`Error::Unsupported`] for a traced outline with [`Model::Ribbon`]: only a pistol has bands.
    pub fn new(template: Template, start: &StartPose, options: TrackerOptions) -> Result<Self> {
        options.check()?;
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
            moulded: Vec::with_capacity(samples.len()),
            looks: None,
            thumb_missed: 0,
            posture: Posture::Straight,
            bent_frames: 0,
            straight_frames: 0,
            usual_px: f64::INFINITY,
            partly_frames: MOST_COVERED_FRAMES,
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
            last_time_s: None,
            exposure: Exposure::new(),
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
    /// widths. When that frame shows no hand there, the template waits.
    ///
    /// # Errors
    /// Those of [`new`](Self::new).
    pub fn at_hand(template: Template, start: &StartPose, options: TrackerOptions) -> Result<Self> {
        let mut tracker = Self::new(template, start, options)?;
        tracker.phase = Phase::Acquiring { settled: 1 };
        Ok(tracker)
    }

    /// The same tracker with another instruction set than the processor's widest: slower, with the
    /// same results to the last bit.
    #[must_use]
    pub fn with_isa(self, isa: Isa) -> Self {
        let convergence = self.convergence.with_isa(isa);
        Self { convergence, refiner: self.refiner.with_isa(isa), ..self }
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
        let Self { hand, samples, waiting, .. } = self;
        hand.outline(&hand.shape, samples, &waiting.measure, |_, placed| contour.push(placed));
        contour
    }

    /// The last search: lines, what each one found, and whether that agrees with the fit.
    #[must_use]
    pub fn search_lines(&self) -> impl ExactSizeIterator<Item = SearchedLine<'_>> {
        self.convergence.search_lines()
    }

    /// One frame of looking for a lost hand: where it was last, then at the waiting template.
    fn recover(
        &mut self,
        frame: &Scene<'_>,
        time_s: f64,
        settled: usize,
        last: (Shape, Kind),
    ) -> Result<Track> {
        let (shape, kind) = last;
        let settling = std::mem::replace(&mut self.hand.kind, kind);
        let reach_px = LOST_REACH * self.largeness() * self.options.track.half_length_px;
        let accept = self.options.acquire.accept;
        let found = self.find(frame, shape, reach_px, None)?;
        if self.known(&accept, None).judge(&found).is_ok() {
            let bend = self.bend(frame, &found)?;
            let posture = self.hand.posture.after(bend.as_ref(), &found);
            if !posture.is_bent() {
                self.hand.shape = found.shape;
                self.start(time_s, &found, posture)?;
                return self.tracked(frame, time_s, &found, &accept);
            }
        }
        self.hand.kind = settling;
        self.acquire(frame, time_s, settled, Some(last))
    }

    /// One frame of acquisition, for the first time or after a loss.
    fn acquire(
        &mut self,
        frame: &Scene<'_>,
        time_s: f64,
        settled: usize,
        lost: Option<(Shape, Kind)>,
    ) -> Result<Track> {
        let AcquireOptions { accept, settle_frames, settle_change, .. } = self.options.acquire;
        let width_before = self.hand.shape.width();
        let (mut found, mut refusal) = self.seen(frame, settled)?;
        if refusal.is_some() && (1..settle_frames).contains(&settled) {
            // It has moved on farther than edges lead: the template still waits there.
            (found, refusal) = self.seen(frame, 0)?;
        }
        let accepted = refusal.is_none();
        let change = (found.shape.width() / width_before - 1.0).abs();
        let settled = match (accepted, settled) {
            (false, _) => 0,
            (true, 0) => 1,
            (true, n) if change <= settle_change => n + 1,
            (true, _) => 1,
        };
        if accepted {
            self.hand.shape = found.shape;
        } else {
            self.hand.shape = self.waiting.shape(&self.template);
            self.hand.kind = self.waiting.kind(&self.options);
        }
        if settled >= settle_frames {
            let before = self.hand.clone();
            if let Some(acquired) = self.freeze(frame)? {
                let bend = self.bend(frame, &acquired)?;
                let posture = Posture::Straight.after(bend.as_ref(), &acquired);
                if !posture.is_bent() {
                    let accept = self.options.track.accept;
                    self.start(time_s, &acquired, posture)?;
                    return self.tracked(frame, time_s, &acquired, &accept);
                }
                refusal = Some(Refusal::Misfit);
                self.hand = before;
            } else {
                self.hand = before;
            }
        }
        let (phase, status) = lost
            .map_or((Phase::Acquiring { settled }, Status::Acquiring), |last| {
                (Phase::Lost { last, settled }, Status::Lost)
            });
        self.phase = phase;
        Ok(track(time_s, status, &found, &accept, refusal))
    }

    /// What is found without what is known of the background, or else with it, and why it is no hand.
    fn seen(&mut self, frame: &Scene<'_>, settled: usize) -> Result<(Found, Option<Refusal>)> {
        let alone = self.settled(frame, &frame.alone(), settled)?;
        if alone.1.is_none() || frame.background().is_none() {
            return Ok(alone);
        }
        self.settled(frame, frame, settled)
    }

    /// What is found at the waiting template or where it was, and why it is no hand. What lies on the
    /// table is none, nor is the inside of a hand: a finger shows foreground inside its outline and
    /// less of it outside, as far as what is behind it is known. A thumb may lie before the hand.
    fn settled(
        &mut self,
        frame: &Scene<'_>,
        seen: &Scene<'_>,
        settled: usize,
    ) -> Result<(Found, Option<Refusal>)> {
        let found = self.mould(seen, settled)?;
        let refusal = found.refusal(&self.options.acquire.accept);
        let is_table = || !self.stands_free(frame, &found.shape);
        let refusal = refusal.or_else(|| is_table().then_some(Refusal::Background));
        Ok((found, refusal))
    }

    fn stands_free(&self, frame: &Scene<'_>, shape: &Shape) -> bool {
        let Some(background) = frame.background() else { return true };
        let away_px = (FREE_PART * shape.width()).max(FREE_PX);
        let mut sides = [(0.0, 0.0); 2];
        self.hand.outline(shape, &self.samples, &self.waiting.measure, |part, placed| {
            if part == Part::Thumb {
                return;
            }
            for ((sum, count), px) in sides.iter_mut().zip([-away_px, away_px]) {
                let at = placed.position + placed.normal * px;
                if let Some(likely) = background.foreground(frame, at.x, at.y) {
                    *sum += likely;
                    *count += 1.0;
                }
            }
        });
        let [inside, outside] = sides.map(|(sum, count)| (count > 0.0).then(|| sum / count));
        inside.is_none_or(|share| {
            share >= FREE_SHARE && outside.is_none_or(|around| around <= share - FREE_CONTRAST)
        })
    }

    /// The hand at the waiting template, or where an earlier frame has found it.
    fn mould(&mut self, frame: &Scene<'_>, settled: usize) -> Result<Found> {
        let mould = Mould {
            options: &self.options,
            samples: &self.samples,
            waiting: &self.waiting.ribbon,
            measure: self.waiting.measure,
        };
        let moulded = match self.hand.shape {
            _ if self.template.proportions().is_none() => {
                let half_length_px = self.options.acquire.reach_px(self.waiting.ribbon[3]);
                return self.affine(frame, self.waiting.map, half_length_px);
            }
            Shape::Ribbon(x) if settled > 0 => {
                mould.refit(&mut self.convergence, frame, &x, self.hand.kind)?
            }
            _ => mould.find(&mut self.convergence, frame)?,
        };
        self.hand.kind = moulded.kind;
        Ok(moulded.hand.into())
    }

    /// Keeps the settled hand's dimensions and looks: tracking starts from them. None if the
    /// paper's template cannot take them on, or explains them badly.
    fn freeze(&mut self, frame: &Scene<'_>) -> Result<Option<Found>> {
        let settled = self.hand.shape.placement();
        self.bed_in(frame)?;
        if let Some(looks) = &mut self.hand.looks {
            looks.anchor();
        }
        let frozen = match (self.hand.shape, self.options.model) {
            (Shape::Ribbon(x), Model::Ribbon) => {
                self.hand.acquired = x;
                self.settle(frame, self.hand.shape, Scale::Fine, None)?
            }
            (Shape::Ribbon(x), Model::Paper) => {
                self.hand.acquired = x;
                let length_px = self.waiting.measure.length_px;
                // A thumb that the image shows nearly along the finger makes no pistol; the finger
                // does without it.
                let with_thumb = self.hand.kind.has_thumb;
                let pistol = self.template.moulded(&x, length_px, with_thumb);
                self.hand.kind.has_thumb = with_thumb && pistol.is_ok();
                let Ok(template) = pistol.or_else(|_| self.template.moulded(&x, length_px, false))
                else {
                    return Ok(None);
                };
                self.hand.moulded = template.samples(self.options.samples)?;
                let tip = self.ribbon::<RIBBON_DOF>(&x)?.pose(&x).axis().tip;
                self.affine(frame, AffineMap::upright(tip, x[2], length_px)?, NEAR_PX)?
            }
            (Shape::Planar(map), _) => self.affine(frame, map, NEAR_PX)?,
        };
        // A hand that stays has not slid along what is behind it.
        let slid = frozen.shape.placement() - settled;
        let length_px = self.waiting.measure.length_px;
        let most_px =
            self.options.acquire.reach_px(self.waiting.ribbon[3]).max(MOST_SLID * length_px);
        let stays = slid.xy().norm() <= most_px && slid[2].sin().abs() <= MOST_TURNED_RAD;
        let accepted = stays
            && frozen.is_accepted(&self.options.track.accept)
            && self.told_apart(frame) >= STANDS_OUT;
        if accepted {
            self.hand.shape = frozen.shape;
        }
        Ok(accepted.then_some(frozen))
    }

    /// Learns what the settled hand looks like, and looks at it once more in the mixture of colours
    /// that shows it best: a shaded flank or the tip, which grey may have hidden, comes out now.
    fn bed_in(&mut self, frame: &Scene<'_>) -> Result<()> {
        let mut told = self.told_apart(frame);
        for _ in 0..BED_IN_ROUNDS {
            self.hand.looks = None;
            self.learn_looks(frame)?;
            let (Shape::Ribbon(x), true) = (self.hand.shape, self.hand.is_mixed()) else {
                return Ok(());
            };
            let half_length_px = self.options.acquire.reach_px(self.waiting.ribbon[3]);
            let look = Look { lead: Lead::AnyEdge, ..Look::edges(half_length_px) };
            let turned = self.run_ribbon::<3>(frame, &x, Limb::Finger, look, None)?;
            self.hand.acquired = x;
            let held = self.held::<5>(&x, BED_IN_SLACK);
            let finger = self.run_ribbon::<5>(frame, &turned.x, Limb::Finger, look, Some(&held))?;
            if Found::from(finger).is_accepted(&self.options.acquire.accept) {
                let slid = finger.x.fixed_rows::<2>(0) - x.fixed_rows::<2>(0);
                let mut moved = finger.x;
                // The thumb stays where it was.
                moved[5] -= slid.dot(&Vector2::new(x[2].cos(), x[2].sin()));
                self.hand.shape = Shape::Ribbon(moved);
                let now = self.told_apart(frame);
                if now < STILL_TOLD * told {
                    self.hand.shape = Shape::Ribbon(x);
                    return Ok(());
                }
                told = now;
            }
        }
        Ok(())
    }

    /// How well the last search's contour tells the inside of the finger from its outside.
    fn told_apart(&mut self, frame: &Scene<'_>) -> f64 {
        let (samples, finger) = (self.hand.fingers(&self.samples), self.hand.shape.silhouette());
        self.convergence.told_apart(samples, frame, &finger)
    }

    /// Whether the planar template has a thumb that shows length and shear; a traced outline is
    /// taken to be no mere finger.
    fn shows_shear(&self) -> bool {
        self.hand.kind.has_thumb || self.template.proportions().is_none()
    }

    /// A hand that was found is followed from here.
    fn start(&mut self, time_s: f64, found: &Found, posture: Posture) -> Result<()> {
        let large = self.largeness();
        self.gate = self.options.gate(large)?;
        let options = &self.options.track.dynamics;
        let (components, gap_s) = (options.components(large), options.longest_gap_s);
        let at = found.shape.placement();
        self.dynamics = Some(Dynamics::start(components, gap_s, time_s, &at, &misfit())?);
        self.pace = Pace::unknown();
        self.steady.forget();
        self.hand.usual_px = found.fit.map_or(f64::INFINITY, |fit| fit.residual_rms_px);
        self.hand.partly_frames = MOST_COVERED_FRAMES;
        self.hand.count_partly(found);
        self.hand.thumb_missed = 0;
        self.hand.posture = posture;
        (self.hand.bent_frames, self.hand.straight_frames) = (0, 0);
        self.phase = Phase::Tracking { missed: 0 };
        Ok(())
    }

    /// How many times as large as a usual hand this one is seen: it moves so much farther.
    fn largeness(&self) -> f64 {
        (self.hand.acquired[3] / FOLLOWED_HALF_WIDTH_PX).max(1.0)
    }

    /// What the hand's motion tells about this frame; nothing after a long gap.
    fn foretell(&self, time_s: f64) -> Result<Option<Foretold>> {
        let Some(dynamics) = self.dynamics else { return Ok(None) };
        Ok(match dynamics.predict(time_s)? {
            Prediction::Expected(expected) => {
                let window = Window {
                    expected,
                    gate: self.gate,
                    near_px: self.largeness() * NEAR_PX,
                    own_only: false,
                    lead: Lead::HandEdges,
                };
                Some(Foretold { dynamics, time_s, window })
            }
            Prediction::Lost { .. } => None,
        })
    }

    /// One frame of tracking. A hand that was not seen for long is not followed but found again.
    fn follow(&mut self, frame: &Scene<'_>, time_s: f64, missed: usize) -> Result<Track> {
        let TrackOptions { half_length_px, accept, lose_after_frames, .. } = self.options.track;
        let from = self.hand.shape;
        let Some(foretold) = self.foretell(time_s)? else {
            return self.recover(frame, time_s, 0, (from, self.hand.kind));
        };
        let expected = foretold.window.expected.vector;
        // It may as well have stopped or turned round, and the longer it is unseen the more it may.
        let went_px = (expected - from.placement()).xy().norm();
        let reach_px = self.largeness() * half_length_px * (1.0 + missed as f64) + went_px;
        let predicted = from.placed(&expected);
        let found = self.find(frame, predicted, reach_px, Some(&foretold))?;
        let followed = foretold.followed(&found)?;
        let innovation = followed.as_ref().and_then(|(_, innovation)| innovation.as_ref());
        let known = self.known(&accept, innovation);
        let innovation = innovation.map(Innovation::normalised_square);
        let verdict = known.judge(&found);
        let min_agreement = found.fit.map_or(accept.min_inliers, |fit| known.min_agreement(&fit));
        let accept = AcceptOptions { min_inliers: min_agreement, ..accept };
        if let (Ok(()), Some((dynamics, _))) = (verdict, followed) {
            let bend = self.bend(frame, &found)?;
            self.hand.posture = self.hand.posture.after(bend.as_ref(), &found);
            self.hand.shape = found.shape;
            let jumped = innovation.is_some_and(|square| square > self.surprise);
            let before = foretold.dynamics.velocity();
            self.dynamics = Some(if jumped { dynamics.doubting(before) } else { dynamics });
            let mut track = if self.hand.posture.is_bent() {
                self.keep_in_sight(time_s, &found, &accept)
            } else {
                self.hand.bent_frames = 0;
                self.hand.straight_frames += 1;
                self.hand.grow();
                self.hand.count_thumb(&found, lose_after_frames);
                self.hand.count_partly(&found);
                if !found.fit.is_some_and(|fit| fit.own_only) {
                    self.take_over_looks(frame, &found)?;
                }
                self.pace.follow(innovation);
                self.hand.learn_usual(&found);
                self.phase = Phase::Tracking { missed: 0 };
                self.tracked(frame, time_s, &found, &accept)?
            };
            track.diagnostics.innovation = innovation;
            track.diagnostics.bend_rad = bend.map(|b| b.angle_rad);
            return Ok(track);
        }
        let missed = missed + 1;
        let status = if missed >= lose_after_frames {
            self.phase = Phase::Lost { last: (from, self.hand.kind), settled: 0 };
            Status::Lost
        } else {
            self.phase = Phase::Tracking { missed };
            Status::Tracking
        };
        let mut track = track(time_s, status, &found, &accept, verdict.err());
        track.diagnostics.innovation = innovation;
        Ok(track)
    }

    /// A bent finger yields no line, but stays in sight, to be followed again when it is straight;
    /// not for longer than it has been straight, for what is bent may be no finger at all.
    fn keep_in_sight(&mut self, time_s: f64, found: &Found, accept: &AcceptOptions) -> Track {
        self.hand.bent_frames += 1;
        // The template slides as the finger bends, and back again.
        self.pace = Pace::unknown();
        let patience = self.hand.straight_frames.min(MOST_BENT_FRAMES);
        let is_over = self.hand.bent_frames > patience;
        self.phase = if is_over {
            Phase::Lost { last: (found.shape, self.hand.kind), settled: 0 }
        } else {
            Phase::Tracking { missed: 0 }
        };
        track(time_s, self.status(), found, accept, Some(Refusal::Misfit))
    }

    /// What a fit of the followed hand is judged by.
    fn known(&self, accept: &AcceptOptions, innovation: Option<&Innovation<3>>) -> Known<'_> {
        let motion = innovation.map(|i| Motion::of(i, self.surprise));
        let Hand { acquired, .. } = &self.hand;
        let most_scatter_px = self.hand.most_scale_px();
        Known { accept: *accept, acquired, motion, most_scatter_px }
    }

    /// The hand about a predicted shape. Its edges are usually near and sharp; when they explain
    /// the contour badly, or by a motion that surprises, it may have gone on as it did and be covered
    /// in part, or have gone elsewhere: the votes lead there from afar, and a larger kernel sees edges
    /// that motion has smeared. What explains the contour best by edges that look like the hand counts,
    /// less what its motion costs. Where nothing looks like the hand and all its edges are in their
    /// place, the light has changed.
    fn find(
        &mut self,
        frame: &Scene<'_>,
        predicted: Shape,
        reach_px: f64,
        foretold: Option<&Foretold>,
    ) -> Result<Found> {
        let reach_px = reach_px.min(MAX_HALF_LENGTH_PX as f64);
        let window = foretold.map(|f| f.window);
        let near = self.settle(frame, predicted, Scale::Fine, window)?;
        if self.is_plain(&near, foretold)? {
            return Ok(near);
        }
        let near = self.weighed(frame, near, (predicted, Scale::Fine, window), foretold)?;
        let steady = match foretold {
            Some(f) if self.hand.is_known_whole() => {
                let narrow = Some(self.pace.steady(&f.window));
                Some(self.way(frame, (predicted, Scale::Fine, narrow), foretold)?)
            }
            _ => None,
        };
        let approached = self.approach(frame, predicted, reach_px)?;
        let smeared = self.way(frame, (approached, Scale::Coarse, None), foretold)?;
        let sharp = self.way(frame, (smeared.found.shape, Scale::Fine, None), foretold)?;
        // Of equals the last one, whose search need not be done again.
        let (mut best, mut is_last) = (sharp, true);
        let mut impossible: Option<Way> = None;
        for way in [Some(smeared), steady, Some(near)].into_iter().flatten() {
            let mut other = way;
            if other.worth() > best.worth() {
                std::mem::swap(&mut best, &mut other);
                is_last = false;
            }
            let explained = impossible.as_ref().map_or(SURE, |way| way.found.explained());
            if other.cost.is_infinite() && other.found.explained() >= explained {
                impossible = Some(other);
            }
        }
        if let (Some(foretold), true) = (foretold, best.worth() < UNLIKE) {
            let window = self.pace.steady(&foretold.window);
            let narrow = Some(Window { lead: Lead::AnyEdge, ..window });
            let relit = self.way(frame, (predicted, Scale::Fine, narrow), Some(foretold))?;
            if self.is_plain(&relit.found, Some(foretold))? {
                return Ok(relit.found);
            }
            is_last = false;
        }
        // What no hand can have become or moved to is told as such, where no hand is left.
        if let Some(way) = impossible
            && best.found.explained() < self.options.track.accept.min_inliers
        {
            (best, is_last) = (way, false);
        }
        if is_last {
            return Ok(best.found);
        }
        // Once more, so that the last search is that of the best.
        let (from, scale, window) = best.path;
        self.settle(frame, from, scale, window)
    }

    /// A way to settle, tried.
    fn way(&mut self, frame: &Scene<'_>, path: Path, foretold: Option<&Foretold>) -> Result<Way> {
        let (from, scale, window) = path;
        let found = self.settle(frame, from, scale, window)?;
        self.weighed(frame, found, path, foretold)
    }

    /// What was found in the last search, and what tells for and against it.
    fn weighed(
        &mut self,
        frame: &Scene<'_>,
        found: Found,
        path: Path,
        foretold: Option<&Foretold>,
    ) -> Result<Way> {
        let cost = match found.fit {
            Some(_) => self.motion(&found, foretold)?.cost,
            None => f64::INFINITY,
        };
        let samples = self.hand.fingers(&self.samples);
        let sight = self.hand.sight(frame, Lead::HandEdges, self.options.polarity);
        let within_px = OWN_SCALES * self.hand.most_scale_px();
        let own = self.convergence.own_share(frame, &sight, samples, within_px)?;
        Ok(Way { found, path, own, cost })
    }

    /// Whether a fit leaves nothing to ask: nearly all of the contour is explained, where a hand would
    /// be that goes on as it did.
    fn is_plain(&self, found: &Found, foretold: Option<&Foretold>) -> Result<bool> {
        Ok(found.explained() >= SURE && !self.motion(found, foretold)?.surprises)
    }

    /// What the way to a fit costs, and whether it surprises.
    fn motion(&self, found: &Found, foretold: Option<&Foretold>) -> Result<Moved> {
        let followed = foretold.map(|f| f.followed(found)).transpose()?.flatten();
        let innovation = followed.as_ref().and_then(|(_, innovation)| innovation.as_ref());
        let possible = self.known(&self.options.track.accept, innovation).is_possible(&found.shape);
        let cost = match (possible, innovation) {
            (Err(_), _) => f64::INFINITY,
            (Ok(()), Some(i)) if self.hand.is_known_whole() => self.pace.cost(i),
            _ => 0.0,
        };
        let surprises = cost > UNSURPRISING
            || innovation.is_some_and(|i| i.normalised_square() > self.surprise);
        Ok(Moved { cost, surprises })
    }

    /// From afar: by the votes of pixels, if they are known, to about the right place; then the
    /// template moves, then turns, until it covers what looks like the hand.
    fn approach(&mut self, frame: &Scene<'_>, from: Shape, reach_px: f64) -> Result<Shape> {
        let (from, look) = if self.hand.votes_in(frame) {
            let look = Look { lead: Lead::Votes, ..Look::edges(SOUGHT * reach_px) };
            (self.seek(frame, from, reach_px)?, look)
        } else {
            (from, Look::edges(reach_px))
        };
        Ok(match from {
            Shape::Planar(map) => {
                let moved = self.planar::<Translation, 2>(frame, map, look)?;
                Shape::Planar(self.planar::<Rigid, 3>(frame, moved.shape, look)?.shape)
            }
            Shape::Ribbon(x) => {
                let moved = self.run_ribbon::<2>(frame, &x, Limb::Thumb, look, None)?;
                Shape::Ribbon(self.run_ribbon::<3>(frame, &moved.x, Limb::Finger, look, None)?.x)
            }
        })
    }

    /// The pose about another that looks most like the hand.
    fn seek(&mut self, frame: &Scene<'_>, about: Shape, reach_px: f64) -> Result<Shape> {
        let Self { hand, samples, waiting, seek, convergence, options, .. } = self;
        let sight = hand.sight(frame, Lead::Votes, options.polarity);
        let Some(appearance) = sight.cue.appearance() else { return Ok(about) };
        let mut best = (f32::NEG_INFINITY, about);
        for turn_rad in SOUGHT_TURNS_RAD {
            let mut placement = about.placement();
            placement[2] += turn_rad;
            seek.clear(hand.acquired[3]);
            let turned = about.placed(&placement);
            hand.outline(&turned, samples, &waiting.measure, |_, placed| seek.push(&placed));
            let shown = convergence.shown_about(frame, sight.mixture, seek.pixels(), reach_px)?;
            let Judged { by_px, separation } = seek.best(&shown, appearance, reach_px);
            if separation > best.0 {
                placement[0] += by_px.x;
                placement[1] += by_px.y;
                best = (separation, about.placed(&placement));
            }
        }
        Ok(best.1)
    }

    /// From nearby, or as far as the window says, by edges: everything that the model leaves a
    /// tracked hand. The paper's leans its thumb, if it has one to show the shear; the band model
    /// takes up what a hand can change.
    fn settle(
        &mut self,
        frame: &Scene<'_>,
        from: Shape,
        scale: Scale,
        window: Option<Window>,
    ) -> Result<Found> {
        let near_px = window.map_or(self.largeness() * NEAR_PX, |w| w.near_px);
        let own_only = window.is_some_and(|w| w.own_only);
        let lead = window.map_or(Lead::HandEdges, |w| w.lead);
        let look = Look { lead, scale, own_only, ..Look::edges(near_px) };
        let first = match window {
            Some(Window { gate, .. }) => Look { window, half_length_px: gate.longest_px(), ..look },
            None => look,
        };
        let before_others = Look { rest_px: TAKEN_OVER_PX, ..first };
        Ok(match from {
            Shape::Planar(map) if self.shows_shear() => {
                let turned = self.planar::<Rigid, 3>(frame, map, before_others)?;
                self.planar::<RigidShear, 4>(frame, turned.shape, look)?.into()
            }
            Shape::Planar(map) => self.planar::<Rigid, 3>(frame, map, first)?.into(),
            Shape::Ribbon(x) => {
                let belief = window.and_then(|w| w.belief());
                let turned =
                    self.run_ribbon::<3>(frame, &x, Limb::Finger, before_others, belief.as_ref())?;
                let mut held = self.held::<5>(&x, 1.0);
                if let Some(Prior { mean, information }) = belief {
                    held.mean.fixed_rows_mut::<3>(0).copy_from(&mean);
                    held.information.fixed_view_mut::<3, 3>(0, 0).copy_from(&information);
                }
                let finger =
                    self.run_ribbon::<5>(frame, &turned.x, Limb::Finger, look, Some(&held))?;
                match &finger.fit {
                    Some(fit) if self.hand.kind.has_thumb => {
                        self.lean_thumb(frame, &finger, fit, look)?.into()
                    }
                    _ => finger.into(),
                }
            }
        })
    }

    /// The paper's acquisition: the template moves, turns, then deforms affinely; a finger alone,
    /// which shows neither length nor shear, only grows.
    fn affine(&mut self, frame: &Scene<'_>, from: AffineMap, half_length_px: f64) -> Result<Found> {
        let look = Look::edges(half_length_px);
        let moved = self.planar::<Translation, 2>(frame, from, look)?;
        let turned = self.planar::<Rigid, 3>(frame, moved.shape, look)?;
        Ok(if self.shows_shear() {
            self.planar::<Affine, 6>(frame, turned.shape, look)?.into()
        } else {
            self.planar::<Similarity, 4>(frame, turned.shape, look)?.into()
        })
    }

    /// One planar shape space; a fit that mirrors or flattens the template is none.
    fn planar<S: PlanarSpace<D>, const D: usize>(
        &mut self,
        frame: &Scene<'_>,
        from: AffineMap,
        look: Look,
    ) -> Result<Found<AffineMap>> {
        let Ok((space, x)) = S::through(&from) else {
            return Ok(Found { shape: from, fit: None, iterations: 0 });
        };
        let samples = self.hand.planar(&self.samples);
        let attempt = self.hand.attempt(samples, frame, look, self.options.polarity);
        let found = self.convergence.run(frame, &space, x, &attempt, None)?;
        let map = space.pose(&found.x);
        let sound = map.decompose().is_ok();
        Ok(Found {
            shape: if sound { map } else { from },
            fit: found.fit.filter(|_| sound),
            iterations: found.iterations,
        })
    }

    /// The thumb of a finger that was fitted. A thumb bends and leans; it must not turn the finger,
    /// whose line and covariance stay as they are.
    fn lean_thumb(
        &mut self,
        frame: &Scene<'_>,
        finger: &Converged<RIBBON_DOF>,
        fit: &Fit,
        look: Look,
    ) -> Result<Converged<RIBBON_DOF>> {
        let mut held = self.held::<RIBBON_DOF>(&finger.x, 1.0);
        for i in 0..5 {
            held.mean[i] = finger.x[i];
            held.information[(i, i)] = PINNED_SIGMA.powi(-2);
        }
        let look = Look { rest_px: THUMB_RESTS_PX, ..look };
        let whole = self.run_ribbon(frame, &finger.x, Limb::Thumb, look, Some(&held))?;
        let Some(with_thumb) = whole.fit else { return Ok(*finger) };
        if !self.is_thumb(&whole.x, &with_thumb) {
            // It stays where it was.
            return Ok(Converged { fit: Some(Fit { seen: with_thumb.seen, ..*fit }), ..*finger });
        }
        let mut shape = with_thumb.shape;
        for i in 0..5 {
            shape.vector[i] = finger.x[i];
        }
        shape
            .covariance
            .view_mut((0, 0), (5, 5))
            .copy_from(&fit.shape.covariance.view((0, 0), (5, 5)));
        let iterations = finger.iterations + whole.iterations;
        Ok(Converged {
            x: shape.vector,
            fit: Some(Fit { shape, rank: with_thumb.rank, seen: with_thumb.seen, ..*fit }),
            iterations,
        })
    }

    /// Whether what was fitted is still a thumb: about as long and as wide as it was when the hand
    /// was acquired, and seen. A thumb that has gone astray would hide the finger.
    fn is_thumb(&self, x: &RibbonVector, fit: &Fit) -> bool {
        let spine = |x: &RibbonVector| x.fixed_rows::<2>(6).norm();
        let acquired = &self.hand.acquired;
        let within = |ratio: f64| (1.0 / THUMB_CHANGE..=THUMB_CHANGE).contains(&ratio);
        within(spine(x) / spine(acquired))
            && within(x[8] / acquired[8])
            && fit.support.of(Part::Thumb) >= THUMB_SEEN
    }

    /// One prefix of the band template's shape vector, by the samples of the finger or of all of
    /// the hand, down to the thumb.
    fn run_ribbon<const D: usize>(
        &mut self,
        frame: &Scene<'_>,
        from: &RibbonVector,
        down_to: Limb,
        look: Look,
        held: Option<&Prior<D>>,
    ) -> Result<Converged<RIBBON_DOF>> {
        let space = self.ribbon::<D>(from)?;
        let samples = match down_to {
            Limb::Finger => finger_samples(&self.samples),
            Limb::Thumb => self.hand.bands(&self.samples),
        };
        let attempt = self.hand.attempt(samples, frame, look, self.options.polarity);
        let x = Ribbon::<D>::free(from);
        let found = self.convergence.run(frame, &space, x, &attempt, held)?;
        Ok(Converged { x: space.full(&found.x), fit: found.fit, iterations: found.iterations })
    }

    fn ribbon<const D: usize>(&self, about: &RibbonVector) -> Result<Ribbon<D>> {
        Ribbon::about(about, &self.waiting.measure.with_thumb(self.hand.kind.has_thumb))
    }

    /// What the hand cannot change: the widths and the taper are those it was acquired with, the
    /// thumb is near where it was in the last frame.
    fn held<const D: usize>(&self, last: &RibbonVector, slack: f64) -> Prior<D> {
        let acquired = &self.hand.acquired;
        let thumb_px = HELD_THUMB_SIGMA * self.waiting.measure.length_px;
        let held = [
            (0.0, f64::INFINITY),
            (0.0, f64::INFINITY),
            (0.0, f64::INFINITY),
            (acquired[3], HELD_WIDTH_SIGMA * acquired[3]),
            (acquired[4], HELD_TAPER_SIGMA),
            (last[5], thumb_px),
            (last[6], thumb_px),
            (last[7], thumb_px),
            (acquired[8], HELD_WIDTH_SIGMA * acquired[8]),
        ];
        let mut prior = Prior { mean: SVector::zeros(), information: SMatrix::zeros() };
        for (i, (mean, sigma)) in held.iter().take(D).enumerate() {
            prior.mean[i] = *mean;
            prior.information[(i, i)] = (slack * sigma).powi(-2);
        }
        prior
    }

    /// Takes over what a fit that counts shows of the hand. Where its looks did not lead to it, the
    /// light has changed: it looks as it looks now.
    fn take_over_looks(&mut self, frame: &Scene<'_>, found: &Found) -> Result<()> {
        let is_relit = self.hand.votes_in(frame) && found.fit.is_some_and(|fit| !fit.by_looks);
        if is_relit {
            self.hand.looks = None;
        }
        self.learn_looks(frame)?;
        if let Some(looks) = self.hand.looks.as_mut().filter(|_| is_relit) {
            looks.anchor();
        }
        Ok(())
    }

    /// Takes over what the last accepted fit saw on either side of the contour.
    fn learn_looks(&mut self, frame: &Scene<'_>) -> Result<()> {
        let coloured = frame.colour().is_some();
        let known = self.hand.looks.as_ref().map(Looks::is_coloured);
        if known == Some(true) && !coloured {
            return Ok(());
        }
        if known != Some(coloured) {
            self.hand.looks = None;
        }
        let (samples, finger) = (self.hand.fingers(&self.samples), self.hand.shape.silhouette());
        let keep = 1.0 - self.options.track.appearance_rate;
        let looks = self.hand.looks.get_or_insert_with(|| Looks::new(coloured));
        self.convergence.teach(looks, samples, frame, &finger, keep)
    }

    /// The story of a frame whose fit was accepted, with the finger line.
    fn tracked(
        &mut self,
        frame: &Scene<'_>,
        time_s: f64,
        found: &Found,
        accept: &AcceptOptions,
    ) -> Result<Track> {
        let refined = match self.hand.shape {
            Shape::Ribbon(x) if self.options.refine => self.refine(frame, &x)?,
            _ => None,
        };
        // Where the pixels agree with a finger only so far, the contour knows other things than two
        // bare flanks tell: the hand's colours, and its width.
        let contour = found.fit.map(|f| {
            FingerLine::of_contour(&f.axis, &f.line_covariance).misled(self.hand.unusual_px(&f))
        });
        let beside_cover = found.fit.is_some_and(|fit| fit.own_only);
        let finger_line = match (refined, contour) {
            // What covers a hand has pixels of its own.
            (Some(refined), Some(contour))
                if beside_cover
                    && (refined.source != Source::Photometric
                        || contour.contradicts(&FingerLine::of_pixels(&refined))) =>
            {
                Some(contour)
            }
            (Some(refined), _) if refined.source == Source::Photometric => {
                Some(FingerLine::of_pixels(&refined))
            }
            (Some(refined), Some(contour)) if refined.source == Source::Unsure => {
                Some(FingerLine::of_pixels(&refined).joined(&contour))
            }
            (Some(refined), Some(contour)) => Some(contour.doubted(&refined.axis)),
            (None, contour) | (_, contour @ None) => contour,
        };
        let finger_line = match self.hand.shape {
            Shape::Ribbon(x) if self.options.refine => finger_line.map(|line| {
                let length_px = self.waiting.measure.length_px;
                let shown = Shown { half_width_px: x[3], taper: x[4], length_px };
                self.steady.follow(frame.image(), time_s, line, &shown)
            }),
            _ => finger_line,
        };
        Ok(Track { finger_line, ..track(time_s, Status::Tracking, found, accept, None) })
    }

    /// How the finger of a fit that counts is bent, if its flanks tell; never of the paper's model.
    fn bend(&mut self, frame: &Scene<'_>, found: &Found) -> Result<Option<Bend>> {
        let Shape::Ribbon(x) = found.shape else { return Ok(None) };
        let Some(finger) = self.finger(&x)? else { return Ok(None) };
        let sight = self.hand.sight(frame, Lead::HandEdges, self.options.polarity);
        let shown = self.convergence.shown(frame, sight.mixture, &finger)?;
        self.refiner.bend(&shown, &finger, sight.polarity, sight.cue.appearance())
    }

    /// The finger by its flanks alone; none if they cannot be believed.
    fn refine(&mut self, frame: &Scene<'_>, x: &RibbonVector) -> Result<Option<Refined>> {
        let Some(finger) = self.finger(x)? else { return Ok(None) };
        let sight = self.hand.sight(frame, Lead::HandEdges, self.options.polarity);
        let shown = self.convergence.shown(frame, sight.mixture, &finger)?;
        let looks = sight.cue.appearance();
        // What is known of the background are grey levels, whatever mixture shows the hand best.
        let known = frame.background().map(|b| KnownBackground::from(b).behind(*frame.image()));
        self.refiner.refine(&shown, &finger, sight.polarity, looks, known.as_ref())
    }

    /// The finger that the band template stands for, as far as both its flanks were seen.
    fn finger(&self, x: &RibbonVector) -> Result<Option<Finger>> {
        let BandMeasure { length_px, round_end_px, .. } = self.waiting.measure;
        let (half_width_px, taper) = (x[3], x[4]);
        let flank = |flank| {
            let from = self.convergence.beginning(&self.samples, flank)?;
            let whole = self.samples.iter().filter(|s| s.part() == flank).all(|s| s.along >= from);
            Some(Stretch {
                from_px: if whole {
                    (from - BEYOND_OUTLINE) * length_px
                } else {
                    from * length_px + CROTCH_PX
                },
                to_px: round_end_px + CAP * half_width_px,
            })
        };
        let (Some(right), Some(left)) = (flank(Part::RightFlank), flank(Part::LeftFlank)) else {
            return Ok(None);
        };
        let flanks = [right, left];
        let axis = self.ribbon::<RIBBON_DOF>(x)?.pose(x).axis();
        Ok(Some(Finger { axis, half_width_px, taper, flanks, round_end_px: Some(round_end_px) }))
    }
}

/// The story of one frame whose fit was judged by `accept`, but for the finger line.
fn track(
    time_s: f64,
    status: Status,
    found: &Found,
    accept: &AcceptOptions,
    refusal: Option<Refusal>,
) -> Track {
    let accepted = refusal.is_none();
    let seen = found.fit.map_or(Seen::default(), |f| f.seen);
    Track {
        time_s,
        status,
        shape: found.fit.filter(|_| accepted).map(|f| f.shape),
        finger_line: None,
        diagnostics: Diagnostics {
            hits: seen.hits,
            iterations: found.iterations,
            accepted,
            refusal,
            visible: seen.visible,
            inliers: seen.inliers,
            agreement: found.fit.map_or(0.0, |f| f.agreement),
            min_agreement: accept.min_inliers,
            max_residual_px: max_residual_px(accept, found.shape.width()),
            residual_rms_px: found.fit.map_or(0.0, |f| f.residual_rms_px),
            rank: found.fit.map_or(0, |f| f.rank),
            innovation: None,
            bend_rad: None,
        },
    }
}

impl Waiting {
    /// What a hand would show that is just like the template.
    fn kind(&self, options: &TrackerOptions) -> Kind {
        Kind { has_thumb: self.measure.side != 0.0, polarity: options.polarity }
    }

    fn shape(&self, template: &Template) -> Shape {
        match template.proportions() {
            Some(_) => Shape::Ribbon(self.ribbon),
            None => Shape::Planar(self.map),
        }
    }
}

impl Shape {
    /// (c_u, c_v, θ): what both models share.
    fn placement(&self) -> Vector3<f64> {
        match self {
            Self::Ribbon(x) => x.fixed_rows::<3>(0).into_owned(),
            Self::Planar(map) => {
                let a = map.linear.column(0);
                Vector3::new(map.centre.x, map.centre.y, a.y.atan2(a.x))
            }
        }
    }

    /// The whole hand moved and turned to a placement.
    fn placed(&self, at: &Vector3<f64>) -> Self {
        let turn = Rotation2::new(at[2] - self.placement()[2]);
        match *self {
            Self::Ribbon(mut x) => {
                x.fixed_rows_mut::<3>(0).copy_from(at);
                let thumb = turn * Vector2::new(x[6], x[7]);
                (x[6], x[7]) = (thumb.x, thumb.y);
                Self::Ribbon(x)
            }
            Self::Planar(AffineMap { linear, .. }) => Self::Planar(AffineMap {
                centre: Point2::from(at.xy()),
                linear: turn.matrix() * linear,
            }),
        }
    }

    fn silhouette(&self) -> Silhouette {
        match self {
            Self::Ribbon(x) => Silhouette::of_band(x),
            Self::Planar(map) => {
                Silhouette { ahead: map.linear.column(0).normalize(), half_width_px: self.width() }
            }
        }
    }

    /// Half the width of the finger, up to a factor that the template fixes.
    fn width(&self) -> f64 {
        match self {
            Self::Ribbon(x) => x[3],
            Self::Planar(map) => map.linear.determinant() / map.linear.column(0).norm(),
        }
    }
}
