"""Fresh pictures of a run's parameters, and what they say about the run."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np

from unrender.core import arrays
from unrender.core.arrays import Array
from unrender.core.random import Key
from unrender.core.trees import Tree
from unrender.estimators.penalties import penalty
from unrender.rendering.renderer import SampleRequest
from unrender.scene.batches import PixelBatch, PixelSample
from unrender.scene.problem import Problem
from unrender.scene.render import view_request
from unrender.statistics import paired_losses

__all__ = ["FreshPictures", "Picture", "Remembering", "is_finite", "remembered"]

_GROUPS = 4
"""Independent images of each fresh picture."""
_LEAST_PATHS, _MOST_PATHS = 1 << 13, 1 << 22
"""Paths of a fresh picture."""
_LONGER = 4
"""Ratio of the allowed paths to the least ones below which a picture has the least: another number of pixels is another recording."""
_FEW_PIXELS = 1 << 12
"""Number of pixels of all views up to which whole views are rendered, whatever the number of paths."""
_STREAM = 2
"""Stream of the run's key that fresh pictures draw from; a run's steps use 0, its warm-up 1."""
_MOST_NON_FINITE = 0.01
"""Share of pixels that may be non-finite besides those of the start, before a picture counts as non-finite."""


@runtime_checkable
class Remembering(Protocol):
    """An estimator's state, or a part of it, that holds images of earlier steps."""

    def remembered(self) -> tuple[Tree, Sequence[Array]] | None:
        """Return the parameters that the images are of, and the image (H, W, 3) of each view; None before there are any."""
        ...


def remembered(state: Any) -> Iterator[tuple[Tree, Sequence[Array]]]:
    """Yield what all parts of an estimator's state remember."""
    if isinstance(state, Remembering):
        if (found := state.remembered()) is not None:
            yield found
    elif dataclasses.is_dataclass(state) and not isinstance(state, type):
        for field in dataclasses.fields(state):
            yield from remembered(getattr(state, field.name))
    elif isinstance(state, Mapping):
        for part in state.values():
            yield from remembered(part)
    elif isinstance(state, (list, tuple)):
        for part in state:
            yield from remembered(part)


@dataclass(frozen=True)
class Picture:
    """The fresh picture of one point.

    Attributes:
        images: (K, N, 3) of each frame, independent over K.
        losses: pseudo-values (K, N) of the parts of the loss; see `paired_losses.pseudo_values`. Parts are pixels, or what was drawn of
            all pixels: pairs of these, or views.
    """

    images: tuple[np.ndarray, ...]
    losses: np.ndarray

    @property
    def loss(self) -> tuple[float, float]:
        """The loss without the noise of the picture, and its standard error; infinite for a non-finite picture."""
        value, error = paired_losses.mean_and_error(self.losses)
        return (value, error) if math.isfinite(value) and math.isfinite(error) else (math.inf, math.inf)


@dataclass(frozen=True)
class _Frame:
    """Pixels of one view, or a list of pixels of all views.

    Attributes:
        view: index of the view that is rendered whole; None for a list of pixels.
        views, pixels: index of each pixel's view, and its row-major index in the film, (N,).
        reference: (N, 3).
        factors: (N, 1), factor of each pixel's loss.
    """

    view: int | None
    views: np.ndarray
    pixels: np.ndarray
    reference: np.ndarray
    factors: np.ndarray


