"""Mitsuba's texture loop as its tutorials write it, in Dr.Jit and in PyTorch, and each with three lines changed."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.internals import dr, mi

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
        error: of a texture, against the truth.
        max_depth: of paths.
    """

    scene: Callable[[], dict[str, Any]]
    key: str
    start: np.ndarray
    reference: np.ndarray
    error: Callable[[Any], float]
    max_depth: int


def _now() -> float:
    return time.process_time() / dr.thread_count()


class Clock:
    """Seconds of the steps of a loop, and the error at some of them, which is not counted.

    Seconds of processor time of this process, over the number of its threads: what others do on the machine does not count.

    Args:
        seconds: of the loop.
        error: of a texture.
        warm: first steps that are not counted.
    """

    def __init__(self, seconds: float, error: Callable[[Any], float], warm: int = 3):
        self.history: list[tuple[float, float]] = []
        self._seconds, self._error, self._warm = seconds, error, warm
        self._spent, self._began, self._next, self.steps = 0.0, _now(), 0.0, -warm

    def goes_on(self, texture: Any) -> bool:
        """At the end of each step: whether there is another."""
        dr.sync_thread()
        self.steps += 1
        if self.steps > 0:
            self._spent += _now() - self._began
        over = self._spent >= self._seconds
        if self.steps > 0 and (over or self._spent >= self._next):
            self.history.append((self._spent, self._error(texture)))
            self._next = self._spent + self._seconds / 40
        self._began = _now()
        return not over


def drjit_stock(task: Task, spp: int, rate: float, loss: Loss, seed: int, clock: Clock) -> None:
    """`mi.render`, `dr.backward`, `mi.ad.Adam`."""
    scene = mi.load_dict({**task.scene(), "integrator": {"type": "prb", "max_depth": task.max_depth}})
    params, reference = mi.traverse(scene), mi.TensorXf(task.reference)
    optimizer = mi.ad.Adam(lr=rate)
    optimizer[task.key] = mi.TensorXf(task.start)
    params.update(optimizer)
    step = 0
    while True:
        image = mi.render(scene, params, spp=spp, seed=seed * 1_000_003 + step)
        value = dr.mean(dr.abs(image - reference) if loss == "l1" else dr.square(image - reference))
        dr.backward(value)
        optimizer.step()
        optimizer[task.key] = dr.clip(optimizer[task.key], 0, 1)
        params.update(optimizer)
        step += 1
        if not clock.goes_on(optimizer[task.key]):
            return


def drjit_ours(task: Task, spp: int, rate: float, loss: Loss, seed: int, clock: Clock, **options: Any) -> None:
    """The same: the scene's line, the render's, and no `params.update`."""
    renderer = ur.Renderer(task.scene, [task.key], spp=spp, max_depth=task.max_depth, seed=seed, **options)
    reference = mi.TensorXf(task.reference)
    optimizer = mi.ad.Adam(lr=rate)
    optimizer[task.key] = mi.TensorXf(task.start)
    while True:
        image = renderer(optimizer)
        value = dr.mean(dr.abs(image - reference) if loss == "l1" else dr.square(image - reference))
        dr.backward(value)
        optimizer.step()
        optimizer[task.key] = dr.clip(optimizer[task.key], 0, 1)
        if not clock.goes_on(optimizer[task.key]):
            return


def torch_stock(task: Task, spp: int, rate: float, loss: Loss, seed: int, clock: Clock) -> None:
    """`dr.wrap` around `mi.render`, PyTorch's Adam."""
    import torch  # pyright: ignore[reportMissingImports]

    scene = mi.load_dict({**task.scene(), "integrator": {"type": "prb", "max_depth": task.max_depth}})
    params, reference = mi.traverse(scene), torch.from_numpy(task.reference)

    @dr.wrap(source="torch", target="drjit")
    def render(texture: Any, seed: int = 0) -> Any:
        params[task.key] = texture
        params.update()
        return mi.render(scene, params, spp=spp, seed=seed, seed_grad=seed + 1)

    texture = torch.from_numpy(task.start.copy()).requires_grad_()
    optimizer = torch.optim.Adam([texture], lr=rate)
    step = 0
    while True:
        optimizer.zero_grad()
        image = render(texture, seed=seed * 1_000_003 + 2 * step)
        difference = image - reference
        (difference.abs() if loss == "l1" else difference**2).mean().backward()
        optimizer.step()
        with torch.no_grad():
            texture.clamp_(0, 1)
        step += 1
        if not clock.goes_on(texture):
            return


def torch_ours(task: Task, spp: int, rate: float, loss: Loss, seed: int, clock: Clock, **options: Any) -> None:
    """The same: `renderer(texture)` in place of the wrapped function."""
    import torch  # pyright: ignore[reportMissingImports]

    renderer = ur.Renderer(task.scene, [task.key], spp=spp, max_depth=task.max_depth, seed=seed, **options)
    reference = torch.from_numpy(task.reference)
    texture = torch.from_numpy(task.start.copy()).requires_grad_()
    optimizer = torch.optim.Adam([texture], lr=rate)
    while True:
        optimizer.zero_grad()
        difference = renderer(texture) - reference
        (difference.abs() if loss == "l1" else difference**2).mean().backward()
        optimizer.step()
        with torch.no_grad():
            texture.clamp_(0, 1)
        if not clock.goes_on(texture):
            return
