"""Coordinates of the optimisation: the variables that an optimizer updates in place of the parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from unrender.core import arrays, periodic, trees
from unrender.core.trees import Tree
from unrender.parameterisations import Transform
from unrender.preconditioners.base import HeldElements, Preconditioner


@dataclass(frozen=True)
class Coordinates:
    """The change of variables x = φ(u), u = S v, with parameterisation φ and preconditioner S; each is the identity if absent.

    An optimizer gets u and the gradient with respect to v; its steps are in v. φ enters by its derivative at the current parameters,
    {key: φ'}. In arrays with repeated border columns, gradients and steps of those columns are copies.

    Attributes:
        transforms: {key: φ}.
        preconditioners: {key: S}.
        repeated: {key: number of repeated columns at each end}, see `core.periodic`.
    """

    transforms: Mapping[str, Transform]
    preconditioners: Mapping[str, Preconditioner]
    repeated: Mapping[str, int] = field(default_factory=dict)

    def of(self, parameters: Tree) -> Tree:
        """Return u = φ⁻¹(x)."""
        maps = self.transforms
        return {key: maps[key].inverse(x) if key in maps else x for key, x in parameters.items()}

    def slopes(self, parameters: Tree) -> Tree:
        """Return {key: φ'} for the parameters that have a φ."""
        return {key: φ.slope(parameters[key]) for key, φ in self.transforms.items() if key in parameters}

    def curvatures(self, parameters: Tree) -> Tree:
        """Return {key: φ''} for the parameters that have a φ."""
        return {key: φ.curvature(parameters[key]) for key, φ in self.transforms.items()}

    def wrt_u(self, gradient: Tree, parameters: Tree) -> Tree:
        """Return the gradient with respect to u, φ' g, from the gradient g with respect to x."""
        return _times(gradient, self.slopes(parameters))

    def pull_back(self, gradient: Tree, slopes: Tree, free: Tree | None = None) -> Tree:
        """Return the gradient with respect to v, S (φ' g), from the gradient g with respect to x; `free`: see `moved`."""
        return self._precondition(_times(gradient, slopes | (free or {})))

    def push_forward(self, tangent: Tree, slopes: Tree) -> Tree:
        """Return the tangent of x, φ' (S t), from a tangent t of v."""
        return _times(self._precondition(tangent), slopes)

    @property
    def held(self) -> dict[str, HeldElements]:
        """The preconditioners of parameters of which elements may stay at a bound."""
        return {key: S for key, S in self.preconditioners.items() if isinstance(S, HeldElements)}

    def moved(self, parameters: Tree, steps: Tree, free: Tree | None = None) -> tuple[Tree, Tree]:
        """Return u and x after steps of v. Elements of x whose change is zero keep their exact value.

        Args:
            free: {key: 0 for elements that stay at a bound, 1 for the others} of parameters with a preconditioner and without a φ.
        """
        changes = _times(self._precondition(steps), {key: S.free for key, S in self.held.items()} | (free or {}))
        reached = trees.add(self.of(parameters), changes)

        def values(key: str):
            if key not in self.transforms:
                return reached[key]
            return arrays.where(changes[key] == 0, parameters[key], self.transforms[key].forward(reached[key]))

        return reached, {key: values(key) for key in reached}

    def _precondition(self, tree: Tree) -> Tree:
        maps = self.preconditioners
        result = {key: maps[key].apply(x) if key in maps else x for key, x in tree.items()}
        return {key: periodic.repeat(x, self.repeated.get(key, 0)) for key, x in result.items()}


def _times(tree: Tree, factors: Tree) -> Tree:
    return {key: x * factors[key] if key in factors else x for key, x in tree.items()}
