"""A run that is looked at, paused and stopped by files: what is written, what is obeyed, what it may cost."""

from __future__ import annotations

import json
import os
import shutil
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from callbacks import of_the_run

import unrender as ur
from unrender.app.watch.monitor import LOST, PAUSED, RUNNING, SAVING, VANISHED, WAITING, RunMonitor
from unrender.io.bounded_files import read_float_arrays
from unrender.io.resampling import reduced
from unrender.runs import live as module
from unrender.runs.folder.reader import read_record
from unrender.runs.live import Live


@pytest.fixture
def problem() -> ur.Problem:
    return ur.gallery.problem("exponential")


@pytest.fixture(autouse=True)
def _always(monkeypatch: pytest.MonkeyPatch) -> None:
    """An update at every step."""
    monkeypatch.setattr(module, "_INTERVAL", 0.0)
    monkeypatch.setattr(module, "_SHARE", 1e9)
    monkeypatch.setattr(module, "_POLL_SECONDS", 0.0)


class Then(ur.protocols.Callback):
    """Does something at one step."""

    def __init__(self, **at: Any):
        self._at = {int(name[1:]): what for name, what in at.items()}
        self.result: Any = None

    def on_step(self, run: Any, record: dict[str, Any]) -> None:
        if run.step in self._at:
            self._at[run.step]()


def descend(problem: ur.Problem, callbacks: list[ur.protocols.Callback], steps: int = 6) -> ur.Result:
    estimator = ur.PathGradient(spp=4)
    return ur.optimize(problem, estimator, ur.optimizers.Adam(learning_rate=0.02), steps=steps, callbacks=callbacks)


def order(folder: Path, command: str) -> None:
    (folder / "control.json").write_text(json.dumps({"command": command}))


def test_what_is_written_is_what_the_run_is(problem, tmp_path):
    live = Live(tmp_path / "run", method="plain", command="unrender run exponential")
    seen: list[Any] = []
    source = RunMonitor(tmp_path / "run")
    descend(problem, [live, Then(_4=lambda: seen.append(source.snapshot()))])
    (snapshot,) = seen
    assert snapshot.state == RUNNING
    assert snapshot.problems == ()
    assert snapshot.status.step == 4
    assert len(snapshot.run.history) == 4
    assert snapshot.run.record.command == "unrender run exponential"
    assert snapshot.run.truth.keys() == problem.truth.keys()
    key = next(iter(problem.truth))
    assert snapshot.run.error_before[key] == pytest.approx(
        float(np.abs(snapshot.run.initial[key] - problem.truth[key]).mean())
    )
    view = snapshot.run.views[0]
    np.testing.assert_array_equal(view.reference, np.asarray(problem.views[0].reference))
    assert view.result.shape == view.reference.shape
    ended = source.snapshot()
    assert ended.state == SAVING
    assert ended.run is not None
    assert ended.run.record.stopped == "steps"
    live.clear()
    assert not any((tmp_path / "run").iterdir())
    assert source.snapshot().state == VANISHED  # and what was last known is still there to be seen
    assert source.snapshot().run is not None


def test_pictures_are_those_of_the_step(problem, tmp_path):
    kept: list[np.ndarray] = []

    class Keep(ur.protocols.Callback):
        def on_step(self, run: Any, record: dict[str, Any]) -> None:
            kept.append(np.asarray(run.estimate.info["images"][0], np.float32))
            with np.load(tmp_path / "live" / "views.npz") as found:
                np.testing.assert_array_equal(found["view0/result"], kept[-1])
            with np.load(tmp_path / "live" / "start.npz") as found:
                np.testing.assert_array_equal(found["view0/initial"], kept[0])

    descend(problem, [Live(tmp_path), Keep()], steps=3)
    assert len(kept) == 3


def test_a_pause_holds_the_step_and_is_no_time_of_the_run(problem, tmp_path):
    source, seen = RunMonitor(tmp_path), []

    def resume() -> None:
        while source.snapshot().state != PAUSED:
            time.sleep(0.01)
        path = tmp_path / "live" / "status.json"
        before = json.loads(path.read_text())["step"]
        time.sleep(1.0)
        seen.append((before, json.loads(path.read_text())["step"]))
        order(tmp_path, "run")

    other = threading.Thread(target=resume)
    other.start()
    began = time.monotonic()
    result = descend(problem, [Then(_3=lambda: order(tmp_path, "pause")), Live(tmp_path)])
    other.join()
    assert seen == [(3, 3)]
    assert result.steps == 6
    assert result.seconds < time.monotonic() - began - 1.0
    assert not (tmp_path / "control.json").exists()


def test_a_command_that_is_read_while_it_is_written_counts_afterwards(problem, tmp_path):
    """The file was empty when it was read, and its time was the same after it was filled: a pause lasted for ever."""
    path, stamp = tmp_path / "control.json", (10**18, 10**18)

    def write(text: str) -> None:
        path.write_text(text)
        os.utime(path, ns=stamp)

    steps = Then(_2=lambda: write(""), _4=lambda: write('{"command": "stop"}'))
    result = descend(problem, [steps, Live(tmp_path)])
    assert (result.stopped, result.steps) == ("interrupted", 4)


