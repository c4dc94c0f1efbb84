"""The gradients of two states of a problem, the last step's and this one's, on one set of paths."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from unrender import trees
from unrender.arrays import Array
from unrender.gradients.path import crossed_groups
from unrender.images.base import Beside, ImageEstimator
from unrender.keys import Key
from unrender.problem.problem import Problem
from unrender.rendering.port import Shot
from unrender.trees import Tree


@dataclass(frozen=True)
class PairGradient:
    """What one set of paths tells of two states.

    Attributes:
        current, previous: the gradient of each state's loss with respect to its parameters.
        losses: of the current state, one per view, lazy.
        images: of the current state, per view, as the loss saw them.
        samples: paths traced for images and adjoints.
        told: what the image estimator tells, {name: {view: array}}.
        image: the image estimator's next state.
    """

    current: Tree
    previous: Tree
    losses: list[Array]
    images: dict[int, Array]
    samples: int
    told: dict[str, dict[int, Any]]
    image: Any


def pair_gradient(
    problem: Problem, parameters: Tree, image: ImageEstimator, state: Any, beside: Beside, spp: int, key: Key
) -> PairGradient:
    """Both gradients, their noise as much alike as the space allows; their difference is a finite difference of gradients.

    As in `PathGradient`, each group's adjoint is weighted by the loss derivative at the image of all other groups, for each state by
    its own; samples that cannot be cut into groups (1, and primes above 16) get a second set of paths for the adjoint.
    Unbiased each where `PathGradient` is.
    """
    groups = crossed_groups(spp)
    gradients: list[tuple[Tree, Tree]] = []
    losses: list[Array] = []
    kept: list[Any] = []
    images: dict[int, Array] = {}
    told: dict[str, dict[int, Any]] = {}
    samples = 0
    for view in range(len(problem.views)):
        key_view = key.fold(view)
        found, keep = image.estimate(problem, parameters, state, view, spp, groups, key_view.fold(0), beside)
        kept.append(keep)
        paths, traced = found.paths, spp
        if groups == 1:
            shot = Shot(problem.views[view].sensor, spp, key_view.fold(1).uint32())
            paths = problem.renderer.image_pair(parameters, beside.previous, shot, beside.space).paths
            traced += spp
        weights = problem.loss_derivative(view, found.others())
        weights_previous = problem.loss_derivative(view, found.previous_others())
        gradients.append(problem.renderer.adjoint_pair(parameters, beside.previous, paths, weights, weights_previous))
        picture = found.mean()
        images[view] = picture
        losses.append(problem.loss_value(view, picture))
        samples += traced * int(picture.shape[0]) * int(picture.shape[1])
        for name, value in found.info.items():
            told.setdefault(name, {})[view] = value
    current, previous = gradients[0]
    for a, b in gradients[1:]:
        current, previous = trees.add(current, a), trees.add(previous, b)
    after = image.advance(parameters, state, tuple(kept))
    return PairGradient(current, previous, losses, images, samples, told, after)
