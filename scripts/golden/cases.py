"""The descents that golden trajectories are made of: twelve small problems by six methods, and optimizers on made gradients."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

import unrender as ur
from tests.analytic import AnalyticRenderer
from unrender.core import arrays
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import FreshGradient, Variance
from unrender.methods.plan import bind
from unrender.preconditioners import LargeSteps, Sobolev
from unrender.preconditioners.mesh import MeshTopology
from unrender.runs.callbacks import Callback

__all__ = ["METHODS", "OPTIMIZERS", "PROBLEMS", "Trajectory", "descend", "optimize"]

STEPS = 12
"""Of a descent by a method."""
_SAMPLES = {"spp": 4}
METHODS: dict[str, dict[str, Any]] = {
    "auto": {},
    "plain": _SAMPLES,
    "rcv": _SAMPLES,
    "coupled": _SAMPLES,
    "adaptive": {"pixels": 32},
    "smoothed": {},
}
"""{name: settings}."""


def _linear(loss: Any, size: int, views: int = 1) -> ur.Problem:
    """A colour and a texture that 8 × 8 pixels are linear in."""
    rng, shape = np.random.default_rng(7), (8, 8)
    truth = {"colour": rng.uniform(0.3, 0.9, 3), "map": rng.uniform(0.3, 0.9, (size, size, 1))}
    matrix = rng.uniform(0.0, 1.0, (shape[0] * shape[1] * 3, 3 + size * size)) / size
    renderer = AnalyticRenderer(truth, matrix, 0.1, 0.5, shape=shape, sensors=views)
    asked = [ur.Parameter(key, initial=0.5, bounds=(0, 1)) for key in truth]
    reference = renderer.exact(truth)
    return ur.Problem(renderer, asked, [ur.View(reference, sensor=n) for n in range(views)], loss=loss, truth=truth)


def _gallery(name: str, **options: Any) -> Callable[[], ur.Problem]:
    return lambda: ur.gallery.problem(name, **options)


_SMALL = {"resolution": 8, "reference_spp": 256}
PROBLEMS: dict[str, Callable[[], ur.Problem]] = {
    "linear": lambda: _linear(ur.losses.L2(), 6),
    "linear-l1": lambda: _linear(ur.losses.L1(), 8, views=2),
    "exponential": _gallery("exponential"),
    "quad": _gallery("quad"),
    "poster": _gallery("poster", texture_resolution=8, **_SMALL),
    "wall": _gallery("wall", texture_resolution=8, **_SMALL),
    "lamp": _gallery("lamp", texture_resolution=8, **_SMALL),
    "three-bodies": _gallery("three-bodies", **_SMALL),
    "smoke": _gallery("smoke", grid_resolution=8, views=2, **_SMALL),
    "mug": _gallery("mug", label=4, **_SMALL),
    "sphere-to-mesh": _gallery("sphere-to-mesh", subdivisions=1, views=2, **_SMALL),
    "camera": _gallery("camera", **_SMALL),
}
"""The problems by name. The first four are analytic; the others are rendered by Mitsuba."""


class Trajectory(Callback):
    """The parameters of a descent, step by step.

    Attributes:
        losses: one for each step.
        hashes: of all parameters after each step.
        sketch: {key: a few random projections of the last parameters}, float64; the same directions for equal shapes.
    """

    def __init__(self) -> None:
        self.losses: list[float] = []
        self.hashes: list[str] = []
        self.sketch: dict[str, list[float]] = {}

    def on_step(self, run: Any, record: dict[str, Any]) -> None:
        """Note one step."""
        self.note(record["loss"], {key: arrays.numpy(value) for key, value in run.parameters.items()})

    def note(self, loss: float, parameters: Mapping[str, np.ndarray]) -> None:
        """Add a loss and the parameters after its step."""
        digest = hashlib.sha256()
        for key, value in sorted(parameters.items()):
            digest.update(key.encode() + np.ascontiguousarray(value).tobytes())
        self.losses.append(float(loss))
        self.hashes.append(digest.hexdigest()[:8])
        self.sketch = {key: _sketch(value) for key, value in parameters.items()}


def _sketch(value: np.ndarray) -> list[float]:
    flat = np.asarray(value, np.float64).reshape(-1)
    directions = np.random.default_rng(flat.size).normal(size=(4, flat.size))
    return (directions @ flat / np.sqrt(flat.size)).tolist()


def descend(problem: ur.Problem, method: str, seed: int) -> Trajectory:
    """Take the steps of a method. Raises `InputError` where it does not suit the problem."""
    from unrender.methods import method as named

    choice, trajectory = named(method).plan(problem, METHODS[method]), Trajectory()
    ur.optimize(problem, choice, steps=STEPS, seed=seed, callbacks=[trajectory], progress=False)
    return trajectory


# ------------------------------------------------------------------------------------------- optimizers on made gradients

_STREAM, _QUIET = 70, 45
"""Steps of an optimizer, and of these the steps with little noise: smoothing becomes weaker for detail, and stronger again for noise."""


def _schedule_free(**options: Any) -> ur.optimizers.ScheduleFree:
    return ur.optimizers.ScheduleFree(
        {"*": 0.05, "number": 0.02}, preconditioner=Sobolev(), preconditioned=("map",), **options
    )


def _on_sheet() -> Any:
    """Schedule-free steps of values at the vertices of a mesh, beside large steps of positions."""
    topology = _sheet(4)
    inner = ur.optimizers.ScheduleFree(0.05, preconditioner=Sobolev(), preconditioned=("vertices",))
    partitioned = ur.optimizers.Partitioned(("colour",), ur.optimizers.Adam(0.01, uniform=True), inner)
    return bind(partitioned, lambda key: topology if key == "vertices" else None, {})


def _sheet(side: int) -> MeshTopology:
    numbers = np.arange(side * side).reshape(side, side)
    across = np.stack([numbers[:, :-1], numbers[:, 1:]], axis=-1).reshape(-1, 2)
    down = np.stack([numbers[:-1], numbers[1:]], axis=-1).reshape(-1, 2)
    return MeshTopology(np.arange(side * side), np.concatenate([across, down]))


OPTIMIZERS: dict[str, Callable[[], Any]] = {
    "Adam": lambda: ur.optimizers.Adam(0.02, schedule=ur.schedules.Exponential(30)),
    "Adam, uniform": lambda: ur.optimizers.Adam({"*": 0.02, "number": 0.1}, beta_2=0.99, uniform=True),
    "SGD": lambda: ur.optimizers.SGD(0.05),
    "SGD, momentum": lambda: ur.optimizers.SGD(0.02, momentum=0.8, schedule=ur.schedules.Cosine(60)),
    "MetaAdam": lambda: ur.optimizers.MetaAdam(0.004),
    "ScheduleFree": lambda: ur.optimizers.ScheduleFree(0.05),
    "ScheduleFree, scheduled": lambda: ur.optimizers.ScheduleFree(
        0.05, 0.8, averaging=4.0, growth=0.2, decay=0.4, schedule=ur.schedules.Cosine(60)
    ),
    "ScheduleFree, smooth": _schedule_free,
    "ScheduleFree, smooth, whole steps": lambda: _schedule_free(wiener=False),
    "ScheduleFree, logarithms": lambda: _schedule_free(reparameterised=("colour",)),
    "ScheduleFree, large steps": lambda: ur.optimizers.ScheduleFree(
        0.05, preconditioner=LargeSteps(4.0), preconditioned=("map",)
    ),
    "Partitioned, mesh": _on_sheet,
}
"""By what a line is called."""


def optimize(name: str, seed: int) -> Trajectory:
    """Take the steps of an optimizer along gradients of a bowl with noise, of which some samples are remembered."""
    optimizer, trajectory = OPTIMIZERS[name](), Trajectory()
    rng = np.random.default_rng(100 + seed)
    ramp = np.linspace(0.2, 0.8, 16, dtype=np.float32)
    board = (np.indices((16, 16)).sum(0) % 2).astype(np.float32)
    target = {
        "map": np.stack([np.outer(ramp, ramp) + 0.4 * board, np.outer(ramp, 1 - ramp) + 0.4 * board], axis=-1) - 0.2,
        "colour": np.array([0.9, 1.7, 0.05], np.float32),
        "number": np.array([-0.4], np.float32),
        "vertices": np.sin(np.arange(48, dtype=np.float32)),
    }
    point = {key: np.full_like(value, 0.5) for key, value in target.items()}
    state = optimizer.init(point, {"colour": 0.03})
    for loss, estimate in _estimates(target, point, rng):
        steps, state = optimizer.update(estimate, state, point)
        for key, by in steps.items():
            point[key] = np.clip(point[key] + np.asarray(by, np.float32), 0.0, 2.0 if key != "number" else 0.5)
        trajectory.note(loss, point)
    return trajectory


def _estimates(
    target: Mapping[str, np.ndarray], point: Mapping[str, np.ndarray], rng: np.random.Generator
) -> Iterator[tuple[float, Estimate]]:
    """Estimates at the points that `point` comes to hold."""
    remembered = {key: np.zeros_like(value) for key, value in target.items()}
    for step in range(_STREAM):
        deviation = 0.05 if step < _QUIET else 0.6
        noise = {key: rng.normal(0.0, deviation, value.shape).astype(np.float32) for key, value in target.items()}
        exact = {key: point[key] - value for key, value in target.items()}
        remembered = {key: np.float32(0.8) * remembered[key] + np.float32(0.2) * noise[key] for key in noise}
        gradient = {key: exact[key] + remembered[key] for key in exact}
        fresh = FreshGradient({key: exact[key] + noise[key] for key in exact})
        variance = Variance({key: np.full_like(value, 0.01) for key, value in exact.items()})
        loss = sum(float(np.square(x).sum()) for x in exact.values())
        yield loss, Estimate(loss, gradient, capabilities=(fresh, variance))
