"""Bad input: status 2, one line on standard error, nothing left behind."""

from __future__ import annotations

import os
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from unrender.backend import variant
from unrender.core.errors import VariantError

# Arguments, and what the line says. None of them reaches a renderer.
MISTAKES = [
    (["rnu"], "No such command 'rnu'. Did you mean 'run'?"),
    (["run"], "Missing argument 'PROBLEM'"),
    (["run", "problem.toml", "--stpes", "3"], "No such option: --stpes"),
    (["run", "problem.toml", "--steps", "many"], "Invalid value for '--steps'"),
    (["run", "problem.toml", "--steps", "0"], "--steps 0: expected at least 1"),
    (["run", "problem.toml", "--steps", "-5"], "--steps -5: expected at least 1"),
    (["run", "problem.toml", "--seconds", "-1"], "--seconds -1: expected a number above 0"),
    (["run", "problem.toml", "--seconds", "nan"], "--seconds nan: expected a number above 0"),
    (["run", "problem.toml", "--seconds", "inf"], "--seconds inf: expected a number above 0"),
    (["run", "problem.toml", "--seed", "-1"], "Invalid value for '--seed'"),
    (["run", "problem.toml", "--final-spp", "0"], "Invalid value for '--final-spp'"),
    (["run", "problem.toml", "--method", "rvc"], "unknown method rvc; did you mean rcv?"),
    (["run", "problem.toml", "--set", "spp"], "--set spp: expected NAME=VALUE"),
    (["run", "problem.toml", "--set", "=3"], "--set =3: expected NAME=VALUE"),
    (["run", "problem.toml", "--set", "spp=2", "--set", "spp=4"], "--set spp=4: spp is set twice"),
    (["run", "problem.toml", "--set", "spp=-2"], "option spp: expected a whole number above 0 or none, got '-2'"),
    (
        ["run", "problem.toml", "--set", f"spp={2**31}"],
        "option spp: expected a whole number above 0 or none and below 2**31",
    ),
    (["run", "problem.toml", "--set", f"spp={10**30}"], "option spp: expected a whole number above 0 or none"),
    (["run", "problem.toml", "--final-spp", str(10**23)], "Invalid value for '--final-spp'"),
    (["run", "problem.toml", "--checkpoint-every", str(10**23)], "Invalid value for '--checkpoint-every'"),
    (["compare", "problem.toml", "--seeds", str(10**11)], "Invalid value for '--seeds'"),
    (
        ["sweep", "problem.toml", "--over", "learning_rate=0.1,0.2", "--seeds", str(2**30)],
        "Invalid value for '--seeds'",
    ),
    (
        ["sweep", "problem.toml", "--over", "learning_rate=0.1:1:log", "--trials", str(2**30)],
        "Invalid value for '--trials'",
    ),
    (["run", "problem.toml", "--set", "sp=2"], "method auto has no option sp; did you mean spp?"),
    (
        ["run", "problem.toml", "-m", "rcv", "--set", "schedule=cosin(9)"],
        "schedule: unknown 'cosin'; did you mean cosine?",
    ),
    (["run", "problem.toml", "--set", "steps=x"], "--set steps=x: expected a whole number"),
    (["run", "problem.toml", "--set", "seconds=x"], "--set seconds=x: expected a number"),
    (["run", "problem.toml", "--set", "steps=3", "--steps", "3"], "--set steps=3: --steps is given as well"),
    (["run", "problem.toml", "--variant", "cuda_ad_rbg"], "did you mean cuda_ad_rgb?"),
    (["run", "problem.toml", "--problem-set", "resolution=8"], "--problem-set resolution: only gallery problems"),
    (["run", "missing.toml"], "missing.toml: no such file"),
    (
        ["run", "problem.toml", "--out=~/run"],
        "--out=~/run: the shell has not replaced ~ by the home folder; write $HOME/run",
    ),
    (["run", "problems.toml"], "problems.toml: no such file; did you mean problem.toml?"),
    (["run", "problem"], "no problem problem: neither a TOML file nor in the gallery; did you mean problem.toml?"),
    (["run", "wall.xml"], "wall.xml: a scene does not define the unknowns"),
    (["run", "indirect-rom"], "neither a TOML file nor in the gallery; did you mean indirect-room?"),
    (["run", "indirect-room", "-p", "resolutoin=8"], "no option resolutoin; did you mean resolution?"),
    (["run", "indirect-room", "-p", "resolution=-8"], "resolution"),
    (["run", "indirect-room", "-p", "resolution=big"], "resolution"),
    (["run", "indirect-room", "-p", "resolution=1000000000"], "resolution must be at most 8192, got 1000000000"),
    (["run", "indirect-room", "-p", "reference_spp=1000000000"], "reference_spp must be at most 16777216"),
    (["run", "exponential", "-p", f"max_depth={10**30}"], "max_depth"),
    (["run", "problem.toml", "--out", "problem.toml"], "--out problem.toml: a file, expected a folder"),
    (["run", "problem.toml", "--out", "problem.toml/run"], "--out problem.toml/run: Not a directory"),
    (["run", "problem.toml", "--out", "."], "--out .: the folder is not empty and holds no earlier results"),
    (["run", "problem.toml", "--out", ".", "--overwrite"], "--out .: the folder is not empty"),
    (["methods", ""], "unknown method ; there are auto, plain"),
    (["methods", "plian"], "unknown method plian; did you mean plain?"),
    (["gallery", "indirect-rooms"], "did you mean indirect-room?"),
    (["report", "nowhere"], "nowhere"),
    (["report", "."], "run.json"),
    (["compare"], "Missing argument"),
    (["compare", "problem.toml", "--methods", "plain,rvc"], "unknown method rvc; did you mean rcv?"),
    (["compare", "problem.toml", "--methods", ","], "--methods: expected at least one name"),
    (["compare", "problem.toml", "--methods", "rcv,rcv"], "--methods: rcv is listed twice"),
    (["compare", "problem.toml", "--seconds", "0"], "--seconds 0: expected a number above 0"),
    (["compare", "problem.toml", "--seeds", "0"], "Invalid value for '--seeds'"),
    (["compare", "problem.toml", "--set", "rvc.spp=2"], "rvc is not one of the methods stock, auto"),
    (["compare", "problem.toml", "--set", "space=path"], "method stock has no option space"),
    (["compare", "problem.toml", "--set", "auto.spp=0"], "method auto: option spp: expected a whole number above 0"),
    (["compare", ".", "nowhere"], "nowhere: no such run folder"),
    (["compare", "."], "run.json"),
]
MISTAKES += [  # options that would be ignored
    *(
        (["compare", ".", name, *value], f"compare: {name} does not apply to run folders; leave it out")
        for name, *value in (
            ("--seconds", "3"),
            ("--seeds", "2"),
            ("--set", "spp=2"),
            ("--final-spp", "4"),
            ("--no-cache",),
        )
    ),
    (["compare", ".", "-p", "resolution=8"], "compare: --problem-set does not apply to run folders"),
    (
        ["run", "problem.toml", "--no-cache"],
        "--no-cache: only the references of gallery problems are cached; leave it out",
    ),
    (["compare", "problem.toml", "--no-cache"], "--no-cache: only the references of gallery problems are cached"),
    (
        ["export", "problem.toml", "--format", "ply", "--spp", "4"],
        "--spp: only the format mitsuba writes scene.xml; leave it out",
    ),
    (["methods", "rcv", "--variant", "auto"], "methods: --variant needs --plan PROBLEM"),
    (["methods", "-s", "spp=2"], "methods: --set needs --plan PROBLEM"),
    (["run", "."], ".: a folder, expected a problem file; did you mean problem.toml?"),
    (["methods", "--plan", "."], ".: a folder, expected a problem file; did you mean problem.toml?"),
    (["run", "photo.exr"], "photo.exr: expected a problem file, whose name ends in .toml"),
    (
        ["compare", "problem.toml", "wall.xml"],
        "problem.toml: not a run folder; give one problem, or several run folders",
    ),
    (["export", "wall.xml"], "wall.xml: a file, expected a run folder or a problem file (.toml)"),
]


