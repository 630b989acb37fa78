//! The extension module `fingerpost._core`: converts arguments, releases the GIL, calls
//! `fingerpost-core`, maps errors. Nothing else; `python/fingerpost/_core.pyi` documents it.

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

/// The stages of the tracker, in Rust.
// Free-threaded Python gets its GIL back when it imports this module. Nothing here relies on the
// GIL to protect Rust's data: every class is frozen or behind a borrow flag. But arrays are copied
// on the way in as if nobody wrote to them meanwhile, which only the GIL assures; the wheel is
// abi3, which free-threaded interpreters do not load (abi3t comes with 3.15); and no test runs on
// one. The loss is small: whatever takes longer than a conversion detaches.
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
