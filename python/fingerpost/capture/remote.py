"""Determines whether a URL is a film, a stream or neither, before it is opened.

A film on a web server is a recording: as a stream it would be played as fast as it is received.
Answers are classified by their content type and first bytes. A page or a single picture is refused,
and so is a server that refuses.
"""

from __future__ import annotations

import http.client
import os
import socket
import ssl
import tempfile
import urllib.error
import urllib.request
from enum import Enum
from pathlib import Path
from urllib.parse import SplitResult, unquote, urlsplit, urlunsplit

from fingerpost.capture.url import masked
from fingerpost.capture.video import VideoFile
from fingerpost.errors import CaptureError, InvalidInputError

_PORTS = {"rtsp": 554, "rtsps": 322, "rtmp": 1935, "rtmps": 443, "tcp": None}
_WEB = ("http", "https")
_FIRST_BYTES = 512
_CHUNK_BYTES = 1 << 20
_PICTURE_STARTS = (b"\xff\xd8\xff", b"\x89PNG", b"GIF8", b"BM")
_PLAYLIST = b"#EXTM3U"
_PAGE_TYPES = ("text/", "application/json", "application/xml", "application/xhtml")


class Remote(Enum):
    """Kind of content at a URL."""

    FILM = "film"
    STREAM = "stream"


def look_up(url: str, timeout_s: float) -> Remote:
    """Determine the kind of content at a URL.

    Parameters
    ----------
    url
        URL with its scheme; for schemes other than web and RTSP only the host is contacted.
    timeout_s
        Time limit for each answer [s], > 0.

    Raises
    ------
    CaptureError
        The host does not exist or does not answer, the server refuses, or the content is neither a
        film nor a stream.
    InvalidInputError
        Not a valid URL.
    """
    parts = _split(url)
    if parts.scheme in _WEB:
        with _answer(url, timeout_s) as answer:
            return _kind(answer, masked(url), timeout_s)
    port = parts.port or _PORTS.get(parts.scheme)
    if parts.hostname and port:
        _knock(url, parts, port, timeout_s)
    return Remote.STREAM


def _split(url: str) -> SplitResult:
    try:
        parts = urlsplit(url)
        parts.port  # noqa: B018 - raises for one that is no number
    except ValueError as error:
        raise InvalidInputError(f"{masked(url)}: is no URL: {error}") from error
    if parts.scheme in _WEB and not parts.hostname:
        raise InvalidInputError(f"{masked(url)}: names no host; http://HOST/PATH is right")
    return parts


def _answer(url: str, timeout_s: float) -> http.client.HTTPResponse:
    """Open a web address."""
    parts = _split(url)
    place = parts.netloc.rpartition("@")[2]
    bare = urlunsplit((parts.scheme, place, parts.path, parts.query, ""))
    passwords = urllib.request.HTTPPasswordMgrWithDefaultRealm()
    if parts.username is not None:
        passwords.add_password(None, bare, unquote(parts.username), unquote(parts.password or ""))
    opener = urllib.request.build_opener(
        urllib.request.HTTPBasicAuthHandler(passwords),
        urllib.request.HTTPDigestAuthHandler(passwords),
    )
    name = masked(url)
    try:
        answer = opener.open(bare, timeout=timeout_s)
    except urllib.error.HTTPError as error:
        error.close()
        refusal = _refusal(error.code, error.reason, parts)
        raise CaptureError(f"{name}: {refusal}") from error
    except urllib.error.URLError as error:
        raise CaptureError(f"{name}: {_failure(error.reason, timeout_s)}") from error
    except (OSError, http.client.HTTPException, ValueError) as error:
        raise CaptureError(f"{name}: {_failure(error, timeout_s)}") from error
    assert isinstance(answer, http.client.HTTPResponse)
    return answer


def _refusal(code: int, reason: str, url: SplitResult) -> str:
    hints = {
        401: "it takes another user or password than the URL's"
        if url.username is not None
        else f"it needs a user and a password: {url.scheme}://USER:PASSWORD@HOST/PATH",
        403: "this user may not see it",
        404: "there is nothing at this path; look for the stream's in the camera's manual",
        410: "there is nothing at this path any more",
        503: "it is busy, or has too many viewers",
    }
    hint = f"; {hints[code]}" if code in hints else ""
    return f"the server answers {code} {reason}{hint}"


