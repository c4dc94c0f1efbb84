# Dr.Jit's stubs know less than its functions return.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportReturnType=false

"""The adjoint of two states on one set of paths: the current one's is the ordinary adjoint, the previous one's is the derivative of
the previous image on those paths, for BSDFs of every kind; and in the mean it is the previous scene's own."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from test_adjoint import STEP, total
from zoo import ALL, DEPTH, EACH, LIGHTS, MATERIALS, SIZE, scene, size, spp, subject, two_states

from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.renderer import SampleRequest


def close(a: Any, b: Any, rel: float) -> bool:
    a, b = np.array(a), np.array(b)
    return bool(np.abs(a - b).max() <= rel * np.abs(b).max())


@pytest.mark.parametrize("name", EACH)
def test_the_previous_state_s_adjoint_is_the_derivative_of_its_image_on_the_shared_paths(name: str) -> None:
    description, changes = subject(name)
    renderer = MitsubaRenderer(description, DEPTH)
    current, previous = two_states(renderer, changes)
    session = renderer.prepare(list(current), "path")
    request = SampleRequest(0, spp(name), 7)
    rng = np.random.default_rng(2)
    weight, weight_previous = rng.uniform(0.5, 1.5, (2, size(name), size(name), 3))
    pair = session.image_pair(current, previous, request, "path")
    arrays = renderer.array(weight[None]), renderer.array(weight_previous[None])
    gradient, gradient_previous = session.adjoint_pair(current, previous, pair.paths, *arrays)
    alone = session.adjoint(current, session.image(current, request).paths, arrays[0])
    for key in current:
        assert close(gradient[key], alone[key], 1e-3), key
        sides = []
        for side in (1 + STEP, 1 - STEP):
            moved = {**previous, key: previous[key] * side}
            image = session.image_pair(current, moved, request, "path").previous
            assert image is not None
            sides.append(total(image[0], weight_previous))
        expected = (sides[0] - sides[1]) / (2 * STEP)
        found = float((np.array(gradient_previous[key]).astype(np.float64) * np.array(previous[key])).sum())
        assert expected != 0
        assert found == pytest.approx(expected, rel=0.02), key


@pytest.mark.slow
def test_equal_states_have_equal_gradients() -> None:
    material, changes = MATERIALS[next(iter(MATERIALS))]
    renderer = MitsubaRenderer(scene(material()), DEPTH)
    current, _ = two_states(renderer, {**changes, **LIGHTS})
    session = renderer.prepare(list(current), "path")
    weight = renderer.array(np.random.default_rng(3).uniform(0.5, 1.5, (2, SIZE, SIZE, 3)))
    for space in ("path", "primary"):
        pair = session.image_pair(current, current, SampleRequest(0, 4, 7, groups=2), space)
        a, b = session.adjoint_pair(current, current, pair.paths, weight, weight)
        assert all(close(a[key], b[key], 1e-4) for key in current), space


@pytest.mark.slow
def test_in_primary_space_each_state_has_its_own_adjoint() -> None:
    """That of the previous scene is what the current one gives at the same parameters and random numbers, to rounding."""
    description, changes = subject(ALL)
    renderer = MitsubaRenderer(description, DEPTH)
    current, previous = two_states(renderer, changes)
    session = renderer.prepare(list(current), "primary")
    weight = renderer.array(np.random.default_rng(4).uniform(0.5, 1.5, (2, size(ALL), size(ALL), 3)))
    request = SampleRequest(0, 8, 5, groups=2)
    pair = session.image_pair(current, previous, request, "primary")
    _, found = session.adjoint_pair(current, previous, pair.paths, weight, weight)
    alone = session.adjoint(previous, session.image(previous, request).paths, weight)
    for key in current:
        assert np.abs(np.array(alone[key])).max() > 0
        assert close(found[key], alone[key], 2e-3), key


@pytest.mark.slow
def test_in_path_space_the_mean_is_the_previous_scene_s_own() -> None:
    """Per parameter, over many seeds, against the ordinary adjoint at the previous state; a planted tenth is seen."""
    material, changes = MATERIALS["rough conductor"]
    renderer = MitsubaRenderer(scene(material()), DEPTH)
    current, previous = two_states(renderer, {**changes, **LIGHTS})
    session = renderer.prepare(list(current), "path")
    weight = renderer.array(np.random.default_rng(4).uniform(0.5, 1.5, (1, SIZE, SIZE, 3)))

    def means(tree: dict[str, Any]) -> np.ndarray:
        return np.array([np.array(tree[key]).astype(np.float64).mean() for key in current])

    shared, own = [], []
    for seed in range(64):
        pair = session.image_pair(current, previous, SampleRequest(0, 16, 2 * seed), "path")
        shared.append(means(session.adjoint_pair(current, previous, pair.paths, weight, weight)[1]))
        paths = session.image(previous, SampleRequest(0, 16, 2 * seed + 1)).paths
        own.append(means(session.adjoint(previous, paths, weight)))
    a, b = np.array(shared), np.array(own)
    error = np.sqrt(a.var(0, ddof=1) / len(a) + b.var(0, ddof=1) / len(b))
    assert (np.abs(a.mean(0) - b.mean(0)) < 4 * error).all()
    seen = np.abs(1.1 * a.mean(0) - b.mean(0)) > 4 * error
    assert seen.sum() >= 2, "too noisy to see a tenth"
