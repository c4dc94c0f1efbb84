"""LPIPS (Zhang et al. 2018), where its package and the weights of its network are on this machine; nothing is fetched."""

from __future__ import annotations

import functools
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

__all__ = ["MISSING", "available", "distance"]

MISSING = "LPIPS is left out: it needs pip install lpips, and AlexNet's weights in PyTorch's folder hub/checkpoints"
_LEAST = 32
"""Pixels a side that the network needs."""


def available() -> bool:
    """Whether the package is installed and AlexNet's weights lie where torchvision keeps them."""
    if any(find_spec(name) is None for name in ("torch", "torchvision", "lpips")):
        return False
    import torch  # pyright: ignore[reportMissingImports]

    return any((Path(torch.hub.get_dir()) / "checkpoints").glob("alexnet-*.pth"))


def distance(image: np.ndarray, reference: np.ndarray) -> float | None:
    """Of two pictures (H, W, 3) as displayed, in [0, 1], by AlexNet. Smaller is better. None where it cannot be computed."""
    if min(image.shape[:2]) < _LEAST or not available():
        return None
    import torch  # pyright: ignore[reportMissingImports]

    one, two = (
        torch.from_numpy(np.ascontiguousarray(2 * x.transpose(2, 0, 1)[None] - 1, np.float32))
        for x in (image, reference)
    )
    with torch.no_grad():
        return float(_network()(one, two))


@functools.cache
def _network() -> Any:
    import lpips  # pyright: ignore[reportMissingImports]

    return lpips.LPIPS(net="alex", verbose=False)  # pyright: ignore[reportAttributeAccessIssue]
