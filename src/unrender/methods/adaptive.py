"""`adaptive`: pixel mini-batches."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, NonNegativeInt, PositiveFloat, PositiveInt

from unrender import pixels
from unrender.core.registry import register
from unrender.estimators.base import Estimator
from unrender.estimators.path import PathGradient
from unrender.images.plain import Plain
from unrender.images.recursive_control_variate import RecursiveControlVariate
from unrender.methods.adam_options import SamplingOptions
from unrender.optimizers.base import Optimizer
from unrender.pixels.base import PixelSampler


@register(name="adaptive", position=5)
class AdaptiveMethod(SamplingOptions):
    """mini-batches of pixels drawn where the gradient's variance is, from all views at once, Adam"""

    pixels: PositiveInt = Field(4096, description="pixels a step, drawn from all pixels of all views")
    scheme: Literal["adaptive", "loss", "uniform"] = Field(
        "adaptive",
        description="pixels where the gradient's variance is, or in proportion to the loss derivative, or all alike",
    )
    spp: PositiveInt = Field(2, description="samples per drawn pixel; from 2 on, the adjoint shares their paths")
    levels: NonNegativeInt = Field(0, description="coarser resolutions that the probabilities look at, of adaptive")
    refresh: PositiveInt = Field(20, description="steps between estimates of the probabilities")
    uniform: PositiveFloat | None = Field(
        None,
        le=1,
        description="share of the draws that all pixels have equally; left out, as much as the samples ask for",
    )
    image: Literal["plain", "rcv"] = Field(
        "plain", description="what the loss sees: a fresh rendering, or rcv's, with a step of whole views now and then"
    )
    whole_views: PositiveInt = Field(20, description="steps between those of whole views, where image is rcv")

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
