"""Table and figure."""

from benchmarks import figures, markdown
from benchmarks.runner.records import Record

ORDER = ("stock", "plain", "plain, denoised", "rcv, denoised", "rcv")


def table(record: Record) -> str:
    """Equal-time reconstruction."""
    rows = []
    for entry in record["entries"].values():
        for method in (each for each in ORDER if each in entry["methods"]):
            found, others = {**entry, **entry["methods"][method], **entry["summary"][method]}, ["1", "", ""]
            if method != "rcv":
                reached = sorted(t for t in found["rcv_reaches_its_best_after"] if t is not None)
                share = f"{len(reached)} of {len(entry['methods']['rcv']['runs'])}"
                when = f"{reached[len(reached) // 2]:.1f} s ({share})" if reached else "never"
                others = [f"{1 / found['ratio']:.2f}×", f"{found['it_reaches_its_best_after']:.1f} s", when]
            clock = " of the processor" if "processor" in entry else ""
            row = f"{{problem}} | {{loss}} | {{seconds:g}} s{clock} | {method} ({{spp}} spp, {{rate:g}}) | {{final!m}} | {{best:.3f}}"
            rows.append([markdown.fill(row, found), *others])
    head = "problem | loss | budget | method (spp, rate) | final error | best on the way | × rcv's final | its best at"
    return markdown.table(f"{head} | rcv gets there at", rows)


def plot(record: Record) -> figures.Figure:
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
