"""`fingerpost cameras --publish`: this machine's cameras to a rig on another machine."""

from __future__ import annotations

import threading
import tomllib
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import click

from fingerpost.cli.endings import ending_as_interrupted
from fingerpost.cli.live_views import hush_streams
from fingerpost.errors import FingerpostError, InvalidInputError
from fingerpost.signals import wait_hearing_signals

if TYPE_CHECKING:
    from fingerpost.capture import CameraSettings, Source
    from fingerpost.publishing.address import Address
    from fingerpost.publishing.over_zenoh import Zenoh

_SCHEME = "zenoh"


def address_of(url: str) -> Address:
    """Return the address to publish at: this machine listens there unless the URL says otherwise.

    Raises
    ------
    InvalidInputError
        It is not an address of zenoh.
    """
    from fingerpost.publishing.address import Address

    address = Address.of(url)
    if address.scheme != _SCHEME:
        raise InvalidInputError(f"--publish {url}: zenoh://ADDRESS:PORT/KEY is right for cameras")
    return address.with_options({"role": "listen", "pictures": "", **address.options})


def named(sources: Sequence[str]) -> dict[str, str | int]:
    """Return cameras by their names; `left=0` is camera 0, called left.

    Raises
    ------
    InvalidInputError
        Two cameras have the same name.
    """
    found: dict[str, str | int] = {}
    for given in sources:
        name, sign, source = given.partition("=")
        if not (sign and name.isidentifier()):
            name, source = f"camera-{given}" if given.isdecimal() else f"camera-{len(found)}", given
        if name in found:
            raise InvalidInputError(f"{given}: there is a camera {name!r} already; NAME={source}")
        found[name] = int(source) if source.isdecimal() else source
    return found


def settings_of(settings: Sequence[str]) -> CameraSettings | None:
    """Return the settings of the cameras; each is a line of TOML, as in a rig file.

    Raises
    ------
    InvalidInputError
        A line is invalid, has an unknown key, or is out of range.
    """
    from fingerpost.config import CameraTable

    if not settings:
        return None
    shown = " ".join(settings)
    try:
        given = tomllib.loads("\n".join(settings))
    except tomllib.TOMLDecodeError as error:
        raise InvalidInputError(
            f"--set {shown}: {error}; KEY=VALUE as in TOML is right, such as width=1280"
        ) from error
    if unknown := set(given) - set(CameraTable.__struct_fields__):
        known = ", ".join(CameraTable.__struct_fields__)
        raise InvalidInputError(f"--set {shown}: unknown key {unknown.pop()!r}; known are {known}")
    return CameraTable(**given).settings()


def serve(
    sources: Mapping[str, str | int], address: Address, settings: CameraSettings | None = None
) -> None:
    """Publish the newest images of cameras until Ctrl-C, or until one of them fails.

    Parameters
    ----------
    sources
        Sources for `fingerpost.capture.open_source`, by name.
    address
        Address, as returned by `address_of`.
    settings
        Requested settings of each camera.
    """
    from fingerpost.capture import Reading, SourceKind, open_views
    from fingerpost.publishing.over_zenoh import Zenoh

    hush_streams(sources)
    readings = [Reading(camera=settings)] * len(sources)
    counts: dict[str, int] = dict.fromkeys(sources, 0)
    try:
        with ending_as_interrupted(), open_views(sources, readings) as opened:
            for source in opened:
                if source.kind is not SourceKind.LIVE:
                    raise InvalidInputError(f"{source.name}: is a recording; a camera is right")
            link = Zenoh(address)
            try:
                for line in rig_lines(address, list(sources)):
                    click.echo(line)
                _serve(dict(zip(sources, opened, strict=True)), link, counts)
            finally:
                link.close()
    finally:
        for name, count in counts.items():
            click.echo(f"{name}: {count} pictures", err=True)


def rig_lines(address: Address, names: Sequence[str]) -> list[str]:
    """Return the lines of a rig file on another machine for these cameras."""
    from fingerpost.zenoh_link import DEFAULT_PORT

    place = f"{address.host}:{address.port_or(DEFAULT_PORT)}/{address.path or 'fingerpost'}"
    return [f'source = "{_SCHEME}://{place}/{name}"' for name in names]


def _serve(sources: Mapping[str, Source], link: Zenoh, counts: dict[str, int]) -> None:
    failures: list[FingerpostError] = []
    ended = threading.Event()

    def send(name: str, source: Source) -> None:
        try:
            for seen in source:
                if ended.is_set():
                    return
                counts[name] += _sent(link, name, seen)
        except FingerpostError as error:
            failures.append(error)
        finally:
            ended.set()

    threads = [threading.Thread(target=send, args=entry, daemon=True) for entry in sources.items()]
    for thread in threads:
        thread.start()
    try:
        wait_hearing_signals(ended.wait)
    finally:
        ended.set()
        for source in sources.values():
            source.close()
        for thread in threads:
            thread.join()
    if failures:
        raise failures[0]


def _sent(link: Zenoh, name: str, seen: object) -> int:
    """Send an image; return the number sent: 0 for a loss, or without a receiver."""
    from fingerpost.capture import Frame
    from fingerpost.errors import CaptureError

    if not isinstance(seen, Frame):
        return 0
    try:
        link.send_pictures([(name, seen)])
    except CaptureError:  # the router is not there yet
        return 0
    return 1
