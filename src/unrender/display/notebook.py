"""HTML fragments that display objects in a notebook, and a progress bar. They have no scripts, and escape all text."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from html import escape
from typing import Any

import numpy as np

from unrender.core import phases
from unrender.display import pictures
from unrender.display.plots import COLOURS, Chart

_FEW_PIXELS = 200
_SHOWN_WIDTH = 180


def block(title: str, *parts: str) -> str:
    """Return the HTML of an object: a heading, followed by parts that are already HTML."""
    head = f'<div style="font-weight:600;margin-bottom:.3em">{escape(title)}</div>'
    return f'<div style="font-family:system-ui,sans-serif;font-size:13px;line-height:1.4">{head}{"".join(parts)}</div>'


def lines(texts: Sequence[str], prefix: str = "") -> str:
    return "".join(f"<div>{escape(prefix + text)}</div>" for text in texts)


def facts(rows: Mapping[str, str]) -> str:
    """Return an HTML table of names and values."""
    cell = 'style="text-align:left;padding:1px 12px 1px 0;vertical-align:top;background:none;border:none"'
    cells = (
        f"<tr style='background:none'><th {cell}>{escape(name)}</th><td {cell}>{escape(value)}</td></tr>"
        for name, value in rows.items()
    )
    return f'<table style="border:none;margin:.3em 0;font-size:inherit">{"".join(cells)}</table>'


def picture_row(shown: Mapping[str, np.ndarray]) -> str:
    """Return images side by side, from {caption: (H, W, 3) in [0, 1]}; "" for none."""
    if not shown:
        return ""
    figures = []
    for caption, colours in shown.items():
        height, width = colours.shape[:2]
        sharp = "image-rendering:pixelated;" if max(width, height) < _FEW_PIXELS else ""
        size = f"width:{_SHOWN_WIDTH}px;height:auto;aspect-ratio:{width}/{height}"
        figures.append(
            f'<figure style="margin:0;width:{_SHOWN_WIDTH}px"><img src="{pictures.data_uri(colours)}" alt="{escape(caption)}" '
            f'style="{sharp}{size};display:block">'
            f'<figcaption style="opacity:.75;overflow-wrap:anywhere">{escape(caption)}</figcaption></figure>'
        )
    return f'<div style="display:flex;flex-wrap:wrap;gap:10px;margin:.4em 0">{"".join(figures)}</div>'


def charts(curves: Sequence[Chart | None]) -> str:
    """Return charts side by side; None entries are skipped."""
    parts = "".join(_chart(chart) for chart in curves if chart is not None)
    return f'<div style="display:flex;flex-wrap:wrap;gap:14px;margin:.4em 0">{parts}</div>' if parts else ""


def _chart(chart: Chart) -> str:
    f = chart.frame
    text = 'fill="currentColor" fill-opacity=".75" font-size="11" stroke="none"'
    rule = 'stroke="currentColor" stroke-opacity=".15"'
    parts = []
    for y, label in chart.y_ticks:
        parts.append(f'<line x1="{f["left"]}" x2="{f["right"]}" y1="{y:.1f}" y2="{y:.1f}" {rule}/>')
        parts.append(f'<text x="{f["left"] - 6}" y="{y + 4:.1f}" text-anchor="end" {text}>{escape(label)}</text>')
    for x, label in chart.x_ticks:
        parts.append(f'<text x="{x:.1f}" y="{f["bottom"] + 15}" text-anchor="middle" {text}>{escape(label)}</text>')
    middle = (f["left"] + f["right"]) / 2
    parts.append(
        f'<text x="{middle}" y="{chart.height - 4}" text-anchor="middle" {text}>{escape(chart.x_label)}</text>'
    )
    legend = []
    for curve in chart.curves:
        colour = COLOURS[curve.colour]
        parts.append(
            f'<path d="{escape(curve.path)}" fill="none" stroke="{colour}" stroke-width="1.6" stroke-linecap="round"/>'
        )
        legend.append(f'<span style="color:{colour}">● {escape(curve.name)}</span>')
    names = f'<div style="font-size:11px">{"&ensp;".join(legend)}</div>' if len(legend) > 1 else ""
    return (
        f'<div style="width:330px"><div style="opacity:.75">{escape(chart.title)}</div>{names}'
        f'<svg viewBox="0 0 {chart.width} {chart.height}" width="330" role="img" '
        f'aria-label="{escape(f"{chart.title}. {chart.description}")}">{"".join(parts)}</svg></div>'
    )


_INTERVAL = 0.2


def in_notebook() -> bool:
    """Return whether this code runs in a notebook cell whose output shows HTML."""
    ipython = sys.modules.get("IPython")
    shell: Any = ipython.get_ipython() if ipython is not None else None
    return shell is not None and type(shell).__name__ == "ZMQInteractiveShell"


@contextmanager
def shown() -> Iterator[None]:
    """Display a bar with the phases of the calls within this context, if `in_notebook`. It disappears at the end."""
    if not in_notebook():
        yield
        return
    bar = NotebookBar()
    try:
        with phases.listening(bar):
            yield
    finally:
        bar.close()


class NotebookBar(phases.Listener):
    """Progress bar with a line of text. As a listener it displays the name and progress of the innermost phase."""

    def __init__(self) -> None:
        self._handle: Any = None
        self._within: list[str] = []
        self._began = time.perf_counter()
        self._updated = -1.0

    def on_phase(self, name: str) -> None:
        self._within.append(name)
        self.show(name, None, at_once=True)

    def on_progress(self, share: float) -> None:
        if self._within:
            self.show(self._within[-1], share)

    def on_phase_end(self, name: str) -> None:
        self._within.pop()

    def show(self, text: str, share: float | None, at_once: bool = False) -> None:
        """Replace the line of text and the bar, a share in [0, 1] or None, at most five times per second unless `at_once`."""
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
