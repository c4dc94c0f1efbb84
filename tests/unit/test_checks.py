"""Checks of components' options by the annotations of their fields."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, Literal

import numpy as np
import pytest

from unrender.core import checks, registry
from unrender.core.checks import Count, Fraction, Index, NotNegative, OpenFraction, Positive, Seed, Several
from unrender.core.errors import InputError

RANGES = ("Positive", "NotNegative", "Fraction", "OpenFraction", "Index", "Seed", "Count", "Several", "bool", "Literal")


@dataclass(frozen=True)
class Options(checks.Checked):
    rate: Positive = 1.0
    pull: NotNegative = 0.0
    decay: Fraction = 0.0
    damping: OpenFraction = 0.5
    seed: Seed = 0
    start: Index = 0
    count: Count = 1
    pair: Several | None = None
    flag: bool = False
    kind: Literal["a", "b"] | Literal["c"] | None = "a"
    free: Any = None


def test_values_within_the_ranges_are_taken() -> None:
    Options(1e-9, 2.0, 0.999, 1e-9, 2**63 - 1, 7, 2**32 - 1, 2, True, "c", "anything")
    Options(kind=None, pair=None)


def test_numbers_of_numpy_become_pythons() -> None:
    """Mitsuba refuses NumPy's integers: a run with `spp=np.int64(4)` ended in a traceback."""
    made = Options(rate=np.float32(0.5), count=np.int64(4))  # pyright: ignore[reportArgumentType]
    assert (type(made.rate), type(made.count)) == (float, int)
    assert (made.rate, made.count) == (0.5, 4)


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("rate", 0.0, "rate must be a finite number > 0, got 0.0"),
        ("rate", True, "rate must be a finite number > 0, got True"),
        ("pull", -1.0, "pull must be a finite number >= 0, got -1.0"),
        ("decay", 1.0, "decay must be a finite number >= 0 and < 1, got 1.0"),
        ("damping", 0.0, "damping must be a finite number > 0 and < 1, got 0.0"),
        ("seed", -1, "seed must be a whole number of at least 0, got -1"),
        ("seed", 2**63, "seed must be at most 9223372036854775807, got 9223372036854775808"),
        ("start", 2**32, "start must be at most 4294967295, got 4294967296"),
        ("count", 10**400, "count must be at most 4294967295, got an integer of 1329 bits"),
        pytest.param(
            "count", -(10**5000), "count must be a whole number of at least 1, got an integer of 16610 bits", id="minus"
        ),
        pytest.param("rate", 10**5000, "rate must be a finite number > 0, got an integer of 16610 bits", id="long"),
        ("count", None, "count must be a whole number of at least 1, got None"),
        ("count", [0] * 99, f"count must be a whole number of at least 1, got [{'0, ' * 11}0 ... {'0, ' * 5}0, 0]"),
        ("pair", 1, "pair must be a whole number of at least 2, got 1"),
        ("flag", 1, "flag must be true or false, got 1"),
        ("kind", np.zeros(2), 'kind must be "a", "b" or "c", got array([0., 0.])'),
        ("kind", "d", """kind must be "a", "b" or "c", got 'd'"""),
    ],
)
def test_others_are_refused_by_name(name: str, value: Any, expected: str) -> None:
    with pytest.raises(InputError) as error:
        Options(**{name: value})
    assert str(error.value) == f"Options: {expected}"
    part = Options()
    object.__setattr__(part, name, value)
    with pytest.raises(InputError, match=r"^table: "):
        checks.fields(part, "table")


@pytest.mark.mitsuba
def test_every_annotated_range_of_a_component_is_found() -> None:
    """An annotation that cannot be resolved when the program runs would silently go without its check."""
    for kind in registry.KINDS:
        for cls in registry.components(kind).values():
            if getattr(cls, "__post_init__", None) is None:
                continue
            found = {name for name, *_ in checks._checked(cls)}
            for each in fields(cls):
                words = str(each.type).replace(" | None", "")
                if words in RANGES or words.startswith("Literal["):
                    assert each.name in found, (cls, each.name)
