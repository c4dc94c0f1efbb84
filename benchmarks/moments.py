"""Mean and variance over independent runs, and the bias of a mean."""

from __future__ import annotations

from typing import Any

import numpy as np


class Moments:
    """Mean and variance over independent runs, per element of an array, and the spread of its overall mean."""

    def __init__(self) -> None:
        self.count = 0
        self.mean: np.ndarray = np.zeros(())
        self._squares: np.ndarray = np.zeros(())
        self._levels: list[float] = []

    def add(self, values: Any) -> None:
        """One more run."""
        x = np.asarray(values, np.float64)
        self.count += 1
        before = x - self.mean
        self.mean = self.mean + before / self.count
        self._squares = self._squares + before * (x - self.mean)
        self._levels.append(float(x.mean()))

    @property
    def variance(self) -> np.ndarray:
        """Of one run; unbiased."""
        return self._squares / (self.count - 1)

    @property
    def error(self) -> np.ndarray:
        """Standard error of `mean`, per element."""
        return np.sqrt(self.variance / self.count)

    @property
    def level(self) -> float:
        """The mean over all elements."""
        return float(np.mean(self._levels))

    @property
    def level_error(self) -> float:
        """Its standard error."""
        return float(np.std(self._levels, ddof=1) / np.sqrt(self.count))


def bias(found: Moments, reference: Moments) -> dict[str, float]:
    """How far the mean of runs is from a converged image, freed of the noise that both have.

    Returns:
        signed, signed_error: mean over pixels of the difference, with standard error, over the mean of |reference|.
        square, square_error: mean square of the difference less what noise alone gives (may be negative), likewise.
        rms: the root of `square`, 0 where that is negative.
        variance: of one run, mean over pixels, relative to the squared mean of |reference|.
    """
    scale = float(np.abs(reference.mean).mean())
    level_error = float(np.hypot(found.level_error, reference.level_error))
    summary = _bias(found.mean - reference.mean, found.error**2 + reference.error**2, level_error, scale)
    return {**summary, "variance": float(found.variance.mean() / scale**2)}


def paired_bias(difference: Moments, scale: float) -> dict[str, float]:
    """The same from differences, run by run, to something unbiased that takes the same samples, relative to `scale`."""
    return _bias(difference.mean, difference.error**2, difference.level_error, scale)


def _bias(difference: np.ndarray, noise: np.ndarray, level_error: float, scale: float) -> dict[str, float]:
    squares = ((difference**2 - noise) / scale**2).mean(axis=-1)  # channels of a pixel share paths; pixels do not
    square = float(squares.mean())
    return {
        "signed": float(difference.mean() / scale),
        "signed_error": level_error / scale,
        "square": square,
        "square_error": float(squares.std(ddof=1) / np.sqrt(squares.size)),
        "rms": float(np.sqrt(max(square, 0.0))),
    }


def summed_variances(stack: np.ndarray) -> np.ndarray:
    """(runs, steps) of images (runs, steps, H, W, 3): squared deviations summed over pixels, whose mean over runs is the variance
    between runs, summed over pixels."""
    runs = len(stack)
    return np.square(stack - stack.mean(axis=0)).sum(axis=(2, 3, 4)) * runs / (runs - 1)
