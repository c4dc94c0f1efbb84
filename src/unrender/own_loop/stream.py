"""The images of one sensor, or the pixel mini-batches of several, from step to step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import reduce
from typing import Any

import numpy as np

from unrender.core import arrays, trees
from unrender.core.arrays import Array
from unrender.core.random import Key
from unrender.core.trees import Tree
from unrender.estimators.sample_groups import PIXELS
from unrender.own_loop.options import Options
from unrender.pixels.base import MiniBatch
from unrender.rendering.renderer import RenderSession, SampleRequest, Space
from unrender.scene.batches import Frame, PixelBatch, whole_views
from unrender.scene.problem import Problem
from unrender.statistics import meta


@dataclass(frozen=True)
class CoupledState:
    """State between steps.

    Attributes:
        parameters: of the last step that had a gradient; None before the first.
        derivative: the loss derivative of that step, (1, H, W, 3).
        elements: {key: meta-estimate and statistics of each element of the gradient}; empty before the first step.
    """

    parameters: Tree | None = None
    derivative: Array | None = None
    elements: dict[str, meta.State] = field(default_factory=dict)


@dataclass(frozen=True)
class CoupledGradient:
    """What a coupled step gives.

    Attributes:
        gradient: {key: array}.
        variance: of `gradient` per element, as the recurrence has it.
        state: the next.
    """

    gradient: Tree
    variance: Tree
    state: CoupledState


def coupled_gradient(
    session: RenderSession,
    space: Space,
    parameters: Tree,
    request: SampleRequest,
    derivative: Array,
    state: CoupledState,
) -> CoupledGradient:
    """M_n = F_n + w (M_{n−1} − H_n), with F_n = J(θ_n)ᵀ g_n and H_n = J(θ_{n−1})ᵀ g_{n−1} from the same paths.

    The loss lives outside, so its derivatives g_n are given: H_n takes the one that the user gave at the last step. Given these, the
    recursion reduces the noise of the paths of J, and leaves that of g_n to the image that the loss sees. Of `MetaEstimator(coupled=True)`
    this is the recursion, per element, with w from the covariance of F and H. Differences are not divided by the step length
    (Eq. 13), since g_n − g_{n−1} need not vanish with it.

    Bias: that of MetaEstimator with shared statistics: w knows the samples that it weighs, which pulls the gradient toward zero, most
    at the first steps.

    Args:
        session: of both states.
        space: in which they share samples.
        parameters: the current ones.
        request: the samples of the adjoint, independent of those of the image; of one group.
        derivative: g_n, (1, H, W, 3).
        state: the last.
    """
    previous, before, elements = state.parameters, state.derivative, state.elements
    if previous is None or before is None or trees.shapes(previous) != trees.shapes(parameters):
        previous, before, elements = parameters, derivative, {key: meta.init(x) for key, x in parameters.items()}
    rendering = session.image_pair(parameters, previous, replace(request, both_gradients=True), space)
    F, H = session.adjoint_pair(parameters, previous, rendering.paths, derivative, before)
    found = {key: meta.update_coupled(elements[key], F[key], H[key], 1.0, decouple=False) for key in parameters}
    gradient, variance, _, after = ({key: parts[n] for key, parts in found.items()} for n in range(4))
    arrays.evaluate(gradient, variance, after)
    return CoupledGradient(gradient, variance, CoupledState(parameters, derivative, after))


@dataclass(frozen=True)
class Batch:
    """The pixels of the last render, for a loss over a mini-batch; N of all P pixels of all sensors. Arrays of the renderer.

    Attributes:
        sensors: the place of each pixel's sensor in `sensor=`, (N,).
        pixels: row-major index within its film, (N,).
        weights: (N, 1): sums of them times a loss per element (N, 3) are unbiased for its mean over all P · 3 elements.
    """

    sensors: Array
    pixels: Array
    weights: Array


@dataclass(frozen=True)
class StreamState:
    """State between steps.

    Attributes:
        image: the image estimator's.
        pixels: the pixel sampler's.
        batches: mini-batches since whole images were last rendered.
        coupled: that of coupled gradients.
    """

    image: Any
    pixels: Any
    batches: int = 0
    coupled: CoupledState = field(default_factory=CoupledState)


@dataclass(frozen=True)
class _FrameRecord:
    """One launch: its pixels, its paths in so many groups, the key of its draws, the shape of its image."""

    frame: Frame
    paths: Any
    groups: int
    key: Key
    shape: tuple[int, ...]


@dataclass(frozen=True)
class Rendered:
    """What `Stream.backward` needs of one render.

    Attributes:
        parameters: that were rendered.
        frames: what was launched.
        shape: of the image that was handed out.
        batch: its pixels; None for a whole image.
    """

    parameters: Tree
    frames: tuple[_FrameRecord, ...]
    shape: tuple[int, ...]
    batch: Batch | None


class Stream:
    """Renders steps, and takes the derivative of each back to the parameters.

    Args:
        problem: with the sensors as its views.
        options: of the `Renderer`.

    Attributes:
        state: between steps.
        variance: of the last gradient, {key: array}; None but for coupled gradients.

    Raises `InputError` for a parameter that has no path gradient, or that cannot be compared with an earlier value of itself.
    """

    def __init__(self, problem: Problem, options: Options):
        self.problem, self._options = problem, options
        self.variance: Tree | None = None
        start, keys = problem.initial(), list(options.keys)
        problem.renderer.prepare(keys, options.image.space)
        if options.coupled:
            problem.renderer.prepare(keys, self._space())
        self.state = StreamState(options.image.init(problem, start), options.pixels.init(problem, start))

    def render(self, parameters: Tree, key: Key) -> tuple[Rendered, Array]:
        """The image of a step, and what its backward pass needs. Advances the state.

        The image is (H, W, 3) or, of a mini-batch, (N, 3); with several groups (groups, ...), each from the samples of all other groups.
        """
        options, state, problem = self._options, self.state, self.problem
        batch, pixels = MiniBatch(None), state.pixels
        if not options.all_pixels and not options.image.needs_whole_views(parameters, state.image, state.batches):
            batch, pixels = options.pixels.draw(problem, parameters, state.pixels, key.fold(PIXELS))
        frames = whole_views(problem) if batch.sample is None else [PixelBatch(problem, batch.sample)]
        records, images, kept = [], [], []
        for index, frame in enumerate(frames):
            of_frame = key.fold(index)
            found, part = options.image.estimate(
                problem, parameters, state.image, frame, options.spp, options.groups, of_frame.fold(0)
            )
            shown = found.mean() if options.groups == 1 else found.others()
            groups = arrays.shape(found.images)[0]
            records.append(_FrameRecord(frame, found.paths, groups, of_frame, arrays.shape(shown)))
            images.append(shown)
            kept.append(part)
        after, count = state.image, state.batches + 1
        if batch.sample is None:
            after, count = options.image.advance(parameters, state.image, tuple(kept)), 0
            after = after if options.all_pixels else options.image.prepare(problem, after)
        else:
            after = options.image.learn(problem, after, batch.sample, kept[0])
        self.state = replace(state, image=after, pixels=pixels, batches=count)
        image = images[0] if options.all_pixels else self._as_rows(images)
        arrays.evaluate(image, self.state)
        chosen = None if options.all_pixels else self._batch(batch, image)
        return Rendered(parameters, tuple(records), arrays.shape(image), chosen), image

    def backward(self, rendered: Rendered, derivative: Array) -> Tree:
        """The gradient of a loss with this derivative by the image of `rendered`, of its shape. Unbiased for a given one that does not know
        the adjoint's samples."""
        parts = [
            self._frame_gradient(rendered.parameters, record, part)
            for record, part in zip(rendered.frames, self._per_frame(rendered, derivative), strict=True)
        ]
        gradient = reduce(trees.add, parts)
        arrays.evaluate(gradient)
        if not self._options.all_pixels:
            moved = self.problem.coordinates.wrt_u(gradient, rendered.parameters)
            pixels = self._options.pixels.observe(self.problem, self.state.pixels, moved)
            self.state = replace(self.state, pixels=pixels)
        return gradient

    def _frame_gradient(self, parameters: Tree, record: _FrameRecord, derivative: Array) -> Tree:
        options, keys = self._options, list(self._options.keys)
        if options.groups > 1:  # the session takes the mean over groups
            session = self.problem.renderer.prepare(keys, None)
            return session.adjoint(parameters, record.paths, derivative * float(record.groups))
        weights = arrays.add_first_axis(derivative)
        request = record.frame.request(options.adjoint_spp or options.spp, record.key.fold(1).uint32())
        if not options.coupled:
            session = self.problem.renderer.prepare(keys, None)
            return session.adjoint(parameters, session.image(parameters, request).paths, weights)
        space = self._space()
        session = self.problem.renderer.prepare(keys, space)
        found = coupled_gradient(session, space, parameters, request, weights, self.state.coupled)
        self.variance, self.state = found.variance, replace(self.state, coupled=found.state)
        return found.gradient

    def _space(self) -> Space:
        if self._options.image.space is not None:
            return self._options.image.space
        known = self.problem.renderer.parameters()
        return "path" if all(known[key].shares_paths for key in self._options.keys) else "primary"

    def _as_rows(self, images: Sequence[Array]) -> Array:
        """Images (H, W, 3) or (N, 3) of all frames, one behind the other: (N, 3); with several groups (groups, N, 3)."""
        if self._options.groups == 1:
            return arrays.concatenate([arrays.rows(image) for image in images])
        groups = range(arrays.shape(images[0])[0])
        per_group = [arrays.concatenate([arrays.rows(image[group]) for image in images]) for group in groups]
        return arrays.concatenate([arrays.add_first_axis(rows) for rows in per_group])

    def _per_frame(self, rendered: Rendered, derivative: Array) -> list[Array]:
        """The derivative of each frame's image, of its shape."""
        if rendered.batch is None:
            return [derivative]
        found, start = [], 0
        for record in rendered.frames:
            end = start + record.frame.pixels
            part = derivative[start:end] if self._options.groups == 1 else derivative[:, start:end]
            found.append(arrays.reshape(part, record.shape))
            start = end
        return found

    def _batch(self, drawn: MiniBatch, like: Array) -> Batch:
        resolutions = self.problem.renderer.resolutions()
        sizes = [int(np.prod(resolutions[view.sensor])) for view in self.problem.views]
        total = sum(sizes)
        if drawn.sample is not None:
            return Batch(drawn.sample.views, drawn.sample.pixels, drawn.sample.weights / (3.0 * total))
        flat = like if self._options.groups == 1 else like[0]
        sensors = arrays.like_integers(np.repeat(np.arange(len(sizes)), sizes), flat)
        pixels = arrays.like_integers(np.concatenate([np.arange(size) for size in sizes]), flat)
        return Batch(sensors, pixels, arrays.like(np.full((total, 1), 1.0 / (3.0 * total)), flat))
