"""Searches and their order, on errors that a formula gives."""

from __future__ import annotations

import json
import math
import random
import shlex
from pathlib import Path

import numpy as np
import pytest

from unrender.app.cli.sweep_driver import equally_good, run_command
from unrender.app.sweeps.record import (
    RunOutcome,
    Started,
    SweepPlan,
    SweepRecord,
    TrialRecord,
    Trials,
    best_folders,
    read_sweep,
    trial_record,
    watched_folders,
    write_sweep,
)
from unrender.app.sweeps.search import Axis, Grid, Random, Search, parse_axes
from unrender.core.errors import InputError
from unrender.methods import method

PLAIN = method("plain")


def axes(*given: str) -> tuple[Axis, ...]:
    return parse_axes(given, PLAIN)


# ---------------------------------------------------------------------- axes and searches


def test_a_grid_has_every_combination_once_the_last_axis_fastest() -> None:
    grid = Grid(axes("learning_rate=0.001:0.1:log:3", "spp=2:4", "schedule=none,cosine(300),steps(100, 0.5)"))
    found = [tuple(grid.ask(i).values()) for i in range(grid.trials)]
    assert len(set(found)) == 27
    assert found[0] == ("0.001", "2", "none")
    assert found[1] == ("0.001", "2", "cosine(300)")
    assert found[9] == ("0.01", "2", "none")
    assert found[-1] == ("0.1", "4", "steps(100, 0.5)")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("spp=2:16:log", [math.log((k + 0.5) / (k - 0.5)) / math.log(16.5 / 1.5) for k in range(2, 17)]),
        ("spp=2:5", [0.25] * 4),
        ("spp=2,4,8", [1 / 3] * 3),
    ],
)
def test_random_values_have_their_chances(text: str, expected: list[float]) -> None:
    count = 4000
    search = Random(axes(text), count, seed=3)
    drawn = [int(search.ask(i)["spp"]) for i in range(count)]
    frequencies = [drawn.count(value) / count for value in sorted(set(drawn))]
    errors = [math.sqrt(p * (1 - p) / count) for p in expected]
    assert np.all(np.abs(np.array(frequencies) - expected) < 4 * np.array(errors))


def test_random_numbers_are_even_in_the_logarithm_and_can_be_typed() -> None:
    search = Random(axes("learning_rate=0.001:1:log"), 2000, seed=1)
    drawn = [search.ask(i)["learning_rate"] for i in range(2000)]
    shares = (np.log10([float(text) for text in drawn]) + 3) / 3
    assert abs(shares.mean() - 0.5) < 4 / math.sqrt(12 * 2000)
    assert shares.min() >= 0
    assert shares.max() <= 1
    assert all(len(text.replace("0.", "").lstrip("0")) <= 4 for text in drawn)
    assert Random(axes("learning_rate=0.001:1:log"), 5, seed=1).ask(4)["learning_rate"] == drawn[4]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["spp"], "expected NAME=VALUE,VALUE"),
        (["spp=2,"], "a value is empty"),
        (["spp=2,2"], "2 is given twice"),
        (["spp=2,4", "spp=8"], "spp is given twice"),
        (["beta_1=0.1,0.2"], "fixed by --set"),
        (["spp=0:4"], "expected a whole number above 0"),
        (["spp=2:4.5"], "expected whole numbers"),
        (["learning_rate=1:0.1"], "the lower one first"),
        (["learning_rate=0.1:inf"], "two finite numbers"),
        (["learning_rate=-1:1:log"], "above 0"),
        (["learning_rate=0.1:1:log:3:4"], r"expected LOW:HIGH\[:log\]\[:POINTS\]"),
        (["learning_rate=0.1:1:0"], "from 1 to 10000 points"),
        (["lerning_rate=0.1:1"], "did you mean learning_rate"),
        (["one_rate=0:1"], "a number, one_rate is true or false"),
        ([], "nothing to vary"),
    ],
)
def test_axes_that_make_no_sense_are_one_line(given: list[str], message: str) -> None:
    with pytest.raises(InputError, match=message):
        parse_axes(given, PLAIN, ["beta_1"])


def test_values_from_python_are_taken_as_they_are() -> None:
    given = {"schedule": ["none", "steps(100, 0.5)"], "spp": [1, 4], "one_rate": [True, False], "beta_1": "0.1:0.9:3"}
    found = parse_axes(given, PLAIN)
    assert [axis.choices for axis in found[:3]] == [("none", "steps(100, 0.5)"), ("1", "4"), ("true", "false")]
    assert found == axes(*(f"{axis.name}={axis.text}" for axis in found))
    with pytest.raises(InputError, match="has a comma"):
        parse_axes({"schedule": ["none,none"]}, PLAIN)


