"""Participating media."""

from __future__ import annotations

from typing import Any

from summaries.tables import table

COST = """\
Ratios of medians, 10th to 90th percentile; the machine was busy with other work, so they are rough. A pair costs more
than the 1.35 that was hoped for: both states' coefficients are looked up at every tentative collision."""

GRADIENTS = """\
Derivative of the mean picture along one direction each, against finite differences: z-scores of the difference.
Mitsuba's `prbvolpath` is biased where the medium is empty or black, and of the wrong sign where density is at the
majorant."""


def cost(found: dict[str, Any]) -> str:
    """Ratios."""
    rows = [[name, f"{m:.2f}", f"{low:.2f} to {high:.2f}"] for name, (low, m, high) in found["ratios"].items()]
    size = (
        f"`smoke`, {found['resolution']}², a grid of {found['grid']}³, {found['spp']} spp, {found['repeats']} repeats."
    )
    return f"{size}\n\n{table(['ratio', 'median', 'range'], rows)}"


def gradients(found: dict[str, Any]) -> str:
    """z-scores."""
    rows = []
    for name, e in found["directions"].items():
        value, error = e["finite differences"]
        ours, theirs = e["differential ratio tracking"], e["prbvolpath"]
        rows.append([name, f"{value:.3g} ± {error:.1g}", *(f"{v:.3g}, z {z:.1f}" for v, _, z in (ours, theirs))])
    head = ["direction", "finite differences", "here", "`prbvolpath`"]
    return f"{found['runs']} runs of {found['spp']} spp, depth {found['depth']}.\n\n{table(head, rows)}"
