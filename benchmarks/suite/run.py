"""What someone gets who sets nothing, against Mitsuba's own loop as a good user tunes it, over problems of the gallery and of others.

Each problem gets the same time from both. `auto` has no option given; where `--option` gives some, it is tuned over these beside, on a seed
of its own, by when it is at what the loop reaches. The loop of `mi.render`, `dr.backward` and `mi.ad.Adam` is tuned on a seed of its own
for the whole time, over samples per pixel, learning rate, and whether the rate falls as half a cosine over the time; its best setting is
then run on the other seeds. A parameter's own rate, where a gallery problem gives one, is the loop's for it.

Errors are of the elements that the views see: those that change the images at the truth by at least a twentieth of the median
(`unrender.sensitivity`). Beside both stands what somebody would do by hand where every unknown is a reflectance, reference over rendering
(`stock_loop.fixed_point`). Compilation is left out of the time on both sides, and told apart. Problems of poses are in
higher_order.table2, since the loop has no gradients of them.
"""

from __future__ import annotations

import gc
import math
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from statistics import geometric_mean
from typing import Any

import numpy as np

import unrender as ur
from benchmarks import figures, markdown
from benchmarks.internals import dr, insensitive
from benchmarks.races import TUNING_SEED, Recorder, Setting, grid, tune
from benchmarks.runner import records
from benchmarks.runner.records import Record
from benchmarks.stock_loop import applies, fixed_point, stock_loop
from benchmarks.suite import ablation, scenes

GALLERY = (
    "indirect-room", "glossy-room", "sunlit-vase", "lamp", "spiral", "ajar", "chalice", "mirror-trio", "sun-glossy",
    "plain-and-textured", "two-planets", "caustic", "poster", "three-bodies", "tea", "smoke", "wall",
)  # fmt: skip
FOREIGN = tuple(f"{scene}, {loss}" for scene in scenes.SCENES for loss in scenes.LOSSES)
QUICK = {
    "problem": ("mirror-trio",), "seconds": 0.4, "seeds": 1, "option": ("spp=2",), "spp": (4,), "rates": (0.02,),
    "gallery_reference_spp": 1, "every": 1,
}  # fmt: skip
MERGE = ("problems.*",)
FIXED_POINT_SPP = 16
Points = list[tuple[float, float]]


def visible(problem: ur.Problem) -> dict[str, np.ndarray]:
    """{key: mask of the elements that the images depend on at the truth}; of numbers, all."""
    found = {}
    for key, value in ur.runs.sensitivity(problem, {**problem.initial_values(), **problem.truth}).items():
        seen = ~insensitive(value)[..., None] if value.ndim > 1 else np.True_
        found[key] = np.broadcast_to(seen, value.shape)
    return found


def errors_of(problem: ur.Problem) -> Callable[[dict[str, Any]], dict[str, float]]:
    """The errors of given parameters where they are seen: each one's RMSE over its RMSE at the start."""
    seen = visible(problem)

    def errors(values: dict[str, Any]) -> dict[str, float]:
        full = problem.full(values)
        return {
            key: float(np.sqrt(np.mean((full[key].reshape(truth.shape) - truth)[seen[key].reshape(truth.shape)] ** 2)))
            for key, truth in problem.truth.items()
        }

    start = errors(problem.initial())
    return lambda values: {key: error / start[key] for key, error in errors(values).items()}


def error_of(problem: ur.Problem) -> Callable[[dict[str, Any]], float]:
    """The mean of `errors_of`."""
    errors = errors_of(problem)
    return lambda values: float(np.mean(list(errors(values).values())))


def ours(
    problem: ur.Problem, error: Callable[[dict[str, Any]], float], seconds: float, seed: int, option: str = ""
) -> tuple[Points, dict[str, Any]]:
    """Run `auto`, with an option or without a part (`ablation.plan`); return its curve, its steps and its seconds of compilation."""
    curve = Recorder(lambda values: {"": error(values)}, {"": 1.0}, 1 / 100)
    plan = ablation.plan(problem, option)
    # Kernels are recorded anew after the loop's scene has come or gone.
    before = ur.optimize(plan.problem, plan, steps=2, seed=seed).warmup_seconds
    result = ur.optimize(plan.problem, plan, seconds=seconds, seed=seed, callbacks=[curve])
    points = [(at, found) for at, _, found in curve.points[""][1:]]
    return points, {"steps": result.steps, "compile_seconds": before + result.warmup_seconds}


