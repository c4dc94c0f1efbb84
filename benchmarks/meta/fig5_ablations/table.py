"""Table."""

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Meta, Fig. 5."""
    settings = record["settings"]
    rows = [
        [name, f"{f['rate']:g}", f"{f['final'][0]:.3f} ({f['final'][1]:.3f} to {f['final'][2]:.3f})"]
        for name, f in record["methods"].items()
    ]
    sizes = f"`ajar`, {settings['resolution']}², {settings['seconds']:g} s, {settings['seeds']} seeds, each tuned."
    blocks = [sizes, markdown.table(["form, and what is left out", "rate", "final error: median (range)"], rows)]
    long = record.get("at length")
    if long:
        blocks.append(
            f"`indirect-room`, {long['resolution']}², {long['steps']} steps at the rate {long['rate']:g}, {long['seeds']} seeds."
        )
        head = [
            "form, and what is left out",
            "final error: median (range)",
            "highest along a run: median (range)",
            "diverged",
        ]
        rows = [
            [
                name,
                *(f"{f[k][0]:.3f} ({f[k][1]:.3f} to {f[k][2]:.3f})" for k in ("final", "highest")),
                f"{f['diverged']} of {len(f['runs'])}",
            ]
            for name, f in long["methods"].items()
        ]
        blocks.append(markdown.table(head, rows))
    return "\n\n".join(blocks)
