"""Connections of the live page: a time limit on each request, and a limit on the open connections that have not shown the token.

Every account on this machine can connect to 127.0.0.1. Connections that send no request, send it slowly, or send it without the token
must not block the browser of the owner.

Every account can read the arguments of a process. Therefore the browser opens a file that only its owner can read, which redirects to
the page.
"""

from __future__ import annotations

import asyncio
import contextlib
import html
import os
import shutil
import tempfile
import time
from pathlib import Path
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol

BACKLOG = 1024
"""Limit of the connections that wait to be accepted; accepting all of them must not exhaust the open files of the process."""

_STRANGERS = 768
"""Limit of the open connections whose last request did not show the token; one more closes the oldest of them."""

_FILES = 4096  # limit of open files that the server requests from the system

_ADMITTED = "unrender.admitted"


def admit(scope: Any) -> None:
    """Mark the request of an ASGI scope as one that showed the token."""
    scope.setdefault("state", {})[_ADMITTED] = True


class Connection(H11Protocol):
    """A connection that must send each complete request, body included, within `seconds_to_ask`."""

    seconds_to_ask = 10.0
    strangers = _STRANGERS

    def __init__(self, *arguments: Any, **options: Any):
        super().__init__(*arguments, **options)
        self.began = time.monotonic()
        self._deadline: asyncio.TimerHandle | None = None

    @property
    def admitted(self) -> bool:
        """True if the last request showed the token."""
        return bool(self.scope) and _ADMITTED in self.scope.get("state", {})

    def connection_made(self, transport: Any) -> None:
        """Start the clock. If too many connections have not shown the token, close the oldest of them."""
        super().connection_made(transport)
        self._start_clock()
        if len(self.connections) <= self.strangers:
            return
        known = (each for each in self.connections if isinstance(each, Connection))
        strangers = [each for each in known if not each.admitted and not each.transport.is_closing()]
        if len(strangers) > self.strangers:
            min(strangers, key=lambda each: each.began).transport.abort()

    def data_received(self, data: bytes) -> None:
        """Run the clock from the first byte of a request to its last; the response has no time limit."""
        if self._deadline is None and (self.cycle is None or self.cycle.response_complete):
            self._start_clock()
        super().data_received(data)
        if self.cycle is not None and not self.cycle.more_body and not self.cycle.response_complete:
            self._stop_clock()

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop the clock."""
        self._stop_clock()
        super().connection_lost(exc)

    def _start_clock(self) -> None:
        self._deadline = self.loop.call_later(self.seconds_to_ask, self.transport.abort)

    def _stop_clock(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None


def enough_files() -> None:
    """Raise the limit of open files of this process, if the system has such a limit and permits it."""
    try:
        import resource
    except ImportError:  # Windows
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    target = _FILES if hard == resource.RLIM_INFINITY else min(_FILES, hard)
    if soft != resource.RLIM_INFINITY and soft < target:
        resource.setrlimit(resource.RLIMIT_NOFILE, (target, hard))


_PAGE = """<!doctype html>
<meta charset="utf-8">
<meta name="referrer" content="no-referrer">
<meta http-equiv="refresh" content="0; url={url}">
<title>unrender watch</title>
<p><a href="{url}">The live page</a>
"""


class Redirect:
    """A file that redirects a browser to `url`, in a folder of its own. Only the owner can read either. The context manager removes both.
    Raises `OSError` if it cannot be written."""

    def __init__(self, url: str):
        self._folder = Path(tempfile.mkdtemp(prefix="unrender-watch-"))  # mode 0700
        self.path = self._folder / "open.html"
        try:
            descriptor = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
            with os.fdopen(descriptor, "w", encoding="utf-8") as file:
                file.write(_PAGE.format(url=html.escape(url)))
        except BaseException:
            self.remove()
            raise

    def __enter__(self) -> Redirect:
        return self

    def __exit__(self, *error: object) -> None:
        self.remove()

    def remove(self) -> None:
        """Remove the file and its folder. Further calls do nothing."""
        with contextlib.suppress(OSError):
            shutil.rmtree(self._folder)
