"""Mini-batches of whole views."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from unrender.core import arrays, checks
from unrender.core.errors import InputError
from unrender.core.random import Key
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.pixels import pixel_statistics, uniform_share
from unrender.pixels.base import DrawStatistics, MiniBatch, check_batch
from unrender.pixels.tile_samples import finite
from unrender.pixels.uniform_share import ShareEvidence
from unrender.problem.batches import PixelSample
from unrender.problem.problem import Problem
from unrender.problem.upsampling import SQUARES, Upsampler

__all__ = ["Views", "ViewsState", "inclusion_probabilities"]

_REFRESH, _FORGOTTEN = 10, 0.5
"""Steps between those that are learnt from; others are, too, where a view was never seen, or that counts less than so much by now."""

_PRIOR = 0.1
"""Weight of the mean over all views in what is known of one, in times that it was seen."""

_MEMORY = 0.8 ** (1 / 20)
"""Weight, after each further step, of what was learnt before."""


@dataclass(frozen=True)
class ViewsState:
    """State between steps, where views are drawn by their gradients.

    Attributes:
        step: steps drawn so far.
        totals: running sums of what was seen of each view's second moment, (views,).
        counts: how often it was seen, (views,); earlier times count less.
        evidence: for the share of uniform draws.
        uniform: that share.
        since: steps since these were last changed.
        second_moment: running mean square of each element of the gradient, in the coordinates of the descent; {} before the first.
    """

    step: int
    totals: np.ndarray
    counts: np.ndarray
    evidence: ShareEvidence = field(default_factory=ShareEvidence)
    uniform: float = uniform_share.MOST
    since: int = 0
    second_moment: Tree = field(default_factory=dict)

    def upsampled(self, upsampler: Upsampler) -> ViewsState:
        """See `Upsamplable`: the mean squares of the gradient are interpolated."""
        return replace(self, second_moment=upsampler.tree(self.second_moment, SQUARES))

    def density(self) -> np.ndarray:
        """q of each view, mean 1: the root of its mean second moment, and a little of that of all views."""
        seen = self.counts > 0
        if not (seen.any() and self.totals.sum() > 0):
            return np.ones(len(self.counts))
        usual = float((self.totals[seen] / self.counts[seen]).mean())
        root = np.sqrt((self.totals + _PRIOR * usual) / (self.counts + _PRIOR))
        return root / root.mean()


@register
@dataclass(frozen=True)
class Views:
    """All pixels of some views, others at each step. Unbiased: each view is weighted by one over the probability π_v that it is among them.

    What a step costs for each view that it looks at, whatever the number of its pixels (borders of moving shapes, small pictures), falls
    with the number of views; pixels drawn from all views at once (`Uniform`) leave it as it is. The gradient varies with the views.

    by="uniform": any set of `count` views is equally likely. by="gradients": π_v goes by λ + (1 - λ) q_v, with mean 1 of q, and is 1 at
    most, where

        q_v ∝ sqrt(Σ_{j in v} E[(∂L/∂I_j)²] · Σ_k E[(∂I_j/∂θ_k)²])

    is the root of the second moment of the view's gradient, which minimises its variance if the pixels of each view agree as much as those
    of another. Views that show little of the parameters, or are right already, are drawn less often. Both factors come
    from the samples of the steps, as for `AdaptiveCounts`, in units of Adam's steps: whenever a view is drawn of which nothing, or
    nothing recent, is known, and in one of ten steps, at the price of a pass more. λ is 0.8 at first, and falls to 0.1 as samples confirm q
    (`uniform_share.choose`): the second moment is at most 1.25 times that of uniform draws without evidence. Estimators that
    cannot tell what samples saw, such as coupled gradients, leave all views equally likely.

    Args:
        count: views a step, >= 1; where the problem has no more, all.
        by: "uniform" or "gradients".
        uniform: λ, in (0, 1]; None for 0.8 at first, and then by what the samples tell.
    """

    count: int
    by: Literal["uniform", "gradients"] = "uniform"
    uniform: float | None = None

    def __post_init__(self):
        checks.integer("Views", "count", self.count, at_least=1)
        if self.by not in ("uniform", "gradients"):
            raise InputError(f'Views: by must be "uniform" or "gradients", got {self.by!r}')
        share = self.uniform
        if share is not None and not checks.number("Views", "uniform", share, above=0.0) <= 1:
            raise InputError(f"Views: uniform must be a share in (0, 1], got {share!r}")

    def init(self, problem: Problem, parameters: Tree) -> ViewsState | None:
        """See `PixelSampler.init`: there is no state where all views are equally likely."""
        del parameters
        check_batch("Views", problem, 1)
        zeros = np.zeros(len(problem.views))
        share = uniform_share.MOST if self.uniform is None else self.uniform
        return None if self.by == "uniform" else ViewsState(0, zeros, zeros, uniform=share)

    def draw(
        self, problem: Problem, parameters: Tree, state: ViewsState | None, key: Key
    ) -> tuple[MiniBatch, ViewsState | None]:
        """See `PixelSampler.draw`."""
        chosen, weights = self._chosen(problem, state, key)
        batch = _whole(problem, chosen, weights)
        if state is None or self.count >= len(problem.views):
            return batch, state
        counts = state.counts[chosen] * _MEMORY**state.since
        if counts.min() < _FORGOTTEN or state.step % _REFRESH == 0:
            scales = pixel_statistics.scales(parameters, state.second_moment)
            batch = replace(batch, tangents=pixel_statistics.random_tangents(problem, parameters, scales, key.fold(2)))
        return batch, replace(state, step=state.step + 1, since=state.since + 1)

    def redraw(self, problem: Problem, state: ViewsState | None, key: Key) -> MiniBatch:
        """See `RepeatableSampler.redraw`."""
        return _whole(problem, *self._chosen(problem, state, key))

    def _chosen(self, problem: Problem, state: ViewsState | None, key: Key) -> tuple[np.ndarray, np.ndarray]:
        """Views, ascending, and their weights."""
        total = len(problem.views)
        count, random = min(self.count, total), np.random.default_rng(key.uint32())
        if state is None:
            return np.sort(random.choice(total, count, replace=False)), np.full(count, total / count)
        likely = self._probabilities(state)
        chosen = _systematic(likely, random)
        return chosen, 1 / likely[chosen]

    def learn(
        self, problem: Problem, state: ViewsState | None, sample: PixelSample | None, draws: DrawStatistics
    ) -> ViewsState | None:
        """See `LearningSampler.learn`."""
        if state is None or sample is None:
            return state
        total, decay = len(problem.views), _MEMORY**state.since
        views = arrays.numpy(sample.views).astype(np.int64)
        product = (finite(draws.squares) * finite(draws.moments)).sum(axis=1)
        chosen = np.unique(views)
        seen = np.bincount(views, weights=product, minlength=total)
        relative = self._probabilities(state) * (total / min(self.count, total))
        told = product / relative[views]  # by pixel: that many samples there are of what a view's sum may have missed
        evidence = uniform_share.observed(state.evidence, np.array([told, told]), state.density()[views], decay)
        counts = state.counts * decay
        counts[chosen] += 1
        return replace(
            state,
            totals=state.totals * decay + seen,
            counts=counts,
            evidence=evidence,
            uniform=uniform_share.choose(evidence) if self.uniform is None else self.uniform,
            since=0,
        )

    def observe(self, problem: Problem, state: ViewsState | None, gradient: Tree) -> ViewsState | None:
        """Update the mean square of the gradient's elements."""
        if state is None:
            return None
        return replace(state, second_moment=pixel_statistics.observed(problem, state.second_moment, gradient))

    def _probabilities(self, state: ViewsState) -> np.ndarray:
        return inclusion_probabilities((1 - state.uniform) * state.density() + state.uniform, self.count)


