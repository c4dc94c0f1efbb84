"""The command as a user types it, in this process."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from unrender.app.cli.main import main
from unrender.io import confinement

SCENE = """<scene version="3.0.0">
    <sensor type="perspective">
        <transform name="to_world"><lookat origin="0, 0, 2" target="0, 0, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm">
            <integer name="width" value="6"/><integer name="height" value="4"/><rfilter type="box"/>
        </film>
    </sensor>
    <emitter type="constant"/>
    <shape type="rectangle" id="wall"><bsdf type="diffuse"><rgb name="reflectance" value="0.2"/></bsdf></shape>
</scene>
"""
KEY = "wall.bsdf.reflectance.value"
PROBLEM = f"""\
scene = "wall.xml"
loss = "L2"
max_depth = 2
[[parameters]]
key = "{KEY}"
truth = [0.6, 0.5, 0.4]
[[views]]
reference = "photo.exr"
"""


@dataclass(frozen=True)
class Answer:
    """How a command ended and what it said."""

    status: int
    out: str
    error: str

    def refuses(self, words: str) -> bool:
        """Whether the input was refused in one line with these words."""
        return self.status == 2 and words in self.error and self.error.count("\n") == 1


Unrender = Callable[..., Answer]


@pytest.fixture
def unrender(capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Unrender:
    """`unrender(*arguments)`, in an empty folder of its own."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setenv(confinement.VARIABLE, "0")  # which --allow-outside sets

    def call(*arguments: object) -> Answer:
        capsys.readouterr()
        status = main([str(argument) for argument in arguments])
        said = capsys.readouterr()
        return Answer(status, said.out, said.err)

    return call


@pytest.fixture
def problem(tmp_path: Path) -> Path:
    """A wall under an even sky, all white without the wall's colour: problem.toml."""
    (tmp_path / "wall.xml").write_text(SCENE)
    (tmp_path / "problem.toml").write_text(PROBLEM)
    # Under a sky of radiance 1 a diffuse wall that fills the picture has the radiance of its reflectance.
    photo = np.broadcast_to(np.array([0.6, 0.5, 0.4], np.float32), (4, 6, 3))
    mi.Bitmap(np.ascontiguousarray(photo)).write(str(tmp_path / "photo.exr"))
    return tmp_path / "problem.toml"


@pytest.fixture
def run_once(unrender: Unrender, problem: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """`run_once(*options)`: the run folder `result` of a run of the problem, copied from an earlier test's with the same options.

    The copy is what the run would have left here: the folder's own path in its files is this one's.
    """

    def run(*options: object) -> Path:
        folder = problem.parent / "result"
        words = [str(option) for option in options]
        if (known := _runs.get(tuple(words))) is None:
            answer = unrender("run", "problem.toml", "--out", "result", *words)
            assert answer.status == 0, answer.error
            kept = tmp_path_factory.mktemp("run") / "result"
            shutil.copytree(folder, kept)
            _runs[tuple(words)] = kept, problem.parent
            return folder
        kept, place = known
        shutil.copytree(kept, folder)
        for path in folder.rglob("*"):
            if path.suffix in (".json", ".toml") and str(place) in (text := path.read_text(encoding="utf-8")):
                path.write_text(text.replace(str(place), str(problem.parent)), encoding="utf-8")
        return folder

    return run


_runs: dict[tuple[str, ...], tuple[Path, Path]] = {}
"""{options: (a copy of the run folder, where the run was)} of this test process."""
