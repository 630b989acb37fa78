"""Pictures draw everything where cameras and plane project it, and accept any fix.

The truth is the pinhole camera of `geometry_rig`, which projects points of the plane and the rod.
"""

import dataclasses
import math

import cv2
import numpy as np
import pytest
from geometry_rig import CORNERS, SIDE, camera, finger_line, plane_view, rod, stereo
from hypothesis import given, settings
from hypothesis import strategies as st

from fingerpost.capture import Frame
from fingerpost.errors import InvalidInputError
from fingerpost.lens import Lens
from fingerpost.pointing import Fix, PlaneView, Status, indicated_point
from fingerpost.recording.picture import (
    MAX_WIDTH_PX,
    Composition,
    Plan,
    RobotMarks,
    SearchMarks,
    draw_plan,
    draw_view,
)
from fingerpost.recording.picture.palette import (
    BLOCK,
    INK,
    NORMAL,
    PANEL,
    POINT,
    REJECTED,
    ROBOT,
    STATUSES,
    VIEWS,
)
from fingerpost.uncertainty import UNBOUNDED

SIZE = (640, 480)
TARGET = np.array([180.0, 130.0])
CAMERAS = stereo()
PLANE_VIEWS = [plane_view(view, 0.5**2 * np.eye(2)) for view in CAMERAS]
ROD = rod(TARGET, azimuth_deg=40.0, slant_deg=45.0, tip_height_mm=120.0)
LINES = [finger_line(view, ROD, np.diag([0.1**2, 0.01**2])) for view in CAMERAS]
FIX = indicated_point(LINES, PLANE_VIEWS, time_s=0.0)
NO_FIX = Fix(1.0, Status.ACQUIRING, (None, None), reason="view 0 is acquiring")
UNDETERMINED = Fix(
    1.0,
    Status.ILL_CONDITIONED,
    FIX.constraint_lines,
    None,
    UNBOUNDED,
    0.001,
    "no bound on the point along the constraint lines",
)

# Anti-aliased marks approximate their colour; a line one pixel wide between two rows of pixels is
# spread over both.
SAME_COLOUR = 40
SHARED_OUT = 130


@dataclasses.dataclass
class Seen:
    """An observation, reduced to the fields that pictures use."""

    view: str = "left"
    frame: Frame | None = None
    contour_px: np.ndarray = dataclasses.field(default_factory=lambda: np.empty((0, 2)))
    search: SearchMarks = dataclasses.field(default_factory=SearchMarks.none)
    reasons: tuple[str, ...] = ()
    finger: object = Status.ACQUIRING


def frame(width=SIZE[0], height=SIZE[1], level=128, *, colour=False):
    shape = (height, width, 3) if colour else (height, width)
    return Frame(0, 0.0, np.full(shape, level, np.uint8))


def seen(index=0, **changes):
    given = {"view": ("left", "right")[index], "frame": frame(), "finger": LINES[index]}
    return Seen(**{**given, **changes})


def searched(edges_px, agrees=True, half_length_px=10.0):
    """Vertical search lines centred at edges."""
    edges_px = np.asarray(edges_px, np.float64)
    ends = edges_px[:, None] + np.array([[0.0, -half_length_px], [0.0, half_length_px]])
    return SearchMarks(ends, edges_px, np.broadcast_to(agrees, len(edges_px)))


def view_picture(index=0, fix=FIX, **options):
    observed = options.pop("observed", None) or seen(index)
    return draw_view(observed, PLANE_VIEWS, index, fix, **{"size_px": SIZE, **options})


def plan_picture(fix=FIX, **options):
    return draw_plan(PLANE_VIEWS, fix, **{"unit": "mm", "size_px": SIZE, **options})


def shows(picture, places, colour, tolerance=SAME_COLOUR):
    """Return whether one of the pixels around each place has a colour."""
    height, width = picture.shape[:2]
    answers = []
    for x, y in np.reshape(places, (-1, 2)):
        columns = np.clip([math.floor(x), math.ceil(x)], 0, width - 1)
        rows = np.clip([math.floor(y), math.ceil(y)], 0, height - 1)
        around = picture[rows][:, columns].astype(int)
        answers.append((np.abs(around - colour).max(axis=-1) <= tolerance).any())
    return np.array(answers)


