"""docs/papers.md and EQUATIONS.md have every equation, figure and table of the papers, and their files, names and numbers exist."""

from __future__ import annotations

import ast
import functools
import itertools
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from benchmarks.runner.catalogue import ROOT, benchmarks
from benchmarks.runner.results_page import section as section_of

pytestmark = pytest.mark.mitsuba  # tables of some benchmarks name problems of the gallery
KNOWN = benchmarks()
PAGE = "".join((ROOT / name).read_text(encoding="utf-8") for name in ("src/unrender/EQUATIONS.md", "docs/papers.md"))
BASELINES = (ROOT / "benchmarks" / "runner" / "baselines.md").read_text(encoding="utf-8")
NOTES = "".join(f"# {name}\n{(each.folder / 'notes.md').read_text(encoding='utf-8')}\n" for name, each in KNOWN.items())
"""The notes of all benchmarks, each under its name."""
COMMAND = re.compile(r"^- (.*?): (`python -m benchmarks ([\w.]+).*`)$", re.MULTILINE)
"""A figure, and a command that made it."""
LONGEST_CELL = 120
"""Characters of a cell of a figure or a goal."""
MOST_SHORT = 10
"""Figures that may be short."""
TABLE_2 = ("QUAD", "BOX2", "BOX10", "MUG", "SHADOW", "BUNNY", "TEXTURE", "CNN", "CNN5")
PAPERS: dict[str, tuple[int, list[str]]] = {
    "Recursive control variates": (
        20,
        [
            *(f"Fig. {n}" for n in range(1, 9)),
            *("Fig. 9, L1 and L2", "Fig. 9, tea", "Fig. 9, denoised"),
            *(f"Fig. {n}" for n in range(10, 13)),
            *("Sec. 7, heuristic weights", "Suppl., image viewer"),
        ],
    ),
    "Meta-estimation": (21, [*(f"Fig. {n}" for n in range(1, 10)), "Sec. 7, differences"]),
    "Smoothed derivatives": (
        23,
        [
            *(f"Fig. {n}" for n in range(1, 5)),
            *("Fig. 5, SUZANNE", "Fig. 5, BANANA", "Table 1", "Table 2, all"),
            *(f"Table 2, {task}" for task in TABLE_2),
            *("Table 2, convergence plots", "Suppl. Secs A to D", "Suppl. Sec. H", "Suppl. Sec. J"),
            *("Suppl., L-BFGS", "Suppl., rendering noise", "Suppl., starts and outcomes"),
        ],
    ),
    "Adaptive pixel sampling": (
        20,
        [
            *(f"Fig. {n}" for n in range(1, 8)),
            *(f"Fig. 8, {scene}" for scene in ("DODOCO", "POTTERY", "EARTH2MARS", "SMOKE")),
            *(f"Fig. 9, {scene}" for scene in ("EARTH", "DODOCOA", "BOWL", "LEGO", "DODOCOB", "KIRBY")),
            "Suppl., animations",
        ],
    ),
}
"""Of each paper: how many numbered equations it has, and its figures and tables, in parts where a figure has several tasks, with
what the text says of the supplement or finds in a section."""
VERDICT = re.compile(r"(met|beyond|short because|not comparable because|not run because)\b")
NUMBER = r"[-+]?\d+(?:\.\d+)?(?:e-?\d+)?"
WITH_SPREAD = rf"(?: ± {NUMBER}| \({NUMBER}(?: to {NUMBER})?\))"
OF_EVERY_BENCHMARK = {"quick", "plots_only", "out"}
TUNING_SEEDS = {"meta.fig2_exponential": 16, "higher_order.table2": 3}
"""Where it is not one."""


def section(page: str, title: str) -> str:
    """The text of all sections of a title."""
    return "\n".join(re.findall(rf"^## {title}\n(.*?)(?=^## |\Z)", page, re.MULTILINE | re.DOTALL))


def rows(text: str, cells: int) -> Iterator[list[str]]:
    """The rows of all tables of so many columns, without their heads."""
    lines = [line[2:-2].split(" | ") for line in text.splitlines() if line.startswith("| ")]
    return (row for row in lines if len(row) == cells and row[0] not in ("equation", "figure", "goal"))


def numbers_of(equation: str) -> list[int]:
    """ "6, 7, 9" or "15 to 20, listings 1, 2" or "sec. 3.5"."""
    found: list[int] = []
    for part in re.split(r", (?=\d)", re.sub(r",? ?\b(listing|sec|suppl|algorithm).*", "", equation)):
        first, _, last = part.partition(" to ")
        found += range(int(first), int(last or first) + 1) if first else []
    return found


