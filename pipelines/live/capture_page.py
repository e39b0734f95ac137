"""Serve a capture as a local web page: what the terminal shows, with its keys as buttons, dim red on black.

The page is served to this computer only, at an address that cannot be guessed: its path begins with a random token.
"""

import secrets
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.resources import files
from typing import Any

import msgspec
import numpy as np
import uvicorn
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, Response
from starlette.routing import Route

from faintfield.pipelines.formats.image_files import encoded
from faintfield.pipelines.live.panel import REQUESTS, CapturePanel
from faintfield.pipelines.live.terminal import LABELS, display_levels
from faintfield.rig.capture.guide import format_duration

_HOST = "127.0.0.1"
# Width of the frame's picture in pixels.
_PICTURE_PX = 960
_HISTOGRAM_BINS = 64
# Longer requests are not read: a press is far shorter.
_MAX_PRESS_BYTES = 1000
_HEADERS = {
    "Cache-Control": "no-store",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Content-Security-Policy": "default-src 'none'; img-src 'self' data:; connect-src 'self'; "
    "style-src 'unsafe-inline'; script-src 'unsafe-inline'; frame-ancestors 'none'",
}


class _PressRequest(msgspec.Struct, forbid_unknown_fields=True):
    """Message from the page when a button is pressed."""

    word: str
    prompt: int | None = None


@contextmanager
def serve_page(panel: CapturePanel) -> Iterator[str]:
    """Serve the page of `panel` while the block runs; yield its address."""
    token = secrets.token_urlsafe(24)
    listener = socket.create_server((_HOST, 0))
    application = _application(panel, token)
    server = uvicorn.Server(
        uvicorn.Config(application, log_level="critical", lifespan="off", timeout_graceful_shutdown=1)
    )
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True, name="page")
    thread.start()
    try:
        yield f"http://{_HOST}:{listener.getsockname()[1]}/{token}/"
    finally:
        server.should_exit = True
        thread.join()
        listener.close()


def _application(panel: CapturePanel, token: str) -> Starlette:
    """Return the web application; every path of it begins with the token."""
    html = files("faintfield.pipelines.live").joinpath("capture.html").read_text(encoding="utf-8")

    async def index(_: Request) -> Response:
        return HTMLResponse(html, headers=_HEADERS)

    async def state(_: Request) -> Response:
        return JSONResponse(_state(panel), headers=_HEADERS)

    async def picture(_: Request) -> Response:
        if panel.shown is None:
            return Response(status_code=404, headers=_HEADERS)
        grey = display_levels(panel.shown.pixels, _PICTURE_PX)
        zero = np.zeros_like(grey)
        red = encoded(np.dstack([grey, zero, zero]), ".png")
        return Response(red, media_type="image/png", headers=_HEADERS)

    async def press(request: Request) -> Response:
        try:
            body = await request.body()
            pressed = msgspec.json.decode(body[:_MAX_PRESS_BYTES], type=_PressRequest)
        except msgspec.DecodeError as failure:
            return JSONResponse({"error": str(failure)}, status_code=400, headers=_HEADERS)
        if pressed.word not in LABELS:
            return JSONResponse({"error": "no such button"}, status_code=400, headers=_HEADERS)
        panel.press(pressed.word, pressed.prompt)
        return JSONResponse({}, headers=_HEADERS)

    return Starlette(
        routes=[
            Route(f"/{token}/", index),
            Route(f"/{token}/state", state),
            Route(f"/{token}/frame.png", picture),
            Route(f"/{token}/press", press, methods=["POST"]),
        ],
        # Turn away requests by another host name, which a foreign page could make point to this computer
        middleware=[Middleware(TrustedHostMiddleware, allowed_hosts=[_HOST])],
    )


def _state(panel: CapturePanel) -> dict[str, Any]:
    """Return what the page shows, except the picture, as a JSON object."""
    asked, status, shown = panel.asked, panel.status, panel.shown
    words = REQUESTS if asked is None else asked.prompt.answers
    frame = None
    if shown is not None:
        counts, edges = np.histogram(shown.pixels, bins=_HISTOGRAM_BINS)
        frame = {
            "name": shown.frame.name,
            "values": dict(shown.values),
            "histogram": np.log1p(counts).tolist(),
            "range_dn": [float(edges[0]), float(edges[-1])],
        }
    return {
        "prompt": None if asked is None else {"number": asked.number, **msgspec.to_builtins(asked.prompt)},
        "status": None if status is None else msgspec.to_builtins(status),
        "to_go": "" if status is None else format_duration(status.to_go_s),
        "buttons": [{"word": word, "label": LABELS[word]} for word in words],
        "frame": frame,
    }
