"""`stock` is the loop that people have: the same gradients, the same steps, and it resumes like the others."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from backends import LAMP, TEXTURE, problem, surface

import unrender as ur
from unrender.core import arrays
from unrender.core.random import Key
from unrender.estimators.base import Estimate
from unrender.estimators.path import StockGradient
from unrender.methods import method


@pytest.mark.cpu("atomic additions of a GPU have no order")
@pytest.mark.usefixtures("one_thread")
def test_its_gradient_is_that_of_mitsubas_own_functions() -> None:
    asked, key = problem(), Key(5, 3)
    start = asked.initial()
    estimator = StockGradient(spp=4)
    state = estimator.init(asked, start)
    found, _ = estimator.estimate(asked, start, state, key)
    again, _ = estimator.estimate(asked, start, state, key)

    # Unmerged, as `unrender` loads it: for the same shapes in the same order.
    scene = mi.load_dict({**surface(), "integrator": {"type": "prb", "max_depth": 3}}, optimize=False, parallel=False)
    params = mi.traverse(scene)
    own: dict[str, Any] = {TEXTURE: mi.TensorXf(start[TEXTURE]), LAMP: mi.Color3f(*start[LAMP].numpy().tolist())}
    dr.enable_grad(own)
    for name, value in own.items():
        params[name] = value
    params.update()
    seeds = (key.fold(0).fold(0).uint32(), key.fold(0).fold(1).uint32())
    image = mi.render(scene, params, spp=4, seed=mi.UInt32(seeds[0]), seed_grad=seeds[1])
    loss = dr.mean(dr.square(image - asked.reference(0)), axis=None)
    dr.backward(loss)

    assert found.loss == pytest.approx(arrays.number(dr.detach(loss)), rel=1e-5)
    np.testing.assert_allclose(found.gradient[TEXTURE].numpy(), dr.grad(own[TEXTURE]).numpy(), rtol=1e-4, atol=1e-9)
    np.testing.assert_allclose(found.gradient[LAMP].numpy(), np.ravel(dr.grad(own[LAMP]).numpy()), rtol=1e-4)
    np.testing.assert_array_equal(found.gradient[TEXTURE].numpy(), again.gradient[TEXTURE].numpy())
    assert np.abs(found.gradient[TEXTURE].numpy()).max() > 1e-6
    assert found.info["samples"] == 2 * 4 * 8 * 8


def test_alpha_of_the_film_is_left_out() -> None:
    """Films with alpha are common, and references have none."""
    described = surface()
    wall = {name: described[name] for name in ("type", "back", "sky")}
    seen = {}
    for pixel_format in ("rgb", "rgba"):
        film = {**described["sensor"]["film"], "pixel_format": pixel_format}
        scene = {**wall, "sensor": {**described["sensor"], "film": film}}
        asked = ur.Problem(scene, [ur.Parameter(TEXTURE, initial=0.5)], [ur.View(np.full((8, 8, 3), 0.3))], max_depth=2)
        start, estimator = asked.initial(), StockGradient(spp=4)
        found, _ = estimator.estimate(asked, start, estimator.init(asked, start), Key(5, 3))
        assert found.info["images"][0].shape == (8, 8, 3)
        seen[pixel_format] = found
    assert seen["rgba"].loss == pytest.approx(seen["rgb"].loss, rel=1e-5)
    ours, theirs = (seen[each].gradient[TEXTURE].numpy() for each in ("rgba", "rgb"))
    np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-9)


def test_its_steps_are_those_of_mitsubas_adam() -> None:
    rng = np.random.default_rng(0)
    theirs, ours = mi.ad.Adam(lr=0.03), ur.optimizers.Adam(0.03)
    theirs["x"] = mi.Float([0.1, 0.5, 0.9])
    x = {"x": mi.TensorXf(np.array([0.1, 0.5, 0.9], np.float32))}
    state = ours.init(x)
    for _ in range(10):
        gradient = rng.normal(size=3).astype(np.float32)
        dr.set_grad(theirs["x"], mi.Float(gradient))
        theirs.step()
        steps, state = ours.update(Estimate(0.0, {"x": mi.TensorXf(gradient)}), state, x)
        x = {"x": x["x"] + steps["x"]}
        np.testing.assert_allclose(x["x"].numpy(), np.ravel(theirs["x"].numpy()), rtol=1e-4, atol=1e-6)


@pytest.mark.slow
@pytest.mark.usefixtures("one_thread")
def test_it_resumes_as_if_nothing_had_been(tmp_path: Path) -> None:
    estimator, optimizer = method("stock").start({"spp": "2", "learning_rate": "0.05"})
    assert (estimator, optimizer) == (StockGradient(2), ur.optimizers.Adam(0.05))
    whole = ur.optimize(problem((TEXTURE,)), estimator, optimizer, steps=6)
    ur.optimize(problem((TEXTURE,)), estimator, optimizer, steps=3, run_directory=tmp_path / "run")
    found = ur.resume(tmp_path / "run", problem=problem((TEXTURE,)), steps=6)
    assert found.steps == 6
    assert (found.parameters[TEXTURE] != found.initial[TEXTURE]).any()
    np.testing.assert_array_equal(found.parameters[TEXTURE], whole.parameters[TEXTURE])
