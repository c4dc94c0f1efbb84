"""What --workers of one run refuses, before anything takes time."""

from __future__ import annotations

from importlib import import_module
from types import SimpleNamespace
from typing import Any

import pytest

from unrender.app.cli.main import main
from unrender.app.cli.tasks import Job, RunTask
from unrender.app.distributed.cluster import Ended
from unrender.app.sweeps.record import RunOutcome
from unrender.display.terminal import Console

compare = import_module("unrender.app.cli.compare")


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--workers", "two"], "--workers two: expected auto, a number, the address HOST:PORT"),
        (["--workers", "0"], "--workers 0: expected"),
    ],
)
def test_bad_words_are_one_line(words: list[str], line: str, capfd: Any, tmp_path: Any) -> None:
    assert main(["run", "indirect-room", *words, "--out", str(tmp_path / "out")]) == 2
    told = capfd.readouterr().err
    assert line in told
    assert told.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_an_interrupted_comparison_tells_what_was_done(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    def found(name: str, status: Any) -> Ended:
        outcome = RunOutcome(folder=name, seed=0, status=status, stopped="interrupted", steps=3)
        return Ended((name, 0), ([outcome], {f"{name}/run.json": b"{}"}))

    class Executor:
        """Two workers; the first run ends, then Ctrl-C comes, and the second saves what it has reached."""

        slots = 2

        def __init__(self, *_: Any) -> None:
            self.started: list[str] = []
            self.told = 0

        @property
        def pending(self) -> int:
            return len(self.started) - self.told

        def start(self, key: Any, *_: Any) -> None:
            self.started.append(key[0])

        def wait(self, _: float) -> list[Ended]:
            if self.told:
                raise KeyboardInterrupt
            self.told = 1
            return [found(self.started[0], "finished")]

        def saved(self) -> list[Ended]:
            return [found(self.started[1], "interrupted")]

    monkeypatch.setattr("unrender.app.distributed.cluster.OnWorkers", Executor)
    runs = [RunTask(f"plain-seed{n}", "plain", {}, None, 1.0, n, None) for n in range(4)]
    job, cluster = Job("quad", {}, True, "", str(tmp_path)), SimpleNamespace()
    outcomes = compare._on_workers(Console(quiet=True), job, runs, cluster)  # pyright: ignore[reportArgumentType]
    assert [(of.folder, of.status) for of in outcomes] == [("plain-seed0", "finished"), ("plain-seed1", "interrupted")]
    assert (tmp_path / "plain-seed1" / "run.json").exists()
