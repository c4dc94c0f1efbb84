"""Run folders after kills at every file operation and after power cuts at every flush: nothing lost, nothing left over."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import unrender as ur
from tests.campaigns.faults import Killed, operations
from tests.campaigns.survivors import recording
from unrender.runs.folder import checkpoint, reader

pytestmark = pytest.mark.usefixtures("short_ends")

RATE, STEPS = "rate", 6


def run(folder: Path, steps: int = STEPS, every: int | None = 2, callbacks: Any = ()) -> ur.Result:
    """A run without a renderer."""
    problem = ur.gallery.problem("exponential")
    parts = ur.PathGradient(spp=2), ur.optimizers.Adam(0.05)
    return ur.optimize(problem, *parts, steps, None, 0, callbacks, folder, checkpoint_every=every)


def states(folder: Path) -> dict[str, bytes]:
    """Every number of the last checkpoint."""
    last = max((folder / checkpoint.FOLDER).glob("[0-9]*"))
    return {last.name: (last / checkpoint.STATE).read_bytes()}


def leftovers(folder: Path) -> list[Path]:
    """What no run that ended leaves."""
    found = [path for end in ("part", "old") for path in folder.rglob(f"*.{end}")]
    kept = (folder / checkpoint.FOLDER).glob("*")
    return found + [path for path in kept if not (path / checkpoint.MANIFEST).exists()]


def go_on(folder: Path) -> ur.Result:
    """What a user does after a death: resume, or begin again what had not begun."""
    if (folder / "run.json").exists():
        next(checkpoint.candidates(folder))
        reader.read(folder)
        if json.loads((folder / "run.json").read_text())["status"] != "finished":
            return ur.resume(folder)
        return ur.resume(folder, steps=STEPS + 1)
    return run(folder)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The states of an uninterrupted run, at its end and a step later."""
    folder = tmp_path_factory.mktemp("durability") / "whole"
    run(folder)
    found = states(folder)
    ur.resume(folder, steps=STEPS + 1)
    return found | states(folder)


@pytest.fixture
def no_flush(monkeypatch: pytest.MonkeyPatch) -> None:
    """Flushing takes most of the time, and no kill needs it."""
    monkeypatch.setattr(os, "fsync", lambda file: None)


def kill_everywhere(
    tmp_path: Path,
    whole: dict[str, bytes],
    chosen: slice,
    begin: Callable[[Path], Any] = run,
    prepare: Callable[[Path], Any] = lambda folder: None,
) -> int:
    """Kill `begin` at those of its file operations, and go on. Returns how many it has."""
    prepare(tmp_path / "counted")
    with operations(tmp_path / "counted") as seen:
        begin(tmp_path / "counted")
    for number in range(len(seen))[chosen]:
        folder = tmp_path / f"killed-{number}"
        prepare(folder)
        with pytest.raises(Killed), operations(folder, at=number):
            begin(folder)
        go_on(folder)
        assert states(folder).items() <= whole.items(), seen[number]
        assert leftovers(folder) == [], seen[number]
        shutil.rmtree(folder)
    return len(seen)


@pytest.mark.slow
@pytest.mark.usefixtures("no_flush")
def test_a_run_killed_at_some_file_operations(tmp_path: Path, whole: dict[str, bytes]) -> None:
    assert kill_everywhere(tmp_path, whole, slice(0, None, 11)) > 100


@pytest.mark.slow
@pytest.mark.usefixtures("no_flush")
def test_a_run_killed_at_every_file_operation(tmp_path: Path, whole: dict[str, bytes]) -> None:
    kill_everywhere(tmp_path, whole, slice(None))


@pytest.mark.slow
@pytest.mark.usefixtures("no_flush")
def test_a_resumed_run_killed_at_every_file_operation(tmp_path: Path, whole: dict[str, bytes]) -> None:
    with pytest.raises(Killed), operations(tmp_path / "interrupted", at=100):
        run(tmp_path / "interrupted")

    def copy(folder: Path) -> None:
        shutil.copytree(tmp_path / "interrupted", folder)

    assert kill_everywhere(tmp_path, whole, slice(None), ur.resume, copy) > 40


def test_a_power_cut_leaves_the_last_checkpoint(tmp_path: Path, whole: dict[str, bytes]) -> None:
    """On the worst disk that POSIX allows, at every fifth flush, and right after the end."""
    promised: list[tuple[int, int]] = []

    class Note(ur.protocols.Callback):
        def on_step(self, run, record):
            if run.step % 2 == 0:
                promised.append((now.flushes, run.step))

    with recording(tmp_path, every=5) as (now, cuts):
        run(tmp_path / "run", callbacks=[Note()])
        end = now.copy()
    assert len(cuts) >= 5
    for cut in {cut.flushes: cut for cut in [*cuts, end]}.values():  # the end may be a fifth flush
        place = tmp_path / f"cut-{cut.flushes}"
        cut.restore(place)
        folder = place / "run"
        begun = (folder / "run.json").exists()
        result = go_on(folder)
        assert states(folder).items() <= whole.items()
        assert leftovers(folder) == []
        last = max((step for flushes, step in promised if flushes <= cut.flushes), default=0)
        assert (result.resumed[-1] if begun else 0) >= last
    assert end.flushes == now.flushes
    record = json.loads((tmp_path / f"cut-{end.flushes}" / "run" / "run.json").read_text())
    assert record["resumed"] == [STEPS]  # it had been finished, and was given one step more


def test_a_saved_result_survives_a_power_cut(tmp_path: Path) -> None:
    """The archives and the record of a result that a script saves, in folders that it makes on the way."""
    result = ur.optimize(ur.gallery.problem("exponential"), ur.PathGradient(spp=2), ur.optimizers.Adam(), 2)
    with recording(tmp_path) as (now, _):
        result.save(tmp_path / "a" / "b")
    now.restore(tmp_path / "cut")
    found = reader.read(tmp_path / "cut" / "a" / "b")
    np.testing.assert_array_equal(found.parameters[RATE], np.float32(result.parameters[RATE]))
    assert found.record.status == "finished"
