"""The methods of HO Table 2 and the configurations that each is tuned over."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import unrender as ur
from benchmarks.higher_order.table2.tasks import Task

FLOOR = 0.05
"""σ, learning rates and Newton's steps shrink to this share of their start, and no further."""
_MANY = 100
"""Parameters from which on a step is searched along one direction, and CMA-ES learns no covariances."""

Config = dict[str, float]


@dataclass(frozen=True)
class Method:
    """A column of the table.

    Attributes:
        make: (task, number of parameters, configuration) to estimator and optimizer.
        grid: what is tried.
    """

    make: Callable[[Task, int, Config], tuple[Any, Any]]
    grid: dict[str, tuple[float, ...]]


def _samples(n: int, c: Config) -> int:
    """Renders that an aggregate gradient takes."""
    usual = 8 if n <= 3 else 32 if n <= 32 else 256
    return max(round(c.get("samples", 1.0) * usual), 4)


def _shrinking(half_life: float, floor: float) -> ur.schedules.Exponential:
    return ur.schedules.Exponential(half_life, floor)


def _smoothed(task: Task, c: Config, samples: int, **more: Any) -> ur.SmoothedDerivatives:
    schedule = _shrinking(c["half_life"], FLOOR)
    return ur.SmoothedDerivatives(task.widths, samples, spp=task.spp, schedule=schedule, **{"joint": False, **more})


def _adam(task: Task, c: Config) -> Any:
    return ur.optimizers.Adam(c["rate"] * task.sigma, schedule=_shrinking(2 * c["half_life"], FLOOR))


def _newton(n: int, c: Config) -> dict[str, Any]:
    """Options of both Newton's methods: a trust radius of so much for each number, in units of σ, and steps that shrink."""
    return {"trust_radius": c["radius"] * math.sqrt(n), "schedule": _shrinking(c["steps"], FLOOR)}


def _fr22(task: Task, n: int, c: Config) -> tuple[Any, Any]:
    return _smoothed(task, c, _samples(n, c), product=True), _adam(task, c)


