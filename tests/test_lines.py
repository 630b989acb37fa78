import numpy as np
import pytest
from geometry_rig import CORNERS, camera, central_differences
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from fingerpost.errors import InvalidInputError
from fingerpost.homography import transfer_to_image
from fingerpost.lines import (
    clip_to_rectangle,
    constraint_line,
    crossing_angle_rad,
    distance,
    intersection,
    line_at_angle,
    line_at_angle_jacobian,
    line_through,
    normalised,
)

reproducible = settings(max_examples=200, derandomize=True)

# Pixel coordinates, including some far outside any image.
coordinate = st.floats(-1e4, 1e4)
points = st.tuples(coordinate, coordinate)
angles = st.floats(-10.0, 10.0) | st.sampled_from([0.0, np.pi / 2, np.pi, -np.pi / 2, 1e-12])


@reproducible
@given(points, angles, st.floats(-1e3, 1e3), st.floats(-1e3, 1e3))
def test_a_line_at_an_angle_measures_distance_along_its_normal(point, angle, along, offset):
    tangent = np.array([np.cos(angle), np.sin(angle)])
    normal = np.array([-np.sin(angle), np.cos(angle)])
    line = line_at_angle(point, angle)
    assert np.hypot(*line[:2]) == pytest.approx(1.0)
    assert distance(line, point + along * tangent + offset * normal) == pytest.approx(
        offset, abs=1e-10
    )


def test_the_normal_points_to_the_right_of_the_lines_direction():
    along_u = line_at_angle([0, 100], 0.0)
    assert distance(along_u, [50, 110]) == pytest.approx(10)  # v points down


@reproducible
@given(points, angles)
def test_the_jacobian_agrees_with_central_differences(point, angle):
    normal = np.array([-np.sin(angle), np.cos(angle)])
    numeric = central_differences(
        lambda p: line_at_angle(point + p[0] * normal, angle + p[1]), np.zeros(2), [1.0, 1.0]
    )
    analytic = line_at_angle_jacobian(point, angle)
    # c has the magnitude of the coordinates; over steps of 1e-5 it loses 1e4 · 1e-16 / 1e-5.
    assert np.allclose(analytic, numeric, rtol=1e-7, atol=1e-5)


def test_arrays_of_lines_equal_lines_one_by_one():
    rng = np.random.default_rng(21)
    p, angle = rng.normal(0, 100, (3, 4, 2)), rng.normal(0, 2, (3, 4))
    one = line_at_angle(p[1, 2], angle[1, 2])
    assert np.array_equal(line_at_angle(p, angle)[1, 2], one)
    assert np.array_equal(
        line_at_angle_jacobian(p, angle)[1, 2], line_at_angle_jacobian(p[1, 2], angle[1, 2])
    )


@reproducible
@given(points, points)
def test_a_line_through_two_points_runs_from_the_first_to_the_second(first, second):
    assume(np.hypot(*np.subtract(second, first)) > 1e-3)
    line = line_through(first, second)
    assert np.allclose(distance(line, [first, second]), 0, atol=1e-9)
    assert np.subtract(second, first) @ [line[1], -line[0]] > 0


def test_a_line_through_two_equal_points_is_refused():
    with pytest.raises(InvalidInputError, match="two equal points"):
        line_through([1, 2], [1, 2])


def test_normalised_keeps_the_sign_and_is_nan_at_infinity():
    assert np.allclose(normalised([-3, 4, 10]), [-0.6, 0.8, 2])
    assert np.isnan(normalised([0, 0, 5])).all()
    assert np.isnan(normalised([1e-320, 0, 5])).all()


def test_the_constraint_line_projects_to_the_finger_line():
    T = camera(20.0).image_from_plane
    on_plane = line_through([30, 350], [380, 90])
    seen = line_through(*transfer_to_image(T, [[30, 350], [380, 90]]))
    found = constraint_line(T, 7.0 * seen)
    assert np.allclose(found * np.sign(found @ on_plane), on_plane, atol=1e-10)


def test_constraint_lines_of_many_views_in_one_call():
    T = np.stack([camera(a).image_from_plane for a in (-15, 0, 15)])
    seen = line_at_angle(np.full((3, 2), 300.0), [0.1, 0.7, 2.0])
    each = [constraint_line(t, line) for t, line in zip(T, seen, strict=True)]
    assert np.allclose(constraint_line(T, seen), each, rtol=1e-14, atol=0)


def test_the_horizon_has_no_constraint_line():
    # The horizon is the image of the plane's line at infinity.
    T = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0.25, 1]])
    assert np.isnan(constraint_line(T, [0.0, -0.25, 1.0])).all()


