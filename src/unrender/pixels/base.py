"""What a pixel sampler is: it says which pixels a step looks at, and with which weights."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from unrender.core.errors import InputError
from unrender.core.random import Key
from unrender.core.trees import Tree
from unrender.problem.batches import PixelSample
from unrender.problem.problem import Problem


@dataclass(frozen=True)
class MiniBatch:
    """What one step looks at.

    Attributes:
        draw: the pixels; None for all of every view.
        samples: paths traced to find them.
        probability: per view how likely its pixels are, relative to equal probabilities: a map (rows, columns), coarser than
            the film; empty where all are alike.
    """

    draw: PixelSample | None
    samples: int = 0
    probability: dict[int, np.ndarray] = field(default_factory=dict)


class PixelSampler(Protocol):
    """Immutable; all that changes is in the state.

    A draw spans the pixels of all views at once. Whatever its probabilities, sums over it are unbiased: they are above zero for every
    pixel, and known exactly.
    """

    def init(self, problem: Problem, parameters: Tree) -> Any:
        """The state before the first step. Raises `InputError` where pixels are drawn and the problem's loss is not one per pixel."""
        ...

    def draw(self, problem: Problem, parameters: Tree, state: Any, key: Key) -> tuple[MiniBatch, Any]:
        """The pixels of one step, and the next state."""
        ...

    def observe(self, problem: Problem, state: Any, gradient: Tree) -> Any:
        """The state after a step whose gradient was this one, before preconditioning."""
        ...


def check_loss(problem: Problem) -> None:
    """Raise `InputError` where the loss of a pixel depends on others."""
    if not problem.loss.pixelwise:
        raise InputError(
            f"pixels: {type(problem.loss).__name__} looks at whole pictures, so pixels cannot be drawn one by one; "
            "use unrender.pixels.All()"
        )
