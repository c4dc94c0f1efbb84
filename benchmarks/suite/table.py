"""Table."""

from __future__ import annotations

from statistics import geometric_mean

from benchmarks import markdown
from benchmarks.runner.records import Record


def readme_rows(record: Record) -> list[str]:
    """The rows of README's table: errors at the end, and how much earlier `auto` is at the loop's best."""
    rows = []
    for name, entry in record["problems"].items():
        speed = f"{entry['speed']:.2g}" if entry["speed"] else "never"
        rows.append(f"| {name} | {entry['loop'][-1]:.2f} | {entry['auto'][-1]:.2f} | {speed} |")
    return rows


def _tuned(entry: Record) -> str:
    """How much faster with the option that `auto` was tuned to."""
    found = entry.get("tuned")
    if found is None:
        return ""
    speed = f"{found['speed']:.2g}" if found["speed"] else "below 1"
    return f"{speed} ({found['option'] or 'as it is'})"


def _mean(speeds: list[float | None], problems: list[Record], seconds: float) -> float:
    """The geometric mean, where `auto` never gets there as if it did at the end."""
    return geometric_mean(
        speed or entry["seconds_of_loop"] / seconds for speed, entry in zip(speeds, problems, strict=True)
    )


def table(record: Record) -> str:
    """Error at the end, and the time to the tuned loop's best error."""
    settings, problems = record["settings"], record["problems"]
    rows = []
    for name, entry in problems.items():
        setting, never = entry["setting"], entry["speed"] is None
        words = f"{setting['spp']} spp, {setting['rate']:g}{', falling' if setting['falling'] else ''}"
        hand = entry.get("fixed_point")
        first = "never" if never else f"{entry['seconds_of_auto']:.2g} s"
        rows.append(
            [
                name, words, f"{entry['loop'][4]:.3f}, {entry['loop'][-1]:.3f}", f"{entry['auto'][4]:.3f}, {entry['auto'][-1]:.3f}",
                f"{hand[4]:.3f}, {hand[-1]:.3f}" if hand else "",
                f"{entry['seconds_of_loop']:.2g} s", first, "below 1" if never else f"**{entry['speed']:.2g}**",
                _tuned(entry), f"{entry['compile_seconds']:.1f} s",
            ]
        )  # fmt: skip
    head = ["problem", "the loop's best setting", "loop, half and end", "auto, half and end", "fixed point"]
    head += ["loop at its best", "auto there", "faster", "tuned", "compile"]
    entries = list(problems.values())
    mean = _mean([entry["speed"] for entry in entries], entries, settings["seconds"])
    ours = [entry for entry in entries if "tuned" in entry]
    of_tuned = _mean([entry["tuned"]["speed"] for entry in ours], ours, settings["seconds"]) if ours else None
    seeds = sorted({len(entry["final"]["auto"]) for entry in entries})
    tuned = len(settings["spp"]) * len(settings["rates"]) * 2
    return "\n\n".join(
        [
            f"{settings['seconds']:g} s, {' or '.join(map(str, seeds))} seeds, medians; errors where seen, relative to the "
            f"start. The loop is the best of {tuned} settings, `auto` has none.",
            markdown.table(head, rows),
            f"Geometric mean over the {len(problems)} problems: **{mean:.2f}** times as fast, where `auto` never gets "
            f"there as if it did at the end. Ahead at the end on {sum(e['auto'][-1] < e['loop'][-1] for e in entries)}."
            + (
                f" With `auto` tuned over as many settings, {len(ours)} problems: **{of_tuned:.2f}**."
                if of_tuned
                else ""
            ),
        ]
    )
