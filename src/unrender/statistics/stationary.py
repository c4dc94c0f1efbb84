"""Means of correlated sequences that have become stationary, with standard errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_STARTS = np.arange(1, 11) / 20
"""First values of the windows, as fractions of the sequence. Each window has half of the sequence at least."""
_FEWEST, _CROSSINGS = 16, 4
"""Number of values of a window, and number of times that they cross their mean, below which drift and noise look alike."""
_FEW = 4.0  # length of a window relative to its correlation time up to which it shows no mean
_DIFFERENT = 2.0  # standard errors between the means of two parts of a window from which it is not stationary
_CROSSING_TIMES = 4
"""Largest lag of the autocovariances that are summed, in units of the lag at which they first reach 0."""
_LOST, _LARGEST_LOSS = 1.25, 0.7
"""Fraction of the variance that is lost to the subtracted mean, in units of the largest lag over the length, and its limit. Source: the
coverage of the mean of autoregressive and of oscillating sequences."""


@dataclass(frozen=True)
class StationaryMean:
    """Mean of the end of a sequence.

    Attributes:
        start: index of its first value.
    """

    start: int
    value: float
    error: float


def stationary_mean(sequence: np.ndarray) -> StationaryMean | None:
    """Return the mean over the longest window at the end of a sequence (T,) in which it is stationary.

    In such a window the values cross their mean repeatedly. The means of the first quarter and of the first half differ from those of the
    rest by less than two standard errors. None if no window of at least half the sequence and 16 values is stationary, as for a sequence
    that converges smoothly or drifts slowly.
    """
    count = len(sequence)
    for start in sorted({int(count * share) for share in _STARTS}):
        window = sequence[start:]
        length = len(window)
        if length < _FEWEST:
            return None
        quarter, half = length // 4, length // 2
        deviations = window - window.mean()
        variance, correlated = long_run_variance(_without_trend(window[quarter:]))
        crossings = np.count_nonzero(deviations[1:] * deviations[:-1] < 0.0)
        if variance <= 0.0 or crossings < _CROSSINGS or length - quarter <= _FEW * correlated:
            continue
        early = _distance(window, quarter, variance)
        if max(early, _distance(window, half, variance)) < _DIFFERENT:
            own = max(long_run_variance(part)[0] for part in (window, window[quarter:]))
            # Where few correlation times make up the window, the variance itself has a large error.
            return StationaryMean(
                start, float(window.mean()), float(np.sqrt(own * (1.0 + 2.0 * correlated / length) / length))
            )
    return None


def long_run_variance(values: np.ndarray) -> tuple[float, float]:
    """Return n times the variance of the mean of n correlated values (n,), and their correlation time, which is 1 for independent ones.

    The autocovariances up to some lag K are summed with the weights 1 − l / (K + 1) (Bartlett). K is four times the lag at which they
    first reach 0 (the pairs of Geyer 1992), since values that oscillate are anticorrelated beyond it. The mean that is subtracted makes
    the sum smaller by a fraction of about K / n, which is corrected.
    """
    n = len(values)
    spectrum = np.fft.rfft(values - values.mean(), 2 * n)
    covariances = np.fft.irfft(np.square(np.abs(spectrum)))[:n] / n
    if covariances[0] <= 0.0:
        return 0.0, 1.0
    pairs = covariances[: n - n % 2].reshape(-1, 2).sum(axis=1)
    crossing = 2 * int(np.argmax(pairs <= 0.0)) if (pairs <= 0.0).any() else n
    lags = np.arange(1, min(_CROSSING_TIMES * crossing, n // 2) + 1)
    width = len(lags) + 1
    total = float(covariances[0] + 2.0 * ((1.0 - lags / width) @ covariances[lags]))
    total = max(total, 0.0) / (1.0 - min(_LOST * width / n, _LARGEST_LOSS))
    return total, total / float(covariances[0])


def _without_trend(values: np.ndarray) -> np.ndarray:
    """Return the values minus the straight line of least squares."""
    places = np.arange(len(values)) - 0.5 * (len(values) - 1)
    return values - (places @ values) / (places @ places) * places


def _distance(window: np.ndarray, place: int, variance: float) -> float:
    """Return the difference of the means before and after `place`, in standard errors."""
    difference = window[:place].mean() - window[place:].mean()
    return float(abs(difference) / np.sqrt(variance * (1.0 / place + 1.0 / (len(window) - place))))
