"""Counts the kernels that Dr.Jit makes anew."""

from collections.abc import Iterator
from contextlib import contextmanager

import drjit as dr


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
