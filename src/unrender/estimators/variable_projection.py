"""Variable projection (Golub and Pereyra 1973): derivatives by few numbers along lines on which eliminated textures follow.

Where a number x and a texture t explain the same residual, a step of one at a fixed other is short. With the change S of the texture per
unit of x, the derivative image of x is J = ∂I/∂x + (∂I/∂t) S. S is best where the texture explains nothing of J, (∂I/∂t)ᵀ W J = 0 with the
second derivatives W of the loss. For a quadratic loss, the minimum by x along such a line is the same for every texture. So the step of x
does not wait for the texture, whose own optimizer moves it. S is found step by step:

    S ← S − γ L⁻¹ (∂I/∂t)ᵀ W J,        L = (∂I/∂t)ᵀ W (∂I/∂t) s / s.

If no pixel darkens as a texel grows, L is no less than the Hessian of the texture for any s > 0, so these steps converge.

Golub and Pereyra, "The Differentiation of Pseudo-Inverses and Nonlinear Least Squares Problems Whose Variables Separate", SIAM Journal
on Numerical Analysis 10(2), 1973.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from unrender.core import arrays, trees
from unrender.core.random import Key
from unrender.core.trees import Tree
from unrender.estimators.capabilities import DerivativeImages
from unrender.rendering.renderer import RenderSession, SampleRequest
from unrender.scene.parameter import Unknown
from unrender.scene.problem import Problem
from unrender.scene.upsampling import Upsampler

IMAGES = 3
"""Number of images that a step renders of each view."""

_LEAST_GAIN = 0.25  # Smallest γ. The first is 1, and the k-th is 1 / k until then.
_CHANGE = 0.05  # change of a texture in both directions for the derivative along s, relative to its root mean square
_UNSEEN = 1e-3
"""Share of the mean of L that is added to it, since noise dominates the slopes of texels that hardly any pixel sees."""
_LAST = 3  # index of the random numbers of the derivative along s


@dataclass(frozen=True)
class Response:
    """Response of the eliminated textures to a change of few numbers: S, {key of a texture: (n, *shape)}, after `count` steps, and the mean
    of L over these, {key: shape}."""

    slopes: dict[str, np.ndarray]
    curvature: dict[str, np.ndarray] = field(default_factory=dict)
    count: int = 0

    @classmethod
    def zero(cls, parameters: Tree, keys: Sequence[str], elements: int) -> Response:
        """Return a response of 0: the textures stay fixed."""
        return cls({key: np.zeros((elements, *arrays.shape(parameters[key])), np.float32) for key in keys})

    def within(self, problem: Problem, parameters: Tree) -> Response:
        """Return the response with texels fixed at their bounds, where a gradient of the loss remains."""
        slopes = {}
        for key, own in self.slopes.items():
            sides = problem.unknowns[key].sides(arrays.numpy(parameters[key]))
            slopes[key] = np.where(sides == 0.0, own, np.float32(0.0))
        return replace(self, slopes=slopes)

    def upsampled(self, upsampler: Upsampler) -> Response:
        """Return a response at the finer resolution, which restarts at 0."""
        shapes = {key: np.empty(upsampler.problem.shapes(upsampler.step)[key]) for key in self.slopes}
        return Response.zero(shapes, tuple(shapes), len(next(iter(self.slopes.values()), ())))


def can_be_eliminated(unknown: Unknown) -> bool:
    """Return whether an unknown has no parameterisation, preconditioner or prior: S is for its own values and the loss alone."""
    return (unknown.transform, unknown.preconditioner, unknown.prior) == (None, None, None)


def update_response(
    response: Response, problem: Problem, parameters: Tree, images: DerivativeImages, spp: int, key: Key
) -> tuple[Response, int]:
    """Return the response after one step, from derivative images J along the present one, and the number of paths traced for images.

    The cost for each view is that of `IMAGES` images, and of an adjoint of `spp` samples for each element and one more. Random numbers are
    independent of those of J.
    """
    session = problem.renderer.prepare(list(parameters), None)
    ends = {key: _ends(arrays.numpy(parameters[key]), problem.unknowns[key].project) for key in response.slopes}
    slopes = {k: np.zeros(x.shape) for k, x in response.slopes.items()}
    curvature = {k: np.zeros(x.shape[1:]) for k, x in response.slopes.items()}
    traced = 0
    for view, (elements, derivatives, weights) in images.views.items():
        request = SampleRequest(problem.views[view].sensor, spp, key.fold(view).uint32())
        paths = session.image(parameters, request).paths
        other = replace(request, seed=key.fold(view).fold(_LAST).uint32())
        along = _directional_derivative(session, parameters, ends, other)
        for index, image in ((None, along), *zip(elements.tolist(), derivatives, strict=True)):
            weighted = arrays.add_first_axis(problem.renderer.array((image * weights).astype(np.float32)))
            gradient = session.adjoint(parameters, paths, weighted)
            for k in slopes:
                own = arrays.numpy(gradient[k]).astype(np.float64)
                if index is None:
                    distance = ends[k][0] - ends[k][1]
                    curvature[k] += np.divide(own, distance, out=np.zeros(own.shape), where=distance > 0.0)
                else:
                    slopes[k][index] += own
        traced += IMAGES * spp * weights.shape[0] * weights.shape[1]
    return _next_response(response, slopes, curvature), traced


def _ends(value: np.ndarray, project: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Return the values of a texture after a change in both directions, within its bounds, (2, *shape). Their difference is s."""
    change = _CHANGE * (float(np.sqrt(np.mean(np.square(value)))) or 1.0)
    return project(np.stack([value + change, value - change])).astype(np.float64)


def _directional_derivative(
    session: RenderSession, parameters: Tree, ends: Mapping[str, np.ndarray], request: SampleRequest
) -> np.ndarray:
    """Return the derivative of the image by the textures along s, (H, W, 3)."""
    fixed = {key: np.broadcast_to(x, (2, *x.shape)) for key, x in trees.numpy(parameters).items()}
    states = {key: ends[key].astype(np.float32) if key in ends else x for key, x in fixed.items()}
    one, other = arrays.numpy(session.image_batch(states, request)).astype(np.float64)
    return one - other


def _next_response(
    response: Response, gradients: Mapping[str, np.ndarray], curvature: Mapping[str, np.ndarray]
) -> Response:
    """Return the response after the step for the gradients (∂I/∂t)ᵀ W J; `response` itself if one of them is not finite."""
    count = response.count + 1
    before = response.curvature or curvature
    mean = {key: (before[key] + (x - before[key]) / count).astype(np.float32) for key, x in curvature.items()}
    gain, slopes = max(1.0 / count, _LEAST_GAIN), {}
    for key, own in response.slopes.items():
        positive = np.maximum(mean[key].astype(np.float64), 0.0)
        scale = positive + _UNSEEN * float(positive.mean())
        change = np.divide(gradients[key], scale, out=np.zeros(own.shape), where=scale > 0.0)
        slopes[key] = (own - gain * change).astype(np.float32)
    finite = all(np.isfinite(x).all() for x in (*slopes.values(), *mean.values()))
    return Response(slopes, mean, count) if finite else response
