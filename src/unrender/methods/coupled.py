"""Method `coupled`: meta-estimation whose samples contribute to both of its terms."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, PositiveInt

from unrender.core.registry import register
from unrender.estimators.base import Estimator
from unrender.estimators.meta import MetaEstimator
from unrender.images.plain import Plain
from unrender.images.recursive_control_variate import RecursiveControlVariate
from unrender.methods.meta import MetaCommonOptions
from unrender.optimizers.base import Optimizer


@register(name="coupled", position=4)
class CoupledMethod(MetaCommonOptions):
    """meta-estimation with every sample in both of its terms, MetaAdam"""

    spp: PositiveInt = Field(3, description="samples per pixel, each for the gradient and for its change")
    image: Literal["plain", "rcv"] = Field(
        "plain",
        description="image estimator: a new rendering, or rcv's control variate (in path space, unless space is primary)",
    )

    def build(self) -> tuple[Estimator, Optimizer]:
        image = Plain()
        if self.image == "rcv":
            image = RecursiveControlVariate("primary" if self.space == "primary" else "path")
        return MetaEstimator(coupled=True, spp=self.spp, image=image, **self.shared()), self.built_optimizer()
