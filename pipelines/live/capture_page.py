"""Serve a capture as a local web page: what the terminal shows, with its keys as buttons, and live planes.

The page is served to this computer only, at an address that cannot be guessed: its path begins with a random token.
Whatever any program sends there, the capture goes on: connections are bounded in number, size and time, and each
serves one request.
"""

import asyncio
import math
import secrets
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from importlib.resources import files
from json import dumps

import msgspec
import numpy as np
import uvicorn
from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.responses import HTMLResponse, Response
from starlette.routing import Route, Router
from starlette.types import Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

from faintfield.pipelines.console import conceal, inform
from faintfield.pipelines.formats.image_files import encoded
from faintfield.pipelines.live.boards_client import BoardsClient
from faintfield.pipelines.live.light_meter import LightMeter
from faintfield.pipelines.live.panel import CapturePanel, SessionFrames
from faintfield.pipelines.live.planes_client import PlanesClient
from faintfield.pipelines.live.terminal import display_levels
from faintfield.pipelines.live.view import CaptureView
from faintfield.rig.capture.guide import Answer, OperatorRequest, ShownFrame

_HOST = "127.0.0.1"
# Width of the frame's picture in pixels.
_PICTURE_PX = 960
# Bounds on connections: how many, of which so many may arrive at once; how long one may last; what it may send.
_MAX_CONNECTIONS = 64
_MAX_ARRIVALS = 16
_MAX_REQUEST_S = 15.0
_MAX_HEADER_BYTES = 8192
_MAX_PRESS_BYTES = 1000
# The end of the capture waits no longer for the page; and not for one that has not asked for so long.
_MAX_FAREWELL_S = 5.0
_GONE_S = 2.0
_HEADERS = {
    "Connection": "close",
    "Cache-Control": "no-store",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Content-Security-Policy": "default-src 'none'; img-src 'self' data:; connect-src 'self'; "
    "style-src 'unsafe-inline'; script-src 'unsafe-inline'; frame-ancestors 'none'",
}


class _PressRequest(msgspec.Struct, forbid_unknown_fields=True):
    word: Answer | OperatorRequest
    prompt: int | None = None


@contextmanager
def serve_page(
    panel: CapturePanel,
    frames: SessionFrames | None = None,
    planes: PlanesClient | None = None,
    boards: BoardsClient | None = None,
    meter: LightMeter | None = None,
) -> Iterator[str]:
    """Serve the page of a capture while the block runs; yield its address, which no log records.

    It shows prompts and state of `panel`, the `frames` of the session, live planes, the board sweeps, and the light.
    """
    token = secrets.token_urlsafe(24)
    conceal(token)
    audience = _Audience()
    listener = socket.create_server((_HOST, 0))
    server = uvicorn.Server(
        uvicorn.Config(
            _TokenMiddleware(_pages(CaptureView(panel, frames, planes, boards, meter), audience), token),
            http=_BoundedConnection,
            h11_max_incomplete_event_size=_MAX_HEADER_BYTES,
            backlog=_MAX_ARRIVALS,
            ws="none",
            lifespan="off",
            proxy_headers=False,
            server_header=False,
            headers=list(_HEADERS.items()),
            log_config=None,
            log_level="critical",
            timeout_graceful_shutdown=1,
        )
    )
    thread = threading.Thread(target=_run, args=(server, listener), daemon=True, name="page")
    thread.start()
    try:
        yield f"http://{_HOST}:{listener.getsockname()[1]}/{token}/"
    finally:
        if panel.outcome is not None:
            audience.wait()
        server.should_exit = True
        thread.join(_MAX_FAREWELL_S)
        listener.close()


class _Audience:
    """The pages that look on: when one asked for the state, and whether one has shown the outcome."""

    def __init__(self) -> None:
        self._asked_s = -math.inf
        self._informed = threading.Event()

    def note(self, *, informed: bool) -> None:
        """Note that a page has asked for the state."""
        self._asked_s = time.monotonic()
        if informed:
            self._informed.set()

    def wait(self) -> None:
        """Wait until a page that looks on has shown the outcome."""
        if time.monotonic() - self._asked_s < _GONE_S:
            self._informed.wait(_MAX_FAREWELL_S)


def _run(server: uvicorn.Server, listener: socket.socket) -> None:
    """Run the server; its failure is printed, and does not end the capture."""

    async def serve() -> None:
        # What fails in a connection concerns nobody else, and asyncio would print its traceback
        asyncio.get_running_loop().set_exception_handler(lambda _, __: None)
        await server.serve(sockets=[listener])
        for connection in tuple(server.server_state.connections):
            connection.transport.abort()

    try:
        asyncio.run(serve())
    except Exception as failure:
        inform(f"warning: the page has ended ({type(failure).__name__}: {failure}); the capture goes on without it")


