"""Drawn pixels."""

from __future__ import annotations

from typing import Any

from summaries.tables import table

VARIANCE = """\
Trace of the gradient's covariance for one parameter, the roughness, at its start. The probabilities of "loss" come
from single paths, whose noise counts as loss derivative, as it would for anyone who renders few samples. Five levels
(D = 4) are the paper's default; one is the default here. Where the error is as large as the variance, it is that of one gradient among
1024: a rare bright path in a pixel that the estimate held for quiet."""

EQUAL_TIME = """\
Each method's learning rate tuned over a grid on a seed of its own, constant over the run. `adaptive` measures noise
in units of Adam's steps (each element's variance over its mean squared gradient); "as the paper" is the plain sum of
Eq. 12 with five levels. The machine's speed changed up to twofold between runs, so "over uniform" by time takes paths
at their cost measured in turns.

At equal samples adaptive pixels are ahead of uniform ones on `sun-glossy` and `two-planets` from the second or third
checkpoint on, by up to a sixth, and level on `plain-and-textured`, whose error is half that of one colour, which
wanders with its noise. At equal time part or all of it goes into dearer steps: of `two-planets`, where uniform draws
waste four fifths of their paths on the sky, these cost next to nothing on a processor. In the first tenths every
pixel is wrong, noise matters little, and uneven draws only leave texels waiting. Where the noise of a step does not
limit Adam, nothing is to be gained: with 8192 pixels a step `plain-and-textured` gives the same 0.08 in 200 steps by
any scheme, though the gradient's variance per texel (geometric mean) is 2.4 times smaller.

What was tried, by that variance and by the mean of |E g| / sqrt(E g²), Adam's progress a step, on `two-planets`
(128², 8192 pixels; free and enclosed planet; uniform 0.41 / 0.35, twice as many uniform pixels 0.48 / 0.38): five
levels 0.44 / 0.37; paper's plain sum 0.42 / 0.36; one level 0.48 / 0.39; a longer memory of maps alone 0.47 / 0.40;
cells of one path in place of two 0.52 / 0.41, without a denoiser 0.42 / 0.35; the loss derivative alone 0.49 / 0.39.
So one level, cells of one path and the longer memory are the defaults now. Energies with a floor from their mean,
which few texels with rare bright paths set a thousand times the typical one, lost 0.02 to 0.05 on the enclosed
planet. Not tried: rates that fall, probabilities by variance times cost.

With memories (small pictures, 5 s, before these changes): final errors of adaptive pixels alone 0.411 (range 0.37 to
0.43), with a control variate 0.417 (0.39 to 0.43), whole pictures with one 0.462; coupled meta-estimation 0.465 (0.44
to 0.48) drawn, 0.459 (0.45 to 0.47) whole. So each is level with the better of its parts but for meta-estimation,
which falls short of plain drawn pixels: its steps are dearer, and noise is not what limits so short a descent."""

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
            rows.append([method, f"{run['rate']:g}", f"{entry['errors'][method][-1]:.3f}"])
            for ratios in entry["over uniform"].values():
                rows[-1].append(" ".join(f"{x:.2f}" for x in ratios[method]))
        head = [
            "pixels",
            "rate",
            "error at equal time",
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
