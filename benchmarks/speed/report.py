"""Table."""

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Costs as ratios."""
    primal, steps, ratios = record["primal_ms"], record["step_ms"], record["step_ratios"]
    images = [
        ["plain, this kernel", f"{primal['plain'][0]:.1f}", "1"],
        [
            "Mitsuba's prb, primal",
            f"{primal['mitsuba_prb'][0]:.1f}",
            f"{primal['pair/plain'] / primal['pair/prb']:.2f}",
        ],
        ["**pair**", f"{primal['pair'][0]:.1f}", f"**{primal['pair/plain']:.2f}** ({primal['pair/prb']:.2f} of prb)"],
    ]
    whole = [["stock loop", f"{steps['stock']:.1f}", "1"]]
    for key, name in {"leave-one-out": "plain, leave-one-out groups", "rcv": "control variate"}.items():
        whole.append([name, f"{steps[key][0]:.1f}", f"**{ratios[f'{key}/stock']:.2f}**"])
    variance = [
        [name, *(f"{entry[place]['ratio']:.2f}" if place in entry else "" for place in ("start", "near the truth"))]
        for name, entry in record["gradient_variance"].items()
    ]
    return markdown.blocks(
        "`indirect-room`, {resolution}², {spp} spp, milliseconds (median of 15).".format(**record["settings"]),
        markdown.table("primal | ms | ratio", images),
        markdown.table("whole step | ms | of the stock loop", whole),
        "Variance of the gradient, leave-one-out groups over an adjoint on paths of its own, equal spp, L2 (equal is 1):",
        markdown.table("problem | at the start | near the truth", variance),
    )
