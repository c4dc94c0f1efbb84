"""Newton's method on the weighted mean of all quadratic models, i.e. recursive least squares."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from unrender.core import arrays, checks, trees
from unrender.core.checks import NotNegative, OpenFraction, Positive
from unrender.core.errors import InputError
from unrender.core.registry import register
from unrender.core.text import did_you_mean
from unrender.core.trees import Tree
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import (
    Capabilities,
    Gradient,
    GradientNoise,
    Hessian,
    HessianNoise,
    ScoreCovariance,
)
from unrender.optimizers.base import check_rates, rates_of
from unrender.optimizers.directions import coordinate_scales, sides_of_bounds
from unrender.optimizers.newton import trust_region_step
from unrender.optimizers.transforms.base import checked_keys
from unrender.scene.upsampling import NotCarried, Upsampler
from unrender.statistics.scores import positive_part, scaled_eigh

_FEWEST_MODELS = 8.0
"""Number of models from which their scatter gives a standard error."""
_FIRST_MODELS = 8.0
"""Number of models from which `settled_averaging` applies."""
_MOST_CURVATURE, _CURVATURE_ERRORS = 10.0, 3.0
"""Ratio of the mean curvature to that of a new model from which the mean is of another scene; multiple of the new one's noise."""
_USED, _SHRINK, _GROW = 0.5, 0.7, 1 / 0.7
"""Share of the radius from which a step counts as one that used the region, and the factors of the radius after such steps. Their product
is 1, so noise alone neither closes the region nor opens it."""
_LEAST_NOISE, _SURPRISE_ERRORS = 1e-6, 6.0
"""Relative eigenvalue of the gradient's noise below which a direction has none, and standard errors of a mean square of 1 that noise may
reach."""
_OUTLIER = 100.0
"""Ratio of a gradient's variance by noise to the mean one from which on it is left out, once at a time: noise may have grown. Weighted by
its inverse variance it would add at most 1 % to what is known."""
_WEAK_SHARE = 0.01
"""Squared share of an element in damped or unresolved directions above which its standard error is infinite."""
_RESOLVED = 8.0
"""Curvature relative to what noise would add to it below which it may be noise, and so the errors that follow from it. Source: 17 problems
of few numbers, 2 to 5 seeds: below it, 2 of 13 runs ended at 4.2 and 5.3 of their errors, above it 1 of 39 at more than 3.1."""
_OF_LINEAR = 1e4
"""Factor of the trust region along parameters in which images are linear."""
_OF_WIDTH = 0.1
"""Share of a width below which the end of a step along such a parameter counts as 0."""


@dataclass(frozen=True)
class AveragedNewtonState:
    """State between steps.

    Attributes:
        learning_rates: learning rate of each parameter, its scale.
        matrix: A, the mean of the Hessians, (n, n), double precision on the host.
        target: b, the mean of H x − g, (n,). The mean model has its minimum where A x = b.
        noise: mean contribution of noise to squared derivatives, (n, n), see `HessianNoise`.
        gradient_noise: mean covariance of the models' gradients, (n, n), see `GradientNoise`.
        shares: fraction of that contribution in the mean, (n,): the sum of the squared weights of the models.
        counts: effective number of models in each element's mean, (n,); long steps reduce it.
        lengths: length of the last step of the elements that moved together, in units of the trust region, (n,).
        scatter: covariance of `target` from noise, (n, n): the sum over models of the squared weight times the squared difference between
            the model's gradient and that of the previous mean.
        radii: radius of the trust region of each element, (n,), in its units; 0 without a limit.
        step: last step, in units of the parameters, (n,).
        scores: latest covariance of the gradient from the references' noise, (n, n), see `ScoreCovariance`; None if it is unknown.
        ignored: whether the last model was left out as an outlier, (n,).
    """

    learning_rates: dict[str, float]
    matrix: np.ndarray
    target: np.ndarray
    noise: np.ndarray
    gradient_noise: np.ndarray
    shares: np.ndarray
    counts: np.ndarray
    lengths: np.ndarray
    scatter: np.ndarray
    radii: np.ndarray
    step: np.ndarray
    scores: np.ndarray | None
    ignored: np.ndarray

    def upsampled(self, upsampler: Upsampler) -> AveragedNewtonState:
        """Return this state. Raises `NotCarried` if one of its parameters changes its resolution."""
        if any(key in upsampler.shares for key in self.learning_rates):
            raise NotCarried("AveragedNewton's models")
        return self


