"""Table and figure."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from benchmarks import figures, markdown
from benchmarks.runner.records import Record

_RATES = ("base_learning_rate", "learning_rate")


def _spread(values: Sequence[float]) -> str:
    return markdown.median_range((float(np.median(values)), min(values), max(values)))


def _reached(runs: Sequence[Record], error: float) -> str:
    """The median over runs of the seconds after which the error is first at most so much."""
    firsts = [next((seconds for seconds, found in run["curve"] if found <= error), np.inf) for run in runs]
    found = float(np.median(firsts))
    return f"{found:.1f} s" if np.isfinite(found) else "never"


def table(record: Record) -> str:
    """Errors at the end, and steps; how far each peer's rendering of the true scene is from the references."""
    settings = record["settings"]
    parts = [
        f"{settings['seconds']:g} s of the processor, pictures of {settings['resolution']}², textures of {settings['texture']}², "
        "errors relative to the start, median and range: of the textures where seen, and of held-out pictures."
    ]
    for name, sides in record["problems"].items():
        several = len(sides["auto"]["runs"][0]["each"]) > 1
        head = ["side", "rate", "steps", "textures", "held-out pictures", "`auto` as good after"]
        rows = [_row(side, entry, sides["auto"]["runs"], several) for side, entry in sides.items()]
        count = len(sides["auto"]["runs"])
        parts.append(f"**{name}**, {count} seed{'s' if count > 1 else ''}")
        parts.append(markdown.table([*head, "each texture"] if several else head, rows))
        checks = [
            f"{side} {run['check']:.3f}" for side, entry in sides.items() for run in entry["runs"] if "check" in run
        ]
        parts.append(f"The true scene as a peer renders it, from the references, relative: {', '.join(checks)}.")
    return "\n\n".join(parts)


def _row(side: str, entry: Record, ours: Sequence[Record], several: bool) -> list[str]:
    runs = entry["runs"]
    rate = next((f"{entry['settings'][key]:.2g}" for key in _RATES if key in entry.get("settings", {})), "")
    steps = f"{np.median([run['steps'] for run in runs]):g}"
    errors = [_spread([run[kind] for run in runs]) for kind in ("textures", "pictures")]
    reached = "" if side == "auto" else _reached(ours, float(np.median([run["textures"] for run in runs])))
    each = [f"{channel} {np.median([run['each'][channel] for run in runs]):.3f}" for channel in runs[0]["each"]]
    return [side, rate, steps, *errors, reached, *(["; ".join(each)] if several else [])]


def plot(record: Record) -> Figure:
    """Error of the textures over processor seconds."""
    panels = {
        name: {
            side: [tuple(zip((0.0, 1.0), *run["curve"][1:], strict=True)) for run in entry["runs"]]
            for side, entry in sides.items()
        }
        for name, sides in record["problems"].items()
    }
    return figures.curves(panels, "processor seconds", "error where seen / at the start", log="")
