"""Rigid poses of shapes, lights and sensors as parameters, with one pose per lane.

For every shape that is not a sensor, every sensor without a shape, and the emitters without a shape that `_LIGHTS` lists, the renderer
offers parameters that Mitsuba does not have:

    <id>.translation    (3,)  in world units; 0 as loaded
    <id>.rotation       (3,)  rotation vector, axis times angle in radians; 0 as loaded
    <id>.scale          ()    factor, shapes only; 1 as loaded

and each coordinate of the first two alone, `<id>.translation.x` and so on, (). A point x of the shape moves to c + translation + scale
R (x - c), where c is the centre of the shape's bounding box, or the position of the sensor or light.

Shapes that do not emit are not moved, and no acceleration structure is rebuilt. A posed shape is in a scene of its own, and rays are
transformed to its local space. Each ray may have its own transform, so one launch renders any number of poses. Poses of lights are
written into the scene instead (`rigid_motions.py`), since the scene samples its emitters.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from unrender.core.errors import InputError
from unrender.rendering.mitsuba.scene_graph import scene_of
from unrender.rendering.renderer import ParameterInfo

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
"""{class of an emitter without a shape: parts of its pose}."""
_NAMELESS = re.compile(r"|object_\d{9,}|__.*|elm__\d+")


@dataclass(frozen=True)
class PoseKey:
    """Meaning of a pose parameter's key.

    Attributes:
        target: id of the shape, emitter or sensor.
        part: "translation", "rotation" or "scale".
        axis: 0 to 2, or None for all.
        light: whether the target emits light.
        smooth: whether it changes the radiance of a light continuously, and no path, so that path replay gives its derivative.
        axial, forward: see `ParameterInfo`.
    """

    target: str
    part: str
    axis: int | None
    light: bool = False
    smooth: bool = False
    axial: bool = False
    forward: tuple[float, ...] | None = None

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the parameter."""
        return (3,) if self.axis is None and self.part != "scale" else ()

    def loaded(self) -> np.ndarray:
        """Return the value at which nothing moves."""
        return np.full(self.shape, 1.0 if self.part == "scale" else 0.0, np.float32)


def keys(scene: Any) -> dict[str, PoseKey]:
    targets = [
        (shape.id(), (*_MOTIONS, "scale"), shape.is_emitter()) for shape in scene.shapes() if not shape.is_sensor()
    ]
    lamps = [emitter for emitter in scene.emitters() if emitter.get_shape() is None]
    targets += [(lamp.id(), _LIGHTS.get(lamp.class_name(), ()), True) for lamp in lamps]
    targets += [(sensor.id(), _MOTIONS, False) for sensor in scene.sensors() if sensor.get_shape() is None]
    counts = Counter(target for target, _, _ in targets)
    turning = {lamp.id() for lamp in lamps if _turns_smoothly(lamp)}
    axial = {lamp.id() for lamp in lamps if _has_axis(lamp)}
    looking = [lamp for lamp in lamps if "translation" in _LIGHTS.get(lamp.class_name(), ())]
    looking += [sensor for sensor in scene.sensors() if sensor.get_shape() is None]
    forward = {one.id(): _forward(one) for one in looking}
    result: dict[str, PoseKey] = {}
    for target, parts, light in targets:
        if _NAMELESS.fullmatch(target) or counts[target] > 1:
            continue
        for part in parts:
            key, turn = f"{target}.{part}", part == "rotation"
            own = light, turn and target in turning, turn and target in axial, forward.get(target) if turn else None
            result[key] = PoseKey(target, part, None, *own)
            if part != "scale":
                for axis, name in enumerate(_AXES):
                    result[f"{key}.{name}"] = PoseKey(target, part, axis, *own)
    return result


def _has_axis(lamp: Any) -> bool:
    """Return whether turns of an emitter about its own direction change no picture."""
    if lamp.class_name() != "SpotLight":
        return lamp.class_name() == "DirectionalEmitter"
    return not {name for name, _ in mi.traverse(lamp) if name.startswith("texture.")} - {"texture.value"}


def _forward(item: Any) -> tuple[float, ...] | None:
    """Return the direction of the local z-axis of a sensor or light in world space; None for one without."""
    known: Any = mi.traverse(item)
    if "to_world" not in known:
        return None
    axis = np.array(dr.detach(known["to_world"].matrix), float).reshape(4, 4)[:3, 2]
    return tuple(map(float, axis / max(float(np.linalg.norm(axis)), 1e-300)))


