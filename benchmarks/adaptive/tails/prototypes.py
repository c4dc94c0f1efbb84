"""Estimators with something against heavy tails, as prototypes beside `PathGradient`: all wrap sessions of the port, or another estimator.

Clipping here keeps what it cuts off: that goes into a store, of which each later step gets a share. In a stationary state the store's
expectation over the share is what is cut off, so that the bias vanishes; while parameters move, it lags by some steps.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.internals import Estimator, ImageEstimator, Key, Tree, WholeView, arrays, prepare

RELEASE = 0.125
"""Share of the store that a step gets."""
_MEAN, _LIMIT = 0.1, 0.1
"""Weights of a step's image and quantile in the running ones."""


@dataclass(frozen=True)
class _View:
    """Of a view, from earlier steps: running image, quantile, and store."""

    mean: np.ndarray
    limit: float
    store: np.ndarray


@dataclass(frozen=True)
class _State:
    image: Any
    views: tuple[_View | None, ...]


def cut(values: np.ndarray, limit: float | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values within ±limit, and what was cut off."""
    inside = np.clip(values, -limit, limit)
    return inside, values - inside


def share(store: np.ndarray, cut_off: np.ndarray, release: float) -> tuple[np.ndarray, np.ndarray]:
    """What a step gets of the store, and the next store."""
    return release * store, (1 - release) * store + cut_off


@dataclass(frozen=True)
class _OfGroups:
    """Leave-one-out groups, with something done to images, weights or groups.

    Args:
        spp: samples per pixel, as many groups up to 16.
        image: estimates the image.
    """

    spp: int = 4
    image: ImageEstimator = field(default_factory=ur.images.Plain)

    @property
    def provides(self) -> Any:
        """A gradient."""
        return ur.PathGradient().provides

    def init(self, problem: ur.Problem, parameters: Tree) -> Any:
        """No view was seen."""
        return _State(self.image.init(problem, parameters), (None,) * len(problem.views))

    def estimate(self, problem: ur.Problem, parameters: Tree, state: Any, key: Key) -> Any:
        """See `Estimator.estimate`."""
        session, groups = prepare(problem, parameters), ur.PathGradient(spp=self.spp).groups
        gradient: dict[str, Any] = {}
        views, contributions, loss = [], [], 0.0
        for index, known in enumerate(state.views):
            frame = WholeView(problem, index)
            found, contribution = self.image.estimate(
                problem, parameters, state.image, frame, self.spp, groups, key.fold(index)
            )
            images, others = (arrays.numpy(x).astype(np.float64) for x in (found.images, found.others()))

            def derivative(seen: np.ndarray, index: int = index, like: Any = found.images) -> np.ndarray:
                return arrays.numpy(problem.loss_derivative(index, arrays.like(np.asarray(seen, np.float32), like)))

            def adjoint(weights: np.ndarray, found: Any = found) -> Tree:
                return session.adjoint(
                    parameters, found.paths, arrays.like(np.asarray(weights, np.float32), found.images)
                )

            weights, kept = self.weights(images, others, derivative, known)
            for name, part in self.combined(adjoint, weights).items():
                gradient[name] = part + gradient[name] if name in gradient else part
            views.append(kept)
            contributions.append(contribution)
            loss += arrays.number(frame.loss_value(found.mean()))
        image = self.image.advance(parameters, state.image, tuple(contributions))
        arrays.evaluate(gradient, image)
        return ur.Estimate(loss, gradient, info={"samples": self.spp * problem.pixels}), _State(image, tuple(views))

    def weights(
        self, images: np.ndarray, others: np.ndarray, derivative: Callable[..., np.ndarray], known: _View | None
    ) -> tuple[np.ndarray, _View | None]:
        """Of the adjoint (groups, H, W, 3), and what the next step knows."""
        del images
        return derivative(others), known

    def combined(self, adjoint: Callable[[np.ndarray], Tree], weights: np.ndarray) -> Tree:
        """The gradient of a view."""
        return adjoint(weights)


@dataclass(frozen=True)
class ClippedImages(_OfGroups):
    """Deviations of the images that the loss derivative sees from a running image, clipped at a running quantile over pixels.

    Args:
        quantile: of the deviations' absolute values.
        release: share of the store that a step gets.
    """

    quantile: float = 0.98
    release: float = RELEASE

    def weights(self, images: np.ndarray, others: np.ndarray, derivative: Any, known: _View | None) -> Any:
        """See `_OfGroups`."""
        now = images.mean(axis=0)
        if known is None:
            return derivative(others), _View(
                now, float(np.quantile(np.abs(others - now), self.quantile)), np.zeros_like(now)
            )
        deviation = others - known.mean
        inside, cut_off = cut(deviation, known.limit)
        released, store = share(known.store, cut_off.mean(axis=0), self.release)
        mean = known.mean + _MEAN * (now - known.mean)
        limit = known.limit + _LIMIT * (float(np.quantile(np.abs(deviation), self.quantile)) - known.limit)
        return derivative(known.mean + inside + released), _View(mean, limit, store)


@dataclass(frozen=True)
class ClippedWeights(_OfGroups):
    """The loss derivative that weights the adjoint, clipped at a running quantile over pixels.

    Args:
        quantile: of the absolute values.
        release: share of the store that a step gets.
    """

    quantile: float = 0.98
    release: float = RELEASE

    def weights(self, images: np.ndarray, others: np.ndarray, derivative: Any, known: _View | None) -> Any:
        """See `_OfGroups`."""
        weights = derivative(others).astype(np.float64)
        now = float(np.quantile(np.abs(weights), self.quantile))
        if known is None:
            nothing = np.zeros(weights.shape[1:])
            return weights, _View(nothing, now, nothing)
        inside, cut_off = cut(weights, known.limit)
        released, store = share(known.store, cut_off.mean(axis=0), self.release)
        return inside + released, _View(known.mean, known.limit + _LIMIT * (now - known.limit), store)


@dataclass(frozen=True)
class MedianOfMeans(_OfGroups):
    """The median over blocks of groups of their gradients, element by element. Biased where gradients are skewed; one adjoint a block.

    Args:
        blocks: at most; the groups are divided into as many.
    """

    blocks: int = 4

    def combined(self, adjoint: Callable[[np.ndarray], Tree], weights: np.ndarray) -> Tree:
        """See `_OfGroups`."""
        groups = len(weights)
        blocks = min(self.blocks, groups)
        parts = []
        for block in np.array_split(np.arange(groups), blocks):
            chosen = np.zeros((groups, 1, 1, 1))
            chosen[block] = groups / len(block)
            parts.append(adjoint(weights * chosen))
        return {
            name: arrays.like(np.median([arrays.numpy(part[name]) for part in parts], axis=0).astype(np.float32), like)
            for name, like in parts[0].items()
        }


@dataclass(frozen=True)
class _Clipping:
    inner: Any
    square: dict[str, np.ndarray]
    store: dict[str, np.ndarray]
    step: int = 0


@dataclass(frozen=True)
class ClippedGradient:
    """Another estimator's gradient, each element clipped at some times its running root mean square.

    Args:
        inner: estimates it.
        times: the root mean square.
        release: share of the store that a step gets; 0: what is cut off is dropped, and the bias stays.
    """

    inner: Estimator = field(default_factory=ur.PathGradient)
    times: float = 2.0
    release: float = RELEASE

    @property
    def provides(self) -> Any:
        """A gradient."""
        return ur.PathGradient().provides

    def init(self, problem: ur.Problem, parameters: Tree) -> _Clipping:
        """Nothing was seen."""
        nothing = {name: np.zeros(arrays.shape(value)) for name, value in parameters.items()}
        return _Clipping(self.inner.init(problem, parameters), nothing, nothing)

    def estimate(self, problem: ur.Problem, parameters: Tree, state: _Clipping, key: Key) -> Any:
        """See `Estimator.estimate`."""
        found, inner = self.inner.estimate(problem, parameters, state.inner, key)
        gradient, square, store = {}, {}, {}
        for name, value in found.gradient.items():
            now = arrays.numpy(value).astype(np.float64)
            weight = max(0.05, 1 / (state.step + 1))
            if state.step < 4:
                inside, store[name] = now, state.store[name]
                result = now
            else:
                inside, cut_off = cut(now, self.times * np.sqrt(state.square[name]))
                released, store[name] = share(state.store[name], cut_off, self.release)
                result = inside + released
            square[name] = (1 - weight) * state.square[name] + weight * inside**2
            gradient[name] = arrays.like(np.asarray(result, np.float32), value)
        estimate = ur.Estimate(found.loss, gradient, info={"samples": found.info["samples"]})
        return estimate, _Clipping(inner, square, store, state.step + 1)


@dataclass(frozen=True)
class Recorded:
    """An estimator whose estimates are kept by key, for several that wrap it; only for equal parameters and equal chains of keys.

    Args:
        inner: estimates.
        tape: what it estimated, and the state after.
    """

    inner: Estimator
    tape: dict[Key, Any] = field(default_factory=dict)

    @property
    def provides(self) -> Any:
        """See `Estimator.provides`."""
        return self.inner.provides

    def init(self, problem: ur.Problem, parameters: Tree) -> Any:
        """See `Estimator.init`."""
        return self.inner.init(problem, parameters)

    def estimate(self, problem: ur.Problem, parameters: Tree, state: Any, key: Key) -> Any:
        """See `Estimator.estimate`."""
        if key not in self.tape:
            self.tape[key] = self.inner.estimate(problem, parameters, state, key)
        return self.tape[key]
