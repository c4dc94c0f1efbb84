"""Named phases: who hears of them, and how their time is summed up."""

from __future__ import annotations

import pytest

from unrender.core import phases


class Listener(phases.Listener):
    def __init__(self) -> None:
        self.heard: list[tuple[str, object]] = []

    def on_phase(self, name: str) -> None:
        self.heard.append(("begin", name))

    def on_progress(self, share: float) -> None:
        self.heard.append(("at", share))

    def on_phase_end(self, name: str) -> None:
        self.heard.append(("end", name))


def test_a_listener_hears_of_phases_within_phases_and_of_their_progress() -> None:
    listener = Listener()
    with phases.listening(listener), phases.phase("outer"), phases.phase("inner") as advance:
        advance(0.5)
        advance(7.0)
    assert listener.heard == [
        ("begin", "outer"), ("begin", "inner"), ("at", 0.5), ("at", 1.0), ("end", "inner"), ("end", "outer"),
    ]  # fmt: skip


def test_one_that_listens_twice_hears_once() -> None:
    listener = Listener()
    with phases.listening(listener, listener), phases.listening(listener), phases.phase("once"):
        pass
    assert listener.heard == [("begin", "once"), ("end", "once")]


def test_a_phase_ends_by_an_exception_and_nobody_hears_afterwards() -> None:
    listener = Listener()
    with pytest.raises(RuntimeError), phases.listening(listener), phases.phase("fails"):
        raise RuntimeError
    with phases.phase("unheard") as advance:
        advance(1.0)
    assert listener.heard == [("begin", "fails"), ("end", "fails")]


def test_a_stopwatch_counts_no_second_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr(phases.time, "perf_counter", lambda: now[0])
    watch = phases.Stopwatch()

    def spend(seconds: float) -> None:
        now[0] += seconds

    with phases.listening(watch):
        with phases.phase("loading"):
            spend(1.0)
            with phases.phase("references"):
                spend(10.0)
            spend(2.0)
        spend(100.0)  # in no phase
        with phases.phase("loading"):
            spend(4.0)
    assert watch.seconds == {"loading": 7.0, "references": 10.0}
