"""Directions shortened where gradients are noise, as by Wiener's filter."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from unrender.core import arrays
from unrender.core.arrays import Array
from unrender.core.errors import InputError
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.optimizers.transforms.base import MEAN_SQUARES, StepTransform, StepUpdate, TransformState, checked_keys
from unrender.preconditioners import Sobolev
from unrender.preconditioners.base import Preconditioner

_MEMORY = 0.8
"""Decay of the sums over steps."""

_LEAST_SIGNAL = 0.02
"""The least factor of a step: gradients that were noise may come to tell something."""


@dataclass(frozen=True)
class GradientProducts(TransformState):
    """State of `WienerShrinkage`.

    Attributes:
        product: Exponentially weighted sum of g_t g_{t-1} of every element.
        square: The same of (g_t² + g_{t-1}²) / 2.
    """

    product: Tree = field(metadata=MEAN_SQUARES)
    square: Tree = field(metadata=MEAN_SQUARES)


@register
@dataclass(frozen=True)
class WienerShrinkage(StepTransform):
    """Multiply each element's direction by the share of its gradient that is signal, in [0.02, 1].

        max(s, 0.02),   s = S² ⟨g_t g_{t-1}⟩ / S² ⟨(g_t² + g_{t-1}²) / 2⟩

    The means ⟨·⟩ are over the last steps and the channels of a cell; S² averages over its neighbours. Two gradients share the signal, not
    the noise. A `FittedSobolev` before it provides S and the last gradient. Where fresh samples do not confirm the product, it counts by
    the share confirmed. The direction keeps its unit, and is biased toward zero.

    Args:
        keys: Parameters whose direction is shortened; a `FittedSobolev` must precondition them.
    """

    keys: tuple[str, ...] = ()

    def __post_init__(self):
        object.__setattr__(self, "keys", checked_keys("WienerShrinkage: keys", self.keys))

    def init(self, parameters: Tree, learning_rates: Mapping[str, float]) -> GradientProducts:
        """See `StepTransform.init`. Raises `InputError` for a key that is no parameter."""
        del learning_rates
        if unknown := next((key for key in self.keys if key not in parameters), None):
            raise InputError(f'WienerShrinkage: keys: unknown parameter "{unknown}"')
        zeros = {key: arrays.zeros_like(parameters[key]) for key in self.keys}
        return GradientProducts(zeros, dict(zeros))

    def update(self, update: StepUpdate, state: GradientProducts) -> tuple[StepUpdate, GradientProducts]:
        """See `StepTransform.update`. Waits for the device but for large textures."""
        direction, products, squares = dict(update.direction), dict(state.product), dict(state.square)
        previous = update.require_previous("WienerShrinkage")
        for key in self.keys:
            change, g, h = update.smoothing.get(key), update.gradient[key], previous[key]
            if change is None or change.preconditioner is None:
                raise InputError(
                    f"WienerShrinkage: keys: FittedSobolev must precondition {key}; add it to preconditioned"
                )
            if update.made > 0:
                memory = arrays.scalar(_MEMORY * change.gain, g)
                h = h * arrays.scalar(math.sqrt(change.gain), g)
                products[key] = memory * products[key] + g * h
                squares[key] = memory * squares[key] + 0.5 * (g * g + h * h)
            unknown = _MEMORY**update.made
            direction[key] = direction[key] * signal_share(
                change.preconditioner, products[key], squares[key], unknown, change.confirmed, change.vertices
            )
        return replace(update, direction=direction), GradientProducts(products, squares)


def signal_share(
    smooth: Preconditioner, product: Array, square: Array, unknown: float, confirmed: float, vertices: int
) -> Array:
    """The share of signal per element, in [0.02, 1], of the shape and kind of `product`, as in Wiener's filter.

    max(s, 0.02), s = S² ⟨g_t g_{t-1}⟩ / S² ⟨(g_t² + g_{t-1}²) / 2⟩, with means over the channels of a cell: two gradients share the signal,
    not the noise.

    Args:
        smooth: S, which averages over neighbours.
        product, square: the sums over steps that the means ⟨·⟩ are of.
        unknown: the part of the answer that is 1, since little is known yet, in [0, 1].
        confirmed: the share of the products that is no noise remembered.
        vertices: of the mesh whose values these are, (n V,); 0 of textures and grids.
    """
    shape = arrays.shape(product)
    if not vertices and isinstance(smooth, Sobolev) and smooth.is_on_device(shape):
        return _on_device(smooth, product, square, unknown, confirmed)
    cells = (vertices, -1) if vertices else shape
    parts = [arrays.numpy(x).astype(np.float64).reshape(cells) for x in (product, square)]
    means = np.stack([part.mean(axis=-1) for part in parts], axis=-1)
    flat = means.reshape(-1) if vertices else means
    for _ in range(2):
        flat = np.asarray(smooth.apply(flat))
    means = flat.reshape(means.shape)
    whole, squares = means[..., :1] * confirmed, means[..., 1:]
    share = np.where(squares > 0, whole / np.where(squares > 0, squares, 1.0), 1.0)
    share = np.clip((1.0 - unknown) * np.clip(share, 0.0, 1.0) + unknown, _LEAST_SIGNAL, 1.0)
    found = np.broadcast_to(share, parts[0].shape).astype(np.float32).reshape(shape)
    return arrays.like(found, product)


def _on_device(smooth: Sobolev, product: Array, square: Array, unknown: float, confirmed: float) -> Array:
    """The same of textures and grids so large that they stay where they are; lazy on Dr.Jit."""
    *cells, channels = arrays.shape(product)
    kind = arrays.flat(product)
    element = arrays.arange(kind, math.prod(cells) * channels)
    cell = element // channels
    whole, squares = (
        arrays.gather(arrays.flat(smooth.apply_twice(_summed(x, (*cells, 1)))), cell) for x in (product, square)
    )
    whole = whole * arrays.scalar(confirmed, kind)
    known = squares > 0
    share = arrays.where(known, whole / arrays.where(known, squares, 1.0), 1.0)
    part = arrays.scalar(unknown, kind)
    share = arrays.clip((1.0 - part) * arrays.clip(share, 0.0, 1.0) + part, _LEAST_SIGNAL, 1.0)
    return arrays.shaped(share, (*cells, channels), product)


def _summed(x: Array, shape: tuple[int, ...]) -> Array:
    """The sum over channels, of the shape (*cells, 1)."""
    channels, flat = arrays.shape(x)[-1], arrays.flat(x)
    first = arrays.arange(flat, math.prod(shape)) * channels
    found = arrays.gather(flat, first)
    for channel in range(1, channels):
        found = found + arrays.gather(flat, first + channel)
    return arrays.shaped(found, shape, x)
