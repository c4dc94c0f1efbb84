"""Derivatives of the loss, smoothed by a Gaussian, from renders at perturbed parameters (Wang et al., section 3)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from unrender.core import checks, trees
from unrender.core.checks import Positive
from unrender.core.errors import InputError
from unrender.core.random import Key
from unrender.core.registry import register
from unrender.core.text import did_you_mean
from unrender.core.trees import Tree
from unrender.estimators import smoothing as smoothed
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import (
    Capabilities,
    Capability,
    Gradient,
    Hessian,
    HessianProduct,
    LossFunction,
    Smoothing,
    Variance,
)
from unrender.estimators.coordinates import PreconditionedPerturbations
from unrender.estimators.loss_values import BlackBox
from unrender.estimators.smoothing.function import (
    estimate_gradient,
    estimate_gradient_and_product,
    estimate_hessian,
    estimate_hvp,
)
from unrender.estimators.smoothing.sampling import SamplingOptions
from unrender.scene.problem import Problem
from unrender.scene.upsampling import Upsampler
from unrender.schedules import Schedule, schedule_factor

_MAX_STORED = 4096  # maximum number of parameters for which a Hessian is stored between steps
_DIRECTIONS = 1  # stream of random numbers for the directions of products; 0 is for the perturbations


@dataclass(frozen=True)
class SmoothedState:
    """State between steps.

    Attributes:
        age: argument of the schedule of σ: the number of steps or, with `adaptive_annealing`, the sum of their convergence measures.
        hessian: with `hessian_rate`, the Hessian stored between steps, in units of σ, (n, n), or its diagonal, (n,); None before the
            first step.
    """

    age: float = 0.0
    hessian: np.ndarray | None = None

    def upsampled(self, upsampler: Upsampler) -> SmoothedState:
        return replace(self, hessian=None)

    def restarted(self, fresh: SmoothedState) -> SmoothedState:
        return replace(self, hessian=fresh.hessian)


@register
@dataclass(frozen=True)
class SmoothedDerivatives:
    """∇ S L, and ∇² S L or its products with vectors: S smooths the loss L over the parameters by a Gaussian of standard deviation σ.

    The renderer is a black box and never differentiated, so plateaus, silhouettes, shadows and poses (`rendering/mitsuba/poses.py`) are
    supported. All perturbations of a step share the random numbers of their renders, so differences are due to the parameters, not to
    noise. Perturbed parameters are projected onto their bounds before they are rendered.

    A parameter with a preconditioner S is perturbed by S ε instead of ε, scaled to σ in the root mean square, so neighbouring vertices or
    texels move together. Derivatives are then with respect to v, where the parameter is S v; the smoothing Gaussian has covariance S². Use
    it for meshes and textures of thousands of elements: the noise of a gradient grows with the number of directions, which S reduces.

    Unbiased for the derivative of the smoothed expected loss of images at `spp` samples. Their noise adds to the loss unless it is
    `debiased`. Products that are not `joint` have the bias of their central difference (`smoothed.hvp`).

    Args:
        sigma: σ in units of the parameters, > 0 (with a preconditioner the root mean square of a perturbation): one number, or
            {key: number}, where "*" stands for all keys that are not named.
        samples: renders per view and derivative, >= 4; without `aggregate`, per element of the derivative as well.
        order: "gradient", "hessian" (n × n, for few parameters), or "hvp".
        aggregate: one sample of the mixture over all elements serves all of them (section 3.5); otherwise each element has its own.
        product: sample every dimension from its own gradient kernel at once, instead of `aggregate`: the gradient of Fischer and
            Ritschel 2023, "FR22" in the paper, whose smoothing kernel is not a Gaussian; gradients only.
        joint: with "hessian" and "hvp", gradient and curvature from the same renders (`smoothed.joint`), so curvature is free.
            Otherwise, as in the paper, a Hessian has its own samples, and products are differences of two gradients, each with twice
            `samples` renders. `aggregate` and `baseline` apply to the latter.
        antithetic, baseline, low_discrepancy: see `unrender.smoothed`.
        spp: samples per pixel of a render, >= 1.
        debiased: remove the noise bias of the loss: from two halves of the samples with mean images A and B, the
            loss is 2 L((A + B) / 2) − (L(A) + L(B)) / 2. Unbiased for a loss that is quadratic in the image (`loss.linear`); for other
            smooth losses the remaining bias is of fourth order in the noise. Takes two launches, and at least 2 samples.
        epsilon: ε of products by differences, in units of σ, > 0 (see `unrender.smoothed.hvp`): images are discontinuous at edges, so
            it is larger than the default there.
        schedule: factor of σ by step, e.g. `schedules.Exponential(100)`; see `unrender.schedules`.
        adaptive_annealing: advance the schedule of σ by convergence instead of steps. A step advances it by the mean over the root
            mean square, if positive, of the losses at the perturbed points minus the loss at the parameters, which the gradient has
            evaluated already. This measure is near 1 at a minimum of the smoothed loss (0.6 to 0.8 for one parameter, less with noise),
            and 0 on a slope or a plateau of any length. σ therefore decreases after convergence at the current σ. Half-lives are
            shorter, e.g. `Exponential(6)`. Use it for few parameters: with many, the curvature in all other directions dominates the
            slope in one, and the schedule advances at every step.
        hessian_rate: ω in (0, 1], for "hvp": products use a Hessian that is stored between steps in units of σ, (n, n), so all products of
            a step are free. None, the default: products use this step's renders only. With `joint`, the stored matrix B moves by ω towards
            this step's Hessian. Otherwise each step estimates one product h along a random direction v, by the difference of two gradients
            whose mean is the step's gradient, with `samples` renders for both in one launch, and moves B by ω towards the nearest symmetric
            matrix with B v = h (Powell's symmetric Broyden update; Gower and Richtárik 2017 on random directions). The first B is vᵀh times
            the identity. Costs n² memory, and is refused above 4096 parameters. Old curvature biases products, not the gradient.
        hessian_form: "full", or "diagonal": with `hessian_rate`, only the diagonal is stored, (n,), for many weakly coupled parameters.
            Each sample determines one sum of its elements: zᵀ B z if joint, zᵀ B v otherwise. A step moves the diagonal by ω towards
            the nearest one that satisfies all sums; the first is a multiple of the identity (`updated_hessian`).
            Products use this diagonal with elements of at least 0.15 times their mean magnitude, so that it is positive definite.
        orthogonal: see `smoothed.gradient`: with `aggregate` or `joint`, sample orthogonal directions. Use it for many parameters and
            samples: 2 n of them (4 n for products that are not joint) determine the full gradient of a linear loss.
    """

    sigma: float | Mapping[str, float]
    samples: int = 32
    order: Literal["gradient", "hessian", "hvp"] = "gradient"
    aggregate: bool = True
    product: bool = False
    joint: bool = True
    antithetic: bool = True
    baseline: bool = True
    low_discrepancy: bool = False
    spp: int = 4
    epsilon: Positive = 0.3
    schedule: Schedule | None = None
    adaptive_annealing: bool = False
    debiased: bool = False
    hessian_rate: Positive | None = None
    hessian_form: Literal["full", "diagonal"] = "full"
    orthogonal: bool = False

    def __post_init__(self):
        checks.fields(self)
        if self.product and self.order != "gradient":
            raise InputError(f'SmoothedDerivatives: product=True requires order="gradient", got {self.order!r}')
        for name, value in self.sigma.items() if isinstance(self.sigma, Mapping) else [("sigma", self.sigma)]:
            checks.number("SmoothedDerivatives", f"sigma of {name}" if name != "sigma" else name, value, above=0.0)
        checks.integer("SmoothedDerivatives", "samples", self.samples, at_least=16 if self.low_discrepancy else 4)
        checks.integer("SmoothedDerivatives", "spp", self.spp, at_least=2 if self.debiased else 1)
        if self.hessian_form == "diagonal" and self.hessian_rate is None:
            raise InputError('SmoothedDerivatives: hessian_form="diagonal" requires hessian_rate')
        if self.order == "gradient":
            checks.without_effect(self, ("joint", "epsilon"), 'order="hessian" or "hvp"')
        joint = self.joint and self.order != "gradient"
        if self.orthogonal and (self.low_discrepancy or not (joint or self.aggregate) or self.product):
            raise InputError(
                "SmoothedDerivatives: orthogonal requires aggregate, and neither low_discrepancy nor product"
            )
        if self.hessian_rate is not None:
            if self.hessian_rate > 1.0:
                raise InputError(f"SmoothedDerivatives: hessian_rate must be at most 1, got {self.hessian_rate!r}")
            if self.order != "hvp":
                raise InputError(f'SmoothedDerivatives: hessian_rate requires order="hvp", got {self.order!r}')
            if not (self.joint or (self.aggregate and self.antithetic)):
                raise InputError("SmoothedDerivatives: hessian_rate requires aggregate and antithetic")

    @property
    def provides(self) -> Capabilities:
        """A gradient with its variance and σ, the loss at any points, and the curvature that `order` selects."""
        common = (Gradient, Variance, LossFunction)
        match self.order:
            case "gradient":
                return Capabilities(*common)
            case "hessian":
                return Capabilities(*common, Hessian)
            case "hvp":
                return Capabilities(*common, HessianProduct)

    def init(self, problem: Problem, parameters: Tree) -> SmoothedState:
        """Return the state before the first step. Raise `InputError` if a parameter cannot be perturbed or has no σ, or if one has a
        preconditioner and one a parameterisation."""
        PreconditionedPerturbations(problem, parameters)
        problem.renderer.prepare(list(parameters), None, derivatives=False)
        self._sigma_per_parameter(parameters)
        size = trees.ravel(parameters).size
        if self.hessian_rate is not None and self.hessian_form == "full" and size > _MAX_STORED:
            raise InputError(
                f"SmoothedDerivatives: hessian_rate would store a matrix of {size} × {size} elements, which is too large; "
                f'leave it out above {_MAX_STORED} parameters, or use hessian_form="diagonal"'
            )
        return SmoothedState()

    def estimate(
        self, problem: Problem, parameters: Tree, state: SmoothedState, key: Key
    ) -> tuple[Estimate, SmoothedState]:
        """Return an estimate and the next state. `info`: "samples" (paths traced, including those of products), "images" per view at
        the parameters."""
        box = BlackBox(problem, parameters, self.spp, key.fold(0), self.debiased)
        factor = schedule_factor("SmoothedDerivatives", self.schedule, state.age)
        if factor == 0.0:
            raise InputError(
                f"SmoothedDerivatives: schedule must stay above 0, got 0 at step {state.age:g}; set its floor"
            )
        smooth = PreconditionedPerturbations(problem, parameters)
        sigma = {
            name: factor * value for name, value in smooth.deviations(self._sigma_per_parameter(parameters)).items()
        }
        evaluate, perturbed = smooth.by_coordinates(box.losses), []

        def record_losses(points: np.ndarray) -> np.ndarray:
            perturbed.append(evaluate(points))
            return perturbed[-1]

        point = trees.ravel(parameters), trees.repeat_per_element(sigma, parameters)
        seed, hessian = key.fold(1).uint32(), state.hessian
        if self.hessian_rate is not None:
            gradient, error, hessian = self._stored_hessian(record_losses, *point, seed, hessian, self.hessian_rate)
            width = point[1]
            if self.hessian_form == "diagonal":
                used, multiply = positive_diagonal(hessian), np.multiply
            else:
                used, multiply = hessian, np.matmul
            curvature = self._curvature(lambda: used, lambda v: multiply(used, v / width) / width, parameters)
        else:
            derive = self._joint if self.joint and self.order != "gradient" else self._separate
            gradient, error, curvature = derive(record_losses, *point, seed, parameters)
        losses = np.concatenate(perturbed)
        capabilities = (
            Variance(trees.unravel(error**2, parameters)),
            *curvature,
            LossFunction(evaluate),
            Smoothing(sigma),
        )
        estimate = Estimate(
            box.center(), trees.unravel(gradient, parameters), capabilities, box.info, preconditioned=bool(smooth)
        )
        age = state.age + (_convergence(losses, estimate.loss) if self.adaptive_annealing else 1.0)
        return estimate, SmoothedState(age, hessian)

    def _joint(
        self, f: smoothed.Function, theta: np.ndarray, sigma: np.ndarray, seed: int, like: Tree
    ) -> tuple[np.ndarray, np.ndarray, tuple[Capability, ...]]:
        """Return the gradient (n,), its standard error (n,), and the curvature that `order` selects, all from the same renders."""
        derivatives = smoothed.joint(f, theta, sigma, self.samples, seed, self.low_discrepancy, self.orthogonal)
        return *derivatives.gradient(), self._curvature(
            lambda: derivatives.hessian()[0], lambda v: derivatives.hvp(v)[0], like
        )

    def _separate(
        self, f: smoothed.Function, theta: np.ndarray, sigma: np.ndarray, seed: int, like: Tree
    ) -> tuple[np.ndarray, np.ndarray, tuple[Capability, ...]]:
        """Return the results of `_joint`, with separate renders for each derivative."""
        options = self._options(seed)
        gradient, error = estimate_gradient(f, theta, sigma, options)

        def product(v: np.ndarray) -> np.ndarray:
            return estimate_hvp(f, theta, v, sigma, replace(options, samples=2 * self.samples))[0]

        curvature = self._curvature(lambda: estimate_hessian(f, theta, sigma, options)[0], product, like)
        return gradient, error, curvature

    def _stored_hessian(
        self,
        f: smoothed.Function,
        theta: np.ndarray,
        sigma: np.ndarray,
        seed: int,
        stored: np.ndarray | None,
        rate: float,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the gradient (n,), its standard error (n,), and the updated Hessian in units of σ: (n, n), or its diagonal (n,)."""
        if self.joint:
            derivatives = smoothed.joint(f, theta, sigma, self.samples, seed, self.low_discrepancy, self.orthogonal)
            if self.hessian_form == "diagonal":
                rows, values = derivatives.draws * derivatives.draws, derivatives.curvatures
                return *derivatives.gradient(), updated_hessian(stored, rows, values, rate)
            hessian = derivatives.hessian()[0] * np.outer(sigma, sigma)
            return *derivatives.gradient(), hessian if stored is None else stored + rate * (hessian - stored)
        v = np.random.default_rng([seed, _DIRECTIONS]).standard_normal(theta.size)
        v /= np.linalg.norm(v)
        both = estimate_gradient_and_product(f, theta, sigma * v, sigma, self._options(seed))
        gradient, error, product = both.gradient, both.error, sigma * both.product
        if self.hessian_form == "diagonal":
            return gradient, error, updated_hessian(stored, both.draws * v, both.changes, rate)
        if stored is None:
            stored, rate = float(v @ product) * np.eye(theta.size), 1.0
        return gradient, error, symmetric_update(stored, v, product, rate)

    def _options(self, seed: int) -> SamplingOptions:
        return SamplingOptions(
            self.samples,
            seed,
            self.aggregate,
            self.antithetic,
            self.baseline,
            self.low_discrepancy,
            self.product,
            self.orthogonal,
            self.epsilon,
        )

    def _curvature(
        self, hessian: Callable[[], np.ndarray], product: Callable[[np.ndarray], np.ndarray], like: Tree
    ) -> tuple[Capability, ...]:
        match self.order:
            case "gradient":
                return ()
            case "hessian":
                return (Hessian(hessian()),)
            case "hvp":
                return (HessianProduct(lambda v: trees.unravel(product(trees.ravel(v)), like)),)

    def _sigma_per_parameter(self, parameters: Tree) -> dict[str, float]:
        """Return σ of each parameter before the schedule. Raise `InputError` for a key that is unknown or missing."""
        if not isinstance(self.sigma, Mapping):
            return dict.fromkeys(parameters, float(self.sigma))
        for key in self.sigma:
            if key != "*" and key not in parameters:
                hint = did_you_mean(key, parameters)
                raise InputError(f"SmoothedDerivatives: sigma names {key}, which is not a parameter{hint}")
        missing = [key for key in parameters if key not in self.sigma and "*" not in self.sigma]
        if missing:
            raise InputError(f"SmoothedDerivatives: sigma has no entry for parameter {missing[0]}")
        return {key: float(self.sigma[key] if key in self.sigma else self.sigma["*"]) for key in parameters}


def _convergence(losses: np.ndarray, center: float) -> float:
    """Return a measure of convergence at the current σ, in [0, 1]: mean over root mean square of `losses` (B,) minus the loss at the
    parameters; 0 if the mean is negative."""
    differences = losses - center
    root_mean_square = float(np.sqrt(np.mean(differences * differences)))
    return max(0.0, float(np.mean(differences))) / root_mean_square if root_mean_square > 0.0 else 0.0


# ---------------------------------------------------------------------- Hessian from curvatures along random directions
#
# A full matrix B moves towards the nearest symmetric matrix with B v = h, where h is the product of the Hessian with a direction v:
# Powell's symmetric Broyden update; Gower and Richtárik 2017 on random directions.
#
# For a diagonal H, zᵀ H v = Σᵢ zᵢ vᵢ Hᵢᵢ is linear in the diagonal, so each pair of directions gives one equation. A step moves the
# diagonal by a fraction ω of the smallest change, in the Euclidean norm, that satisfies all its equations. With one equation and v = z this
# is the quasi-Cauchy update of Zhu, Nazareth and Wolkowicz 1999; with several it is the block method of Kaczmarz. n independent equations
# determine the diagonal. The off-diagonal elements of H average out over steps if the directions have independent random signs.

LEAST = 0.15
"""Smallest usable element of a diagonal, relative to the mean magnitude of its elements."""
RIDGE = 0.01
"""Regularisation of the equations, relative to their mean squared row length. It damps equations that nearly repeat others."""


def symmetric_update(matrix: np.ndarray, v: np.ndarray, product: np.ndarray, rate: float) -> np.ndarray:
    """Return the symmetric B (n, n) moved by `rate` in (0, 1] towards the nearest symmetric one with B v = `product`, v a unit vector."""
    missing = product - matrix @ v
    update = np.outer(missing, v) + np.outer(v, missing) - float(v @ missing) * np.outer(v, v)
    return matrix + rate * update


def isotropic_fit(rows: np.ndarray, values: np.ndarray) -> float:
    """Return the least-squares solution c of rows · (c, c, ...) = values, with rows (B, n) and values (B,); 0 where every row sums to
    0."""
    sums = rows.sum(axis=1)
    square = float(sums @ sums)
    return float(sums @ values) / square if square > 0.0 else 0.0


def corrected_diagonal(diagonal: np.ndarray, rows: np.ndarray, values: np.ndarray, rate: float) -> np.ndarray:
    """Return the diagonal d (n,) moved by the fraction ω = `rate` in (0, 1] toward the nearest solution of A d = y.

    A is `rows` (B, n) and y is `values` (B,). The result is d + ω Aᵀ (A Aᵀ + ρ I)⁻¹ (y − A d), with ρ from `RIDGE`. Takes O(B² n + B³)
    time and O(B n + B²) memory.
    """
    gram = rows @ rows.T
    ridge = RIDGE * float(np.mean(np.diagonal(gram)))
    if ridge == 0.0:
        return diagonal.copy()
    gram[np.diag_indices(len(gram))] += ridge
    return diagonal + rate * (rows.T @ np.linalg.solve(gram, values - rows @ diagonal))


def updated_hessian(stored: np.ndarray | None, rows: np.ndarray, values: np.ndarray, rate: float) -> np.ndarray:
    """Return the diagonal after a step's equations, (n,): `corrected_diagonal`, from `isotropic_fit` if there is none yet.

    Args:
        stored: diagonal before the step, (n,), or None.
        rows, values, rate: see `corrected_diagonal`.
    """
    before = np.full(rows.shape[1], isotropic_fit(rows, values)) if stored is None else stored
    return corrected_diagonal(before, rows, values, rate)


def positive_diagonal(diagonal: np.ndarray) -> np.ndarray:
    """Clamp the elements of a diagonal (n,) to at least `LEAST` times their mean magnitude.

    The result is positive definite unless all elements are 0. Elements that are small or negative only because of noise would otherwise
    cause the longest steps.
    """
    return np.maximum(diagonal, LEAST * float(np.mean(np.abs(diagonal))))