@register
@dataclass(frozen=True)
class AveragedNewton:
    """Minimum of the weighted mean of the quadratic models g_tᵀ (x − x_t) + (x − x_t)ᵀ H_t (x − x_t) / 2 of all steps t.

    With the means A of H_t and b of H_t x_t − g_t, the minimum solves A x = b. After k models, the next one has the weight (1 + r) / (k +
    1 + r), so that weights grow as k^r; from 8 models on with another r. Near the solution the noise of n steps then decreases as 1 / √n,
    without a learning rate or a known length of the run. After a step of length m the weight is at least m² / (1 + m²), and k is reduced
    to match, because models are valid where they were made. With exact models of a quadratic loss, the first step is Newton's.

    With noisy derivatives (`HessianNoise`, N), the step is (A + σ N)⁻¹ (b − A x), with the mean of N and the sum σ of the models' squared
    weights. σ N is what noise would add to A if A were built from the mean derivatives. Directions that consist of noise hardly move
    until there are enough steps. A + σ N is scaled to a unit diagonal, and the magnitudes of its eigenvalues are at least `damping` times
    the largest. A damped direction takes more steps to the same solution.

    Parameters that A does not connect take separate steps, each in its own trust region: the minimum of the model for ‖s‖ <= Δ. Lengths
    are in coordinates x / η, see `Newton`. The widths of differences are its σ (`Estimate.sigma`).

    Where images are linear in a parameter (`linear`), a model is exact at any distance, so Δ hardly limits its steps.

    Directions along which noise (`GradientNoise`) moves the minimum by more than Δ are damped, by s / (a Δ²) for the curvature a and the
    variance s of the mean gradient. Elements at a bound beyond which the model falls stay there, and the others take their minimum for
    that. A gradient that differs from the mean model's by more than noise allows reduces k, and so does a far smaller curvature.

    Δ shrinks after a long step if the new gradient shows that the loss rises along it, and grows while the loss falls. So averaging
    begins even where noise moves the minimum by more than the region.

    An estimate that is not finite is ignored. Takes O(n³) time and O(n²) memory for n parameters in total.

    Args:
        learning_rate: η, in units of the parameter, > 0, for the parameters without their own.
        averaging: r, >= 0. Larger ones forget more of the first models.
        settled_averaging: r from 8 models on, >= 0; None for `averaging`. After n steps the variance is 1.33 / n of that of one for 1, and
            1.8 / n for 2.
        trust_radius: Δ of the first step and upper limit of the later ones, > 0; None for no limit.
        damping: smallest eigenvalue relative to the largest, in (0, 1).
        linear: keys of parameters in which images are linear, such as radiances.
    """

    learning_rate: float = 1.0
    averaging: NotNegative = 2.0
    settled_averaging: NotNegative | None = None
    trust_radius: Positive | None = 2.0
    damping: OpenFraction = 1e-3
    linear: tuple[str, ...] = ()

    def __post_init__(self):
        object.__setattr__(self, "linear", checked_keys("AveragedNewton: linear", self.linear))
        check_rates("AveragedNewton", self.learning_rate, None)
        checks.fields(self)

    requires = Capabilities(Gradient, Hessian)

    def init(self, parameters: Tree, learning_rates: Mapping[str, float] | None = None) -> AveragedNewtonState:
        """Return the state before the first step. Raises `InputError` for an unknown parameter."""
        own = rates_of("AveragedNewton", parameters, self.learning_rate, learning_rates)
        if unknown := next((key for key in self.linear if key not in parameters), None):
            raise InputError(
                f'AveragedNewton: linear: unknown parameter "{unknown}"{did_you_mean(unknown, parameters)}'
            )
        n = trees.ravel(parameters).size
        square, row = np.zeros((n, n)), np.zeros(n)
        radii = np.full(n, self.trust_radius or 0.0)
        return AveragedNewtonState(
            own, square, row, square, square, row, row, row, square, radii, row, None, np.zeros(n, bool)
        )

    def update(
        self, estimate: Estimate, state: AveragedNewtonState, parameters: Tree
    ) -> tuple[Tree, AveragedNewtonState]:
        hessian = arrays.numpy(estimate.require("AveragedNewton", Hessian).matrix).astype(np.float64)
        gradient, x = trees.ravel(estimate.gradient), trees.ravel(parameters)
        if not (np.isfinite(hessian).all() and np.isfinite(gradient).all()):
            return trees.unravel(np.zeros_like(x), parameters), state
        hessian = 0.5 * (hessian + hessian.T)
        added, fluctuation, scores = (_finite(estimate.get(x)) for x in (HessianNoise, GradientNoise, ScoreCovariance))
        added, fluctuation = (np.zeros_like(hessian) if x is None else x for x in (added, fluctuation))
        scale = coordinate_scales(estimate, state, parameters, self.learning_rate)
        reaches = {key: _OF_LINEAR if key in self.linear else 1.0 for key in parameters}
        region = scale * trees.repeat_per_element(reaches, parameters)
        step, matrix, target = np.zeros_like(x), state.matrix.copy(), state.target.copy()
        noise, gradient_noise = state.noise.copy(), state.gradient_noise.copy()
        shares, counts = state.shares.copy(), state.counts.copy()
        lengths, scatter, radii = np.zeros_like(x), state.scatter.copy(), state.radii.copy()
        ignored = state.ignored.copy()
        outwards = sides_of_bounds(estimate, parameters)
        for block in _blocks((matrix != 0.0) | (hessian != 0.0)):
            both = np.ix_(block, block)
            if not ignored[block].any() and _is_outlier(fluctuation[both], gradient_noise[both]):
                ignored[block], lengths[block] = True, state.lengths[block]
                continue
            ignored[block] = False
            news = gradient[block] - (matrix[both] @ x[block] - target[block])
            surprise = _surprise(news, fluctuation[both] + shares[block].max() * gradient_noise[both])
            surprise *= _outdated(matrix[both], hessian[both], added[both])
            count, length = counts[block].min() / surprise, state.lengths[block].max()
            growth = self._growth(count)
            weight = max((1.0 + growth) / (count + 1.0 + growth), length * length / (1.0 + length * length))
            scatter[both] *= (1.0 - weight) ** 2
            if counts[block].min() > 0.0:
                scatter[both] += weight**2 * np.outer(news, news) / (1.0 + shares[block].max())
            counts[block] = self._count(weight)
            matrix[both] += weight * (hessian[both] - matrix[both])
            noise[both] += weight * (added[both] - noise[both])
            gradient_noise[both] += weight * (fluctuation[both] - gradient_noise[both])
            shares[block] = (1.0 - weight) ** 2 * shares[block] + weight**2
            target[block] += weight * (hessian[both] @ x[block] - gradient[block] - target[block])
            own = region[block]
            radii[block] = radius = self._radius(radii[block].min(), state.step[block] / own, own * gradient[block])
            slope = matrix[both] @ x[block] - target[block]
            damped = matrix[both] + shares[block].max() * noise[both]
            rough = shares[block].max() * gradient_noise[both]
            step[block] = own * self._step(
                own[:, None] * damped * own, own * slope, own[:, None] * rough * own, outwards[block], radius
            )
            lengths[block] = _length(x[block], step[block], scale[block], own > scale[block])
        return trees.unravel(step, parameters), AveragedNewtonState(
            state.learning_rates, matrix, target, noise, gradient_noise, shares, counts, lengths, scatter, radii, step, scores, ignored,
        )  # fmt: skip

    def averages(self, keys: Iterable[str], state: Any = None) -> frozenset[str]:
        return frozenset(keys)

    def standard_errors(self, state: AveragedNewtonState, parameters: Tree) -> Tree:
        """Return the standard errors of A⁻¹ b, from the scatter of the models' gradients about those of the mean.

        They cover the noise of the run and of the references, not the bias of finite differences. They are infinite for elements that
        change no image, and for those with a share in a direction that is damped, or whose curvature may be noise. {} if the last estimate
        has no `ScoreCovariance`. Parameters with fewer than 8 effective models, with models without noise, or still on the way to A⁻¹ b in
        a trust region that limits their steps, are omitted.
        """
        if state.scores is None:
            return {}
        errors, counts = (trees.parts(x[None], parameters) for x in self._errors(state, parameters))
        return {key: x[0] for key, x in errors.items() if counts[key].min() >= _FEWEST_MODELS and x.all()}

    def unsettled(self, state: AveragedNewtonState, parameters: Tree) -> frozenset[str]:
        """Return the parameters whose means have too few models for standard errors, after steps that are longer than these or that a
        region cuts."""
        # Weights by noise change from step to step. At noisy references they leave few models, too, but short steps.
        errors, counts = self._errors(state, parameters)
        long = np.abs(state.step) > np.where(np.isfinite(errors), errors, 0.0)
        short = (counts < _FEWEST_MODELS) & ((counts == 0.0) | long)
        return frozenset(key for key, x in trees.parts(short[None], parameters).items() if x.any())

    def _errors(self, state: AveragedNewtonState, parameters: Tree) -> tuple[np.ndarray, np.ndarray]:
        """Return the standard errors of A⁻¹ b, without the references' noise if that is unknown, and the effective number of models, (n,)
        each. The number is 0 for blocks that the trust region holds more than a standard error away from A⁻¹ b."""
        known = state.matrix.any(axis=1)  # the others are in no model
        x, errors, counts = trees.ravel(parameters), np.full(known.size, np.inf), np.where(known, state.counts, np.inf)
        held = (state.radii > 0.0) & (state.lengths >= _USED * state.radii)
        for block in _blocks(state.matrix != 0.0):
            both = np.ix_(block, block)
            if not np.diag(state.matrix[both]).all():
                continue
            scales, eigenvalues, directions = scaled_eigh(state.matrix[both])
            rough = state.shares[block].max() * state.noise[both] / scales
            hidden = _RESOLVED * np.einsum("ki,kl,li->i", directions, rough, directions)
            weak = eigenvalues <= np.maximum(self.damping * eigenvalues.max(), hidden)
            inverse = (directions / np.where(weak, np.inf, eigenvalues)) @ directions.T / scales
            middle = state.scatter[both] + (0.0 if state.scores is None else positive_part(state.scores[both]))
            error = np.sqrt(np.abs(np.diag(inverse @ middle @ inverse)))
            errors[block] = np.where((directions[:, weak] ** 2).sum(axis=1) > _WEAK_SHARE, np.inf, error)
            away = np.abs(inverse @ (state.matrix[both] @ x[block] - state.target[block]))
            if held[block].any() and (away > errors[block]).any():
                counts[block] = 0.0
        return errors, counts

    def _count(self, weight: float) -> float:
        """Return the effective number of models of a mean whose last model has this weight."""
        first, later = ((1.0 + self._growth(count)) * (1.0 / weight - 1.0) + 1.0 for count in (0.0, _FIRST_MODELS))
        return first if first <= _FIRST_MODELS else max(later, _FIRST_MODELS)

    def _growth(self, count: float) -> float:
        """Return the power of their number with which the weights of models grow."""
        return self.averaging if self.settled_averaging is None or count < _FIRST_MODELS else self.settled_averaging

    def _radius(self, radius: float, step: np.ndarray, gradient: np.ndarray) -> float:
        """Return the next radius of a block's trust region, from the gradient at the end of its last step.

        If the loss rises there, along a step that used the region, the radius shrinks. If it still falls, the radius grows again.
        """
        length = float(np.linalg.norm(step))
        if self.trust_radius is None or length < _USED * radius:
            return radius
        change = _SHRINK if float(step @ gradient) > 0.0 else _GROW
        return min(change * radius, self.trust_radius)

    def _step(
        self, matrix: np.ndarray, gradient: np.ndarray, noise: np.ndarray, outwards: np.ndarray, radius: float
    ) -> np.ndarray:
        """Return the step of one block, in units of the trust region. Elements at a bound that would leave it stay there."""
        step, free = np.zeros_like(gradient), np.full(gradient.size, True)
        while free.any():
            both = np.ix_(free, free)
            step[:] = 0.0
            step[free] = self._solve(matrix[both], gradient[free], noise[both], radius)
            leaving = free & (step * outwards > 0.0)
            if not leaving.any():
                break
            free &= ~leaving
            step[leaving] = 0.0
        return step

    def _solve(self, matrix: np.ndarray, gradient: np.ndarray, noise: np.ndarray, radius: float) -> np.ndarray:
        """Return the minimum of the model in the trust region."""
        units = np.sqrt(np.abs(np.diag(matrix)))
        if not units.all():
            return np.zeros_like(gradient)
        eigenvalues, eigenvectors = np.linalg.eigh(matrix / np.outer(units, units))
        curvatures = np.abs(eigenvalues)
        curvatures = np.maximum(curvatures, self.damping * curvatures.max())
        hessian = units[:, None] * (eigenvectors * curvatures) @ eigenvectors.T * units
        curvatures, eigenvectors = np.linalg.eigh(0.5 * (hessian + hessian.T))
        curvatures = np.maximum(curvatures, 0.0)
        if self.trust_radius is not None and curvatures.all():
            variances = np.einsum("ki,kl,li->i", eigenvectors, noise, eigenvectors)
            curvatures = curvatures + variances / (curvatures * self.trust_radius**2)
        return eigenvectors @ trust_region_step(
            curvatures, eigenvectors.T @ gradient, None if self.trust_radius is None else radius
        )


