"""Derivatives of the loss from renders at perturbed parameters alone, smoothed by a Gaussian (Wang et al., section 3)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from unrender import smoothing as smoothed
from unrender.core import checks, vectors
from unrender.core.errors import InputError
from unrender.core.random import Key
from unrender.core.registry import register
from unrender.core.suggestions import did_you_mean
from unrender.core.trees import Tree
from unrender.estimators.base import GRADIENT, HESSIAN, HVP, LOSSES, VARIANCE, Estimate
from unrender.estimators.loss_values import BlackBox
from unrender.problem.problem import Problem
from unrender.problem.upsampling import Upsampler
from unrender.schedules.functions import Schedule

_Derivatives = tuple[tuple[np.ndarray, np.ndarray], Callable[[], np.ndarray], Callable[[np.ndarray], np.ndarray]]
"""Gradient with standard error, what makes the Hessian, what makes its product with a vector."""


@dataclass(frozen=True)
class SmoothedState:
    """State between steps.

    Attributes:
        age: what the schedule of σ is asked for: the steps made or, with `arrival`, the sum of how far each had arrived.
    """

    age: float = 0.0

    def upsampled(self, upsampler: Upsampler) -> SmoothedState:
        """See `Upsamplable`: nothing in it has a parameter's shape."""
        del upsampler
        return self

    def restarted(self, fresh: SmoothedState) -> SmoothedState:
        """See `Restartable`: the schedule of σ goes on."""
        del fresh
        return self


