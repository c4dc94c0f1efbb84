"""What a worker process does before its first kernel."""

from __future__ import annotations

from unrender.backend import variant

__all__ = ["prepare_worker"]

_prepared: list[tuple[str, int]] = []


def prepare_worker(name: str, threads: int) -> str:
    """Choose the variant and the number of threads, once a process: later calls with the same arguments do nothing.

    Args:
        name: of the variant, or "auto".
        threads: of the processor, >= 1.

    Returns:
        The variant in use.

    Raises:
        VariantError: this machine cannot run it.
    """
    chosen = variant.use(name)
    if (name, threads) not in _prepared:
        variant.use_threads(threads)
        _prepared[:] = [(name, threads)]
    return chosen
