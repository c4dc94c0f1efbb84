"""Problem files: what they may say, and that each mistake is told with its line and its field."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from unrender import losses
from unrender.core.errors import InputError
from unrender.io import toml_lines
from unrender.preconditioners import LargeSteps
from unrender.scene.problem import Problem

SCENE = """<scene version="3.0.0">
    <sensor type="perspective">
        <film type="hdrfilm"><integer name="width" value="6"/><integer name="height" value="4"/><rfilter type="box"/></film>
    </sensor>
    <emitter type="constant"/>
    <shape type="rectangle" id="wall">
        <bsdf type="diffuse" id="paint">
            <texture type="bitmap" name="reflectance"><string name="filename" value="paint.exr"/></texture>
        </bsdf>
    </shape>
</scene>
"""
KEY = "wall.bsdf.reflectance.data"
REFERENCE = np.random.default_rng(0).random((4, 6, 3)).astype(np.float32)

FULL = f"""\
# A wall and its photograph.
name = "the wall"
scene = "scenes/wall.xml"
max_depth = 3
loss = {{ type = "Huber", delta = 0.2 }}

[[parameters]]
key = "{KEY}"
initial = "start.png"
bounds = [
    0.1,  # not quite black
    inf,
]
learning_rate = 0.02
truth = [0.5, 0.4, 0.3]

[parameters.preconditioner]
type = "LargeSteps"
strength = 3

[[views]]
reference = "photo.exr"
weight = 2
mask = "mask.png"
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "scenes").mkdir()
    (tmp_path / "scenes" / "wall.xml").write_text(SCENE)
    mi.Bitmap(np.full((8, 8, 3), 0.5, np.float32)).write(str(tmp_path / "scenes" / "paint.exr"))
    mi.Bitmap(np.full((8, 8, 3), 188, np.uint8)).write(str(tmp_path / "start.png"))
    mi.Bitmap(REFERENCE).write(str(tmp_path / "photo.exr"))
    mi.Bitmap(np.full((4, 6), 255, np.uint8)).write(str(tmp_path / "mask.png"))
    return tmp_path


def write(folder: Path, text: str) -> Path:
    path = folder / "problem.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_reads_everything_relative_to_the_file(folder: Path):
    problem = Problem.from_file(write(folder, FULL))
    assert problem.name == "the wall"
    assert problem.max_depth == 3
    assert problem.loss == losses.Huber(0.2)
    assert problem.unknowns[KEY].bounds == (0.1, None)
    assert problem.learning_rates == {KEY: 0.02}
    assert problem.unknowns[KEY].preconditioner == LargeSteps(3)
    np.testing.assert_allclose(problem.initial()[KEY].numpy(), 0.5029, atol=1e-4)
    np.testing.assert_allclose(problem.truth[KEY], np.broadcast_to([0.5, 0.4, 0.3], (8, 8, 3)))
    np.testing.assert_array_equal(problem.views[0].reference, REFERENCE)
    assert problem.views[0].weight == 2.0
    np.testing.assert_array_equal(problem.views[0].mask, np.ones((4, 6)))
    assert problem.notices == [f"parameter {KEY}: initial start.png: 8-bit sRGB, linearised"]


SHORT = f"""\
scene = "scenes/wall.xml"
loss = "L1"
[[parameters]]
key = "{KEY}"
[[views]]
reference = "photo.exr"
"""


def test_little_is_required(folder: Path):
    problem = Problem.from_file(str(write(folder, SHORT)))
    assert problem.name == "problem"
    assert problem.loss == losses.L1()
    assert problem.unknowns[KEY].bounds == (0.0, 1.0)
    assert problem.max_depth == 6