def test_a_grid_without_points_or_too_large_is_refused() -> None:
    with pytest.raises(InputError, match="needs a number of points"):
        Grid(axes("learning_rate=0.1:1"))
    with pytest.raises(InputError, match="the grid has 1000000 points"):
        Grid(axes("learning_rate=0.1:1:1000", "beta_1=0.1:0.9:1000"))


# ---------------------------------------------------------------------- the order of trials


def error_of(settings: dict[str, str]) -> float:
    """Least at a learning rate of 0.03 and 5 samples."""
    rate, spp = float(settings["learning_rate"]), float(settings.get("spp", 5))
    return math.log10(rate / 0.03) ** 2 + 0.1 * math.log(spp / 5) ** 2


def carry_out(trials: Trials, workers: int, order: random.Random) -> list[tuple]:
    """As if `workers` finished in a random order; a trial in seven fails."""
    running: list[Started] = []
    while not trials.done:
        while len(running) < workers and (started := trials.next()) is not None:
            running.append(started)
        one = running.pop(order.randrange(len(running)))
        message = "lost" if one.number % 7 == 3 else ""
        runs = [] if message else [run(error=error_of(one.settings))]
        trials.end(trial_record(one.number, one.settings, runs, message=message))
    return [(t.settings, t.status, t.error) for _, t in sorted(trials.ended.items())]


def searches(kind: str) -> Search:
    space = axes("learning_rate=0.0003:3:log", "spp=2:16:log")
    if kind == "tpe":
        pytest.importorskip("optuna")
        from unrender.app.sweeps.search import TPE

        return TPE(space, 24, 5)
    return Random(space, 24, 5)


@pytest.mark.parametrize("kind", ["random", "tpe"])
def test_the_outcome_does_not_depend_on_workers_nor_on_who_is_first(kind: str) -> None:
    found = [
        carry_out(Trials(searches(kind), window=6), workers, random.Random(workers)) for workers in (1, 2, 3, 6, 20)
    ]
    assert all(one == found[0] for one in found)
    statuses = [status for _, status, _ in found[0]]
    assert {"finished", "failed"} == set(statuses)


def test_that_test_sees_a_search_that_learns_of_whatever_has_ended() -> None:
    class Eager(Trials):
        def end(self, record: TrialRecord) -> None:
            super().end(record)
            self.search.tell(record.number, record.error)

    one, other = (carry_out(Eager(searches("tpe"), 1000), n, random.Random(n)) for n in (1, 6))
    assert one != other


def test_a_sweep_taken_up_again_has_the_trials_it_would_have_had() -> None:
    whole = Trials(searches("tpe"), 4)
    expected = carry_out(whole, 2, random.Random(0))
    half = {n: t for n, t in whole.ended.items() if n < 9 or n == 10}
    again = Trials(searches("tpe"), 4, ended=half)
    assert carry_out(again, 3, random.Random(1)) == expected


def test_trials_of_other_settings_are_refused() -> None:
    trials = Trials(searches("random"), ended={0: trial_record(0, {"learning_rate": "0.5"}, [], message="x")})
    with pytest.raises(InputError, match="trial 0 was made with -s learning_rate=0"):
        trials.next()


def best(kind: str) -> float:
    return min(e for _, _, e in carry_out(Trials(searches(kind)), 1, random.Random(0)) if e is not None)


def test_tpe_finds_more_than_random_settings_do() -> None:
    assert best("tpe") < best("random")


# ---------------------------------------------------------------------- records


def run(**given: object) -> RunOutcome:
    return RunOutcome.model_validate({"folder": "f", "seed": 0, "status": "finished", **given})


def test_a_trial_is_the_mean_over_its_seeds() -> None:
    trial = trial_record(0, {"spp": "2"}, [run(error=1.0), run(error=2.0), run(error=6.0)])
    assert (trial.status, trial.error) == ("finished", 3.0)
    assert trial.standard_error == pytest.approx(np.std([1, 2, 6], ddof=1) / math.sqrt(3))
    assert trial_record(0, {}, [run(error=1.0), run(error=None)]).status == "failed"
    assert trial_record(0, {}, [run(error=1.0, status="failed")]).status == "failed"
    assert trial_record(0, {"schedule": "cosine(300)"}, []).line == "-s 'schedule=cosine(300)'"


