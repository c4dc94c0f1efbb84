"""Rigid poses of shapes, lights and sensors as parameters, a pose per lane.

For every shape that carries no sensor, every sensor that no shape carries, and the emitters without a shape that `_LIGHTS` lists, the
renderer offers parameters that Mitsuba does not have:

    <id>.translation    (3,)  in units of the world; 0 as loaded
    <id>.rotation       (3,)  rotation vector, axis times angle in radians; 0 as loaded
    <id>.scale          ()    factor, shapes only; 1 as loaded

and each coordinate of the first two alone, `<id>.translation.x` and so on, (). A point x of the shape goes to
c + translation + scale R (x - c), where c is the centre of the shape's bounding box, or where the sensor or light stands.

The geometry of shapes that emit nothing is never moved, and no acceleration structure rebuilt: a posed shape lives in a scene of its own,
and rays are transformed into it. Since each ray may have its own transform, one launch renders any number of poses. Poses of lights are
written into the scene instead (`rigid_motions.py`), where emitters are sampled.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from unrender.core.errors import InputError
from unrender.rendering.renderer import ParameterInfo

__all__ = [
    "Assembly",
    "Pose",
    "PoseKey",
    "PosedScene",
    "centres",
    "info",
    "is_bare",
    "is_posable",
    "keys",
    "matrices",
    "slots",
]

_AXES = ("x", "y", "z")
_MOTIONS = ("translation", "rotation")
_LIGHTS = {
    "PointLight": ("translation",),
    "SpotLight": ("translation", "rotation"),
    "Projector": ("translation", "rotation"),
    "DirectionalEmitter": ("rotation",),
    "EnvironmentMapEmitter": ("rotation",),
    "SunskyEmitter": ("rotation",),
}
"""{class of an emitter without a shape: what its pose consists of}."""
_NAMELESS = re.compile(r"|object_\d{9,}|__.*|elm__\d+")


@dataclass(frozen=True)
class PoseKey:
    """What a key of this module stands for.

    Attributes:
        target: id of the shape, emitter or sensor.
        part: "translation", "rotation" or "scale".
        axis: 0 to 2, or None for all.
        light: whether the target emits light.
    """

    target: str
    part: str
    axis: int | None
    light: bool = False

    @property
    def shape(self) -> tuple[int, ...]:
        """Of the parameter."""
        return (3,) if self.axis is None and self.part != "scale" else ()

    def loaded(self) -> np.ndarray:
        """The value at which nothing moves."""
        return np.full(self.shape, 1.0 if self.part == "scale" else 0.0, np.float32)


def keys(scene: Any) -> dict[str, PoseKey]:
    """Return the pose parameters that a scene has, by key."""
    targets = [
        (shape.id(), (*_MOTIONS, "scale"), shape.is_emitter()) for shape in scene.shapes() if not shape.is_sensor()
    ]
    lamps = [emitter for emitter in scene.emitters() if emitter.get_shape() is None]
    targets += [(lamp.id(), _LIGHTS.get(lamp.class_name(), ()), True) for lamp in lamps]
    targets += [(sensor.id(), _MOTIONS, False) for sensor in scene.sensors() if sensor.get_shape() is None]
    counts = Counter(target for target, _, _ in targets)
    found: dict[str, PoseKey] = {}
    for target, parts, light in targets:
        if _NAMELESS.fullmatch(target) or counts[target] > 1:
            continue
        for part in parts:
            key = f"{target}.{part}"
            found[key] = PoseKey(target, part, None, light)
            if part != "scale":
                found |= {f"{key}.{name}": PoseKey(target, part, axis, light) for axis, name in enumerate(_AXES)}
    return found


def is_posable(emitter: Any) -> bool:
    """Return whether an emitter without a shape has a pose."""
    return emitter.class_name() in _LIGHTS


def is_bare(scene: Any, target: str) -> bool:
    """Return whether a target is an emitter without a shape."""
    return any(emitter.id() == target and emitter.get_shape() is None for emitter in scene.emitters())


def info(key: PoseKey, obstacle: str, sensor: int | None) -> ParameterInfo:
    """What the renderer says of a pose parameter; `obstacle`: why path gradients do not serve, "" where they do;
    `sensor`: index of the sensor that it moves, None where it moves a shape."""
    viewpoint = sensor is not None
    what = "light" if key.light else "sensor" if viewpoint else "shape"
    why = f"it moves a {what} as a whole"
    if obstacle:
        why += f", and {obstacle}; SmoothedDerivatives has its derivative"
    low = 1e-3 if key.part == "scale" else None
    return ParameterInfo(
        key.shape,
        not obstacle,
        shares_paths=False,
        reason=why,
        lowest=low,
        rigid=True,
        light=key.light,
        viewpoint=viewpoint,
        sensor=sensor,
    )


class Pose:
    """A rigid motion and a uniform scale per lane: x to c + t + s R (x - c)."""

    # No dataclass: Dr.Jit would take it for state of a loop.
    def __init__(self, centre: Any, translation: Any, rotation: Any, scale: Any):
        self.centre, self.translation, self.scale = mi.Point3f(centre), mi.Vector3f(translation), mi.Float(scale)
        self.matrix = _rotation(mi.Vector3f(rotation))
        self.inverse = self.matrix.T

    def ray_inside(self, ray: Any) -> Any:
        """The ray in the space of what is posed. Distances along it stay those of the world."""
        local = mi.Ray3f(ray)
        local.o = self.centre + self.inverse @ (ray.o - self.centre - self.translation) / self.scale
        local.d = self.inverse @ ray.d / self.scale
        return local

    def ray_outside(self, ray: Any) -> Any:
        """A posed sensor's ray in the world."""
        moved = type(ray)(ray)
        moved.o = self.point(ray.o)
        moved.d = self.matrix @ ray.d
        return moved

    def point(self, p: Any) -> Any:
        """Where a point goes."""
        return self.centre + self.translation + self.scale * (self.matrix @ (p - self.centre))  # pyright: ignore[reportOperatorIssue]

    def transform(self) -> Any:
        """As a matrix of homogeneous coordinates."""
        linear = self.scale * self.matrix
        shift = self.point(mi.Point3f(0))
        rows = [[*(linear[row, column] for column in range(3)), shift[row]] for row in range(3)]
        return mi.Transform4f(mi.Matrix4f(*rows[0], *rows[1], *rows[2], 0, 0, 0, 1))


