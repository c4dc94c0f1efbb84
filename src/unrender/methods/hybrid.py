"""Method `hybrid`: path gradients together with perturbed renders."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from pydantic import Field, NonNegativeInt, PositiveFloat, PositiveInt

from unrender import pixels
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.estimators.base import Estimator
from unrender.estimators.hybrid import HybridGradient, beyond_paths
from unrender.estimators.meta import MetaEstimator
from unrender.estimators.path import PathGradient
from unrender.estimators.smoothed import SmoothedDerivatives
from unrender.images.base import ImageEstimator
from unrender.images.plain import Plain
from unrender.images.recursive_control_variate import RecursiveControlVariate
from unrender.methods.base import parse_schedule
from unrender.methods.paths import AdamOptions
from unrender.methods.plan import Plan
from unrender.methods.smoothed import SIGMA_HELP, WIDTH, parse_widths, widths_of
from unrender.optimizers.base import Optimizer
from unrender.optimizers.recipes import Adam, MetaAdam
from unrender.pixels.base import PixelSampler
from unrender.scene.problem import Problem

_IMAGE_MEMORY, _GRADIENT_MEMORY = 0.95, 0.8
"""Largest weights of the past for images and gradients. Larger weights retain noise that no optimizer averages."""


@register(name="hybrid", position=7)
class HybridMethod(AdamOptions):
    """path gradients, with optional control variates and pixel mini-batches; perturbed renders for poses and others; Adam"""

    spp: PositiveInt = Field(4, description="samples per pixel of path gradients")
    image: Literal["plain", "rcv"] = Field(
        "plain", description="image estimator: a new rendering, or rcv's control variate"
    )
    gradient: Literal["plain", "coupled"] = Field(
        "plain", description="a new gradient at each step, or coupled's meta-estimate, which uses MetaAdam"
    )
    space: Literal["path", "primary"] | None = Field(
        None, description="what two steps share: paths, or random numbers; none for paths if all parameters allow it"
    )
    pixels: NonNegativeInt = Field(0, description="pixels per step, sampled by the gradient's variance; 0 for all")
    sigma: PositiveFloat | str | None = Field(None, description=f"initial {SIGMA_HELP}")
    sigma_schedule: str | None = Field(
        "exponential(25, 0.1)", description="factor of sigma by step, such as cosine(300)"
    )
    step: PositiveFloat = Field(0.2, description="learning rate of perturbed parameters, relative to their sigma")
    samples: int = Field(16, ge=4, description="perturbed renders per view and step")
    perturbed_spp: PositiveInt = Field(2, description="samples per pixel of a perturbed render")
    perturbed: str | None = Field(
        None,
        description="perturbed parameters, separated by commas; none for poses and parameters without path gradients",
    )

    def build(self) -> tuple[Estimator, Optimizer]:
        """Return both parts without learning rates of perturbed parameters, which depend on the problem."""
        widths = parse_widths(WIDTH if self.sigma is None else self.sigma)
        return self._parts("path" if self.space is None else self.space, widths, {})

    def plan(self, problem: Problem) -> Plan:
        known, keys = problem.renderer.parameters(), list(problem.shapes())
        own = beyond_paths(known, keys) if self._keys is None else self._keys
        space = self.space or ("path" if all(known[key].shares_paths for key in keys) else "primary")
        widths = widths_of(self.sigma, problem, [key for key in own if key in keys])
        rates = {key: self.step * width for key, width in widths.items()}
        reason = f"perturbed renders of {', '.join(own)}; path gradients of all others"
        wanted = parse_widths(self.sigma, problem, tuple(widths))
        return Plan(problem, *self._parts(space, wanted, rates), reasons=(reason,) if own else ())

    @property
    def _keys(self) -> tuple[str, ...] | None:
        return None if self.perturbed is None else tuple(key.strip() for key in self.perturbed.split(","))

    def _parts(
        self, space: Literal["path", "primary"], widths: float | dict[str, float], rates: Tree
    ) -> tuple[Estimator, Optimizer]:
        image = Plain() if self.image == "plain" else RecursiveControlVariate(space, max_weight=_IMAGE_MEMORY)
        smoothing = SmoothedDerivatives(
            widths,
            self.samples,
            spp=self.perturbed_spp,
            schedule=parse_schedule(self.sigma_schedule),
            debiased=self.perturbed_spp > 1,
        )
        path, optimizer = self._path(image, space), self.optimizer()
        if rates and isinstance(optimizer, (Adam, MetaAdam)):
            optimizer = replace(optimizer, learning_rate={"*": self.learning_rate, **rates})
        return HybridGradient(path, smoothing, self._keys, averaged=self.gradient == "coupled"), optimizer

    def _path(self, image: ImageEstimator, space: Literal["path", "primary"]) -> Estimator:
        sampler: PixelSampler = pixels.Adaptive(self.pixels) if self.pixels else pixels.All()
        if self.gradient == "coupled":
            return MetaEstimator(
                coupled=True, spp=self.spp, image=image, space=space, pixels=sampler, max_weight=_GRADIENT_MEMORY
            )
        return PathGradient(image, sampler, self.spp)

    def optimizer(self) -> Optimizer:
        """Return Adam, or MetaAdam for a meta-estimated gradient."""
        if self.gradient == "coupled":
            return MetaAdam(self.learning_rate, schedule=parse_schedule(self.schedule))
        return super().optimizer()
