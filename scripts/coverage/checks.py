"""Check functions: pictures against Mitsuba's own, gradients against finite differences, descents against their start."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

__all__ = ["Agreement", "descended", "gradients_agree", "images_agree"]

_TRUNCATION = 0.01
"""Share of a finite difference that its own truncation may account for."""
_SIGMAS = 5.0
_SQUARE_SIGMAS = 7.0
"""Limit of single squares: rare bright paths have longer tails than a normal distribution."""
_RESOLVED = 0.03
"""A comparison that could not see this relative difference is reported as weak."""


@dataclass(frozen=True)
class Agreement:
    """Result of a comparison.

    Attributes:
        ratio: what was checked over what it should be; None where that is zero.
        error: standard error of the ratio, or of the difference.
        z: largest difference in standard errors.
        verdict: "ok", "wrong", or "weak" where a difference of 3 % would not have been seen.
    """

    ratio: float | None
    error: float
    z: float
    verdict: str

    def record(self) -> dict[str, Any]:
        """Return the attributes by name, rounded."""
        return {
            key: value if isinstance(value, str | None) else float(f"{value:.3g}")
            for key, value in asdict(self).items()
        }


def images_agree(ours: np.ndarray, theirs: np.ndarray) -> Agreement:
    """Compare two sets of independent pictures, each (R, H, W, 3), by their mean and by squares of 2 x 2 pixels."""
    if not (np.isfinite(ours).all() and np.isfinite(theirs).all()):
        return Agreement(None, np.inf, np.inf, "wrong")
    total = _compare(ours.mean((1, 2, 3))[:, None], theirs.mean((1, 2, 3))[:, None])
    found = _compare(*(_squares(images) for images in (ours, theirs)))
    mean = float(theirs.mean())
    error = float(np.sqrt(_variance(ours.mean((1, 2, 3))) + _variance(theirs.mean((1, 2, 3)))))
    z = max(float(np.max(np.abs(total))), float(np.max(np.abs(found))))
    differ = np.max(np.abs(total)) > _SIGMAS or np.max(np.abs(found)) > _SQUARE_SIGMAS
    if mean == 0:
        return Agreement(None, error, z, "ok" if not ours.any() else "wrong")
    verdict = "wrong" if differ else "weak" if _SIGMAS * error > _RESOLVED * abs(mean) else "ok"
    return Agreement(float(ours.mean()) / mean, error / abs(mean), z, verdict)


def gradients_agree(adjoints: np.ndarray, differences: np.ndarray) -> Agreement:
    """Compare derivatives along one direction: of path replay, (R,), and finite differences, (Q,)."""
    if not (np.isfinite(adjoints).all() and np.isfinite(differences).all()):
        return Agreement(None, np.inf, np.inf, "wrong")
    expected = float(differences.mean())
    error = float(np.sqrt(_variance(adjoints) + _variance(differences)))
    difference = float(adjoints.mean()) - expected
    if expected == 0 and not adjoints.any():
        return Agreement(None, 0.0, 0.0, "zero")
    z = max(0.0, abs(difference) - _TRUNCATION * abs(expected)) / max(error, 1e-12)
    ratio = float(adjoints.mean()) / expected if expected else None
    relative = error / abs(expected) if expected else np.inf
    verdict = "wrong" if z > _SIGMAS else "weak" if _SIGMAS * relative > 1 else "ok"
    return Agreement(ratio, relative if np.isfinite(relative) else error, z, verdict)


def descended(before: float, after: float) -> bool:
    """Whether a descent ended at less than half of its first error."""
    return bool(np.isfinite(after)) and after < 0.5 * before


def _variance(values: np.ndarray) -> float:
    """Return the variance of the mean."""
    return float(np.var(values, ddof=1) / len(values))


def _squares(images: np.ndarray) -> np.ndarray:
    """Return means over squares of 2 x 2 pixels, (R, N); pictures of fewer pixels as they are."""
    runs, height, width, channels = images.shape
    if height < 2 or width < 2:
        return images.reshape(runs, -1)
    cut = images[:, : height // 2 * 2, : width // 2 * 2]
    return cut.reshape(runs, height // 2, 2, width // 2, 2, channels).mean((2, 4)).reshape(runs, -1)


def _compare(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """Return z of each column. Columns of little noise of their own get a thousandth of the brightest value besides."""
    variance = ours.var(0, ddof=1) / len(ours) + theirs.var(0, ddof=1) / len(theirs)
    typical = np.mean(variance)  # few runs tell a column's variance badly
    floor = 1e-3 * np.abs(theirs).max(initial=0)
    return (ours.mean(0) - theirs.mean(0)) / np.sqrt(np.maximum(variance, 0.25 * typical) + floor**2 + 1e-20)
