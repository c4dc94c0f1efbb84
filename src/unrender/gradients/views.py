"""What all gradient estimators by path replay do with each view: image, loss derivative, adjoint; of one state, or of two on one set
of paths."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from unrender import trees
from unrender.arrays import Array
from unrender.images.base import Beside, ImageEstimator
from unrender.keys import Key
from unrender.problem.problem import Problem
from unrender.rendering.port import Shot
from unrender.trees import Tree

_MOST_GROUPS = 16


@dataclass(frozen=True)
class Gathered:
    """What one step's paths tell, over all views.

    Attributes:
        gradient: of the loss with respect to the current parameters.
        previous: that of the previous state, with respect to its own; None where it was not asked for.
        losses: of the current state, one per view, lazy.
        images: of the current state, per view, as the loss saw them.
        samples: paths traced for images and adjoints.
        told: what the image estimator tells, {name: {view: array}}.
        image: the image estimator's next state.
    """

    gradient: Tree
    previous: Tree | None
    losses: list[Array]
    images: dict[int, Array]
    samples: int
    told: dict[str, dict[int, Any]]
    image: Any


def crossed_groups(spp: int, adjoint_spp: int | None = None) -> int:
    """How many groups `spp` samples are cut into; 1 where they cannot be, or the adjoint has paths of its own."""
    return 1 if adjoint_spp is not None else max(n for n in range(1, _MOST_GROUPS + 1) if spp % n == 0)


def gather(
    problem: Problem,
    parameters: Tree,
    image: ImageEstimator,
    state: Any,
    spp: int,
    key: Key,
    adjoint_spp: int | None = None,
    beside: Beside | None = None,
) -> Gathered:
    """The loss gradient, each group's adjoint weighted by the loss derivative at the image of all other groups (`PathGradient`).

    A single group gets `adjoint_spp` paths of its own for the adjoint, `spp` where that is None. With `beside`, the previous state's
    gradient too, on the same paths and weighted by its own images: the noise of the two is as much alike as the space allows, and
    their difference is a finite difference of gradients.
    """
    groups = crossed_groups(spp, adjoint_spp)
    gradient: Tree = {}
    previous: Tree | None = None
    losses: list[Array] = []
    kept: list[Any] = []
    images: dict[int, Array] = {}
    told: dict[str, dict[int, Any]] = {}
    samples = 0
    for view in range(len(problem.views)):
        key_view = key.fold(view)
        found, keep = image.estimate(problem, parameters, state, view, spp, groups, key_view.fold(0), beside)
        kept.append(keep)
        picture = found.mean()
        images[view] = picture
        losses.append(problem.loss_value(view, picture))
        paths, traced = found.paths, spp
        if groups == 1:
            shot = Shot(problem.views[view].sensor, adjoint_spp or spp, key_view.fold(1).uint32())
            paths = _paths(problem, parameters, shot, beside)
            traced += shot.spp
        weights = problem.loss_derivative(view, found.others())
        if beside is None:
            part = problem.renderer.adjoint(parameters, paths, weights)
        else:
            weights_previous = problem.loss_derivative(view, found.previous_others())
            part, other = problem.renderer.adjoint_pair(parameters, beside.previous, paths, weights, weights_previous)
            previous = other if previous is None else trees.add(previous, other)
        gradient = trees.add(gradient, part) if gradient else part
        samples += traced * int(picture.shape[0]) * int(picture.shape[1])
        for name, value in found.info.items():
            told.setdefault(name, {})[view] = value
    after = image.advance(parameters, state, tuple(kept))
    return Gathered(gradient, previous, losses, images, samples, told, after)


def _paths(problem: Problem, parameters: Tree, shot: Shot, beside: Beside | None) -> Any:
    if beside is None:
        return problem.renderer.image(parameters, shot).paths
    return problem.renderer.image_pair(parameters, beside.previous, shot, beside.space).paths
