"""Figure."""

from typing import Any

from matplotlib.figure import Figure

from benchmarks.race_plots import colours, over_time_and_paths
from benchmarks.runner.records import Record

OTHER = {
    "rcv": "#555555",
    "meta": "#1f6fb4",
    "meta, naive": "#7fb2dd",
    "coupled": "#1a8f4c",
    "coupled, rcv": "#8a3fa8",
}


def plot(record: Record) -> Figure:
    """Per problem: error over seconds and over samples."""
    return over_time_and_paths(record["entries"], "seconds", _styles)


def _styles(methods: dict[str, Any]) -> dict[str, tuple[Any, str]]:
    adam = [name for name, found in methods.items() if found["group"] == "adam"]
    shade = dict(zip(adam, colours(len(adam)), strict=True))
    return {
        name: (shade[name], "-") if name in shade else (OTHER[found["group"]], "--" if name.endswith("8 spp") else "-")
        for name, found in methods.items()
    }