def test_stop_ends_the_run_as_an_interrupt_does(problem, tmp_path):
    result = descend(problem, [Then(_3=lambda: order(tmp_path, "stop")), Live(tmp_path)])
    assert (result.stopped, result.steps) == ("interrupted", 3)


def test_a_command_from_before_the_run_does_not_hold(problem, tmp_path):
    order(tmp_path, "stop")
    assert descend(problem, [Live(tmp_path)]).stopped == "steps"


@pytest.mark.parametrize(
    "text",
    ["", "[", "[]", "{}", '{"command": 5}', '{"command": "explode"}', '{"command": ["stop"]}', "[" * 4000, "\xff", " " * 5000],
)  # fmt: skip
def test_what_is_no_command_changes_nothing(problem, tmp_path, text):
    path = tmp_path / "control.json"
    result = descend(problem, [Then(_2=lambda: path.write_text(text, "latin-1")), Live(tmp_path)])
    assert (result.stopped, result.steps, of_the_run(result.warnings)) == ("steps", 6, [])


def test_a_pipe_or_a_link_in_place_of_the_command_is_not_read(problem, tmp_path):
    (tmp_path / "elsewhere.json").write_text('{"command": "stop"}')
    folder = tmp_path / "run"
    folder.mkdir()
    links = Then(
        _2=lambda: (folder / "control.json").symlink_to(tmp_path / "elsewhere.json"),
        _4=lambda: ((folder / "control.json").unlink(), os.mkfifo(folder / "control.json")),
    )
    assert descend(problem, [links, Live(folder)]).stopped == "steps"


def test_a_folder_that_vanishes_is_a_warning_and_is_not_brought_back(problem, tmp_path):
    folder = tmp_path / "run"
    gone = Then(_3=lambda: shutil.rmtree(folder))
    result = descend(problem, [gone, Live(folder)])
    assert result.steps == 6
    assert not folder.exists()
    (warning,) = [one for one in result.warnings if "too few to judge" not in one]
    assert "can no longer be watched" in warning


def test_a_paused_run_whose_folder_vanishes_goes_on(problem, tmp_path):
    folder = tmp_path / "run"
    source = RunMonitor(folder)

    def remove() -> None:
        while source.snapshot().state != PAUSED:
            time.sleep(0.01)
        folder.rename(tmp_path / "elsewhere")  # at once, since a folder without a command lets the run go on

    other = threading.Thread(target=remove)
    other.start()
    result = descend(problem, [Then(_2=lambda: order(folder, "pause")), Live(folder)])
    other.join()
    assert result.steps == 6


def test_nothing_is_written_through_a_link(problem, tmp_path):
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "mine.txt").write_text("mine")
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "live").symlink_to(elsewhere)
    result = descend(problem, [Live(folder)])
    assert [path.name for path in elsewhere.iterdir()] == ["mine.txt"]
    assert "can no longer be watched" in result.warnings[0]


def test_updates_take_at_most_their_share_of_the_time(problem, tmp_path, monkeypatch):
    """On a clock of its own, where each update takes 0.1 s and a step 0.05 s: every 5 s, then, which is 2 %."""
    now = [0.0]
    monkeypatch.setattr(module, "_INTERVAL", 1.0)
    monkeypatch.setattr(module, "_SHARE", 0.02)
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    writes: list[float] = []
    monkeypatch.setattr(module, "_views", lambda run: writes.append(now[0]) or now.__setitem__(0, now[0] + 0.1) or {})

    class Tick(ur.protocols.Callback):
        def on_step(self, run: Any, record: dict[str, Any]) -> None:
            now[0] += 0.05

    descend(problem, [Tick(), Live(tmp_path)], steps=400)
    assert len(writes) * 0.1 <= 0.02 * now[0] + 0.2  # the first one and the last one are free
    assert len(writes) >= 4


def test_history_of_its_own_until_somebody_else_writes_one(problem, tmp_path):
    lines: list[int] = []
    own = tmp_path / "live" / "history.jsonl"

    def count() -> None:
        lines.append(len(own.read_text().splitlines()) if own.exists() else -1)

    other = Then(_2=count, _3=lambda: (tmp_path / "history.jsonl").write_text("{}\n"), _5=count)
    descend(problem, [Live(tmp_path), other])
    assert lines == [2, -1]


def test_a_run_whose_process_died_is_told_from_one_that_goes_on(problem, tmp_path):
    source = RunMonitor(tmp_path)
    assert source.snapshot().state == WAITING
    kept: list[str] = []
    path = tmp_path / "live" / "status.json"
    descend(problem, [Live(tmp_path), Then(_3=lambda: kept.append(path.read_text()))])
    status = json.loads(kept[0])
    path.write_text(json.dumps(status | {"process": 2**22 + 1}))  # beyond what Linux numbers processes to
    assert source.snapshot().state == LOST
    path.write_text(json.dumps(status | {"process": 2**22 + 1, "host": "another machine"}))
    assert source.snapshot().state == RUNNING