def on_plane(points):
    return np.column_stack([points, np.zeros(len(points))])


def shadow(view, point):
    """The point of the plane that a point hides: where the ray from the camera through it ends."""
    ray = point - view.position
    return (view.position - ray * view.position[2] / ray[2])[:2]


# --- one view ---------------------------------------------------------------------------------


@pytest.mark.parametrize("index", [0, 1])
def test_the_point_is_drawn_where_the_camera_sees_it(index):
    (place,) = CAMERAS[index].project(on_plane(TARGET[None]))
    picture = view_picture(index)
    assert shows(picture, place, POINT)
    assert not shows(view_picture(index, NO_FIX), place, POINT)


@pytest.mark.parametrize("size", [(320, 240), (1280, 960), (500, 700), (900, 300)])
def test_the_point_scales_with_the_frame(size):
    (place,) = CAMERAS[0].project(on_plane(TARGET[None]))
    scale = min(size[0] / SIZE[0], size[1] / SIZE[1])
    bars = (np.array(size) - scale * np.array(SIZE)) / 2
    picture = view_picture(size_px=size)
    assert picture.shape == (size[1], size[0], 3)
    assert shows(picture, (place + 0.5) * scale - 0.5 + bars, POINT)


def test_reference_points_are_marked_and_joined():
    places = CAMERAS[0].project(on_plane(CORNERS))
    sides = CAMERAS[0].project(on_plane((CORNERS + np.roll(CORNERS, -1, axis=0)) / 2))
    picture = view_picture(fix=NO_FIX, observed=seen(frame=frame(level=0)))
    assert shows(picture, places, INK).all()
    assert shows(picture, sides, INK, SHARED_OUT).all()
    inside = CAMERAS[0].project(on_plane(CORNERS / 2 + 90.0))
    assert not shows(picture, inside, INK, SHARED_OUT).any()


def test_a_lens_bends_sides_and_point():
    f, centre, k1 = 500.0, (319.5, 239.5), -0.3
    lens = Lens(fx=f, fy=f, cx=centre[0], cy=centre[1], k1=k1)

    def through_lens(points):
        m = (CAMERAS[0].project(on_plane(points)) - centre) / f
        return m * (1.0 + k1 * (m**2).sum(axis=1, keepdims=True)) * f + centre

    view = PlaneView.from_reference_points(CORNERS, through_lens(CORNERS), 0.25 * np.eye(2), lens)
    fix = dataclasses.replace(FIX, constraint_lines=(None, None))
    observed = seen(finger=Status.LOST, frame=frame(level=0))
    picture = draw_view(observed, [view, PLANE_VIEWS[1]], 0, fix, size_px=SIZE)
    middles = through_lens((CORNERS + np.roll(CORNERS, -1, axis=0)) / 2)
    corners = through_lens(CORNERS)
    assert np.linalg.norm((corners + np.roll(corners, -1, axis=0)) / 2 - middles, axis=1).max() > 5
    assert shows(picture, middles, INK, SHARED_OUT).all()
    assert shows(picture, through_lens(fix.point[None]), POINT)


def test_the_finger_line_runs_from_the_tip_through_the_point():
    finger = LINES[0]
    (place,) = CAMERAS[0].project(on_plane(TARGET[None]))
    along = (place - finger.tip_px) / np.linalg.norm(place - finger.tip_px)
    picture = view_picture()
    before = finger.tip_px + along * np.arange(4.0, 40.0, 4.0)[:, None]
    beyond = place + along * np.arange(20.0, 60.0, 4.0)[:, None]
    behind = finger.tip_px - along * np.arange(6.0, 60.0, 4.0)[:, None]
    assert shows(picture, before, VIEWS[0]).all()
    assert shows(picture, beyond, VIEWS[0]).all()
    assert not shows(picture, behind, VIEWS[0]).any()


