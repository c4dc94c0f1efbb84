"""Reconstruction at equal time (RCV Fig. 9): the stock loop, plain gradients and recursive control variates, each tuned.

Each method is tuned on a seed of its own over a grid of samples per pixel and learning rates for the whole budget; the best by final
parameter error then runs on the seeds, all methods in turns. The error is each parameter's RMSE relative to where it began, averaged over
parameters. `stock` is `mi.render`, `dr.backward`, `mi.ad.Adam`; `plain` is this library's gradient on leave-one-out sample groups; `rcv`
has a recursive control variate besides. "denoised" is either of these with its images denoised before the loss sees them, by Open Image
Denoise or OptiX; where neither is there, by total variation, and the record says by which.

Equal time is that of the clock; with `--processor` that of the processor, all cores together, which other work on the
machine does not change much: entries of their own, on smaller films. `--steps` and `--spp IMAGE ADJOINT` race those
smaller films at equal steps, the adjoint on paths of its own as in the paper, rates falling along half a cosine. There
"converged" has images of 64 times the samples: no control variate and no denoiser can do better with that adjoint.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

import unrender as ur
from benchmarks import figures, markdown
from benchmarks.internals import ImageEstimator, available_denoiser
from benchmarks.races import TUNING_SEED, Entrant, Setting, median_and_range, race, scaled, total_error, tune
from benchmarks.runner.records import Record
from benchmarks.runner.timing import work_time
from benchmarks.stock_loop import stock_loop
from benchmarks.timed_runs import timed_run

Grid = dict[str, list[tuple[int, float]]]

RATES = (3e-3, 1e-2, 3e-2)
SPP = {"plain": (2, 8, 32), "rcv": (2, 8, 32)}
NOISY = {"plain": (8, 32, 128), "rcv": (2, 8, 32)}  # of indirect-room, where fewer samples alone only make things worse
BUDGETS = {"indirect-room": 15.0}
# Noise in the reference is part of the loss's minimum: a method that minimises the loss well fits it. Here it must be small.
OPTIONS: dict[str, dict[str, Any]] = {
    "indirect-room": {"reference_spp": 4096},
    "glossy-room": {"resolution": 64, "reference_spp": 4096},
    "sunlit-vase": {"resolution": 64, "reference_spp": 4096},
    "lamp": {"resolution": 64, "reference_spp": 4096},
}
# By processor time, on films of at most this size: three configurations each.
SMALL: dict[str, dict[str, Any]] = {
    "indirect-room": {"resolution": 64, "texture_resolution": 32, "reference_spp": 4096},
    "tea": {"resolution": 32, "reference_spp": 8192},
}
GRID: Grid = {
    "plain": [(8, 1e-2), (32, 1e-2), (32, 3e-2)],
    "stock": [(32, 1e-2), (32, 2e-2), (32, 3e-2)],
    "rcv": [(4, 1e-2), (4, 2e-2), (8, 2e-2)],
    "plain, denoised": [(8, 1e-2), (8, 2e-2), (32, 2e-2)],
    "rcv, denoised": [(4, 1e-2), (4, 2e-2), (8, 2e-2)],
}
METHODS = ("plain", "stock", "rcv")
DENOISED = ("plain, denoised", "rcv, denoised")
IMAGES: dict[str, Callable[[], ImageEstimator]] = {
    "plain": ur.images.Plain,
    "rcv": ur.images.RecursiveControlVariate,
    "plain, denoised": lambda: ur.images.Denoised(ur.images.Plain(), by=available_denoiser()),
    "rcv, denoised": lambda: ur.images.Denoised(ur.images.RecursiveControlVariate(), by=available_denoiser()),
}
CONVERGED = 64
"""Samples of a converged image over those of the other methods' images."""
MERGE = ("entries", "equal steps.*.methods")
QUICK = {
    "problem": ("indirect-room",), "loss": ("L2",), "seconds": 0.5, "seeds": 2, "resolution": 16,
    "grid": ("stock=2:0.01", "plain=2:0.01", "rcv=2:0.01,2:0.02"),
}  # fmt: skip


def descend(
    problem: ur.Problem, method: str, spp: int, rate: float, seconds: float, seed: int, processor: bool
) -> list[tuple[float, float]]:
    """(seconds, error) along one run."""
    start = problem.parameter_error(problem.initial())
    if method == "stock":
        timer = work_time if processor else time.perf_counter
        history = stock_loop(problem, spp, rate, seconds=seconds, seed=seed, timer=timer)
    else:
        estimator, optimizer = ur.PathGradient(IMAGES[method](), spp=spp), ur.optimizers.Adam(learning_rate=rate)
        if processor:
            found = timed_run(problem, seconds, seed, estimator, optimizer).found
            return [(at, total_error(problem.parameter_error(values), start)) for at, values in found]
        history = ur.optimize(problem, estimator, optimizer, seconds=seconds, seed=seed).history
    return [(h["seconds"], total_error(h["parameter_error"], start)) for h in history if "parameter_error" in h]


