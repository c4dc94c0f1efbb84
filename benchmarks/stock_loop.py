"""The usual loop, as Mitsuba's tutorials write it; and what somebody would do by hand for a reflectance that is seen directly: multiply
each texel by reference over rendering."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.internals import (
    SampleRequest,
    dr,
    from_tensor,
    load_scene,
    mi,
    prepare,
    project,
    scene_description,
    scene_values,
    stock_scene,
    volumetric,
)


def step_seed(seed: int, step: int, view: int) -> int:
    """The first of two seeds of a view at a step, which no other step of the run has."""
    return (seed * 1_000_003 + step * 64 + view) * 2 % 2**31


class StockViews:
    """The views of a problem by `mi.render`. Views with known values have scenes of their own; ties and expressions are applied.

    Args:
        integrator: of radiance; `prb`, or `prbvolpath` for media, unless given. AOVs are those of Mitsuba's `aov`.
        own: scene and parameters of views without known values; None for those of the problem's renderer.
    """

    def __init__(
        self, problem: ur.Problem, integrator: dict[str, Any] | None = None, own: tuple[Any, Any] | None = None
    ):
        self.problem = problem
        path = mi.load_dict(
            {**(integrator or {"type": "prbvolpath" if volumetric(problem) else "prb"}), "max_depth": problem.max_depth}
        )
        self._worlds: list[tuple[Any, Any, Any]] = [({}, *(own or stock_scene(problem)))]
        self._views = []
        for view in problem.original_views:
            known = {key: np.asarray(value, np.float32) for key, value in (view.known or {}).items()}
            same = (n for n, (held, *_) in enumerate(self._worlds) if _equal(held, known))
            if (index := next(same, None)) is None:
                index, scene = len(self._worlds), load_scene(scene_description(problem))
                parameters = mi.traverse(scene)
                for key, value in known.items():
                    parameters[key] = from_tensor(mi.TensorXf(value), parameters[key])
                self._worlds.append((known, scene, parameters))
            aov = {"type": "aov", "aovs": f"seen:{view.aov}"}
            self._views.append((index, view.sensor, mi.load_dict(aov) if view.aov else path))

    def write(self, values: Mapping[str, Any]) -> None:
        """Set the unknowns: tensors, or values of Mitsuba's types. Derivatives are kept."""
        for known, _, parameters in self._worlds:
            for key, value in scene_values(self.problem, values).items():
                if key not in known:
                    parameters[key] = from_tensor(value, parameters[key]) if dr.is_tensor_v(value) else value
            parameters.update()

    def backward(self, seed: int, step: int, views: Iterable[int], spp: int = 0, more: Any = 0.0) -> Any:
        """Render views, sum their losses and `more`, and call `dr.backward`. Return the sum; 0 samples are the integrator's own."""
        loss = more
        for view in views:
            (world, sensor, integrator), number = self._views[view], step_seed(seed, step, view)
            _, scene, parameters = self._worlds[world]
            options = {"sensor": sensor, "integrator": integrator, "spp": spp, "seed": number, "seed_grad": number + 1}
            image = mi.render(scene, parameters, **options)
            if self.problem.original_views[view].aov == "depth":
                image = image[..., :1] + dr.zeros(mi.TensorXf, (*image.shape[:2], 3))
            loss += self.problem.loss_value(view, image)
        dr.backward(loss)
        return loss


def _equal(one: Mapping[str, np.ndarray], other: Mapping[str, np.ndarray]) -> bool:
    """Whether two sets of known values have the same keys and equal arrays."""
    return one.keys() == other.keys() and all(np.array_equal(value, other[key]) for key, value in one.items())


def priors(problem: ur.Problem, values: Mapping[str, Any]) -> Any:
    """The priors' part of the loss, up to a constant, with its derivative at these values."""
    total: Any = 0.0
    for key, unknown in problem.unknowns.items():
        if unknown.prior is not None:
            _, slope = unknown.prior.evaluate(np.array(dr.detach(values[key])))
            total += dr.sum(
                values[key] * mi.TensorXf((problem.prior_scales[key] * slope).astype(np.float32)), axis=None
            )
    return total


class _Descent:
    """Adam on a problem's parameters from its start; `step` takes one step with the given views and returns the loss."""

    def __init__(self, problem: ur.Problem, stock: StockViews, rates: Mapping[str, float]):
        self.problem, self.stock, self.rates = problem, stock, rates
        self.optimizer = mi.ad.Adam(lr=1.0)
        for key, value in problem.initial().items():
            self.optimizer[key] = value
        self.set_rates(1.0)
        stock.write(self.optimizer)

    def set_rates(self, factor: float) -> None:
        self.optimizer.set_learning_rate({key: max(rate * factor, 1e-9) for key, rate in self.rates.items()})

    def step(self, seed: int, number: int, views: Iterable[int], spp: int) -> float:
        loss = self.stock.backward(seed, number, views, spp, priors(self.problem, self.optimizer))
        self.optimizer.step()
        for key in self.rates:
            self.optimizer[key] = project(self.optimizer[key], *self.problem.unknowns[key].bounds)
        self.stock.write(self.optimizer)
        found = float(np.array(dr.detach(loss)).reshape(-1)[0])
        dr.sync_thread()
        return found

    def values(self) -> dict[str, Any]:
        return {key: mi.TensorXf(dr.detach(self.optimizer[key])) for key in self.rates}


