"""`auto`: what suits the problem."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from unrender import pixels
from unrender.core.errors import InputError
from unrender.core.registry import register
from unrender.core.text import grouped, listed
from unrender.estimators.base import Estimator
from unrender.estimators.gauss_newton import GaussNewton, explained
from unrender.estimators.hybrid import HybridGradient, beyond_paths
from unrender.estimators.path import PathGradient
from unrender.estimators.smoothed import SmoothedDerivatives
from unrender.images.base import ImageEstimator
from unrender.images.plain import Plain
from unrender.images.recursive_control_variate import RecursiveControlVariate
from unrender.methods.base import Options, method, parameterised
from unrender.methods.first_rates import first_rates, logarithms
from unrender.methods.plan import Plan
from unrender.methods.smoothed import parse_widths, widths_of
from unrender.optimizers.adam import Adam
from unrender.optimizers.averaged_newton import AveragedNewton
from unrender.optimizers.base import Optimizer
from unrender.optimizers.partitioned import Partitioned
from unrender.optimizers.schedule_free import ScheduleFree
from unrender.pixels.base import PixelSampler
from unrender.preconditioners import LargeSteps, Sobolev, grid
from unrender.rendering.partial import PartialDerivatives
from unrender.scene.coarse_to_fine import CoarseToFine
from unrender.scene.parameter import ParameterSettings
from unrender.scene.problem import Problem
from unrender.schedules import Exponential, InverseRoot

__all__ = ["AutoMethod"]

_RATE = 0.1
"""Learning rate, as a share of a parameter's range or size."""
_PATHS, _FEWEST, _MOST = 1 << 15, 2, 16
"""Of a step: so many paths in all views, as far as that is between 2 and 16 samples per pixel."""
_VERTICES_PER_STRENGTH, _STRENGTHS = 192, (1.0, 64.0)
"""λ of the large steps of vertices is their number over 192, within limits: steps are smooth over the same share of any mesh, since √λ is a
number of edges. 13 or so for some 2500; 19 in Nicolet et al. 2021."""
_MESH_TIME = 15.0
"""Steps after which the rate of vertices is 1/√2 of the first: a shape's first steps are the longest that it bears."""
_MANY_VIEWS, _MOST_VIEWS = 4, 8
"""Of meshes: from how many views on a step takes half of them, and how many at most."""
_TOLERANCE = 2.0
"""κ of `PathGradient`."""
_LINEAR_MEMORY, _MEMORY = 0.95, 0.97
"""`max_weight` of control variates, for losses whose derivatives are linear and for others, which noise of the image biases."""
_CAMERA_SHARE = 0.1
"""First steps of sensors' poses by path gradients, in units of the world and radians, over `learning_rate`."""
_IMAGE_PATHS, _FEWEST_IMAGE, _MOST_IMAGE = 1 << 21, 8, 256
"""Of a Gauss-Newton step: so many paths in all images, as far as that is between 8 and 256 samples per pixel."""
_PER_DERIVATIVE, _FEWEST_DERIVATIVE, _MOST_ELEMENTS = 8, 4, 1 << 10
"""Samples of the images over those of the derivative images, and the fewest of these; elements of poses up to which there is a matrix."""
_FEW_NUMBERS, _NUMBER_SIZE = 24, 4
"""Elements of all numbers together, and of each, up to which they take Gauss-Newton steps."""
_NUMBER_PATHS, _FEWEST_NUMBER, _MOST_NUMBER = 1 << 16, 4, 256
"""Of such a step: so many paths in all images, as far as that is between 4 and 256 samples per pixel."""
_DIFFERENCE_PATHS, _MOST_DIFFERENCE = 1 << 20, 8
"""Paths of all derivative images, as far as that is between 2 and 8 samples per pixel; 16 times as many are too dear."""
_TRIAL_SPP, _EXPLAINED = 4, 0.1
"""Of poses of shapes: samples of the derivative images at the start, and the share of the loss that they must explain."""
_FRESH_FROM = 12
"""Of `PathGradient`: the step from which fresh gradients tell whether detail is smoothed away."""
_CORRELATION = Sobolev().correlation
_SIGMA, _STEP = 0.2, 0.5
"""Width of the smoothing of what is perturbed, and its first rate as a share of that."""
_PERTURBED, _PERTURBED_SPP, _ANNEALING = 16, 2, (25.0, 0.1)
"""Perturbed renders per view and step, their samples per pixel, and half-life and floor of their width."""
_GRID = 4
"""Dimensions of a grid, (Z, Y, X, C)."""
_COARSE: tuple[tuple[int, tuple[int, ...]], ...] = ((16, (8, 20)), (8, (14,)))
"""Of grids with so many cells along their shortest side: the steps before which their resolution doubles."""
_MOST_PIXELS = 1 << 19
"""Of all views, that a step renders whole."""
_DRAWN, _DRAWN_PATHS = 1 << 15, 1 << 17
"""Where there are more: the pixels that a step draws of them, and its paths."""


