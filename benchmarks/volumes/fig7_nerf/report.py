"""Table and figure."""

from matplotlib.figure import Figure

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Final errors at equal time."""
    parts = []
    for s in record["schedules"].values():
        rows = [
            [
                name,
                f"{e['rate']:g}",
                *("{:.3f} ({:.3f} to {:.3f})".format(*e["final"][views]) for views in ("seen", "unseen")),
                ", ".join(map(str, e["steps"])),
            ]
            for name, e in s["methods"].items()
        ]
        head = ["method", "learning rate", "error of views seen", "of views unseen", "steps"]
        of = f" of {s['balls']} balls" if s["balls"] else ""
        by = " of the processor" if s["processor"] else ""
        sizes = f"`nerf-volume`{of}, {s['resolution']}², grids of {s['grid']}³, {s['kind']} rates"
        sizes += f", {s['seconds']:g} s{by}, {s['seeds']} seeds."
        parts.append(f"{sizes} Errors over the initial ones.\n\n{markdown.table(head, rows)}")
    return "\n\n".join(parts)


def plot(record: Record) -> Figure:
    """Error of views seen and unseen over seconds, or over paths where runs are told by the processor's time."""
    panels = {
        f"{kind}, {views}, over {'paths' if entry['processor'] else 'seconds'}": {
            f"{name}: {found['final'][views][0]:.3f}": figures.points(found["runs"][views], int(entry["processor"]))
            for name, found in entry["methods"].items()
        }
        for kind, entry in record["schedules"].items()
        for views in ("seen", "unseen")
    }
    return figures.curves(panels, "", "error of images / at the start", columns=2)
