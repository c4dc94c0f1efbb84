"""Methods by name: an estimator and an optimizer that go together, with the options that people set.

To add one, write its options as a class of documented fields, a function that builds it, and a line in `METHODS`; the
command line and its help follow.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import pydantic
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, NonNegativeInt, PositiveFloat, PositiveInt

from unrender import optimizers, pixels, schedules
from unrender.core.errors import InputError
from unrender.core.suggestions import did_you_mean
from unrender.estimators.base import Estimator
from unrender.estimators.loss_values import LossValues
from unrender.estimators.meta import MetaEstimator
from unrender.estimators.path import PathGradient
from unrender.estimators.smoothed import SmoothedDerivatives
from unrender.images.base import ImageEstimator
from unrender.images.denoised import Denoised
from unrender.images.plain import Plain
from unrender.images.recursive_control_variate import RecursiveControlVariate
from unrender.optimizers.base import Optimizer
from unrender.pixels.base import PixelSampler
from unrender.statistics import meta

SCHEDULES: dict[str, type] = {
    "constant": schedules.Constant,
    "exponential": schedules.Exponential,
    "cosine": schedules.Cosine,
    "steps": schedules.Steps,
    "warmup": schedules.Warmup,
}
SCHEDULE_HELP = "learning rate over the steps: cosine(300), exponential(100), steps(100, 0.5), warmup(20)"
_WIDTH = pydantic.TypeAdapter(PositiveFloat)
_CALL = re.compile(r"\s*([A-Za-z_]+)\s*(?:\(([^()]*)\))?\s*")


class Options(BaseModel):
    """Options of a method. Each field has a description, a default and a range."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class AdamOptions(Options):
    """What every method has that descends with Adam."""

    learning_rate: PositiveFloat = Field(0.01, description="step size of the parameters that have none of their own")
    beta_1: FiniteFloat = Field(0.9, ge=0, lt=1, description="Adam's decay of the mean gradient")
    beta_2: FiniteFloat = Field(0.999, ge=0, lt=1, description="Adam's decay of the mean squared gradient")
    schedule: str | None = Field(None, description=SCHEDULE_HELP)

    def optimizer(self) -> Optimizer:
        """Adam with these options."""
        return optimizers.Adam(
            self.learning_rate, beta_1=self.beta_1, beta_2=self.beta_2, schedule=parse_schedule(self.schedule)
        )


class PathOptions(AdamOptions):
    """What every method has that follows path gradients."""

    spp: PositiveInt = Field(8, description="samples per pixel; from 2 on, the adjoint shares their paths")
    adjoint_spp: PositiveInt | None = Field(None, description="samples per pixel of an adjoint on paths of its own")
    denoise: bool = Field(False, description="whether the loss sees denoised images (biased; extra unrender[denoise])")

    def estimator(self, image: ImageEstimator) -> Estimator:
        """The path gradient of what the loss sees in `image`."""
        return PathGradient(Denoised(image) if self.denoise else image, spp=self.spp, adjoint_spp=self.adjoint_spp)


class RecursiveControlVariateOptions(PathOptions):
    """Options of `rcv`."""

    spp: PositiveInt = Field(2, description="samples per pixel; from 2 on, the adjoint shares their paths")
    space: Literal["path", "primary"] = Field(
        "path", description="what two steps share: paths (materials, emitters), or random numbers (any parameter)"
    )
    alpha: FiniteFloat = Field(0.9, ge=0, lt=1, description="decay of the means behind the control weight")
    beta: FiniteFloat = Field(0.999, ge=0, lt=1, description="decay of the covariances behind the control weight")


