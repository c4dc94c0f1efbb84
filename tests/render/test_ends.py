"""How runs end, said as it is: finished, interrupted, failed; and what signals, numbers that are none, and damage do to them."""

from __future__ import annotations

import dataclasses
import itertools
import json
import os
import signal
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from callbacks import At, of_the_run

import unrender as ur
from unrender.core.errors import InputError
from unrender.core.signals import GRACEFUL
from unrender.runs.folder import checkpoint, history, reader
from unrender.runs.folder.history import HistoryReader, read_records, steps_in, thinned
from unrender.runs.folder.state import Packed, not_finite

RATE = "rate"


def start(
    folder: Path | None, steps: int = 12, callbacks: Any = (), optimizer: Any = None, every: int = 2, **options: Any
) -> ur.Result:
    problem = ur.gallery.problem("exponential")
    parts = options.pop("estimator", None) or ur.PathGradient(spp=2), optimizer or ur.optimizers.Adam(0.05)
    return ur.optimize(problem, *parts, steps, None, 0, callbacks, folder, checkpoint_every=every, **options)


def record(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "run.json").read_text())


@pytest.fixture(autouse=True)
def no_flush(monkeypatch: pytest.MonkeyPatch) -> None:
    """Flushing takes most of the time of such short runs; `test_durability` is about it."""
    monkeypatch.setattr(os, "fsync", lambda file: None)


@pytest.fixture(scope="module")
def whole() -> ur.Result:
    return start(None)


# ---------------------------------------------------------------------- numbers that are none


@dataclasses.dataclass(frozen=True)
class Spoilt:
    """An estimator whose estimates are not finite from a step on."""

    since: int
    inner: Any = dataclasses.field(default_factory=lambda: ur.PathGradient(spp=2))
    what: str = "gradient"

    @property
    def provides(self):
        return self.inner.provides

    def init(self, problem, parameters):
        return {"count": 0, "inner": self.inner.init(problem, parameters)}

    def estimate(self, problem, parameters, state, key):
        found, inner = self.inner.estimate(problem, parameters, state["inner"], key)
        if key.step >= self.since:
            wrong = {k: np.asarray(g) * np.nan for k, g in found.gradient.items()}
            found = dataclasses.replace(found, **({"gradient": wrong} if self.what == "gradient" else {"loss": np.nan}))
        return found, {"count": state["count"], "inner": inner}


@dataclasses.dataclass(frozen=True)
class Exploding:
    """An optimizer that makes a step of a number that is none, from a step on."""

    since: int
    inner: Any = dataclasses.field(default_factory=lambda: ur.optimizers.Adam(0.05))

    @property
    def requires(self):
        return self.inner.requires

    def init(self, parameters, learning_rates=None):
        return {"count": 0, "inner": self.inner.init(parameters, learning_rates)}

    def update(self, estimate, state, parameters):
        steps, inner = self.inner.update(estimate, state["inner"], parameters)
        if state["count"] >= self.since:
            steps = {key: np.asarray(value) * np.nan for key, value in steps.items()}
        return steps, {"count": state["count"] + 1, "inner": inner}