# What to replace in SHORT, by what, the line, and how the message begins.
MISTAKES = [
    # the text itself
    ('"L1"', '"L1', 2, "not valid TOML: "),
    ('"L1"', '"L1" "L2"', 2, "not valid TOML: "),
    ('loss = "L1"', 'scene = "again.xml"', 2, "not valid TOML: "),
    ("[[parameters]]", "[parameters]\n[[parameters]]", 4, "not valid TOML: Cannot "),
    # names of fields
    ("scene =", "scen =", 1, "scen: no such field; did you mean scene?"),
    (
        'loss = "L1"',
        "zzz = 1",
        2,
        "zzz: no such field; there are scene, parameters, views, name, max_depth, expressions, loss",
    ),
    (
        'reference = "photo.exr"',
        'refrence = "photo.exr"',
        6,
        "views[0].refrence: no such field; did you mean reference?",
    ),
    ("key =", "initial = 1\nkye =", 5, "parameters[0].kye: no such field; did you mean key?"),
    # missing
    ('scene = "scenes/wall.xml"', "", 1, "scene: missing, expected the path of a Mitsuba .xml file"),
    ('reference = "photo.exr"', "", 5, "views[0].reference: missing, expected the path of a picture"),
    (
        f'key = "{KEY}"',
        "",
        3,
        "parameters[0].key: missing, expected the name of a scene parameter, or several names as keys",
    ),
    ("[[views]]", "[[parameters]]\nkey='x'\n#", 8, "parameters[1].reference: no such field"),
    # kinds
    ('"scenes/wall.xml"', "3", 1, "scene: expected the path of a Mitsuba .xml file, got 3"),
    ('"L1"', "3", 2, 'loss: expected a name such as "L1"'),
    ("[[views]]", "[views]", 5, "views: expected at least one [[views]] table"),
    (
        "[[parameters]]",
        "max_depth = 2.5\n[[parameters]]",
        3,
        "max_depth: expected a whole number of at least 1, got 2.5",
    ),
    ("[[parameters]]", "max_depth = 0\n[[parameters]]", 3, "max_depth: expected a whole number of at least 1, got 0"),
    ("[[views]]", "initial = true\n[[views]]", 5, "parameters[0].initial: expected a number, a colour"),
    (
        "[[views]]",
        "learning_rate = '1'\n[[views]]",
        5,
        "parameters[0].learning_rate: expected a number above 0, got '1'",
    ),
    ("[[views]]", "bounds = [1]\n[[views]]", 5, "parameters[0].bounds: expected two numbers [low, high]"),
    (
        "[[views]]",
        "bounds = [\n0,\n'x']\n[[views]]",
        5,
        "parameters[0].bounds: expected two numbers [low, high] (inf is unbounded), got 'x'",
    ),
    ("[[views]]", "[[views]]\nsensor = 1.5", 6, "views[0].sensor: expected the index of a sensor"),
    # values
    (
        '"L1"',
        '"L3"',
        2,
        'loss: expected "L1" or "L2" or "RelativeL2" or "Huber" or "Perceptual" or "Censored", got "L3"',
    ),
    (
        '"L1"',
        '"huber"',
        2,
        'loss: expected "L1" or "L2" or "RelativeL2" or "Huber" or "Perceptual" or "Censored", got "huber"; did you mean Huber?',
    ),
    ('"L1"', '{ type = "Huber", dleta = 1 }', 2, "loss: Huber has no option dleta; did you mean delta?"),
    ('"L1"', '{ type = "Huber", delta = -1 }', 2, "loss: Huber: delta must be"),
    ("wall.xml", "wal.xml", 1, "scene: "),
    (
        "reflectance",
        "reflectnce",
        4,
        f"parameters[0].key: the scene has no parameter wall.bsdf.reflectnce.data; did you mean {KEY}?",
    ),
    ("[[views]]", "bounds = [1, 0]\n[[views]]", 5, "parameters[0].bounds: low must be less than high, got 1 and 0"),
    ("[[views]]", "learning_rate = -1\n[[views]]", 5, "parameters[0].learning_rate: expected a number above 0, got -1"),
    ("[[views]]", "truth = [1, 2]\n[[views]]", 5, "parameters[0].truth: expected a number, a colour (3 numbers)"),
    (
        "[[views]]",
        "[parameters.preconditioner]\ntype = 'LargeStep'\n[[views]]",
        5,
        'parameters[0].preconditioner: expected "LargeSteps" or "Sobolev", got "LargeStep"; did you mean LargeSteps?',
    ),
    (
        "[[views]]",
        "parameterisation = 'lgo'\n[[views]]",
        5,
        "parameters[0].parameterisation: unknown 'lgo'; did you mean log?",
    ),
    (
        "[[views]]",
        "bounds = [-inf, 1]\nparameterisation = 'log'\n[[views]]",
        6,
        "parameters[0].parameterisation: log needs a lower bound, got bounds open to 1; give bounds, such as [0, inf]",
    ),
    (
        "[[views]]",
        "parameterisation = 3\n[[views]]",
        5,
        'parameters[0].parameterisation: expected "identity" or "log", got 3',
    ),
    (
        "[[views]]",
        "parameterisation = 'log(x)'\n[[views]]",
        5,
        "parameters[0].parameterisation: expected log(), got 'log(x)'",
    ),
    ("[[views]]", "preconditioner = 'LargeSteps'\ninitial = 'no.png'\n[[views]]", 6, "parameters[0].initial: "),
    (
        "photo.exr",
        "scenes/paint.exr",
        6,
        "views[0].reference: paint.exr: 8x8 pixels (width x height), but the sensor's film is 6x4",
    ),
    ("photo.exr", "photo.gif", 6, "views[0].reference: "),
    ("[[views]]", "[[views]]\nsensor = 1", 6, "views[0].sensor: expected 0, the only sensor, got 1"),
    (
        "[[views]]",
        "[[views]]\nreference = 'photo.exr'\n[[views]]\nweight = 0\n",
        8,
        "views[1].weight: expected a number above 0, got 0",
    ),
]


