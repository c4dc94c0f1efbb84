"""Image estimator that denoises another estimator's image."""

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
from unrender.images.base import ImageEstimate, ImageEstimator, PairRequest, needs_whole_views
from unrender.images.denoising import Denoiser
from unrender.images.plain import Plain
from unrender.rendering.renderer import Space
from unrender.scene.batches import Frame, PixelSample
from unrender.scene.problem import Problem


@register
@dataclass(frozen=True)
class Denoised:
    """The image of another estimator, denoised before the loss is evaluated. Biased.

    A denoiser trades variance for a systematic error that no number of steps averages out. The optimisation converges to parameters whose
    *denoised* image matches the reference, which are at best near the truth. Use it if the loss derivative is nonlinear and the image so
    noisy that the bias from noise is larger, and for previews. A control variate in `inner` applies to the image before denoising.

    Image and adjoint stay independent: for each sample group the image of all *other* groups is denoised separately, so no adjoint is
    weighted by an image of its own samples. Each is a call of the denoiser, so fewer groups are used than elsewhere.

    Denoisers need independent noise per pixel. Pixels here do not share samples; otherwise a denoiser takes correlated noise for texture.

    Args:
        inner: image estimator, `images.Plain()` or `images.RecursiveControlVariate()`.
        by: the denoiser: "auto" (OptiX on a GPU, else OIDN: `pip install 'unrender[denoise]'`), "oidn", "optix" or "variation".
        groups: number of sample groups, >= 2: the largest divisor of the estimator's own number that is at most this, else its smallest
            divisor above 1. Each group needs a call of the denoiser in addition to the full image; more groups have less noisy images.

    Raises:
        InputError: at construction, a value out of range; from `init`, a denoiser that is not available.
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
        """The space of `inner`."""
        return self.inner.space

    @property
    def pixelwise(self) -> bool:
        """False, because a denoiser needs the neighbours of a pixel."""
        return False

    def init(self, problem: Problem, parameters: Tree) -> Any:
        """Return the state of `inner`. Raises `InputError` if the denoiser is not available."""
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
        estimate, contribution = self.inner.estimate(
            problem, parameters, state, frame, spp, self._groups(groups), key, pair_request
        )
        return replace(estimate, filter=self._filter(problem), variance=None), contribution

    needs_whole_views = needs_whole_views

    def needs_full_views(self, parameters: Tree, state: Any, batches: int) -> bool:
        """Return True."""
        del parameters, state, batches
        return True

    def prepare(self, problem: Problem, state: Any) -> Any:
        del problem
        return state

    def learn(self, problem: Problem, state: Any, sample: PixelSample, contribution: Any) -> Any:
        del problem, sample, contribution
        return state

    def advance(self, parameters: Tree, state: Any, contributions: tuple[Any, ...]) -> Any:
        return self.inner.advance(parameters, state, contributions)

    def _groups(self, requested: int) -> int:
        """Return the largest divisor of `requested` that is at most `groups`, else its smallest divisor above 1."""
        divisors = [n for n in range(2, requested + 1) if requested % n == 0]
        return max((n for n in divisors if n <= self.groups), default=min(divisors, default=1))

    def _filter(self, problem: Problem) -> Callable[[Array], Array]:
        def denoise(image: Array) -> Array:
            noisy = arrays.numpy(image)
            if not arrays.all_finite(noisy):
                return image  # the loop then skips the step
            return problem.renderer.array(denoising.denoise(noisy, by=self.by))

        return denoise
