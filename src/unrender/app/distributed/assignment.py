"""Distribution of views to workers, and sums of their results. This module does not need Ray."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from unrender.app.distributed.messages import Batch
from unrender.core import arrays
from unrender.core.errors import InputError
from unrender.pixels.base import DrawStatistics
from unrender.scene.batches import PixelSample
from unrender.scene.problem import Problem


def assign(pixels: Sequence[int], workers: int) -> tuple[tuple[int, ...], ...]:
    """Return the views of each worker, ascending. The largest remaining view goes to the first worker with the fewest pixels so far. At
    most one worker per view is used."""
    shares: list[list[int]] = [[] for _ in range(min(workers, len(pixels)))]
    loads = [0] * len(shares)
    for view in sorted(range(len(pixels)), key=lambda index: -pixels[index]):
        least = loads.index(min(loads))
        shares[least].append(view)
        loads[least] += pixels[view]
    return tuple(tuple(sorted(share)) for share in shares)


def total(parts: Iterable[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Return the sum of trees of equal keys, shapes and types in order, in double precision; {} for none, or empty ones."""
    sums: dict[str, np.ndarray] = {}
    for part in parts:
        for key, value in part.items():
            if key not in sums:
                sums[key] = np.zeros(value.shape, np.float64)
            sums[key] += value
    return sums


_SIZES = 16
"""Number of distinct sizes that a share's part of a mini-batch is padded to, since each size needs its own kernel."""


def split(problem: Problem, sample: PixelSample, shares: Sequence[Sequence[int]]) -> list[Batch | None]:
    """Return the pixels of each share, in the mini-batch's order; None for a share without pixels.

    Padding has weight 0, and the random numbers of the mini-batch's first pixel.
    """
    views, pixels = (arrays.numpy(x).astype(np.uint32) for x in (sample.views, sample.pixels))
    weights = arrays.numpy(sample.weights).reshape(-1)
    unit = max(1, -(-len(views) // _SIZES))
    result: list[Batch | None] = []
    for share in shares:
        local = np.full(len(problem.views), len(share), np.uint32)
        local[list(share)] = np.arange(len(share))
        own = np.flatnonzero(local[views] < len(share))
        if not len(own):
            result.append(None)
            continue
        fill = -len(own) % unit if len(shares) > 1 else 0
        parts = local[views[own]], pixels[own], weights[own], own.astype(np.uint32)
        local_views, own_pixels, own_weights, positions = (np.pad(part, (0, fill)) for part in parts)
        result.append(Batch(local_views, own_pixels, own_weights, positions, len(views)))
    return result


def joined(parts: Sequence[tuple[Batch, DrawStatistics]]) -> DrawStatistics | None:
    """Return the pixel statistics of all shares, in the mini-batch's order; None if no share returned any."""
    if not parts:
        return None
    squares, moments = (np.zeros((parts[0][0].count, 3)) for _ in range(2))
    for batch, draws in parts:
        valid = batch.weights > 0
        squares[batch.positions[valid]] = draws.squares[valid]
        moments[batch.positions[valid]] = draws.moments[valid]
    return DrawStatistics(squares, moments)


_COPIES = 8
"""Copies of each parameter in a worker: current, previous, both scenes' own, both gradients, sent and received."""
_WITH_CONTROL_VARIATE = 24
"""Images per view in the memory of a control variate: itself, its variance and ten statistics, before and after a step."""
_PLAIN = 4  # other images per view: reference, rendering, loss derivative and mask
_FLOAT = 4


def needed(problem: Problem, views: Sequence[int], has_memory: bool) -> tuple[dict[str, int], int]:
    """Return the bytes of a worker's memory for each parameter, and for these views, with those of an image estimator that `has_memory`."""
    parameters = {key: _COPIES * _FLOAT * math.prod(shape) for key, shape in problem.shapes().items()}
    resolutions = problem.renderer.resolutions()
    pixels = sum(math.prod(resolutions[problem.views[view].sensor]) for view in views)
    return parameters, pixels * 3 * _FLOAT * (_WITH_CONTROL_VARIATE + _PLAIN if has_memory else _PLAIN)


def check(problem: Problem, shares: Sequence[Sequence[int]], free: Sequence[tuple[str, int]], has_memory: bool) -> None:
    """Raise `InputError` if a share does not fit, stating its size and what would fit. `free`: (machine, bytes or 0 if unknown) of each."""
    for views, (where, room) in zip(shares, free, strict=True):
        parameters, images = needed(problem, views, has_memory)
        if not room or sum(parameters.values()) + images <= room:
            continue
        left = room - sum(parameters.values())
        if left > 0 and len(views) > 1 and images // len(views) <= left:
            fitting = left * len(views) // images
            raise InputError(
                f"workers: {len(views)} views need {_size(images)} with their image statistics, but {where} has {_size(left)} for them; "
                f"{fitting} would fit: use at least {-(-len(problem.views) // fitting)} workers on as many machines"
            )
        key = max(parameters, key=lambda name: parameters[name])
        rest = room - images - sum(parameters.values()) + parameters[key]
        raise InputError(
            f"workers: parameter {key} {_shape(problem.shapes()[key])} is {_size(parameters[key])} in each worker ({_COPIES} copies), "
            f"but {where} has {_size(max(rest, 0))} for it: {_fitting(problem.shapes(), key, parameters, rest)}"
        )


def _fitting(shapes: Mapping[str, tuple[int, ...]], key: str, parameters: Mapping[str, int], rest: int) -> str:
    shape = shapes[key]
    axes = len(shape) - 1 if len(shape) > 1 else 1
    factor = max(rest, 0) / parameters[key]
    smaller = tuple(int(n * factor ** (1 / axes)) for n in shape[:axes]) + shape[axes:]
    return f"{_shape(smaller)} would fit" if min(smaller) > 0 else "none would fit"


def _shape(shape: tuple[int, ...]) -> str:
    return "(" + " × ".join(map(str, shape)) + ")"


def _size(count: float) -> str:
    return f"{count / 1e9:.3g} GB" if count >= 1e8 else f"{count / 1e6:.3g} MB"