def test_a_record_is_read_as_it_was_written_and_a_malformed_one_is_one_line(tmp_path: Path) -> None:
    plan = SweepPlan(problem="quad", method="plain", over=["spp=2,4"], search="grid", trials=2, seed=5, seeds=2)
    record = SweepRecord(plan=plan, trials=[trial_record(1, {"spp": "2"}, [run(error=1.0)])])
    write_sweep(tmp_path, record)
    assert read_sweep(tmp_path) == record
    folder = tmp_path.name
    assert [str(path.relative_to(tmp_path.parent)) for path in watched_folders(tmp_path)] == [
        f"{folder}/trial-{i:03d}-seed{seed}" for i in range(2) for seed in (5, 6)
    ]
    assert watched_folders(tmp_path / "trial-000-seed5") == [tmp_path / "trial-000-seed5"]
    assert best_folders(tmp_path, record) == [tmp_path / "f"]
    given = json.loads((tmp_path / "sweep.json").read_text())
    for change, message in [
        ({"plan": 3}, "plan"),
        ({"trials": given["trials"] * 2}, "ascending numbers"),
        ({"format": 2}, "format"),
        ({"trials": [{**given["trials"][0], "error": "much"}]}, "trials.0.error"),
        (
            {"trials": [{**given["trials"][0], "runs": [{"folder": "..", "seed": 0, "status": "failed"}]}]},
            "folder",
        ),
    ]:
        (tmp_path / "sweep.json").write_text(json.dumps({**given, **change}))
        with pytest.raises(InputError, match=message):
            read_sweep(tmp_path)
    (tmp_path / "sweep.json").unlink()
    with pytest.raises(InputError, match="holds no sweep"):
        read_sweep(tmp_path)


def test_trials_that_noise_may_have_put_behind_the_best_are_named() -> None:
    def trial(number: int, error: float, standard_error: float | None) -> TrialRecord:
        return TrialRecord(
            number=number, settings={}, status="finished", runs=[], error=error, standard_error=standard_error
        )

    plan = SweepPlan(problem="quad", method="plain", over=["spp=2,4"], search="grid", trials=4, seed=5, seeds=1)
    noisy = [trial(0, 0.9, 0.3), trial(1, 0.5, 0.3), trial(2, 1.5, 0.3), trial(3, 0.5, None)]
    assert equally_good(SweepRecord(plan=plan, trials=noisy, best=1)) == [0, 3]
    exact = [trial(0, 0.9, None), trial(1, 0.5, None)]
    assert equally_good(SweepRecord(plan=plan, trials=exact, best=1)) == []
    assert equally_good(SweepRecord(plan=plan, trials=exact)) == []


def test_equal_trials_of_few_seeds_are_named_nineteen_times_in_twenty() -> None:
    """Two standard errors of two seeds each would name four in five."""
    plan = SweepPlan(problem="quad", method="plain", over=["spp=2,4"], search="grid", trials=2, seed=0, seeds=2)
    errors, named = np.random.default_rng(3).normal(1.0, 0.1, (1000, 2, 2)), 0
    for pair in errors:
        made = [
            trial_record(
                n, {}, [RunOutcome(folder=f"f{n}{s}", seed=s, status="finished", error=e) for s, e in enumerate(of)]
            )
            for n, of in enumerate(pair)
        ]
        best = min(made, key=lambda one: one.error or 0.0).number
        named += len(equally_good(SweepRecord(plan=plan, trials=made, best=best)))
    assert named / len(errors) > 0.935  # Welch's test names somewhat more than 0.95, whose standard error is 0.007


def test_the_command_of_the_best_trial_repeats_its_first_run() -> None:
    """All that a run depends on is named, unless it is the command's default."""
    plan = SweepPlan(problem="quad", method="plain", over=["spp=2,4"], search="grid", trials=2, steps=20)
    record = SweepRecord(plan=plan, best_line="-s spp=4")
    assert run_command(record) == "unrender run quad --method plain --steps 20 -s spp=4"
    other = plan.model_copy(update={"seed": 5, "final_spp": 8, "variant": "llvm_ad_rgb", "settings": {"loss": "L1 x"}})
    words = shlex.split(run_command(record.model_copy(update={"plan": other})))
    assert words[5:] == [
        "-s",
        "loss=L1 x",
        "--steps",
        "20",
        "--seed",
        "5",
        "--final-spp",
        "8",
        "--variant",
        "llvm_ad_rgb",
        "-s",
        "spp=4",
    ]


@pytest.mark.mitsuba
@pytest.mark.parametrize(
    ("runs", "status"),
    [
        ({"finished": ""}, 0),
        ({"finished": "", "does not fit": ""}, 0),
        ({"does not fit": ""}, 5),
        ({"worse than start": ""}, 5),
        ({"failed": "non-finite", "memory disagrees": ""}, 4),
        ({"interrupted": "interrupted", "does not fit": ""}, 130),
    ],
)
def test_a_comparison_has_the_exit_status_of_its_worst_run(runs: dict[str, str], status: int) -> None:
    from unrender.app.cli.compare import status_of

    assert status_of([run(status=of, stopped=why) for of, why in runs.items()]) == status
