"""The server of the live page: on this machine only, with a secret in the address."""

from __future__ import annotations

import asyncio
import hashlib
import json
import math
import secrets
import socket
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Mount, Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from unrender.app.watch import connections, dashboard
from unrender.app.watch.monitor import RunMonitor
from unrender.core.errors import InputError
from unrender.io import files
from unrender.runs.folder.schema import COMMANDS, CONTROL

HOST = "127.0.0.1"
_NAMES = {HOST, "localhost"}
_LONGEST_COMMAND = 1024
_LONGEST_NUMBER = 9  # limit of the digits of the number of a run in an address
_REFUSAL_SECONDS = 2.0
_STOPS = 8.0
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_HEADERS = {
    "content-security-policy": _POLICY,
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cross-origin-resource-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
    "cache-control": "no-store",
}


@dataclass(frozen=True)
class Address:
    """The address of the page: port on 127.0.0.1, and the secret that every path begins with."""

    port: int
    token: str = field(default_factory=lambda: secrets.token_urlsafe(24))

    @property
    def url(self) -> str:
        """The URL to open."""
        return f"http://{HOST}:{self.port}/{self.token}/"


def listen(port: int) -> socket.socket:
    """Open a listening socket on 127.0.0.1; port 0 selects any free port. Raises `InputError` if the port cannot be used."""
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((HOST, port))
        listener.listen(connections.BACKLOG)
    except (OSError, OverflowError) as error:
        listener.close()
        raise InputError(f"--port {port}: {getattr(error, 'strerror', None) or error}") from error
    return listener


def serve(
    directories: Sequence[Path], address: Address, on: socket.socket, on_admission: Callable[[], object] | None = None
) -> None:
    """Serve the page of these run folders on a socket of `listen` until Ctrl-C; call `on_admission` at the first request with the token."""
    connections.enough_files()
    uvicorn.Server(_config(application(directories, address, _REFUSAL_SECONDS, on_admission))).run(sockets=[on])


def _config(page: ASGIApp) -> uvicorn.Config:
    return uvicorn.Config(
        page,
        loop="asyncio",
        http=connections.Connection,
        backlog=connections.BACKLOG,
        log_level="error",
        access_log=False,  # a log would contain the secret
        lifespan="off",
        ws="none",
        server_header=False,
        timeout_graceful_shutdown=1,
    )


def application(
    directories: Sequence[Path],
    address: Address,
    refusal_seconds: float = 0.0,
    on_admission: Callable[[], object] | None = None,
) -> ASGIApp:
    """Return the page as an ASGI application. Requests without the token are answered with 403, after a delay so that repeated ones take no
    time from the runs. `on_admission`: see `serve`."""
    page = _Page(directories)
    routes = [
        Route("/", page.full),
        Route("/update", page.update),
        Route("/picture/{name}", page.picture),
        Route("/control/{run}", page.control, methods=["POST"]),
        Route("/{name}", _asset),
    ]
    mounted = Starlette(routes=[Mount(f"/{address.token}", routes=routes)])
    return _AccessControl(mounted, address, refusal_seconds, on_admission)


class _AccessControl:
    """Middleware that admits requests that name this machine as the host, carry the token, and come from no other page."""

    def __init__(
        self, app: ASGIApp, address: Address, refusal_seconds: float, on_admission: Callable[[], object] | None
    ):
        self._app = app
        self._token = address.token.encode()
        self._port = address.port
        self._refusal_seconds = refusal_seconds
        self._on_admission = on_admission

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            return
        answer = self._refusal(scope)
        if answer is None:
            connections.admit(scope)
            if self._on_admission is not None:
                self._on_admission()
                self._on_admission = None
        else:
            answer.headers["connection"] = "close"
            await asyncio.sleep(self._refusal_seconds)

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [
                    *message.get("headers", []), *((k.encode(), v.encode()) for k, v in _HEADERS.items())
                ]  # fmt: skip
            await send(message)

        await (answer or self._app)(scope, receive, send_with_headers)

    def _refusal(self, scope: Scope) -> Response | None:
        headers = dict(scope["headers"])
        # DNS rebinding: a foreign host name that resolves to this machine would permit another page to read this one.
        host = headers.get(b"host", b"").decode("latin-1").lower()
        if host.partition(":")[0] not in _NAMES or host.partition(":")[2] not in ("", str(self._port)):
            return PlainTextResponse("this page is served to this machine alone", 403)
        first = scope["path"].lstrip("/").partition("/")[0].encode("utf-8", "surrogatepass")
        if not secrets.compare_digest(first, self._token):
            return PlainTextResponse("the address lacks its secret: use the one that unrender watch printed", 403)
        origin = headers.get(b"origin")
        if origin is not None and origin.decode("latin-1").lower() != f"http://{host}":
            return PlainTextResponse("another page may not ask", 403)
        return None


