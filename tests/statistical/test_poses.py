# Dr.Jit's stubs know less than its functions return.
# pyright: reportArgumentType=false

"""Posed shapes and sensors against scenes in which they were moved for good."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import stats
from zscores import agree, z_scores

import unrender as ur
from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.renderer import SampleRequest

RUNS, SPP, DEPTH = 24, 32, 5
TURN = np.array([0.3, 0.5, -0.2])
"""A rotation vector."""


def motion(centre: list[float], shift: list[float], scale: float = 1.0) -> Any:
    """The matrix of TURN about `centre`, with `scale` and `shift`."""
    angle = float(np.linalg.norm(TURN))
    there = mi.ScalarTransform4f().translate([c + s for c, s in zip(centre, shift, strict=True)])
    turned = there.rotate((TURN / angle).tolist(), np.degrees(angle)).scale(scale)
    return turned.translate([-c for c in centre])


def scene(block: Any = None, ball: tuple[float, float, float] = (-0.45, 0.3, 0.2), camera: Any = None) -> dict:
    """A box lit by a lamp and a sky, a glossy block, a glass ball and a textured one; optionally moved."""
    described = mi.cornell_box()
    del described["small-box"], described["large-box"]
    described["sensor"]["film"] = {"type": "hdrfilm", "width": 32, "height": 32, "rfilter": {"type": "box"}}
    if camera is not None:
        described["sensor"]["to_world"] = camera @ described["sensor"]["to_world"]
    described["sky"] = {"type": "constant", "radiance": {"type": "rgb", "value": 0.3}}
    place = mi.ScalarTransform4f().translate([0.2, 0.1, 0.3]).scale([0.2, 0.35, 0.15])
    described["block"] = {
        "type": "cube",
        "to_world": place if block is None else block @ place,
        "bsdf": {"type": "roughconductor", "alpha_u": 0.1, "alpha_v": 0.4},
    }
    described["ball"] = {"type": "sphere", "center": list(ball), "radius": 0.3, "bsdf": {"type": "dielectric"}}
    return described


def theirs(described: dict) -> np.ndarray:
    path = mi.load_dict({"type": "path", "max_depth": DEPTH})
    loaded = mi.load_dict(described)
    return np.stack([mi.render(loaded, integrator=path, spp=SPP, seed=100 + run).numpy() for run in range(RUNS)])


def ours(parameters: dict[str, Any], keys: list[str] | None = None) -> np.ndarray:
    renderer = MitsubaRenderer(scene, DEPTH)
    session = renderer.prepare(keys or list(parameters), None, derivatives=False)
    stacked = {key: np.asarray(value, np.float64)[None] for key, value in parameters.items()}
    return np.stack([session.image_batch(stacked, SampleRequest(0, SPP, run)).numpy()[0] for run in range(RUNS)])


def test_posed_shapes_look_as_if_they_had_been_moved() -> None:
    shift, scale = [-0.2, 0.25, 0.1], 1.3
    found = ours(
        {
            "block.translation": shift,
            "block.rotation": TURN,
            "block.scale": scale,
            "ball.translation.x": 0.1,
            "ball.translation.y": -0.6,
        }
    )
    moved = theirs(scene(motion([0.2, 0.1, 0.3], shift, scale), (-0.35, -0.3, 0.2)))
    assert agree(found, moved)
    assert not agree(found, theirs(scene(motion([0.2, 0.1, 0.3], shift, 1.0), (-0.35, -0.3, 0.2)))), "unscaled"


@pytest.mark.slow
def test_a_posed_sensor_sees_as_if_it_had_been_moved() -> None:
    shift = [0.2, -0.1, 0.15]
    found = ours({"sensor.translation": shift, "sensor.rotation": 0.2 * TURN, "ball.translation.y": -0.5})
    angle = 0.2 * float(np.linalg.norm(TURN))
    stands = np.array([0, 0, 3.9])
    there = mi.ScalarTransform4f().translate((stands + shift).tolist())
    camera = there.rotate((TURN / np.linalg.norm(TURN)).tolist(), np.degrees(angle)).translate((-stands).tolist())
    assert agree(found, theirs(scene(ball=(-0.45, -0.2, 0.2), camera=camera)))


@pytest.mark.slow
def test_a_pose_beside_other_parameters() -> None:
    """Those are the scene's: one launch for each state, or for all that share a value of them."""
    key = "block.bsdf.alpha_u.value"
    renderer = MitsubaRenderer(scene, DEPTH)
    session = renderer.prepare(["ball.translation", key], None, derivatives=False)
    states = {"ball.translation": np.array([[0, 0, 0], [0, -0.5, 0.0]]), key: np.array([0.1, 0.5])}
    both = [session.image_batch(states, SampleRequest(0, SPP, run)).numpy() for run in range(RUNS)]
    copied, shared = (
        {**states, key: of(np.array(0.3), 2)} for of in (np.repeat, lambda x, n: np.broadcast_to(x, (n,)))
    )
    images = [session.image_batch(each, SampleRequest(0, SPP, 5)).numpy() for each in (copied, shared)]
    np.testing.assert_allclose(images[0], images[1], rtol=1e-4, atol=1e-5)
    for index, (place, alpha) in enumerate((((-0.45, 0.3, 0.2), 0.1), ((-0.45, -0.2, 0.2), 0.5))):
        described = scene(ball=place)
        described["block"]["bsdf"]["alpha_u"] = alpha
        assert agree(np.stack([pair[index] for pair in both]), theirs(described))