def _rotation(vector: Any) -> Any:
    """The matrix of a rotation vector (Rodrigues)."""
    square = dr.squared_norm(vector)
    small = square < 1e-8
    angle = dr.sqrt(dr.select(small, 1, square))  # the root has no derivative at 0
    a = dr.select(small, 1 - square / 6, dr.sin(angle) / dr.select(small, 1, angle))
    b = dr.select(small, 0.5 - square / 24, (1 - dr.cos(angle)) / dr.select(small, 1, square))
    x, y, z = vector
    cross = mi.Matrix3f(0, -z, y, z, 0, -x, -y, x, 0)
    return dr.identity(mi.Matrix3f) + a * cross + b * (cross @ cross)


class PosedScene:
    """A scene of which some shapes and sensors are posed: built once, then any poses.

    Args:
        scene: as loaded.
        chosen: {key: what it stands for} of the parameters in use.

    Attributes:
        static: what does not move, with all emitters and sensors.
        parts: {id: a scene of that shape alone}.

    Raises `InputError` where a coordinate is asked for twice.
    """

    def __init__(self, scene: Any, chosen: Mapping[str, PoseKey]):
        self._slots = slots(chosen)
        targets = {key.target for key in chosen.values()}
        shapes = scene.shapes()
        posed = {shape.id(): shape for shape in shapes if shape.id() in targets}
        rest = [shape for shape in shapes if shape.id() not in posed]
        rest += [emitter for emitter in scene.emitters() if emitter.get_shape() is None]
        carried = {sensor.id(): sensor.get_shape() for sensor in scene.sensors()}
        carriers = [shape.id() for shape in carried.values() if shape is not None]
        # In the order of the scene's sensors, since a request names one by its index: a shape brings the one that it carries.
        sensors = [sensor if carried[sensor.id()] is None else carried[sensor.id()] for sensor in scene.sensors()]
        self.static = _scene([*(item for item in rest if item.id() not in carriers), *sensors])
        self.parts = {name: _scene([shape]) for name, shape in posed.items()}
        self._centres = centres(scene, targets)

    def scenes(self) -> list[Any]:
        """All scenes, to hand to frozen kernels."""
        return [self.static, *self.parts.values()]

    def numbers(self, parameters: Mapping[str, np.ndarray]) -> np.ndarray:
        """The poses as one array, (7 per target, B), from {key: (B, *shape)} of all chosen keys."""
        count = len(next(iter(parameters.values())))
        rows = np.zeros((len(self._centres), 7, count), np.float32)
        rows[:, 6] = 1.0
        names = list(self._centres)
        for key, (target, first, size) in self._slots.items():
            rows[names.index(target), first : first + size] = np.reshape(parameters[key], (count, size)).T
        return rows.reshape(-1, count)

    def at(self, scenes: list[Any], numbers: Any, batch: Any) -> Assembly:
        """The scene with each lane's poses.

        Args:
            scenes: of `scenes()`, as the frozen kernel was handed them.
            numbers: of `numbers()`, raveled, on the device.
            batch: which of the B poses, per lane.
        """
        count = dr.width(numbers) // (7 * len(self._centres))
        poses = {}
        for index, (name, centre) in enumerate(self._centres.items()):
            v = [dr.gather(mi.Float, numbers, (7 * index + row) * count + batch) for row in range(7)]
            poses[name] = Pose(centre, v[0:3], v[3:6], v[6])
        static, *parts = scenes
        return Assembly(static, [(part, poses[name]) for name, part in zip(self.parts, parts, strict=True)], poses)


