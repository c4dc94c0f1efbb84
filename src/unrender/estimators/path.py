"""The gradient by path replay, weighted by the loss derivative of an image that knows nothing of those paths."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

from unrender.core import arrays
from unrender.core.errors import InputError
from unrender.core.random import Key
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.estimators.base import GRADIENT, Estimate
from unrender.estimators.sample_groups import PIXELS, check_pixels, gather, leave_one_out_groups
from unrender.images.base import ImageEstimator
from unrender.images.plain import Plain
from unrender.pixels.all import All
from unrender.pixels.base import MiniBatch, PixelSampler
from unrender.problem.problem import Problem
from unrender.problem.upsampling import Upsampler, upsampled


@dataclass(frozen=True)
class PathGradientState:
    """State between steps.

    Attributes:
        image: the image estimator's.
        pixels: the pixel sampler's.
        batches: steps of drawn pixels since the last that looked at whole views.
    """

    image: Any
    pixels: Any
    batches: int = 0

    def upsampled(self, upsampler: Upsampler) -> PathGradientState:
        """See `Upsamplable`: the states of image estimator and pixel sampler are carried."""
        return replace(self, image=upsampled(self.image, upsampler), pixels=upsampled(self.pixels, upsampler))


@register
@dataclass(frozen=True)
class PathGradient:
    """∂L/∂θ = Σ ∂L/∂I · ∂I/∂θ, the two factors from independent samples (Nicolet et al. 2023, Eqs 12 and 13).

    Independence comes from crossing: each pixel's samples form groups (halves at 2 spp), and the adjoint of each group is
    weighted by the loss derivative at the image of all the others. Two traces serve what the usual loop traces three times. With a
    control variate the groups' images share the memory, which is independent of them all. For noise that dominates, G groups have
    G / (G - 1) times the variance of an adjoint on paths of its own, so there are as many as samples, up to 16.

    Unbiased for a loss whose derivative is linear in the image (`loss.linear`) and a plain image; otherwise biased by the noise of
    the image that the loss sees, which a control variate reduces step by step.

    With drawn pixels (Eq. 4 of the paper of `pixels.Adaptive`) each draw brings its samples, weighted by 1 / (N p): unbiased as the
    gradient of all pixels is, for whatever probabilities.

    Args:
        image: what the loss sees, `images.Plain()` or `images.RecursiveControlVariate()`.
        pixels: which pixels a step looks at: `pixels.All()`, or a number drawn by `Uniform`, `LossProportional` or `Adaptive`.
        spp: samples per pixel and view of the image, or per drawn pixel, >= 1.
        adjoint_spp: samples per pixel of the adjoint on paths of its own, >= 1. None for crossed groups, and for `spp` paths of
            its own where `spp` cannot be cut into groups: 1, and primes above 16.
    """

    image: ImageEstimator = field(default_factory=Plain)
    pixels: PixelSampler = field(default_factory=All)
    spp: int = 4
    adjoint_spp: int | None = None

    def __post_init__(self):
        for name, value in (("spp", self.spp), ("adjoint_spp", self.adjoint_spp)):
            if value is not None and (not isinstance(value, int) or isinstance(value, bool) or value < 1):
                raise InputError(f"PathGradient: {name} must be a whole number of at least 1, got {value!r}")
        check_pixels("PathGradient", self.pixels, self.image)

    @property
    def provides(self) -> frozenset[str]:
        """A gradient."""
        return frozenset({GRADIENT})

    @property
    def groups(self) -> int:
        """How many groups are crossed; 1 where the adjoint has paths of its own."""
        return leave_one_out_groups(self.spp, self.adjoint_spp)

    def init(self, problem: Problem, parameters: Tree) -> PathGradientState:
        """See `Estimator.init`. Raises `InputError` for a parameter that `image.space` cannot carry."""
        problem.renderer.select(list(parameters), self.image.space)
        return PathGradientState(self.image.init(problem, parameters), self.pixels.init(problem, parameters))

    def estimate(
        self, problem: Problem, parameters: Tree, state: PathGradientState, key: Key
    ) -> tuple[Estimate, PathGradientState]:
        """See `Estimator.estimate`. `info`: "samples" (paths traced for images, adjoints and probabilities), "images" and what the
        image estimator tells, per view that was looked at whole, "pixel_probability" per view where pixels are drawn."""
        batch, pixels = MiniBatch(None), state.pixels
        if not self.image.needs_whole_views(parameters, state.image, state.batches):
            batch, pixels = self.pixels.draw(problem, parameters, state.pixels, key.fold(PIXELS))
        step = gather(problem, parameters, self.image, state.image, self.spp, key, self.adjoint_spp, batch=batch)
        pixels = self.pixels.observe(problem, pixels, step.gradient)
        whole, image = batch.draw is None, step.image
        if whole and not isinstance(self.pixels, All):
            image = self.image.prepare(problem, image)
        next_state = PathGradientState(image, pixels, 0 if whole else state.batches + 1)
        arrays.evaluate(step.gradient, step.losses, next_state, step.info)
        loss = sum(arrays.number(value) for value in step.losses)
        info = {"samples": step.samples, "images": step.images, **step.info}
        return Estimate(loss, step.gradient, info=info), next_state
