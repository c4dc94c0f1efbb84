"""Pixel mini-batches at equal time (Adaptive Figs 1, 4, 5, 8 and 9): `sun-glossy`, `plain-and-textured`, `two-planets`, `mirror-trio`, and
`three-textures`, `globe-and-mirror`, `sunlit-vase`.

Uniform mini-batches, those in proportion to the loss derivative, and adaptive ones, two paths per pixel and as many pixels for all, Adam,
the learning rate of each tuned on a seed of its own for the whole budget. Images and textures have fewer sampled pixels per texel than
texels, as in the paper. On `plain-and-textured` also five levels. Error is each parameter's RMSE relative to where it began, averaged over
parameters; ratios are to uniform mini-batches, at ten checkpoints, medians over seeds, at equal samples and at equal time. Since the
machine's speed may change between runs, the time of a path is measured in turns, after the race (`--part cost`: that alone).

`--steps 5000` races by steps, with rates that fall along half a cosine; `time` is then that in which each method first
reaches the least error that all reach, over that of uniform mini-batches; these races have entries of their own. Large
pictures: `--resolution 1024`. `--levels` races one level against five at equal steps in
`plain-and-textured`: the paper's form, as Fig. 5 has it, and the default.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

import unrender as ur
from benchmarks import figures, markdown
from benchmarks.internals import Tree, dr
from benchmarks.pixel_schemes import PAPERS, pixels
from benchmarks.races import Entrant, Measure, Runs, follow, over, race, reached, scaled, tenths
from benchmarks.runner.records import Record
from benchmarks.runner.timing import work_time

FINE = {"resolution": 192, "texture_resolution": 192}
MANY = {"resolution": 512, "texture_resolution": 192, "reference_spp": 8}
"""As many pixels a picture as the paper's Fig. 9 has, where there are 16 or 32 of them."""
TASKS: dict[str, tuple[str, dict[str, Any], int]] = {
    "sun-glossy L2": ("sun-glossy", {"loss": "L2", **FINE}, 2048),
    "sun-glossy relative L2": ("sun-glossy", {"loss": "RelativeL2", **FINE}, 2048),
    "plain-and-textured": ("plain-and-textured", FINE, 2048),
    "two-planets": ("two-planets", {"resolution": 128, "texture_resolution": 128}, 2048),
    "mirror-trio": ("mirror-trio", {"resolution": 192}, 2048),
    "three-textures": ("three-textures", FINE, 2048),
    "globe-and-mirror": ("globe-and-mirror", {"resolution": 4096, "texture_resolution": 256, "reference_spp": 4}, 2048),
    "sunlit-vase": ("sunlit-vase", {**MANY, "views": 16, "loss": "L2"}, 2048),
    "sun-glossy, 32 views": ("sun-glossy", {**MANY, "views": 32}, 2048),
}
"""Problem, its options, pixels a step."""
RATES = (0.01, 0.03)
MERGE = ("entries.*.methods", "seconds_per_path.*", "levels.*")
QUICK = {"problem": ("two-planets",), "seconds": 0.3, "seeds": 2, "resolution": 16, "count": 32, "rounds": 2}


def entrants(task: str, count: int, steps: int | None = None) -> list[Entrant]:
    """Who races; rates fall over so many steps, or are constant."""

    def adam(rate: float) -> ur.optimizers.Adam:
        return ur.optimizers.Adam(rate, schedule=ur.schedules.Cosine(steps)) if steps else ur.optimizers.Adam(rate)

    def entrant(label: str, scheme: str, **options: Any) -> Entrant:
        return Entrant(label, label, ur.PathGradient(pixels=pixels(scheme, count, **options), spp=2), adam, RATES)

    found = [entrant("uniform", "uniform"), entrant("loss", "loss"), entrant("adaptive", "adaptive")]
    if task in ("plain-and-textured", "sun-glossy L2"):
        found.append(entrant("adaptive, as the paper", "adaptive", **PAPERS, levels=4))
    if task == "plain-and-textured":
        found.append(entrant("adaptive, five levels", "adaptive", levels=4))
    return found


LEVELS: dict[str, dict[str, Any] | None] = {
    "uniform": None, "paper's form, one level": PAPERS, "paper's form, five levels": {**PAPERS, "levels": 4},
    "adaptive, one level": {}, "adaptive, five levels": {"levels": 4},
}  # fmt: skip


