//! Numbers from Python, checked where they enter and named in the errors.

use crate::errors::{InvalidInputError, wrong};
use pyo3::prelude::*;
use pyo3::types::PyBool;

/// Maximum number of items that one call makes: far above any use for a contour, but an array of
/// them still fits into memory.
pub const MAX_COUNT: usize = 1 << 20;

/// A real number, finite or not; the core checks whether it must be finite.
pub fn real(value: &Bound<'_, PyAny>, what: &str) -> PyResult<f64> {
    match value.extract() {
        Ok(number) if !value.is_instance_of::<PyBool>() => Ok(number),
        _ => Err(wrong(what, value, "a real number")),
    }
}

/// A non-negative integer.
pub fn whole(value: &Bound<'_, PyAny>, what: &str) -> PyResult<usize> {
    match value.extract() {
        Ok(number) if !value.is_instance_of::<PyBool>() => Ok(number),
        _ => {
            let right = format!("a whole number, not negative, of at most {} bits", usize::BITS);
            Err(wrong(what, value, &right))
        }
    }
}

/// A number of items to make; too large a number is refused before anything is allocated.
pub fn count(value: &Bound<'_, PyAny>, what: &str) -> PyResult<usize> {
    let count = whole(value, what)?;
    if count <= MAX_COUNT {
        Ok(count)
    } else {
        Err(InvalidInputError::new_err(format!("{what} is {count}; at most {MAX_COUNT} are made")))
    }
}
