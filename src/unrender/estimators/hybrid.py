"""Path gradients of most parameters, and smoothed derivatives, from perturbed renders, of those that these do not reach."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from unrender.core import arrays, checks, trees
from unrender.core.errors import InputError
from unrender.core.random import Key
from unrender.core.registry import register
from unrender.core.suggestions import did_you_mean
from unrender.core.trees import Tree
from unrender.estimators.base import Estimate, Estimator
from unrender.estimators.capabilities import BlockEstimate, Capabilities, Capability, FreshGradient, Gradient, Variance
from unrender.estimators.coordinates import by_coordinates, restricted
from unrender.estimators.gauss_newton import GaussNewton, GaussNewtonState
from unrender.estimators.path import PathGradient
from unrender.estimators.smoothed import SmoothedDerivatives, SmoothedState
from unrender.rendering.partial import HeldParameters, PartialDerivatives
from unrender.rendering.renderer import ParameterInfo, Renderer
from unrender.scene.problem import Problem
from unrender.scene.upsampling import SQUARES, Upsampler, restarted, upsampled

_PERTURBED = 1 << 33
"""The stream of a step's key that draws the perturbed renders; path gradients have those below."""

_MEAN, _SQUARE = 0.9, 0.999
"""Decays of the running means of the gradient by the second parameters and of its square: Adam's."""


def beyond_paths(known: Mapping[str, ParameterInfo], keys: Sequence[str]) -> tuple[str, ...]:
    """Those of the keys that path gradients do not serve: without a path gradient, or poses, whose loss has plateaus.

    Args:
        known: of `Renderer.parameters`.
        keys: in any order.
    """
    return tuple(key for key in keys if known[key].rigid or not known[key].differentiable)


@dataclass(frozen=True)
class HybridState:
    """State between steps: of both estimators.

    Attributes:
        path: of the path gradients.
        perturbed: of the second estimator.
        mean, square: running means of the gradient by the second parameters, and of its square, not debiased; {} where it is not
            `averaged`.
        step: estimates made so far, since these began.
    """

    path: Any
    perturbed: SmoothedState | GaussNewtonState
    mean: Tree = field(default_factory=dict)
    square: Tree = field(default_factory=dict)
    step: int = 0

    def upsampled(self, upsampler: Upsampler) -> HybridState:
        """See `Upsamplable`."""
        return replace(
            self,
            path=upsampled(self.path, upsampler),
            perturbed=upsampled(self.perturbed, upsampler),
            mean=upsampler.tree(self.mean, 1.0),
            square=upsampler.tree(self.square, SQUARES),
        )

    def restarted(self, fresh: HybridState) -> HybridState:
        """See `Restartable`."""
        return replace(
            fresh, path=restarted(self.path, fresh.path), perturbed=restarted(self.perturbed, fresh.perturbed)
        )