def compare(
    name: str, loss: str, seconds: float, seeds: int, options: dict[str, Any], chosen: Grid | None, processor: bool
) -> dict[str, Any]:
    """Tune every method, then run its best on the seeds, in turns."""
    problem = ur.gallery.problem(name, loss=loss, **options)
    found: dict[str, Any] = {"problem": name, "loss": loss, "seconds": seconds, "options": options, "methods": {}}
    methods, counts = found["methods"], NOISY if name == "indirect-room" else SPP
    if processor:
        found |= {"processor": True, "denoiser": available_denoiser()}
    for method in (*METHODS, *(DENOISED if processor else ())):
        # The stock loop takes plain's spp: its estimate is the same but for the sample groups.
        spp = (methods["plain"]["spp"],) if method == "stock" else counts.get(method, ())
        usual = GRID[method] if processor else list(itertools.product(spp, RATES))
        settings = [{"spp": n, "rate": rate} for n, rate in (chosen or {}).get(method, usual)]

        def end(setting: Setting, method: str = method) -> float:
            return descend(problem, method, **setting, seconds=seconds, seed=TUNING_SEED, processor=processor)[-1][1]

        best, tried = (settings[0], []) if len(settings) == 1 else tune(f"{name} {method}", settings, end)
        methods[method] = {**best, "tried": tried, "runs": []}
    for seed in range(seeds):
        for method, entry in methods.items():
            entry["runs"].append(descend(problem, method, entry["spp"], entry["rate"], seconds, seed, processor))
            print(f"{name} {loss} {method} seed {seed}: {entry['runs'][-1][-1][1]:.3f}", flush=True)
    found["summary"] = summarise(found)
    return found


def at_equal_steps(
    name: str,
    loss: str,
    steps: int,
    spp: tuple[int, int],
    seeds: int,
    rates: tuple[float, ...],
    methods: tuple[str, ...],
) -> dict[str, Any]:
    """Tune the rate of every method, then run its best on the seeds; the adjoint has paths of its own."""
    problem = ur.gallery.problem(name, loss=loss, **SMALL[name])
    image, adjoint = spp
    estimators = {method: ur.PathGradient(make(), spp=image, adjoint_spp=adjoint) for method, make in IMAGES.items()}
    estimators["converged"] = ur.PathGradient(spp=CONVERGED * image, adjoint_spp=adjoint)
    adam = scaled(ur.optimizers.Adam, ur.schedules.Cosine(steps))
    entrants = [Entrant(m, m, each, adam, rates) for m, each in estimators.items() if not methods or m in methods]
    conditions = {"problem": name, "loss": loss, "steps": steps, "spp": spp, "denoiser": available_denoiser()}
    return {**conditions, "methods": race(problem, entrants, seeds, steps=steps)}


def summarise(found: dict[str, Any]) -> dict[str, Any]:
    """Final errors (median, least, most), their ratio, and when the control variate reaches the others' best error."""
    rows: dict[str, Any] = {}
    for method, entry in found["methods"].items():
        final = [run[-1][1] for run in entry["runs"]]
        rows[method] = {"final": median_and_range(final), "best": median_best(entry["runs"])}
    ours = found["methods"]["rcv"]["runs"]
    for method in (method for method in found["methods"] if method != "rcv"):
        rows[method]["ratio"] = rows["rcv"]["final"][0] / rows[method]["final"][0]
        reached = [next((t for t, e in run if e <= rows[method]["best"]), None) for run in ours]
        rows[method]["rcv_reaches_its_best_after"] = reached
        rows[method]["it_reaches_its_best_after"] = float(
            np.median([min(run, key=lambda p: p[1])[0] for run in found["methods"][method]["runs"]])
        )
    return rows


def median_best(runs: list[list[tuple[float, float]]]) -> float:
    """The median over runs of the least error along each."""
    return float(np.median([min(e for _, e in run) for run in runs]))


def parse(given: tuple[str, ...]) -> Grid | None:
    """What `--grid` says."""
    pairs = (text.split("=") for text in given)
    return {m: [(int(t.split(":")[0]), float(t.split(":")[1])) for t in tries.split(",")] for m, tries in pairs} or None


