"""What Dr.Jit's kernel history tells."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from benchmarks.internals import dr


def kernels(call: Callable[[int], Any], numbers: Iterable[int]) -> tuple[float, int, float]:
    """Over calls with these numbers: milliseconds inside kernels per call, kernels that were new, and launches per call."""
    inside, new, launched, calls = 0.0, 0, 0, 0
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for number in numbers:
            dr.kernel_history_clear()
            call(number)
            dr.sync_thread()
            history = dr.kernel_history()
            traced = [kernel for kernel in history if kernel["type"] == dr.KernelType.JIT]
            inside += sum(kernel["execution_time"] for kernel in history)
            new += sum(not kernel["cache_hit"] or kernel["cache_disk"] for kernel in traced)
            launched += len(traced)
            calls += 1
    return inside / calls, new, launched / calls