@register
@dataclass(frozen=True)
class HybridGradient:
    """Two gradients in one: by path replay for the parameters that it suits, and smoothed ones for the others alone.

    The others are poses, whose loss has plateaus and edges, and whatever has no path gradient. Each step renders the scene at its present
    parameters for the first, with all that `path` has: control variates, memories of gradients, mini-batches of pixels; and, with the
    first kept as they are, at perturbed values of the second for `perturbed`. Perturbations of a few numbers take a few renders, whatever
    the number of texels beside them.

    The gradient by the first is exactly that of `path` at these values of the second, from the same random numbers. Where two states
    share samples, the previous one is rendered with its own values of the second; as paths of one pose are not valid in another, that
    takes space="primary" where poses are among them. The gradient by the second is that of `perturbed`: of the loss smoothed over these
    alone. So each has the bias that its estimator states, and no more: the two gradients are of one loss, but of a smoothed one for the
    second, whose minimum moves to that of the loss itself as σ falls.

    Let `perturbed` be `debiased`: the noise of a few samples a pixel adds to the loss of each perturbed render, and less where the second
    parameters make for darker images; the first, which do not see that, would follow the second away.

    With `GaussNewton` for `perturbed`, the second parameters are a block of their own (`BlockEstimate`): an optimizer such as
    `Partitioned(keys, AveragedNewton(), others)` solves it, and the gradient by them is 0 in steps in which they stay. Then `wait` and
    `every` say in which steps they move. While textures are far off, the pictures say little about poses beside them.

    The two kinds of steps have no common scale: give the second learning rates of their own.

    Provides a gradient, and its variance where `path` does: for the second parameters the mean square, variance plus squared
    gradient, which is what a meta-estimate has of as many samples. By the variance alone, which is small where perturbations agree,
    `MetaAdam` would take steps longer than its learning rate. The loss is that of `path`.

    Args:
        path: an estimator of path gradients: `PathGradient`, `MetaEstimator`, or `FilteredGradient` of one.
        perturbed: of order "gradient", its `sigma` for the second parameters alone; or `GaussNewton`.
        keys: the second parameters; None for all poses, and all that have no path gradient.
        averaged: for `MetaAdam`, which has no momentum: the gradient by the second parameters is the running mean of about ten steps, and
            its variance that of the squares, both debiased, so its steps there are Adam's. Differences of the smoothed
            loss between two steps are not rendered, so the mean lags behind. Optimizers that average by themselves, or grow their
            rates while gradients agree, should have it False. Needs a variance of `path`.
        wait: steps before the first in which a block moves, >= 0. For `GaussNewton` alone.
        every: the second parameters of a block move in each so many-th step, >= 1. For `GaussNewton` alone.
    """

    path: Estimator = field(default_factory=PathGradient)
    perturbed: SmoothedDerivatives | GaussNewton = field(
        default_factory=lambda: SmoothedDerivatives(0.2, samples=16, spp=2, debiased=True)
    )
    keys: tuple[str, ...] | None = None
    averaged: bool = False
    wait: int = 0
    every: int = 1

    def __post_init__(self):
        if isinstance(self.path, type) or not hasattr(self.path, "provides"):
            raise InputError(
                f"HybridGradient: path must be an estimator, such as PathGradient(), got {self.path!r:.80}"
            )
        if isinstance(self.path, (SmoothedDerivatives, HybridGradient)) or Gradient.name not in self.path.provides:
            raise InputError(
                f"HybridGradient: path must be an estimator of path gradients, such as PathGradient(), got "
                f"{type(self.path).__name__}"
            )
        checks.integer("HybridGradient", "wait", self.wait, at_least=0)
        checks.integer("HybridGradient", "every", self.every, at_least=1)
        if self._is_block and self.averaged:
            raise InputError("HybridGradient: averaged goes with SmoothedDerivatives, not with GaussNewton")
        if not self._is_block and (self.wait or self.every > 1):
            raise InputError("HybridGradient: wait and every go with GaussNewton, not with SmoothedDerivatives")
        if not self._is_block and (
            not isinstance(self.perturbed, SmoothedDerivatives) or self.perturbed.order != "gradient"
        ):
            raise InputError(
                'HybridGradient: perturbed must be GaussNewton, or SmoothedDerivatives with order="gradient", since path gradients have no '
                f"curvature, got {self.perturbed!r:.80}"
            )
        if self.averaged and Variance.name not in self.path.provides:
            raise InputError(
                f"HybridGradient: averaged needs a path that provides a variance, such as MetaEstimator(), got {type(self.path).__name__}"
            )
        if self.keys is not None:
            if isinstance(self.keys, str) or not all(isinstance(key, str) for key in self.keys):
                raise InputError(f"HybridGradient: keys must be a list of parameters' keys, got {self.keys!r:.80}")
            object.__setattr__(self, "keys", tuple(self.keys))

    @property
    def provides(self) -> Capabilities:
        """A gradient, and its variance where both have one; with `GaussNewton`, a block."""
        if self._is_block:
            return Capabilities(Gradient, BlockEstimate)
        return Capabilities(Gradient, Variance) if Variance.name in self.path.provides else Capabilities(Gradient)

    def init(self, problem: Problem, parameters: Tree) -> HybridState:
        """See `Estimator.init`. Raises `InputError` where one of the two estimators would have no parameter, or refuses its own."""
        own = self._perturbed(problem.renderer, parameters)
        path, perturbed = self._problems(problem, parameters, own)
        part = {key: parameters[key] for key in own}
        nothing = trees.zeros_like(part) if self.averaged else {}
        return HybridState(self.path.init(path, parameters), self.perturbed.init(perturbed, part), nothing, nothing)

    def estimate(
        self, problem: Problem, parameters: Tree, state: HybridState, key: Key
    ) -> tuple[Estimate, HybridState]:
        """See `Estimator.estimate`. `info`: that of `path`, with "samples" of both, and "perturbed_loss", at the parameters, of the
        perturbed renders' noise."""
        own = self._perturbed(problem.renderer, parameters)
        path, perturbed = self._problems(problem, parameters, own)
        found, path_state = self.path.estimate(path, parameters, state.path, key)
        part = {name: parameters[name] for name in own}
        own_key = key.fold(_PERTURBED)
        if self._is_block:
            moved, perturbed_state, samples = self._block(perturbed, part, state, own_key)
        else:
            moved, perturbed_state = self.perturbed.estimate(perturbed, part, state.perturbed, own_key)  # pyright: ignore[reportArgumentType]
            samples = int(moved.info.get("samples", 0))
        if found.preconditioned or moved.preconditioned:
            found, moved = (
                by_coordinates(found, problem, parameters),
                by_coordinates(moved, restricted(problem, own), part),
            )
        moments = replace(state, step=state.step + 1) if self._is_block else state
        if self.averaged:
            moved, moments = _averaged(moved, state)
        elif Variance.name in self.provides:
            moved = replace(moved, capabilities=(Variance(_mean_square(moved)),))
        gradient = {name: moved.gradient[name] if name in own else g for name, g in found.gradient.items()}
        info = {
            **found.info,
            "samples": int(found.info.get("samples", 0)) + samples,
            "perturbed_loss": moved.loss,
        }
        whole = replace(found, gradient=gradient, capabilities=_merged(found, moved, own), info=info)
        arrays.evaluate(moments.mean, moments.square)
        return whole, replace(moments, path=path_state, perturbed=perturbed_state)

    @property
    def _is_block(self) -> bool:
        return isinstance(self.perturbed, GaussNewton)

    def _block(
        self, problem: Problem, part: Tree, state: HybridState, key: Key
    ) -> tuple[Estimate, GaussNewtonState | SmoothedState, int]:
        """Return the estimate with a block, the state, and the paths traced. The first step is estimated for its kernels, at least."""
        still = Estimate(0.0, trees.zeros_like(part), (BlockEstimate(tuple(part), None),))
        moves = state.step >= self.wait and (state.step - self.wait) % self.every == 0
        if not moves and state.step:
            return still, state.perturbed, 0
        found, after = self.perturbed.estimate(problem, part, state.perturbed, key)  # pyright: ignore[reportArgumentType]
        samples = int(found.info.get("samples", 0))
        if not moves:
            return still, state.perturbed, samples
        return replace(found, capabilities=(BlockEstimate(tuple(part), found),)), after, samples

    def _problems(self, problem: Problem, parameters: Tree, own: Sequence[str]) -> tuple[Problem, Problem]:
        """As each of the two estimators sees it."""
        held = {key: x for key, x in parameters.items() if key not in own}
        return (
            problem.with_parts(renderer=PartialDerivatives(problem.renderer, frozenset(own))),
            problem.with_parts(renderer=HeldParameters(problem.renderer, held)),
        )

    def _perturbed(self, renderer: Renderer, parameters: Tree) -> tuple[str, ...]:
        """The second parameters, in the order of all."""
        if self.keys is None:
            own = beyond_paths(renderer.parameters(), list(parameters))
            if not own:
                raise InputError(
                    "HybridGradient: path gradients reach all parameters; name those to be perturbed (keys; of method hybrid, perturbed), "
                    "or use PathGradient"
                )
        else:
            for key in self.keys:
                if key not in parameters:
                    hint = did_you_mean(key, parameters)
                    raise InputError(f"HybridGradient: keys names {key}, which is none of the parameters{hint}")
            own = tuple(key for key in parameters if key in self.keys)
            if not own:
                raise InputError("HybridGradient: keys must name at least one parameter; without any, use PathGradient")
        if len(own) == len(parameters):
            raise InputError(
                "HybridGradient: all parameters are perturbed, none is left to path gradients; use SmoothedDerivatives"
            )
        return own


