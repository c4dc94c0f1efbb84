"""New images of any parameters with their noise: for the verification of runs and the comparison of starts."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from unrender.core import arrays
from unrender.core.arrays import Array
from unrender.core.random import Key
from unrender.core.trees import Tree
from unrender.estimators.penalties import penalty
from unrender.images.base import leave_one_out
from unrender.losses.pixelwise import determined_pixels
from unrender.rendering.renderer import SampleRequest
from unrender.scene.batches import PixelBatch, PixelSample
from unrender.scene.problem import Problem
from unrender.scene.render import power_of_two, view_request
from unrender.statistics import paired_losses
from unrender.statistics.paired_losses import DISTANCE

_GROUPS = 4  # number of independent groups of each new image
_LEAST_PATHS, _MOST_PATHS = 1 << 12, 1 << 22  # limits of the paths of a new image
_LONGER = 2
"""Ratio of the allowed paths to the minimum below which an image has the minimum, because another number of pixels needs another
recording."""
_FEW_PIXELS, _FEW_OF_VIEWS = 1 << 10, 1 << 12
"""Number of pixels of all views up to which full views are rendered, for any number of paths; the same number for losses of full views."""
_TOGETHER, _FEWER = 16, 4
"""Number of states that share a launch in `FreshPictures.images_of`, since one number needs one recording; ratio of the samples of one
image to those of each state, since places differ much."""
_BLOCK = 8  # side in pixels of the squares of `Residuals.largest`
_STREAM = 2  # stream of the run's key for new images; the steps use 0, the warm-up 1
_MOST_NON_FINITE = 0.01
"""Fraction of pixels that may become non-finite, compared to the start, before an image counts as non-finite."""


@dataclass(frozen=True)
class Picture:
    """The new image at one point.

    Attributes:
        images: images of each frame, (K, N, 3), independent over K.
        losses: pseudo-values (K, N) of the parts of the loss with priors and regularizers; see `paired_losses.pseudo_values`. Parts are
            pixels, or the sampling units: pairs of pixels, or views.
    """

    images: tuple[np.ndarray, ...]
    losses: np.ndarray

    @property
    def loss(self) -> tuple[float, float]:
        """The loss without the image's noise, and its standard error; infinite for a non-finite image."""
        value, error = paired_losses.mean_and_error(self.losses)
        return (value, error) if math.isfinite(value) and math.isfinite(error) else (math.inf, math.inf)


@dataclass(frozen=True)
class Residuals:
    """Differences of K independent images of the same parameters from the references.

    Pixels where an image is not finite have the difference and the weight 0.

    Attributes:
        images: differences, (K, N, 3), in an order that mostly keeps neighbours adjacent.
        references: references, (N, 3).
        weights: weight of each pixel, (N,), in [0, 1].
        sizes: (height, width) of the images; [] for a sample of pairs, see `paired_losses.nearby`.
    """

    images: np.ndarray
    references: np.ndarray
    weights: np.ndarray
    sizes: Sequence[tuple[int, int]]

    def __post_init__(self):
        finite = np.isfinite(self.images.sum(axis=(0, 2)))
        object.__setattr__(self, "images", np.where(finite[:, None], self.images, 0.0))
        object.__setattr__(self, "weights", self.weights * finite)

    @classmethod
    def of(cls, problem: Problem, views: Sequence[int], images: Sequence[Sequence[np.ndarray]]) -> Residuals:
        """Return those of K images (H, W, 3) of each of some views. Views of AOVs beside others are in the unit of colours."""
        references = [np.asarray(problem.views[view].reference, np.float32) for view in views]
        weights = np.concatenate([problem.test_weights(*of).ravel() for of in zip(views, images, strict=True)])
        pixels = np.concatenate([image.reshape(-1, 3) for image in references])
        residuals = np.stack(
            [np.concatenate([x.reshape(-1, 3) for x in of]) - pixels for of in zip(*images, strict=True)]
        )
        sizes = [(height, width) for height, width, _ in map(np.shape, references)]
        units = np.repeat(np.array(problem.units, np.float32)[list(views)], [math.prod(of) for of in sizes])[:, None]
        return cls(residuals * units, pixels * units, weights, sizes)

    @property
    def halves(self) -> tuple[np.ndarray, np.ndarray]:
        """Means of every second image, from the first one and from the second one on, (N, 3) each, with independent noise."""
        return self.images[0::2].mean(axis=0), self.images[1::2].mean(axis=0)

    @property
    def mean_square(self) -> float:
        """Mean square of the mean difference over pixels and channels."""
        return paired_losses.mean_square(self.images.mean(axis=0), self.weights)

    @property
    def largest(self) -> float:
        """Root mean square of the mean difference of 8 x 8 pixels where it is largest, without the images' noise; 0 for pairs."""
        most = 0.0
        for part, (height, width) in zip(paired_losses.slices_of_images(self.sizes), self.sizes, strict=True):
            rows, columns = height // _BLOCK, width // _BLOCK
            halves = (np.reshape(x[part] * self.weights[part, None], (height, width, 3)) for x in self.halves)
            inner = (x[: rows * _BLOCK, : columns * _BLOCK].reshape(rows, _BLOCK, columns, _BLOCK, 3) for x in halves)
            one, other = (x.mean(axis=(1, 3)) for x in inner)
            most = max(most, float((one * other).mean(axis=2).max(initial=0.0)))
        return math.sqrt(most)

    @property
    def products(self) -> np.ndarray:
        """Products of both halves, summed over channels and times the weights, (N,). Noise of the images does not change their mean."""
        one, other = self.halves
        return (one * other).sum(axis=1) * self.weights

    @property
    def shared(self) -> float:
        """Mean square difference over pixels and channels without the images' noise, at least 0."""
        return max(float(self.products.sum()) / max(3.0 * float(self.weights.sum()), 1e-300), 0.0)

    @property
    def size(self) -> float:
        """Root mean square of the references."""
        return math.sqrt(paired_losses.mean_square(self.references, self.weights))