def _whole(problem: Problem, chosen: np.ndarray, weights: np.ndarray) -> MiniBatch:
    """All pixels of the chosen views, with the views' weights."""
    known = problem.sizes
    sizes = [math.prod(known[view]) for view in chosen]
    like = problem.renderer.array(np.repeat(weights, sizes)[:, None].astype(np.float32))
    views = arrays.like_integers(np.repeat(chosen, sizes), like)
    pixels = arrays.like_integers(np.concatenate([np.arange(size) for size in sizes]), like)
    return MiniBatch(PixelSample(views, pixels, like))


def inclusion_probabilities(shares: np.ndarray, count: int) -> np.ndarray:
    """π of each of V views, (V,), in proportion to the shares, (V,) > 0, but 1 at most; their sum is `count`, or V where that is less."""
    found, free = np.ones(len(shares)), np.ones(len(shares), bool)
    while (left := count - int((~free).sum())) > 0 and free.any():
        found[free] = shares[free] * (left / shares[free].sum())
        over = free & (found >= 1)
        if not over.any():
            break
        found[over], free = 1.0, free & ~over
    return found


def _systematic(likely: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Different views, ascending, each with its probability: at equal distances along the sums of a random order."""
    order = random.permutation(len(likely))
    ends = np.floor(np.cumsum(likely[order]) + random.random() + 1e-9)
    return np.sort(order[np.diff(ends, prepend=0) > 0])
