"""Checked options of a `Renderer`, and the problems that represent its sensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from unrender.core import checks
from unrender.core.checks import Count, Seed
from unrender.core.errors import InputError
from unrender.core.text import in_words
from unrender.estimators.sample_groups import check_pixels
from unrender.images.base import ImageEstimator
from unrender.pixels.adaptive_counts import AdaptiveCounts
from unrender.pixels.base import PixelSampler
from unrender.pixels.uniform import All, Uniform
from unrender.rendering.picture_format import format_of
from unrender.rendering.renderer import Renderer as RendererPort
from unrender.scene.parameter import Parameter
from unrender.scene.problem import Problem
from unrender.scene.references import View
from unrender.scene.validation import open_renderer


@dataclass(frozen=True)
class Options:
    """Options of a `Renderer`, named as its arguments. Raises `InputError` for invalid or incompatible options.

    Attributes:
        single: whether a single sensor was passed, so that a call returns its image and not a tuple.
        max_depth: maximum path length in segments, also if it is that of the scene's integrator.
        references, loss: targets and loss of guided mini-batches; () and None without.
    """

    keys: tuple[str, ...]
    image: ImageEstimator
    pixels: PixelSampler
    spp: Count
    adjoint_spp: Count | None
    groups: Count
    coupled: bool
    sensors: tuple[int, ...]
    single: bool
    max_depth: int
    seed: Seed
    references: tuple[Any, ...] = field(default=(), compare=False)
    loss: Any = field(default=None, compare=False)

    def __post_init__(self):
        owner = "Renderer"
        checks.fields(self, owner)
        check_pixels(owner, self.pixels, self.image, self.spp)
        if isinstance(self.pixels, AdaptiveCounts):
            raise InputError(
                f"{owner}: AdaptiveCounts needs the loss derivative of each sample, which only optimize() knows; "
                "use pixels=unrender.pixels.All()"
            )
        if self.spp % self.groups:
            raise InputError(f"{owner}: groups must divide spp, {self.spp}, got {self.groups}")
        if self.groups > 1 and self.adjoint_spp is not None:
            raise InputError(
                f"{owner}: adjoint_spp needs groups=1; with more groups the adjoint uses the image's paths"
            )
        if self.coupled and self.groups > 1:
            raise InputError(f"{owner}: coupled=True needs groups=1, because its adjoint uses separate paths")
        if self.coupled and not self.all_pixels:
            raise InputError(
                f"{owner}: coupled=True needs the loss derivative of the last step at every pixel; use pixels=unrender.pixels.All()"
            )
        if not self.all_pixels and not isinstance(self.pixels, Uniform) and not self.references:
            raise InputError(
                f"{owner}: {type(self.pixels).__name__} samples pixels by their loss derivative; set references=, the target image of "
                "each sensor, or use unrender.pixels.Uniform"
            )

    @property
    def all_pixels(self) -> bool:
        """Return whether every step renders full images."""
        return isinstance(self.pixels, All)

    def describe(self) -> dict[str, Any]:
        """Return the options that a saved state must match, in types of JSON."""
        return {
            "keys": list(self.keys),
            "image": repr(self.image),
            "pixels": repr(self.pixels),
            "spp": self.spp,
            "adjoint_spp": self.adjoint_spp,
            "groups": self.groups,
            "coupled": self.coupled,
            "sensors": list(self.sensors),
            "max_depth": self.max_depth,
        }


def open_scene(scene: Any, keys: Any, max_depth: int | None) -> tuple[RendererPort, tuple[str, ...]]:
    """Return the renderer port of a scene, and the keys as a tuple. Raises `InputError` if either is invalid."""
    names = (keys,) if isinstance(keys, str) else keys
    if isinstance(names, (bytes, dict)) or not isinstance(names, Sequence) or not names:
        raise InputError(f"Renderer: keys must be a list of scene parameters, got {in_words(keys)}")
    if max_depth is not None:
        checks.integer("Renderer", "max_depth", max_depth, at_least=1)
    keys = [name for name in names if isinstance(name, str)]
    return open_renderer(scene, max_depth, keys), tuple(names)


def problem_of(renderer: RendererPort, options: Options, sensors: tuple[int, ...], scene: Any) -> Problem:
    """Return a problem of these sensors, those without a reference with a black one. Raises `InputError` for an unknown sensor."""
    sizes = renderer.resolutions()
    references = dict(zip(options.sensors, options.references, strict=True)) if options.references else {}
    for sensor in sensors:
        if not 0 <= sensor < len(sizes):
            have = f"0 to {len(sizes) - 1}" if len(sizes) > 1 else "0, the only one"
            raise InputError(f"Renderer: sensor must be {have}, got {in_words(sensor)}")

    def channels(sensor: int) -> int:
        return 1 if format_of(renderer, sensor).colour == "luminance" else 3

    views = [
        View(
            references[sensor] if sensor in references else np.zeros((*sizes[sensor], channels(sensor)), np.float32),
            sensor,
        )
        for sensor in sensors
    ]
    name = Path(scene).stem if isinstance(scene, (str, Path)) else "scene"
    parameters = [Parameter(key) for key in options.keys]
    return Problem(renderer, parameters, views, options.loss, options.max_depth, name=name)
