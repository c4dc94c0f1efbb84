"""Two states of a mesh on the same samples: paths carried along with its triangles against shared random numbers.

Variance: a ball of triangles in the Cornell box (and `sphere-to-bunny` at its start), moved smoothly by steps of some size (root mean
square; the ball's radius is .45); one sample per pixel, many times. Of F the current and H the previous state: Var[F - H] / Var F, summed
over pixels that do not see the lamp, and its geometric mean over pixels; the weight cov(F, H) / Var H, clamped to [0, 1]; processor time
of the pair over that of one image of Mitsuba's `prb`, in one thread, with both scenes built.

Descent: `sphere-to-bunny` with L1, large steps, equal numbers of steps: the plain image, and control variates in both spaces. Surface error
over the start's, and processor time of a step over the plain one's.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.internals import dr, mi, with_preconditioner
from unrender.gallery import meshes
from unrender.gallery.sphere_to_bunny import SphereToBunny
from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.renderer import SampleRequest, Space

QUICK: dict[str, Any] = {
    "resolution": 8, "samples": 8, "moves": [0.01], "scenes": ["diffuse"], "steps": 2, "seeds": 1, "views": 2, "subdivisions": 1,
    "spps": [2],
}  # fmt: skip
SPACES: tuple[Space, ...] = ("primary", "path")
_MATERIALS = {
    "diffuse": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.6, 0.5]}},
    "fine": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.6, 0.5]}},
    "glossy": {"type": "roughconductor", "alpha": 0.15},
    "mirror": {"type": "conductor"},
}
_DEPTH = 4
_TIMED, _WARM = 40, 4
_BRIGHT = 4.0
"""Of pixels that see the lamp."""


def room(name: str, resolution: int) -> dict[str, Any]:
    """The Cornell box with a ball of 1280 ("fine": 20480) triangles in place of its boxes."""
    points, faces = meshes.icosphere(5 if name == "fine" else 3)
    found = {key: value for key, value in mi.cornell_box().items() if not key.endswith("-box") and key != "integrator"}
    found["sensor"]["film"] = {
        "type": "hdrfilm",
        "width": resolution,
        "height": resolution,
        "rfilter": {"type": "box"},
    }
    place = np.array([0.0, -0.4, 0.0]) + 0.45 * points * np.array([1.0, 1.2, 0.8])
    return {**found, "ball": meshes.triangles("ball", place, faces, {"type": "twosided", "b": _MATERIALS[name]})}


def variances(name: str, resolution: int, samples: int, moves: tuple[float, ...]) -> dict[str, Any]:
    """Of one scene."""
    if name == "sphere-to-bunny":
        scene: Callable[[], Any] = SphereToBunny(resolution=resolution, views=1).scene
        renderer, key = MitsubaRenderer(scene, 2), "sphere.vertex_positions"
    else:
        renderer, key = MitsubaRenderer(lambda: room(name, resolution), _DEPTH), "ball.vertex_positions"
    session = renderer.prepare([key], "path")
    renderer.prepare([key], "primary")
    loaded = np.array(renderer.values([key])[key]).reshape(-1, 3)
    generator = np.random.default_rng(0)
    one, two = generator.normal(size=(2, 3, 3))
    way = np.sin(3 * loaded @ one) @ two
    way /= np.sqrt(np.mean(np.sum(way**2, axis=1)))
    previous = {key: renderer.array(loaded.reshape(-1))}
    found: dict[str, Any] = {space: {"sum": [], "geometric": [], "weight": []} for space in SPACES}
    for move in moves:
        current = {key: renderer.array((loaded + move * way).reshape(-1))}
        for space in SPACES:
            pair = session.image_pair(current, previous, SampleRequest(0, samples, 1, samples), space)
            F, H = (np.array(images, float) for images in (pair.images, pair.previous))
            dark = F.mean(axis=0).max(axis=-1) < _BRIGHT
            var, varₚ, rest = F.var(axis=0)[dark], H.var(axis=0)[dark], (F - H).var(axis=0)[dark]
            noisy = (var > 0) & (varₚ > 0)
            covariance = ((var + varₚ - rest) / 2)[noisy]
            of = found[space]
            of["sum"].append(float(rest.sum() / var.sum()))
            of["geometric"].append(float(np.exp(np.log(np.maximum(rest[noisy] / var[noisy], 1e-6)).mean())))
            of["weight"].append(float(np.clip(covariance / varₚ[noisy], 0, 1).mean()))
    request = SampleRequest(0, 64, 1)

    def alone() -> None:
        dr.eval(session.image(current, request).images)

    def both(space: Space) -> None:
        pair = session.image_pair(current, previous, request, space)
        dr.eval(pair.images, pair.previous)

    calls = [alone, *(partial(both, space) for space in SPACES)]
    single, *pairs = processor_seconds(calls)
    for space, seconds in zip(SPACES, pairs, strict=True):
        found[space]["cost"] = seconds / single
    return found


def processor_seconds(calls: list[Callable[[], None]]) -> list[float]:
    """The least of several of each, in turns. In one thread: what others wait counts as well."""
    threads = dr.thread_count()
    dr.set_thread_count(1)
    times: list[list[float]] = [[] for _ in calls]
    for number in range(_TIMED + _WARM):
        for of, call in zip(times, calls, strict=True):
            began = time.process_time()
            call()
            dr.sync_thread()
            if number >= _WARM:
                of.append(time.process_time() - began)
    dr.set_thread_count(threads)
    return [min(of) for of in times]


class _Clock(ur.protocols.Callback):
    """Processor time of the steps from the second one on."""

    def __init__(self) -> None:
        self.times: list[float] = []
        self._before = 0.0

    def on_step(self, run: Any, record: dict[str, Any]) -> None:
        now = time.process_time()
        self.times.append(now - self._before)
        self._before = time.process_time()


def descents(resolution: int, views: int, subdivisions: int, steps: int, spps: tuple[int, ...], seeds: int) -> dict:
    """Surface errors of `sphere-to-bunny` with L1, over the start's."""
    problem = ur.gallery.problem(
        "sphere-to-bunny", resolution=resolution, views=views, subdivisions=subdivisions, loss=ur.losses.L1()
    )
    (key,) = problem.faces
    start = problem.parameter_error(problem.initial())[key]
    problem = with_preconditioner(problem, ur.preconditioners.LargeSteps(4.0 ** (subdivisions - 2)), key)
    images = {"plain": ur.images.Plain()} | {space: ur.images.RecursiveControlVariate(space) for space in SPACES}
    found: dict[str, Any] = {}
    for spp in spps:
        for name, image in images.items():
            errors, times = [], []
            for seed in range(seeds):
                clock = _Clock()
                descent = ur.optimizers.Adam(0.02, uniform=True, schedule=ur.schedules.Exponential(steps, 0.1))
                estimator = ur.PathGradient(image, spp=spp)
                result = ur.optimize(problem, estimator, descent, steps=steps, seed=seed, callbacks=[clock])
                errors.append(problem.parameter_error(result.parameters)[key] / start)
                times.append(float(np.median(clock.times[1:])))
            found[f"{name}, {spp}"] = {"errors": errors, "step": float(np.median(times))}
            print(name, spp, errors, flush=True)
    return found


def run(
    scenes: tuple[str, ...] = ("diffuse", "fine", "glossy", "mirror", "sphere-to-bunny"),
    moves: tuple[float, ...] = (0.04, 0.02, 0.01, 0.005, 0.0025),
    resolution: int = 32,
    samples: int = 256,
    views: int = 4,
    subdivisions: int = 3,
    steps: int = 80,
    spps: tuple[int, ...] = (1, 2),
    seeds: int = 2,
) -> dict[str, Any]:
    """Variances and descents.

    Args:
        moves: sizes of the steps
        samples: of a pixel, of which variances are taken
        views: of the descents
        subdivisions: of their sphere
        steps: of each
        spps: samples per pixel of the descents
        seeds: of the descents
    """
    found = {name: variances(name, resolution, samples, moves) for name in scenes}
    return {"scenes": found, "descents": descents(resolution, views, subdivisions, steps, spps, seeds)}
