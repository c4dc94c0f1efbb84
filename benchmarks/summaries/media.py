"""Participating media."""

from __future__ import annotations

from typing import Any

from summaries.tables import table

COST = """\
Ratios of medians, 10th to 90th percentile; the machine was busy with other work, so they are rough."""

GRADIENTS = """\
Derivative of the mean picture along one direction each, against finite differences: z-scores of the difference.
Mitsuba's `prbvolpath` is biased where the medium is empty or black, and of the wrong sign where density is at the
majorant."""


def cost(found: dict[str, Any]) -> str:
    """Ratios."""
    rows = [[name, f"{m:.2f}", f"{low:.2f} to {high:.2f}"] for name, (low, m, high) in found["ratios"].items()]
    what = "A sparse grid" if found.get("sparse") else "`smoke`"
    size = (
        f"{what}, {found['resolution']}², a grid of {found['grid']}³, {found['spp']} spp, {found['repeats']} repeats."
    )
    return f"{size}\n\n{table(['ratio', 'median', 'range'], rows)}"


def gradients(found: dict[str, Any]) -> str:
    """z-scores."""
    rows = []
    for name, e in found["directions"].items():
        value, error = e["finite differences"]
        ours, theirs = e["differential ratio tracking"], e["prbvolpath"]
        rows.append([name, f"{value:.3g} ± {error:.1g}", *(f"{v:.3g}, z {z:.1f}" for v, _, z in (ours, theirs))])
    head = ["direction", "finite differences", "here", "`prbvolpath`"]
    return f"{found['runs']} runs of {found['spp']} spp, depth {found['depth']}.\n\n{table(head, rows)}"


DRIFT = """\
With plain L1 gradients the noise of the picture drives paint and fog away from the truth, the more the fewer samples; with a
control variate they stay, within two standard errors or a hundredth. With L2 nothing drifts significantly. The metal's roughness, of
which the picture says little, wanders in all rows, and only upwards with plain L1."""


def drift(found: dict[str, Any]) -> str:
    """Distances from the truth."""
    keys = list(next(iter(found["drift"].values())))
    rows = [
        [name, *(f"{100 * mean:+.1f} ± {100 * error:.1f} %" for mean, error in entry.values())]
        for name, entry in found["drift"].items()
    ]
    settings = found["settings"]
    return (
        f"`three-bodies`, {settings['resolution']}², {settings['steps']} steps, learning rate {found['rate']:g}, "
        f"{settings['seeds']} seeds.\n\n{table(['loss, method', *keys], rows)}"
    )


SMOKE = ""

NERF = ""


def smoke(found: dict[str, Any]) -> str:
    """Final errors by samples of the picture."""

    def told(entry: dict[str, Any]) -> str:
        middle, low, high = entry["final"]
        return f"{entry['rate']:g}: {middle:.3f} ({low:.3f} to {high:.3f})"

    settings = found["settings"]
    heads = {"time": f"{settings['seconds']:g} s", "steps": f"{settings['steps']} steps"}
    budgets = [budget for budget in heads if budget in found]
    rows = [[name, *(told(found[budget][name]) for budget in budgets)] for name in found[budgets[0]]]
    return (
        f"`smoke`, {settings['resolution']}², grids of {settings['grid']}³, {settings['seeds']} seeds. Learning rate, error over "
        f"the initial one: median (range).\n\n"
        f"{table(['picture, paths per pixel', *(heads[budget] for budget in budgets)], rows)}"
    )


def nerf(found: dict[str, Any]) -> str:
    """Final errors at equal time."""
    rows = [
        [name, f"{e['rate']:g}", "{:.3f} ({:.3f} to {:.3f})".format(*e["final"]), str(len(e["runs"][0]))]
        for name, e in found["methods"].items()
    ]
    s = found["settings"]
    head = ["method", "learning rate", "error over the initial one", "points on the curve"]
    return f"`nerf-volume`, {s['resolution']}², grids of {s['grid']}³, {s['seconds']:g} s, {s['seeds']} seeds.\n\n{table(head, rows)}"


def memory(found: dict[str, Any]) -> str:
    """Gigabytes, and copies of the unknowns."""
    grids = [key for key in next(iter(found["methods"].values())) if key.isdigit()]
    rows = [
        [by, *(f"{entry[grid]['bytes'] / 1e9:.2f} GB, {entry[grid]['copies']:.1f}" for grid in grids)]
        for by, entry in found["methods"].items()
    ]
    return (
        "Greatest resident size of the process, and what it has more than at 16³ in copies of the unknowns (extinction and "
        f"emission, 16 bytes a voxel).\n\n{table(['method', *(f'{grid}³' for grid in grids)], rows)}"
    )
