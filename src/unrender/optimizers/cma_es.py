"""CMA-ES (Hansen and Ostermeier 1996), a derivative-free search on the `cma` package: the baseline of methods without derivatives."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from unrender.core import checks, trees
from unrender.core.checks import Positive, Seed
from unrender.core.errors import InputError
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import Capabilities, LossFunction
from unrender.optimizers.base import check_rates, rates_of

_TOLERANCE = 0.01
"""Distance between parameters and mean, in standard deviations, below which they count as equal."""


@dataclass(frozen=True)
class CMAESState:
    """State between steps: the ranks of all generations, from which the search is reproduced with its seed.

    The first step after a checkpoint repeats the arithmetic of all generations without evaluating losses, and then continues as if
    uninterrupted.

    Attributes:
        learning_rates: learning rate of each parameter, its scale.
        start: first mean in the scaled coordinates u, (n,).
        ranks: (generations, population) integers: rank of each point in its generation, from 0 for the smallest loss; equal losses have
            equal ranks.
        held: generations before which bounds moved the parameters away from the mean, (k,).
        held_at: the parameters at those generations, in u, (k, n).
    """

    learning_rates: dict[str, float]
    start: np.ndarray
    ranks: np.ndarray
    held: np.ndarray
    held_at: np.ndarray

    # Cache of the search at this state, not a field: it moves to the next state, and is rebuilt from the ranks if it is missing.
    _search: ClassVar[_Search | None] = None


@register
@dataclass(frozen=True)
class CMAES:
    """One generation of CMA-ES per step.

    Points are sampled from a Gaussian around the mean, and mean and covariance move towards the points with lower losses. The step ends
    at the new mean. The search is invariant to monotonic functions of the loss. All points of a generation share random numbers, which
    change with each generation. Losses that are not finite rank last. If all losses of a generation are equal, as on a plateau, there is
    no step and no update; the next generation samples other points.

    Scales: the search uses u = x / η with each parameter's learning rate η. Its first standard deviation is `sigma0` η, the same in all
    directions of u.

    Bounds: the caller projects the parameters onto them. If the parameters differ from the mean, the search adopts them as its mean, and
    clips later points to that bound. (Beyond a bound the loss is that of the bound. Unclipped points would let the mean drift, or the
    deviations explode, in directions without influence on the loss. `cma`'s own bound handling performed much worse on a quadratic with a
    few bounds.) So only steps and bounds may change the parameters during a search.

    Takes O(n²) time per point and O(n²) memory, plus O(n³) every few generations; O(n) with `diagonal`. The state grows by `population`
    numbers per generation, and by n per bound.

    Args:
        sigma0: first standard deviation, in units of η, > 0: about a third of the expected distance to the optimum.
        population: λ, points per generation, >= 4; None for 4 + ⌊3 log n⌋. Noise needs more.
        seed: seed of the sampled points, >= 0.
        diagonal: whether only variances are adapted, not covariances; for more than a few hundred parameters.
        learning_rate: η, in units of the parameter, > 0, for the parameters without their own; or {key: η, "*": η of the others}.
    """

    sigma0: Positive = 0.3
    population: int | None = None
    seed: Seed = 0
    diagonal: bool = False
    learning_rate: float | Mapping[str, float] = 1.0

    def __post_init__(self):
        check_rates("CMAES", self.learning_rate, None)
        if self.population is not None:
            checks.integer("CMAES", "population", self.population, at_least=4)
        checks.fields(self)

    requires = Capabilities(LossFunction)

    def init(self, parameters: Tree, learning_rates: Mapping[str, float] | None = None) -> CMAESState:
        own = rates_of("CMAES", parameters, self.learning_rate, learning_rates)
        start = trees.ravel(parameters) / trees.repeat_per_element(own, parameters)
        population = self.population or 4 + math.floor(3 * math.log(start.size))
        ranks, held = np.zeros((0, population), np.int32), np.zeros(0, np.int32)
        return CMAESState(own, start, ranks, held, np.zeros((0, start.size)))

    def update(self, estimate: Estimate, state: CMAESState, parameters: Tree) -> tuple[Tree, CMAESState]:
        """Return the step of one generation and the next state. On the host. Raises `InputError` unless there is one loss per point."""
        evaluate = estimate.require("CMAES", LossFunction).evaluate
        search = state._search or self._replay(state)
        object.__setattr__(state, "_search", None)  # the search advances to the next state
        scale = trees.repeat_per_element(state.learning_rates, parameters)
        here, generation = trees.ravel(parameters) / scale, len(state.ranks)
        if search.differs(here):
            search.bound_at(here)
            held = np.append(state.held, np.int32(generation))
            state = replace(state, held=held, held_at=np.concatenate([state.held_at, here[None]]))
        points = search.draw(self._random(generation))
        losses = np.asarray(evaluate(points * scale), np.float64)
        if losses.shape != (len(points),):
            raise InputError(f"CMAES: losses must have shape ({len(points)},), one per point, got {losses.shape}")
        known = np.where(np.isfinite(losses), losses, np.inf)
        ranks = np.unique(known, return_inverse=True)[1].astype(np.int32)  # equal losses have equal ranks
        search.update(ranks)
        state = replace(state, ranks=np.concatenate([state.ranks, ranks[None]]))
        object.__setattr__(state, "_search", search)
        step = scale * (search.mean - here) if ranks.any() else np.zeros_like(here)
        return trees.unravel(step, parameters), state

    def _replay(self, state: CMAESState) -> _Search:
        """Rebuild the search at a state from its ranks."""
        search = _Search(state.start, self.sigma0, state.ranks.shape[1], self.diagonal)
        held = dict(zip(state.held.tolist(), state.held_at, strict=True))
        for generation, ranks in enumerate(state.ranks):
            if generation in held:
                search.bound_at(held[generation])
            search.draw(self._random(generation))
            search.update(ranks)
        return search

    def _random(self, generation: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, generation])


class _Search:
    """`cma.CMAEvolutionStrategy` without output, with an explicit random generator."""

    def __init__(self, start: np.ndarray, sigma0: float, population: int, diagonal: bool):
        self._least, self._most = np.full(start.size, -math.inf), np.full(start.size, math.inf)
        self._random = np.random.default_rng(0)
        self._points = np.zeros((0, start.size))
        with _quiet():
            import cma  # imported here because it takes a second

            options = {
                "popsize": population,
                "CMA_diagonal": diagonal,
                # Badly conditioned covariances are rescaled per coordinate, but never by a change of coordinates.
                "conditioncov_alleviate": [1e8, math.inf],
                "randn": lambda *shape: self._random.standard_normal(shape),
                "seed": math.nan,  # does not seed NumPy's global generator
                "verbose": -10,
                "verb_disp": 0,
                "verb_log": 0,
            }
            self._strategy: Any = cma.CMAEvolutionStrategy(start, sigma0, options)

    @property
    def mean(self) -> np.ndarray:
        return np.array(self._strategy.mean)

    def differs(self, here: np.ndarray) -> bool:
        return bool(np.any(np.abs(here - self._strategy.mean) > self._tolerance()))

    def bound_at(self, here: np.ndarray) -> None:
        """Make `here` (n,) the mean, and a bound in each dimension where it differs from the previous mean."""
        mean, near = self._strategy.mean, self._tolerance()
        self._least = np.where(here > mean + near, here, self._least)
        self._most = np.where(here < mean - near, here, self._most)
        self._strategy.mean = here.copy()

    def draw(self, random: np.random.Generator) -> np.ndarray:
        """Return the next generation, (population, n), or other points of this one if all of its ranks were equal."""
        self._random, strategy = random, self._strategy
        with _quiet():
            # The first two may be a mirrored pair along the last step, which is sampled only once.
            if len(self._points):
                points = [*self._points[:2], *(strategy.ask(1)[0] for _ in self._points[2:])]
            else:
                points = strategy.ask()
        strategy.sent_solutions.clear()  # an archive of the points, needed only if they are passed back in other coordinates
        self._points = np.clip(points, self._least, self._most)
        return self._points

    def update(self, ranks: np.ndarray) -> None:
        if ranks.any():
            with _quiet():
                self._strategy.tell(list(self._points), ranks.astype(np.float64).tolist(), check_points=False)
            self._points = self._points[:0]

    def _tolerance(self) -> np.ndarray:
        return _TOLERANCE * self._strategy.stds


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress the warnings of the `cma` package, and its changes to the warning filters."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield
