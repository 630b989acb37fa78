"""A ROS arm behind rosbridge: the protocol's operations, positions, stops and faults."""

import signal
import socket
import threading
import time

import numpy as np
import pytest
from robot_rig import assert_in_time, best_of_three
from rosbridge_rig import rosbridge_rig
from scipy.spatial.transform import Rotation
from so101_rig import wait_until
from websockets.sync.server import serve

from fingerpost.errors import InvalidInputError
from fingerpost.robot import open_robot
from fingerpost.robot.emulator.faults import Fault
from fingerpost.robot.errors import (
    CommandRefusedError,
    ConnectionLostError,
    GarbledReplyError,
    GripperError,
    NotArrivedError,
    RobotError,
    RobotTimeoutError,
    StoppedError,
)
from fingerpost.robot.protocol import TOOL_DOWN_RAD, Pose, RobotState

GOAL = Pose(0.3, 0.1, 0.2, pitch_rad=TOOL_DOWN_RAD, roll_rad=0.3, yaw_rad=0.0)
NEAR, FAR = Pose(0.3, -0.1, 0.2), Pose(0.3, 0.1, 0.2)


def published(rig):
    return [one["msg"] for one in rig.server.operations if one["op"] == "publish"]


def test_it_sends_messages_of_the_rosbridge_protocol():
    with rosbridge_rig(frame="base_link", target_topic="/fingerpost/target") as rig:
        said = [one for one in rig.server.operations if one["op"] != "publish"]
        advertised, subscribed, stopped, started = said
        assert advertised == {
            "op": "advertise",
            "topic": "/fingerpost/target",
            "type": "geometry_msgs/PoseStamped",
        }
        assert subscribed.items() >= {"op": "subscribe", "topic": "/fingerpost/pose"}.items()
        assert stopped["op"] == started["op"] == "call_service"
        assert (stopped["service"], started["service"]) == ("/fingerpost/stop", "/fingerpost/start")
        assert stopped["args"] == {}
        rig.robot.move_to(GOAL)
        last = published(rig)[-1]
        # Without a stamp, the bridge fills in its own time.
        assert last["header"] == {"frame_id": "base_link"}
        np.testing.assert_allclose(list(last["pose"]["position"].values()), (0.3, 0.1, 0.2))
        assert list(last["pose"]["orientation"]) == ["x", "y", "z", "w"]
        turned = Rotation.from_quat(list(last["pose"]["orientation"].values()))
        np.testing.assert_allclose(turned.apply((0, 0, 1)), (0, 0, -1), atol=1e-9)


def test_it_connects_to_another_websocket_server():
    """Handshake and frames with the server of `websockets`."""
    came, answered = [], threading.Event()

    def handle(connection):
        for text in connection:
            came.append(text)
            answered.set()

    with serve(handle, "127.0.0.1", 0) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        host, port = server.socket.getsockname()
        with open_robot(f"rosbridge://{host}:{port}"):
            assert answered.wait(5.0)
            wait_until(lambda: len(came) == 3)
        server.shutdown()
    assert '"op":"advertise"' in came[0]


# Motion.


def test_it_moves_straight_at_the_given_speed_and_rotates_evenly():
    with rosbridge_rig() as rig:
        rig.robot.move_to(Pose(0.3, -0.1, 0.2, pitch_rad=TOOL_DOWN_RAD, roll_rad=0.0, yaw_rad=0.0))
        seen, begin_s = len(published(rig)), rig.clock()
        rig.robot.move_to(GOAL, speed_m_s=0.1)
        assert rig.clock() - begin_s > 2.0
        sent = published(rig)[seen:]
        places = np.array([list(one["pose"]["position"].values()) for one in sent])
        np.testing.assert_allclose(places[:, [0, 2]], [[0.3, 0.2]] * len(places), atol=1e-9)
        assert (np.diff(places[:, 1]) >= 0).all()
        assert len(sent) >= 20
        turned = Rotation.from_quat([list(one["pose"]["orientation"].values()) for one in sent])
        angle = (turned[0].inv() * turned).magnitude()
        np.testing.assert_allclose(angle, 0.3 * (places[:, 1] + 0.1) / 0.2, atol=1e-2)
        np.testing.assert_allclose(rig.true_m(), (0.3, 0.1, 0.2), atol=1e-6)
        assert rig.robot.pose().roll_rad == pytest.approx(0.3)


def test_the_gripper_uses_two_services():
    with rosbridge_rig() as rig:
        rig.robot.gripper("close")
        rig.robot.gripper("open")
        assert rig.server.calls[-2:] == ["/fingerpost/close", "/fingerpost/open"]
        rig.server.refuses = {"/fingerpost/close": "nothing between the fingers"}
        with pytest.raises(GripperError, match="/fingerpost/close: nothing between the fingers"):
            rig.robot.gripper("close")


# Stopping.