def race_levels(count: int, steps: int, seeds: int, only: tuple[str, ...], options: dict[str, Any]) -> dict[str, Any]:
    """Race samplers of one and of five levels at the rate that the race by time chose for each. On one thread a seed gives one run."""
    dr.set_thread_count(1)
    adam, chosen = scaled(ur.optimizers.Adam, ur.schedules.Cosine(steps)), []
    for name, own in ((name, own) for name, own in LEVELS.items() if not only or name in only):
        sampler = ur.pixels.Uniform(count) if own is None else ur.pixels.Adaptive(count, **own)
        chosen.append(Entrant(name, name, ur.PathGradient(pixels=sampler, spp=2), adam, RATES[:1]))
    problem = ur.gallery.problem("plain-and-textured", **options)
    methods = race(problem, chosen, seeds, measure=by_object(problem), by="both", points=4, steps=steps)
    return {"options": options, "count": count, "steps": steps, "seeds": seeds, "methods": methods}


def by_object(problem: ur.Problem) -> Measure:
    """Measure the error of each object's reflectance relative to the start, and the mean over both objects under the name "both"."""
    start = problem.parameter_error(problem.initial())

    def measure(parameters: Tree) -> dict[str, float]:
        errors = problem.parameter_error(parameters)
        relative = {key.partition(".")[0]: error / start[key] for key, error in errors.items()}
        return {"both": sum(relative.values()) / len(relative), **relative}

    return measure