def test_the_live_folder_is_readable_as_a_run_folder_s_parts_are(problem, tmp_path):
    descend(problem, [Live(tmp_path)])
    assert read_record(tmp_path / "live" / "run.json", tmp_path).name == problem.name
    assert read_float_arrays(tmp_path / "live" / "parameters.npz", tmp_path).keys() == set(problem.initial())


def test_reduced_keeps_the_mean_and_the_largest_side():
    rng = np.random.default_rng(1)
    array = rng.random((64, 96, 3))
    small = reduced(array, 32)
    assert small.shape == (22, 32, 3)
    np.testing.assert_allclose(reduced(array, 48).mean(), array.mean(), rtol=1e-12)
    np.testing.assert_allclose(reduced(array, 32)[3, 4], array[9:12, 12:15].mean((0, 1)), rtol=1e-12)
    volume = rng.random((8, 16, 32, 1))
    assert reduced(volume, 8, 3).shape == (2, 4, 8, 1)
    assert reduced(np.ones((2, 3000, 3)), 1000).shape == (1, 1000, 3)
    assert reduced(array, 96) is array


@pytest.mark.parametrize("when", [0, 3])
def test_a_disk_that_is_full_is_a_warning_and_the_run_goes_on(problem, tmp_path, monkeypatch, when):
    """From the beginning, or after the third update."""
    before = module.files.write
    written = []

    def write(path: Path, data: bytes, durable: bool = True, name_too: bool = True) -> Path:
        written.append(path.name)
        if written.count("views.npz") >= when:
            raise ur.InputError(f"{path}: cannot be written: No space left on device")
        return before(path, data, durable, name_too)

    monkeypatch.setattr(module.files, "write", write)
    result = descend(problem, [Live(tmp_path)])
    assert result.steps == 6
    (warning,) = [one for one in result.warnings if "too few to judge" not in one]
    assert "No space left on device" in warning
    assert "\n" not in warning


@pytest.mark.parametrize("when", [0, 2])
def test_after_a_full_disk_the_controls_are_alive(problem, tmp_path, monkeypatch, when):
    """Full from the beginning, or from the second step; until the fifth. Commands are followed meanwhile, too."""
    monkeypatch.setattr(module, "_RETRY_SECONDS", 0.0)
    full = [when == 0]
    before, opened = module.files.write, Path.open

    def write(path: Path, data: bytes, durable: bool = True, name_too: bool = True) -> Path:
        if full[0]:
            raise ur.InputError(f"{path}: cannot be written: No space left on device")
        return before(path, data, durable, name_too)

    def open_file(path: Path, mode: str = "r", *more: Any, **named: Any) -> Any:
        if full[0] and mode == "ab":
            raise OSError(28, "No space left on device")
        return opened(path, mode, *more, **named)

    monkeypatch.setattr(module.files, "write", write)
    monkeypatch.setattr(Path, "open", open_file)
    source, states = RunMonitor(tmp_path), []
    steps = Then(
        _2=lambda: full.__setitem__(0, True),
        _5=lambda: full.__setitem__(0, False),
        _7=lambda: states.append(source.snapshot()),
        _8=lambda: order(tmp_path, "stop"),
    )
    result = descend(problem, [steps, Live(tmp_path)], steps=12)
    assert (result.stopped, result.steps) == ("interrupted", 8)
    (warning,) = result.warnings
    assert "the run continues, but cannot be watched until there is room" in warning
    (seen,) = states
    assert (seen.state, seen.problems) == (RUNNING, ())
    assert seen.run.record.steps == len(seen.run.history) == 6  # as the step before left it
    assert seen.run.initial.keys() == set(problem.initial())


def test_commands_are_followed_while_the_disk_is_full(problem, tmp_path, monkeypatch):
    live = Live(tmp_path)

    def fill() -> None:
        monkeypatch.setattr(live, "_update", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left on device")))
        order(tmp_path, "stop")

    assert descend(problem, [Then(_3=fill), live]).steps == 3


def test_what_is_not_finite_is_null_for_those_who_watch(problem, tmp_path):
    """Strict JSON has no word for it."""

    class Spoil(ur.protocols.Callback):
        def on_step(self, run: Any, record: dict[str, Any]) -> None:
            record["loss"] = float("nan")

    seen: list[str] = []
    texts = Then(_3=lambda: seen.extend((tmp_path / "live" / n).read_text() for n in ("status.json", "history.jsonl")))
    descend(problem, [Spoil(), Live(tmp_path), texts])
    assert len(seen) == 2
    for text in seen:
        assert "NaN" not in text
        assert '"loss": null' in text