class Assembly:
    """The static scene and the posed ones, intersected as one. Stands for a `mitsuba.Scene` where rays are traced."""

    # No dataclass: Dr.Jit would take it for state of a loop.
    def __init__(self, static: Any, parts: list[tuple[Any, Pose]], poses: Mapping[str, Pose]):
        self.static, self.parts, self.poses = static, parts, poses

    def ray_intersect(self, ray: Any, ray_flags: Any, coherent: Any, active: Any) -> Any:
        """See `mitsuba.Scene.ray_intersect`."""
        nearest = self.static.ray_intersect_preliminary(ray, coherent=coherent, active=active)
        nearest = dr.select(active, nearest, dr.zeros(mi.PreliminaryIntersection3f))
        nearest.t = dr.select(nearest.is_valid(), nearest.t, dr.inf)
        inside = mi.Ray3f(ray)
        matrix, scale = mi.Matrix3f(dr.identity(mi.Matrix3f)), mi.Float(1)
        for part, pose in self.parts:
            local = pose.ray_inside(ray)
            local.maxt = dr.minimum(ray.maxt, nearest.t)
            found = part.ray_intersect_preliminary(local, coherent=coherent, active=active)
            hit = active & found.is_valid() & (found.t < nearest.t)
            nearest = dr.select(hit, found, nearest)
            inside = dr.select(hit, local, inside)
            matrix = dr.select(hit, pose.matrix, matrix)
            scale = dr.select(hit, pose.scale, scale)
        valid = active & nearest.is_valid()
        inside.maxt = dr.inf  # pyright: ignore[reportAttributeAccessIssue]
        si = nearest.compute_surface_interaction(inside, ray_flags, valid)
        si.p = dr.select(valid, ray(si.t), si.p)
        si.n = mi.Normal3f(matrix @ si.n)
        frame = si.sh_frame
        si.sh_frame = mi.Frame3f(matrix @ frame.s, matrix @ frame.t, matrix @ frame.n)
        si.dp_du, si.dp_dv = scale * (matrix @ si.dp_du), scale * (matrix @ si.dp_dv)
        si.dn_du, si.dn_dv = matrix @ si.dn_du, matrix @ si.dn_dv
        si.wi = dr.select(valid, si.to_local(-ray.d), -ray.d)
        return si

    def ray_test(self, ray: Any, active: Any) -> Any:
        """See `mitsuba.Scene.ray_test`."""
        blocked = self.static.ray_test(ray, active)
        for part, pose in self.parts:
            blocked |= part.ray_test(pose.ray_inside(ray), active & ~blocked)
        return blocked


