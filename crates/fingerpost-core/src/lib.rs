#![doc = include_str!("../README.md")]
//!
//! # Names
//!
//! All names for embedding the crate are at its root. The modules that implement them are not part
//! of the interface and change without notice.
//!
//! | for | names |
//! |---|---|
//! | images | [`GrayView`], [`ColourView`], and both as a [`Frame`] |
//! | one hand in one view | [`ContourTracker`] of a [`Template`] at a [`StartPose`]; a [`Track`] for every frame, with its [`Status`] and [`FingerLine`] |
//! | several views at once | [`update_views`], one [`ViewUpdate`] each |
//! | a hand that may be anywhere | [`HandFinder`], whose [`Candidate`]s are start poses of [`ContourTracker::at_hand`] |
//! | a static camera | [`Background`], for [`ContourTracker::update_before`] |
//! | the parts | [`BSpline`], [`sample_contour`], [`EdgeSearch`], [`ShapeSpace`], [`Fitter`] |
//!
//! Every options struct has a `Default`; unit and range stand beside each field.

#[doc(hidden)]
pub mod appearance;
#[doc(hidden)]
pub mod axis;
#[doc(hidden)]
pub mod detect;
mod error;
#[doc(hidden)]
pub mod geometry;
#[doc(hidden)]
pub mod image;
#[doc(hidden)]
pub mod measure;
#[doc(hidden)]
pub mod numeric;
#[doc(hidden)]
pub mod plane;
#[doc(hidden)]
pub mod solve;
#[doc(hidden)]
pub mod track;

pub use error::{Error, Result};
pub use nalgebra;

// Images.
#[doc(inline)]
pub use image::frame::{ColourView, Frame};
#[doc(inline)]
pub use image::gray::GrayView;

// One hand in one view, or in several.
#[doc(inline)]
pub use axis::{BisectorOptions, PhotometricOptions, RefineOptions, Stretch};
#[doc(inline)]
pub use geometry::shape_space::{Axis, PlacedSample};
#[doc(inline)]
pub use geometry::template::{
    Limb, OutlineAxis, Proportions, Template, TemplateSample, Thumb, ThumbProportions,
};
#[doc(inline)]
pub use track::views::{Schedule, ViewUpdate, update_views};
#[doc(inline)]
pub use track::{
    AcceptOptions, AcquireOptions, ContourTracker, Diagnostics, DynamicsOptions, FingerLine,
    LineSource, MAX_DOF, Model, Refusal, SearchedLine, ShapeEstimate, StartPose, Status, Track,
    TrackOptions, TrackerOptions,
};

// Detection of hands, and the background.
#[doc(inline)]
pub use appearance::background::Background;
#[doc(inline)]
pub use appearance::background::options::{BackgroundOptions, KeepOut, Light};
#[doc(inline)]
pub use appearance::histogram::HistogramModel;
#[doc(inline)]
pub use detect::candidates::{Candidate, FinderOptions, HandFinder};

// The parts: curves, edge measurements, shape spaces, least squares.
#[doc(inline)]
pub use geometry::bspline::{BSpline, BasisRow, CurvePoint, Degree, Parametrization, SplineFit};
#[doc(inline)]
pub use geometry::contour::{ContourSample, HandSide, sample as sample_contour};
#[doc(inline)]
pub use geometry::planar::{Affine, AffineMap, Rigid, RigidShear};
#[doc(inline)]
pub use geometry::shape_space::{Pose, ShapeSpace};
#[doc(inline)]
pub use measure::edge::{Edge, EdgeMeasurement, Miss, Polarity, Scale, SearchLine};
#[doc(inline)]
pub use measure::edge_search::{Cue, EdgeSearch, SearchOptions};
#[doc(inline)]
pub use solve::fit::{
    EquationBuffer, Equations, FitOptions, FitReport, Fitter, Loss, Outcome, Prior, Solve,
};
