"""Table and figure."""

from collections.abc import Sequence

import numpy as np

from benchmarks import figures, markdown
from benchmarks.runner.records import Record

_RATES = ("base_learning_rate", "learning_rate")


def _reached(runs: Sequence[Record], error: float) -> str:
    """The median over runs of the seconds after which the error is first at most so much."""
    firsts = [next((seconds for seconds, found in run["curve"] if found <= error), np.inf) for run in runs]
    found = float(np.median(firsts))
    return f"{found:.1f} s" if np.isfinite(found) else "never"


def table(record: Record) -> str:
    """Errors at the end, and steps; how far each peer's rendering of the true scene is from the references."""
    text = "{seconds:g} s of the processor, pictures of {resolution}², textures of {texture}², errors relative to the start, median and "
    text += "range: of the textures where seen, and of held-out pictures."
    parts = [text.format(**record["settings"])]
    for name, sides in record["problems"].items():
        ours = sides["auto"]["runs"]
        several = len(ours[0]["each"]) > 1
        head = "side | rate | steps | textures | held-out pictures | `auto` as good after"
        rows = [_row(side, entry, ours, several) for side, entry in sides.items()]
        runs = ((side, run) for side, entry in sides.items() for run in entry["runs"])
        checks = ", ".join(f"{side} {run['check']:.3f}" for side, run in runs if "check" in run)
        parts += [
            f"**{name}**, {len(ours)} seed{'s' if len(ours) > 1 else ''}",
            markdown.table(f"{head} | each texture" if several else head, rows),
            f"The true scene as a peer renders it, from the references, relative: {checks}.",
        ]
    return markdown.blocks(*parts)


def _row(side: str, entry: Record, ours: Sequence[Record], several: bool) -> list[str]:
    runs = entry["runs"]
    rate = next((f"{entry['settings'][key]:.2g}" for key in _RATES if key in entry.get("settings", {})), "")
    steps = f"{np.median([run['steps'] for run in runs]):g}"
    errors = [markdown.spread([run[kind] for run in runs]) for kind in ("textures", "pictures")]
    reached = "" if side == "auto" else _reached(ours, float(np.median([run["textures"] for run in runs])))
    each = [f"{channel} {np.median([run['each'][channel] for run in runs]):.3f}" for channel in runs[0]["each"]]
    return [side, rate, steps, *errors, reached, *(["; ".join(each)] if several else [])]


def plot(record: Record) -> figures.Figure:
    """Error of the textures over processor seconds."""
    panels = {
        name: {
            side: [tuple(zip((0.0, 1.0), *run["curve"][1:], strict=True)) for run in entry["runs"]]
            for side, entry in sides.items()
        }
        for name, sides in record["problems"].items()
    }
    return figures.curves(panels, "processor seconds", "error where seen / at the start", log="")
