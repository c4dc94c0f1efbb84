# Dr.Jit's stubs know less than its functions return.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportOptionalMemberAccess=false

"""Samples that are not finite: where they came from, and what becomes of them."""

from __future__ import annotations

import logging
from typing import Any

import fog
import mitsuba as mi
import numpy as np
import pytest
from nonfinite_hunt import hunt, subjects
from zoo import DEPTH, MATERIALS, SIZE, scene

from unrender.rendering.mitsuba.integrators.emitters import mis_weight
from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.renderer import SampleRequest


def test_weights_of_huge_densities_are_finite_and_sum_to_one() -> None:
    densities = np.array([0, 1e-15, 1, 2, 1e19, 1e30, np.inf], np.float32)
    a, b = (mi.Float(x.ravel()) for x in np.meshgrid(densities, densities))
    weight, other = mis_weight(a, b).numpy(), mis_weight(b, a).numpy()
    assert np.isfinite(weight).all()
    some = np.maximum(a.numpy(), b.numpy()) > 0
    np.testing.assert_allclose((weight + other)[some], 1, atol=1e-6)
    # A lamp seen edge-on: the density's square is no single-precision number.
    assert mis_weight(mi.Float(1e20), mi.Float(0)).numpy()[0] == 1
    np.testing.assert_allclose(mis_weight(mi.Float(2), mi.Float(1)).numpy()[0], 0.8, rtol=1e-6)


KEY = "floor.bsdf.reflectance.data"
SPP = 16


def broken(renderer: MitsubaRenderer) -> tuple[dict[str, Any], dict[str, Any]]:
    """The scene's own state, and one with a texel that is no number."""
    good = renderer.values([KEY])
    values = np.array(good[KEY])
    values[3, 4] = np.nan
    return good, {KEY: renderer.array(values)}


def test_samples_that_are_not_finite_are_dropped_counted_and_reported(caplog: pytest.LogCaptureFixture) -> None:
    """In every pass; and an image of the remaining samples is as before where no sample was dropped."""
    renderer = MitsubaRenderer(scene(MATERIALS["diffuse"][0]()), DEPTH)
    good, bad = broken(renderer)
    session, request = renderer.prepare([KEY], "path"), SampleRequest(0, SPP, 5, 2)
    weight = renderer.array(np.ones((2, SIZE, SIZE, 3)))
    whole = session.image(good, request)
    assert session.dropped.count == 0
    with caplog.at_level(logging.WARNING, "unrender"):
        found = session.image(bad, request)
        dropped = session.dropped.count
    assert 0 < dropped < SPP * SIZE**2
    assert f"samples of a picture are not finite; {dropped} of" in caplog.text
    images, expected = np.array(found.images), np.array(whole.images)
    assert np.isfinite(images).all()
    lost = ~np.isfinite(np.array([found.paths.radiance[channel].numpy() for channel in range(3)])).all(axis=0)
    assert lost.sum() == dropped
    untouched = ~lost.reshape(SIZE, SIZE, 2, -1).any(axis=-1).transpose((2, 0, 1))
    assert untouched.any()
    np.testing.assert_allclose(images[untouched], expected[untouched], rtol=1e-5)
    for current, previous in ((good, bad), (bad, good)):
        pair = session.image_pair(current, previous, request, "path")
        assert np.isfinite([np.array(pair.images), np.array(pair.previous)]).all()
        for tree in session.adjoint_pair(current, previous, pair.paths, weight, weight):
            assert np.isfinite(np.array(tree[KEY])).all()
            assert np.abs(np.array(tree[KEY])).max() > 0
    gradient = np.array(session.adjoint(bad, found.paths, weight)[KEY])
    assert np.isfinite(gradient).all()
    assert np.abs(gradient).max() > 0
    tangents = {KEY: renderer.array(np.ones(np.shape(np.array(good[KEY]))))}
    assert np.isfinite(np.array(session.tangent_moment(bad, session.image(bad, request).paths, tangents))).all()


def test_a_batch_of_states_drops_what_is_not_finite() -> None:
    renderer = MitsubaRenderer(scene(MATERIALS["diffuse"][0]()), DEPTH)
    good, bad = broken(renderer)
    session = renderer.prepare([KEY], None, derivatives=False)
    stack = {KEY: np.stack([np.array(good[KEY]), np.array(bad[KEY])])}
    images = np.array(session.image_batch(stack, SampleRequest(0, SPP, 5)))
    assert np.isfinite(images).all()
    assert session.dropped.count > 0


@pytest.mark.slow
@pytest.mark.cpu("texture units spread a NaN of a grid, and its gradient is NaN")
def test_media_drop_what_is_not_finite() -> None:
    renderer = MitsubaRenderer(fog.scene(fog.cloud()), fog.DEPTH)
    key = next(key for key in renderer.parameters() if key.endswith("albedo.data"))
    good = renderer.values([key])
    values = np.array(good[key])
    values[4, 4, 4] = np.nan
    session, request = renderer.prepare([key], "path"), SampleRequest(0, SPP, 5)
    pair = session.image_pair({key: renderer.array(values)}, good, request, "path")
    assert session.dropped.count > 0
    assert np.isfinite([np.array(pair.images), np.array(pair.previous)]).all()
    weight = renderer.array(np.ones((1, fog.SIZE, fog.SIZE, 3)))
    for tree in session.adjoint_pair({key: renderer.array(values)}, good, pair.paths, weight, weight):
        assert np.abs(np.array(tree[key])).max() > 0


SEARCHED = ("material: diffuse", "material: principled", "emitter: rectangle and environment", "medium: cloud")


@pytest.mark.slow
@pytest.mark.parametrize("name", SEARCHED)
def test_no_path_of_the_zoo_is_lost(name: str) -> None:
    """A small edition of `nonfinite_hunt.py`, which takes any number of paths."""
    assert list(hunt(name, subjects()[name], 1 << 20)) == []
    assert list(hunt(name, subjects()[name], 1 << 16, replays=True)) == []


def test_the_search_finds_a_planted_path() -> None:
    def broken() -> dict[str, Any]:
        found = scene(MATERIALS["diffuse"][0]())
        values = np.full((8, 8, 3), 0.5, np.float32)
        values[3, 4] = np.nan
        found["floor"]["bsdf"]["reflectance"]["bitmap"] = mi.Bitmap(values)
        return found

    lines = list(hunt("planted", broken, 1 << 14))
    assert lines
    assert all(line.startswith("planted: image, seed 0") for line in lines)
