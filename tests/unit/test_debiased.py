"""Errors of noisy pictures without their noise."""

from __future__ import annotations

import math

import numpy as np
import pytest

from unrender.core.errors import InputError
from unrender.display import formatting
from unrender.statistics import debiased

RUNS = 400


def pictures(rng: np.random.Generator, sigma: float, shape: tuple[int, ...] = (12, 10, 3)) -> list[np.ndarray]:
    """Two noisy pictures whose channels are correlated, as those of paths are."""
    shared = rng.gamma(0.5, size=(2, *shape[:2], 1)) - 0.5  # skewed
    return list(sigma * (shared + 0.3 * rng.standard_normal((2, *shape))))


@pytest.mark.parametrize("sigma", [0.05, 1.0])
def test_the_mean_square_is_unbiased_and_its_standard_error_right(sigma: float) -> None:
    rng = np.random.default_rng(1)
    difference = rng.uniform(-0.4, 0.5, (12, 10, 3))
    truth = float(np.mean(difference**2))
    squares, errors, naive = [], [], []
    for _ in range(RUNS):
        first, second = (difference + noise for noise in pictures(rng, sigma))
        product = float(np.mean(first * second))
        value, error = debiased.rmse(first, second, np.zeros_like(first))
        squares.append(product)
        naive.append(float(np.mean(((first + second) / 2) ** 2)))
        if value**2 > 2 * error * 2 * value:
            assert value == pytest.approx(math.sqrt(product))
            errors.append(error * 2 * value)
        else:
            errors.append(error**2 / 2)
    spread = np.std(squares) / math.sqrt(RUNS)
    assert abs(np.mean(squares) - truth) < 4 * spread
    # The error bar agrees with the spread over runs: its mean square is the variance of the estimate.
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(np.std(squares), rel=0.25)
    assert np.mean(naive) - truth > 0.4 * sigma**2 * 0.5 * 0.5  # the picture's own noise would be called error


def test_pure_noise_is_below_a_bound_and_not_a_number() -> None:
    rng = np.random.default_rng(3)
    first, second = pictures(rng, 0.5)
    value, error = debiased.rmse(first, second, np.zeros((12, 10, 3)))
    assert formatting.with_error(value, error).startswith("below 0.")
    assert math.hypot(value, error) < 0.35 < math.sqrt(0.5) * 0.5 * 1.1


def test_pictures_without_noise_have_their_plain_error() -> None:
    picture = np.full((2, 3, 3), 0.5)
    assert debiased.rmse(picture, picture, np.zeros_like(picture)) == (0.5, 0.0)
    assert debiased.rmse(picture, picture, picture) == (0.0, 0.0)


def test_what_is_not_finite_is_infinitely_wrong_and_sizes_must_agree() -> None:
    picture = np.full((2, 2, 3), np.nan)
    assert debiased.rmse(picture, picture, np.zeros((2, 2, 3))) == (math.inf, math.inf)
    with pytest.raises(InputError, match="one size"):
        debiased.rmse(picture, picture, np.zeros((2, 3, 3)))


def test_the_mean_over_views() -> None:
    assert debiased.mean([(1.0, 0.3), (3.0, 0.4)]) == pytest.approx((2.0, 0.25))


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [
        (0.21234, 0.00361, "0.2123 ± 0.0036"), (1.5, 0.0, "1.5"), (0.0, 0.02, "below 0.02"), (0.03, 0.04, "below 0.05"),
        (math.inf, math.inf, "∞"), (123.4, 1.2, "123.4 ± 1.2"),
    ],
)  # fmt: skip
def test_values_with_their_errors_in_words(value: float, error: float, text: str) -> None:
    assert formatting.with_error(value, error) == text


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [
        (0.0018, 0.0019, "0.0018 ± 0.0019"), (-0.0005, 0.0019, "−0.0005 ± 0.0019"), (0.0, 0.02, "0.000 ± 0.020"), (0.3, 0.0, "0.3"),
        (-2e-8, 3e-8, "−2·10⁻⁸ ± 3·10⁻⁸"), (math.inf, 1.0, "∞"), (0.215, 5.9e-11, "0.215"), (0.5, 2e-7, "0.5 ± 2·10⁻⁷"),
    ],
)  # fmt: skip
def test_values_within_their_standard_error_are_no_limit(value: float, error: float, text: str) -> None:
    assert formatting.with_standard_error(value, error) == text


def test_few_values_are_listed_up_to_twelve_numbers() -> None:
    known = {f"colour{i}": np.array([0.25, 0.5, 1.0]) for i in range(5)} | {"map": np.zeros((4, 4))}
    texts = formatting.few_values(known, {"colour0": [0.01, None, 0.02]})
    assert list(texts) == ["colour0", "colour1", "colour2", "colour3"]
    assert texts["colour0"] == "0.250 ± 0.010, 0.5 (not determined), 1.000 ± 0.020"
    assert texts["colour1"] == "0.25, 0.5, 1"


def test_phases_in_words() -> None:
    assert formatting.phases({"loading": 2.123, "page": 0.01, "steps": 83.0}) == "loading 2.1 s, steps 1 min 23 s"


def test_a_mask_says_what_counts():
    """The error of the pixels that count, with its standard error, whatever is elsewhere."""
    generator = np.random.default_rng(3)
    first, second = (0.5 + 0.1 * generator.standard_normal((20, 30, 3)) for _ in range(2))
    black, mask = np.zeros((20, 30, 3)), np.zeros((20, 30))
    mask[:, :10] = 1.0
    alone = debiased.rmse(first[:, :10], second[:, :10], black[:, :10])
    first[:, 10:] = np.inf
    assert debiased.rmse(first, second, black, mask) == pytest.approx(alone)
    assert debiased.rmse(first, second, black, 0.5 * mask) == pytest.approx(alone)
    assert debiased.rmse(first, second, black, 0.0 * mask) == (0.0, 0.0)
    with pytest.raises(InputError, match="mask"):
        debiased.rmse(first, second, black, mask[:5])


@pytest.mark.parametrize("masked", [False, True])
def test_the_error_of_a_single_pixel_is_not_zero(masked: bool) -> None:
    """A pixel has no spread over pixels, so its noise comes from its two renderings alone."""
    rng, scores = np.random.default_rng(4), []
    shape, mask = ((2, 2, 3), np.array([[1.0, 0.0], [0.0, 0.0]])) if masked else ((1, 1, 3), None)
    for _ in range(400):
        first, second = (0.5 + rng.normal(0.0, 0.05, shape) for _ in range(2))
        value, error = debiased.rmse(first, second, np.zeros(shape), mask)
        scores.append(abs(value - 0.5) / error)
    assert np.quantile(scores, 0.5) < 2.0


def test_values_have_as_many_digits_as_their_standard_errors() -> None:
    """A value of 12.035 ± 0.042 was shown as 12."""
    found = formatting.values(np.array([12.0353, -0.00123, 50.713]), [0.0424, 0.0011, None])
    assert found == "12.035 ± 0.042, −0.0012 ± 0.0011, 50.7 (not determined)"
