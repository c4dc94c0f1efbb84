"""Perturbations of parameters that have a preconditioner: Gaussian in the coordinates of the descent, so as smooth as its steps."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from unrender.core import arrays, vectors
from unrender.core.arrays import Array
from unrender.core.errors import InputError
from unrender.core.trees import Tree
from unrender.preconditioners.base import Preconditioner
from unrender.scene.problem import Problem

_PROBES = 4
"""Draws that tell how much S shrinks white noise: of a thousand vertices, to 5 percent or less."""


class PreconditionedPerturbations:
    """A function of the parameters as one of v, where u = θ + S (v − θ), S the preconditioners, θ the parameters now.

    A Gaussian of v of deviation σ moves u by σ S ε: neighbours move alike, by less than σ. `deviations` are those of v that move the
    elements of u by σ, in the mean square over a parameter. Without preconditioners all is as it is.

    Args:
        problem: whose preconditioners.
        parameters: θ; their keys and shapes.

    Raises:
        InputError: where beside a preconditioner there is a parameterisation, whose coordinates would be others.
    """

    def __init__(self, problem: Problem, parameters: Tree):
        maps = problem.coordinates.preconditioners
        self._maps: Mapping[str, Preconditioner] = {key: maps[key] for key in parameters if key in maps}
        self._parameters, self._theta = parameters, vectors.ravel(parameters)
        bent = [key for key in problem.coordinates.transforms if key in parameters]
        if self._maps and bent:
            smooth = next(iter(self._maps))
            raise InputError(
                f"SmoothedDerivatives: parameter {smooth} has a preconditioner and {bent[0]} a parameterisation; leave one of them out"
            )

    def __bool__(self) -> bool:
        """Whether there is a preconditioner."""
        return bool(self._maps)

    def deviations(self, sigma: Mapping[str, float]) -> dict[str, float]:
        """{key: deviation of v} for {key: σ of u}: σ over the root mean square of S ε, by a few draws of ε, the same in every step."""
        return {
            key: value / self._gain(key, arrays.shape(self._parameters[key])) if key in self._maps else value
            for key, value in sigma.items()
        }

    def by_coordinates(self, f: Callable[[np.ndarray], np.ndarray]) -> Callable[[np.ndarray], np.ndarray]:
        """f of u, (B, n) to (B,), as a function of v."""
        if not self._maps:
            return f
        return lambda points: f(self._reached(points))

    def _reached(self, points: np.ndarray) -> np.ndarray:
        """u at v, (B, n) each."""
        changes = vectors.parts(points - self._theta, self._parameters)
        rows = [
            np.stack([self._smoothed(key, row) for row in rows]) if key in self._maps else rows
            for key, rows in changes.items()
        ]
        return self._theta + np.concatenate([part.reshape(len(points), -1) for part in rows], axis=1)

    def _gain(self, key: str, shape: tuple[int, ...]) -> float:
        draws = np.random.default_rng(0).standard_normal((_PROBES, *shape))
        return float(np.sqrt(np.mean([np.mean(self._smoothed(key, draw) ** 2) for draw in draws])))

    def _smoothed(self, key: str, x: Array) -> np.ndarray:
        """S x on the host, in double precision."""
        return np.asarray(self._maps[key].apply(np.asarray(x, np.float32)), np.float64)