def test_the_other_views_constraint_line_crosses_it_in_the_point():
    # On the plane it joins the target and the point that the rod's tip hides from the other camera.
    hidden = shadow(CAMERAS[1], ROD.tip)
    places = CAMERAS[0].project(
        on_plane(TARGET + np.linspace(0.2, 0.6, 9)[:, None] * (hidden - TARGET))
    )
    assert shows(view_picture(), places, VIEWS[1]).all()
    assert not shows(view_picture(index=0, fix=NO_FIX), places, VIEWS[1]).any()


@pytest.mark.parametrize(
    ("finger", "status", "share"),
    [
        (LINES[0], "tracking", (0.99, 1.0)),
        (Status.ACQUIRING, "acquiring", (0.5, 0.9)),
        (Status.LOST, "lost", (0.3, 0.65)),
    ],
)
def test_the_outline_shows_the_status_by_colour_and_stroke(finger, status, share):
    places = np.column_stack([np.linspace(300.0, 620.0, 321), np.full(321, 20.0)])
    observed = seen(contour_px=places, finger=finger, frame=frame(level=60))
    picture = view_picture(fix=NO_FIX, observed=observed)
    found = shows(picture, places, STATUSES[status]).mean()
    assert share[0] <= found <= share[1]


def test_fingers_of_an_outline_are_not_joined():
    one = np.column_stack([np.linspace(400.0, 440.0, 21), np.full(21, 20.0)])
    other = one + np.array([120.0, 0.0])
    picture = view_picture(fix=NO_FIX, observed=seen(contour_px=np.concatenate([one, other])))
    colour = STATUSES["tracking"]
    assert shows(picture, one, colour).all()
    assert shows(picture, other, colour).all()
    assert not shows(picture, np.array([[460.0, 20.0], [480.0, 20.0], [500.0, 20.0]]), colour).any()


def test_the_ellipse_is_projected_back():
    fix = dataclasses.replace(FIX, covariance=np.diag([40.0**2, 15.0**2]))
    turn = np.linspace(0.0, 2 * np.pi, 24, endpoint=False)
    # 95 % of a normal distribution in the plane: χ² with 2 degrees of freedom is 5.991.
    outline = TARGET + math.sqrt(5.991) * np.column_stack(
        [40.0 * np.cos(turn), 15.0 * np.sin(turn)]
    )
    places = CAMERAS[0].project(on_plane(outline))
    alone = seen(finger=Status.LOST)
    picture = view_picture(
        fix=dataclasses.replace(fix, constraint_lines=(None, None)), observed=alone
    )
    assert shows(picture, places, POINT).all()
    ground = np.full(3, 128)
    inside = CAMERAS[0].project(on_plane(TARGET + (outline - TARGET) * 0.6))
    tinted = picture[tuple(np.rint(inside).astype(int).T[::-1])].astype(float)
    assert np.allclose(tinted, 0.4 * np.array(POINT) + 0.6 * ground, atol=2.0)


def test_a_search_is_marked_when_asked_for():
    # Too wide for the magnifier: a chosen edge, a rejected one, a search line without an edge.
    x = np.array([60.0, 330.0, 600.0])
    marks = dataclasses.replace(
        searched(np.column_stack([x, np.full(3, 440.0)]), [True, False, False]),
        edges_px=np.array([[60.0, 444.0], [330.0, 444.0], [np.nan, np.nan]]),
    )
    observed = seen(search=marks)
    picture = view_picture(fix=NO_FIX, observed=observed, edges=True)
    without = view_picture(fix=NO_FIX, observed=observed)
    edges = marks.edges_px[:2]
    assert list(shows(picture, edges, INK)) == [True, False]
    assert list(shows(picture, edges, REJECTED)) == [False, True]
    ends = marks.lines_px[:, 0] + [0.0, 2.0]
    assert shows(picture, ends, NORMAL, SHARED_OUT).all()
    changed = (picture != without).any(axis=-1)
    # They differ in shape as well as colour: a bare line, a dot, a wider cross.
    spans = [int(changed[434:455, int(c) - 12 : int(c) + 13].any(axis=0).sum()) for c in x]
    assert spans[2] < spans[0] < spans[1]
    changed[425:460] = False
    assert not changed.any()


