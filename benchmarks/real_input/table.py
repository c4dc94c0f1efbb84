"""Table."""

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """The main job on foreign scenes."""
    rows = []
    for name, methods in record["scenes"].items():
        for method, f in methods.items():
            a, b = f["texture_rmse_where_seen"]
            c, d = f["image_rmse_view0"]
            errors = [f"{a:.3f} → {b:.3f}", f"{f['share_seen']:.0%}", f"{c:.4f} → {d:.4f}"]
            rows.append([name, method, f["steps"], f"{f['seconds']:.0f}", *errors])
    head = ["scene", "method", "steps", "seconds", "texture RMSE where seen", "texels seen", "image RMSE, first view"]
    commands = "\n".join(f["command"] for methods in record["scenes"].values() for f in methods.values())
    return markdown.table(head, rows) + "\n\nThe commands, as the script types them:\n\n```sh\n" + commands + "\n```"
