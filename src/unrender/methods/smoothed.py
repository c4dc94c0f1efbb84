"""Method `smoothed`: derivatives of a smoothed loss (Wang et al.)."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, Literal

import pydantic
from pydantic import Field, PositiveFloat, PositiveInt

from unrender import optimizers
from unrender.core.errors import InputError
from unrender.core.registry import register
from unrender.estimators.base import Estimator
from unrender.estimators.loss_values import LossValues
from unrender.estimators.smoothed import SmoothedDerivatives
from unrender.methods.base import Options, parse_schedule
from unrender.optimizers.base import Optimizer

_WIDTH = pydantic.TypeAdapter(PositiveFloat)


@register(name="smoothed", position=6)
class SmoothedMethod(Options):
    """derivatives of a smoothed loss from perturbed renders, for poses and plateaus (Wang et al.), Newton-CG"""

    optimizer: Literal["newton-cg", "newton", "lbfgs", "adam", "cma-es"] = Field(
        "newton-cg",
        description="optimizer; newton forms n x n matrices, adam and lbfgs use gradients only, cma-es uses losses only",
    )
    sigma: PositiveFloat | str = Field(
        0.2,
        description="initial smoothing width in units of the parameters, optionally per parameter: 0.2, mug.rotation.y=0.6",
    )
    sigma_schedule: str | None = Field(
        "exponential(25, 0.1)",
        description="factor of sigma by step, such as cosine(300); with adam, also of its learning rate; unused by cma-es",
    )
    step: PositiveFloat = Field(
        0.5,
        description="relative to sigma: longest step; learning rate of adam; first standard deviation of cma-es",
    )
    samples: int = Field(16, ge=4, description="renders per view and step, for each separately estimated derivative")
    spp: PositiveInt = Field(2, description="samples per pixel of a render")
    joint: bool = Field(
        True,
        description="whether gradient and curvature use the same renders; otherwise separate ones, as in the paper",
    )
    iterations: PositiveInt = Field(3, description="Hessian-vector products per step of newton-cg")

    def build(self) -> tuple[Estimator, Optimizer]:
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


def parse_widths(sigma: float | str) -> float | dict[str, float]:
    """Return a width for all parameters, or {key: width, "*": width of the others} from "0.2, mug.rotation.y=0.6".

    Raises:
        InputError: the width of the others is missing, or a width is not a positive number.
    """
    if not isinstance(sigma, str):
        return sigma
    widths: dict[str, float] = {}
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


def widths_of(sigma: float | str, keys: Iterable[str]) -> dict[str, float]:
    """Return the width of each of these parameters, see `parse_widths`."""
    widths = parse_widths(sigma)
    each = widths if isinstance(widths, dict) else {"*": widths}
    return {key: each.get(key, each["*"]) for key in keys}
