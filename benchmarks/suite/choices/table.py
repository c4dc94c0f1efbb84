"""Table."""

from __future__ import annotations

from statistics import geometric_mean, median

from benchmarks import markdown
from benchmarks.runner.records import Record


def _cell(ratio: float | None, best: float) -> str:
    """A ratio, bold where it is the best and below 1; same: `auto` chose it, too."""
    if ratio is None:
        return "same"
    return f"**{ratio:.2f}**" if ratio == best < 1 else f"{ratio:.2f}"


def table(record: Record) -> str:
    """Errors at the end over those of `auto`, and the regret."""
    settings, problems = record["settings"], record["problems"]
    rows, regrets, smoothing = [], [], []
    for name, ends in problems.items():
        chosen = median(ends["auto"])
        others = {label: median(found) / chosen for label, found in ends.items() if label != "auto"}
        best = min(others, key=lambda label: others[label])
        regrets.append(max(1.0, 1 / others[best]))
        if "smooth=false" in others and name != "checkerboard":
            smoothing.append(1 / others["smooth=false"])
        cells = [_cell(others.get(label), others[best]) for label in settings["choice"]]
        rows.append([name, f"{chosen:.3f}", *cells, f"{regrets[-1]:.2f}"])
    head = ["problem", "auto", *settings["choice"], "regret"]
    within = sum(regret <= 1.15 for regret in regrets)
    lines = [
        f"{settings['seconds']:g} s, {settings['seeds']} seeds, medians: the error at the end where seen, relative to the start, "
        "of `auto`; of its options, over that of `auto` (below 1, the option is better; same: `auto` chose it, too).",
        markdown.table(head, rows),
        f"Regret at most 1.15 on {within} of {len(regrets)}; geometric mean {geometric_mean(regrets):.2f}.",
    ]
    if smoothing:
        lines.append(
            f"With smoothing over without, geometric mean without the checkerboard: {geometric_mean(smoothing):.2f}."
        )
    return "\n\n".join(lines)