def loop(
    problem: ur.Problem,
    error: Callable[[dict[str, Any]], float],
    seconds: float,
    seed: int,
    every: int,
    setting: dict[str, Any],
    timer: Callable[[], float] = time.perf_counter,
    integrator: Any = None,
) -> Points:
    """A run of the stock loop, with an integrator other than `prb` if given."""
    fall: Any = ur.schedules.Cosine(1) if setting["falling"] else None
    options = {"seed": seed, "every": every, "fall": fall, "error": error, "timer": timer, "integrator": integrator}
    history = stock_loop(problem, setting["spp"], setting["rate"], seconds, **options)
    return [(h["seconds"], h["parameter_error"]) for h in history]


def tune_ours(
    problem: ur.Problem, error: Any, seconds: float, options: Any, loop_curve: np.ndarray, seeds: int
) -> tuple[str, list[dict[str, Any]]]:
    """The option of `auto` with which it is first at the loop's best error, or of least error where none gets there; and all tried.

    What `auto` chooses by itself is not tried again. Figures are of the median over `seeds` runs: the least of several single runs is
    that of the luckiest, where a problem has few numbers.
    """
    tried = []
    for option in ("", *options):
        if option and not ablation.changes(problem, option):
            continue
        runs = [ours(problem, error, seconds, TUNING_SEED + seed, option)[0] for seed in range(seeds)]
        curve = middle(runs, seconds)
        when = _reached(curve, float(loop_curve.min()), seconds)
        tried.append({"option": option, "error": float(curve[-1]), "seconds": when})
        print(f"  {problem.name}: auto {option or 'as it is'}: {curve[-1]:.4f}, there after {when}", flush=True)
    return min(tried, key=lambda one: (one["seconds"] or math.inf, one["error"]))["option"], tried


def middle(runs: list[Points], seconds: float, count: int = 200) -> np.ndarray:
    """The median over runs of the error at equal steps of the time, (count,), 1 before the first point."""
    grid = seconds * np.arange(1, count + 1) / count

    def at(points: Points) -> np.ndarray:
        clock, errors = np.array([(0.0, 1.0), *points]).T
        return np.asarray(errors[np.searchsorted(clock, grid, side="right") - 1])

    return np.median([at(points) for points in runs], axis=0)


def tenths(curve: np.ndarray) -> list[float]:
    """A curve of `middle` at tenths of the time."""
    tenth = len(curve) // 10
    return curve[tenth - 1 :: tenth].tolist()


def compare(theirs: list[Points], found: list[Points], seconds: float) -> dict[str, Any]:
    """Both curves at tenths of the time; when the loop is at its best, and when we are as good; None for never."""
    loop_curve, our_curve = middle(theirs, seconds), middle(found, seconds)
    best = float(loop_curve.min())
    when = (int(np.argmin(loop_curve)) + 1) / len(loop_curve) * seconds
    first = _reached(our_curve, best, seconds)
    curves: dict[str, Any] = {"loop": tenths(loop_curve), "auto": tenths(our_curve), "best_of_loop": best}
    curves["final"] = {"loop": [run[-1][1] for run in theirs], "auto": [run[-1][1] for run in found]}
    return curves | {"seconds_of_loop": when, "seconds_of_auto": first, "speed": when / first if first else None}


def _ours_of(compared: dict[str, Any]) -> dict[str, Any]:
    return {key: compared[key] for key in ("auto", "seconds_of_auto", "speed")}


def _reached(curve: np.ndarray, error: float, seconds: float) -> float | None:
    """The first time at which a curve of `middle` is at an error."""
    reached = np.nonzero(curve <= error)[0]
    return (int(reached[0]) + 1) / len(curve) * seconds if len(reached) else None