def stock_loop(
    problem: ur.Problem,
    spp: int,
    learning_rate: float,
    seconds: float = float("inf"),
    steps: int = sys.maxsize,
    seed: int = 0,
    every: int = 5,
    fall: Callable[[float], float] | None = None,
    error: Callable[[dict[str, Any]], Any] | None = None,
    timer: Callable[[], float] = time.perf_counter,
    views: int | None = None,
    integrator: dict[str, Any] | None = None,
) -> list[dict[str, Any]]:
    """Take the steps of `mi.render` with `prb`, or `prbvolpath` for media, `dr.backward`, `mi.ad.Adam`, values clipped. Return the history.

    Warm-up (two steps, or one of each view) and error measurement are left out of the clock, as in `ur.optimize`.

    Args:
        fall: factor of all rates by the share of the budget that is spent; None for constant rates.
        error: what the history has under "parameter_error"; None for the problem's own.
        timer: counts the seconds: `time.process_time` for those of the processor.
        integrator: see `StockViews`.
        views: random views a step, with one rate for all parameters; None for all views, and the problem's own rates where it has some.
    """
    stock, count, rng = StockViews(problem, integrator), len(problem.views), np.random.default_rng(seed)
    own = {} if views else problem.learning_rates
    rates = {key: own.get(key, learning_rate) for key in problem.initial()}
    warm = _Descent(problem, stock, rates)
    for step in range(count if views else 2):
        warm.step(seed, step, [step] if views else range(count), spp)
    descent, clock, step, history = _Descent(problem, stock, rates), 0.0, 0, []
    while clock < seconds and step < steps:
        began = timer()
        if fall:
            descent.set_rates(fall(min(max(clock / seconds, step / steps), 1.0)))
        chosen = rng.choice(count, min(views, count), replace=False).tolist() if views else range(count)
        loss = descent.step(seed, step, chosen, spp)
        clock += timer() - began
        step += 1
        if step % every == 0 or clock >= seconds or step >= steps:
            entry = {"step": step - 1, "seconds": clock, "loss": loss}
            history.append(entry | {"parameter_error": (error or problem.parameter_error)(descent.values())})
    return history


_WHOLE = 3
"""Steps that are made whole; later ones are made in part, as noise has to be averaged."""
_SUFFIXES = ("reflectance.data", "base_color.data")


def applies(problem: ur.Problem) -> bool:
    """Whether all unknowns are textures of reflectances."""
    return all(key.endswith(_SUFFIXES) for key in problem.shapes())


def fixed_point(
    problem: ur.Problem, spp: int, seconds: float, seed: int, error: Callable[[dict[str, Any]], float]
) -> list[tuple[float, float]]:
    """x ← x (Jᵀ R / Jᵀ I)^c, c = min(1, 3 / (k + 1)) at step k, with the Jacobian J of one set of paths for both, and I of another.

    For a texture that the camera sees directly, Jᵀ R / Jᵀ I is the mean of the pixels' reference over that of their rendering.
    Returns (seconds, error) of each step; the first step, which compiles, is made twice and timed once. Errors are not timed.
    """
    keys = list(problem.shapes())
    session = prepare(problem, keys)
    references = [problem.renderer.array(np.asarray(view.reference)[None]) for view in problem.views]
    history: list[tuple[float, float]] = []
    for warm in (True, False):
        x = {key: np.array(value, np.float32) for key, value in problem.initial().items()}
        clock, step = 0.0, 0
        while clock < seconds and step < (1 if warm else 1 << 30):
            began = time.perf_counter()
            values = {key: mi.TensorXf(value) for key, value in x.items()}
            above, below = ({key: np.zeros(value.shape) for key, value in x.items()} for _ in range(2))
            for view, reference in enumerate(references):
                sensor, number = problem.views[view].sensor, step_seed(seed, step, view)
                image = session.image(values, SampleRequest(sensor, spp, number)).images
                paths = session.image(values, SampleRequest(sensor, spp, number + 1)).paths
                for weights, sums in ((reference, above), (image, below)):
                    for key, found in session.adjoint(values, paths, weights).items():
                        sums[key] += np.array(found, np.float64).reshape(sums[key].shape)
            part = min(1.0, _WHOLE / (step + 1))
            for key, value in x.items():
                known = (above[key] > 0) & (below[key] > 0)
                ratio = np.where(known, above[key], 1.0) / np.where(known, below[key], 1.0)
                low, high = problem.unknowns[key].bounds
                x[key] = np.clip(value * ratio**part, low, high).astype(np.float32)
            clock += time.perf_counter() - began
            step += 1
            if not warm:
                history.append((clock, error({key: mi.TensorXf(value) for key, value in x.items()})))
    return history
