"""Robots by name: those of this package, and installed plug-ins.

A package adds a robot by an entry point of the group `fingerpost.robots` with the robot's name and
a `RobotFactory`:

    [project.entry-points."fingerpost.robots"]
    myarm = "mypackage.robot:open_arm"
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib.metadata import EntryPoint, entry_points
from typing import TypeAlias, TypeVar
from urllib.parse import parse_qsl, urlsplit

import msgspec

from fingerpost.errors import FingerpostError, InvalidInputError
from fingerpost.robot.gcode import GcodeArm, GcodeOptions
from fingerpost.robot.gcode_dialects import DEXARM, MARLIN, UARM, Dialect
from fingerpost.robot.protocol import Robot
from fingerpost.robot.rosbridge import DEFAULT_PORT, RosbridgeArm, RosbridgeOptions
from fingerpost.robot.scorbot import Scorbot, ScorbotOptions
from fingerpost.robot.serial_line import LAST_PORT, check_address
from fingerpost.robot.simulated import SimulatedOptions, SimulatedRobot
from fingerpost.robot.so101 import SO100, SO101, Build, SoArm, SoArmOptions
from fingerpost.robot.ur import UniversalRobot, UrOptions
from fingerpost.robot.xarm import Xarm, XarmOptions

ENTRY_POINT_GROUP = "fingerpost.robots"

RobotFactory: TypeAlias = Callable[[str, Mapping[str, object]], Robot]
"""Makes a robot, not yet connected, from its address and its options by name. Options from a URL
are text, or a list of texts if separated by commas."""

_Options = TypeVar("_Options", bound=msgspec.Struct)


def open_robot(target: str, **options: object) -> Robot:
    """Make a robot by URL or by name; `connect` or a `with` block opens it.

    Parameters
    ----------
    target : str
        `name://address?option=value&…`, or a name alone. A serial arm's address is a device
        (`acl:///dev/ttyUSB0`, `acl://COM3`) or, after a plus, a serial server
        (`acl+socket://host:4001`, `acl+rfc2217://host:2217`); others have a host (`ur://10.0.0.5`)
        or none (`sim://`). Several numbers are separated by commas.
    **options
        Options by name, including `address` if `target` is only a name. They override the URL.

    Returns
    -------
    Robot
        The robot, not yet connected.

    Raises
    ------
    InvalidInputError
        An unknown robot or option, an invalid value, or a failing plug-in; the message names it.
    MissingExtraError
        The robot needs a library that is not installed.

    Examples
    --------
    >>> robot = open_robot("sim://?homing_s=0")
    >>> robot.status().state
    <RobotState.DISCONNECTED: 'disconnected'>
    """
    name, address, from_url = _split(target)
    address = str(options.pop("address", address))
    robot = _factory(name, target)(address, {**from_url, **options})
    if not isinstance(robot, Robot):
        raise InvalidInputError(
            f"the plug-in for {name!r} returned {type(robot).__name__}, which is no Robot"
        )
    return robot


def robot_names() -> list[str]:
    """Return the names of all robots that can be opened."""
    return sorted({*BUILT_IN, *(point.name for point in _plug_ins())})


def read_options(kind: type[_Options], options: Mapping[str, object], robot: str) -> _Options:
    """Convert options given by name, as text or values, to a driver's own struct.

    Parameters
    ----------
    kind : type
        A `msgspec.Struct`.
    options : mapping
        Options by name.
    robot : str
        The robot's name, for the message.

    Raises
    ------
    InvalidInputError
        An unknown option or an invalid value; the message names it.
    """
    try:
        return msgspec.convert(dict(options), type=kind, strict=False)
    except msgspec.ValidationError as error:
        known = ", ".join(field.name for field in msgspec.structs.fields(kind))
        raise InvalidInputError(f"options of {robot}: {error}; it takes {known}") from error


def _split(target: str) -> tuple[str, str, dict[str, object]]:
    """Split a URL into name, address and options."""
    scheme, is_url, rest = target.partition("://")
    if not is_url:
        return target, "", {}
    try:
        parts = urlsplit(f"//{rest}")
    except ValueError as error:
        raise InvalidInputError(
            f"{target}: {error}; name://address?option=value is needed"
        ) from error
    name, plus, transport = scheme.lower().partition("+")
    address = parts.netloc + parts.path
    try:
        pairs = parse_qsl(parts.query, keep_blank_values=True, strict_parsing=bool(parts.query))
    except ValueError as error:
        raise InvalidInputError(f"{target}: {error}; name=value&… is needed") from error
    options: dict[str, object] = {
        key: value.split(",") if "," in value else value for key, value in pairs
    }
    return name, f"{transport}://{address}" if plus else address, options


def _factory(name: str, target: str) -> RobotFactory:
    if name in BUILT_IN:
        return BUILT_IN[name]
    for point in _plug_ins():
        if point.name == name:
            return _loaded(point)
    if name in OTHERS:
        raise InvalidInputError(f"{target!r}: {OTHERS[name]}")
    raise InvalidInputError(
        f"{target!r}: there is no robot {name!r}; there are {', '.join(robot_names())}; "
        "acl:///dev/ttyUSB0 is right, say. "
        f"Others are added by the entry point group {ENTRY_POINT_GROUP!r}"
    )


def _loaded(point: EntryPoint) -> RobotFactory:
    """Import a plug-in; its errors, now or when it makes a robot, become one line."""
    try:
        factory: RobotFactory = point.load()
    except (Exception, SystemExit) as error:
        raise _broken(point, "cannot be imported", error) from error

    def make(address: str, options: Mapping[str, object]) -> Robot:
        try:
            return factory(address, options)
        except FingerpostError:
            raise
        except Exception as error:
            raise _broken(point, "cannot make its robot", error) from error

    return make


def _broken(point: EntryPoint, problem: str, error: BaseException) -> InvalidInputError:
    package = "" if point.dist is None else f" of the package {point.dist.name}"
    why = " ".join(f"{type(error).__name__}: {error}".split())
    return InvalidInputError(
        f"the plug-in for {point.name!r}{package}, {point.value}, {problem} ({why}); see to it, or "
        "uninstall it; other arms work without"
    )


def _plug_ins() -> list[EntryPoint]:
    return list(entry_points(group=ENTRY_POINT_GROUP))


def _scorbot(address: str, options: Mapping[str, object]) -> Robot:
    check_address(address, "acl")
    return Scorbot(address, read_options(ScorbotOptions, options, "acl"))


def _gcode(name: str, dialect: Dialect) -> RobotFactory:
    def factory(address: str, options: Mapping[str, object]) -> Robot:
        check_address(address, name)
        return GcodeArm(address, dialect, read_options(GcodeOptions, options, name))

    return factory


def _so_arm(build: Build) -> RobotFactory:
    def factory(address: str, options: Mapping[str, object]) -> Robot:
        check_address(address, build.name)
        return SoArm(address, build, read_options(SoArmOptions, options, build.name))

    return factory


def _ur(address: str, options: Mapping[str, object]) -> Robot:
    return UniversalRobot(_host(address, "ur"), read_options(UrOptions, options, "ur"))


def _xarm(address: str, options: Mapping[str, object]) -> Robot:
    return Xarm(_host(address, "xarm"), read_options(XarmOptions, options, "xarm"))


def _rosbridge(address: str, options: Mapping[str, object]) -> Robot:
    host, colon, port = address.rpartition(":")
    if not colon:
        host, port = address, str(DEFAULT_PORT)
    if not host or "/" in address or not port.isdecimal() or not 0 < int(port) <= LAST_PORT:
        raise InvalidInputError(
            f"rosbridge://{address}: a host and a port are needed; rosbridge://10.0.0.5:9090 is "
            "right"
        )
    return RosbridgeArm(host, int(port), read_options(RosbridgeOptions, options, "rosbridge"))


def _simulated(address: str, options: Mapping[str, object]) -> Robot:
    if address:
        raise InvalidInputError(f"sim takes no address, but {address!r} is given")
    return SimulatedRobot(read_options(SimulatedOptions, options, "sim"))


def _host(address: str, name: str) -> str:
    if not address or "/" in address:
        raise InvalidInputError(
            f"{name}://{address}: a host alone is needed; {name}://10.0.0.5 is right"
        )
    return address


BUILT_IN: dict[str, RobotFactory] = {
    "acl": _scorbot,
    "dexarm": _gcode("dexarm", DEXARM),
    "marlin": _gcode("marlin", MARLIN),
    "rosbridge": _rosbridge,
    "sim": _simulated,
    "so100": _so_arm(SO100),
    "so101": _so_arm(SO101),
    "uarm": _gcode("uarm", UARM),
    "ur": _ur,
    "xarm": _xarm,
}
"""The robots of this package; no plug-in can take their names."""

_DOBOT = (
    "a Dobot Magician speaks a binary protocol, which no driver here knows. Rotrics' DexArm is "
    "dexarm:///dev/ttyACM0, another arm on a Marlin board marlin:///dev/ttyACM0"
)
OTHERS = {"dobot": _DOBOT, "magician": _DOBOT}
"""Messages for names that are probably mistaken; a plug-in can use them."""
