"""A loop of one's own: Mitsuba's texture loop with three lines changed, against itself unchanged, at equal time.

`indirect-room`, whose back wall is a texture, by `mi.render`, `dr.backward` and `mi.ad.Adam`, and in PyTorch by `dr.wrap` and
`torch.optim.Adam`; changed, the image comes from `unrender.Renderer` with a control variate and two sample groups. Samples per pixel and
learning rate of each are tuned in Dr.Jit, on a seed of their own, and taken over in PyTorch.
"""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import itertools
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

import unrender as ur
from benchmarks import figures, markdown
from benchmarks.internals import dr, mi, scene_description
from benchmarks.peers.drivers.recorder import BudgetSpentError, Recorder
from benchmarks.races import TUNING_SEED, Setting, grid, median_and_range, tune
from benchmarks.runner.records import Record

QUICK = {
    "loss": ("l2",), "seconds": 0.5, "tuning_seconds": 0.2, "seeds": 1, "resolution": 16, "texture_resolution": 8,
    "reference_spp": 16, "spp": (4,), "rates": (0.02,),
}  # fmt: skip
KEY = "back.bsdf.reflectance.data"
_WARM = 3
"""First steps that do not count."""
Loss = str
"""Of the mean: "l1" or "l2"."""


@dataclass(frozen=True)
class Task:
    """A texture to recover, on a scene of stock Mitsuba.

    Attributes:
        scene: makes the dictionary.
        key: of the texture.
        start: (H, W, 3).
        reference: (H, W, 3).
        max_depth: of paths.
    """

    scene: Callable[[], dict[str, Any]]
    key: str
    start: np.ndarray
    reference: np.ndarray
    max_depth: int


Step = Callable[[Any], None]
"""Takes the texture after each step, and ends the loop by an exception."""


def drjit(task: Task, spp: int, rate: float, loss: Loss, seed: int, done: Step, changed: bool) -> None:
    """`mi.render`, `dr.backward`, `mi.ad.Adam`; changed: the scene's line, the render's, and no `params.update`."""
    reference, optimizer = mi.TensorXf(task.reference), mi.ad.Adam(lr=rate)
    optimizer[task.key] = mi.TensorXf(task.start)
    render = _ours(task, spp, seed) if changed else _stock(task, spp, seed)
    while True:
        difference = render(optimizer) - reference
        dr.backward(dr.mean(dr.abs(difference) if loss == "l1" else dr.square(difference)))
        optimizer.step()
        optimizer[task.key] = dr.clip(optimizer[task.key], 0, 1)
        done(dr.detach(optimizer[task.key]))


def torch(task: Task, spp: int, rate: float, loss: Loss, seed: int, done: Step, changed: bool) -> None:
    """`dr.wrap` around `mi.render`, PyTorch's Adam; changed: `renderer(texture)` in place of the wrapped function."""
    import torch  # pyright: ignore[reportMissingImports]

    reference = torch.from_numpy(task.reference)
    texture = torch.from_numpy(task.start.copy()).requires_grad_()
    optimizer = torch.optim.Adam([texture], lr=rate)
    render = _ours(task, spp, seed) if changed else _wrapped(task, spp, seed)
    while True:
        optimizer.zero_grad()
        difference = render(texture) - reference
        (difference.abs() if loss == "l1" else difference**2).mean().backward()
        optimizer.step()
        with torch.no_grad():
            texture.clamp_(0, 1)
        done(texture.detach())


def _ours(task: Task, spp: int, seed: int) -> ur.Renderer:
    image = ur.images.RecursiveControlVariate()
    return ur.Renderer(task.scene, [task.key], spp=spp, max_depth=task.max_depth, seed=seed, image=image, groups=2)


def _loaded(task: Task) -> tuple[Any, Any]:
    scene = mi.load_dict({**task.scene(), "integrator": {"type": "prb", "max_depth": task.max_depth}})
    return scene, mi.traverse(scene)


def _stock(task: Task, spp: int, seed: int) -> Callable[[Any], Any]:
    scene, params = _loaded(task)
    numbers = itertools.count(seed * 1_000_003)

    def render(optimizer: Any) -> Any:
        params.update(optimizer)
        return mi.render(scene, params, spp=spp, seed=next(numbers))

    return render


def _wrapped(task: Task, spp: int, seed: int) -> Callable[[Any], Any]:
    scene, params = _loaded(task)
    numbers = itertools.count(seed * 1_000_003, 2)

    @dr.wrap(source="torch", target="drjit")
    def render(texture: Any, number: int) -> Any:
        params[task.key] = texture
        params.update()
        return mi.render(scene, params, spp=spp, seed=number, seed_grad=number + 1)

    return lambda texture: render(texture, next(numbers))