class FreshPictures:
    """Renders fresh pictures of any parameters, all with the same random numbers.

    The random numbers come from a stream of the run's key of their own, so they are independent of the run's. Few pixels are rendered
    as whole views. Many are a list of pixels, a random sample of all where the paths do not suffice. Where the loss needs whole views, or
    cameras move, it is a random sample of views.

    The number of samples per pixel of a launch depends on the problem alone, so all pictures share one compiled kernel, and those of a
    short run one recording. More paths come from more pixels, and then from more launches.

    Args:
        problem: whose views.
        seed: the run's.
        paths: about how many to trace for one picture.
        number: which of the run's independent sets of random numbers.
    """

    def __init__(self, problem: Problem, seed: int, paths: float, number: int = 0):
        self._problem, self._key = problem, Key(seed, 0, _STREAM).fold(number)
        allowed = _LEAST_PATHS if paths < _LONGER * _LEAST_PATHS else int(min(paths, _MOST_PATHS))
        self.frames, self.sampled = _frames(problem, allowed // _GROUPS, self._key.fold(0))
        self.pixels = sum(len(frame.pixels) for frame in self.frames)
        self._spp = _GROUPS * _power_of_two(_LEAST_PATHS // (_GROUPS * max(self.pixels, 1)))
        self._launches = _power_of_two(allowed // max(self.pixels * self._spp, 1))

    @property
    def paths(self) -> int:
        """How many one picture traces."""
        return self.pixels * self._spp * self._launches

    def picture(self, parameters: Mapping[str, np.ndarray] | Tree, problem: Problem | None = None) -> Picture:
        """Render the parameters; `problem` where they are those of another mesh."""
        images = self.images(parameters, problem)
        parts = [self._losses(frame, of) for frame, of in zip(self.frames, images, strict=True)]
        losses = np.concatenate(parts, axis=1)
        # Without noise, so each part gets the same share.
        losses += penalty(problem or self._problem, parameters) / losses.shape[1]
        return Picture(tuple(images), losses)

    def images(self, parameters: Mapping[str, np.ndarray] | Tree, problem: Problem | None = None) -> list[np.ndarray]:
        """Return the images (K, N, 3) of each frame."""
        renderer = (problem or self._problem).renderer
        tree = {k: renderer.array(x) if isinstance(x, np.ndarray) else x for k, x in parameters.items()}
        session = renderer.prepare(list(tree), None, derivatives=False)
        found = []
        for index, frame in enumerate(self.frames):
            key, total = self._key.fold(index + 1), np.zeros((_GROUPS, len(frame.pixels), 3))
            for launch in range(self._launches):
                seed = (key.fold(launch) if launch else key).uint32()
                images = session.image(tree, self._request(frame, seed)).images
                total += arrays.numpy(images).reshape(total.shape)
            found.append(total / self._launches)
        return found

    def residual(self, images: Sequence[np.ndarray]) -> float:
        """Return the mean square over pixels and channels by which images (K, N, 3) of each frame differ from the references."""
        means = np.concatenate([one.mean(axis=0) for one in images])
        weights = self.weights[:, None] * np.isfinite(means)
        squares = np.where(np.isfinite(means), means - self.references, 0.0) ** 2
        return float((weights * squares).sum() / max(float(weights.sum()), 1e-300))

    @property
    def weights(self) -> np.ndarray:
        """How much each pixel counts, (N,), of all frames one after the other; at most 1."""
        factors = np.concatenate([frame.factors[:, 0] for frame in self.frames])
        return factors / max(float(factors.max(initial=0.0)), 1e-300)

    @property
    def references(self) -> np.ndarray:
        """The reference of each pixel, (N, 3)."""
        return np.concatenate([frame.reference for frame in self.frames]).astype(np.float64)

    def memory(self, images: Sequence[Array]) -> list[np.ndarray]:
        """Return the pixels (N, 3) of each frame from one image (H, W, 3) of each view."""
        flat: dict[int, np.ndarray] = {}
        for frame in self.frames:
            for view in np.unique(frame.views):
                flat[int(view)] = arrays.numpy(images[view]).astype(np.float64).reshape(-1, 3)
        return [
            np.concatenate([flat[int(v)][frame.pixels[frame.views == v]] for v in np.unique(frame.views)])
            for frame in self.frames
        ]

    def _request(self, frame: _Frame, seed: int) -> SampleRequest:
        if frame.view is not None:
            return replace(view_request(self._problem, frame.view, self._spp, seed), groups=_GROUPS)
        like = self._problem.renderer.array(np.zeros(1))
        views, pixels = (arrays.like_integers(x, like) for x in (frame.views, frame.pixels))
        sample = PixelSample(views, pixels, self._problem.renderer.array(frame.factors))
        return PixelBatch(self._problem, sample).request(self._spp, seed, _GROUPS)

    def _losses(self, frame: _Frame, images: np.ndarray) -> np.ndarray:
        """The pseudo-values (K, N) of pixels, or of the view (K, 1) where the loss needs whole images."""
        candidates = [images.mean(axis=0), *paired_losses.leave_one_out(images)]
        whole, *others = (self._values(frame, image) for image in candidates)
        found = paired_losses.pseudo_values(whole, np.stack(others))
        if not self.sampled:
            return found
        # The parts are what was drawn: pairs of pixels, or views.
        drawn = 1 if frame.view is not None else found.shape[1] // 2
        return found.reshape(len(found), drawn, -1).sum(axis=2)

    def _values(self, frame: _Frame, image: np.ndarray) -> np.ndarray:
        problem, array = self._problem, self._problem.renderer.array
        if frame.view is not None and not problem.loss.pixelwise:
            height, width = problem.sizes[frame.view]
            return np.array([arrays.number(problem.loss_value(frame.view, array(image.reshape(height, width, 3))))])
        values = arrays.numpy(problem.loss.value(array(image), array(frame.reference))).reshape(len(image), -1)
        counted = frame.factors > 0
        return np.where(counted, values * frame.factors, 0.0).sum(axis=1, dtype=np.float64)


def is_finite(first: Picture, other: Picture) -> bool:
    """Return whether `other` is finite wherever `first` is, but for very few pixels."""
    broken, known = 0, 0
    for a, b in zip(first.images, other.images, strict=True):
        at_first, here = (np.isfinite(images.sum(axis=(0, 2))) for images in (a, b))
        broken += int((at_first & ~here).sum())
        known += at_first.size
    return broken <= _MOST_NON_FINITE * known


def _power_of_two(number: int) -> int:
    """Return the greatest that is not above `number`; 1 for less than 1."""
    return 1 << (max(number, 1).bit_length() - 1)


def _frames(problem: Problem, allowed: int, key: Key) -> tuple[list[_Frame], bool]:
    """The pixels that are looked at, at most about `allowed` of them, and whether they are a sample."""
    count, total = len(problem.views), problem.pixels
    if total <= _FEW_PIXELS:
        return [_whole(problem, view) for view in range(count)], False
    generator = np.random.default_rng(key.uint32())
    known = problem.renderer.parameters()
    rigid = any(known[parameter.key].rigid for parameter in problem.parameters)
    if not problem.loss.pixelwise or (rigid and count > 1):
        many = max(1, min(count, allowed * count // total))
        chosen = np.sort(generator.choice(count, many, replace=False))
        return [_whole(problem, int(view)) for view in chosen], many < count
    return [_listed(problem, None if total <= allowed else allowed, generator)], total > allowed


def _whole(problem: Problem, view: int) -> _Frame:
    height, width = problem.sizes[view]
    seen = problem.views[view]
    reference = np.asarray(seen.reference, np.float32).reshape(-1, 3)
    mask = np.ones((height, width)) if seen.mask is None else np.asarray(seen.mask)
    factors = mask.reshape(-1, 1) * (seen.weight / reference.size)
    return _Frame(view, np.full(height * width, view), np.arange(height * width), reference, factors)


def _listed(problem: Problem, count: int | None, generator: np.random.Generator) -> _Frame:
    """Pairs of neighbouring pixels, evenly over all pixels of all views; None for all pixels."""
    sizes = np.array([height * width for height, width in problem.sizes])
    starts = np.cumsum([0, *sizes])
    place = np.arange(starts[-1])
    if count is not None:
        strata = np.linspace(0, starts[-1], max(count // 2, 1) + 1)
        place = (strata[:-1] + generator.random(len(strata) - 1) * np.diff(strata)).astype(np.int64)
        place = np.clip(place, 0, starts[-1] - 1)
    views = np.searchsorted(starts, place, side="right") - 1
    pixels = place - starts[views]
    if count is not None:
        partners = np.where(pixels + 1 < sizes[views], pixels + 1, np.maximum(pixels - 1, 0))
        pixels, views = np.stack([pixels, partners], axis=1).reshape(-1), np.repeat(views, 2)
    like = problem.renderer.array(np.zeros(1))
    reference, factors = problem.references.at(arrays.like_integers(views, like), arrays.like_integers(pixels, like))
    weight = starts[-1] / len(pixels)
    return _Frame(None, views, pixels, arrays.numpy(reference), arrays.numpy(factors).astype(np.float64) * weight)
