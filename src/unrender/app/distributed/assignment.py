"""Which worker has which views, and how what they found is summed. Nothing here needs Ray."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

__all__ = ["assign", "total"]


def assign(pixels: Sequence[int], workers: int) -> tuple[tuple[int, ...], ...]:
    """The views of each worker, ascending: the largest view that is left goes to who has the fewest pixels so far, the first of these.

    Args:
        pixels: of each view, at least one view.
        workers: how many, >= 1; no more than there are views get any.
    """
    shares: list[list[int]] = [[] for _ in range(min(workers, len(pixels)))]
    loads = [0] * len(shares)
    for view in sorted(range(len(pixels)), key=lambda index: -pixels[index]):
        least = loads.index(min(loads))
        shares[least].append(view)
        loads[least] += pixels[view]
    return tuple(tuple(sorted(share)) for share in shares)


def total(parts: Iterable[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """The sum of trees in the order in which they come, in double precision. {} for none, or empty ones.

    Args:
        parts: trees of equal keys, shapes and types.
    """
    sums: dict[str, np.ndarray] = {}
    for part in parts:
        for key, value in part.items():
            if key not in sums:
                sums[key] = np.zeros(value.shape, np.float64)
            sums[key] += value
    return sums
