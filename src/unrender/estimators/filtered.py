"""Gradients of textures and grids, filtered in parameter space."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from unrender.core import arrays, trees
from unrender.core.arrays import Array
from unrender.core.errors import InputError
from unrender.core.random import Key
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.estimators import atrous
from unrender.estimators.base import Estimate, Estimator
from unrender.estimators.capabilities import Capabilities, FreshGradient, Gradient, Variance
from unrender.estimators.path import PathGradient
from unrender.preconditioners import grid
from unrender.scene.problem import Problem
from unrender.scene.upsampling import Upsampler, upsampled

__all__ = ["FilteredGradient", "FilteredGradientState"]

_SIGNS = 1 << 33
"""The stream of a step's key that draws signs."""


@dataclass(frozen=True)
class FilteredGradientState:
    """State between steps.

    Attributes:
        halves: the inner estimator's, one per half; one alone where it tells its variance.
    """

    halves: tuple[Any, ...]

    def upsampled(self, upsampler: Upsampler) -> FilteredGradientState:
        """See `Upsamplable`: the inner states are carried."""
        return FilteredGradientState(tuple(upsampled(half, upsampler) for half in self.halves))


@register
@dataclass(frozen=True)
class FilteredGradient:
    """The gradient of another estimator, smoothed over neighbouring texels as far as it is noise.

    An edge-aware à-trous filter, guided by the parameter's current values, divides the gradient of a texture or grid into details of each
    scale, d_l, with x = x_L + Σ d_l for the gradient x and its smoothest version x_L. Each is shrunk by James and Stein's factor, place by
    place:

        x̂ = x_L + Σ_l α_l d_l,   α_l = max(0, 1 − (p − 2) / (p + 2) · S² e_l² / S² d_l²)

    with the details e_l of a sample of the noise, and means S² over p numbers nearby. So the result is the unbiased gradient where that is
    hardly noisy, and its cross-bilateral mean where it is noise. The ideas are those of Chang et al. 2024, "Spatiotemporal Bilateral
    Gradient Filtering for Inverse Rendering", and of Gu and Moon 2025, "James–Stein Gradient Combiner for Inverse Monte Carlo Rendering";
    here filter width, strength and mixture follow from the noise, and nothing is to be tuned.

    The noise is that of two halves A and B, two estimates of the inner estimator that never share samples, each with a memory of its own
    where the estimator has one: the gradient is (A + B) / 2, and (A − B) / 2 is a sample of its noise, with all correlations between texels
    and whatever the halves remember. So give `inner` half of the samples that a step shall have, and 2 per pixel at least where it divides
    them into groups. Where the inner estimator provides the variance, there is one estimate, and the sample is of independent noise: its
    root with random signs.

    Why an estimator, not a preconditioner: a preconditioner is one linear, symmetric map of gradients and steps; this filter depends
    on the gradient itself, on its noise and on the parameter's values, and steps are not to be filtered. Preconditioners, and the
    smoothing of `ScheduleFree`, come after it.

    Biased, towards smooth gradients, and consistent: as noise falls, the result is the inner gradient. The halves of a loss whose
    derivative is not linear have the bias of half the samples. Parameters that are neither textures (H, W, C) nor grids (Z, Y, X, C)
    have the inner gradient. `FreshGradient` is passed on as it is, not filtered.

    Computed on the host; on Dr.Jit it waits for the device, and copies to and fro where that is a GPU.

    Args:
        inner: an estimator that provides gradients.
        wrap: {key: whether opposite borders are neighbours, as for a tiling texture}, for all axes, or one truth value per axis: an
            environment map (H, W, C) wraps as (False, True). False for keys left out.
    """

    inner: Estimator = field(default_factory=lambda: PathGradient(spp=2))
    wrap: Mapping[str, bool | tuple[bool, ...]] = field(default_factory=dict)

    def __post_init__(self):
        if isinstance(self.inner, type) or not hasattr(self.inner, "provides"):
            raise InputError(
                f"FilteredGradient: inner must be an estimator, such as PathGradient(spp=2), got {self.inner!r:.80}"
            )
        if Gradient.name not in self.inner.provides:
            raise InputError(f"FilteredGradient: {type(self.inner).__name__} provides no gradient to be filtered")
        if not isinstance(self.wrap, Mapping):
            raise InputError(f"FilteredGradient: wrap must be {{key: true or false}}, got {self.wrap!r:.80}")
        wrap = {key: grid.wraps("FilteredGradient", found) for key, found in self.wrap.items()}
        object.__setattr__(self, "wrap", wrap)

    @property
    def provides(self) -> Capabilities:
        """A gradient."""
        return Capabilities(Gradient)

    @property
    def _tells_variance(self) -> bool:
        return Variance.name in self.inner.provides

    def init(self, problem: Problem, parameters: Tree) -> FilteredGradientState:
        """See `Estimator.init`. Raises `InputError` for a `wrap` of no parameter, or of another number of axes."""
        for key, wrap in self.wrap.items():
            if key not in parameters:
                raise InputError(f'FilteredGradient: wrap: unknown parameter "{key}"')
            grid.check("FilteredGradient", key, arrays.shape(parameters[key]), wrap)
        halves = 1 if self._tells_variance else 2
        return FilteredGradientState(tuple(self.inner.init(problem, parameters) for _ in range(halves)))

    def estimate(
        self, problem: Problem, parameters: Tree, state: FilteredGradientState, key: Key
    ) -> tuple[Estimate, FilteredGradientState]:
        """See `Estimator.estimate`. `info`: that of the inner estimator's first half, "samples" of both, and "kept" per filtered
        parameter: the share of each level of detail, from the finest, that is no noise."""
        found = [
            self.inner.estimate(problem, parameters, half, key.fold(index)) for index, half in enumerate(state.halves)
        ]
        estimates, halves = [estimate for estimate, _ in found], tuple(half for _, half in found)
        first = estimates[0]
        gradient = _mean([estimate.gradient for estimate in estimates])
        filtered, kept = {}, {}
        for index, (name, value) in enumerate(gradient.items()):
            filtered[name] = value
            if grid.is_map(arrays.shape(value)):
                noise = self._noise(estimates, name, key.fold(_SIGNS + index))
                filtered[name], kept[name] = self._filtered(name, value, noise, parameters[name])
        fresh = [each.values for each in (estimate.get(FreshGradient) for estimate in estimates) if each is not None]
        info = {
            **first.info,
            "samples": sum(int(estimate.info.get("samples", 0)) for estimate in estimates),
            "kept": kept,
        }
        whole = replace(
            first,
            loss=float(np.mean([estimate.loss for estimate in estimates])),
            gradient=filtered,
            capabilities=(FreshGradient(_mean(fresh)),) if len(fresh) == len(estimates) else (),
            info=info,
        )
        return whole, FilteredGradientState(halves)

    def _noise(self, estimates: list[Estimate], name: str, key: Key) -> np.ndarray:
        """A sample of the noise of a parameter's gradient."""
        if len(estimates) == 2:
            first, second = (arrays.numpy(estimate.gradient[name]) for estimate in estimates)
            return 0.5 * (first - second)
        variance = arrays.numpy(estimates[0].require("FilteredGradient", Variance).values[name])
        signs = np.random.default_rng(key.uint32()).integers(0, 2, variance.shape) * 2.0 - 1.0
        return np.sqrt(variance) * signs

    def _filtered(self, name: str, value: Array, noise: np.ndarray, parameter: Array) -> tuple[Array, list[float]]:
        g, guide = arrays.numpy(value), arrays.numpy(parameter)
        if not (np.isfinite(g).all() and np.isfinite(noise).all()):
            return value, []  # for the loop to refuse
        size = float(np.abs(g).max())
        if size == 0:
            return value, []
        wrap = grid.per_axis(self.wrap.get(name, False), g.ndim - 1)
        # By its greatest element, so that squares neither overflow nor vanish.
        smooth, kept = atrous.shrunk((g / size).astype(np.float32), (noise / size).astype(np.float32), guide, wrap)
        return arrays.like(smooth * np.float32(size), value), kept


def _mean(parts: list[Tree]) -> Tree:
    return parts[0] if len(parts) == 1 else trees.map(lambda *each: sum(each[1:], each[0]) * (1.0 / len(each)), *parts)
