"""Runs whose unknown is a mesh: `auto` on the gallery's problems, their folders, exports, and other triangles on the way."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import unrender as ur
from unrender.runs.callbacks import Callback
from unrender.runs.folder import reader
from unrender.runs.metadata import RunAnnotations
from unrender.runs.refinement import remeshed
from unrender.runs.run import Run
from unrender.scene.problem import Problem
from unrender.scene.surfaces import Surface

SMALL = {"resolution": 16, "subdivisions": 2, "reference_spp": 32}
STATUE, STONE = "statue.vertex_positions", "statue.bsdf.brdf_0.reflectance.data"


@pytest.mark.slow
def test_auto_brings_shape_and_texture_nearer_across_a_change_of_triangles(tmp_path: Path) -> None:
    made = ur.gallery.problem("statue", **SMALL, views=2, texture_resolution=8)
    given = [
        replace(p, remeshing={"steps": [5], "method": "subdivide"}) if p.key == STATUE else p for p in made.parameters
    ]
    scene = made.renderer.pair.description  # type: ignore
    known = made.unknowns[STATUE].surface
    assert known is not None
    problem = Problem(scene, given, made.views, made.loss, made.max_depth, surfaces={STATUE: known})
    result = ur.optimize(problem, steps=11, run_directory=tmp_path / "run", annotations=RunAnnotations(final_spp=32))
    run = reader.read(tmp_path / "run")
    assert run.error_after[STATUE] < 0.9 * run.error_before[STATUE]
    assert result.history[-1]["parameter_error"][STATUE] == pytest.approx(run.error_after[STATUE], rel=1e-3)
    assert [record.get("faces") for record in result.history if "faces" in record] == [{STATUE: 1280}]
    assert result.history[-1]["loss"] < result.history[4]["loss"] < 0.9 * result.history[0]["loss"]
    assert np.ptp(result.parameters[STONE]) > 0.05
    # Starts and results have different triangles; both have their pictures.
    assert len(run.meshes[STATUE].first_faces) == 320
    before, after = (result.image_errors[f"view0/{which}"][0] for which in ("initial", "result"))
    assert after < before
    import trimesh  # takes half a second, not at the collection of every process

    written: Any = trimesh.load(tmp_path / "run/meshes/statue.ply", process=False)
    np.testing.assert_array_equal(written.vertices.astype(np.float32).reshape(-1), result.parameters[STATUE])
    # What is exported renders what the last picture shows.
    moved = remeshed(problem, {STATUE: _mesh(run)})
    exported = ur.app.export((moved, result.parameters), tmp_path / "scene", formats=["mitsuba", "ply", "obj"])
    for path in (tmp_path / "scene/ply/statue.ply", tmp_path / "scene/obj/asset.obj"):
        again: Any = trimesh.load(path, process=False, maintain_order=True)
        np.testing.assert_allclose(np.sort(again.vertices, axis=0), np.sort(written.vertices, axis=0), atol=1e-6)
        assert len(again.faces) == 1280
    picture = np.array(mi.render(mi.load_file(str(exported.scene)), sensor=0, spp=256))
    ours = ur.render(moved, result.parameters, 0, spp=256)
    assert np.sqrt(np.mean((picture - ours) ** 2)) < 0.02


def _mesh(run: reader.RunFolder):
    from unrender.rendering.renderer import ReplacedMesh

    mesh = run.meshes[STATUE]
    return ReplacedMesh(run.parameters[STATUE].reshape(-1, 3), mesh.faces, mesh.uv)


def test_a_mesh_with_values_at_its_vertices_is_not_remeshed(tmp_path: Path) -> None:
    """New vertices read beyond the values, and the picture was another one."""
    mesh: Any = mi.load_dict({"type": "cube"})
    mesh.add_attribute("vertex_color", 3, np.full(3 * mesh.vertex_count(), 0.5, np.float32))
    mesh.write_ply(str(tmp_path / "box.ply"))
    scene = {
        "type": "scene",
        "camera": {"type": "perspective", "film": {"type": "hdrfilm", "width": 4, "height": 4}},
        "box": {"type": "ply", "filename": str(tmp_path / "box.ply")},
    }
    unknown = ur.Parameter("box.vertex_positions", remeshing={"steps": [5], "method": "subdivide"})
    with pytest.raises(ur.InputError, match="remeshing: its mesh has vertex_color, and new triangles would have none"):
        ur.Problem(scene, [unknown], [ur.View(np.zeros((4, 4, 3)))])


def box(bsdf: dict[str, Any]) -> dict[str, Any]:
    """A cube under a lamp."""
    return {
        "type": "scene",
        "camera": {
            "type": "perspective",
            "to_world": mi.ScalarTransform4f().look_at([0, 0, 6], [0, 0, 0], [0, 1, 0]),
            "film": {"type": "hdrfilm", "width": 6, "height": 6},
        },
        "box": {"type": "cube", "bsdf": bsdf},
        "lamp": {"type": "point", "position": [1, 2, 5], "intensity": 9.0},
    }


def test_views_know_their_values_after_a_change_of_triangles() -> None:
    """Their sensors were those behind the scene's, which `Problem.replaced` and a second change did not find."""
    scene = box({"type": "diffuse"})
    key, lamp, reference = "box.vertex_positions", "lamp.intensity.value", np.full((6, 6, 3), 0.1)
    unknown = ur.Parameter(key, remeshing={"steps": [5], "method": "subdivide"})
    made = ur.Problem(scene, [unknown], [ur.View(reference), ur.View(reference, known={lamp: 1.0})])
    before, again = [ur.render(made, view=view, spp=64) for view in (0, 1)], made
    for _ in range(2):
        old = again.unknowns[key]
        assert old.remeshing is not None
        assert old.faces is not None
        points, uv = old.initial.reshape(-1, 3), again.texture_coordinates(key)
        again = remeshed(again, {key: old.remeshing.apply(points, old.faces, uv)})
        assert again.original_views[1].known == {lamp: 1.0}
        for view in (0, 1):
            np.testing.assert_allclose(ur.render(again, view=view, spp=64), before[view], atol=0.02)
    assert before[0].mean() > 5 * before[1].mean()