@best_of_three
def test_a_stop_arrives_within_20_ms_and_ends_the_targets():
    with rosbridge_rig() as rig:
        for goal in (FAR, NEAR):
            rig.robot.move_to(goal, wait=False, speed_m_s=0.2)
            wait_until(rig.is_moving)
            time.sleep(0.05)
            seen, called_s = len(rig.emulator.wire), time.monotonic()
            rig.robot.stop()
            arrived_s = []
            wait_until(
                lambda seen=seen, arrived=arrived_s: (
                    arrived.extend(
                        event.time_s for event in rig.emulator.wire[seen:] if not event.sent
                    )
                    or arrived
                )
            )
            wait_until(lambda: rig.server.calls[-1] == "/fingerpost/stop")
            assert_in_time(called_s, arrived_s[0])
            sent = len(published(rig))
            time.sleep(0.05)
            assert len(published(rig)) == sent
            wait_until(lambda: not rig.is_moving())
            assert np.linalg.norm(rig.true_m() - goal.position_m) > 0.02
            # The stop target is the last reported position, 20 ms of arm time old.
            held = list(published(rig)[-1]["pose"]["position"].values())
            np.testing.assert_allclose(rig.true_m(), held, atol=1e-9)
        rig.robot.move_to(NEAR)
        assert rig.server.calls[-1] == "/fingerpost/start"  # made ready again


def test_a_stop_from_a_signal_handler_that_interrupts_any_line():
    with rosbridge_rig() as rig:
        previous = signal.signal(signal.SIGALRM, lambda *_: rig.robot.stop())
        try:
            for delay_s in (0.002, 0.004, 0.006, 0.01, 0.02):
                signal.setitimer(signal.ITIMER_REAL, delay_s)
                with pytest.raises(StoppedError):
                    rig.robot.move_to(FAR, speed_m_s=0.1)
                signal.setitimer(signal.ITIMER_REAL, 0.0)
        finally:
            signal.signal(signal.SIGALRM, previous)
        assert rig.robot.status().state is RobotState.IDLE


def test_a_refused_stop_is_reported():
    with rosbridge_rig() as rig:
        rig.server.refuses = {"/fingerpost/stop": "no such controller"}
        rig.robot.stop()
        wait_until(lambda: rig.server.calls[-1] == "/fingerpost/stop")
        wait_until(lambda: rig.robot._link._responses)
        with pytest.raises(CommandRefusedError, match="has not stopped the arm: no such contr"):
            rig.robot.pose()
        rig.robot.pose()  # the refusal is reported once


# Faults.


def other_frame(rig):
    rig.server.frame = "world"


FAULTS = {
    "no poses": (
        lambda rig: rig.emulator.inject(Fault.LOST_SERVO),
        RobotTimeoutError,
        "/fingerpost/pose: no pose within",
    ),
    "status": (
        lambda rig: rig.emulator.inject(Fault.IMPACT),
        RobotError,
        "rosbridge says: publish: the controller has been aborted",
    ),
    "other frame": (other_frame, GarbledReplyError, r"in the frame 'world', and frame=base_link"),
    "unplugged": (
        lambda rig: rig.emulator.inject(Fault.UNPLUG),
        ConnectionLostError,
        "the connection is gone",
    ),
    "garbage": (
        lambda rig: rig.emulator.inject(Fault.GARBAGE),
        ConnectionLostError,
        "the connection is gone",
    ),
    "stuck": (lambda rig: rig.emulator.inject(Fault.STICK), NotArrivedError, "stands at"),
}


@pytest.mark.parametrize("kind", FAULTS)
def test_a_fault_during_a_move_is_named_in_one_line(kind):
    inject, error, words = FAULTS[kind]
    with rosbridge_rig(stall_s=0.3) as rig:
        rig.robot.move_to(NEAR)
        threading.Timer(0.1, lambda: inject(rig)).start()
        with pytest.raises(error, match=words) as caught:
            rig.robot.move_to(FAR, speed_m_s=0.05)
        assert "\n" not in str(caught.value)
        assert np.linalg.norm(rig.true_m() - FAR.position_m) > 0.01


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"pose_topic": "/nobody"}, RobotTimeoutError, "/nobody: no pose within"),
        ({"frame": "panda_link0"}, GarbledReplyError, "frame=panda_link0"),
        ({"stop_service": "/x"}, CommandRefusedError, "/x has not stopped .*does not exist"),
        ({"start_service": "/x"}, CommandRefusedError, "/x: Service /x does not exist"),
    ],
)
def test_wrong_topics_services_and_frames_are_named(options, error, words):
    with rosbridge_rig(home=False, time_scale=20.0, **options) as rig:
        rig.robot.connect()
        with pytest.raises(error, match=words):
            rig.robot.home()


def test_silent_and_foreign_servers_are_named(monkeypatch):
    monkeypatch.setattr("fingerpost.robot.rosbridge_link.OPEN_S", 0.1)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = "{}:{}".format(*silent.getsockname())
        with pytest.raises(RobotTimeoutError, match=f"ws://{address}: no answer within 0.1 s"):
            open_robot(f"rosbridge://{address}").connect()
    with pytest.raises(ConnectionLostError, match="see that rosbridge_server runs there"):
        open_robot(f"rosbridge://{address}").connect()


@pytest.mark.parametrize(
    "url", ["rosbridge://", "rosbridge://host:0", "rosbridge://host:ros", "rosbridge://host:1/x"]
)
def test_an_invalid_address_is_refused_in_one_line(url):
    with pytest.raises(InvalidInputError, match=r"rosbridge://10\.0\.0\.5:9090 is right"):
        open_robot(url)


def test_a_gripper_needs_both_services():
    with pytest.raises(InvalidInputError, match="open_service is missing"):
        open_robot("rosbridge://host?close_service=/close")


def test_a_stop_of_a_closed_arm_is_an_error():
    with (
        rosbridge_rig(home=False) as rig,
        pytest.raises(ConnectionLostError, match="not connected"),
    ):
        rig.robot.stop()
