"""The coordinates of the descent: the variables that an optimizer moves in place of the parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from unrender.core import arrays, periodic, trees
from unrender.core.trees import Tree
from unrender.parameterisations.base import Transform
from unrender.preconditioners.base import Preconditioner


@dataclass(frozen=True)
class Coordinates:
    """x = φ(u), u = S v: φ of a parameter's parameterisation, S its preconditioner, each the identity where there is none.

    An optimizer is given u, and the gradient by v; its steps are of v. φ is known by its slope at the present parameters: {key: φ'} of the
    parameters that have one. Outer columns that repeat others are no unknowns: gradients and steps there are copies.

    Attributes:
        transforms: {key: φ}.
        preconditioners: {key: S}.
        repeated: {key: number of columns at each end that repeat those of the opposite end}, see `core.periodic`.
    """

    transforms: Mapping[str, Transform]
    preconditioners: Mapping[str, Preconditioner]
    repeated: Mapping[str, int] = field(default_factory=dict)

    def of(self, parameters: Tree) -> Tree:
        """u."""
        maps = self.transforms
        return {key: maps[key].inverse(x) if key in maps else x for key, x in parameters.items()}

    def slopes(self, parameters: Tree) -> Tree:
        """{key: φ'} where there is a φ."""
        return {key: φ.slope(parameters[key]) for key, φ in self.transforms.items()}

    def curvatures(self, parameters: Tree) -> Tree:
        """{key: φ''} where there is a φ."""
        return {key: φ.curvature(parameters[key]) for key, φ in self.transforms.items()}

    def by_u(self, gradient: Tree, parameters: Tree) -> Tree:
        """The gradient by u, of that by x: φ' g."""
        return _times(gradient, self.slopes(parameters))

    def pull_back(self, gradient: Tree, slopes: Tree) -> Tree:
        """The gradient by v, of that by x: S (φ' g)."""
        return self._smoothed(_times(gradient, slopes))

    def push_forward(self, tangent: Tree, slopes: Tree) -> Tree:
        """The tangent of x, of one of v: φ' (S t)."""
        return _times(self._smoothed(tangent), slopes)

    def moved(self, parameters: Tree, steps: Tree) -> tuple[Tree, Tree]:
        """u after steps of v, and the parameters there; elements without a step are exactly as before."""
        changes = self._smoothed(steps)
        reached = trees.add(self.of(parameters), changes)

        def values(key: str):
            if key not in self.transforms:
                return reached[key]
            return arrays.where(changes[key] == 0, parameters[key], self.transforms[key].forward(reached[key]))

        return reached, {key: values(key) for key in reached}

    def _smoothed(self, tree: Tree) -> Tree:
        maps = self.preconditioners
        found = {key: maps[key].apply(x) if key in maps else x for key, x in tree.items()}
        return {key: periodic.repeat(x, self.repeated.get(key, 0)) for key, x in found.items()}


def _times(tree: Tree, factors: Tree) -> Tree:
    return {key: x * factors[key] if key in factors else x for key, x in tree.items()}
