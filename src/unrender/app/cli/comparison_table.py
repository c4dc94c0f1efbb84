"""Tables of `unrender compare`, one per metric. A separate module, since its imports would slow down `unrender --help`."""

from __future__ import annotations

from rich.markup import escape

from unrender.app.report.equal_time import LOSS_WINDOW, Comparison, Spread
from unrender.core.text import visible
from unrender.display import formatting
from unrender.display.terminal import Console, columns
from unrender.losses.metrics import has_flip


def show(console: Console, comparison: Comparison) -> None:
    """Print the median and range over each method's runs, for every metric and for the final pictures."""
    parameters = [metric for metric in comparison.metrics if metric.name != "loss"]
    for metric in parameters or comparison.metrics:
        window = f" (median over the last {LOSS_WINDOW:.0%} of the time)" if metric.name == "loss" else ""
        console.print(f"[bold]{plain(metric.title)}[/]{window}", soft_wrap=True)
        first = metric.methods[comparison.groups[0].label]
        times = [f"at {formatting.duration(moment.seconds)}" for moment in first.moments]
        table = columns("method", "runs", *times, f"after {formatting.count(comparison.samples)} paths")
        for group in comparison.groups:
            outcome = metric.methods[group.label]
            cells = [moment.error for moment in (*outcome.moments, outcome.at_samples[-1])]
            table.add_row(plain(group.label), str(len(group.runs)), *map(_spread, cells))
        console.print(table)
    if comparison.image_error[comparison.groups[0].label].median is not None:
        console.print("[bold]Last pictures, each run's at its own end[/]")
        table = columns("method", *comparison.images)
        for group in comparison.groups:
            table.add_row(plain(group.label), *(_spread(of[group.label]) for of in comparison.images.values()))
        console.print(table)
        if not has_flip():
            console.say("FLIP is left out: its package is missing (pip install 'unrender[flip]')")


def plain(text: str) -> str:
    """Return text of a run folder without rich markup, with its printed width."""
    return escape(visible(text))


def _spread(of: Spread) -> str:
    if of.median is None:
        return "–"
    middle = formatting.number(of.median)
    low, high = formatting.number(of.low), formatting.number(of.high)
    return middle if low == high else f"{middle} ({low}–{high})"
