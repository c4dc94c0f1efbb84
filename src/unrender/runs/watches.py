"""Warnings of a run: settings before its first step; parameters without influence, numbers at their bounds, and faulty meshes."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from unrender.core import arrays, memory
from unrender.core.arrays import Array
from unrender.core.geometry import weld
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import BlockEstimate
from unrender.optimizers.base import Optimizer, rates_of
from unrender.optimizers.recipes import Adam, MetaAdam, ScheduleFree
from unrender.pixels.uniform import Views
from unrender.runs.callbacks import Callback
from unrender.runs.folder.state import parts
from unrender.scene.problem import Problem
from unrender.scene.surfaces import crossing_triangles, folds

if TYPE_CHECKING:
    from unrender.runs.run import Run

_NEAR = 0.01  # distance to a bound, relative to the range, below which a number counts as at the bound
_SHARE = 0.05  # share of the elements of a texture, grid or colour that must be at a bound


class BoundsWatch(Callback):
    """Callback that warns of numbers that started inside of a bounded range and end next to one of its bounds.

    A derivative may vanish there or be mostly noise, so an optimisation that overshot does not return. Elements of colours, textures and
    grids may well be at the ends of the physical range, so they count at other bounds only, and at the least roughness: the range ends
    there so that paths have densities.
    """

    def warnings(self, run: Run) -> list[str]:
        lines, known = [], run.problem.renderer.parameters()
        for key, unknown in run.problem.unknowns.items() if run.stopped else ():
            first, (low, high) = unknown.initial, unknown.bounds
            last = arrays.numpy(run.parameters[key])
            if low is None or high is None or first.shape != last.shape:  # a grid that is still coarse, or another mesh
                continue
            near = _NEAR * (high - low)
            for bound, physical in ((low, known[key].lowest), (high, known[key].highest)):
                count = int(np.sum((np.abs(last - bound) <= near) & (near < np.abs(first - bound))))
                usual = first.size > 1 and bound == physical and not (bound == low and low > 0.0)
                if usual or count < (1.0 if first.size == 1 else _SHARE * first.size):
                    continue
                ended = f"ended at {last.item():.3g}," if first.size == 1 else f"{count} of {first.size} values ended"
                wider = "" if bound == physical else "wider bounds, "
                lines.append(
                    f"parameter {key}: {ended} next to its bound {bound:g}: if this is unexpected, try {wider}another seed or a lower "
                    "learning_rate"
                )
        return lines


_LEAST = 1e-30  # square of a norm that is exact in single precision
_STEPS, _DRAWS = 5, 12
"""Number of first steps whose gradients are tested; the same in units of the steps that drawn views need to show all views."""


class InfluenceWatch(Callback):
    """Callback that warns of parameters whose gradient was zero, or below the optimizer's ε, in each of the first steps.

    Steps of Adam and `ScheduleFree` are then below half of their rate, as with dim pictures: gradients of L2 are their squares.

    The steps are five, or more if steps draw some of the views. Parameters of a block that is not estimated yet are excluded.
    """

    def __init__(self) -> None:
        self._steps = 0  # unknown before the first step
        self._small: dict[str, bool] = {}

    def on_update(self, run: Run, estimate: Estimate, applied: bool) -> None:
        self._steps = self._steps or max(_STEPS, _draws(run))
        if not applied or run.step > self._steps:
            return
        zero, steps = run.state.zero_gradient, self._steps
        block = estimate.get(BlockEstimate)
        of_block = () if block is None else block.keys  # whose optimizer has no ε
        waiting = of_block if block is not None and block.estimate is None else ()
        epsilon = max(
            (part.epsilon for part in parts(run.optimizer) if type(part) in (Adam, ScheduleFree)), default=0.0
        )
        for key, gradient in estimate.gradient.items():
            norm = _norm(gradient)
            zero[key] = zero[key] and key not in waiting and norm == 0.0
            self._small[key] = self._small.get(key, True) and key not in of_block and 0.0 < norm < epsilon
            if zero[key] and run.step == steps:
                run.warnings.append(
                    f"parameter {key}: its gradient is zero so far; it does not seem to influence the images"
                )
            if self._small[key] and run.step == steps:
                run.warnings.append(
                    f"parameter {key}: its gradient is below the optimizer's epsilon of {epsilon:g}, so its steps are short; scale lights "
                    "and references up"
                )


def _norm(gradient: Array) -> float:
    """Return the Euclidean norm of a gradient, whose square may be below single precision."""
    square = arrays.number(memory.square(gradient))
    return math.sqrt(square) if square > _LEAST else math.sqrt(arrays.number(memory.square(gradient / _LEAST))) * _LEAST


def _draws(run: Run) -> int:
    """Return the number of steps that very probably show all views: 1 if each does."""
    counts = (part.count for part in parts(run.estimator) if isinstance(part, Views))
    return max(
        (_DRAWS * math.ceil(len(run.problem.views) / n) for n in counts if n < len(run.problem.views)), default=1
    )


_EVERY, _TRIANGLES = 25, 100
"""Steps between two tests for self-intersections: the first number, or the number of triangles divided by the second if larger."""


class MeshWatch(Callback):
    """Callback that warns of meshes that no image shows any more, and of new self-intersections and folds."""

    def on_update(self, run: Run, estimate: Estimate, applied: bool) -> None:
        hidden = run.state.hidden
        for key, faces in run.problem.faces.items() if applied else ():
            # None for estimators of losses only, or of directions instead of gradients.
            gradient = estimate.gradient.get(key)
            shown = gradient is not None and arrays.number(memory.square(gradient)) > 0.0
            if shown:
                hidden[key] = 0
            elif gradient is not None and key in hidden:
                hidden[key] += 1
                if hidden[key] == _draws(run):
                    run.warnings.append(
                        f"step {run.step}: {key}: its gradient has become zero: the mesh has left the pictures, or is hidden"
                    )
            if run.step % max(_EVERY, len(faces) // _TRIANGLES) == 0 and (line := self._crosses(run, key)):
                run.warnings.append(f"step {run.step}: {line}")

    def warnings(self, run: Run) -> list[str]:
        lines = []
        for key in run.problem.faces if run.stopped else ():
            before, after, joined = _joined(run, key)
            if (count := folds(after, joined)) > folds(before, joined):
                lines.append(
                    f"{key}: the mesh folds over at {count} edges: a lower learning rate, or a larger λ of LargeSteps, keeps it smooth"
                )
            if line := self._crosses(run, key):
                lines.append(line)
        return lines

    def _crosses(self, run: Run, key: str) -> str:
        """Return the warning about new self-intersections of a mesh; "" if there are none, or it was issued."""
        told = f"{key}: the mesh passes through itself"
        ignored = run.problem.unknowns[key].parameter.self_intersection == "ignore"
        if ignored or any(f": {told}" in f": {line}" for line in run.warnings):
            return ""
        before, after, joined = _joined(run, key)
        count = len(crossing_triangles(after, joined))
        if count == 0 or count <= len(crossing_triangles(before, joined)):
            return ""
        return (
            f"{told} at {count} pairs of triangles: a lower learning rate or a larger λ of LargeSteps, "
            'or self_intersection = "prevent" of the parameter'
        )


def _joined(run: Run, key: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the vertices (V, 3) at the start and now, and the faces (F, 3), without seams."""
    start, end = (
        np.asarray(x).reshape(-1, 3) for x in (run.problem.unknowns[key].initial, arrays.numpy(run.parameters[key]))
    )
    first, places = weld(start)
    return start[first], end[first], places[run.problem.faces[key]]


_LARGEST_STEP = 0.5  # fraction of a bounded parameter's range: a longer first step always ends at a bound


def remarks(problem: Problem, optimizer: Optimizer) -> list[str]:
    """Return one line for each parameter whose first step crosses at least half of its range.

    Adam's steps are about as long as the learning rate, in units of the parameter, whatever the scale of the loss.
    """
    if not isinstance(optimizer, (Adam, MetaAdam)):
        return []
    lines = []
    each = rates_of(type(optimizer).__name__, problem.unknowns, optimizer.learning_rate, problem.learning_rates)
    for key, unknown in problem.unknowns.items():
        rate, (low, high) = each[key], unknown.bounds
        if unknown.transform is None and low is not None and high is not None and rate >= _LARGEST_STEP * (high - low):
            lines.append(
                f"parameter {key}: a learning_rate of {rate:g} crosses its range, {low:g} to {high:g}, in "
                f"{_steps((high - low) / rate)}; 0.005 to 0.05 of the range are usual"
            )
    return lines


def _steps(number: float) -> str:
    return "one step" if number <= 1 else f"{number:.2g} steps"
