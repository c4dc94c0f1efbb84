"""Schedules against closed forms."""

import math
from typing import Any

import numpy as np
import pytest

from unrender.core.errors import InputError
from unrender.schedules import Constant, Cosine, Exponential, Inverse, InverseRoot, Steps, Warmup, schedule_factor


@pytest.mark.parametrize(
    ("schedule", "factors"),
    [
        (Constant(), {0: 1.0, 1000: 1.0}),
        (Constant(0.3), {0: 0.3, 1000: 0.3}),
        (Exponential(100), {0: 1.0, 50: math.sqrt(0.5), 100: 0.5, 300: 0.125}),
        (Exponential(100, floor=0.2), {0: 1.0, 100: 0.5, 300: 0.2}),
        (Inverse(15), {0: 1.0, 15: 0.5, 45: 0.25, 1485: 0.01}),
        (InverseRoot(15), {0: 1.0, 15: math.sqrt(0.5), 45: 0.5, 225: 0.25}),
        (Cosine(100), {0: 1.0, 25: 0.5 + math.sqrt(0.125), 50: 0.5, 100: 0.0, 101: 0.0, 10**9: 0.0}),
        (Cosine(100, floor=0.2), {0: 1.0, 50: 0.6, 100: 0.2, 200: 0.2}),
        (Steps(10, 0.5), {0: 1.0, 9: 1.0, 10: 0.5, 19: 0.5, 20: 0.25}),
        (Steps(1, 2.0), {0: 1.0, 10: 1024.0, 2000: math.inf}),
        (Warmup(4), {0: 0.25, 1: 0.5, 1.5: 0.625, 3: 1.0, 3.5: 1.0, 4: 1.0, 100: 1.0}),
        (Warmup(4, Exponential(2)), {0: 0.25, 3: 1.0, 4: 1.0, 6: 0.5}),
    ],
    ids=repr,
)
def test_closed_form(schedule, factors):
    assert {step: schedule(step) for step in factors} == pytest.approx(factors, abs=1e-12)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Constant(-0.1), "Constant: factor must be a finite number >= 0, got -0.1"),
        (lambda: Exponential(0), "Exponential: half_life must be a finite number > 0, got 0"),
        (lambda: Exponential(math.nan), "Exponential: half_life must be a finite number > 0, got nan"),
        (lambda: Inverse(0), "Inverse: time must be a finite number > 0, got 0"),
        (lambda: InverseRoot(0), "InverseRoot: time must be a finite number > 0, got 0"),
        (lambda: Exponential(10, -1), "Exponential: floor must be a finite number >= 0, got -1"),
        (lambda: Cosine(0), "Cosine: steps must be a whole number of at least 1, got 0"),
        (lambda: Cosine(10, -1), "Cosine: floor must be a finite number >= 0, got -1"),
        (lambda: Steps(2.5), "Steps: every must be a whole number of at least 1, got 2.5"),  # type: ignore
        (lambda: Steps(2, 0), "Steps: factor must be a finite number > 0, got 0"),
        (lambda: Warmup(True), "Warmup: steps must be a whole number of at least 1, got True"),
        (lambda: Warmup(3, 0.5), "Warmup: then must be one of unrender.schedules or None, got 0.5"),  # type: ignore
    ],
)
def test_bad_arguments_are_named(make, message):
    with pytest.raises(InputError) as caught:
        make()
    assert str(caught.value) == message


@pytest.mark.parametrize(
    "value", [10**400, -(10**400), math.nan, math.inf, -1.0, None, "0.5", b"1", [0.5], np.zeros(2), 1j]
)
def test_results_of_own_schedules_that_are_no_factor_are_one_line(value: Any) -> None:
    with pytest.raises(InputError, match=r"^Adam: schedule must return a finite factor >= 0, got .* at step 3$"):
        schedule_factor("Adam", lambda step: value, 3)


@pytest.mark.parametrize("value", [0, 0.5, True, np.float32(0.5), np.int64(2), np.array(0.5)])
def test_results_of_own_schedules_may_be_numbers_of_any_type(value: Any) -> None:
    factor = schedule_factor("Adam", lambda step: value, 3)
    assert type(factor) is float
    assert factor == value
