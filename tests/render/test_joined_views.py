"""Several views in one launch: images, gradients and memories are those of a launch for each view."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
import pytest

import unrender as ur
from tiers import quick
from unrender.core import arrays
from unrender.core.random import Key
from unrender.estimators.capabilities import FreshGradient, NoiseSample
from unrender.estimators.sample_groups import GradientRequest
from unrender.gallery import parts
from unrender.runs.folder.state import check_alike
from unrender.scene import batches

KEYS = ("wall.bsdf.reflectance.data", "ball.bsdf.alpha.value")


def problem(loss: Any = None, sizes: tuple[int, ...] = (12, 12, 12, 12), **more: Any) -> ur.Problem:
    """A textured wall and a metal ball seen by cameras, the first with a mask and the last with a weight."""
    texels = np.random.default_rng(0).uniform(0.2, 0.8, (4, 4, 3)).astype(np.float32)
    cameras = {
        f"camera_{n}": parts.camera((1.2 * n - 1.5, 0.3, 3.0), (0.0, 0.0, 0.0), 50.0, size)
        for n, size in enumerate(sizes)
    }
    scene = {
        "type": "scene",
        **cameras,
        "wall": parts.rectangle(
            (0, 0, -1), (2, 0, 0), (0, 2, 0), {"type": "diffuse", "reflectance": parts.bitmap(texels)}
        ),
        "ball": {
            "type": "sphere",
            "center": [0.3, -0.2, 0.2],
            "radius": 0.4,
            "bsdf": {"type": "roughconductor", "alpha": 0.3},
        },
        "sky": {"type": "constant"},
        "lamp": {"type": "point", "position": [0.0, 1.5, 2.0], "intensity": {"type": "rgb", "value": 3.0}},
    }
    views = [
        ur.View(np.full((size, size, 3), 0.2 + 0.1 * n, np.float32), sensor=n, weight=2.0 if n == 3 else 1.0)
        for n, size in enumerate(sizes)
    ]
    mask = np.ones((sizes[0], sizes[0]), np.float32)
    mask[:5] = 0.0
    views[0] = ur.View(views[0].reference, sensor=0, mask=mask)
    keys = more.pop("keys", KEYS)
    return ur.Problem(
        scene, [ur.Parameter(key) for key in keys], views, loss=loss or ur.losses.L2(), max_depth=3, **more
    )


def apart(monkeypatch: pytest.MonkeyPatch) -> None:
    """Render every view by a launch of its own."""
    monkeypatch.setattr(batches, "_MOST_JOINED", 0)


def steps(asked: ur.Problem, estimator: ur.PathGradient, count: int) -> list[tuple[Any, Any]]:
    """Return estimates and states while the parameters move."""
    at, made = asked.initial(), []
    state = estimator.init(asked, at)
    for step in range(count):
        estimate, state = estimator.estimate(asked, at, state, Key(7, step))
        made.append((estimate, state))
        at = {key: asked.unknowns[key].project(value * 0.97) for key, value in at.items()}
    return made


def assert_close(found: Any, expected: Any) -> None:
    assert found.keys() == expected.keys()
    for key, value in expected.items():
        other, own = arrays.numpy(value), arrays.numpy(found[key])
        assert own.shape == other.shape
        np.testing.assert_allclose(own, other, atol=1e-3 * float(np.abs(other).max()))


CONTROL = ur.images.RecursiveControlVariate()
ESTIMATORS: dict[str, tuple[Any, ur.PathGradient, int]] = {
    "plain": (ur.losses.L2(), ur.PathGradient(spp=4), 2),
    "control variate": (ur.losses.L2(), ur.PathGradient(CONTROL, spp=2, noise_sample=True), 4),
    "damped": (ur.losses.L1(), ur.PathGradient(CONTROL, spp=4, tolerance=2.0, fresh_from=8), 9),
    "random numbers": (ur.losses.L2(), ur.PathGradient(ur.images.RecursiveControlVariate("primary"), spp=2), 3),
}


@pytest.mark.parametrize("name", quick(ESTIMATORS, "control variate", "random numbers"))
def test_views_of_one_launch_are_those_of_separate_launches(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    loss, estimator, count = ESTIMATORS[name]
    asked = problem(loss)
    joined = steps(asked, estimator, count)
    apart(monkeypatch)
    for (found, state), (expected, separate) in zip(joined, steps(asked, estimator, count), strict=True):
        assert found.loss == pytest.approx(expected.loss, rel=1e-4)
        assert found.info["samples"] == expected.info["samples"]
        assert found.info.keys() == expected.info.keys()
        assert_close(found.gradient, expected.gradient)
        for kind in (FreshGradient, NoiseSample):
            own, other = found.get(kind), expected.get(kind)
            assert (own is None) == (other is None)
            if own is not None and other is not None:
                assert_close(own.values, other.values)
        for shown in ("images", *(key for key in ("control_weight", "variance") if key in expected.info)):
            assert_close(found.info[shown], expected.info[shown])
        if name != "plain":
            assert (len(state.image.views), len(separate.image.views)) == (1, 4)
            for own, other in zip(state.image.of_views(), separate.image.views, strict=True):
                assert_close({"": own.image}, {"": other.image})
                assert_close({"": own.joint.mean_y}, {"": other.joint.mean_y})
            _, images = state.image.control_variates()
            assert [arrays.shape(image) for image in images] == [(12, 12, 3)] * 4


def kinds(asked: ur.Problem, estimator: ur.PathGradient, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return the kinds of the frames of a step, which ends before they are rendered."""
    found: list[str] = []
    inner = GradientRequest.begin

    def noted(self: Any, problem: Any) -> Any:
        found.extend(type(frame).__name__ for frame in inner(self, problem).frames)
        raise StopIteration

    monkeypatch.setattr(GradientRequest, "begin", noted)
    with pytest.raises(StopIteration):
        steps(asked, estimator, 1)
    return found


