"""Methods on perturbed renders: `smoothed`, derivatives of a smoothed loss (Wang et al.), and `hybrid`, with path gradients."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal

import pydantic
from pydantic import Field, NonNegativeInt, PositiveFloat, PositiveInt

from unrender.core import lazy
from unrender.core.errors import InputError
from unrender.core.registry import register
from unrender.core.text import did_you_mean
from unrender.methods.base import Options, parameterised, parse_schedule
from unrender.methods.paths import AdamOptions, estimators, images, optimizers, pixels

if TYPE_CHECKING:
    from unrender.core.trees import Tree
    from unrender.estimators import hybrid
    from unrender.estimators.base import Estimator
    from unrender.images.base import ImageEstimator
    from unrender.methods import plan as plans
    from unrender.optimizers.base import Optimizer
    from unrender.pixels.base import PixelSampler
    from unrender.scene.problem import Problem
else:  # options are checked without Dr.Jit
    hybrid, plans = lazy.modules("estimators.hybrid", "methods.plan")

SIGMA_HELP = "smoothing width in units of the parameters, optionally per parameter: 0.2, mug.rotation.y=0.6; none for 0.2 times their size"
WIDTH = 0.2
"""Default smoothing width relative to the order of magnitude of a parameter's size."""
_WIDTH = pydantic.TypeAdapter(PositiveFloat)
_IMAGE_MEMORY, _GRADIENT_MEMORY = 0.95, 0.8
"""Largest weights of the past for images and gradients of `hybrid`. Larger weights retain noise that no optimizer averages."""


@register(name="smoothed", position=6)
class SmoothedMethod(Options):
    """derivatives of a smoothed loss from perturbed renders, for poses and plateaus (Wang et al.), Newton-CG"""

    optimizer: Literal["newton-cg", "newton", "lbfgs", "adam", "cma-es"] = Field(
        "newton-cg",
        description="optimizer; newton forms n x n matrices, adam and lbfgs use gradients only, cma-es uses losses only",
    )
    sigma: PositiveFloat | str | None = Field(None, description=f"initial {SIGMA_HELP}")
    sigma_schedule: str | None = Field(
        "exponential(25, 0.1)",
        description="factor of sigma by step, such as cosine(300); with adam, also of its learning rate; cma-es has none",
    )
    step: PositiveFloat = Field(
        0.5, description="relative to sigma: longest step; learning rate of adam; first standard deviation of cma-es"
    )
    samples: int = Field(16, ge=4, description="renders per view and step, for each separately estimated derivative")
    spp: PositiveInt = Field(2, description="samples per pixel of a render")
    joint: bool = Field(
        True,
        description="whether gradient and curvature use the same renders; otherwise separate ones, as in the paper",
    )
    iterations: PositiveInt = Field(3, description="Hessian-vector products per step of newton-cg")

    def build(self) -> tuple[Estimator, Optimizer]:
        """Return both parts for parameters whose sizes are of the order of 1."""
        return self._parts(parse_widths(WIDTH if self.sigma is None else self.sigma), {})

    def plan(self, problem: Problem) -> plans.Plan:
        sigma, first = parse_widths(self.sigma, problem), first_steps(self.sigma, problem, problem.shapes())
        own = first if set(first.values()) - {_common(sigma)} else {}
        return plans.Plan(problem, *self._parts(sigma, own), reasons=parameterised(problem))

    def _parts(self, sigma: float | dict[str, float], own: Mapping[str, float]) -> tuple[Estimator, Optimizer]:
        """Return both parts; `own`: widths of the optimizer's variables, by which the first steps of adam and cma-es are scaled."""
        schedule = parse_schedule(self.sigma_schedule)
        common = _common(sigma)
        units: dict[str, float] = {"*": 1.0} | {key: width / common for key, width in own.items()}
        if self.optimizer == "cma-es":
            return estimators.LossValues(self.spp), optimizers.CMAES(
                sigma0=self.step * common, learning_rate=units if own else 1.0
            )
        scaled = {key: self.step * common * unit for key, unit in units.items()}
        rate = scaled if own else self.step * common
        order: Any = {"newton-cg": "hvp", "newton": "hessian"}.get(self.optimizer, "gradient")
        joint = self.joint or order == "gradient"
        estimator = estimators.SmoothedDerivatives(
            sigma, self.samples, order, joint=joint, spp=self.spp, schedule=schedule
        )
        made: dict[str, Callable[[], Optimizer]] = {
            "newton-cg": lambda: optimizers.NewtonCG(trust_radius=self.step, iterations=self.iterations),
            "newton": lambda: optimizers.Newton(trust_radius=self.step),
            "lbfgs": lambda: optimizers.LBFGS(trust_radius=self.step),
            "adam": lambda: optimizers.Adam(rate, schedule=schedule),
        }
        return estimator, made[self.optimizer]()


