"""Meta-estimation of a radiance field at equal time (Meta Figs 7 and 8): `nerf-volume`, at one resolution.

Adam on plain gradients at 2, 4 and 8 samples per pixel, against meta-estimation with MetaAdam in the paper's form (1
difference, 2 proportional samples), in the coupled one, and in that on a control variate's images; two of them with more
samples as well. Each is tuned on a seed of its own for the whole budget: the emission's learning rate, extinction's
being 20 times that, falling along half a cosine over the steps that fit into the budget.

The field has no truth, so errors are of images: root mean square over the 8 views that the descent sees, and over 4
between them that it does not, relative to where it began. They are free of rendering noise: products of two independent
renders' differences. Learning rates are tuned by the views seen.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import unrender as ur
from benchmarks import figures, markdown
from benchmarks.internals import Estimator, dr
from benchmarks.races import AT_END, TUNING_SEED, Entrant, follow, race, scaled
from benchmarks.runner.records import Record
from benchmarks.runner.timing import work_time
from benchmarks.timed_runs import ImageErrors
from unrender.schedules import Constant, Cosine, Schedule

SPP = (2, 4, 8)
VIEWS = 12
UNSEEN = (1, 4, 7, 10)
RATES = {"Adam": (0.02, 0.04, 0.08), "meta": (0.01, 0.02, 0.04)}
FLOOR = 0.05
USUAL_GRID = 64
MERGE = ("schedules.*.methods",)
QUICK = {
    "seconds": 0.5, "seeds": 1, "resolution": 8, "grid": 8, "only": ("Adam, 2 spp", "meta"), "reference_spp": 16,
}  # fmt: skip


def entrants(schedule: Schedule) -> list[Entrant]:
    """Who races."""
    adam, meta = scaled(ur.optimizers.Adam, schedule), scaled(ur.optimizers.MetaAdam, schedule)
    control = ur.images.RecursiveControlVariate()
    others: dict[str, Estimator] = {
        "meta": ur.MetaEstimator(),
        "coupled, 3 spp": ur.MetaEstimator(coupled=True, spp=3),
        "coupled on rcv, 3 spp": ur.MetaEstimator(coupled=True, spp=3, image=control),
        "meta, 8 and 4 spp": ur.MetaEstimator(proportional_spp=8, difference_spp=4),
        "coupled on rcv, 8 spp": ur.MetaEstimator(coupled=True, spp=8, image=control),
    }
    found = [Entrant(f"Adam, {n} spp", "Adam", ur.PathGradient(spp=n), adam, RATES["Adam"]) for n in SPP]
    return found + [Entrant(name, "meta", estimator, meta, RATES["meta"]) for name, estimator in others.items()]


def steps_in(problem: ur.Problem, entrant: Entrant, errors: ImageErrors, seconds: float, processor: bool) -> int:
    """How many steps fit into so many seconds. Compiles and records what is left after a warm-up, measured as the runs are."""
    rate = entrant.rates[0]
    recorder = follow(problem, entrant, rate, TUNING_SEED, errors, 5, steps=15)
    clocks = [clock for clock, _, _ in recorder.points["seen"]]
    of_three = (clocks[-1] - clocks[-3]) / 2
    if processor:
        spent = []
        for steps in (3, 6):
            began = work_time()
            follow(problem, entrant, rate, TUNING_SEED, errors, AT_END, steps=steps)
            spent.append(work_time() - began)
        of_three = spent[1] - spent[0]
    return max(1, round(3 * seconds / of_three))


def measure(
    problem: ur.Problem, errors: ImageErrors, name: str, seconds: float, seeds: int, processor: bool
) -> dict[str, Any]:
    """One entrant's figures."""

    def entrant(schedule: Schedule) -> Entrant:
        return next(e for e in entrants(schedule) if e.name == name)

    steps = steps_in(problem, entrant(Constant()), errors, seconds, processor)
    budget: dict[str, Any] = {"steps": steps} if processor else {"seconds": seconds}
    return race(problem, [entrant(Cosine(steps, FLOOR))], seeds, measure=errors, by="seen", **budget)


def label(grid: int, balls: int) -> str:
    """The name of an entry of the record."""
    of = [f"{grid}³"] * (grid != USUAL_GRID) + [f"{balls} balls"] * (balls > 0)
    return ", ".join(["falling", *of])


def run(
    seconds: float = 12.0,
    seeds: int = 2,
    resolution: int = 64,
    grid: int = USUAL_GRID,
    only: tuple[str, ...] = (),
    balls: int = 0,
    processor: bool = False,
    reference_spp: int = 1024,
) -> Iterator[dict[str, Any]]:
    """A part per method.

    Args:
        grid: voxels along a side; the others' figures stay
        balls: in place of the toy, so that the volume is sparse (Fig. 8); 0: the toy. The other's figures stay
        processor: whether seconds are those of one thread of the processor, which tell the steps of a run
    """
    options = {
        "resolution": resolution, "grid_resolution": grid, "views": VIEWS, "reference_spp": reference_spp, "balls": balls
    }  # fmt: skip
    made = ur.gallery.problem("nerf-volume", **options)
    views = [view for number, view in enumerate(made.original_views) if number not in UNSEEN]
    problem = made.replaced(views=views)
    if processor:
        dr.set_thread_count(1)
    groups = {"seen": [n for n in range(VIEWS) if n not in UNSEEN], "unseen": list(UNSEEN)}
    errors, conditions = ImageErrors(made, options, groups, 16), {"seconds": seconds, "seeds": seeds}
    conditions |= {"resolution": resolution, "processor": processor, "grid": grid, "balls": balls}
    for name in (e.name for e in entrants(Constant()) if not only or e.name in only):
        methods = measure(problem, errors, name, seconds, seeds, processor)
        yield {"schedules": {label(grid, balls): {**conditions, "methods": methods}}}


def table(record: Record) -> str:
    parts = []
    for entry in record["schedules"].values():
        of = " of {balls} balls" if entry["balls"] else ""
        by = " of the processor" if entry["processor"] else ""
        text = f"`nerf-volume`{of}, {{resolution}}², grids of {{grid}}³, falling rates, {{seconds:g}} s{by}, {{seeds}} seeds. "
        rows = [
            [
                markdown.fill("{name} | {rate:g} | {final[seen]!m} | {final[unseen]!m}", found),
                ", ".join(map(str, found["steps"])),
            ]
            for found in markdown.named(entry["methods"], "name")
        ]
        head = "method | learning rate | error of views seen | of views unseen | steps"
        parts += [markdown.fill(text + "Errors over the initial ones.", entry), markdown.table(head, rows)]
    return markdown.blocks(*parts)


def plot(record: Record) -> figures.Figure:
    """Error of views seen and unseen over seconds, or over paths where runs are told by the processor's time."""
    panels = {
        f"{kind}, {views}, over {'paths' if entry['processor'] else 'seconds'}": figures.race_curves(
            entry["methods"], views, int(entry["processor"])
        )
        for kind, entry in record["schedules"].items()
        for views in ("seen", "unseen")
    }
    return figures.curves(panels, "", "error of images / at the start", columns=2)