def run(
    problem: tuple[str, ...] = GALLERY,
    foreign: tuple[str, ...] = (),
    assets: Path | None = None,
    seconds: float = 10.0,
    seeds: int = 3,
    spp: tuple[int, ...] = (4, 16, 64),
    rates: tuple[float, ...] = (0.005, 0.02, 0.05),
    gallery_reference_spp: int | None = None,
    gallery_resolution: int | None = None,
    every: int = 2,
    option: tuple[str, ...] = (),
    option_seeds: int = 1,
    retune: bool = True,
    without: tuple[str, ...] = (),
) -> Iterator[dict[str, Any]]:
    """Every problem.

    Args:
        problem: of the gallery
        foreign: of others, such as "cbox, L2"; none for all of them where assets are given
        gallery_reference_spp: of the gallery's references, none for its own
        gallery_resolution: film size of the gallery's problems, none for its own
        every: steps of the loop between errors
        option: of `auto`, as "spp=2 learning_rate=0.3", each a setting to tune it by as well; none for not to tune it
        option_seeds: runs of each of these settings, of which the median counts
        retune: the loop; else its settings are those of the record
        without: parts of `auto` to leave out, one at a time, by the names of `ablation.PARTS`
    """
    if unknown := set(without) - set(ablation.PARTS):
        raise ur.InputError(f"--without {', '.join(unknown)}: expected {', '.join(ablation.PARTS)}")
    record = None if retune else records.read(Path(__file__).parent)
    known = record["problems"] if record else {}
    given = {"reference_spp": gallery_reference_spp, "resolution": gallery_resolution}
    options = {key: value for key, value in given.items() if value is not None}
    names = (*problem, *(() if assets is None else foreign or FOREIGN))
    if lacking := [] if retune else [name for name in names if name not in known]:
        raise ur.InputError(f"--no-retune: the record has no setting of the loop for {', '.join(lacking)}")
    found: dict[str, Any] = {"problems": {}}
    for name in names:
        opened = scenes.problem(name, assets, **options)
        error = error_of(opened)
        if retune:

            def end(setting: Setting, opened: ur.Problem = opened, error: Any = error) -> float:
                return loop(opened, error, seconds, TUNING_SEED, every, setting)[-1][1]

            setting, tried = tune(f"{name}: loop", grid(spp=spp, rate=rates, falling=(False, True)), end)
        else:
            setting, tried = known[name]["setting"], known[name]["tried"]
        theirs, mine, details = [], [], {}
        for seed in range(seeds):
            theirs.append(loop(opened, error, seconds, seed, every, setting))
            points, details = ours(opened, error, seconds, seed)
            mine.append(points)
            print(f"{name} seed {seed}: loop {theirs[-1][-1][1]:.4f}, auto {mine[-1][-1][1]:.4f}", flush=True)
        entry = compare(theirs, mine, seconds)
        entry |= {"setting": setting, "tried": tried, **details}
        if option:
            best, ways = tune_ours(opened, error, seconds, option, middle(theirs, seconds), option_seeds)
            runs = mine if not best else [ours(opened, error, seconds, seed, best)[0] for seed in range(seeds)]
            entry["tuned"] = {"option": best, "tried": ways, **_ours_of(compare(theirs, runs, seconds))}
        if without:
            entry["without"] = {}
        for part in without:
            changed = ablation.changes(opened, part)
            runs = [ours(opened, error, seconds, seed, part)[0] for seed in range(seeds)] if changed else mine
            entry["without"][part] = {"changed": changed, **_ours_of(compare(theirs, runs, seconds))}
            print(f"{name} without {part}: speed {entry['without'][part]['speed']}", flush=True)
        if applies(opened):
            hands = [fixed_point(opened, FIXED_POINT_SPP, seconds, seed, error) for seed in range(seeds)]
            entry["fixed_point"] = tenths(middle(hands, seconds))
        found["problems"][name] = entry
        print(f"{name}: speed {entry['speed']}", flush=True)
        del opened, error
        gc.collect()  # the loop would trace the virtual calls of earlier scenes as well
        dr.sync_thread()
        yield found


_MOST_REGRET = 1.15
"""Of the error at the end, that counts as chosen well."""


def _tuned(entry: Record) -> str:
    """How much faster with the option that `auto` was tuned to."""
    found = entry.get("tuned")
    if found is None:
        return ""
    speed = f"{found['speed']:.2g}" if found["speed"] else "below 1"
    return f"{speed} ({found['option'] or 'as it is'})"


