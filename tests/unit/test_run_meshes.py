"""Meshes of a run folder: files that other programs read, arrays that anybody may have made, and the page on which they turn."""

from __future__ import annotations

import base64
import io
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from report_folders import write_run

import unrender as ur
from browser import chromium
from unrender.app import report
from unrender.app.report import pages
from unrender.gallery import meshes
from unrender.io import mesh_files
from unrender.runs import reopen
from unrender.runs.folder import reader

KEY = "ball.vertex_positions"
POINTS, FACES = meshes.icosphere(1)
OF, CUT, UV = meshes.unrolled(POINTS, FACES)


def written(folder: Path, **more: np.ndarray) -> Path:
    """A run folder of a sphere that has grown by a tenth, and whose truth is twice as large."""
    start = POINTS.reshape(-1).astype(np.float32)
    arrays: dict[str, Any] = {
        f"{KEY}/faces": FACES,
        f"{KEY}/true_vertices": 2 * POINTS,
        f"{KEY}/true_faces": FACES,
        **more,
    }
    path = write_run(folder, truth={}, initial={KEY: start}, parameters={KEY: start * 1.1})
    np.savez(path / "meshes.npz", **{name: value for name, value in arrays.items() if value is not None})
    return path


def test_ply_and_obj_are_read_again_as_they_were() -> None:
    import trimesh  # takes half a second, not at the collection of every process

    vertices = POINTS[OF].astype(np.float32)
    normals = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    found: Any = trimesh.load(io.BytesIO(mesh_files.ply(vertices, CUT, normals, UV)), file_type="ply", process=False)
    np.testing.assert_array_equal(found.vertices.astype(np.float32), vertices)
    np.testing.assert_array_equal(found.faces, CUT)
    np.testing.assert_allclose(found.vertex_normals, normals, atol=1e-6)
    np.testing.assert_allclose(found.visual.uv, np.stack([UV[:, 0], 1 - UV[:, 1]], 1), atol=1e-6)
    for uv in (None, UV):
        text = mesh_files.obj(vertices, CUT, uv)
        found: Any = trimesh.load(io.BytesIO(text), file_type="obj", process=False, maintain_order=True)
        np.testing.assert_array_equal(found.vertices.astype(np.float32), vertices)
        np.testing.assert_array_equal(found.faces, CUT)
        if uv is not None:
            np.testing.assert_allclose(found.visual.uv, np.stack([uv[:, 0], 1 - uv[:, 1]], 1), atol=1e-6)


def test_a_run_folder_tells_distances_of_surfaces(tmp_path: Path) -> None:
    run = reader.read(written(tmp_path / "run"))
    assert run.known == (KEY,)
    inner = np.sqrt(np.mean(np.square(np.linalg.norm(POINTS[FACES].mean(axis=1), axis=1))))
    assert run.error_before[KEY] == pytest.approx(inner, rel=0.05)
    assert run.error_after[KEY] == pytest.approx(0.9 * inner, rel=0.05)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("faces", FACES + 1, "names vertex 42 of 42"),
        ("faces", FACES[:, :2], "vertex indices"),
        ("faces", np.where(FACES == 3, np.nan, FACES), "vertex indices"),
        ("true_faces", FACES - 1, "names vertex"),
        ("true_vertices", np.full((42, 3), np.inf), "finite vertices"),
    ],
)
def test_arrays_that_make_no_mesh_are_one_line(tmp_path: Path, name: str, value: np.ndarray, message: str) -> None:
    path = written(tmp_path / "run", **{f"{KEY}/{name}": value})
    with pytest.raises(ur.InputError, match=f"meshes.npz: {KEY}: surface: .*{message}"):
        reader.read(path)


def test_the_page_holds_meshes_and_a_picture_of_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = written(tmp_path / "run")
    shown = pages.shape_panel(reader.read(path), KEY)
    assert [solid.label for solid in shown.solids] == ["Start", "Recovered", "Truth"]
    sizes = []
    for solid in shown.solids:
        steps = np.frombuffer(base64.b64decode(solid.positions), "<u2").reshape(-1, 3)
        np.testing.assert_array_equal(np.frombuffer(base64.b64decode(solid.faces), "<u4").reshape(-1, 3), FACES)
        sizes.append(float(np.linalg.norm(2 * steps.astype(float) / 65535 - 1, axis=1).mean()))
    extent = np.abs(POINTS).max()
    np.testing.assert_allclose(2 * np.array(sizes) * extent, [1, 1.1, 2], rtol=1e-3)  # one scale for all
    text = report.page(path).read_text()
    assert text.count("<canvas") == 1
    assert shown.picture in text
    assert "http" not in text.split("<main")[0].replace("http-equiv", "")  # nothing is fetched
    monkeypatch.setattr(pages, "MOST_FACES", 100)
    large = pages.shape_panel(reader.read(path), KEY)
    assert (large.solids, large.picture) == ((), "")
    assert "too large to be shown" in large.note


@pytest.mark.slow
def test_meshes_turn_or_are_a_picture(tmp_path: Path) -> None:
    path = report.page(written(tmp_path / "run"))
    with chromium() as page:
        page.goto(path.as_uri())
        canvas, picture = page.locator(".shape canvas"), page.locator(".shape img")
        assert canvas.is_visible() != picture.is_visible()
        assert page.complaints == []


def test_a_problem_gets_the_triangles_that_a_run_ended_with(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Judging, turning and exporting render the result of a mesh that was remeshed; one that was not stays as it is."""
    points, faces = meshes.icosphere(0)
    finer = {f"{KEY}/first_faces": faces}
    path = write_run(
        tmp_path / "run",
        truth={},
        initial={KEY: points.reshape(-1).astype(np.float32)},
        parameters={KEY: POINTS.reshape(-1).astype(np.float32)},
    )
    np.savez(path / "meshes.npz", **{f"{KEY}/faces": FACES, **finer})  # type: ignore
    run = reader.read(path)
    problem: Any = SimpleNamespace(faces={KEY: faces})
    monkeypatch.setattr(reopen, "remeshed", lambda problem, found: found)
    found: Any = reopen.with_meshes(problem, run)
    np.testing.assert_array_equal(found[KEY].faces, FACES)
    np.testing.assert_array_equal(found[KEY].vertices, POINTS.astype(np.float32))
    problem.faces = {KEY: FACES}
    assert reopen.with_meshes(problem, run) is problem