@reproducible
@given(points, angles, angles)
def test_lines_through_a_point_intersect_there(point, first, second):
    sine = abs(np.sin(first - second))
    assume(sine > 1e-6)
    meeting = intersection(line_at_angle(point, first), line_at_angle(point, second))
    assert np.allclose(meeting, point, atol=1e-11 * (1 + np.abs(point).max()) / sine)


def test_parallel_lines_have_no_intersection():
    assert np.isnan(intersection([0, 1, 5], [0, -2, 3])).all()
    assert np.isnan(intersection([0.6, 0.8, 1], [0.6, 0.8, 1])).all()


@reproducible
@given(angles, st.sampled_from([0.0, 1e-14, 1e-9, 1e-4, 0.3, 1.0, np.pi / 2]))
def test_small_crossing_angles_are_exact(angle, crossing):
    first = line_at_angle([3.0, 4.0], angle)
    second = line_at_angle([-5.0, 1.0], angle + crossing)
    assert crossing_angle_rad(first, second) == pytest.approx(crossing, rel=1e-9, abs=3e-15)
    assert crossing_angle_rad(first, -second) == crossing_angle_rad(first, second)


LOWER, UPPER = np.array([-0.5, -0.5]), np.array([639.5, 479.5])


@reproducible
@given(st.tuples(st.floats(-200, 900), st.floats(-200, 700)), angles)
@example((0.0, -0.5), 0.0)
@example((639.5, 0.0), np.pi / 2)
def test_clipping_keeps_the_part_inside(point, angle):
    line = line_at_angle(point, angle)
    tangent = np.array([np.cos(angle), np.sin(angle)])
    along = np.linspace(-2000, 2000, 40001)[:, None]
    samples = point + along * tangent
    # Along an edge, rounding decides whether a line is inside.
    margins = [np.minimum(samples - LOWER, UPPER - samples).min(axis=1) > m for m in (1e-9, -1e-9)]
    surely, perhaps = (np.count_nonzero(inside) for inside in margins)
    clipped = clip_to_rectangle(line, LOWER, UPPER)
    if clipped is None:
        assert surely <= 1  # the line touches a corner at most
        return
    first, last = clipped
    assert (last - first) @ tangent > 0
    assert np.allclose(distance(line, clipped), 0, atol=1e-9)
    assert np.all((clipped >= LOWER) & (clipped <= UPPER))
    assert 0.1 * surely - 0.2 <= np.hypot(*(last - first)) <= 0.1 * perhaps + 0.2


@pytest.mark.parametrize(
    ("line", "ends"),
    [
        ([1, 0, -100], [[100, 479.5], [100, -0.5]]),
        ([0, 1, -100], [[-0.5, 100], [639.5, 100]]),
        ([1, 0, 100], None),
        ([0, 1, 0.5], [[-0.5, -0.5], [639.5, -0.5]]),  # along an edge
        ([1, 0, -639.5], [[639.5, 479.5], [639.5, -0.5]]),
        ([1, 0, -639.6], None),
        ([1e-310, 1, -100], [[-0.5, 100], [639.5, 100]]),
    ],
)
def test_clipping_of_axis_parallel_lines(line, ends):
    clipped = clip_to_rectangle(line, LOWER, UPPER)
    assert clipped is None if ends is None else np.allclose(clipped, ends)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (([0, 0, 1], LOWER, UPPER), "line at infinity"),
        (([1, 0, 0], UPPER, LOWER), "is empty"),
        (([1, 0, 0], LOWER, LOWER), "is empty"),
        (([1, 0], LOWER, UPPER), r"line: shape \(2,\)"),
        (([1, np.nan, 0], LOWER, UPPER), r"line\[1\] is nan"),
    ],
)
def test_clipping_refuses_empty_rectangles_and_invalid_lines(arguments, words):
    with pytest.raises(InvalidInputError, match=words):
        clip_to_rectangle(*arguments)


@pytest.mark.parametrize(
    "call",
    [
        lambda bad: line_at_angle(bad, 0.0),
        lambda bad: line_at_angle_jacobian(bad, 0.0),
        lambda bad: line_at_angle([0, 0], bad[0]),
        lambda bad: line_through([0, 0], bad),
        lambda bad: distance([1, 0, 0], bad),
    ],
)
def test_nan_is_refused_everywhere(call):
    with pytest.raises(InvalidInputError, match="is nan"):
        call(np.array([np.nan, 1.0]))


def test_edges_of_the_workspace_intersect_in_its_corners():
    edges = line_through(CORNERS, np.roll(CORNERS, -1, axis=0))
    assert np.allclose(intersection(edges, np.roll(edges, 1, axis=0)), CORNERS, atol=1e-10)
