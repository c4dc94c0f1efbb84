"""Path gradients for most parameters, and smoothed derivatives from perturbed renders for the others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from unrender.core import arrays, checks, trees
from unrender.core.checks import Count, Index
from unrender.core.errors import InputError
from unrender.core.random import WARM_UP, Key
from unrender.core.registry import register
from unrender.core.text import did_you_mean, in_words
from unrender.core.trees import Tree
from unrender.estimators.base import Estimate, Estimator, pixel_weights
from unrender.estimators.capabilities import (
    BlockEstimate,
    Capabilities,
    Capability,
    DerivativeImages,
    FreshGradient,
    Gradient,
    GradientAtBounds,
    Variance,
)
from unrender.estimators.coordinates import bounded_with_preconditioner, by_coordinates, restricted
from unrender.estimators.gauss_newton import GaussNewton, GaussNewtonState
from unrender.estimators.path import PathGradient
from unrender.estimators.smoothed import SmoothedDerivatives, SmoothedState
from unrender.estimators.variable_projection import Response, can_be_eliminated, update_response
from unrender.rendering.partial import EliminatedParameters, HeldParameters, PartialDerivatives
from unrender.rendering.renderer import ParameterInfo, Renderer
from unrender.scene.problem import Problem
from unrender.scene.upsampling import SQUARES, Upsampler, restarted, upsampled

_PERTURBED = 1 << 33  # stream of a step's key for the perturbed renders; path gradients use lower streams
_ADJOINTS = 1 << 20  # index of the random numbers of the adjoints of eliminated textures

_MEAN, _SQUARE = 0.9, 0.999
"""Decays of the running means of the perturbed parameters' gradient and of its square, as in Adam."""


def beyond_paths(known: Mapping[str, ParameterInfo], keys: Sequence[str]) -> tuple[str, ...]:
    """Return the keys that path gradients do not suit: parameters without a path gradient, and poses, whose loss has plateaus."""
    return tuple(key for key in keys if known[key].rigid or not known[key].differentiable)


@dataclass(frozen=True)
class HybridState:
    """State between steps of both estimators.

    Attributes:
        perturbed: state of the second estimator.
        mean, square: running means of the perturbed parameters' gradient, and of its square, not debiased; {} unless `averaged`.
        step: number of estimates since these began; with a block, of all.
        response: response of the eliminated textures; None without any.
    """

    path: Any
    perturbed: SmoothedState | GaussNewtonState
    mean: Tree = field(default_factory=dict)
    square: Tree = field(default_factory=dict)
    step: int = 0
    response: Response | None = None

    def upsampled(self, upsampler: Upsampler) -> HybridState:
        return replace(
            self,
            path=upsampled(self.path, upsampler),
            perturbed=upsampled(self.perturbed, upsampler),
            mean=upsampler.tree(self.mean, 1.0),
            square=upsampler.tree(self.square, SQUARES),
            response=upsampled(self.response, upsampler),
        )

    def restarted(self, fresh: HybridState) -> HybridState:
        parts = {name: restarted(getattr(self, name), getattr(fresh, name)) for name in ("path", "perturbed")}
        return replace(fresh, **parts, step=fresh.step if fresh.mean else self.step)


