"""Vignetting and corrections of cameras, on a renderer of known integrals: pictures, exact derivatives, projections."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

import unrender as ur
from tests.analytic import AnalyticRenderer
from unrender.core.errors import InputError
from unrender.core.trees import Tree
from unrender.rendering.camera_poses import POSES, Corrections, PosedCameras
from unrender.rendering.exposure import VIGNETTING, VignettedRenderer, falloff, powers
from unrender.rendering.photographs import scene_renderer, scene_values, sensors_with_rows, with_photographs
from unrender.rendering.renderer import Camera, Renderer, SampleRequest

PLACES = np.array([[4.0, 0, 0], [0, 4, 1], [-4, 0, 0.5], [0, -4, 0], [1, 2, 4]])


class Seen:
    """A session in which the poses of sensors that a request does not ask for change nothing."""

    def __init__(self, inner: Any):
        self.inner, self.image_batch = inner, inner.image_batch
        self.unseen: list[str] = []

    def image(self, parameters: Tree, request: SampleRequest) -> Any:
        seen = {request.sensor} if request.sensors is None else set(request.sensors.tolist())
        self.unseen = [k for k in parameters if k[0] == "c" and int(k[1]) not in seen]
        return self.inner.image(self.still(parameters), request)

    def adjoint(self, parameters: Tree, paths: Any, weights: Any) -> Tree:
        found = self.inner.adjoint(self.still(parameters), paths, weights)
        return found | {key: 0 * found[key] for key in self.unseen}

    def still(self, parameters: Tree) -> Tree:
        return parameters | {key: 0 * parameters[key] for key in self.unseen}


class Cameras(AnalyticRenderer):
    """Five sensors, whose poses change the picture like any other parameter."""

    def __init__(self) -> None:
        rng = np.random.default_rng(0)
        keys = [f"c{v}.{part}" for v in range(len(PLACES)) for part in ("rotation", "translation")]
        values = {"map": rng.uniform(0.3, 0.9, (2, 2, 1)), **{key: np.zeros(3) for key in keys}}
        super().__init__(values, rng.uniform(0, 1, (36, 34)), 0.1, shape=(3, 4), sensors=len(PLACES))

    def prepare(self, keys: list[str], space: Any, derivatives: Any = True) -> Any:
        return Seen(super().prepare(keys, space, derivatives))

    def cameras(self) -> Mapping[int, Camera]:
        return {v: Camera(f"c{v}.rotation", f"c{v}.translation", place) for v, place in enumerate(PLACES)}


def requests() -> list[SampleRequest]:
    """A whole film, pixels of one sensor, and pixels of several."""
    pixels, sensors = np.array([3, 0, 5, 3, 9]), np.array([1, 0, 4, 3, 1])
    return [
        SampleRequest(1, 4, 6, 2),
        SampleRequest(1, 4, 7, 2, pixels),
        SampleRequest(0, 4, 8, 2, pixels, sensors),
        SampleRequest(0, 4, 9, 1, pixels, sensors),
    ]


def slopes(renderer: Renderer, state: Tree, key: str, request: SampleRequest, weights: np.ndarray) -> np.ndarray:
    """By central differences of the same random numbers."""
    session, found = renderer.prepare(list(state), None), np.zeros(state[key].shape)
    for index in np.ndindex(found.shape):
        values = []
        for amount in (1e-4, -1e-4):
            moved = state[key].copy()
            moved[index] += amount
            images = session.image(state | {key: moved}, request).images
            values.append((weights * images).sum() / len(images))
        found[index] = (values[0] - values[1]) / 2e-4
    return found


def check_adjoint(renderer: Renderer, state: Tree, key: str, share: float) -> None:
    rng = np.random.default_rng(2)
    session = renderer.prepare(list(state), None)
    for request in requests():
        rendering = session.image(state, request)
        weights = rng.uniform(0.5, 1.5, rendering.images.shape)
        expected = slopes(renderer, state, key, request, weights)
        found = session.adjoint(state, rendering.paths, weights)
        assert list(found) == list(state)
        close = {"rtol": share, "atol": share * np.abs(expected).max()}
        np.testing.assert_allclose(found[key], expected, **close)
        assert not np.allclose(found[key], 1.05 * expected, **close)


def test_vignetting_darkens_pixels_by_their_distance_from_the_middle() -> None:
    renderer = VignettedRenderer(Cameras())
    stops = np.array([-0.6, 0.2, -0.3])
    state = {"map": renderer.values(["map"])["map"], VIGNETTING: stops}
    session, plain = renderer.prepare(list(state), None), renderer.inner.prepare(["map"], None)
    factors = falloff(stops, 3, 4)
    np.testing.assert_allclose(powers(3, 4).reshape(3, 4, 3)[1, 2, 0], 0.5**2 / (1.5**2 + 2**2))
    for request in requests():
        shown = plain.image({"map": state["map"]}, request).images
        own = factors if request.pixels is None else factors.reshape(-1, 1)[request.pixels]
        np.testing.assert_allclose(session.image(state, request).images, shown * own, rtol=1e-6)
    check_adjoint(renderer, state, VIGNETTING, 1e-5)
    check_adjoint(renderer, state, "map", 1e-5)
    stacked = {key: np.stack([value, 1.1 * value]) for key, value in state.items()}
    again = session.image_batch(stacked, SampleRequest(1, 4, 6))
    np.testing.assert_allclose(again[:1], session.image(state, SampleRequest(1, 4, 6)).images, rtol=1e-5)


def test_corrections_have_the_derivatives_of_the_cameras_own_parameters() -> None:
    renderer = PosedCameras(Cameras(), list(range(5)))
    state = {"map": renderer.values(["map"])["map"], POSES: np.random.default_rng(1).normal(0, 0.5, (5, 6))}
    check_adjoint(renderer, state, POSES, 1e-3)


def test_what_moves_all_cameras_alike_is_projected_out() -> None:
    corrections = Corrections(Cameras().cameras())
    arms = PLACES - PLACES.mean(0)
    turn, shift = np.array([0.3, -0.5, 0.2]), np.array([0.1, 0.4, -0.2])
    rigid = np.concatenate(
        [np.broadcast_to(turn, (5, 3)), np.radians(np.cross(turn, arms) + shift + 0.2 * arms) / corrections.unit], 1
    )
    np.testing.assert_allclose(corrections.projected(rigid), 0, atol=1e-9)
    rows = np.random.default_rng(0).normal(size=(5, 6))
    once = corrections.projected(rows)
    np.testing.assert_allclose(corrections.projected(once), once, atol=1e-12)
    assert np.abs(once).max() > 0.1  # 30 numbers less 7
    assert np.linalg.matrix_rank(np.stack([corrections.projected(r.reshape(5, 6)).ravel() for r in np.eye(30)])) == 23
    assert corrections.unit == pytest.approx(np.radians(1) * np.sqrt((arms**2).sum(1).mean()))


def test_a_problem_takes_them_and_a_scene_is_told_the_poses() -> None:
    views = [ur.View(np.full((3, 4, 3), 0.5), sensor) for sensor in range(5)]
    keys = ["map", "exposure", VIGNETTING, POSES]
    problem = ur.Problem(Cameras(), [ur.Parameter(key) for key in keys], views, max_depth=1)
    assert isinstance(scene_renderer(problem.renderer), Cameras)
    assert sensors_with_rows(problem.renderer) == (0, 1, 2, 3, 4)
    assert with_photographs(problem.renderer, keys, [1, 2]) is problem.renderer
    result = ur.optimize(problem, ur.PathGradient(spp=4), ur.optimizers.Adam(0.01), steps=2)
    assert all(np.isfinite(result.parameters[key]).all() and result.parameters[key].any() for key in keys)
    told = scene_values(problem.renderer, {POSES: np.ones((5, 6)), VIGNETTING: np.zeros(3), "map": np.zeros(1)})
    assert set(told) == {
        "map",
        *(key for camera in Cameras().cameras().values() for key in (camera.rotation, camera.translation)),
    }
    with pytest.raises(InputError, match="at least 3 sensors"):
        ur.Problem(Cameras(), [ur.Parameter(POSES)], views[:2], max_depth=1)
