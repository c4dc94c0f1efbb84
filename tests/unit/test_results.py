"""README.md and docs/results.md quote numbers that the pages of the benchmarks have."""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import cache

import pytest

from benchmarks.runner.catalogue import ROOT, benchmarks
from benchmarks.runner.results_page import section

pytestmark = pytest.mark.mitsuba  # tables of some benchmarks name problems of the gallery
PAGE = (ROOT / "docs" / "results.md").read_text(encoding="utf-8")
README = (ROOT / "README.md").read_text(encoding="utf-8")
NUMBER = r"(?<![\w.,])\d+(?:\.\d+)?(?![\w³])"


def quoted(page: str) -> Iterator[tuple[str, list[str]]]:
    """(benchmark, numbers) of each row of a table that names a benchmark in its last cell."""
    for line in page.splitlines():
        if name := re.search(r"\| `([\w.]+)` \|$", line):
            cells = re.sub(r"`[^`]*`|\bL[12]\b", "", " | ".join(line.split(" | ")[1:-1]))
            yield name[1], re.findall(NUMBER, cells)


@cache
def measured(name: str) -> set[str]:
    """Numbers on the page of a benchmark."""
    return set(re.findall(NUMBER, section(benchmarks()[name]) or ""))


def wrong(page: str) -> list[str]:
    """Numbers that the named benchmark's page does not have."""
    return [f"{name}: {number}" for name, numbers in quoted(page) for number in numbers if number not in measured(name)]


def test_every_number_is_on_its_benchmarks_page() -> None:
    assert wrong(PAGE) + wrong(README) == []
    assert sum(len(numbers) for _, numbers in quoted(README)) >= 4
    assert sum(len(numbers) for _, numbers in quoted(PAGE)) > 25


def test_a_wrong_number_is_seen() -> None:
    assert "suite: 8.43" in wrong(README.replace("| 8.42 |", "| 8.43 |"))
    assert "own_loop: 0.97" in wrong(PAGE.replace("error 0.96 (L2)", "error 0.97 (L2)"))


def test_the_page_stays_short() -> None:
    assert len(PAGE.encode()) <= 8 << 10
