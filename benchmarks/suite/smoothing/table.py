"""Table."""

from __future__ import annotations

from statistics import geometric_mean, median

from benchmarks import markdown
from benchmarks.runner.records import Record

BASES = {"filter": "none", "filter and sobolev": "sobolev", "sobolev": "none", "pyramid": "none"}
"""{smoothing: the same method without it}."""


def table(record: Record) -> str:
    """Errors at half and at the end, and each smoothing's over that of the same method without it."""
    settings, problems = record["settings"], record["problems"]
    kinds = list(next(iter(problems.values())))
    ends = {
        name: {kind: median(c[-1] for c in found) for kind, found in curves.items()}
        for name, curves in problems.items()
    }
    halves = {
        name: {kind: median(c[4] for c in found) for kind, found in curves.items()} for name, curves in problems.items()
    }
    rows = []
    for name, end in ends.items():
        best = min(end.values())
        cells = (
            f"{halves[name][kind]:.3f}, " + (f"**{end[kind]:.3f}**" if end[kind] == best else f"{end[kind]:.3f}")
            for kind in kinds
        )
        rows.append([name, *cells])
    shown = [(kind, base) for kind, base in BASES.items() if kind in kinds and base in kinds]
    ratios = []
    for kind, base in shown:
        textures = [end[kind] / end[base] for name, end in ends.items() if not name.startswith("checkerboard")]
        boards = [end[kind] / end[base] for name, end in ends.items() if name.startswith("checkerboard")]
        ratios.append(
            [
                f"{kind} over {base}",
                f"{geometric_mean(textures):.2f} ({min(textures):.2f} to {max(textures):.2f})" if textures else "",
                ", ".join(f"{ratio:.2f}" for ratio in boards),
            ]
        )
    seeds = sorted({len(found) for curves in problems.values() for found in curves.values()})
    return "\n\n".join(
        [
            f"Error where seen, relative to the start, after half and all of {settings['steps']} steps of as many samples; "
            f"medians of {' or '.join(map(str, seeds))} seeds.",
            markdown.table(["problem", *kinds], rows),
            "Errors at the end over those of the same method without it: geometric mean and range over the textures, and each "
            "checkerboard.",
            markdown.table(["", "textures", "checkerboards"], ratios),
        ]
    )
