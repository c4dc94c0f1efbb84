"""Longer budgets than the suite's: whether `auto` stays ahead of the tuned stock loop, and whether its error still falls.

The loop has the best settings of the suite's record, each run anew over the whole budget (so a falling rate falls over that), and the best
by its median at the end counts. `auto` has none set. Errors and times are those of `suite`.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import unrender as ur
from benchmarks import markdown
from benchmarks.internals import dr
from benchmarks.runner import records
from benchmarks.runner.records import Record
from benchmarks.suite import scenes
from benchmarks.suite.run import FOREIGN, GALLERY, compare, error_of, loop, middle, ours, setting_text

PROBLEMS = ("wall", "smoke")
MERGE = ("entries.*",)
QUICK = {
    "problem": ("mirror-trio",), "seconds": (0.4,), "seeds": 1, "settings": 1, "gallery_reference_spp": 1, "every": 1
}  # fmt: skip


def best_settings(name: str, count: int) -> list[dict[str, Any]]:
    """Those of least error in the suite's record. Raises `InputError` for a problem that it does not have."""
    record = records.read(Path(__file__).parents[1])
    if record is None or name not in record["problems"]:
        known = ", ".join((*GALLERY, *FOREIGN))
        raise ur.InputError(f"{name}: the record of suite has no settings of the loop for it; it has at most {known}")
    tried = sorted(record["problems"][name]["tried"], key=lambda found: found["error"])
    return [{key: found[key] for key in ("spp", "rate", "falling")} for found in tried[:count]]


def run(
    problem: tuple[str, ...] = PROBLEMS,
    foreign: tuple[str, ...] = (),
    assets: Path | None = None,
    seconds: tuple[float, ...] = (30.0,),
    seeds: int = 2,
    settings: int = 2,
    gallery_reference_spp: int | None = None,
    every: int = 4,
) -> Iterator[dict[str, Any]]:
    """An entry for each problem and budget.

    Args:
        problem: of the gallery
        foreign: of others, such as "cbox, L2"
        settings: of the loop, that were best in the suite's record
        gallery_reference_spp: of the gallery's references, none for its own
        every: steps of the loop between errors
    """
    options = {} if gallery_reference_spp is None else {"reference_spp": gallery_reference_spp}
    for name in (*problem, *foreign):
        chosen = best_settings(name, settings)
        opened = scenes.problem(name, assets, **options)
        error = error_of(opened)
        for budget in seconds:
            theirs = [[loop(opened, error, budget, seed, every, given) for seed in range(seeds)] for given in chosen]
            best = min(range(len(chosen)), key=lambda index: middle(theirs[index], budget)[-1])
            mine = [ours(opened, error, budget, seed)[0] for seed in range(seeds)]
            found = compare(theirs[best], mine, budget)
            found |= {"problem": name, "seconds": budget, "setting": chosen[best], "seeds": seeds}
            print(f"{name}, {budget:g} s: loop {found['loop'][-1]:.4f}, auto {found['auto'][-1]:.4f}", flush=True)
            yield {"entries": {f"{name}, {budget:g} s": found}}
        del opened, error
        dr.sync_thread()


def table(record: Record) -> str:
    """Errors of both sides at tenths of the time."""
    rows = []
    for entry in record["entries"].values():
        words = markdown.fill("{problem} | {seconds:g} s", entry)
        errors = (" ".join(f"{error:.3f}" for error in entry[side]) for side in ("loop", "auto"))
        speed = f"**{entry['speed']:.2g}**" if entry["speed"] else "below 1"
        rows.append([words, setting_text(entry["setting"]), *errors, speed, entry["seeds"]])
    head = "problem | budget | the loop's setting | loop, at tenths | auto, at tenths | speed-up | seeds"
    return markdown.table(head, rows)
