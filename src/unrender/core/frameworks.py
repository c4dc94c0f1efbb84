"""Arrays of NumPy, Dr.Jit and PyTorch, in which a user's loop or loss may be written.

This module never imports PyTorch. An array of PyTorch can only come from a program that has imported it.
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
    """Return whether `x` is a PyTorch tensor."""
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(x, torch.Tensor)


def framework(values: Iterable[Any], owner: str) -> Framework:
    """Return the framework of some arrays: "numpy" if none is of Dr.Jit or PyTorch.

    Numbers, lists and NumPy arrays may be mixed with arrays of one other framework.

    Raises `InputError` that names `owner` if arrays of Dr.Jit and PyTorch are mixed.
    """
    kinds: set[Framework] = set()
    for value in values:
        if is_torch(value):
            kinds.add("torch")
        elif arrays.is_drjit(value):
            kinds.add("drjit")
    if len(kinds) > 1:
        raise InputError(f"{owner}: arrays of Dr.Jit and of PyTorch are mixed; use one framework for all")
    return kinds.pop() if kinds else "numpy"


def host(x: Any, owner: str) -> np.ndarray:
    """Convert an array of any framework, or nested lists, to NumPy. Waits for the device.

    A NumPy array of float64 is returned itself. Other types than float64 become float32.
    Raises `InputError` that names `owner` if the values are not integers or real numbers.
    """
    if is_torch(x):
        x = x.detach().cpu().numpy()
    elif arrays.is_drjit(x):
        x = x.numpy()
    try:
        values = np.asarray(x)
    except ValueError as error:  # ragged lists
        raise InputError(f"{owner}: expected an array of numbers, got {type(x).__name__}: {error}") from error
    if values.dtype.kind not in "fiu":
        raise InputError(f"{owner}: expected an array of numbers, got {type(x).__name__} of {values.dtype}")
    return values if values.dtype == np.float64 else values.astype(np.float32)


def to_torch(values: np.ndarray, like: Any) -> Any:
    """Return `values` as a PyTorch tensor with the type and device of the tensor `like`. The tensor owns its memory."""
    torch = sys.modules["torch"]
    return torch.from_numpy(np.array(values)).to(like)


def shape(x: Array) -> tuple[int, ...]:
    """Return the shape of an array of any framework as a tuple of integers."""
    return tuple(int(n) for n in np.shape(x)) if not hasattr(x, "shape") else tuple(int(n) for n in x.shape)
