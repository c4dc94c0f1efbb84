"""Table and figure."""

import numpy as np
from matplotlib.figure import Figure

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Held-out PSNR of each, of each capture, resolution and time."""
    races = sorted(record["races"].items(), key=lambda item: (item[1]["pixels"], item[1]["seconds"]))
    return "\n\n".join(_race(name, race) for name, race in races)


def _race(name: str, race: Record) -> str:
    rows = []
    for who, entry in race["found"].items():
        means = [float(np.mean(one)) for one in entry["psnr"]]
        spread = f" ± {np.std(means):.2f}" if len(means) > 1 else ""
        given = {key: value for key, value in entry.get("settings", {}).items() if value is not False}
        settings = ", ".join(key if value is True else f"{key} {value:g}" for key, value in given.items())
        steps = f"{np.mean(entry['steps']):.0f}" if "steps" in entry else ""
        rows.append(
            [who, f"{np.mean(means):.2f}{spread}", f"{min(entry['psnr'][0]):.2f}", str(len(means)), steps, settings]
        )
    capture, size, _ = name.rsplit(", ", 2)
    counts = f"{race['views']} photographs of {size} pixels along the longer side, {race['held_out']} more held out"
    said = f"{capture}: {counts}, {race['seconds']:g} s of the processor each."
    head = ["", "held-out PSNR (dB)", "the worst of them", "seeds", "steps", "settings"]
    tried = [
        [
            who,
            str(row["spp"]),
            f"{row['rate']:g}{' falling' if row.get('falling') else ''}",
            str(row["steps"]),
            f"{np.mean(row['psnr']):.2f}",
        ]
        for who, entry in race["found"].items()
        for row in entry.get("tried", [])
    ]
    columns = ["tried", "spp", "rate", "steps", "held-out PSNR (dB)"]
    return f"{said}\n\n{markdown.table(head, rows)}" + (f"\n\n{markdown.table(columns, tried)}" if tried else "")


def plot(record: Record) -> Figure:
    """A held-out photograph of the vase that the project renders, and what each makes of it."""
    maps = record["maps"]
    shown = ("photograph", "projection", "stock", "stock-normals", "stages")
    return figures.pictures([{name: maps[name] for name in shown if name in maps}])
