"""The cost of a pair, a step and the loop, as ratios within one run.

On `indirect-room`: the pair against a plain primal render of the same kernel and of Mitsuba's `prb`; a step on
leave-one-out sample groups and a step with the control variate against the stock loop (`mi.render`, `dr.backward`,
`mi.ad.Adam`) at equal spp; the variance of the gradients, leave-one-out groups against own paths.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

import unrender as ur
from benchmarks import markdown
from benchmarks.internals import Key, SampleRequest, dr, mi, prepare, project, stock_scene
from benchmarks.paths import truth
from benchmarks.pixel_schemes import gradients, spread
from benchmarks.runner.records import Record
from benchmarks.runner.timing import percentiles, turns
from benchmarks.stock_loop import stock_loop

PROBLEMS = ("indirect-room", "glossy-room", "sunlit-vase", "lamp")
QUICK = {"problem": ("indirect-room",), "resolution": 16, "spp": 2}


def stepper(problem: ur.Problem, estimator: Any) -> Callable[[int], None]:
    """A function that takes one whole step."""
    optimizer = ur.optimizers.Adam(learning_rate=1e-3)
    parameters = problem.initial()
    state = {"p": parameters, "s": estimator.init(problem, parameters), "m": optimizer.init(parameters)}

    def step(number: int) -> None:
        found, state["s"] = estimator.estimate(problem, state["p"], state["s"], Key(0, number))
        steps, state["m"] = optimizer.update(found, state["m"], state["p"])
        state["p"] = {k: project(x + steps[k], *problem.unknowns[k].bounds) for k, x in state["p"].items()}
        dr.eval(state["p"], state["m"])

    return step


def stock_time(problem: ur.Problem, spp: int, steps: int = 20) -> float:
    """Median milliseconds of a step of the stock loop."""
    clock = [h["seconds"] for h in stock_loop(problem, spp, 1e-3, steps=steps, every=1)]
    return 1e3 * float(np.median(np.diff(clock)))


def primal_costs(problem: ur.Problem, spp: int) -> dict[str, Any]:
    """A pair against plain renders, in turns, in milliseconds: median, 10th and 90th percentile."""
    session, now = prepare(problem, [p.key for p in problem.parameters], "path"), problem.initial()
    before = {k: x * 0.99 for k, x in now.items()}
    dr.eval(before)
    prb = mi.load_dict({"type": "prb", "max_depth": problem.max_depth})
    scene, _ = stock_scene(problem)

    def pair(n: int) -> None:
        found = session.image_pair(now, before, SampleRequest(0, spp, n, 2), "path")
        dr.eval(found.images, found.previous)

    def stock(n: int) -> None:
        with dr.suspend_grad():
            dr.eval(prb.render(scene, sensor=0, spp=spp, seed=n))

    def plain(n: int) -> None:
        dr.eval(session.image(now, SampleRequest(0, spp, n, 2)).images)

    times = turns({"plain": plain, "pair": pair, "mitsuba_prb": stock})
    found: dict[str, Any] = {name: percentiles(values) for name, values in times.items()}
    others = {"pair/plain": "plain", "pair/prb": "mitsuba_prb"}
    return found | {name: found["pair"][0] / found[other][0] for name, other in others.items()}


def gradient_variance(problem: ur.Problem, spp: int, count: int = 24) -> dict[str, Any]:
    """Variance of the gradient summed over elements, leave-one-out groups against an adjoint on paths of its own at equal spp.

    At the start, where the loss derivative is large, and a twentieth of the way from the truth to it. On its own paths an
    image and an adjoint are correlated; their product's variance gains or loses by that, as the loss derivative is positive or not.
    """
    start, end = problem.initial(), truth(problem)
    near = {key: end[key] + (start[key] - end[key]) * 0.05 for key in start}
    dr.eval(near)
    estimators = {"leave-one-out": ur.PathGradient(spp=spp), "own paths": ur.PathGradient(spp=spp, adjoint_spp=spp)}
    found: dict[str, Any] = {}
    for place, point in (("start", start), ("near the truth", near)):
        variances = {
            name: spread(gradients(problem, estimator, count, 7, point)[0])[0] for name, estimator in estimators.items()
        }
        found[place] = {**variances, "ratio": variances["leave-one-out"] / variances["own paths"]}
    return found


def run(problem: tuple[str, ...] = PROBLEMS, resolution: int = 128, spp: int = 16) -> dict[str, Any]:
    """All parts.

    Args:
        problem: of the variances
    """

    def room() -> ur.Problem:  # one for each contender, whose scenes hold its own parameters
        return ur.gallery.problem("indirect-room", resolution=resolution, loss="L2")

    control_variate = ur.images.RecursiveControlVariate()
    plain, rcv = ur.PathGradient(spp=spp), ur.PathGradient(control_variate, spp=spp)
    primal, stock = primal_costs(room(), spp), stock_time(room(), spp)
    times = turns({"leave-one-out": stepper(room(), plain), "rcv": stepper(room(), rcv)})
    steps = {"stock": stock, **{name: percentiles(values) for name, values in times.items()}}
    half = {name: ur.gallery.problem(name, resolution=resolution // 2, loss="L2") for name in problem}
    return {
        "primal_ms": primal,
        "step_ms": steps,
        "step_ratios": {f"{name}/stock": steps[name][0] / stock for name in ("leave-one-out", "rcv")},
        "gradient_variance": {name: gradient_variance(made, spp) for name, made in half.items()},
    }


def table(record: Record) -> str:
    primal, steps, ratios = record["primal_ms"], record["step_ms"], record["step_ratios"]
    over_plain, over_prb = primal["pair/plain"], primal["pair/prb"]
    images = [
        ["plain, this kernel", f"{primal['plain'][0]:.1f}", "1"],
        ["Mitsuba's prb, primal", f"{primal['mitsuba_prb'][0]:.1f}", f"{over_plain / over_prb:.2f}"],
        ["**pair**", f"{primal['pair'][0]:.1f}", f"**{over_plain:.2f}** ({over_prb:.2f} of prb)"],
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
