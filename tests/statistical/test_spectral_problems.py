"""Problems of the suite in a spectral variant: adjoints against finite differences of Mitsuba's own renderings."""

# Dr.Jit's stubs know less than its functions return.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from zscores import z_scores

import unrender as ur
from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.renderer import SampleRequest

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("spectral_variant")]

RUNS, SPP, STEP = 16, 256, 0.01


def gallery(name: str) -> tuple[MitsubaRenderer, list[str]]:
    problem = ur.gallery.problem(name, resolution=16, texture_resolution=8, reference_spp=1)
    assert isinstance(problem.renderer, MitsubaRenderer)
    return problem.renderer, list(problem.truth)


def numbers(assets: Path, folder: Path) -> tuple[MitsubaRenderer, list[str]]:
    from benchmarks.suite import scenes

    found, _ = scenes.SCENES["numbers"](assets, folder, 16, 8)
    return MitsubaRenderer(folder / "scene.xml", 5), list(found)


def slopes_of_stock(
    renderer: MitsubaRenderer, values: dict[str, Any], key: str, v: np.ndarray, weight: np.ndarray
) -> np.ndarray:
    """Central differences along `v` of a weighted rendering, (RUNS,). Both ends have the same seed."""
    path, scene = mi.load_dict({"type": "path", "max_depth": renderer.max_depth}), renderer.pair.loaded()
    ends = []
    for side in (STEP, -STEP):
        moved = np.array(values[key]) + side * v
        scene.set_parameters({**values, key: mi.TensorXf(moved.astype(np.float32))})
        pictures = [np.array(mi.render(scene.scene, integrator=path, spp=SPP, seed=n), float) for n in range(RUNS)]
        ends.append(np.array([(picture[..., :3] * weight).sum() for picture in pictures]))
    return (ends[0] - ends[1]) / (2 * STEP)


@pytest.mark.parametrize("name", ["indirect-room", "glossy-room", "numbers"])
def test_gradients_are_those_of_mitsubas_renderings(name: str, request: pytest.FixtureRequest, tmp_path: Path):
    """A gradient that is a tenth too large is found out in at least one parameter."""
    renderer, keys = numbers(request.getfixturevalue("assets"), tmp_path) if name == "numbers" else gallery(name)
    session, values = renderer.prepare(keys, None), renderer.values(keys)
    random = np.random.default_rng(3)
    weight = random.uniform(0.5, 1.5, (*renderer.resolutions()[0], 3))
    gradients = []
    for number in range(RUNS):
        paths = session.image(values, SampleRequest(0, SPP, 500 + number)).paths
        gradients.append(session.adjoint(values, paths, renderer.array(weight[None])))
    found_out = False
    for key in keys:
        v = random.uniform(0.5, 1.5, values[key].shape)
        expected = slopes_of_stock(renderer, values, key, v, weight)
        found = np.array([(np.array(gradient[key], float) * v).sum() for gradient in gradients])
        z = abs(float(z_scores(found[:, None], expected[:, None])[0]))
        print(f"{name} {key}: {found.mean():.2f}, differences {expected.mean():.2f}, |z| {z:.2f}")
        assert z < 3.9, (key, found.mean(), expected.mean())
        found_out |= abs(float(z_scores(1.1 * found[:, None], expected[:, None])[0])) > 3.9
    assert found_out
