"""Table and figure."""

from typing import Any

from matplotlib.figure import Figure

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Final errors by samples of the image, and how many a control variate is worth."""

    def summary(entry: dict[str, Any], timed: bool) -> str:
        middle, low, high = entry["final"]["both"]
        seconds = f", {entry['runs']['both'][0][-1][0]:.0f} s" if timed else ""
        return f"{entry['rate']:g}: {middle:.3f} ({low:.3f} to {high:.3f}){seconds}"

    parts = []
    of_smoke = {name: budget for name, budget in record["budgets"].items() if name in ("steps", "time")}
    others = {name: {name: budget} for name, budget in record["budgets"].items() if name not in of_smoke}
    for title, budgets in {"`smoke`": of_smoke, **others}.items():
        if not budgets:
            continue
        heads = [f"{b['steps']} steps" if "steps" in b else f"{b['seconds']:g} s" for b in budgets.values()]
        first = next(iter(budgets.values()))
        rows = [
            [
                name,
                *(
                    summary(budget["methods"][name], by in of_smoke) if name in budget["methods"] else ""
                    for by, budget in budgets.items()
                ),
            ]
            for name in first["methods"]
        ]
        title = title.replace("steps, ", "`smoke`, ")
        told = [f"{title}, {first['resolution']}², grids of {first['grid']}³, {first['seeds']} seeds."]
        for budget in budgets:
            for name, need in record.get("needs", {}).get(budget, {}).items():
                plain = f"more than {need['more_than']}" if "more_than" in need else f"{need['spp']:.1f}"
                times = f"{'more than ' * ('more_than' in need)}{need['times']:.1f}"
                told.append(
                    f"For the error of {name} spp a plain image needs {plain} spp at equal steps: {times} times the samples."
                )
        parts += [" ".join(told), markdown.table(["image, paths per pixel", *heads], rows)]
    head = "Learning rate of the albedo, error over the initial one: median (range); of `smoke`, seconds of a run."
    return "\n\n".join([head, *parts])


def plot(record: Record) -> Figure:
    """Error over seconds where a race is of smoke, else over paths."""
    panels = {}
    for budget, entry in record["budgets"].items():
        by_paths = budget not in ("steps", "time")
        panels[f"{budget}, over {'paths' if by_paths else 'seconds'}"] = {
            f"{name}: {found['final']['both'][0]:.3f}": figures.points(found["runs"]["both"], int(by_paths))
            for name, found in entry["methods"].items()
        }
    return figures.curves(panels, "", log="")
