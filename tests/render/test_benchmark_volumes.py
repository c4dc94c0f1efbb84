"""The volumes that the benchmark of RCV Fig. 11 makes beside the gallery's smoke."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

SIZES = {"resolution": 8, "grid": 6, "reference_spp": 16}
race: Any = None
scenes: Any = None


@pytest.fixture(autouse=True, scope="module")
def with_benchmark() -> None:
    """Import the benchmark here, not at collection: every test process would take a second for its figures."""
    global race, scenes
    race, scenes = (importlib.import_module(f"benchmarks.volumes.fig11_smoke.{name}") for name in ("run", "scenes"))


def test_the_lamp_stands_in_the_same_smoke(tmp_path: Path) -> None:
    plain, lit = (scenes.problem(name, assets=tmp_path, **SIZES) for name in ("smoke", "lit inside"))
    assert plain is not None
    assert lit is not None
    for key, values in plain.truth.items():
        np.testing.assert_array_equal(lit.truth[key], values)
    outside, inside = (np.asarray(each.views[0].reference)[..., 0] for each in (plain, lit))
    assert inside[3:6, 3:6].max() > 4 * outside.max(), "the lamp shows"
    assert inside[0].max() < outside[0].min(), "and its sky is dim"
    assert scenes.measure(lit)(lit.initial())["both"] == pytest.approx(1.0)


def test_a_volume_of_a_file_is_resized_and_scaled_and_left_out_where_there_is_none(tmp_path: Path) -> None:
    import mitsuba as mi

    assert scenes.problem("tutorial", assets=tmp_path, **SIZES) is None
    density = np.zeros((9, 7, 8, 1), np.float32)
    density[:4] = 0.25
    (tmp_path / scenes.FILE).parent.mkdir()
    mi.VolumeGrid(density).write(str(tmp_path / scenes.FILE))
    made = scenes.problem("tutorial", assets=tmp_path, **SIZES)
    assert made is not None
    found = made.truth[scenes.EXTINCTION]
    assert found.shape == (6, 6, 6, 1)
    assert found.max() == pytest.approx(scenes.DENSEST)
    assert not found[4:].any()


def test_what_plain_images_need_is_between_their_neighbours() -> None:
    def entry(error: float) -> dict[str, Any]:
        return {"final": {"both": [error, error, error]}}

    methods = {"plain, 1": entry(1.0), "plain, 4": entry(0.5), "plain, 16": entry(0.25), "rcv, 1": entry(0.5**0.5)}
    record = {"budgets": {"lit inside": {"methods": dict(reversed(methods.items()))}}}
    found = race.summarize(record)
    assert list(found["budgets"]["lit inside"]["methods"]) == list(methods)
    assert found["needs"]["lit inside"]["rcv, 1"]["times"] == pytest.approx(2.0)
    methods["rcv, 1"] = entry(0.2)
    told = race.summarize({"budgets": {"lit inside": {"methods": methods}}})["needs"]["lit inside"]["rcv, 1"]
    assert told == {"more_than": 16, "times": 16.0}
    assert race.summarize({"budgets": {"lit inside": {"methods": {"plain, 1": entry(1.0)}}}})["needs"] == {}


def test_fine_grids_are_the_same_problem_with_smoothed_gradients(tmp_path: Path) -> None:
    made = scenes.problem("lit inside", assets=tmp_path, **SIZES)
    assert made is not None
    found = scenes.smoothed(made)
    for before, after in zip(made.parameters, found.parameters, strict=True):
        assert after.preconditioner is not None
        assert (after.key, after.learning_rate) == (before.key, before.learning_rate)
    assert scenes.measure(found)(found.initial())["both"] == pytest.approx(1.0)
