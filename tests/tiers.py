"""Which parameters of a test are in the quick tier (`make test`), and which in the long one alone (`make test-all`)."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def quick(parameters: Iterable[Any], *chosen: Any) -> list[Any]:
    """`parameters` for `pytest.mark.parametrize`: those in `chosen` are in both tiers, the others are marked slow."""
    parameters = list(parameters)
    if unknown := [each for each in chosen if each not in parameters]:
        raise ValueError(f"not among the parameters: {unknown}")
    return [each if each in chosen else slow(each) for each in parameters]


def slow(*values: Any) -> Any:
    """One parameter, or one tuple of several, in the long tier alone."""
    return pytest.param(*values, marks=pytest.mark.slow)