def _gradient(task: Task, n: int, c: Config) -> tuple[Any, Any]:
    return _smoothed(task, c, max(_samples(n, c) // n, 4), aggregate=False), _adam(task, c)


def _hessian(task: Task, n: int, c: Config) -> tuple[Any, Any]:
    samples = max(2 * _samples(n, c) // n, 4)
    estimator = _smoothed(task, c, samples, order="hessian", aggregate=False, adaptive_annealing=True)
    return estimator, ur.optimizers.Newton(**_newton(n, c))


def _products(aggregate: bool) -> Callable[..., tuple[Any, Any]]:
    def make(task: Task, n: int, c: Config) -> tuple[Any, Any]:
        samples = _samples(n, c) if aggregate else max(_samples(n, c) // n, 4)
        if "memory" in c:
            return _kept(task, c, samples), _newton_cg(n, c)
        estimator = _smoothed(task, c, samples, order="hvp", aggregate=aggregate, adaptive_annealing=True)
        return estimator, ur.optimizers.NewtonCG(
            iterations=1 if n > _MANY else int(c.get("iterations", min(n, 3))), **_newton(n, c)
        )

    return make


def _kept(task: Task, c: Config, samples: int, joint: bool = False) -> ur.SmoothedDerivatives:
    """Products of a Hessian that is kept between steps; with `adaptive`, σ shrinks by convergence in place of steps."""
    adaptive = bool(c.get("adaptive", 0.0))
    half_life = c.get("half_life", 3.0 if adaptive else 20.0)
    more = {"joint": joint, "hessian_rate": c["memory"], "adaptive_annealing": adaptive}
    return _smoothed(task, {**c, "half_life": half_life}, samples, order="hvp", **more)


def _newton_cg(n: int, c: Config) -> Any:
    """On such a Hessian, with steps that shrink as noise wants it."""
    options = {**_newton(n, c), "schedule": ur.schedules.Inverse(c["steps"])}
    return ur.optimizers.NewtonCG(iterations=min(n, 5), **options)


def _joint(task: Task, n: int, c: Config) -> tuple[Any, Any]:
    if "memory" in c:
        return _kept(task, c, _samples(n, c), joint=True), _newton_cg(n, c)
    estimator = _smoothed(task, c, _samples(n, c), order="hvp", joint=True, adaptive_annealing=True)
    many = n > _MANY
    return estimator, ur.optimizers.NewtonCG(iterations=1 if many else min(n, 5), line=many, **_newton(n, c))


def _search(task: Task, n: int, c: Config) -> tuple[Any, Any]:
    population = None if c["population"] == 0 else int(c["population"])
    optimizer = ur.optimizers.CMAES(c["deviation"], population, diagonal=n > _MANY, learning_rate=task.sigma)
    return ur.LossValues(spp=task.spp), optimizer


def _lbfgs(task: Task, n: int, c: Config) -> tuple[Any, Any]:
    return _smoothed(task, c, _samples(n, c)), ur.optimizers.LBFGS(**_newton(n, c))


_NEWTON_GRID = {"half_life": (6.0,), "steps": (30.0,), "radius": (0.5,)}
_HALF_OR_ALL = {"samples": (0.5, 1.0)}
_KEPT_GRID = {"adaptive": (0.0, 1.0), "steps": (10.0,)}
METHODS = {
    "FR22": Method(_fr22, {"half_life": (10.0, 25.0), "rate": (0.15, 0.5), **_HALF_OR_ALL}),
    "CMA-ES": Method(_search, {"deviation": (0.5, 1.0), "population": (8, 16)}),
    "L-BFGS": Method(_lbfgs, {"half_life": (10.0, 25.0), "steps": (30.0,), "radius": (0.5, 1.5), **_HALF_OR_ALL}),
    "OurG": Method(_gradient, {"half_life": (25.0,), "rate": (0.15, 0.3)}),
    "OurH": Method(_hessian, _NEWTON_GRID),
    "OurHVP": Method(_products(False), _NEWTON_GRID),
    "OurHVPA": Method(_products(True), {**_KEPT_GRID, "radius": (1.5,), "memory": (0.25, 0.5), **_HALF_OR_ALL}),
    "OurJoint": Method(_joint, {**_KEPT_GRID, "radius": (1.0,), "memory": (0.3, 1.0), **_HALF_OR_ALL}),
}
_RATES = {"rate": (0.03, 0.1, 0.3)}
_WIDE = {"half_life": (1e6,), "steps": (1e6,), "radius": (0.5,)}
_FAR = {"half_life": (6.0, 60.0), "steps": (30.0,), "radius": (0.8, 4.0)}
_CROWD = {"half_life": (30.0,), "radius": (0.25, 0.5), **_HALF_OR_ALL}
_FAR_KEPT = {"half_life": (6.0, 60.0), "steps": (30.0,), "radius": (0.8, 4.0), "memory": (0.5, 1.0)}
OTHER_GRIDS: dict[tuple[str, str], dict[str, tuple[float, ...]]] = {
    ("BOX10", "OurHVPA"): {**_CROWD, "steps": (30.0, 80.0), "iterations": (1.0,)},
    ("BOX10", "OurJoint"): {**_CROWD, "steps": (20.0, 80.0), "adaptive": (0.0,), "memory": (0.3,)},
    ("BUNNY", "Mitsuba"): _RATES,
    **{("QUAD", method): _FAR for method in ("OurH", "OurHVP")},
    ("QUAD", "OurHVPA"): {**_FAR, "iterations": (1.0, 2.0)},
    ("QUAD", "OurJoint"): _FAR_KEPT,
    ("QUAD", "FR22"): {"half_life": (25.0, 60.0), "rate": (0.5, 0.7, 1.0, 2.0)},
    ("QUAD", "OurG"): {"half_life": (25.0, 60.0), "rate": (0.5, 1.0, 2.0)},
    ("TEXTURE", "Mitsuba"): {"rate": (0.03, 0.1)},
    ("TEXTURE", "FR22"): {"half_life": (60.0,), "rate": (0.2, 0.4)},
    ("TEXTURE", "CMA-ES"): {"deviation": (0.5,), "population": (16,)},
    ("TEXTURE", "OurG"): {"half_life": (60.0,), "rate": (0.2,)},
    ("TEXTURE", "OurHVP"): _WIDE,
    ("TEXTURE", "OurHVPA"): _WIDE,
    ("TEXTURE", "OurJoint"): _WIDE,
}
"""What is tried in place of a method's own grid."""
LEFT_OUT = {("TEXTURE", "OurH"): "a Hessian of 1024 × 1024 elements, each from perturbations of its own"}


def configurations(task: str, method: str) -> list[Config]:
    """What is tried for a method on a task."""
    grid = OTHER_GRIDS.get((task, method)) or METHODS[method].grid
    return [dict(zip(grid, values, strict=True)) for values in itertools.product(*grid.values())]