@pytest.mark.parametrize("scale", [1, 3])
def test_a_small_search_is_magnified_away_from_hand_and_point(scale):
    # The same small part of the picture in a VGA frame and in a larger one.
    size = (scale * SIZE[0], scale * SIZE[1])
    edges = scale * np.array([[600.0, 440.0], [610.0, 450.0], [620.0, 440.0]])
    observed = seen(frame=frame(*size), search=searched(edges, [True, False, True], scale * 5.0))
    view = PLANE_VIEWS[0]
    if scale != 1:
        image = scale * CAMERAS[0].project(on_plane(CORNERS))
        view = PlaneView.from_reference_points(CORNERS, image, np.eye(2))
    given = {"size_px": SIZE, "edges": True}
    picture = draw_view(observed, [view], 0, NO_FIX, **given).astype(int)
    red = (np.abs(picture - REJECTED).max(axis=-1) <= 2 * SAME_COLOUR).nonzero()
    assert len(red[0]) > 5
    # The hand is at the lower right, so the magnifier is at the upper left.
    assert red[0].max() < SIZE[1] / 2
    assert red[1].max() < SIZE[0] / 2
    # A point there moves the magnifier elsewhere.
    x, y, w = np.linalg.solve(view.image_from_plane, [60.0 * scale, 60.0 * scale, 1.0])
    at_upper_left = dataclasses.replace(
        FIX, point=np.array([x / w, y / w]), covariance=np.eye(2), constraint_lines=(None,)
    )
    picture = draw_view(observed, [view], 0, at_upper_left, **given).astype(int)
    red = (np.abs(picture - REJECTED).max(axis=-1) <= 2 * SAME_COLOUR).nonzero()
    assert red[0].max() >= SIZE[1] / 2 or red[1].max() >= SIZE[0] / 2


def test_marks_of_edges_leave_the_outline_visible():
    outline = np.column_stack([np.arange(300.0, 620.0), np.full(320, 20.0)])
    observed = seen(search=searched(outline), contour_px=outline)
    picture = view_picture(fix=NO_FIX, observed=observed, edges=True)
    assert shows(picture, outline, INK).mean() > 0.1
    assert shows(picture, outline, STATUSES["tracking"]).mean() > 0.2


def test_grey_and_colour_frames_look_the_same():
    grey = view_picture(observed=seen(frame=frame()))
    assert (view_picture(observed=seen(frame=frame(colour=True))) == grey).all()


def test_a_missing_frame_is_an_empty_panel():
    for missing in (None, Frame(0, 0.0, np.empty((0, 0), np.uint8))):
        picture = view_picture(observed=seen(frame=missing))
        assert (picture == PANEL).all(axis=-1).mean() > 0.98


# --- the plan ---------------------------------------------------------------------------------


def test_the_plan_shows_the_point_the_references_and_the_truth():
    plan = Plan.of(PLANE_VIEWS[0], SIZE)
    truth = TARGET + np.array([90.0, 60.0])
    picture = plan_picture(truth=truth)
    assert shows(picture, plan.place(TARGET), POINT)
    assert shows(picture, plan.place(CORNERS), INK).all()
    arms = np.array([[5.0, 0.0], [-5.0, 0.0], [0.0, 5.0], [0.0, -5.0]])
    assert shows(picture, plan.place(truth) + arms, INK).all()
    assert not shows(plan_picture(), plan.place(truth), INK)


def test_the_plan_is_true_to_scale():
    plan = Plan.of(PLANE_VIEWS[0], SIZE)
    corners = plan.place(CORNERS)
    sides = np.linalg.norm(corners - np.roll(corners, -1, axis=0), axis=1)
    assert np.allclose(sides, sides[0])
    assert sides[0] > 0.6 * SIZE[1]


