"""Table."""

from typing import Any

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Final errors by samples of the image, and how many a control variate is worth."""

    def summary(entry: dict[str, Any]) -> str:
        middle, low, high = entry["final"]["both"]
        return f"{entry['rate']:g}: {middle:.3f} ({low:.3f} to {high:.3f}), {entry['runs']['both'][0][-1][0]:.0f} s"

    settings = record["settings"]
    budgets = record["budgets"]
    heads = [f"{b['steps']} steps" if "steps" in b else f"{b['seconds']:g} s" for b in budgets.values()]
    rows = [
        [name, *(summary(budget["methods"][name]) if name in budget["methods"] else "" for budget in budgets.values())]
        for name in next(iter(budgets.values()))["methods"]
    ]
    needs = []
    for name, need in record.get("needs", {}).items():
        plain = f"more than {need['more_than']}" if "more_than" in need else f"{need['spp']:.1f}"
        times = f"{'more than ' * ('more_than' in need)}{need['times']:.1f}"
        needs.append(
            f"For the error of {name} spp a plain image needs {plain} spp at equal steps: {times} times the samples."
        )
    return (
        f"`smoke`, {settings['resolution']}², grids of {settings['grid']}³, {settings['seeds']} seeds. Learning rate of the albedo, "
        f"error over the initial one: median (range), seconds of a run.\n\n"
        f"{markdown.table(['image, paths per pixel', *heads], rows)}\n\n{' '.join(needs)}"
    )
