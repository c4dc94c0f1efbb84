"""`meta`: meta-estimation (Balint et al. 2023)."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, FiniteFloat, PositiveFloat, PositiveInt

from unrender.core.registry import register
from unrender.estimators.base import Estimator
from unrender.estimators.meta import MetaEstimator
from unrender.methods.base import SCHEDULE_HELP, Options, parse_schedule
from unrender.optimizers.adam import Adam
from unrender.optimizers.base import Optimizer
from unrender.optimizers.meta_adam import MetaAdam
from unrender.statistics import meta


class MetaCommonOptions(Options):
    """Options of `meta` and of `coupled`."""

    optimizer: Literal["meta-adam", "adam"] = Field(
        "meta-adam",
        description="what takes the steps; adam, which takes the gradients for independent, is for comparison",
    )
    step_rule: Literal["deviation", "walk"] = Field(
        "deviation",
        description="of meta-adam: steps per deviation of the gradient, as in the paper; or such that noise moves a parameter as "
        "far as adam does, with adam's learning rates",
    )
    learning_rate: PositiveFloat = Field(0.002, description="step size of the parameters that have none of their own")
    schedule: str | None = Field(None, description=SCHEDULE_HELP)
    space: Literal["auto", "path", "primary"] = Field(
        "auto", description="what two steps share: paths, random numbers, or paths where all parameters allow it"
    )
    beta_proportional: FiniteFloat = Field(
        meta.BETA_PROPORTIONAL, ge=0, lt=1, description="decay of the mean square of the gradient samples"
    )
    beta_difference: FiniteFloat = Field(
        meta.BETA_DIFFERENCE, ge=0, lt=1, description="decay of the mean square of their differences, per step length"
    )
    max_weight: FiniteFloat = Field(
        1.0,
        gt=0,
        le=1,
        description="upper bound of the weight of the past: 0.9 forgets noise of the gradient after some 10 steps",
    )

    def built_optimizer(self) -> Optimizer:
        """The optimizer with these options."""
        schedule = parse_schedule(self.schedule)
        if self.optimizer == "adam":
            return Adam(self.learning_rate, schedule=schedule)
        return MetaAdam(self.learning_rate, schedule=schedule, rule=self.step_rule)

    def shared(self) -> dict[str, Any]:
        """The arguments that both forms of `MetaEstimator` take."""
        return {name: getattr(self, name) for name in ("space", "beta_proportional", "beta_difference", "max_weight")}


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
        spp, images = (self.proportional_spp, self.difference_spp), self.difference_images
        return MetaEstimator(*spp, difference_images=images, **self.shared()), self.built_optimizer()
