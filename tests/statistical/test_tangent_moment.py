# Dr.Jit's stubs know less than its functions return.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportReturnType=false

"""Squared derivatives of single paths: against finite differences on the same paths, and against one pass per parameter."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import stats
from zoo import DEPTH, SIZE, TOGETHER, scene, size, subject, tiles, two_states

import unrender as ur
from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.renderer import SampleRequest

STEP = 4e-3


@pytest.mark.parametrize("name", TOGETHER)
def test_it_is_the_squared_derivative_of_each_path(name: str) -> None:
    """One sample per pixel, so that an image is its paths; all parameters grow together."""
    description, changes = subject(name)
    renderer = MitsubaRenderer(description, DEPTH)
    current, _ = two_states(renderer, changes)
    session = renderer.prepare(list(current), "path")
    request = SampleRequest(0, 1, 11)
    sides = []
    for scale in (1 + STEP, 1 - STEP):
        pair = session.image_pair(current, {key: x * scale for key, x in current.items()}, request, "path")
        assert pair.previous is not None
        sides.append(np.array(pair.previous[0]).astype(np.float64))
    expected = ((sides[0] - sides[1]) / (2 * STEP)) ** 2
    found = np.array(session.tangent_moment(current, session.image(current, request).paths, current))
    assert found.shape == (size(name), size(name), 3)
    for one, exact in zip(tiles(found), tiles(expected), strict=True):
        assert exact.sum() > 0
        close = np.abs(one - exact) < 0.05 * exact + 1e-3 * exact.mean()
        assert close.mean() > 0.99
        assert one.sum() == pytest.approx(exact.sum(), rel=0.03)


def twelve() -> tuple[MitsubaRenderer, dict[str, Any]]:
    """Four colours of three channels: a material's, a floor's, two lights'."""
    description = scene(
        {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.5, 0.6, 0.3]}}, environment=False
    )
    description["floor"]["bsdf"] = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.4, 0.3, 0.7]}}
    description["second"] = {"type": "point", "position": [-1, -1, 2], "intensity": {"type": "rgb", "value": [1, 2, 1]}}
    renderer = MitsubaRenderer(description, DEPTH)
    keys = [
        key
        for key, info in renderer.parameters().items()
        if info.differentiable and info.shape == (3,) and key.endswith(".value")
    ]
    values = renderer.values(keys)
    assert sum(np.array(x).size for x in values.values()) == 12
    return renderer, values


@pytest.mark.slow
def test_random_signs_sum_the_squares_of_twelve_single_derivatives() -> None:
    """On the same paths: the mean over sign patterns against one pass per parameter, per block of pixels and channel."""
    renderer, values = twelve()
    session = renderer.prepare(list(values), None)
    paths = session.image(values, SampleRequest(0, 16, 3)).paths

    def blocks(moment: Any) -> np.ndarray:
        return np.array(moment).astype(np.float64).reshape(6, SIZE // 6, 6, SIZE // 6, 3).mean(axis=(1, 3))

    single = np.zeros((6, 6, 3))
    for key in values:
        for channel in range(3):
            unit = {k: np.zeros(3) for k in values}
            unit[key][channel] = 1.0
            single += blocks(session.tangent_moment(values, paths, {k: renderer.array(v) for k, v in unit.items()}))
    rng = np.random.default_rng(0)
    signed = []
    for _ in range(200):
        signs = {k: renderer.array(rng.choice([-1.0, 1.0], 3)) for k in values}
        signed.append(blocks(session.tangent_moment(values, paths, signs)))
    signed = np.array(signed)
    error = signed.std(axis=0, ddof=1) / np.sqrt(len(signed))
    known = error > 1e-6 * single
    assert known.mean() > 0.8
    limit = stats.norm.isf((1 - (1 - 1e-3) ** (1 / known.sum())) / 2)
    z = (signed.mean(axis=0) - single)[known] / error[known]
    assert np.abs(z).max() < limit
    # What forgets the cross terms' averaging out, one pattern for all, is seen.
    same = {k: renderer.array(np.ones(3)) for k in values}
    wrong = blocks(session.tangent_moment(values, paths, same))
    assert np.abs((wrong - single)[known] / error[known]).max() > limit


@pytest.mark.slow
@pytest.mark.parametrize("name", ["smoke", "three-bodies", "nerf-volume"])
def test_in_media_it_is_the_squared_product_of_the_paths_own_gradient(name: str) -> None:
    """Collisions are chosen by chance apart from what they bring, so no finite difference sees a path's derivative; its adjoint does."""
    problem = ur.gallery.problem(name, resolution=5, reference_spp=1)
    renderer, values = problem.renderer, problem.initial()
    session = renderer.prepare(list(values), None)
    rng = np.random.default_rng(0)
    tangents = {key: rng.normal(size=x.shape) * np.array(x) for key, x in values.items()}
    paths = session.image(values, SampleRequest(0, 1, 8)).paths
    found = np.array(session.tangent_moment(values, paths, {k: renderer.array(x) for k, x in tangents.items()}))
    expected = np.zeros_like(found)
    for place in np.ndindex(found.shape):
        weights = np.zeros((1, *found.shape))
        weights[0][place] = 1.0
        gradient = session.adjoint(values, paths, renderer.array(weights))
        expected[place] = sum(np.sum(np.array(gradient[key]) * x) for key, x in tangents.items()) ** 2
    assert (expected > 0).sum() > 10
    np.testing.assert_allclose(found, expected, rtol=2e-3, atol=1e-4 * expected.max())


@pytest.mark.slow
def test_gradients_after_a_tangent_pass_are_what_they_were() -> None:
    """The pass cuts what ties the scenes to their parameters; the next rendering ties them anew, in every scene of the process."""
    renderer, values = twelve()
    other, others = twelve()

    def gradients(asked: MitsubaRenderer, at: dict[str, Any]) -> np.ndarray:
        session = asked.prepare(list(at), "path")
        rendering = session.image_pair(at, at, SampleRequest(0, 4, 5), "path")
        found = session.adjoint_pair(at, at, rendering.paths, rendering.images, rendering.images)
        return np.stack([np.concatenate([np.array(g) for g in tree.values()]) for tree in found])

    before = gradients(renderer, values), gradients(other, others)
    session = renderer.prepare(list(values), None)
    session.tangent_moment(values, session.image(values, SampleRequest(0, 4, 6)).paths, values)
    after = gradients(renderer, values), gradients(other, others)
    assert np.abs(np.array(before)).min() > 0
    np.testing.assert_allclose(np.array(after), np.array(before), rtol=1e-5)
