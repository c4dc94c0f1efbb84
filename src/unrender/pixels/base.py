"""The protocol of pixel samplers, which choose the pixels that a step renders, and their weights."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np

from unrender.core.errors import InputError
from unrender.core.random import Key
from unrender.core.trees import Tree
from unrender.scene.batches import PixelSample
from unrender.scene.problem import Problem
from unrender.scene.sample_counts import SampleShares

_FEWEST_REFUSED = 1 << 16
_MOST_DRAWS = 4
"""Draws per pixel of all views beyond which a mini-batch is refused, where it is large at all."""


@dataclass(frozen=True)
class MiniBatch:
    """The pixels of one step.

    Attributes:
        sample: the pixels; None for all pixels of all views.
        samples: paths traced to estimate their probabilities.
        probability: per view, the probability of its pixels relative to uniform sampling: a map (rows, columns), coarser than
            the film; empty where it is uniform.
        tangents: of the parameters, along which the squared derivatives of the drawn pixels are asked for (`DrawStatistics`); {} where
            they are not.
        shares: of the samples of whole views; None where all pixels have as many.
    """

    sample: PixelSample | None
    samples: int = 0
    probability: dict[int, np.ndarray] = field(default_factory=dict)
    tangents: Tree = field(default_factory=dict)
    shares: SampleShares | None = None


@dataclass(frozen=True)
class DrawStatistics:
    """What the samples of a mini-batch, or of whole views, tell of the second moment of their pixels' gradients, on the host.

    Attributes:
        squares: (∂L/∂I)² of each drawn pixel, without the pixel's weight: the mean over its sample groups, (N, 3). Of whole views: of
            the pixels of all views, concatenated, the mean over its samples.
        moments: (Σ_k v_k ∂I/∂θ_k)² along the tangents v of the mini-batch, likewise.
        counts: samples behind each, (N,); None where all are of as many.
    """

    squares: np.ndarray
    moments: np.ndarray
    counts: np.ndarray | None = None


class PixelSampler(Protocol):
    """Immutable; all that changes is in the state.

    A mini-batch is drawn from the pixels of all views at once. Weighted sums over it are unbiased, since its probabilities are positive
    for every pixel and known exactly.
    """

    def init(self, problem: Problem, parameters: Tree) -> Any:
        """The state before the first step. Raises `InputError` for mini-batches of a problem whose loss is not pixelwise."""
        ...

    def draw(self, problem: Problem, parameters: Tree, state: Any, key: Key) -> tuple[MiniBatch, Any]:
        """The pixels of one step, and the next state."""
        ...

    def observe(self, problem: Problem, state: Any, gradient: Tree) -> Any:
        """The state after a step with this gradient by u (`Problem.coordinates`), before preconditioning."""
        ...


@runtime_checkable
class RepeatableSampler(PixelSampler, Protocol):
    """A pixel sampler that can draw several mini-batches of one step: for estimators that render more than one.

    Without `redraw` each further mini-batch counts as a step of the sampler: an importance map ages the faster.
    """

    def redraw(self, problem: Problem, state: Any, key: Key) -> MiniBatch:
        """Another mini-batch of the step that `draw` returned `state` for, with the same probabilities; the state stays as it is."""
        ...


@runtime_checkable
class LearningSampler(PixelSampler, Protocol):
    """A pixel sampler that asks by `MiniBatch.tangents` for what the samples of a step tell, and learns from it.

    An estimator that cannot tell does not call `learn`.
    """

    def learn(self, problem: Problem, state: Any, sample: PixelSample | None, draws: DrawStatistics) -> Any:
        """The state after the step that `draw` returned `state` for, with what its samples tell; `sample`: None for whole views."""
        ...


def learned(
    sampler: PixelSampler, problem: Problem, state: Any, sample: PixelSample | None, draws: DrawStatistics | None
) -> Any:
    """The state of a sampler with what a step's samples tell, where it learns from them and they were asked for."""
    if draws is None or not isinstance(sampler, LearningSampler):
        return state
    return sampler.learn(problem, state, sample, draws)


def check_batch(owner: str, problem: Problem, count: int) -> None:
    """Raise `InputError` where the loss of a pixel depends on others, or the mini-batch is far larger than all views together.

    Args:
        owner: the sampler, for the message.
        problem: what is rendered.
        count: pixels a step.
    """
    if not problem.loss.pixelwise:
        raise InputError(
            f"pixels: {type(problem.loss).__name__} is of whole images, so it takes no pixel mini-batches; "
            "use unrender.pixels.All()"
        )
    pixels = problem.pixels
    if count > max(_MOST_DRAWS * pixels, _FEWEST_REFUSED):
        raise InputError(
            f"{owner}: {count} pixels a step, but all views together have {pixels}; give fewer, or take unrender.pixels.All() "
            "(methods plain and rcv)"
        )
