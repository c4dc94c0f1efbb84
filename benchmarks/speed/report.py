"""Table."""

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Costs as ratios."""
    settings = record["settings"]
    primal, steps, ratios = record["primal_ms"], record["step_ms"], record["step_ratios"]
    variance = [
        [name, *(f"{entry[place]['ratio']:.2f}" if place in entry else "" for place in ("start", "near the truth"))]
        for name, entry in record["gradient_variance"].items()
    ]
    outside = [
        [name, f"{e['wall_ms']:.1f}", f"{e['kernels_ms']:.1f}", f"{e['outside']:.1%}", e["new"]]
        for name, e in record["outside_kernels"].items()
    ]
    return "\n\n".join(
        [
            f"`indirect-room`, {settings['resolution']}², {settings['spp']} spp, milliseconds (median of 15).",
            markdown.table(
                ["primal", "ms", "ratio"],
                [
                    ["plain, this kernel", f"{primal['plain'][0]:.1f}", "1"],
                    [
                        "Mitsuba's prb, primal",
                        f"{primal['mitsuba_prb'][0]:.1f}",
                        f"{primal['pair/plain'] / primal['pair/prb']:.2f}",
                    ],
                    [
                        "**pair**",
                        f"{primal['pair'][0]:.1f}",
                        f"**{primal['pair/plain']:.2f}** ({primal['pair/prb']:.2f} of prb)",
                    ],
                ],
            ),
            markdown.table(
                ["whole step", "ms", "of the stock loop"],
                [
                    ["stock loop", f"{steps['stock']:.1f}", "1"],
                    [
                        "plain, leave-one-out groups",
                        f"{steps['leave-one-out'][0]:.1f}",
                        f"**{ratios['leave-one-out/stock']:.2f}**",
                    ],
                    ["control variate", f"{steps['rcv'][0]:.1f}", f"**{ratios['rcv/stock']:.2f}**"],
                ],
            ),
            "Variance of the gradient, leave-one-out groups over an adjoint on paths of its own, equal spp, L2 (equal is 1):",
            markdown.table(["problem", "at the start", "near the truth"], variance),
            "Time outside kernels at the gallery's default sizes, control variate at 2 spp, and kernels new after warm-up:",
            markdown.table(["problem", "wall ms a step", "kernel ms", "outside", "new kernels"], outside),
        ]
    )
