"""Columns that repeat those of the opposite end are no unknowns: they follow, and smoothing goes on across the border."""

from __future__ import annotations

import numpy as np
import pytest
from test_large_steps import matrix

import unrender as ur
from unrender.core import periodic
from unrender.preconditioners.base import Preconditioner
from unrender.scene.coordinates import Coordinates

HEIGHT, WIDTH = 5, 8
X = np.random.default_rng(0).normal(size=(HEIGHT, WIDTH, 3)).astype(np.float32)


def test_padding_and_interior_are_inverse():
    padded = periodic.pad(X, 2)
    assert padded.shape == (HEIGHT, WIDTH + 4, 3)
    np.testing.assert_array_equal(padded[:, :2], X[:, -2:])
    np.testing.assert_array_equal(padded[:, -2:], X[:, :2])
    np.testing.assert_array_equal(periodic.interior(padded, 2), X)
    assert periodic.interior_shape(padded.shape, 2) == X.shape
    assert periodic.repeat(X, 0) is X


def test_a_map_narrower_than_its_padding_goes_around_twice():
    np.testing.assert_array_equal(periodic.pad(X[:, :1], 2), np.repeat(X[:, :1], 5, axis=1))


@pytest.mark.mitsuba
def test_repeats_on_the_device_as_in_numpy():
    import mitsuba as mi

    stale = periodic.pad(X, 1)
    stale[:, [0, -1]] = 9
    np.testing.assert_array_equal(np.array(periodic.repeat(mi.TensorXf(stale), 1)), periodic.repeat(stale, 1))


def root(strength: float) -> np.ndarray:
    """(I + λ L)^(-1/2) of the grid that is closed along its width."""
    values, vectors = np.linalg.eigh(matrix(strength, (HEIGHT, WIDTH), (False, True)).toarray())
    return vectors @ np.diag(values**-0.5) @ vectors.T


def test_sobolev_smooths_across_the_border():
    bound = ur.preconditioners.Sobolev(3.0).on_repeated(1)
    expected = (root(3.0) @ X.reshape(-1, 3)).reshape(X.shape)
    np.testing.assert_allclose(bound.apply(periodic.pad(X, 1)), periodic.pad(expected, 1), atol=1e-5)
    unaware = ur.preconditioners.Sobolev(3.0).apply(periodic.pad(X, 1))[:, 1:-1]
    assert np.abs(unaware - expected).max() > 0.05


def test_its_strength_is_that_of_the_unknown_columns_and_scales():
    bound, plain = ur.preconditioners.Sobolev().on_repeated(1), ur.preconditioners.Sobolev(wrap=(False, True))
    assert bound.strength_of((HEIGHT, WIDTH + 2, 3)) == plain.strength_of(X.shape)
    shares = np.array([1.0, 0.25])
    other = np.random.default_rng(1).normal(size=X.shape).astype(np.float32)
    first, second = periodic.pad(X, 1), periodic.pad(other, 1)
    np.testing.assert_allclose(bound.descents(first, second, shares), plain.descents(X, other, shares), rtol=1e-6)
    np.testing.assert_allclose(
        periodic.interior(bound.scaled(0.5).apply(first), 1), plain.scaled(0.5).apply(X), atol=1e-6
    )


@pytest.mark.parametrize("name", ["Sobolev", "LargeSteps"])
def test_preconditioners_of_environment_maps_are_symmetric_and_turn_with_the_map(name: str):
    bound: Preconditioner = getattr(ur.preconditioners, name)().on_repeated(1)
    bound.check("sky", (HEIGHT, WIDTH + 2, 3))
    y = np.random.default_rng(2).normal(size=X.shape).astype(np.float32)
    smooth = [periodic.interior(bound.apply(periodic.pad(x, 1)), 1) for x in (X, y)]
    assert np.vdot(smooth[0], y) == pytest.approx(np.vdot(X, smooth[1]), rel=1e-4)
    turned = periodic.interior(bound.apply(periodic.pad(np.roll(X, 3, axis=1), 1)), 1)
    np.testing.assert_allclose(turned, np.roll(smooth[0], 3, axis=1), atol=1e-5)


def test_steps_move_the_repeated_columns_along():
    """With the gradient of an image that does not see the repeated columns, which optimizers leave where they are."""
    sky = periodic.pad(np.abs(X) + 1, 1)
    gradient = periodic.pad(X, 1)
    gradient[:, [0, -1]] = 0
    for repeated in ({"sky": 1}, {}):
        coordinates = Coordinates({}, {}, repeated)
        pulled = coordinates.pull_back({"sky": gradient}, {})
        _, moved = coordinates.moved({"sky": sky}, {"sky": -0.1 * pulled["sky"]})
        follows = np.array_equal(moved["sky"], periodic.repeat(moved["sky"], 1))
        assert follows == bool(repeated)


@pytest.mark.mitsuba
def test_repeated_columns_stay_at_a_bound_with_their_own() -> None:
    """Columns of a sky at its bound, black in the reference, between others that become brighter. Repeated ones have no gradient."""
    import mitsuba as mi

    film = {"type": "hdrfilm", "width": 8, "height": 4, "rfilter": {"type": "box"}}
    look = mi.ScalarTransform4f().look_at([0, 0, 0], [0, 0, -1], [0, 1, 0])
    camera = {"type": "perspective", "fov": 150, "to_world": look, "film": film}
    sky = np.abs(X) + 0.5
    sky[:, [0, -1]] = 0.0
    scene = {"type": "scene", "camera": camera, "sky": {"type": "envmap", "bitmap": mi.Bitmap(sky)}}
    reference = np.full((4, 8, 3), 5.0)
    reference[:, 2:6] = 0.0
    smooth = ur.preconditioners.LargeSteps(10.0)
    unknown = ur.Parameter("sky.data", preconditioner=smooth, parameterisation="identity")
    problem = ur.Problem(scene, [unknown], [ur.View(reference)])
    result = ur.optimize(problem, ur.PathGradient(spp=4), ur.optimizers.Adam(0.01), steps=2)
    values = result.last["sky.data"] if result.last else result.parameters["sky.data"]
    np.testing.assert_array_equal(values, periodic.repeat(values, 1))
    assert (values[:, 1:-1] != problem.initial_values()["sky.data"][:, 1:-1]).any()
