"""Table."""

import numpy as np

from benchmarks import markdown
from benchmarks.runner.records import Record
from benchmarks.shapes.cameras.run import ASKED


def table(record: Record) -> str:
    """What was left: median and range over cameras and starts, and how many were as near as asked."""
    rows = []
    for scene, found in record["scenes"].items():
        for name, runs in found.items():
            finals = np.array([camera for run in runs for camera in run["final"]])
            cells = [
                markdown.median_range((float(np.median(column)), float(column.min()), float(column.max())))
                for column in finals.T
            ]
            near = int((finals <= ASKED).all(axis=1).sum())
            rows.append([scene, name, len(runs), *cells, f"{near} of {len(finals)}"])
    settings = record["settings"]
    said = (
        f"After {settings['seconds']:g} s of the processor, from 2 degrees and 2 % off, pictures of {settings['resolution']}²: median "
        f"(least to greatest) over cameras and starts, and how many are within {ASKED[0]:g} degrees and {ASKED[1]:g} %."
    )
    head = ["scene", "method", "starts", "angle, degrees", "place, % of the distance", "as near as asked"]
    return said + "\n\n" + markdown.table(head, rows)
