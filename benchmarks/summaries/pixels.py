"""Drawn pixels."""

from __future__ import annotations

from typing import Any

from summaries.tables import table

VARIANCE = """\
Trace of the gradient's covariance for one parameter, the roughness, at its start. The probabilities of "loss" come
from single paths, whose noise counts as loss derivative, as it would for anyone who renders few samples."""

EQUAL_TIME = """\
Each method's learning rate tuned over a grid on a seed of its own, constant over the run. `adaptive` measures noise
in units of Adam's steps (each element's variance over its mean squared gradient); "paper's variance" is the plain sum
of Eq. 12. Measured before the maps of all views were denoised in one picture, which took most of a refresh on `two-
planets` and `sun-glossy`.

Adaptive pixels are ahead at the end on `sun-glossy` and for the first half on `two-planets`, and gain nothing on
`plain-and-textured`. Why not more: at first every pixel is wrong and noise matters little, so uneven draws only leave
texels waiting; and what uniform draws waste, they waste cheaply: a path that leaves the scene at once costs next to
nothing, and a uniform step of `two-planets` takes half the time of an adaptive one. Tried, 150 steps, three seeds,
error of adaptive over uniform on `sun-glossy` (L2) / `plain-and-textured` / `two-planets`: paper's variance, 1024 to
512 paths a refresh 0.87 / 1.13 / 1.00; relative variance 0.84 / 1.75 / 1.00; one level 0.81 / 1.14 / 0.99; a uniform
share of 0.3 0.83 / 1.11 / 0.98; 8192 paths a refresh 0.78 / 0.94 / 0.91, with one level 0.72 / 1.03 / 0.88, with the
paper's variance 0.85 / 1.22 / 0.97. So refreshes now take 4096 paths at least. Not tried: probabilities by variance
times cost, rates that fall."""

FAILURE = """\
Taken as they come, probabilities from 4 paths per pixel make the caustic's gradient noisier than uniform draws do, as
the paper found; the same paths serve the other two scenes. Denoised, as `Adaptive` does by default, they serve the
caustic too, at half as much variance again as probabilities from 1024 paths."""


def variance(found: dict[str, Any]) -> str:
    """Per scheme."""
    rows = [
        [name, f"{e['variance']:.3g} ± {e['error']:.1g}", f"{e['z']:.1f}" if "z" in e else ""]
        for name, e in found["schemes"].items()
    ]
    ratios = ", ".join(f"{name} {ratio:.2f}" for name, ratio in found["ratios"].items())
    head = ["scheme", "variance at equal paths", "mean against all pixels, z"]
    settings = found["settings"]
    return (
        f"`mirror-trio`, {settings['resolution']}², {settings['count']} pixels with two paths each, {settings['runs']} runs.\n\n"
        f"{table(head, rows)}\n\nRatios: {ratios}."
    )


def equal_time(found: dict[str, Any]) -> str:
    """Per task: final errors, and ratios to uniform at checkpoints."""
    parts = []
    for name, entry in found["entries"].items():
        rows = []
        for method, run in entry["methods"].items():
            middle, least, most = run["final"]
            rows.append([method, f"{run['rate']:g}", f"{middle:.3f} ({least:.3f} to {most:.3f})"])
            for ratios in entry["over uniform"].values():
                rows[-1].append(" ".join(f"{x:.2f}" for x in ratios[method]))
        head = [
            "pixels",
            "rate",
            "final error",
            *(f"over uniform, at tenths of the {by}" for by in entry["over uniform"]),
        ]
        sizes = ", ".join(f"{key}={value}" for key, value in entry["options"].items())
        told = f"{entry['count']} pixels a step, {entry['seconds']:g} s, {entry['seeds']} seeds"
        parts.append(f"**{name}**{f' ({sizes})' if sizes else ''}, {told}.\n\n{table(head, rows)}")
    return "\n\n".join(parts)


def failure(found: dict[str, Any]) -> str:
    """What probabilities from few paths cost, and how far their maps are from one of many."""
    kinds = ("few", "few, denoised", "many")
    gains = [
        [name, *(f"{entry[k]['mean']:.2f} ± {entry[k]['error']:.2f}, worst {entry[k]['worst']:.2f}" for k in kinds)]
        for name, entry in found["variance"].items()
    ]
    rows = [
        [name, *(f"{entry[spp]:.2f}" for spp in ("2", "4", "16", "64")), f"{entry['many']:.2f}"]
        for name, entry in found["correlation"].items()
    ]
    many = found["settings"]["many"]
    head = ["problem", "2 paths per pixel", "4", "16", "64", f"{many}, with another of {many}"]
    paths = ("4 paths per pixel", "4, denoised", f"{many}")
    return (
        f"Variance over that of uniform draws.\n\n{table(['problem', *paths], gains)}\n\n"
        f"Correlation of the logarithms of probabilities with those from {many} paths per pixel.\n\n{table(head, rows)}"
    )


def cost(found: dict[str, Any]) -> str:
    """Refreshes, picture sizes, memory."""
    rows = [
        [name, f"{e['uniform']:.1f}", f"{e['kept']:.1f}", f"{e['refreshed']:.1f}", f"{e['share']:.1%}"]
        for name, e in found["refresh"].items()
    ]
    sizes = found["step_ms"]
    first = next(iter(sizes.values()))
    by_size = [[f"{size}²", f"{ms:.1f}", f"{ms / first:.3f}"] for size, ms in sizes.items()]
    memory = found["memory"]
    where = "host memory" if memory["host"] else "the device"
    return "\n\n".join(
        [
            f"{found['settings']['count']} pixels a step, milliseconds of a step:",
            table(["problem", "uniform", "adaptive, kept", "refreshed every 20", "share of refreshing"], rows),
            "By the size of the picture, refreshes included, `plain-and-textured`:",
            table(["picture", "ms a step", "over the smallest"], by_size),
            f"16 views of 4 megapixels: at most {memory['peak_gb']:.2f} GB resident, references in {where}.",
        ]
    )
