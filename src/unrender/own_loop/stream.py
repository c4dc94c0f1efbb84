"""Rendering of one sensor, or of pixel mini-batches of several, from step to step, and the file of its state."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.numpy

from unrender.core import arrays, trees
from unrender.core.arrays import Array
from unrender.core.errors import InputError, prefixed
from unrender.core.random import Key
from unrender.core.trees import Tree
from unrender.estimators.sample_groups import PIXELS
from unrender.images.base import needs_full_views
from unrender.io import bounded_files, files
from unrender.own_loop.options import Options
from unrender.pixels.base import MiniBatch
from unrender.rendering.renderer import RenderSession, SampleRequest, Space
from unrender.runs.folder.state import Packed, pack, unpack
from unrender.scene.batches import Frame, PixelBatch, full_views
from unrender.scene.problem import Problem
from unrender.statistics import meta


@dataclass(frozen=True)
class CoupledState:
    """State of coupled gradients between steps: parameters and loss derivative (1, H, W, 3) of the last step with a gradient, and {key:
    meta-estimate and statistics of each element of the gradient}."""

    parameters: Tree | None = None
    derivative: Array | None = None
    elements: dict[str, meta.State] = field(default_factory=dict)


def coupled_gradient(
    session: RenderSession,
    space: Space,
    parameters: Tree,
    request: SampleRequest,
    derivative: Array,
    state: CoupledState,
) -> tuple[Tree, Tree, CoupledState]:
    """Return the gradient M_n, its variance per element by the recurrence, and the next state.

    M_n = F_n + w (M_{n−1} − H_n), with F_n = J(θ_n)ᵀ g_n and H_n = J(θ_{n−1})ᵀ g_{n−1} from the same paths. The loss is external, so its
    derivatives g_n are inputs, and H_n uses the one of the last step. For fixed derivatives, the recursion reduces the noise of the paths
    of J; the noise of g_n depends on the image estimator. It is the recursion of `MetaEstimator(coupled=True)`, per element, with w from
    the covariance of F and H. Differences are not divided by the step length (Eq. 13), because g_n − g_{n−1} need not vanish with it.

    Bias: the weight w depends on the samples that it weights. This shrinks the gradient toward zero, most in the first steps.

    Args:
        parameters: θ_n.
        request: samples of the adjoint, in one group, independent of those of the image.
        derivative: g_n, (1, H, W, 3).
        state: state after the previous step. With other shapes than those of θ_n, the recursion starts again.
    """
    previous, earlier, elements = state.parameters, state.derivative, state.elements
    if previous is None or earlier is None or trees.shapes(previous) != trees.shapes(parameters):
        previous, earlier, elements = parameters, derivative, {key: meta.init(x) for key, x in parameters.items()}
    rendering = session.image_pair(parameters, previous, replace(request, both_gradients=True), space)
    F, H = session.adjoint_pair(parameters, previous, rendering.paths, derivative, earlier)
    estimates = {key: meta.update_coupled(elements[key], F[key], H[key], 1.0, decouple=False) for key in parameters}
    gradient, variance, _, next_elements = ({key: parts[n] for key, parts in estimates.items()} for n in range(4))
    arrays.evaluate(gradient, variance, next_elements)
    return gradient, variance, CoupledState(parameters, derivative, next_elements)


@dataclass(frozen=True)
class Batch:
    """Pixels of a mini-batch: N of the P pixels of all sensors. Arrays of the renderer, or of the loop in `Renderer.batch`.

    Attributes:
        sensors: index into `sensor=` for each pixel, (N,).
        pixels: row-major index in its film, (N,).
        weights: (N, 1). Their sum times an elementwise loss (N, 3) is an unbiased estimate of its mean over all P · 3 elements.
    """

    sensors: Array
    pixels: Array
    weights: Array


@dataclass(frozen=True)
class StreamState:
    """State of a `Stream` between steps: of the image estimator, of the pixel sampler and of coupled gradients, and the number of
    mini-batches since full images were last rendered."""

    image: Any
    pixels: Any
    batches: int = 0
    coupled: CoupledState = field(default_factory=CoupledState)


@dataclass(frozen=True)
class _FrameRecord:
    """One launch: its pixels, its paths, their number of groups, the key of its random numbers, and the shape of its image."""

    frame: Frame
    paths: Any
    groups: int
    key: Key
    shape: tuple[int, ...]


@dataclass(frozen=True)
class Rendered:
    """Record of one render for `Stream.backward`: its launches, and its pixels, None for a full image."""

    parameters: Tree
    frames: tuple[_FrameRecord, ...]
    shape: tuple[int, ...]
    batch: Batch | None


class Stream:
    """Renders steps, and backpropagates the derivative of each.

    Args:
        problem: problem with the sensors as its views.

    Attributes:
        state: state between steps.
        variance: variance of the last gradient, {key: array}; None except for coupled gradients.

    Raises `InputError` for a parameter without a path gradient, or one that does not support comparison with its earlier value.
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
        """Return the image of a step and the record for its backward pass, and advance the state.

        The image is (H, W, 3) or, for a mini-batch, (N, 3). With several groups it is (groups, ...), each from the samples of all other
        groups.
        """
        options, state, problem = self._options, self.state, self.problem
        batch, pixels = MiniBatch(None), state.pixels
        if not options.all_pixels and not needs_full_views(options.image, parameters, state.image, state.batches):
            batch, pixels = options.pixels.draw(problem, parameters, state.pixels, key.fold(PIXELS))
        frames = full_views(problem) if batch.sample is None else [PixelBatch(problem, batch.sample)]
        records, images, contributions = [], [], []
        for index, frame in enumerate(frames):
            frame_key = key.fold(index)
            estimate, part = options.image.estimate(
                problem, parameters, state.image, frame, options.spp, options.groups, frame_key.fold(0)
            )
            shown = estimate.mean() if options.groups == 1 else estimate.others()
            groups = arrays.shape(estimate.images)[0]
            records.append(_FrameRecord(frame, estimate.paths, groups, frame_key, arrays.shape(shown)))
            images.append(shown)
            contributions.append(part)
        after, count = state.image, state.batches + 1
        if batch.sample is None:
            after, count = options.image.advance(parameters, state.image, tuple(contributions)), 0
            after = after if options.all_pixels else options.image.prepare(problem, after)
        else:
            after = options.image.learn(problem, after, batch.sample, contributions[0])
        self.state = replace(state, image=after, pixels=pixels, batches=count)
        image = images[0] if options.all_pixels else self._as_rows(images)
        arrays.evaluate(image, self.state)
        chosen = None if options.all_pixels else self._batch(batch, image)
        return Rendered(parameters, tuple(records), arrays.shape(image), chosen), image

    def backward(self, rendered: Rendered, derivative: Array) -> Tree:
        """Return the gradient of a loss from its derivative with respect to the image of `rendered`, of the same shape.

        Unbiased for a derivative that is independent of the adjoint's samples.
        """
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
        gradient, self.variance, coupled = coupled_gradient(
            session, space, parameters, request, weights, self.state.coupled
        )
        self.state = replace(self.state, coupled=coupled)
        return gradient

    def _space(self) -> Space:
        if self._options.image.space is not None:
            return self._options.image.space
        known = self.problem.renderer.parameters()
        return "path" if all(known[key].shares_paths for key in self._options.keys) else "primary"

    def _as_rows(self, images: Sequence[Array]) -> Array:
        """Concatenate the images (H, W, 3) or (N, 3) of all frames: (N, 3); with several groups (groups, N, 3)."""
        if self._options.groups == 1:
            return arrays.concatenate([arrays.rows(image) for image in images])
        groups = range(arrays.shape(images[0])[0])
        per_group = [arrays.concatenate([arrays.rows(image[group]) for image in images]) for group in groups]
        return arrays.concatenate([arrays.add_first_axis(rows) for rows in per_group])

    def _per_frame(self, rendered: Rendered, derivative: Array) -> list[Array]:
        """Return the derivative of each frame's image, with the image's shape."""
        if rendered.batch is None:
            return [derivative]
        parts, start = [], 0
        for record in rendered.frames:
            end = start + record.frame.pixels
            part = derivative[start:end] if self._options.groups == 1 else derivative[:, start:end]
            parts.append(arrays.reshape(part, record.shape))
            start = end
        return parts

    def _batch(self, mini_batch: MiniBatch, like: Array) -> Batch:
        resolutions = self.problem.renderer.resolutions()
        sizes = [int(np.prod(resolutions[view.sensor])) for view in self.problem.views]
        total = sum(sizes)
        if mini_batch.sample is not None:
            return Batch(mini_batch.sample.views, mini_batch.sample.pixels, mini_batch.sample.weights / (3.0 * total))
        flat = like if self._options.groups == 1 else like[0]
        sensors = arrays.like_integers(np.repeat(np.arange(len(sizes)), sizes), flat)
        pixels = arrays.like_integers(np.concatenate([np.arange(size) for size in sizes]), flat)
        return Batch(sensors, pixels, arrays.like(np.full((total, 1), 1.0 / (3.0 * total)), flat))


