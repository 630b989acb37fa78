"""The page's process: receives moments from a pipe, serves them, and returns commands.

It ends with the program, which closes its end of the pipe.
"""

from __future__ import annotations

import asyncio
import logging
import signal
import socket
import threading
from contextlib import nullcontext, suppress
from functools import partial
from multiprocessing.connection import Connection
from typing import Any

_END_S = 2


def serve(pipe: Connection, host: str, port: int, token: str) -> None:
    """Serve the page until the program ends: the body of the process.

    Parameters
    ----------
    pipe
        Carries pairs of kind and content. Received: "setup", "still", "rig", "moment", "arm",
        "note", "ended" and "close"; sent: "listening" or "refused", "done", "allow", "setup" and
        "arm".
    host, port
        Address; port 0 chooses a free one.
    token
        Required to open the page.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # where it cannot be blocked
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")
    try:
        listening = socket.create_server((host, port), backlog=256)
    except OSError as error:
        pipe.send(("refused", error.strerror or str(error)))
        return
    with listening:
        asyncio.run(_serve(pipe, listening, host, token))


async def _serve(pipe: Connection, listening: socket.socket, host: str, token: str) -> None:
    import uvicorn

    from fingerpost.live.commands import LARGEST_BYTES
    from fingerpost.live.hub import Hub
    from fingerpost.live.patience import ImpatientProtocol
    from fingerpost.live.web import application

    port = listening.getsockname()[1]
    hub = Hub(
        lambda steps: _send(pipe, "allow", steps),
        lambda wanted: _send(pipe, "setup", wanted),
        lambda command: _send(pipe, "arm", command),
    )
    hub.start()
    config = uvicorn.Config(
        application(hub, host, port, token),
        http=ImpatientProtocol,
        ws="websockets-sansio",
        ws_max_size=LARGEST_BYTES,
        ws_per_message_deflate=False,  # pictures are already compressed
        lifespan="off",
        log_config=None,
        access_log=False,
        server_header=False,
        timeout_graceful_shutdown=_END_S,
    )
    logging.getLogger("uvicorn.error").setLevel(logging.CRITICAL)
    server = uvicorn.Server(config)
    server.capture_signals = nullcontext  # type: ignore[method-assign, assignment]
    loop = asyncio.get_running_loop()
    reading = partial(_read, pipe, hub, loop, server)
    threading.Thread(target=reading, name="moments", daemon=True).start()
    _send(pipe, "listening", port)
    await server.serve([listening])


def _read(pipe: Connection, hub: Any, loop: asyncio.AbstractEventLoop, server: Any) -> None:
    """Pass the program's messages to the event loop: the body of a thread."""
    from fingerpost.live.composer import Composer

    composer: Composer | None = None
    with suppress(EOFError, OSError, RuntimeError):  # RuntimeError: the event loop has ended
        while True:
            kind, content = pipe.recv()
            if kind == "moment" and composer is not None:
                loop.call_soon_threadsafe(hub.arrived, composer.message(content))
                _send(pipe, "done", None)
            elif kind == "rig":
                composer = Composer(content)
                loop.call_soon_threadsafe(hub.open_rig, content)
            elif kind == "setup":
                loop.call_soon_threadsafe(hub.open_setup, content)
            elif kind == "still":
                loop.call_soon_threadsafe(hub.show_still, *content)
            elif kind == "arm":
                loop.call_soon_threadsafe(hub.show_arm, content)
            elif kind == "note":
                loop.call_soon_threadsafe(hub.note, content)
            elif kind == "ended":
                loop.call_soon_threadsafe(hub.end, content)
            elif kind == "close":
                break
    server.should_exit = True


_sending = threading.Lock()


def _send(pipe: Connection, kind: str, content: Any) -> None:
    with suppress(OSError), _sending:  # the program may have ended
        pipe.send((kind, content))