def task_of(problem: ur.Problem) -> Task:
    """The problem as people have it: a dictionary, a start, a reference."""
    start = np.array(problem.initial()[KEY]).astype(np.float32)
    reference = np.array(problem.views[0].reference, np.float32)
    return Task(lambda: scene_description(problem), KEY, start, reference, problem.max_depth)


def now() -> float:
    """Seconds of processor time of this process over the number of its threads: what others do on the machine does not count."""
    dr.sync_thread()
    return time.process_time() / dr.thread_count()


def follow(
    problem: ur.Problem, loop: Callable[..., None], setting: Setting, loss: str, seconds: float, seed: int
) -> tuple[list[tuple[float, float]], int]:
    """(seconds, error) along a run of a loop, and its number of steps, both without the first ones."""
    recorder = Recorder(seconds, 40, timer=now, warm=_WARM)
    with contextlib.suppress(BudgetSpentError):
        done = lambda texture: recorder.step(lambda: {KEY: np.array(texture)})  # noqa: E731
        loop(task_of(problem), setting["spp"], setting["rate"], loss, seed, done)
    history = [(at, problem.parameter_error(values)[KEY]) for at, _, values in recorder.kept if at > 0]
    return history, recorder.steps - _WARM


def contenders() -> dict[str, Callable[..., None]]:
    """Return the loops by name; those of PyTorch where that is installed."""
    every = {"drjit": drjit}
    if importlib.util.find_spec("torch") is not None:
        every["torch"] = torch
    return {
        name + suffix: functools.partial(loop, changed=bool(suffix))
        for name, loop in every.items()
        for suffix in ("", ", changed")
    }


def run(
    loss: tuple[str, ...] = ("l2", "l1"),
    seconds: float = 6.0,
    tuning_seconds: float = 2.0,
    seeds: int = 3,
    resolution: int = 64,
    texture_resolution: int = 32,
    reference_spp: int = 4096,
    spp: tuple[int, ...] = (2, 4, 16),
    rates: tuple[float, ...] = (0.02, 0.05),
) -> Iterator[dict[str, Any]]:
    """All parts.

    Args:
        loss: the loop's
        seconds: of a run: processor time over the number of threads
        tuning_seconds: of a run on the tuning seed
    """
    sizes = {"resolution": resolution, "texture_resolution": texture_resolution, "reference_spp": reference_spp}
    problem = ur.gallery.problem("indirect-room", **sizes)
    found: dict[str, Any] = {"start": problem.parameter_error(problem.initial())[KEY], "losses": {}}
    every = contenders()
    for kind in loss:
        tuned = {}
        for name in ("drjit", "drjit, changed"):

            def end(setting: Setting, loop: Callable[..., None] = every[name], kind: str = kind) -> float:
                return follow(problem, loop, setting, kind, tuning_seconds, TUNING_SEED)[0][-1][1]

            tuned[name], _ = tune(f"{kind} {name}", grid(spp=spp, rate=rates), end)
        entries: dict[str, Any] = {name: {**tuned[name.replace("torch", "drjit")], "runs": []} for name in every}
        for seed in range(seeds):
            for name, loop in every.items():
                history, entries[name]["steps"] = follow(problem, loop, entries[name], kind, seconds, seed)
                entries[name]["runs"].append(history)
                print(f"{kind} {name} seed {seed}: {history[-1][1]:.4f} in {entries[name]['steps']} steps", flush=True)
        for entry in entries.values():
            entry["final"] = median_and_range([history[-1][1] for history in entry["runs"]])
        found["losses"][kind] = entries
        yield found


def table(record: Record) -> str:
    rows = []
    for entry in markdown.named(record["losses"], "loss", "", "name"):
        name, (middle, low, high) = entry["name"], entry["final"]
        unchanged = record["losses"][entry["loss"]][name.removesuffix(", changed")]["final"][0]
        ratio = f"**{middle / unchanged:.2f}**" if name.endswith("changed") else "1"
        row = markdown.fill("{name} | {spp} | {rate:g} | {steps}", entry)
        rows.append([entry["loss"].upper(), row, f"{middle:.4f} ({low:.4f} to {high:.4f})", ratio])
    text = "`indirect-room`, {resolution}², texture {texture_resolution}², {seconds:g} s, {seeds} seeds; error of the texture (RMSE; "
    text += "{start:.3f} at the start), median and range."
    return markdown.blocks(
        markdown.fill(text, record, record["settings"]),
        markdown.table("loss | loop | spp | rate | steps | error | of the unchanged", rows),
    )


def plot(record: Record) -> figures.Figure:
    """Error over seconds, a panel for each loss."""
    panels = {
        f"{loss.upper()} loss": {
            f"{name}, {entry['spp']} spp": figures.from_start(entry["runs"], record["start"])
            for name, entry in entries.items()
        }
        for loss, entries in record["losses"].items()
    }
    return figures.curves(panels, "seconds", "RMSE of the texture", log="")