@dataclass(frozen=True)
class _RenderedPage:
    """A rendered page, with the revisions of the runs and its number in the cache of pictures."""

    revisions: tuple[int, ...]
    page: int
    text: str
    digest: str


class _Page:
    """The routes of the page, with the current state of the runs."""

    def __init__(self, directories: Sequence[Path]):
        self._monitors = [RunMonitor(path) for path in directories]
        self._pictures = dashboard.PictureCache()
        self._lock = threading.Lock()
        self._rendered: dict[tuple[str, int, int], _RenderedPage] = {}

    def full(self, request: Request) -> Response:
        return Response(self._render("watch.html", request)[0], media_type="text/html")

    def update(self, request: Request) -> Response:
        """Respond with the part of the page that changes; 204 if its digest is that of the query."""
        began = time.perf_counter()
        text, digest = self._render("watch_main.html", request)
        if request.query_params.get("seen") == digest:
            return Response(status_code=204)
        took = f"{1e3 * (time.perf_counter() - began):.1f}"
        return Response(text, media_type="text/html", headers={"x-digest": digest, "x-milliseconds": took})

    def picture(self, request: Request) -> Response:
        """Respond with a picture as PNG, `stops` above its own exposure."""
        with self._lock:
            picture = self._pictures.get(request.path_params["name"])
        if picture is None:
            raise HTTPException(404)
        stops = _number(request, "stops")
        return Response(picture.png(2.0**stops, effort=1), media_type="image/png")

    async def control(self, request: Request) -> Response:
        digits = request.path_params["run"]
        known = len(digits) <= _LONGEST_NUMBER and digits.isascii() and digits.isdigit()
        if not known or int(digits) >= len(self._monitors):
            raise HTTPException(404)
        number = int(digits)
        if request.headers.get("content-type", "").partition(";")[0].strip() != "application/json":
            raise HTTPException(415, "expected JSON")
        body = b""
        async for part in request.stream():
            body += part
            if len(body) > _LONGEST_COMMAND:
                raise HTTPException(413, "too long for a command")
        try:
            message = json.loads(body)
        except (ValueError, RecursionError) as error:
            raise HTTPException(400, "expected JSON") from error
        command = message.get("command") if isinstance(message, dict) else None
        if command not in COMMANDS:
            raise HTTPException(400, f"expected one of {', '.join(COMMANDS)}")
        return await run_in_threadpool(self._command, number, command)

    def _command(self, number: int, command: str) -> Response:
        monitor = self._monitors[number]
        with self._lock:
            accepts_commands = monitor.snapshot().accepts_commands
        if not accepts_commands:
            return PlainTextResponse("this run has ended: it accepts no commands", 409)
        try:
            files.write(monitor.path / CONTROL, (json.dumps({"command": command}) + "\n").encode())
        except InputError as error:
            return PlainTextResponse(str(error), 409)
        return Response(status_code=204)

    def _render(self, template: str, request: Request) -> tuple[str, str]:
        """Return the text and its digest; the text is rendered again only if a run has changed."""
        run, view = (int(_number(request, name)) for name in ("run", "view"))
        with self._lock:
            snapshots = [monitor.snapshot() for monitor in self._monitors]
            now = tuple(monitor.revision for monitor in self._monitors)
            rendered = self._rendered.get((template, run, view))
            if rendered is None or rendered.revisions != now or not self._pictures.has_page(rendered.page):
                text = dashboard.render(template, snapshots, self._pictures, run, view)
                digest = hashlib.blake2b(text.encode(), digest_size=12).hexdigest()
                rendered = _RenderedPage(now, self._pictures.pages, text, digest)
                self._rendered = {k: of for k, of in self._rendered.items() if self._pictures.has_page(of.page)}
                self._rendered[template, run, view] = rendered
            return rendered.text, rendered.digest


def _number(request: Request, name: str) -> float:
    text = request.query_params.get(name, "0")
    try:
        number = float(text)
    except ValueError as error:
        raise HTTPException(400, f"{name}: expected a number") from error
    if not math.isfinite(number) or abs(number) > (_STOPS if name == "stops" else 1e6):
        raise HTTPException(400, f"{name}: out of range")
    return number


_ASSETS = {"style.css": "text/css", "viewer.js": "text/javascript", "watch.js": "text/javascript"}


def _asset(request: Request) -> Response:
    name = request.path_params["name"]
    if name not in _ASSETS:
        raise HTTPException(404)
    return Response(dashboard.source(name), media_type=_ASSETS[name])