@register(name="hybrid", position=7)
class HybridMethod(AdamOptions):
    """path gradients, with optional control variates and pixel mini-batches; perturbed renders for poses and others; Adam"""

    spp: PositiveInt = Field(4, description="samples per pixel of path gradients")
    image: Literal["plain", "rcv"] = Field(
        "plain", description="image estimator: a new rendering, or rcv's control variate"
    )
    gradient: Literal["plain", "coupled"] = Field(
        "plain", description="a new gradient at each step, or coupled's meta-estimate, which uses MetaAdam"
    )
    space: Literal["path", "primary"] | None = Field(
        None, description="what two steps share: paths, or random numbers; none for paths if all parameters allow it"
    )
    pixels: NonNegativeInt = Field(0, description="pixels per step, sampled by the gradient's variance; 0 for all")
    sigma: PositiveFloat | str | None = Field(None, description=f"initial {SIGMA_HELP}")
    sigma_schedule: str | None = Field(
        "exponential(25, 0.1)", description="factor of sigma by step, such as cosine(300)"
    )
    step: PositiveFloat = Field(0.2, description="learning rate of perturbed parameters, relative to their sigma")
    samples: int = Field(16, ge=4, description="perturbed renders per view and step")
    perturbed_spp: PositiveInt = Field(2, description="samples per pixel of a perturbed render")
    perturbed: str | None = Field(
        None,
        description="perturbed parameters, separated by commas; none for poses and parameters without path gradients",
    )

    def build(self) -> tuple[Estimator, Optimizer]:
        """Return both parts without learning rates of perturbed parameters, which depend on the problem."""
        widths = parse_widths(WIDTH if self.sigma is None else self.sigma)
        return self._parts("path" if self.space is None else self.space, widths, {})

    def plan(self, problem: Problem) -> plans.Plan:
        known, keys = problem.renderer.parameters(), list(problem.shapes())
        own = hybrid.beyond_paths(known, keys) if self._keys is None else self._keys
        space = self.space or ("path" if all(known[key].shares_paths for key in keys) else "primary")
        widths = widths_of(self.sigma, problem, [key for key in own if key in keys])
        rates = {key: self.step * width for key, width in first_steps(self.sigma, problem, widths).items()}
        reason = f"perturbed renders of {', '.join(own)}; path gradients of all others"
        wanted = parse_widths(self.sigma, problem, tuple(widths))
        return plans.Plan(problem, *self._parts(space, wanted, rates), reasons=(reason,) if own else ())

    @property
    def _keys(self) -> tuple[str, ...] | None:
        return None if self.perturbed is None else tuple(key.strip() for key in self.perturbed.split(","))

    def _parts(
        self, space: Literal["path", "primary"], widths: float | dict[str, float], rates: Tree
    ) -> tuple[Estimator, Optimizer]:
        image = (
            images.Plain() if self.image == "plain" else images.RecursiveControlVariate(space, max_weight=_IMAGE_MEMORY)
        )
        smoothing = estimators.SmoothedDerivatives(
            widths,
            self.samples,
            spp=self.perturbed_spp,
            schedule=parse_schedule(self.sigma_schedule),
            debiased=self.perturbed_spp > 1,
        )
        path, optimizer = self._path(image, space), self.optimizer()
        if rates and isinstance(optimizer, (optimizers.Adam, optimizers.MetaAdam)):
            optimizer = replace(optimizer, learning_rate={"*": self.learning_rate, **rates})
        return estimators.HybridGradient(path, smoothing, self._keys, averaged=self.gradient == "coupled"), optimizer

    def _path(self, image: ImageEstimator, space: Literal["path", "primary"]) -> Estimator:
        sampler: PixelSampler = pixels.Adaptive(self.pixels) if self.pixels else pixels.All()
        if self.gradient == "coupled":
            return estimators.MetaEstimator(
                coupled=True, spp=self.spp, image=image, space=space, pixels=sampler, max_weight=_GRADIENT_MEMORY
            )
        return estimators.PathGradient(image, sampler, self.spp)

    def optimizer(self) -> Optimizer:
        """Return Adam, or MetaAdam for a meta-estimated gradient."""
        if self.gradient == "coupled":
            return optimizers.MetaAdam(self.learning_rate, schedule=parse_schedule(self.schedule))
        return super().optimizer()


