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
"""Parameters from which on the Hessian is a diagonal, and CMA-ES learns no covariances."""
_SMOOTH = 0.2
"""Factor of σ where the loss is smooth: perturbations that hardly leave the bounds."""
_UNBOUNDED = 1e6
"""A trust radius that bounds nothing."""

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


def _spp(task: Task, c: Config) -> int:
    """Samples per pixel of a render: a configuration's own, or the task's."""
    return int(c.get("spp", task.spp))


def _smoothed(task: Task, c: Config, samples: int, **more: Any) -> ur.SmoothedDerivatives:
    schedule = _shrinking(c["half_life"], FLOOR)
    more = {"joint": False, **more} if "order" in more else more
    return ur.SmoothedDerivatives(task.widths, samples, spp=_spp(task, c), schedule=schedule, **more)


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
        if n > _MANY and aggregate:
            return _many(task, n, c, joint=False)
        if "memory" in c:
            return _kept(task, c, samples), _newton_cg(n, c)
        estimator = _smoothed(task, c, samples, order="hvp", aggregate=aggregate, adaptive_annealing=True)
        return estimator, ur.optimizers.NewtonCG(iterations=int(c.get("iterations", min(n, 3))), **_newton(n, c))

    return make


def _kept(task: Task, c: Config, samples: int, joint: bool = False) -> ur.SmoothedDerivatives:
    """Products of a Hessian that is kept between steps; with `adaptive`, σ shrinks by convergence in place of steps."""
    adaptive = bool(c.get("adaptive", 0.0))
    half_life = c.get("half_life", 3.0 if adaptive else 20.0)
    more = {"joint": joint, "adaptive_annealing": adaptive, "epsilon": c.get("epsilon", 0.3)}
    more |= {"hessian_rate": c["memory"], "hessian_form": "diagonal" if "diagonal" in c else "full"}
    return _smoothed(task, {**c, "half_life": half_life}, samples, order="hvp", **more)


def _newton_cg(n: int, c: Config) -> Any:
    """On such a Hessian, with steps that shrink as noise wants it; those on a diagonal as without memory."""
    options = _newton(n, c)
    if "diagonal" not in c:
        options["schedule"] = ur.schedules.Inverse(c["steps"])
    return ur.optimizers.NewtonCG(iterations=min(n, 5), **options)


def _many(task: Task, n: int, c: Config, joint: bool) -> tuple[Any, Any]:
    """Of many parameters that hardly touch one another: as many orthogonal directions a step as tell the gradient, the diagonal of the
    Hessian, which the same renders tell, and whole Newton's steps that shrink."""
    samples = _samples(n, c)
    options: dict[str, Any] = {"order": "hvp", "joint": joint, "spp": _spp(task, c), "orthogonal": True}
    options |= {"hessian_form": "diagonal", "hessian_rate": 1.0, "schedule": ur.schedules.Constant(_SMOOTH)}
    share = min(1.0, samples / (2 if joint else 4) / n)
    falling = {"step_scale": share, "schedule": ur.schedules.Inverse(c["steps"])}
    optimizer = ur.optimizers.NewtonCG(trust_radius=_UNBOUNDED, iterations=8, tolerance=0.01, damping=0.02, **falling)
    return ur.SmoothedDerivatives(task.widths, samples, **options), optimizer


def _joint(task: Task, n: int, c: Config) -> tuple[Any, Any]:
    if n > _MANY:
        return _many(task, n, c, joint=True)
    if "memory" in c:
        return _kept(task, c, _samples(n, c), joint=True), _newton_cg(n, c)
    estimator = _smoothed(task, c, _samples(n, c), order="hvp", joint=True, adaptive_annealing=True)
    return estimator, ur.optimizers.NewtonCG(iterations=min(n, 5), **_newton(n, c))


def _search(task: Task, n: int, c: Config) -> tuple[Any, Any]:
    population = None if c["population"] == 0 else int(c["population"])
    optimizer = ur.optimizers.CMAES(c["deviation"], population, diagonal=n > _MANY, learning_rate=task.sigma)
    return ur.estimators.LossValues(spp=_spp(task, c)), optimizer


def _lbfgs(task: Task, n: int, c: Config) -> tuple[Any, Any]:
    return _smoothed(task, c, _samples(n, c)), ur.optimizers.LBFGS(**_newton(n, c))


