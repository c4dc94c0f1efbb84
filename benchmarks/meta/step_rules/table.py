"""Table."""

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Errors along the descents, and the wander of noise."""
    settings, walks = record["settings"], record["wander"]
    rows = []
    for name, f in record["methods"].items():
        errors = [f"{e[1]:.3f}" for e in f["errors"][:-1]]
        low, middle, high = f["errors"][-1]
        tried = ", ".join(f"{rate:g}: {error:.3f}" for rate, error in f["tried"])
        rows.append(
            [name, str(f["steps"]), f"{f['rate']:g}", *errors, f"{middle:.3f} ({low:.3f} to {high:.3f})", tried]
        )
    head = ["method", "steps", "rate", *(f"at {n} %" for n in (20, 40, 60, 80)), "end (quartiles)", "all rates"]
    of_adam = walks["Adam, 2 spp"]
    moved = [[name, f"{way:.1f}", f"{way / of_adam:.2f}"] for name, way in walks.items()]
    text = f"How far {settings['wander_steps']} steps move an element in noise, in learning rates, and over Adam's:"
    return "\n\n".join(
        [
            f"Median error over the start's, {settings['trials']} trials.",
            markdown.table(head, rows),
            text,
            markdown.table(["method", "deviation", "over Adam's"], moved),
        ]
    )
