"""Sampling of the films' reconstruction filters, pixel by pixel.

Mitsuba's film divides Σ k L by Σ k over all samples within the filter's support, where k is the filter's value. In the limit of many
samples a pixel is

    I = ∫ k(x - c) L(x) dx / ∫ k(x - c) dx        over the crop window, or over the full plane with `sample_border`

for the pixel's centre c. Here the samples of a pixel have the density |k| / ∫ |k|, and the weight sign(k) ∫ |k| / ∫ k (filter importance
sampling: M. Ernst, M. Stamminger, G. Greiner 2006). Every pixel therefore has its own samples, and their mean has the expectation I.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

_BINS = 4096  # number of bins of equal probability, for each distance from the borders of the crop window
_CELLS = 1 << 14  # number of cells in which a filter is tabulated


def is_box(film: Any) -> bool:
    """Return whether a pixel is the mean over its square."""
    return bool(film.rfilter().is_box_filter())


def has_negative_lobes(film: Any) -> bool:
    """Return whether the filter has negative values, so that pixels may be negative."""
    rfilter = film.rfilter()
    radius = float(rfilter.radius())
    return bool((_values(rfilter, -radius, radius)[1] < 0).any())


_Kind = tuple[str, bytes, bool]


def _kind(film: Any) -> _Kind:
    """Return everything that determines a film's filter weights, except its size. Printed filters are rounded, so sample values are
    included."""
    rfilter = film.rfilter()
    places = np.linspace(0.0, rfilter.radius(), 17, dtype=np.float32)
    return str(rfilter), np.array(rfilter.eval(mi.Float(places))).tobytes(), bool(film.sample_border())


@dataclass(frozen=True)
class PixelFilters:
    """Inverse cumulative distributions of several films' filters along one axis: filters of Mitsuba are separable.

    The filter is truncated at the border of the crop window, so a pixel's distribution depends on its distance from both borders.

    Attributes:
        nodes: `mi.Float`, offsets from the pixel's centre, `_BINS` + 1 for each distribution.
        weights: `mi.Float`, weight of each bin, `_BINS` for each distribution.
        first: `mi.UInt32`, each film's first distribution.
        reach: `mi.UInt32`, for each film the number of pixels beyond which a border does not truncate the filter.
    """

    nodes: Any
    weights: Any
    first: Any
    reach: Any

    @classmethod
    def of(cls, sensors: Sequence[Any]) -> PixelFilters | None:
        """Return the filters of a list of `mitsuba.Sensor`; None if all are box filters."""
        films = [sensor.film() for sensor in sensors]
        if all(map(is_box, films)):
            return None
        known: dict[_Kind, tuple[int, int]] = {}
        kinds = [_kind(film) for film in films]
        nodes: list[np.ndarray] = []
        weights: list[np.ndarray] = []
        for film, kind in zip(films, kinds, strict=True):
            if kind in known:
                continue
            reach = _reach(film)
            known[kind] = len(nodes), reach
            for below in range(reach + 1):
                for above in range(reach + 1):
                    distribution = _distribution(film.rfilter(), below, above, reach)
                    nodes.append(distribution[0])
                    weights.append(distribution[1])
        each = [known[kind] for kind in kinds]
        return cls(
            mi.Float(np.concatenate(nodes).astype(np.float32)),
            mi.Float(np.concatenate(weights).astype(np.float32)),
            mi.UInt32([first for first, _ in each]),
            mi.UInt32([reach for _, reach in each]),
        )

    def sample(self, u: Any, pixel: Any, count: Any, film: Any) -> tuple[Any, Any]:
        """Return offsets from the centres of pixels, and their weights, for uniform `u` and rows or columns `pixel` of `count`."""
        first, reach = dr.gather(mi.UInt32, self.first, film), dr.gather(mi.UInt32, self.reach, film)
        below, above = dr.minimum(pixel, reach), dr.minimum(count - 1 - pixel, reach)
        row = first + below * (reach + 1) + above
        place = u * _BINS
        bin_ = dr.minimum(mi.UInt32(place), _BINS - 1)
        node = row * (_BINS + 1) + bin_
        start, end = dr.gather(mi.Float, self.nodes, node), dr.gather(mi.Float, self.nodes, node + 1)
        return dr.lerp(start, end, place - bin_), dr.gather(mi.Float, self.weights, row * _BINS + bin_)


def _reach(film: Any) -> int:
    """Return the number of pixels from a border beyond which it does not truncate the filter; 0 if the film samples its border."""
    return 0 if film.sample_border() else max(0, math.ceil(film.rfilter().radius() - 0.5))


def _span(radius: float, below: int, above: int, reach: int) -> tuple[float, float]:
    """Return the interval of a pixel's filter after truncation. `below` and `above` are its distances from the borders, at most `reach`."""
    low = -radius if below >= reach else max(-radius, -below - 0.5)
    return low, radius if above >= reach else min(radius, above + 0.5)


