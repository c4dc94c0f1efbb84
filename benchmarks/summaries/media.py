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


SMOKE = """\
L1 sees the noise of a picture: at 1 spp plain gradients hardly move, and at a higher rate (0.003) the error rises above the initial
one. With a control variate a picture at 1 spp does what one at 21 does without, and one at 2 spp what one at 32 does: more than the
paper's 4 to 8. These are 300 steps on small films, which leave 0.7 of the error. At equal time the control variate is ahead too.
Rates: 0.001, 0.0018 and 0.003 from 4 spp on at equal steps, elsewhere a factor of 3 apart. Two things kept an earlier race from showing
anything: the tuned rate was not extinction's, which the problem gives a rate of its own (now both move together), and albedo counted in
voxels without smoke, where no picture tells it: its error over all voxels grows to 1.2 to 1.5 of the initial one wherever the smoke is
found. So errors here are of extinction and of extinction times albedo."""

NERF = """\
Meta-estimation in the paper's form loses to Adam at 2, 4 and 8 spp at equal time. The best of its forms, the coupled one on a control
variate's images at 8 spp, beats Adam at 2 and 4 spp and loses to 8. Its steps are dear: beside the paths, a step pays for gradients,
differences, mean squares and variances of a million unknowns. With a grid of 64³, films of 64² and 8 views, steps of Adam at 2, 4 and 8
spp took 106, 151 and 260 ms in a trial, those of the paper's form 303, of the coupled one at 3 spp 229; with a grid of 16³ 86, 146,
199, 193 and 144. So samples cost little beside it, and every method gains by more of them. Step by step the order is another: on a
control variate's images at 8 spp, 40 steps come below 93 of Adam's at 4 spp, and near 60 of Adam's at 8. Views between those seen gain
little in any descent, most at low rates and in the forms with a memory; they are not what was tuned. None but Adam at 2 spp made more
than 100 steps. Constant rates over 12 s, tried for three of the methods, gave the same order (Adam at 2 spp 0.34, coupled 0.37, the
paper's form 0.43), but two seconds of the latter two went to kernels that were recorded anew within the run's clock."""


def smoke(found: dict[str, Any]) -> str:
    """Final errors by samples of the picture, and how many a control variate is worth."""

    def told(entry: dict[str, Any]) -> str:
        middle, low, high = entry["final"]["both"]
        return f"{entry['rate']:g}: {middle:.3f} ({low:.3f} to {high:.3f}), {entry['runs']['both'][0][-1][0]:.0f} s"

    settings = found["settings"]
    heads = {"steps": f"{settings['steps']} steps", "time": f"{settings['seconds']:g} s"}
    budgets = [budget for budget in heads if budget in found]
    rows = [
        [name, *(told(found[budget][name]) if name in found[budget] else "" for budget in budgets)]
        for name in found[budgets[0]]
    ]
    needs = []
    for name, need in found["needs"].items():
        plain = f"more than {need['more_than']}" if "more_than" in need else f"{need['spp']:.1f}"
        times = f"{'more than ' * ('more_than' in need)}{need['times']:.1f}"
        needs.append(
            f"For the error of {name} spp a plain picture needs {plain} spp at equal steps: {times} times the samples."
        )
    return (
        f"`smoke`, {settings['resolution']}², grids of {settings['grid']}³, {settings['seeds']} seeds. Learning rate of the albedo, "
        f"error over the initial one: median (range), seconds of a run.\n\n"
        f"{table(['picture, paths per pixel', *(heads[budget] for budget in budgets)], rows)}\n\n{' '.join(needs)}"
    )


def nerf(found: dict[str, Any]) -> str:
    """Final errors at equal time."""
    parts = []
    for kind, methods in found["schedules"].items():
        rows = [
            [
                name,
                f"{e['rate']:g}",
                *("{:.3f} ({:.3f} to {:.3f})".format(*e["final"][views]) for views in ("seen", "unseen")),
                ", ".join(map(str, e["steps"])),
            ]
            for name, e in methods.items()
        ]
        s = found["settings"][kind]
        head = ["method", "learning rate", "error of views seen", "of views unseen", "steps"]
        parts.append(
            f"`nerf-volume`, {s['resolution']}², grids of {s['grid']}³, {kind} rates, {s['seconds']:g} s, {s['seeds']} seeds. "
            f"Errors over the initial ones.\n\n{table(head, rows)}"
        )
    return "\n\n".join(parts)


