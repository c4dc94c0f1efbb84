"""Callbacks that several tests of runs share."""

from __future__ import annotations

from typing import Any

import unrender as ur


def of_the_run(warnings: list[str]) -> list[str]:
    """Warnings without the advice that a short run has not settled, which a test of a few steps expects."""
    return [line for line in warnings if "the run ended before it settled" not in line]


class At(ur.protocols.Callback):
    """Does something once, after a number of steps."""

    def __init__(self, step: int, what: Any):
        self.step, self.what = step, what

    def on_step(self, run, record):
        if run.step == self.step:
            self.what(run)