def left_out(page: str) -> Iterator[str]:
    """Equations, figures and tables that have no row, or more than one, or that no paper has."""
    for title, (equations, figures) in PAPERS.items():
        text = section(page, title)
        found = sorted(number for row in rows(text, 3) for number in numbers_of(row[0]))
        if found != [*range(1, equations + 1)]:
            yield f"{title}: equations {found}"
        if [row[0] for row in rows(text, 5)] != figures:
            yield f"{title}: figures {sorted({row[0] for row in rows(text, 5)} ^ set(figures)) or 'in another order'}"


@functools.cache
def defined(file: Path) -> set[str]:
    """Functions, classes and methods of a file, without importing it."""
    found: set[str] = set()
    for node in ast.parse(file.read_text(encoding="utf-8")).body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            found.add(node.name)
            found |= {f"{node.name}.{each.name}" for each in node.body if isinstance(each, ast.FunctionDef)}
    return found


def wrong_names(page: str) -> Iterator[str]:
    """Files that are not there, and names that they do not define: "`a/b.py`: `f`, `C.g`"."""
    for path, names in re.findall(r"`([\w/]+\.py)`((?:[:,] `[\w.]+`(?!:))*)", page):
        file = next((each for each in (ROOT / "src/unrender" / path, ROOT / path) if each.is_file()), None)
        if file is None:
            yield f"no file {path}"
            continue
        yield from (f"no {name} in {path}" for name in re.findall(r"`([\w.]+)`", names) if name not in defined(file))
    for title in PAPERS:
        for row in rows(section(page, title), 3):
            if not row[2].startswith("none: ") and not re.search(r"`[\w/]+\.py`: `", row[2]):
                yield f"{title}, equation {row[0]}: neither a file and a name nor a reason"


def links(cell: str) -> list[str]:
    """The benchmarks that a cell links to."""
    return re.findall(r"\[([\w.]+)\]", cell)


def commands(text: str) -> list[tuple[str, list[str]]]:
    """Each benchmark that a command runs, with the options it gives."""
    found = re.findall(r"`python -m benchmarks ([\w.]+)([^`]*)`", text)
    return [(name, [o.replace("-", "_") for o in re.findall(r"--([\w-]+)", rest)]) for name, rest in found]


@functools.cache
def options_of(name: str) -> set[str]:
    """What a benchmark's `run` takes, without importing it."""
    tree = ast.parse((KNOWN[name].folder / "run.py").read_text(encoding="utf-8"))
    run = next(node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name == "run")
    return {each.arg for each in run.args.args} | OF_EVERY_BENCHMARK


def wrong_commands(notes: str) -> Iterator[str]:
    """Commands of figures: of a benchmark whose notes they are not in, or that no figure's row names, or with unknown options."""
    linked = {(row[0], name) for _, row in figures_of(PAGE) for name in links(row[3])}
    for own, text in re.findall(r"^# ([\w.]+)\n((?:(?!# [\w.]+\n).*\n)*)", notes, re.MULTILINE):
        for figure, command, name in COMMAND.findall(text):
            if name != own or (figure, name) not in linked:
                yield f"{own}, {figure}: a command of {name}, which its row does not name"
            for _, options in commands(command):
                unknown = sorted(set(options) - options_of(own))
                yield from (f"{name} has no option {option}" for option in unknown)


def unknown_benchmarks(page: str) -> Iterator[str]:
    """Benchmarks that the page names and that the catalogue does not have."""
    named = [name for _, row in figures_of(page) for name in links(row[3])]
    named += re.findall(r"[`\[]((?:rcv|meta|higher_order|adaptive|volumes)\.\w+)[`\]]", page)
    yield from (f"no benchmark {name}" for name in named if name not in KNOWN)


def wrong_verdicts(page: str) -> Iterator[str]:
    """Verdicts of other words, and those that do not go with whether there is a command."""
    for title, row in figures_of(page):
        verdict = VERDICT.match(row[4])
        if (
            verdict is None
            or (verdict[0] == "not run because") != (row[3] == "—")
            or bool(links(row[3])) == (row[3] == "—")
        ):
            yield f"{title}, {row[0]}: {row[3]}: {row[4]}"


def figures_of(page: str) -> Iterator[tuple[str, list[str]]]:
    """(paper, row) of all figures and tables."""
    return ((title, row) for title in PAPERS for row in rows(section(page, title), 5))


@functools.cache
def numbers(text: str) -> frozenset[str]:
    """As they are written, with their signs, alone and with the spread or the range behind them; not those in names (L2, Eq. 5)."""
    text = re.sub(r"\b(Eq|Fig|Sec|Table)s?\.? \d+(, \d+)*( (and|to) \d+)?", "", text)
    return frozenset(re.findall(rf"(?<![\w.]){NUMBER}", text) + re.findall(rf"(?<![\w.]){NUMBER}{WITH_SPREAD}", text))