@pytest.mark.parametrize("index", [0, 1])
def test_constraint_lines_are_the_part_of_the_plane_that_the_finger_hides(index):
    plan = Plan.of(PLANE_VIEWS[0], SIZE)
    away = shadow(CAMERAS[index], ROD.tip) - TARGET
    points = TARGET + np.linspace(-1.0, 1.0, 21)[:, None] * away / np.linalg.norm(away) * 120.0
    points = points[np.linalg.norm(points - TARGET, axis=1) > 25.0]
    assert shows(plan_picture(), plan.place(points), VIEWS[index]).all()


def test_the_band_has_one_standard_deviation():
    # A line along X at Y = 130, with σ = 20 mm everywhere.
    line = FIX.constraint_lines[0]
    line = dataclasses.replace(
        line, line=np.array([0.0, 1.0, -130.0]), covariance=np.diag([0.0, 0.0, 20.0**2])
    )
    picture = plan_picture(Fix(0.0, Status.LOST, (line, None)))
    without = plan_picture(Fix(0.0, Status.LOST, (None, None)))
    plan = Plan.of(PLANE_VIEWS[0], SIZE)
    column, _ = np.rint(plan.place([330.0, 130.0])).astype(int)
    rows = np.flatnonzero((picture != without).any(axis=-1)[:, column])
    expected = np.sort(plan.place([[330.0, 110.0], [330.0, 150.0]])[:, 1])
    assert np.allclose([rows.min(), rows.max()], expected, atol=2.0)


@given(
    azimuth=st.floats(-180.0, 180.0),
    elevation=st.floats(15.0, 85.0),
    mirrored=st.booleans(),
    turn=st.integers(0, 3),
    unit=st.sampled_from([1e-3, 1.0, 1e6]),
)
def test_the_plan_is_never_mirrored(azimuth, elevation, mirrored, turn, unit):
    points = np.roll(CORNERS, turn, axis=0) * unit / SIDE
    view = camera(azimuth, elevation)
    image = view.project(on_plane(CORNERS))
    if mirrored:
        points = points[:, ::-1]
    seen_by = PlaneView.from_reference_points(points, image, np.eye(2))
    on_plan = Plan.of(seen_by, SIZE).place(points)

    def signed_area(corners):
        x, y = corners.T
        return float(x @ np.roll(y, -1) - y @ np.roll(x, -1))

    assert np.sign(signed_area(on_plan)) == np.sign(signed_area(image))


@pytest.mark.parametrize("azimuth", range(0, 360, 30))
def test_the_plan_is_oriented_as_the_view_sees_the_plane(azimuth):
    view = camera(azimuth + 10.0, 60.0)
    plane = PlaneView.from_reference_points(CORNERS, view.project(on_plane(CORNERS)), np.eye(2))
    plan = Plan.of(plane, SIZE)
    middle = CORNERS.mean(axis=0)
    ahead = middle + np.eye(2)
    seen = plane.project(ahead) - plane.project(middle)
    drawn = plan.place(ahead) - plan.place(middle)
    # The plane's axis that is nearer to horizontal in the view is horizontal on the plan; the other
    # points up or down as in the view.
    across = int(abs(seen[1, 0]) > abs(seen[0, 0]))
    assert plan.across == across
    assert abs(drawn[across, 0]) > 1e6 * abs(drawn[across, 1])
    assert abs(drawn[1 - across, 1]) > 1e6 * abs(drawn[1 - across, 0])
    if across:
        assert np.sign(drawn[1, 0]) == np.sign(seen[1, 0])
        assert np.sign(drawn[0, 1]) == np.sign(seen[0, 1])


MARKS = RobotMarks(
    gripper=(120.0, 300.0),
    jaw_width=70.0,
    jaw_angle_rad=0.5,
    jaw_length=20.0,
    trail=((20.0, 300.0), (120.0, 300.0)),
    block=((290.0, 90.0), (330.0, 90.0), (330.0, 130.0), (290.0, 130.0)),
    words="descend",
)