def _turns_smoothly(lamp: Any) -> bool:
    """Return whether the radiance of an emitter in a fixed direction is a continuous function of the emitter's rotation.

    It is for an environment map without scale, and for a spotlight with a falloff and no texture. The disk of a sun has an edge, and
    Mitsuba's derivative of a projector does not contain the cosine at its plane.
    """
    if lamp.class_name() != "SpotLight":
        return lamp.class_name() == "EnvironmentMapEmitter" and keeps_lengths(lamp)
    known: Any = mi.traverse(lamp)
    ramp = float(known["cutoff_angle"][0]) - float(known["beam_width"][0])
    return ramp > 0.0 and "texture.data" not in known


def keeps_lengths(lamp: Any) -> bool:
    """Return whether the `to_world` of a distant emitter is a rotation or a reflection. Mitsuba samples others with a wrong density."""
    known: Any = mi.traverse(lamp)
    linear = np.array(dr.detach(known["to_world"].matrix), float).reshape(4, 4)[:3, :3]
    return np.allclose(linear @ linear.T, np.eye(3), atol=1e-3)


def is_posable(emitter: Any) -> bool:
    """Return whether an emitter without a shape has a pose."""
    return emitter.class_name() in _LIGHTS


def is_bare(scene: Any, target: str) -> bool:
    """Return whether a target is an emitter without a shape."""
    return any(emitter.id() == target and emitter.get_shape() is None for emitter in scene.emitters())


def info(key: PoseKey, obstacle: str, sensor: int | None, length: float = 1.0) -> ParameterInfo:
    """Return the description of a pose parameter; `obstacle` is the reason why path gradients do not support it, `sensor` the index of a
    sensor that it moves, and `length` the order of magnitude of lengths at the object, see `rigid_motions.lengths`."""
    viewpoint = sensor is not None
    kind = "light" if key.light else "sensor" if viewpoint else "shape"
    reason = f"it moves a {kind} rigidly"
    if obstacle:
        advice = "" if "--method smoothed" in obstacle else "; use --method smoothed (SmoothedDerivatives)"
        reason += f", and {obstacle}{advice}"
    low = 1e-3 if key.part == "scale" else None
    return ParameterInfo(
        key.shape,
        not obstacle,
        shares_paths=False,
        reason=reason,
        lowest=low,
        rigid=True,
        light=key.light,
        viewpoint=viewpoint,
        sensor=sensor,
        angle=key.part == "rotation",
        axial=key.axial,
        forward=key.forward,
        length=length if key.part == "translation" else 1.0,
    )


class Pose:
    """A rigid motion with a uniform scale per lane: x moves to c + t + s R (x - c)."""

    # This is not a dataclass, since Dr.Jit would treat a dataclass as loop state.
    def __init__(self, centre: Any, translation: Any, rotation: Any, scale: Any):
        self.centre, self.translation, self.scale = mi.Point3f(centre), mi.Vector3f(translation), mi.Float(scale)
        self.matrix = _rotation(mi.Vector3f(rotation))
        self.inverse = self.matrix.T

    def ray_inside(self, ray: Any) -> Any:
        """Transform a world ray to the local space of the posed object. Distances along the ray do not change."""
        local = mi.Ray3f(ray)
        local.o = self.point_inside(ray.o)
        local.d = self.inverse @ ray.d / self.scale
        return local

    def ray_outside(self, ray: Any) -> Any:
        """Transform a posed sensor's ray to world space."""
        moved = type(ray)(ray)
        moved.o = self.point(ray.o)
        moved.d = self.matrix @ ray.d
        return moved

    def point_inside(self, p: Any) -> Any:
        """Transform a world point to the local space of the posed object."""
        return self.centre + self.inverse @ (p - self.centre - self.translation) / self.scale

    def point(self, p: Any) -> Any:
        """Transform a point."""
        return self.centre + self.translation + self.scale * (self.matrix @ (p - self.centre))  # pyright: ignore[reportOperatorIssue]

    def transform(self) -> Any:
        """Return the pose as a matrix of homogeneous coordinates."""
        linear = self.scale * self.matrix
        shift = self.point(mi.Point3f(0))
        rows = [[*(linear[row, column] for column in range(3)), shift[row]] for row in range(3)]
        return mi.Transform4f(mi.Matrix4f(*rows[0], *rows[1], *rows[2], 0, 0, 0, 1))


