"""Measure one plugin: its picture, the gradient of each parameter, and a short descent."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.internals import SampleRequest, descend, load_scene, media, mi
from scripts.coverage.checks import descended, gradients_agree, images_agree
from scripts.coverage.plugins import IN_INSTANCES, PLUGINS
from scripts.coverage.scenes import Plugin
from unrender.rendering.mitsuba.renderer import MitsubaRenderer

__all__ = ["descent", "measure"]

DEPTH = 4
RUNS, SPP = 16, 64
_MOST_RUNS = 4 * RUNS
"""Runs of a comparison of gradients that is weak, or differs by `_DOUBTFUL` standard errors, after `RUNS`."""
_DOUBTFUL = 2.5
STEPS, DESCENT_SPP = 40, 16
"""Steps of a descent, and samples per pixel of each."""
_SEEN, _LEAST = 10.0, 1e-8
"""Standard errors, and square error of the picture, from which on a start is seen to differ from the truth."""
_ONE_OF_MANY = ("vertex_positions", "vertex_normals", "vertex_texcoords", "control_points", "phase_function.values")
"""Parameters of which many values give nearly the same picture: their descents are judged by the picture alone."""
_INSTANCED = 1
"""Parameters of a plugin in instances that are measured."""
_UNROULETTED = 1000
_AXES = (".x", ".y", ".z")


def measure(name: str, known: dict[str, Any] | None = None) -> dict[str, Any]:
    """Return {"refused": reason}, or {"image": ..., "notices": ..., "parameters": {key: ...}}.

    Args:
        name: of the plugin.
        known: what was measured before: descents alone are added. None measures all.
    """
    plugin = (PLUGINS | IN_INSTANCES)[name]
    with tempfile.TemporaryDirectory() as folder:
        try:
            return _measure(plugin, Path(folder), known)
        except ur.InputError as error:
            return {"refused": str(error)}


def _measure(plugin: Plugin, folder: Path, known: dict[str, Any] | None) -> dict[str, Any]:
    def description() -> Any:
        return plugin.build(folder)

    renderer = MitsubaRenderer(description, DEPTH)
    found = known or {"notices": list(getattr(renderer, "notices", ())), "parameters": {}}
    if known is None:
        session = renderer.prepare([], None, False)
        ours = [np.array(session.image({}, SampleRequest(0, SPP, 100 + n)).images[0]) for n in range(RUNS)]
        found["image"] = images_agree(np.stack(ours), _stock(description())).record()
    for key, info in renderer.parameters().items():
        prefix = next((p for p in plugin.prefixes if key.startswith(f"{p}.")), None)
        if prefix is None or key.endswith(_AXES) or not (info.perturbable or info.differentiable):
            continue
        if (
            plugin.instanced
            and len(found["parameters"]) == _INSTANCED
            and key.removeprefix(f"{prefix}.") not in found["parameters"]
        ):
            continue
        entry = found["parameters"].setdefault(key.removeprefix(f"{prefix}."), {})
        if known is None:
            try:
                entry["gradient"] = _gradient(renderer, key, info, SPP // 4 if plugin.instanced else SPP)
            except ur.InputError as error:
                entry["gradient"] = {"refused": str(error)}
        try:
            entry["descent"] = descent(renderer, key, info)
        except ur.InputError as error:
            entry["descent"] = {"refused": str(error)}
    return found


def _stock(description: Any) -> np.ndarray:
    scene = load_scene(description)
    kind = "volpath" if media(scene) else "path"
    integrator = mi.load_dict({"type": kind, "max_depth": DEPTH, "rr_depth": _UNROULETTED})
    images = [np.array(mi.render(scene, integrator=integrator, spp=SPP, seed=900 + n)) for n in range(RUNS)]
    return np.stack(images)[..., :3]


def _weights(shape: tuple[int, ...]) -> np.ndarray:
    """Return a ramp with some noise, (1, H, W, 3): motions show in a ramp."""
    y, x = (np.linspace(0, 1, n) for n in shape)
    ramp = 0.3 + x[None, :, None] + 0.6 * y[:, None, None]
    return (ramp * np.random.default_rng(2).uniform(0.7, 1.3, (*shape, 3)))[None].astype(np.float32)


def _direction(key: str, value: np.ndarray, scale: float, welded: bool = False) -> np.ndarray:
    """Return a random direction. Vertices of a mesh at one place move as one, since gaps would open between them."""
    rng = np.random.default_rng(4)
    if welded:
        places, vertex = np.unique(value.reshape(-1, 3), axis=0, return_inverse=True)
        return scale * rng.normal(size=places.shape)[vertex.reshape(-1)].reshape(value.shape)
    if key.endswith(("control_points", "vertex_normals", "normalmap.data", "nested_texture.data")):
        return scale * rng.normal(size=value.shape)
    return scale * rng.uniform(0.5, 1.5, value.shape)


def _scale(value: np.ndarray, info: Any) -> float:
    """Return a typical change of a value: a twentieth of its range, or of its size."""
    if info.lowest is not None and info.highest is not None:
        return 0.05 * min(info.highest - info.lowest, 1.0 + float(np.abs(value).max()))
    return 0.05 * (float(np.abs(value).max(initial=0)) or 1.0)


def _gradient(renderer: Any, key: str, info: Any, spp: int) -> dict[str, Any]:
    if not info.differentiable:
        return {"perturbed": info.reason}
    session = renderer.prepare([key], None)
    value = renderer.values([key])[key]
    at = np.array(value).astype(np.float64)
    along, weights = _direction(key, at, _scale(at, info), info.welded), _weights(renderer.resolutions()[0])
    given = renderer.array(weights)
    width = 2.0 if info.rigid or info.welded or info.viewpoint or key.endswith("control_points") else 0.2
    reach = 0.5 * width * np.abs(along)  # differences must not leave the range
    if info.lowest is not None and (at - reach < info.lowest).any():
        at = np.maximum(at, info.lowest + reach)
    if info.highest is not None and (at + reach > info.highest).any():
        at = np.minimum(at, info.highest - reach)
    value = renderer.array(at.astype(np.float32))
    adjoints, differences = [], []
    found = None
    for number in range(_MOST_RUNS):
        paths = session.image({key: value}, SampleRequest(0, spp, 200 + number)).paths
        gradient = np.array(session.adjoint({key: value}, paths, given)[key]).astype(np.float64)
        adjoints.append(float(np.sum(gradient * along)))
        steps = np.array([0.5, -0.5, 0.25, -0.25]) * width
        states = {key: np.stack([at + step * along for step in steps]).astype(np.float32)}
        images = np.array(session.image_batch(states, SampleRequest(0, 4 * spp, 500 + number))).astype(np.float64)
        values = (images * weights).sum((1, 2, 3))
        wide, narrow = (values[0] - values[1]) / width, (values[2] - values[3]) / (width / 2)
        differences.append((4 * narrow - wide) / 3)
        if (number + 1) % RUNS == 0:
            found = gradients_agree(np.array(adjoints), np.array(differences))
            if found.verdict in ("ok", "zero") and found.z < _DOUBTFUL:
                break
    assert found is not None
    return found.record()


@dataclass(frozen=True)
class Effort:
    """How much a descent may take.

    Attributes:
        spp: samples per pixel of a step, and of a picture.
        rate: learning rate over the start's distance from the truth.
        pictures: how many pictures make one half of the reference, and of a picture whose error counts.
        widths: distances of the start, in `_scale`; the first one that the pictures show is taken.
        newton: Gauss-Newton steps from perturbed renders instead of Adam's, as `auto` takes for few numbers.
    """

    spp: int
    rate: float
    pictures: int
    widths: tuple[float, ...]
    newton: bool = False


_EFFORTS = (
    Effort(DESCENT_SPP, 0.15, 32, (2.0, 4.0, 8.0)),
    Effort(8 * DESCENT_SPP, 0.08, 32, (8.0,)),
)
"""The second one where the first one does not suffice."""
_NEWTON, _FEW = Effort(8 * DESCENT_SPP, 0.08, 32, (8.0,), newton=True), 24
"""Where both do not suffice, for at most so many numbers: their slopes are small relative to the noise of one render."""


def descent(renderer: Any, key: str, info: Any) -> dict[str, Any]:
    """Descend from a perturbed start by Adam: on path gradients, or on perturbed renders where there are none. Few numbers that noise hides
    take Gauss-Newton steps.

    Returns:
        Mean squares of the pictures' differences "before" and "after", without the noise of their rendering, and the standard
        "deviation" of the first; the parameter's error after over before as "error"; "ok", or None where the pictures hardly differ.
    """
    found = _descend(renderer, key, info, _EFFORTS[0])
    if found["ok"] or (found["ok"] is None and not info.differentiable):
        return found
    found = _descend(renderer, key, info, _EFFORTS[1])
    few = not info.differentiable and np.prod(info.shape, dtype=int) <= _FEW
    return _descend(renderer, key, info, _NEWTON) if found["ok"] is False and few else found


def _descend(renderer: Any, key: str, info: Any, effort: Effort) -> dict[str, Any]:
    truth = np.array(renderer.values([key])[key]).astype(np.float64)
    session, groups = renderer.prepare([key], None, info.differentiable), 2 if info.differentiable else 1

    def picture(value: Any, half: int) -> np.ndarray:
        tree = {key: renderer.array(np.asarray(value, np.float32))}
        seeds = range(5000 + 1000 * half, 5000 + 1000 * half + effort.pictures)
        requests = [SampleRequest(0, effort.spp, seed, groups=groups) for seed in seeds]
        return np.mean([np.array(session.image(tree, request).images).mean(0) for request in requests], axis=0)

    references = [picture(truth, half) for half in (0, 1)]

    def error(value: Any) -> tuple[float, float]:
        """The product of two independent differences, each of equal random numbers, has no noise on average."""
        one, other = (picture(value, half) - references[half] for half in (0, 1))
        square, noise = float(np.mean(one * other)), float(np.mean((one - other) ** 2)) / 2
        return square, float(np.sqrt(noise * (noise + 2 * max(square, 0.0)) / one.size))

    for width in effort.widths:
        start, offset = _start(key, truth, info, width)
        before, deviation = error(start)
        if seen := before > max(_SEEN * deviation, _LEAST):
            break
    if not seen:
        return {"before": before, "deviation": deviation, "ok": None}
    size, reference = float(np.abs(offset).mean()), np.mean(references, axis=0)
    # Vertices at one place must move as one.
    smooth = ur.preconditioners.LargeSteps(1.0) if info.welded and info.differentiable else None
    parameter = ur.Parameter(key, start, preconditioner=smooth)
    problem = ur.Problem(renderer, [parameter], [ur.View(reference)], truth={key: truth})
    smoothed = ur.SmoothedDerivatives(size / 2, samples=8, spp=effort.spp)
    estimator = ur.PathGradient(spp=effort.spp) if info.differentiable else smoothed
    optimizer = ur.optimizers.Adam(effort.rate * size, schedule=ur.schedules.Cosine(STEPS))
    if effort.newton:
        estimator, optimizer = ur.GaussNewton(4 * effort.spp, effort.spp), ur.optimizers.AveragedNewton()
    end = descend(problem, estimator, optimizer, STEPS)[key]
    after, _ = error(end)
    first, last = (problem.parameter_error({key: value})[key] for value in (start.astype(np.float32), end))
    closer = last / first if first else 0.0
    # Perturbed renders move elements that no picture shows, too; path gradients leave these as they are.
    alone = key.endswith(_ONE_OF_MANY) or not info.differentiable
    ok = descended(before, after) and (closer < 1 or alone)
    return {"before": before, "deviation": deviation, "after": max(after, 0.0), "error": closer, "ok": ok}


def _start(key: str, truth: np.ndarray, info: Any, width: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a perturbed start within the range, and how far it is away."""
    offset = width * _direction(key, truth, _scale(truth, info), info.welded)
    start = truth - offset if info.highest is not None and (truth + offset > info.highest).any() else truth + offset
    start = start if info.lowest is None else np.maximum(start, info.lowest)
    start = start if info.highest is None else np.minimum(start, info.highest)
    return start, start - truth
