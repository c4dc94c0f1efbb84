"""Table and figure."""

from matplotlib.figure import Figure

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """What probabilities from few paths cost, and how far their maps are from one of many."""
    settings = record["settings"]
    kinds = ("few", "few, denoised", "many")
    gains = [
        [name, *(f"{entry[k]['mean']:.2f} ± {entry[k]['error']:.2f}, worst {entry[k]['worst']:.2f}" for k in kinds)]
        for name, entry in record["variance"].items()
    ]
    rows = [
        [name, *(f"{entry[spp]:.2f}" for spp in ("2", "4", "16", "64")), f"{entry['many']:.2f}"]
        for name, entry in record["correlation"].items()
    ]
    many = settings["many"]
    head = ["problem", "2 paths per pixel", "4", "16", "64", f"{many}, with another of {many}"]
    paths = ("4 paths per pixel", "4, denoised", f"{many}")
    return (
        f"Variance over that of uniform draws.\n\n{markdown.table(['problem', *paths], gains)}\n\n"
        f"Correlation of the logarithms of probabilities with those from {many} paths per pixel.\n\n{markdown.table(head, rows)}"
    )


def plot(record: Record) -> Figure:
    """Per problem: the picture, and maps of probabilities from few paths and from many."""
    maps = record["maps"]
    rows = [
        {name: maps[f"{name}|reference"]}
        | {f"{kind}: variance × {found[kind]['mean']:.2f}": maps[f"{name}|{kind}"] for kind in ("few", "many")}
        for name, found in record["variance"].items()
    ]
    return figures.pictures(rows, cmap="magma", norm="log")