def _rotation(vector: Any) -> Any:
    """Return the matrix of a rotation vector (Rodrigues' formula)."""
    square = dr.squared_norm(vector)
    small = square < 1e-8
    angle = dr.sqrt(dr.select(small, 1, square))  # the square root has no derivative at 0
    a = dr.select(small, 1 - square / 6, dr.sin(angle) / dr.select(small, 1, angle))
    b = dr.select(small, 0.5 - square / 24, (1 - dr.cos(angle)) / dr.select(small, 1, square))
    x, y, z = vector
    cross = mi.Matrix3f(0, -z, y, z, 0, -x, -y, x, 0)
    return dr.identity(mi.Matrix3f) + a * cross + b * (cross @ cross)


class PosedScene:
    """A scene with posed shapes and sensors, built once for any poses.

    Args:
        chosen: {key: its meaning} of the parameters in use.
        attributed: ids of shapes whose materials read attributes of vertices.

    Attributes:
        static: scene without the posed shapes, with all emitters and sensors.
        parts: {id: a scene of that shape alone}.

    Raises `InputError` if two parameters set the same coordinate.
    """

    def __init__(self, scene: Any, chosen: Mapping[str, PoseKey], attributed: Collection[str] = ()):
        self._slots, self._attributed = slots(chosen), attributed
        targets = {key.target for key in chosen.values()}
        shapes = scene.shapes()
        posed = {shape.id(): shape for shape in shapes if shape.id() in targets}
        rest = [shape for shape in shapes if shape.id() not in posed]
        rest += [emitter for emitter in scene.emitters() if emitter.get_shape() is None]
        shape_of_sensor = {sensor.id(): sensor.get_shape() for sensor in scene.sensors()}
        sensor_shapes = [shape.id() for shape in shape_of_sensor.values() if shape is not None]
        # Keep the order of the sensors, since a request selects one by its index. A sensor of a shape is added by its shape.
        sensors = [
            sensor if shape_of_sensor[sensor.id()] is None else shape_of_sensor[sensor.id()]
            for sensor in scene.sensors()
        ]
        self.static = scene_of([*(item for item in rest if item.id() not in sensor_shapes), *sensors])
        self.parts = {name: scene_of([shape]) for name, shape in posed.items()}
        self._centres = centres(scene, targets)

    def scenes(self) -> list[Any]:
        """Return all scenes, which are inputs of frozen kernels."""
        return [self.static, *self.parts.values()]

    def numbers(self, parameters: Mapping[str, np.ndarray], count: int) -> np.ndarray:
        """Return `count` poses as one array, (7 per target, count), from {key: (count, *shape)}. A missing key is as loaded."""
        columns = {key: np.reshape(x, (count, -1)).T for key, x in parameters.items() if key in self._slots}
        ends = np.zeros(count, np.float32), np.ones(count, np.float32)
        poses = [numbers_of(target, self._slots, columns, *ends) for target in self._centres]
        return np.array(poses, np.float32).reshape(-1, count)

    def at(self, scenes: list[Any], numbers: Any, batch: Any) -> Assembly:
        """Return the scene with each lane's poses, from `scenes()` and raveled `numbers()`; `batch` is the index of the lane's pose."""
        count = dr.width(numbers) // (7 * len(self._centres))
        poses = {}
        for index, (name, centre) in enumerate(self._centres.items()):
            v = [dr.gather(mi.Float, numbers, (7 * index + row) * count + batch) for row in range(7)]
            poses[name] = Pose(centre, v[0:3], v[3:6], v[6])
        static, *parts = scenes
        return Assembly(static, dict(zip(self.parts, parts, strict=True)), poses, self._attributed)


