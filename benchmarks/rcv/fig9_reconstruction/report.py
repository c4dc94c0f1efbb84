"""Table and figure."""

from matplotlib.figure import Figure

from benchmarks import figures, markdown
from benchmarks.runner.records import Record

ORDER = ("stock", "plain", "plain, denoised", "rcv, denoised", "rcv")


def table(record: Record) -> str:
    """Equal-time reconstruction."""
    rows = []
    for entry in record["entries"].values():
        summary = entry["summary"]
        for method in (each for each in ORDER if each in entry["methods"]):
            chosen, row = entry["methods"][method], summary[method]
            middle, low, high = row["final"]
            other = ""
            if method != "rcv":
                reached = [t for t in row["rcv_reaches_its_best_after"] if t is not None]
                share = f"{len(reached)} of {len(entry['methods']['rcv']['runs'])}"
                when = f"{sorted(reached)[len(reached) // 2]:.1f} s ({share})" if reached else "never"
                other = f"{1 / row['ratio']:.2f}× | {row['it_reaches_its_best_after']:.1f} s | {when}"
            else:
                other = "1 | | "
            rows.append(
                [
                    entry["problem"],
                    entry["loss"],
                    f"{entry['seconds']:g} s{' of the processor' if 'processor' in entry else ''}",
                    f"{method} ({chosen['spp']} spp, {chosen['rate']:g})",
                    f"{middle:.3f} ({low:.3f} to {high:.3f})",
                    f"{row['best']:.3f}",
                    *other.split(" | "),
                ]
            )
    head = ["problem", "loss", "budget", "method (spp, rate)", "final error", "best on the way"]
    head += ["× rcv's final", "its best at", "rcv gets there at"]
    return markdown.table(head, rows)


def plot(record: Record) -> Figure:
    """Error over seconds, a panel per problem and loss."""
    panels = {
        name: {
            f"{method}, {found['spp']} spp, rate {found['rate']:g}": [
                tuple(zip((0.0, 1.0), *run, strict=True)) for run in found["runs"]
            ]
            for method, found in entry["methods"].items()
        }
        for name, entry in record["entries"].items()
    }
    return figures.curves(panels, "seconds", log="")
