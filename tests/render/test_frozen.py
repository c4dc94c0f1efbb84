# Dr.Jit's stubs know less than its functions return.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false

"""Recorded functions: when they give up recording, and when an error is just an error."""

from __future__ import annotations

import gc
import weakref
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from unrender.rendering.mitsuba import frozen
from unrender.rendering.mitsuba.frozen import FrozenFunction, shapes_are_recordable


@pytest.fixture
def warned(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    found: list[str] = []
    monkeypatch.setattr(frozen, "_warn", found.append)
    return found


def nothing() -> None:
    return None


def test_what_cannot_be_recorded_is_traced_at_every_call(warned: list[str]) -> None:
    """It reads an array's value, which no recording can."""
    calls: list[int] = []

    def function(x: Any) -> Any:
        calls.append(1)
        return x * float(dr.sum(x)[0])

    once = FrozenFunction(function)
    prepared: list[int] = []
    for n in (1, 2, 3, 4):
        x = mi.Float([1.0, 2.0, float(n)])
        dr.eval(x)
        assert dr.allclose(once(lambda: prepared.append(1), x), x * float(3 + n))
    assert len(warned) == 1
    assert len(calls) == 7  # three attempts, and four calls
    assert len(prepared) == 7


def test_what_its_first_use_makes_recordable_is_recorded_at_the_next_call(warned: list[str]) -> None:
    """As lights of other scenes that make tables when they are first sampled."""
    calls: list[int] = []

    def function(x: Any) -> Any:
        calls.append(1)
        return x * float(dr.sum(x)[0]) if len(calls) < 3 else x + 1

    once = FrozenFunction(function)
    x = mi.Float([1.0, 2.0, 3.0])
    dr.eval(x)
    for _ in range(4):
        once(nothing, x)
    assert len(calls) == 3  # an attempt that failed, its call, and one that was recorded
    assert not warned


@pytest.mark.parametrize("collected", [True, False])
def test_scenes_that_are_no_longer_used_are_freed_after_a_failure(
    collected: bool, warned: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Objects of a scene in a cycle of references stay in Dr.Jit's registry, and may prevent recording, until they are collected."""

    class Scene:
        def __init__(self) -> None:
            self.itself = self

    gone = weakref.ref(Scene())
    if not collected:
        monkeypatch.setattr(frozen.gc, "collect", lambda: 0)

    def function(x: Any) -> Any:
        return x + 1 if gone() is None else x * float(dr.sum(x)[0])

    once = FrozenFunction(function)
    x = mi.Float([1.0, 2.0, 3.0])
    dr.eval(x)
    gc.disable()
    try:
        for _ in range(4):
            once(nothing, x)
    finally:
        gc.enable()
    assert bool(warned) != collected


def test_the_error_of_a_replay_is_raised_and_the_recording_stays(
    warned: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[int] = []

    def function(x: Any) -> Any:
        calls.append(1)
        return x + 1

    once = FrozenFunction(function)
    x = mi.Float([1.0, 2.0, 3.0])
    dr.eval(x)
    assert dr.allclose(once(nothing, x), [2, 3, 4])
    replay = once._frozen

    def out_of_memory(*arguments: Any) -> Any:
        raise RuntimeError("out of memory")

    monkeypatch.setattr(once, "_frozen", out_of_memory)
    with pytest.raises(RuntimeError, match="out of memory"):
        once(nothing, x)
    monkeypatch.setattr(once, "_frozen", replay)
    assert dr.allclose(once(nothing, x * 2), [3, 5, 7])
    assert len(calls) == 1
    assert not warned


def test_another_layout_of_the_arguments_is_recorded_anew_or_traced(warned: list[str]) -> None:
    """A recording that fails later than the first call is given up as well: the next calls are traced."""

    def function(x: Any) -> Any:
        return x * float(dr.sum(x)[0]) if isinstance(x, mi.Float) else x + 1

    once = FrozenFunction(function)
    integers, numbers = mi.UInt32([1, 2, 3]), mi.Float([1.0, 2.0, 3.0])
    dr.eval(integers, numbers)
    assert dr.all(once(nothing, integers) == [2, 3, 4])
    assert not warned
    for _ in range(3):
        assert not warned
        assert dr.allclose(once(nothing, numbers), numbers * 6)
    assert len(warned) == 1
    assert dr.all(once(nothing, integers) == [2, 3, 4])


def test_the_function_s_own_error_is_the_one_that_counts(warned: list[str]) -> None:
    def function(x: Any) -> Any:
        raise ValueError("of the function")

    with pytest.raises(ValueError, match="of the function"):
        FrozenFunction(function)(nothing, mi.Float([1.0, 2.0]))


def test_a_recording_of_one_thread_is_not_replayed_by_two(warned: list[str]) -> None:
    """Sums have a place for each thread: a replay by more would write beyond them."""
    calls: list[int] = []

    def function(x: Any, index: Any) -> Any:
        calls.append(1)
        sums = dr.zeros(mi.Float, 4)
        dr.scatter_reduce(dr.ReduceOp.Add, sums, x, index)
        return sums

    once = FrozenFunction(function)
    x, index = dr.full(mi.Float, 1.0, 1 << 16), dr.arange(mi.UInt32, 1 << 16) % 4
    dr.eval(x, index)
    for threads, traced in ((1, 1), (1, 1), (2, 2), (2, 2), (1, 3)):
        dr.set_thread_count(threads)
        assert dr.allclose(once(nothing, x, index), 1 << 14)
        assert len(calls) == traced
    assert not warned


def above(floor: dict[str, Any]) -> dict[str, Any]:
    """A camera above a floor."""
    return {
        "type": "scene",
        "camera": {
            "type": "perspective",
            "to_world": mi.ScalarTransform4f().look_at(origin=[0, 2, 4], target=[0, 0, 0], up=[0, 1, 0]),
            "film": {"type": "hdrfilm", "width": 4, "height": 4, "rfilter": {"type": "box"}},
        },
        "floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -90), **floor},
    }


def test_kernels_of_a_textured_area_light_are_recorded(warned: list[str]) -> None:
    """Such a light makes the distribution of its texels at its first sample, which is too late within a recording."""
    from unrender.rendering.mitsuba.renderer import MitsubaRenderer
    from unrender.rendering.renderer import SampleRequest

    scene = above({}) | {
        "screen": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().translate([0, 0, -1]),
            "emitter": {
                "type": "area",
                "radiance": {"type": "bitmap", "bitmap": mi.Bitmap(np.ones((2, 2, 3), np.float32)), "raw": True},
            },
        },
        "lamp": {"type": "point", "position": [0, 2, 0]},
    }
    key = "screen.emitter.radiance.data"
    session = MitsubaRenderer(scene).prepare([key], None)
    bright, dark = (
        np.array(
            session.image({key: mi.TensorXf(np.full((2, 2, 3), value, np.float32))}, SampleRequest(0, 4, 0, 1)).images
        )
        for value in (3.0, 0.0)
    )
    assert not warned
    assert bright.mean() > 1.2 * dark.mean()


def test_later_steps_replay_what_two_have_recorded() -> None:
    """Whatever the seed, and although two scenes share what their replays let them share."""
    from unrender.rendering.mitsuba.path_cache.session import CachingSession
    from unrender.rendering.mitsuba.renderer import MitsubaRenderer
    from unrender.rendering.renderer import SampleRequest

    grey = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.5, 0.5, 0.5]}}
    scene = above({"bsdf": grey}) | {"lamp": {"type": "constant"}}
    key = "floor.bsdf.reflectance.value"
    session = MitsubaRenderer(scene).prepare([key], "path")
    assert isinstance(session, CachingSession)

    def value(x: float) -> dict[str, Any]:
        return {key: mi.TensorXf(np.full(3, x, np.float32))}

    recordings = []
    states = [value(x) for x in (0.1, 0.2, 0.3, 0.4)]
    # Two steps as a run's warm-up takes them, and then others.
    for seed, now, before in [(7, 0, 0), (7, 1, 0), (1, 0, 0), (2, 1, 0), (3, 2, 1), (4, 3, 2)]:
        session.image_pair(states[now], states[before], SampleRequest(0, 4, seed, 1), "path")
        functions = [*session._functions.values(), *session._inner._functions.values()]
        recordings.append(sum(getattr(once._frozen, "n_recordings", 0) for once in functions))
    assert recordings[1:] == recordings[1:2] * 5


@pytest.mark.parametrize("kind", ["bsplinecurve", "linearcurve"])
@pytest.mark.parametrize("grouped", [False, True])
def test_kernels_that_hit_curves_are_not_recorded(kind: str, grouped: bool, tmp_path: Path) -> None:
    """Four of five runs of Gauss-Newton steps on the roughness of hair ended in a segmentation fault."""
    (tmp_path / "curve.txt").write_text("".join(f"{x} 0 0 0.1\n" for x in range(5)))
    shape = {"type": kind, "filename": str(tmp_path / "curve.txt"), "bsdf": {"type": "diffuse"}}
    scene: dict[str, Any] = {"type": "scene", "camera": {"type": "perspective"}, "sky": {"type": "constant"}}
    if grouped:
        scene |= {"group": {"type": "shapegroup", "shape": shape}}
        scene |= {"placed": {"type": "instance", "group": {"type": "ref", "id": "group"}}}
    else:
        scene["shape"] = shape
    assert not shapes_are_recordable(mi.load_dict(scene))
    assert shapes_are_recordable(mi.load_dict({"type": "scene", "ball": {"type": "sphere"}}))