_FORMAT = "unrender.Renderer 1"
_LARGEST = 1 << 36
_HEADER = "__metadata__"


@dataclass(frozen=True)
class RendererState:
    """State of a `Renderer` between steps: number of renders so far, and {sensor as text, or "mini-batches": state}."""

    step: int
    seed: int
    streams: dict[str, StreamState]


def write_state(path: Path, state: RendererState, options: dict[str, Any]) -> Path:
    """Write a state and its options, and return the path. Raises `InputError` if they cannot be written."""
    packed = pack(state)
    notes = {"format": _FORMAT, "options": json.dumps(options), "state": json.dumps(packed.skeleton, allow_nan=False)}
    return files.write(path, safetensors.numpy.save(packed.tensors, metadata=notes), durable=True)


def read_state(path: Path, options: dict[str, Any], pattern: RendererState) -> RendererState:
    """Return the state in a file of `write_state`, with the same components as `pattern`. Raises `InputError` if it is damaged, or has
    other options."""
    size = path.stat().st_size if path.is_file() else 0
    data = bounded_files.read_bytes(path, min(size, _LARGEST), path.parent)
    length = int.from_bytes(data[:8], "little")
    header = bounded_files.parse_json(data[8 : 8 + min(length, len(data))], f"{path}: header")
    notes = header.get(_HEADER) if isinstance(header, dict) else None
    if not isinstance(notes, dict) or notes.get("format") != _FORMAT:
        raise InputError(f"{path}: not the state of a Renderer, as Renderer.save writes it")
    _check_options(path, bounded_files.parse_json(str(notes.get("options")).encode(), f"{path}: options"), options)
    skeleton = bounded_files.parse_json(str(notes.get("state")).encode(), f"{path}: state")
    try:
        tensors = {name: array.copy() for name, array in safetensors.numpy.load(data).items()}
    except (safetensors.SafetensorError, KeyError) as error:
        raise InputError(f"{path}: tensors cannot be read: {str(error)[:200]}") from error
    with prefixed(path):
        state = unpack(Packed(skeleton, tensors), [pattern])
    if not _fits(state, pattern):
        raise InputError(f"{path}: not the state of a Renderer with these options")
    return state


def _check_options(path: Path, saved: Any, options: dict[str, Any]) -> None:
    if not isinstance(saved, dict):
        raise InputError(f"{path}: options: expected an object, got {saved!r:.60}")
    for name, value in options.items():
        if saved.get(name) != value:
            raise InputError(
                f"{path}: it is of a Renderer with {name}={saved.get(name)!r:.120}, this one has {value!r:.120}"
            )


def _fits(state: Any, pattern: RendererState) -> bool:
    if not isinstance(state, RendererState) or not isinstance(state.streams, dict):
        return False
    known = next(iter(pattern.streams.values()))
    numbers = (state.step, state.seed)
    if any(isinstance(n, bool) or not isinstance(n, int) or n < 0 for n in numbers):
        return False
    names = state.streams.keys()
    if any(name not in pattern.streams and not (isinstance(name, str) and name.isdecimal()) for name in names):
        return False
    return all(
        isinstance(stream, StreamState)
        and type(stream.image) is type(known.image)
        and type(stream.pixels) is type(known.pixels)
        and type(stream.coupled) is type(known.coupled)
        for stream in state.streams.values()
    )
