"""Plug-in of pytest: each test's outcome goes to a file as it ends, and tests that have one there are left out.

`-p benchmarks.gpu.outcomes --outcomes FILE`. So tests that were cut short go on where they were. A test that twice began and never ended
is left out, too: it ended the process.
"""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

_ENDS = 2
"""Beginnings without an end from which on a test counts as one that ends its process."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """The option."""
    parser.addoption("--outcomes", type=Path, help="file of the tests' outcomes, one JSON line each")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out what has an outcome."""
    known = read(Path(str(config.getoption("--outcomes"))))
    left_out = [item for item in items if item.nodeid in known]
    config.hook.pytest_deselected(items=left_out)
    items[:] = [item for item in items if item.nodeid not in known]


@pytest.hookimpl(tryfirst=True)
def pytest_configure(config: pytest.Config) -> None:
    """Only the first process writes: with pytest-xdist it hears of all workers' tests."""
    if not hasattr(config, "workerinput"):
        config.pluginmanager.register(_Writer(Path(str(config.getoption("--outcomes")))), "outcomes-writer")


class _Writer:
    def __init__(self, file: Path):
        self.file = file
        file.parent.mkdir(parents=True, exist_ok=True)

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        self._write({"test": nodeid, "outcome": "began"})

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.when == "call" or report.outcome != "passed":
            line: dict[str, Any] = {
                "test": report.nodeid,
                "outcome": report.outcome,
                "seconds": round(report.duration, 2),
            }
            if report.failed:
                line["error"] = str(report.longrepr).strip().splitlines()[-1][:300]
            self._write(line)

    def _write(self, line: dict[str, Any]) -> None:
        with self.file.open("a") as file:
            file.write(json.dumps(line, ensure_ascii=False) + "\n")


def read(file: Path) -> dict[str, str]:
    """{test: "passed", "failed", "skipped", or "ended the process"}; of several outcomes of a test, the worst."""
    lines = [json.loads(line) for line in file.read_text().splitlines()] if file.is_file() else []
    found: dict[str, str] = {}
    for line in lines:
        if line["outcome"] != "began" and found.get(line["test"]) != "failed":
            found[line["test"]] = line["outcome"]
    begun = Counter(line["test"] for line in lines if line["outcome"] == "began")
    return found | {t: "ended the process" for t, n in begun.items() if n >= _ENDS and t not in found}


def counts(file: Path) -> dict[str, int]:
    """How many tests had which outcome."""
    return dict(Counter(read(file).values()))