def _averaged(perturbed: Estimate, state: HybridState) -> tuple[Estimate, HybridState]:
    """The debiased running mean of the gradient, with its debiased mean square for variance; the state with both."""
    step = state.step + 1
    mean = trees.map(lambda m, g: _MEAN * m + (1.0 - _MEAN) * g, state.mean, perturbed.gradient)
    square = trees.map(lambda v, g: _SQUARE * v + (1.0 - _SQUARE) * (g * g), state.square, perturbed.gradient)
    gradient = {key: x * arrays.scalar(1.0 / (1.0 - _MEAN**step), x) for key, x in mean.items()}
    variance = {key: x * arrays.scalar(1.0 / (1.0 - _SQUARE**step), x) for key, x in square.items()}
    found = replace(perturbed, gradient=gradient, capabilities=(Variance(variance),))
    return found, replace(state, mean=mean, square=square, step=step)


def _mean_square(perturbed: Estimate) -> Tree:
    """Variance plus squared gradient."""
    variance = perturbed.require("HybridGradient", Variance).values
    return trees.map(lambda v, g: v + g * g, variance, perturbed.gradient)


def _merged(path: Estimate, perturbed: Estimate, own: Sequence[str]) -> tuple[Capability, ...]:
    """What both tell: the variance of both, and the fresh gradient, which the perturbed one always is."""
    found: list[Capability] = []
    for capability in path.capabilities:
        match capability:
            case Variance(values):
                other = perturbed.require("HybridGradient", Variance).values
                found.append(Variance({key: other[key] if key in own else v for key, v in values.items()}))
            case FreshGradient(values):
                fresh = {key: perturbed.gradient[key] if key in own else g for key, g in values.items()}
                found.append(FreshGradient(fresh))
            case _:
                pass
    return (*found, *(block for block in perturbed.capabilities if isinstance(block, BlockEstimate)))