WEIGHTS = """\
Weights and variance settle within some twenty steps. The variance rises again while paint and metal reach their values, from step 35 to 75
or so, and settles at a twentieth of a plain render's. Roughness, of which the picture says little, is the least certain in both."""

LANDSCAPE = """\
As in the paper: noise moves the minimum of both losses towards thinner fog, but the zero of the derivative of L1 alone, which a descent
finds; L2's is at the truth within two standard errors."""

DRAWN = """\
Of smoke, drawn pixels of any scheme find little within this budget: each voxel is met by a few paths a step, and all pixels that show
smoke are about as noisy and as telling as the next. Adaptive ones are no better than uniform ones here, and their steps dearer; those in
proportion to the loss derivative gain a little."""


def drawn(found: dict[str, Any]) -> str:
    """Final errors, and ratios to uniform draws."""
    rows = [
        [
            name,
            f"{e['rate']:g}",
            "{:.3f} ({:.3f} to {:.3f})".format(*e["final"]["both"]),
            *(" ".join(f"{x:.3f}" for x in ratios[name][1::3]) for ratios in found["over uniform"].values()),
        ]
        for name, e in found["methods"].items()
    ]
    s = found["settings"]
    head = [
        "pixels",
        "learning rate",
        "final error",
        *(f"over uniform, at .2 .5 .8 of the {by}" for by in found["over uniform"]),
    ]
    return (
        f"`smoke`, {s['resolution']}², grids of {s['grid']}³, {s['count']} pixels a step, L2, {s['seconds']:g} s, {s['seeds']} seeds.\n\n"
        f"{table(head, rows)}"
    )


def weights(found: dict[str, Any]) -> str:
    """Along one descent."""
    steps = [n for n in (1, 5, 20, 50, 100, 200, 500) if n < len(found["weight"])] + [len(found["weight"]) - 1]
    rows = [
        [
            str(n),
            f"{found['weight'][n]:.3f}",
            f"{found['weight_10_50_90'][1][n]:.3f}",
            f"{found['variance_ratio'][n]:.3f} ± {found['variance_ratio_error'][n]:.3f}",
        ]
        for n in steps
    ]
    keys = list(found["errors"]["rcv"])
    ends = [[method, *(_median(runs[key]) for key in keys)] for method, runs in found["errors"].items()]
    s = found["settings"]
    return (
        f"`three-bodies`, {s['resolution']}², {s['spp']} spp, L1, Adam at {s['rate']:g}, {s['steps']} steps; weights and variance over "
        f"{s['runs']} runs along one descent's path.\n\n"
        f"{table(['step', 'weight, mean over pixels', 'median', 'variance over that of a plain render'], rows)}\n\n"
        f"Errors over the initial ones, mean of the last fifth of the steps: median of {s['seeds']} seeds (range).\n\n"
        f"{table(['picture', *keys], ends)}"
    )


def _median(runs: list[list[float]]) -> str:
    last = sorted(sum(run[-(len(run) // 5) :]) / (len(run) // 5) for run in runs)
    return f"{last[len(last) // 2]:.3f} ({last[0]:.3f} to {last[-1]:.3f})"


def landscape(found: dict[str, Any]) -> str:
    """Where the mean loss is least, and where its mean derivative is zero."""

    def told(name: str, spp: str, what: str) -> str:
        place, error = found["places"][name][spp][what], found["errors"][name][spp][what]
        if place is None:
            return "outside"
        return f"{place:.3f}" + ("" if error is None else f" ± {error:.3f}")

    rows = [
        [name, spp, told(name, spp, "least"), told(name, spp, "stop")]
        for name, entry in found["places"].items()
        for spp in entry
    ]
    s, factors = found["settings"], found["factors"]
    head = ["loss", "spp", "mean loss least at", "mean derivative 0 at"]
    return (
        f"`three-bodies`, {s['resolution']}², {s['runs']} renders at {len(factors)} factors from {factors[0]:g} to {factors[-1]:g} of "
        f"the fog's true extinction, 1.\n\n{table(head, rows)}"
    )


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