@dataclass(frozen=True)
class _Image:
    """What the loss sees, and why."""

    name: str
    estimator: ImageEstimator
    reason: str


@register(name="auto", position=0)
class AutoMethod(Options):
    """what suits the problem: images with a memory or without, smoothing for textures and grids, schedule-free Adam

    The loss sees recursive control variates, which use earlier samples again: less noise, and less of the bias that noise gives to losses
    other than L2. Its errors are forgotten after some 20 steps, of L1 and such 33, lest steps follow them. Where the scene cannot be
    loaded twice, or a mesh moves and the loss is unbiased without a memory, each step has its own rendering. Textures, grids and values at
    the vertices of meshes move along Sobolev gradients, vertices of meshes along large steps at one rate for all, other parameters by
    steps in proportion to their range. Where path gradients do not reach a parameter, as of a pose, it moves by perturbed renders, beside
    path gradients of the others (`hybrid`), or `smoothed` where there are no others; cameras alone take Gauss-Newton steps, and so do poses
    of shapes from a start that overlaps enough. Grids of
    volumes are coarse in the first steps. Every choice can be set.
    """

    image: Literal["plain", "rcv"] | None = Field(
        None, description="what the loss sees: a fresh rendering, or rcv's; none for the latter where it can be had"
    )
    spp: PositiveInt | None = Field(
        None,
        description="samples per pixel; none for some 32768 paths a step, 131072 of drawn pixels, from 2 to 16 per pixel",
    )
    pixels: PositiveInt | None = Field(
        None,
        description="pixels a step, drawn from all views; none for all pixels, or 32768 where there are more than 524288",
    )
    tolerance: NonNegativeFloat = Field(
        _TOLERANCE, description="times its noise, within which L1 and Huber count a residual by its size, not its sign"
    )
    parameterise: bool = Field(
        True, description="whether positive numbers, colours and textures without an upper bound move as logarithms"
    )
    sigma: PositiveFloat | str = Field(
        _SIGMA,
        description="width of the smoothing of what path gradients do not reach, in its units: 0.2, mug.rotation.y=0.6",
    )
    smooth: bool = Field(
        True, description="whether textures, grids and values at vertices move along Sobolev gradients"
    )
    correlation: PositiveFloat = Field(
        _CORRELATION,
        le=1,
        description="length over which Sobolev gradients smooth, at most, as a share of a texture's side",
    )
    coarse: bool = Field(True, description="whether grids of volumes are coarse in the first steps")
    learning_rate: PositiveFloat = Field(
        _RATE,
        le=1,
        description="first steps, as a share of a parameter's range, or of its size where the range is open",
    )

    def build(self) -> tuple[Estimator, Optimizer]:
        """See `Options.build`: what is chosen where nothing is known of the problem."""
        image = Plain() if self.image == "plain" else RecursiveControlVariate(max_weight=_LINEAR_MEMORY)
        sampler = pixels.Uniform(self.pixels) if self.pixels else pixels.All()
        return PathGradient(image, sampler, self.spp or _FEWEST), ScheduleFree(self.learning_rate)

    def plan(self, problem: Problem) -> Plan:
        if _is_of_cameras(problem) and (plan := self._of_cameras(problem)):
            return plan
        if plan := self._of_numbers(problem):
            return plan
        perturbed = beyond_paths(problem.renderer.parameters(), list(problem.shapes()))
        part = problem.rendered_by(PartialDerivatives(problem.renderer, frozenset(perturbed)))
        if 0 < len(perturbed) < len(problem.shapes()) and not _refusal(part):
            return replace(self._hybrid(part, perturbed), problem=problem)
        if unreachable := _unreachable(problem):
            reason = f"derivatives of a smoothed loss (method smoothed): {unreachable}"
            return Plan(problem, *method("smoothed").start({"sigma": self.sigma}), reasons=(reason,))
        return self._of_paths(problem)

    def _hybrid(self, problem: Problem, perturbed: Sequence[str]) -> Plan:
        """Where some parameters are beyond path gradients, and `problem` differentiates the others alone."""
        plan = self._of_paths(problem, {key: _STEP * width for key, width in widths_of(self.sigma, perturbed).items()})
        annealing, widths = Exponential(*_ANNEALING), parse_widths(self.sigma)
        smoothing = SmoothedDerivatives(widths, _PERTURBED, spp=_PERTURBED_SPP, schedule=annealing, debiased=True)
        estimator = HybridGradient(plan.estimator, smoothing, tuple(perturbed))
        known = problem.renderer.parameters()
        reason = f"perturbed renders of {', '.join(f'{key}: {known[key].reason}' for key in perturbed)}"
        return replace(plan, estimator=estimator, reasons=(reason, *plan.reasons))

    def _of_paths(self, problem: Problem, given: Mapping[str, float] | None = None) -> Plan:
        """By path gradients; `given`: first rates that are known already."""
        sampler, drawn = self._sampler(problem)
        meshes, given = tuple(problem.faces), given or {}
        image = self._image(problem, _shows_half(problem, sampler), bool(meshes))
        spp, smoothed = self._samples(problem, sampler), self._smoothed(problem)
        moved = logarithms(problem) if self.parameterise else {}
        coarse = {} if meshes or not self.coarse else _coarse(problem)
        large_steps = LargeSteps(_strength(problem)) if meshes else None
        settings = {
            key: ParameterSettings(
                None if key in given else moved.get(key),
                large_steps if key in meshes else None,
                CoarseToFine(coarse[key], states="carry") if key in coarse else None,
            )
            for key in problem.shapes()
        }
        given_problem, problem = problem, problem.configured(settings)
        rates = {**first_rates(problem, self.learning_rate), **given}
        optimizer: Optimizer = ScheduleFree(
            {"*": self.learning_rate, **{key: rate for key, rate in rates.items() if key not in meshes}},
            preconditioner=Sobolev(correlation=self.correlation) if smoothed else None,
            preconditioned=smoothed,
            wiener=not isinstance(sampler, pixels.Uniform),
            reparameterised=tuple(key for key in problem.parameterisations if key in problem.coordinates.transforms),
        )
        biased = problem.loss.pixelwise and not problem.loss.linear
        tolerance = self.tolerance if biased and isinstance(sampler, (pixels.All, pixels.Views)) else 0.0
        kind = {"plain": "a fresh rendering each step", "rcv": "recursive control variates"}[image.name]
        coarse_steps = {
            key: f"resolution doubled by step {' and '.join(map(str, steps))}" for key, steps in coarse.items()
        }
        first = grouped({key: f"{rate:.3g}" for key, rate in (rates | problem.learning_rates).items()})
        reasons = (
            f"{kind}, {spp} samples per pixel: {image.reason}",
            drawn,
            f"{type(problem.loss).__name__} damped where noise exceeds the residual" if tolerance else "",
            f"Sobolev gradients of {listed(smoothed)}" if smoothed else "",
            f"coarse to fine: {grouped(coarse_steps)}" if coarse else "",
            *parameterised(problem),
            f"large steps of {listed(meshes)}: one rate for all vertices, λ {_strength(problem):.2g}" if meshes else "",
            f"schedule-free Adam, first rate {first}" if len(meshes) < len(rates) else f"Adam, first rate {first}",
        )
        fresh_from = _FRESH_FROM if smoothed and image.name == "rcv" and isinstance(sampler, pixels.All) else 0
        estimator = PathGradient(image.estimator, sampler, spp, tolerance=tolerance, fresh_from=fresh_from)
        if meshes:
            rate = min(rates[key] for key in meshes)
            descent = Adam(rate, schedule=InverseRoot(_MESH_TIME), uniform=True)
            optimizer = Partitioned(meshes, descent, optimizer)
        return Plan(given_problem, estimator, optimizer, settings, tuple(filter(None, reasons)))

    def _of_cameras(self, problem: Problem) -> Plan | None:
        """Where poses of sensors alone are unknown; None where neither way serves."""
        known = problem.renderer.parameters()
        elements = sum(math.prod(shape) for shape in problem.shapes().values())
        wants_paths = self.image is not None or self.pixels is not None
        if wants_paths or elements > _MOST_ELEMENTS or problem.preconditioners or not problem.loss.pixelwise:
            reached = all(known[key].differentiable for key in problem.shapes())
            return self._of_cameras_by_paths(problem) if reached else None
        whole = self.spp or min(max(_IMAGE_PATHS // problem.pixels, _FEWEST_IMAGE), _MOST_IMAGE)
        spp, derivative_spp = max(whole, 2), max(whole // _PER_DERIVATIVE, _FEWEST_DERIVATIVE)
        reason = (
            f"Gauss-Newton steps of cameras by perturbed renders, {spp} samples per pixel of the image, {derivative_spp} of those; "
            "the mean of all steps' models"
        )
        estimator = GaussNewton(spp, derivative_spp, tolerance=self._damping(problem))
        return Plan(problem, estimator, AveragedNewton(), reasons=(reason,))

    def _of_numbers(self, problem: Problem) -> Plan | None:
        """Gauss-Newton steps where few numbers are unknown and the picture changes its form with one of them; else None.

        Of poses of shapes, where derivative images at the start explain the residual: on a plateau a smoothed loss is needed.
        """
        known, shapes = problem.renderer.parameters(), problem.shapes()
        elements = sum(math.prod(shape) for shape in shapes.values())
        poses = [key for key in shapes if known[key].rigid]
        cameras = [key for key in poses if known[key].viewpoint]
        small = all(len(shape) <= 1 and math.prod(shape) <= _NUMBER_SIZE for shape in shapes.values())
        numbers = small and all(known[key].perturbable and key not in cameras for key in shapes)
        nonlinear = poses or [key for key in shapes if known[key].nonlinear]
        differences = _DIFFERENCE_PATHS // (2 * elements * problem.pixels)
        dear = elements > _FEW_NUMBERS or 4 * elements * problem.pixels > 16 * _DIFFERENCE_PATHS
        if not numbers or dear or not nonlinear or 0 < len(poses) < len(shapes):
            return None
        if self.image is not None or self.pixels is not None or not problem.loss.pixelwise or problem.preconditioners:
            return None
        spp = self.spp or min(max(_NUMBER_PATHS // problem.pixels, _FEWEST_NUMBER), _MOST_NUMBER)
        spp, derivative_spp = max(spp, 2), min(max(differences, 2), _MOST_DIFFERENCE)
        largest = widths_of(self.sigma, poses)
        trial = GaussNewton(spp, _TRIAL_SPP, largest=largest)
        if poses and (not problem.loss.linear or not explained(problem, trial) > _EXPLAINED):
            return None
        reason = (
            f"Gauss-Newton steps of {elements} number{'s' * (elements > 1)} by perturbed renders, {spp} samples per pixel of the image, "
            f"{derivative_spp} of those: pictures change their form with {listed(nonlinear)}"
        )
        estimator = replace(trial, derivative_spp=derivative_spp, tolerance=self._damping(problem))
        return Plan(problem, estimator, AveragedNewton(), reasons=(reason,))

    def _damping(self, problem: Problem) -> float:
        """κ of Gauss-Newton steps; 0 is not allowed there."""
        return _TOLERANCE if problem.loss.linear or not self.tolerance else self.tolerance

    def _of_cameras_by_paths(self, problem: Problem) -> Plan:
        """Likewise, by path gradients: where they are asked for, by an image or pixels, and where there is no Gauss-Newton step."""
        sampler, drawn = self._sampler(problem)
        spp, rate = self._samples(problem, sampler), _CAMERA_SHARE * self.learning_rate
        image = RecursiveControlVariate("primary") if self.image == "rcv" else Plain()
        reason = (
            f"path gradients of cameras, {spp} samples per pixel, Adam, first rate {rate:.3g}, halved every 30 steps"
        )
        descent = Adam(rate, beta_2=0.99, schedule=Exponential(30, 0.01))
        return Plan(problem, PathGradient(image, sampler, spp), descent, reasons=tuple(filter(None, (reason, drawn))))

    def _image(self, problem: Problem, whole: bool, deforms: bool) -> _Image:
        if self.image == "plain":
            return _Image("plain", Plain(), "as asked for")
        if self.image is None and deforms and problem.loss.linear:
            return _Image("plain", Plain(), "a mesh moves, and the loss is unbiased without a memory")
        if self.image is None and not whole:
            return _Image("plain", Plain(), "control variates need whole views, half of them a step")
        space, obstacle = _shared_space(problem)
        if obstacle and self.image is None:
            return _Image("plain", Plain(), f"no control variates: {obstacle}")
        reason = "as asked for" if self.image else "earlier samples are used again"
        most = _LINEAR_MEMORY if problem.loss.linear else _MEMORY
        return _Image("rcv", RecursiveControlVariate(space, max_weight=most), reason)

    def _sampler(self, problem: Problem) -> tuple[PixelSampler, str]:
        """The pixels of a step, and why they are not all."""
        if self.pixels is not None:
            return pixels.Uniform(self.pixels), ""
        count, views = problem.pixels, len(problem.views)
        if problem.faces and problem.loss.pixelwise and views >= _MANY_VIEWS and count <= _MOST_PIXELS:
            taken = min(-(-views // 2), _MOST_VIEWS)
            return pixels.Views(taken), f"{taken} of {views} views a step: moving borders cost each view alike"
        if count <= _MOST_PIXELS or not problem.loss.pixelwise:
            return pixels.All(), ""
        return pixels.Uniform(_DRAWN), f"{_DRAWN} of all {count} pixels a step"

    def _samples(self, problem: Problem, sampler: PixelSampler) -> int:
        """Per pixel: the power of two that comes nearest to the paths of a step from below."""
        draws = isinstance(sampler, pixels.Uniform)
        count, paths = (sampler.count, _DRAWN_PATHS) if draws else (problem.pixels, _PATHS)
        return self.spp or min(max(1 << ((paths // count).bit_length() - 1 if count <= paths else 0), _FEWEST), _MOST)

    def _smoothed(self, problem: Problem) -> tuple[str, ...]:
        """Textures, grids and values at vertices, but for positions, that have no preconditioner of their own."""
        known = problem.renderer.parameters()
        return tuple(
            key
            for key, shape in problem.shapes().items()
            if self.smooth
            and key not in problem.preconditioners
            and (grid.is_map(shape) or (known[key].mesh is not None and not known[key].welded))
        )


def _coarse(problem: Problem) -> dict[str, tuple[int, ...]]:
    """{key: steps before which the resolution doubles} of grids: a few cells find where there is something with less noise than many. Not
    of textures, where smoothed gradients do the same; nor of grids that start with detail, which would be lost."""
    known, start, found = problem.renderer.parameters(), problem.initial_values(), {}
    for key, shape in problem.shapes().items():
        ways = [steps for cells, steps in _COARSE if len(shape) == _GRID and min(shape[:-1]) >= cells]
        own = key in problem.coarse_to_fine or key in problem.preconditioners
        if ways and not own and known[key].resizable and not _detail(start[key]):
            found[key] = ways[0]
    return found


def _detail(grid: np.ndarray) -> bool:
    """Whether its cells differ."""
    return bool((grid != grid[:1, :1, :1]).any())


def _shows_half(problem: Problem, sampler: PixelSampler) -> bool:
    """Whether a step renders all views, or half of them: what was remembered of a view seldom seen is of another mesh."""
    half = isinstance(sampler, pixels.Views) and 2 * sampler.count >= len(problem.views)
    return half or isinstance(sampler, pixels.All)


def _shared_space(problem: Problem) -> tuple[Literal["path", "primary"], str]:
    """Where two states of the parameters share samples, and why nowhere; "" where they do."""
    obstacle = ""
    for space in ("path", "primary"):
        try:
            problem.renderer.prepare(list(problem.shapes()), space)
        except InputError as error:
            obstacle = str(error)
        else:
            return space, ""
    return "primary", obstacle


def _is_of_cameras(problem: Problem) -> bool:
    """Whether all parameters are poses of sensors. Lenses are in other units."""
    known = problem.renderer.parameters()
    return all(known[key].viewpoint and known[key].rigid for key in problem.shapes())


def _unreachable(problem: Problem) -> str:
    """Why path gradients of the parameters do not serve; "" where they do."""
    known = problem.renderer.parameters()
    if rigid := next((key for key in problem.shapes() if known[key].rigid), ""):
        other = "; --method plain has path gradients" if known[rigid].differentiable else ""
        return f"parameter {rigid} moves a shape or sensor as a whole, with plateaus of the loss{other}"
    return _refusal(problem)


def _refusal(problem: Problem) -> str:
    """Why the renderer has no path gradients of the parameters; "" where it has."""
    try:
        problem.renderer.prepare(list(problem.shapes()), None)
    except InputError as error:
        return str(error)
    return ""


def _strength(problem: Problem) -> float:
    """λ of the large steps of the smallest mesh."""
    fewest = min(problem.initial_values()[key].size // 3 for key in problem.faces)
    return float(np.clip(fewest / _VERTICES_PER_STRENGTH, *_STRENGTHS))
