"""Directions shortened by the fraction of signal in the gradient, as in Wiener's filter, and a weak pull to the start."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from unrender.core import arrays, checks
from unrender.core.arrays import Array
from unrender.core.checks import PositiveByKey
from unrender.core.errors import InputError
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.estimators.capabilities import FreshGradient
from unrender.optimizers.transforms.base import (
    MEAN_SQUARES,
    VALUES,
    StepTransform,
    StepUpdate,
    TransformState,
    checked_keys,
)
from unrender.preconditioners import Sobolev
from unrender.preconditioners.base import Preconditioner

_MEMORY = 0.8
"""Decay of the sums over steps."""

_LEAST_SIGNAL = 0.02
"""Smallest factor of a step, because gradients of pure noise may contain signal later."""


@dataclass(frozen=True)
class GradientProducts(TransformState):
    """State of `WienerShrinkage`.

    Attributes:
        product: Exponentially weighted sum of g_t g_{t-1} per element.
        square: Exponentially weighted sum of (g_t² + g_{t-1}²) / 2 per element.
    """

    product: Tree = field(metadata=MEAN_SQUARES)
    square: Tree = field(metadata=MEAN_SQUARES)


@register
@dataclass(frozen=True)
class WienerShrinkage(StepTransform):
    """Multiply each element's direction by the fraction of signal in its gradient, in [0.02, 1].

        max(s, 0.02),   s = S² ⟨g_t g_{t-1}⟩ / S² ⟨(g_t² + g_{t-1}²) / 2⟩

    The means ⟨·⟩ are over recent steps and the channels of a cell; S² averages over neighbours. Two successive gradients share the
    signal, not the noise. A `FittedSobolev` before it provides S and the last gradient. The product is multiplied by the fraction that
    independent samples confirm. The direction keeps its unit, and is biased toward zero.

    Args:
        keys: Parameters whose direction is shortened; a `FittedSobolev` must precondition them.
    """

    keys: tuple[str, ...] = ()

    def __post_init__(self):
        object.__setattr__(self, "keys", checked_keys("WienerShrinkage: keys", self.keys))

    def init(self, parameters: Tree, learning_rates: Mapping[str, float]) -> GradientProducts:
        """Return the state before the first step. Raises `InputError` for an unknown key."""
        if unknown := next((key for key in self.keys if key not in parameters), None):
            raise InputError(f'WienerShrinkage: keys: unknown parameter "{unknown}"')
        zeros = {key: arrays.zeros_like(parameters[key]) for key in self.keys}
        return GradientProducts(zeros, dict(zeros))

    def update(self, update: StepUpdate, state: GradientProducts) -> tuple[StepUpdate, GradientProducts]:
        """Shorten the direction. Waits for the device except for large textures."""
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
    """Return the fraction of signal per element, in [0.02, 1], with the shape and type of `product` (Wiener's filter).

    It is max(s, 0.02), s = S² ⟨g_t g_{t-1}⟩ / S² ⟨(g_t² + g_{t-1}²) / 2⟩, with means over the channels of a cell.

    Args:
        smooth: S, which averages over neighbours.
        product, square: sums over steps of the two products.
        unknown: weight of the prior value 1, in [0, 1], for the first steps.
        confirmed: fraction of the products that is not reused noise.
        vertices: number of vertices of the mesh that carries the values, (n V,); 0 for textures and grids.
    """
    shape = arrays.shape(product)
    if not vertices and isinstance(smooth, Sobolev) and smooth.is_on_device(shape):
        return _on_device(smooth, product, square, unknown, confirmed)
    cells = (vertices, -1) if vertices else shape
    parts = [arrays.numpy(x).astype(np.float64).reshape(cells) for x in (product, square)]
    means = np.stack([part.mean(axis=-1) for part in parts], axis=-1)
    flat = means.reshape(-1) if vertices else means
    flat = np.asarray(smooth.apply_twice(flat) if isinstance(smooth, Sobolev) else smooth.apply(smooth.apply(flat)))
    means = flat.reshape(means.shape)
    signal, squares = means[..., :1] * confirmed, means[..., 1:]
    share = np.where(squares > 0, signal / np.where(squares > 0, squares, 1.0), 1.0)
    share = np.clip((1.0 - unknown) * np.clip(share, 0.0, 1.0) + unknown, _LEAST_SIGNAL, 1.0)
    shares = np.broadcast_to(share, parts[0].shape).astype(np.float32).reshape(shape)
    return arrays.like(shares, product)


def _on_device(smooth: Sobolev, product: Array, square: Array, unknown: float, confirmed: float) -> Array:
    """Return the same for textures and grids that are large enough to stay on the device; lazy for Dr.Jit."""
    *cells, channels = arrays.shape(product)
    kind = arrays.flat(product)
    element = arrays.arange(kind, math.prod(cells) * channels)
    cell = element // channels
    signal, squares = (
        arrays.gather(arrays.flat(smooth.apply_twice(_summed(x, (*cells, 1)))), cell) for x in (product, square)
    )
    signal = signal * arrays.scalar(confirmed, kind)
    known = squares > 0
    share = arrays.where(known, signal / arrays.where(known, squares, 1.0), 1.0)
    part = arrays.scalar(unknown, kind)
    share = arrays.clip((1.0 - part) * arrays.clip(share, 0.0, 1.0) + part, _LEAST_SIGNAL, 1.0)
    return arrays.shaped(share, (*cells, channels), product)


def _summed(x: Array, shape: tuple[int, ...]) -> Array:
    """Return the sum over channels, of shape (*cells, 1)."""
    channels, flat = arrays.shape(x)[-1], arrays.flat(x)
    first = arrays.arange(flat, math.prod(shape)) * channels
    sums = arrays.gather(flat, first)
    for channel in range(1, channels):
        sums = sums + arrays.gather(flat, first + channel)
    return arrays.shaped(sums, shape, x)


@dataclass(frozen=True)
class Start(TransformState):
    """State of `PullToStart`.

    Attributes:
        values: {key: initial values} of the parameters that are pulled.
    """

    values: Tree = field(metadata=VALUES)

    def restarted(self, fresh: Start) -> Start:
        """Return the values before the first step, and those of `fresh` where shapes have changed."""
        pairs = {key: (self.values[key], x) for key, x in fresh.values.items()}
        return Start({key: old if arrays.shape(old) == arrays.shape(x) else x for key, (old, x) in pairs.items()})


@register
@dataclass(frozen=True)
class PullToStart(StepTransform):
    """Add c L (u − u_0) to the gradient of the loss L, with the initial values u_0.

    This is the derivative of a normal distribution around u_0 (`scene.prior.Prior`) whose likelihood has the residual's present size as
    its noise, c = p / (N τ²), for a loss of |image − reference|^p, N values of all references, and the standard deviation τ. The residual
    is large at first, and noise at last. Elements that the pictures determine better than τ hardly notice it.

    Steps of Adam's length move weakly observed elements as fast as all others, so they compensate errors that other unknowns have at
    first, such as the lower half of a sky those of a wall. Pictures hardly tell them apart, so the gradient takes thousands of steps to
    undo that. The pull keeps such directions near the start. The result is biased towards it.

    Args:
        weights: {key: c}, > 0; other parameters are not pulled.
    """

    weights: PositiveByKey = field(default_factory=dict)

    def __post_init__(self):
        checks.fields(self)

    def init(self, parameters: Tree, learning_rates: Mapping[str, float]) -> Start:
        return Start({key: parameters[key] for key in self.weights})

    def update(self, update: StepUpdate, state: Start) -> tuple[StepUpdate, Start]:
        loss = max(float(update.estimate.loss), 0.0)
        pulls = {
            key: arrays.scalar(self.weights[key] * loss, start) * (update.parameters[key] - start)
            for key, start in state.values.items()
        }
        estimate, fresh = update.estimate, update.estimate.get(FreshGradient)
        if fresh is not None:
            others = (one for one in estimate.capabilities if one is not fresh)
            estimate = replace(estimate, capabilities=(*others, FreshGradient(_sum(fresh.values, pulls))))
        gradient = _sum(update.gradient, pulls)
        return replace(update, estimate=estimate, gradient=gradient, direction=gradient), state


def _sum(gradient: Tree, pulls: Tree) -> Tree:
    return {key: g + pulls[key] if key in pulls else g for key, g in gradient.items()}