@functools.cache
def results() -> dict[str, str]:
    """The page of each benchmark that has a record."""
    pages = {name: section_of(each) for name, each in KNOWN.items()}
    return {name: COMMAND.sub("", text) for name, text in pages.items() if text is not None}


def wrong_numbers(page: str) -> Iterator[str]:
    """Numbers given as ours that the results of the row's benchmark do not have; a verdict may repeat the paper's."""
    for title, row in figures_of(page):
        known = frozenset[str]().union(*(numbers(results()[name]) for name in links(row[3]) if name in results()))
        given = (numbers(row[2]) - known) | (numbers(row[4]) - known - numbers(row[1]) - numbers(row[0]))
        if given and row[3] != "—":
            yield f"{title}, {row[0]}: not in the results: {sorted(given)}"


def wrong_goals(page: str) -> Iterator[str]:
    """Goals not reached of which fewer than three things were tried, or whose numbers the results of the benchmarks named do not have."""
    for goal, here, tried, reason, record in rows(section(page, "Goals that were not reached"), 5):
        if len(re.split("[;,] ", tried)) < 3 or not reason:
            yield f"{goal}: three attempts and why they fail"
        known = frozenset[str]().union(*(numbers(results()[name]) for name in re.findall(r"`([\w.]+)`", record)))
        if given := numbers(here) - known:
            yield f"{goal}: not in the results: {sorted(given)}"


def wrong_rules(page: str) -> Iterator[str]:
    """Ratios of HO Table 2 that are not in the table of the rule that the page gives them by: the paper's goals and convention, or ours."""
    ours, _, papers = (
        numbers(part) for part in re.split(r"By (?:our|the paper's) goals.*\n", results()["higher_order.table2"])[-3:]
    )
    for figure, given, record in [(row[0], row[2], row[3]) for _, row in figures_of(page)] + [
        (row[0], row[1], row[4]) for row in rows(section(page, "Goals that were not reached"), 5)
    ]:
        if record.strip("[]`") == "higher_order.table2":
            for rule, text in re.findall(r"at (the paper's goals|ours) ((?:(?!at ours|with pub|; |by med).)+)", given):
                wrong = numbers(text) - (ours if rule == "ours" else papers)
                yield from (f"{figure}: not by {rule}: {number}" for number in sorted(wrong))


def long_cells(page: str) -> Iterator[str]:
    """Cells of figures and goals that are too long to read in a table."""
    for row in [row for _, row in figures_of(page)] + [*rows(section(page, "Goals that were not reached"), 5)]:
        yield from (f"{row[0]}: {len(cell)} characters" for cell in row if len(cell) > LONGEST_CELL)


def configurations(entrant: dict[str, Any]) -> int:
    """How many were tried, on short runs or, of `meta.at_length`, on whole ones."""
    whole = {f"{each['rate']:.2g}" for each in entrant.get("whole", ())}
    return len(entrant["tried"]) + len(whole - {f"{each['rate']:.2g}" for each in entrant["tried"] if "rate" in each})


@functools.cache
def baselines() -> list[str]:
    """The rows of the table of baselines that the records ask for, as regular expressions."""
    found = []
    for name in sorted(set(re.findall(r"^\| `([\w.]+)` \|", BASELINES, re.MULTILINE))):
        record = json.loads((KNOWN[name].folder / "results.json").read_text())
        tasks = next(
            (record[key] for key in ("entries", "tasks", "budgets", "schedules") if key in record), {None: record}
        )
        for task, entry in tasks.items():
            tried = "; ".join(f"{method}: {configurations(each) or '—'}" for method, each in entry["methods"].items())
            cells = [
                f"`{re.escape(name)}`",
                re.escape(task) if task else r"[\w-]+",
                re.escape(tried),
                str(seeds(name, task)),
            ]
            found.append(r"^\| " + r" \| ".join(cells) + r" \|")
    return found


def seeds(name: str, task: str | None) -> int:
    """Tuning seeds of a task."""
    exceptions = {("meta.equal_time", "spiral"): 3, ("higher_order.table2", "TEXTURE"): 1}
    return exceptions.get((name, task or ""), TUNING_SEEDS.get(name, 1))


def wrong_baselines(table: str) -> Iterator[str]:
    """Rows that differ from the records, or are too few or too many."""
    yield from (f"baselines: no row {row}" for row in baselines() if not re.search(row, table, re.MULTILINE))
    if table.count("\n| `") != len(baselines()):
        yield f"baselines: {len(baselines())} rows expected"


CHECKS = (
    left_out,
    wrong_names,
    unknown_benchmarks,
    wrong_verdicts,
    wrong_numbers,
    wrong_goals,
    wrong_rules,
    long_cells,
)


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
def test_the_page_is_true(check: Any) -> None:
    assert not list(check(PAGE))


