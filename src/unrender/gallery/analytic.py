"""Problems without a renderer: `exponential`, the toy problem of Balint et al. 2023, Fig. 2, and `quad`, a polynomial."""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np

from unrender.core.errors import InputError
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.gallery import fields
from unrender.losses import L2, Loss
from unrender.rendering.renderer import ParameterInfo, Rendering, RenderSession, SampleRequest, Space
from unrender.scene.parameter import Parameter
from unrender.scene.problem import Problem
from unrender.scene.references import View

_MEAN, _FIRST_RATE = 2.0, 1.5


@register(name="exponential", position=13)
@dataclass(frozen=True)
class Exponential:
    """The rate of an exponential distribution from its mean: one number, no renderer.

    The mean is 2, the true rate 0.5, the initial rate 1.5.
    """

    loss: Loss = field(default=L2(), metadata=fields.LOSS)

    def problem(self, name: str) -> Problem:
        """Return the problem, with an image of one pixel that contains the mean."""
        return Problem(
            ExponentialRenderer(1 / _MEAN),
            [Parameter(RATE, initial=_FIRST_RATE)],
            [View(np.full((1, 1, 3), _MEAN, np.float32))],
            self.loss,
            truth={RATE: 1 / _MEAN},
            name=name,
        )


_MATRIX = np.array([[5.0, 3.75], [3.75, 5.0]])
_START = (1.5, 1.0)


@register(name="quad", position=14)
@dataclass(frozen=True)
class Quad:
    """The minimum of 5 x₀² + 5 x₁² + 7.5 x₀ x₁, a narrow smooth valley: no renderer, no noise.

    Two unknowns, x (2,). The minimum is 0 at 0, the start is (1.5, 1). With L2, the default, the loss is the polynomial itself. Its
    Hessian has eigenvalues 17.5 and 2.5, along (1, 1) and (1, −1). At this ratio of seven, steepest descent zigzags, whereas Newton's
    method needs one step.
    """

    loss: Loss = field(default=L2(), metadata=fields.LOSS)

    def problem(self, name: str) -> Problem:
        """Return the problem, with a black image of one pixel as reference."""
        return Problem(
            QuadraticRenderer(_MATRIX, np.zeros(2)),
            [Parameter(POINT, initial=np.array(_START))],
            [View(np.zeros((1, 1, 3), np.float32))],
            self.loss,
            truth={POINT: np.zeros(2)},
            name=name,
        )


RATE = "rate"
"""Key of λ, the parameter of `ExponentialRenderer`."""
POINT = "x"
"""Key of x, the parameter of `QuadraticRenderer`."""


class _OnePixel:
    """A renderer of one pixel and one parameter. It is stateless and therefore its own session."""

    key: ClassVar[str]

    def resolutions(self) -> list[tuple[int, int]]:
        return [(1, 1)]

    def array(self, values: np.ndarray) -> np.ndarray:
        return np.array(values, np.float64)

    def prepare(
        self, keys: list[str], space: Space | None, derivatives: bool | AbstractSet[str] = True
    ) -> RenderSession:
        for key in keys:
            if key != self.key:
                raise InputError(f"parameter {key}: the scene has none of that name; it has {self.key}")
        return self  # pyright: ignore[reportReturnType]

    def adjoint(self, parameters: Tree, paths: Any, weights: np.ndarray) -> Tree:
        raise NotImplementedError

    def adjoint_pair(
        self, current: Tree, previous: Tree, paths: Any, weights: np.ndarray, weights_previous: np.ndarray
    ) -> tuple[Tree, Tree]:
        return self.adjoint(current, paths, weights), self.adjoint(previous, paths, weights_previous)


@dataclass(frozen=True)
class ExponentialPaths:
    """Samples of a rendering at λ = 1, (groups, *shape of a picture, samples per group)."""

    unit: np.ndarray


