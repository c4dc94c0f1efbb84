# Dr.Jit's stubs know less than its functions return.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportReturnType=false

"""Media in the renderer: what it says of their parameters, what it refuses, in one line, and that steps repeat."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import unrender as ur
from tiers import quick
from unrender.gallery import parts, volumes
from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.renderer import SampleRequest

KEY = "cloud.interior_medium.sigma_t.data"


def scene(medium: dict[str, Any]) -> dict[str, Any]:
    return {
        "type": "scene",
        "camera": parts.camera((0, 0.5, 4.5), (0, 0, 0), 36.0, 8),
        "sky": {"type": "constant", "radiance": parts.colour(0.5)},
        "cloud": volumes.cube(medium),
    }


def cloud(density: float = 1.0, albedo: float = 0.7) -> dict[str, Any]:
    extinction = np.random.default_rng(1).uniform(0.5, 1, (4, 4, 4, 1)) * density
    scattering = np.full((3, 3, 3, 3), albedo)
    return {"type": "heterogeneous", "sigma_t": volumes.grid(extinction), "albedo": volumes.grid(scattering)}


def test_parameters_of_media_are_differentiable_carried_and_bounded() -> None:
    found = MitsubaRenderer(scene(cloud())).parameters()
    extinction, albedo = found[KEY], found["cloud.interior_medium.albedo.data"]
    assert extinction.differentiable
    assert extinction.shares_paths
    assert (extinction.lowest, extinction.highest) == (0, None)
    assert (albedo.lowest, albedo.highest) == (0, 1)
    glow = {"type": "emissive", "sigma_t": cloud()["sigma_t"], "emission": cloud()["albedo"]}
    emission = MitsubaRenderer(scene(glow)).parameters()["cloud.interior_medium.emission.data"]
    assert emission.shares_paths
    assert (emission.lowest, emission.highest) == (0, None)


@pytest.mark.parametrize(
    ("medium", "message"),
    [
        (lambda: cloud(density=-1.0), f"{KEY} must be at least 0, got -"),
        (lambda: cloud(albedo=1.5), "cloud.interior_medium.albedo.data must be at most 1, got 1.5"),
        (lambda: cloud(density=float("nan")), f"{KEY} holds values that are not finite"),
        (
            lambda: {"type": "emissive", "sigma_t": cloud()["sigma_t"]},
            "emission must be a volume, such as a gridvolume, got nothing",
        ),
        (lambda: {"type": "heterogeneous", "sigma_t": {"type": "gridvolume", "filename": "none.vol"}}, "none.vol"),
    ],
)
def test_a_bad_medium_is_one_line(medium: Any, message: str) -> None:
    with pytest.raises(ur.InputError) as caught:
        MitsubaRenderer(scene(medium()))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_grid_file_that_was_cut_short_is_one_line(tmp_path: Path) -> None:
    whole = tmp_path / "whole.vol"
    mi.VolumeGrid(np.ones((4, 4, 4, 1), np.float32)).write(str(whole))
    MitsubaRenderer(scene({"type": "heterogeneous", "sigma_t": {"type": "gridvolume", "filename": str(whole)}}))
    for length in (3, 40, 100):
        short = tmp_path / f"short_{length}.vol"
        short.write_bytes(whole.read_bytes()[:length])
        with pytest.raises(ur.InputError) as caught:
            MitsubaRenderer(scene({"type": "heterogeneous", "sigma_t": {"type": "gridvolume", "filename": str(short)}}))
        assert "\n" not in str(caught.value)


def test_what_moves_among_media_is_refused() -> None:
    renderer = MitsubaRenderer(scene(cloud()))
    assert "cloud.translation" not in renderer.parameters()
    with pytest.raises(ur.InputError, match="it moves a shape, in a scene with media"):
        renderer.prepare(["cloud.vertex_positions"], None)


def test_masks_among_media_are_refused() -> None:
    leaf = {"type": "mask", "opacity": 0.5, "b": {"type": "diffuse"}}
    description = {**scene(cloud()), "leaf": {"type": "sphere", "radius": 0.3, "bsdf": leaf}}
    with pytest.raises(ur.InputError, match="opacity of a mask in a scene with media"):
        MitsubaRenderer(description).prepare(["leaf.bsdf.opacity.value"], None)


@pytest.mark.parametrize("space", quick(["path", "primary"], "path"))
def test_equal_states_give_equal_images_and_gradients_and_seeds_repeat(space: Any) -> None:
    renderer = MitsubaRenderer(scene(cloud()), 4)
    session = renderer.prepare([KEY], space)
    current = renderer.values([KEY])
    weight = renderer.array(np.random.default_rng(1).uniform(0.5, 1, (2, 8, 8, 3)))
    rows = []
    for _ in range(3):
        pair = session.image_pair(current, current, SampleRequest(0, 8, 5, groups=2), space)
        np.testing.assert_array_equal(np.array(pair.images), np.array(pair.previous))
        both = session.adjoint_pair(current, current, pair.paths, weight, weight)
        a, b = (np.array(gradient[KEY]) for gradient in both)
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-4 * np.abs(a).max())
        rows.append((np.array(pair.images), a))
    for images, gradient in rows[1:]:
        np.testing.assert_array_equal(images, rows[0][0])
        np.testing.assert_allclose(gradient, rows[0][1], rtol=1e-3, atol=1e-4 * np.abs(gradient).max())


@pytest.mark.slow
def test_the_adjoint_of_a_pair_s_current_state_needs_no_weights_of_the_previous() -> None:
    """Its collisions depended on both states, and so must the replay."""
    renderer = MitsubaRenderer(scene(cloud()), 4)
    session = renderer.prepare([KEY], "path")
    current = renderer.values([KEY])
    previous = {KEY: current[KEY] * 1.5}
    weight = renderer.array(np.random.default_rng(1).uniform(0.5, 1, (1, 8, 8, 3)))
    pair = session.image_pair(current, previous, SampleRequest(0, 16, 5), "path")
    alone = session.adjoint(current, pair.paths, weight)[KEY]
    both = session.adjoint_pair(current, previous, pair.paths, weight, weight * 0.5)[0][KEY]
    np.testing.assert_allclose(np.array(alone), np.array(both), rtol=1e-3, atol=1e-4 * np.abs(np.array(both)).max())


def test_density_that_was_zero_everywhere_is_found() -> None:
    """A medium without majorant: no ray collides, and yet each voxel's derivative is there."""
    renderer = MitsubaRenderer(scene(cloud()), 4)
    session = renderer.prepare([KEY], "path")
    current = {KEY: renderer.values([KEY])[KEY] * 0.0}
    weight = renderer.array(np.ones((1, 8, 8, 3)))
    paths = session.image(current, SampleRequest(0, 256, 5)).paths
    gradient = np.array(session.adjoint(current, paths, weight)[KEY])
    assert np.isfinite(gradient).all()
    # Under a sky of one colour, what scatters gives a share of it back, and extinction takes all: a share 1 - albedo is lost.
    assert (gradient < 0).mean() > 0.9


