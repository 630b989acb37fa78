//! Arrays of numbers, in and out. Arguments are copied: contours and shape vectors are small.
//! (Images are not copied; see `image`.)

use crate::errors::InvalidInputError;
use fingerpost_core::nalgebra::{Point2, SMatrix, Vector2};
use numpy::{
    Element, PyArray1, PyArray2, PyArrayDescrMethods, PyArrayMethods, PyReadonlyArrayDyn,
    PyUntypedArray, PyUntypedArrayMethods,
};
use pyo3::exceptions::PyException;
use pyo3::intern;
use pyo3::prelude::*;

/// Kinds of dtype that are real numbers: integers, unsigned integers, floats.
const REAL_KINDS: &[u8] = b"iuf";

/// Tolerance of the length of a unit vector, and so the relative error of offsets along it.
pub const UNIT_TOLERANCE: f64 = 1e-6;

/// The numbers of an array-like of shape (N,).
pub fn vector(value: &Bound<'_, PyAny>, what: &str) -> PyResult<Vec<f64>> {
    let (numbers, shape) = reals(value, what)?;
    match shape[..] {
        [_] => Ok(numbers),
        _ => Err(wrong_shape(what, &shape, "(N,)")),
    }
}

/// The numbers of an array-like of shape (N, K), row by row, and K.
pub fn rows(value: &Bound<'_, PyAny>, what: &str) -> PyResult<(Vec<f64>, usize)> {
    let (numbers, shape) = reals(value, what)?;
    match shape[..] {
        [_, columns] => Ok((numbers, columns)),
        _ => Err(wrong_shape(what, &shape, "(N, D)")),
    }
}

/// The rows of an array-like of shape (N, 2), as points.
pub fn points(value: &Bound<'_, PyAny>, what: &str) -> PyResult<Vec<Point2<f64>>> {
    let (numbers, shape) = reals(value, what)?;
    match shape[..] {
        [_, 2] => Ok(numbers.chunks_exact(2).map(|row| Point2::new(row[0], row[1])).collect()),
        _ => Err(wrong_shape(what, &shape, "(N, 2)")),
    }
}

/// The rows of an array-like of shape (N, 2), as unit vectors.
pub fn unit_vectors(value: &Bound<'_, PyAny>, what: &str) -> PyResult<Vec<Vector2<f64>>> {
    let vectors: Vec<_> = points(value, what)?.into_iter().map(|point| point.coords).collect();
    let is_unit = |v: &Vector2<f64>| (v.norm() - 1.0).abs() <= UNIT_TOLERANCE;
    match vectors.iter().position(|v| !is_unit(v)) {
        None => Ok(vectors),
        Some(i) => Err(InvalidInputError::new_err(format!(
            "{what} {i} is ({}, {}); its length must be 1",
            vectors[i].x, vectors[i].y
        ))),
    }
}

/// Refuses a sequence whose length is not that of the sequence it belongs to.
pub fn same_length(what: &str, given: usize, whose: &str, needed: usize) -> PyResult<()> {
    if given == needed {
        return Ok(());
    }
    Err(InvalidInputError::new_err(format!(
        "{what} has {given} entries; one for each of the {needed} {whose} is needed"
    )))
}

/// An array-like of shape (2,), as a point.
pub fn point(value: &Bound<'_, PyAny>, what: &str) -> PyResult<Point2<f64>> {
    matrix::<2, 1>(value, what, "(2,)").map(Point2::from)
}

/// An array-like of shape (R, C), or (R,) if C is 1. `shape` names the shape in errors.
pub fn matrix<const R: usize, const C: usize>(
    value: &Bound<'_, PyAny>,
    what: &str,
    shape: &str,
) -> PyResult<SMatrix<f64, R, C>> {
    let (numbers, given) = reals(value, what)?;
    if given[..] == [R, C] || (C == 1 && given[..] == [R]) {
        Ok(SMatrix::from_row_slice(&numbers))
    } else {
        Err(wrong_shape(what, &given, shape))
    }
}

/// The real numbers of anything that NumPy reads as an array, row by row, and their shape.
fn reals(value: &Bound<'_, PyAny>, what: &str) -> PyResult<(Vec<f64>, Vec<usize>)> {
    if let Ok(array) = value.extract::<PyReadonlyArrayDyn<'_, f64>>()
        && array.is_aligned()
        && array.is_c_contiguous()
    {
        return contents(&array);
    }
    let py = value.py();
    let numpy = py.import("numpy")?;
    // Interned: Python's method cache would keep the name of every call.
    let array = numpy.call_method1(intern!(py, "asarray"), (value,)).map_err(|error| {
        // An interruption, such as Ctrl-C, is no error of the value.
        if !error.is_instance_of::<PyException>(py) {
            return error;
        }
        let given = value.get_type();
        InvalidInputError::new_err(format!(
            "{what} is of {given}, which NumPy cannot read as an array ({error}); it must be an \
             array of real numbers"
        ))
    })?;
    let dtype = array.cast::<PyUntypedArray>()?.dtype();
    if !REAL_KINDS.contains(&dtype.kind()) {
        return Err(InvalidInputError::new_err(format!(
            "{what} has the dtype {dtype}; it must be an array of real numbers"
        )));
    }
    // Whatever its strides and byte order are: "C" contiguous and "A"ligned.
    let array = numpy.call_method1(intern!(py, "require"), (array, "float64", ["C", "A"]))?;
    contents(&array.extract()?)
}

fn contents(array: &PyReadonlyArrayDyn<'_, f64>) -> PyResult<(Vec<f64>, Vec<usize>)> {
    Ok((array.as_slice()?.to_vec(), array.shape().to_vec()))
}

fn wrong_shape(what: &str, given: &[usize], needed: &str) -> PyErr {
    let given = as_tuple(given);
    InvalidInputError::new_err(format!("{what} has the shape {given}; it must be {needed}"))
}

/// Numbers in Python's notation of a tuple.
pub fn as_tuple<T: ToString>(numbers: &[T]) -> String {
    let numbers: Vec<_> = numbers.iter().map(ToString::to_string).collect();
    let comma = if numbers.len() == 1 { "," } else { "" };
    format!("({}{comma})", numbers.join(", "))
}

/// A read-only array (N,) of the given numbers or words.
pub fn column<T: Element>(py: Python<'_>, values: impl IntoIterator<Item = T>) -> Py<PyArray1<T>> {
    let array = PyArray1::from_iter(py, values);
    array.readwrite().make_nonwriteable();
    array.unbind()
}

/// A read-only array (N, K) of the given rows.
pub fn table<const K: usize>(
    py: Python<'_>,
    rows: impl IntoIterator<Item = [f64; K]>,
) -> PyResult<Py<PyArray2<f64>>> {
    flat_table(py, rows.into_iter().flatten().collect(), K)
}

/// A read-only array (N, `columns`) of the given numbers, row by row.
pub fn flat_table<T: Element>(
    py: Python<'_>,
    numbers: Vec<T>,
    columns: usize,
) -> PyResult<Py<PyArray2<T>>> {
    let rows = numbers.len() / columns.max(1);
    let array = PyArray1::from_vec(py, numbers).reshape([rows, columns])?;
    array.readwrite().make_nonwriteable();
    Ok(array.unbind())
}
