"""Tables."""

from benchmarks import markdown
from benchmarks.derivative_bias import METHODS
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """The bias, and where descents end."""
    settings, network = record["settings"], record["network"]
    sizes = (
        f"{settings['resolution']}², {settings['spp']} spp, {settings['runs']} runs, step {settings['step']}; relative to the derivative's "
        f"mean. The network tells {network['accuracy']:.0%} of new crops, by chance {network['chance']:.0%}."
    )
    found = record["bias"]["losses"]["perceptual"]
    rows = []
    for method in METHODS:
        f = found[method]
        rows.append(
            [
                method,
                f"{f['rms']:.2f} ({f['square']:.3f} ± {f['square_error']:.3f})",
                f"{f['signed']:+.1%} ± {f['signed_error']:.1%}",
                f"{f['variance']:.2f}",
            ]
        )
    parts = [sizes, markdown.table(["image", "bias, RMS over pixels (its square)", "mean bias", "variance"], rows)]
    if "methods" in record:
        rows = []
        for name, entry in record["methods"].items():
            (features, *of_features), (texture, *of_texture) = entry["final"]["features"], entry["final"]["texture"]
            rows.append(
                [
                    name,
                    f"{entry['rate']:g}",
                    f"{features:.4f} ({of_features[0]:.4f} to {of_features[1]:.4f})",
                    f"{texture:.3f} ({of_texture[0]:.3f} to {of_texture[1]:.3f})",
                ]
            )
        parts.append(f"After {settings['steps']} steps, over the start, {settings['seeds']} seeds: median (range).")
        parts.append(markdown.table(["image", "learning rate", "distance of features", "error of the texture"], rows))
    return "\n\n".join(parts)
