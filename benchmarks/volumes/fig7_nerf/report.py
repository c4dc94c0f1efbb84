"""Table and figure."""

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Final errors at equal time."""
    parts = []
    for entry in record["schedules"].values():
        of = " of {balls} balls" if entry["balls"] else ""
        by = " of the processor" if entry["processor"] else ""
        text = f"`nerf-volume`{of}, {{resolution}}², grids of {{grid}}³, {{kind}} rates, {{seconds:g}} s{by}, {{seeds}} seeds. "
        rows = [
            [
                markdown.fill("{name} | {rate:g} | {final[seen]!m} | {final[unseen]!m}", found),
                ", ".join(map(str, found["steps"])),
            ]
            for found in markdown.named(entry["methods"], "name")
        ]
        head = "method | learning rate | error of views seen | of views unseen | steps"
        parts += [markdown.fill(text + "Errors over the initial ones.", entry), markdown.table(head, rows)]
    return markdown.blocks(*parts)


def plot(record: Record) -> figures.Figure:
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