def run(
    problem: tuple[str, ...] = (),
    loss: tuple[str, ...] = ("L1", "L2"),
    seconds: float | None = None,
    seeds: int = 5,
    resolution: int | None = None,
    grid: tuple[str, ...] = (),
    processor: bool = False,
    steps: int | None = None,
    spp: tuple[int, ...] = (16, 16),
    rates: tuple[float, ...] = (0.01, 0.03),
    only: tuple[str, ...] = (),
) -> Iterator[dict[str, Any]]:
    """A part per problem and loss.

    Args:
        problem: by the clock some of indirect-room, glossy-room, sunlit-vase, lamp, by processor time of indirect-room, tea; left out, all
        seconds: budget of every run (15 for indirect-room, else 4; by processor time 8)
        grid: METHOD=SPP:RATE,..., in place of the method's grid; a single one is taken as it is
        processor: whether seconds are of the processor; then with denoised images, too, and smaller films
        steps: of every run, in place of its seconds
        spp: samples per pixel of the image and of the adjoint, with steps
        rates: of a race by steps, to try; a single one is taken as it is
    """
    sizes = SMALL if processor or steps else OPTIONS
    for name in problem:
        if name not in sizes:
            way = "with --processor" if processor else "without --processor"
            raise ur.InputError(f"{name}: not raced {way}; there are {', '.join(sizes)}")
    for name, which in itertools.product(problem or sizes, loss):
        options = {**sizes[name], **({"resolution": resolution} if resolution else {})}
        if steps:
            image, adjoint = spp
            entry = f"{name}, {which}, {image} + {adjoint} spp"
            yield {"equal steps": {entry: at_equal_steps(name, which, steps, (image, adjoint), seeds, rates, only)}}
            continue
        budget = seconds or (8.0 if processor else BUDGETS.get(name, 4.0))
        entry = f"{name}, {which}{', processor' if processor else ''}"
        yield {"entries": {entry: compare(name, which, budget, seeds, options, parse(grid), processor)}}


ORDER = ("stock", "plain", "plain, denoised", "rcv, denoised", "rcv")


def table(record: Record) -> str:
    """Reconstruction at equal time, and at equal steps, of those that the record has."""
    tables = {"entries": by_time, "equal steps": by_steps}
    return markdown.blocks(*(make(record[kind]) for kind, make in tables.items() if kind in record))


def by_steps(entries: dict[str, Any]) -> str:
    """Final errors of races at equal steps."""
    row, rows = "{name} | {steps[0]} | {method} | {rate:g} | {final!m}", []
    for found in markdown.named(entries, "name", "methods", "method"):
        by = f" by {found['denoiser']}" if "denoised" in found["method"] else ""
        rows.append([markdown.fill(row, found | {"method": found["method"] + by})])
    return markdown.table("at equal steps: problem, loss, image + adjoint | steps | method | rate | final error", rows)


def by_time(entries: dict[str, Any]) -> str:
    """Final errors of races at equal time, and when each method is at its best."""
    rows = []
    for entry in entries.values():
        for method in (each for each in ORDER if each in entry["methods"]):
            found, others = {**entry, **entry["methods"][method], **entry["summary"][method]}, ["1", "", ""]
            if method != "rcv":
                reached = sorted(t for t in found["rcv_reaches_its_best_after"] if t is not None)
                share = f"{len(reached)} of {len(entry['methods']['rcv']['runs'])}"
                when = f"{reached[len(reached) // 2]:.1f} s ({share})" if reached else "never"
                others = [f"{1 / found['ratio']:.2f}×", f"{found['it_reaches_its_best_after']:.1f} s", when]
            clock = " of the processor" if "processor" in entry else ""
            row = f"{{problem}} | {{loss}} | {{seconds:g}} s{clock} | {method} ({{spp}} spp, {{rate:g}}) | {{final!m}} | {{best:.3f}}"
            rows.append([markdown.fill(row, found), *others])
    head = "problem | loss | budget | method (spp, rate) | final error | best on the way | × rcv's final | its best at"
    return markdown.table(f"{head} | rcv gets there at", rows)


def plot(record: Record) -> figures.Figure:
    """Error over seconds, a panel per problem and loss; over shares of the steps where the record has races at equal steps only."""
    if "entries" not in record:
        races = {
            name: {
                method: [(np.linspace(0.0, 1.0, len(run)), [point[-1] for point in run]) for run in found["runs"]]
                for method, found in entry["methods"].items()
            }
            for name, entry in record["equal steps"].items()
        }
        return figures.curves(races, "share of the steps", log="")
    panels = {
        name: {
            f"{method}, {found['spp']} spp, rate {found['rate']:g}": figures.from_start(found["runs"])
            for method, found in entry["methods"].items()
        }
        for name, entry in record["entries"].items()
    }
    return figures.curves(panels, "seconds", log="")
