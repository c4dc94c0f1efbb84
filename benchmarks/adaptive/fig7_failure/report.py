"""Table and figure."""

from benchmarks import figures, markdown
from benchmarks.runner.records import Record

KINDS = ("few", "few, denoised", "many")


def table(record: Record) -> str:
    """What probabilities from few paths cost, and how far their maps are from one of many."""
    many = record["settings"]["many"]
    cells = (f"{{{kind}[mean]:.2f}} ± {{{kind}[error]:.2f}}, worst {{{kind}[worst]:.2f}}" for kind in KINDS)
    gains = markdown.records(
        f"problem | 4 paths per pixel | 4, denoised | {many}",
        " | ".join(["{name}", *cells]),
        markdown.named(record["variance"], "name"),
    )
    correlation = markdown.table(
        f"problem | 2 paths per pixel | 4 | 16 | 64 | {many}, with another of {many}",
        [
            [name, *(f"{entry[spp]:.2f}" for spp in ("2", "4", "16", "64", "many"))]
            for name, entry in record["correlation"].items()
        ],
    )
    text = f"Correlation of the logarithms of probabilities with those from {many} paths per pixel."
    return markdown.blocks("Variance over that of uniform draws.", gains, text, correlation)


def plot(record: Record) -> figures.Figure:
    """Per problem: the picture, and maps of probabilities from few paths and from many."""
    maps = record["maps"]
    rows = [
        {name: maps[f"{name}|reference"]}
        | {f"{kind}: variance × {found[kind]['mean']:.2f}": maps[f"{name}|{kind}"] for kind in ("few", "many")}
        for name, found in record["variance"].items()
    ]
    return figures.pictures(rows, cmap="magma", norm="log")
