"""Table and figure."""

from matplotlib.figure import Figure

from benchmarks import figures, markdown
from benchmarks.meta.fig5_ablations.run import FORMS
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Meta, Fig. 5."""
    settings = record["settings"]
    rows = [
        [name, f"{f['rate']:g}", f"{f['final'][0]:.3f} ({f['final'][1]:.3f} to {f['final'][2]:.3f})"]
        for name, f in record["methods"].items()
    ]
    sizes = f"`ajar`, {settings['resolution']}², {settings['seconds']:g} s, {settings['seeds']} seeds, each tuned."
    blocks = [sizes, markdown.table(["form, and what is left out", "rate", "final error: median (range)"], rows)]
    long = record.get("at length")
    if long:
        blocks.append(
            f"`indirect-room`, {long['resolution']}², {long['steps']} steps at the rate {long['rate']:g}, {long['seeds']} seeds."
        )
        head = [
            "form, and what is left out",
            "final error: median (range)",
            "highest along a run: median (range)",
            "diverged",
        ]
        rows = [
            [
                name,
                *(f"{f[k][0]:.3f} ({f[k][1]:.3f} to {f[k][2]:.3f})" for k in ("final", "highest")),
                f"{f['diverged']} of {len(f['runs'])}",
            ]
            for name, f in long["methods"].items()
        ]
        blocks.append(markdown.table(head, rows))
    return "\n\n".join(blocks)


def plot(record: Record) -> Figure:
    """Error over the race's seconds, and over the paths of the descents at length; a panel per form."""
    parts = [("ajar, over seconds", record["methods"], 0)]
    if "at length" in record:
        parts.append(("indirect-room, at length, over paths", record["at length"]["methods"], 1))
    panels = {
        f"{title}, {form}": {
            f"{name.partition(', ')[2]}: {found['final'][0]:.3f}": figures.points(found["runs"], column)
            for name, found in methods.items()
            if name.startswith(f"{form}, ")
        }
        for title, methods, column in parts
        for form in FORMS
    }
    return figures.curves(panels, "", columns=2)
