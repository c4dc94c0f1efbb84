# Dr.Jit's stubs know less than its functions return.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportReturnType=false

"""Media that emit and absorb: closed forms for constant ones, gradients against finite differences for the others."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from fog import DARK, KIND, LEVELS, fog, grid, scene
from test_volume_gradients import limit, own, scores

from tiers import quick
from unrender.rendering.mitsuba.emissive import harmonics
from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.renderer import SampleRequest

SKY = np.array([0.2, 0.5, 0.8])


def glow(extinction: np.ndarray, emission: np.ndarray, filter_type: str = "trilinear") -> dict[str, Any]:
    return {"type": "emissive", "sigma_t": grid(extinction, filter_type), "emission": grid(emission, filter_type)}


def before_the_sky(medium: dict[str, Any]) -> dict[str, Any]:
    """A cube of the medium seen face on by parallel rays, before a sky of one colour."""
    found = scene(medium, lights="sky")
    found["sky"] = {"type": "constant", "radiance": {"type": "rgb", "value": SKY.tolist()}}
    found["sensor"] = {
        "type": "orthographic",
        "to_world": mi.ScalarTransform4f().look_at([0, -5, 0], [0, 0, 0], [0, 0, 1]).scale(0.9),
        "film": found["sensor"]["film"],
    }
    del found["floor"]
    return found


@pytest.mark.parametrize("depth", quick([1, 4], 4))
def test_a_constant_glow_is_what_its_closed_form_says(depth: int) -> None:
    """e (1 - exp(-2 σ)) + sky exp(-2 σ), whatever the depth: emission is seen directly."""
    extinction, emission = 0.6, np.array([1.5, 0.3, 0.0])
    medium = glow(np.full((4, 4, 4, 1), extinction), np.broadcast_to(emission, (4, 4, 4, 3)))
    renderer = MitsubaRenderer(before_the_sky(medium), depth)
    rendering = renderer.prepare([], None).image({}, SampleRequest(0, 32 * 64, 1, 32))
    images = np.array(rendering.images).astype(np.float64).mean(axis=(1, 2))
    passed = np.exp(-2 * extinction)
    expected = emission * (1 - passed) + SKY * passed
    error = images.std(axis=0, ddof=1) / np.sqrt(len(images))
    assert (np.abs(images.mean(axis=0) - expected) < 4 * error).all()
    assert (error < 0.005).all()


def slabs(voxels: int) -> tuple[np.ndarray, np.ndarray]:
    """Extinction and emission in slabs along y, empty to dense, other ones where x < 0 than where x > 0."""
    rng = np.random.default_rng(7)
    extinction, emission = rng.choice([0, 0.02, 1, 6], (2, voxels)), rng.uniform(0, 2, (2, voxels, 3))
    half = np.where(np.arange(voxels) < voxels // 2, 0, 1)
    shape = (voxels, voxels, voxels)
    by_half = [
        np.broadcast_to(np.moveaxis(x[half], 0, 1), (*shape, x.shape[2])) for x in (extinction[..., None], emission)
    ]
    return by_half[0], by_half[1]


def seen_through(extinction: np.ndarray, emission: np.ndarray) -> np.ndarray:
    """The mean over x of what such slabs show from y = -1, before the sky: colours."""
    voxels = len(extinction)
    passed, found = np.ones((voxels, 1)), np.zeros((voxels, 3))
    for y in range(voxels):
        through = np.exp(-extinction[0, y] * 2 / voxels)
        found += passed * (1 - through) * emission[0, y]
        passed = passed * through
    return (found + passed * SKY).mean(axis=0)


@pytest.mark.parametrize("voxels", quick([8, 20], 20))
def test_slabs_that_glow_are_what_their_closed_form_says(voxels: int) -> None:
    """With one majorant and with a supergrid of them; alone, and both images of a pair."""
    extinction, emission = slabs(voxels)
    renderer = MitsubaRenderer(before_the_sky(glow(extinction, emission, "nearest")), 2)
    keys = ["body.interior_medium.sigma_t.data", "body.interior_medium.emission.data"]
    session = renderer.prepare(keys, "path")
    assert bool(renderer.pair.majorants(previous=False, both=True)) == (voxels == 20)
    current = renderer.values(keys)
    previous = {keys[0]: current[keys[0]] * 0.7, keys[1]: current[keys[1]]}
    alone = session.image(current, SampleRequest(0, 32 * 64, 1, 32))
    pair = session.image_pair(current, previous, SampleRequest(0, 32 * 64, 2, 32), "path")
    for rendered, factor in ((alone.images, 1.0), (pair.images, 1.0), (pair.previous, 0.7)):
        images = np.array(rendered).astype(np.float64).mean(axis=(1, 2))
        error = images.std(axis=0, ddof=1) / np.sqrt(len(images))
        expected = seen_through(extinction * factor, emission)
        assert (np.abs(images.mean(axis=0) - expected) < 4 * error).all(), (images.mean(axis=0), expected, error)
        wrong = seen_through(extinction * factor * 1.05, emission)
        assert (np.abs(images.mean(axis=0) - wrong) > 4 * error).any(), "5 % more extinction goes unseen"


@pytest.mark.slow
def test_gradients_of_glowing_voxels_agree_with_finite_differences() -> None:
    """Emission where it is zero, and extinction where that is."""
    light = np.where(DARK, 0, np.random.default_rng(1).uniform(0.3, 2, (*KIND.shape[:3], 3)))
    medium = glow(np.array(list(LEVELS.values()))[KIND], light, "nearest")
    renderer = MitsubaRenderer(scene(medium, lights="sky"), 3)
    found = scores(renderer, own(renderer), 32)
    assert len(found) == 8
    assert max(map(abs, found.values())) < limit(len(found)), found


@pytest.mark.slow
def test_gradients_of_a_radiance_field_agree_with_finite_differences() -> None:
    """With spherical harmonics, the derivative's two estimators are weighted by extinction, also where that is zero."""
    rng = np.random.default_rng(1)
    medium = glow(np.array(list(LEVELS.values()))[KIND], rng.uniform(0.6, 2, (*KIND.shape[:3], 3)), "nearest")
    medium |= {f"emission_{k}": grid(rng.uniform(-0.1, 0.1, (*KIND.shape[:3], 3)), "nearest") for k in range(1, 4)}
    renderer = MitsubaRenderer(scene(medium, lights="sky"), 1)
    assert renderer.pair.radiance_field
    gradients, bound = own(renderer), limit(11)
    found = scores(renderer, gradients, 24)
    assert len(found) == 11
    assert max(map(abs, found.values())) < bound, found


