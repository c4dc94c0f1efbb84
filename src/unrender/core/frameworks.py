"""Arrays of the three frameworks that a user's own loop or loss may be written in: NumPy, Dr.Jit and PyTorch.

PyTorch is never imported here: an array of its kind can only come from a program that has imported it.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from typing import Any, Literal

import numpy as np

from unrender.core import arrays
from unrender.core.arrays import Array
from unrender.core.errors import InputError

Framework = Literal["numpy", "drjit", "torch"]


def is_torch(x: Any) -> bool:
    """Whether `x` is a PyTorch tensor."""
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(x, torch.Tensor)


def framework(values: Iterable[Any], owner: str) -> Framework:
    """The framework of some arrays: that of their one kind, where numbers, lists and NumPy arrays go with any.

    Raises `InputError` that names `owner` where Dr.Jit's and PyTorch's are mixed.
    """
    kinds: set[Framework] = set()
    for value in values:
        if is_torch(value):
            kinds.add("torch")
        elif arrays.is_drjit(value):
            kinds.add("drjit")
    if len(kinds) > 1:
        raise InputError(f"{owner}: arrays of Dr.Jit and of PyTorch are mixed; give all of one kind")
    return kinds.pop() if kinds else "numpy"


def host(x: Any, owner: str) -> np.ndarray:
    """The numbers of an array of any framework, or of nested lists, in NumPy: float64 where they were, else float32. Waits for the device.

    Raises `InputError` that names `owner` where they are no real numbers.
    """
    if is_torch(x):
        x = x.detach().cpu().numpy()
    elif arrays.is_drjit(x):
        x = x.numpy()
    try:
        found = np.asarray(x)
    except ValueError as error:  # ragged lists
        raise InputError(f"{owner}: expected an array of numbers, got {type(x).__name__}: {error}") from error
    if found.dtype.kind not in "fiu":
        raise InputError(f"{owner}: expected an array of numbers, got {type(x).__name__} of {found.dtype}")
    return found if found.dtype == np.float64 else found.astype(np.float32)


def to_torch(values: np.ndarray, like: Any) -> Any:
    """`values` as a PyTorch tensor of the type and on the device of the tensor `like`, in memory of its own."""
    torch = sys.modules["torch"]
    return torch.from_numpy(np.array(values)).to(like)


def shape(x: Array) -> tuple[int, ...]:
    """The shape of an array of any framework as a tuple of integers."""
    return tuple(int(n) for n in np.shape(x)) if not hasattr(x, "shape") else tuple(int(n) for n in x.shape)
