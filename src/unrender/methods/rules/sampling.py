"""Rules for how a step renders: pixels, samples per pixel, and the image that the loss sees."""

from __future__ import annotations

from typing import Literal

from unrender import pixels
from unrender.core.errors import InputError
from unrender.images.base import ImageEstimator
from unrender.images.plain import Plain
from unrender.images.recursive_control_variate import RecursiveControlVariate
from unrender.methods.rules.traits import Traits
from unrender.pixels.base import PixelSampler
from unrender.scene.problem import Problem


def sampler(traits: Traits) -> tuple[PixelSampler, str]:
    """Return the pixels of a step, and why they are not all."""
    constants, problem = traits.constants, traits.problem
    if traits.options.pixels is not None:
        return pixels.Uniform(traits.options.pixels), ""
    count, views = problem.pixels, len(problem.views)
    few = count <= constants.most_pixels
    if traits.meshes and problem.loss.pixelwise and views >= constants.many_views and few:
        taken = min(-(-views // 2), constants.most_views)
        return pixels.Views(taken), f"{taken} of {views} views a step: moving borders cost each view alike"
    if few or not problem.loss.pixelwise:
        return pixels.All(), ""
    return pixels.Uniform(constants.drawn), f"{constants.drawn} of all {count} pixels a step"


def samples_per_pixel(traits: Traits, sampler: PixelSampler) -> int:
    """Return the power of two that comes nearest to the path budget from below."""
    constants = traits.constants
    draws = isinstance(sampler, pixels.Uniform)
    count, paths = (sampler.count, constants.drawn_paths) if draws else (traits.problem.pixels, constants.paths)
    power = 1 << ((paths // count).bit_length() - 1 if count <= paths else 0)
    return traits.options.spp or within(constants.spp, power)


def image(traits: Traits, sampler: PixelSampler) -> tuple[ImageEstimator, str]:
    """Return the image that the loss sees, and why."""
    asked, linear = traits.options.image, traits.problem.loss.linear
    if asked == "plain":
        return Plain(), "as asked for"
    if asked is None and traits.meshes and linear:
        return Plain(), "a mesh moves, and the loss is unbiased without a memory"
    if asked is None and not renders_half(traits.problem, sampler):
        return Plain(), "control variates need whole views, half of them a step"
    space, obstacle = _shared_space(traits.problem)
    if obstacle and asked is None:
        return Plain(), f"no control variates: {obstacle}"
    most = traits.constants.linear_memory if linear else traits.constants.memory
    reason = "as asked for" if asked else "earlier samples are used again"
    return RecursiveControlVariate(space, max_weight=most), reason


def renders_half(problem: Problem, sampler: PixelSampler) -> bool:
    """Return whether a step renders at least half of the views. A memory of a view that is seldom rendered shows another mesh."""
    half = isinstance(sampler, pixels.Views) and 2 * sampler.count >= len(problem.views)
    return half or isinstance(sampler, pixels.All)


def within(limits: tuple[int, int], value: int) -> int:
    """Return the value, moved into the limits."""
    return min(max(value, limits[0]), limits[1])


def _shared_space(problem: Problem) -> tuple[Literal["path", "primary"], str]:
    """Return where two states of the unknowns share samples, and why nowhere; "" where they do."""
    obstacle = ""
    for space in ("path", "primary"):
        try:
            problem.renderer.prepare(list(problem.shapes()), space)
        except InputError as error:
            obstacle = str(error)
        else:
            return space, ""
    return "primary", obstacle