def parse_widths(
    sigma: float | str | None, problem: Problem | None = None, keys: Collection[str] | None = None
) -> float | dict[str, float]:
    """Return a width for all parameters, or {key: width, "*": width of the others} from "0.2, mug.rotation.y=0.6".

    Without `sigma`, it is {key: width} for the problem's parameters `keys` (None: all), or 0.2 if all have this width. The width is 0.2
    times a size: `ParameterInfo.length` of a pose, else the order of magnitude of the range or of the largest initial value.

    Raises:
        InputError: the width of the others is missing, or a width is not a positive number.
    """
    if sigma is None:
        sizes = {key: _size(problem, key) for key in problem.shapes() if keys is None or key in keys} if problem else {}
        widths = {key: WIDTH * size for key, size in sizes.items()}
        return widths if set(widths.values()) - {WIDTH} else WIDTH
    if not isinstance(sigma, str):
        return sigma
    widths = {}
    for part in sigma.split(","):
        key, _, number = part.rpartition("=")
        try:
            widths[key.strip() or "*"] = _WIDTH.validate_python(number.strip())
        except pydantic.ValidationError as error:
            raise InputError(f"sigma: expected a number above 0, got {number.strip()!r}") from error
    if problem and (unknown := next((key for key in widths if key != "*" and key not in problem.unknowns), None)):
        raise InputError(f"sigma names {unknown}, which is not a parameter{did_you_mean(unknown, problem.unknowns)}")
    if "*" not in widths:
        raise InputError(
            f"sigma: expected a number for the other parameters too, as in 0.2, mug.rotation.y=0.6, got {sigma!r}"
        )
    return widths if len(widths) > 1 else widths["*"]


def widths_of(sigma: float | str | None, problem: Problem, keys: Iterable[str]) -> dict[str, float]:
    """Return the width of each of these parameters, see `parse_widths`."""
    widths = parse_widths(sigma, problem)
    return {key: widths.get(key, widths.get("*", WIDTH)) if isinstance(widths, dict) else widths for key in keys}


def first_steps(sigma: float | str | None, problem: Problem, keys: Iterable[str]) -> dict[str, float]:
    """Return the width of each of these parameters in units of its optimizer's variable u, where x = φ(u): σ over the largest φ'."""
    widths = widths_of(sigma, problem, keys)
    known = {key: problem.unknowns[key] for key in widths}
    slopes = {k: u.transform.slope(u.project(u.initial)) for k, u in known.items() if u.transform is not None}
    return {k: width / float(slopes[k].max()) if k in slopes else width for k, width in widths.items()}


def _common(sigma: float | Mapping[str, float]) -> float:
    return sigma.get("*", WIDTH) if isinstance(sigma, Mapping) else sigma


def _size(problem: Problem, key: str) -> float:
    """Return the order of magnitude of a parameter's size, a power of ten; 1 for a value of 0 without bounds."""
    unknown, info = problem.unknowns[key], problem.renderer.parameters()[key]
    (low, high), largest = unknown.bounds, float(abs(unknown.initial).max(initial=0.0))
    if info.rigid:
        return info.length
    if low is not None and high is not None:
        digits = math.log10(high - low)
        return 10.0 ** (math.floor(digits) if digits > 0.0 else round(digits))
    return 10.0 ** round(math.log10(largest)) if largest > 0.0 else 1.0