@pytest.mark.usefixtures("short_ends")
def test_a_change_of_triangles_restarts_what_is_of_the_mesh_alone() -> None:
    """In whichever part of a partition the mesh is, and not the schedule of a smoothed loss."""
    grey = mi.Bitmap(np.full((2, 2, 3), 0.5, np.float32))
    scene = box({"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": grey, "raw": True}})
    mesh, paint = "box.vertex_positions", "box.bsdf.reflectance.data"
    given = [ur.Parameter(mesh, remeshing={"steps": [2], "method": "subdivide"}), ur.Parameter(paint)]
    problem = Problem(scene, given, [ur.View(np.full((6, 6, 3), 0.1))], max_depth=2)
    smoothed = ur.SmoothedDerivatives(0.05, 4, spp=2, schedule=ur.optimizers.schedules.Exponential(2))
    estimator = ur.estimators.HybridGradient(ur.PathGradient(spp=2), smoothed, keys=(paint,))
    vertices, texels = ur.optimizers.Adam(0.005, uniform=True), ur.optimizers.Adam(0.02)
    seen = Steps()
    optimizer = ur.optimizers.Partitioned((paint,), texels, vertices)
    result = ur.optimize(problem, estimator, optimizer, steps=4, callbacks=[seen])
    assert [record.get("faces") for record in result.history if "faces" in record] == [{mesh: 48}]
    assert seen.rows == [(1.0, 1, 1), (2.0, 2, 2), (3.0, 3, 1), (4.0, 4, 2)]


class Steps(Callback):
    """Age of the smoothed loss, and number of steps in the states of both optimizers."""

    def __init__(self) -> None:
        self.rows: list[tuple[float, int, int]] = []

    def on_step(self, run: Run, record: dict[str, Any]) -> None:
        del record
        parts = run.state.optimizer.own, run.state.optimizer.others
        own, others = (part.step - part.begun for part in parts)
        self.rows.append((run.state.estimator.perturbed.age, own, others))


@pytest.mark.slow
@pytest.mark.usefixtures("short_ends")
def test_a_resumed_run_knows_the_true_surface_and_when_the_mesh_was_seen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Problem files have no surface, so the run folder tells it. A mesh that pictures no longer show has its line also then."""
    film = '<film type="hdrfilm"><integer name="width" value="4"/><integer name="height" value="4"/></film>'
    text = f'<sensor type="perspective">{film}</sensor><emitter type="constant"/><shape type="cube" id="box"/>'
    (tmp_path / "scene.xml").write_text(f'<scene version="3.0.0">{text}</scene>')
    key, views = "box.vertex_positions", [ur.View(np.full((4, 4, 3), 0.5, np.float32))]
    made = Problem(tmp_path / "scene.xml", [ur.Parameter(key)], views)
    surface = Surface(1.1 * made.unknowns[key].initial.reshape(-1, 3), made.faces[key])
    made = Problem(tmp_path / "scene.xml", [ur.Parameter(key)], views, surfaces={key: surface})
    parts = ur.SmoothedDerivatives(0.05, 4, spp=1), ur.optimizers.Adam(0.01)
    ur.optimize(made, *parts, steps=1, run_directory=tmp_path / "run")
    before = reader.read(tmp_path / "run").error_before
    result = ur.resume(tmp_path / "run", steps=2)
    assert "parameter_error" in result.history[-1]
    after = reader.read(tmp_path / "run")
    assert after.error_before == before == {key: pytest.approx(made.parameter_error(made.initial())[key], rel=1e-5)}
    assert after.error_after.keys() == {key}
    steps_that_show_it(monkeypatch, 2)
    whole = ur.optimize(made, *parts, steps=4, run_directory=tmp_path / "whole")
    for steps in (2, 3):  # a step before the mesh is hidden, and one after
        ur.optimize(made, *parts, steps=steps, run_directory=tmp_path / str(steps))
        again = ur.resume(tmp_path / str(steps), steps=4)
        assert again.warnings == whole.warnings
        np.testing.assert_array_equal(again.parameters[key], whole.parameters[key])
    assert any("the mesh has left the pictures" in line for line in whole.warnings)


def steps_that_show_it(monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    """Let the gradient of smoothed derivatives be 1, and zero after some steps."""
    estimate = ur.SmoothedDerivatives.estimate

    def hidden(self: Any, problem: Any, parameters: Any, state: Any, key: Any) -> Any:
        found, after = estimate(self, problem, parameters, state, key)
        shown = float(key.step < count)
        return replace(found, gradient={k: 0.0 * x + shown for k, x in found.gradient.items()}), after

    monkeypatch.setattr(ur.SmoothedDerivatives, "estimate", hidden)