@register
@dataclass(frozen=True)
class SmoothedDerivatives:
    """∇ S L, and ∇² S L or its products with vectors: S smooths the loss L over the parameters by a Gaussian of deviation σ.

    The renderer is a black box: no derivative of it is asked for, so plateaus, silhouettes, shadows and poses (`rendering/poses.py`)
    count. All perturbations of a step share the random numbers of their renders, so that differences are of the parameters and not of
    the noise. Perturbed parameters are moved into their bounds before they are rendered.

    Unbiased for the derivative of the smoothed expected loss of images at `spp` samples, whose noise adds to the loss; but
    products that are not `together` have the bias of their central difference (`smoothed.hvp`).

    Args:
        sigma: σ in units of the parameters, > 0: one number, or {key: number}, where "*" stands for all keys that are not named.
        samples: renders per view and derivative, >= 4; without `aggregate`, per element of the derivative too.
        order: "gradient", "hessian" (n × n, for few parameters), or "hvp".
        aggregate: one draw from the mixture over all elements serves all of them (section 3.5); otherwise each element has its own.
        product: every dimension from its own gradient kernel at once, in place of `aggregate`: the gradient of Fischer and
            Ritschel 2023, "FR22" in the paper, whose smoothing is not a Gaussian's; gradients only.
        together: with "hessian" and "hvp", gradient and curvature from the same renders (`smoothed.together`), so that curvature costs
            nothing. Without, as the paper has it: a Hessian from draws of its own, products by the difference of two gradients, each
            taking twice `samples` renders. `aggregate` and `baseline` are for that.
        antithetic, baseline, low_discrepancy: see `unrender.smoothed`.
        spp: samples per pixel of a render, >= 1.
        epsilon: of products by differences, in units of σ, > 0 (see `unrender.smoothed.hvp`): pictures of edges jump, so more than the
            default there.
        schedule: factor of σ by step, e.g. `schedules.Exponential(100)`; see `unrender.schedules.functions`.
        arrival: let time stand still for the schedule until the descent arrives: a step counts by how far the loss here is below those
            of the perturbations around it, which the gradient has rendered anyway: by the mean of the differences over their root mean
            square, if positive. That is near 1 at a minimum of the smoothed loss (0.6 to 0.8 for one parameter, with noise less),
            and 0 on a slope or a plateau, of whatever length. So σ shrinks where it is at home and no sooner; half-lives are shorter,
            e.g. `Exponential(6)`. For few parameters: with many, the bowl in all other directions outweighs the slope in one, and time
            always passes.
    """

    sigma: float | Mapping[str, float]
    samples: int = 32
    order: Literal["gradient", "hessian", "hvp"] = "gradient"
    aggregate: bool = True
    product: bool = False
    together: bool = True
    antithetic: bool = True
    baseline: bool = True
    low_discrepancy: bool = False
    spp: int = 4
    epsilon: float = 0.3
    schedule: Schedule | None = None
    arrival: bool = False

    def __post_init__(self):
        if self.order not in ("gradient", "hessian", "hvp"):
            raise InputError(f'SmoothedDerivatives: order must be "gradient", "hessian" or "hvp", got {self.order!r}')
        if self.product and self.order != "gradient":
            raise InputError(f'SmoothedDerivatives: product=True goes with order="gradient", got {self.order!r}')
        for name, value in self.sigma.items() if isinstance(self.sigma, Mapping) else [("sigma", self.sigma)]:
            checks.number("SmoothedDerivatives", f"sigma of {name}" if name != "sigma" else name, value, above=0.0)
        checks.integer("SmoothedDerivatives", "samples", self.samples, at_least=16 if self.low_discrepancy else 4)
        checks.integer("SmoothedDerivatives", "spp", self.spp, at_least=1)
        checks.number("SmoothedDerivatives", "epsilon", self.epsilon, above=0.0)

    @property
    def provides(self) -> frozenset[str]:
        """A gradient with its variance, the loss at any points, and what `order` says."""
        return frozenset({GRADIENT, VARIANCE, LOSSES, *{"hessian": [HESSIAN], "hvp": [HVP]}.get(self.order, [])})

    def init(self, problem: Problem, parameters: Tree) -> SmoothedState:
        """See `Estimator.init`. Raises `InputError` where a parameter cannot be perturbed, has a preconditioner, or has no σ."""
        for key in problem.preconditioners:
            raise InputError(
                f"SmoothedDerivatives: parameter {key} has a preconditioner; leave it out, σ smooths already"
            )
        problem.renderer.select(list(parameters), None, derivatives=False)
        self._widths(parameters)
        return SmoothedState()

    def estimate(
        self, problem: Problem, parameters: Tree, state: SmoothedState, key: Key
    ) -> tuple[Estimate, SmoothedState]:
        """See `Estimator.estimate`. `info`: "samples" (paths traced, those of products included), "images" per view
        at the parameters themselves."""
        box = BlackBox(problem, parameters, self.spp, key.fold(0))
        factor = self.schedule(state.age) if self.schedule else 1.0
        width = {k: factor * number for k, number in self._widths(parameters).items()}
        theta, sigma = vectors.ravel(parameters), vectors.spread(width, parameters)
        heard: list[np.ndarray] = []

        def listen(points: np.ndarray) -> np.ndarray:
            heard.append(box.losses(points))
            return heard[-1]

        ask = self._together if self.together and self.order != "gradient" else self._apart
        (gradient, error), hessian, product = ask(listen, theta, sigma, key.fold(1).uint32())
        around = np.concatenate(heard)
        found = Estimate(
            box.here(),
            vectors.unravel(gradient, parameters),
            vectors.unravel(error**2, parameters),
            hessian() if self.order == "hessian" else None,
            (lambda v: vectors.unravel(product(vectors.ravel(v)), parameters)) if self.order == "hvp" else None,
            box.losses,
            width,
            info=box.info,
        )
        return found, SmoothedState(state.age + (_arrival(around, found.loss) if self.arrival else 1.0))

    def _together(self, f: smoothed.Function, theta: np.ndarray, sigma: np.ndarray, seed: int) -> _Derivatives:
        """The gradient with its standard error, and how to get the others: from the same renders."""
        found = smoothed.together(f, theta, sigma, self.samples, seed, self.low_discrepancy)
        return found.gradient(), lambda: found.hessian()[0], lambda v: found.hvp(v)[0]

    def _apart(self, f: smoothed.Function, theta: np.ndarray, sigma: np.ndarray, seed: int) -> _Derivatives:
        """Likewise, each from renders of its own."""
        point = (f, theta, sigma, self.samples, seed, self.aggregate)
        options: dict[str, Any] = {"antithetic": self.antithetic, "low_discrepancy": self.low_discrepancy}
        gradient = smoothed.gradient(*point, product=self.product, baseline=self.baseline, **options)

        def product(v: np.ndarray) -> np.ndarray:
            samples = 2 * self.samples
            return smoothed.hvp(f, theta, v, sigma, samples, seed, self.aggregate, epsilon=self.epsilon, **options)[0]

        return gradient, lambda: smoothed.hessian(*point, baseline=self.baseline, **options)[0], product

    def _widths(self, parameters: Tree) -> dict[str, float]:
        """σ of each parameter at the start."""
        if not isinstance(self.sigma, Mapping):
            return dict.fromkeys(parameters, float(self.sigma))
        for key in self.sigma:
            if key != "*" and key not in parameters:
                hint = did_you_mean(key, parameters)
                raise InputError(f"SmoothedDerivatives: sigma names {key}, which is none of the parameters{hint}")
        missing = [key for key in parameters if key not in self.sigma and "*" not in self.sigma]
        if missing:
            raise InputError(f"SmoothedDerivatives: sigma has no entry for parameter {missing[0]}")
        return {key: float(self.sigma[key] if key in self.sigma else self.sigma["*"]) for key in parameters}


def _arrival(around: np.ndarray, here: float) -> float:
    """How much better a point is than those around it, 0 to 1: the mean of their losses' differences over its root mean square."""
    worse = around - here
    size = float(np.sqrt(np.mean(worse * worse)))
    return max(0.0, float(np.mean(worse))) / size if size > 0.0 else 0.0
