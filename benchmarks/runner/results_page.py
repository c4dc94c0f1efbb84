"""Pages of the documentation site, one per benchmark: notes, command, table and figure, built from its record."""

from __future__ import annotations

import shutil
from pathlib import Path

from benchmarks import markdown
from benchmarks.gpu.plan import FULL, SLICES, Folder
from benchmarks.runner import records
from benchmarks.runner.catalogue import ROOT, Benchmark, benchmarks

_BASELINES = Path(__file__).with_name("baselines.md")
_FOLDER = ROOT / "docs" / "benchmarks"
_INDEX = """# Benchmarks

One page per benchmark: its question, the command, the table of its record and the figure. Ratios are of one run on one
machine; times are not comparable between pages. [Results](../results.md) has the summary.

```{{toctree}}
:maxdepth: 1

{names}
```
"""


def write_pages(folder: Path = _FOLDER, figures: bool = True) -> Path:
    """Write a page per benchmark and an index.

    Args:
        folder: receives the pages.
        figures: whether to draw each benchmark's figure beside its page.

    Returns:
        The index.
    """
    folder.mkdir(parents=True, exist_ok=True)
    names = []
    for name, benchmark in benchmarks().items():
        text = section(benchmark)
        if text is None:
            continue
        names.append(name)
        if figures:
            text += _figure(benchmark, folder)
        (folder / f"{name}.md").write_text(f"{text[1:]}\n")
    names.append(_BASELINES.stem)
    shutil.copyfile(_BASELINES, folder / _BASELINES.name)
    index = folder / "index.md"
    index.write_text(_INDEX.format(names="\n".join(names)))
    return index


def section(benchmark: Benchmark) -> str | None:
    """Return one benchmark's text under a heading of level two; None without a record."""
    record = records.read(benchmark.folder)
    if record is None:
        return None
    title, notes = split_notes(benchmark)
    hardware, versions = record["hardware"], record["versions"]
    measured = (
        f"`{record['command']}`, {record['date']}, {hardware['cores']} cores of {hardware['processor']}, "
        f"Mitsuba {versions['mitsuba']}."
    )
    parts = [f"## {title}", notes, measured, benchmark.table(record)]
    return "\n\n".join(filter(None, [*parts, *on_a_gpu(benchmark)]))


def on_a_gpu(benchmark: Benchmark, folder: Folder = FULL) -> list[str]:
    """Return what a GPU gave for a benchmark, a paragraph for each slice that has ended it, with the device."""
    found = []
    for part in SLICES:
        own = [command for command in part.commands if command.name == benchmark.name]
        record = records.read(folder.path / part.name / benchmark.name)
        if record is not None and any(folder.ended(part, command) == "done" for command in own):
            name = folder.read(part)["device"]["name"]
            title = f"**On a GPU: {name}**, `{record['command']}`, {record['date']}."
            found.append(markdown.blocks(title, benchmark.table(record)))
    return found


def split_notes(benchmark: Benchmark) -> tuple[str, str]:
    """Return the title and the findings of notes.md."""
    head, _, body = (benchmark.folder / "notes.md").read_text().partition("\n")
    return head.removeprefix("# ").strip(), body.strip()


def _figure(benchmark: Benchmark, folder: Path) -> str:
    """Draw the figure from the record. Return the Markdown that shows it, "" where the record has no images to draw."""
    from benchmarks.runner.cli import draw

    record = records.read(benchmark.folder)
    file = folder / f"{benchmark.name}.png"
    if record is None or not draw(benchmark, record, file):
        return ""
    return f"\n\n![{split_notes(benchmark)[0]}]({file.name})"