@pytest.mark.parametrize(("old", "new", "line", "message"), MISTAKES)
def test_every_mistake_is_one_line_with_its_place(folder: Path, old: str, new: str, line: int, message: str):
    assert SHORT.count(old) == 1
    with pytest.raises(InputError) as caught:
        Problem.from_file(write(folder, SHORT.replace(old, new)))
    assert str(caught.value).startswith(f"{folder / 'problem.toml'}:{line}: {message}")
    assert "\n" not in str(caught.value)


def test_refuses_what_is_no_text(folder: Path):
    with pytest.raises(InputError, match=r"nowhere\.toml: no such file"):
        Problem.from_file(folder / "nowhere.toml")
    with pytest.raises(InputError, match="a folder, expected a file"):
        Problem.from_file(folder)
    (folder / "binary.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match=r"binary\.toml: not UTF-8"):
        Problem.from_file(folder / "binary.toml")


def test_broken_xml_is_one_line(folder: Path):
    (folder / "scenes" / "wall.xml").write_text(SCENE.replace("</shape>", ""))
    with pytest.raises(InputError, match=r"problem\.toml:1: scene: .*wall\.xml") as caught:
        Problem.from_file(write(folder, SHORT))
    assert "\n" not in str(caught.value)


def test_windows_line_ends_and_byte_order_mark(folder: Path):
    text = "\ufeff" + SHORT.replace('"L1"', '"L9"')
    path = folder / "problem.toml"
    path.write_bytes(text.replace("\n", "\r\n").encode("utf-8"))
    with pytest.raises(InputError, match=r"problem\.toml:2: loss: "):
        Problem.from_file(path)


LINES = '''\
a = """
[not.a.table]
b = 1
"""
"quoted key" = 1
c.d.e = 2
f = [
  { g = 1 },

  { g = 2 },
]
[h]
i = 1
[h.j]
k = 1
[[l]]
[[l.m]]
n = 1
[[l.m]]
n = 2
[[l]]
[l.o]
p = 1  # [[l]]
'''


@pytest.mark.parametrize(
    ("place", "line"),
    [
        (("a",), 1),
        (("quoted key",), 5),
        (("c", "d", "e"), 6),
        (("c",), 6),
        (("f",), 7),
        (("f", 1, "g"), 7),
        (("h", "i"), 13),
        (("h", "j", "k"), 15),
        (("h", "missing"), 12),
        (("l", 0), 16),
        (("l", 0, "m", 0, "n"), 18),
        (("l", 0, "m", 1, "n"), 20),
        (("l", 1), 21),
        (("l", 1, "o", "p"), 23),
        (("b",), 1),
        ((), 1),
    ],
)
def test_finds_lines(place: tuple, line: int):
    assert toml_lines.find(LINES, place) == line
