"""`auto`: chooses estimator, optimizer and preconditioner from the problem."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from unrender.core import lazy
from unrender.core.registry import register
from unrender.methods.base import Options, measured, measuring_once
from unrender.methods.paths import estimators, images, optimizers, pixels
from unrender.methods.rules.constants import CONSTANTS
from unrender.methods.smoothed import SIGMA_HELP

if TYPE_CHECKING:
    from unrender.estimators.base import Estimator
    from unrender.methods.plan import Plan
    from unrender.methods.rules import exchangeable, paths, places, starts, traits, turns
    from unrender.optimizers.base import Optimizer
    from unrender.scene import render
    from unrender.scene.problem import Problem
else:  # options are checked without Dr.Jit
    exchangeable, paths = lazy.modules("methods.rules.exchangeable", "methods.rules.paths")
    places, starts = lazy.modules("methods.rules.places", "methods.rules.starts")
    traits, turns = lazy.modules("methods.rules.traits", "methods.rules.turns")
    render = lazy.Module("scene.render")


@register(name="auto", position=0)
class AutoMethod(Options):
    """chooses estimator, optimizer and preconditioner from the problem: control variates, Sobolev gradients, schedule-free Adam

    The first rule (`unrender.methods.rules`) that fits the problem decides. Options override every choice.

    | part | decision | option |
    |---|---|---|
    | image | a control variate that forgets after about 20 steps, 33 where noise biases the loss | `image` |
    | the same, scene not loadable twice or moving mesh with an unbiased loss | a new rendering per step | |
    | noise-biased losses | pixels whose noise exceeds their residual are damped | `tolerance` |
    | samples | 32,768 paths per step, 2 to 16 per pixel, fewer where a step takes a fifth of the seconds | `spp` |
    | pixels | all of them up to 2¹⁹; beyond, 2¹⁵ per step at 4 samples | `pixels` |
    | smoothing | Sobolev gradients over at most an eighth of a texture, grid or mesh, less where gradients confirm detail | `smooth` |
    | steps | schedule-free Adam; the rate follows the agreement of successive gradients | `learning_rate` |
    | first rate | a tenth of the parameter's range or size; 0.3 of that for a number or a colour with two bounds | `learning_rate` |
    | the same, 64 elements or more | up to 3 times that, the less noise the first gradient has | |
    | logarithms | positive numbers, colours and textures without an upper bound | `parameterise` |
    | grids of media | a quarter of the resolution before step 8, half before step 20 | `coarse` |
    | environment maps | a weak pull to the start, for texels that pictures hardly show | |
    | vertices | large steps, one rate for all | |
    | cameras; up to 24 numbers, one of a light or of the picture's form | Gauss-Newton steps | `image` |
    | 2 to 24 other numbers, linear loss | Gauss-Newton steps once path gradients no longer agree | `image` |
    | poses, and what path gradients refuse | perturbed renders: Gauss-Newton steps, or a smoothed loss | `sigma` |
    | poses on a plateau | the best of 16 to 64 places of each shape | |
    """

    image: Literal["plain", "rcv"] | None = Field(
        None, description="image estimator: a new rendering, or rcv's control variate; none takes rcv where possible"
    )
    spp: PositiveInt | None = Field(
        None,
        description="samples per pixel; none for about 32768 paths per step, 131072 in mini-batches, 2 to 16 per pixel",
    )
    pixels: PositiveInt | None = Field(
        None, description="pixels per step, sampled from all views; none for all pixels, or 32768 of more than 524288"
    )
    tolerance: NonNegativeFloat = Field(
        CONSTANTS.tolerance,
        description="multiple of its noise within which L1 and Huber weight a residual by its size instead of its sign",
    )
    parameterise: bool = Field(
        True,
        description="whether positive numbers, colours and textures without an upper bound are optimised as logarithms",
    )
    sigma: PositiveFloat | str | None = Field(None, description=f"for parameters without path gradients: {SIGMA_HELP}")
    smooth: bool = Field(True, description="whether textures, grids and values at vertices use Sobolev gradients")
    correlation: PositiveFloat = Field(
        CONSTANTS.correlation,
        le=1,
        description="maximum smoothing length of Sobolev gradients, relative to a texture's side",
    )
    coarse: bool = Field(True, description="whether grids of volumes have a coarse resolution in the first steps")
    learning_rate: PositiveFloat = Field(
        CONSTANTS.learning_rate,
        le=1,
        description="first learning rate relative to a parameter's range, or to its size if the range is unbounded",
    )

    def build(self) -> tuple[Estimator, Optimizer]:
        """Return the choices without knowledge of the problem."""
        image = (
            images.Plain()
            if self.image == "plain"
            else images.RecursiveControlVariate(max_weight=CONSTANTS.linear_memory)
        )
        sampler = pixels.Uniform(self.pixels) if self.pixels else pixels.All()
        return estimators.PathGradient(image, sampler, self.spp or CONSTANTS.spp[0]), optimizers.ScheduleFree(
            self.learning_rate
        )

    def plan(self, problem: Problem) -> Plan:
        known = traits.Traits(problem, self, CONSTANTS)
        plan = next(plan for rule in paths.RULES if (plan := rule(known)) is not None)
        plan = replace(plan, reasons=(*plan.reasons, *known.notes, *exchangeable.exchangeable(known)))
        keys, few = list(known.infos), known.elements <= CONSTANTS.few_numbers
        by_paths = isinstance(plan.estimator, estimators.PathGradient | estimators.PathThenNewton)
        varied = places.varied_keys(problem, keys) if few else []
        varied = [key for key in varied if not (by_paths and places.is_scale(problem, key))]
        plan = replace(plan, other_starts=tuple(dict.fromkeys([*varied, *turns.turned_keys(problem, keys)])))
        if few and any(places.starts_at_bound(problem, key) for key in keys):
            plan = starts.best_start(known, keys, plan)
        shorter = self._shorter(plan, 0.0)
        return replace(plan, cheaper=partial(self._cheaper, plan, measured())) if shorter else plan

    def _shorter(self, plan: Plan, share: float) -> Mapping[str, int] | None:
        """Return options with which path gradients take about a share of the time: fewer samples per pixel, or else a mini-batch of pixels
        if noise does not bias the loss. None without such options, as for Gauss-Newton steps, which take at least half of the time then."""
        path = getattr(plan.estimator, "path", plan.estimator)
        if self.spp or not isinstance(path, estimators.PathGradient):
            return None
        if (spp := max(render.power_of_two(int(share * path.spp)), CONSTANTS.spp[0])) < path.spp:
            return {"spp": spp}
        (least, batch_spp), count = CONSTANTS.short_batch, plan.problem.pixels
        drawn = max(render.power_of_two(int(share * path.spp * count)) // batch_spp, least)
        batched = self.image is None and path is plan.estimator and isinstance(path.pixels, pixels.All)
        suits = batched and 4 * drawn <= count and plan.problem.loss.linear
        return {"pixels": drawn, "spp": batch_spp} if suits else None

    def _cheaper(self, plan: Plan, known: dict[Any, Any] | None, share: float) -> tuple[Plan, Mapping[str, int]] | None:
        """Return `Plan.cheaper`; None if noise changes the kind of the steps."""
        if (options := self._shorter(plan, share)) is None:
            return None
        with measuring_once(known):
            made = self.model_copy(update=dict(options)).plan(plan.problem)
        return (made, options) if type(made.estimator) is type(plan.estimator) else None