_LONG = "A" * 5000
MISTAKES += [  # names that no file can have
    (["run", _LONG], "File name too long"),
    (["run", f"{_LONG}.toml"], "File name too long"),
    (["run", "problem.toml", "--out", _LONG], "File name too long"),
    (["run", "problem.toml", "--method", _LONG], "unknown method AAAA"),
    (["run", "problem.toml", "--set", f"{_LONG}=1"], "has no option AAAA"),
    (["run", "problem.toml", "--set", "resolution=64"], "-p sets options of a gallery problem"),
    (["run", "indirect-room", "-p", f"{_LONG}=1"], "no option AAAA"),
    (["compare", _LONG], "File name too long"),
    (["compare", ".", _LONG], "File name too long"),
    (["report", _LONG], "File name too long"),
    (["resume", _LONG], "File name too long"),
    (["export", _LONG], "File name too long"),
    (["watch", _LONG], "File name too long"),
    (["gallery", _LONG], "AAAA"),
    (["methods", _LONG], "AAAA"),
    (["run", "\x1b]0;owned\x07\x9b2J.toml"], "\\x1b]0;owned\\x07\\x9b2J.toml: no such file"),
    (["methods", "\x1b[2J"], "unknown method \\x1b[2J"),
]


def check(answer, message: str, status: int = 2) -> None:
    assert answer.status == status
    assert message in answer.error
    assert answer.error.startswith("unrender: ")
    assert answer.error.count("\n") == 1
    assert "Traceback" not in answer.out + answer.error
    assert len(answer.error) < 1100
    assert answer.error[:-1].isprintable()


