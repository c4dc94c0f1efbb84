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
from unrender.estimators.base import LOSSES, Estimate
from unrender.optimizers import rates

_NEAR = 0.01
"""How far parameters may be from the search's mean, in its standard deviations, and still count as there."""


@dataclass(frozen=True)
class CMAESState:
    """State between steps: what the search was told, which with its seed is all that it ever knew.

    A state that was read back searches on as if it had never been away, after its generations have been told again (no loss is
    evaluated for that, but all of the search's own arithmetic is repeated).

    Attributes:
        learning_rates: of each parameter: its scale.
        start: (n,), the first mean, in the scaled coordinates u.
        ranks: (generations, population) whole numbers: each point's place in its generation, from 0, the least loss; equal losses share
            a place.
        held: (k,), the generations before which the parameters turned out to be held back from the mean.
        held_at: (k, n), where, in u.
    """

    learning_rates: dict[str, float]
    start: np.ndarray
    ranks: np.ndarray
    held: np.ndarray
    held_at: np.ndarray

    # The live search of this very state: no field, but a cache, which goes on to the next state and is built again where it is missing.
    _search: ClassVar[_Search | None] = None


@register
@dataclass(frozen=True)
class CMAES:
    """One generation of CMA-ES a step: points around a mean are drawn from a Gaussian, their losses ranked, and mean and covariance moved
    towards the better ones. The step goes to the new mean.

    Invariant to any monotonic function of the loss. Every point of a generation is evaluated with the same random numbers, other ones in
    the next generation. Losses that are not finite rank last. A generation whose losses are all equal, on a plateau or where none is
    finite, teaches nothing: there is no step, and the next one draws others.

    Scales: the search is for u = x / η with each parameter's learning rate η; its first standard deviation is `sigma0` η, the same in all
    directions of u.

    Bounds are the caller's, who holds the parameters back where a step would leave them. The search takes notice: where the parameters turn
    out to be short of its mean it goes on from there, and from then on moves the points it draws beyond to that place. (Their losses are
    those at the bound anyway, and left there they would make the mean drift, or the deviations explode, in directions that no loss
    depends on. `cma`'s own handling of bounds did much worse on a quadratic with a few of them.) So nothing but steps and bounds may
    move the parameters during a search.

    Costs O(n²) time a point and O(n²) memory, and O(n³) every few generations; O(n) with `diagonal`. The state grows by `population`
    numbers a generation, and by n each time a bound is found.

    Args:
        sigma0: the first standard deviation, in units of η, > 0: about a third of the distance to where the optimum may be.
        population: λ, points a generation, >= 4; None for 4 + ⌊3 log n⌋. More suits noise.
        seed: of the points drawn, >= 0.
        diagonal: learn the variances of the parameters alone, not their covariance: for more than some hundred.
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
    def requires(self) -> frozenset[str]:
        """The loss at points of its own."""
        return frozenset({LOSSES})

    def init(self, parameters: Tree, learning_rates: Mapping[str, float] | None = None) -> CMAESState:
        """See `Optimizer.init`."""
        own = rates.per_parameter("CMAES", parameters, self.learning_rate, learning_rates)
        start = vectors.ravel(parameters) / vectors.spread(own, parameters)
        population = self.population or 4 + math.floor(3 * math.log(start.size))
        ranks, held = np.zeros((0, population), np.int32), np.zeros(0, np.int32)
        return CMAESState(own, start, ranks, held, np.zeros((0, start.size)))

    def update(self, estimate: Estimate, state: CMAESState, parameters: Tree) -> tuple[Tree, CMAESState]:
        """See `Optimizer.update`. On the host. Raises `InputError` for losses of another shape than one per point."""
        assert estimate.losses is not None
        search = state._search or self._again(state)
        object.__setattr__(state, "_search", None)  # whatever comes now, it is no longer this state's
        scale = vectors.spread(state.learning_rates, parameters)
        here, generation = vectors.ravel(parameters) / scale, len(state.ranks)
        if search.is_elsewhere(here):
            search.hold(here)
            held = np.append(state.held, np.int32(generation))
            state = replace(state, held=held, held_at=np.concatenate([state.held_at, here[None]]))
        points = search.draw(self._random(generation))
        losses = np.asarray(estimate.losses(points * scale), np.float64)
        if losses.shape != (len(points),):
            raise InputError(f"CMAES: losses must have shape ({len(points)},), one per point, got {losses.shape}")
        ranks = _ranks(losses)
        search.learn(ranks)
        state = replace(state, ranks=np.concatenate([state.ranks, ranks[None]]))
        object.__setattr__(state, "_search", search)
        step = scale * (search.mean - here) if ranks.any() else np.zeros_like(here)
        return vectors.unravel(step, parameters), state

    def _again(self, state: CMAESState) -> _Search:
        """The search of a state that has none: it is told everything once more."""
        search = _Search(state.start, self.sigma0, state.ranks.shape[1], self.diagonal)
        held = dict(zip(state.held.tolist(), state.held_at, strict=True))
        for generation, ranks in enumerate(state.ranks):
            if generation in held:
                search.hold(held[generation])
            search.draw(self._random(generation))
            search.learn(ranks)
        return search

    def _random(self, generation: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, generation])


def _ranks(losses: np.ndarray) -> np.ndarray:
    """Places from 0, the least; equal losses share one, and all that are not finite the last."""
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

    def is_elsewhere(self, here: np.ndarray) -> bool:
        """Whether `here` (n,) is not the mean."""
        return bool(np.any(np.abs(here - self._strategy.mean) > self._near()))

    def hold(self, here: np.ndarray) -> None:
        """Make `here` the mean, and a bound wherever it is short of the mean that was."""
        mean, near = self._strategy.mean, self._near()
        self._least = np.where(here > mean + near, here, self._least)
        self._most = np.where(here < mean - near, here, self._most)
        self._strategy.mean = here.copy()

    def draw(self, random: np.random.Generator) -> np.ndarray:
        """(population, n): the next generation, or other points of this one if nothing was learnt from it."""
        self._random, strategy = random, self._strategy
        with _quiet():
            if len(self._points):  # its first two may be a mirrored pair along the last step, drawn only once
                drawn = [*self._points[:2], *(strategy.ask(1)[0] for _ in self._points[2:])]
            else:
                drawn = strategy.ask()
        strategy.sent_solutions.clear()  # an archive of what it drew, for when that is told in other coordinates
        self._points = np.clip(drawn, self._least, self._most)
        return self._points

    def learn(self, ranks: np.ndarray) -> None:
        """Tell the ranks of the points drawn last, (population,). If all are the same there is nothing to tell."""
        if ranks.any():
            with _quiet():
                self._strategy.tell(list(self._points), ranks.astype(np.float64).tolist(), check_points=False)
            self._points = self._points[:0]

    def _near(self) -> np.ndarray:
        return _NEAR * self._strategy.stds


@contextmanager
def _quiet() -> Iterator[None]:
    """Without warnings of the `cma` package, and without those it adds to the filters."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield
