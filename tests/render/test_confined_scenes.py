"""Textures, meshes and grids that an XML scene names lie in its folder or in that of its problem file."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from hostile_inputs import KEY, problem, scene, write_scene

import unrender as ur
from unrender.core.errors import InputError
from unrender.io import confinement

_PLY = (
    "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
)


@pytest.fixture(autouse=True)
def _confined(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(confinement.VARIABLE, raising=False)


def _assets(place: Path) -> None:
    place.mkdir(parents=True, exist_ok=True)
    (place / "x.ply").write_text(_PLY)
    mi.Bitmap(np.full((2, 2, 3), 0.5, np.float32)).write(str(place / "x.exr"))


def _body(kind: str, name: str) -> str:
    if kind == "mesh":
        return f'<shape type="ply"><string name="filename" value="{name}"/></shape>'
    return (
        '<shape type="sphere"><bsdf type="diffuse"><texture type="bitmap" name="reflectance">'
        f'<string name="filename" value="{name}"/></texture></bsdf></shape>'
    )


@pytest.mark.parametrize("way", ["above", "absolute", "a link"])
@pytest.mark.parametrize(("kind", "file"), [("mesh", "x.ply"), ("texture", "x.exr")])
def test_assets_outside_are_refused(
    kind: str, file: str, way: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _assets(tmp_path / "other")
    folder = tmp_path / "scene"
    folder.mkdir()
    name = f"../other/{file}"
    if way == "absolute":
        name = str(tmp_path / "other" / file)
    elif way == "a link":
        (folder / file).symlink_to(name)
        name = file
    write_scene(folder, scene(body=_body(kind, name)))
    text = f'scene = "scene.xml"\n[[parameters]]\nkey = "{KEY}"\n[[views]]\nreference = "photo.npy"\n'
    (folder / "problem.toml").write_text(text)
    with pytest.raises(InputError, match=r"lies outside .*--allow-outside"):
        ur.Problem.from_file(folder / "problem.toml")
    assert problem(folder)().shapes()  # a script that names the scene itself
    monkeypatch.setenv(confinement.VARIABLE, "1")
    assert ur.Problem.from_file(folder / "problem.toml").shapes()


def test_assets_in_the_problems_folder_are_read(tmp_path: Path) -> None:
    """project/problem.toml, project/scenes/scene.xml, project/textures/x.exr: a usual layout."""
    _assets(tmp_path / "textures")
    (tmp_path / "scenes").mkdir()
    write_scene(tmp_path / "scenes", scene(body=_body("texture", "../textures/x.exr")))
    text = f'scene = "scenes/scene.xml"\n[[parameters]]\nkey = "{KEY}"\n[[views]]\nreference = "scenes/photo.npy"\n'
    (tmp_path / "problem.toml").write_text(text)
    assert ur.Problem.from_file(tmp_path / "problem.toml").shapes()


def test_a_scene_made_in_python_names_what_it_likes(tmp_path: Path) -> None:
    _assets(tmp_path / "other")
    described = {
        "type": "scene",
        "camera": {"type": "perspective", "film": {"type": "hdrfilm", "width": 6, "height": 4}},
        "sky": {"type": "constant"},
        "wall": {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.2}}},
        "mesh": {"type": "ply", "filename": str(tmp_path / "other" / "x.ply")},
    }
    np.save(tmp_path / "photo.npy", np.full((4, 6, 3), 0.5, np.float32))
    assert ur.Problem(described, [ur.Parameter(KEY)], [ur.View(tmp_path / "photo.npy")]).shapes()
