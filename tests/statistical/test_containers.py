# Dr.Jit's stubs know less than its functions return.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportReturnType=false

"""Both states of scenes with nested and shared objects: images and adjoints of a pair against separate renders."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from containers import CONTAINERS, DEPTH, SHARED, SIZE, ball, boundary, diffuse, instances, scene, to
from test_adjoint import derivative_on_the_same_paths
from zscores import agree, check_pair

import unrender as ur
from tiers import quick
from unrender.core.errors import InputError
from unrender.methods.base import method
from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.renderer import SampleRequest

RUNS, SPP = 24, 64
QUICK = ("child of a shape group", "one texture under two BSDFs", "medium in a group")


def prepared(name: str) -> tuple[MitsubaRenderer, dict[str, Any], dict[str, Any]]:
    """The renderer of a container, its current and its previous state."""
    objects, changes = CONTAINERS[name]
    renderer = MitsubaRenderer(lambda: scene(**objects()), DEPTH)
    known = renderer.parameters()
    keys = {
        part: next(key for key, info in known.items() if part in key and info.differentiable and info.shares_paths)
        for part in changes
    }
    current = renderer.values(list(keys.values()))
    return renderer, current, {keys[part]: current[keys[part]] * factor for part, factor in changes.items()}


def runs(images: Any) -> np.ndarray:
    return np.array(images).astype(np.float64)


@pytest.mark.parametrize("name", quick(CONTAINERS, *QUICK))
def test_both_images_agree_with_separate_renders(name: str) -> None:
    renderer, current, previous = prepared(name)
    session = renderer.prepare(list(current), "path")
    check_pair(session, current, previous, RUNS, SPP, fault=1.03)


@pytest.mark.parametrize("name", quick(CONTAINERS, QUICK[0]))
def test_both_adjoints_agree_with_separate_adjoints(name: str) -> None:
    renderer, current, previous = prepared(name)
    session = renderer.prepare(list(current), "path")
    weight = renderer.array(np.random.default_rng(4).uniform(0.5, 1.5, (1, SIZE, SIZE, 3)))
    found: dict[str, list[np.ndarray]] = {"now": [], "before": [], "alone now": [], "alone before": []}
    for run in range(16):
        pair = session.image_pair(current, previous, SampleRequest(0, SPP, 3 * run), "path")
        of_pair = session.adjoint_pair(current, previous, pair.paths, weight, weight)
        separate = [
            session.adjoint(state, session.image(state, SampleRequest(0, SPP, 3 * run + 1 + k)).paths, weight)
            for k, state in enumerate((current, previous))
        ]
        for what, gradient in zip(found, (*of_pair, *separate), strict=True):
            found[what].append(np.array([runs(gradient[key]).mean() for key in current]))
    for what in ("now", "before"):
        a, b = np.array(found[what]), np.array(found[f"alone {what}"])
        error = np.sqrt((a.var(0, ddof=1) + b.var(0, ddof=1)) / len(a))
        share = error / np.abs(b.mean(0))
        assert (share < 0.22).all(), f"too noisy: standard errors are {share} of the gradients"
        assert (np.abs(a.mean(0) - b.mean(0)) < 4.5 * error + 1e-6 * np.abs(b.mean(0))).all(), (
            what,
            a.mean(0),
            b.mean(0),
            error,
        )


@pytest.mark.parametrize("name", quick(SHARED, "one texture under two BSDFs"))
def test_a_shared_object_is_one_parameter_with_one_gradient(name: str) -> None:
    """Its derivative is that of both uses: finite differences on the same paths."""
    renderer, current, _ = prepared(name)
    (key,) = current
    node = renderer.pair.current_parameters.properties[key][2]
    assert [
        other
        for other, (*_, holder, _) in renderer.pair.current_parameters.properties.items()
        if holder is node and other.rpartition(".")[2] == key.rpartition(".")[2]
    ] == [key]
    weight = np.random.default_rng(2).uniform(0.5, 1.5, (SIZE, SIZE, 3))
    request = SampleRequest(0, 4 * SPP, 7)
    session = renderer.prepare([key], "path")
    gradient = session.adjoint(current, session.image(current, request).paths, renderer.array(weight[None]))[key]
    expected = derivative_on_the_same_paths(renderer, current, key, request, weight)
    assert expected != 0
    found = float((runs(gradient) * runs(current[key])).sum())
    assert found == pytest.approx(expected, rel=0.02)
    assert 1.03 * found != pytest.approx(expected, rel=0.02)


def test_owners_of_a_shared_grid_are_updated() -> None:
    """Mitsuba updates the first owner alone, and the other's majorant would be that of the old values."""
    grid = {"type": "gridvolume", "id": "smoke", "raw": True, "grid": mi.VolumeGrid(np.ones((2, 2, 2, 1), np.float32))}
    medium = {"type": "heterogeneous", "albedo": 0.5, "sigma_t": {"type": "ref", "id": "smoke"}}
    description = scene(smoke=grid, ball_0=boundary(-0.6, medium), ball_1=boundary(0.6, medium))
    renderer = MitsubaRenderer(description, DEPTH)
    (key,) = [key for key in renderer.parameters() if key in ("smoke.data", "ball_0.interior_medium.sigma_t.data")]
    loaded = renderer.pair.loaded()
    for factor in (3.0, 1.0):
        loaded.set_parameters({key: renderer.values([key])[key] * factor} if factor != 1 else {})
        mei = dr.zeros(mi.MediumInteraction3f)
        for medium in loaded.graph.of("medium"):
            assert medium.get_majorant(mei).numpy().ravel()[0] == pytest.approx(factor)


