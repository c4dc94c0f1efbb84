"""Counts the kernels that Dr.Jit makes anew, and gives them inputs that do not ask for another by chance."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from unrender.core import arrays

if TYPE_CHECKING:
    import mitsuba as mi
    import pytest


def on_device(x: Any) -> mi.TensorXf:
    """The numbers in the device's own memory: NumPy's would be shared, and compile other kernels where it is not aligned."""
    import mitsuba as mi

    return mi.TensorXf(arrays.owned(x, mi.Float), np.shape(x))


def count_recordings(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Return a list that gets an entry for each attempt to record a function, until the monkeypatch ends."""
    from unrender.rendering.mitsuba import frozen

    found: list[int] = []
    make = frozen._recorder

    def counting(function: Any, tracing: Any) -> Any:
        def counted(*arguments: Any) -> Any:
            found.append(1)
            return function(*arguments)

        return make(counted, tracing)

    monkeypatch.setattr(frozen, "_recorder", counting)
    return found


@contextmanager
def recorded() -> Iterator[list[bool]]:
    """A list with one entry per kernel launched inside: whether this process saw it for the first time.

    A kernel that an earlier process left on disk counts as new: else a second run of the tests would find nothing.
    """
    found: list[bool] = []
    dr.eval()  # what others have left to be computed is not of what happens inside
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        yield found
        for kernel in dr.kernel_history([dr.KernelType.JIT]):
            found.append(bool(not kernel["cache_hit"] or kernel["cache_disk"]))
