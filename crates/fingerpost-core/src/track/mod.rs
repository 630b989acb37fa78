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
//! ([`crate::axis`]), else from the contour; the lines of the frames before have a say in it where
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
//! the two halves of the finger are looked at once more, each for itself ([`crate::axis::Bend`]).
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
//! the hand may be. Each place is settled on by `fit_stages`, the stages of the fit, and an accepted
//! one yields its line, and teaches what the hand looks like, in `tell`.
//!
//! Source: Cipolla, Hadfield & Hollinghurst 1994, section 3.2.

mod acquire;
mod appearance;
mod axis_curvature;
mod close_by;
mod convergence;
mod design_effect;
mod estimate;
mod exposure;
mod fit_result;
mod fit_stages;
mod flank_levels;
mod flanks;
mod follow;
mod foreground_test;
mod grid_search;
mod hand;
mod hypotheses;
mod initialise;
mod length;
mod limbs;
mod line;
mod line_filter;
mod motion_prediction;
mod motion_prior;
mod normals;
mod options;
mod outcome;
mod pyramid;
mod registration;
mod report;
mod scene;
mod separation;
mod shaded_flank;
mod shape;
mod silhouette;
mod stage;
mod status;
mod thumb;
mod tracker;
mod validation;
mod variance_factor;
pub mod views;

pub use estimate::{MAX_DOF, ShapeEstimate};
pub use fit_result::Refusal;
pub use line::{FingerLine, LineSource};
pub use normals::SearchedLine;
pub use options::{
    AcceptOptions, AcquireOptions, DynamicsOptions, Model, TrackOptions, TrackerOptions,
};
pub use outcome::{Diagnostics, Track};
pub use status::{StartPose, Status};
pub use tracker::ContourTracker;
