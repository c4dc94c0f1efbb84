"""docs/results.md: notes, tables and figures of all benchmarks that were measured, and beside them what a GPU gave."""

from __future__ import annotations

from pathlib import Path

from benchmarks.gpu.page import beside
from benchmarks.runner import records
from benchmarks.runner.catalogue import ROOT, Benchmark, benchmarks

HEAD = """# Results

Written by `python -m benchmarks results` from each benchmark's `notes.md`, `results.json` and `table.py`; losses as plainly as wins.
Ratios are of one run on one machine; times are not comparable between sections.

RCV: Nicolet et al. 2023, *Recursive Control Variates for Inverse Rendering*. Meta: Balint et al. 2023, *Joint Sampling and Optimisation for
Inverse Rendering*. HO: Wang et al. 2025, *Stochastic Gradient Estimation for Higher-order Differentiable Rendering*. Adaptive: *Image-space
Adaptive Sampling for Fast Inverse Rendering*. [The papers](papers.md) has their own figures and tables beside these."""


def write_page(file: Path = ROOT / "docs" / "results.md") -> Path:
    """Write the page; its path."""
    file.write_text("\n\n".join([HEAD, *filter(None, map(section, benchmarks().values()))]) + "\n")
    return file


def section(benchmark: Benchmark) -> str | None:
    """One benchmark's part of the page; None where it was not measured."""
    record = records.read(benchmark.folder)
    if record is None:
        return None
    title, notes = split_notes(benchmark)
    hardware, versions = record["hardware"], record["versions"]
    measured = (
        f"`{record['command']}`, {record['date']}, {hardware['cores']} cores of {hardware['processor']}, "
        f"Mitsuba {versions['mitsuba']}."
    )
    parts = [f"## {title}", measured, notes, benchmark.module("table").table(record)]
    if (benchmark.folder / "figure.png").is_file():
        parts.append(f"![{title}](../{(benchmark.folder / 'figure.png').relative_to(ROOT).as_posix()})")
    return "\n\n".join(filter(None, [*parts, *beside(benchmark)]))


def split_notes(benchmark: Benchmark) -> tuple[str, str]:
    """The title and the findings in notes.md."""
    head, _, body = (benchmark.folder / "notes.md").read_text().partition("\n")
    return head.removeprefix("# ").strip(), body.strip()