def _length(x: np.ndarray, step: np.ndarray, scale: np.ndarray, linear: np.ndarray) -> float:
    """Return the length of a step, in units of `scale`, or relative to its end where images are linear, whichever is longer.

    The noise of a model is proportional to its distance from the solution. So a model of a lamp ten times too bright must not remain in
    the mean. The step from it may be short in units of the widths, since these are large there, too.
    """
    relative = step[linear] / (np.abs(x + step) + _OF_WIDTH * scale)[linear]
    return max(float(np.linalg.norm(step / scale)), float(np.linalg.norm(relative)))


def _is_outlier(noise: np.ndarray, mean: np.ndarray) -> bool:
    """Return whether a gradient has far more noise (n, n) than those before, as by a path that finds the sun by chance.

    Its gradient would move the mean, and its noise would hide for many steps that the mean is outdated.
    """
    usual = np.diag(mean)
    return bool(usual.all() and (np.diag(noise) > _OUTLIER * usual).any())


def _surprise(news: np.ndarray, noise: np.ndarray) -> float:
    """Return the factor by which a gradient differs from that of the mean model by more than noise (n, n) allows, squared; at least 1.

    The scene is then less quadratic than the mean model, whose oldest parts are to be forgotten.
    """
    units = np.sqrt(np.diag(noise))
    if not (np.isfinite(noise).all() and units.all()):
        return 1.0
    inverse = np.linalg.pinv(noise / np.outer(units, units), rcond=_LEAST_NOISE, hermitian=True)
    square = float((news / units) @ inverse @ (news / units)) / news.size
    return max(square - _SURPRISE_ERRORS * math.sqrt(2.0 / news.size), 1.0)


