"""Table and figure."""

import itertools
import statistics
from typing import Any

from benchmarks import figures, markdown
from benchmarks.runner.records import Record

OURS = ("OurHVPA", "OurJoint")
"""Tuned as widely as FR22, and measured with it."""
GOALS = "image 90 % | 99 % | 99.9 % | parameters 90 % | 99 % | 99.9 %"


def table(record: Record) -> str:
    """Seconds to each reduction of the error, and FR22's and CMA-ES's against the better of `OURS`."""
    entries = list(markdown.named(record["tasks"], "task", "methods", "method"))
    rows = []
    for entry in entries:
        times = [*entry["summary"]["image"], *entry["summary"]["parameter"]]
        there = " / ".join(map(str, entry["summary"]["parameter_count"])) + f" of {len(entry['runs'])}"
        cells = ("—" if time is None else f"{time:.3g}" for time in times)
        rows.append([entry["task"], entry["method"], *cells, there])
    commands = dict.fromkeys(entry["command"] for entry in entries if "command" in entry)
    parts = [
        f"Random starts, {record['settings']['resolution']}²; median seconds of the processor, — where half the runs or more "
        "never got there.",
        markdown.table(f"task | method | {GOALS} | runs that got there", rows),
        "Made by\n\n" + "\n".join(f"- `{command}`" for command in commands),
    ]
    for rival in ("FR22", "CMA-ES"):
        text = "'s time over the better of OurHVPA and OurJoint, per goal (>: its budget over theirs where it never got there):"
        parts += [rival + text, _gains(record["tasks"], rival)]
    text = "Times over those of one method alone, OurHVPA, the paper's, and OurJoint: means over the goals that both reached."
    return markdown.blocks(*parts, text, _apart(record["tasks"]))


def _apart(tasks: dict[str, Any]) -> str:
    """A row per rival and method: the mean of their ratios on each task, and of all, with the geometric mean."""
    rows = []
    for method, rival in itertools.product(OURS, ("FR22", "CMA-ES", "L-BFGS", "Mitsuba")):
        ratios = {name: _both(task["methods"], rival, method) for name, task in tasks.items()}
        every = [ratio for found in ratios.values() for ratio in found]
        cells = [f"{statistics.fmean(found):.2f}" if found else "—" for found in ratios.values()]
        middle = f"{statistics.fmean(every):.2f} ({statistics.geometric_mean(every):.2f})" if every else "—"
        rows.append([f"{rival} / {method}", *cells, middle, len(every)])
    return markdown.table(" | ".join(["", *tasks, "all (geometric)", "goals"]), rows)


def _both(methods: dict[str, Any], rival: str, method: str) -> list[float]:
    """The rival's times over the method's, of the goals that both reached in more than half of their runs."""
    if rival not in methods or method not in methods:
        return []
    theirs, ours = (
        [*entry["image"], *entry["parameter"]] for entry in (methods[m]["summary"] for m in (rival, method))
    )
    return [a / b for a, b in zip(theirs, ours, strict=True) if a is not None and b is not None]


def _gains(tasks: dict[str, Any], rival: str) -> str:
    """A row of ratios per task, their mean, and the mean of all."""
    rows, everything = [], []
    for name, task in tasks.items():
        if rival not in task["methods"]:
            continue
        mine = [entry for method, entry in task["methods"].items() if method in OURS]
        ours, longest = ([entry["summary"] for entry in mine], max(entry["seconds"] for entry in mine))
        theirs, known, cells = task["methods"][rival], [], []
        for which, goal in itertools.product(("image", "parameter"), range(3)):
            times = [summary[which][goal] for summary in ours if summary[which][goal] is not None]
            time = theirs["summary"][which][goal]
            if not times and time is None:
                cells.append("—")
                continue
            ratio = (time or theirs["seconds"]) / min([*times, longest])
            known.append(ratio)
            cells.append(f"{'> ' * (time is None)}{'< ' * (not times)}{ratio:.2f}")
        everything += known
        rows.append([name, *cells, f"{sum(known) / len(known):.2f}" if known else "—"])
    mean = (
        f"Mean of all {len(everything)}, bounds counted as they are: {sum(everything) / max(len(everything), 1):.2f}."
    )
    return markdown.table(f"task | {GOALS} | mean", rows) + f"\n\n{mean}"


def plot(record: Record) -> figures.Figure:
    """Per task: median error over seconds, in the image and in the parameters."""
    panels = {
        f"{name}: {kind}": {method: [entry["curves"][kind]] for method, entry in task["methods"].items()}
        for name, task in record["tasks"].items()
        for kind in ("image", "parameter")
    }
    return figures.curves(panels, "seconds", log="xy")
