"""One protocol of events: the user's callbacks receive what the parts of a run receive."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import unrender as ur
from tests.unit.test_budget import problem
from unrender.core import phases
from unrender.runs.callbacks import Callback, UserCallbacks

EVENTS = [name for name in vars(Callback) if not name.startswith("_")]


class Recorder(Callback):
    """Records the events in the order in which they arrive."""

    def __init__(self) -> None:
        self.events: list[str] = []

    def on_phase(self, name: str) -> None:
        self.events.append(name)

    def on_progress(self, share: float) -> None:
        self.events.append("progress")

    def on_phase_end(self, name: str) -> None:
        self.events.append(f"{name} ends")

    def on_warm_up(self, run: Any, fresh: dict[str, Any], warm: dict[str, Any]) -> None:
        assert fresh.keys() == warm.keys()
        self.events.append("warm-up")

    def on_start(self, run: Any) -> None:
        self.events.append("start")

    def before_step(self, run: Any) -> None:
        self.events.append("before")

    def on_update(self, run: Any, estimate: Any, applied: bool) -> None:
        assert applied
        self.events.append("update")

    def on_step(self, run: Any, record: dict[str, Any]) -> None:
        assert run.history[-1] is record
        self.events.append("step")

    def on_result(self, run: Any, result: ur.Result) -> ur.Result:
        self.events.append("result")
        return replace(result, info={"added": 1})

    def on_error(self, run: Any, error: BaseException) -> None:
        self.events.append(f"error: {error}")

    def on_end(self, run: Any, result: ur.Result) -> None:
        self.events.append("end")

    def warnings(self, run: Any) -> list[str]:
        return ["a line of one's own"]


STEP = ["before", "update", "step"]


def test_user_callbacks_receive_every_event_in_order() -> None:
    recorder = Recorder()
    with phases.listening(recorder):  # as a progress bar does, which is a callback of the run, too
        result = ur.optimize(problem(), ur.PathGradient(), ur.optimizers.Adam(0.01), steps=2, callbacks=[recorder])
    verification = ["verification", "verification ends"]
    start = [
        "compiling",
        "compiling ends",
        "compiling",
        "compiling ends",
        "warm-up",
        "start",
    ]  # of steps and of new images
    assert recorder.events == [*start, *STEP, *STEP, *verification, "result", "end"]
    assert result.info == {"added": 1}
    assert "a line of one's own" in result.warnings


def test_user_callbacks_receive_errors() -> None:
    class Fails(Callback):
        def on_step(self, run: Any, record: dict[str, Any]) -> None:
            raise RuntimeError("planted")

    recorder = Recorder()
    with pytest.raises(RuntimeError, match="planted"):
        ur.optimize(problem(), "plain", steps=2, callbacks=[recorder, Fails()])
    assert recorder.events[-1] == "error: planted"


@pytest.mark.mitsuba
def test_a_resumed_run_tells_its_callbacks_of_phases_too(tmp_path: Path) -> None:
    made, recorder = problem(), Recorder()
    ur.optimize(made, "plain", steps=2, run_directory=tmp_path / "run")
    ur.resume(tmp_path / "run", made, steps=3, callbacks=[recorder])
    assert recorder.events.count("compiling") >= 1
    assert recorder.events[-1] == "end"


def test_every_event_is_passed_on_and_undefined_ones_cost_nothing() -> None:
    """`run.shown` upsamples coarse parameters, so it is entered only for overridden events."""
    assert set(EVENTS) == {name for name in vars(UserCallbacks) if not name.startswith("_")}

    class Run:
        shown_count = 0

        def shown(self) -> Any:
            self.shown_count += 1
            return pytest.MonkeyPatch.context()

    class Steps(Callback):
        def on_step(self, run: Any, record: dict[str, Any]) -> None:
            record["seen"] = True

    run: Any = Run()
    record: dict[str, Any] = {}
    both = UserCallbacks([Steps(), Steps()])
    both.before_step(run)
    both.on_start(run)
    assert run.shown_count == 0
    both.on_step(run, record)
    assert run.shown_count == 1
    assert record == {"seen": True}


@pytest.mark.parametrize("callbacks", [[3], None, print])
def test_callbacks_of_another_kind_are_refused_in_one_line(callbacks: Any) -> None:
    """They ended in an AttributeError or a TypeError within the run."""
    with pytest.raises(ur.InputError, match="optimize: callbacks: expected a list of Callback objects, got"):
        ur.optimize(problem(), steps=1, callbacks=callbacks)


@pytest.mark.parametrize(
    ("call", "name"),
    [
        (lambda x: ur.optimize(x, steps=1), "optimize"),
        (lambda x: ur.estimate(x, ur.PathGradient()), "estimate"),
        (lambda x: ur.render(x), "render"),
        (lambda x: ur.render_pair(x, {}, {}, 1, 0), "render_pair"),
    ],
)
@pytest.mark.parametrize("wrong", ["room.toml", None, ur.Problem])
def test_a_path_in_place_of_a_problem_is_refused_in_one_line(call: Any, name: str, wrong: Any) -> None:
    with pytest.raises(ur.InputError, match=f"^{name}: expected a Problem, such as"):
        call(wrong)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"annotations": "a run"}, "optimize: annotations: expected a RunAnnotations, got 'a run'"),
        ({"annotations": np.zeros(2)}, r"optimize: annotations: expected a RunAnnotations, got array\(\[0., 0.\]\)"),
        ({"progress": "yes"}, "optimize: progress must be true or false, got 'yes'"),
        ({"run_directory": "a\0b"}, r"optimize: run_directory: expected a folder, got 'a\\x00b'"),
    ],
)
def test_arguments_of_another_kind_are_refused_in_one_line(options: Any, expected: str) -> None:
    parts = (ur.PathGradient(spp=2), ur.optimizers.Adam(0.01))
    with pytest.raises(ur.InputError, match=f"^{expected}$"):
        ur.optimize(problem(), *parts, steps=1, **options)


def test_a_callback_may_add_arrays_to_the_history_and_return_nothing(tmp_path: Path) -> None:
    """A mean by NumPy in a record ended the run in a traceback."""

    class Own(Callback):
        def on_step(self, run: Any, record: dict[str, Any]) -> None:
            record |= {"psnr": np.float32(1.5), "sizes": np.array([1.0, np.nan]), "thing": Path}

        def on_result(self, run: Any, result: ur.Result) -> Any:
            self.steps = result.steps

    own, parts = Own(), (ur.PathGradient(spp=2), ur.optimizers.Adam(0.01))
    result = ur.optimize(problem(), *parts, steps=2, callbacks=[own], run_directory=tmp_path / "run")
    assert own.steps == result.steps == 2
    record = json.loads((tmp_path / "run" / "history.jsonl").read_text().splitlines()[-1])
    assert (record["psnr"], record["sizes"], record["thing"]) == (1.5, [1.0, None], repr(Path))


@pytest.mark.parametrize("value", ["done", 10**400, {}, np.zeros(2)])
def test_a_callback_that_returns_no_result_is_named_in_a_warning(value: Any) -> None:
    class Own(Callback):
        def on_result(self, run: Any, result: ur.Result) -> Any:
            return value

    result = ur.optimize(problem(), ur.PathGradient(spp=2), ur.optimizers.Adam(0.01), steps=1, callbacks=[Own()])
    assert result.warnings[-1].startswith("Own.on_result: expected a Result, got ")


@pytest.mark.mitsuba
@pytest.mark.parametrize("folder", ["", 5, None])
def test_what_is_no_folder_is_refused(folder: Any) -> None:
    def run(**of: Any) -> ur.Result:
        return ur.optimize(problem(), ur.PathGradient(spp=2), ur.optimizers.Adam(0.01), steps=1, **of)

    result = run()
    calls: list[Callable[[], Any]] = [
        lambda: result.save(folder),
        lambda: ur.resume(folder),
        lambda: ur.app.judge(folder),
    ]
    calls += [
        lambda: ur.Problem.from_file(folder),
        lambda: ur.app.turntable(".", folder),
        lambda: ur.app.export(".", folder),
    ]
    calls += [] if folder is None else [lambda: run(run_directory=folder)]
    for call in calls:
        with pytest.raises(ur.InputError, match=f": expected a [a-z ]+, got {folder!r}$"):
            call()
