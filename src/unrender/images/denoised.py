"""An image without its noise, and with a denoiser's error in its place."""

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
from unrender.evaluation import denoising
from unrender.evaluation.denoising import Denoiser
from unrender.images.base import ImageEstimate, ImageEstimator, PairRequest
from unrender.images.plain import Plain
from unrender.problem.batches import Frame
from unrender.problem.problem import Problem
from unrender.rendering.renderer import Space


@register
@dataclass(frozen=True)
class Denoised:
    """What another image estimator makes, denoised before the loss sees it. Biased.

    A denoiser trades noise for an error of its own, which no number of steps averages out: a descent comes to rest where the
    *denoised* image fits the reference, next to the truth at best. It pays where the loss's derivative is not linear and the image is so
    noisy that its bias is the larger one, and for previews. Memory, where `inner` has one, is of the image as it was rendered.

    Image and adjoint stay independent: for each group of samples, the image of all the *others* is denoised by itself, so that no adjoint
    is weighted by an image that knows its samples. Each of these is a call of the denoiser, so samples form fewer groups than elsewhere.

    Every film of `unrender` has a box filter, which denoisers need: with a wider one neighbours share samples, and their noise looks like
    a picture.

    Args:
        inner: makes the image, `images.Plain()` or `images.RecursiveControlVariate()`.
        by: who denoises: "auto" (OptiX on a GPU, else OIDN: `pip install 'unrender[denoise]'`), "oidn", "optix", or "variation".
        groups: the most groups that samples form, >= 2, where their number can be divided so. Two groups are two calls beside that of
            the whole image; more of them leave each image less noisy.

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
        """That of the image that is denoised."""
        return self.inner.space

    @property
    def pixelwise(self) -> bool:
        """False: a denoiser needs a pixel's neighbours."""
        return False

    def init(self, problem: Problem, parameters: Tree) -> Any:
        """See `ImageEstimator.init`. The state is that of the image that is denoised."""
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
        """See `ImageEstimator.estimate`."""
        found, kept = self.inner.estimate(
            problem, parameters, state, frame, spp, self._groups(groups), key, pair_request
        )
        return replace(found, clean=self._cleaner(problem)), kept

    def needs_whole_views(self, parameters: Tree, state: Any, batches: int) -> bool:
        """Always."""
        del parameters, state, batches
        return True

    def prepare(self, problem: Problem, state: Any) -> Any:
        """See `ImageEstimator.prepare`."""
        del problem
        return state

    def advance(self, parameters: Tree, state: Any, kept: tuple[Any, ...]) -> Any:
        """See `ImageEstimator.advance`."""
        return self.inner.advance(parameters, state, kept)

    def _groups(self, asked: int) -> int:
        """As many of the groups asked for as may be; where their number has no such divisor, its smallest one."""
        divisors = [n for n in range(2, asked + 1) if asked % n == 0]
        return max((n for n in divisors if n <= self.groups), default=min(divisors, default=1))

    def _cleaner(self, problem: Problem) -> Callable[[Array], Array]:
        def clean(image: Array) -> Array:
            noisy = arrays.numpy(image)
            if not arrays.all_finite(noisy):
                return image  # for the loop to see
            return problem.renderer.array(denoising.denoise(noisy, by=self.by))

        return clean