def costs(
    problem: ur.Problem, chosen: list[Entrant], rate: float, rounds: int = 5, steps: int = 60
) -> dict[str, float]:
    """Seconds per path of short descents, of the processor (`work_time`), in turns: medians."""
    found: dict[str, list[float]] = {entrant.name: [] for entrant in chosen}
    for turn in range(rounds):
        for entrant in chosen:
            points = follow(problem, entrant, rate, turn, points=2 * steps, clock=work_time, steps=steps).points[""]
            (begun, before, _), (ended, after, _) = points[steps // 3], points[-1]
            found[entrant.name].append((ended - begun) / (after - before))
    return {name: float(np.median(times)) for name, times in found.items()}


def timed(methods: dict[str, Any], seconds: dict[str, float]) -> Runs:
    """The runs, with their seconds as so many paths take."""
    return {
        name: [[(samples * seconds[name], samples, error) for _, samples, error in run] for run in entry["runs"]]
        for name, entry in methods.items()
    }


def summarize(record: dict[str, Any]) -> dict[str, Any]:
    """Each task's errors at equal time, and ratios to uniform mini-batches by time and by samples."""
    entries = {}
    for task, entry in record.get("entries", {}).items():
        runs = timed(entry["methods"], record["seconds_per_path"][task])
        entries[task] = {**entry, "errors": tenths(runs, 0), "over uniform": over(runs, "uniform")}
        if entry.get("steps"):
            entries[task]["time"] = times(runs)
    return {"entries": entries}


def times(runs: Runs) -> dict[str, float | None]:
    """When each method first has the least error that half of the runs of all have in the end, over when uniform mini-batches do."""
    level = max(float(np.quantile([run[-1][2] for run in found], 0.5, method="higher")) for found in runs.values())
    first = {name: reached(found, level, 0) for name, found in runs.items()}
    uniform = first["uniform"]
    return {name: second / uniform if second and uniform else None for name, second in first.items()}


def run(
    problem: tuple[str, ...] = tuple(TASKS),
    seconds: float = 8.0,
    seeds: int = 5,
    resolution: int | None = None,
    count: int | None = None,
    steps: int | None = None,
    texture_resolution: int | None = None,
    only: tuple[str, ...] = (),
    part: tuple[str, ...] = ("race", "cost"),
    rounds: int = 5,
    levels: bool = False,
) -> Iterator[dict[str, Any]]:
    """A part per task.

    Args:
        steps: of every run, in place of its seconds, with falling rates
        texture_resolution: texels a side, for GPUs
        rounds: of turns of the cost
        levels: race one level against five, by steps; the rest of the record stays
    """
    given = {"resolution": resolution, "texture_resolution": texture_resolution}
    given = {key: value for key, value in given.items() if value}
    if levels:
        races = race_levels(count or 512, steps or 400, seeds, only, {**FINE, **given})
        yield {"levels": {f"{count or 512} pixels": races}}
        return
    for task in problem:
        name, options, usual = TASKS[task]
        options = {**options, **given}
        made, pixel_count, found = ur.gallery.problem(name, **options), count or usual, {}
        chosen = [e for e in entrants(task, pixel_count, steps) if not only or e.name in only]
        label = f"{task}, {steps} steps" if steps else task
        if "race" in part:
            conditions = {"options": options, "count": pixel_count, "seconds": seconds, "seeds": seeds}
            budget: dict[str, Any] = {"steps": steps} if steps else {"seconds": seconds}
            conditions |= budget
            found["entries"] = {label: {**conditions, "methods": race(made, chosen, seeds, **budget)}}
        yield {**found, "seconds_per_path": {label: costs(made, chosen, RATES[0], rounds)}}


def table(record: Record) -> str:
    """All races in one table; then per task final errors, and ratios to uniform at checkpoints."""
    parts = [all_races(record)] if record["entries"] else []
    for name, entry in record.get("levels", {}).items():
        head = "pixels | rate | error of both objects | of the textured one | of the plain one"
        row = "{method} | {rate:g} | {final[both]!m} | {final[cushion]!m} | {final[bin]!m}"
        parts += [
            f"**One level against five**, `plain-and-textured`, {name} and {entry['steps']} steps, falling rates, {entry['seeds']} seeds.",
            markdown.records(head, row, markdown.named(entry["methods"], "method")),
        ]
    for name, entry in record["entries"].items():
        over = entry["over uniform"]
        rows = []
        for method, run in entry["methods"].items():
            ratios = (" ".join(f"{x:.2f}" for x in of[method]) for of in over.values())
            rows.append([method, f"{run['rate']:g}", f"{entry['errors'][method][-1]:.3f}", *ratios])
        head = " | ".join(
            ["pixels | rate | error at equal time", *(f"over uniform, at tenths of the {by}" for by in over)]
        )
        sizes = ", ".join(f"{key}={value}" for key, value in entry["options"].items())
        budget = f"{entry['steps']} steps, falling rates" if entry.get("steps") else f"{entry['seconds']:g} s"
        summary = f"{entry['count']} pixels a step, {budget}, {entry['seeds']} seeds"
        parts += [f"**{name}**{f' ({sizes})' if sizes else ''}, {summary}.", markdown.table(head, rows)]
        if "time" in entry:
            found = (f"{method} {'never' if x is None else f'{x:.2f}'}" for method, x in entry["time"].items())
            parts.append(f"Time to the least error that all reach, over that of uniform pixels: {', '.join(found)}.")
    return markdown.blocks(*parts)


def all_races(record: Record) -> str:
    """Of each race: errors of Eq. 5 and adaptive pixels over uniform ones' at its end, and the time to the least error that all reach."""
    rows, ends = [], []
    for name, entry in record["entries"].items():
        over, time = entry["over uniform"], entry.get("time", {}).get("adaptive")
        pairs = [(by, method) for by in ("time", "samples") for method in ("loss", "adaptive")]
        cells = (f"{over[by][method][-1]:.2f}" if method in over[by] else "–" for by, method in pairs)
        rows.append([name, *cells, f"{time:.2f}" if time else "–"])
        if not name.startswith("mirror-trio"):
            ends.append(over["time"]["adaptive"][-1])
    head = "race | Eq. 5, equal time | adaptive, equal time | Eq. 5, equal samples | adaptive, equal samples | time"
    mean = float(np.exp(np.log(ends).mean()))
    return markdown.blocks(
        "**All races**: error at the end over that of uniform pixels, and the time of adaptive pixels to the least error that all reach "
        f"over theirs. Geometric mean of adaptive pixels at equal time: {mean:.2f}, without `mirror-trio`, whose error crosses 0.",
        markdown.table(head, rows),
    )


def plot(record: Record) -> figures.Figure:
    panels = {
        name: {
            f"{method}: {entry['errors'][method][-1]:.3f}": figures.points(runs)
            for method, runs in timed(entry["methods"], record["seconds_per_path"][name]).items()
        }
        for name, entry in record["entries"].items()
    } | {
        f"one level or five, texture, {name}": {
            of: figures.points(run["runs"]["cushion"]) for of, run in entry["methods"].items()
        }
        for name, entry in record.get("levels", {}).items()
    }
    return figures.curves(panels, "seconds")
