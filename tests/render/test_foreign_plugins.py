"""Shared libraries beside a scene, in the current directory, or elsewhere: none of them is loaded."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from hostile_inputs import problem, scene, write_scene

import unrender as ur
from unrender.backend import plugins
from unrender.core.errors import InputError
from unrender.rendering.mitsuba import description

_ENDING = {"win32": ".dll", "darwin": ".dylib"}.get(sys.platform, ".so")
_SOURCE = """
#include <stdio.h>
#include <stdlib.h>
__attribute__((constructor)) static void begin(void) {
    FILE *file = fopen(getenv("UNRENDER_TEST_MARKER"), "a");
    if (file) { fputs("was here\\n", file); fclose(file); }
}
"""
_TYPE = "unrender_test_foreign"


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A library that leaves a mark when it is loaded. Without a compiler, one that cannot be loaded: trying is an error of Mitsuba's."""
    folder = tmp_path_factory.mktemp("library")
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    made = folder / "foreign.so"
    if compiler is None:
        made.write_bytes(b"\x7fELF no library")
        return made
    (folder / "foreign.c").write_text(_SOURCE)
    subprocess.run([compiler, "-shared", "-fPIC", "-o", str(made), str(folder / "foreign.c")], check=True, timeout=60)
    return made


@pytest.fixture
def marker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the library leaves its mark. The current directory is an empty one."""
    place = tmp_path / "marker"
    monkeypatch.setenv("UNRENDER_TEST_MARKER", str(place))
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    return place


def _plant(library: Path, folder: Path, *types: str) -> None:
    """Libraries under the names of these types, as plugins of a folder."""
    (folder / "plugins").mkdir(parents=True)
    for kind in types:
        (folder / "plugins" / f"{kind}{_ENDING}").symlink_to(library)


def test_the_library_would_be_loaded(library: Path, marker: Path):
    """What the other tests rest on: Mitsuba's own loader does load it, and says that it is no plugin."""
    _plant(library, Path(), _TYPE)
    with pytest.raises(RuntimeError, match=r"entry point|loading plugin"):
        mi.load_dict({"type": _TYPE})
    assert marker.exists() or not shutil.which("cc")


@pytest.mark.parametrize("where", ["beside the scene", "here"])
def test_a_plugin_of_a_folder_is_not_loaded(library: Path, marker: Path, tmp_path: Path, where: str):
    folder = tmp_path / "mailed"
    folder.mkdir()
    _plant(library, folder if where == "beside the scene" else Path(), _TYPE)
    write_scene(folder, scene(body=f'<shape type="{_TYPE}"/>'))
    with pytest.raises(InputError, match=_TYPE) as caught:
        problem(folder)()
    assert "entry point" not in str(caught.value)
    assert "Error while loading plugin" not in str(caught.value)
    assert not marker.exists()


def test_a_plugin_of_a_search_path_is_not_loaded(library: Path, marker: Path, tmp_path: Path):
    folder = tmp_path / "mailed"
    _plant(library, folder / "parts", _TYPE)
    write_scene(folder, scene(head='<path value="parts"/>', body=f'<shape type="{_TYPE}"/>'))
    with pytest.raises(InputError, match=_TYPE):
        problem(folder)()
    given = {"type": "scene", "a": {"type": "resources", "path": str(folder / "parts")}, "b": {"type": _TYPE}}
    with pytest.raises(Exception, match=_TYPE) as caught:
        description.load(given)
    assert "entry point" not in str(caught.value)
    assert not marker.exists()


@pytest.mark.parametrize(
    "form", ["{folder}/x", "../mailed/x", "../../mailed/x", "sub/../x", "x.y", "", " x", "x\n", "a" * 101]
)
def test_types_are_names(library: Path, marker: Path, tmp_path: Path, form: str):
    """Mitsuba joins a type to a folder's name: an absolute one takes its place."""
    folder = tmp_path / "mailed"
    folder.mkdir()
    (folder / "x.so").symlink_to(library)
    (folder / "sub").mkdir()
    with pytest.raises(InputError, match="expected the name of a plugin"):
        description.load({"type": "scene", "a": {"type": form.format(folder=folder)}})
    assert not marker.exists()


def test_a_plugin_in_python_is_no_library(library: Path, marker: Path):
    """Mitsuba looks for a library of the name of a plugin that is registered in Python, too."""
    ur.gallery.names()
    given = {"type": "scene", "cube": {"type": "cube", "interior": {"type": "emissive"}}}
    with pytest.raises(Exception, match="sigma_t"):
        description.load(given)
    _plant(library, Path(), "emissive")
    with pytest.raises(InputError, match=r"emissive.* is not Mitsuba's"):
        description.load(given)
    assert not marker.exists()