@pytest.mark.parametrize(
    ("asked", "estimator", "frames"),
    [
        (lambda: problem(), ur.PathGradient(spp=2), 1),
        (lambda: problem(sizes=(12, 8, 8, 8)), ur.PathGradient(spp=2), 1),
        (lambda: problem(sizes=(64, 64, 64, 64)), ur.PathGradient(spp=16), 2),
        (lambda: problem(sizes=(72, 64, 64, 64)), ur.PathGradient(spp=16), 0),
        (lambda: problem(sizes=(12,)), ur.PathGradient(spp=2), 0),
        (lambda: problem(), ur.PathGradient(spp=2, adjoint_spp=2), 0),
        (lambda: problem(), ur.PathGradient(pixels=ur.pixels.AdaptiveCounts(), spp=4), 0),
        (lambda: problem(keys=("ball.translation.x",)), ur.PathGradient(spp=2), 0),
    ],
)
def test_launches_have_several_views_if_they_are_small(
    asked: Any, estimator: ur.PathGradient, frames: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Separate adjoints have other random numbers than the images, and what moves has terms of each view."""
    made = asked()
    expected = ["JoinedViews"] * frames or ["FullView"] * len(made.views)
    assert kinds(made, estimator, monkeypatch) == expected


def test_a_state_of_separate_views_goes_on_with_them(monkeypatch: pytest.MonkeyPatch) -> None:
    asked, estimator = problem(), ur.PathGradient(CONTROL, spp=2)
    with monkeypatch.context() as patch:
        apart(patch)
        _, state = steps(asked, estimator, 2)[-1]
    _, after = estimator.estimate(asked, asked.initial(), state, Key(7, 2))
    assert len(after.image.views) == 4


@pytest.mark.slow
@pytest.mark.usefixtures("short_ends")
def test_checkpoints_of_separate_and_joined_views_are_resumed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As those of workers and of earlier versions are; with the same launches to the same bits."""
    asked = problem()
    parts: dict[str, Any] = {"estimator": ur.PathGradient(CONTROL, spp=2), "optimizer": ur.optimizers.SGD(0.1)}

    def run(name: str, steps: int) -> Any:
        options = {"run_directory": tmp_path / name, "checkpoint_every": 2, "seed": 1, "progress": False}
        return ur.optimize(asked, parts["estimator"], parts["optimizer"], steps=steps, **options)

    threads = dr.thread_count()
    dr.set_thread_count(1)
    expected = run("whole", 4).last
    run("half", 2)
    with monkeypatch.context() as patch:
        apart(patch)
        run("apart", 2)
    joined, separate = (ur.resume(tmp_path / name, asked, steps=4, **parts).last for name in ("half", "apart"))
    dr.set_thread_count(threads)
    for key, value in expected.items():
        np.testing.assert_array_equal(joined[key], value)
        np.testing.assert_allclose(separate[key], value, rtol=1e-4)


@pytest.mark.parametrize("sizes", [((1000, 1000),) * 4, ((12, 12),) * 3, ("x",) * 4, ((12,),) * 4])
def test_memories_of_other_sizes_are_refused(sizes: Any) -> None:
    state = steps(problem(), ur.PathGradient(CONTROL, spp=2), 2)[-1][1].image
    check_alike(state, [state])
    other = replace(state, views=(replace(state.views[0], sizes=sizes),))
    with pytest.raises(ur.InputError, match="expected"):
        check_alike(other, [state])
