import numpy as np
import pytest

from fingerpost.checks import covariance_array, finite_array, in_range
from fingerpost.errors import InvalidInputError


@pytest.mark.parametrize(
    ("value", "shape"),
    [
        ([[1, 2], [3, 4]], (2, 2)),
        ([[1, 2], [3, 4]], ("N", 2)),
        ([[[1.5, 2]]], (..., 2)),
        ([1, 2], (..., 2)),
        (7, ()),
        (7, (...,)),
        ([[7]], (...,)),
        (np.zeros((0, 2)), ("N", 2)),
        (np.array([1, 2], dtype=np.uint8), (2,)),
        (np.array([1e200, 1e200]), (2,)),
    ],
)
def test_numbers_of_the_wanted_shape_pass_as_floats(value, shape):
    array = finite_array(value, "x", shape)
    assert array.dtype == np.float64
    assert np.array_equal(array, np.asarray(value))


def test_a_checked_array_is_not_copied():
    array = np.ones((3, 2))
    assert finite_array(array, "x", ("N", 2)) is array


@pytest.mark.parametrize(
    ("value", "shape", "words"),
    [
        ([1, 2, 3], (2,), r"x: shape \(3,\) found; \(2\) is needed"),
        ([[1, 2, 3]], (..., 2), r"\(\.\.\., 2\) is needed"),
        ([1, 2], ("N", 2), r"\(N, 2\) is needed"),
        (3.0, (..., 2), r"shape \(\) found"),
        ([], (2,), r"shape \(0,\) found"),
        ([1], (), r"shape \(1,\) found; \(\) is needed"),
        ([[1, 2], [3]], (2, 2), "x: "),
        ([[0, 1], [np.nan, 2]], (2, 2), r"x\[1, 0\] is nan; a finite number is needed"),
        (np.array([np.inf]), (1,), r"x\[0\] is inf"),
        (np.nan, (), "x is nan"),
        ("ab", (), "real numbers are needed"),
        ([1j], (1,), "real numbers are needed"),
        ([True], (1,), "real numbers are needed"),
        (None, (), "real numbers are needed"),
    ],
)
def test_anything_else_is_refused_by_name_and_place(value, shape, words):
    with pytest.raises(InvalidInputError, match=words):
        finite_array(value, "x", shape)


@pytest.mark.parametrize(
    "matrix", [np.zeros((2, 2)), [[1, 0], [0, 0]], [[2, 1], [1, 1]], [[1e-30, 0], [0, 1e30]]]
)
def test_covariances_pass_even_singular_ones(matrix):
    assert np.array_equal(covariance_array(matrix, "C", (2, 2)), matrix)


def test_rounding_in_a_covariance_is_forgiven_and_removed():
    matrix = np.array([[1.0, 0.5], [0.5 + 1e-13, 0.25 - 1e-13]])
    checked = covariance_array(matrix, "C", (2, 2))
    assert np.array_equal(checked, checked.T)


@pytest.mark.parametrize(
    ("matrix", "words"),
    [
        ([[1, 0.5], [0.4, 1]], "C is not symmetric"),
        ([[1, 2], [2, 1]], "negative eigenvalue -1"),
        ([[-1, 0], [0, 1]], "negative eigenvalue"),
        ([np.eye(2), -np.eye(2)], "negative eigenvalue"),
        ([[1, 0], [0, np.nan]], r"C\[1, 1\] is nan"),
    ],
)
def test_what_is_no_covariance_is_refused(matrix, words):
    with pytest.raises(InvalidInputError, match=words):
        covariance_array(matrix, "C", (..., 2, 2))


@pytest.mark.parametrize("value", [0, 0.5, 1.0, np.float32(0.25), np.int64(1)])
def test_a_number_in_range_passes_as_a_float(value):
    checked = in_range(value, "x", 0.0, 1.0)
    assert type(checked) is float
    assert checked == value


@pytest.mark.parametrize("value", [-0.1, 1.1, np.nan, np.inf, "1", None, True, [0.5]])
def test_a_number_out_of_range_is_refused(value):
    with pytest.raises(InvalidInputError, match="x"):
        in_range(value, "x", 0.0, 1.0)
