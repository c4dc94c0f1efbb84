"""Rigid poses that are written into the scene: those of lights, and all poses with path gradients."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from unrender.rendering.mitsuba import poses
from unrender.rendering.mitsuba.mesh_layout import NORMALS, POSITIONS
from unrender.rendering.mitsuba.poses import Pose, PoseKey


class RigidMotions:
    """Pose parameters of a loaded scene whose targets have vertices, a transformation or a position to write; `own` are the loaded values,
    not copied."""

    def __init__(self, scene: Any, own: Mapping[str, Any]):
        known = poses.keys(scene)
        targets = {pose.target for pose in known.values()}
        self._own = own
        self._worlds = {
            item.id(): _copy(parameters["to_world"])
            for item in (*scene.shapes(), *scene.emitters(), *scene.sensors())
            if item.id() in targets and "to_world" in (parameters := mi.traverse(item))
        }
        written = {target: self._written(target) for target in targets}
        self._keys = {key: pose for key, pose in known.items() if written[pose.target]}
        self._centres = poses.centres(scene, {pose.target for pose in self._keys.values()})

    def _written(self, target: str) -> str:
        """Return Mitsuba's parameter that places a target; "" if there is none."""
        for name in (POSITIONS, "position"):
            if f"{target}.{name}" in self._own:
                return f"{target}.{name}"
        return f"{target}.to_world" if target in self._worlds else ""

    def __contains__(self, key: str) -> bool:
        return key in self._keys

    def key(self, key: str) -> PoseKey:
        """Return the meaning of a key."""
        return self._keys[key]

    def loaded(self) -> dict[str, Any]:
        """Return {key: `mi.Float`} of the values at which nothing moves."""
        return {key: mi.Float(pose.loaded().reshape(-1).tolist()) for key, pose in self._keys.items()}

    def written(self, key: str) -> list[str]:
        """Return Mitsuba's parameters that a parameter is written to: itself, unless it is a pose."""
        if key not in self._keys:
            return [key]
        return [self._written(self._keys[key].target)]

    def restore(self, parameters: mi.SceneParameters, key: str) -> None:
        """Restore the target of a pose as loaded, without derivatives. The caller updates the scene."""
        target = self._keys[key].target
        (name,) = self.written(key)
        if name in self._own:
            parameters[name] = type(self._own[name])(self._own[name])
        else:
            self._set_world(parameters, name, _copy(self._worlds[target]))

    def write(self, parameters: mi.SceneParameters, values: Mapping[str, Any]) -> None:
        """Move the targets to the values of all poses that are set, with derivatives if these are attached, and update the scene."""
        rotated: dict[str, Any] = {}
        for target, pose in self._poses(values).items():
            name = self._written(target)
            if name not in self._own:
                self._set_world(parameters, name, pose.transform() @ self._worlds[target])
                continue
            if name.endswith(".position"):
                parameters[name] = pose.point(self._own[name])
                continue
            parameters[name] = dr.ravel(pose.point(dr.unravel(mi.Point3f, self._own[name])))
            normals = f"{target}.{NORMALS}"
            if dr.width(self._own.get(normals, 0)) == dr.width(self._own[name]):
                rotated[normals] = dr.ravel(pose.matrix @ dr.unravel(mi.Vector3f, self._own[normals]))
        parameters.update()
        # Normals need a second update: Mitsuba recomputes them whenever positions change.
        for name, value in rotated.items():
            parameters[name] = value
        if rotated:
            parameters.update()

    def _set_world(self, parameters: mi.SceneParameters, name: str, transform: Any) -> None:
        # Mitsuba ignores an equal matrix and would keep its old derivatives, so assign a different one first.
        parameters[name] = mi.Transform4f().scale(-1)
        parameters[name] = transform

    def _poses(self, values: Mapping[str, Any]) -> dict[str, Pose]:
        result = {}
        chosen = {key: self._keys[key] for key in values}
        slots = poses.slots(chosen)
        parts = {key: [dr.gather(mi.Float, values[key], k) for k in range(size)] for key, (_, _, size) in slots.items()}
        for target in {pose.target for pose in chosen.values()}:
            numbers = poses.numbers_of(target, slots, parts, mi.Float(0), mi.Float(1))
            result[target] = Pose(self._centres[target], numbers[0:3], numbers[3:6], numbers[6])
        return result


def _copy(transform: Any) -> Any:
    return type(transform)(transform)


def lengths(scene: Any) -> dict[str, float]:
    """Return the order of magnitude of lengths at each shape, sensor and emitter with a pose, a power of ten, by id.

    It is the diagonal of a shape's bounding box, at most twice its distance from the nearest sensor. For sensors and emitters it is a
    third of the median distance from shapes.
    """
    boxes = {shape.id(): shape.bbox() for shape in scene.shapes() if not shape.is_sensor() and shape.bbox().valid()}
    sensors = {sensor.id() for sensor in scene.sensors() if sensor.get_shape() is None}
    lamps = {lamp.id() for lamp in scene.emitters() if lamp.get_shape() is None and poses.is_posable(lamp)}
    places = {name: np.array(at) for name, at in poses.centres(scene, {*boxes, *sensors, *lamps}).items()}
    sizes = {}
    for name, box in boxes.items():
        distances = [2.0 * float(np.linalg.norm(places[name] - places[sensor])) for sensor in sensors]
        sizes[name] = min([float(np.linalg.norm(np.array(box.extents(), float))), *(d for d in distances if d > 0.0)])
    for name in lamps | sensors:
        sizes[name] = float(np.median([np.linalg.norm(places[name] - places[other]) for other in boxes] or [0.0])) / 3.0
    return {name: 10.0 ** round(math.log10(size)) if 0.0 < size < math.inf else 1.0 for name, size in sizes.items()}
