"""From a recipe, which describes a scene and what to forget of it, to a problem with references and truth."""

from __future__ import annotations

from typing import Any, Protocol

import mitsuba as mi
import numpy as np

from unrender.backend.variant import ensure
from unrender.core.random import Key
from unrender.losses import Loss
from unrender.problem.parameter import Parameter
from unrender.problem.problem import Problem
from unrender.problem.view import View
from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.mitsuba.scene_loading import media

_LANES = 1 << 21
"""Paths per pass of a reference: what fits a small machine's memory."""

_REFERENCE = Key(seed=0x9A11E47)
"""Where the references' random numbers come from: no run that counts its seeds from 0 shares them."""


class Specification(Protocol):
    """A gallery problem: a frozen dataclass whose fields are its options (see `fields.py`)."""

    @property
    def resolution(self) -> int:
        """Pixels along a side of each view."""
        ...

    @property
    def reference_spp(self) -> int:
        """Samples per pixel of the references."""
        ...

    @property
    def max_depth(self) -> int:
        """Longest light path in segments."""
        ...

    @property
    def loss(self) -> Loss:
        """Between picture and reference."""
        ...

    def scene(self) -> dict[str, Any]:
        """The true scene as a Mitsuba dictionary, made anew at each call. Called once a variant is set."""
        ...

    def parameters(self) -> tuple[Parameter, ...]:
        """What is to be recovered, and from where."""
        ...


def build_problem(name: str, specification: Specification) -> Problem:
    """The problem: truth read off the scene, one view per sensor, references by Mitsuba's own integrators.

    Args:
        name: the problem's.
        recipe: with its options.
    """
    ensure()
    renderer = MitsubaRenderer(specification.scene, specification.max_depth)
    parameters = specification.parameters()
    truth = {key: value.numpy() for key, value in renderer.values([p.key for p in parameters]).items()}
    scene = renderer.pair.current
    views = [
        View(reference(scene, sensor, specification.reference_spp, specification.max_depth), sensor)
        for sensor in range(len(scene.sensors()))
    ]
    return Problem(renderer, parameters, views, specification.loss, specification.max_depth, truth=truth, name=name)


def reference(scene: Any, sensor: int, spp: int, max_depth: int) -> np.ndarray:
    """A picture by Mitsuba's `path` integrator, or `volpath` where there are media: (H, W, 3) float32. Unbiased.

    Takes as many passes as memory asks for. Equal arguments give equal pictures.
    """
    integrator = mi.load_dict({"type": "volpath" if media(scene) else "path", "max_depth": max_depth})
    width, height = scene.sensors()[sensor].film().crop_size()
    per_pass = max(1, _LANES // int(width * height))
    total, done = np.zeros((int(height), int(width), 3)), 0
    while done < spp:
        take = min(per_pass, spp - done)
        seed = _REFERENCE.fold(sensor).fold(done).uint32()
        total += take * mi.render(scene, sensor=sensor, integrator=integrator, spp=take, seed=mi.UInt32(seed)).numpy()
        done += take
    return (total / spp).astype(np.float32)
