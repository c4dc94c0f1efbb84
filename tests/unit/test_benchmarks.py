"""The benchmarks' runner, without rendering: folders, options, records, turns, the results page."""

from __future__ import annotations

import argparse
import importlib
import inspect
import itertools
import json
import math
import re
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import figures, markdown
from benchmarks.runner import cli, records, results_page
from benchmarks.runner.catalogue import ROOT, Benchmark, benchmarks
from benchmarks.runner.machine import Load
from benchmarks.runner.options import add_options, defaults
from benchmarks.runner.timing import turns

ALL = benchmarks()
LONGEST_NOTES = 40
"""Lines of notes without the commands of the paper's figures."""
TOY = ["--seeds", "2", "--tuning-seeds", "1", "--steps", "3", "5", "--rates", "1"]


@pytest.fixture(params=ALL)
def benchmark(request: pytest.FixtureRequest) -> Benchmark:
    if request.param == "higher_order.networks":
        pytest.importorskip("torch")
    return ALL[request.param]


def test_every_benchmark_is_whole_and_its_toy_sizes_are_options(benchmark: Benchmark) -> None:
    run = benchmark.module
    assert benchmark.summary
    assert benchmark.summary
    assert set(run.QUICK) <= set(inspect.signature(run.run).parameters)
    parser = argparse.ArgumentParser()
    names = add_options(parser, run.run)
    without_default = set(names) - set(defaults(run.run))
    assert not vars(parser.parse_args(["."] * len(without_default))).keys() - without_default


def test_commands_of_figures_are_parsed(benchmark: Benchmark) -> None:
    """Option names and choices: a method that no option names could not be run again."""
    parser = argparse.ArgumentParser(exit_on_error=False)
    parser.add_argument("--plots-only", action="store_true")
    add_options(parser, benchmark.module.run)
    notes = (benchmark.folder / "notes.md").read_text()
    for arguments in re.findall(
        rf"^- .*: `python -m benchmarks {re.escape(benchmark.name)}(.*)`$", notes, re.MULTILINE
    ):
        parser.parse_args(shlex.split(arguments))


def test_notes_are_dated_by_the_figures_they_speak_of(benchmark: Benchmark) -> None:
    record = records.read(benchmark.folder)
    _, notes = results_page.split_notes(benchmark)
    assert record is not None
    assert re.findall(r"^Findings on the figures of (\d{4}-\d\d-\d\d)\.$", notes, flags=re.MULTILINE) == [
        record["date"]
    ]
    assert record["command"].startswith(f"python -m benchmarks {benchmark.name}")


def test_notes_are_short(benchmark: Benchmark) -> None:
    notes, heading, commands = (
        (benchmark.folder / "notes.md").read_text().partition("\nCommands of the paper's figures:\n")
    )
    assert len(notes.splitlines()) <= LONGEST_NOTES
    listed = [line for line in commands.splitlines() if line]
    assert all(re.fullmatch(r"- .*: `python -m benchmarks .*`", line) for line in listed)
    assert bool(listed) == bool(heading)


def test_every_benchmark_has_a_page(tmp_path: Path) -> None:
    index = results_page.write_pages(tmp_path, figures=False).read_text()
    for name, each in ALL.items():
        page = (tmp_path / f"{name}.md").read_text()
        assert page.startswith(f"# {results_page.split_notes(each)[0]}\n")
        assert f"\n{name}\n" in index
    assert {page.stem for page in tmp_path.glob("*.md")} == {*ALL, "index", "baselines"}


@pytest.mark.slow
def test_every_figure_is_drawn_from_its_record(benchmark: Benchmark, tmp_path: Path) -> None:
    record = records.read(benchmark.folder)
    assert record is not None
    assert cli.draw(benchmark, record, tmp_path / "figure.png") == (benchmark.plot is not None)


def test_a_record_of_races_at_equal_steps_alone_has_a_table_and_a_figure() -> None:
    """Each denoised row names its denoiser."""
    benchmark = ALL["rcv.fig9_reconstruction"]
    record = records.read(benchmark.folder)
    assert record is not None
    del record["entries"]
    rows = [row for row in benchmark.table(record).splitlines() if "denoised" in row]
    assert len(rows) == 6
    assert all("denoised by oidn" in row for row in rows)
    assert benchmark.plot is not None
    assert len(benchmark.plot(record).axes) == len(record["equal steps"])


