"""Denoised images for the loss."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

from unrender.core import arrays, checks
from unrender.core.arrays import Array
from unrender.core.errors import InputError
from unrender.core.random import Key
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.images import denoising
from unrender.images.base import ImageEstimate, ImageEstimator, PairRequest
from unrender.images.denoising import Denoiser
from unrender.images.plain import Plain
from unrender.rendering.renderer import Space
from unrender.scene.batches import Frame, PixelSample
from unrender.scene.problem import Problem


@register
@dataclass(frozen=True)
class Denoised:
    """The image of another estimator, denoised before the loss is evaluated. Biased.

    A denoiser trades variance for a systematic error, which no number of steps averages out: a descent converges to where the
    *denoised* image fits the reference, near the truth at best. It pays where the loss derivative is not linear and the image so noisy
    that the bias by noise is the larger one, and for previews. A control variate of `inner` is of the image before denoising.

    Image and adjoint stay independent: for each sample group, the image of all *other* groups is denoised by itself, so that no adjoint
    is weighted by an image of its own samples. Each is a call of the denoiser, so there are fewer groups than elsewhere.

    Every pixel of `unrender` has samples of its own, which denoisers need: where neighbouring pixels share samples, their
    correlated noise is taken for texture.

    Args:
        inner: estimates the image, `images.Plain()` or `images.RecursiveControlVariate()`.
        by: the denoiser: "auto" (OptiX on a GPU, else OIDN: `pip install 'unrender[denoise]'`), "oidn", "optix", or "variation".
        groups: the most sample groups, >= 2; fewer where the number of samples has no such divisor. Two groups are two calls of the
            denoiser beside that of the whole image; more groups make each image less noisy.

    Raises:
        InputError: at construction, a value out of range; from `init`, a denoiser that cannot run here.
    """

    inner: ImageEstimator = field(default_factory=Plain)
    by: Denoiser = "auto"
    groups: int = 2

    def __post_init__(self):
        checks.integer("Denoised", "groups", self.groups, 2)
        if isinstance(self.inner, (type, Denoised)):
            raise InputError(f"Denoised: inner must be an image estimator such as Plain(), got {self.inner!r}")

    @property
    def space(self) -> Space | None:
        """That of `inner`."""
        return self.inner.space

    @property
    def pixelwise(self) -> bool:
        """False: a denoiser needs the neighbours of a pixel."""
        return False

    def init(self, problem: Problem, parameters: Tree) -> Any:
        """See `ImageEstimator.init`. The state is that of `inner`."""
        denoising.choose(self.by)
        return self.inner.init(problem, parameters)

    def estimate(
        self,
        problem: Problem,
        parameters: Tree,
        state: Any,
        frame: Frame,
        spp: int,
        groups: int,
        key: Key,
        pair_request: PairRequest | None = None,
    ) -> tuple[ImageEstimate, Any]:
        found, kept = self.inner.estimate(
            problem, parameters, state, frame, spp, self._groups(groups), key, pair_request
        )
        return replace(found, filter=self._filter(problem), variance=None), kept

    def needs_whole_views(self, parameters: Tree, state: Any, batches: int) -> bool:
        """Always."""
        del parameters, state, batches
        return True

    def prepare(self, problem: Problem, state: Any) -> Any:
        del problem
        return state

    def learn(self, problem: Problem, state: Any, sample: PixelSample, kept: Any) -> Any:
        del problem, sample, kept
        return state

    def advance(self, parameters: Tree, state: Any, kept: tuple[Any, ...]) -> Any:
        return self.inner.advance(parameters, state, kept)

    def _groups(self, asked: int) -> int:
        """The largest divisor of `asked` up to `groups`; its smallest one above 1 where there is none."""
        divisors = [n for n in range(2, asked + 1) if asked % n == 0]
        return max((n for n in divisors if n <= self.groups), default=min(divisors, default=1))

    def _filter(self, problem: Problem) -> Callable[[Array], Array]:
        def denoise(image: Array) -> Array:
            noisy = arrays.numpy(image)
            if not arrays.all_finite(noisy):
                return image  # so that the loop skips the step
            return problem.renderer.array(denoising.denoise(noisy, by=self.by))

        return denoise
