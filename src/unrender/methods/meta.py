"""Methods of meta-estimation (Balint et al. 2023): `meta`, and `coupled`, whose samples contribute to both of its terms."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, FiniteFloat, PositiveFloat, PositiveInt

from unrender.core.registry import register
from unrender.estimators.base import Estimator
from unrender.estimators.meta import MetaEstimator
from unrender.images.base import Plain
from unrender.images.recursive_control_variate import RecursiveControlVariate
from unrender.methods.base import SCHEDULE_HELP, Options, parse_schedule
from unrender.optimizers.base import Optimizer
from unrender.optimizers.recipes import Adam, MetaAdam
from unrender.statistics import meta


class MetaCommonOptions(Options):
    """Options of `meta` and `coupled`."""

    optimizer: Literal["meta-adam", "adam"] = Field(
        "meta-adam", description="optimizer; adam, which assumes independent gradients, is for comparison"
    )
    learning_rate: PositiveFloat = Field(0.002, description="learning rate of parameters without their own")
    schedule: str | None = Field(None, description=SCHEDULE_HELP)
    space: Literal["auto", "path", "primary"] = Field(
        "auto", description="what two steps share: paths, random numbers, or paths if all parameters allow it"
    )
    beta_proportional: FiniteFloat = Field(
        meta.BETA_PROPORTIONAL, ge=0, lt=1, description="decay of the mean square of the gradient samples"
    )
    beta_difference: FiniteFloat = Field(
        meta.BETA_DIFFERENCE, ge=0, lt=1, description="decay of the mean square of their differences per step length"
    )
    max_weight: FiniteFloat = Field(
        1.0,
        gt=0,
        le=1,
        description="upper bound of the weight of the past: 0.9 forgets noise of the gradient after about 10 steps",
    )

    def built_optimizer(self) -> Optimizer:
        """Return the optimizer with these options."""
        schedule = parse_schedule(self.schedule)
        if self.optimizer == "adam":
            return Adam(self.learning_rate, schedule=schedule)
        return MetaAdam(self.learning_rate, schedule=schedule)

    def shared(self) -> dict[str, Any]:
        """Return the arguments that both forms of `MetaEstimator` share."""
        return {name: getattr(self, name) for name in ("space", "beta_proportional", "beta_difference", "max_weight")}


@register(name="meta", position=3)
class MetaMethod(MetaCommonOptions):
    """meta-estimation: earlier gradients are reused, updated by finite differences (Balint et al. 2023), MetaAdam"""

    proportional_spp: PositiveInt = Field(2, description="samples per pixel of the gradient itself")
    difference_spp: PositiveInt = Field(1, description="samples per pixel of its change since the last step")
    difference_images: Literal["own", "proportional"] = Field(
        "own",
        description="images for the loss derivatives of the change: from separate samples, or from the gradient's",
    )

    def build(self) -> tuple[Estimator, Optimizer]:
        spp, images = (self.proportional_spp, self.difference_spp), self.difference_images
        return MetaEstimator(*spp, difference_images=images, **self.shared()), self.built_optimizer()


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
