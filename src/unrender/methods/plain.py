"""Method `plain`: a new rendering at each step."""

from __future__ import annotations

from unrender.core.registry import register
from unrender.estimators.base import Estimator
from unrender.images.plain import Plain
from unrender.methods.adam_options import PathOptions
from unrender.optimizers.base import Optimizer


@register(name="plain", position=1)
class PlainMethod(PathOptions):
    """a new rendering at each step, leave-one-out sample groups, Adam"""

    def build(self) -> tuple[Estimator, Optimizer]:
        return self.estimator(Plain()), self.optimizer()