def test_templates_take_entries_of_records() -> None:
    entry = {
        "name": "a",
        "runs": [[1.0, 2.0], [3.0, 4.5]],
        "final": {"both": [0.5, 0.25, 1.0]},
        "ends": [3.0, 1.0, 2.0],
    }
    assert markdown.fill("{name}: {runs[-1][1]:g}, {final[both]!m}", entry) == "a: 4.5, 0.500 (0.250 to 1.000)"
    assert markdown.fill("{ends!v} {spp} {runs!n}", entry, {"spp": 4}) == "2.000 (1.000 to 3.000) 4 2"
    with pytest.raises(KeyError):
        markdown.fill("{rate}", entry)


def test_entries_have_the_keys_on_the_way() -> None:
    record = {"x": {"spp": 2, "methods": {"a": {"rate": 1}, "b": {"rate": 3}}}}
    rows = list(markdown.named(record, "task", "methods", "method"))
    assert [(row["task"], row["method"], row["rate"], row["spp"]) for row in rows] == [
        ("x", "a", 1, 2),
        ("x", "b", 3, 2),
    ]
    assert list(markdown.named({"u": {"v": {"n": 1}}}, "one", "", "two")) == [{"n": 1, "two": "v", "one": "u"}]
    table = markdown.records("task | rate", "{task}, {method} | {rate:g}", rows)
    assert table.splitlines() == ["| task | rate |", "|---|---|", "| x, a | 1 |", "| x, b | 3 |"]


def test_a_goal_that_a_run_never_reached_counts_as_zero_in_the_paper_s_means_alone() -> None:
    run = importlib.import_module("benchmarks.higher_order.table2.run")
    times = np.array([[1.0, 1.0, math.inf], [3.0, math.inf, math.inf], [8.0, 2.0, math.inf]])
    np.testing.assert_array_equal(run.mean_times(times), [4.0, 1.0, math.inf])
    np.testing.assert_array_equal(run.median_times(times), [3.0, 2.0, math.inf])
    assert run.median_times(times[:2])[1] == math.inf, "half of the runs are too few"


def test_the_paper_s_goals_are_squared_errors_of_single_steps() -> None:
    descents = importlib.import_module("benchmarks.higher_order.table2.descents")
    errors = np.array([1.0, 0.31, 0.5, *np.full(30, 0.09)])
    found = descents.Descent(np.arange(33.0), errors, np.full(33, np.nan), 1.0, np.zeros(1))
    assert found.reached("squared") == [1.0, 3.0, math.inf]
    assert found.reached("parameter") == [12.0, math.inf, math.inf], "means over ten steps"


def test_every_configuration_of_table_2_can_be_made() -> None:
    """A race of hours must not end at an option that the library refuses. OurGN has none of its own, and renders to be made."""
    methods, tasks = (
        importlib.import_module(f"benchmarks.higher_order.table2.{name}") for name in ("methods", "tasks")
    )
    chosen = methods.METHODS.keys() - {"OurGN"}
    for (name, task), method in itertools.product(tasks.TASKS.items(), chosen):
        for config in methods.configurations(name, method):
            methods.METHODS[method].make(task, 1024 if name == "TEXTURE" else 3, config)


def test_curves_show_the_median_and_the_range_of_runs() -> None:
    runs = [([0.0, 1.0], [level, level]) for level in (1.0, 2.0, 4.0)]
    figure = figures.curves({"left": {"a": runs}, "empty": {}}, "seconds")
    (axis,) = figure.axes
    assert np.array_equal(np.asarray(axis.lines[0].get_ydata()), [2.0, 2.0])
    (patch,) = axis.collections
    heights = np.asarray(patch.get_paths()[0].vertices)[:, 1]
    assert (heights.min(), heights.max()) == (1.0, 4.0)


def test_a_record_keeps_six_digits_and_reads_back(tmp_path: Path) -> None:
    points = [[0.1, 123456.789], [2.0, 1e-9]]
    records.write(tmp_path, {"runs": {"a": points, "b": [[[1, 2.5]]]}, "note": "x" * 200, "none": None})
    record = records.read(tmp_path)
    assert record is not None
    assert record["runs"] == {"a": [[0.1, 123457.0], [2.0, 1e-9]], "b": [[[1, 2.5]]]}
    assert record["note"] == "x" * 200
    assert record["none"] is None


def test_nothing_is_added_to_the_search_path() -> None:
    for file in (ROOT / "benchmarks").rglob("*.py"):
        assert "sys.path" not in file.read_text(), file


def example(
    folder: Path,
    scene: tuple[str, ...] = ("a", "b"),
    sizes: tuple[int, ...] = (1, 2),
    only: tuple[str, ...] = (),
    seconds: float | None = None,
    fast: bool = False,
) -> None:
    """An example.

    Args:
        folder: where
        seconds: budget
            of a run
    """


