"""Method `smoothed`: derivatives of a smoothed loss (Wang et al.)."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any, Literal

import numpy as np
import pydantic
from pydantic import Field, PositiveFloat, PositiveInt

from unrender import optimizers
from unrender.core.errors import InputError
from unrender.core.registry import register
from unrender.estimators.base import Estimator
from unrender.estimators.loss_values import LossValues
from unrender.estimators.smoothed import SmoothedDerivatives
from unrender.methods.base import Options, parameterised, parse_schedule
from unrender.methods.plan import Plan
from unrender.optimizers.base import Optimizer
from unrender.scene.problem import Problem

SIGMA_HELP = "smoothing width in units of the parameters, optionally per parameter: 0.2, mug.rotation.y=0.6; none for 0.2 times their size"
WIDTH = 0.2
"""Default smoothing width relative to the order of magnitude of a parameter's size."""
_WIDTH = pydantic.TypeAdapter(PositiveFloat)


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
        description="factor of sigma by step, such as cosine(300); with adam, also of its learning rate; unused by cma-es",
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

    def plan(self, problem: Problem) -> Plan:
        widths = parse_widths(self.sigma, problem)
        own = widths if self.sigma is None and isinstance(widths, dict) else {}
        return Plan(problem, *self._parts(widths, own), reasons=parameterised(problem))

    def _parts(self, sigma: float | dict[str, float], own: Mapping[str, float]) -> tuple[Estimator, Optimizer]:
        """Return both parts; `own` has the widths by which the first steps of adam and cma-es are scaled."""
        schedule = parse_schedule(self.sigma_schedule)
        common = sigma.get("*", WIDTH) if isinstance(sigma, dict) else sigma
        units: dict[str, float] = {"*": 1.0} | {key: width / common for key, width in own.items()}
        if self.optimizer == "cma-es":
            return LossValues(self.spp), optimizers.CMAES(
                sigma0=self.step * common, learning_rate=units if own else 1.0
            )
        scaled = {key: self.step * common * unit for key, unit in units.items()}
        rate = scaled if own else self.step * common
        order: Any = {"newton-cg": "hvp", "newton": "hessian"}.get(self.optimizer, "gradient")
        estimator = SmoothedDerivatives(sigma, self.samples, order, joint=self.joint, spp=self.spp, schedule=schedule)
        made: dict[str, Callable[[], Optimizer]] = {
            "newton-cg": lambda: optimizers.NewtonCG(trust_radius=self.step, iterations=self.iterations),
            "newton": lambda: optimizers.Newton(trust_radius=self.step),
            "lbfgs": lambda: optimizers.LBFGS(trust_radius=self.step),
            "adam": lambda: optimizers.Adam(rate, schedule=schedule),
        }
        return estimator, made[self.optimizer]()


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
    if "*" not in widths:
        raise InputError(
            f"sigma: expected a number for the other parameters too, as in 0.2, mug.rotation.y=0.6, got {sigma!r}"
        )
    return widths if len(widths) > 1 else widths["*"]


def widths_of(sigma: float | str | None, problem: Problem, keys: Iterable[str]) -> dict[str, float]:
    """Return the width of each of these parameters, see `parse_widths`."""
    widths = parse_widths(sigma, problem)
    return {key: widths.get(key, widths.get("*", WIDTH)) if isinstance(widths, dict) else widths for key in keys}


def _size(problem: Problem, key: str) -> float:
    """Return the order of magnitude of a parameter's size, a power of ten; 1 for a value of 0 without bounds."""
    unknown, info = problem.unknowns[key], problem.renderer.parameters()[key]
    (low, high), largest = unknown.bounds, float(np.abs(unknown.initial).max(initial=0.0))
    if info.rigid:
        return info.length
    if low is not None and high is not None:
        digits = math.log10(high - low)
        return 10.0 ** (math.floor(digits) if digits > 0.0 else round(digits))
    return 10.0 ** round(math.log10(largest)) if largest > 0.0 else 1.0
