"""What all gradient estimators by path replay do with each frame, a view or a batch of pixels: image, loss derivative, adjoint; of one
state, or of two on one set of paths."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from unrender.core import trees
from unrender.core.arrays import Array
from unrender.core.errors import InputError
from unrender.core.random import Key
from unrender.core.trees import Tree
from unrender.images.base import ImageEstimator, PairRequest
from unrender.pixels.all import All
from unrender.pixels.base import MiniBatch, PixelSampler
from unrender.problem.batches import PixelBatch, WholeView, whole_views
from unrender.problem.problem import Problem
from unrender.rendering.renderer import RenderSession, SampleRequest

PIXELS = 1 << 32
"""The stream of a step's key that draws its pixels; those below are its frames'."""

_MOST_GROUPS = 16


@runtime_checkable
class _PixelSampler(PixelSampler, Protocol): ...


@dataclass(frozen=True)
class GradientSample:
    """What one step's paths tell, over all frames.

    Attributes:
        gradient: of the loss with respect to the current parameters.
        previous: that of the previous state, with respect to its own; None where it was not asked for.
        losses: of the current state, one per frame, lazy.
        images: of the current state, per whole view, as the loss saw them.
        samples: paths traced for images, adjoints and the pick.
        told: what the image estimator tells of whole views, and the pick of its probabilities, {name: {view: array}}.
        image: the image estimator's next state.
    """

    gradient: Tree
    previous: Tree | None
    losses: list[Array]
    images: dict[int, Array]
    samples: int
    info: dict[str, dict[int, Any]]
    image: Any


def leave_one_out_groups(spp: int, adjoint_spp: int | None = None) -> int:
    """How many groups `spp` samples are cut into; 1 where they cannot be, or the adjoint has paths of its own."""
    return 1 if adjoint_spp is not None else max(n for n in range(1, _MOST_GROUPS + 1) if spp % n == 0)


def check_pixels(owner: str, pixels: Any, image: ImageEstimator) -> None:
    """Raise `InputError` for what is no pixel sampler, or one that draws pixels where the image must be whole."""
    if isinstance(pixels, type) or not isinstance(pixels, _PixelSampler):
        raise InputError(f"{owner}: pixels must be one of unrender.pixels, such as All(), got {pixels!r}")
    if not isinstance(pixels, All) and not image.pixelwise:
        raise InputError(f"{owner}: {type(image).__name__} needs whole views; use pixels=unrender.pixels.All()")


def gather(
    problem: Problem,
    parameters: Tree,
    image: ImageEstimator,
    state: Any,
    spp: int,
    key: Key,
    adjoint_spp: int | None = None,
    pair_request: PairRequest | None = None,
    batch: MiniBatch | None = None,
) -> GradientSample:
    """The loss gradient, each group's adjoint weighted by the loss derivative at the image of all other groups (`PathGradient`).

    A single group gets `adjoint_spp` paths of its own for the adjoint, `spp` where that is None. With `pair_request`, the previous state's
    gradient too, on the same paths and weighted by its own images: the noise of the two is as much alike as the space allows, and
    their difference is a finite difference of gradients. With a `batch` of pixels, of these alone, in one launch for all views; the image
    estimator's state advances where whole views were looked at.
    """
    drawn = batch is not None and batch.draw is not None
    frames = whole_views(problem)
    if batch is not None and batch.draw is not None:
        frames = [PixelBatch(problem, batch.draw)]
    groups = leave_one_out_groups(spp, adjoint_spp)
    session = problem.renderer.prepare(list(parameters), pair_request.space if pair_request else None)
    gradient: Tree = {}
    previous: Tree | None = None
    losses: list[Array] = []
    kept: list[Any] = []
    images: dict[int, Array] = {}
    info: dict[str, dict[int, Any]] = {"pixel_probability": batch.probability} if batch and batch.probability else {}
    samples = batch.samples if batch else 0
    for index, frame in enumerate(frames):
        key_frame = key.fold(index)
        found, keep = image.estimate(problem, parameters, state, frame, spp, groups, key_frame.fold(0), pair_request)
        kept.append(keep)
        picture = found.mean()
        losses.append(frame.loss_value(picture))
        paths, traced = found.paths, spp
        if groups == 1:
            request = frame.request(adjoint_spp or spp, key_frame.fold(1).uint32())
            paths = _paths(session, parameters, request, pair_request)
            traced += request.spp
        weights = frame.loss_derivative(found.others())
        if pair_request is None:
            part = session.adjoint(parameters, paths, weights)
        else:
            weights_previous = frame.loss_derivative(found.previous_others())
            part, other = session.adjoint_pair(parameters, pair_request.previous, paths, weights, weights_previous)
            previous = other if previous is None else trees.add(previous, other)
        gradient = trees.add(gradient, part) if gradient else part
        samples += traced * frame.pixels
        if isinstance(frame, WholeView):
            images[frame.view] = picture
            for name, value in found.info.items():
                info.setdefault(name, {})[frame.view] = value
    after = state if drawn else image.advance(parameters, state, tuple(kept))
    return GradientSample(gradient, previous, losses, images, samples, info, after)


def _paths(session: RenderSession, parameters: Tree, request: SampleRequest, pair_request: PairRequest | None) -> Any:
    if pair_request is None:
        return session.image(parameters, request).paths
    return session.image_pair(parameters, pair_request.previous, request, pair_request.space).paths
