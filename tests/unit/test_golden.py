"""Golden trajectories: what a comparison says, and that optimizers on made gradients take the recorded steps."""

from __future__ import annotations

import json
from typing import Any

import pytest

from scripts.golden import cases
from scripts.golden.cli import RECORD, compare, summary

KNOWN: dict[str, Any] = json.loads(RECORD.read_text())["cases"]


def entry(loss: float, sketches: list[float], step: str = "aa") -> dict[str, Any]:
    return {"losses": [1.0, loss], "hashes": ["00", step], "sketches": [{"x": [each] * 4} for each in sketches]}


def test_a_comparison_knows_equal_trajectories_from_scatter_and_from_faults() -> None:
    known = entry(0.5, [1.0, 1.1, 0.95])
    assert compare(known, entry(0.5, [1.0])) == "equal"
    assert compare(known, entry(0.5, [1.05], "bb")).startswith("within seed scatter: from step 1 on")
    assert compare(known, entry(0.5, [1.3], "bb")).startswith("differs: from step 1 on")
    assert compare(known, {"refused": "no"}) == "differs: it ran -> no"
    assert compare({"refused": "no"}, {"refused": "no"}) == "equal"
    assert compare(entry(0.5, [1.0, 1.0]), entry(0.5, [1.001], "bb")).startswith("differs"), "seeds make no scatter"


def test_the_record_has_every_case() -> None:
    expected = {f"optimizer/{name}" for name in cases.OPTIMIZERS}
    expected |= {f"{problem}/{method}" for problem in cases.PROBLEMS for method in cases.METHODS}
    assert set(KNOWN) == expected
    assert len(cases.PROBLEMS) == 12
    assert len(cases.METHODS) == 6


@pytest.mark.parametrize("name", cases.OPTIMIZERS)
def test_optimizers_take_the_recorded_steps(name: str) -> None:
    """To the bit where NumPy rounds as on the machine of the record, within the scatter of seeds elsewhere."""
    found = summary(lambda seed: cases.optimize(name, seed), seeds=1)
    assert not compare(KNOWN[f"optimizer/{name}"], found).startswith("differs")
    assert found["losses"] == pytest.approx(KNOWN[f"optimizer/{name}"]["losses"], rel=1e-3)


@pytest.mark.parametrize("method", ["plain", "rcv"])
def test_a_descent_takes_the_recorded_steps(method: str) -> None:
    found = summary(lambda seed: cases.descend(cases.PROBLEMS["linear"](), method, seed), seeds=1)
    assert not compare(KNOWN[f"linear/{method}"], found).startswith("differs")
