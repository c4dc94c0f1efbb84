"""What a scene keeps of large parameters: no gradient after a pass, no second copy of a texture, its own values once for all."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import unrender as ur
from unrender.core import memory
from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.renderer import SampleRequest

KEY = "wall.bsdf.reflectance.data"
REQUEST = SampleRequest(0, 2, 1, 2)


def scene() -> dict[str, Any]:
    texels = mi.Bitmap(np.linspace(0.2, 0.8, 8 * 8 * 3, dtype=np.float32).reshape(8, 8, 3))
    return {
        "type": "scene",
        "camera": {
            "type": "perspective",
            "to_world": mi.ScalarTransform4f().look_at(origin=[0, 0, 3], target=[0, 0, 0], up=[0, 1, 0]),
            "film": {"type": "hdrfilm", "width": 6, "height": 6, "rfilter": {"type": "box"}},
        },
        "wall": {
            "type": "rectangle",
            "bsdf": {"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": texels, "raw": True}},
        },
        "sky": {"type": "constant"},
    }


@pytest.fixture
def renderer(monkeypatch: pytest.MonkeyPatch) -> MitsubaRenderer:
    monkeypatch.setattr(memory, "LARGE", 100)
    return MitsubaRenderer(scene, 2)


def weights(renderer: MitsubaRenderer) -> mi.TensorXf:
    return mi.TensorXf(renderer.array(np.ones((2, 6, 6, 3), np.float32)))


def test_textures_hold_the_parameter_itself(renderer: MitsubaRenderer) -> None:
    session, values = renderer.prepare([KEY], None), {KEY: renderer.array(np.full((8, 8, 3), 0.5, np.float32))}
    paths = session.image(values, REQUEST).paths
    session.adjoint(values, paths, weights(renderer))
    loaded = renderer.pair.loaded()
    held: Any = loaded.parameters[KEY]
    assert held.array.index == values[KEY].array.index
    assert not loaded.parameters.nodes_to_update


def test_gradients_are_handed_over(renderer: MitsubaRenderer) -> None:
    session, values = renderer.prepare([KEY], None), renderer.values([KEY])
    paths = session.image(values, REQUEST).paths
    gradient = session.adjoint(values, paths, weights(renderer))[KEY]
    leaf = renderer.pair.loaded().leaves[KEY]
    assert np.abs(gradient.numpy()).max() > 0
    assert not dr.grad(leaf).numpy().any()


def test_the_previous_state_has_no_gradient_that_nobody_asks_for(renderer: MitsubaRenderer) -> None:
    session, values = renderer.prepare([KEY], "path"), renderer.values([KEY])
    moved = {KEY: values[KEY] * 0.9}
    paths = session.image_pair(values, moved, REQUEST, "path").paths
    alone = session.adjoint(values, paths, weights(renderer))
    assert not renderer.pair.loaded(previous=True).leaves
    both = session.adjoint_pair(values, moved, paths, weights(renderer), weights(renderer))
    assert set(renderer.pair.loaded(previous=True).leaves) == {KEY}
    np.testing.assert_allclose(alone[KEY].numpy(), both[0][KEY].numpy(), rtol=1e-5, atol=1e-9)
    assert np.abs(both[1][KEY].numpy()).max() > 0


@pytest.mark.cpu("NumPy does not see the memory of a GPU")
def test_both_loads_and_the_problem_share_the_values_that_were_loaded(renderer: MitsubaRenderer) -> None:
    pair = renderer.pair
    assert pair.loaded()._own[KEY].array.index == pair.loaded(previous=True)._own[KEY].array.index
    picture = np.full((6, 6, 3), 0.3, np.float32)
    problem = ur.Problem(renderer, [ur.Parameter(KEY)], [ur.View(picture)])
    assert np.shares_memory(problem.unknowns[KEY].initial, pair.loaded()._own[KEY].numpy())
    assert not problem.unknowns[KEY].initial.flags.writeable
    assert problem.initial_values()[KEY].flags.writeable
    result = ur.optimize(problem, ur.PathGradient(spp=2), ur.optimizers.Adam(0.01), steps=2)
    assert np.shares_memory(result.initial[KEY], problem.unknowns[KEY].initial)
    assert (result.parameters[KEY] != result.initial[KEY]).any()


def test_what_a_user_gives_is_copied() -> None:
    given = np.full((8, 8, 3), 0.4, np.float32)
    problem = ur.Problem(scene, [ur.Parameter(KEY, initial=given)], [ur.View(np.full((6, 6, 3), 0.3, np.float32))])
    given[:] = 0.1
    assert problem.unknowns[KEY].initial.min() == pytest.approx(0.4)
