"""Mitsuba's texture loop as its tutorials write it, in Dr.Jit and in PyTorch, and each with three lines changed."""

from __future__ import annotations

import itertools
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
