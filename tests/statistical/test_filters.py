# Dr.Jit's stubs know less than its functions return.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false

"""Reconstruction filters: images and derivatives against what `mi.render` converges to, and faults that these tests must see."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from scipy import stats
from test_boundary import LIMIT, block, differences, gradients, scores
from test_camera_motion import glowing, sunlit
from zscores import z_scores

from tiers import quick
from unrender.rendering.mitsuba.pixel_filter import PixelFilters
from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.renderer import SampleRequest

KEY = "wall.bsdf.reflectance.data"
RUNS, SPP, DEPTH = 12, 512, 3
WIDTH, HEIGHT = 8, 6


def wall(rfilter: dict[str, Any], **film: Any) -> Callable[[], dict[str, Any]]:
    """A painted wall under an even sky, which the picture's borders cut: no pixel is nearly without noise."""

    def described() -> dict[str, Any]:
        picture = np.random.default_rng(1).random((17, 19, 3)).astype(np.float32) ** 2
        texture = {
            "type": "bitmap", "raw": True, "format": "variant", "data": mi.TensorXf(picture),
        }  # fmt: skip
        place = mi.ScalarTransform4f().look_at(origin=[0.3, 0, 4], target=[0.3, 0, 0], up=[0, 1, 0])
        size = {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT}
        return {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": DEPTH},
            "sensor": {"type": "perspective", "fov": 35, "to_world": place, "film": size | film | {"rfilter": rfilter}},
            "sky": {"type": "constant"},
            "wall": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().scale(3),
                "bsdf": {"type": "diffuse", "reflectance": texture},
            },
        }

    return described


CASES = {
    "gaussian": wall({"type": "gaussian"}),
    "tent": wall({"type": "tent", "radius": 1.3}),
    "mitchell": wall({"type": "mitchell"}),
    "lanczos": wall({"type": "lanczos"}),
    "catmullrom": wall({"type": "catmullrom"}),
    "wide": wall({"type": "gaussian", "stddev": 0.9}),
    "border": wall({"type": "gaussian"}, sample_border=True),
    "crop": wall({"type": "gaussian"}, crop_offset_x=2, crop_offset_y=1, crop_width=3, crop_height=4),
}
each = pytest.mark.parametrize("name", quick(CASES, "gaussian"))


def theirs(described: Callable[[], dict[str, Any]], shift: Any = None) -> np.ndarray:
    """(RUNS, H, W, 3) by `mi.render`; `shift` is added to the texture."""
    scene = mi.load_dict(described())
    if shift is not None:
        parameters: Any = mi.traverse(scene)
        parameters[KEY] = mi.TensorXf(parameters[KEY] + mi.TensorXf(shift.astype(np.float32)))
        parameters.update()
    return np.array([np.array(mi.render(scene, spp=SPP, seed=run)) for run in range(RUNS)], float)


def ours(described: Callable[[], dict[str, Any]]) -> np.ndarray:
    renderer = MitsubaRenderer(described)
    assert renderer.notices == ()
    session, values = renderer.prepare([KEY], None), renderer.values([KEY])
    return np.array([session.image(values, SampleRequest(0, SPP, 100 + run)).images[0] for run in range(RUNS)], float)


def worst(a: np.ndarray, b: np.ndarray) -> tuple[float, float]:
    """The largest score of all pixels and of the whole picture's mean, and the limit at 0.001 after Šidák."""
    means = [np.tensordot(x, np.linspace(0.5, 1.5, x[0].size).reshape(x[0].shape), 3)[:, None] for x in (a, b)]
    found = np.concatenate([z_scores(a, b).ravel(), z_scores(*means).ravel()])
    return float(np.abs(found).max()), float(stats.norm.isf((1 - (1 - 1e-3) ** (1 / found.size)) / 2))


@each
def test_images_are_those_of_mitsuba(name: str) -> None:
    score, limit = worst(ours(CASES[name]), theirs(CASES[name]))
    assert score < limit


def test_a_shift_of_half_a_pixel_a_factor_and_a_box_are_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    expected, found = theirs(CASES["gaussian"]), ours(CASES["gaussian"])
    sample = PixelFilters.sample

    def shifted(*given: Any) -> tuple[Any, Any]:
        offset, weight = sample(*given)
        return offset + 0.5, weight

    monkeypatch.setattr(PixelFilters, "sample", shifted)
    for faulty in (1.03 * found, ours(CASES["gaussian"]), ours(wall({"type": "box"}))):
        score, limit = worst(faulty, expected)
        assert score > limit


@each
def test_gradients_are_derivatives_of_mitsuba_s_images(name: str) -> None:
    """Images are linear in the texture, so a difference is exact."""
    described, numbers = CASES[name], np.random.default_rng(2)
    renderer = MitsubaRenderer(described)
    session, values = renderer.prepare([KEY], None), renderer.values([KEY])
    along = 0.1 * numbers.uniform(0.5, 1.5, values[KEY].shape)
    weights = numbers.uniform(0.5, 1.5, (1, *renderer.resolutions()[0], 3)) * np.linspace(0.2, 1, 3)
    found = []
    for run in range(RUNS):
        paths = session.image(values, SampleRequest(0, SPP, 300 + run)).paths
        gradient = session.adjoint(values, paths, renderer.array(weights))[KEY]
        found.append(np.sum(np.array(gradient) * along))
    images = theirs(described, along) - theirs(described, -along)
    expected = np.tensordot(images, weights[0], 3) / 2
    assert np.abs(z_scores(np.array(found)[:, None], expected[:, None])).max() < stats.norm.isf(5e-4)
    if name == "gaussian":
        assert np.abs(z_scores(1.03 * np.array(found)[:, None], expected[:, None])).max() > stats.norm.isf(5e-4)


