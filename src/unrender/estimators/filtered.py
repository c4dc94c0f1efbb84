"""Gradients of textures and grids, filtered in parameter space.

The decomposition is that of Dammertz et al. 2010, "Edge-Avoiding À-Trous Wavelet Transform for fast Global Illumination Filtering". Its
edges are those of another map, the guide. The shrinkage is that of James and Stein 1961, "Estimation with Quadratic Loss".
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from unrender.core import arrays, trees
from unrender.core.arrays import Array
from unrender.core.errors import InputError
from unrender.core.random import Key
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.estimators.base import Estimate, Estimator
from unrender.estimators.capabilities import Capabilities, FreshGradient, Gradient, Variance
from unrender.estimators.path import PathGradient
from unrender.preconditioners import grid
from unrender.scene.problem import Problem
from unrender.scene.upsampling import Upsampler, upsampled

_TAPS = {-1: 0.25, 0: 0.5, 1: 0.25}
"""Weights of the smoothing along an axis."""
_POOLED = 128 / 35
"""Equivalent number of independent values per axis in a mean that applies the taps' weights twice."""


def levels_of(grid: tuple[int, ...]) -> int:
    """Return the number of detail levels of a grid. The spacing doubles from one texel to a quarter of the longest side."""
    return max(1, int(np.log2(max(grid))) - 1)


def shrunk(x: np.ndarray, noise: np.ndarray, guide: np.ndarray, wrap: Sequence[bool]) -> tuple[np.ndarray, list[float]]:
    """Return `x` with shrunk details, and the mean weight α of each level, from the finest.

    With x_0 = x and F_l the smoothing at spacing 2^l, x_{l+1} = F_l x_l, the details d_l = x_l − x_{l+1} and the remainder sum to x: x
    = x_L + Σ d_l. The same maps, applied to a sample of the noise, give the noise e_l of the details, for any correlation between
    texels. Then

        x̂ = x_L + Σ_l α_l d_l,   α_l = max(0, 1 − (p − 2) / (p + 2) · S² e_l² / S² d_l²)

    with means S² over neighbours at the same spacing and channels, of p numbers: James and Stein's factor for p means of one variance,
    which is itself estimated from p samples. As the noise vanishes, x̂ tends to x. For pure noise, x̂ is smooth except at the guide's
    edges.

    Args:
        x: (*grid, channels).
        noise: a sample of the noise of x, of its shape: mean 0, and the covariance of x.
        guide: (*grid, any number of channels): neighbours are averaged according to their similarity in the guide.
        wrap: per axis, whether its two ends are neighbours.
    """
    grid, channels = x.shape[:-1], x.shape[-1]
    pooled = channels * _POOLED ** sum(size > 1 for size in grid)
    factor = max(0.0, pooled - 2.0) / (pooled + 2.0)
    result, shares = np.zeros_like(x), []
    remainder = np.concatenate([x, noise], axis=-1)
    for spacing, detail, smooth in details(remainder, guide, wrap):
        remainder = smooth
        d, e = detail[..., :channels], detail[..., channels:]
        energy = np.stack([np.square(d).mean(axis=-1), np.square(e).mean(axis=-1)], axis=-1)
        for _ in range(2):
            energy = _smooth(energy, spacing, wrap, None)
        signal, noise_energy = energy[..., :1], energy[..., 1:]
        share = np.clip(1.0 - factor * noise_energy / np.where(signal > 0, signal, 1.0), 0.0, 1.0)
        result += share * d
        shares.append(float(share.mean()))
    return result + remainder[..., :channels], shares