@pytest.mark.slow
def test_both_states_of_a_glow_agree_with_separate_renders() -> None:
    rng = np.random.default_rng(4)
    medium = glow(rng.uniform(0, 3, (4, 4, 4, 1)), rng.uniform(0, 2, (4, 4, 4, 3)))
    found = scene(medium)
    found["ball"] = {
        "type": "sphere",
        "center": [0, -1.9, 0.9],
        "radius": 0.5,
        "bsdf": {"type": "null"},
        "interior": fog(),
    }
    renderer = MitsubaRenderer(found, 4)
    keys = ["body.interior_medium.sigma_t.data", "body.interior_medium.emission.data"]
    session = renderer.prepare(keys, "path")
    current = renderer.values(keys)
    previous = {key: value * 0.8 for key, value in current.items()}
    pair = session.image_pair(current, previous, SampleRequest(0, 24 * 64, 1, 24), "path")
    for state, images, seed in ((current, pair.images, 2), (previous, pair.previous, 3)):
        alone = session.image(state, SampleRequest(0, 24 * 64, seed, 24))
        a, b = (np.array(x).astype(np.float64).mean(axis=(1, 2)) for x in (images, alone.images))
        error = np.sqrt((a.var(axis=0, ddof=1) + b.var(axis=0, ddof=1)) / 24)
        assert (np.abs(a.mean(axis=0) - b.mean(axis=0)) < 4 * error).all()


@pytest.mark.slow
def test_a_glow_of_spherical_harmonics_is_what_its_closed_form_says() -> None:
    """Constant coefficients: the picture seen face on from -y; and what is emitted in a direction, with its derivatives."""
    rng = np.random.default_rng(3)
    coefficients, extinction, shape = rng.uniform(-0.1, 0.3, (4, 3)), 0.6, (2, 2, 2)
    medium = glow(np.full((*shape, 1), extinction), np.broadcast_to(coefficients[0], (*shape, 3)))
    medium |= {f"emission_{k}": grid(np.broadcast_to(coefficients[k], (*shape, 3)), "trilinear") for k in range(1, 4)}
    renderer = MitsubaRenderer(before_the_sky(medium), 1)
    keys = [f"body.interior_medium.emission{more}.data" for more in ("", "_1", "_2", "_3")]
    assert all(
        (info.lowest, info.highest) == (None, None) for key, info in renderer.parameters().items() if key in keys
    )
    sums = np.array([1, -(3**0.5), 0, 0]) @ coefficients
    radiance, covered = 0.05 * np.log1p(np.exp(sums / 0.05)), 1 - np.exp(-2 * extinction)
    images = np.array(renderer.prepare([], None).image({}, SampleRequest(0, 32 * 64, 1, 32)).images).astype(np.float64)
    images = images.mean(axis=(1, 2))
    expected, error = radiance * covered + SKY * (1 - covered), images.std(axis=0, ddof=1) / np.sqrt(len(images))
    assert (np.abs(images.mean(axis=0) - expected) < 4 * error).all()
    assert (np.abs(images.mean(axis=0) - 1.05 * expected) > 4 * error).any()
    Y = np.array(harmonics(mi.ScalarPoint3f(0, -1, 0), 9))
    np.testing.assert_allclose(Y, [1, -(3**0.5), 0, 0, 0, 0, -(5**0.5) / 2, 0, -(15**0.5) / 2], atol=1e-6)