@register
@dataclass(frozen=True)
class HybridGradient:
    """Path gradients for the parameters that they suit, and smoothed gradients for the others.

    The others, the perturbed parameters, are poses, whose loss has plateaus and edges, and parameters without a path gradient. Each
    step renders the scene at its current parameters for `path`, with all its features: control variates, gradient reuse, pixel
    mini-batches. It also renders the scene at perturbed values of the perturbed parameters for `perturbed`, with the others fixed.
    Perturbations of a few numbers take a few renders, independent of the number of texels.

    The gradient of the path parameters is exactly that of `path` at the current perturbed parameters, from the same random numbers. If
    two states share samples, the previous state is rendered with its own perturbed parameters. Paths of one pose are not valid in
    another, so poses require space="primary". The gradient of the perturbed parameters is that of `perturbed`: of the loss smoothed
    over these alone. Each gradient has the bias that its estimator states. Both belong to one loss, smoothed for the perturbed
    parameters, whose minimum tends to that of the loss itself as σ decreases.

    Set `debiased` in `perturbed`: the noise of few samples per pixel increases the loss of each perturbed render, less so for darker
    images. The bias would drive the perturbed parameters towards dark images, and the path parameters would compensate.

    With `GaussNewton` for `perturbed`, the perturbed parameters form a block (`BlockEstimate`). An optimizer such as `Partitioned(keys,
    AveragedNewton(), others)` solves it, and their gradient is 0 in steps in which they are fixed. `wait` and `every` select the
    steps in which they move. While textures are far from the solution, images contain little information on poses. Textures in
    `eliminated` are eliminated from the block (`estimators.variable_projection`). The position of a lamp, for example, then converges
    without waiting for the texture that it lights.

    The steps of both groups have no common scale: give the perturbed parameters their own learning rates.

    Provides a gradient, and its variance if `path` does. For the perturbed parameters it is the mean square, variance plus squared
    gradient, as a meta-estimate has from as many samples. With the variance alone, which is small if perturbations agree, `MetaAdam`
    would take steps longer than its learning rate. The loss is that of `path`.

    Args:
        path: an estimator of path gradients: `PathGradient` or `MetaEstimator`.
        perturbed: of order "gradient", with `sigma` for the perturbed parameters; or `GaussNewton`.
        keys: the perturbed parameters; None for all poses and all parameters without a path gradient.
        averaged: for `MetaAdam`, which has no momentum: the gradient of the perturbed parameters is the running mean of about ten steps,
            and its variance that of the squares, both debiased, which gives Adam's steps. Differences of the smoothed loss between two
            steps are not rendered, so the mean lags behind. Set it to False for optimizers that average themselves, or that increase
            their rates while gradients agree. Requires a variance of `path`.
        wait: number of steps before the first in which a block moves, >= 0. For `GaussNewton` only.
        every: interval of steps in which a block moves, >= 1. For `GaussNewton` only.
        eliminated: keys of reflectances or radiances that the block eliminates, without preconditioner, parameterisation and prior. Each
            of its steps takes three more images of each view, and an adjoint for each of its elements and one more, all with
            `derivative_spp` samples per pixel. For `GaussNewton` without `remember` only.
    """

    path: Estimator = field(default_factory=PathGradient)
    perturbed: SmoothedDerivatives | GaussNewton = field(
        default_factory=lambda: SmoothedDerivatives(0.2, samples=16, spp=2, debiased=True)
    )
    keys: tuple[str, ...] | None = None
    averaged: bool = False
    wait: Index = 0
    every: Count = 1
    eliminated: tuple[str, ...] = ()

    def __post_init__(self):
        checks.fields(self)
        for name in ("keys", "eliminated") if self.keys is not None else ("eliminated",):
            keys: Any = getattr(self, name)
            if isinstance(keys, str) or not isinstance(keys, Sequence) or not all(isinstance(key, str) for key in keys):
                raise InputError(f"HybridGradient: {name} must be a list of parameters' keys, got {in_words(keys)}")
            object.__setattr__(self, name, tuple(keys))
        if isinstance(self.path, (SmoothedDerivatives, HybridGradient)) or Gradient.name not in self.path.provides:
            raise InputError(
                f"HybridGradient: path must be an estimator of path gradients, such as PathGradient(), got "
                f"{type(self.path).__name__}"
            )
        if self._is_block and self.averaged:
            raise InputError("HybridGradient: averaged requires SmoothedDerivatives, got GaussNewton")
        if not self._is_block and (self.wait or self.every > 1 or self.eliminated):
            raise InputError("HybridGradient: wait, every and eliminated require GaussNewton, got SmoothedDerivatives")
        if not self._is_block and (
            not isinstance(self.perturbed, SmoothedDerivatives) or self.perturbed.order != "gradient"
        ):
            raise InputError(
                'HybridGradient: perturbed must be GaussNewton, or SmoothedDerivatives with order="gradient", since path gradients have no '
                f"curvature, got {in_words(self.perturbed)}"
            )
        if self.averaged and Variance.name not in self.path.provides:
            raise InputError(
                f"HybridGradient: averaged needs a path that provides a variance, such as MetaEstimator(), got {type(self.path).__name__}"
            )
        if isinstance(self.perturbed, GaussNewton):
            if self.eliminated and self.perturbed.remember:
                raise InputError(
                    "HybridGradient: eliminated requires GaussNewton(remember=False), since the lines of earlier derivative images differ"
                )
            # a block states no error
            options = replace(self.perturbed, scores=False, derivative_images=bool(self.eliminated))
            object.__setattr__(self, "perturbed", options)

    @property
    def provides(self) -> Capabilities:
        """A gradient, and its variance if both have one; with `GaussNewton`, a block."""
        if self._is_block:
            return Capabilities(Gradient, BlockEstimate)
        return Capabilities(Gradient, Variance) if Variance.name in self.path.provides else Capabilities(Gradient)

    def pixel_weights(self, state: HybridState) -> tuple[np.ndarray, ...]:
        return pixel_weights(self.perturbed, state.perturbed)

    def init(self, problem: Problem, parameters: Tree) -> HybridState:
        """Return the state before the first step. Raise `InputError` if one of the two estimators has no parameter, or refuses its own."""
        own = self._perturbed(problem.renderer, parameters)
        part = {key: parameters[key] for key in own}
        self._check_eliminated(problem, parameters, own)
        response = Response.zero(parameters, self.eliminated, trees.ravel(part).size) if self.eliminated else None
        path, perturbed = self._problems(problem, parameters, own, response)
        zeros = trees.zeros_like(part) if self.averaged else {}
        states = self.path.init(path, parameters), self.perturbed.init(perturbed, part)
        return HybridState(*states, zeros, zeros, response=response)

    def estimate(
        self, problem: Problem, parameters: Tree, state: HybridState, key: Key
    ) -> tuple[Estimate, HybridState]:
        """Return an estimate and the next state. `info`: that of `path`, with "samples" of both, and "perturbed_loss", the loss at the
        parameters with the noise of the perturbed renders."""
        own = self._perturbed(problem.renderer, parameters)
        if state.response is not None:
            state = replace(state, response=state.response.within(problem, parameters))
        path, perturbed = self._problems(problem, parameters, own, state.response)
        path_estimate, path_state = self.path.estimate(path, parameters, state.path, key)
        part = {name: parameters[name] for name in own}
        own_key = key.fold(_PERTURBED)
        if self._is_block:
            compiles = key.stream == WARM_UP and not state.step
            problems = path, perturbed
            perturbed_estimate, state, samples = self._block(problems, parameters, part, state, own_key, compiles)
        else:
            perturbed_estimate, after = self.perturbed.estimate(perturbed, part, state.perturbed, own_key)  # pyright: ignore[reportArgumentType]
            state, samples = replace(state, perturbed=after), int(perturbed_estimate.info.get("samples", 0))
        if path_estimate.preconditioned or perturbed_estimate.preconditioned:
            bounded = bounded_with_preconditioner(problem) if not path_estimate.preconditioned else ()
            fresh = (GradientAtBounds({name: path_estimate.gradient[name] for name in bounded}),) if bounded else ()
            path_estimate = replace(path_estimate, capabilities=(*path_estimate.capabilities, *fresh))
            path_estimate, perturbed_estimate = (
                by_coordinates(path_estimate, problem, parameters),
                by_coordinates(perturbed_estimate, restricted(problem, own), part),
            )
        moments = replace(state, step=state.step + 1) if self._is_block else state
        if self.averaged:
            perturbed_estimate, moments = _averaged(perturbed_estimate, state)
        elif Variance.name in self.provides:
            perturbed_estimate = replace(perturbed_estimate, capabilities=(Variance(_mean_square(perturbed_estimate)),))
        gradient = {
            name: perturbed_estimate.gradient[name] if name in own else g for name, g in path_estimate.gradient.items()
        }
        info = {
            **path_estimate.info,
            "samples": int(path_estimate.info.get("samples", 0)) + samples,
            "perturbed_loss": perturbed_estimate.loss,
        }
        merged = replace(
            path_estimate, gradient=gradient, capabilities=_merged(path_estimate, perturbed_estimate, own), info=info
        )
        arrays.evaluate(moments.mean, moments.square)
        return merged, replace(moments, path=path_state)

    @property
    def _is_block(self) -> bool:
        return isinstance(self.perturbed, GaussNewton)

    def _block(
        self,
        problems: tuple[Problem, Problem],
        parameters: Tree,
        part: Tree,
        state: HybridState,
        key: Key,
        compiles: bool,
    ) -> tuple[Estimate, HybridState, int]:
        """Return the estimate with a block, the state, and the paths traced. `part` are the parameters of the block; in the warm-up
        (`compiles`), it is estimated in any case."""
        fixed = Estimate(0.0, trees.zeros_like(part), (BlockEstimate(tuple(part), None),))
        moves = state.step >= self.wait and (state.step - self.wait) % self.every == 0
        if not (moves or compiles):
            return fixed, state, 0
        estimate, after = self.perturbed.estimate(problems[1], part, state.perturbed, key)  # pyright: ignore[reportArgumentType]
        samples, response = int(estimate.info.get("samples", 0)), state.response
        images = estimate.get(DerivativeImages)
        if response is not None and images is not None and isinstance(self.perturbed, GaussNewton):
            spp = self.perturbed.derivative_spp
            response, paths = update_response(response, problems[0], parameters, images, spp, key.fold(_ADJOINTS))
            samples += paths
        if not moves:
            return fixed, state, samples
        block = BlockEstimate(tuple(part), estimate)
        return replace(estimate, capabilities=(block,)), replace(state, perturbed=after, response=response), samples

    def _check_eliminated(self, problem: Problem, parameters: Tree, own: Sequence[str]) -> None:
        for name in self.eliminated:
            if name not in parameters or name in own:
                hint = did_you_mean(name, [other for other in parameters if other not in own])
                raise InputError(
                    f"HybridGradient: eliminated names {name}, which is not one of the other parameters{hint}"
                )
            if not can_be_eliminated(problem.unknowns[name]):
                raise InputError(
                    f"HybridGradient: parameter {name} has a preconditioner, parameterisation or prior; remove it from eliminated"
                )

    def _problems(
        self, problem: Problem, parameters: Tree, own: Sequence[str], response: Response | None
    ) -> tuple[Problem, Problem]:
        held = {key: x for key, x in parameters.items() if key not in own}
        renderer = HeldParameters(problem.renderer, held)
        if response is not None:
            origin = trees.ravel({key: parameters[key] for key in own})
            bounds = {key: problem.unknowns[key].project for key in response.slopes}
            renderer = EliminatedParameters(problem.renderer, held, origin, response.slopes, bounds)
        return (
            problem.with_parts(renderer=PartialDerivatives(problem.renderer, frozenset(own))),
            problem.with_parts(renderer=renderer),
        )

    def _perturbed(self, renderer: Renderer, parameters: Tree) -> tuple[str, ...]:
        if self.keys is None:
            own = beyond_paths(renderer.parameters(), list(parameters))
            if not own:
                raise InputError(
                    "HybridGradient: path gradients suit all parameters; name those to perturb (keys; with method hybrid, perturbed), "
                    "or use PathGradient"
                )
        else:
            for key in self.keys:
                if key not in parameters:
                    hint = did_you_mean(key, parameters)
                    raise InputError(f"HybridGradient: keys names {key}, which is not a parameter{hint}")
            own = tuple(key for key in parameters if key in self.keys)
            if not own:
                raise InputError("HybridGradient: keys must name at least one parameter; without any, use PathGradient")
        if len(own) == len(parameters):
            raise InputError("HybridGradient: all parameters are perturbed; use SmoothedDerivatives")
        return own


