//! The extension module `fingerpost._core`: converts arguments, releases the GIL, calls
//! `fingerpost-core`, maps errors. `python/fingerpost/_core.pyi` is its reference.

mod arrays;
mod background;
mod bspline;
mod candidates;
mod contour;
mod errors;
mod fit;
mod image;
mod numbers;
mod options;
mod outline;
mod plane;
mod round;
mod search;
mod shape_space;
mod template;
mod tracker;
mod views;
mod words;

use pyo3::prelude::*;

/// The stages of the contour tracker.
// A free-threaded interpreter enables the GIL when it imports this module, for three reasons.
// Arrays are copied on the way in, and only the GIL prevents writes to them meanwhile. The wheel is
// abi3, which free-threaded interpreters do not load (abi3t comes with 3.15). No test runs on one.
// Rust's data do not depend on the GIL: every class is frozen or behind a borrow flag. The loss is
// small, because every call that takes longer than a conversion detaches.
#[pymodule(gil_used = true)]
mod _core {
    #[pymodule_export]
    use super::background::PyBackground;
    #[pymodule_export]
    use super::bspline::{PyArcLength, PyBSpline, PyBasisRows, PyCurvePoints, PySplineFit};
    #[pymodule_export]
    use super::candidates::{PyCandidate, PyHandFinder};
    #[pymodule_export]
    use super::contour::{PyContourSamples, sample_contour};
    #[pymodule_export]
    use super::fit::{PyFitReport, PyFitter};
    #[pymodule_export]
    use super::outline::{PyEdgePoints, PyLineFit, edges_along, fit_line};
    #[pymodule_export]
    use super::plane::{PyPlaneLevel, PyPlaneRegistration, PyRegisteredPlane};
    #[pymodule_export]
    use super::round::PyRoundFinger;
    #[pymodule_export]
    use super::search::{PyEdgeSearch, PySearchLines};
    #[pymodule_export]
    use super::shape_space::{PyAxis, PyPlacedContour, PyShapeSpace};
    #[pymodule_export]
    use super::template::PyTemplate;
    #[pymodule_export]
    use super::tracker::{PyContourTracker, PyDiagnostics, PyFingerLine, PyStartPose, PyTrack};
    #[pymodule_export]
    use super::views::update_views;
}