class Assembly:
    """The static scene and the posed ones, intersected as one. It replaces a `mitsuba.Scene` for ray tracing."""

    # This is not a dataclass, since Dr.Jit would treat a dataclass as loop state.
    def __init__(self, static: Any, parts: Mapping[str, Any], poses: Mapping[str, Pose], attributed: Collection[str]):
        self.static, self.poses, self._attributed = static, poses, attributed
        self.parts = {name: (part, poses[name]) for name, part in parts.items()}

    def ray_intersect(self, ray: Any, ray_flags: Any, coherent: Any, active: Any) -> Any:
        """Return the nearest surface interaction, like `mitsuba.Scene.ray_intersect`."""
        nearest = self.static.ray_intersect_preliminary(ray, coherent=coherent, active=active)
        nearest = dr.select(active, nearest, dr.zeros(mi.PreliminaryIntersection3f))
        nearest.t = dr.select(nearest.is_valid(), nearest.t, dr.inf)
        inside = mi.Ray3f(ray)
        matrix, scale = mi.Matrix3f(dr.identity(mi.Matrix3f)), mi.Float(1)
        for part, pose in self.parts.values():
            local = pose.ray_inside(ray)
            local.maxt = dr.minimum(ray.maxt, nearest.t)
            candidate = part.ray_intersect_preliminary(local, coherent=coherent, active=active)
            hit = active & candidate.is_valid() & (candidate.t < nearest.t)
            nearest = dr.select(hit, candidate, nearest)
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

    def material(self, si: Any) -> Any:
        """Return an interaction as materials see it: Mitsuba interpolates attributes of vertices at the point where the mesh was loaded."""
        material = type(si)(si)
        for part, pose in (self.parts[name] for name in self._attributed):
            own = si.shape == mi.ShapePtr(part.shapes()[0])
            material.p = dr.select(own, pose.point_inside(si.p), material.p)
        return material

    def ray_test(self, ray: Any, active: Any) -> Any:
        """Return whether a ray is occluded, like `mitsuba.Scene.ray_test`."""
        blocked = self.static.ray_test(ray, active)
        for part, pose in self.parts.values():
            blocked |= part.ray_test(pose.ray_inside(ray), active & ~blocked)
        return blocked


def matrices(scene: Any, parameters: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return {id of a shape or sensor: (4, 4)}, the matrix that multiplies its `to_world` from the left in these poses."""
    from scipy.spatial.transform import Rotation

    known = keys(scene)
    result = {}
    chosen = {key: known[key] for key in parameters}
    for target, centre in centres(scene, {key.target for key in chosen.values()}).items():
        values = {key: np.reshape(parameters[key], -1) for key in chosen}
        numbers = np.array(numbers_of(target, slots(chosen), values, 0.0, 1.0))
        linear = numbers[6] * Rotation.from_rotvec(numbers[3:6]).as_matrix()
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = linear, centre + numbers[:3] - linear @ centre
        result[target] = matrix
    return result


def centres(scene: Any, targets: set[str]) -> dict[str, list[float]]:
    """Return the centre of rotation of each target: shapes first, then emitters, then sensors."""
    moved = [shape for shape in scene.shapes() if shape.id() in targets]
    result = {shape.id(): np.array(shape.bbox().center(), float).reshape(-1).tolist() for shape in moved}
    lamps = [emitter for emitter in scene.emitters() if is_posable(emitter) and emitter.id() in targets]
    result |= {lamp.id(): _place(lamp) for lamp in lamps}
    for sensor in scene.sensors():
        if sensor.id() in targets:
            matrix = np.array(sensor.world_transform().matrix.numpy(), float).reshape(4, 4)
            result[sensor.id()] = matrix[:3, 3].tolist()
    return result


def _place(emitter: Any) -> list[float]:
    """Return the position of an emitter without a shape; the origin for a distant emitter."""
    parameters: Any = mi.traverse(emitter)
    if "position" in parameters:
        return np.array(parameters["position"], float).reshape(3).tolist()
    if "translation" not in _LIGHTS[emitter.class_name()]:
        return [0.0, 0.0, 0.0]
    return np.array(parameters["to_world"].matrix, float).reshape(4, 4)[:3, 3].tolist()


def slots(chosen: Mapping[str, PoseKey]) -> dict[str, tuple[str, int, int]]:
    """Return {key: (target, index of its first of 7 numbers, count)}. Raise `InputError` if two keys set the same coordinate."""
    owner: dict[tuple[str, int], str] = {}
    result: dict[str, tuple[str, int, int]] = {}
    for name, key in chosen.items():
        first = {"translation": 0, "rotation": 3, "scale": 6}[key.part] + (key.axis or 0)
        size = int(np.prod(key.shape))
        for slot in range(first, first + size):
            if other := owner.get((key.target, slot)):
                raise InputError(f"parameter {name}: {other} sets the same coordinate; leave out one of them")
            owner[key.target, slot] = name
        result[name] = (key.target, first, size)
    return result


def numbers_of(
    target: str, slots: Mapping[str, tuple[str, int, int]], values: Mapping[str, Any], zero: Any, one: Any
) -> list[Any]:
    """Return the 7 numbers of a target's pose: translation, rotation vector, scale; those of missing keys are `zero` and `one`, as
    loaded."""
    numbers = [zero] * 6 + [one]
    for key, (owner, first, size) in slots.items():
        if owner == target and key in values:
            numbers[first : first + size] = values[key]
    return numbers
