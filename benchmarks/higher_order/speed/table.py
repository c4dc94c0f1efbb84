"""Table."""

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Milliseconds per perturbation."""
    settings = record["settings"]
    parts = [f"`bunny`, {settings['resolution']}², {settings['spp']} spp, milliseconds per perturbed render."]
    meshes = record["meshes"]
    sizes = [row["size"] for row in next(iter(meshes.values()))["batches"]]
    rows = []
    for name, entry in meshes.items():
        rows.append([f"{name}: call", *(f"{row['wall']:.2f}" for row in entry["batches"]), f"{entry['moved']:.1f}"])
        rows.append([f"{name}: kernels", *(f"{row['kernels']:.2f}" for row in entry["batches"]), ""])
        rows.append([f"{name}: call / kernels", *(f"{r['wall'] / r['kernels']:.2f}" for r in entry["batches"]), ""])
        faster = (f"{entry['moved'] / row['wall']:.1f}×" for row in entry["batches"])
        rows.append([f"{name}: faster than moved vertices", *faster, ""])
    parts.append(markdown.table(["", *(f"batch of {size}" for size in sizes), "moved vertices"], rows))
    return "\n\n".join(parts)
