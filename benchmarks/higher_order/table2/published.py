"""FR22 and OurHVPA with the settings of the paper's public code (wangzican/prdpt2024), which are not tuned here.

Schedules of σ are linear: constant for the first steps, then down to the last value, which the last steps have. OurHVPA is the nonlinear
conjugate gradient of that code: one Hessian-vector product along the direction, by differences at ± σ / 3, and a step from a gradient of
its own, 8 renders in all for one pair of perturbations. BOX10 has three such steps along each direction; its films are of 500² there,
without noise. Negative curvature counts as 1, and steps are at most `trust` σ long. The direction is the gradient's again where it would
not descend; the code's counter of steps to a restart never rises.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

import unrender as ur
from benchmarks.higher_order.table2.descents import Descent, Track
from benchmarks.internals import Estimate, Key, black_box, gaussian, trees
from benchmarks.runner.timing import work_time

Function = Callable[[np.ndarray], np.ndarray]
METHODS = ("FR22, published", "OurHVPA, published")


@dataclass(frozen=True)
class Settings:
    """Settings of one method on one task.

    Attributes:
        sigma, last_sigma: σ at the start and at the end, in units of `unit`.
        steps: number of steps.
        first, last: steps before and after the change of σ.
        rate: Adam's learning rate, in units of `unit`; 0 for conjugate gradients.
        trust: longest step in units of σ.
        pairs: antithetic pairs of perturbations per gradient.
        searches: Newton steps along each direction of the conjugate gradients.
        spp: samples per pixel of a render.
        unit: the paper's unit of the parameters in ours.
    """

    sigma: float
    last_sigma: float
    steps: int
    first: int = 0
    last: int = 0
    rate: float = 0.0
    trust: float = 1.0
    pairs: int = 1
    searches: int = 1
    spp: int = 32
    unit: float = 1.0

    def sigma_at(self, step: int) -> float:
        """Return σ of a step."""
        share = np.clip((step - self.first) / max(self.steps - self.last - self.first, 1), 0.0, 1.0)
        return float(self.sigma + share * (self.last_sigma - self.sigma))


_TWENTY_DEGREES = float(np.radians(20.0))
_PIXEL = 2 / 500
SETTINGS: dict[str, dict[str, Settings]] = {
    "MUG": {
        "FR22, published": Settings(3.0, 0.01, 300, 50, 100, rate=0.1, unit=_TWENTY_DEGREES),
        "OurHVPA, published": Settings(3.0, 0.01, 30, 0, 10, trust=4.0, unit=_TWENTY_DEGREES),
    },
    "SHADOW": {
        "FR22, published": Settings(0.5, 0.01, 350, 150, rate=0.02),
        "OurHVPA, published": Settings(0.5, 0.05, 60, 0, 41, trust=4.0),
    },
    "BUNNY": {
        "FR22, published": Settings(0.004, 0.004, 200, rate=0.02, pairs=2),
        "OurHVPA, published": Settings(0.06, 0.005, 100, 20, 20, trust=2.0, pairs=2),
    },
    "CNN": {"FR22, published": Settings(0.5, 0.5, 10_000, rate=1e-4, unit=_TWENTY_DEGREES)},
    "BOX10": {
        "FR22, published": Settings(50.0, 0.1, 7000, 2000, 500, rate=0.05, pairs=6, spp=4, unit=_PIXEL),
        "OurHVPA, published": Settings(83.0, 0.1, 200, 20, 10, trust=10.0, pairs=6, searches=3, spp=4, unit=_PIXEL),
    },
}
"""Of the public code, by task."""


def descend(name: str, method: str, problem: ur.Problem, seed: int) -> Descent:
    """Return one run with the published settings."""
    settings = SETTINGS[name][method]
    stepper, track = _fr22 if settings.rate else _conjugate_gradients, Track(problem)
    stepper(problem, settings, seed, lambda *_: None, 2)
    began = work_time()

    def moved(point: np.ndarray) -> None:
        track.add(settings.unit * point, work_time() - began)

    renders = stepper(problem, settings, seed, moved, settings.steps)
    return track.descent(settings.spp * renders)


def _loss(problem: ur.Problem, settings: Settings, seed: int, step: int) -> Function:
    """Return the loss at points in units of `Settings.unit`, all with the same random numbers."""
    losses = black_box(problem, problem.initial(), settings.spp, Key(seed, step))
    return lambda points: losses(settings.unit * points)


def _fr22(problem: ur.Problem, settings: Settings, seed: int, moved: Callable[[np.ndarray], None], steps: int) -> int:
    """Descend by Adam on the gradient of Fischer and Ritschel 2023. Return the number of renders."""
    rng, x = np.random.default_rng([31, seed]), trees.ravel(problem.initial()) / settings.unit
    adam = ur.optimizers.Adam(settings.rate)
    state = adam.init({"x": x})
    for step in range(steps):
        sigma = settings.sigma_at(step)
        gradient = fr22_gradient(_loss(problem, settings, seed, step), x, sigma, settings.pairs, rng)
        move, state = adam.update(Estimate(0.0, {"x": gradient}), state, {"x": x})
        x = x + move["x"]
        moved(x)
    return 2 * settings.pairs * steps


def fr22_gradient(f: Function, x: np.ndarray, sigma: float, pairs: int, rng: np.random.Generator) -> np.ndarray:
    """Return the gradient of Fischer and Ritschel 2023 from antithetic pairs, (n,). For one number it is the paper's, too."""
    z = gaussian.gradient_sample(rng.uniform(size=(pairs, x.size)))
    return np.mean(_odd(f, x, sigma, z)[:, None] * np.sign(z), axis=0) * gaussian.GRADIENT_MASS / sigma