@dataclass(frozen=True)
class _Frame:
    """Pixels of one view, all of which are rendered, or a list of pixels of all views (`view` is None), with view and row-major index of
    each, (N,), its reference (N, 3) and the factor of its loss (N, 1)."""

    view: int | None
    views: np.ndarray
    pixels: np.ndarray
    reference: np.ndarray
    factors: np.ndarray


class FreshPictures:
    """Renders new images of any parameters, all with the same random numbers.

    The random numbers come from a separate stream of the run's key, so they are independent of the run's. Few pixels are rendered as full
    views. Many pixels are rendered as a list, which is a random sample if there are too few paths. If the loss needs full views, the sample
    consists of views.

    The samples per pixel of a launch depend on the problem only, so all images share one compiled kernel, and those of a short run share
    one recording. More paths use more pixels, and then more launches.

    Args:
        paths: approximate number of paths of one image.
        number: index of the run's independent set of random numbers.
        parts: power of two; largest number of parts of the launches whose images are kept apart. More images have a sharper test, since
            the standard error is better known.
    """

    def __init__(self, problem: Problem, seed: int, paths: float, number: int = 0, parts: int = 1):
        self._problem, self._key = problem, Key(seed, 0, _STREAM).fold(number)
        allowed = _LEAST_PATHS if paths < _LONGER * _LEAST_PATHS else int(min(paths, _MOST_PATHS))
        self.frames, self.sampled = _frames(problem, allowed // _GROUPS, self._key.fold(0))
        self.pixels = sum(len(frame.pixels) for frame in self.frames)
        self._spp = _GROUPS * power_of_two(_LEAST_PATHS // (_GROUPS * max(self.pixels, 1)))
        self._launches = power_of_two(allowed // max(self.pixels * self._spp, 1))
        self._parts = min(parts, self._launches)
        self.rendered = 0
        """Number of paths of all images so far."""

    @property
    def paths(self) -> int:
        """Number of paths of one image."""
        return self.pixels * self._spp * self._launches

    def picture(self, parameters: Mapping[str, np.ndarray] | Tree, problem: Problem | None = None) -> Picture:
        """Render the parameters; `problem` is needed for parameters of another mesh."""
        images = self.images(parameters, problem)
        losses = self.losses(images)
        # The penalty has no noise, so each part gets an equal share.
        losses += penalty(problem or self._problem, parameters) / losses.shape[1]
        return Picture(tuple(images), losses)

    def images(self, parameters: Mapping[str, np.ndarray] | Tree, problem: Problem | None = None) -> list[np.ndarray]:
        """Return the images (K, N, 3) of each frame, K = 4 times the number of parts."""
        renderer = (problem or self._problem).renderer
        tree = {
            k: renderer.array(np.asarray(x)) if isinstance(x, (np.ndarray, np.generic)) else x
            for k, x in parameters.items()
        }
        session = renderer.prepare(list(tree), None, derivatives=False)
        images_by_frame = []
        self.rendered += self.paths
        for index, frame in enumerate(self.frames):
            key, total = self._key.fold(index + 1), np.zeros((self._parts, _GROUPS, len(frame.pixels), 3))
            for launch in range(self._launches):
                seed = (key.fold(launch) if launch else key).uint32()
                images = session.image(tree, self._request(frame, seed)).images
                total[launch % self._parts] += arrays.numpy(images).reshape(total.shape[1:])
            images_by_frame.append(total.reshape(-1, *total.shape[2:]) * (self._parts / self._launches))
        return images_by_frame

    def images_of(self, states: Sequence[Mapping[str, np.ndarray]], varied: Sequence[str]) -> list[list[np.ndarray]]:
        """Return `images` of each state; these differ in the unknowns `varied` alone. Where all pixels are rendered, states that differ in
        poses of shapes share launches, with a quarter of the samples."""
        known = self._problem.renderer.parameters()
        posed = all(known[key].shape_pose for key in varied)
        if self.sampled or self._parts > 1 or not posed:
            return [self.images(state) for state in states]
        images_by_state: list[list[np.ndarray]] = []
        for start in range(0, len(states), _TOGETHER):
            part = list(states[start : start + _TOGETHER])
            images_by_state += self._rendered_together(part, varied)[: len(part)]
        return images_by_state

    def _rendered_together(
        self, states: list[Mapping[str, np.ndarray]], varied: Sequence[str]
    ) -> list[list[np.ndarray]]:
        """Return the images (4, N, 3) of each frame, of each of `_TOGETHER` states; the last of fewer states is repeated."""
        states = [*states, *[states[-1]] * (_TOGETHER - len(states))]
        stacked = {
            key: np.stack([state[key] for state in states])
            if key in varied
            else np.broadcast_to(x, (_TOGETHER, *np.shape(x)))
            for key, x in states[0].items()
        }
        session = self._problem.renderer.prepare(list(stacked), None, derivatives=False)
        spp, views = max(self._spp * self._launches // (_FEWER * _GROUPS), 1), []
        for view in range(len(self._problem.views)):
            key, sensor = self._key.fold(view + 1), self._problem.views[view].sensor
            requests = [SampleRequest(sensor, spp, key.fold(group).uint32()) for group in range(_GROUPS)]
            groups = [arrays.numpy(session.image_batch(stacked, request)) for request in requests]
            self.rendered += _TOGETHER * _GROUPS * spp * (groups[0][0].size // 3)
            views.append(np.stack(groups, axis=1).astype(np.float64).reshape(_TOGETHER, _GROUPS, -1, 3))
        frames = views if self.frames[0].view is not None else [np.concatenate(views, axis=2)]
        return [list(of_state) for of_state in zip(*frames, strict=True)]

    def losses(self, images: Sequence[np.ndarray]) -> np.ndarray:
        """Return the pseudo-values (K, N) of the loss without priors and regularizers, from images (K, N, 3) of each frame."""
        with np.errstate(invalid="ignore", over="ignore"):
            parts = [self._losses(frame, of) for frame, of in zip(self.frames, images, strict=True)]
        return np.concatenate(parts, axis=1)

    def compare(self, images: Sequence[np.ndarray]) -> Residuals:
        """Return the differences of images (K, N, 3) of each frame from the references."""
        differences = np.concatenate(images, axis=1) - self.references
        return Residuals(differences, self.references, self.weights_of(images), self.sizes)

    @property
    def sizes(self) -> list[tuple[int, int]]:
        """(height, width) of the views that are rendered, row by row; [] for a sample of pairs, see `paired_losses.nearby`."""
        sizes = self._problem.sizes
        if self.frames[0].view is None:
            return [] if self.sampled else list(sizes)
        return [sizes[frame.view] for frame in self.frames if frame.view is not None]

    @property
    def weights(self) -> np.ndarray:
        """Weight of each pixel, (N,), of all frames concatenated; at most 1, and 0 for lower bounds of `Censored`."""
        return self.weights_of(())

    def weights_of(self, images: Sequence[np.ndarray]) -> np.ndarray:
        """Return `weights`, and those of the lower bounds that images (K, N, 3) of each frame do not reach."""
        factors = np.concatenate([frame.factors[:, 0] for frame in self.frames])
        joined = np.concatenate(images, axis=1) if len(images) else None
        factors = factors * determined_pixels(self._problem.loss, self.references, joined)
        return factors / max(float(factors.max(initial=0.0)), 1e-300)

    @property
    def references(self) -> np.ndarray:
        """Reference of each pixel, (N, 3)."""
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
        """Return the pseudo-values (K, N) of pixels, or (K, 1) of the view if the loss needs full images."""
        total, *others = self._values(frame, np.stack([images.mean(axis=0), *leave_one_out(images)]))
        pseudo = paired_losses.pseudo_values(total, np.stack(others))
        if not self.sampled:
            return pseudo
        # The parts are the sampling units: pairs of pixels, or views.
        divisor = 1 if frame.view is not None else pseudo.shape[1] // 2
        return pseudo.reshape(len(pseudo), divisor, -1).sum(axis=2)

    def _values(self, frame: _Frame, images: np.ndarray) -> np.ndarray:
        """Return the loss of each pixel, (M, N), or of the view, (M, 1), for images (M, N, 3)."""
        problem, array = self._problem, self._problem.renderer.array
        if frame.view is not None and not problem.loss.pixelwise:
            of_view = [array(image.reshape(*problem.sizes[frame.view], 3)) for image in images]
            return np.array([[arrays.number(problem.loss_value(frame.view, image))] for image in of_view])
        references = np.tile(frame.reference, (len(images), 1))
        values = arrays.numpy(problem.loss.value(array(images.reshape(-1, 3)), array(references))).reshape(images.shape)
        return np.where(frame.factors > 0, values * frame.factors, 0.0).sum(axis=2, dtype=np.float64)


def is_finite(first: Picture, other: Picture) -> bool:
    """Return whether `other` is finite wherever `first` is, except at very few pixels."""
    broken, known = 0, 0
    for a, b in zip(first.images, other.images, strict=True):
        at_first, here = (np.isfinite(images.sum(axis=(0, 2))) for images in (a, b))
        broken += int((at_first & ~here).sum())
        known += at_first.size
    return broken <= _MOST_NON_FINITE * known


def _frames(problem: Problem, allowed: int, key: Key) -> tuple[list[_Frame], bool]:
    """Return the tested pixels, at most about `allowed`, and whether they are a sample."""
    count, total = len(problem.views), problem.pixels
    if total <= (_FEW_PIXELS if problem.loss.pixelwise else _FEW_OF_VIEWS):
        return [_full_view(problem, view) for view in range(count)], False
    generator = np.random.default_rng(key.uint32())
    if not problem.loss.pixelwise:
        many = max(1, min(count, allowed * count // total))
        chosen = np.sort(generator.choice(count, many, replace=False))
        return [_full_view(problem, int(view)) for view in chosen], many < count
    return [_pixel_list(problem, None if total <= allowed else allowed, generator)], total > allowed


def _full_view(problem: Problem, view: int) -> _Frame:
    height, width = problem.sizes[view]
    own = problem.views[view]
    reference = np.asarray(own.reference, np.float32).reshape(-1, 3)
    factors = own.pixel_weights((height, width)).reshape(-1, 1) * (own.weight / reference.size)
    return _Frame(view, np.full(height * width, view), np.arange(height * width), reference, factors)


def _pixel_list(problem: Problem, count: int | None, generator: np.random.Generator) -> _Frame:
    """Return pairs of nearby pixels, along a row and along a column in turn, stratified over all views; all pixels if `count` is None."""
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
        partners = _partners(pixels, np.array(problem.sizes)[views])
        pixels, views = np.stack([pixels, partners], axis=1).reshape(-1), np.repeat(views, 2)
    like = problem.renderer.array(np.zeros(1))
    reference, factors = problem.references.at(arrays.like_integers(views, like), arrays.like_integers(pixels, like))
    weight = starts[-1] / len(pixels)
    return _Frame(None, views, pixels, arrays.numpy(reference), arrays.numpy(factors).astype(np.float64) * weight)


def _partners(pixels: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Return the second pixel of each pair, along rows and columns in turn of films of the given (height, width), (N, 2).

    Rows and columns are closed to circles, so that all pixels are equally probable.
    """
    heights, widths = sizes.T
    along_row = np.where(np.minimum(heights, widths) > DISTANCE, np.arange(len(pixels)) % 2 < 1, widths >= heights)
    side, place = np.where(along_row, widths, heights), np.where(along_row, pixels % widths, pixels // widths)
    moved = (place + np.minimum(DISTANCE, side - 1)) % side
    return pixels + (moved - place) * np.where(along_row, 1, widths)