def _values(rfilter: Any, low: float, high: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the borders of equal cells, and the filter's values at their centres."""
    borders = np.linspace(low, high, _CELLS + 1)
    middles = 0.5 * (borders[1:] + borders[:-1])
    return borders, np.array(rfilter.eval(mi.Float(middles.astype(np.float32))), np.float64)


def _distribution(rfilter: Any, below: int, above: int, reach: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the nodes and the bin weights of one inverse cumulative distribution."""
    borders, values = _values(rfilter, *_span(float(rfilter.radius()), below, above, reach))
    absolute = np.concatenate([[0.0], np.cumsum(np.abs(values))])
    signed = np.concatenate([[0.0], np.cumsum(values)])
    levels = np.linspace(0.0, absolute[-1], _BINS + 1)
    nodes = np.interp(levels, absolute, borders)
    masses = np.diff(np.interp(nodes, borders, signed))
    return nodes, masses * (_BINS / signed[-1])


class FilterSlopes:
    """Distributions of the increase and decrease of one film's pixel filters, along one axis. A box filter only changes at its border.

    The derivative of a pixel's normalised filter, including its truncation, is a positive and a negative measure of equal mass.
    """

    # This is not a dataclass, since Dr.Jit would treat a dataclass as loop state.
    def __init__(self, film: Any):
        self._reach = _reach(film)
        each = range(self._reach + 1)
        slopes = [_slopes(film.rfilter(), below, above, self._reach) for below in each for above in each]
        rising, falling, masses = zip(*slopes, strict=True)
        self._rising = mi.Float(np.concatenate(rising).astype(np.float32))
        self._falling = mi.Float(np.concatenate(falling).astype(np.float32))
        self._masses = mi.Float(list(masses))

    def sample(self, u: Any, pixel: Any, count: Any) -> tuple[Any, Any, Any]:
        """Return a sampled offset from the pixel's centre for the increase and one for the decrease, and their mass. See
        `PixelFilters.sample`."""
        below, above = dr.minimum(pixel, self._reach), dr.minimum(count - 1 - pixel, self._reach)
        row = below * (self._reach + 1) + above
        place = u * _BINS
        bin_ = dr.minimum(mi.UInt32(place), _BINS - 1)
        node = row * (_BINS + 1) + bin_
        offsets = [
            dr.lerp(dr.gather(mi.Float, nodes, node), dr.gather(mi.Float, nodes, node + 1), place - bin_)
            for nodes in (self._rising, self._falling)
        ]
        return offsets[0], offsets[1], dr.gather(mi.Float, self._masses, row)


def _slopes(rfilter: Any, below: int, above: int, reach: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the nodes of the increase and, in descending order, of the decrease, and the mass of each."""
    low, high = _span(float(rfilter.radius()), below, above, reach)
    borders, middles = _values(rfilter, low, high)
    values = np.array(rfilter.eval(mi.Float(borders.astype(np.float32))), np.float64)
    changes = np.diff(np.concatenate([[0.0], values, [0.0]]))
    places = np.concatenate([[low], borders, [high]])
    levels, nodes = np.linspace(0.0, 1.0, _BINS + 1), []
    for part in (np.maximum(changes, 0), np.maximum(-changes, 0)):
        reached = np.concatenate([[0.0], np.cumsum(part)])
        nodes.append(np.interp(levels * reached[-1], reached, places))
    mass = float(np.maximum(changes, 0).sum() / (middles.mean() * (high - low)))
    return nodes[0], nodes[1][::-1], mass


_integrals: dict[_Kind, list[float]] = {}  # cached integrals of pixel filters, by their distances from the borders


class FilterStencil:
    """Pixels of one film that a sample contributes to, with the weights of the film."""

    # This is not a dataclass, since Dr.Jit would treat a dataclass as loop state.
    def __init__(self, film: Any):
        self._filter: Any = film.rfilter()
        self._box, self._reach = is_box(film), _reach(film)
        size = film.crop_size()
        self._size = int(size[0]), int(size[1])
        self._radius = float(self._filter.radius())
        kind = _kind(film)
        if kind not in _integrals:
            each = range(self._reach + 1)
            _integrals[kind] = [self._integral(below, above) for below in each for above in each]
        self._integrals = mi.Float(_integrals[kind])
        self.margin = self._radius if film.sample_border() and not self._box else 0.0

    def _integral(self, below: int, above: int) -> float:
        """Return the integral of the filter of a pixel at these distances from the borders."""
        if self._box:
            return 1.0
        low, high = _span(self._radius, below, above, self._reach)
        return float(_values(self._filter, low, high)[1].mean() * (high - low))

    def is_sampled(self, uv: Any) -> Any:
        """Return whether the film takes samples at `uv`, which ranges from 0 to 1 in the crop window."""
        if not self.margin:
            return dr.all((uv >= 0) & (uv < 1))
        return dr.all(
            (uv * mi.Vector2f(*self._size) >= -self.margin) & ((uv - 1) * mi.Vector2f(*self._size) < self.margin)
        )

    def add(self, position: Any, each: Callable[[Any, Any, Any], None]) -> None:
        """Call `each` with index, weight and whether it is in the film for each pixel that samples at `position`, in pixels, contribute
        to."""
        width, height = self._size
        if self._box:
            x = dr.clip(mi.Int32(dr.floor(position.x)), 0, width - 1)
            y = dr.clip(mi.Int32(dr.floor(position.y)), 0, height - 1)
            each(mi.UInt32(y * width + x), mi.Float(1), mi.Bool(True))
            return
        columns, rows = self._axis(position.x, width), self._axis(position.y, height)
        for y, of_row, in_row in rows:
            for x, of_column, in_column in columns:
                each(mi.UInt32(y * width + x), of_row * of_column, in_row & in_column)

    def _axis(self, position: Any, count: int) -> list[tuple[Any, Any, Any]]:
        """Return index, weight, and whether it is in the film, for the pixels along one axis."""
        first, result = mi.Int32(dr.ceil(position - 0.5 - self._radius)), []
        for number in range(math.ceil(2 * self._radius)):
            index = first + number
            inside = (index >= 0) & (index < count)
            index = dr.clip(index, 0, count - 1)
            below, above = dr.minimum(index, self._reach), dr.minimum(count - 1 - index, self._reach)
            integral = dr.gather(mi.Float, self._integrals, mi.UInt32(below * (self._reach + 1) + above))
            result.append((index, self._filter.eval(position - mi.Float(index) - 0.5) / integral, inside))
        return result
