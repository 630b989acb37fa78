//! Options: arguments are nested dictionaries with the values that differ from the defaults in
//! Rust; results are dictionaries with all values.

use crate::errors::{InvalidInputError, wrong};
use crate::numbers::{real, whole};
use pyo3::prelude::*;
use pyo3::types::{PyMapping, PyString};

/// A value that a dictionary entry may replace.
pub trait Overlay {
    /// Replaces it by the entry's value; `path` names the entry in errors.
    fn overlay(&mut self, value: &Bound<'_, PyAny>, path: &str) -> PyResult<()>;

    /// The value as an entry that [`overlay`](Self::overlay) accepts.
    fn entry<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>>;
}

/// The defaults, overlaid with `given`.
pub fn options<T: Overlay + Default>(given: Option<&Bound<'_, PyAny>>) -> PyResult<T> {
    let mut options = T::default();
    if let Some(given) = given {
        options.overlay(given, "options")?;
    }
    Ok(options)
}

impl Overlay for f64 {
    fn overlay(&mut self, value: &Bound<'_, PyAny>, path: &str) -> PyResult<()> {
        *self = real(value, path)?;
        Ok(())
    }

    fn entry<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        Ok(self.into_pyobject(py)?.into_any())
    }
}

impl Overlay for bool {
    fn overlay(&mut self, value: &Bound<'_, PyAny>, path: &str) -> PyResult<()> {
        *self = value.extract().map_err(|_| wrong(path, value, "True or False"))?;
        Ok(())
    }

    fn entry<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        Ok(self.into_pyobject(py)?.to_owned().into_any())
    }
}

impl Overlay for usize {
    fn overlay(&mut self, value: &Bound<'_, PyAny>, path: &str) -> PyResult<()> {
        *self = whole(value, path)?;
        Ok(())
    }

    fn entry<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        Ok(self.into_pyobject(py)?.into_any())
    }
}

/// The entries of the dictionary at `path`, or the error that it is not a dictionary.
pub fn entries<'py>(
    value: &Bound<'py, PyAny>,
    path: &str,
) -> PyResult<Vec<(String, Bound<'py, PyAny>)>> {
    let mapping = value.cast::<PyMapping>().map_err(|_| wrong(path, value, "a dictionary"))?;
    mapping
        .items()?
        .iter()
        .map(|item| {
            let (key, value): (Bound<'py, PyAny>, Bound<'py, PyAny>) = item.extract()?;
            match key.cast::<PyString>() {
                Ok(key) => Ok((key.to_string(), value)),
                Err(_) => Err(wrong(&format!("a key of {path}"), &key, "a string")),
            }
        })
        .collect()
}

/// The error that there is no option of this name.
pub fn unknown(path: &str, key: &str, known: &[&str]) -> PyErr {
    InvalidInputError::new_err(format!("{path} has no option {key:?}; it has {}", known.join(", ")))
}

/// Implements [`Overlay`] for an options struct: every field can be replaced, and no other key is
/// accepted. An invocation that omits a field does not compile.
macro_rules! overlay_fields {
    ($options:ty { $($field:ident),+ $(,)? }) => {
        impl $crate::options::Overlay for $options {
            fn overlay(
                &mut self,
                value: &pyo3::Bound<'_, pyo3::PyAny>,
                path: &str,
            ) -> pyo3::PyResult<()> {
                for (key, value) in $crate::options::entries(value, path)? {
                    match key.as_str() {
                        $(stringify!($field) => $crate::options::Overlay::overlay(
                            &mut self.$field, &value, &format!("{path}.{key}"),
                        )?,)+
                        _ => return Err($crate::options::unknown(
                            path, &key, &[$(stringify!($field)),+],
                        )),
                    }
                }
                Ok(())
            }

            fn entry<'py>(
                &self,
                py: pyo3::Python<'py>,
            ) -> pyo3::PyResult<pyo3::Bound<'py, pyo3::PyAny>> {
                let Self { $($field),+ } = self;
                let dict = pyo3::types::PyDict::new(py);
                $(pyo3::types::PyDictMethods::set_item(
                    &dict, stringify!($field), $crate::options::Overlay::entry($field, py)?,
                )?;)+
                Ok(dict.into_any())
            }
        }
    };
}
pub(crate) use overlay_fields;

/// Implements [`Overlay`] for enums whose values are words in Python.
macro_rules! overlay_words {
    ($($choice:ty),+ $(,)?) => {
        $(impl $crate::options::Overlay for $choice {
            fn overlay(
                &mut self,
                value: &pyo3::Bound<'_, pyo3::PyAny>,
                path: &str,
            ) -> pyo3::PyResult<()> {
                *self = $crate::words::Word::parse(value, path)?;
                Ok(())
            }

            fn entry<'py>(
                &self,
                py: pyo3::Python<'py>,
            ) -> pyo3::PyResult<pyo3::Bound<'py, pyo3::PyAny>> {
                let word = $crate::words::Word::word(*self);
                Ok(pyo3::types::PyString::new(py, word).into_any())
            }
        })+
    };
}
pub(crate) use overlay_words;
