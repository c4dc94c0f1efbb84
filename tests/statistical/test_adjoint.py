# Dr.Jit's stubs know less than its functions return.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportReturnType=false

"""The adjoint against finite differences of the pair's previous image on the very same paths, for BSDFs of every kind.

On one set of paths the previous image is a smooth function of the previous state, and path replay is its exact derivative:
the two agree to rounding and truncation, seed by seed, with no noise in between.
"""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from zoo import ALL, DEPTH, SIZE, scene, size, spp, subject, two_states

from tiers import slow
from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.renderer import SampleRequest

STEP = 4e-3


def total(image: Any, weight: np.ndarray) -> float:
    return float((np.array(image).astype(np.float64) * weight).sum())


def derivative_on_the_same_paths(
    renderer: MitsubaRenderer,
    current: dict[str, Any],
    key: str,
    request: SampleRequest,
    weight: np.ndarray,
    step: float = STEP,
) -> float:
    """d/ds of sum(weight * image) for the parameter `key` at (1 + s) times its value, at s = 0."""
    session, values = renderer.prepare(list(current), "path"), []
    for side in (1 + step, 1 - step):
        pair = session.image_pair(current, {**current, key: current[key] * side}, request, "path")
        assert pair.previous is not None
        values.append(total(pair.previous[0], weight))
    return (values[0] - values[1]) / (2 * step)


@pytest.mark.slow  # in the quick tier, test_adjoint_pair.py compares the same replay
def test_the_adjoint_is_the_derivative_of_the_image_on_its_paths() -> None:
    description, changes = subject(ALL)
    renderer = MitsubaRenderer(description, DEPTH)
    current, _ = two_states(renderer, changes)
    session = renderer.prepare(list(current), "path")
    request = SampleRequest(0, spp(ALL), 7)
    weight = np.random.default_rng(2).uniform(0.5, 1.5, (size(ALL), size(ALL), 3))
    paths = session.image(current, request).paths
    gradient = session.adjoint(current, paths, renderer.array(weight[None]))
    for key in current:
        expected = derivative_on_the_same_paths(renderer, current, key, request, weight)
        found = float((np.array(gradient[key]).astype(np.float64) * np.array(current[key])).sum())
        assert expected != 0
        assert found == pytest.approx(expected, rel=0.02), key


def dents() -> Any:
    """A normal map with directions of length 1."""
    beside = np.random.default_rng(4).uniform(-0.4, 0.4, (4, 4, 2))
    values = np.concatenate([beside, np.sqrt(1 - (beside**2).sum(-1, keepdims=True))], axis=-1)
    return {"type": "bitmap", "bitmap": mi.Bitmap((0.5 + 0.5 * values).astype(np.float32)), "raw": True}


@pytest.mark.parametrize(
    "inner", [{"type": "roughconductor", "alpha": 0.3}, slow({"type": "twosided", "b": {"type": "diffuse"}})]
)
def test_the_gradient_of_a_normal_map_and_a_planted_fault_of_three_per_cent(inner: dict[str, Any]) -> None:
    renderer = MitsubaRenderer(scene({"type": "normalmap", "normalmap": dents(), "b": inner}), DEPTH)
    key = "ball.bsdf.normalmap.data"
    current, request = renderer.values([key]), SampleRequest(0, 64, 7)
    session = renderer.prepare([key], "path")
    weight = np.random.default_rng(2).uniform(0.5, 1.5, (SIZE, SIZE, 3)) * np.linspace(0, 2, SIZE)[:, None]
    paths = session.image(current, request).paths
    gradient = np.array(session.adjoint(current, paths, renderer.array(weight[None]))[key]).astype(np.float64)
    found = float((gradient * np.array(current[key])).sum())
    # Few samples pass the horizon of a normal within so small a step, which makes them black.
    expected = derivative_on_the_same_paths(renderer, current, key, request, weight, 1e-4)
    assert found == pytest.approx(expected, rel=0.01)
    assert 1.03 * found != pytest.approx(expected, rel=0.01)


def test_halves_are_weighted_each_by_its_own() -> None:
    """Weights of the one group must reach the paths of that group alone."""
    renderer = MitsubaRenderer(scene({"type": "diffuse"}), DEPTH)
    key = "floor.bsdf.reflectance.data"
    session = renderer.prepare([key], None)
    current = renderer.values([key])
    one, none = np.ones((SIZE, SIZE, 3)), np.zeros((SIZE, SIZE, 3))
    paths = session.image(current, SampleRequest(0, 8, 3, 2)).paths
    halves = [
        np.array(session.adjoint(current, paths, renderer.array(np.stack(w)))[key]) for w in ((one, none), (none, one))
    ]
    both = np.array(session.adjoint(current, paths, renderer.array(np.stack((one, one))))[key])
    assert not np.allclose(halves[0], halves[1], rtol=1e-3)
    np.testing.assert_allclose(halves[0] + halves[1], both, rtol=1e-3, atol=1e-3 * np.abs(both).max())


def test_repeating_repeats_the_image_to_the_bit_and_the_gradient_to_rounding() -> None:
    """Threads add to the gradient in the order they finish: its bits repeat with one thread only."""
    renderer = MitsubaRenderer(scene({"type": "diffuse"}), DEPTH)
    key = "floor.bsdf.reflectance.data"
    session = renderer.prepare([key], None)
    current = renderer.values([key])
    weight = renderer.array(np.ones((1, SIZE, SIZE, 3)))
    requests = [session.image(current, SampleRequest(0, 4, 9)) for _ in range(3)]
    images = [np.array(request.images[0]) for request in requests]
    gradients = [np.array(session.adjoint(current, request.paths, weight)[key]) for request in requests]
    for image, gradient in zip(images[1:], gradients[1:], strict=True):
        assert np.array_equal(images[0], image)
        np.testing.assert_allclose(gradient, gradients[0], rtol=1e-4, atol=1e-5 * np.abs(gradients[0]).max())


def test_gradients_agree_with_mitsuba_prb() -> None:
    """Our path replay and Mitsuba's `prb` estimate the same derivative of the mean image with respect to a colour."""
    renderer = MitsubaRenderer(
        scene({"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.5, 0.4, 0.3]}}), DEPTH
    )
    key = next(k for k in renderer.parameters() if k.startswith("ball") and k.endswith("reflectance.value"))
    session = renderer.prepare([key], None)
    current = renderer.values([key])
    weight = renderer.array(np.full((1, SIZE, SIZE, 3), 1 / SIZE**2))
    ours = np.stack(
        [
            np.array(session.adjoint(current, session.image(current, SampleRequest(0, 64, s)).paths, weight)[key])
            for s in range(12)
        ]
    )
    import drjit as dr

    prb = mi.load_dict({"type": "prb", "max_depth": DEPTH})
    parameters = mi.traverse(renderer.pair.previous)
    theirs = []
    for seed in range(12):
        leaf = mi.Color3f(dr.detach(parameters[key]))
        dr.enable_grad(leaf)
        parameters[key] = leaf
        parameters.update()
        image = mi.render(renderer.pair.previous, parameters, integrator=prb, spp=64, seed=50 + seed)
        dr.backward(dr.sum(image, axis=None) / SIZE**2)
        theirs.append(np.array(dr.grad(leaf)).reshape(-1))
    a, b = ours.astype(np.float64), np.stack(theirs).astype(np.float64)
    z = (a.mean(0) - b.mean(0)) / np.sqrt(a.var(0, ddof=1) / 12 + b.var(0, ddof=1) / 12)
    assert np.abs(z).max() < 4.5, z
