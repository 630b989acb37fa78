"""A simulated robot behind a guard, on a simulated clock that only `sleep` advances."""

from contextlib import contextmanager

import numpy as np
from robot_rig import ManualClock

from fingerpost.pointing import Fix, Status
from fingerpost.robot.guard import Guard, GuardOptions
from fingerpost.robot.plane import RobotPlane
from fingerpost.robot.protocol import TOOL_DOWN_RAD
from fingerpost.robot.region import SafeRegion
from fingerpost.robot.simulated import SimulatedOptions, SimulatedRobot

# Plane in millimetres, 20 mm above the robot's base plane.
TIE = np.array([[1e-3, 0.0, 0.2], [0.0, 1e-3, -0.2], [0.0, 0.0, 1.0]])
PLANE = RobotPlane(TIE, 0.02, pitch_rad=TOOL_DOWN_RAD, roll_rad=0.0)
REGION = SafeRegion([[0, 0], [300, 0], [300, 400], [0, 400]], 0.01, 0.2)
CENTRE = [150.0, 200.0]
SURE = np.eye(2)  # 1 mm: a 95 % ellipse of 2.4 mm
PATIENT = {"operator_timeout_s": 1e6}


def fix_at(point, time_s, covariance=SURE, status=Status.OK):
    if status is not Status.OK:
        return Fix(time_s, status, ())
    return Fix(time_s, status, (), np.array(point, dtype=float), np.array(covariance, dtype=float))


class Rig:
    def __init__(self, robot, guard, clock):
        self.robot = robot
        self.guard = guard
        self.clock = clock

    def fix(self, point=CENTRE, *, age_s=0.0, **fields):
        return fix_at(point, self.clock() - age_s, **fields)

    def is_moving(self):
        return self.robot._motion.is_moving(self.clock())

    def start_moving(self, needs, point=(290.0, 390.0)):
        fix = self.fix(point)
        self.guard.observe(fix)
        self.guard.move(point, 0.1, fix=fix, needs=needs, speed_m_s=0.01, wait=False)
        assert self.is_moving()


@contextmanager
def guard_rig(
    *, home=True, arm=True, enter=True, on_record=None, robot_type=SimulatedRobot, **options
):
    clock = ManualClock()
    robot = robot_type(SimulatedOptions(homing_s=0.0), clock=clock, sleep=clock.sleep)
    robot.connect()
    if home:
        robot.home()
    options = GuardOptions(**{**PATIENT, **options})
    guard = Guard(robot, PLANE, REGION, options, clock=clock, on_record=on_record)
    rig = Rig(robot, guard, clock)
    if home and arm:
        guard.arm()
        if enter:
            guard.enter()
    yield rig
