//! Tracking of one hand in one view, in three states: *acquiring*, *tracking*, *lost*.
//!
//! **Acquiring.** The initial template stays at its start pose. A first fit starts from there, the
//! following ones from the last fit. A fit counts only if it is *accepted* (below) and its
//! half-width is within a factor [`AcquireOptions::max_scale`] of the initial template's; otherwise
//! the next one starts from the start pose again. The fit has *settled* when, over
//! [`AcquireOptions::settle_frames`] accepted frames in a row, the finger's half-width changed by
//! at most the fraction [`AcquireOptions::settle_change`] per frame. The hand may move meanwhile,
//! within the reach of the initial template. The settled hand is then refitted with an appearance
//! model learned from it: a mixture of colours, or the grey levels of each flank where there are no
//! colours. [`Model::Ribbon`] is shortened where it extends beyond the finger; [`Model::Paper`] is
//! deformed affinely once more and its size is frozen.
//!
//! **Tracking, band model.** All components of the shape vector stay free. A prior holds those that
//! a hand cannot change (widths, taper) near their acquired values, which follow the measurements
//! slowly. The finger is fitted first. The thumb is fitted afterwards, so that it does not turn the
//! finger, and is left out after [`TrackOptions::lose_after_frames`] frames without it. Each flank
//! is used from the tip back to where it stops agreeing with the fit: behind that, a thumb may lie
//! along the finger. The finger line comes from the pixels near the flanks if their fit can be
//! relied on ([`crate::axis`]), else from the contour. It is combined with the lines of earlier
//! frames, carried along by registration of the finger's texture, where these are more certain. The
//! line is reported for one fixed stretch of the finger, whichever part of the flanks a frame
//! shows. Its covariance includes the curvature of the finger's axis and the scatter of the lines
//! of successive frames.
//!
//! **Tracking, paper's model.** The size is the settled one; rigid motion and one shear remain, or
//! rigid motion alone for a template without a thumb, since only the thumb determines the shear.
//!
//! **Prediction.** For both models a Kalman filter with constant velocity ([`DynamicsOptions`])
//! predicts place and angle (c_u, c_v, θ), and from their covariance the length of each search
//! line. If the fit found there explains too little of the contour, or its innovation is too large,
//! other hypotheses are searched over a larger region.
//!
//! **Lost.** After [`TrackOptions::lose_after_frames`] frames in a row without an accepted fit the
//! hand is lost. It is searched for at its last pose, where tracking resumes with the first fit
//! that acquisition would accept, and at the start pose, until a fit settles there.
//!
//! **Acceptance.** A fit is accepted when it is determined, when the edges of a sufficient fraction
//! of the visible contour agree with it, and when the residual offsets of those are small; see
//! [`AcceptOptions`]. A frame without an accepted fit yields no finger line.
//!
//! **Bent finger.** A bent finger has no straight axis. After a fit is accepted by its edges, the
//! two halves of the finger are measured separately ([`crate::axis::Bend`]). The fit is refused as
//! [`Refusal::Misfit`] if their directions differ by more than 20° in the image, either by two
//! standard deviations more than that or in the second such frame in a row. A first frame that is
//! less certain keeps its line, because blur and background also bend flanks. The hand is still
//! tracked, without a line, until its halves differ by less than 15° and its tip is seen. If a
//! frame does not determine the bend, the line returns when the fit explains at least 85 % of the
//! contour, or 70 % after a single bent frame. One view observes only the component of a bend
//! across its line of sight. The paper's model is not tested for bend.
//!
//! **Large hands.** A hand of the band model whose start pose implies a finger at least 24 px
//! across is tracked in an image reduced by an integer factor, in which the finger is 12 to 18 px
//! wide; all results are reported in pixels of the frame. The line is refined in the full frame
//! where that is sharp and its pixels agree with the model of a finger.
//!
//! **Structure.** `acquire` or `follow` processes a frame. The latter calls `hypotheses`, which
//! tries the places where the hand may be. `fit_stages` fits each of them; `report` derives the
//! finger line of an accepted fit and updates the appearance model.
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
mod initial_prior;
mod initialise;
mod length;
mod limbs;
mod line;
mod line_comparison;
mod line_filter;
mod motion_prediction;
mod motion_prior;
mod normals;
mod options;
mod outcome;
mod pyramid;
mod registration;
mod report;
mod running_mean;
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