@pytest.mark.parametrize(("words", "message"), MISTAKES)
def test_mistakes_are_one_line(unrender, problem: Path, words: list[str], message: str):
    before = sorted(problem.parent.rglob("*"))
    check(unrender(*words), message)
    assert sorted(problem.parent.rglob("*")) == before


@pytest.mark.parametrize("words", [["watch", "loop"], ["import", ".", "--out", "loop"]])
def test_links_in_a_circle_are_one_line(unrender, problem: Path, words: list[str]) -> None:
    (problem.parent / "loop").symlink_to("loop")
    check(unrender(*words), "loop")


# How to spoil the files of a problem, and what the line says.
def _nan(folder: Path) -> None:
    photo = np.full((4, 6, 3), 0.5, np.float32)
    photo[1, 2] = np.nan
    mi.Bitmap(photo).write(str(folder / "photo.exr"))


def _wrong_size(folder: Path) -> None:
    mi.Bitmap(np.zeros((6, 4, 3), np.float32)).write(str(folder / "photo.exr"))


def _pipe(name: str):
    def spoil(folder: Path) -> None:
        (folder / name).unlink()
        os.mkfifo(folder / name)

    return spoil


def _edit(name: str, old: str, new: str):
    def spoil(folder: Path) -> None:
        text = (folder / name).read_text()
        assert old in text
        (folder / name).write_text(text.replace(old, new))

    return spoil


