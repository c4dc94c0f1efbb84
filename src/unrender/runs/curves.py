"""The curves of a result's history, as arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

__all__ = ["loss", "parameter_errors"]

_POINTS = 200

Curve = tuple[np.ndarray, np.ndarray]
"""Seconds, ascending, and values."""


def loss(history: Sequence[Mapping[str, Any]]) -> Curve:
    """The loss of the steps' own samples: means over up to 200 groups of consecutive steps; NaN where none was finite."""
    seconds = np.array([record["seconds"] for record in history], float)
    values = np.array([record["loss"] for record in history], float)
    values[~np.isfinite(values)] = np.nan
    groups = np.array_split(np.arange(len(history)), min(len(history), _POINTS)) if len(history) else []
    means = [np.mean(kept) if (kept := values[g][np.isfinite(values[g])]).size else np.nan for g in groups]
    return np.array([seconds[g[-1]] for g in groups]), np.array(means, float)


def parameter_errors(history: Sequence[Mapping[str, Any]], initial: Mapping[str, float]) -> dict[str, Curve]:
    """{key: error} where it was measured, from the start's `initial` on."""
    found: dict[str, Curve] = {}
    for key, first in initial.items():
        known = [
            (record["seconds"], record["parameter_error"][key])
            for record in history
            if key in record.get("parameter_error", {})
        ]
        if known:
            seconds, values = np.array([(0.0, first), *known], float).T
            found[key] = seconds, values
    return found
