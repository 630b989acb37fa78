//! Numbers from Python: checked where they enter, named in the errors.

use crate::errors::{InvalidInputError, wrong};
use pyo3::prelude::*;
use pyo3::types::PyBool;

/// The most of anything that one call makes: far more than a contour has any use for, and still an
/// array that fits into memory.
pub const MAX_COUNT: usize = 1 << 20;

/// A real number, finite or not: the core says which it needs.
pub fn real(value: &Bound<'_, PyAny>, what: &str) -> PyResult<f64> {
    match value.extract() {
        Ok(number) if !value.is_instance_of::<PyBool>() => Ok(number),
        _ => Err(wrong(what, value, "a real number")),
    }
}

/// A whole number, not negative.
pub fn whole(value: &Bound<'_, PyAny>, what: &str) -> PyResult<usize> {
    match value.extract() {
        Ok(number) if !value.is_instance_of::<PyBool>() => Ok(number),
        _ => {
            let right = format!("a whole number, not negative, of at most {} bits", usize::BITS);
            Err(wrong(what, value, &right))
        }
    }
}

/// How many of something to make; refused before anything of that size is.
pub fn count(value: &Bound<'_, PyAny>, what: &str) -> PyResult<usize> {
    let count = whole(value, what)?;
    if count <= MAX_COUNT {
        Ok(count)
    } else {
        Err(InvalidInputError::new_err(format!("{what} is {count}; at most {MAX_COUNT} are made")))
    }
}
