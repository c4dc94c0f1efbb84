"""What a run writes, its reader takes: whatever names, seeds, settings and numbers were typed. What it would refuse is refused first."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

import unrender as ur
from tests.analytic import AnalyticRenderer
from unrender.app.stages import stages_file
from unrender.app.sweeps.record import SweepPlan, SweepRecord, read_sweep, write_sweep
from unrender.core.errors import InputError
from unrender.core.random import LARGEST_SEED, LEAST_SEED
from unrender.runs.callbacks import Callback
from unrender.runs.folder import method_file, reader, schema
from unrender.runs.metadata import RunAnnotations

WORDS = st.text(max_size=20) | st.sampled_from(
    ["\udcff", "\x1b[2J", "a/../b", "\0", "\u202e", "1e999", "x" * 5000, "../..", "ü"]
)
NUMBERS = (
    st.floats()
    | st.integers()
    | st.sampled_from([1e308, 5e-324, -0.0, float("nan"), float("inf"), 2**63, -(2**70), 10**400])
)
VALUES = st.recursive(
    WORDS | NUMBERS | st.booleans() | st.none(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(WORDS, inner, max_size=3),
    max_leaves=6,
)
SEEDS = st.integers() | st.sampled_from([LARGEST_SEED, LARGEST_SEED + 1, LEAST_SEED, LEAST_SEED - 1, 2**64, 10**5000])


class _Counter(Callback):
    """Counts steps."""

    def __init__(self) -> None:
        self.steps = 0

    def on_step(self, run: Any, record: dict[str, Any]) -> None:
        del run, record
        self.steps += 1


def _problem(name: str, key: str = "colour") -> ur.Problem:
    truth = {key: np.array([0.3, 0.5])}
    renderer = AnalyticRenderer(
        truth, np.random.default_rng(0).uniform(0, 1, (12, 2)), 0.1, 0.1, shape=(2, 2), sensors=1
    )
    views = [ur.View(renderer.exact(truth))]
    return ur.Problem(renderer, [ur.Parameter(key, initial=0.4)], views, truth=truth, name=name)


def _holds(folder: Path, counter: _Counter, run: Callable[[], Any]) -> bool:
    """Whether the run was made; then its folder can be read. Else it was refused before its first step, and there is no run folder."""
    refused = False
    try:
        run()
    except InputError:
        refused = True
    if refused:
        assert counter.steps == 0, "refused after the work"
        assert not (folder / schema.RECORD).exists()
        return False
    found = reader.read(folder)
    assert found.record.status == "finished"
    assert method_file.read(folder / schema.METHOD).seed == found.record.seed
    return True


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], derandomize=True)
@given(name=WORDS, method=WORDS, command=WORDS, option=VALUES, reasons=st.lists(WORDS, max_size=2), seed=SEEDS)
@example(name="a", method="plain", command="unrender run 'a\udcff'", option=1, reasons=[], seed=0)
@example(name="a", method="plain", command="", option=1, reasons=[], seed=LARGEST_SEED + 1)
@example(name="a", method="plain", command="", option=float("nan"), reasons=[], seed=LEAST_SEED)
@example(name="a", method="plain", command="," * 300_000, option=1, reasons=[], seed=0)
def test_a_run_that_begins_can_be_read(
    tmp_path_factory: pytest.TempPathFactory,
    name: str,
    method: str,
    command: str,
    option: Any,
    reasons: list[str],
    seed: int,
) -> None:
    folder, counter = tmp_path_factory.mktemp("run") / "out", _Counter()
    notes = RunAnnotations(method, {"options": {"value": option}}, reasons, command)

    def run() -> None:
        problem = _problem(name)
        ur.optimize(
            problem, ur.PathGradient(), ur.optimizers.SGD(), 1, None, seed, [counter], folder, annotations=notes
        )

    _holds(folder, counter, run)


@pytest.mark.parametrize(
    "key", ["/etc/passwd", "a/../../b", "a\0b", "\udcff", "\\\\host", "a.npy", "file", "a b", "ü.x"]
)
def test_names_of_parameters_that_no_archive_gives_back_are_refused(key: str, tmp_path: Path) -> None:
    counter = _Counter()
    out = tmp_path / "out"

    def run() -> None:
        ur.optimize(
            _problem("a", key), ur.PathGradient(), ur.optimizers.SGD(), 1, callbacks=[counter], run_directory=out
        )

    made = _holds(out, counter, run)
    assert made == (key in ("a.npy", "a b", "ü.x", "file"))


def test_a_refused_run_leaves_the_earlier_one(tmp_path: Path) -> None:
    ur.optimize(_problem("first"), ur.PathGradient(), ur.optimizers.SGD(), 1, run_directory=tmp_path)
    notes = RunAnnotations(command="\udcff")
    with pytest.raises(InputError, match="not UTF-8"):
        ur.optimize(_problem("b"), ur.PathGradient(), ur.optimizers.SGD(), 1, run_directory=tmp_path, annotations=notes)
    assert reader.read(tmp_path).record.name == "first"


def test_a_warning_that_is_no_unicode_is_written(tmp_path: Path) -> None:
    class Warns(Callback):
        def on_step(self, run: Any, record: dict[str, Any]) -> None:
            run.warnings.append("photo \udcff")

    ur.optimize(_problem("a"), ur.PathGradient(), ur.optimizers.SGD(), 1, callbacks=[Warns()], run_directory=tmp_path)
    assert "photo \\udcff" in reader.read(tmp_path).record.warnings


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], derandomize=True)
@given(command=WORDS, value=WORDS, seed=st.integers(0))
def test_a_sweep_that_is_written_can_be_read(
    tmp_path_factory: pytest.TempPathFactory, command: str, value: str, seed: int
) -> None:
    folder = tmp_path_factory.mktemp("sweep")
    plan = SweepPlan.model_construct(
        problem="a", method="m", settings={"x": value}, over=[], search="grid", seed=seed, steps=1
    )
    record = SweepRecord.model_construct(command=command, plan=plan)
    try:
        write_sweep(folder, record)
    except InputError:
        assert not list(folder.iterdir())
        return
    assert read_sweep(folder).command == command


def test_a_seed_of_the_last_run_counts() -> None:
    from unrender.core.random import check_seed

    assert check_seed("--seed", LARGEST_SEED - 2, 3) == LARGEST_SEED - 2
    with pytest.raises(InputError, match=r"--seed: expected a whole number from -2\*\*63 to 2\*\*63 - 3"):
        check_seed("--seed", LARGEST_SEED - 1, 3)


def test_stages_of_a_name_that_is_no_unicode_are_refused(tmp_path: Path) -> None:
    stages = stages_file.Stages(
        Path("/tmp/\udcff.toml"), (stages_file.Stage("a", ("b",)),), "auto", {}, 1, None, 0, None
    )
    with pytest.raises(InputError, match="not UTF-8"):
        stages_file.write(stages, tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(sys.platform != "linux", reason="names of any bytes")
def test_every_record_goes_by_its_reader() -> None:
    """Planted: a record whose reader would refuse it is not written."""
    with pytest.raises(InputError, match=r"x: name: expected a valid string, got 3"):
        schema.encode(schema.RunRecord, {"name": 3, "method": ""}, "x")
    with pytest.raises(InputError, match="larger than 16 MiB"):
        schema.encode(schema.RunRecord, {"name": "n" * (17 << 20), "method": ""}, "x")
    assert json.loads(schema.encode(schema.RunRecord, {"name": "ü", "method": ""}, "x"))["name"] == "ü"
