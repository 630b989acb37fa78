"""The web application: the page's files and one WebSocket, with access control."""

from __future__ import annotations

import ipaddress
import logging
import secrets
from pathlib import Path

from starlette.applications import Starlette
from starlette.datastructures import Headers, QueryParams
from starlette.requests import Request, cookie_parser
from starlette.responses import FileResponse, PlainTextResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket

from fingerpost.live.client import Client
from fingerpost.live.commands import FRAMED
from fingerpost.live.drop import take
from fingerpost.live.hub import MOST_CLIENTS, Hub

_log = logging.getLogger(__name__)

SITE = Path(__file__).with_name("site")
"""The page's files."""

_PAGES = {"/": "index.html", "/plan": "plan.html"}
"""Pages by path; the first request has the token in its address, later ones in a cookie."""

_CONTENT = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_HEADERS = {
    "content-security-policy": _CONTENT,
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "cache-control": "no-store",
}

_FRAMED_HEADERS = {
    **_HEADERS,
    "content-security-policy": _CONTENT.replace("; frame-ancestors 'none'", ""),
    "cross-origin-resource-policy": "cross-origin",
}
"""Headers of a page that may be framed: its address contains the token, so nobody else knows it."""


def application(hub: Hub, host: str, port: int, token: str) -> ASGIApp:
    """Return the web application.

    Parameters
    ----------
    hub
        The hub with the state to show.
    host, port
        Address at which it is served.
    token
        Required for access.
    """
    cookie = f"fingerpost-{port}"  # browsers share cookies between all ports of a host

    async def page(request: Request) -> Response:
        response = FileResponse(SITE / _PAGES[request.url.path])
        response.set_cookie(cookie, token, httponly=True, samesite="strict", path="/")
        return response

    async def socket(websocket: WebSocket) -> None:
        if len(hub.watchers) >= MOST_CLIENTS:
            words = f"{MOST_CLIENTS} pages are open already; close one of them\n"
            await websocket.send_denial_response(PlainTextResponse(words, 503))
            return
        await websocket.accept()
        await Client(websocket, hub).run()

    async def still(request: Request) -> Response:
        number = request.path_params["number"]
        if number >= len(hub.stills):
            return PlainTextResponse("there is no such picture\n", 404)
        return Response(hub.stills[number], media_type="image/jpeg")

    async def drop(request: Request) -> Response:
        return await take(request, hub)

    routes = [
        *(Route(path, page) for path in _PAGES),
        Route("/drop/{name}", drop, methods=["PUT"]),
        Route("/still/{number:int}.jpg", still),
        WebSocketRoute("/socket", socket),
        Mount("/", StaticFiles(directory=SITE)),
    ]
    return Guard(Starlette(routes=routes), host=host, port=port, token=token, cookie=cookie)


class Guard:
    """Admits only pages of this server that were opened with its token.

    Parameters
    ----------
    app
        The guarded application.
    host, port
        Address at which it is served: requests with another `Host` are refused, against DNS
        rebinding, and those with another `Origin` may not open a WebSocket or send data.
    token
        Required in the query of the first request, afterwards in a cookie.
    cookie
        Name of the cookie.
    """

    def __init__(self, app: ASGIApp, *, host: str, port: int, token: str, cookie: str) -> None:
        self._app, self._token, self._cookie = app, token, cookie
        names = {host, "127.0.0.1", "localhost"} if _is_loopback(host) else {host}
        self._hosts = {f"{name}:{port}" for name in names}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or refuse it with one line."""
        if scope["type"] not in ("http", "websocket"):
            return
        framed = self._framed(scope)
        refused = self._refused(framed or scope, has_token=framed is not None)
        if refused is None:
            headers = _FRAMED_HEADERS if framed else _HEADERS
            await self._app(framed or scope, receive, _with_headers(send, headers))
            return
        status, words = refused
        _log.warning("refused: %s", words)
        await PlainTextResponse(f"{words}\n", status, _HEADERS)(scope, receive, send)

    def _framed(self, scope: Scope) -> Scope | None:
        """Convert a request of a framed page to that of an ordinary one; None for any other."""
        head, _, path = scope["path"].removeprefix(FRAMED).partition("/")
        is_framed = scope["path"].startswith(FRAMED)
        if is_framed and secrets.compare_digest(head.encode(), self._token.encode()):
            return {**scope, "path": f"/{path}", "raw_path": f"/{path}".encode()}
        return None

    def _refused(self, scope: Scope, *, has_token: bool) -> tuple[int, str] | None:
        """Return status and reason with which a request is refused; None if it is admitted."""
        headers = Headers(scope=scope)
        host, origin = headers.get("host", ""), headers.get("origin")
        if host not in self._hosts:
            return 400, f"Host is {host[:80]!r}; open the address that fingerpost has printed"
        is_asked_only = scope["type"] == "http" and scope["method"] in ("GET", "HEAD")
        if not is_asked_only and origin != f"http://{host}":
            return 403, f"Origin is {str(origin)[:80]!r}; only the page itself may do that"
        if not (has_token or self._has_token(scope, headers)):
            return (
                403,
                "no valid token; open the address that fingerpost has printed",
            )
        return None

    def _has_token(self, scope: Scope, headers: Headers) -> bool:
        given = [cookie_parser(headers.get("cookie", "")).get(self._cookie, "")]
        if scope["type"] == "http" and scope["path"] in _PAGES:
            given.append(QueryParams(scope["query_string"]).get("token", ""))
        known = self._token.encode()
        return any(secrets.compare_digest(one.encode(), known) for one in given)


def _is_loopback(host: str) -> bool:
    return ipaddress.ip_address(host).is_loopback


def _with_headers(send: Send, headers: dict[str, str]) -> Send:
    async def sending(message: Message) -> None:
        if message["type"] in ("http.response.start", "websocket.http.response.start"):
            added = [(name.encode(), value.encode()) for name, value in headers.items()]
            message = {**message, "headers": [*message.get("headers", []), *added]}
        await send(message)

    return sending
