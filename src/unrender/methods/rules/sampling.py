"""Rules for the rendering of a step: pixels, samples per pixel, and the image estimator."""

from __future__ import annotations

from typing import Literal

from unrender import pixels
from unrender.core.errors import InputError
from unrender.images.base import ImageEstimator, Plain
from unrender.images.recursive_control_variate import RecursiveControlVariate
from unrender.methods.rules.traits import Traits
from unrender.pixels.base import PixelSampler
from unrender.scene.problem import Problem


def sampler(traits: Traits) -> tuple[PixelSampler, str]:
    """Return the pixel sampler, and the reason if it does not take all pixels."""
    constants, problem = traits.constants, traits.problem
    if traits.options.pixels is not None:
        return pixels.Uniform(traits.options.pixels), ""
    count, views = problem.pixels, len(problem.views)
    few = count <= constants.most_pixels
    if traits.meshes and problem.loss.pixelwise and views >= constants.many_views and few:
        batch = min(-(-views // 2), constants.most_views)
        return pixels.Views(batch), f"{batch} of {views} views a step: each view's boundary gradients cost the same"
    if few or not problem.loss.pixelwise:
        return pixels.All(), ""
    return pixels.Uniform(constants.batch_pixels), f"{constants.batch_pixels} of all {count} pixels a step"


def samples_per_pixel(traits: Traits, sampler: PixelSampler) -> int:
    """Return the option `spp`, or else the largest power of two within the path budget, clamped to the limits."""
    constants = traits.constants
    draws = isinstance(sampler, pixels.Uniform)
    count, paths = (sampler.count, constants.batch_paths) if draws else (traits.problem.pixels, constants.paths)
    power = 1 << ((paths // count).bit_length() - 1 if count <= paths else 0)
    return traits.options.spp or within(constants.spp, power)


def image(traits: Traits, sampler: PixelSampler) -> tuple[ImageEstimator, str]:
    """Return the image estimator, and the reason."""
    requested, linear = traits.options.image, traits.problem.loss.linear
    if requested == "plain":
        return Plain(), "as asked for"
    if requested is None and traits.meshes and linear:
        return Plain(), "a mesh moves, and the loss is unbiased without a control variate"
    if requested is None and not renders_half(traits.problem, sampler):
        return Plain(), "control variates need full views, half of them a step"
    space, obstacle = _shared_space(traits.problem)
    if obstacle and requested is None:
        return Plain(), f"no control variates: {obstacle}"
    most = traits.constants.linear_memory if linear else traits.constants.memory
    reason = "as asked for" if requested else "earlier samples are used again"
    return RecursiveControlVariate(space, max_weight=most), reason


def renders_half(problem: Problem, sampler: PixelSampler) -> bool:
    """Return whether a step renders at least half of the views. The control variate of a rarely rendered view shows an outdated mesh."""
    half = isinstance(sampler, pixels.Views) and 2 * sampler.count >= len(problem.views)
    return half or isinstance(sampler, pixels.All)


def within(limits: tuple[int, int], value: int) -> int:
    """Clamp a value to the limits."""
    return min(max(value, limits[0]), limits[1])


def _shared_space(problem: Problem) -> tuple[Literal["path", "primary"], str]:
    """Return the space in which two states of the unknowns can share samples, and the obstacle, "" if there is none."""
    obstacle = ""
    for space in ("path", "primary"):
        try:
            problem.renderer.prepare(list(problem.shapes()), space)
        except InputError as error:
            obstacle = str(error)
        else:
            return space, ""
    return "primary", obstacle
