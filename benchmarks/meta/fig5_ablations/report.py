"""Table and figure."""

from benchmarks import figures, markdown
from benchmarks.meta.fig5_ablations.run import FORMS
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Meta, Fig. 5."""
    blocks = [
        "`ajar`, {resolution}², {seconds:g} s, {seeds} seeds, each tuned.".format(**record["settings"]),
        markdown.records(
            "form, and what is left out | rate | final error: median (range)",
            "{name} | {rate:g} | {final!m}",
            markdown.named(record["methods"], "name"),
        ),
    ]
    if long := record.get("at length"):
        head = (
            "form, and what is left out | final error: median (range) | highest along a run: median (range) | diverged"
        )
        row = "{name} | {final!m} | {highest!m} | {diverged} of "
        rows = ([markdown.fill(row, f) + str(len(f["runs"]))] for f in markdown.named(long["methods"], "name"))
        text = "`indirect-room`, {resolution}², {steps} steps at the rate {rate:g}, {seeds} seeds.".format(**long)
        blocks += [text, markdown.table(head, rows)]
    return markdown.blocks(*blocks)


def plot(record: Record) -> figures.Figure:
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
