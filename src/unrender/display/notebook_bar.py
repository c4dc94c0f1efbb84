"""Progress bar in a notebook's output, as plain HTML without widgets. Outside of notebooks it does nothing."""

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
    """Return whether this code runs in a notebook cell whose output shows HTML."""
    ipython = sys.modules.get("IPython")
    shell: Any = ipython.get_ipython() if ipython is not None else None
    return shell is not None and type(shell).__name__ == "ZMQInteractiveShell"


@contextmanager
def shown() -> Iterator[None]:
    """Display the phases of the calls within this context, if it is in a notebook. The bar disappears at the end."""
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
    """Progress bar with a line of text. As a listener it displays the name and progress of the innermost phase."""

    def __init__(self) -> None:
        self._handle: Any = None
        self._within: list[str] = []
        self._began = time.perf_counter()
        self._updated = -1.0

    def on_phase(self, name: str) -> None:
        """Display the name of a phase that starts."""
        self._within.append(name)
        self.show(name, None, at_once=True)

    def on_progress(self, share: float) -> None:
        """Display the progress of the innermost phase."""
        if self._within:
            self.show(self._within[-1], share)

    def on_phase_end(self, name: str) -> None:
        """Return to the enclosing phase."""
        del name
        self._within.pop()

    def show(self, text: str, share: float | None, at_once: bool = False) -> None:
        """Replace the line of text and the bar, at most five times per second.

        Args:
            text: description of the activity.
            share: progress in [0, 1]; None if unknown.
            at_once: whether to ignore the time limit.
        """
        now = time.perf_counter()
        if not at_once and now - self._updated < _INTERVAL:
            return
        self._updated = now
        value = "" if share is None else f' value="{min(max(share, 0.0), 1.0):.4f}"'
        self._put(f'<progress max="1"{value} style="width:160px;vertical-align:middle"></progress> {escape(text)}')

    def close(self, text: str = "") -> None:
        """Replace the bar by this line of text, or by nothing."""
        if self._handle is not None or text:
            self._put(escape(text))

    def _put(self, html: str) -> None:
        from IPython.display import HTML, display  # pyright: ignore[reportMissingImports]

        body = f'<div style="font-family:system-ui,sans-serif;font-size:13px">{html}</div>' if html else ""
        if self._handle is None:
            self._handle = display(HTML(body), display_id=True)
        else:
            self._handle.update(HTML(body))
