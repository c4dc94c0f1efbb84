"""Checks of components' options by the annotations of their fields."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest

import unrender as ur
from unrender.core import checks, registry
from unrender.core.checks import (
    Count,
    Fraction,
    Index,
    NotNegative,
    OpenFraction,
    Positive,
    PositiveByKey,
    Seed,
    Several,
)
from unrender.core.errors import InputError

RANGES = (
    "Positive",
    "PositiveByKey",
    "NotNegative",
    "Fraction",
    "OpenFraction",
    "Index",
    "Seed",
    "Count",
    "Several",
    "bool",
    "Literal",
)


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
    weights: PositiveByKey = field(default_factory=dict)


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
        ("weights", 1.0, "weights must be numbers by key, {key: number}, got 1.0"),
        ("weights", {1: 1.0}, "weights must be numbers by key, {key: number}, got {1: 1.0}"),
        ("weights", {"k": "1"}, "weights of k must be a finite number > 0, got '1'"),
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


@pytest.mark.mitsuba
def test_values_of_other_types_for_a_field_of_a_component_are_one_line() -> None:
    """No field may raise Python's own error, and one for a component may not wait for the run to find that it is none."""
    wrong = [
        "abc",
        None,
        [1, "a"],
        {"a": 1},
        {1: 2},
        object(),
        int,
        10**400,
        np.zeros(3),
        b"x",
        lambda *_: None,
        [[1], [2, 3]],
    ]
    for name, made_by in registry.table_components().items():
        parts = [each for each in fields(made_by) if each.init]
        needed = {each.name: 3 for each in parts if each.default is MISSING and each.default_factory is MISSING}
        for each in parts:
            refused = 0
            for value in wrong:
                try:
                    made_by(**(needed | {each.name: value}))
                except InputError:
                    refused += 1
                except Exception as error:
                    raise AssertionError(f"{name}: {each.name}={value!r}") from error
            assert refused >= len(wrong) - 3, f"{name}: {each.name} takes anything"


@pytest.mark.mitsuba
@pytest.mark.parametrize(
    ("made", "expected"),
    [
        (lambda x: ur.PathGradient(image=x), "PathGradient: image must be one of unrender.images, got 'rcv'"),
        (
            lambda x: ur.optimizers.Partitioned(others=x),
            "Partitioned: others must be one of unrender.optimizers, got 'rcv'",
        ),
        (lambda x: ur.optimizers.Successive(then=x), "Successive: then must be an AveragedNewton, got 'rcv'"),
        (
            lambda x: ur.estimators.HybridGradient(perturbed=x),
            "HybridGradient: perturbed must be a SmoothedDerivatives or a GaussNewton, got 'rcv'",
        ),
        (
            lambda x: ur.optimizers.ScheduleFree(preconditioner=x),
            "ScheduleFree: preconditioner must be one of unrender.preconditioners or None, got 'rcv'",
        ),
    ],
)
def test_components_of_another_kind_are_refused_by_name(made: Callable[[Any], Any], expected: str) -> None:
    with pytest.raises(InputError) as error:
        made("rcv")
    assert str(error.value) == expected


_WRONG: list[Any] = [3, [1, "a"], {1: 2}, object(), int, np.zeros(3), b"x", {1}, 10**400, "a\0b", "x" * 5000]


@pytest.mark.mitsuba
@pytest.mark.parametrize(
    ("call", "but"),
    [
        (lambda x: ur.app.ImportOptions(mesh=x), "x"),
        (lambda x: ur.app.ImportOptions(unknowns=x), ""),
        (lambda x: ur.app.ImportOptions(response=x), "3"),
        (lambda x: ur.app.import_capture(x, "out"), ""),
        (lambda x: ur.app.import_capture("nowhere", x), ""),
        (lambda x: ur.app.import_capture("nowhere", "out", x), ""),
        (lambda x: ur.app.export(x, "out"), ""),
        (lambda x: ur.app.export("nowhere", "out", formats=x), ""),
        (lambda x: ur.app.judge(x), ""),
        (lambda x: ur.app.judge("nowhere", out=x), ""),
        (lambda x: ur.app.sweep(x, steps=1, over={"learning_rate": "1,2"}, out="out"), ""),
        (lambda x: ur.app.sweep("exponential", settings=x, steps=1, over={"learning_rate": "1,2"}, out="out"), ""),
        (lambda x: ur.app.sweep("exponential", steps=x, over={"learning_rate": "1,2"}, out="out"), "3"),
        (lambda x: ur.app.sweep("exponential", seconds=x, over={"learning_rate": "1,2"}, out="out"), "3"),
        (lambda x: ur.app.turntable("nowhere", "a.mp4", rate=x), ""),
        (lambda x: ur.app.turntable("nowhere", "a.mp4", elevation=x), ""),
        (lambda x: ur.app.turntable("nowhere", "a.mp4", background=x), ""),
        (lambda x: ur.app.turntable("nowhere", "a.mp4", up=x), ""),
        (lambda x: ur.gallery.photographs(x), "x"),
        (lambda x: ur.smoothed.gradient(lambda points: x, np.zeros(2), 0.1, 16), ""),
        (lambda x: ur.smoothed.gradient(lambda points: points[:, 0], x, 0.1, 16), "array"),
    ],
)
def test_arguments_of_another_kind_are_one_line(
    call: Callable[[Any], Any], but: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They ended in an AttributeError, a TypeError or an OSError. `but` begins the words of values that are right."""
    monkeypatch.chdir(tmp_path)
    for value in _WRONG:
        if but and (repr(value).strip("'")[:1] == but or repr(value).startswith(but)):
            continue
        with pytest.raises(InputError) as error:
            call(value)
        assert len(str(error.value).splitlines()) == 1
