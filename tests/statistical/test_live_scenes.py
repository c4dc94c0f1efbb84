"""Descents beside scenes of the caller's own that are alive in the same process: kernels are recorded all the same."""

from __future__ import annotations

import gc
from collections.abc import Callable
from typing import Any

import drjit as dr
import fog
import mitsuba as mi
import numpy as np
import pytest
import zoo

import unrender as ur
from kernels import count_recordings
from unrender.rendering.mitsuba import frozen

KEY = "back.bsdf.reflectance.data"


@pytest.fixture
def warned(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    found: list[str] = []
    monkeypatch.setattr(frozen, "_warn", found.append)
    return found


@pytest.fixture
def recordings(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    return count_recordings(monkeypatch)


def room(views: int = 1) -> dict[str, Any]:
    described = mi.cornell_box()
    described["sensor"]["film"].update(width=8, height=8, rfilter={"type": "box"})
    described["back"]["bsdf"] = {"type": "diffuse", "reflectance": zoo.texture(1)}
    if views > 1:
        described["second"] = dict(described["sensor"])
    return described


def problem(views: int = 1) -> ur.Problem:
    reference = np.full((8, 8, 3), 0.3, np.float32)
    return ur.Problem(
        lambda: room(views),
        [ur.Parameter(KEY, initial=0.5)],
        [ur.View(reference, sensor=view) for view in range(views)],
        max_depth=4,
    )


def with_textured_light(bsdf: dict[str, Any] | None = None) -> dict[str, Any]:
    """A scene whose light makes a table of its texels when it is first sampled."""
    described = zoo.scene(bsdf or {"type": "diffuse", "reflectance": zoo.texture(2)})
    described["lamp"]["emitter"]["radiance"] = zoo.texture(3)
    described["integrator"] = {"type": "prb", "max_depth": 4}
    return described


def through_a_lens() -> dict[str, Any]:
    described = with_textured_light()
    described["sensor"] |= {"type": "thinlens", "aperture_radius": 0.1, "focus_distance": 4.0}
    return described


def own_loop(described: dict[str, Any]) -> tuple[Any, ...]:
    """Two steps of a loop over every texture of a scene, left in the middle of the third."""
    scene = mi.load_dict(described)
    parameters = mi.traverse(scene)
    optimizer = mi.ad.Adam(lr=0.02)
    for key in [key for key, _ in parameters if key.endswith(".data") and key != "sky.data"]:
        optimizer[key] = parameters[key]  # pyright: ignore[reportArgumentType]
    for seed in range(3):
        parameters.update(optimizer)
        image = mi.render(scene, parameters, spp=1, seed=seed)  # pyright: ignore[reportArgumentType]
        dr.backward(dr.mean(dr.square(image - 0.3), axis=None))
        optimizer.step()
    return scene, parameters, optimizer, image  # pyright: ignore[reportPossiblyUnboundVariable]


@pytest.mark.slow
def test_beside_three_scenes_every_kernel_is_recorded(warned: list[str], recordings: list[int]) -> None:
    alive = [mi.load_dict(with_textured_light()), own_loop(with_textured_light()), mi.load_dict(through_a_lens())]
    counts: list[int] = []

    class Watch(ur.protocols.Callback):
        def on_step(self, run: Any, record: dict[str, Any]) -> None:
            counts.append(len(recordings))

    ur.optimize(problem(), steps=8, callbacks=[Watch()])
    assert not warned
    assert counts[3:] == counts[3:4] * len(counts[3:])
    assert len(alive) == 3


@pytest.mark.parametrize("built", [True, False])
def test_one_attempt_is_enough_if_the_tables_of_all_lights_are_built(
    built: bool, warned: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(frozen, "_ATTEMPTS", 1)
    if not built:
        monkeypatch.setattr(frozen, "build_emitter_tables", lambda: None)
    alive = mi.load_dict(with_textured_light())
    ur.optimize(problem(), ur.PathGradient(spp=2), ur.optimizers.Adam(0.01), steps=2)
    assert bool(warned) != built
    assert alive is not None


@pytest.mark.slow
def test_mini_batches_of_several_views_beside_a_lens_that_cannot_be_recorded(
    warned: list[str], recordings: list[int]
) -> None:
    alive = mi.load_dict(through_a_lens())
    estimator = ur.PathGradient(pixels=ur.pixels.Uniform(16), spp=2)
    ur.optimize(problem(views=2), estimator, ur.optimizers.Adam(0.01), steps=6)
    assert not warned
    assert len(recordings) <= 8
    assert alive is not None


@pytest.mark.slow
def test_beside_loops_over_every_material(warned: list[str], recordings: list[int]) -> None:
    """As many scenes as there are materials, half of them never rendered."""
    alive = []
    for index, (make, _) in enumerate(zoo.MATERIALS.values()):
        described = with_textured_light(make())
        alive.append(mi.load_dict(described) if index % 2 else own_loop(described))
    ur.optimize(problem(), steps=6)
    assert not warned
    assert len(recordings) <= 16
    assert len(alive) == len(zoo.MATERIALS)


def plain() -> dict[str, Any]:
    return zoo.scene({"type": "diffuse", "reflectance": zoo.texture(2)})


def foggy() -> dict[str, Any]:
    described = zoo.scene({"type": "null"}, environment=False)
    described["ball"]["interior"] = fog.fog()
    return described


def one_unknown(key: str, initial: float, make: Callable[[], dict[str, Any]] = plain) -> Callable[[], ur.Problem]:
    """Return a function that opens a problem of one unknown in a scene of a small film."""

    def scene() -> dict[str, Any]:
        described = make()
        described["sensor"]["film"].update(width=8, height=8)
        return described

    reference = np.full((8, 8, 3), 0.3, np.float32)
    return lambda: ur.Problem(scene, [ur.Parameter(key, initial=initial)], [ur.View(reference)], max_depth=4)


PROBLEMS = {
    "paths in memory": problem,
    "light": one_unknown("lamp.emitter.radiance.data", 2.0, with_textured_light),
    "few numbers": one_unknown("lamp.emitter.radiance.value", 2.0),
    "sky": one_unknown("sky.data", 0.5),
    "roughness": one_unknown("ball.bsdf.alpha.data", 0.3, lambda: zoo.scene(zoo.rough())),
    "fog": one_unknown("ball.interior_medium.sigma_t.value.value", 0.5, foggy),
    "pose": one_unknown("ball.translation", 0.1),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", PROBLEMS)
def test_as_many_kernels_are_recorded_as_without_other_scenes(
    name: str, warned: list[str], recordings: list[int]
) -> None:
    """Three scenes are alive: one never rendered, one in the middle of a loop with gradients pending, one behind a lens."""

    def count() -> int:
        gc.collect()
        opened = PROBLEMS[name]()
        before = len(recordings)
        ur.optimize(opened, steps=4)
        return len(recordings) - before

    alone = count()
    alive = [mi.load_dict(with_textured_light()), own_loop(with_textured_light()), mi.load_dict(through_a_lens())]
    beside = count()
    assert not warned
    assert beside == alone > 0
    assert len(alive) == 3