def _gauss_newton(task: Task, n: int, c: Config) -> tuple[Any, Any]:
    """Return differences of renders at widths of at most σ, with the mean of all quadratic models as `auto` uses it."""
    largest = {key: task.widths.get(key, task.sigma) for key in task.problem().initial()}
    coarse = c["coarse"] if c["coarse"] > 0.0 else None
    samples = int(c["spp"]), int(c["derivative_spp"])
    estimator = ur.GaussNewton(*samples, coarse=coarse, largest=largest, scores=False)
    return estimator, ur.optimizers.AveragedNewton()


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
    "OurGN": Method(
        _gauss_newton,
        {"draws": (32.0, 64.0), "spread": (0.7, 1.5), "coarse": (4.0, 8.0)} | {"spp": (8.0,), "derivative_spp": (2.0,)},
    ),
}
_RATES = {"rate": (0.03, 0.1, 0.3)}
_WIDE = {"half_life": (1e6,), "steps": (1e6,), "radius": (0.5,), "iterations": (1.0,)}
_ONE_BY_ONE = {"steps": (2.0, 5.0), "spp": (8.0, 16.0)}
_FAR = {"half_life": (6.0, 60.0), "steps": (30.0,), "radius": (0.8, 4.0)}
_FEW_SAMPLES = {"spp": (1.0, 2.0)}
_MORE_SAMPLES = {"spp": (2.0, 4.0)}
_BUNNY = {"adaptive": (1.0,), "steps": (10.0,), **_HALF_OR_ALL, **_MORE_SAMPLES}
_CROWD = {"half_life": (30.0,), "radius": (0.25,), "steps": (80.0,), **_HALF_OR_ALL, **_FEW_SAMPLES}
"""Chosen by hand before there was a kept Hessian: σ by convergence, nothing kept."""
_DIAGONAL = {"adaptive": (1.0,), "diagonal": (1.0,), "steps": (80.0,), **_FEW_SAMPLES}
_FAR_KEPT = {"half_life": (6.0, 60.0), "steps": (30.0,), "radius": (0.8, 4.0), "memory": (0.5, 1.0)}
Grid = dict[str, tuple[float, ...]]
OTHER_GRIDS: dict[tuple[str, str], Grid | tuple[Grid, ...]] = {
    ("BOX10", "FR22"): {"half_life": (10.0, 25.0), "rate": (0.15,), **_HALF_OR_ALL, **_FEW_SAMPLES},
    ("BOX10", "OurHVPA"): (
        {**_CROWD, "iterations": (1.0,)},
        {**_DIAGONAL, "half_life": (30.0, 45.0), "radius": (0.15,), "memory": (0.1,), "epsilon": (0.8,)},
    ),
    ("BOX10", "OurJoint"): (
        _CROWD,
        {**_DIAGONAL, "half_life": (30.0,), "radius": (0.25,), "memory": (0.3,), **_HALF_OR_ALL},
    ),
    ("BUNNY", "Mitsuba"): _RATES,
    ("BUNNY", "FR22"): {"half_life": (10.0, 25.0), "rate": (0.15,), **_HALF_OR_ALL, **_MORE_SAMPLES},
    ("BUNNY", "CMA-ES"): {"deviation": (0.5, 1.0), "population": (8, 16), **_MORE_SAMPLES},
    ("BUNNY", "OurHVPA"): {**_BUNNY, "radius": (1.5,), "memory": (0.5,), "epsilon": (0.3, 0.8)},
    ("BUNNY", "OurJoint"): {**_BUNNY, "radius": (1.0,), "memory": (0.3, 1.0)},
    **{("QUAD", method): _FAR for method in ("OurH", "OurHVP")},
    ("QUAD", "OurHVPA"): {**_FAR, "iterations": (1.0, 2.0)},
    ("QUAD", "OurJoint"): _FAR_KEPT,
    ("QUAD", "FR22"): {"half_life": (25.0, 60.0), "rate": (0.5, 0.7, 1.0, 2.0)},
    ("QUAD", "OurG"): {"half_life": (25.0, 60.0), "rate": (0.5, 1.0, 2.0)},
    ("TEXTURE", "Mitsuba"): {"rate": (0.03, 0.1, 0.3, 1.0)},
    ("TEXTURE", "FR22"): {"half_life": (30.0, 60.0), "rate": (0.25, 0.5), "spp": (4.0, 16.0)},
    ("TEXTURE", "CMA-ES"): {"deviation": (0.25, 0.5), "population": (16, 32), "spp": (4.0,)},
    ("TEXTURE", "OurG"): {"half_life": (60.0,), "rate": (0.2,)},
    ("TEXTURE", "OurHVP"): _WIDE,
    ("TEXTURE", "OurHVPA"): {"samples": (12.0, 16.0), **_ONE_BY_ONE},
    ("TEXTURE", "OurJoint"): {"samples": (6.0, 8.0), **_ONE_BY_ONE},
}
"""What is tried in place of a method's own grid; several grids are tried one after the other."""
LEFT_OUT = {
    ("TEXTURE", "OurH"): "a Hessian of 1024 × 1024 elements, each from perturbations of its own",
    ("QUAD", "OurGN"): "its images have one pixel, which determines one combination of two numbers",
}


def configurations(task: str, method: str) -> list[Config]:
    """What is tried for a method on a task."""
    found = OTHER_GRIDS.get((task, method)) or METHODS[method].grid
    grids = (found,) if isinstance(found, dict) else found
    return [dict(zip(grid, values, strict=True)) for grid in grids for values in itertools.product(*grid.values())]
