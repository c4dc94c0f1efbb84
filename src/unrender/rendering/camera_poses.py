"""Small corrections of all camera poses of a capture as one parameter, without the common similarity transform."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from unrender.core import arrays
from unrender.core.arrays import Array
from unrender.core.errors import InputError
from unrender.core.trees import Tree
from unrender.rendering.picture_factors import WithParameter
from unrender.rendering.renderer import (
    Camera,
    Derivatives,
    ParameterInfo,
    Renderer,
    Rendering,
    RenderSession,
    SampleRequest,
    Space,
    WithCameras,
    differentiated,
)
from unrender.rendering.wrapper import DerivedSession

POSES = "poses"
"""The parameter's key. No scene has it: Mitsuba's keys have a dot."""
_FEWEST = 3
"""Minimum number of cameras. Two cameras have fewer than 6 degrees of freedom beyond their common similarity transform."""


class Corrections:
    """Map between the parameter `poses` (V, 6) and the pose parameters of V cameras.

    Row v is (ω, t). The rotation vector ω turns the camera about its own position, in degrees along the world axes. The vector t translates
    it. The unit of t is the length of an arc of one degree at the distance R. R is the root mean square distance of the cameras from their
    centroid m. A unit of any of the six numbers therefore changes a picture by a similar amount.

    A similarity transform of all cameras, to first order ω the same for all and t = ω × (c_v - m) + τ + s (c_v - m), is equivalent to a
    transform of the asset and its lights. This part of the rows is projected out: P = 1 - G (Gᵀ G)⁻¹ Gᵀ.

    Args:
        cameras: {sensor: its camera}, at least 3.

    Raises:
        InputError: fewer than 3 cameras.
    """

    def __init__(self, cameras: Mapping[int, Camera]):
        if len(cameras) < _FEWEST:
            raise InputError(
                f"{POSES}: expected views of at least {_FEWEST} sensors, got {len(cameras)}; one camera's pose is <id>.rotation and "
                "<id>.translation"
            )
        self.cameras = dict(cameras)
        places = np.array([camera.place for camera in cameras.values()], np.float64)
        offsets = places - places.mean(axis=0)
        radius = math.sqrt(np.mean(np.sum(offsets**2, axis=1)))
        self.unit = math.radians(1.0) * (radius or 1.0)
        arms = offsets / (radius or 1.0)
        columns = []
        for axis in np.eye(3):
            turn = np.cross(axis, arms)
            columns.append(np.concatenate([np.broadcast_to(axis, arms.shape), turn], 1))
            columns.append(np.concatenate([np.zeros_like(arms), np.broadcast_to(axis, arms.shape)], 1))
        columns.append(np.concatenate([np.zeros_like(arms), arms], 1))
        basis, sizes, _ = np.linalg.svd(np.stack([column.ravel() for column in columns], 1), full_matrices=False)
        self._common = basis[:, sizes > 1e-9 * sizes.max()]

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of the parameter, (V, 6)."""
        return len(self.cameras), 6

    def projected(self, rows: np.ndarray) -> np.ndarray:
        """Return rows (..., V, 6) without the common similarity transform of all cameras."""
        flat = rows.reshape(*rows.shape[:-2], -1).astype(np.float64)
        return (flat - (flat @ self._common) @ self._common.T).reshape(rows.shape)

    def poses(self, rows: np.ndarray) -> dict[str, np.ndarray]:
        """Return {key: (..., 3)} of the cameras' pose parameters for rows (..., V, 6): rotations in radians, translations in world
        units."""
        moved = self.projected(rows)
        poses = {}
        for row, camera in enumerate(self.cameras.values()):
            poses[camera.rotation] = np.radians(moved[..., row, :3]).astype(np.float32)
            poses[camera.translation] = (self.unit * moved[..., row, 3:]).astype(np.float32)
        return poses

    def gradient(self, poses: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return the gradient by the rows, (V, 6), from the gradient by the cameras' pose parameters. A camera without
        entries contributes 0.
        """
        rows = np.zeros(self.shape)
        for row, camera in enumerate(self.cameras.values()):
            if camera.rotation in poses:
                rows[row, :3] = math.radians(1.0) * poses[camera.rotation]
                rows[row, 3:] = self.unit * poses[camera.translation]
        return self.projected(rows)


class PosedCameras(WithParameter):
    """A renderer with the parameter `poses` (V, 6) for all cameras together, a row for each of `sensors`, see `Corrections`.

    Images, batches and gradients are as unbiased as the inner renderer's. `tangent_moment` omits the derivatives by the poses. Two states
    share random numbers, not paths. Raises `InputError` for fewer than 3 sensors, a sensor that cannot be moved, or a renderer that does
    not implement `WithCameras`.
    """

    key = POSES

    def __init__(self, inner: Renderer, sensors: list[int]):
        known = inner.cameras() if isinstance(inner, WithCameras) else {}
        if missing := next((sensor for sensor in sensors if sensor not in known), None):
            raise InputError(
                f"{POSES}: sensor {missing} cannot be moved; expected a perspective sensor with an id of its own"
            )
        super().__init__(inner)
        self.rows = {sensor: row for row, sensor in enumerate(dict.fromkeys(sensors))}
        self.corrections = Corrections({sensor: known[sensor] for sensor in self.rows})

    def info(self) -> ParameterInfo:
        first = next(iter(self.corrections.cameras.values()))
        of = self.inner.parameters()[first.translation]
        return ParameterInfo(
            self.corrections.shape, of.differentiable, False, "it moves sensors", perturbable=True, viewpoint=True
        )

    def prepare(self, keys: list[str], space: Space | None, derivatives: Derivatives = True) -> RenderSession:
        differentiable, own = differentiated(keys, derivatives), [key for key in keys if key != POSES]
        if len(own) == len(keys):
            return self.inner.prepare(own, space, differentiable)
        cameras = self.corrections.cameras.values()
        poses = [key for camera in cameras for key in (camera.rotation, camera.translation)]
        inner = self.inner.prepare(
            [*own, *poses], space, differentiable - {POSES} | (set(poses) if POSES in differentiable else set())
        )
        return PosedCamerasSession(self, inner)


@dataclass(frozen=True)
class PosedPaths:
    """Paths of a rendering: those of the inner renderer, and the indices of the rendered sensors."""

    inner: object
    sensors: tuple[int, ...]


class PosedCamerasSession(DerivedSession):
    """A session that renders and differentiates with respect to the cameras' poses and the inner session's parameters."""

    def __init__(self, renderer: PosedCameras, inner: RenderSession):
        super().__init__(inner, {POSES})
        self._renderer = renderer

    def image_batch(self, parameters: Tree, request: SampleRequest) -> Array:
        own, rest = self._split(parameters)
        return self._inner.image_batch({**rest, **self._renderer.corrections.poses(np.asarray(own[POSES]))}, request)

    def _shown(self, rendering: Rendering, request: SampleRequest) -> Rendering:
        return replace(rendering, paths=PosedPaths(rendering.paths, _sensors(request)))

    def _paths(self, paths: PosedPaths) -> Any:
        return paths.inner

    def _tangents(self, parameters: Tree, tangents: Tree) -> Tree:
        """Return the tangents of the scene's parameters, and zeros for the pose parameters."""
        poses = self._state({POSES: parameters[POSES]})
        return {**self._split(tangents)[1], **{key: arrays.zeros_like(value) for key, value in poses.items()}}

    def _inside(self, own: Tree) -> Tree:
        poses = self._renderer.corrections.poses(arrays.numpy(own[POSES]))
        return {key: self._renderer.array(value) for key, value in poses.items()}

    def _gradient(self, parameters: Tree, inner_gradient: Tree, paths: PosedPaths) -> Tree:
        renderer = self._renderer
        cameras = list(renderer.corrections.cameras.values())
        rendered = [cameras[renderer.rows[sensor]] for sensor in paths.sensors if sensor in renderer.rows]
        keys = [key for camera in rendered for key in (camera.rotation, camera.translation)]
        rows = renderer.corrections.gradient({key: arrays.numpy(inner_gradient[key]) for key in keys})
        return {key: renderer.array(rows) if key == POSES else inner_gradient[key] for key in parameters}


def _sensors(request: SampleRequest) -> tuple[int, ...]:
    if request.sensors is None:
        return (request.sensor,)
    return tuple(np.unique(arrays.numpy(request.sensors)).tolist())