def _failure(error: object, timeout_s: float) -> str:
    """Return why a host cannot be reached."""
    if isinstance(error, socket.gaierror):
        return "unknown host; is its name right, and this machine on its network?"
    if isinstance(error, ConnectionRefusedError):
        return "connection refused: nothing listens there; is it switched on, and the port right?"
    if isinstance(error, TimeoutError):
        return f"did not answer within {timeout_s:g} s"
    if isinstance(error, ssl.SSLError):
        return f"no secure connection: {error.reason or error}"
    if isinstance(error, http.client.HTTPException):
        return "what answers there is no web server"
    if isinstance(error, OSError):
        return f"cannot be reached: {error.strerror or error}"
    return f"cannot be opened: {error}"


def _kind(answer: http.client.HTTPResponse, name: str, timeout_s: float) -> Remote:
    """Distinguish film and stream; refuse any other content."""
    content = answer.headers.get_content_type().lower()
    if content.startswith("multipart/"):
        return Remote.STREAM
    has_end = answer.headers["Content-Length"] is not None
    if content.startswith("video/") and not has_end:
        return Remote.STREAM
    try:
        first = answer.read(_FIRST_BYTES)
    except (OSError, http.client.HTTPException) as error:
        raise CaptureError(f"{name}: {_failure(error, timeout_s)}") from error
    if first.startswith(_PLAYLIST) or "mpegurl" in content or "dash+xml" in content:
        return Remote.STREAM
    if content.startswith("image/") or first.startswith(_PICTURE_STARTS):
        raise CaptureError(
            f"{name}: is one picture ({content}), no stream; the camera's stream is needed, which "
            "has an address of its own"
        )
    if first.lstrip()[:1] == b"<" or content.startswith(_PAGE_TYPES):
        raise CaptureError(
            f"{name}: is a page ({content}), no stream; the address of the stream itself is "
            "needed, which such a page often shows"
        )
    if not first:
        raise CaptureError(f"{name}: the server sends nothing; a stream or a film is needed")
    return Remote.FILM if has_end else Remote.STREAM


def _knock(url: str, parts: SplitResult, port: int, timeout_s: float) -> None:
    """Connect to the host; on an RTSP server also request a description of the stream."""
    name = masked(url)
    try:
        with socket.create_connection((str(parts.hostname), port), timeout_s) as line:
            # With a password there are several authentication schemes: left to FFmpeg.
            if parts.scheme != "rtsp" or parts.username is not None:
                return
            line.settimeout(timeout_s)
            line.sendall(f"DESCRIBE {url} RTSP/1.0\r\nCSeq: 1\r\n\r\n".encode())
            status = line.recv(_FIRST_BYTES).decode("latin-1").partition("\r\n")[0]
    except OSError as error:
        raise CaptureError(f"{name}: {_failure(error, timeout_s)}") from error
    protocol, _, answer = status.partition(" ")
    code, _, reason = answer.partition(" ")
    if protocol.startswith("RTSP/") and code.isdigit() and int(code) >= 400:
        raise CaptureError(f"{name}: {_refusal(int(code), reason, parts)}")


class RemoteFilm(VideoFile):
    """A film on a web server, read from a copy that is deleted with the source.

    Many servers cannot send a file from other positions than its start, and MP4 may have its index
    at the end.
    """

    def __init__(self, url: str, *, fps: float, timeout_s: float) -> None:
        self._copy = _download(url, timeout_s)
        try:
            super().__init__(self._copy, fps=fps, name=masked(url))
        except BaseException:
            self._copy.unlink(missing_ok=True)
            raise

    def close(self) -> None:
        """Close the file and remove the copy."""
        super().close()
        self._copy.unlink(missing_ok=True)


def _download(url: str, timeout_s: float) -> Path:
    """Download a URL into a file."""
    name = masked(url)
    with tempfile.NamedTemporaryFile(prefix="fingerpost-", delete=False) as file:
        copy = Path(file.name)
        try:
            with _answer(url, timeout_s) as answer:
                while chunk := _next_chunk(answer, name, timeout_s):
                    file.write(chunk)
        except CaptureError:
            copy.unlink()
            raise
        except OSError as error:
            copy.unlink()
            raise CaptureError(
                f"{name}: cannot be copied to {copy.parent}: {os.strerror(error.errno or 0)}"
            ) from error
        except BaseException:
            copy.unlink()
            raise
    return copy


def _next_chunk(answer: http.client.HTTPResponse, name: str, timeout_s: float) -> bytes:
    try:
        return answer.read(_CHUNK_BYTES)
    except http.client.IncompleteRead as error:
        return error.partial  # a truncated film is reported by its reader
    except (OSError, http.client.HTTPException) as error:
        raise CaptureError(f"{name}: {_failure(error, timeout_s)}") from error
