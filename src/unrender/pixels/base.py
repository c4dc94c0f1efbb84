"""Protocol of pixel samplers, which choose the pixels that a step renders and their weights."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np

from unrender.core.errors import InputError
from unrender.core.random import Key
from unrender.core.trees import Tree
from unrender.scene.batches import PixelSample, SampleShares
from unrender.scene.problem import Problem

_FEWEST_REFUSED = 1 << 16
_MOST_DRAWS = 4  # number of samples per pixel of all views above which a large mini-batch is refused


@dataclass(frozen=True)
class MiniBatch:
    """The pixels of one step.

    Attributes:
        sample: the pixels; None for all pixels of all views.
        samples: number of paths traced to estimate their probabilities.
        probability: {view: pixels' probability or sample count relative to uniform sampling}, a map of the tiles (rows, columns); {} if
            uniform.
        tangents: parameter tangents along which the squared derivatives of the pixels are requested (`DrawStatistics`); {} for no request.
        shares: distribution of the samples over full views; None for equal numbers.
    """

    sample: PixelSample | None
    samples: int = 0
    probability: dict[int, np.ndarray] = field(default_factory=dict)
    tangents: Tree = field(default_factory=dict)
    shares: SampleShares | None = None


@dataclass(frozen=True)
class DrawStatistics:
    """Second moments of the pixels' derivatives from the samples of a mini-batch or of full views, on the host.

    Attributes:
        squares: (∂L/∂I)² of each sampled pixel, without the pixel's weight, as mean over its sample groups, (N, 3). For full views, the
            mean over its samples for the concatenated pixels of all views.
        moments: (Σ_k v_k ∂I/∂θ_k)² along the mini-batch's tangents v, in the same layout.
        counts: number of samples of each pixel, (N,); None for equal numbers.
    """

    squares: np.ndarray
    moments: np.ndarray
    counts: np.ndarray | None = None


@runtime_checkable
class PixelSampler(Protocol):
    """Immutable pixel sampler; everything that changes is in the state.

    A mini-batch is sampled from the pixels of all views at once. Its probabilities are known exactly and positive for every pixel, so its
    weighted sums are unbiased.
    """

    def init(self, problem: Problem, parameters: Tree) -> Any:
        """Return the state before the first step. Raises `InputError` for mini-batches with a loss that is not pixelwise."""
        ...

    def draw(self, problem: Problem, parameters: Tree, state: Any, key: Key) -> tuple[MiniBatch, Any]:
        """Return the pixels of one step, and the next state."""
        ...

    def observe(self, problem: Problem, state: Any, gradient: Tree) -> Any:
        """Return the state after a step with this gradient with respect to u (`Problem.coordinates`), before preconditioning.

        The same by default.
        """
        return state


@runtime_checkable
class RepeatableSampler(PixelSampler, Protocol):
    """A pixel sampler that can sample several mini-batches per step, for estimators that render more than one.

    Without `redraw`, each further mini-batch counts as a step of the sampler, so an importance map ages faster.
    """

    def redraw(self, problem: Problem, state: Any, key: Key) -> MiniBatch:
        """Return another mini-batch for the step of `state`, as returned by `draw`, with the same probabilities."""
        ...


@runtime_checkable
class LearningSampler(PixelSampler, Protocol):
    """A pixel sampler that requests derivative statistics of a step's samples by `MiniBatch.tangents`, and learns from them.

    An estimator without these statistics does not call `learn`.
    """

    def learn(self, problem: Problem, state: Any, sample: PixelSample | None, draws: DrawStatistics) -> Any:
        """Return the state updated by the samples of the step for which `draw` returned `state`; `sample` is None for full views."""
        ...


def learned(
    sampler: PixelSampler, problem: Problem, state: Any, sample: PixelSample | None, draws: DrawStatistics | None
) -> Any:
    """Return a sampler's state, updated by a step's samples if it learns from them and requested them."""
    if draws is None or not isinstance(sampler, LearningSampler):
        return state
    return sampler.learn(problem, state, sample, draws)


def check_batch(owner: str, problem: Problem, count: int) -> None:
    """Raise `InputError` if the loss is not pixelwise, or if `count` is above 65536 and above four times the pixels of all views."""
    if not problem.loss.pixelwise:
        raise InputError(
            f"pixels: {type(problem.loss).__name__} is a loss of full images, which does not support pixel mini-batches; "
            "use unrender.pixels.All()"
        )
    pixels = problem.pixels
    if count > max(_MOST_DRAWS * pixels, _FEWEST_REFUSED):
        raise InputError(
            f"{owner}: {count} pixels a step, but all views together have {pixels}; use fewer, or unrender.pixels.All() "
            "(methods plain and rcv)"
        )
