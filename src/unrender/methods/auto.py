"""`auto`: chooses estimator, optimizer and preconditioner from the problem."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from unrender import pixels
from unrender.core.registry import register
from unrender.estimators.base import Estimator
from unrender.estimators.path import PathGradient
from unrender.images.plain import Plain
from unrender.images.recursive_control_variate import RecursiveControlVariate
from unrender.methods.base import Options
from unrender.methods.plan import Plan
from unrender.methods.rules import RULES
from unrender.methods.rules.constants import CONSTANTS
from unrender.methods.rules.traits import Traits
from unrender.optimizers.base import Optimizer
from unrender.optimizers.schedule_free import ScheduleFree
from unrender.scene.problem import Problem


@register(name="auto", position=0)
class AutoMethod(Options):
    """what suits the problem: images with a memory or without, smoothing for textures and grids, schedule-free Adam

    The loss sees recursive control variates, which use earlier samples again: less noise, and less of the bias that noise gives to losses
    other than L2. Its errors are forgotten after some 20 steps, of L1 and such 33, lest steps follow them. Where the scene cannot be
    loaded twice, or a mesh moves and the loss is unbiased without a memory, each step has its own rendering. Textures, grids and values at
    the vertices of meshes move along Sobolev gradients, vertices of meshes along large steps at one rate for all, other parameters by
    steps in proportion to their range. A parameter that path gradients do not reach, such as a pose, takes Gauss-Newton steps by perturbed
    renders beside path gradients of the others, or steps by a smoothed loss where these do not suit (`hybrid`, `smoothed`). Cameras alone
    take Gauss-Newton steps, and so do poses of shapes alone from a start that overlaps enough. Grids of
    volumes are coarse in the first steps. Every choice can be set.
    """

    image: Literal["plain", "rcv"] | None = Field(
        None, description="what the loss sees: a fresh rendering, or rcv's; none for the latter where it can be had"
    )
    spp: PositiveInt | None = Field(
        None,
        description="samples per pixel; none for some 32768 paths a step, 131072 of drawn pixels, from 2 to 16 per pixel",
    )
    pixels: PositiveInt | None = Field(
        None,
        description="pixels a step, drawn from all views; none for all pixels, or 32768 where there are more than 524288",
    )
    tolerance: NonNegativeFloat = Field(
        CONSTANTS.tolerance,
        description="times its noise, within which L1 and Huber count a residual by its size, not its sign",
    )
    parameterise: bool = Field(
        True, description="whether positive numbers, colours and textures without an upper bound move as logarithms"
    )
    sigma: PositiveFloat | str = Field(
        CONSTANTS.sigma,
        description="width of the smoothing of what path gradients do not reach, in its units: 0.2, mug.rotation.y=0.6",
    )
    smooth: bool = Field(
        True, description="whether textures, grids and values at vertices move along Sobolev gradients"
    )
    correlation: PositiveFloat = Field(
        CONSTANTS.correlation,
        le=1,
        description="length over which Sobolev gradients smooth, at most, as a share of a texture's side",
    )
    coarse: bool = Field(True, description="whether grids of volumes are coarse in the first steps")
    learning_rate: PositiveFloat = Field(
        CONSTANTS.learning_rate,
        le=1,
        description="first steps, as a share of a parameter's range, or of its size where the range is open",
    )

    def build(self) -> tuple[Estimator, Optimizer]:
        """See `Options.build`: what is chosen where nothing is known of the problem."""
        image = Plain() if self.image == "plain" else RecursiveControlVariate(max_weight=CONSTANTS.linear_memory)
        sampler = pixels.Uniform(self.pixels) if self.pixels else pixels.All()
        return PathGradient(image, sampler, self.spp or CONSTANTS.spp[0]), ScheduleFree(self.learning_rate)

    def plan(self, problem: Problem) -> Plan:
        traits = Traits(problem, self, CONSTANTS)
        return next(plan for rule in RULES if (plan := rule(traits)) is not None)