def parse(*words: str) -> dict[str, Any]:
    parser = argparse.ArgumentParser()
    add_options(parser, example)
    return vars(parser.parse_args(words))


def test_options_have_the_parameters_types() -> None:
    words = ["here", "--sizes", "3", "4", "--seconds", "2", "--fast", "--only", "x", "--scene", "b"]
    expected = {"sizes": [3, 4], "seconds": 2.0, "fast": True, "only": ["x"], "scene": ["b"]}
    assert parse(*words) == {"folder": Path("here"), **expected}
    assert parse("here") == {"folder": Path("here")}


def test_options_refuse_what_is_no_choice(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        parse("here", "--scene", "c")
    assert "'c'" in capsys.readouterr().err


def test_help_tells_what_the_docstring_says() -> None:
    parser = argparse.ArgumentParser()
    add_options(parser, example)
    assert "budget of a run" in parser.format_help()


def test_merge_keeps_what_was_not_measured_again() -> None:
    old = {"date": "1", "tasks": {"a": {"spp": 2, "methods": {"x": 1, "y": 2}}, "b": {"spp": 2, "methods": {"x": 3}}}}
    new = {"date": "2", "tasks": {"a": {"spp": 2, "methods": {"y": 5}}}}
    merged = records.merge(old, new, ["tasks", "*", "methods"])
    assert merged == {
        "date": "2",
        "tasks": {"a": {"spp": 2, "methods": {"x": 1, "y": 5}}, "b": {"spp": 2, "methods": {"x": 3}}},
    }


def test_merge_drops_what_was_measured_under_other_conditions() -> None:
    old = {"tasks": {"a": {"spp": 2, "methods": {"x": 1}}}}
    new = {"tasks": {"a": {"spp": 4, "methods": {"y": 5}}}}
    assert records.merge(old, new, ["tasks", "*", "methods"]) == new


def test_merge_takes_tuples_for_the_lists_that_json_makes_of_them() -> None:
    old = json.loads(json.dumps({"tasks": {"a": {"steps": (1, 2), "methods": {"x": 1}}}}))
    new = {"tasks": {"a": {"steps": (1, 2), "methods": {"y": 5}}}}
    assert records.merge(old, new, ["tasks", "*", "methods"])["tasks"]["a"]["methods"] == {"x": 1, "y": 5}


def test_merge_keeps_a_part_that_the_new_record_lacks() -> None:
    old, new = {"cost": {"32": 1}, "variance": {"a": 2}}, {"variance": {"b": 3}}
    assert records.merge(old, new, ["cost"]) == {"cost": {"32": 1}, "variance": {"b": 3}}
    assert records.merge(old, new, ["variance"]) == {"variance": {"a": 2, "b": 3}}


def test_contenders_are_timed_in_turns() -> None:
    calls: list[tuple[str, int]] = []
    times = turns({"a": lambda n: calls.append(("a", n)), "b": lambda n: calls.append(("b", n))}, repeats=2, warm=1)
    assert calls == [("a", 0), ("b", 0), ("a", 1), ("b", 1), ("a", 2), ("b", 2)]
    assert {name: len(found) for name, found in times.items()} == {"a": 2, "b": 2}


def test_the_load_of_others_is_a_share() -> None:
    after = Load(moment=0.01).after()
    assert {"before", "during", "average_after"} == set(after)
    assert after["during"] is None or after["during"] >= 0


def test_a_benchmark_from_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["meta.fig2_exponential", *TOY, "--out", str(tmp_path)]) == 0
    record = records.read(tmp_path)
    assert record is not None
    assert {"command", "date", "hardware", "versions", "load", "settings", "methods"} <= set(record)
    assert record["settings"] == {"seeds": 2, "tuning_seeds": 1, "steps": [3, 5], "rates": 1}
    assert "| coupled |" in capsys.readouterr().out
    (tmp_path / "figure.png").unlink()
    before = (tmp_path / "results.json").read_bytes()
    assert cli.main(["meta.fig2_exponential", "--plots-only", "--out", str(tmp_path)]) == 0
    assert (tmp_path / "figure.png").is_file()
    assert (tmp_path / "results.json").read_bytes() == before


def test_the_list_has_a_line_each(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([]) == 0
    lines = capsys.readouterr().out.splitlines()
    for name in ALL:
        assert sum(line.startswith(f"{name} ") for line in lines) == 1


def test_an_unknown_benchmark_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["rcv.fig99"]) == 2
    assert capsys.readouterr().err == "no benchmark 'rcv.fig99'; python -m benchmarks lists them\n"
