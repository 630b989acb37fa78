//! Track a pointing finger in an image with an active contour.
//!
//! A B-spline [`template`](geometry::template) of the index finger and the up-turned thumb is
//! placed in the image. In every frame the tracker [`search`](measure::edge_search)es for edges
//! along the normals of the contour and [`fit`](solve::fit)s the deformations that a
//! [`shape_space`](geometry::shape_space) allows by weighted least squares; the fit is accepted, or
//! the hand is lost. One basis vector of the template lies along the index finger, so the fitted
//! shape vector gives the *finger line*, the image line along which the finger points, with its
//! covariance.
//!
//! The method is that of Cipolla, Hadfield & Hollinghurst, *Uncalibrated stereo vision with
//! pointing for a man–machine interface*, MVA 1994.
//!
//! Pixel (0, 0) is the centre of the top-left pixel; u runs right, v runs down; angles are in
//! radians from +u towards +v. Nothing here reads files, opens cameras, prints or panics.
//!
//! # Example: tracking a finger
//!
//! ```
//! use fingerpost_core::nalgebra::{Point2, Vector2};
//! use fingerpost_core::geometry::template::{Template, Thumb};
//! use fingerpost_core::track::{ContourTracker, StartPose, Status, TrackerOptions};
//! use fingerpost_core::{Frame, GrayView};
//!
//! // A camera's frame: a bright finger of 70 px, its tip at `tip`, before a darker table.
//! let (width, height, angle_rad) = (320, 240, 0.6_f64);
//! let e = Vector2::new(angle_rad.cos(), angle_rad.sin());
//! let picture = |tip: Point2<f64>| -> Vec<u8> {
//!     let pixel = |i: usize| {
//!         let d = Point2::new((i % width) as f64, (i / width) as f64) - tip;
//!         let along = d.dot(&e).clamp(-120.0, -8.0);
//!         let inside = 8.0 - (d - e * along).norm();
//!         (60.0 + 100.0 * (0.5 + 0.5 * inside).clamp(0.0, 1.0)) as u8
//!     };
//!     (0..width * height).map(pixel).collect()
//! };
//!
//! // The start pose of the template is near the finger, a few pixels off.
//! let start = StartPose { tip_px: Point2::new(183.0, 137.0), angle_rad: 0.55, length_px: 70.0 };
//! let template = Template::pistol(Thumb::None)?;
//! let mut tracker = ContourTracker::new(template, &start, TrackerOptions::default())?;
//!
//! // It is fitted to the finger for a few frames, then tracks it.
//! for k in 0..12 {
//!     let tip = Point2::new(180.0, 140.0) + Vector2::new(2.0, -1.0) * f64::from(k);
//!     let pixels = picture(tip);
//!     let frame = Frame::gray(GrayView::new(&pixels, width, height, width)?);
//!     let track = tracker.update(&frame, f64::from(k) / 30.0)?;
//!     if k >= 4 {
//!         assert_eq!(track.status, Status::Tracking);
//!         let line = track.finger_line.expect("the finger is in view");
//!         assert!((line.axis.tip - tip).norm() < 0.5);
//!         assert!((line.axis.angle_rad - angle_rad).abs() < 0.01);
//!         // The standard deviation of the angle.
//!         assert!(line.covariance[(1, 1)].sqrt() < 0.01);
//!     }
//! }
//! # Ok::<(), fingerpost_core::Error>(())
//! ```

pub mod appearance;
pub mod axis;
pub mod detect;
mod error;
pub mod geometry;
pub mod image;
pub mod measure;
pub mod numeric;
pub mod plane;
pub mod solve;
pub mod track;

pub use error::{Error, Result};
pub use image::frame::Frame;
pub use image::gray::GrayView;
pub use nalgebra;
