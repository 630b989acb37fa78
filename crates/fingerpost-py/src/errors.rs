//! One tree of exceptions: invalid input raises `fingerpost.errors.InvalidInputError`.

use fingerpost_core::Error;
use pyo3::prelude::*;

pyo3::import_exception!(fingerpost.errors, FingerpostError);
pyo3::import_exception!(fingerpost.errors, InvalidInputError);

/// The Python exception for an error of the core. (The orphan rule forbids `From` here.)
#[expect(clippy::needless_pass_by_value, reason = "the signature that `map_err` wants")]
pub fn invalid_input(error: Error) -> PyErr {
    InvalidInputError::new_err(error.to_string())
}

/// The error that `what` has the wrong value.
pub fn wrong(what: &str, value: &Bound<'_, PyAny>, right: &str) -> PyErr {
    let given = value.repr().map_or_else(|_| format!("a {}", value.get_type()), |r| r.to_string());
    InvalidInputError::new_err(format!("{what} is {given}; it must be {right}"))
}

/// The error that a mutable object is in use in another thread.
pub fn in_use(what: &str) -> PyErr {
    FingerpostError::new_err(format!(
        "this {what} is in use in another thread; each thread needs one of its own, or a lock"
    ))
}