class _BoundedConnection(H11Protocol):
    """A connection that is closed after a limited time, or sooner if others need its place.

    When there are too many, the oldest that has not given the token goes: who has it is never kept out for long.
    """

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._deadline = self.loop.call_later(_MAX_REQUEST_S, transport.abort)
        self._strangers: dict[object, asyncio.Transport] = self.config.app.strangers  # type: ignore[union-attr]
        self._strangers[self.client or self] = transport
        if len(self.connections) > _MAX_CONNECTIONS:
            self._strangers.pop(next(iter(self._strangers))).abort()

    def connection_lost(self, exc: Exception | None) -> None:
        self._deadline.cancel()
        self._strangers.pop(self.client or self, None)
        super().connection_lost(exc)


class _TokenMiddleware:
    """Passes a request on if it gives the token, and comes from this page; tells others nothing."""

    def __init__(self, pages: Router, token: str) -> None:
        # The connections that have not given the token, the oldest first, by the address of the other side
        self.strangers: dict[object, asyncio.Transport] = {}
        self._pages = pages
        self._token = token.encode()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        token, _, path = scope["path"].removeprefix("/").partition("/")
        if secrets.compare_digest(token.encode(), self._token) and _is_own(Headers(scope=scope)):
            self.strangers.pop(scope["client"], None)
            await self._pages({**scope, "path": f"/{path}"}, receive, send)
        else:
            await Response(status_code=404)(scope, receive, send)


def _is_own(headers: Headers) -> bool:
    """Return whether a request comes from the page itself, whatever the port, as that of a tunnel may be any.

    A foreign page can make a name of its own point to this computer, which `Host` tells, or post to an address that it
    knows, which `Origin` tells.
    """
    host = headers.get("host", "")
    return host.partition(":")[0] == _HOST and headers.get("origin") in (None, f"http://{host}")


def _pages(view: CaptureView, audience: _Audience) -> Router:
    """Return the addresses behind the token."""
    panel, frames, planes = view.panel, view.session, view.planes
    html = files("faintfield.pipelines.live").joinpath("capture.html").read_text(encoding="utf-8")

    async def index(_: Request) -> Response:
        return HTMLResponse(html)

    async def state(request: Request) -> Response:
        audience.note(informed="informed" in request.query_params)
        return _json(msgspec.to_builtins(view.state()))

    async def picture(_: Request) -> Response:
        shown = panel.shown
        return _image(None if shown is None else _png(shown))

    async def live_picture(request: Request) -> Response:
        return _image(None if planes is None else planes.picture(request.path_params["name"]))

    async def node(request: Request) -> Response:
        status, row, column = panel.status, request.path_params["row"], request.path_params["column"]
        if frames is None or status is None:
            return Response(status_code=404)
        return _json(frames.at(status.step - 1, (row, column)))

    async def press(request: Request) -> Response:
        try:
            pressed = msgspec.json.decode(await _body(request), type=_PressRequest)
        except (msgspec.DecodeError, UnicodeDecodeError):
            return _json({"error": "not a press of a button"}, status_code=400)
        panel.press(pressed.word, pressed.prompt)
        return _json({})

    return Router(
        [
            Route("/", index),
            Route("/state", state),
            Route("/frame.png", picture),
            Route("/planes/{name}", live_picture),
            Route("/node/{row:int}/{column:int}", node),
            Route("/press", press, methods=["POST"]),
        ],
        redirect_slashes=False,
    )


def _json(content: object, status_code: int = 200) -> Response:
    # Escaped, because the name of a file may not be UTF-8
    return Response(dumps(content), status_code, media_type="application/json")


def _image(png: bytes | None) -> Response:
    return Response(status_code=404) if png is None else Response(png, media_type="image/png")


async def _body(request: Request) -> bytes:
    """Return the body of a request; nothing, and without reading on, if it is too long for a press."""
    if int(request.headers.get("content-length", 0)) > _MAX_PRESS_BYTES:
        return b""
    body = b""
    async for chunk in request.stream():
        body += chunk
        if len(body) > _MAX_PRESS_BYTES:
            return b""
    return body


# Several pages may ask for the same picture.
@lru_cache(maxsize=1)
def _png(shown: ShownFrame) -> bytes:
    """Return the picture of a frame in red, as a PNG file."""
    red = display_levels(shown.pixels, _PICTURE_PX, shown.scale_dn)
    return encoded(np.dstack([red, np.zeros_like(red), np.zeros_like(red)]), ".png")
