"""What a GPU needs, checked on the CPU: textures hold copies of parameters, and a kernel traces rays in one scene."""

from __future__ import annotations

from functools import partial
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from unrender.backend import variant
from unrender.rendering.mitsuba.integrators.moved_pair import MovedPair
from unrender.rendering.mitsuba.poses import Assembly
from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.renderer import SampleRequest

PAINT = "wall.bsdf.reflectance.data"
VERTICES = "block.vertex_positions"


@pytest.fixture
def on_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """The rules of a GPU, on whatever there is."""
    monkeypatch.setattr(variant, "is_gpu", lambda: True)


def scene(turn: float = 0.0) -> dict[str, Any]:
    """A block before a painted wall, turned about the vertical axis by an angle in radians."""
    transform = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
    paint = mi.Bitmap(np.random.default_rng(0).uniform(0.2, 0.8, (4, 4, 3)).astype(np.float32))
    return {
        "type": "scene",
        "sensor": {
            "type": "perspective",
            "fov": 40,
            "to_world": transform().look_at([0.3, 0.2, 5], [0, 0, 0], [0, 1, 0]),
            "film": film,
        },
        "wall": {
            "type": "rectangle",
            "to_world": transform().translate([0, 0, -1]).scale(2.0),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": paint, "raw": True}},
        },
        "block": {
            "type": "cube",
            "to_world": transform().rotate([0, 1, 0], np.degrees(turn)).scale(0.5),
            "bsdf": {"type": "diffuse"},
        },
        "sky": {"type": "constant"},
    }


def numbers(values: Any) -> np.ndarray:
    return np.array(values).astype(np.float64)


def test_a_second_adjoint_has_the_gradient_of_the_first(on_gpu: None) -> None:
    """Each has a leaf of its own, since the copy of a texture gives a leaf one gradient."""
    renderer = MitsubaRenderer(scene, 2)
    session, values = renderer.prepare([PAINT], None), renderer.values([PAINT])
    loaded = renderer.pair.loaded()
    paths = session.image(values, SampleRequest(0, 4, 1)).paths
    weights = renderer.array(np.ones((1, 8, 8, 3)))
    first = numbers(session.adjoint(values, paths, weights)[PAINT])
    leaf = loaded.leaves[PAINT]
    second = numbers(session.adjoint(values, paths, weights)[PAINT])
    assert loaded.leaves[PAINT] is not leaf
    assert np.abs(first).max() > 0
    np.testing.assert_allclose(second, first, rtol=1e-4)


def test_poses_are_written_into_the_scene(on_gpu: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """The images are those of scenes with the turned block: rays are not transformed, which takes a second scene."""
    key, turns = "block.rotation.y", np.array([0.0, 0.6])
    request, expected = SampleRequest(0, 1024, 3), []
    for turn in turns:
        turned = MitsubaRenderer(partial(scene, turn), 2)
        expected.append(numbers(turned.prepare([PAINT], None).image(turned.values([PAINT]), request).images)[0])
    monkeypatch.setattr(Assembly, "ray_intersect", lambda *_, **__: pytest.fail("a second scene is traced"))
    renderer = MitsubaRenderer(scene, 2)
    found = numbers(renderer.prepare([key], None, derivatives=False).image_batch({key: turns}, request))
    assert np.abs(expected[1] - expected[0]).max() > 0.1
    assert np.abs(found - np.stack(expected)).max() < 0.03


@pytest.mark.slow
def test_images_of_a_pair_of_meshes_trace_one_scene_each(on_gpu: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MovedPair, "sample", lambda *_: pytest.fail("both scenes are traced in one kernel"))
    renderer = MitsubaRenderer(scene, 2, [VERTICES])
    current = renderer.values([VERTICES])
    moved = {VERTICES: mi.TensorXf(numbers(current[VERTICES]).astype(np.float32) * np.float32(1.2))}  # pyright: ignore[reportCallIssue, reportArgumentType]
    session, request = renderer.prepare([VERTICES], "path"), SampleRequest(0, 512, 3)
    pair = session.image_pair(moved, current, request, "path")
    assert pair.paths.space == "primary"
    for image, state in ((pair.images, moved), (pair.previous, current)):
        alone = numbers(session.image(state, SampleRequest(0, 512, 4)).images)
        assert np.abs(numbers(image) - alone).max() < 0.12
    gradients = session.adjoint_pair(moved, current, pair.paths, *[renderer.array(np.ones((1, 8, 8, 3)))] * 2)
    assert all(np.abs(numbers(tree[VERTICES])).max() > 0 for tree in gradients)


def test_lookups_outside_of_virtual_calls_have_no_mask(on_gpu: None, monkeypatch: pytest.MonkeyPatch) -> None:
    assert variant.lookup_mask(mi.Bool(False)) is True
    monkeypatch.setattr(variant, "is_gpu", lambda: False)
    assert not variant.lookup_mask(mi.Bool(False))
