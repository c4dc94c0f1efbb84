"""A progress bar in a notebook's output: plain HTML that is replaced as things go on, without widgets. Elsewhere, nothing."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from html import escape
from typing import Any

from unrender.core import phases

_INTERVAL = 0.2


def in_notebook() -> bool:
    """Whether this code is a cell of a notebook, whose output shows HTML."""
    ipython = sys.modules.get("IPython")
    shell: Any = ipython.get_ipython() if ipython is not None else None
    return shell is not None and type(shell).__name__ == "ZMQInteractiveShell"


@contextmanager
def shown() -> Iterator[None]:
    """Show the phases of what is called within, where this is a notebook and they take time. The bar goes when they are done."""
    if not in_notebook():
        yield
        return
    bar = NotebookBar()
    try:
        with phases.listening(bar):
            yield
    finally:
        bar.close()


class NotebookBar:
    """One bar with a line of text. As a listener to phases it shows the name of the innermost, and how far it is."""

    def __init__(self) -> None:
        self._handle: Any = None
        self._within: list[str] = []
        self._began = time.perf_counter()
        self._updated = -1.0

    def on_phase(self, name: str) -> None:
        """See `phases.Listener.on_phase`."""
        self._within.append(name)
        self.show(name, None, at_once=True)

    def on_progress(self, share: float) -> None:
        """See `phases.Listener.on_progress`."""
        if self._within:
            self.show(self._within[-1], share)

    def on_phase_end(self, name: str) -> None:
        """See `phases.Listener.on_phase_end`."""
        del name
        self._within.pop()

    def show(self, text: str, share: float | None, at_once: bool = False) -> None:
        """Replace the line of text and the bar; no oftener than five times a second, unless `at_once`.

        Args:
            text: what is done.
            share: how far it is, in [0, 1]; None where that is not known.
            at_once: however short a time ago the last one was shown.
        """
        now = time.perf_counter()
        if not at_once and now - self._updated < _INTERVAL:
            return
        self._updated = now
        value = "" if share is None else f' value="{min(max(share, 0.0), 1.0):.4f}"'
        self._put(f'<progress max="1"{value} style="width:160px;vertical-align:middle"></progress> {escape(text)}')

    def close(self, text: str = "") -> None:
        """Leave this line of text in place of the bar, or nothing."""
        if self._handle is not None or text:
            self._put(escape(text))

    def _put(self, html: str) -> None:
        from IPython.display import HTML, display  # pyright: ignore[reportMissingImports]

        body = f'<div style="font-family:system-ui,sans-serif;font-size:13px">{html}</div>' if html else ""
        if self._handle is None:
            self._handle = display(HTML(body), display_id=True)
        else:
            self._handle.update(HTML(body))