def test_a_run_that_is_given_up_has_failed(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    result = start(folder, 100, optimizer=Exploding(since=5))
    assert (result.status, result.stopped, result.steps, result.skipped) == ("failed", "non-finite", 25, 20)
    np.testing.assert_array_equal(result.parameters[RATE], start(None, 5).parameters[RATE])  # the last that was finite
    written = record(folder)
    assert (written["status"], written["error"]) == ("failed", "stopped: the last gradients were not finite")
    first, last = result.warnings
    assert first == (
        "step 6: the optimizer's step for rate (from its own state, or the preconditioner) was not finite; such steps are not applied"
    )
    assert last.startswith("20 steps in a row were not finite: the run was stopped")
    assert reader.read(folder).record.status == "failed"


@pytest.mark.parametrize(
    ("steps", "words"), [(1, "1 step was"), (3, "3 steps in a row were"), (20, "20 steps in a row were")]
)
def test_a_short_run_without_a_finite_step_has_failed(steps: int, words: str, tmp_path: Path) -> None:
    """Resumed with the same budget, it had a second line, of 0 steps in a row."""
    result = start(tmp_path / "run", steps, optimizer=Exploding(since=0))
    assert (result.status, result.stopped, result.skipped) == ("failed", "non-finite", steps)
    assert result.warnings[-1].startswith(f"{words} not finite")
    parts = {"estimator": ur.PathGradient(spp=2), "optimizer": Exploding(since=0)}
    again = ur.resume(tmp_path / "run", ur.gallery.problem("exponential"), steps=steps, **parts)
    assert (again.status, again.warnings) == (result.status, result.warnings)


def test_bounds_do_not_hide_a_step_that_is_no_number(tmp_path: Path) -> None:
    """The nearest point inside the bounds to what is no number may be a bound."""
    made = ur.gallery.problem("exponential")
    problem = ur.Problem(made.renderer, [ur.Parameter(RATE, initial=1.0, bounds=(0.5, 4.0))], made.original_views)
    result = ur.optimize(problem, ur.PathGradient(spp=2), Exploding(since=0), 3)
    np.testing.assert_array_equal(result.parameters[RATE], result.initial[RATE])
    assert result.skipped == 3


def test_a_state_that_is_not_finite_is_no_checkpoint(tmp_path: Path) -> None:
    """Of an optimizer that hides it from its steps for the time being."""

    @dataclasses.dataclass(frozen=True)
    class Hiding(Exploding):
        def update(self, estimate, state, parameters):
            steps, inner = self.inner.update(estimate, state["inner"], parameters)
            return steps, {"count": state["count"] + 1, "inner": inner, "hidden": np.array([1.0, np.nan])}

    folder = tmp_path / "run"
    result = start(folder, 4, optimizer=Hiding(since=0))
    (line,) = of_the_run(result.warnings)
    assert "checkpoint not written: the state holds numbers that are not finite (optimizer['hidden'])" in line
    assert list((folder / "checkpoints").glob("*")) == []


def edit(folder: Path, step: int, change: Any) -> None:
    """Write a checkpoint anew, its manifest true to what it holds."""
    found = checkpoint.read(folder / "checkpoints" / f"{step:08d}")
    manifest = found.manifest
    packed = change(found.packed) or found.packed
    checkpoint.write(folder, step, manifest.seed, packed, manifest.versions, manifest.problem)


def _spoil_adam(packed: Packed) -> None:
    """The second moment is no number."""
    nodes = dict(packed.skeleton["dict"])
    _, mean_square = nodes["optimizer"]["fields"]["states"]["tuple"]
    moment = dict(mean_square["fields"]["second_moment"]["dict"])[RATE]
    number = str(moment["array"])
    packed.tensors[number] = np.full_like(packed.tensors[number], np.nan)


def _other_shape(packed: Packed) -> Packed:
    return Packed(packed.skeleton, {name: np.zeros((3, 3), np.float32) for name in packed.tensors})


def _other_class(packed: Packed) -> Packed:
    text = json.dumps(packed.skeleton).replace("MeanSquare", "Velocity")
    return Packed(json.loads(text), packed.tensors)


@pytest.mark.parametrize("spoil", [_spoil_adam, _other_shape, _other_class])
def test_a_checkpoint_that_parses_but_cannot_be_used_is_passed_over(
    tmp_path: Path, whole: ur.Result, spoil: Any
) -> None:
    folder = tmp_path / "run"
    with pytest.raises(ZeroDivisionError):
        start(folder, callbacks=[At(7, lambda run: 1 / 0)])
    edit(folder, 6, spoil)
    result = ur.resume(folder)
    assert result.resumed == [4]
    np.testing.assert_array_equal(result.parameters[RATE], whole.parameters[RATE])
    (line,) = of_the_run(result.warnings)
    assert line.startswith("skipped: ")
    assert "checkpoint of step 6" in line or "state: " in line
    assert of_the_run(record(folder)["warnings"]) == [line]


def test_where_no_checkpoint_can_be_used_the_last_one_s_fault_is_told(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    start(folder, 6)
    for step in (2, 4, 6):
        edit(folder, step, _spoil_adam)
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    with pytest.raises(
        InputError, match=r"^checkpoint of step 6: optimizer\.states\[1\]\.second_moment\['rate'\]: not finite$"
    ):
        ur.resume(folder, steps=12)
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize(("what", "culprit"), [("loss", "the loss"), ("gradient", "the gradient of rate")])
def test_a_failed_run_that_is_resumed_tries_again(tmp_path: Path, what: str, culprit: str) -> None:
    folder = tmp_path / "run"
    first = start(folder, 100, estimator=Spoilt(since=4, what=what))
    assert first.status == "failed"
    assert first.warnings[0] == f"step 5: {culprit} was not finite; such steps are not applied"
    problem = ur.gallery.problem("exponential")
    again = ur.resume(folder, problem, steps=100, estimator=Spoilt(since=4, what=what))
    assert again.warnings == first.warnings
    assert (again.status, again.steps, again.skipped) == ("failed", 44, 40)


def test_where_a_state_is_not_finite_is_told() -> None:
    state = {"a": (1.0, np.float32(2)), "b": [None, {"c": np.array([1, 2]), "d": np.array([0.0, np.inf])}], "e": "nan"}
    assert not_finite(state) == "state['b'][1]['d']"
    state["b"][1]["d"] = np.zeros(3)
    assert not_finite(state) == ""
    assert not_finite((1.0, float("nan")), "optimizer") == "optimizer[1]"


# ---------------------------------------------------------------------- signals and threads


class Handler:
    """A handler of SIGTERM that lets a run have its own."""

    def __init__(self) -> None:
        self.seen: list[int] = []
        setattr(self, GRACEFUL, True)

    def __call__(self, number: int, frame: Any) -> None:
        self.seen.append(number)


def tell(run: Any) -> None:
    os.kill(os.getpid(), signal.SIGTERM)


def test_sigterm_ends_a_run_with_a_checkpoint(
    tmp_path: Path, whole: ur.Result, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And then, where nobody handles it, the process, as it would have; without the pictures, which may take long."""
    ended: list[int] = []
    monkeypatch.setattr(signal, "raise_signal", ended.append)
    folder = tmp_path / "run"
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    result = start(folder, callbacks=[At(5, tell)])
    assert ended == [signal.SIGTERM]
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    assert (result.status, result.stopped, result.steps) == ("interrupted", "terminated", 5)
    assert (record(folder)["status"], result.pictures) == ("interrupted", {})
    assert (folder / "checkpoints" / "00000005").is_dir()
    again = ur.resume(folder)
    np.testing.assert_array_equal(again.parameters[RATE], whole.parameters[RATE])
    assert again.pictures
    assert ended == [signal.SIGTERM]


def test_a_program_s_own_handler_of_sigterm_stays(tmp_path: Path) -> None:
    seen: list[int] = []
    before = signal.signal(signal.SIGTERM, lambda number, frame: seen.append(number))
    try:
        assert start(tmp_path / "run", callbacks=[At(5, tell)]).status == "finished"
        handler = Handler()
        signal.signal(signal.SIGTERM, handler)
        result = start(tmp_path / "other", callbacks=[At(5, tell)])
        assert signal.getsignal(signal.SIGTERM) is handler
    finally:
        signal.signal(signal.SIGTERM, before)
    assert seen == [signal.SIGTERM]
    assert (result.stopped, handler.seen) == ("terminated", [])


def test_a_second_thread_is_refused_while_a_run_goes_on(tmp_path: Path, whole: ur.Result) -> None:
    told: list[str] = []
    problem = ur.gallery.problem("exponential")

    def other() -> None:
        calls = (
            lambda: start(None),
            lambda: ur.resume(tmp_path),
            lambda: ur.render(problem),
            lambda: ur.estimate(problem, ur.PathGradient()),
            lambda: ur.gallery.problem("exponential"),
            lambda: ur.app.export((problem, {}), tmp_path / "scene"),
        )
        for call in calls:
            with pytest.raises(InputError) as caught:
                call()
            told.append(str(caught.value))

    def beside(run: Any) -> None:
        thread = threading.Thread(target=other)
        thread.start()
        thread.join()

    result = start(None, callbacks=[At(3, beside), At(4, lambda run: ur.render(problem, spp=1))])
    assert len(told) == 6
    assert all("optimize is running in another thread" in line and "\n" not in line for line in told)
    np.testing.assert_array_equal(result.parameters[RATE], whole.parameters[RATE])


# ---------------------------------------------------------------------- histories without end


@pytest.mark.slow
def test_a_long_history_is_thinned_and_resumed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("unrender.runs.folder.writer.THINNED_FROM", 1 << 14)
    folder, steps = tmp_path / "run", 500
    sizes: list[int] = []
    followed = HistoryReader(folder / "history.jsonl", folder)

    class Watch(ur.protocols.Callback):
        def on_step(self, run, record):
            sizes.append((folder / "history.jsonl").stat().st_size)
            if run.step % 50 == 0:
                found = followed.read(to_the_end=False)
                assert found.seconds[-1] == record["seconds"]

    with pytest.raises(ZeroDivisionError):
        start(folder, steps, [Watch(), At(461, lambda run: 1 / 0)], every=20)
    assert max(sizes) < (1 << 14) + 1000
    assert sum(b < a for a, b in itertools.pairwise(sizes)) >= 2
    result = ur.resume(folder)
    assert (result.resumed, result.steps, record(folder)["steps"]) == ([460], steps, steps)
    kept = [line["step"] for line in result.history]
    assert len(kept) < steps
    assert kept[0] == 0
    assert kept[-30:] == list(range(steps - 30, steps))
    gaps = np.diff(kept)
    assert (np.diff(gaps) <= 0).all()  # the older, the sparser, by powers of two
    assert gaps.max() in (2, 4, 8, 16)  # times have more digits on a busy machine
    assert [line["step"] for line in read_records(folder / "history.jsonl", folder)[0]] == kept
    assert len(reader.read(folder).history) == len(kept)
    np.testing.assert_array_equal(result.parameters[RATE], start(None, steps).parameters[RATE])


def test_thinning_keeps_its_promises() -> None:
    records: list[dict[str, Any]] = [{"step": step} for step in range(1000)]
    records[333]["resolution"] = {"wall": [4, 4]}
    for stride in (2, 4, 8):
        records = thinned(records)
        early = [line["step"] for line in records[: len(records) // 3] if "resolution" not in line]
        assert early == list(range(0, early[-1] + 1, stride))
        assert any("resolution" in line for line in records)
        assert steps_in(records) == 1000
    assert thinned(records[:1]) == records[:1]
    assert thinned([]) == []


@pytest.mark.slow  # it writes 300 MB
def test_a_history_of_more_than_256_mebibytes_is_resumed(tmp_path: Path, whole: ur.Result) -> None:
    folder = tmp_path / "run"
    with pytest.raises(ZeroDivisionError):
        start(folder, callbacks=[At(7, lambda run: 1 / 0)])
    lines = (folder / "history.jsonl").read_text().splitlines()
    with (folder / "history.jsonl").open("w") as file:
        for step in range(6):
            file.write(lines[step] + "\n")
        for step in range(6, 340):
            file.write(json.dumps({**json.loads(lines[5]), "step": step, "padding": "x" * 900_000}) + "\n")
    assert (folder / "history.jsonl").stat().st_size > 1 << 28
    result = ur.resume(folder)
    assert (result.resumed, result.steps) == ([6], 12)
    np.testing.assert_array_equal(result.parameters[RATE], whole.parameters[RATE])


def test_a_history_too_large_for_any_run_is_one_line(tmp_path: Path) -> None:
    with (tmp_path / "history.jsonl").open("wb") as file:
        file.truncate(history.LARGEST + 1)
    with pytest.raises(InputError, match=r"history.jsonl: larger than 1 GiB, which no run writes"):
        read_records(tmp_path / "history.jsonl", tmp_path)
    (tmp_path / "history.jsonl").write_bytes(b'{"step": 0}\n' + b" " * (history.LARGEST_LINE + 2))
    found, reason = read_records(tmp_path / "history.jsonl", tmp_path)
    assert len(found) == 1
    assert reason.endswith("history.jsonl:2: a line of more than 1 MiB")
