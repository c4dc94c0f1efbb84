"""Derivatives of the loss from renders at perturbed parameters alone, smoothed by a Gaussian (Wang et al., section 3)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from unrender import arrays, checks, flat, smoothed
from unrender.errors import InputError
from unrender.gradients.estimate import GRADIENT, HESSIAN, HVP, VARIANCE, Estimate
from unrender.keys import Key
from unrender.problem.bounds import project
from unrender.problem.problem import Problem
from unrender.rendering.port import Shot
from unrender.trees import Tree


@dataclass(frozen=True)
class SmoothedState:
    """Nothing is kept."""


@dataclass(frozen=True)
class SmoothedDerivatives:
    """∇ S L, and ∇² S L or its products with vectors: S smooths the loss L over the parameters by a Gaussian of deviation σ.

    The renderer is a black box: no derivative of it is asked for, so plateaus, silhouettes and shadows count. All perturbations of a step
    share the random numbers of their renders, so that differences are of the parameters and not of the noise. Perturbed parameters are
    moved into their bounds before they are rendered.

    Unbiased for the derivative of the smoothed expected loss of images at `spp` samples, whose noise adds to the loss; the Hessian-vector
    product has the bias of its central difference (`smoothed.hvp`).

    Args:
        sigma: σ in units of the parameters, > 0: one number, or {key: number}.
        samples: renders per view and derivative, >= 4.
        order: "gradient", "hessian" (n × n, for few parameters), or "hvp".
        aggregate, antithetic, baseline, low_discrepancy: see `unrender.smoothed`.
        spp: samples per pixel of a render, >= 1.
    """

    sigma: Any
    samples: int = 32
    order: Literal["gradient", "hessian", "hvp"] = "gradient"
    aggregate: bool = True
    antithetic: bool = True
    baseline: bool = True
    low_discrepancy: bool = False
    spp: int = 4

    def __post_init__(self):
        if self.order not in ("gradient", "hessian", "hvp"):
            raise InputError(f'SmoothedDerivatives: order must be "gradient", "hessian" or "hvp", got {self.order!r}')
        for name, value in self.sigma.items() if isinstance(self.sigma, dict) else [("sigma", self.sigma)]:
            checks.number("SmoothedDerivatives", f"sigma of {name}" if name != "sigma" else name, value, above=0.0)
        checks.whole("SmoothedDerivatives", "samples", self.samples, at_least=16 if self.low_discrepancy else 4)
        checks.whole("SmoothedDerivatives", "spp", self.spp, at_least=1)

    @property
    def provides(self) -> frozenset[str]:
        """A gradient with its variance, and what `order` says."""
        return frozenset({GRADIENT, VARIANCE, *{"hessian": [HESSIAN], "hvp": [HVP]}.get(self.order, [])})

    def init(self, problem: Problem, parameters: Tree) -> SmoothedState:
        """See `Estimator.init`. Raises `InputError` where a parameter has a preconditioner, or none has a σ."""
        for key in problem.preconditioners:
            raise InputError(
                f"SmoothedDerivatives: parameter {key} has a preconditioner; leave it out, σ smooths already"
            )
        problem.renderer.select(list(parameters), None)
        self._sigma(parameters)
        return SmoothedState()

    def estimate(
        self, problem: Problem, parameters: Tree, state: SmoothedState, key: Key
    ) -> tuple[Estimate, SmoothedState]:
        """See `Estimator.estimate`. `info`: "samples" (paths traced), "images" per view at the parameters themselves."""
        theta, sigma = flat.ravel(parameters), self._sigma(parameters)
        counted = [0]
        images: dict[int, Any] = {}

        def losses(points: np.ndarray) -> np.ndarray:
            return np.array([self._loss(problem, parameters, point, key, counted) for point in points])

        loss = self._loss(problem, parameters, theta, key, counted, images)
        seed = key.fold(1).uint32()
        options = {
            "aggregate": self.aggregate,
            "antithetic": self.antithetic,
            "low_discrepancy": self.low_discrepancy,
        }
        gradient, error = smoothed.gradient(losses, theta, sigma, self.samples, seed, baseline=self.baseline, **options)
        hessian = None
        if self.order == "hessian":
            hessian, _ = smoothed.hessian(losses, theta, sigma, self.samples, seed, baseline=self.baseline, **options)

        def product(v: Tree) -> Tree:
            found, _ = smoothed.hvp(losses, theta, flat.ravel(v), sigma, 2 * self.samples, seed, **options)
            return flat.unravel(found, parameters)

        return Estimate(
            loss,
            flat.unravel(gradient, parameters),
            flat.unravel(error**2, parameters),
            hessian,
            product if self.order == "hvp" else None,
            info={"samples": counted[0], "images": images},
        ), state

    def _loss(
        self,
        problem: Problem,
        parameters: Tree,
        point: np.ndarray,
        key: Key,
        counted: list[int],
        images: dict[int, Any] | None = None,
    ) -> float:
        tree = {k: project(x, *problem.bounds[k]) for k, x in flat.unravel(point, parameters).items()}
        parts: list[Any] = []
        for view in range(len(problem.views)):
            shot = Shot(problem.views[view].sensor, self.spp, key.fold(0).fold(view).uint32())
            image = arrays.mean_first(problem.renderer.image(tree, shot).images)
            parts.append(problem.loss_value(view, image))
            counted[0] += self.spp * math.prod(_size(image.shape))
            if images is not None:
                images[view] = image
        arrays.evaluate(parts)
        return sum(arrays.number(part) for part in parts)

    def _sigma(self, parameters: Tree) -> np.ndarray:
        if not isinstance(self.sigma, dict):
            return np.full(flat.ravel(parameters).size, float(self.sigma))
        missing = [key for key in parameters if key not in self.sigma]
        if missing:
            raise InputError(f"SmoothedDerivatives: sigma has no entry for parameter {missing[0]}")
        return flat.spread(self.sigma, parameters)


def _size(shape: Sequence[int]) -> tuple[int, int]:
    return int(shape[0]), int(shape[1])
