"""HTML fragments that display objects in a notebook. They are self-contained, have no scripts, and escape all text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

import numpy as np

from unrender.display import pictures
from unrender.display.plots import Chart

_COLOURS = ("#2a6fdb", "#d9622b", "#1a9a6c", "#8a4fc4", "#b8860b", "#c2407f")
_FEW_PIXELS = 200
_SHOWN_WIDTH = 180


def block(title: str, *parts: str) -> str:
    """Return the HTML of an object: a heading, followed by parts that are already HTML."""
    head = f'<div style="font-weight:600;margin-bottom:.3em">{escape(title)}</div>'
    return f'<div style="font-family:system-ui,sans-serif;font-size:13px;line-height:1.4">{head}{"".join(parts)}</div>'


def lines(texts: Sequence[str], prefix: str = "") -> str:
    """Return one line of HTML per text."""
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
        colour = _COLOURS[curve.colour % len(_COLOURS)]
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