def test_mitsuba_looks_into_its_own_folder_first():
    """For what this package, the user and Mitsuba itself make without a description."""
    assert plugins.search_paths()[0] == plugins.own_folder()
    assert (plugins.own_folder() / "plugins" / f"diffuse{_ENDING}").exists()
    before = plugins.search_paths()
    plugins.prefer_own()
    assert plugins.search_paths() == before
    with plugins.only(Path("/nowhere")):
        assert plugins.search_paths() == [Path("/nowhere")]
    assert plugins.search_paths() == before


def test_files_are_found_where_mitsuba_finds_them(tmp_path: Path, marker: Path):
    """Beside the scene, in a folder that it names, beside where the program runs; the scene's folder goes first."""
    folder = tmp_path / "scene"
    for place, grey in ((folder, 0.1), (folder / "parts", 0.2), (Path(), 0.3)):
        place.mkdir(exist_ok=True)
        for name in {folder: "a", folder / "parts": "ab", Path(): "abc"}[place]:
            mi.Bitmap(np.full((2, 2, 3), grey, np.float32)).write(str(place / f"{name}.exr"))
    text = '<texture type="bitmap" name="reflectance"><boolean name="raw" value="true"/><string name="filename" value="{}"/></texture>'
    for name, grey in (("a.exr", 0.1), ("b.exr", 0.2), ("c.exr", 0.3), (str(folder / "parts" / "a.exr"), 0.2)):
        write_scene(folder, scene(bsdf=text.format(name)).replace("</scene>", '<path value="parts"/></scene>'))
        found = problem(folder, key="wall.bsdf.reflectance.data")
        if name == "a.exr":  # a folder that is named goes before the scene's own
            grey = 0.2
        np.testing.assert_allclose(np.asarray(found().initial()["wall.bsdf.reflectance.data"]), grey, rtol=1e-3)


@pytest.mark.slow
def test_commands_load_no_plugins_of_where_they_run(library: Path, marker: Path, tmp_path: Path):
    """`doctor`, `run`, `resume` and `export` in a folder with a library for each of Mitsuba's own types."""
    own = [path.stem for path in (plugins.own_folder() / "plugins").iterdir() if path.suffix == _ENDING]
    assert len(own) > 50
    folder = tmp_path / "downloads"
    _plant(library, folder, *own)
    write_scene(folder, scene())
    text = 'scene = "scene.xml"\nmax_depth = 2\n[[parameters]]\nkey = "wall.bsdf.reflectance.value"\n[[views]]\nreference = "photo.npy"\n'
    (folder / "problem.toml").write_text(text)
    run = "run problem.toml --method plain --set spp=2 --steps 2 --out out --final-spp 1"
    for words in ("doctor", run, "resume out --steps 3", "export out"):
        command = [
            sys.executable,
            "-m",
            "unrender",
            *words.split(),
            *(["--variant", "llvm_ad_rgb"] if words != "doctor" else []),
        ]
        done = subprocess.run(command, cwd=folder, env=os.environ, capture_output=True, text=True, timeout=200)
        assert not marker.exists(), words
        assert done.returncode == 0, (words, done.stderr[-2000:])
    code = "from unrender.backend import variant; print(variant.gpu_trial(variant='llvm_ad_rgb'))"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=folder, env=os.environ, capture_output=True, text=True, timeout=200
    )
    assert done.stdout.strip() == "None", done
    assert not marker.exists()


def test_a_run_folder_brings_no_plugins(library: Path, marker: Path, tmp_path: Path):
    """Its problem may name a scene inside it."""
    folder = tmp_path / "run"
    _plant(library, folder, _TYPE)
    write_scene(folder, scene(body=f'<shape type="{_TYPE}"/>'))
    table: dict[str, Any] = {"folder": folder}
    text = 'scene = "{folder}/scene.xml"\n[[parameters]]\nkey = "a"\n[[views]]\nreference = "{folder}/photo.npy"\n'
    (folder / "problem.toml").write_text(text.format(**table))
    from unrender.runs import reopen

    (folder / "run.json").write_text('{"name": "a", "method": "plain"}')
    with pytest.raises(InputError, match=_TYPE):
        reopen.problem_of(folder)
    assert not marker.exists()
