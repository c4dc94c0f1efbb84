"""Table and figure."""

import numpy as np

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Held-out PSNR of each, of each capture, resolution and time."""
    races = sorted(record["races"].items(), key=lambda item: (item[1]["pixels"], item[1]["seconds"]))
    return markdown.blocks(*(_race(name, race) for name, race in races))


def _race(name: str, race: Record) -> str:
    rows, tried = [], []
    for who, entry in race["found"].items():
        means = [float(np.mean(one)) for one in entry["psnr"]]
        spread = f" ± {np.std(means):.2f}" if len(means) > 1 else ""
        given = {key: value for key, value in entry.get("settings", {}).items() if value is not False}
        settings = ", ".join(key if value is True else f"{key} {value:g}" for key, value in given.items())
        steps = f"{np.mean(entry['steps']):.0f}" if "steps" in entry else ""
        worst = f"{min(entry['psnr'][0]):.2f}"
        rows.append([who, f"{np.mean(means):.2f}{spread}", worst, len(means), steps, settings])
        for row in entry.get("tried", []):
            rate = f"{row['rate']:g}{' falling' if row.get('falling') else ''}"
            tried.append([who, row["spp"], rate, row["steps"], f"{np.mean(row['psnr']):.2f}"])
    capture, size, _ = name.rsplit(", ", 2)
    counts = f"{race['views']} photographs of {size} pixels along the longer side, {race['held_out']} more held out"
    parts = [
        f"{capture}: {counts}, {race['seconds']:g} s of the processor each.",
        markdown.table(" | held-out PSNR (dB) | the worst of them | seeds | steps | settings", rows),
    ]
    if tried:
        parts.append(markdown.table("tried | spp | rate | steps | held-out PSNR (dB)", tried))
    return markdown.blocks(*parts)


def plot(record: Record) -> figures.Figure:
    """A held-out photograph of the vase that the project renders, and what each makes of it."""
    maps = record["maps"]
    shown = ("photograph", "projection", "stock", "stock-normals", "stages")
    return figures.pictures([{name: maps[name] for name in shown if name in maps}])
