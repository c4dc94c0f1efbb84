"""The plan for a GPU, without one: its options, what is run again and what is not, limits of time, and what it writes."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import pytest

from benchmarks.gpu import cli, execute
from benchmarks.gpu.plan import FULL, SLICES, Command, Folder, Slice, device
from benchmarks.runner.catalogue import ROOT, benchmarks
from benchmarks.runner.options import add_options
from benchmarks.runner.results_page import on_a_gpu
from unrender.backend import variant

NOWHERE = {"name": "a device", "variant": "llvm_ad_rgb"}
ALL = benchmarks()
COMMANDS = [command for part in SLICES for command in part.commands]


def run_python(monkeypatch: pytest.MonkeyPatch, **programs: str) -> None:
    """Let each command, by its first word, be a program in Python instead."""
    monkeypatch.setattr(execute, "words", lambda part, command, folder: [sys.executable, "-c", programs[command.name]])


def made(*names: str) -> Slice:
    return Slice("a-slice", "what it shows", tuple(Command(name, 1.0) for name in names))


@pytest.fixture
def folder(tmp_path: Path) -> Folder:
    return Folder(tmp_path / "records", is_toy=True)


def test_slices_have_names_of_their_own_and_ten_minutes_at_most() -> None:
    assert len({part.name for part in SLICES}) == len(SLICES)
    for part in SLICES:
        assert 0 < part.minutes <= 10, part.name
        assert len({command.words for command in part.commands}) == len(part.commands)


@pytest.mark.mitsuba
@pytest.mark.parametrize("name", sorted({c.name for c in COMMANDS} - {"doctor", "tests"}))
def test_every_benchmark_of_the_plan_has_its_options(name: str) -> None:
    if name == "higher_order.networks":
        pytest.importorskip("torch")
    parser = argparse.ArgumentParser()
    parser.add_argument("--quick", action="store_true")
    add_options(parser, ALL[name].module.run)
    for command in (c for c in COMMANDS if c.name == name):
        for small in (False, True):
            parser.parse_args(command.arguments(small))  # exits where there is no such option or choice


def test_toy_commands_keep_names_and_leave_sizes_to_the_benchmark() -> None:
    command = Command("suite --problem lamp 'a, b' --seconds 10 --spp 4 16 --only uniform", 1.0)
    assert command.arguments(False)[1:3] == ["lamp", "a, b"]
    assert command.arguments(True) == ["--quick", "--problem", "lamp", "a, b", "--only", "uniform"]


def test_tests_of_the_plan_are_there() -> None:
    for command in (c for c in COMMANDS if c.name == "tests"):
        for small in (False, True):
            (path,) = [word for word in command.arguments(small) if word.startswith("tests/")]
            assert (ROOT / path).exists()


@pytest.mark.mitsuba
def test_two_commands_of_a_benchmark_in_a_slice_merge_into_one_record() -> None:
    for part in SLICES:
        names = [c.name for c in part.commands if c.name not in ("doctor", "tests")]
        for name in {n for n in names if names.count(n) > 1}:
            assert getattr(ALL[name].module, "MERGE", ()), f"{part.name}: {name} would lose the first's figures"


def test_what_ended_is_not_run_again(folder: Folder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    count = f"open({str(tmp_path / 'runs')!r}, 'a').write('x')"
    run_python(monkeypatch, good=count, bad=f"{count}; print('why'); raise SystemExit(3)")
    part = made("good", "bad")
    assert folder.summary(part) == "not run"
    for _ in range(2):
        assert execute.run_slice(part, folder, NOWHERE, 1.0) == "failed"
        assert (tmp_path / "runs").read_text() == "xx"
    entry = folder.read(part)["commands"]["bad"]
    assert (entry["status"], entry["last_line"]) == (3, "why")
    assert not folder.is_next(part)
    folder.forget(part)
    assert folder.is_next(part)


@pytest.mark.slow
def test_a_slice_over_its_minutes_is_cut_short_and_goes_on(
    folder: Folder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(execute, "_GRACE", 0.2)
    flag = tmp_path / "flag"
    wait = f"import pathlib, time; p = pathlib.Path({str(flag)!r}); p.exists() or (p.touch(), time.sleep(600))"
    run_python(monkeypatch, first="", slow=wait, last="")
    part = made("first", "slow", "last")
    assert execute.run_slice(part, folder, NOWHERE, 0.05) == "cut short"
    assert [folder.ended(part, c) for c in part.commands] == ["done", "cut short", ""]
    assert folder.is_next(part)
    assert execute.run_slice(part, folder, NOWHERE, 1.0) == "done"


@pytest.mark.mitsuba
def test_a_state_names_the_device(folder: Folder, monkeypatch: pytest.MonkeyPatch) -> None:
    run_python(monkeypatch, good="")
    execute.run_slice(made("good"), folder, NOWHERE, 1.0)
    assert folder.read(made("good"))["device"] == NOWHERE
    assert device(on_gpu=False)["variant"] == variant.LLVM


def test_children_are_told_the_variant(folder: Folder, monkeypatch: pytest.MonkeyPatch) -> None:
    run_python(monkeypatch, asks="import os; raise SystemExit(os.environ['UNRENDER_VARIANT'] != 'some variant')")
    assert execute.run_slice(made("asks"), folder, {**NOWHERE, "variant": "some variant"}, 1.0) == "done"


def test_without_a_gpu_it_refuses_in_one_line(
    folder: Folder, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(cli, "FULL", folder)
    monkeypatch.setattr(variant, "gpu_problem", lambda: "it is on holiday")
    assert cli.main(["--next"]) == 2
    told = capsys.readouterr().err
    assert told == "no GPU works here: it is on holiday; --toy runs the plan on the processor\n"
    assert not folder.path.exists()


def test_the_list_has_a_line_for_each_slice(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([]) == 0
    told = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in told] == [part.name for part in SLICES]


def test_next_goes_through_the_plan(folder: Folder, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cli, "FULL", folder)
    monkeypatch.setattr(variant, "gpu_problem", lambda: None)
    monkeypatch.setattr(cli, "device", lambda on_gpu: NOWHERE)
    monkeypatch.setattr(execute, "words", lambda part, command, folder: [sys.executable, "-c", ""])
    folder.path.mkdir()
    for number in range(1, 3):
        assert cli.main(["--next"]) == 0
        assert len(list(folder.path.glob("*.json"))) == number
        assert [folder.summary(part) == "done" for part in SLICES[:3]] == [True] * number + [False] * (3 - number)


@pytest.mark.mitsuba
def test_figures_of_a_gpu_stand_beside_those_of_the_processor(folder: Folder) -> None:
    part = next(part for part in SLICES if part.name == "speed")
    measured = json.loads((ALL["speed"].folder / "results.json").read_text())
    measured["step_ms"]["rcv"][0] = 7.3
    file = folder.path / "speed" / "speed" / "results.json"
    file.parent.mkdir(parents=True)
    file.write_text(json.dumps(measured))
    assert on_a_gpu(ALL["speed"], folder) == []  # not ended
    where = {"name": "A fast GPU", "variant": "cuda_ad_rgb"}
    folder.note(part, part.commands[0], where, {"ended": "done", "seconds": 5.0})
    (told,) = on_a_gpu(ALL["speed"], folder)
    assert "A fast GPU" in told
    assert "| control variate | 7.3 |" in told
    assert on_a_gpu(ALL["suite"], folder) == []


def test_a_record_of_a_gpu_is_of_a_gpu() -> None:
    for part in SLICES:
        state = FULL.read(part)
        assert not state or state["device"]["variant"] == variant.CUDA