def _averaged(perturbed: Estimate, state: HybridState) -> tuple[Estimate, HybridState]:
    """Return the estimate with the debiased running mean of the gradient, and its debiased mean square as variance; and the state with
    both."""
    step = state.step + 1
    mean = trees.map(lambda m, g: _MEAN * m + (1.0 - _MEAN) * g, state.mean, perturbed.gradient)
    square = trees.map(lambda v, g: _SQUARE * v + (1.0 - _SQUARE) * (g * g), state.square, perturbed.gradient)
    gradient = {key: x * arrays.scalar(1.0 / (1.0 - _MEAN**step), x) for key, x in mean.items()}
    variance = {key: x * arrays.scalar(1.0 / (1.0 - _SQUARE**step), x) for key, x in square.items()}
    averaged = replace(perturbed, gradient=gradient, capabilities=(Variance(variance),))
    return averaged, replace(state, mean=mean, square=square, step=step)


def _mean_square(perturbed: Estimate) -> Tree:
    variance = perturbed.require("HybridGradient", Variance).values
    return trees.map(lambda v, g: v + g * g, variance, perturbed.gradient)


def _merged(path: Estimate, perturbed: Estimate, own: Sequence[str]) -> tuple[Capability, ...]:
    """Return the capabilities of both: the variance of both, and the fresh gradient, since perturbed gradients are always fresh."""
    merged: list[Capability] = []
    for capability in path.capabilities:
        match capability:
            case Variance(values):
                other = perturbed.require("HybridGradient", Variance).values
                merged.append(Variance({key: other[key] if key in own else v for key, v in values.items()}))
            case FreshGradient(values):
                fresh = {key: perturbed.gradient[key] if key in own else g for key, g in values.items()}
                merged.append(FreshGradient(fresh))
            case GradientAtBounds(values):
                merged.append(GradientAtBounds({key: g for key, g in values.items() if key not in own}))
            case _:
                pass
    return (*merged, *(block for block in perturbed.capabilities if isinstance(block, BlockEstimate)))