class AdaptiveOptions(AdamOptions):
    """Options of `adaptive`."""

    pixels: PositiveInt = Field(4096, description="pixels a step, drawn from all pixels of all views")
    scheme: Literal["adaptive", "loss", "uniform"] = Field(
        "adaptive",
        description="pixels where the gradient's variance is, or in proportion to the loss derivative, or all alike",
    )
    spp: PositiveInt = Field(2, description="samples per drawn pixel; from 2 on, the adjoint shares their paths")
    levels: NonNegativeInt = Field(0, description="coarser resolutions that the probabilities look at, of adaptive")
    refresh: PositiveInt = Field(20, description="steps between estimates of the probabilities")
    uniform: PositiveFloat = Field(0.1, le=1, description="share of the draws that all pixels have equally")
    image: Literal["plain", "rcv"] = Field(
        "plain", description="what the loss sees: a fresh rendering, or rcv's, with a step of whole views now and then"
    )
    whole_views: PositiveInt = Field(20, description="steps between those of whole views, where image is rcv")

    def estimator(self) -> Estimator:
        """The path gradient of these pixels."""
        refreshed: dict[str, Any] = {"refresh": self.refresh, "uniform": self.uniform}
        made: dict[str, Callable[[], PixelSampler]] = {
            "adaptive": lambda: pixels.Adaptive(self.pixels, self.levels, **refreshed),
            "loss": lambda: pixels.LossProportional(self.pixels, **refreshed),
            "uniform": lambda: pixels.Uniform(self.pixels),
        }
        image = Plain() if self.image == "plain" else RecursiveControlVariate(whole_views=self.whole_views)
        return PathGradient(image, made[self.scheme](), self.spp)


