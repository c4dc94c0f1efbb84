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
"""Of the smoothing along an axis."""
_POOLED = 128 / 35
"""Independent numbers along an axis, of which a mean with the weights of the taps, applied twice, has the variance."""


def levels_of(grid: tuple[int, ...]) -> int:
    """The levels of detail of a grid: their spacing doubles from one texel to a quarter of the longest side."""
    return max(1, int(np.log2(max(grid))) - 1)


def shrunk(x: np.ndarray, noise: np.ndarray, guide: np.ndarray, wrap: Sequence[bool]) -> tuple[np.ndarray, list[float]]:
    """`x` with its details shrunk, and the mean share of each level that is kept, from the finest.

    With x_0 = x and F_l the smoothing at spacing 2^l, x_{l+1} = F_l x_l, the details d_l = x_l − x_{l+1} and what is left sum up to x:
    x = x_L + Σ d_l. The same maps, applied to a sample of the noise, give that of the details, e_l: of whatever correlation between texels.
    Then

        x̂ = x_L + Σ_l α_l d_l,   α_l = max(0, 1 − (p − 2) / (p + 2) · S² e_l² / S² d_l²)

    with means S² over neighbours at the same spacing and channels, of p numbers: James and Stein's factor for p means of one variance,
    itself estimated from p samples. Where noise falls to 0, x̂ is x; where all is noise, x̂ is smooth except along the guide's edges.

    Args:
        x: (*grid, channels).
        noise: a sample of the noise of x, of its shape: mean 0, and the covariance of x.
        guide: (*grid, channels of any number): neighbours are averaged as far as they are alike here.
        wrap: per axis, whether its two ends are neighbours.
    """
    grid, channels = x.shape[:-1], x.shape[-1]
    pooled = channels * _POOLED ** sum(size > 1 for size in grid)
    factor = max(0.0, pooled - 2.0) / (pooled + 2.0)
    result, shares = np.zeros_like(x), []
    left = np.concatenate([x, noise], axis=-1)
    for spacing, detail, smooth in details(left, guide, wrap):
        left = smooth
        d, e = detail[..., :channels], detail[..., channels:]
        energy = np.stack([np.square(d).mean(axis=-1), np.square(e).mean(axis=-1)], axis=-1)
        for _ in range(2):
            energy = _smooth(energy, spacing, wrap, None)
        whole, noisy = energy[..., :1], energy[..., 1:]
        share = np.clip(1.0 - factor * noisy / np.where(whole > 0, whole, 1.0), 0.0, 1.0)
        result += share * d
        shares.append(float(share.mean()))
    return result + left[..., :channels], shares


def details(x: np.ndarray, guide: np.ndarray, wrap: Sequence[bool]) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """(spacing in texels, the detail at this spacing, what is left) from the finest; x is all details and the last that is left."""
    for level in range(levels_of(x.shape[:-1])):
        spacing = 1 << level
        smooth = _smooth(x, spacing, wrap, guide)
        yield spacing, x - smooth, smooth
        x = smooth


def _smooth(x: np.ndarray, spacing: int, wrap: Sequence[bool], guide: np.ndarray | None) -> np.ndarray:
    """The mean over neighbours at a spacing, as far as they exist, by the taps and, with a guide, by how alike it is there.

    Two texels count by exp(−|a_i − a_j|² / 2 s²) with s² the mean of |a_i − a_j|² over all pairs at the same offset: half of those of
    a guide that is all noise remain neighbours, and an edge that stands out of the rest separates.
    """
    total, weights = np.zeros_like(x), np.zeros((*x.shape[:-1], 1), x.dtype)
    for offset in itertools.product(_TAPS, repeat=x.ndim - 1):
        neighbour, exists = _neighbours(x.shape[:-1], offset, spacing, wrap)
        weight = exists * float(np.prod([_TAPS[o] for o in offset]))
        if guide is not None and any(offset):
            weight = weight * _alike(guide, neighbour(guide), exists)
        total += weight * neighbour(x)
        weights += weight
    return total / weights


def _alike(guide: np.ndarray, other: np.ndarray, exists: np.ndarray) -> np.ndarray:
    """How alike a guide and its neighbour are, (*grid, 1), in (0, 1]; 1 where the guide is constant."""
    square = np.square(guide - other).sum(axis=-1, keepdims=True) * exists
    pairs = exists.sum()
    mean = float(square.sum() / pairs) if pairs else 0.0
    return np.exp(-0.5 * square / mean) if mean > 0 else np.ones_like(square)


def _neighbours(
    grid: tuple[int, ...], offset: tuple[int, ...], spacing: int, wrap: Sequence[bool]
) -> tuple[Callable[[np.ndarray], np.ndarray], np.ndarray]:
    """A function from a map to that of the neighbours at an offset, and where there are any, (*grid, 1), as 0 or 1.

    Where an axis has one texel, it has no neighbours there.
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
        smooth, kept = shrunk((g / size).astype(np.float32), (noise / size).astype(np.float32), guide, wrap)
        return arrays.like(smooth * np.float32(size), value), kept


def _mean(parts: list[Tree]) -> Tree:
    return parts[0] if len(parts) == 1 else trees.map(lambda *each: sum(each[1:], each[0]) * (1.0 / len(each)), *parts)
