"""Ctrl-C and SIGTERM at bad moments: one line, an exit status, never a traceback."""

from __future__ import annotations

import json
import os
import signal
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from unrender.app.cli import main as command
from unrender.app.cli.signals import Signals
from unrender.core.signals import GRACEFUL
from unrender.estimators.path import PathGradient
from unrender.runs.live import Live

TOY = ["exponential", "--method", "plain", "--steps", 30, "--final-spp", 1]


@pytest.fixture(autouse=True)
def handlers_stay() -> Any:
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    yield
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before


def at_step(monkeypatch: pytest.MonkeyPatch, step: int, what: Any) -> None:
    """Let something happen inside a run of the command."""
    before = Live.on_step

    def on_step(self: Live, run: Any, record: dict[str, Any]) -> None:
        before(self, run, record)
        if run.step == step:
            what()

    monkeypatch.setattr(Live, "on_step", on_step)


def send(*numbers: int) -> None:
    for number in numbers:
        os.kill(os.getpid(), number)


def test_sigterm_ends_a_run_with_143(unrender, monkeypatch: pytest.MonkeyPatch, mitsuba_variant: str) -> None:
    with monkeypatch.context() as patches:
        at_step(patches, 5, lambda: send(signal.SIGTERM))
        answer = unrender("run", *TOY, "--out", "run", "--variant", mitsuba_variant)
    assert (answer.status, answer.error) == (143, "unrender: terminated\n")
    assert "terminated: the current state is saved" in answer.out
    assert "to continue: unrender resume run" in answer.out
    record = json.loads(Path("run/run.json").read_text())
    assert (record["status"], record["stopped"], record["steps"]) == ("interrupted", "terminated", 5)
    assert Path("run/checkpoints/00000005/manifest.json").exists()
    assert not Path("run/pictures.npz").exists()
    assert Path("run/report.html").exists()
    assert unrender("resume", "run").status == 0
    assert json.loads(Path("run/run.json").read_text())["status"] == "finished"


@pytest.mark.parametrize(("first", "second"), [("SIGINT", "SIGINT"), ("SIGTERM", "SIGINT"), ("SIGINT", "SIGTERM")])
def test_the_second_one_interrupts_at_once(
    unrender, monkeypatch: pytest.MonkeyPatch, mitsuba_variant: str, first: str, second: str
) -> None:
    numbers = [signal.Signals[name] for name in (first, second)]
    at_step(monkeypatch, 5, lambda: send(*numbers))
    answer = unrender("run", *TOY, "--out", "run", "--variant", mitsuba_variant)
    words = {"SIGINT": "interrupted", "SIGTERM": "terminated"}[second]
    assert (answer.status, answer.error.split("\n")[-2]) == (128 + numbers[1], f"unrender: {words}")
    assert "Traceback" not in answer.error + answer.out
    assert json.loads(Path("run/run.json").read_text())["status"] == "interrupted"


def test_one_that_comes_while_it_ends_leaves_at_once(
    unrender, monkeypatch: pytest.MonkeyPatch, mitsuba_variant: str
) -> None:
    """The first lets the run end, the second interrupts, the third does not wait; what is on the disk is as after a kill."""

    class Left(SystemExit):
        pass

    def leave(status: int) -> None:
        raise Left(status)

    monkeypatch.setattr(os, "_exit", leave)
    monkeypatch.setattr("unrender.runs.folder.writer.RunWriter.on_error", lambda *_: send(signal.SIGINT))
    at_step(monkeypatch, 5, lambda: send(signal.SIGINT, signal.SIGINT))
    answer = unrender("run", *TOY, "--out", "run", "--variant", mitsuba_variant)
    assert answer.status == 130
    assert "Traceback" not in answer.error + answer.out


def test_what_an_interrupt_becomes_in_compiled_code_is_the_interrupt(
    unrender, monkeypatch, mitsuba_variant: str
) -> None:
    def estimate(*_: Any) -> None:
        try:
            send(signal.SIGINT, signal.SIGINT)
        except KeyboardInterrupt:
            raise RuntimeError("Unable to cast Python instance\nto C++ type") from None

    monkeypatch.setattr(PathGradient, "estimate", estimate)
    answer = unrender("run", *TOY, "--out", "run", "--variant", mitsuba_variant)
    assert (answer.status, answer.error) == (130, "unrender: interrupted\n")


def test_an_error_of_its_own_is_no_interrupt(unrender, monkeypatch, mitsuba_variant: str) -> None:
    def estimate(*_: Any) -> None:
        raise RuntimeError("a defect")

    monkeypatch.setattr(PathGradient, "estimate", estimate)
    with pytest.raises(RuntimeError, match="a defect"):
        unrender("run", *TOY, "--out", "run", "--variant", mitsuba_variant)


def test_outside_of_runs_both_interrupt(unrender, monkeypatch: pytest.MonkeyPatch) -> None:
    for number, status, words in ((signal.SIGINT, 130, "interrupted"), (signal.SIGTERM, 143, "terminated")):
        monkeypatch.setattr(command, "_command", lambda given, began, number=number: partial(send, number))
        answer = unrender("methods")
        assert (answer.status, answer.error) == (status, f"unrender: {words}\n")


def test_a_process_that_ends_ignores_late_signals() -> None:
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.getsignal(number) for number in numbers]
    try:
        with Signals(process=True):
            assert hasattr(signal.getsignal(signal.SIGTERM), GRACEFUL)
        assert [signal.getsignal(number) for number in numbers] == [signal.SIG_IGN] * 2
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


def test_a_run_that_is_given_up_is_no_success(unrender, monkeypatch: pytest.MonkeyPatch, mitsuba_variant: str) -> None:
    import dataclasses

    before = PathGradient.estimate

    def estimate(self: Any, problem: Any, parameters: Any, state: Any, key: Any) -> Any:
        found, after = before(self, problem, parameters, state, key)
        return (dataclasses.replace(found, loss=np.nan) if key.step >= 3 else found), after

    monkeypatch.setattr(PathGradient, "estimate", estimate)
    answer = unrender("run", *TOY, "--out", "run", "--variant", mitsuba_variant)
    assert (answer.status, answer.error) == (4, "unrender: failed: the lines above name the cause\n")
    assert "failed: stopped after 23 steps; the result has the values of the 3 applied steps" in answer.out
    assert "to try once more from its last step: unrender resume run" in answer.out
    assert json.loads(Path("run/run.json").read_text())["status"] == "failed"
    assert "failed: gradients were not finite" in Path("run/report.html").read_text()
    methods = ["--methods", "plain,rcv", "--seconds", 0.5, "--final-spp", 1]
    answer = unrender("compare", "exponential", *methods, "--out", "both", "--variant", mitsuba_variant)
    assert answer.status == 4
    assert "failed after" in Path("both/compare.html").read_text()
