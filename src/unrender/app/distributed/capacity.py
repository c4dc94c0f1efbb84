"""Whether a share of the views fits a worker's memory, before anything is rendered."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from unrender.core.errors import InputError
from unrender.scene.problem import Problem

__all__ = ["check", "needed"]

_COPIES = 8
"""Of each parameter in a worker: current and previous, both scenes' own, the gradients of both, what is sent and what arrived."""
_REMEMBERED = 24
"""Images of a view that a control variate remembers: itself, its variance and ten statistics, before and after a step."""
_PLAIN = 4
"""Images of a view otherwise: reference, rendering, loss derivative and mask."""
_FLOAT = 4


def needed(problem: Problem, views: Sequence[int], remembers: bool) -> tuple[dict[str, int], int]:
    """Bytes of a worker's memory for each parameter, and for these views.

    Args:
        problem: the whole one.
        views: of the share.
        remembers: whether the image estimator remembers views.
    """
    parameters = {key: _COPIES * _FLOAT * math.prod(shape) for key, shape in problem.shapes().items()}
    resolutions = problem.renderer.resolutions()
    pixels = sum(math.prod(resolutions[problem.views[view].sensor]) for view in views)
    return parameters, pixels * 3 * _FLOAT * (_REMEMBERED + _PLAIN if remembers else _PLAIN)


def check(problem: Problem, shares: Sequence[Sequence[int]], free: Sequence[tuple[str, int]], remembers: bool) -> None:
    """Raise `InputError` where a share does not fit: with its size, and what would fit.

    Args:
        problem: the whole one.
        shares: the views of each.
        free: where each lives, and bytes that it may have; 0 for unknown.
        remembers: see `needed`.
    """
    for views, (where, room) in zip(shares, free, strict=True):
        parameters, images = needed(problem, views, remembers)
        if not room or sum(parameters.values()) + images <= room:
            continue
        left = room - sum(parameters.values())
        if left > 0 and len(views) > 1 and images // len(views) <= left:
            fitting = left * len(views) // images
            raise InputError(
                f"workers: {len(views)} views and what is remembered of them are {_size(images)} on {where}, which has "
                f"{_size(left)} for them: {fitting} would fit; take {-(-len(problem.views) // fitting)} workers or more on as many machines"
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