def _conjugate_gradients(
    problem: ur.Problem, settings: Settings, seed: int, moved: Callable[[np.ndarray], None], steps: int
) -> int:
    """Descend by nonlinear conjugate gradients with aggregate gradients and products. Return the number of renders."""
    rng, x = np.random.default_rng([37, seed]), trees.ravel(problem.initial()) / settings.unit
    sigma = settings.sigma_at(0)
    residual = -_gradient(_loss(problem, settings, seed, -1), x, sigma, settings.pairs, rng)
    direction = residual
    for step in range(steps):
        sigma = settings.sigma_at(step)
        loss, length = _loss(problem, settings, seed, step), float(np.linalg.norm(direction))
        for _ in range(settings.searches if length > 0.0 else 0):
            ahead = sigma / 3 / length * direction
            state = rng.bit_generator.state
            product = -_gradient(loss, x - ahead, sigma, settings.pairs, rng)
            rng.bit_generator.state = state
            product = (product + _gradient(loss, x + ahead, sigma, settings.pairs, rng)) / (2 * sigma / 3) * length
            curvature = float(direction @ product)
            slope = float(_gradient(loss, x, sigma, settings.pairs, rng) @ direction)
            move = -slope / (curvature if curvature > 0.0 else 1.0) * direction
            x = x + move * min(1.0, settings.trust * sigma / max(float(np.linalg.norm(move)), 1e-30))
        moved(x)
        last, residual = residual, -_gradient(loss, x, sigma, settings.pairs, rng)
        direction = residual + (residual @ residual) / max(float(last @ last), 1e-30) * direction
        if residual @ direction <= 0.0:
            direction = residual
    return (6 * settings.searches + 2) * settings.pairs * steps


def _gradient(f: Function, x: np.ndarray, sigma: float, pairs: int, rng: np.random.Generator) -> np.ndarray:
    """Return the aggregate gradient of the paper's section 3.5 from antithetic pairs, (n,)."""
    normal = rng.standard_normal((pairs, x.size))
    z = gaussian.gradient_mixture(rng.uniform(size=pairs), rng.uniform(size=(pairs, x.size)), normal)
    weight = z / (sigma * gaussian.gradient_ratio(z)[:, None])
    return np.mean(_odd(f, x, sigma, z)[:, None] * weight, axis=0)


def _odd(f: Function, x: np.ndarray, sigma: float, z: np.ndarray) -> np.ndarray:
    """Return half of f(x + σ z) − f(x − σ z), (B,)."""
    values = f(np.concatenate([x + sigma * z, x - sigma * z]))
    return 0.5 * (values[: len(z)] - values[len(z) :])
