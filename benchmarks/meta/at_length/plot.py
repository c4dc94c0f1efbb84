"""Figure."""

from matplotlib.figure import Figure

from benchmarks.race_plots import over_time_and_paths
from benchmarks.runner.records import Record

COLOURS = {
    "Adam, 16 spp": "#e0a030",
    "Adam, 64 spp": "#a04010",
    "meta, 1 + 2": "#1f6fb4",
    "meta, 12 + 4": "#7fb2dd",
    "meta, 4 + 16": "#123f66",
    "meta, 1 + 2, walk": "#20b0b0",
    "coupled": "#1a8f4c",
    "coupled on rcv": "#8a3fa8",
}


def plot(record: Record) -> Figure:
    """Per problem: error over processor seconds and over samples."""
    return over_time_and_paths(
        record["entries"], "processor seconds", lambda methods: {name: (COLOURS[name], "-") for name in methods}
    )
