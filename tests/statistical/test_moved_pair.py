# Dr.Jit's stubs know less than its functions return.
# pyright: reportArgumentType=false

"""Pairs of states whose meshes move: both images against separate renders, derivatives by replay, what related paths are worth."""

from __future__ import annotations

from functools import cache
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from zscores import agree

from unrender.gallery import meshes
from unrender.rendering.mitsuba.integrators.moved_pair import MovedPair
from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.renderer import SampleRequest, Space

VERTICES, SCALE, DEPTH = "ball.vertex_positions", "ball.scale", 4
RUNS, SPP = 32, 32

pytestmark = pytest.mark.slow


def room(fineness: int = 1, **more: Any) -> dict[str, Any]:
    """The Cornell box with a ball of triangles in place of its boxes."""
    points, faces = meshes.icosphere(fineness)
    found = {key: value for key, value in mi.cornell_box().items() if not key.endswith("-box") and key != "integrator"}
    found["sensor"]["film"] = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}}
    bsdf = {"type": "twosided", "b": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.6, 0.5]}}}
    return {**found, "ball": meshes.triangles("ball", np.array([0.0, -0.3, 0.0]) + 0.5 * points, faces, bsdf), **more}


@cache
def renderer(key: str, fineness: int = 1) -> MitsubaRenderer:
    return MitsubaRenderer(lambda: room(fineness), DEPTH, [key])


def states(of: MitsubaRenderer, key: str, step: float) -> tuple[Any, Any]:
    """Two, of which the current one is so far off."""
    before = of.values([key])
    value = np.array(before[key])
    shift = step if key == SCALE else step * np.sin(7.0 * np.roll(value.reshape(-1, 3), 1, 1)).reshape(value.shape)
    return {key: of.array(value + shift)}, before


def pair(
    of: MitsubaRenderer, key: str, step: float, space: Space, runs: int, spp: int
) -> tuple[np.ndarray, np.ndarray]:
    session = of.prepare([key], space)
    rendering = session.image_pair(*states(of, key, step), SampleRequest(0, runs * spp, 1, runs), space)
    return np.array(rendering.images, float), np.array(rendering.previous, float)


def alone(of: MitsubaRenderer, key: str, step: float, previous: bool, seed: int) -> np.ndarray:
    session = of.prepare([key], "path")
    rendering = session.image(states(of, key, step)[previous], SampleRequest(0, RUNS * SPP, seed, RUNS))
    return np.array(rendering.images, float)


def test_both_images_agree_with_separate_renders_and_a_planted_fault_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """Scale halves the areas of all triangles: a density that leaves that out is wrong."""
    of = renderer(SCALE)
    now, before = pair(of, SCALE, 0.4, "path", RUNS, SPP)
    # The current paths are those of `prb`, so that its adjoint replays them.
    np.testing.assert_array_equal(now, alone(of, SCALE, 0.4, previous=False, seed=1))
    apart = alone(of, SCALE, 0.4, previous=True, seed=2)
    verdict, figures = agree(before, apart, size=4)
    assert verdict, figures
    blind = MitsubaRenderer(room, DEPTH, [SCALE])
    session = blind.prepare([SCALE], "path")
    monkeypatch.setattr(session, "_moved_kernel", MovedPair(DEPTH, areas=False))
    _, wrong = pair(blind, SCALE, 0.4, "path", RUNS, SPP)
    verdict, figures = agree(wrong, apart, size=4)
    assert not verdict, f"areas left out of the density went unseen: {figures}"


def test_other_materials_agree() -> None:
    """Walls of rough metal, a floor of plastic, a mirror."""
    kinds = {
        "back": {"type": "roughconductor", "alpha": 0.2},
        "floor": {"type": "plastic"},
        "red-wall": {"type": "conductor"},
    }
    walls = {name: {**room()[name], "bsdf": bsdf} for name, bsdf in kinds.items()}
    of = MitsubaRenderer(lambda: room(**walls), DEPTH, [VERTICES])
    _, before = pair(of, VERTICES, 0.1, "path", RUNS, SPP)
    verdict, figures = agree(before, alone(of, VERTICES, 0.1, previous=True, seed=2), size=4)
    assert verdict, figures


def test_carried_paths_differ_less_than_those_of_equal_random_numbers() -> None:
    """Geometric mean over pixels of Var[F - H] / Var F, small triangles; it falls nearly with the step's square."""
    of, found = renderer(VERTICES, 4), {}
    for space in ("primary", "path"):
        for step in (0.01, 0.0025):
            now, before = pair(of, VERTICES, step, space, 128, 1)
            ratio = (now - before).var(axis=0) / np.maximum(now.var(axis=0), 1e-12)
            found[space, step] = np.exp(np.log(np.maximum(ratio, 1e-7)).mean())
    assert found["path", 0.01] < 0.6 * found["primary", 0.01], found
    assert found["path", 0.0025] < 0.15 * found["path", 0.01], found


def test_adjoints_of_both_states_are_those_of_separate_renders() -> None:
    of = renderer(VERTICES)
    current, previous = states(of, VERTICES, 0.05)
    session, request = of.prepare([VERTICES], "path"), SampleRequest(0, 8, 1, 2)
    weights = of.array(np.random.default_rng(0).random((2, 16, 16, 3)))
    rendering = session.image_pair(current, previous, request, "path")
    both = session.adjoint_pair(current, previous, rendering.paths, weights, weights)
    for state, gradient in zip((current, previous), both, strict=True):
        single = session.adjoint(state, session.image(state, request).paths, weights)
        a, b = np.array(gradient[VERTICES]), np.array(single[VERTICES])
        assert np.abs(a - b).max() < 1e-4 * np.abs(b).max()
