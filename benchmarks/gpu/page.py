"""The plan as a list, and the records of a GPU beside the processor's."""

from __future__ import annotations

from collections.abc import Iterator

from benchmarks import markdown
from benchmarks.gpu.plan import SLICES
from benchmarks.gpu.states import Folder, full
from benchmarks.runner import records
from benchmarks.runner.catalogue import Benchmark

__all__ = ["beside", "lines"]


def lines(folder: Folder) -> Iterator[str]:
    """A line per slice: its name, its state, when and on what, the minutes that it took or is expected to take, what it shows."""
    width = max(len(part.name) for part in SLICES)
    for part in SLICES:
        state = folder.read(part)
        spent = sum(entry["seconds"] for entry in state.get("commands", {}).values()) / 60
        time = f"{spent:.1f} min" if state else f"~{part.minutes:.0f} min"
        where = f", {state['date']}, {state['device']['name']}" if state else ""
        yield f"{part.name:{width}}  {folder.summary(part):11}  {time:>8}  {part.what}{where}"


def beside(benchmark: Benchmark, folder: Folder | None = None) -> list[str]:
    """What a GPU gave for a benchmark, as paragraphs below the processor's: of each slice that has ended it, with the device."""
    folder = folder or full()
    found = []
    for part in SLICES:
        own = [command for command in part.commands if command.name == benchmark.name]
        record = records.read(folder.records / part.name / benchmark.name)
        if record is None or not any(folder.ended(part, command) == "done" for command in own):
            continue
        state = folder.read(part)
        title = f"**On a GPU: {state['device']['name']}**, `{record['command']}`, {record['date']}."
        found.append(markdown.blocks(title, benchmark.module("table").table(record)))
    return found