@pytest.mark.slow
def test_shapes_that_path_gradients_have_moved_are_posed_from_where_they_were() -> None:
    key, turns = "block.rotation.y", np.array([0.0, 0.4])

    def moved(renderer: MitsubaRenderer) -> None:
        at = {key: renderer.array(np.array(0.9, np.float32))}
        renderer.prepare([key], None).image(at, SampleRequest(0, 4, 1))

    def seen(renderer: MitsubaRenderer) -> np.ndarray:
        return (
            renderer.prepare([key], None, derivatives=False).image_batch({key: turns}, SampleRequest(0, 4, 1)).numpy()
        )

    first, second = MitsubaRenderer(scene, 2), MitsubaRenderer(scene, 2)
    moved(first)
    expected = seen(second)
    np.testing.assert_array_equal(seen(first), expected)
    moved(second)
    np.testing.assert_array_equal(seen(second), expected)


@pytest.mark.cpu("atomic additions of a GPU have no order")
def test_all_states_of_a_batch_share_their_random_numbers() -> None:
    renderer = MitsubaRenderer(scene, DEPTH)
    session = renderer.prepare(["block.rotation.y"], None, derivatives=False)
    turns = np.array([0.0, 0.7, 0.0, 0.7, 0.0])
    batch = session.image_batch({"block.rotation.y": turns}, SampleRequest(0, 2, 5)).numpy()
    assert np.array_equal(batch[0], batch[2])
    assert np.array_equal(batch[1], batch[3])
    assert not np.array_equal(batch[0], batch[1])
    alone = session.image_batch({"block.rotation.y": turns[1:2]}, SampleRequest(0, 2, 5)).numpy()
    assert np.array_equal(batch[1], alone[0])
    assert np.array_equal(
        batch[1], session.image({"block.rotation.y": mi.TensorXf(0.7)}, SampleRequest(0, 2, 5)).images[0]
    )
    assert not np.array_equal(batch, session.image_batch({"block.rotation.y": turns}, SampleRequest(0, 2, 6)).numpy())