def details(x: np.ndarray, guide: np.ndarray, wrap: Sequence[bool]) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Yield (spacing in texels, detail at this spacing, remainder) from the finest level; x is the sum of all details and the last
    remainder."""
    for level in range(levels_of(x.shape[:-1])):
        spacing = 1 << level
        smooth = _smooth(x, spacing, wrap, guide)
        yield spacing, x - smooth, smooth
        x = smooth


def _smooth(x: np.ndarray, spacing: int, wrap: Sequence[bool], guide: np.ndarray | None) -> np.ndarray:
    """Return the mean over existing neighbours at a spacing, weighted by the taps and, with a guide, by similarity.

    The similarity of two texels is exp(−|a_i − a_j|² / 2 s²), where s² is the mean of |a_i − a_j|² over all pairs at the same offset.
    Noisy guides therefore retain about half of the neighbours, while a pronounced edge separates them.
    """
    total, weights = np.zeros_like(x), np.zeros((*x.shape[:-1], 1), x.dtype)
    for offset in itertools.product(_TAPS, repeat=x.ndim - 1):
        neighbour, exists = _neighbours(x.shape[:-1], offset, spacing, wrap)
        weight = exists * float(np.prod([_TAPS[o] for o in offset]))
        if guide is not None and any(offset):
            weight = weight * _similarity(guide, neighbour(guide), exists)
        total += weight * neighbour(x)
        weights += weight
    return total / weights


def _similarity(guide: np.ndarray, other: np.ndarray, exists: np.ndarray) -> np.ndarray:
    """Return the similarity of a guide and its neighbour, (*grid, 1), in (0, 1]; 1 for a constant guide."""
    square = np.square(guide - other).sum(axis=-1, keepdims=True) * exists
    pairs = exists.sum()
    mean = float(square.sum() / pairs) if pairs else 0.0
    return np.exp(-0.5 * square / mean) if mean > 0 else np.ones_like(square)


def _neighbours(
    grid: tuple[int, ...], offset: tuple[int, ...], spacing: int, wrap: Sequence[bool]
) -> tuple[Callable[[np.ndarray], np.ndarray], np.ndarray]:
    """Return a function from a map to that of the neighbours at an offset, and whether they exist, (*grid, 1), as 0 or 1.

    An axis of one texel has no neighbours.
    """
    exists = np.ones((*grid, 1), np.float32)
    index = []
    for axis, (size, step, wraps) in enumerate(zip(grid, offset, wrap, strict=True)):
        at = np.arange(size) + step * spacing
        inside = np.ones(size, bool) if wraps and (size > 1 or step == 0) else (at >= 0) & (at < size)
        exists = exists * inside.reshape([-1 if a == axis else 1 for a in range(len(grid) + 1)])
        index.append(at % size)
    place = np.ix_(*index)
    return lambda x: x[place], exists


_SIGNS = 1 << 33
"""Stream of a step's key for random signs."""


@dataclass(frozen=True)
class FilteredGradientState:
    """State between steps.

    Attributes:
        halves: states of the inner estimator, one per half; a single state if it provides its variance.
    """

    halves: tuple[Any, ...]

    def upsampled(self, upsampler: Upsampler) -> FilteredGradientState:
        """Return the state with upsampled inner states."""
        return FilteredGradientState(tuple(upsampled(half, upsampler) for half in self.halves))