def test_the_plan_marks_the_robot_and_its_block():
    picture = plan_picture(NO_FIX, robot=MARKS)
    plan = Plan.of(PLANE_VIEWS[0], SIZE)
    along = np.array([np.cos(0.5), np.sin(0.5)])
    jaws = np.array(MARKS.gripper) + np.array([[-35.0], [35.0]]) * along
    assert shows(picture, plan.place(jaws), ROBOT).all()
    assert MARKS.jaws().mean(axis=1) == pytest.approx(jaws)
    assert shows(picture, plan.place((310.0, 110.0)), BLOCK, SHARED_OUT).all()
    assert not shows(plan_picture(NO_FIX), plan.place(jaws), ROBOT).any()


@pytest.mark.parametrize("in_views", [False, True])
def test_a_view_marks_a_robot_that_it_does_not_show(in_views):
    marks = dataclasses.replace(MARKS, in_views=in_views)
    picture = draw_view(seen(), PLANE_VIEWS, 0, NO_FIX, size_px=SIZE, robot=marks)
    jaws = PLANE_VIEWS[0].project(marks.jaws().mean(axis=1))
    assert shows(picture, jaws, ROBOT).all() == in_views


@given(
    side=st.floats(1e-6, 1e9),
    aspect=st.floats(0.05, 20.0),
    shift=st.floats(-5.0, 5.0),
    width=st.integers(1, 2000),
    height=st.integers(1, 2000),
)
@settings(max_examples=60)
def test_ticks_are_few_round_and_in_place(side, aspect, shift, width, height):
    points = (CORNERS / SIDE + shift) * [side, side * aspect]
    view = PlaneView.from_reference_points(points, CAMERAS[0].project(on_plane(CORNERS)), np.eye(2))
    plan = Plan.of(view, (width, height))
    assert (plan.lower < plan.upper).all()
    shorter = int((plan.upper - plan.lower).argmin())
    assert 2 <= len(plan.ticks(shorter)) <= 9
    corner = np.array([plan.columns.start, plan.rows.start])
    for axis in (0, 1):
        for value, pixel in plan.ticks(axis):
            slack = 1e-9 * (plan.upper - plan.lower)[axis]
            assert plan.lower[axis] - slack <= value <= plan.upper[axis] + slack
            point = np.where(np.arange(2) == axis, value, plan.lower)
            assert plan.place(point)[axis] - corner[axis] == pytest.approx(pixel, abs=1e-6)
            digits = f"{value:.6e}".split("e")[0].rstrip("0")
            assert len(digits) <= 8


@pytest.mark.parametrize(
    ("away", "corner"),
    [
        ((1e4, 0.0), (1, 0)),
        ((-1e4, 0.0), (-1, 0)),
        ((0.0, 1e4), (0, -1)),
        ((1e300, -1e300), (1, 1)),
    ],
)
def test_an_arrow_points_at_a_point_outside_the_plan(away, corner):
    fix = dataclasses.replace(
        FIX, point=np.array(away) + SIDE / 2, covariance=np.eye(2), constraint_lines=(None, None)
    )
    picture = plan_picture(fix)
    plan = Plan.of(PLANE_VIEWS[0], SIZE)
    window = picture[plan.rows, plan.columns].astype(int)
    rows, columns = np.nonzero(np.abs(window - POINT).max(axis=-1) <= SAME_COLOUR)
    centre = np.array(window.shape[1::-1]) / 2
    assert 20 < len(rows) < 200
    direction = np.array([columns.mean(), rows.mean()]) - centre
    for axis in (0, 1):
        if corner[axis]:
            assert direction[axis] * corner[axis] > 0.5 * min(centre)
        else:
            assert abs(direction[axis]) < 2.0
    assert not (np.abs(plan_picture().astype(int) - POINT).max(axis=-1)[:60] <= SAME_COLOUR).any()


