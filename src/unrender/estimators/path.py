"""Gradient by path replay, weighted by the loss derivative at an independent image; and that of Mitsuba's tutorial loop."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import reduce
from typing import Any

from unrender.core import arrays, checks, trees
from unrender.core.checks import Count, Index, NotNegative
from unrender.core.errors import InputError
from unrender.core.random import Key
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.estimators import emitter_selection
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import Capabilities, FreshGradient, Gradient, NoiseSample
from unrender.estimators.emitter_selection import EmitterSelection, EmitterState
from unrender.estimators.sample_groups import PIXELS, GradientRequest, check_pixels, draws_pixels, leave_one_out_groups
from unrender.images.base import ImageEstimator, Plain, needs_full_views
from unrender.pixels.adaptive_counts import AdaptiveCounts
from unrender.pixels.base import MiniBatch, PixelSampler, learned
from unrender.pixels.uniform import All
from unrender.rendering.renderer import StockRenderer, with_differential_bsdf
from unrender.scene.problem import Problem
from unrender.scene.upsampling import Upsampler, upsampled

_EMITTERS = PIXELS + 1  # stream of a step's key for the tangents of emitter sampling
_WINDOW = 8  # number of consecutive estimates that have the fresh gradient


@dataclass(frozen=True)
class PathGradientState:
    """State between steps: of the image estimator, of the pixel sampler and of the emitter probabilities, None for the scene's own; number
    of estimates so far, and of steps with mini-batches since the last of full views."""

    image: Any
    pixels: Any
    batches: int = 0
    step: int = 0
    emitters: EmitterState | None = None

    def upsampled(self, upsampler: Upsampler) -> PathGradientState:
        emitters = None if self.emitters is None else self.emitters.upsampled(upsampler)
        image, pixels = upsampled(self.image, upsampler), upsampled(self.pixels, upsampler)
        return replace(self, image=image, pixels=pixels, emitters=emitters)


@register
@dataclass(frozen=True)
class PathGradient:
    """∂L/∂θ = Σ ∂L/∂I · ∂I/∂θ, with the two factors from independent samples (Nicolet et al. 2023, Eqs 12 and 13).

    Independence comes from leave-one-out sample groups (dual buffers at 2 spp): the adjoint of each group is weighted by the loss
    derivative at the image of all other groups. This takes two traces where the usual loop takes three. With a control variate the
    groups' images share the control variate, which is independent of all of them. If noise dominates, G groups have G / (G - 1) times
    the variance of an adjoint on separate paths. Therefore there are as many groups as samples, up to 16.

    Unbiased for a loss whose derivative is linear in the image (`loss.linear`) and a plain image. Otherwise it is biased by the noise
    of the image that the loss sees, which a control variate reduces from step to step.

    With pixel mini-batches (Eq. 4 of the paper of `pixels.Adaptive`) each pixel's samples are weighted by 1 / (N p). This is as
    unbiased as the gradient of all pixels, for any positive probabilities.

    Args:
        image: estimator of the image that the loss sees, `images.Plain()` or `images.RecursiveControlVariate()`.
        pixels: pixel sampler: `pixels.All()`, or a mini-batch by `Uniform`, `LossProportional` or `Adaptive`.
        spp: samples per pixel and view of the image, or per pixel of the mini-batch, >= 1.
        adjoint_spp: samples per pixel of the adjoint on separate paths, >= 1. None for leave-one-out groups, or for `spp` separate paths
            if `spp` cannot be divided into groups: 1, and primes above 16.
        tolerance: κ >= 0. If it is positive, the loss's derivative is not linear, such as L1's, and the variance σ² of the image is known
            (full views, or mini-batches of these, with several samples), then the derivative at the residual r is multiplied by
            |r| / √(r² + κ² σ²), with σ² averaged over neighbouring pixels. L1 becomes Charbonnier's loss √(r² + δ²) with δ = κ σ: where
            noise determines the sign of r, the derivative is proportional to r, so skewed noise, such as fireflies, does not bias it. It
            tends to the loss itself as noise decreases.
        fresh_from: index of the estimate from which eight have `FreshGradient` as well, and again from twice, four times, … this
            index, >= 8; 0 for none. It costs an additional adjoint. Only for full views, with an image estimator that reuses earlier
            samples (otherwise every gradient is fresh), and with a linear derivative or a tolerance.
        noise_sample: whether the first estimate has a `NoiseSample`: the gradient with the opposite sign in every other group. It costs an
            additional adjoint, and requires full views and an even number of groups.
        emitters: selection of emitters in next-event estimation: "scene", uniform or by the scene's own sampling weights, or
            "adaptive", to minimise the variance of the gradient, in units of Adam's steps (`emitter_selection.EmitterState`). Both are
            unbiased alike. The first steps, and one in 20, take two additional passes, which update the probabilities. The weight of the
            scene's own probabilities decreases from four fifths to a tenth as samples confirm the estimate. These passes store eight
            bytes per path and vertex. It requires at least two leave-one-out groups, and a scene without participating media, moving
            shapes or moving sensors. It has no effect with a single emitter.
        differential_bsdf: whether the adjoint samples the derivative of rough conductors by their roughness separately, in proportion
            to it and in antithetic pairs (Belhe et al. 2024). It is as unbiased. An adjoint costs about twice as much, and the variance
            of roughness gradients decreases, most for smooth surfaces. `init` raises `InputError` if no parameter is such a roughness
            (`RoughLobes`), or if views are distributed to workers.
    """

    image: ImageEstimator = field(default_factory=Plain)
    pixels: PixelSampler = field(default_factory=All)
    spp: Count = 4
    adjoint_spp: Count | None = None
    tolerance: NotNegative = 0.0
    fresh_from: Index = 0
    noise_sample: bool = False
    emitters: EmitterSelection = "scene"
    differential_bsdf: bool = False

    def __post_init__(self):
        checks.fields(self)
        if 0 < self.fresh_from < _WINDOW:
            raise InputError(f"PathGradient: fresh_from must be 0, or at least {_WINDOW}, got {self.fresh_from}")
        check_pixels("PathGradient", self.pixels, self.image, self.spp, self.adjoint_spp)
        equal = not isinstance(self.pixels, AdaptiveCounts)
        emitter_selection.check("PathGradient", self.emitters, self.groups, equal)
        if self.differential_bsdf and self.emitters == "adaptive":
            raise InputError(
                'PathGradient: differential_bsdf does not support emitters="adaptive"; leave out one of them'
            )

    provides = Capabilities(Gradient)

    @property
    def groups(self) -> int:
        """Number of leave-one-out sample groups; 1 if the adjoint has separate paths."""
        return leave_one_out_groups(self.spp, self.adjoint_spp)

    def _in_window(self, step: int) -> bool:
        """Return whether the estimate of this index has the fresh gradient as well."""
        if self.fresh_from == 0 or step < self.fresh_from:
            return False
        start = self.fresh_from << ((step // self.fresh_from).bit_length() - 1)
        return step < start + _WINDOW

    def _rendered(self, problem: Problem) -> Problem:
        if not self.differential_bsdf:
            return problem
        return problem.with_parts(renderer=with_differential_bsdf(problem.renderer))

    def init(self, problem: Problem, parameters: Tree) -> PathGradientState:
        """Return the state before the first step. Raise `InputError` for a parameter that `image.space` does not support."""
        problem = self._rendered(problem)
        session = problem.renderer.prepare(list(parameters), self.image.space)
        adaptive = self.emitters == "adaptive"
        emitters = emitter_selection.init("PathGradient", session) if adaptive else None
        image, pixels = self.image.init(problem, parameters), self.pixels.init(problem, parameters)
        return PathGradientState(image, pixels, emitters=emitters)

    def estimate(
        self, problem: Problem, parameters: Tree, state: PathGradientState, key: Key
    ) -> tuple[Estimate, PathGradientState]:
        """Return an estimate and the next state. `info`: "samples" (paths traced for images, adjoints and probabilities), "images" and
        the info of the image estimator, per fully rendered view, "pixel_probability" per view of a mini-batch, "emitter_probability" if
        it is adaptive."""
        problem = self._rendered(problem)
        batch, pixels = MiniBatch(None), state.pixels
        has_batches = draws_pixels(self.pixels)
        if not has_batches or not needs_full_views(self.image, parameters, state.image, state.batches):
            batch, pixels = self.pixels.draw(problem, parameters, state.pixels, key.fold(PIXELS))
        emitters, emitter_request = state.emitters, None
        if emitters is not None:
            emitter_request = emitter_selection.request(problem, parameters, emitters, key.fold(_EMITTERS))
        secant = problem.loss.linear or (problem.loss.pixelwise and self.tolerance > 0)
        request = GradientRequest(
            parameters,
            self.image,
            state.image,
            self.spp,
            key,
            self.adjoint_spp,
            batch=batch,
            tolerance=self.tolerance,
            fresh=batch.sample is None and self._in_window(state.step) and secant,
            noise=batch.sample is None and self.noise_sample and state.step == 0,
            emitters=emitter_request,
        )
        step = problem.executor.estimate_gradient(problem, request)
        wrt_u = problem.coordinates.wrt_u(step.gradient, parameters)
        pixels = self.pixels.observe(problem, pixels, wrt_u)
        if emitters is not None:
            emitters = emitter_selection.learned(emitter_selection.observed(problem, emitters, wrt_u), step.connections)
        pixels = learned(self.pixels, problem, pixels, batch.sample, step.draws)
        is_full, image = batch.sample is None, step.image
        if is_full and has_batches:
            image = problem.executor.prepare_images(problem, self.image, image)
        next_state = PathGradientState(image, pixels, 0 if is_full else state.batches + 1, state.step + 1, emitters)
        arrays.evaluate(step.gradient, step.fresh, step.noise, step.losses, next_state, step.info)
        loss = sum(arrays.number(value) for value in step.losses)
        info = {"samples": step.samples, "images": step.images, **step.info}
        if emitter_request is not None:
            info["emitter_probability"] = emitter_request.probabilities
        capabilities = tuple(kind(x) for kind, x in ((FreshGradient, step.fresh), (NoiseSample, step.noise)) if x)
        return Estimate(loss, step.gradient, capabilities, info), next_state


@dataclass(frozen=True)
class StockState:
    """State between steps.

    Attributes:
        path: state of the path gradient that replaces it; None if the renderer has a stock loop.
    """

    path: PathGradientState | None = None


@register
@dataclass(frozen=True)
class StockGradient(checks.Checked):
    """The gradient of a standard Mitsuba loop: `mi.render` of each view, the loss, `dr.backward`, with independent samples for image
    and adjoint.

    With `optimizers.Adam`, whose steps are those of `mi.ad.Adam`, it is the loop of Mitsuba's tutorials. Neighbouring pixels share
    samples, as in Mitsuba's film; elsewhere in `unrender` each pixel has its own samples. For renderers other than Mitsuba, it is
    `PathGradient(spp=spp, adjoint_spp=spp)`, which estimates the same from the same number of samples.

    Unbiased for a loss whose derivative is linear in the image; otherwise biased by the image's noise.

    Args:
        spp: samples per pixel and view of the image, and again of the adjoint, >= 1.
    """

    spp: Count = 16

    provides = Capabilities(Gradient)

    def init(self, problem: Problem, parameters: Tree) -> StockState:
        """Return the state before the first step. Raise `InputError` for a parameter that Mitsuba cannot differentiate."""
        problem.renderer.prepare(list(parameters), None)
        known = problem.renderer.parameters()
        if camera := next((key for key in parameters if known[key].viewpoint), ""):
            raise InputError(
                f"parameter {camera}: Mitsuba's loop has no gradient by the pose of a sensor; use --method plain"
            )
        if isinstance(problem.renderer, StockRenderer):
            return StockState()
        return StockState(self._path.init(problem, parameters))

    def estimate(self, problem: Problem, parameters: Tree, state: StockState, key: Key) -> tuple[Estimate, StockState]:
        """Return an estimate and the next state. `info`: "samples" (paths traced for images and adjoints), "images" per view."""
        renderer = problem.renderer
        if state.path is not None or not isinstance(renderer, StockRenderer):
            path = state.path or self._path.init(problem, parameters)
            estimate, path = self._path.estimate(problem, parameters, path, key)
            return estimate, StockState(path)
        loop = renderer.stock()
        parts, losses, images, samples = [], [], {}, 0
        for index, view in enumerate(problem.views):
            seeds = key.fold(index).fold(0).uint32(), key.fold(index).fold(1).uint32()
            images[index], gradient = loop.gradient(
                parameters,
                view.sensor,
                self.spp,
                seeds,
                lambda image, index=index: problem.loss_derivative(index, image),
            )
            losses.append(problem.loss_value(index, images[index]))
            height, width = renderer.resolutions()[view.sensor]
            samples += 2 * self.spp * height * width
            parts.append(gradient)
        total = reduce(trees.add, parts)
        arrays.evaluate(total, losses)
        loss = sum(arrays.number(value) for value in losses)
        return Estimate(loss, total, info={"samples": samples, "images": images}), state

    @property
    def _path(self) -> PathGradient:
        return PathGradient(spp=self.spp, adjoint_spp=self.spp)