@register
@dataclass(frozen=True)
class FilteredGradient:
    """The gradient of another estimator, smoothed over neighbouring texels according to its noise.

    An edge-aware à-trous filter, guided by the parameter's current values, decomposes the gradient of a texture or grid into details
    d_l of each scale: x = x_L + Σ d_l for the gradient x and its smoothest version x_L. Each detail is shrunk locally by James and
    Stein's factor:

        x̂ = x_L + Σ_l α_l d_l,   α_l = max(0, 1 − (p − 2) / (p + 2) · S² e_l² / S² d_l²)

    with the details e_l of a sample of the noise, and means S² over p numbers nearby. The result is the unbiased gradient where its
    noise is small, and its cross-bilateral mean where noise dominates. The ideas are those of Chang et al. 2024, "Spatiotemporal
    Bilateral Gradient Filtering for Inverse Rendering", and of Gu and Moon 2025, "James–Stein Gradient Combiner for Inverse Monte Carlo
    Rendering". Here filter width, strength and mixture follow from the noise, without tuning parameters.

    The noise comes from two halves A and B, two estimates of the inner estimator that never share samples, each with its own state. The
    gradient is (A + B) / 2, and (A − B) / 2 is a sample of its noise, including correlations between texels and with earlier samples.
    Give `inner` half of the samples per step, at least 2 per pixel if it divides them into groups. If the inner estimator provides the
    variance, there is one estimate, and the noise sample is the standard deviation with random signs, which neglects correlations.

    This is an estimator instead of a preconditioner, since a preconditioner is one linear, symmetric map of gradients and steps. The
    filter depends on the gradient, its noise and the parameter's values, and must not filter steps. Preconditioners, and the smoothing
    of `ScheduleFree`, are applied after it.

    Biased towards smooth gradients, and consistent: as noise vanishes, the result is the inner gradient. For a loss whose derivative is
    not linear, the halves have the bias of half the samples. Parameters that are neither textures (H, W, C) nor grids (Z, Y, X, C) have
    the inner gradient. `FreshGradient` is not filtered.

    The filter runs on the host. On Dr.Jit it waits for the device, and copies to and from a GPU.

    Args:
        inner: an estimator that provides gradients.
        wrap: {key: whether opposite borders are neighbours, as for a tiling texture}, for all axes, or one boolean per axis: an
            environment map (H, W, C) wraps as (False, True). False for other keys.
    """

    inner: Estimator = field(default_factory=lambda: PathGradient(spp=2))
    wrap: Mapping[str, bool | tuple[bool, ...]] = field(default_factory=dict)

    def __post_init__(self):
        if isinstance(self.inner, type) or not hasattr(self.inner, "provides"):
            raise InputError(
                f"FilteredGradient: inner must be an estimator, such as PathGradient(spp=2), got {self.inner!r:.80}"
            )
        if Gradient.name not in self.inner.provides:
            raise InputError(
                f"FilteredGradient: {type(self.inner).__name__} provides no gradient; choose an inner estimator that does"
            )
        if not isinstance(self.wrap, Mapping):
            raise InputError(f"FilteredGradient: wrap must be {{key: true or false}}, got {self.wrap!r:.80}")
        wrap = {key: grid.wraps("FilteredGradient", value) for key, value in self.wrap.items()}
        object.__setattr__(self, "wrap", wrap)

    @property
    def provides(self) -> Capabilities:
        """A gradient."""
        return Capabilities(Gradient)

    @property
    def _provides_variance(self) -> bool:
        return Variance.name in self.inner.provides

    def init(self, problem: Problem, parameters: Tree) -> FilteredGradientState:
        """Return the state before the first step. Raise `InputError` for a `wrap` of an unknown parameter, or with another number of
        axes."""
        for key, wrap in self.wrap.items():
            if key not in parameters:
                raise InputError(f'FilteredGradient: wrap: unknown parameter "{key}"')
            grid.check("FilteredGradient", key, arrays.shape(parameters[key]), wrap)
        halves = 1 if self._provides_variance else 2
        return FilteredGradientState(tuple(self.inner.init(problem, parameters) for _ in range(halves)))

    def estimate(
        self, problem: Problem, parameters: Tree, state: FilteredGradientState, key: Key
    ) -> tuple[Estimate, FilteredGradientState]:
        """Return an estimate and the next state. `info`: that of the inner estimator's first half, "samples" of both, and "kept" per
        filtered parameter: the mean weight α of each level of detail, from the finest."""
        results = [
            self.inner.estimate(problem, parameters, half, key.fold(index)) for index, half in enumerate(state.halves)
        ]
        estimates, halves = [estimate for estimate, _ in results], tuple(half for _, half in results)
        first = estimates[0]
        gradient = _mean([estimate.gradient for estimate in estimates])
        filtered, weights = {}, {}
        for index, (name, value) in enumerate(gradient.items()):
            filtered[name] = value
            if grid.is_map(arrays.shape(value)):
                noise = self._noise(estimates, name, key.fold(_SIGNS + index))
                filtered[name], weights[name] = self._filtered(name, value, noise, parameters[name])
        fresh = [each.values for each in (estimate.get(FreshGradient) for estimate in estimates) if each is not None]
        info = {
            **first.info,
            "samples": sum(int(estimate.info.get("samples", 0)) for estimate in estimates),
            "kept": weights,
        }
        result = replace(
            first,
            loss=float(np.mean([estimate.loss for estimate in estimates])),
            gradient=filtered,
            capabilities=(FreshGradient(_mean(fresh)),) if len(fresh) == len(estimates) else (),
            info=info,
        )
        return result, FilteredGradientState(halves)

    def _noise(self, estimates: list[Estimate], name: str, key: Key) -> np.ndarray:
        """Return a sample of the noise of a parameter's gradient."""
        if len(estimates) == 2:
            first, second = (arrays.numpy(estimate.gradient[name]) for estimate in estimates)
            return 0.5 * (first - second)
        variance = arrays.numpy(estimates[0].require("FilteredGradient", Variance).values[name])
        signs = np.random.default_rng(key.uint32()).integers(0, 2, variance.shape) * 2.0 - 1.0
        return np.sqrt(variance) * signs

    def _filtered(self, name: str, value: Array, noise: np.ndarray, parameter: Array) -> tuple[Array, list[float]]:
        g, guide = arrays.numpy(value), arrays.numpy(parameter)
        if not (np.isfinite(g).all() and np.isfinite(noise).all()):
            return value, []  # the loop refuses gradients that are not finite
        size = float(np.abs(g).max())
        if size == 0:
            return value, []
        wrap = grid.per_axis(self.wrap.get(name, False), g.ndim - 1)
        # Normalise by the largest element, so that squares neither overflow nor underflow.
        smooth, weights = shrunk((g / size).astype(np.float32), (noise / size).astype(np.float32), guide, wrap)
        return arrays.like(smooth * np.float32(size), value), weights


def _mean(parts: list[Tree]) -> Tree:
    return parts[0] if len(parts) == 1 else trees.map(lambda *each: sum(each[1:], each[0]) * (1.0 / len(each)), *parts)
