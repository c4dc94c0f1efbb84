"""Table."""

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Variances per problem and image, then the races."""
    settings, parts = record["settings"], []
    for image, summary in record["summary"].items():
        entries = {name: entry[image] for name, entry in record["variance"].items() if image in entry}
        steps = [str(point["step"]) for point in next(iter(entries.values()))]
        rows = [[name, *map(_cell, points), f"{points[-1]['cost']:.2f}"] for name, points in entries.items()]
        plain, relative = summary["mean"]
        parts += [
            f"**{image}**, variance of the gradient over that with equal numbers, {settings['spp']} samples per pixel on average: plain / "
            f"relative; λ; after so many steps. Geometric means at the end: {plain:.2f} / {relative:.2f}.",
            markdown.table(["problem", *steps, "counted cost of a path"], rows),
        ]
    for name, entry in record["equal_time"].items():
        rows = []
        for method, ratios in entry["over it"].items():
            race, time = record["races"][name][method], entry["time"][method]
            per_path = record["seconds_per_path"][name][method]
            rows.append(
                [
                    method,
                    f"{race['rate']:g}",
                    f"{entry['errors'][method][-1]:.3f}",
                    " ".join(f"{x:.2f}" for x in ratios),
                    "never" if time is None else f"{time:.2f}",
                    f"{per_path * 1e6:.2f}",
                ]
            )
        head = [
            "samples per pixel",
            "rate",
            "error at equal time",
            f"over {entry['best equal']}, at tenths of the time",
            "time to its last error, of all time",
            "µs a path",
        ]
        parts += [f"**{name}**, with a control variate, at equal processor time.", markdown.table(head, rows)]
    return markdown.blocks(*parts)


def _cell(point: dict) -> str:
    plain, relative = point["ratio"]
    return f"{plain:.2f} / {relative:.2f} ± {point['error'][1]:.1g}; {point['uniform']:.2g}"
