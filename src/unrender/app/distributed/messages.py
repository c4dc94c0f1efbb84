"""What the driver sends to the worker that has a share of the views, and what comes back: NumPy arrays, numbers and frozen components."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from unrender.core.random import Key
from unrender.pixels.base import DrawStatistics
from unrender.rendering.renderer import Space

References = dict[str, int]
"""{parameter: number of the array that it is}."""


@dataclass(frozen=True)
class Difference:
    """An array as its difference from one that the worker has.

    Attributes:
        base: the number of that array.
        values: the difference, float16.
    """

    base: int
    values: np.ndarray

    def applied(self, base: np.ndarray) -> np.ndarray:
        """The array."""
        return (base + self.values.astype(base.dtype)).astype(base.dtype)


@dataclass(frozen=True)
class Pair:
    """A `PairRequest`."""

    previous: References
    space: Space
    step: int
    difference_spp: int | None


@dataclass(frozen=True)
class ImageState:
    """The state of an image estimator that remembers its views.

    Attributes:
        parameters: of the last step that rendered whole views; None before the first.
        memory: the number of what is remembered of the views; None before the first step.
        snapshot: whether it is prepared for pixel mini-batches.
        step: as of `RecursiveControlVariateState`.
    """

    parameters: References | None
    memory: int | None
    snapshot: bool
    step: int


@dataclass(frozen=True)
class Batch:
    """The part of a pixel mini-batch that is of a worker's views; all (N,).

    Attributes:
        views: index of each pixel's view among the worker's.
        pixels: row-major index within its film.
        weights: see `PixelSample`; 0 for pixels that fill up.
        positions: index within the mini-batch, by which random numbers are drawn.
        count: pixels of the whole mini-batch.
    """

    views: np.ndarray
    pixels: np.ndarray
    weights: np.ndarray
    positions: np.ndarray
    count: int


@dataclass(frozen=True)
class Pilot:
    """A `PilotRequest` beside what a `Call` has.

    Attributes:
        references: (N, 3) each, of the call's pixels.
    """

    references: tuple[np.ndarray, ...]


@dataclass(frozen=True)
class Call:
    """One gradient of a share of the views: a `GradientRequest` in numbers.

    Attributes:
        arrays: {number: array} that the worker does not have yet.
        drop_arrays, drop_memories: numbers of what it need not keep.
        parameters: the current ones.
        image: the image estimator.
        state: its state; None for one that remembers nothing.
        result: the number of what will be remembered after this step; None for nothing.
        replay: whether only that is wanted.
        pictures: whether the images are wanted, too.
        single: whether gradients are to be in single precision; else they are in double.
        spp, adjoint_spp, key, pair, tolerance, fresh: of the request.
        batch: the pixels; None for whole views.
        pilot: whether no gradient is wanted, but what paths through these pixels find.
        tangents: along which the squared derivatives of the pixels are wanted; {} where they are not.
    """

    parameters: References
    image: Any
    state: ImageState | None
    spp: int
    key: Key
    adjoint_spp: int | None = None
    pair: Pair | None = None
    batch: Batch | None = None
    pilot: Pilot | None = None
    tangents: References = field(default_factory=dict)
    tolerance: float = 0.0
    fresh: bool = False
    result: int | None = None
    replay: bool = False
    pictures: bool = False
    single: bool = False
    arrays: dict[int, np.ndarray | Difference] = field(default_factory=dict)
    drop_arrays: tuple[int, ...] = ()
    drop_memories: tuple[int, ...] = ()


@dataclass(frozen=True)
class Reply:
    """What came of a call.

    Attributes:
        gradient, previous, fresh, paired: summed over the share's views in double precision; {} where not wanted.
        losses: {view: loss}, by the problem's own index; of a mini-batch under -1.
        samples: paths traced.
        images: {view: (H, W, 3)} where they were wanted.
        info: {name: {view: array}} likewise.
        seconds: that it took.
        paths: what a pilot found of each of the call's pixels.
        draws: what the samples of a mini-batch's pixels tell, in the batch's order; None where it was not wanted.
    """

    gradient: dict[str, np.ndarray]
    previous: dict[str, np.ndarray]
    fresh: dict[str, np.ndarray]
    losses: dict[int, float]
    samples: int
    images: dict[int, np.ndarray]
    info: dict[str, dict[int, np.ndarray]]
    seconds: float
    paths: tuple[np.ndarray, ...] = ()
    draws: DrawStatistics | None = None
    paired: dict[str, np.ndarray] = field(default_factory=dict)


def payload_bytes(message: Any) -> int:
    """Bytes of the arrays in a message."""
    if isinstance(message, np.ndarray):
        return message.nbytes
    if isinstance(message, (Difference, Batch, DrawStatistics, Pilot)):
        return sum(payload_bytes(value) for value in vars(message).values())
    if isinstance(message, (Call, Reply)):
        return sum(payload_bytes(value) for value in vars(message).values())
    if isinstance(message, dict):
        return sum(payload_bytes(value) for value in message.values())
    if isinstance(message, tuple):
        return sum(payload_bytes(value) for value in message)
    return 0
