"""The floor plan of CONTRIBUTING.md: imports run downwards, no circles, files and functions stay small."""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[2] / "src" / "unrender"
FLOORS = (
    *("core", "backend", "io", "statistics", "rendering", "losses", "display"),
    *("schedules", "parameterisations", "preconditioners"),
    *("scene", "images", "pixels", "estimators", "optimizers", "methods"),
    *("gallery", "runs", "own_loop"),
    *(
        f"app.{name}"
        for name in ("distributed", "sweeps", "report", "exporting", "stages", "evaluation", "capture", "watch", "cli")
    ),
)
"""From low to high: a floor imports itself and what is below it. The library comes first, the application last."""

LONGEST_FILE, LONGEST_FUNCTION = 400, 60
SHORTEST_HELPER = 60
"""Lines of a module that one other alone imports, unless it has a registered component."""
APART = {
    "app.capture.formats.llff": "a format of captures like its neighbours",
    "app.cli.app": "imports all commands, and the entry point must work where they cannot be imported",
}
"""Shorter modules, and why they are modules of their own."""


@cache
def modules() -> dict[str, Path]:
    """Every module of the package by its dotted name below `unrender`, but for the roof above all floors: the public names."""
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        name = ".".join(part for part in parts if part != "__init__")
        if name not in ("", "__main__", "protocols"):
            found[name] = path
    return found


@cache
def facts(source: str) -> tuple[list[tuple[str, int, bool]], dict[str, int]]:
    """Imports of a module, as (name below `unrender`, line, whether it is imported when the file is: neither in a function nor for type
    checkers alone), and {function: number of lines}. The tree is not kept: its many nodes would slow down every garbage collection."""
    found: list[tuple[str, int, bool]] = []
    functions: dict[str, int] = {}

    def visit(node: ast.AST, now: bool) -> None:
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        own = (name.removeprefix("unrender.") for name in names if name.startswith("unrender."))
        found.extend((name, getattr(node, "lineno", 0), now) for name in own)
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            functions[node.name] = max((node.end_lineno or 0) - node.lineno + 1, functions.get(node.name, 0))
        for_types = isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING"
        now = now and not for_types and not isinstance(node, ast.FunctionDef)
        # Only statements: an expression imports nothing.
        for block in ("body", "orelse", "finalbody", "handlers", "cases"):
            for child in getattr(node, block, ()):
                visit(child, now)

    for statement in ast.parse(source).body:
        visit(statement, True)
    return found, functions


def imports(source: str, known: Iterable[str]) -> Iterator[tuple[str, int, bool]]:
    """The imports of `facts` with the modules that the names are of, among those known."""
    for name, line, now in facts(source)[0]:
        yield name if name in known else name.rpartition(".")[0], line, now


def floor_of(module: str) -> str:
    """The first folder of a module; in the application the first two."""
    parts = module.split(".")
    return ".".join(parts[: 2 if parts[0] == "app" else 1])


def upward(module: str, source: str, known: dict[str, Path]) -> list[str]:
    """Imports of `source` that do not keep to the floor plan, one line each."""
    floor = floor_of(module)
    if module == "app":
        return []
    if floor not in FLOORS:
        return [f"{module}: stands on no floor"]
    found = []
    for target, line, _ in imports(source, known):
        there = floor_of(target) if target else "the roof"
        if there not in FLOORS or FLOORS.index(there) > FLOORS.index(floor):
            found.append(f"{module}:{line} imports {target or 'unrender'}, of {there}")
    return found


def test_imports_run_downwards() -> None:
    known = modules()
    assert [line for name, path in known.items() for line in upward(name, path.read_text(), known)] == []


def test_an_upward_import_is_found() -> None:
    known = modules()
    assert upward("core.trees", "from unrender.runs.loop import optimize\n", known)
    assert upward("losses.base", "def f():\n    from unrender import scene\n", known)
    assert upward("runs.loop", "from unrender.app.cli import run\n", known)
    assert upward("app.report.page", "from unrender.app.cli import run\n", known)
    assert upward("runs.loop", "from unrender.core import trees\n", known) == []


def test_no_module_imports_itself_through_others() -> None:
    known = modules()
    graph = {
        name: {target for target, _, now in imports(path.read_text(), known) if now and target in known}
        for name, path in known.items()
    }
    done: set[str] = set()

    def visit(name: str, trail: tuple[str, ...]) -> None:
        if name in trail:
            pytest.fail("imports in a circle: " + " -> ".join([*trail[trail.index(name) :], name]))
        if name not in done:
            for target in graph[name] - {name}:
                # A package's `__init__` gathers its own modules, which is no circle.
                if not target.startswith(f"{name}.") and not name.startswith(f"{target}."):
                    visit(target, (*trail, name))
            done.add(name)

    for name in graph:
        visit(name, ())


@pytest.mark.parametrize("module", modules())
def test_files_and_functions_stay_small(module: str) -> None:
    text = modules()[module].read_text()
    assert len(text.splitlines()) <= LONGEST_FILE
    assert not any(line.startswith("# pyright:") for line in text.splitlines()), "pyright is silenced for a whole file"
    assert {name: lines for name, lines in facts(text)[1].items() if lines > LONGEST_FUNCTION} == {}


def slivers(sources: dict[str, str]) -> set[str]:
    """Short modules that one other module alone imports, without a registered component."""
    known = {name: Path(name) for name in sources}
    importers: dict[str, set[str]] = {name: set() for name in sources}
    for name, text in sources.items():
        for target, _, _ in imports(text, known):
            importers.get(target, set()).add(name)
    short = {name for name, text in sources.items() if len(text.splitlines()) < SHORTEST_HELPER}
    return {name for name in short if len(importers[name] - {name}) == 1 and "\n@register" not in sources[name]}


def test_short_modules_have_more_than_one_user() -> None:
    known = modules()
    assert (
        slivers({name: path.read_text() for name, path in known.items() if path.stem != "__init__"}) - {*APART} == set()
    )


def test_a_sliver_is_found() -> None:
    user = "from unrender.core import tiny\n" + "x = 1\n" * SHORTEST_HELPER
    assert slivers({"core.tiny": "y = 2\n", "core.user": user}) == {"core.tiny"}
    assert slivers({"core.tiny": "y = 2\n", "core.user": user, "core.other": user}) == set()
    assert slivers({"core.tiny": "\n@register\nclass Y: ...\n", "core.user": user}) == set()
