"""Table and figure."""

from typing import Any

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Final errors by samples of the image, and how many a control variate is worth."""
    of_smoke = {name: budget for name, budget in record["budgets"].items() if name in ("steps", "time")}
    others = {name: {name: budget} for name, budget in record["budgets"].items() if name not in of_smoke}
    parts = ["Learning rate of the albedo, error over the initial one: median (range); of `smoke`, seconds of a run."]
    for title, budgets in {"`smoke`": of_smoke, **others}.items():
        if not budgets:
            continue
        heads = (f"{b['steps']} steps" if "steps" in b else f"{b['seconds']:g} s" for b in budgets.values())
        first = next(iter(budgets.values()))
        rows = [
            [name, *(_summary(budget["methods"].get(name), by in of_smoke) for by, budget in budgets.items())]
            for name in first["methods"]
        ]
        told = [
            title.replace("steps, ", "`smoke`, ") + ", {resolution}², grids of {grid}³, {seeds} seeds.".format(**first)
        ]
        for need in (
            need for budget in budgets for need in markdown.named(record.get("needs", {}).get(budget, {}), "name")
        ):
            more = "more than " if "more_than" in need else ""
            plain = f"more than {need['more_than']}" if more else f"{need['spp']:.1f}"
            told.append(f"For the error of {need['name']} spp a plain image needs {plain} spp at equal steps:")
            told.append(f"{more}{need['times']:.1f} times the samples.")
        parts += [" ".join(told), markdown.table(" | ".join(["image, paths per pixel", *heads]), rows)]
    return markdown.blocks(*parts)


def _summary(entry: dict[str, Any] | None, timed: bool) -> str:
    if entry is None:
        return ""
    return markdown.fill("{rate:g}: {final[both]!m}" + (", {runs[both][0][-1][0]:.0f} s" if timed else ""), entry)


def plot(record: Record) -> figures.Figure:
    """Error over seconds where a race is of smoke, else over paths."""
    panels = {}
    for budget, entry in record["budgets"].items():
        by_paths = budget not in ("steps", "time")
        panels[f"{budget}, over {'paths' if by_paths else 'seconds'}"] = {
            f"{name}: {found['final']['both'][0]:.3f}": figures.points(found["runs"]["both"], int(by_paths))
            for name, found in entry["methods"].items()
        }
    return figures.curves(panels, "", log="")
