"""Table and figure."""

from __future__ import annotations

from statistics import geometric_mean

import numpy as np

from benchmarks import figures, markdown
from benchmarks.runner.records import Record

_MOST_REGRET = 1.15
"""Of the error at the end, that counts as chosen well."""


def _tuned(entry: Record) -> str:
    """How much faster with the option that `auto` was tuned to."""
    found = entry.get("tuned")
    if found is None:
        return ""
    speed = f"{found['speed']:.2g}" if found["speed"] else "below 1"
    return f"{speed} ({found['option'] or 'as it is'})"


def _regret(entry: Record) -> float:
    """The error of `auto` at the end over the least of its own and its options', of the seed that it was tuned with."""
    ends = {one["option"]: one["error"] for one in entry["tuned"]["tried"]}
    return ends[""] / min(ends.values())


def _of_tuning(entries: list[Record], seconds: float) -> str:
    """What options of `auto` bring, "" where none was tried: in time, over that of none at the loop's best error; and at the end."""
    tuned = [entry["tuned"] for entry in entries if "tuned" in entry]
    if not tuned:
        return ""
    ours = [entry for entry in entries if "tuned" in entry]
    speed = _mean([one["speed"] for one in tuned], ours, seconds)
    counts = sorted({len(one["tried"]) for one in tuned})
    settings = str(counts[0]) if len(counts) == 1 else f"{counts[0]} to {counts[-1]}"
    regrets = [_regret(entry) for entry in ours]
    within = sum(regret <= _MOST_REGRET for regret in regrets)
    return (
        f"\n\nWith `auto` tuned, too, over {settings} settings, its own included, {len(ours)} problems: **{speed:.2f}** times. "
        "Its error at the end over that of the setting that is best then, of one seed: "
        f"at most {_MOST_REGRET:g} on {within}, geometric mean {geometric_mean(regrets):.2f}."
    )


def _mean(speeds: list[float | None], problems: list[Record], seconds: float) -> float:
    """The geometric mean, where `auto` never gets there as if it did at the end."""
    return geometric_mean(
        speed or entry["seconds_of_loop"] / seconds for speed, entry in zip(speeds, problems, strict=True)
    )


def table(record: Record) -> str:
    """Error at the end, and the time to the tuned loop's best error."""
    settings, problems, rows = record["settings"], record["problems"], []
    for name, entry in problems.items():
        sides = {"loop", "auto", "fixed_point"} & entry.keys()
        ends = {side: f"{entry[side][4]:.3f}, {entry[side][-1]:.3f}" for side in sides}
        speed, first = "below 1", "never"
        if entry["speed"] is not None:
            speed, first = f"**{entry['speed']:.2g}**", f"{entry['seconds_of_auto']:.2g} s"
        rows.append([name, _setting(entry), ends["loop"], ends["auto"], ends.get("fixed_point", "")])
        rows[-1] += [
            f"{entry['seconds_of_loop']:.2g} s",
            first,
            speed,
            _tuned(entry),
            f"{entry['compile_seconds']:.1f} s",
        ]
    head = (
        "problem | the loop's best setting | loop, half and end | auto, half and end | fixed point | loop at its best"
    )
    entries = list(problems.values())
    mean = _mean([entry["speed"] for entry in entries], entries, settings["seconds"])
    seeds = sorted({len(entry["final"]["auto"]) for entry in entries})
    tuned = len(settings["spp"]) * len(settings["rates"]) * 2
    return markdown.blocks(
        f"{settings['seconds']:g} s, {' or '.join(map(str, seeds))} seeds, medians; errors where seen, relative to the "
        f"start. The loop is the best of {tuned} settings, the column `auto` has none set.",
        markdown.table(f"{head} | auto there | faster | tuned | compile", rows),
        f"Geometric mean over the {len(problems)} problems: **{mean:.2f}** times as fast, where `auto` never gets "
        f"there as if it did at the end. Ahead at the end on {sum(e['auto'][-1] < e['loop'][-1] for e in entries)}."
        + _of_tuning(entries, settings["seconds"]),
    )


def _setting(entry: Record) -> str:
    falling = ", falling" if entry["setting"]["falling"] else ""
    return f"{entry['setting']['spp']} spp, {entry['setting']['rate']:g}{falling}"


def plot(record: Record) -> figures.Figure:
    """Error of both sides over seconds."""
    seconds = record["settings"]["seconds"] * np.arange(11) / 10
    sides = {"loop": "stock loop, tuned", "auto": "auto, no option", "fixed_point": "reference / rendering"}
    panels = {
        name: {label: [(seconds, [1.0, *entry[side]])] for side, label in sides.items() if side in entry}
        for name, entry in record["problems"].items()
    }
    return figures.curves(panels, "seconds", columns=6)
