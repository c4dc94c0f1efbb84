"""The column "Mitsuba": the loop of its tutorials, on path gradients, where they are not zero."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.higher_order.table2.descents import Descent, Track
from benchmarks.internals import dr, load_scene, mi, scene_description
from benchmarks.runner.timing import work_time

MITSUBA = ("BUNNY", "TEXTURE")
_SPP = {"BUNNY": 4, "TEXTURE": 8}


def _bunny(scene: Any, parameters: Any) -> tuple[Any, Callable[[Any], None]]:
    """Projective sampling of silhouettes, and a function that poses the vertices."""
    integrator = mi.load_dict({"type": "direct_projective", "sppi": 0})
    key = "bunny.vertex_positions"
    rest = dr.unravel(mi.Point3f, mi.Float(parameters[key]))
    box = next(shape for shape in scene.shapes() if shape.id() == "bunny").bbox()
    centre = mi.Point3f(np.array(box.center()).reshape(3).tolist())

    def pose(values: Any) -> None:
        x, z, angle = (dr.gather(mi.Float, values, index) for index in range(3))
        sine, cosine = dr.sin(angle), dr.cos(angle)
        p = rest - centre
        turned = mi.Point3f(cosine * p.x + sine * p.z, p.y, cosine * p.z - sine * p.x)
        parameters[key] = dr.ravel(turned + centre + mi.Vector3f(x, 0, z))
        parameters.update()

    return integrator, pose


def _texture(problem: ur.Problem, parameters: Any) -> tuple[Any, Callable[[Any], None]]:
    """`prb`, and a function that writes the texels."""
    integrator = mi.load_dict({"type": "prb", "max_depth": problem.max_depth})
    key = problem.parameters[0].key
    shape = tuple(parameters[key].shape)

    def paint(values: Any) -> None:
        parameters[key] = mi.TensorXf(values, shape)
        parameters.update()

    return integrator, paint


def mitsuba(name: str, problem: ur.Problem, rate: float, seconds: float) -> Descent:
    """One run of `mi.render`, `dr.backward`, `mi.ad.Adam`: projective sampling of silhouettes for BUNNY, `prb` for TEXTURE."""
    scene = load_scene(scene_description(problem))  # its own: runs of other methods leave the problem's scene anywhere
    parameters = mi.traverse(scene)
    track, step = Track(problem), 0
    integrator, place = _bunny(scene, parameters) if name == "BUNNY" else _texture(problem, parameters)
    for warm in (True, False):
        optimizer = mi.ad.Adam(lr=rate)
        optimizer["x"] = mi.Float(track.points[0])
        clock, step = 0.0, 0
        while clock < seconds and step < (2 if warm else 100_000):
            began = work_time()
            place(optimizer["x"])
            seeds = {"seed": mi.UInt32(2 * step), "seed_grad": 2 * step + 1}
            image = mi.render(scene, parameters, integrator=integrator, spp=_SPP[name], **seeds)
            dr.backward(problem.loss_value(0, image))
            optimizer.step()
            dr.eval(optimizer["x"])
            dr.sync_thread()
            clock += work_time() - began
            step += 1
            if warm:
                continue
            track.add(np.array(optimizer["x"], float), clock)
            if track.arrived:
                break
    return track.descent(step * _SPP[name])