def test_pixels_of_a_mini_batch_have_the_samples_that_they_have_in_the_whole() -> None:
    def two() -> dict[str, Any]:
        found = CASES["gaussian"]()
        found["other"] = found["sensor"] | {"film": found["sensor"]["film"] | {"rfilter": {"type": "lanczos"}}}
        return found | {"third": found["sensor"] | {"film": found["sensor"]["film"] | {"rfilter": {"type": "box"}}}}

    renderer = MitsubaRenderer(two)
    session, values = renderer.prepare([KEY], None), renderer.values([KEY])
    chosen = np.array([0, 5, 17, 40, 47])
    for sensor in range(3):
        request = SampleRequest(0, 4, 7, 1, mi.UInt32(chosen), mi.UInt32([sensor] * 5), mi.UInt32(chosen))
        part = session.image(values, request).images
        every = np.arange(WIDTH * HEIGHT)
        alike = SampleRequest(0, 4, 7, 1, mi.UInt32(every), mi.UInt32([sensor] * len(every)), mi.UInt32(every))
        np.testing.assert_allclose(part[0], np.array(session.image(values, alike).images[0])[chosen], rtol=1e-5)


def test_both_states_of_a_pair_are_filtered() -> None:
    renderer = MitsubaRenderer(CASES["gaussian"])
    session, values = renderer.prepare([KEY], "path"), renderer.values([KEY])
    halved = {KEY: values[KEY] * 0.5}
    found = session.image_pair(halved, values, SampleRequest(0, 64, 3), "path")
    for images, state in ((found.images, halved), (found.previous, values)):
        alone = session.image(state, SampleRequest(0, 64, 3)).images
        np.testing.assert_allclose(np.array(images), np.array(alone), rtol=1e-4, atol=1e-4)


@pytest.mark.slow
def test_hidden_emitters_are_those_that_mitsuba_hides() -> None:
    def described() -> dict[str, Any]:
        found = CASES["gaussian"]()
        lamp = {"type": "area", "radiance": {"type": "rgb", "value": [4, 5, 3]}}
        ball = mi.ScalarTransform4f().translate([0.3, 0.2, 0.8]).scale(0.3)
        pane = mi.ScalarTransform4f().translate([0.4, 0.3, 1.6]).scale(0.3)
        return found | {
            "integrator": {"type": "path", "max_depth": DEPTH, "hide_emitters": True},
            "ball": {"type": "sphere", "to_world": ball, "emitter": lamp},
            "pane": {"type": "rectangle", "to_world": pane, "emitter": lamp},
        }

    score, limit = worst(ours(described), theirs(described))
    assert score < limit


def filtered(description: Callable[[], dict[str, Any]], kind: str, **film: Any) -> Callable[[], dict[str, Any]]:
    def described() -> dict[str, Any]:
        found = description()
        found["sensor"]["film"] |= {"rfilter": {"type": kind}, **film}
        return found

    return described


@pytest.mark.slow
@pytest.mark.parametrize(
    ("description", "key", "depth", "step", "kind", "film"),
    [
        (glowing, "sensor.rotation.y", 1, 0.003, "gaussian", {}),
        (glowing, "sensor.translation.x", 1, 0.005, "gaussian", {}),
        (glowing, "sensor.x_fov", 1, 0.1, "mitchell", {"sample_border": True}),
        (sunlit, "sensor.translation.z", 2, 0.01, "gaussian", {}),
        (block, "moving.translation.x", 2, 0.01, "gaussian", {}),
        (block, "moving.rotation.z", 2, 0.01, "lanczos", {}),
    ],
)
def test_what_moves_is_filtered(
    description: Any, key: str, depth: int, step: float, kind: str, film: dict[str, Any]
) -> None:
    made = filtered(description, kind, **film)
    found, expected = gradients(made, key, depth, 96), differences(made, key, depth, 1024, step)
    assert np.abs(scores(found, expected)).max() < LIMIT, (found.mean(axis=0), expected.mean(axis=0))


@pytest.mark.slow
def test_squared_boundary_derivatives_have_the_filter_s_reach() -> None:
    """Along a tangent, the pictures of a block with a wider filter change further away from its edges."""
    reached = []
    for kind in ("box", "gaussian"):
        renderer = MitsubaRenderer(filtered(block, kind), 2, ["moving.translation.x"])
        key = "moving.translation.x"
        session, values = renderer.prepare([key], None), renderer.values([key])
        paths = session.image(values, SampleRequest(0, 16, 1)).paths
        moment = session.tangent_moment(values, paths, {key: renderer.array(np.ones(()))})
        reached.append(int(np.count_nonzero(np.array(moment).sum(axis=-1))))
    assert reached[1] > 1.3 * reached[0]