def _outdated(mean: np.ndarray, hessian: np.ndarray, noise: np.ndarray) -> float:
    """Return the ratio of the curvature of the mean model to that of a new one with its noise, (n, n) each, over `_MOST_CURVATURE`; at
    least 1.

    The edge of a lamp that was in the picture, for example, leaves a curvature that holds the lamp beside it.
    """
    new = np.abs(np.diag(hessian)) + _CURVATURE_ERRORS * np.diag(noise)
    old = np.diag(mean)
    ratios = np.divide(old, new, out=np.zeros_like(old), where=new > 0.0)
    return max(float(ratios.max(initial=0.0)) / _MOST_CURVATURE, 1.0)


def _finite(capability: GradientNoise | HessianNoise | ScoreCovariance | None) -> np.ndarray | None:
    """Return the matrix of a capability in double precision; None if there is none, or it is not finite."""
    if capability is None:
        return None
    matrix = arrays.numpy(capability.matrix).astype(np.float64)
    return matrix if np.isfinite(matrix).all() else None


def _blocks(connected: np.ndarray) -> list[np.ndarray]:
    """Return the connected components of a symmetric adjacency matrix (n, n), as lists of elements; isolated ones are omitted."""
    from scipy.sparse.csgraph import connected_components

    number, labels = connected_components(connected, directed=False)
    blocks = [np.flatnonzero(labels == label) for label in range(number)]
    return [block for block in blocks if connected[np.ix_(block, block)].any()]
