"""Problems of 1 to 9 numbers: `auto` against Mitsuba's loop and against fixed settings of our own, at equal processor time.

Lamps, a lens, a field of view, indices of refraction, roughness, a principled BSDF, fog, a sky and poses of lights, each from one picture
of at most 32² pixels with 4,096 samples per pixel. Errors are means over the unknowns, relative to the start, of the returned values. The
loop is tuned on a seed of its own over samples per pixel, rates and whether these fall, where `prb` has derivatives. Seconds are the
processor's, without planning and the two steps that compile, of both. Problems of the suite, such as "numbers, L2", can take their place.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from statistics import geometric_mean
from typing import Any

import numpy as np

import unrender as ur
from benchmarks import markdown
from benchmarks.races import TUNING_SEED, Setting, grid, relative_error, tune
from benchmarks.runner.records import Record
from benchmarks.runner.timing import work_time
from benchmarks.shapes.lights import run as lights
from benchmarks.suite import ablation, scenes
from benchmarks.suite.run import Points, compare, loop, setting_text
from benchmarks.timed_runs import blind, timed_run
from benchmarks.uncertainty.numbers import run as uncertain
from tests import few_numbers

MERGE = ("problems.*",)
QUICK: dict[str, Any] = {"problem": ("metal",), "seconds": 0.3, "seeds": 1, "spp": (2,), "rates": (0.02,)}
PROBLEMS: dict[str, Callable[[], ur.Problem]] = {
    **{name: partial(few_numbers.problem, name, 4096) for name in few_numbers.CASES},
    "glass ball": lambda: uncertain.with_own_references(uncertain.problem("glass"), 4096, 0),
    **{name: partial(lights.problem, name, 1, 0, 24, 4096) for name in ("projector", "area")},
}
NO_LOOP = ("lamps", "lens", "view", "plastic", "pose", "projector", "area")
"""Problems with unknowns by which `prb` has no derivatives."""
OPTIONS = ("spp=16", "spp=256", "model-steps")
"""Fixed settings: of `auto`, and its plan without Gauss-Newton steps, see `ablation`."""
_EVERY = 5
"""Steps of the loop between errors."""


def run(
    problem: tuple[str, ...] = tuple(PROBLEMS),
    foreign: tuple[str, ...] = (),
    assets: Path | None = None,
    seconds: float = 1.0,
    seeds: int = 3,
    spp: tuple[int, ...] = (4, 16),
    rates: tuple[float, ...] = (0.005, 0.02, 0.05),
    option: tuple[str, ...] = OPTIONS,
) -> Iterator[dict[str, Any]]:
    """Every problem.

    Args:
        foreign: problems of the suite in their place, such as "numbers, L2"
        assets: folder of their scenes
        option: fixed settings of `auto`, or parts to leave out
    """
    for name in foreign or problem:
        made = PROBLEMS[name]() if name in PROBLEMS else scenes.problem(name, assets)
        error = relative_error(made)

        def ours(seed: int, option: str = "", made: ur.Problem = made, error: Any = error) -> list[tuple[float, float]]:
            plan = ablation.plan(blind(made), option)
            kept = timed_run(plan.problem, seconds, seed, plan)
            return [*((at, error(values)) for at, values in kept.found), (kept.seconds, error(kept.returned))]

        def theirs_of(setting: Setting, seed: int, made: ur.Problem = made, error: Any = error) -> Points:
            return loop(made, error, seconds, seed, _EVERY, setting, timer=work_time)

        setting, tried, mine, theirs = {}, [], [], []
        if name not in NO_LOOP:
            tries = grid(spp=spp, rate=rates, falling=(False, True))
            setting, tried = tune(name, tries, lambda each, of=theirs_of: of(each, TUNING_SEED)[-1][1])
        for seed in range(seeds):  # in turns
            mine.append(ours(seed))
            theirs += [theirs_of(setting, seed)] if setting else []
        fixed = [each for each in option if ablation.changes(made, each)]
        ends = {each: [ours(seed, each)[-1][1] for seed in range(seeds)] for each in fixed}
        entry: dict[str, Any] = {"ends": {"": [points[-1][1] for points in mine], **ends}, "seconds": seconds}
        if setting:
            entry |= {"setting": setting, "tried": tried, "loop": compare(theirs, mine, seconds)}
        print(name, {option: float(np.median(x)) for option, x in entry["ends"].items()}, flush=True)
        yield {"problems": {name: entry}}


def table(record: Record) -> str:
    """Errors at the end, the ratio to the best fixed setting, and the speed-up over the loop."""
    rows, regrets = [], []
    for name, entry in record["problems"].items():
        auto, *others = ((float(np.median(x)), option) for option, x in entry["ends"].items())
        best, option = min(others, default=auto)
        fixed = f"{best:.4f} ({option or '`auto`'})"
        regrets.append(max(auto[0] / best, 1.0))
        cells = ["no derivatives", "", ""]
        if "loop" in entry:
            speed = f"{entry['loop']['speed']:.2g}" if entry["loop"]["speed"] else "below 1"
            cells = [setting_text(entry["setting"]), markdown.spread(entry["loop"]["final"]["loop"]), speed]
        ends = entry["ends"][""]
        spread = markdown.spread(ends)
        rows.append([name, f"{entry['seconds']:g}", len(ends), spread, fixed, f"{regrets[-1]:.2f}", *cells])
    head = "problem | seconds | seeds | `auto` | best fixed setting | regret | the loop's setting | loop | speed-up"
    text = "Seconds of the processor, median (least to greatest). Regret: "
    text += f"geometric mean {geometric_mean(regrets):.2f}, at most 1.15 on {sum(x <= 1.15 for x in regrets)} of {len(rows)}."
    return markdown.blocks(text, markdown.table(head, rows))