def test_few_figures_are_short() -> None:
    """A figure that falls short of the paper's again must be seen."""
    assert sum(row[4].startswith("short because") for _, row in figures_of(PAGE)) <= MOST_SHORT


def test_the_commands_of_figures_are_those_of_their_benchmarks() -> None:
    assert not list(wrong_commands(NOTES))
    assert len(COMMAND.findall(NOTES)) > 40


def test_the_baselines_are_those_of_the_records() -> None:
    assert not list(wrong_baselines(BASELINES))


@pytest.mark.parametrize(
    ("check", "old", "new", "message"),
    [
        (left_out, "| 12, 13 |", "| 12 |", "Recursive control variates: equations"),
        (left_out, "| 18 to 20 |", "| 18 to 21 |", "Meta-estimation: equations"),
        (left_out, "| Fig. 6 | with differential", "| Fig. 4 | with differential", "['Fig. 6']"),
        (left_out, "| Table 2, CNN5 |", "| Table 2, CNN6 |", "Table 2, CNN5"),
        (wrong_names, "`statistics/welford.py`: `update`", "`statistics/wellford.py`: `update`", "no file"),
        (wrong_names, "`optimal_alpha`", "`best_alpha`", "no best_alpha"),
        (wrong_names, "`RenderSession.tangent_moment`", "`RenderSession.moment`", "no RenderSession.moment"),
        (wrong_names, "`update`, `covariance`", "`update`, `variance`", "no variance"),
        (wrong_names, "none: the paper sets it aside", "the paper sets it aside", "equation 9"),
        (unknown_benchmarks, "| [rcv.fig4_order] |", "| [rcv.fig4] |", "no benchmark rcv.fig4"),
        (wrong_commands, "--steps 400 --seeds 3", "--step 400", "no option step"),
        (wrong_commands, "- Fig. 5: `python -m benchmarks volumes", "- Fig. 2: `python -m benchmarks volumes", "does not name"),
        (unknown_benchmarks, "`higher_order.table2`", "`higher_order.table3`", "no benchmark higher_order.table3"),
        (unknown_benchmarks, "[adaptive.over_uniform]", "[adaptive.over]", "no benchmark adaptive.over"),
        (long_cells, "| beyond |", f"| beyond {'.' * 120} |", "Fig. 8: 127 characters"),
        (wrong_verdicts, "| beyond |", "| fine |", "Fig. 8"),
        (wrong_verdicts, "not run because they are not in the paper", "met, not in the paper", "Suppl., animations"),
        (wrong_verdicts, "| met, on another scene |", "| not run because of time |", "Fig. 7"),
        (wrong_numbers, "at ours 2.14 ± 0.20 (1.82)", "at ours 2.14 ± 0.20 (9.99)", "Table 2, all: not in the results: ['9.99']"),
        (wrong_numbers, "L1's derivative -47.1%", "L1's derivative +47.1%", "['+47.1']"),
        (wrong_numbers, "with L1 stock ends at 1.93", "with L1 stock ends at 1.98", "['1.98']"),
        (wrong_goals, "5.07 on `ajar`", "59.07 on `ajar`", "['59.07']"),
        (wrong_goals, "more paths behind the maps; a smaller uniform share; ", "", "Adaptive Fig. 3"),
        (wrong_rules, "at the paper's goals 2.52", "at the paper's goals 2.41", "not by the paper's goals: 2.41"),
        (wrong_rules, "at ours 1.33, 2.66", "at ours 1.61, 2.66", "Table 2, TEXTURE: not by ours: 1.61"),
        (wrong_baselines, "OurHVPA: 8; OurJoint: 8; auto: — |", "OurHVPA: 2; OurJoint: 8; auto: — |", "QUAD"),
        (wrong_baselines, "uniform: 4; loss: 4; adaptive: 4 | 1 |", "uniform: 4; loss: 4; adaptive: 4 | 2 |", "adaptive_smoke"),
        (wrong_baselines, "| `meta.equal_time` | chalice |", "| meta | chalice |", "chalice"),
    ],
)  # fmt: skip
def test_a_fault_is_seen(check: Any, old: str, new: str, message: str) -> None:
    page = {wrong_baselines: BASELINES, wrong_commands: NOTES}.get(check, PAGE)
    assert old in page
    assert message in "\n".join(check(page.replace(old, new)))


def test_there_is_something_to_check() -> None:
    """A page or a results page of another form must not pass for want of matches."""
    figures = [row for _, row in figures_of(PAGE)]
    assert len(figures) == len(list(itertools.chain(*(names for _, names in PAPERS.values()))))
    assert sum(len(numbers(row[2])) for row in figures) > 100
    assert set(results()) == {name for name, each in KNOWN.items() if (each.folder / "results.json").is_file()}
