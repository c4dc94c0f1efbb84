"""Callbacks that several tests of runs share."""

from __future__ import annotations

from typing import Any

import unrender as ur


def of_the_run(warnings: list[str]) -> list[str]:
    """Warnings without the lines that a short run has not settled, or cannot be judged, which a test of a few steps expects."""
    return [x for x in warnings if "the run ended before it settled" not in x and "too few to judge" not in x]


class At(ur.protocols.Callback):
    """Does something once, after a number of steps."""

    def __init__(self, step: int, what: Any):
        self.step, self.what = step, what

    def on_step(self, run, record):
        if run.step == self.step:
            self.what(run)
