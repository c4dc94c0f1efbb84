"""Turns of shapes, lights and cameras: a descent of a pose ends in the nearest minimum, which may be a quarter turn from the best one."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np

from unrender.core.errors import InputError
from unrender.estimators.fresh_pictures import FreshPictures
from unrender.methods.rules.starts import Place
from unrender.scene.problem import Problem
from unrender.statistics.paired_losses import difference, mean_and_error

_TURNS = 8  # number of compared angles of a rotation about one axis; of a rotation vector, half as many about each axis
_ERRORS, _EQUAL = 4.0, 2.0
"""Standard errors of the difference of two losses beyond which another turn is taken, and within which two turns are equally good."""


def turned_keys(problem: Problem, keys: Sequence[str]) -> tuple[str, ...]:
    """Return the rotations among some unknowns, without those that have bounds, a prior or a parameterisation."""
    known, unknowns = problem.renderer.parameters(), problem.unknowns
    return tuple(
        key
        for key in keys
        if known[key].angle and known[key].shape in ((), (3,)) and unknowns[key].bounds == (None, None)
        if unknowns[key].prior is None and unknowns[key].transform is None
    )


def number_of_turns(problem: Problem, keys: Sequence[str]) -> int:
    """Return how many pictures `better_turn` compares at most, that of the given values included."""
    return 1 + sum(len(_turns_of(problem, key, problem.unknowns[key].initial)) for key in keys)


def better_turn(
    problem: Problem,
    pictures: FreshPictures,
    values: Mapping[str, np.ndarray],
    keys: Sequence[str],
    share: float = 1.0,
) -> Place | None:
    """Return the turn of the least loss, key by key; None unless its loss is smaller than a share of that of the given values, beyond
    noise. The latter must be above 0 beyond noise.

    Of turns that are equally good, as those of a symmetric shape are, the one nearest to the initial value is taken.

    Args:
        problem: Problem of the run.
        pictures: Renderer of the pictures.
        values: {key: array}, the values of all unknowns.
        keys: Keys of rotations, see `turned_keys`.
        share: Share of the loss, at most 1.
    """
    first = best = pictures.losses(pictures.images(values))
    chosen: dict[str, np.ndarray] = {}
    start, error = mean_and_error(first)
    for key in keys if start > _ERRORS * error else ():
        initial, better = problem.unknowns[key].initial, []
        for turn in sorted(_turns_of(problem, key, values[key]), key=partial(_distance, initial)):
            try:
                losses = pictures.losses(pictures.images({**values, **chosen, key: turn}))
            except InputError:  # a value that the renderer rejects
                continue
            change = difference(losses, best, sampled=pictures.sampled)
            if change.value > _ERRORS * change.standard_error:
                better.append((turn, losses))
        if better:
            least = min((losses for _, losses in better), key=lambda losses: mean_and_error(losses)[0])
            rises = [difference(least, losses, sampled=pictures.sampled) for _, losses in better]
            chosen[key], best = next(
                each for each, rise in zip(better, rises, strict=True) if rise.value <= _EQUAL * rise.standard_error
            )
    total = mean_and_error(best)[0]
    return Place(chosen, max(total, 0.0) / start, total) if chosen and total < share * start else None


def _turns_of(problem: Problem, key: str, value: np.ndarray) -> list[np.ndarray]:
    """Return `turns` of an unknown rotation. Lights have all, since most of their aims leave the pictures dark."""
    info = problem.renderer.parameters()[key]
    return turns(value, None if info.axial else info.forward, everywhere=info.light)


def turns(value: np.ndarray, axis: Sequence[float] | None = None, everywhere: bool = False) -> list[np.ndarray]:
    """Return other turns of a rotation: of one angle, in steps of 45°; of a rotation vector (3,), by 90°, 180° and 270° about each axis of
    the world, and about an own `axis`. With `everywhere`, all 23 rotations of a cube replace those about the world's axes. Angles are in
    radians, within a full turn."""
    if value.size == 1:
        angles = np.ravel(value)[0] + 2 * math.pi / _TURNS * np.arange(1, _TURNS)
        return [np.full(value.shape, math.remainder(angle, 2 * math.pi), np.float32) for angle in angles]
    quarters = [4 * math.pi / _TURNS * number for number in range(1, _TURNS // 2)]
    steps = [angle * corner for corner in np.eye(3) for angle in quarters]
    if everywhere:
        axes = [np.array(signs) for signs in itertools.product((1.0, 0.0, -1.0), repeat=3) if signs > (0.0, 0.0, 0.0)]
        steps += [math.pi / math.sqrt(2.0) * x for x in axes if np.abs(x).sum() == 2.0]
        steps += [sign * 2 * math.pi / 3 / math.sqrt(3.0) * x for x in axes if x.all() for sign in (1.0, -1.0)]
    own = [] if axis is None else [_composed(value, angle * np.asarray(axis)) for angle in quarters]
    return [*(_composed(step, value) for step in steps), *own]


def _distance(initial: np.ndarray, turn: np.ndarray) -> float:
    """Return the angle between two rotations in radians."""
    if turn.size == 1:
        return abs(math.remainder(np.ravel(turn)[0] - np.ravel(initial)[0], 2 * math.pi))
    return float(np.linalg.norm(_composed(turn, -initial)))


def _composed(second: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Return the rotation vector of a rotation after another, (3,), by quaternions."""
    (a, u), (b, v) = _quaternion(second), _quaternion(first)
    real, imaginary = a * b - u @ v, a * v + b * u + np.cross(u, v)
    sine = float(np.linalg.norm(imaginary))
    angle = 2 * math.atan2(sine, abs(real))
    return (math.copysign(angle / max(sine, 1e-12), real) * imaginary).astype(np.float32)


def _quaternion(vector: np.ndarray) -> tuple[float, np.ndarray]:
    angle = float(np.linalg.norm(vector))
    return math.cos(angle / 2), np.asarray(vector, np.float64) * (math.sin(angle / 2) / max(angle, 1e-12))
