"""Traits of a problem on which the rules of `auto` depend."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Literal

from unrender import pixels
from unrender.core.errors import InputError
from unrender.images.base import ImageEstimator, Plain
from unrender.images.recursive_control_variate import RecursiveControlVariate
from unrender.methods.rules.constants import Constants
from unrender.pixels.base import PixelSampler
from unrender.rendering.renderer import ParameterInfo
from unrender.scene.problem import Problem

if TYPE_CHECKING:
    from unrender.methods.auto import AutoMethod


@dataclass(frozen=True)
class Traits:
    """Properties of a problem on which the rules of `auto` depend.

    Attributes:
        problem: Problem to recover.
        options: Options of the user.
        constants: Constants of the rules.
        rates: First learning rates that are already decided, in units of the unknowns.
        block: Keys of unknowns with a separate optimizer in addition to path gradients.
        notes: Lines that rules add to the reasons of the plan, whichever rule decides.
    """

    problem: Problem
    options: AutoMethod
    constants: Constants
    rates: Mapping[str, float] = field(default_factory=dict)
    block: tuple[str, ...] = ()
    notes: list[str] = field(default_factory=list, compare=False)

    @cached_property
    def infos(self) -> dict[str, ParameterInfo]:
        """The renderer's description of each unknown."""
        known = self.problem.renderer.parameters()
        return {key: known[key] for key in self.problem.shapes()}

    @cached_property
    def elements(self) -> int:
        """Number of elements of all unknowns."""
        return sum(math.prod(shape) for shape in self.problem.shapes().values())

    @property
    def meshes(self) -> tuple[str, ...]:
        """Keys of vertex positions."""
        return tuple(self.problem.faces)

    @property
    def poses(self) -> list[str]:
        """Keys of rigid motions of shapes, lights or sensors."""
        return [key for key, info in self.infos.items() if info.rigid]

    @property
    def lights(self) -> list[str]:
        """Keys of radiances and other values in which images are linear, without those that are optimised in other coordinates."""
        known = self.problem.unknowns
        return [k for k, info in self.infos.items() if info.brightness == "light" and known[k].transform is None]

    @property
    def only_cameras(self) -> bool:
        """Return whether all unknowns are poses of sensors. Lens parameters have other units."""
        return all(info.viewpoint and info.rigid for info in self.infos.values())

    @property
    def cameras_and_lenses(self) -> bool:
        """Return whether all unknowns are poses of sensors and other numbers that change the form of the picture, such as lenses."""
        infos = self.infos.values()
        suit = all(info.perturbable and (info.viewpoint or (info.nonlinear and not info.rigid)) for info in infos)
        return suit and {info.rigid for info in infos} == {True, False}

    @property
    def newton_suits(self) -> bool:
        """Return whether Gauss-Newton steps are possible: no requested image or pixels, a pixelwise loss, no preconditioners."""
        requested = self.options.image is not None or self.options.pixels is not None
        return not requested and self.problem.loss.pixelwise and not self.problem.coordinates.preconditioners

    @cached_property
    def unreachable(self) -> str:
        """Reason why path gradients of the unknowns are unsuitable; "" if they are suitable."""
        if rigid := next((key for key in self.poses if not self._turns_by_paths(key)), ""):
            other = "; --method plain has path gradients" if self.infos[rigid].differentiable else ""
            what = "a light" if self.infos[rigid].light else "a shape or sensor"
            return f"parameter {rigid} moves {what} as a whole, with plateaus of the loss{other}"
        return refusal(self.problem)

    def _turns_by_paths(self, key: str) -> bool:
        """Return whether a pose is a rotation of one of many lights, whose path gradient costs as much as that of one."""
        info = self.infos[key]
        return info.light and info.differentiable and self.elements > self.constants.few_numbers


def refusal(problem: Problem) -> str:
    """Return why the renderer has no path gradients of the unknowns; "" if it has them."""
    try:
        problem.renderer.prepare(list(problem.shapes()), None)
    except InputError as error:
        return str(error)
    return ""


def choose_sampler(traits: Traits) -> tuple[PixelSampler, str]:
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


def choose_image(traits: Traits, sampler: PixelSampler) -> tuple[ImageEstimator, str]:
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
