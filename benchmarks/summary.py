"""Writes docs/results.md from the results.json of every benchmark: the figures there are these, and no others.

python benchmarks/summary.py
"""

from __future__ import annotations

import itertools
import json
import math
import re
from pathlib import Path
from typing import Any

from summaries import media, pixels
from summaries import runs as life
from summaries.tables import table

HERE = Path(__file__).resolve().parent
OUT = HERE.parent / "docs" / "results.md"


def load(folder: str) -> dict[str, Any] | None:
    """The results of a benchmark, None where it was not run."""
    file = HERE / folder / "results.json"
    return json.loads(file.read_text()) if file.is_file() else None


def command(found: dict[str, Any]) -> str:
    """How these figures were made, and on what."""
    words = re.sub(r"\S*/(?=benchmarks/)", "", found["command"])
    hardware = found["hardware"]
    return f"`{words}`, {hardware['cores']} cores of {hardware['processor']}, Mitsuba {found['versions']['mitsuba']}."


def speed(found: dict[str, Any]) -> str:
    """Costs as ratios."""
    primal, steps, ratios = found["primal_ms"], found["step_ms"], found["step_ratios"]
    variance = [
        [name, *(f"{entry[place]['ratio']:.2f}" if place in entry else "" for place in ("start", "near the truth"))]
        for name, entry in found["gradient_variance"].items()
    ]
    outside = [
        [name, f"{e['wall_ms']:.1f}", f"{e['kernels_ms']:.1f}", f"{e['outside']:.1%}", e["new"]]
        for name, e in found["outside_kernels"].items()
    ]
    return "\n\n".join(
        [
            f"`indirect-room`, {found['resolution']}², {found['spp']} spp, milliseconds (median of 15).",
            table(
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
            table(
                ["whole step", "ms", "of the stock loop"],
                [
                    ["stock loop", f"{steps['stock']:.1f}", "1"],
                    ["plain, crossed groups", f"{steps['crossed'][0]:.1f}", f"**{ratios['crossed/stock']:.2f}**"],
                    ["control variate", f"{steps['rcv'][0]:.1f}", f"**{ratios['rcv/stock']:.2f}**"],
                ],
            ),
            "Variance of the gradient, crossed groups over an adjoint on paths of its own, equal spp, L2 (equal is 1):",
            table(["problem", "at the start", "near the truth"], variance),
            "Time outside kernels at the gallery's default sizes, control variate at 2 spp, and kernels new after warm-up:",
            table(["problem", "wall ms a step", "kernel ms", "outside", "new kernels"], outside),
        ]
    )


def reconstruction(found: dict[str, Any]) -> str:
    """Equal-time reconstruction."""
    rows = []
    for entry in found["entries"]:
        summary = entry["summary"]
        for method in ("stock", "plain", "rcv"):
            chosen, row = entry["methods"][method], summary[method]
            middle, low, high = row["final"]
            other = ""
            if method != "rcv":
                reached = [t for t in row["rcv_reaches_its_best_after"] if t is not None]
                share = f"{len(reached)} of {len(entry['methods']['rcv']['runs'])}"
                when = f"{sorted(reached)[len(reached) // 2]:.1f} s ({share})" if reached else "never"
                other = f"{1 / row['ratio']:.2f}× | {row['it_reaches_its_best_after']:.1f} s | {when}"
            else:
                other = "1 | | "
            rows.append(
                [
                    entry["problem"],
                    entry["loss"],
                    f"{entry['seconds']:g} s",
                    f"{method} ({chosen['spp']} spp, {chosen['rate']:g})",
                    f"{middle:.3f} ({low:.3f} to {high:.3f})",
                    f"{row['best']:.3f}",
                    *other.split(" | "),
                ]
            )
    head = ["problem", "loss", "budget", "method (spp, rate)", "final error", "best on the way"]
    head += ["× rcv's final", "its best at", "rcv gets there at"]
    return table(head, rows)


def real_input(found: dict[str, Any]) -> str:
    """The main job on foreign scenes."""
    rows = []
    for name, methods in found["scenes"].items():
        for method, f in methods.items():
            a, b = f["texture_rmse_where_seen"]
            c, d = f["image_rmse_view0"]
            errors = [f"{a:.3f} → {b:.3f}", f"{f['share_seen']:.0%}", f"{c:.4f} → {d:.4f}"]
            rows.append([name, method, f["steps"], f"{f['seconds']:.0f}", *errors])
    head = ["scene", "method", "steps", "seconds", "texture RMSE where seen", "texels seen", "image RMSE, first view"]
    commands = "\n".join(f["command"] for methods in found["scenes"].values() for f in methods.values())
    return table(head, rows) + "\n\nThe commands, as the script types them:\n\n```sh\n" + commands + "\n```"


def weights(found: dict[str, Any]) -> str:
    """Fig. 3."""
    rows = [
        [rule, f"{f['weight'][-1]:.3f}", f"{f['variance'][-1]:.4f}", f"{f['bias']:+.2%} ± {f['bias_error']:.2%}"]
        for rule, f in found["rules"].items()
    ]
    sizes = f"{found['resolution']}², {found['spp']} spp, {found['steps']} steps, {found['runs']} runs"
    return f"{sizes}; at the last step, variance relative to one render's.\n\n" + table(
        ["rule", "weight", "variance", "bias"], rows
    )


def order(found: dict[str, Any]) -> str:
    """Fig. 4."""
    names = {"plain": "plain render", "before": "updated before use (biased)", "after": "updated after use"}
    rows = []
    for path, entry in found["paths"].items():
        for method, name in names.items():
            f = entry["methods"][method]
            converged, paired = f["converged"][-1], f["paired"][-1] if "paired" in f else None
            bias = f"{paired['signed']:+.3%} ± {paired['signed_error']:.3%}, {paired['rms']:.2%}" if paired else ""
            absolute = f"{converged['signed']:+.2%} ± {converged['signed_error']:.2%}"
            rows.append([path, name, absolute, bias, f"{f['equivalent_spp']:.0f}"])
    head = [
        "parameters",
        "statistics",
        "bias against a converged image",
        "bias, paired: mean, RMS over pixels",
        "worth plain spp",
    ]
    sizes = (
        f"{found['resolution']}², {found['spp']} spp, {found['steps']} steps, {found['runs']} runs, `indirect-room`."
    )
    return f"{sizes}\n\n{table(head, rows)}"


def spaces(found: dict[str, Any]) -> str:
    """Fig. 8."""
    rows = []
    for scene, entry in found["scenes"].items():
        for space, f in entry["summary"].items():
            ratios = (f["weight"], f["variance_ratio"], f["error_ratio_at_last"], f["image_cost"], f["step_cost"])
            rows.append([scene, space, *(f"{x:.2f}" for x in ratios)])
    head = [
        "scene",
        "space",
        "mean weight",
        "variance ÷",
        "error ÷ at the last step",
        "cost of an image",
        "cost of a step",
    ]
    sizes = f"{found['resolution']}², {found['spp']} spp, {found['steps']} steps, {found['runs']} runs; relative to a plain render."
    return f"{sizes}\n\n{table(head, rows)}"


def loss_bias(found: dict[str, Any]) -> str:
    """Fig. 7."""
    rows = []
    for loss, entry in found["fig7"]["losses"].items():
        for method in ("plain", "rcv"):
            f = entry[method]
            rows.append(
                [
                    loss,
                    method,
                    f"{f['signed']:+.1%} ± {f['signed_error']:.1%}",
                    f"{f['rms']:.2f}",
                    f"{f['variance']:.2f}",
                ]
            )
    head = ["loss", "image", "bias of the derivative", "RMS over pixels", "variance"]
    ratio = f"The image's variance is {found['fig7']['image_variance_ratio']:.1f} × lower with the control variate."
    sizes = f"{found['resolution']}², {found['spp']} spp, {found['runs']} runs, step {found['step']}; relative to the derivative's mean."
    return f"{sizes}\n\n{table(head, rows)}\n\n{ratio}"


def toy(found: dict[str, Any]) -> str:
    """Meta, Fig. 2."""
    rows = []
    for method, entry in found["methods"].items():
        row: list[Any] = [method]
        for horizon in ("200", "400"):
            f = entry[horizon]
            row += [f"{f['rmse']:.5f}", f"{f['of_adam']:.2f}", f"{f['rate']:g}"]
        rows.append(row)
    head = ["method", "RMSE after 200 steps", "of Adam's", "rate", "RMSE after 400 steps", "of Adam's", "rate"]
    return f"{found['seeds']} runs; each method tuned for each horizon on other seeds.\n\n{table(head, rows)}"


def differences(found: dict[str, Any]) -> str:
    """Meta: variance and cost of differences."""
    rows = []
    for name, entry in found["variance"].items():
        for space in ("path", "primary"):
            f = entry[space]
            ratios = [f"{v / f['gradient']:.1e}" for v in f["difference"]]
            rows.append([name, space, f"{f['slope']:.2f}", *ratios])
    steps = next(iter(found["variance"].values()))["steps"]
    sizes = f"{found['resolution']}², {found['spp']} spp, {found['runs']} runs. Var ΔF / Var F by step, a share of the way to the truth:"
    first = table(["problem", "space", "slope, log-log", *(f"{s:g}" for s in steps)], rows)
    blocks = [sizes, first]
    for size, cost in found["cost"].items():
        keys = list(next(iter(cost.values())))
        blocks.append(f"Whole estimates of all views (`chalice` has two) and their parts for one view, at {size}²:")
        blocks.append(
            table(["milliseconds", *cost], [[key, *(f"{cost[name][key]:.2f}" for name in cost)] for key in keys])
        )
    return "\n\n".join(blocks)


def races(found: dict[str, Any]) -> str:
    """Meta, Figs 1, 6 and 9."""
    blocks = []
    for name, entry in found["entries"].items():
        methods, summary = entry["methods"], entry["summary"]
        rows = []
        for method, f in methods.items():
            end = f["runs"][0][-1]
            row = [
                method,
                f"{f['rate']:g}",
                f"{f['final'][0]:.3f} ({f['final'][1]:.3f} to {f['final'][2]:.3f})",
                f"{end[0]:.1f}",
            ]
            row.append(f"{end[1] / 1e6:.2f}")
            rows.append(row)
        budget = ", ".join(f"{value:g} {unit}" for unit, value in entry["budget"].items())
        head = ["method", "rate", "final error: median (range)", "seconds", "million paths"]
        lines = [
            f"**`{name}`**, {entry['options']['resolution']}², {budget}, {entry['seeds']} seeds.",
            table(head, rows),
        ]
        adam = [m for m, f in methods.items() if f["group"] == "adam"]
        reach = []
        for pair, f in summary.items():
            ours, theirs = pair.split(" / ")
            if theirs in adam[-2:] and ours in ("meta", "coupled 3 spp", "coupled 3 spp, rcv"):
                ratios = [f"{f[u]:.1f}×" if f[u] else "never" for u in ("samples_ratio", "seconds_ratio")]
                reach.append([ours, theirs, *ratios])
        lines += [
            "How many times fewer paths, and less time, until the final error of the other is reached (median run):"
        ]
        lines += [table(["method", "reaches the end of", "fewer paths", "less time"], reach)]
        blocks += lines
    return "\n\n".join(blocks)


def ablations(found: dict[str, Any]) -> str:
    """Meta, Fig. 5."""
    rows = [
        [name, f"{f['rate']:g}", f"{f['final'][0]:.3f} ({f['final'][1]:.3f} to {f['final'][2]:.3f})"]
        for name, f in found["methods"].items()
    ]
    sizes = f"`ajar`, {found['resolution']}², {found['seconds']:g} s, {found['seeds']} seeds, each tuned."
    return f"{sizes}\n\n{table(['form, and what is left out', 'rate', 'final error: median (range)'], rows)}"


def estimates(found: dict[str, Any]) -> str:
    """Meta, Figs 3 and 4."""
    rows = []
    for path, entry in found["paths"].items():
        for method, f in entry["methods"].items():
            q = f["predicted_over_actual"]
            error = [f"{f['error'][n] / entry['methods']['plain']['error'][n]:.2f}" for n in (len(f["error"]) // 2, -1)]
            rows.append([path, method, *error, f"{q[2]:.2f}", f"{q[0]:.2f} to {q[4]:.2f}"])
    head = [
        "parameters",
        "estimate",
        "RMSE / plain's, half way",
        "at the end",
        "predicted / actual deviation",
        "5 % to 95 % of texels and steps",
    ]
    sizes = f"`indirect-room`, {found['resolution']}², 4 paths per pixel and step, {found['steps']} steps, {found['runs']} runs."
    return f"{sizes}\n\n{table(head, rows)}"


def perturbations(found: dict[str, Any]) -> str:
    """Milliseconds per perturbation."""
    parts = [f"`bunny`, {found['resolution']}², {found['spp']} spp, milliseconds per perturbed render."]
    meshes = found["meshes"]
    sizes = [row["size"] for row in next(iter(meshes.values()))["batches"]]
    rows = []
    for name, entry in meshes.items():
        rows.append([f"{name}: call", *(f"{row['wall']:.2f}" for row in entry["batches"]), f"{entry['moved']:.1f}"])
        rows.append([f"{name}: kernels", *(f"{row['kernels']:.2f}" for row in entry["batches"]), ""])
        rows.append([f"{name}: call / kernels", *(f"{r['wall'] / r['kernels']:.2f}" for r in entry["batches"]), ""])
        faster = (f"{entry['moved'] / row['wall']:.1f}×" for row in entry["batches"])
        rows.append([f"{name}: faster than moved vertices", *faster, ""])
    parts.append(table(["", *(f"batch of {size}" for size in sizes), "moved vertices"], rows))
    return "\n\n".join(parts)


def cuts(found: dict[str, Any]) -> str:
    """Variance times evaluations over that of the plain estimator."""
    problems = found["problems"]
    names = list(next(iter(next(iter(problems.values())).values())))
    head = ["", *(f"{problem}: {order}" for problem, orders in problems.items() for order in orders)]
    rows = [
        [name, *(f"{orders[order][name]:.2g}" for orders in problems.values() for order in orders)] for name in names
    ]
    return f"{found['runs']} runs of {found['samples']} evaluations; below 1 pays.\n\n{table(head, rows)}"


def plateaus(found: dict[str, Any]) -> str:
    """Seconds to each reduction of the error, and FR22's and CMA-ES's against the best of ours."""

    def seconds(values: list[float | None]) -> list[str]:
        return ["—" if value is None else f"{value:.3g}" for value in values]

    rows = []
    for name, task in found["tasks"].items():
        for method, entry in task["methods"].items():
            told = entry["summary"]
            there = " / ".join(map(str, told["parameter_count"])) + f" of {len(entry['runs'])}"
            rows.append([name, method, *seconds(told["image"]), *seconds(told["parameter"]), there])
    goals = ["image 90 %", "99 %", "99.9 %", "parameters 90 %", "99 %", "99.9 %"]
    count = f"Random starts, {found['resolution']}²; median seconds of the processor, — where half the runs or more never got there."
    entries = [entry for task in found["tasks"].values() for entry in task["methods"].values()]
    commands = dict.fromkeys(entry["command"] for entry in entries if "command" in entry)
    made = "Made by\n\n" + "\n".join(f"- `{command}`" for command in commands)
    parts = [count, table(["task", "method", *goals, "runs that got there"], rows), made]
    for rival in ("FR22", "CMA-ES"):
        parts += [
            f"{rival}'s time over that of the best of ours, per goal (>: its budget over ours, where it never got there):"
        ]
        parts += [_gains(found["tasks"], rival, goals)]
    return "\n\n".join(parts)


def _gains(tasks: dict[str, Any], rival: str, goals: list[str]) -> str:
    """A row of ratios per task, their mean, and the mean of all."""
    rows, everything = [], []
    for name, task in tasks.items():
        if rival not in task["methods"]:
            continue
        mine = [entry for method, entry in task["methods"].items() if method.startswith("Our")]
        ours, longest = (
            [entry["summary"] for entry in mine],
            max(entry.get("seconds", task["seconds"]) for entry in mine),
        )
        theirs, known, cells = task["methods"][rival], [], []
        for which, goal in itertools.product(("image", "parameter"), range(3)):
            times = [told[which][goal] for told in ours if told[which][goal] is not None]
            time = theirs["summary"][which][goal]
            if not times and time is None:
                cells.append("—")
                continue
            ratio = (time or theirs.get("seconds", task["seconds"])) / min([*times, longest])
            known.append(ratio)
            cells.append(f"{'> ' * (time is None)}{'< ' * (not times)}{ratio:.2f}")
        everything += known
        rows.append([name, *cells, f"{sum(known) / len(known):.2f}" if known else "—"])
    mean = (
        f"Mean of all {len(everything)}, bounds counted as they are: {sum(everything) / max(len(everything), 1):.2f}."
    )
    return table(["task", *goals, "mean"], rows) + f"\n\n{mean}"


def meshes(found: dict[str, Any]) -> str:
    """What was left of the loss."""
    rows = []
    for method, runs in found["methods"].items():
        finals = [f"{run['final']:.3f}" for run in runs]
        rows.append([method, ", ".join(finals), ", ".join(str(run["steps"]) for run in runs)])
    size = f"{found['numbers']} numbers, 6 views of {found['resolution']}², {found['seconds']:g} s of the processor"
    return f"{size}, runs: {found['runs']}.\n\n" + table(["method", "loss / at the start", "steps"], rows)


def networks(found: dict[str, Any]) -> str:
    """Errors of the networks' answers, and when they had fallen by 90 and 99 %."""
    rows = []
    for name, task in found["tasks"].items():
        for method, entry in task["methods"].items():
            finals = sorted(run["final"] for run in entry["runs"])
            steps = sorted(run["steps"] for run in entry["runs"])
            middle = finals[len(finals) // 2]
            spread = f"{middle:.3f} ({finals[0]:.3f} to {finals[-1]:.3f})"
            times = [sorted(run["reached"][goal] for run in entry["runs"])[len(finals) // 2] for goal in range(2)]
            rows.append(
                [
                    f"{name}, {task['weights']} weights",
                    method,
                    f"{entry['rate']:g}",
                    spread,
                    *[f"{t:.3g}" if math.isfinite(t) else "—" for t in times],
                    steps[len(steps) // 2],
                ]
            )
    head = ["task", "method", "rate or radius", "final error: median (range)", "s to 90 %", "99 %", "steps"]
    return f"{found['runs']} runs of {found['seconds']:g} s.\n\n{table(head, rows)}"


INDIRECT_ROOM = """What decides `indirect-room` with L1, from trials on single seeds (error after 12 to 15 s of 128² films):

- With 128² texels, more than the pixels that see them, and no preconditioner, what no pixel sees wanders with every
  noisy step, and many cheap steps are worse than few dear ones: rcv at 8 spp and rate 0.003 ended at 0.18, plain at
  32 spp and 0.01 at 0.15, stock at 32 spp and 0.03 at 0.26. Plain at 2 spp ended at 2.39, every texel at its upper
  bound, for any rate.
- With 64² texels: rcv at 4 spp and 0.01 reached 0.20 after 2.4 s and 0.15 after 12 s; plain at 32 spp and 0.02
  reached 0.16 after 7 s and stayed.
- With 64² texels and LargeSteps(2), as the paper has it in its Fig. 9 and the gallery now has it: rcv at 4 spp and
  0.02 reached 0.15 after 4 s and 0.09 after 12 s; plain at 32 spp and 0.03 ended at 0.19.

Tried without effect at 128², 300 steps of 2 spp at rate 0.01 (final error 0.343): faster means (α = 0.5) 0.344;
faster statistics (β = 0.95) 0.343; (co)variances from the groups within a step 0.343. Predicted and measured
deviations of the control variate agree (0.044 and 0.047 after 600 steps), its bias is 0.4 % of the mean: the image
is as good as it says. At a constant rate, parameters that move by a share δ a step add δ² of a render's variance to
the memory each time, so its relative variance settles near δ instead of 1/n. With a reference at 1024 spp every
method that minimises the loss recovers the reference's noise too."""


META_TOY = """The split of the paper's form matters: differences are so quiet here that eight of them serve as well as sixteen. Adam on the
meta-gradient ("naive") does well on this one convex parameter, where steps never outrun the memory."""

META_DIFFERENCES = """In path space the variance of a difference falls with the square of the step on every problem; in primary sample space
equal random numbers lead to other paths in a share that grows with the step, and where roughness decides the sampling the slope is near
one. (Variances by `--runs 16`; costs at each size by `--costs-only --cost-resolution`.) At 96² launches cost as much as paths; at 192² a
meta step costs less than plain gradients at 4 spp but on `chalice`, whose two views are smaller launches still."""

META_ESTIMATES = """Predicted deviations are too large where the gradient stands out of the noise of one step, as they are zero-centred; the
more so for the coupled form, whose own deviation is the smallest."""

META_ABLATIONS = """Few seeds and a short budget: differences of a few hundredths are noise."""

META_RACES = """\
The paper's form needs many steps for its memory to pay. With two crossed proportional samples per pixel its
single-step noise is twice that of as many independent ones, and of four paths traced per pixel only two serve the
gradient itself; `MetaAdam` moves an element whose gradient is lost in noise by about its learning rate at each step,
and in one direction for as long as the memory lasts. On textures in `ajar`'s light that walk costs more than the
lower noise gains within these budgets. The gradients themselves are as quiet as predicted there (on the path of a
descent, after 60 steps: deviation 0.47 of plain gradients' at 3 spp for the paper's form, 0.20 for the coupled one,
0.07 on a control variate's images). Tried against it on `ajar`: steps limited to the learning rate (`longest=1`: 0.86
at 0.001, 1.3 at 0.003); dividing by the deviation of one step's gradient in place of the memory's (1.08 at 0.01
coupled, 0.61 on a control variate's images); Adam in its place (the rows "naive"); steps shrunk by their significance, by
1 − V/g² where positive, and by g² / (g² + 4 V), in place of the sign of noise (`ajar`, one seed, paper's form / coupled 3 spp /
8 spp / 3 spp on a control variate's images: 0.96 / 0.93 / 0.69 / 0.56 and 0.97 / 0.92 / 0.68 / 0.55; `spiral`, median of three
seeds: 0.14 / 0.32 / 0.16 / 0.13 and 0.36 / 0.19 / 0.17 / 0.07): better for the paper's form on `spiral`, no better elsewhere, so
the rule is left as the paper has it. The machine was busy with other
work during part of `spiral`'s race, which counts steps: its seconds are a hint only (`differences` has the costs)."""


HIGHER_ORDER_CUTS = """Of the Hessian alone, antithetic draws do not pay without the baseline: its kernels are even, and the value
of the loss, which both draws of a pair share, is its noise. With the baseline, which every default has, they do."""

HIGHER_ORDER_TABLE = """\
FR22 here has what ours have: antithetic pairs, shared random numbers, one launch for a step, σ and steps that shrink, and a grid of
half-lives, rates and numbers of samples that it is tuned over. So it is faster than the paper's, and the gain over it smaller than the
paper's 2.71. OurTogether is beyond the paper: gradient and products from the same renders. The machine was busy with other work, so
seconds are the processor's, of one thread; the runs of a command's methods were done by turns.

What decided between convergence and not:

- Newton's steps must shrink, as Adam's do. Without, OurTogether met 99 % of the parameters in 16 of 20 runs on BOX2 and 7 on BUNNY, and
  99.9 % in none; with it, most runs meet 99.9 % on BOX2, MUG and SHADOW.
- σ that shrinks as the descent arrives, and not by steps, took a seventh fewer renders to 99 % on BOX2 in trials of 10 starts. What it
  takes for arrival is sometimes a local minimum of the smoothed loss: with a half-life of 6 OurTogether lost 3 of 20 runs on MUG and 7 on
  BOX10, OurHVPA 4 on each of MUG and BUNNY and 12 on BOX10. These rows were raced again with half-lives of 12 to 30, and OurHVPA on BOX10
  and BUNNY with half as much time again: settings chosen by hand, for MUG and BOX10 on starts of the race itself, which FR22's were not.
  OurHVPA on BOX10 took two such tries (16 runs, then 18). On 20 starts that had no part in it OurTogether met 99 % in 20 runs on MUG,
  where FR22 did in 20, sooner (0.19 s against 0.25), and in 19 on BOX10, where FR22 with a half-life of 40, slower than its tuned one, did
  in 17 (2.8 s against 0.89).
- Loss of noisy pictures: its minimum is off by what their noise changes with the parameters. BUNNY at 1 sample per pixel ended at 2 to 4 %,
  at 4 it reaches 99 %.
- TEXTURE has as many pixels as texels, and texels that are not blended: blended ones cannot be told from one sample per pixel (the
  exact minimum of that loss is at 7 % of the error at the start). Light falls off over the poster, so curvatures differ by 11, and
  the error of a texel falls with exp(−c K / 2 n) after K pairs, c its curvature over the mean: some 15 000 pairs to 90 % and twice as many
  to 99 %, were every pair made the best of. No method on perturbations comes to 99 % in 16 s; ours are first to 90 % of the picture
  and behind FR22 and CMA-ES after: steps along one direction do not tell bright texels from dark ones, and theirs do not shrink there, so
  that noise has the last word. Runs are few here, and alike."""


HIGHER_ORDER_MESH = """\
Settings are set by hand, the same σ and number of perturbations for all. CMA-ES, which learns variances alone here, went farthest."""


SECTIONS: list[tuple[str, str, Any, str]] = [
    (
        "Cost of a pair, a step, the loop",
        "speed",
        speed,
        "",
    ),
    (
        "Equal-time reconstruction (paper Fig. 9)",
        "rcv/fig9_reconstruction",
        reconstruction,
        "Error: each parameter's RMSE over its RMSE at the start, averaged over parameters; 1 is no progress. Final: median over the seeds "
        "(least to most). Every method was tuned on a seed of its own, over spp and learning rate, for the whole budget (grids in the "
        "script, or in the command's `--grid`). `stock` is `mi.render`, `dr.backward`, `mi.ad.Adam`; `plain` and `rcv` are this "
        "library's. `glossy-room` has LargeSteps on two maps, which the stock loop lacks.\n\n" + INDIRECT_ROOM,
    ),
    ("The main job on scenes made by others", "real_input", real_input, ""),
    ("Steady state of the weights (paper Fig. 3)", "rcv/fig3_weights", weights, ""),
    ("Update before or after use (paper Fig. 4)", "rcv/fig4_order", order, ""),
    ("Bias of the loss's derivative (paper Fig. 7; Fig. 6 in the picture)", "rcv/fig6_7_loss_bias", loss_bias, ""),
    ("Path space and primary sample space (paper Fig. 8)", "rcv/fig8_spaces", spaces, ""),
    ("Meta-estimation: the toy problem (Balint et al., Fig. 2)", "meta/fig2_exponential", toy, META_TOY),
    ("Meta-estimation: what differences cost, and their variance", "meta/differences", differences, META_DIFFERENCES),
    ("Meta-estimation: estimates on a fixed path (Figs 3 and 4)", "meta/fig3_4_estimates", estimates, META_ESTIMATES),
    ("Meta-estimation: ablations (Fig. 5)", "meta/fig5_ablations", ablations, META_ABLATIONS),
    ("Meta-estimation against Adam (Figs 1, 6 and 9)", "meta/equal_time", races, META_RACES),
    ("Smoothed derivatives: what a perturbation costs", "higher_order/speed", perturbations, ""),
    ("Smoothed derivatives: what cuts of the variance are worth", "higher_order/variance", cuts, HIGHER_ORDER_CUTS),
    (
        "Smoothed derivatives: times to converge (Wang et al., Table 2)",
        "higher_order/table2",
        plateaus,
        HIGHER_ORDER_TABLE,
    ),
    ("Smoothed derivatives: a sphere becomes a body (Fig. 5)", "higher_order/table2/mesh", meshes, HIGHER_ORDER_MESH),
    (
        "Smoothed derivatives behind a network (Table 2, CNN and CNN5)",
        "higher_order/table2/networks",
        networks,
        "Adam on the gradient learns the angle, in two of three runs. Newton-CG within a trust region of the weights does not within this "
        "budget, and through Adam more slowly; why was not settled. CNN5 learns nothing in 12 s, 20 to 50 steps: colours are no poses, so "
        "every perturbation there is a launch of its own. Tuned on one run of 3 s each.",
    ),
    ("Drawn pixels: variance of the gradient (Fig. 3)", "adaptive/fig3_variance", pixels.variance, pixels.VARIANCE),
    ("Drawn pixels at equal time (Figs 4, 5 and 8)", "adaptive/equal_time", pixels.equal_time, pixels.EQUAL_TIME),
    ("Drawn pixels: where probabilities fail (Fig. 7)", "adaptive/fig7_failure", pixels.failure, pixels.FAILURE),
    ("Drawn pixels: what they cost", "adaptive/cost", pixels.cost, ""),
    ("Participating media: what they cost", "volumes/cost", media.cost, media.COST),
    ("Participating media: gradients", "volumes/gradients", media.gradients, media.GRADIENTS),
    ("Participating media: weights along a descent (Fig. 2)", "volumes/fig2_weights", media.weights, media.WEIGHTS),
    (
        "Participating media: a loss along one parameter (Fig. 6)",
        "volumes/fig6_landscape",
        media.landscape,
        media.LANDSCAPE,
    ),
    ("Participating media: where noise pushes a loss (Figs 5 and 6)", "volumes/fig5_drift", media.drift, media.DRIFT),
    ("Participating media: what a control variate saves (Fig. 11)", "volumes/fig11_smoke", media.smoke, media.SMOKE),
    ("Participating media: what sparse ones cost", "volumes/cost/sparse", media.cost, ""),
    (
        "Participating media: meta-estimation of a radiance field (Figs 7 and 8)",
        "volumes/fig7_nerf",
        media.nerf,
        media.NERF,
    ),
    ("Participating media: drawn pixels", "volumes/adaptive_smoke", media.drawn, media.DRAWN),
    ("Participating media: memory of grids", "volumes/memory", media.memory, ""),
    ("Coarse to fine", "coarse_to_fine", life.coarse_to_fine, life.COARSE),
    ("What checkpoints cost", "checkpoints", life.checkpoints, life.CHECKPOINTS),
    ("What watching costs", "watch", life.watching, life.WATCHING),
]


def main() -> None:
    parts = [
        "# Results",
        "Written by `python benchmarks/summary.py` from the `results.json` beside each benchmark's script; losses as plainly as wins. "
        "Ratios are of one run on one machine; times are not comparable between sections.",
    ]
    for title, folder, render, note in SECTIONS:
        found = load(folder)
        if found is None:
            continue
        parts += [f"## {title}", command(found)]
        parts += [note] if note else []
        parts += [render(found)]
        if (HERE / folder / "figure.png").is_file():
            parts.append(f"![{title}](../benchmarks/{folder}/figure.png)")
    OUT.write_text("\n\n".join(parts) + "\n")
    print(f"wrote {OUT}")


if __name__ == "__main__":
    main()
