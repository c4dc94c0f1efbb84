# Dr.Jit's stubs know less than its functions return.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportReturnType=false

"""Media: our kernel against Mitsuba's `volpath`, both images of the pair against separate renders."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from fog import DEPTH, SCENES, cloud, media_keys, scene, two_media
from zscores import agree, check_pair

from tiers import quick
from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.renderer import SampleRequest

RUNS, SPP = 24, 64


def runs(images: Any) -> np.ndarray:
    return np.array(images).astype(np.float64)


def volpath(renderer: MitsubaRenderer, depth: int = DEPTH, count: int = RUNS) -> np.ndarray:
    integrator = mi.load_dict({"type": "volpath", "max_depth": depth})
    render = [mi.render(renderer.pair.current, integrator=integrator, spp=SPP, seed=100 + run) for run in range(count)]
    return np.stack([np.array(image) for image in render]).astype(np.float64)


def changed(renderer: MitsubaRenderer, keys: list[str]) -> tuple[dict[str, Any], dict[str, Any]]:
    """The scene's own values, and others: some voxels denser, some thinner."""
    current = renderer.values(keys)
    previous = {}
    for number, (key, value) in enumerate(current.items()):
        factor = np.random.default_rng(number).uniform(0.7, 1.1, np.shape(np.array(value)))
        previous[key] = renderer.array(np.array(value) * factor)
    return current, previous


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_the_kernel_agrees_with_volpath(name: str) -> None:
    renderer = MitsubaRenderer(SCENES[name](), DEPTH)
    ours = renderer.prepare([], None).image({}, SampleRequest(0, RUNS * SPP, 1, RUNS))
    assert agree(runs(ours.images), volpath(renderer))


@pytest.mark.slow
@pytest.mark.parametrize("depth", quick([1, 2, 12], 2))
def test_paths_are_as_long_as_volpath_s(depth: int) -> None:
    """Roulette included: at 12 it has ended most paths."""
    renderer = MitsubaRenderer(two_media(), depth)
    ours = renderer.prepare([], None).image({}, SampleRequest(0, RUNS * SPP, 1, RUNS))
    assert agree(runs(ours.images), volpath(renderer, depth))


@pytest.mark.parametrize("name", quick(SCENES, "cloud, all lights"))
def test_both_images_of_the_pair_agree_with_separate_renders(name: str) -> None:
    renderer = MitsubaRenderer(SCENES[name](), DEPTH)
    keys = [*media_keys(renderer), "floor.bsdf.reflectance.value"]
    session = renderer.prepare(keys, "path")
    current, previous = changed(renderer, keys)
    check_pair(session, current, previous, RUNS, SPP, fault=1.03)


@pytest.mark.parametrize("ending", ["sigma_t.data", "albedo.data"])
@pytest.mark.slow
def test_what_is_empty_or_black_now_but_was_not_before_is_not_lost(ending: str) -> None:
    """The majorant bounds both states, and a path goes on while either is alive; the reverse as well."""
    renderer = MitsubaRenderer(scene(cloud()), DEPTH)
    key = next(key for key in renderer.parameters() if key.endswith(ending))
    session = renderer.prepare([key], "path")
    full = renderer.values([key])
    none = {key: full[key] * 0.0}
    for current, previous in ((none, full), (full, none)):
        check_pair(session, current, previous, RUNS, SPP)


def test_the_difference_of_a_pair_is_far_less_noisy_than_that_of_two_renders() -> None:
    renderer = MitsubaRenderer(scene(cloud()), DEPTH)
    keys = media_keys(renderer)
    session = renderer.prepare(keys, "path")
    current = renderer.values(keys)
    previous = {key: value * 0.98 for key, value in current.items()}
    pair = session.image_pair(current, previous, SampleRequest(0, RUNS * SPP, 1, RUNS), "path")
    together = (runs(pair.images) - runs(pair.previous)).var(axis=0, ddof=1).sum()
    assert together < 0.02 * runs(pair.images).var(axis=0, ddof=1).sum()