def test_an_omitted_pose_is_as_loaded() -> None:
    renderer, request = MitsubaRenderer(scene, DEPTH), SampleRequest(0, 2, 5)
    keys = ["block.translation.x", "block.rotation.y"]
    session = renderer.prepare(keys, None, derivatives=False)
    zero, shift = renderer.array(np.array(0.0)), renderer.array(np.array(0.2))
    full = session.image({keys[0]: shift, keys[1]: zero}, request).images.numpy()
    np.testing.assert_array_equal(session.image({keys[0]: shift}, request).images.numpy(), full)
    np.testing.assert_array_equal(session.image_batch({keys[0]: np.array([0.2])}, request).numpy(), full)
    loaded = session.image(dict.fromkeys(keys, zero), request).images.numpy()
    assert not np.array_equal(loaded, full)
    assert session.image({}, request).images.shape == full.shape


def test_what_poses_refuse() -> None:
    renderer = MitsubaRenderer(scene, DEPTH)
    known = renderer.parameters()
    assert "light.translation" in known
    assert "sky.rotation" not in known  # it looks the same from everywhere
    assert known["block.translation"].shape == (3,)
    assert known["block.scale"].shape == ()
    with pytest.raises(ur.InputError, match=r"block\.rotation sets the same coordinate"):
        renderer.prepare(["block.rotation", "block.rotation.y"], None, derivatives=False)
    assert known["block.rotation"].differentiable
    for key, why in (("ball.rotation", "ball is not a mesh"),):
        with pytest.raises(ur.InputError, match=rf"cannot be recovered by path gradients.*{why}.*SmoothedDerivatives"):
            renderer.prepare([key], None)
    renderer.prepare(["block.rotation", "sensor.x_fov"], None, derivatives=False)  # the lens goes with poses


@pytest.mark.slow
def test_path_gradients_of_other_parameters_where_poses_stand() -> None:
    """Of both states of a pair, each in poses of its own, against scenes in which shape and sensor were moved for good; of drawn pixels."""
    shift = [-0.2, 0.25, 0.1]
    block = motion([0.2, 0.1, 0.3], shift)
    camera = mi.ScalarTransform4f().translate([0.2, -0.1, 0.15])
    keys = ["block.bsdf.alpha_u.value", "white.reflectance.value", "light.emitter.radiance.value"]
    poses = {"block.translation": shift, "block.rotation": TURN, "sensor.translation": [0.2, -0.1, 0.15]}
    pixels = mi.UInt32(np.arange(0, 1024, 3, dtype=np.uint32))
    sensors, shape = dr.zeros(mi.UInt32, dr.width(pixels)), (2, dr.width(pixels), 3)
    weights = mi.TensorXf(np.random.default_rng(0).uniform(0, 1, shape).astype(np.float32))

    def rows(description: Any, now: dict[str, Any], before: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
        renderer = MitsubaRenderer(description, 3)
        session = renderer.prepare([*keys, *now], "primary", frozenset(keys))
        own = renderer.values(keys)
        states = [own | {k: renderer.array(np.array(x, np.float32)) for k, x in of.items()} for of in (now, before)]
        found: tuple[list[np.ndarray], list[np.ndarray]] = [], []
        for run in range(RUNS // 2):
            request = SampleRequest(0, 16, run, 2, pixels, sensors)
            rendering = session.image_pair(states[0], states[1], request, "primary")
            assert rendering.previous is not None
            trees = session.adjoint_pair(states[0], states[1], rendering.paths, weights, weights)
            for into, image, tree in zip(found, (rendering.images, rendering.previous), trees, strict=True):
                assert set(tree) == set(keys)
                into.append(
                    np.concatenate([image.numpy().mean((0, 1)).ravel(), *(g.numpy().ravel() for g in tree.values())])
                )
        return np.array(found[0]), np.array(found[1])

    unmoved = {key: np.zeros(3) for key in poses}
    now, before = rows(scene, poses, unmoved)
    moved, _ = rows(lambda: scene(block, camera=camera), {}, {})
    still, _ = rows(scene, {}, {})
    limit = stats.norm.isf((1 - (1 - 1e-3) ** (1 / (2 * now.shape[1]))) / 2)
    assert np.abs(z_scores(now, moved)).max() < limit
    assert np.abs(z_scores(before, still)).max() < limit
    assert np.abs(z_scores(now, still)).max() > limit, "a pose that was left out went unseen"
