"""Options that several methods share: those of Adam and of path gradients."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, FiniteFloat, PositiveFloat, PositiveInt

from unrender.estimators.base import Estimator
from unrender.estimators.emitter_selection import EmitterSelection
from unrender.estimators.path import PathGradient
from unrender.images.base import ImageEstimator
from unrender.images.denoising import Denoised
from unrender.methods.base import SCHEDULE_HELP, Options, parse_schedule
from unrender.optimizers.base import Optimizer
from unrender.optimizers.recipes import Adam
from unrender.pixels.adaptive_counts import AdaptiveCounts
from unrender.pixels.all import All


class AdamOptions(Options):
    """Options of methods that use Adam."""

    learning_rate: PositiveFloat = Field(0.01, description="learning rate of parameters without their own")
    beta_1: FiniteFloat = Field(0.9, ge=0, lt=1, description="decay of Adam's mean gradient")
    beta_2: FiniteFloat = Field(0.999, ge=0, lt=1, description="decay of Adam's mean squared gradient")
    schedule: str | None = Field(None, description=SCHEDULE_HELP)
    one_rate: bool = Field(
        False, description="whether all elements of a parameter share one step scale, for mesh vertices"
    )

    def optimizer(self) -> Optimizer:
        """Return Adam with these options."""
        schedule = parse_schedule(self.schedule)
        return Adam(self.learning_rate, self.beta_1, self.beta_2, schedule=schedule, uniform=self.one_rate)


class SamplingOptions(AdamOptions):
    """Options of the path sampling of `PathGradient`."""

    emitters: EmitterSelection = Field(
        "scene",
        description="how a path selects one of several emitters: by the scene's weights, or by the gradient's variance",
    )
    differential_bsdf: bool = Field(
        False,
        description="whether derivatives with respect to the alpha of rough conductors use separate antithetic pairs of paths",
    )

    def sampling(self) -> dict[str, Any]:
        """Return these options as arguments of `PathGradient`."""
        return {"emitters": self.emitters, "differential_bsdf": self.differential_bsdf}


class PathOptions(SamplingOptions):
    """Options of methods that use path gradients."""

    spp: PositiveInt = Field(8, description="samples per pixel; from 2 on, the adjoint shares their paths")
    adjoint_spp: PositiveInt | None = Field(None, description="samples per pixel of an adjoint with separate paths")
    counts: Literal["equal", "adaptive"] = Field(
        "equal",
        description="samples of each pixel: spp, or spp on average with more where the gradient's variance is high",
    )
    denoise: bool = Field(False, description="whether the loss uses denoised images (biased; extra unrender[denoise])")

    def estimator(self, image: ImageEstimator) -> Estimator:
        """Return the path gradient of the loss at this image estimator's images."""
        sampler = AdaptiveCounts() if self.counts == "adaptive" else All()
        image_estimator = Denoised(image) if self.denoise else image
        return PathGradient(image_estimator, sampler, self.spp, self.adjoint_spp, **self.sampling())
