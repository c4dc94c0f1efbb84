"""A clock of the processor's time that keeps parameters as a descent goes, and ends it.

Both drivers import this in the peer's environment, so it knows nothing of `unrender`.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np


class BudgetSpentError(Exception):
    """Raised within the peer's loop when its time is up."""


class Recorder:
    """Parameters along a descent, over the processor time of its steps, of all threads; the first ones are not counted.

    Args:
        seconds: of the processor.
        points: how many times parameters are kept.
        steps: raise after so many steps at the latest; None for no limit.
        timer: counts the seconds.
        warm: number of first steps that are not counted.
    """

    def __init__(
        self,
        seconds: float,
        points: int,
        steps: int | None = None,
        timer: Callable[[], float] = time.process_time,
        warm: int = 1,
    ):
        self.clock, self.steps = 0.0, 0
        self.kept: list[tuple[float, int, dict[str, np.ndarray]]] = []
        self._seconds, self._every, self._next, self._limit = seconds, seconds / points, 0.0, steps
        self._since: float | None = None
        self._timer, self._warm = timer, warm

    def begin(self) -> None:
        """Before the first step, if it is counted: nothing compiles in it."""
        self._since = self._timer()

    def step(self, values: Callable[[], dict[str, np.ndarray]]) -> None:
        """After each step: `values` makes {key: array}, which is no part of the time."""
        now = self._timer()
        self.clock += 0.0 if self._since is None else now - self._since
        self.steps += 1
        done = self.clock >= self._seconds or (self._limit is not None and self.steps >= self._limit)
        if self.clock >= self._next or done:
            self._next = self.clock + self._every
            self.kept.append((self.clock, self.steps, values()))
        if done:
            raise BudgetSpentError
        self._since = self._timer() if self.steps >= self._warm else None

    def write(self, path: Path, **others: Any) -> None:
        """All that was kept, and `others`, as an .npz file."""
        textures = {f"texture/{key}": np.stack([kept[2][key] for kept in self.kept]) for key in self.kept[0][2]}
        seconds, steps = np.array([kept[0] for kept in self.kept]), np.array([kept[1] for kept in self.kept])
        np.savez(path, seconds=seconds, steps=steps, **textures, **others)


def task() -> dict[str, Any]:
    """What run.py asks for, from the JSON file that is the driver's argument."""
    return json.loads(Path(sys.argv[1]).read_text())


def references(asked: dict[str, Any]) -> list[np.ndarray]:
    """Of each view, (H, W, 3)."""
    with np.load(asked["references"]) as found:
        return [found[f"arr_{view}"] for view in range(len(found.files))]


def difference(render: Callable[[int, int], Any], pictures: list[np.ndarray]) -> float:
    """The root mean square of the difference of a rendering, by view and seed, from pictures, over that of the pictures.

    Of two halves of the samples, so that their noise does not count.
    """
    square = 0.0
    for n, picture in enumerate(pictures):
        one, two = (np.array(render(n, seed)) for seed in (1, 2))
        square += float(np.mean((one - picture) * (two - picture)))
    return float(np.sqrt(max(square, 0.0) / sum(float(np.mean(picture**2)) for picture in pictures)))