def test_a_mesh_attribute_that_a_mirror_reads_follows_as_the_mirror_s_own_colour_does() -> None:
    def description() -> dict[str, Any]:
        colour = {"type": "mesh_attribute", "name": "vertex_color"}
        mesh = mi.load_dict(
            {"type": "cube", "to_world": to().scale(0.5), "bsdf": {"type": "conductor", "specular_reflectance": colour}}
        )
        mesh.add_attribute("vertex_color", 3, np.full(3 * mesh.vertex_count(), 0.8, np.float32))
        return scene(mirror=mesh)

    renderer = MitsubaRenderer(description, DEPTH)
    current = renderer.values(["mirror.vertex_color"])
    previous = {key: value * 0.5 for key, value in current.items()}
    session = renderer.prepare(list(current), "path")
    pair = session.image_pair(current, previous, SampleRequest(0, RUNS * SPP, 1, RUNS), "path")
    alone = runs(session.image(previous, SampleRequest(0, RUNS * SPP, 3, RUNS)).images)
    assert agree(runs(pair.previous), alone)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rcv", pytest.param("auto", marks=pytest.mark.slow)])
def test_the_colour_of_a_shape_group_s_child_is_recovered(name: str) -> None:
    """The control variate's previous state has its own colour too: without it a run ends at half the right value."""
    right = [0.7, 0.2, 0.1]
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    view = to().look_at([0, -5, 1], [0, 0, 0], [0, 0, 1])
    description = {
        "type": "scene",
        "sensor": {"type": "perspective", "fov": 40, "to_world": view, "film": film},
        **instances(ball(bsdf=diffuse(*right))),
        "sky": {"type": "constant", "radiance": 1.0},
    }
    key = "group.part_0.bsdf.reflectance.value"
    reference = np.array(
        mi.render(mi.load_dict(description), integrator=mi.load_dict({"type": "path", "max_depth": 4}), spp=1024)
    )
    parameter = ur.Parameter(key, initial=[0.4, 0.4, 0.4])
    problem = ur.Problem(description, [parameter], [ur.View(reference)], max_depth=4)
    components = () if name == "auto" else method(name).start()
    result = ur.optimize(problem, *components, steps=150, seed=1)
    assert np.abs(result.parameters[key] - right).max() < 0.03


def test_a_missing_entry_of_the_tables_is_seen() -> None:
    renderer, current, previous = prepared("child of a shape group")
    table = renderer.pair.tables()["bsdf"]
    child = next(shape for shape in renderer.pair.loaded().graph.of("shape") if shape.id() == "part_0")
    number = dr.reinterpret_array(mi.UInt32, mi.BSDFPtr(child.bsdf())).numpy()[0]
    broken = table.numpy()
    broken[number] = 0
    renderer.pair.tables()["bsdf"] = mi.UInt32(broken)
    session = renderer.prepare(list(current), "path")
    pair = session.image_pair(current, previous, SampleRequest(0, RUNS * SPP, 1, RUNS), "path")
    alone = runs(session.image(previous, SampleRequest(0, RUNS * SPP, 3, RUNS)).images)
    assert not agree(runs(pair.previous), alone)


def test_an_object_that_its_owner_hides_is_refused_by_name() -> None:
    """A plugin that does not announce what it holds has no second state."""
    renderer = MitsubaRenderer(lambda: scene(**instances(ball(bsdf=diffuse()))), DEPTH)
    for previous in (False, True):
        graph = renderer.pair.loaded(previous).graph
        hidden = next(shape for shape in graph.of("shape") if shape.id() == "part_0").bsdf()
        graph.nodes = [node for node in graph.nodes if node is not hidden]
    with pytest.raises(InputError, match=r"scene: the bsdf of part_0 \(SmoothDiffuse\) is hidden"):
        renderer.pair.tables()


def test_moving_shapes_and_cameras_beside_instances_are_refused_and_colours_are_not() -> None:
    description = scene(**instances(ball(bsdf=diffuse())), ball=ball(bsdf=diffuse()))
    renderer = MitsubaRenderer(description, DEPTH, keys=["ball.translation"])
    for key in ("ball.translation", "sensor.translation"):
        with pytest.raises(InputError, match="do not support scenes with instances"):
            renderer.prepare([key], None)
    renderer.prepare(["sensor.rotation"], None)
    renderer.prepare(["group.part_0.bsdf.reflectance.value"], "path")
    assert renderer.pair.tables()["bsdf"].numpy().any()
