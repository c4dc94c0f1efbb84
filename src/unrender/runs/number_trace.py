"""Values of the numbers of a run at each step."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from unrender.core.errors import InputError

_MOST_ROWS = 2048
"""Rows of a trace, from which pairs of rows are replaced by their means."""


@dataclass
class NumberTrace:
    """Values of the numbers of a run during its steps, in a bounded number of rows.

    Attributes:
        rows: means of `size` steps each, (n,).
        size: number of steps of a row, a power of two.
        total, count: sum of the values of the steps since the last row, and their number.
    """

    rows: list[np.ndarray] = field(default_factory=list)
    size: int = 1
    total: np.ndarray = field(default_factory=lambda: np.zeros(0))
    count: int = 0

    def append(self, values: np.ndarray) -> None:
        """Append the values (n,) of a step."""
        self.total = self.total + values if self.count else values
        self.count += 1
        if self.count < self.size:
            return
        self.rows.append(self.total / self.count)
        self.count = 0
        if len(self.rows) == _MOST_ROWS:
            self.rows = [0.5 * (a + b) for a, b in zip(self.rows[::2], self.rows[1::2], strict=True)]
            self.size *= 2

    def snapshot(self) -> dict[str, Any] | None:
        """Return its contents for a checkpoint; None before the first step."""
        if not (self.rows or self.count):
            return None
        return {"rows": np.array(self.rows), "size": self.size, "total": self.total, "count": self.count}

    @classmethod
    def restored(cls, saved: dict[str, Any] | None) -> NumberTrace:
        """Return the trace of a snapshot."""
        return cls() if saved is None else cls(list(saved["rows"]), saved["size"], saved["total"], saved["count"])

    @staticmethod
    def check(saved: Any, where: str) -> None:
        """Raise `InputError` unless it is a snapshot of a trace."""
        match saved:
            case {"rows": np.ndarray() as rows, "size": int(size), "total": np.ndarray() as total, "count": int(count)}:
                shaped = total.ndim == 1 and (rows.shape == (0,) or rows.shape[1:] == total.shape)
                kinds = rows.dtype == total.dtype == np.float64
                if kinds and shaped and len(rows) < _MOST_ROWS and 0 <= count < size and np.isfinite(rows).all():
                    return
        raise InputError(f"{where}: expected the values of numbers, got {repr(saved)[:60]}")
