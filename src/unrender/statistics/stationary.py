"""Means of correlated sequences that have become stationary, with standard errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_STARTS = np.arange(1, 11) / 20
"""First values of the windows, as fractions of the sequence. Each window has half of the sequence at least."""
_FEWEST, _CROSSINGS = 16, 4
"""Number of values of a window, and number of times that they cross their mean, below which drift and noise look alike."""
_FEW, _MANY = 4.0, 10.0
"""Length of a window relative to its correlation time from which its mean is used, and from which it has a standard error."""
_DIFFERENT = 2.0
"""Standard errors between the means of two parts of a window from which it is not stationary."""
_BIAS = 2.0
"""Correction of the variance for the mean that is estimated from the same values, in correlation times over the length."""


@dataclass(frozen=True)
class StationaryMean:
    """Mean of the end of a sequence.

    Attributes:
        start: index of its first value.
        value: mean.
        error: standard error; NaN if the window is too short for one.
    """

    start: int
    value: float
    error: float


def stationary_mean(sequence: np.ndarray) -> StationaryMean | None:
    """Return the mean over the longest window at the end of a sequence (T,) in which it is stationary; None if no half of it is.

    In such a window the values cross their mean repeatedly, the first quarter has the mean of the rest, and so has the first half, within
    two standard errors. So a sequence that converges smoothly, or wanders slowly, has no mean here.
    """
    count = len(sequence)
    for start in sorted({int(count * share) for share in _STARTS}):
        window = sequence[start:]
        length = len(window)
        if length < _FEWEST:
            return None
        quarter, half = length // 4, length // 2
        deviations = window - window.mean()
        variance, correlated = long_run_variance(window[quarter:])
        crossings = np.count_nonzero(deviations[1:] * deviations[:-1] < 0.0)
        if variance <= 0.0 or crossings < _CROSSINGS or length - quarter <= _FEW * correlated:
            continue
        early = _distance(window, quarter, variance)
        if max(early, _distance(window, half, variance)) < _DIFFERENT:
            own, time = long_run_variance(window)
            error = np.sqrt(max(own, variance) / length)
            return StationaryMean(
                start, float(window.mean()), float(error) if length >= _MANY * max(time, correlated) else np.nan
            )
    return None


def long_run_variance(values: np.ndarray) -> tuple[float, float]:
    """Return n times the variance of the mean of n correlated values (n,), and their correlation time, which is 1 for independent ones.

    The autocovariances are summed in pairs until a pair is not positive (Geyer 1992).
    """
    n = len(values)
    spectrum = np.fft.rfft(values - values.mean(), 2 * n)
    covariances = np.fft.irfft(np.square(np.abs(spectrum)))[:n] / n
    if covariances[0] <= 0.0:
        return 0.0, 1.0
    pairs = covariances[: n - n % 2].reshape(-1, 2).sum(axis=1)
    ends = np.flatnonzero(pairs <= 0.0)
    total = max(2.0 * pairs[: ends[0] if ends.size else len(pairs)].sum() - covariances[0], 0.0)
    time = total / covariances[0]
    return float(total * (1.0 + _BIAS * time / n)), float(time)


def _distance(window: np.ndarray, place: int, variance: float) -> float:
    """Return the difference of the means before and after `place`, in standard errors."""
    difference = window[:place].mean() - window[place:].mean()
    return float(abs(difference) / np.sqrt(variance * (1.0 / place + 1.0 / (len(window) - place))))
