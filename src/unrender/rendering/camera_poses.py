"""Where the cameras of a capture stood, as one parameter: small corrections of all poses, without what moves all alike."""

from __future__ import annotations

import math
from collections.abc import Mapping
from collections.abc import Set as AbstractSet
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
    ParameterInfo,
    Renderer,
    Rendering,
    RenderSession,
    SampleRequest,
    Space,
    WithCameras,
    differentiated,
)
from unrender.rendering.wrapper import SessionWrapper

POSES = "poses"
"""The parameter's key. No scene has it: Mitsuba's keys have a dot."""
_FEWEST = 3
"""Cameras: two that may move as one have less than one pose left between them."""


class Corrections:
    """What the rows of the parameter mean.

    Row v is (ω, t): the camera turns by the rotation vector ω about its own place, in degrees along the axes of the world, and shifts by t,
    in units of an arc of one degree at the cameras' distance R (root mean square) from their middle m: the same number does about the
    same to a picture, whichever of the six it is.

    A motion and a scaling of all cameras together, ω the same for all and t = ω × (c_v - m) + τ + s (c_v - m), can be taken up by the
    asset and its light. So the part of the rows that is such a one, to first order, is projected out: P = 1 - G (Gᵀ G)⁻¹ Gᵀ.

    Args:
        cameras: at least 3.
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
        """Of the parameter."""
        return len(self.cameras), 6

    def projected(self, rows: np.ndarray) -> np.ndarray:
        """Rows (..., V, 6) without what moves all cameras alike."""
        flat = rows.reshape(*rows.shape[:-2], -1).astype(np.float64)
        return (flat - (flat @ self._common) @ self._common.T).reshape(rows.shape)

    def poses(self, rows: np.ndarray) -> dict[str, np.ndarray]:
        """{key: (..., 3)} of the cameras' own parameters, of rows (..., V, 6)."""
        moved = self.projected(rows)
        found = {}
        for row, camera in enumerate(self.cameras.values()):
            found[camera.rotation] = np.radians(moved[..., row, :3]).astype(np.float32)
            found[camera.translation] = (self.unit * moved[..., row, 3:]).astype(np.float32)
        return found

    def gradient(self, poses: Mapping[str, np.ndarray]) -> np.ndarray:
        """By the rows, (V, 6), of that by the cameras' own parameters; those that are missing have none."""
        rows = np.zeros(self.shape)
        for row, camera in enumerate(self.cameras.values()):
            if camera.rotation in poses:
                rows[row, :3] = math.radians(1.0) * poses[camera.rotation]
                rows[row, 3:] = self.unit * poses[camera.translation]
        return self.projected(rows)


class PosedCameras(WithParameter):
    """A renderer whose cameras have one parameter together, `poses` (V, 6): see `Corrections`.

    Images and batches are as unbiased as the inner renderer's, and gradients, too. `tangent_moment` leaves the poses out. Two states share
    random numbers, not paths.

    Args:
        inner: what renders the scene; it knows its cameras.
        sensors: those that have a row, in this order.

    Attributes:
        corrections: what the rows mean.
        notices: of the inner renderer.

    Raises:
        InputError: fewer than 3 sensors, one that cannot be moved, or a renderer that does not know where they stand.
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
        """See `WithParameter.info`: (V, 6)."""
        first = next(iter(self.corrections.cameras.values()))
        of = self.inner.parameters()[first.translation]
        return ParameterInfo(
            self.corrections.shape, of.differentiable, False, "it moves sensors", perturbable=True, viewpoint=True
        )

    def prepare(
        self, keys: list[str], space: Space | None, derivatives: bool | AbstractSet[str] = True
    ) -> RenderSession:
        wanted, own = differentiated(keys, derivatives), [key for key in keys if key != POSES]
        if len(own) == len(keys):
            return self.inner.prepare(own, space, wanted)
        cameras = self.corrections.cameras.values()
        poses = [key for camera in cameras for key in (camera.rotation, camera.translation)]
        inner = self.inner.prepare([*own, *poses], space, wanted - {POSES} | (set(poses) if POSES in wanted else set()))
        return PosedCamerasSession(self, inner)


@dataclass(frozen=True)
class PosedPaths:
    """What `adjoint` needs to walk the paths of a rendering again: the inner renderer's, and of which sensors they are."""

    inner: object
    sensors: tuple[int, ...]


class PosedCamerasSession(SessionWrapper):
    """Images and derivatives with respect to the cameras' poses and to the parameters of a session. See `RenderSession`."""

    def __init__(self, renderer: PosedCameras, inner: RenderSession):
        super().__init__(inner)
        self._renderer = renderer
        self._trees: list[tuple[Array, Tree]] = []

    def image_batch(self, parameters: Tree, request: SampleRequest) -> Array:
        rest = {key: value for key, value in parameters.items() if key != POSES}
        poses = self._renderer.corrections.poses(np.asarray(parameters[POSES]))
        return self._inner.image_batch({**rest, **poses}, request)

    def _shown(self, found: Rendering, request: SampleRequest) -> Rendering:
        return replace(found, paths=PosedPaths(found.paths, _sensors(request)))

    def _paths(self, paths: PosedPaths) -> Any:
        return paths.inner

    def _tangents(self, parameters: Tree, tangents: Tree) -> Tree:
        """Return those of the scene's parameters; the poses are left out."""
        poses = self._state({POSES: parameters[POSES]})
        still = {key: arrays.zeros_like(value) for key, value in poses.items()}
        return {**{key: value for key, value in tangents.items() if key != POSES}, **still}

    def _state(self, parameters: Tree) -> Tree:
        """With the cameras' own parameters: the same arrays for the same poses, which the scene then need not set again."""
        given = parameters[POSES]
        known = next((tree for poses, tree in self._trees if poses is given), None)
        if known is None:
            renderer = self._renderer
            found = renderer.corrections.poses(arrays.numpy(given))
            known = {key: renderer.array(value) for key, value in found.items()}
            self._trees = [*self._trees[-1:], (given, known)]
        return {**{key: value for key, value in parameters.items() if key != POSES}, **known}

    def _gradient(self, parameters: Tree, found: Tree, paths: PosedPaths) -> Tree:
        renderer = self._renderer
        cameras = list(renderer.corrections.cameras.values())
        seen = [cameras[renderer.rows[sensor]] for sensor in paths.sensors if sensor in renderer.rows]
        keys = [key for camera in seen for key in (camera.rotation, camera.translation)]
        rows = renderer.corrections.gradient({key: arrays.numpy(found[key]) for key in keys})
        return {key: renderer.array(rows) if key == POSES else found[key] for key in parameters}


def _sensors(request: SampleRequest) -> tuple[int, ...]:
    if request.sensors is None:
        return (request.sensor,)
    return tuple(np.unique(arrays.numpy(request.sensors)).tolist())
