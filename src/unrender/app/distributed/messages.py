"""Messages between the driver and the worker of a share of the views: NumPy arrays, numbers and frozen components."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from unrender.core.random import Key
from unrender.pixels.base import DrawStatistics
from unrender.rendering.renderer import Space

References = dict[str, int]
"""{parameter: number of its array}."""


@dataclass(frozen=True)
class Pair:
    """A `PairRequest`, with the numbers of its arrays."""

    previous: References
    space: Space
    step: int
    difference_spp: int | None


@dataclass(frozen=True)
class ImageState:
    """State of an image estimator with memory of its views: parameters of the last step of full views, number of that memory, whether it is
    prepared for pixel mini-batches, and the step of `RecursiveControlVariateState`."""

    parameters: References | None
    memory: int | None
    snapshot: bool
    step: int


@dataclass(frozen=True)
class Batch:
    """The pixels of a mini-batch that belong to a worker's views; all arrays (N,).

    Attributes:
        views: index of each pixel's view among the worker's.
        pixels: row-major index within its film.
        weights: see `PixelSample`; 0 for padding pixels.
        positions: index within the mini-batch, which determines the random numbers.
        count: number of pixels of the full mini-batch.
    """

    views: np.ndarray
    pixels: np.ndarray
    weights: np.ndarray
    positions: np.ndarray
    count: int


@dataclass(frozen=True)
class Call:
    """Request for the gradient of a share of the views: a `GradientRequest` with numbered arrays.

    Attributes:
        arrays: {number: array} that the worker does not have yet.
        drop_arrays, drop_memories: numbers that the worker may drop.
        state: its state; None for one without memory.
        result: number of the memory after this step; None for none.
        replay: whether only this memory is needed.
        pictures: whether images are requested.
        spp, adjoint_spp, key, pair, tolerance, fresh, noise: fields of the request.
        batch: the pixels; None for full views.
        pilot: references of these pixels, (N, 3) each, if their paths are requested instead of a gradient, see `PilotRequest`.
        tangents: tangents for the squared derivatives of the pixels; {} if they are not requested.
    """

    parameters: References
    image: Any
    state: ImageState | None
    spp: int
    key: Key
    adjoint_spp: int | None = None
    pair: Pair | None = None
    batch: Batch | None = None
    pilot: tuple[np.ndarray, ...] | None = None
    tangents: References = field(default_factory=dict)
    tolerance: float = 0.0
    fresh: bool = False
    noise: bool = False
    result: int | None = None
    replay: bool = False
    pictures: bool = False
    arrays: dict[int, np.ndarray] = field(default_factory=dict)
    drop_arrays: tuple[int, ...] = ()
    drop_memories: tuple[int, ...] = ()


@dataclass(frozen=True)
class Reply:
    """Result of a call.

    Attributes:
        gradient, previous, fresh, noise, paired: sums over the share's views in double precision; {} if not requested.
        losses: {view: loss}, by the problem's own index; for a mini-batch with the key -1.
        samples: number of paths traced.
        images: {view: (H, W, 3)} if requested.
        info: {name: {view: array}} if requested.
        paths: results of a pilot for each of the call's pixels.
        draws: statistics of a mini-batch's pixels, in the batch's order; None if not requested.
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
    noise: dict[str, np.ndarray] = field(default_factory=dict)


def payload_bytes(message: Any) -> int:
    if isinstance(message, np.ndarray):
        return message.nbytes
    if isinstance(message, (Call, Reply, Batch, DrawStatistics)):
        message = vars(message)
    parts = message.values() if isinstance(message, dict) else message if isinstance(message, tuple) else ()
    return sum(map(payload_bytes, parts))
