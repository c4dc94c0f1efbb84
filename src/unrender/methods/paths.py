"""Methods on path gradients: `plain`, `rcv` (Nicolet et al. 2023), `adaptive`, and `stock`, the loop of Mitsuba's tutorials."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, FiniteFloat, NonNegativeInt, PositiveFloat, PositiveInt

from unrender import pixels
from unrender.core.registry import register
from unrender.estimators.base import Estimator
from unrender.estimators.path import PathGradient
from unrender.estimators.stock import StockGradient
from unrender.images.plain import Plain
from unrender.images.recursive_control_variate import RecursiveControlVariate
from unrender.methods.adam_options import AdamOptions, PathOptions, SamplingOptions
from unrender.optimizers.base import Optimizer
from unrender.pixels.base import PixelSampler


@register(name="plain", position=1)
class PlainMethod(PathOptions):
    """a new rendering at each step, leave-one-out sample groups, Adam"""

    def build(self) -> tuple[Estimator, Optimizer]:
        return self.estimator(Plain()), self.optimizer()


@register(name="rcv", position=2)
class RecursiveControlVariateMethod(PathOptions):
    """recursive control variates, which reuse earlier renderings of the image (Nicolet et al. 2023), Adam"""

    spp: PositiveInt = Field(2, description="samples per pixel; from 2 on, the adjoint shares their paths")
    space: Literal["path", "primary"] = Field(
        "path",
        description="what two steps share: paths (materials, emitters, meshes), or random numbers (any parameter)",
    )
    alpha: FiniteFloat = Field(0.9, ge=0, lt=1, description="decay of the means in the control weight")
    beta: FiniteFloat = Field(0.999, ge=0, lt=1, description="decay of the covariances in the control weight")
    max_weight: FiniteFloat = Field(
        1.0,
        gt=0,
        le=1,
        description="upper bound of the control weight: 0.95 forgets errors of the image after about 20 steps",
    )

    def build(self) -> tuple[Estimator, Optimizer]:
        image = RecursiveControlVariate(self.space, self.alpha, self.beta, max_weight=self.max_weight)
        return self.estimator(image), self.optimizer()


@register(name="adaptive", position=5)
class AdaptiveMethod(SamplingOptions):
    """pixel mini-batches from all views, sampled where the gradient's variance is high, Adam"""

    pixels: PositiveInt = Field(4096, description="pixels per step, sampled from all pixels of all views")
    scheme: Literal["adaptive", "loss", "uniform"] = Field(
        "adaptive",
        description="pixel probabilities: by the gradient's variance, in proportion to the loss derivative, or uniform",
    )
    spp: PositiveInt = Field(
        2, description="samples per pixel of the mini-batch; from 2 on, the adjoint shares their paths"
    )
    levels: NonNegativeInt = Field(0, description="coarser resolutions in the probabilities of the scheme adaptive")
    refresh: PositiveInt = Field(20, description="steps between estimates of the probabilities")
    uniform: PositiveFloat | None = Field(
        None,
        le=1,
        description="fraction of uniform samples; by default it is chosen from the samples",
    )
    image: Literal["plain", "rcv"] = Field(
        "plain", description="image estimator: a new rendering, or rcv's control variate, with some steps of full views"
    )
    whole_views: PositiveInt = Field(20, description="steps between two steps of full views, with the image rcv")

    def build(self) -> tuple[Estimator, Optimizer]:
        image = Plain() if self.image == "plain" else RecursiveControlVariate(whole_views=self.whole_views)
        return PathGradient(image, self._sampler(), self.spp, **self.sampling()), self.optimizer()

    def _sampler(self) -> PixelSampler:
        guided: dict[str, Any] = {"refresh": self.refresh}
        if self.uniform is not None:
            guided["uniform"] = self.uniform
        if self.scheme == "adaptive":
            return pixels.Adaptive(self.pixels, self.levels, **guided)
        if self.scheme == "loss":
            return pixels.LossProportional(self.pixels, **guided)
        return pixels.Uniform(self.pixels)


@register(name="stock", position=8)
class StockMethod(AdamOptions):
    """the loop of Mitsuba's tutorials, for comparison: mi.render with prb, dr.backward, Adam"""

    spp: PositiveInt = Field(16, description="samples per pixel of the image, and as many of the adjoint")

    def build(self) -> tuple[Estimator, Optimizer]:
        return StockGradient(self.spp), self.optimizer()
