"""Means of the numbers of a run over its last steps, which have less noise than the last values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from unrender.core import arrays
from unrender.core.errors import InputError
from unrender.core.text import grouped
from unrender.core.trees import Tree
from unrender.optimizers.base import averaged_by
from unrender.runs.callbacks import Callback
from unrender.runs.result import Result
from unrender.runs.verification import control_variates
from unrender.scene.problem import Problem

if TYPE_CHECKING:
    from unrender.runs.run import Run

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


_MOST_OF_ONE, _MOST_ELEMENTS = 4, 256
"""Elements of one number, and of all numbers, up to which they are averaged."""
_FEWEST_WITH_MEMORY = 100
"""Fewest steps of a mean with a standard error where control variates keep noise for about 20 steps, which shorter means do not show.
Source: a roughness, eight seeds: over 51 steps the errors were 3.0 times the stated ones, over 120 to 228 steps 1.7 times."""


class NumberMeans(Callback):
    """Callback that records the numbers of a run at each step, for `averaged`."""

    def on_step(self, run: Run, record: dict[str, Any]) -> None:
        if shapes := numbers_of(run.problem, run.optimizer, run.state.optimizer):
            values = [arrays.numpy(run.parameters[key]).astype(np.float64).ravel() for key in shapes]
            run.state.numbers.append(np.concatenate(values))


def numbers_of(problem: Problem, optimizer: Any, state: Any = None) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the numbers and colours of a problem, without those that the optimizer averages itself in a state."""
    shapes = problem.shapes()
    own = averaged_by(optimizer, shapes, state)
    numbers = {
        key: shape
        for key, shape in shapes.items()
        if key not in own and len(shape) <= 1 and np.prod(shape, dtype=int) <= _MOST_OF_ONE
    }
    return numbers if sum(int(np.prod(shape, dtype=int)) for shape in numbers.values()) <= _MOST_ELEMENTS else {}


def averaged(run: Run, result: Result) -> Result:
    """Return the result with the mean of each number over its last steps, where these are stationary, and its standard error.

    There are no standard errors if other parameters are unknown, such as textures: numbers may follow these slowly, with little noise.
    Neither are there any of a few steps with control variates.
    """
    trace = run.state.numbers
    shapes = numbers_of(run.problem, run.optimizer, run.state.optimizer)
    if not shapes or not trace.rows:
        return result
    last = {key: result.parameters[key] for key in shapes}
    means, errors, steps = _means(np.array(trace.rows), trace.size, last)
    if not steps:
        return result
    if next(control_variates(run.state.estimator), None) is not None:
        errors = {key: error for key, error in errors.items() if int(steps[key]) >= _FEWEST_WITH_MEMORY}
    return replace(
        result,
        parameters={**result.parameters, **means},
        last=result.parameters,
        standard_error=result.standard_error if set(run.problem.shapes()) - set(shapes) else errors,
        adapted=[*result.adapted, f"numbers are means of their last steps: {grouped(steps)}"],
    )


def normalised(problem: Problem, result: Result) -> Result:
    """Return the result with directions (3,) of length 1 and ratios of the initial lengths, and their standard errors.

    No picture depends on the lengths.
    """
    factors = {key: unknown.normalised(result.parameters[key]) for key, unknown in problem.unknowns.items()}

    def scaled(values: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        return {
            key: np.asarray(x) if (factor := factors.get(key)) is None else np.asarray(x * factor, np.float32)
            for key, x in values.items()
        }

    if all(factor is None for factor in factors.values()):
        return result
    return replace(result, parameters=scaled(result.parameters), standard_error=scaled(result.standard_error))


def _means(
    rows: np.ndarray, size: int, last: dict[str, np.ndarray]
) -> tuple[dict[str, np.ndarray], Tree, dict[str, str]]:
    """Return the means of rows (B, n) by key, their standard errors, and the steps of each key.

    There are standard errors only if all numbers that change are stationary. A number that still drifts takes others with it, however
    steady those seem.
    """
    columns = [stationary_mean(column) for column in rows.T]
    settled = all(mean or (column == column[0]).all() for mean, column in zip(columns, rows.T, strict=True))
    means: dict[str, np.ndarray] = {}
    errors: Tree = {}
    steps: dict[str, str] = {}
    start = 0
    for key, value in last.items():
        own, start = columns[start : start + value.size], start + value.size
        known = [mean for mean in own if mean is not None]
        if not known:
            continue
        values = [x if mean is None else mean.value for x, mean in zip(value.ravel(), own, strict=True)]
        means[key] = np.array(values, value.dtype).reshape(value.shape)
        steps[key] = str(min(len(rows) - mean.start for mean in known) * size)
        if settled and len(known) == value.size:
            errors[key] = np.array([mean.error for mean in known], np.float32).reshape(value.shape)
    return means, errors, steps


# ---------------------------------------------------------------------- means of correlated sequences that have become stationary

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
    places = np.arange(len(values)) - 0.5 * (len(values) - 1)
    return values - (places @ values) / (places @ places) * places


def _distance(window: np.ndarray, place: int, variance: float) -> float:
    """Return the difference of the means before and after `place`, in standard errors."""
    difference = window[:place].mean() - window[place:].mean()
    return float(abs(difference) / np.sqrt(variance * (1.0 / place + 1.0 / (len(window) - place))))
