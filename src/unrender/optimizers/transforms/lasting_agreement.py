"""The fraction of the agreement of successive gradients that gradients of much later steps confirm."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from unrender.core import arrays, checks, trees
from unrender.core.arrays import Array
from unrender.core.checks import Count
from unrender.core.memory import inner_products
from unrender.core.registry import register
from unrender.core.text import listed
from unrender.core.trees import Tree
from unrender.optimizers.transforms.base import (
    GRADIENTS,
    SMOOTHING_UNCHANGED,
    StepTransform,
    StepUpdate,
    TransformState,
)
from unrender.scene.upsampling import Upsampler

_PARTS = 6
"""Ratio of the number of steps so far to the length of a block."""
_LEAST = 0.02
"""Smallest lasting fraction."""
_PERSISTENT = 0.1
"""Fraction of the squared mean gradient of a block that the block before the last confirms, from which on the rate grows."""


@dataclass(frozen=True)
class GradientBlocks(TransformState):
    """State of `LastingAgreement`.

    Attributes:
        total: Sum of the gradients of the current block.
        last: Mean gradient of the last complete block.
        earlier: Mean gradient of the block before that.
        agreement: {key: Σ g_t · g_{t-1} over the current block, a scalar}.
        squares: {key: Σ |g_t|² over the current block, a scalar}.
        blocks: Number of complete blocks.
        fractions: {key: lasting fraction, unclamped; 1 before it is known}.
        inflations: {key: inflation of the noise; 1 before it is known}.
        growths: {key: logarithm of `SmoothingChange.growth`}.
    """

    total: Tree = field(metadata=GRADIENTS)
    last: Tree = field(metadata=GRADIENTS)
    earlier: Tree = field(metadata=GRADIENTS)
    agreement: dict[str, Array]
    squares: dict[str, Array]
    count: int
    blocks: int
    fractions: dict[str, float]
    inflations: dict[str, float]
    growths: dict[str, float]

    def upsampled(self, upsampler: Upsampler) -> GradientBlocks:
        """Interpolate the gradients, and restart the blocks, whose products have another unit."""
        return replace(super().upsampled(upsampler), count=0, blocks=0, growths=dict.fromkeys(self.growths, 0.0))


@register
@dataclass(frozen=True)
class LastingAgreement(checks.Checked, StepTransform):
    """Estimate how much of the agreement of successive gradients is signal, for estimators that reuse samples.

    Reused noise correlates successive gradients. Gradients that are further apart than the memory of the estimator share the signal
    alone. Steps are divided into blocks, each a sixth of the steps so far, and at least `shortest`. With the mean
    gradient m_k of block k, the lasting fraction is

        m_k · m_{k-2} / ⟨g_t · g_{t-1}⟩,

    where the mean ⟨·⟩ is over block k. The average over blocks, with decay 1/2, becomes `SmoothingChange.lasting`, by which
    `AgreementRate` multiplies the agreement. It is 1 in the first three blocks. Blocks restart when the smoothing of a gradient changes.

    Reused noise also adds up over steps. Relative to independent noise of the same size, the variance of its mean over the n steps of a
    block is larger by

        n (|m_k|² - m_k · m_{k-2}) / (⟨|g_t|²⟩ - m_k · m_{k-2}),

    whose average over blocks, at least 1, becomes `SmoothingChange.inflation`.

    Noise hides a signal from successive gradients, not from means of blocks. The sum over blocks of

        m_k · m_{k-2} / |m_k|² - 0.1,

    set to 0 where it becomes negative, is the logarithm of `SmoothingChange.growth`. Blocks oppose each other where steps are too long
    (Pflug 1990).

    Gradients are unchanged. Needs a `FittedSobolev` before it, which stores the last gradient.

    Args:
        shortest: Number of steps of the shortest block, >= 1.
    """

    shortest: Count = 48

    def init(self, parameters: Tree, learning_rates: Mapping[str, float]) -> GradientBlocks:
        total, last, earlier = (trees.zeros_like(parameters) for _ in range(3))
        zeros, ones = {key: arrays.total(x) for key, x in total.items()}, dict.fromkeys(parameters, 1.0)
        growths = dict.fromkeys(parameters, 0.0)
        return GradientBlocks(total, last, earlier, zeros, dict(zeros), 0, 0, ones, dict(ones), growths)

    def update(self, update: StepUpdate, state: GradientBlocks) -> tuple[StepUpdate, GradientBlocks]:
        """Set the lasting fractions, inflations and growths. Waits for the device at the end of a block."""
        gradient, previous = update.gradient, update.require_previous("LastingAgreement")
        if any(change.gain != 1.0 for change in update.smoothing.values()):
            state = replace(state, count=0, blocks=0, growths=dict.fromkeys(state.growths, 0.0))
        if update.made > 0:
            products = inner_products([pair for key, g in gradient.items() for pair in ((g, previous[key]), (g, g))])
            agreement, squares = (dict(zip(gradient, products[part::2], strict=True)) for part in (0, 1))
            if state.count:
                gradient, agreement = trees.add(state.total, gradient), trees.add(state.agreement, agreement)
                squares = trees.add(state.squares, squares)
            state = replace(state, total=gradient, agreement=agreement, squares=squares, count=state.count + 1)
        if state.count >= max(self.shortest, update.made // _PARTS):
            state = _completed(state)
        smoothing = dict(update.smoothing)
        for key, fraction in state.fractions.items():
            change, inflation = smoothing.get(key, SMOOTHING_UNCHANGED), state.inflations[key]
            growth = math.exp(state.growths[key])
            smoothing[key] = replace(change, lasting=max(fraction, _LEAST), inflation=inflation, growth=growth)
        return replace(update, smoothing=smoothing), state

    def choices(self, state: GradientBlocks, made: int) -> tuple[str, ...]:
        """Return the fractions that are below 1."""
        low = [f"{key} {max(fraction, _LEAST):.2g}" for key, fraction in state.fractions.items() if fraction < 1.0]
        return (f"agreement of gradients that lasts: {listed(low)}",) if low else ()


def _completed(state: GradientBlocks) -> GradientBlocks:
    """Return the state after the end of a block."""
    mean = trees.map(lambda x: x * arrays.scalar(1.0 / state.count, x), state.total)
    arrays.evaluate(mean, state.agreement, state.squares)
    fractions, inflations, growths = state.fractions, state.inflations, state.growths
    if state.blocks >= 2:
        products = inner_products([pair for key, m in mean.items() for pair in ((m, state.earlier[key]), (m, m))])
        arrays.evaluate(products)
        numbers = [arrays.number(product) for product in products]
        weight = 1.0 if state.blocks == 2 else 0.5  # of this block, relative to all earlier ones
        fractions, inflations, growths = {}, {}, {}
        for key, lasting, square in zip(mean, numbers[::2], numbers[1::2], strict=True):
            agreement = arrays.number(state.agreement[key]) / state.count
            # Nothing can last where successive gradients do not agree.
            new = min(max(lasting / agreement, -1.0), 1.0) if agreement > 0.0 else 1.0
            fractions[key] = (1.0 - weight) * state.fractions[key] + weight * new
            new = _inflation(lasting, square, arrays.number(state.squares[key]) / state.count, state.count)
            inflations[key] = (1.0 - weight) * state.inflations[key] + weight * new
            persistent = min(max(lasting / square, -1.0), 1.0) if square > 0.0 else 0.0
            growths[key] = max(0.0, state.growths[key] + persistent - _PERSISTENT)
    return replace(
        state,
        last=mean,
        earlier=state.last,
        count=0,
        blocks=state.blocks + 1,
        fractions=fractions,
        inflations=inflations,
        growths=growths,
    )


def _inflation(lasting: float, square: float, mean_square: float, count: int) -> float:
    """Return the inflation from m_k · m_{k-2}, |m_k|², ⟨|g_t|²⟩ and n."""
    noise = mean_square - max(lasting, 0.0)
    return max(1.0, count * (square - max(lasting, 0.0)) / noise) if noise > 0.0 else 1.0
