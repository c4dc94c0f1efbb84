"""Pixel mini-batches, split by who has the views."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from unrender.app.distributed.messages import Batch
from unrender.core import arrays
from unrender.pixels.base import DrawStatistics
from unrender.scene.batches import PixelSample
from unrender.scene.problem import Problem

__all__ = ["joined", "split"]

_SIZES = 16
"""A share's part of a mini-batch is filled up to one of so many sizes, since each is a kernel of its own."""


def split(problem: Problem, sample: PixelSample, shares: Sequence[Sequence[int]]) -> list[Batch | None]:
    """Each share's pixels, in the mini-batch's order; None where it has none.

    What fills up has weight 0, and the random numbers of the mini-batch's first pixel.

    Args:
        problem: the whole one.
        sample: of pixels of all views.
        shares: the views of each.
    """
    views, pixels = (arrays.numpy(x).astype(np.uint32) for x in (sample.views, sample.pixels))
    weights = arrays.numpy(sample.weights).reshape(-1)
    unit = max(1, -(-len(views) // _SIZES))
    found: list[Batch | None] = []
    for share in shares:
        local = np.full(len(problem.views), len(share), np.uint32)
        local[list(share)] = np.arange(len(share))
        mine = np.flatnonzero(local[views] < len(share))
        if not len(mine):
            found.append(None)
            continue
        fill = -len(mine) % unit if len(shares) > 1 else 0

        def filled(values: np.ndarray, fill: int = fill) -> np.ndarray:
            return np.concatenate([values, np.zeros(fill, values.dtype)])

        found.append(
            Batch(
                filled(local[views[mine]]),
                filled(pixels[mine]),
                filled(weights[mine]),
                filled(mine.astype(np.uint32)),
                len(views),
            )
        )
    return found


def joined(parts: Sequence[tuple[Batch, DrawStatistics]]) -> DrawStatistics | None:
    """What the samples of all shares tell, in the mini-batch's order; None where no share was asked."""
    if not parts:
        return None
    squares, moments = (np.zeros((parts[0][0].count, 3)) for _ in range(2))
    for batch, draws in parts:
        drawn = batch.weights > 0
        squares[batch.positions[drawn]] = draws.squares[drawn]
        moments[batch.positions[drawn]] = draws.moments[drawn]
    return DrawStatistics(squares, moments)
