# Dr.Jit's stubs know less than its functions return.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportReturnType=false

"""Both images of the pair against separate renders, and our kernel against Mitsuba's `path`, for BSDFs of every kind."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from zoo import DEPTH, LIGHTS, TOGETHER, everything, scene, subject, texture, tiles, two_states
from zscores import agree, check_pair

from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.renderer import SampleRequest

RUNS, SPP = 32, 16


def runs(images: tuple[Any, ...]) -> np.ndarray:
    return np.stack([np.array(image) for image in images]).astype(np.float64)


def test_an_image_of_the_pair_agrees_with_mitsuba_path_and_three_percent_are_seen() -> None:
    """The quick twin of the test below."""
    count = 8
    description, changes = subject("blend")
    renderer = MitsubaRenderer(description, DEPTH)
    current, previous = two_states(renderer, changes)
    session = renderer.prepare(list(current), "path")
    ours = runs(session.image_pair(current, previous, SampleRequest(0, count * SPP, 1, count), "path").images)
    path, stock = mi.load_dict({"type": "path", "max_depth": DEPTH}), mi.load_dict(subject("blend")[0])
    theirs = runs(tuple(mi.render(stock, integrator=path, spp=SPP, seed=100 + run) for run in range(count)))
    assert agree(ours, theirs)
    assert not agree(1.03 * ours, theirs)


@pytest.mark.slow
@pytest.mark.parametrize("name", TOGETHER)
def test_both_images_of_the_pair_agree_with_separate_renders_and_those_with_mitsuba_path(name: str) -> None:
    description, changes = subject(name)
    renderer = MitsubaRenderer(description, DEPTH)
    current, previous = two_states(renderer, changes)
    session = renderer.prepare(list(current), "path")
    pair = session.image_pair(current, previous, SampleRequest(0, RUNS * SPP, 1, RUNS), "path")
    assert pair.previous is not None
    singles = []
    for state, images, seed in ((current, pair.images, 2), (previous, pair.previous, 3)):
        alone = session.image(state, SampleRequest(0, RUNS * SPP, seed, RUNS))
        singles.append(runs(alone.images))
        for both, single in zip(tiles(runs(images)), tiles(singles[-1]), strict=True):
            assert agree(both, single)
    path = mi.load_dict({"type": "path", "max_depth": DEPTH})
    scene = mi.load_dict(subject(name)[0])
    theirs = runs(tuple(mi.render(scene, integrator=path, spp=SPP, seed=100 + run) for run in range(RUNS)))
    for ours, stock in zip(tiles(singles[0]), tiles(theirs), strict=True):
        assert agree(ours, stock)


@pytest.mark.slow
def test_a_planted_bias_of_one_percent_is_seen() -> None:
    renderer = MitsubaRenderer(everything(), DEPTH)
    changes = {"specular_transmittance.value": 0.9, "alpha.data": 1.2, "floor.bsdf.reflectance.data": 0.9, **LIGHTS}
    current, previous = two_states(renderer, changes)
    session = renderer.prepare(list(current), "path")
    check_pair(session, current, previous, 64, 64, fault=1.01)


def test_mesh_attributes_are_read_from_the_shape_of_their_state() -> None:
    def description() -> dict[str, Any]:
        attribute = {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_color"}}
        mesh = mi.load_dict(
            {"type": "cube", "to_world": mi.ScalarTransform4f().translate([0, 0, 0.6]), "bsdf": attribute}
        )
        count = mesh.vertex_count() * 3
        mesh.add_attribute("vertex_color", 3, np.random.default_rng(1).uniform(0.1, 0.9, count).astype(np.float32))
        return {**scene({"type": "diffuse"}), "ball": mesh}

    renderer = MitsubaRenderer(description, DEPTH)
    current, previous = two_states(renderer, {"vertex_color": 0.8, **LIGHTS})
    session = renderer.prepare(list(current), "path")
    pair = session.image_pair(current, previous, SampleRequest(0, RUNS * SPP, 1, RUNS), "path")
    assert pair.previous is not None
    alone = session.image(previous, SampleRequest(0, RUNS * SPP, 3, RUNS))
    assert agree(runs(pair.previous), runs(alone.images))


def test_light_that_is_black_now_but_was_not_before_is_not_lost() -> None:
    """Termination and visibility must look at both states."""
    renderer = MitsubaRenderer(scene({"type": "diffuse", "reflectance": texture(2)}, environment=False), DEPTH)
    keys = ["lamp.emitter.radiance.value", "floor.bsdf.reflectance.data"]
    session = renderer.prepare(keys, "path")
    previous = renderer.values(keys)
    current = {key: value * 0.0 for key, value in previous.items()}
    pair = session.image_pair(current, previous, SampleRequest(0, RUNS * SPP, 1, RUNS), "path")
    assert pair.previous is not None
    assert all(float(np.abs(image).max()) == 0 for image in runs(pair.images))
    alone = session.image(previous, SampleRequest(0, RUNS * SPP, 3, RUNS))
    assert agree(runs(pair.previous), runs(alone.images))