class ExponentialRenderer(_OnePixel):
    """The mean of an exponential distribution: the toy problem of Balint et al. 2023, Fig. 2.

    A sample is x(u; λ) = −log(1 − u) / λ for a uniform u. Its mean is 1/λ, its variance 1/λ², its derivative −x/λ. All
    three channels are equal.

    Args:
        rate: the scene's own λ, > 0.
        lowest: lower limit of λ in an optimisation, > 0.
    """

    key = RATE

    def __init__(self, rate: float = 0.5, lowest: float = 0.05):
        self.rate, self.lowest = rate, lowest

    def parameters(self) -> Mapping[str, ParameterInfo]:
        return {RATE: ParameterInfo((), lowest=self.lowest)}

    def values(self, keys: list[str]) -> Tree:
        return {key: np.array(self.rate) for key in keys}

    def image(self, parameters: Tree, request: SampleRequest) -> Rendering:
        shape = (1, 1) if request.pixels is None else (len(request.pixels),)
        numbers = np.random.default_rng(request.seed).random((request.groups, *shape, request.spp // request.groups))
        paths = ExponentialPaths(-np.log1p(-numbers))
        return Rendering(self._images(parameters, paths), None, paths)

    def image_batch(self, parameters: Tree, request: SampleRequest) -> np.ndarray:
        rendering = self.image(parameters={RATE: 1.0}, request=replace(request, groups=1))
        means = rendering.images[0, 0, 0] / np.reshape(parameters[RATE], (-1, 1))
        return means[:, None, None, :]

    def image_pair(self, current: Tree, previous: Tree, request: SampleRequest, space: Space) -> Rendering:
        """Render two states with the same random numbers, in either space."""
        rendering = self.image(current, request)
        return Rendering(rendering.images, self._images(previous, rendering.paths), rendering.paths)

    def adjoint(self, parameters: Tree, paths: ExponentialPaths, weights: np.ndarray) -> Tree:
        slopes = -self._images(parameters, paths) / float(parameters[RATE])
        return {RATE: np.array((weights * slopes).sum() / len(slopes))}

    def tangent_moment(self, parameters: Tree, paths: ExponentialPaths, tangents: Tree) -> np.ndarray:
        slopes = paths.unit * float(tangents[RATE]) / float(parameters[RATE]) ** 2
        moments = np.repeat(np.mean(slopes**2, axis=-1)[..., None], 3, axis=-1)
        return moments if len(moments) > 1 else moments[0]

    def _images(self, parameters: Tree, paths: ExponentialPaths) -> np.ndarray:
        means = paths.unit.mean(axis=-1) / float(parameters[RATE])
        return np.repeat(means[..., None], 3, axis=-1)


class QuadraticRenderer(_OnePixel):
    """A quadratic form: the L2 loss against a black reference is exactly xᵀ A x.

    The picture is linear. Its channels are J x with Jᵀ J = 3 A, since the loss is the mean over three channels. There is no noise. The
    derivatives of the loss are known in closed form, ∇ = 2 A x and ∇² = 2 A. Smoothing by a Gaussian only adds the constant Σᵢ Aᵢᵢ σᵢ².

    Args:
        matrix: A, (n, n) for n from 1 to 3, symmetric, without negative eigenvalues.
        point: the scene's own x, (n,).

    Raises:
        InputError: the shapes do not match, or the matrix is not symmetric and positive semi-definite.
    """

    key = POINT

    def __init__(self, matrix: np.ndarray, point: np.ndarray):
        self.matrix, self._point = np.array(matrix, np.float64), np.array(point, np.float64)
        n = self._point.size
        if self._point.shape != (n,) or not 1 <= n <= 3 or self.matrix.shape != (n, n):
            raise InputError(
                f"matrix: expected (n, n) and a point (n,), n from 1 to 3, got {self.matrix.shape}, {self._point.shape}"
            )
        values, vectors = np.linalg.eigh(self.matrix)
        if not np.array_equal(self.matrix, self.matrix.T) or values[0] < -1e-9 * abs(values[-1]):
            raise InputError("matrix: must be symmetric and have no eigenvalue below 0")
        # J is the symmetric square root of 3 A, padded with zero rows. The remaining channels are black.
        root = vectors * np.sqrt(3 * np.maximum(values, 0)) @ vectors.T
        self._jacobian = np.concatenate([root, np.zeros((3 - n, n))])

    def parameters(self) -> Mapping[str, ParameterInfo]:
        return {POINT: ParameterInfo(self._point.shape)}

    def values(self, keys: list[str]) -> Tree:
        return {key: self._point.copy() for key in keys}

    def image(self, parameters: Tree, request: SampleRequest) -> Rendering:
        return Rendering(self._images(parameters, request), None, request)

    def image_batch(self, parameters: Tree, request: SampleRequest) -> np.ndarray:
        return (np.asarray(parameters[POINT]) @ self._jacobian.T)[:, None, None, :]

    def image_pair(self, current: Tree, previous: Tree, request: SampleRequest, space: Space) -> Rendering:
        return Rendering(self._images(current, request), self._images(previous, request), request)

    def adjoint(self, parameters: Tree, paths: Any, weights: np.ndarray) -> Tree:
        return {POINT: weights.reshape(len(weights), -1, 3).sum(axis=1).mean(axis=0) @ self._jacobian}

    def tangent_moment(self, parameters: Tree, paths: SampleRequest, tangents: Tree) -> np.ndarray:
        moments = self._images(tangents, paths) ** 2
        return moments if paths.groups > 1 else moments[0]

    def _images(self, parameters: Tree, request: SampleRequest) -> np.ndarray:
        shape = (1, 1) if request.pixels is None else (len(request.pixels),)
        pixel = self._jacobian @ np.asarray(parameters[POINT])
        return np.broadcast_to(pixel, (request.groups, *shape, 3)).copy()
