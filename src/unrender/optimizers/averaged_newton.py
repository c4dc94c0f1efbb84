"""Newton's method on the mean of all quadratic models so far: recursive least squares."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from unrender.core import arrays, checks, vectors
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import Capabilities, Gradient, Hessian, HessianNoise
from unrender.optimizers import rates
from unrender.optimizers.directions import coordinate_scales
from unrender.optimizers.newton import trust_region_step

_FEWEST_MODELS = 8.0
"""Models in the mean from which on their scatter tells a standard error."""
_WEAK_SHARE = 0.01
"""Share of an element in directions that are held back, as a square, from which on it has no standard error."""


@dataclass(frozen=True)
class AveragedNewtonState:
    """State between steps.

    Attributes:
        learning_rates: of each parameter: its scale.
        matrix: A, the mean of the Hessians, (n, n), double precision on the host.
        target: b, the mean of H x - g, (n,): the mean model is least where A x = b.
        noise: the mean of what noise adds to squares of derivatives, (n, n), see `HessianNoise`.
        shares: of that, what is left in the mean, (n,): the sum of the squared weights of its models.
        counts: how many models each element's mean is of, (n,); fewer where steps have been long.
        lengths: of the last step, in units of the trust region, of the elements that moved together, (n,).
        scatter: covariance of `target` by noise, (n, n): the sum over models of their squared weights times the squared difference of
            each model's gradient from that of the mean before it.
    """

    learning_rates: dict[str, float]
    matrix: np.ndarray
    target: np.ndarray
    noise: np.ndarray
    shares: np.ndarray
    counts: np.ndarray
    lengths: np.ndarray
    scatter: np.ndarray


@register
@dataclass(frozen=True)
class AveragedNewton:
    """The minimum of the weighted mean of the quadratic models g_tᵀ (x − x_t) + (x − x_t)ᵀ H_t (x − x_t) / 2 of all steps t.

    With A and b the means of H_t and H_t x_t − g_t, it is where A x = b. In the mean, the new model has the weight (1 + r) / (k + 1 + r)
    after k others, so that models count by about k^r, and near the solution the noise of n steps falls as 1 / √n, with no learning rate
    and no length of the run to be known. After a step of length m it has the weight m² / (1 + m²) at least, and k falls to what that
    stands for: models are of where they were made. With exact models of a quadratic loss, the first step is Newton's.

    Where derivatives are noisy (`HessianNoise`, N), the step is (A + σ N)⁻¹ (b − A x), with the mean of N and the sum σ of the squared
    weights of the models: what noise would add to A if it were made of the mean derivatives. So directions that are noise alone hardly
    move, until enough steps tell more. A + σ N is taken in coordinates in which its diagonal is 1, with the magnitudes of its
    eigenvalues, none below `damping` times the largest. A damped direction takes more steps, and ends at the same place.

    Parameters that A does not connect take steps of their own, each within its own trust region: the minimum of the model for
    ‖s‖ <= Δ. Lengths are in the coordinates x / η with each parameter's learning rate η, times the σ of smoothed derivatives or the
    widths of differences (`Estimate.sigma`).

    An estimate that is not finite counts for nothing. Costs O(n³) time and O(n²) memory for n parameters in all.

    Args:
        learning_rate: η, in units of the parameter, > 0; for the parameters without their own.
        averaging: r, >= 0.
        trust_radius: Δ, > 0; None for no limit. Where noise alone moves the minimum by more than 1, nothing is averaged: a Δ below 1,
            such as 0.3, averages there, too.
        damping: in (0, 1).
    """

    learning_rate: float = 1.0
    averaging: float = 2.0
    trust_radius: float | None = 2.0
    damping: float = 1e-3

    def __post_init__(self):
        rates.check("AveragedNewton", self.learning_rate, None)
        checks.number("AveragedNewton", "averaging", self.averaging, above=0.0, inclusive=True)
        checks.number("AveragedNewton", "damping", self.damping, above=0.0, below=1.0)
        if self.trust_radius is not None:
            checks.number("AveragedNewton", "trust_radius", self.trust_radius, above=0.0)

    @property
    def requires(self) -> Capabilities:
        """A gradient and its Hessian."""
        return Capabilities(Gradient, Hessian)

    def init(self, parameters: Tree, learning_rates: Mapping[str, float] | None = None) -> AveragedNewtonState:
        own = rates.per_parameter("AveragedNewton", parameters, self.learning_rate, learning_rates)
        n = vectors.ravel(parameters).size
        square, row = np.zeros((n, n)), np.zeros(n)
        return AveragedNewtonState(own, square, row, square, row, row, row, square)

    def update(
        self, estimate: Estimate, state: AveragedNewtonState, parameters: Tree
    ) -> tuple[Tree, AveragedNewtonState]:
        """See `Optimizer.update`. On the host."""
        hessian = arrays.numpy(estimate.require("AveragedNewton", Hessian).matrix).astype(np.float64)
        gradient, x = vectors.ravel(estimate.gradient), vectors.ravel(parameters)
        if not (np.isfinite(hessian).all() and np.isfinite(gradient).all()):
            return vectors.unravel(np.zeros_like(x), parameters), state
        hessian = 0.5 * (hessian + hessian.T)
        found = estimate.get(HessianNoise)
        added = np.zeros_like(hessian) if found is None else arrays.numpy(found.matrix).astype(np.float64)
        if not np.isfinite(added).all():
            added = np.zeros_like(hessian)
        scale = coordinate_scales(estimate, state, parameters)
        step, matrix, target = np.zeros_like(x), state.matrix.copy(), state.target.copy()
        noise, shares, counts = state.noise.copy(), state.shares.copy(), state.counts.copy()
        lengths, scatter = np.zeros_like(x), state.scatter.copy()
        for block in _blocks((matrix != 0.0) | (hessian != 0.0)):
            both = np.ix_(block, block)
            weight = self._weight(counts[block].min(), state.lengths[block].max())
            scatter[both] *= (1.0 - weight) ** 2
            if counts[block].min() > 0.0:
                news = gradient[block] - (matrix[both] @ x[block] - target[block])
                scatter[both] += weight**2 * np.outer(news, news) / (1.0 + shares[block].max())
            counts[block] = (1.0 + self.averaging) * (1.0 / weight - 1.0) + 1.0
            matrix[both] += weight * (hessian[both] - matrix[both])
            noise[both] += weight * (added[both] - noise[both])
            shares[block] = (1.0 - weight) ** 2 * shares[block] + weight**2
            target[block] += weight * (hessian[both] @ x[block] - gradient[block] - target[block])
            own = scale[block]
            slope = matrix[both] @ x[block] - target[block]
            damped = matrix[both] + shares[block].max() * noise[both]
            moved = self._solve(own[:, None] * damped * own, own * slope)
            lengths[block] = np.linalg.norm(moved)
            step[block] = own * moved
        return vectors.unravel(step, parameters), AveragedNewtonState(
            state.learning_rates, matrix, target, noise, shares, counts, lengths, scatter
        )

    def standard_errors(self, state: AveragedNewtonState, parameters: Tree) -> Tree:
        """See `Measuring`: of A⁻¹ b, from the scatter of the models' gradients about those of the mean.

        It is of the run's own noise, not of the references', nor of what differences of a width leave out. It needs some ten models.
        Parameters with a share in a direction that `damping` holds back have none: the step there is not the whole one to A⁻¹ b.
        """
        errors = np.full(len(state.matrix), np.nan)
        for block in _blocks(state.matrix != 0.0):
            both = np.ix_(block, block)
            units = np.sqrt(np.abs(np.diag(state.matrix[both])))
            if not units.all():
                continue
            eigenvalues, directions = np.linalg.eigh(state.matrix[both] / np.outer(units, units))
            weak = eigenvalues <= self.damping * eigenvalues.max()
            inverse = (directions / np.where(weak, np.inf, eigenvalues)) @ directions.T / np.outer(units, units)
            found = np.sqrt(np.abs(np.diag(inverse @ state.scatter[both] @ inverse)))
            errors[block] = np.where((directions[:, weak] ** 2).sum(axis=1) > _WEAK_SHARE, np.nan, found)
        split = vectors.parts(errors[None], parameters)
        counts = vectors.parts(state.counts[None], parameters)
        return {
            key: x[0]
            for key, x in split.items()
            if counts[key].min() >= _FEWEST_MODELS and np.isfinite(x).all() and x.all()
        }

    def _weight(self, count: float, length: float) -> float:
        """Of a model in the mean, after so many others and a step of this length."""
        usual = (1.0 + self.averaging) / (count + 1.0 + self.averaging)
        return max(usual, length * length / (1.0 + length * length))

    def _solve(self, matrix: np.ndarray, gradient: np.ndarray) -> np.ndarray:
        """The step of one block, in coordinates in units of the trust region."""
        units = np.sqrt(np.abs(np.diag(matrix)))
        if not units.all():
            return np.zeros_like(gradient)
        eigenvalues, eigenvectors = np.linalg.eigh(matrix / np.outer(units, units))
        curvatures = np.abs(eigenvalues)
        curvatures = np.maximum(curvatures, self.damping * curvatures.max())
        whole = units[:, None] * (eigenvectors * curvatures) @ eigenvectors.T * units
        curvatures, eigenvectors = np.linalg.eigh(0.5 * (whole + whole.T))
        return eigenvectors @ trust_region_step(
            np.maximum(curvatures, 0.0), eigenvectors.T @ gradient, self.trust_radius
        )


def _blocks(connected: np.ndarray) -> list[np.ndarray]:
    """The elements that are connected, directly or by others, from a symmetric matrix of pairs (n, n); those without any are left out."""
    from scipy.sparse.csgraph import connected_components

    number, labels = connected_components(connected, directed=False)
    blocks = [np.flatnonzero(labels == label) for label in range(number)]
    return [block for block in blocks if connected[np.ix_(block, block)].any()]