class MetaCommonOptions(Options):
    """What the two forms of meta-estimation share."""

    optimizer: Literal["meta-adam", "adam"] = Field(
        "meta-adam",
        description="what takes the steps; adam, which takes the gradients for independent, is for comparison",
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

    def descent(self) -> Optimizer:
        """The optimizer with these options."""
        kind = optimizers.MetaAdam if self.optimizer == "meta-adam" else optimizers.Adam
        return kind(self.learning_rate, schedule=parse_schedule(self.schedule))

    def shared(self) -> dict[str, Any]:
        """The arguments that both forms of `MetaEstimator` take."""
        return {name: getattr(self, name) for name in ("space", "beta_proportional", "beta_difference")}


class MetaOptions(MetaCommonOptions):
    """Options of `meta`."""

    proportional_spp: PositiveInt = Field(2, description="samples per pixel of the gradient itself")
    difference_spp: PositiveInt = Field(1, description="samples per pixel of its change since the last step")


class CoupledOptions(MetaCommonOptions):
    """Options of `coupled`."""

    spp: PositiveInt = Field(3, description="samples per pixel, each for the gradient and for its change")
    image: Literal["plain", "rcv"] = Field(
        "plain", description="what the loss sees: a fresh rendering, or rcv's (in path space, unless space is primary)"
    )


class SmoothedOptions(Options):
    """Options of `smoothed`."""

    optimizer: Literal["newton-cg", "newton", "lbfgs", "adam", "cma-es"] = Field(
        "newton-cg",
        description="what takes the steps; newton forms n x n matrices, adam and lbfgs ask for gradients alone, cma-es for none",
    )
    sigma: PositiveFloat | str = Field(
        0.2,
        description="width of the smoothing at the start, in units of the parameters; some with their own: 0.2, mug.rotation.y=0.6",
    )
    sigma_schedule: str | None = Field("exponential(25, 0.1)", description="sigma over the steps, as for schedule")
    step: PositiveFloat = Field(
        0.5,
        description="as a share of sigma: the longest step; the learning rate, of adam; the first deviation, of cma-es",
    )
    samples: int = Field(16, ge=4, description="renders per view and step, for each derivative that has its own")
    spp: PositiveInt = Field(2, description="samples per pixel of a render")
    joint: bool = Field(
        True, description="gradient and curvature from the same renders; else each from its own, as in the paper"
    )
    iterations: PositiveInt = Field(3, description="products with the Hessian a step, of newton-cg")

    def start(self) -> tuple[Estimator, Optimizer]:
        """Both parts with these options."""
        schedule, sigma = parse_schedule(self.sigma_schedule), parse_widths(self.sigma)
        common = sigma["*"] if isinstance(sigma, dict) else sigma
        if self.optimizer == "cma-es":
            return LossValues(self.spp), optimizers.CMAES(sigma0=self.step * common)
        order: Any = {"newton-cg": "hvp", "newton": "hessian"}.get(self.optimizer, "gradient")
        estimator = SmoothedDerivatives(sigma, self.samples, order, joint=self.joint, spp=self.spp, schedule=schedule)
        made: dict[str, Callable[[], Optimizer]] = {
            "newton-cg": lambda: optimizers.NewtonCG(trust_radius=self.step, iterations=self.iterations),
            "newton": lambda: optimizers.Newton(trust_radius=self.step),
            "lbfgs": lambda: optimizers.LBFGS(trust_radius=self.step),
            "adam": lambda: optimizers.Adam(self.step * common, schedule=schedule),
        }
        return estimator, made[self.optimizer]()


@dataclass(frozen=True)
class Method:
    """A named way to recover a problem's parameters.

    Attributes:
        name: as on the command line.
        summary: one line.
        options: the class of its options.
        build: makes the two parts from options.
    """

    name: str
    summary: str
    options: type[Options]
    build: Callable[[Any], tuple[Estimator, Optimizer]]

    def configure(self, settings: Mapping[str, Any]) -> Options:
        """The options with `settings` in place of defaults; text is converted ("4" to 4, "none" to None).

        Raises:
            InputError: an unknown option (with the nearest known one), or a value of the wrong type or out of range.
        """
        fields = self.options.model_fields
        for name in settings:
            if name not in fields:
                hint = did_you_mean(name, fields) or f"; it has {', '.join(fields)}"
                raise InputError(f"method {self.name} has no option {name}{hint}")
        none = {name: None for name, value in settings.items() if isinstance(value, str) and value.lower() == "none"}
        try:
            return self.options.model_validate({**settings, **none})
        except pydantic.ValidationError as error:
            detail = error.errors()[0]
            name = str(detail["loc"][0])
            expected = f"expected {self.expected(name)}, got {detail['input']!r}"
            raise InputError(f"method {self.name}: option {name}: {expected}") from error

    def expected(self, name: str) -> str:
        """What values an option takes, in words: "a whole number above 0"."""
        schema = self.options.model_json_schema()["properties"][name]
        choices = [_in_words(choice) for choice in schema.get("anyOf", [schema])]
        return " or ".join(choices)

    def start(self, settings: Mapping[str, Any] | None = None) -> tuple[Estimator, Optimizer]:
        """Estimator and optimizer with `settings` in place of defaults. Raises `InputError`."""
        options = self.configure(settings or {})
        try:
            return self.build(options)
        except InputError as error:
            raise InputError(f"method {self.name}: {error}") from error


def _plain(options: PathOptions) -> tuple[Estimator, Optimizer]:
    return options.estimator(Plain()), options.optimizer()


def _rcv(options: RecursiveControlVariateOptions) -> tuple[Estimator, Optimizer]:
    image = RecursiveControlVariate(options.space, options.alpha, options.beta)
    return options.estimator(image), options.optimizer()


def _meta(options: MetaOptions) -> tuple[Estimator, Optimizer]:
    estimator = MetaEstimator(options.proportional_spp, options.difference_spp, **options.shared())
    return estimator, options.descent()


def _coupled(options: CoupledOptions) -> tuple[Estimator, Optimizer]:
    image = Plain()
    if options.image == "rcv":
        image = RecursiveControlVariate("primary" if options.space == "primary" else "path")
    return MetaEstimator(coupled=True, spp=options.spp, image=image, **options.shared()), options.descent()


def _smoothed(options: SmoothedOptions) -> tuple[Estimator, Optimizer]:
    return options.start()


def _adaptive(options: AdaptiveOptions) -> tuple[Estimator, Optimizer]:
    return options.estimator(), options.optimizer()


METHODS: dict[str, Method] = {
    method.name: method
    for method in (
        Method("plain", "a fresh rendering each step, crossed groups of samples, Adam", PathOptions, _plain),
        Method(
            "rcv",
            "recursive control variates: the image keeps what earlier steps rendered (Nicolet et al. 2023), Adam",
            RecursiveControlVariateOptions,
            _rcv,
        ),
        Method(
            "meta",
            "meta-estimation: the gradient keeps earlier ones, moved along by finite differences (Balint et al. 2023), MetaAdam",
            MetaOptions,
            _meta,
        ),
        Method(
            "coupled",
            "the same recursion, every sample in both of its terms, MetaAdam",
            CoupledOptions,
            _coupled,
        ),
        Method(
            "adaptive",
            "mini-batches of pixels drawn where the gradient's variance is, from all views at once, Adam",
            AdaptiveOptions,
            _adaptive,
        ),
        Method(
            "smoothed",
            "derivatives of a smoothed loss from perturbed renders alone, for poses and plateaus (Wang et al.), Newton-CG",
            SmoothedOptions,
            _smoothed,
        ),
    )
}
"""Every method by name."""


def method(name: str) -> Method:
    """The method of that name. Raises `InputError` with the nearest known name."""
    if name not in METHODS:
        known = ", ".join(METHODS)
        raise InputError(f"unknown method {name}{did_you_mean(name, METHODS) or f'; there are {known}'}")
    return METHODS[name]


def parse_schedule(text: str | None) -> schedules.Schedule | None:
    """The schedule that `text` names: "cosine(300)", "warmup(20) then exponential(100)"; None for none.

    Raises:
        InputError: an unknown name, or arguments that do not fit.
    """
    if text is None:
        return None
    first, *rest = re.split(r"\bthen\b", text, maxsplit=1)
    match = _CALL.fullmatch(first)
    name = match[1].lower() if match else ""
    if match is None or name not in SCHEDULES:
        what = match[1] if match else text
        known = ", ".join(SCHEDULES)
        raise InputError(f"schedule: unknown {what!r}{did_you_mean(name, SCHEDULES) or f'; there are {known}'}")
    kind = SCHEDULES[name]
    fields = [field for field in dataclasses.fields(kind) if field.name != "then"]
    given = [part.strip() for part in match[2].split(",")] if match[2] and match[2].strip() else []
    required = [field.name for field in fields if field.default is dataclasses.MISSING]
    if not len(required) <= len(given) <= len(fields):
        raise InputError(f"schedule: expected {name}({', '.join(field.name for field in fields)}), got {text!r}")
    arguments: dict[str, Any] = {field.name: _number(part) for field, part in zip(fields, given, strict=False)}
    if rest:
        if name != "warmup":
            raise InputError(f'schedule: only warmup can have something after "then", got {text!r}')
        arguments["then"] = parse_schedule(rest[0])
    try:
        return kind(**arguments)
    except InputError as error:
        raise InputError(f"schedule: {error}") from error


def parse_widths(given: float | str) -> float | dict[str, float]:
    """A width for all parameters, or {key: width, "*": width of the others} from "0.2, mug.rotation.y=0.6".

    Raises:
        InputError: no width for the others, or what is no number above 0.
    """
    if not isinstance(given, str):
        return given
    widths: dict[str, float] = {}
    for part in given.split(","):
        key, _, number = part.rpartition("=")
        try:
            widths[key.strip() or "*"] = _WIDTH.validate_python(number.strip())
        except pydantic.ValidationError as error:
            raise InputError(f"sigma: expected a number above 0, got {number.strip()!r}") from error
    if "*" not in widths:
        raise InputError(f"sigma: expected a number for all others too, as in 0.2, mug.rotation.y=0.6, got {given!r}")
    return widths if len(widths) > 1 else widths["*"]


def _number(text: str) -> int | float:
    try:
        return int(text)
    except ValueError:
        pass
    try:
        return float(text)
    except ValueError as error:
        raise InputError(f"schedule: expected a number, got {text!r}") from error


def _in_words(schema: Mapping[str, Any]) -> str:
    """A part of a JSON schema."""
    if "enum" in schema:
        return " or ".join(schema["enum"])
    words = {"integer": "a whole number", "number": "a number", "null": "none", "boolean": "true or false"}.get(
        schema.get("type", ""), "text"
    )
    names = {"exclusiveMinimum": "above", "minimum": "of at least", "exclusiveMaximum": "below", "maximum": "up to"}
    limits = [f"{word} {schema[name]:g}" for name, word in names.items() if name in schema]
    return f"{words} {' and '.join(limits)}".rstrip()