SPOILT = [
    (_nan, "problem.toml:8: views[0].reference: photo.exr: 1 pixel is NaN or infinite, the first in row 1, column 2"),
    (
        _wrong_size,
        "problem.toml:8: views[0].reference: photo.exr: 4x6 pixels (width x height), but the sensor's film is 6x4",
    ),
    (lambda folder: (folder / "photo.exr").write_bytes(b"v/1\x01"), "photo.exr: cannot be read as a picture"),
    (lambda folder: (folder / "photo.exr").unlink(), "problem.toml:8: views[0].reference: photo.exr: no such file"),
    (lambda folder: (folder / "wall.xml").unlink(), "problem.toml:1: scene: wall.xml: no such file"),
    (_edit("wall.xml", "</film>", ""), "problem.toml:1: scene: wall.xml:7: not XML: mismatched tag"),
    (_edit("wall.xml", "diffuse", "difuse"), "problem.toml:1: scene: wall.xml: Mitsuba could not load it"),
    (_edit("problem.toml", "photo.exr", "photo.ex"), "photo.ex: no such file; did you mean photo.exr?"),
    (_edit("problem.toml", "wall.xml", "walls.xml"), "walls.xml: no such file; did you mean wall.xml?"),
    (_pipe("photo.exr"), "problem.toml:8: views[0].reference: photo.exr: not a file"),
    (_pipe("wall.xml"), "problem.toml:1: scene: wall.xml: not a file"),
    (_pipe("problem.toml"), "problem.toml: not a regular file"),
    (
        _edit("problem.toml", "max_depth = 2", "max_depth = 4294967296"),
        "problem.toml:3: max_depth: expected at most 1048576",
    ),
    (_edit("problem.toml", "max_depth = 2", f'name = "{_LONG}"'), "problem.toml:3: name: expected a string of at most"),
    (_edit("problem.toml", "photo.exr", _LONG + ".exr"), "File name too long"),
    (_edit("problem.toml", "photo.exr", "\\u001b]0;owned\\u0007.exr"), "\\x1b]0;owned\\x07.exr: no such file"),
    (_edit("wall.xml", "diffuse", "\u202ediffuse"), "expected the name of a plugin"),
    (_edit("problem.toml", "reflectance", "reflectence"), "did you mean wall.bsdf.reflectance.value?"),
    (
        _edit("problem.toml", "truth =", "bounds = [1.0, 0.0]\ntruth ="),
        "problem.toml:6: parameters[0].bounds: low must",
    ),
    (_edit("problem.toml", '"L2"', '"L2'), "problem.toml:2: not valid TOML"),
    (
        _edit("problem.toml", "[[parameters]]", "[[parameter]]"),
        "problem.toml:4: parameter: no such field; did you mean parameters?",
    ),
    (_edit("problem.toml", "wall.bsdf.reflectance.value", "wall.to_world"), "cannot be recovered: its type"),
]


@pytest.mark.parametrize(("spoil", "message"), SPOILT)
def test_spoilt_files_are_one_line(unrender, problem: Path, mitsuba_variant: str, spoil, message: str):
    spoil(problem.parent)
    check(unrender("run", "problem.toml", "--out", "result", "--variant", mitsuba_variant), message)
    assert not (problem.parent / "result").exists()


def test_a_machine_without_libraries_is_status_3(unrender, monkeypatch: pytest.MonkeyPatch):
    def fail() -> None:
        raise VariantError("libatomic.so.1 not found, which Dr.Jit needs; install: this")

    monkeypatch.setattr(variant, "prepare", fail)
    check(unrender("methods"), "libatomic.so.1 not found, which Dr.Jit needs; install: this", status=3)


def test_a_machine_that_cannot_is_status_3(unrender, problem: Path, monkeypatch: pytest.MonkeyPatch):
    def fail(name: str) -> str:
        raise VariantError("no LLVM library was found; install: this")

    monkeypatch.setattr(variant, "use", fail)
    check(unrender("run", "problem.toml"), "no LLVM library was found; install: this", status=3)


def test_names_of_a_scene_do_not_command_the_terminal(unrender, problem: Path, mitsuba_variant: str):
    """XML knows no ESC, but the controls of one character (C1) and those of direction."""
    wall = problem.parent / "wall.xml"
    wall.write_text(wall.read_text().replace('id="wall"', 'id="wall&#x9b;2J&#x202e;"'))
    problem.write_text(problem.read_text().replace('"wall.bsdf', '"wall\\u009b2J\\u202E.bsdf'))
    problem.write_text('name = "\\u001b]0;owned\\u0007"\n' + problem.read_text())
    options = ("--set", "spp=1", "--steps", "2", "--final-spp", "1", "--variant", mitsuba_variant)
    answer = unrender("run", "problem.toml", "--method", "plain", *options, "--out", "out")
    assert answer.status == 0, answer.error
    said = answer.out + answer.error
    assert "\\x9b2J\\u202e.bsdf" in said
    assert "\\x1b]0;owned" in said
    assert all(letter.isprintable() or letter in "\n\t" for letter in said)
    page = (problem.parent / "out" / "report.html").read_text()
    assert "owned" in page
    assert all(letter.isprintable() or letter in "\n\t" for letter in page)


def test_a_deleted_current_folder_is_one_line(unrender, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Mitsuba's import ended the process."""
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    assert unrender("run", "indirect-room").refuses("the current folder no longer exists; change to another one")
