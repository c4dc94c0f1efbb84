"""Geometry of line charts, which a page draws as SVG."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from unrender.display import formatting

AXES = ("seconds", "samples")
"""Possible horizontal axes."""
WIDTH, HEIGHT = 420, 270
LEFT, RIGHT, TOP, BOTTOM = 54, 14, 10, 40
_LOGARITHMIC_FROM = 4.0
COLOURS = ("#2a6fdb", "#d9622b", "#1a9a6c", "#8a4fc4", "#b8860b", "#c2407f")
_SMALLEST, _LARGEST = 1e-280, 1e280
"""Range of magnitudes: ticks of numbers near the ends of the doubles would overflow or be zero."""


@dataclass(frozen=True)
class Line:
    """A curve; x is ascending, and all arrays have the same length. `low` and `high` limit the band around it."""

    name: str
    x: np.ndarray
    y: np.ndarray
    low: np.ndarray | None = None
    high: np.ndarray | None = None
    colour: int = 0


@dataclass(frozen=True)
class Axis:
    """A map from values to [0, 1], linear or logarithmic, with ticks (value, label); `low` and `high` are the values at 0 and 1,
    positive if logarithmic."""

    low: float
    high: float
    logarithmic: bool
    ticks: tuple[tuple[float, str], ...]

    def position(self, values: np.ndarray) -> np.ndarray:
        """Return positions in [0, 1]; values beyond the ends are clipped."""
        low, high = self.low, self.high
        if self.logarithmic:
            values, low, high = np.log(np.maximum(values, low)), math.log(low), math.log(high)
        return np.clip((values - low) / (high - low), 0.0, 1.0)


@dataclass(frozen=True)
class Curve:
    """A line in the chart's coordinates: `d` of the SVG paths of the line and of its band, "" for none; index of its colour, from 0 to
    5."""

    name: str
    path: str
    band: str
    colour: int


@dataclass(frozen=True)
class Chart:
    """A chart for the page's template.

    Attributes:
        title, x_label: labels of the vertical and of the horizontal axis.
        description: text alternative.
        x_ticks, y_ticks: (coordinate, label).
        logarithmic: whether the vertical axis is logarithmic.
        more: number of omitted lines.
        width, height, frame: size of the chart, and borders of the area of its curves, in units of the coordinates.
    """

    title: str
    x_label: str
    description: str
    curves: tuple[Curve, ...]
    x_ticks: tuple[tuple[float, str], ...]
    y_ticks: tuple[tuple[float, str], ...]
    logarithmic: bool
    more: int = 0
    width: int = WIDTH
    height: int = HEIGHT
    frame: dict[str, int] = field(
        default_factory=lambda: {"left": LEFT, "right": WIDTH - RIGHT, "top": TOP, "bottom": HEIGHT - BOTTOM}
    )


def chart(title: str, lines: Sequence[Line], axis: str, end: float) -> Chart | None:
    """Return a chart over "seconds" or "samples" of the first six lines with a finite value; None without one. Values that are not finite
    leave a gap."""
    in_seconds = axis == "seconds"
    x_label, format_value = ("Seconds", formatting.number) if in_seconds else ("Samples (paths)", formatting.count)
    shown = [line for line in lines if np.isfinite(line.y).any()]
    more, shown = max(0, len(shown) - len(COLOURS)), shown[: len(COLOURS)]
    if not shown:
        return None
    end = min(end, _LARGEST) if end > _SMALLEST else 1.0
    x_axis = Axis(0.0, end, False, _even_ticks(0.0, end, format_value))
    y_axis = _vertical(shown)
    return Chart(
        title,
        x_label,
        "; ".join(f"{line.name}: from {_end(line, 0)} to {_end(line, -1)}" for line in shown),
        tuple(_curve(line, x_axis, y_axis) for line in shown),
        tuple((float(_to_x(x_axis, np.array([v]))[0]), label) for v, label in x_axis.ticks),
        tuple((float(_to_y(y_axis, np.array([v]))[0]), label) for v, label in y_axis.ticks),
        y_axis.logarithmic,
        more,
    )


def _vertical(lines: Sequence[Line]) -> Axis:
    parts = [line.y for line in lines] + [b for line in lines for b in (line.low, line.high) if b is not None]
    values, middle = _drawable(parts), _drawable([line.y for line in lines])
    if middle.size and middle.min() > 0 and middle.max() / _LOGARITHMIC_FROM >= middle.min():
        # A band that touches zero must not stretch the logarithmic axis indefinitely.
        low, high = max(values[values > 0].min(), middle.min() / 10), values.max()
        margin = 10.0 ** (0.04 * (math.log10(high) - math.log10(low)))
        low, high = low / margin, high * margin
        return Axis(low, high, True, _logarithmic_ticks(low, high))
    low, high = min(values.min(), 0.0) if values.min() < 0.5 * values.max() else values.min(), values.max()
    span = (high - low) or abs(high) or 1.0
    low, high = (low if low == 0 else low - 0.05 * span), high + 0.05 * span
    return Axis(low, high, False, _even_ticks(low, high, formatting.number))


def _drawable(parts: Sequence[np.ndarray]) -> np.ndarray:
    """Return the finite values, their magnitudes at most `_LARGEST` and those below `_SMALLEST` zero."""
    values = np.clip(np.concatenate([part[np.isfinite(part)] for part in parts]), -_LARGEST, _LARGEST)
    return np.where(np.abs(values) < _SMALLEST, 0.0, values)


def _even_ticks(low: float, high: float, format_value: Callable[[float], str]) -> tuple[tuple[float, str], ...]:
    rough = (high - low) / 5
    size = 10.0 ** math.floor(math.log10(rough))
    step = next(size * factor for factor in (1, 2, 2.5, 5, 10) if size * factor >= rough * 0.999)
    first = math.ceil(low / step - 1e-9)
    values = [i * step for i in range(first, math.floor(high / step + 1e-9) + 1)]
    return tuple((value, format_value(value)) for value in values)


def _logarithmic_ticks(low: float, high: float) -> tuple[tuple[float, str], ...]:
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    values: list[float] = []
    for factors in ((1,), (1, 3), (1, 2, 5), (1, 2, 3, 5, 7)):
        values = [v for d in decades for v in (10.0**d * f for f in factors) if low <= v <= high]
        if len(values) >= 3:
            break
    every = -(-len(values) // 7)
    return tuple((value, formatting.number(value)) for value in values[::every])


def _to_x(axis: Axis, x: np.ndarray) -> np.ndarray:
    return LEFT + axis.position(x) * (WIDTH - LEFT - RIGHT)


def _to_y(axis: Axis, y: np.ndarray) -> np.ndarray:
    return HEIGHT - BOTTOM - axis.position(y) * (HEIGHT - TOP - BOTTOM)


def _curve(line: Line, x_axis: Axis, y_axis: Axis) -> Curve:
    band = ""
    if line.low is not None and line.high is not None:
        known = np.isfinite(line.low) & np.isfinite(line.high)
        across = _to_x(x_axis, line.x[known])
        there = zip(across, _to_y(y_axis, line.high[known]), strict=True)
        back = zip(across[::-1], _to_y(y_axis, line.low[known])[::-1], strict=True)
        band = "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in [*there, *back]) + "Z" if known.sum() > 1 else ""
    return Curve(line.name, _path(line, x_axis, y_axis), band, line.colour % len(COLOURS))


def _path(line: Line, x_axis: Axis, y_axis: Axis) -> str:
    """Return the SVG path: pieces of consecutive finite points. A single point becomes a dot, a line of length zero with a round cap."""
    finite = np.isfinite(line.y)
    across, down = _to_x(x_axis, line.x), _to_y(y_axis, np.where(finite, line.y, 1.0))
    pieces: list[list[str]] = [[]]
    for known, x, y in zip(finite, across, down, strict=True):
        if known:
            pieces[-1].append(f"{x:.1f} {y:.1f}")
        elif pieces[-1]:
            pieces.append([])
    return "".join("M" + "L".join(piece if len(piece) > 1 else piece * 2) for piece in pieces if piece)


def _end(line: Line, which: int) -> str:
    return f"{line.y[np.isfinite(line.y)][which]:.3g}"