def matrices(scene: Any, parameters: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """{id of a shape or sensor: (4, 4)}: what stands before its `to_world` in these poses.

    Args:
        scene: as loaded.
        parameters: {key: value} of poses.
    """
    from scipy.spatial.transform import Rotation

    known = keys(scene)
    found = {}
    chosen = {key: known[key] for key in parameters}
    for target, centre in centres(scene, {key.target for key in chosen.values()}).items():
        numbers = np.array([0, 0, 0, 0, 0, 0, 1.0])
        for key, (owner, first, size) in slots(chosen).items():
            if owner == target:
                numbers[first : first + size] = np.reshape(parameters[key], -1)
        linear = numbers[6] * Rotation.from_rotvec(numbers[3:6]).as_matrix()
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = linear, centre + numbers[:3] - linear @ centre
        found[target] = matrix
    return found


def centres(scene: Any, targets: set[str]) -> dict[str, list[float]]:
    """Return what each of the targets turns about: shapes first, then emitters, then sensors."""
    found = {shape.id(): _centre(shape.bbox()) for shape in scene.shapes() if shape.id() in targets}
    lamps = [emitter for emitter in scene.emitters() if emitter.get_shape() is None and emitter.id() in targets]
    found |= {lamp.id(): _place(lamp) for lamp in lamps}
    for sensor in scene.sensors():
        if sensor.id() in targets:
            matrix = np.array(sensor.world_transform().matrix.numpy(), float).reshape(4, 4)
            found[sensor.id()] = matrix[:3, 3].tolist()
    return found


def _place(emitter: Any) -> list[float]:
    """Return where an emitter without a shape stands; the origin for light from afar."""
    parameters: Any = mi.traverse(emitter)
    if "position" in parameters:
        return np.array(parameters["position"], float).reshape(3).tolist()
    if "translation" not in _LIGHTS[emitter.class_name()]:
        return [0.0, 0.0, 0.0]
    return np.array(parameters["to_world"].matrix, float).reshape(4, 4)[:3, 3].tolist()


def slots(chosen: Mapping[str, PoseKey]) -> dict[str, tuple[str, int, int]]:
    """{key: (target, first of the 7 numbers, how many)}."""
    taken: dict[tuple[str, int], str] = {}
    found: dict[str, tuple[str, int, int]] = {}
    for name, key in chosen.items():
        first = {"translation": 0, "rotation": 3, "scale": 6}[key.part] + (key.axis or 0)
        size = int(np.prod(key.shape))
        for slot in range(first, first + size):
            if other := taken.get((key.target, slot)):
                raise InputError(f"parameter {name}: {other} stands for the same coordinate")
            taken[key.target, slot] = name
        found[name] = (key.target, first, size)
    return found


def _scene(objects: list[Any]) -> Any:
    """A scene of ready objects. Each keeps its id, which Mitsuba would take from the dictionary."""
    named = {"type": "scene"}
    for index, item in enumerate(objects):
        name = item.id()
        named[name if name and name not in named else f"object_{index}"] = item
    return mi.load_dict(named, parallel=False, optimize=False)


def _centre(box: Any) -> list[float]:
    return [float(x) for x in np.array(box.center()).reshape(-1)]
