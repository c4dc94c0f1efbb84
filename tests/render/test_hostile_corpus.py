"""Hostile inputs and damaged run folders: none hangs, none runs code, and each is refused in a line, in little time and memory."""

from __future__ import annotations

import sys
from pathlib import Path

import fuzz_inputs
import hostile_folders
import hostile_inputs
import pytest
from hostile_inputs import INPUTS, ply
from hostile_worker import Outcome, take_in

from unrender.core.errors import InputError
from unrender.rendering.mitsuba import description

_SECONDS, _WALL, _BYTES = 1.0, 10.0, 1 << 30
"""Of an input at most. The clock goes on while other processes run: it is held to what is no hang."""

_DEAR = (  # to write
    "a PNG of zeros",
    "forty textures of 75 million values",
    "a hundred megabytes of problem file",
    "an archive of 400000 names",
    "an archive of four gigabytes of zeros",
    "a list of a hundred thousand lines",
    "a thousand includes",
)


@pytest.mark.parametrize("name", [name for name in INPUTS if name not in _DEAR])
def test_a_hostile_input_is_refused(tmp_path: Path, name: str):
    with pytest.raises(InputError) as caught:
        INPUTS[name](tmp_path)()
    line = str(caught.value)
    assert line.isprintable()
    assert len(line) <= 1500
    assert "Mitsuba could not load" not in line


def _judge(outcomes: list[Outcome], count: int, harmless: tuple[str, ...] = ()) -> None:
    worst = [
        f"{o.name}: {o.kind} {o.said}" for o in outcomes if o.kind != ("taken" if o.name in harmless else "refused")
    ]
    assert not worst
    assert len(outcomes) >= count
    assert [o.name for o in outcomes if not o.said.isprintable()] == []
    assert max((o.seconds, o.name) for o in outcomes) < (_SECONDS,)
    assert max((o.wall, o.name) for o in outcomes) < (_WALL,)
    assert max((o.bytes, o.name) for o in outcomes) < (_BYTES,)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="measures by /proc")
def test_hostile_inputs_take_little(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    outcomes = take_in(hostile_inputs.__name__, "INPUTS", list(INPUTS), tmp_path)
    _print(outcomes, capsys)
    _judge(outcomes, 80)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="measures by /proc")
def test_damaged_folders_take_little(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    outcomes = take_in(hostile_folders.__name__, "FOLDERS", list(hostile_folders.FOLDERS), tmp_path)
    _print(outcomes, capsys)
    _judge(outcomes, 60, hostile_folders.HARMLESS)


def _print(outcomes: list[Outcome], capsys: pytest.CaptureFixture[str]) -> None:
    with capsys.disabled():
        for what, worst in {
            "seconds": max(outcomes, key=lambda o: o.seconds),
            "memory": max(outcomes, key=lambda o: o.bytes),
        }.items():
            print(
                f"\nmost {what}: {worst.name}: {worst.seconds:.2f} s, {worst.bytes / 1e6:.0f} MB of {len(outcomes)}",
                end="",
            )


def test_what_mitsuba_warns_of_is_printable(tmp_path: Path, capfd: pytest.CaptureFixture[str]):
    """It quotes names of files, and would write to the terminal itself."""
    path = tmp_path / "a\x1b]0;owned\x07.ply"
    path.write_bytes(ply(((3, 0, 1, 2),) * 20_000, form="ascii"))
    capfd.readouterr()
    description.load({"type": "ply", "filename": path})
    said = capfd.readouterr()
    assert "performance warning" in said.err
    assert "\\x1b]0;owned\\x07.ply" in said.err
    assert "\x1b" not in said.out + said.err


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="measures by /proc")
def test_files_damaged_at_random_take_little(tmp_path: Path):
    """The short edition of `fuzz_inputs.py`, which goes on for as long as it is told."""
    outcomes = take_in(fuzz_inputs.__name__, "INPUTS", fuzz_inputs.names(0, 40), tmp_path, fuzz_inputs.LONGEST)
    assert fuzz_inputs.faults(outcomes) == []
    assert len(outcomes) == 40 * len(fuzz_inputs.TARGETS)
    kinds = {(o.name.partition(" ")[0], o.kind) for o in outcomes}
    assert kinds == {(target, kind) for target in fuzz_inputs.TARGETS for kind in ("refused", "taken")}


def test_a_planted_fault_is_found():
    """Each thing that a sound reader never does."""
    sound = Outcome("mesh 1", "a.ply: no", "refused"), Outcome("mesh 2", "", "taken")
    for fault in (
        Outcome("mesh 3", "", "died"),
        Outcome("mesh 4", "", "hung"),
        Outcome("mesh 5", "ValueError: x", "raised"),
        Outcome("mesh 6", "", "taken", bytes=_BYTES + 1),
        Outcome("mesh 7", "two\nlines", "refused"),
    ):
        assert len(fuzz_inputs.faults([*sound, fault])) == 1
    assert fuzz_inputs.faults([*sound]) == []
