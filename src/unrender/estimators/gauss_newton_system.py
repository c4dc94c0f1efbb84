"""Images and derivative images of a problem at one point, and the sums over them of a Gauss-Newton step."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from unrender.core import arrays, trees
from unrender.core.arrays import Array
from unrender.core.random import Key
from unrender.core.trees import Tree
from unrender.estimators.derivative_images import (
    MOST_AVERAGED,
    HalvedImage,
    HalvesMean,
    LossWeights,
    Products,
    differences,
    directions,
    mean_residuals,
    noise_weights,
    products,
    running_mean,
    secant_products,
    squared_slope,
)
from unrender.estimators.gradient_sum import smoothed_variance
from unrender.rendering.renderer import RenderSession, SampleRequest
from unrender.scene.problem import Problem
from unrender.statistics.scores import positive_inverse

if TYPE_CHECKING:
    from unrender.estimators.gauss_newton import GaussNewton, GaussNewtonState

_OF_RANGE = 0.125  # largest width relative to the range between a parameter's bounds
_LEAST_RESIDUAL = 1e-6  # relative residual below which single precision has no sign of it
_IMAGE = 2  # Stream of a view's key for the image. Lower streams are for the two halves of the derivative images.


@dataclass
class System:
    """Sums over all views, for n elements.

    Attributes:
        products: products of derivative images.
        slopes: squared differences of neighbouring pixels, summed over the views that the element changes, (n,).
        weighted: derivative images by view, see `DerivativeImages`; {} unless `GaussNewton.derivative_images`.
        variances: running mean of the variance of each view's image.
        derivatives: mean derivative images of each view.
        residuals: mean derivatives of the loss of each view.
        pictures: mean image of each view; [] for losses whose derivative is linear.
        latest: image of each view; [] without scores.
        secant: sums of `secant_products` since the state's anchor.
        fresh: whether there are new derivative images.
    """

    products: Products
    slopes: np.ndarray
    fresh: bool = True
    loss: float = 0.0
    images: dict[int, Array] = field(default_factory=dict)
    weighted: dict[int, tuple[np.ndarray, np.ndarray, np.ndarray]] = field(default_factory=dict)
    variances: list[np.ndarray] = field(default_factory=list)
    derivatives: list[HalvesMean] = field(default_factory=list)
    residuals: list[HalvesMean] = field(default_factory=list)
    pictures: list[HalvesMean] = field(default_factory=list)
    latest: list[HalvesMean] = field(default_factory=list)
    secant: np.ndarray = field(default_factory=lambda: np.zeros(3))

    def is_finite(self) -> bool:
        """Return whether all sums are finite."""
        return all(np.isfinite(x).all() for x in (*vars(self.products).values(), self.slopes))


class Point:
    """Images and derivative images of a problem at its parameters, with the paths traced so far, and the largest width of each parameter,
    infinite if there is none."""

    def __init__(self, options: GaussNewton, problem: Problem, parameters: Tree):
        self.options, self.problem, self.parameters = options, problem, parameters
        self.session: RenderSession = problem.renderer.prepare(list(parameters), None, derivatives=False)
        self.theta = trees.ravel(parameters)
        self.samples = 0
        self.scores = options.scores and problem.pixels <= MOST_AVERAGED
        ranges = {key: (unknown.bounds[0], unknown.bounds[1]) for key, unknown in problem.unknowns.items()}
        self.largest = {
            key: min(
                options.largest.get(key, math.inf),
                math.inf if low is None or high is None else _OF_RANGE * (high - low),
            )
            for key, (low, high) in ranges.items()
        }
        known = problem.renderer.parameters()
        sensors = {key: -1 if known[key].sensor is None else known[key].sensor for key in parameters}
        # No picture depends on the length of a direction, which says nothing of its own error.
        edges = {
            key: (info.rigid or info.nonlinear) and not info.scattering and info.role not in ("direction", "ratios")
            for key, info in known.items()
        }
        self._edges = trees.repeat_per_element(edges, parameters) > 0.0
        self._sensors = trees.repeat_per_element(sensors, parameters)  # pyright: ignore[reportArgumentType]

    def since(self, before: np.ndarray | None, state: GaussNewtonState) -> tuple[np.ndarray, float]:
        """Return the step since a point, (n,), and its length in units of the widths."""
        step = np.zeros_like(self.theta) if before is None else self.theta - before
        widths = trees.repeat_per_element(state.widths, self.parameters)
        return step, float(np.max(np.abs(step) / widths, initial=0.0))

    def system(
        self, state: GaussNewtonState, key: Key, step: np.ndarray | None = None, moved: float = 0.0, fresh: bool = True
    ) -> System:
        """Return gradient and Hessian for the state's widths, after a step (n,) of length `moved` in units of the widths. Without a step,
        only compute the quantities that the next widths need.

        With `fresh`, there are new derivative images; otherwise only the mean of earlier ones.
        """
        total = System(Products.zero(self.theta.size), np.zeros(self.theta.size), fresh)
        steps = trees.repeat_per_element(state.widths, self.parameters)
        inverse = None if state.hessian is None else positive_inverse(state.hessian)
        for view, sensor_view in enumerate(self.problem.views):
            elements = np.flatnonzero((self._sensors == -1) | (self._sensors == sensor_view.sensor))
            seed = key.fold(view)
            images = self._images(view, seed) if step is not None else None
            if images:
                total.images[view] = images.mean
                total.loss += arrays.number(self.problem.loss_value(view, images.mean))
            weights = self._noise_weighted(view, images, state, total, moved) if images else None
            if not elements.size:
                continue
            averaged = images is not None and self.options.remember
            mean = self._mean_derivatives(view, elements, steps, seed, state, total, averaged)
            if weights is not None and self.options.derivative_images:
                total.weighted[view] = (elements, 0.5 * (mean.one + mean.other), weights.second)
            residuals = None
            if self.scores and weights is not None and step is not None:
                before = state.residuals[len(total.residuals)] if state.residuals else None
                residuals = mean_residuals(before, weights, mean, step[elements], moved)
                total.residuals.append(residuals)
            if self.scores and images and weights is not None:
                one, other = (arrays.numpy(x).astype(np.float32) for x in (images.one, images.other))
                latest = HalvesMean(one, other)
                if state.anchor:
                    change = (self.theta - state.anchor_point)[elements]
                    before = state.anchor[len(total.latest)]
                    total.secant += secant_products(before, latest, mean, change, weights.second)
                total.latest.append(latest)
            own = None if inverse is None else inverse[np.ix_(elements, elements)]
            parts = [mean.one, mean.other], weights, residuals, int(state.shift), self.options.remember, own
            total.products.add(products(*parts), elements)
        return total

    def _mean_derivatives(
        self,
        view: int,
        elements: np.ndarray,
        steps: np.ndarray,
        key: Key,
        state: GaussNewtonState,
        total: System,
        averaged: bool,
    ) -> HalvesMean:
        """Return the derivative images of a view, in a mean with those of earlier steps if `averaged`."""
        known = averaged and state.derivatives and not state.narrowed
        before = state.derivatives[len(total.derivatives)] if known else None
        if before is not None and not total.fresh:
            mean = before
        else:
            points, moves = self._points(elements, self._offsets(elements, steps, state.hessian))
            halves = [self._states(points, view, key.fold(half), self.options.derivative_spp) for half in (0, 1)]
            total.slopes[elements] += squared_slope(halves)
            mean = HalvesMean(differences(halves[0], moves), differences(halves[1], moves))
            mean = before.and_one(mean, self.since(state.origin, state)[1]) if before else mean
        if averaged:
            total.derivatives.append(mean)
        return mean

    def _noise_weighted(
        self, view: int, images: HalvedImage, state: GaussNewtonState, total: System, moved: float
    ) -> LossWeights:
        """Return the derivatives of the loss with the weights of the noise, and add the image's variance to `total`.

        The weights are of earlier images only. A bright outlier has a large residual and a large variance, so weights by this image's
        variance would shift the solution to darker images.
        """
        weights, limit = self._weights(view, images, state, total, moved), self.options.noise_limit
        if limit is None:
            return weights
        total.variances.append(
            running_mean(state.variances, view, arrays.numpy(images.variance), self.options.by_channel)
        )
        return weights.times(noise_weights(state.variances[view], limit)) if state.variances else weights

    def _offsets(self, elements: np.ndarray, steps: np.ndarray, hessian: np.ndarray | None) -> np.ndarray:
        """Return the rows by which differences move elements, (m, m): `steps` (n,) of one, or weak directions of those that move edges.

        Where pictures are smooth, differences by single elements have no error that sums of them show.
        """
        rows, edges = np.diag(steps[elements]), self._edges[elements]
        if hessian is not None and edges.any():
            moved, limits = elements[edges], trees.repeat_per_element(self.largest, self.parameters)
            rows[np.ix_(edges, edges)] = directions(hessian[np.ix_(moved, moved)], steps[moved], limits[moved])
        return rows

    def _points(self, elements: np.ndarray, offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the parameters plus, then minus, each row of the offsets of some elements (m, m), within bounds, (2 m, n), and the
        differences of the elements between both, (m, m)."""
        unknowns = self.problem.unknowns
        both = np.zeros((2, elements.size, self.theta.size))
        both[0, :, elements], both[1, :, elements] = offsets.T, -offsets.T
        states = trees.parts(self.theta + both, self.parameters)
        inside = [unknowns[key].project(x).reshape(*x.shape[:2], -1) for key, x in states.items()]
        points = np.concatenate(inside, axis=-1).astype(np.float32).astype(np.float64)
        moves = (points[0] - points[1])[:, elements]
        return points.reshape(-1, self.theta.size), moves

    def _states(self, points: np.ndarray, view: int, key: Key, spp: int) -> np.ndarray:
        """Render images (B, H, W, 3) at points (B, n) with half of the samples, all with the same random numbers."""
        request = SampleRequest(self.problem.views[view].sensor, spp // 2, key.uint32(), stratified=True)
        stacked = {key: x.astype(np.float32) for key, x in trees.parts(points, self.parameters).items()}
        for name, x in stacked.items():
            if (x == x[:1]).all():  # shared by all, see `RenderSession.image_batch`
                stacked[name] = np.broadcast_to(x[0], x.shape)
        images = arrays.numpy(self.session.image_batch(stacked, request))
        self.samples += images.shape[0] * images.shape[1] * images.shape[2] * request.spp
        return images

    def _images(self, view: int, key: Key) -> HalvedImage:
        halves = [self._states(self.theta[None], view, key.fold(_IMAGE + half), self.options.spp)[0] for half in (0, 1)]
        array = self.problem.renderer.array
        mean, variance = 0.5 * (halves[0] + halves[1]), 0.25 * np.square(halves[0] - halves[1])
        return HalvedImage(array(mean), array(variance), array(halves[0]), array(halves[1]))

    def _weights(
        self, view: int, images: HalvedImage, state: GaussNewtonState, total: System, moved: float
    ) -> LossWeights:
        """Return ℓ' and ℓ'' at the image, and ℓ' at its halves, (H, W, 3) each, and add the image to the mean in `total`."""
        problem, image = self.problem, images.mean
        if problem.loss.linear:
            derivative = problem.loss_derivative(view, image)
            second = problem.loss_derivative(view, image + 1.0) - derivative
            halves = (problem.loss_derivative(view, half) for half in (images.one, images.other))
            return LossWeights(*map(arrays.numpy, (derivative, second, *halves)))
        mean, one, other = (arrays.numpy(x) for x in (image, images.one, images.other))
        new = HalvesMean(one, other)
        earlier = state.pictures[view] if state.pictures else new
        total.pictures.append(earlier.and_one(new, moved) if state.pictures else new)
        secant, reference = self._secant(view, earlier), arrays.numpy(problem.reference(view))
        return LossWeights(*(secant * x for x in (mean - reference, 1.0, one - reference, other - reference)))

    def _secant(self, view: int, earlier: HalvesMean) -> np.ndarray:
        """Return ℓ'(s) / s at s² = r² + κ² σ², (H, W, 3), with the residual r of the mean of earlier images and the variance σ² of one.

        The halves' product has no squared noise. s has the sign of r, since losses such as `Censored` are one-sided.
        """
        array, reference = self.problem.renderer.array, arrays.numpy(self.problem.reference(view))
        variance = array(0.25 * earlier.count * np.square(earlier.one - earlier.other))
        square = np.maximum((earlier.one - reference) * (earlier.other - reference), 0.0)
        square += self.options.tolerance**2 * arrays.numpy(smoothed_variance(variance))
        sign = np.where(earlier.one + earlier.other < 2.0 * reference, np.float32(-1.0), np.float32(1.0))
        residual = sign * np.sqrt(square + np.square(_LEAST_RESIDUAL * (1.0 + np.abs(reference))))
        return arrays.numpy(self.problem.loss_derivative(view, array(reference + residual))) / residual
