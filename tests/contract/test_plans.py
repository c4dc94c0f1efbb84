"""Golden plans: what `auto` chooses for each problem of the gallery, one line each, cannot change unnoticed.

After a change on purpose: `python -m tests.contract.test_plans` writes the file anew.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import unrender as ur
from unrender import gallery
from unrender.methods import method

pytestmark = pytest.mark.mitsuba

GOLDEN = Path(__file__).parent / "plans.txt"
SMALL = {
    "resolution": 8,
    "reference_spp": 4,
    "texture_resolution": 8,
    "grid_resolution": 8,
    "views": 2,
    "subdivisions": 1,
    "height_resolution": 4,
    "label": 4,
}
ONE_OF_A_KIND = ("poster", "smoke", "sphere-to-mesh", "mug", "camera", "tea", "exponential")
WITH_L1 = ("poster", "lamp", "smoke", "sphere-to-mesh", "camera")


def brief(value: Any) -> str:
    """A component as its call, without the arguments that are the defaults."""
    if not dataclasses.is_dataclass(value) or isinstance(value, type):
        if isinstance(value, (tuple, list)):
            return f"({', '.join(map(brief, value))})"
        if isinstance(value, dict):
            return f"{{{', '.join(f'{key}: {brief(each)}' for key, each in value.items())}}}"
        return f"{value:.4g}" if isinstance(value, (float, np.floating)) else str(value)
    given = []
    for field in dataclasses.fields(value):
        own = getattr(value, field.name)
        made = field.default_factory() if field.default_factory is not dataclasses.MISSING else field.default
        if field.init and not (type(made) is type(own) and brief(made) == brief(own)):
            given.append(f"{field.name}={brief(own)}")
    return f"{type(value).__name__}({', '.join(given)})"


def line(name: str, problem: ur.Problem) -> str:
    """What `auto` plans for a problem, in one line."""
    plan = method("auto").plan(problem, {})
    settings = "; ".join(f"{key}: {brief(own)}" for key, own in plan.settings.items())
    start = ", ".join(f"{key} {tuple(x.shape)}" for key, x in plan.configured().start().items())
    parts = (name, brief(plan.estimator), brief(plan.optimizer), settings or "-", start, *plan.reasons)
    return " | ".join(" ".join(part.split()) for part in parts)


def small(name: str) -> ur.Problem:
    options = {option.name for option in gallery.options(name)}
    return ur.gallery.problem(name, **{key: value for key, value in SMALL.items() if key in options})


def lines(names: Sequence[str] = gallery.names()) -> Iterator[tuple[str, str]]:
    """(name, line) of problems of the gallery, some with another loss."""
    for name in names:
        try:
            problem = small(name)
        except ur.InputError as error:
            yield name, f"{name} | refused: {error}"
            continue
        yield name, line(name, problem)
        if name in WITH_L1:
            yield f"{name} L1", line(f"{name} L1", problem.replaced(loss=ur.losses.L1()))


def known() -> dict[str, str]:
    return {text.partition(" | ")[0]: text for text in GOLDEN.read_text("utf-8").splitlines()}


def differing(names: Sequence[str]) -> str:
    """Recorded and present lines that differ."""
    expected, found = known(), dict(lines(names))
    pairs = [f"- {expected.get(name)}\n+ {text}" for name, text in found.items() if expected.get(name) != text]
    return "\n".join(pairs)


def test_auto_plans_some_problems_as_recorded() -> None:
    """One for each kind of unknown."""
    assert not differing(ONE_OF_A_KIND)


@pytest.mark.slow
def test_auto_plans_each_problem_of_the_gallery_as_recorded() -> None:
    names = gallery.names()
    assert not differing(names)
    assert known().keys() == set(names) | {f"{name} L1" for name in WITH_L1}


def test_a_changed_constant_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Other samples per pixel, with the same reasons."""
    own = ur.PathGradient.__post_init__

    def planted(estimator: ur.PathGradient) -> None:
        object.__setattr__(estimator, "spp", estimator.spp * 2)
        own(estimator)

    problem, expected = small("poster"), known()["poster"]
    assert line("poster", problem) == expected
    monkeypatch.setattr(ur.PathGradient, "__post_init__", planted)
    assert line("poster", problem) != expected


if __name__ == "__main__":
    ur.use()
    GOLDEN.write_text("".join(f"{text}\n" for _, text in lines()), "utf-8")
