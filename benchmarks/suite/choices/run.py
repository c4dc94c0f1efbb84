"""What `auto` chooses, against the same method with one choice made otherwise.

On each problem `auto` runs with no option given and with each of `CHOICES` set, at equal time. The regret is its error at the end over
that of the choice that turned out to be best; `smooth=false` tells what smoothing over neighbouring texels brings, also on a checkerboard
of one-texel squares, where there is nothing to smooth. What `auto` chooses by itself is not run again. Errors are of the elements that the
views see, as in `suite`.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.internals import dr, method
from benchmarks.suite.run import FOREIGN, Curve, error_of
from benchmarks.suite.scenes import problem as foreign_problem
from unrender.gallery.wall import Wall

GALLERY = ("wall", "checkerboard", "indirect-room", "sunlit-vase", "lamp", "sun-glossy")
CHOICES = (
    "image=plain", "image=rcv", "smooth=false", "spp=2", "spp=16", "learning_rate=0.03", "learning_rate=0.3", "tolerance=0",
)  # fmt: skip
"""Options of `auto`."""
QUICK = {
    "problem": ("checkerboard",),
    "choice": ("smooth=false",),
    "seconds": 0.3,
    "seeds": 1,
    "gallery_reference_spp": 16,
}
_BOARD = (0.1, 0.4)


def checkerboard(reference_spp: int = 8192) -> ur.Problem:
    """The room of `wall`, its photograph a checkerboard of one-texel squares, darker on average than the grey it begins at."""
    wall = Wall()
    side, key = wall.texture_resolution, wall.parameters()[0].key
    odd = (np.indices((side, side)).sum(axis=0) % 2)[..., None]
    truth = np.broadcast_to(np.where(odd == 1, _BOARD[1], _BOARD[0]), (side, side, 3)).astype(np.float32)
    black = ur.View(np.zeros((wall.resolution, wall.resolution, 3), np.float32))
    blank = ur.Problem(
        wall.scene(), wall.parameters(), [black], wall.loss, wall.max_depth, truth={key: truth}, name="checkerboard"
    )
    parts = max(1, reference_spp // 512)
    images = [ur.render(blank, {key: truth}, 0, reference_spp // parts, seed) for seed in range(parts)]
    return blank.replaced(views=[ur.View(np.mean(images, axis=0))])


def _end(problem: ur.Problem, chosen: Any, error: Any, seconds: float, seed: int) -> float:
    """The error at the end of a run."""
    curve = Curve(error, seconds)
    ur.optimize(problem, chosen.estimator, chosen.optimizer, seconds=seconds, seed=seed, callbacks=[curve])
    return curve.points[-1][1]


def run(
    problem: tuple[str, ...] = GALLERY,
    foreign: tuple[str, ...] = FOREIGN,
    assets: Path | None = None,
    choice: tuple[str, ...] = CHOICES,
    seconds: float = 4.0,
    seeds: int = 2,
    resolution: int = 64,
    texture: int = 64,
    reference_spp: int = 2048,
    gallery_reference_spp: int | None = None,
) -> Iterator[dict[str, Any]]:
    """Every problem, every choice.

    Args:
        problem: of the gallery, and "checkerboard"
        foreign: of others, where assets are given
        assets: folder of the scenes of others
        choice: of `auto`'s options
        seconds: budget of a run
        seeds: runs of each
        resolution: of pictures of the scenes of others
        texture: side of their textures
        reference_spp: of their references
        gallery_reference_spp: of the gallery's references, none for its own
    """
    options = {} if gallery_reference_spp is None else {"reference_spp": gallery_reference_spp}
    found: dict[str, Any] = {"problems": {}}
    for name in (*problem, *(foreign if assets is not None else ())):
        if name in FOREIGN and assets is not None:
            opened = foreign_problem(name, assets, resolution, texture, reference_spp)
        else:
            opened = checkerboard(**options) if name == "checkerboard" else ur.gallery.problem(name, **options)
        error = error_of(opened)
        own = method("auto").choose(opened)
        ends = {}
        for label in ("auto", *choice):
            chosen = own if label == "auto" else method("auto").choose(opened, dict([label.split("=")]))
            if label != "auto" and (chosen.estimator, chosen.optimizer) == (own.estimator, own.optimizer):
                continue  # as auto chooses by itself
            ends[label] = [_end(opened, chosen, error, seconds, seed) for seed in range(seeds)]
            print(f"{name}, {label}: {', '.join(f'{end:.4f}' for end in ends[label])}", flush=True)
        found["problems"][name] = ends
        del opened, error
        dr.sync_thread()
        yield found