def test_the_trail_fades_and_the_truth_has_gaps():
    trail = np.column_stack([np.linspace(50.0, 350.0, 7), np.full(7, 350.0)])
    plan = Plan.of(PLANE_VIEWS[0], SIZE)
    picture = plan_picture(NO_FIX, trail=trail)
    places = np.rint(plan.place(trail)).astype(int)
    likeness = np.abs(picture[tuple(places.T[::-1])].astype(int) - POINT).sum(axis=1)
    assert (np.diff(likeness) < 0).all()

    path = np.array([[50.0, 60.0], [150.0, 60.0], [np.nan, np.nan], [250.0, 60.0], [350.0, 60.0]])
    picture = plan_picture(NO_FIX, truth_trail=path)
    assert shows(picture, plan.place([[120.0, 60.0], [320.0, 60.0]]), INK).all()
    assert not shows(picture, plan.place([[200.0, 60.0]]), INK).any()


# --- the composition --------------------------------------------------------------------------


def composition(views=2, **options):
    return Composition([PLANE_VIEWS[k % 2] for k in range(views)], **{"unit": "mm", **options})


def observations(views=2, **changes):
    return [seen(k % 2, view=f"view {k}", **changes) for k in range(views)]


@pytest.mark.parametrize("views", [1, 2, 3, 4, 5, 8, 15])
@pytest.mark.parametrize(
    "size", [(640, 480), (1, 1), (48, 64), (1920, 1080), (3, 2000), (4000, 3000)]
)
def test_any_number_of_views_of_any_size_fit_one_picture(views, size):
    picture = composition(views).draw(observations(views, frame=frame(*size)), FIX)
    height, width = picture.shape[:2]
    assert width <= MAX_WIDTH_PX
    assert width % 2 == height % 2 == 0
    assert 0.3 < width / height < 5.0


def test_all_pictures_of_a_run_have_one_size():
    run = composition()
    first = run.draw([seen(0, frame=None), seen(1, frame=frame(320, 200))], NO_FIX)
    for observed in ([seen(0, frame=frame(200, 320)), seen(1)], [seen(0, frame=None)] * 2):
        assert run.draw(observed, FIX).shape == first.shape


def test_the_same_moment_gives_the_same_bits():
    given = {"truth": TARGET, "trail": [TARGET], "truth_trail": [TARGET]}
    pictures = [composition().draw(observations(), FIX, **given) for _ in range(2)]
    assert (pictures[0] == pictures[1]).all()


def test_every_panel_and_the_numbers_are_drawn():
    whole = composition().draw(observations(), FIX)
    panels = [view_picture(k, size_px=(552, 414)) for k in (0, 1)]
    panels.append(plan_picture(size_px=(552, 414)))
    for k, panel in enumerate(panels):
        left = 20 + k * (552 + 16)
        assert (whole[38 : 38 + 414, left : left + 552] == panel).all()
    footer = composition().draw(observations(), NO_FIX)[-48:]
    assert (whole[-48:] != footer).any()


def test_reasons_are_printed_below_each_view_only_if_edges_are_drawn():
    why = ("refused: 31 % agree", "100 lines")
    plain = composition().draw(observations(reasons=why), FIX)
    assert (plain == composition().draw(observations(), FIX)).all()
    with_why = composition(edges=True).draw(observations(reasons=why), FIX)
    without = composition(edges=True).draw(observations(), FIX)
    changed = (with_why != without).any(axis=-1)
    below = 38 + 414
    assert with_why.shape[0] > plain.shape[0]
    assert (with_why[:below] == plain[:below]).all()
    assert (with_why[-48:] == plain[-48:]).all()
    assert changed[below:-48, :572].any()
    assert changed[below:-48, 588:1140].any()
    # The legend of the marks is below the plan.
    legend = without[below:-48, 1156:1708].astype(int)
    assert (np.abs(legend - REJECTED).max(axis=-1) <= 2 * SAME_COLOUR).any()


def far_point(x, y):
    return dataclasses.replace(FIX, point=np.array([x, y]))