def _regret(entry: Record) -> float:
    """The error of `auto` at the end over the least of its own and its options', of the seed that it was tuned with."""
    ends = {one["option"]: one["error"] for one in entry["tuned"]["tried"]}
    return ends[""] / min(ends.values())


def _of_tuning(entries: list[Record], seconds: float) -> str:
    """What options of `auto` bring, "" where none was tried: in time, over that of none at the loop's best error; and at the end."""
    tuned = [entry["tuned"] for entry in entries if "tuned" in entry]
    if not tuned:
        return ""
    ours = [entry for entry in entries if "tuned" in entry]
    speed = _mean([one["speed"] for one in tuned], ours, seconds)
    counts = sorted({len(one["tried"]) for one in tuned})
    settings = str(counts[0]) if len(counts) == 1 else f"{counts[0]} to {counts[-1]}"
    regrets = [_regret(entry) for entry in ours]
    within = sum(regret <= _MOST_REGRET for regret in regrets)
    return (
        f"\n\nWith `auto` tuned, too, over {settings} settings, its own included, {len(ours)} problems: **{speed:.2f}** times. "
        "Its error at the end over that of the setting that is best then, of one seed: "
        f"at most {_MOST_REGRET:g} on {within}, geometric mean {geometric_mean(regrets):.2f}."
    )


def _mean(speeds: list[float | None], problems: list[Record], seconds: float) -> float:
    """The geometric mean, where `auto` never gets there as if it did at the end."""
    return geometric_mean(
        speed or entry["seconds_of_loop"] / seconds for speed, entry in zip(speeds, problems, strict=True)
    )


def table(record: Record) -> str:
    """Error at the end, and the time to the tuned loop's best error."""
    settings, problems, rows = record["settings"], record["problems"], []
    for name, entry in problems.items():
        sides = {"loop", "auto", "fixed_point"} & entry.keys()
        ends = {side: f"{entry[side][4]:.3f}, {entry[side][-1]:.3f}" for side in sides}
        speed, first = "below 1", "never"
        if entry["speed"] is not None:
            speed, first = f"**{entry['speed']:.2g}**", f"{entry['seconds_of_auto']:.2g} s"
        rows.append([name, setting_text(entry["setting"]), ends["loop"], ends["auto"], ends.get("fixed_point", "")])
        rows[-1] += [f"{entry['seconds_of_loop']:.2g} s", first, speed, _tuned(entry)]
        rows[-1].append(f"{entry['compile_seconds']:.1f} s")
    head = (
        "problem | the loop's best setting | loop, half and end | auto, half and end | fixed point | loop at its best"
    )
    entries = list(problems.values())
    mean = _mean([entry["speed"] for entry in entries], entries, settings["seconds"])
    seeds = sorted({len(entry["final"]["auto"]) for entry in entries})
    tuned = len(settings["spp"]) * len(settings["rates"]) * 2
    return markdown.blocks(
        f"{settings['seconds']:g} s, {' or '.join(map(str, seeds))} seeds, medians; errors where seen, relative to the "
        f"start. The loop is the best of {tuned} settings, the column `auto` has none set.",
        markdown.table(f"{head} | auto there | faster | tuned | compile", rows),
        f"Geometric mean over the {len(problems)} problems: **{mean:.2f}** times as fast, where `auto` never gets "
        f"there as if it did at the end. Lower final error on {sum(e['auto'][-1] < e['loop'][-1] for e in entries)}."
        + _of_tuning(entries, settings["seconds"]),
        *filter(None, [ablation.table(entries, lambda speeds: _mean(speeds, entries, settings["seconds"]))]),
    )


def setting_text(setting: Mapping[str, Any]) -> str:
    """Return a setting of the loop in words."""
    return f"{setting['spp']} spp, {setting['rate']:g}{', falling' if setting['falling'] else ''}"


def plot(record: Record) -> figures.Figure:
    seconds = record["settings"]["seconds"] * np.arange(11) / 10
    sides = {"loop": "stock loop, tuned", "auto": "auto, no option", "fixed_point": "reference / rendering"}
    panels = {
        name: {label: [(seconds, [1.0, *entry[side]])] for side, label in sides.items() if side in entry}
        for name, entry in record["problems"].items()
    }
    return figures.curves(panels, "seconds", columns=6, panel=(2.4, 2.0))
