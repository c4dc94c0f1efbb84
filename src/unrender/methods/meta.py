"""`meta`: meta-estimation (Balint et al. 2023)."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, PositiveInt

from unrender.core.registry import register
from unrender.estimators.base import Estimator
from unrender.estimators.meta import MetaEstimator
from unrender.methods.meta_options import MetaCommonOptions
from unrender.optimizers.base import Optimizer

__all__ = ["MetaMethod"]


@register(name="meta", position=3)
class MetaMethod(MetaCommonOptions):
    """meta-estimation: the gradient keeps earlier ones, moved along by finite differences (Balint et al. 2023), MetaAdam"""

    proportional_spp: PositiveInt = Field(2, description="samples per pixel of the gradient itself")
    difference_spp: PositiveInt = Field(1, description="samples per pixel of its change since the last step")
    difference_images: Literal["own", "proportional"] = Field(
        "own",
        description="images that the loss derivatives of the change are at: of samples of its own, or of the gradient's",
    )

    def build(self) -> tuple[Estimator, Optimizer]:
        """See `Options.build`."""
        spp, images = (self.proportional_spp, self.difference_spp), self.difference_images
        return MetaEstimator(*spp, difference_images=images, **self.shared()), self.built_optimizer()