@pytest.mark.slow
def test_a_grid_made_by_others_is_rendered_and_differentiated(assets: Path) -> None:
    """Mitsuba's tutorial volume: against `volpath`, and with a gradient that is finite and not zero."""
    smoke = {"type": "gridvolume", "filename": str(assets / "tutorials" / "volume.vol"), "to_world": _onto_the_cube()}
    renderer = MitsubaRenderer(scene({"type": "heterogeneous", "scale": 4.0, "sigma_t": smoke, "albedo": 0.8}), 4)
    session = renderer.prepare([KEY], "path")
    current = renderer.values([KEY])
    rendering = session.image(current, SampleRequest(0, 16 * 64, 5, groups=16))
    gradient = np.array(session.adjoint(current, rendering.paths, renderer.array(np.ones((16, 8, 8, 3))))[KEY])
    assert np.isfinite(gradient).all()
    assert np.abs(gradient).max() > 0
    volpath = mi.load_dict({"type": "volpath", "max_depth": 4})
    theirs = [
        np.array(mi.render(renderer.pair.current, integrator=volpath, spp=64, seed=run)).mean() for run in range(16)
    ]
    ours = np.array(rendering.images).mean(axis=(1, 2, 3))
    error = np.sqrt((np.var(ours, ddof=1) + np.var(theirs, ddof=1)) / 16)
    assert abs(ours.mean() - np.mean(theirs)) < 4 * error


def _onto_the_cube() -> Any:
    return mi.ScalarTransform4f().translate([-1, -1, -1]).scale(2)
