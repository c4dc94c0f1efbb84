"""The command as a user types it, in this process."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from unrender.cli.main import main

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


Unrender = Callable[..., Answer]


@pytest.fixture
def unrender(capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Unrender:
    """`unrender(*arguments)`, in an empty folder of its own."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")

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
