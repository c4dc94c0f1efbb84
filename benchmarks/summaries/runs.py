"""The life of a run."""

from __future__ import annotations

from typing import Any

from summaries.tables import table

CHECKPOINTS = """\
One checkpoint in fifty steps, written to the disk and waited for; the machine was busy. `quad` has no renderer, and
steps of a tenth of a millisecond: there a checkpoint costs more than two hundredths. The default writes less often
where it would."""

WATCHING = """\
Blocks by turns: alone, with the live files, with the page open in a browser. The machine was busy, so the error is as
large as what was to be shown."""


def checkpoints(found: dict[str, Any]) -> str:
    """The share of the run."""
    rows = []
    for name, entry in found["cases"].items():
        e = entry[str(found["steps"])] if str(found["steps"]) in entry else next(iter(entry.values()))
        size = f"{e['bytes'] / 1e6:.2f}"
        rows.append([name, f"{e['step_ms']:.1f}", f"{e['checkpoint_ms']:.0f}", size, f"{e['share_checkpoints']:.2%}"])
    return table(["case", "ms a step", "ms a checkpoint", "MB", "share of the run"], rows)


def watching(found: dict[str, Any]) -> str:
    """Time per step relative to being alone."""
    rows = [[kind, f"{ratio['median']:.3f} ± {ratio['standard_error']:.3f}"] for kind, ratio in found["ratios"].items()]
    share = found["processor_share"]
    told = ", ".join(f"{name} {value:.1%}" for name, value in share.items())
    return (
        f"{table(['with', 'time of a step, relative to alone'], rows)}\n\nShare of both processors, page open: {told}."
    )
