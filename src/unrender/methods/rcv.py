"""Method `rcv`: recursive control variates (Nicolet et al. 2023)."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, FiniteFloat, PositiveInt

from unrender.core.registry import register
from unrender.estimators.base import Estimator
from unrender.images.recursive_control_variate import RecursiveControlVariate
from unrender.methods.adam_options import PathOptions
from unrender.optimizers.base import Optimizer


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