@pytest.mark.parametrize(
    "fix",
    [
        FIX,
        NO_FIX,
        UNDETERMINED,
        Fix(1e9, Status.LOST, (FIX.constraint_lines[0], None), reason="x" * 1000),
        far_point(1e12, -1e12),
        far_point(200.0, 1e5),  # beyond the horizon of both views
        dataclasses.replace(FIX, covariance=1e12 * np.eye(2)),
        dataclasses.replace(FIX, covariance=np.diag([1e-30, 0.0])),
        dataclasses.replace(FIX, covariance=np.diag([1500.0**2, 1.0])),  # across the horizon
    ],
)
@pytest.mark.parametrize("size", [(640, 480), (2, 2)])
def test_any_fix_can_be_drawn(fix, size):
    nowhere = np.full(2, np.nan)
    outline = np.array([[10.0, 10.0], [np.nan, 3.0], [1e12, 1e12], [20.0, 30.0], [np.inf, 0.0]])
    changes = {"frame": frame(*size), "contour_px": outline, "search": searched(outline)}
    picture = composition(edges=True).draw(
        observations(**changes),
        fix,
        truth=TARGET,
        trail=[nowhere, [1e20, 0.0]],
        truth_trail=outline,
    )
    assert (picture != picture[0, 0]).any()


def test_a_point_behind_the_camera_is_not_shown_in_its_view():
    picture = view_picture(fix=far_point(200.0, 1e5))
    assert not (np.abs(picture.astype(int) - POINT).max(axis=-1) <= SAME_COLOUR).any()


@pytest.mark.parametrize("size", [(1, 1), (7, 3), (30, 200), (200, 30)])
def test_small_pictures_are_drawn(size):
    assert view_picture(size_px=size).shape == (size[1], size[0], 3)
    assert plan_picture(size_px=size).shape == (size[1], size[0], 3)


@pytest.mark.skipif(not hasattr(cv2, "FontFace"), reason="both letterings are the same there")
def test_stroke_letters_replace_a_missing_typeface(monkeypatch):
    with_typeface = composition().draw(observations(), FIX)
    monkeypatch.setattr("fingerpost.recording.sheet._typeface", lambda: None)
    with_strokes = composition().draw(observations(), FIX)
    assert with_strokes.shape == with_typeface.shape
    (place,) = CAMERAS[0].project(on_plane(TARGET[None]))
    assert shows(with_strokes, (place + 0.5) * 552 / 640 - 0.5 + [20.0, 38.0], POINT)


def test_invalid_input_is_refused():
    with pytest.raises(InvalidInputError, match="plane_views is empty"):
        Composition([], unit="mm")
    with pytest.raises(InvalidInputError, match="1 observations; one for each of 2 views"):
        composition().draw(observations(1), FIX)
    strange = Frame(0, 0.0, np.zeros((4, 4), np.float32))
    with pytest.raises(InvalidInputError, match="float32"):
        composition().draw(observations(frame=strange), FIX)
    with pytest.raises(InvalidInputError, match=r"truth\[0\] is nan"):
        composition().draw(observations(), FIX, truth=[math.nan, 0.0])
    with pytest.raises(InvalidInputError, match="size_px"):
        view_picture(size_px=(0, 10))


# How dichromats see linear RGB: Machado, Oliveira & Fernandes 2009, severity 1.
DICHROMATS = {
    "none": np.eye(3),
    "protanopia": [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
    "deuteranopia": [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ],
    "tritanopia": [
        [1.255528, -0.076749, -0.178779],
        [-0.078411, 0.930809, 0.147602],
        [0.004733, 0.691367, 0.303900],
    ],
}
JUST_NOTICEABLE = 2.3  # CIE76 colour difference


@pytest.mark.parametrize("vision", DICHROMATS)
def test_colours_stay_distinguishable_for_colour_blind_people(vision):
    marks = [*VIEWS, POINT, STATUSES["tracking"], STATUSES["lost"], INK, PANEL]
    srgb = np.array(marks)[:, ::-1] / 255.0
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    seen_linear = np.clip(linear @ np.transpose(DICHROMATS[vision]), 0.0, 1.0)
    lab = cv2.cvtColor(np.float32(seen_linear)[None], cv2.COLOR_LRGB2Lab)[0]
    apart = np.linalg.norm(lab[:, None] - lab, axis=-1)
    assert apart[~np.eye(len(marks), dtype=bool)].min() > 6 * JUST_NOTICEABLE
