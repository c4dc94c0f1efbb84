"""Method `stock`: the loop of Mitsuba's tutorials, for comparison."""

from __future__ import annotations

from pydantic import Field, PositiveInt

from unrender.core.registry import register
from unrender.estimators.base import Estimator
from unrender.estimators.stock import StockGradient
from unrender.methods.adam_options import AdamOptions
from unrender.optimizers.base import Optimizer


@register(name="stock", position=8)
class StockMethod(AdamOptions):
    """the loop of Mitsuba's tutorials, for comparison: mi.render with prb, dr.backward, Adam"""

    spp: PositiveInt = Field(16, description="samples per pixel of the image, and as many of the adjoint")

    def build(self) -> tuple[Estimator, Optimizer]:
        return StockGradient(self.spp), self.optimizer()
