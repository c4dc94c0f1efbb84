"""Tables; `docs/scale.md` has the same ones."""

from benchmarks import markdown
from benchmarks.runner.records import Record
from benchmarks.workers.scale.summary import COUNTS, JOBS, NETWORKS

_MEANING = {
    "driver": ("a step, whatever is computed", "ms", 1e3),
    "parameter": ("each parameter: optimizer, bounds, copies", "ns", 1e9),
    "worker": ("each worker: a call and its reply", "ms", 1e3),
    "gradient": ("each number of each reply: object store, sum", "ns", 1e9),
    "byte": ("each byte from machine to machine, without a limit", "ns", 1e9),
    "trip": ("the link's time there and back", "times", 1.0),
    "transfer": ("bytes over the link's rate", "times", 1.0),
}


def table(record: Record) -> str:
    """All of them."""
    if "costs" not in record:
        return ""
    return "\n\n".join(
        [costs(record), errors(record), *(predictions(record, where) for where in NETWORKS), faults(record)]
    )


def costs(record: Record) -> str:
    """What was fitted."""
    rows = [[text, f"{record['costs'][name] * factor:.3g} {unit}"] for name, (text, unit, factor) in _MEANING.items()]
    return markdown.table(["cost of", "fitted"], rows)


def errors(record: Record) -> str:
    """How far predicted steps are from measured ones."""
    rows = [[name, str(of["count"]), f"{of['median']:.0%}", f"{of['worst']:.0%}"] for name, of in record["fit"].items()]
    return markdown.table(["steps", "how many", "median error", "largest error"], rows)


def predictions(record: Record, where: str) -> str:
    """What is predicted for more workers, for one network."""
    rows = []
    for name, job in JOBS.items():
        for count in COUNTS:
            of = record["predicted"][where][name][str(count)]
            parts = of["parts"]
            wire = parts["byte"] + parts["trip"] + parts["transfer"]
            rows.append(
                [
                    f"{job.parameters / 1e6:.3g}",
                    str(count),
                    *(_seconds(x) for x in (of["compute"], wire, parts["worker"] + parts["gradient"], of["step"])),
                    _seconds(of["simulated"]),
                    f"{100 * of['efficiency']:.2g}%",
                    _seconds(of["compressed"]),
                    _seconds(of["summed_by_machine"]),
                ]
            )
    names = ["million parameters", "GPUs", "render (s)", "link", "calls and sums", "step", "simulated", "efficiency"]
    return f"Predicted, {where}:\n\n" + markdown.table([*names, "compressed", "summed by machine"], rows)


def faults(record: Record) -> str:
    """What losses and stragglers cost."""
    rows = []
    for count in COUNTS:
        of = record["faults"][str(count)]
        row = [str(count)]
        for name in ("lost", "slow"):
            row += [
                _seconds(of[f"{name}_seconds"]),
                _seconds(of[f"{name}_closed"]),
                f"{max(of[f'{name}_share'], 0.0):.2%}",
            ]
        rows.append(row)
    names = ["GPUs", "a loss costs (s), simulated", "closed form", "share of the time"]
    return markdown.table([*names, "a straggler costs (s), simulated", "closed form", "share of the time"], rows)


def _seconds(x: float) -> str:
    return f"{x:.3g}" if x >= 0.005 else "0"
