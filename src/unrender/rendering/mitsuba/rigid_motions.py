"""Rigid poses written into the scene: those of lights, and of all else where path gradients are taken through the keys of `poses.py`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import drjit as dr
import mitsuba as mi

from unrender.rendering.mitsuba import poses
from unrender.rendering.mitsuba.mesh_layout import NORMALS, POSITIONS
from unrender.rendering.mitsuba.poses import Pose, PoseKey

__all__ = ["RigidMotions"]


class RigidMotions:
    """The pose parameters of a loaded scene whose targets have vertices, a transformation or a position to write.

    Args:
        scene: as loaded.
        own: {key: value} of the parameters that Mitsuba has, as loaded. Kept, not copied.
    """

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
        """Return the parameter of Mitsuba that places a target, "" where there is none."""
        for name in (POSITIONS, "position"):
            if f"{target}.{name}" in self._own:
                return f"{target}.{name}"
        return f"{target}.to_world" if target in self._worlds else ""

    def __contains__(self, key: str) -> bool:
        return key in self._keys

    def key(self, key: str) -> PoseKey:
        """What a key stands for."""
        return self._keys[key]

    def loaded(self) -> dict[str, Any]:
        """{key: `mi.Float`}: the values at which nothing moves."""
        return {key: mi.Float(pose.loaded().reshape(-1).tolist()) for key, pose in self._keys.items()}

    def written(self, key: str) -> list[str]:
        """The parameters of Mitsuba that a parameter is written to: itself, where it is one of them."""
        if key not in self._keys:
            return [key]
        return [self._written(self._keys[key].target)]

    def restore(self, parameters: mi.SceneParameters, key: str) -> None:
        """Put what a pose has moved back to where it was loaded, without derivatives; the caller updates the scene."""
        target = self._keys[key].target
        (name,) = self.written(key)
        if name in self._own:
            parameters[name] = type(self._own[name])(self._own[name])
        else:
            self._set_world(parameters, name, _copy(self._worlds[target]))

    def write(self, parameters: mi.SceneParameters, values: Mapping[str, Any]) -> None:
        """Move the targets, with the derivatives of the poses if these are attached, and update the scene.

        Args:
            parameters: of the scene.
            values: {key: `mi.Float`} of all the poses that are set.
        """
        turned: dict[str, Any] = {}
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
                turned[normals] = dr.ravel(pose.matrix @ dr.unravel(mi.Vector3f, self._own[normals]))
        parameters.update()
        # In a second update: Mitsuba computes normals anew whenever positions change.
        for name, value in turned.items():
            parameters[name] = value
        if turned:
            parameters.update()

    def _set_world(self, parameters: mi.SceneParameters, name: str, transform: Any) -> None:
        # Mitsuba would keep an equal matrix, and its derivatives with it: another one first.
        parameters[name] = mi.Transform4f().scale(-1)
        parameters[name] = transform

    def _poses(self, values: Mapping[str, Any]) -> dict[str, Pose]:
        """{target: its pose}."""
        found = {}
        chosen = {key: self._keys[key] for key in values}
        slots = poses.slots(chosen)
        for target in {pose.target for pose in chosen.values()}:
            numbers: list[Any] = [mi.Float(0)] * 6 + [mi.Float(1)]
            for key, (owner, first, size) in slots.items():
                if owner == target:
                    for k in range(size):
                        numbers[first + k] = dr.gather(mi.Float, values[key], k)
            found[target] = Pose(self._centres[target], numbers[0:3], numbers[3:6], numbers[6])
        return found


def _copy(transform: Any) -> Any:
    """Of its own: a sensor gives away the matrix that it goes on using."""
    return type(transform)(transform)
