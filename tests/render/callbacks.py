"""Callbacks that several tests of runs share."""

from __future__ import annotations

from typing import Any

import unrender as ur


class At(ur.protocols.Callback):
    """Does something once, after a number of steps."""

    def __init__(self, step: int, what: Any):
        self.step, self.what = step, what

    def on_step(self, run, record):
        if run.step == self.step:
            self.what(run)
