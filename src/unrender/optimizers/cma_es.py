"""CMA-ES (Hansen and Ostermeier 1996), a search by losses alone: the baseline of methods without derivatives, on the `cma` package."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from unrender.core import checks, vectors
from unrender.core.errors import InputError
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import Capabilities, LossFunction
from unrender.optimizers import rates

_TOLERANCE = 0.01
"""Distance of the parameters from the mean, in standard deviations, up to which they count as equal."""


@dataclass(frozen=True)
class CMAESState:
    """State between steps: the ranks of all generations, from which the search is reproduced with its seed.

    The first step after a checkpoint is read repeats the arithmetic of all generations, without evaluating losses; the search then
    continues as if uninterrupted.

    Attributes:
        learning_rates: of each parameter: its scale.
        start: (n,), the first mean, in the scaled coordinates u.
        ranks: (generations, population) integers: each point's rank in its generation, from 0, the least loss; equal losses have equal
            ranks.
        held: (k,), the generations before which bounds kept the parameters from the mean.
        held_at: (k, n), the parameters there, in u.
    """

    learning_rates: dict[str, float]
    start: np.ndarray
    ranks: np.ndarray
    held: np.ndarray
    held_at: np.ndarray

    # A cache of the search at this state, not a field: it moves on to the next state, and is rebuilt from the ranks where it is missing.
    _search: ClassVar[_Search | None] = None


@register
@dataclass(frozen=True)
class CMAES:
    """One generation of CMA-ES a step: points are drawn from a Gaussian around a mean, their losses ranked, and mean and covariance moved
    towards the better ones. The step ends at the new mean.

    Invariant to any monotonic function of the loss. Every point of a generation is evaluated with the same random numbers, other ones in
    the next generation. Losses that are not finite rank last. A generation whose losses are all equal, on a plateau or where none is
    finite, makes no step and no update; the next one draws other points.

    Scales: the search is for u = x / η with each parameter's learning rate η; its first standard deviation is `sigma0` η, the same in all
    directions of u.

    Bounds are the caller's, who projects the parameters onto them. Where the parameters differ from the mean, the search takes them as its
    mean, and from then on clips the points that it draws to that bound. (Beyond it the loss is that of the bound, and unclipped points
    would make the mean drift, or the deviations explode, in directions that no loss depends on. `cma`'s own handling of bounds did much
    worse on a quadratic with a few of them.) So nothing but steps and bounds may move the parameters during a search.

    Costs O(n²) time a point and O(n²) memory, and O(n³) every few generations; O(n) with `diagonal`. The state grows by `population`
    numbers a generation, and by n each time a bound is found.

    Args:
        sigma0: the first standard deviation, in units of η, > 0: about a third of the distance to where the optimum may be.
        population: λ, points a generation, >= 4; None for 4 + ⌊3 log n⌋. More suits noise.
        seed: of the points drawn, >= 0.
        diagonal: adapt the variances of the parameters only, not their covariances: for more than some hundred.
        learning_rate: η, in units of the parameter, > 0; for the parameters without their own.
    """

    sigma0: float = 0.3
    population: int | None = None
    seed: int = 0
    diagonal: bool = False
    learning_rate: float = 1.0

    def __post_init__(self):
        rates.check("CMAES", self.learning_rate, None)
        checks.number("CMAES", "sigma0", self.sigma0, above=0.0)
        checks.integer("CMAES", "seed", self.seed, at_least=0)
        if self.population is not None:
            checks.integer("CMAES", "population", self.population, at_least=4)
        if not isinstance(self.diagonal, bool):
            raise InputError(f"CMAES: diagonal must be True or False, got {self.diagonal!r}")

    @property
    def requires(self) -> Capabilities:
        """The loss at points of its own."""
        return Capabilities(LossFunction)

    def init(self, parameters: Tree, learning_rates: Mapping[str, float] | None = None) -> CMAESState:
        own = rates.per_parameter("CMAES", parameters, self.learning_rate, learning_rates)
        start = vectors.ravel(parameters) / vectors.repeat_per_element(own, parameters)
        population = self.population or 4 + math.floor(3 * math.log(start.size))
        ranks, held = np.zeros((0, population), np.int32), np.zeros(0, np.int32)
        return CMAESState(own, start, ranks, held, np.zeros((0, start.size)))

    def update(self, estimate: Estimate, state: CMAESState, parameters: Tree) -> tuple[Tree, CMAESState]:
        """See `Optimizer.update`. On the host. Raises `InputError` for losses of another shape than one per point."""
        evaluate = estimate.require("CMAES", LossFunction).evaluate
        search = state._search or self._replay(state)
        object.__setattr__(state, "_search", None)  # it is about to change
        scale = vectors.repeat_per_element(state.learning_rates, parameters)
        here, generation = vectors.ravel(parameters) / scale, len(state.ranks)
        if search.differs(here):
            search.bound_at(here)
            held = np.append(state.held, np.int32(generation))
            state = replace(state, held=held, held_at=np.concatenate([state.held_at, here[None]]))
        points = search.draw(self._random(generation))
        losses = np.asarray(evaluate(points * scale), np.float64)
        if losses.shape != (len(points),):
            raise InputError(f"CMAES: losses must have shape ({len(points)},), one per point, got {losses.shape}")
        ranks = _ranks(losses)
        search.update(ranks)
        state = replace(state, ranks=np.concatenate([state.ranks, ranks[None]]))
        object.__setattr__(state, "_search", search)
        step = scale * (search.mean - here) if ranks.any() else np.zeros_like(here)
        return vectors.unravel(step, parameters), state

    def _replay(self, state: CMAESState) -> _Search:
        """The search at a state, from its ranks."""
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


def _ranks(losses: np.ndarray) -> np.ndarray:
    """Ranks from 0, the least; equal losses have equal ranks, and those that are not finite the last."""
    known = np.where(np.isfinite(losses), losses, np.inf)
    return np.unique(known, return_inverse=True)[1].astype(np.int32)


class _Search:
    """`cma.CMAEvolutionStrategy` that prints nothing, writes no file and draws from the generator it is given."""

    def __init__(self, start: np.ndarray, sigma0: float, population: int, diagonal: bool):
        self._least, self._most = np.full(start.size, -math.inf), np.full(start.size, math.inf)
        self._random = np.random.default_rng(0)
        self._points = np.zeros((0, start.size))
        with _quiet():
            import cma  # here, since it takes a second and few need it

            options = {
                "popsize": population,
                "CMA_diagonal": diagonal,
                # Badly conditioned covariances are rescaled per coordinate, but never by a change of coordinates.
                "conditioncov_alleviate": [1e8, math.inf],
                "randn": lambda *shape: self._random.standard_normal(shape),
                "seed": math.nan,  # not to seed NumPy's global generator
                "verbose": -10,
                "verb_disp": 0,
                "verb_log": 0,
            }
            self._strategy: Any = cma.CMAEvolutionStrategy(start, sigma0, options)

    @property
    def mean(self) -> np.ndarray:
        """(n,)."""
        return np.array(self._strategy.mean)

    def differs(self, here: np.ndarray) -> bool:
        """Whether `here` (n,) differs from the mean."""
        return bool(np.any(np.abs(here - self._strategy.mean) > self._tolerance()))

    def bound_at(self, here: np.ndarray) -> None:
        """Make `here` (n,) the mean, and a bound in each dimension where it differs from the earlier mean."""
        mean, near = self._strategy.mean, self._tolerance()
        self._least = np.where(here > mean + near, here, self._least)
        self._most = np.where(here < mean - near, here, self._most)
        self._strategy.mean = here.copy()

    def draw(self, random: np.random.Generator) -> np.ndarray:
        """(population, n): the next generation, or other points of this one if all of its ranks were equal."""
        self._random, strategy = random, self._strategy
        with _quiet():
            if len(self._points):  # its first two may be a mirrored pair along the last step, drawn only once
                drawn = [*self._points[:2], *(strategy.ask(1)[0] for _ in self._points[2:])]
            else:
                drawn = strategy.ask()
        strategy.sent_solutions.clear()  # an archive of what it drew, for when that is told in other coordinates
        self._points = np.clip(drawn, self._least, self._most)
        return self._points

    def update(self, ranks: np.ndarray) -> None:
        """Update by the ranks (population,) of the points drawn last; no update where all are equal."""
        if ranks.any():
            with _quiet():
                self._strategy.tell(list(self._points), ranks.astype(np.float64).tolist(), check_points=False)
            self._points = self._points[:0]

    def _tolerance(self) -> np.ndarray:
        return _TOLERANCE * self._strategy.stds


@contextmanager
def _quiet() -> Iterator[None]:
    """Without warnings of the `cma` package, and without those it adds to the filters."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield
