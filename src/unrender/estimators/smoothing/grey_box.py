"""A black box behind a PyTorch network: PyTorch's chain rule, of first and second order, with sampled derivatives of the black box only
(Wang et al., section 4, "CNN"; their supplement calls it the grey box).

    poses = network(pictures)  # (K, n)
    losses = ur.grey_box.loss(f, poses, sigma=0.1, samples=32)  # (K,), of f(points, items) -> values
    losses.mean().backward()

Let φ(w) be the network's output and f a function that is only evaluated (a render and its distance to a reference). The derivatives of
S f(φ(w)) are

    gradient                Jᵀ g
    Hessian times v         Jᵀ H J v + Σₖ gₖ (∇² φₖ) v

where J, its products, and ∇² φₖ v are the network's and exact. `unrender.smoothed` estimates g = ∇ S f(φ) and H (J v) = ∇² S f(φ) (J v)
in the few dimensions of φ. No matrix of n × n, or of weights × weights, is formed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from unrender.core import checks, conjugate_gradients
from unrender.core.errors import InputError
from unrender.core.random import Key
from unrender.estimators.smoothing.function import JointDerivatives, estimate_gradient, estimate_hvp, joint
from unrender.estimators.smoothing.sampling import Function, SamplingOptions, numbers

# PyTorch is an optional dependency, and absent if types are checked without the extra.
try:
    import torch  # pyright: ignore[reportMissingImports]
except ImportError as error:
    raise InputError(f"unrender.grey_box needs PyTorch ({error}): pip install torch") from error

__all__ = ["loss", "newton_cg_step"]

_Call = Callable[[Function], Any]


def loss(
    f: Callable[..., Any],
    phi: torch.Tensor,
    sigma: Any,
    samples: int,
    seed: int = 0,
    aggregate: bool = True,
    antithetic: bool = True,
    baseline: bool = True,
    low_discrepancy: bool = False,
    epsilon: float = 0.1,
    joint: bool = False,
) -> torch.Tensor:
    """Return f(φ), with the derivatives of S f(φ), twice differentiable by PyTorch.

    The value is f at φ itself, not smoothed: it costs one evaluation, adds no noise, and measures the quality of φ. Finite differences
    of the value therefore differ from the derivatives. These are unbiased for ∇ S f; products with ∇² S f have the bias of their
    central difference (`smoothed.hvp`).

    The first order is estimated immediately, in the one call of f that also gives the value, if φ requires a gradient and gradients are
    enabled. Every product with the Hessian is one further call. All use the same samples, so the products of conjugate gradients are
    consistent with each other and with the gradient; items have independent samples. If f is noisy itself, use the same random numbers
    in every call of a step.

    Args:
        f: the black box. For φ of (n,): points (B, n) to values (B,), in NumPy. For φ of (K, n), one row for each item of a batch:
            f(points, items), where items (B,) are the rows of φ that the points (B, n) belong to, in [0, K), so that each may have its
            own reference.
        phi: (n,) or (K, n), finite, of any floating-point type, on any device; f is called on the thread that requests the derivative.
        sigma: standard deviation of the smoothing, > 0: a number, or (n,).
        samples: evaluations of f per item for the gradient, >= 4 (>= 16 with `low_discrepancy`); a product takes twice as many. Without
            `aggregate`, for each of the n elements.
        seed: random seed of the perturbations; use a new one for each step.
        aggregate, antithetic, baseline, low_discrepancy, epsilon: see `smoothed.gradient` and `smoothed.hvp`.
        joint: gradient and products from the same evaluations (`smoothed.joint`): products need no call of f and have no bias, and
            `aggregate`, `antithetic`, `baseline` and `epsilon` have no effect.

    Returns:
        () for φ of (n,), (K,) for (K, n), of φ's type and on its device.

    Raises:
        InputError: σ not positive, shapes that do not match, φ or values of f that are not finite. For products, it is raised from
            PyTorch's `grad`.
    """
    if not isinstance(phi, torch.Tensor) or not phi.is_floating_point() or phi.ndim not in (1, 2) or phi.numel() == 0:
        actual = f"{phi.dtype} {tuple(phi.shape)}" if isinstance(phi, torch.Tensor) else type(phi).__name__
        raise InputError(f"grey_box.loss: phi must be a floating-point tensor (n,) or (K, n), got {actual}")
    if not torch.isfinite(phi).all():
        raise InputError("grey_box.loss: phi has elements that are not finite: the network before it has diverged")
    options = SamplingOptions(samples, seed, aggregate, antithetic, baseline, low_discrepancy, epsilon=epsilon)
    box = _BlackBox(f, phi.ndim == 2, sigma, options, joint)
    # Move to the host first: PyTorch then calls f on the calling thread.
    rows = torch.atleast_2d(phi).to("cpu", torch.float64)
    if torch.is_grad_enabled() and phi.requires_grad:
        values = _Loss.apply(rows, box)
    else:
        values = torch.from_numpy(box.values(rows.detach().numpy()))
    return values.reshape(phi.shape[:-1]).to(phi)


def newton_cg_step(
    loss_fn: Callable[[], torch.Tensor],
    parameters: Iterable[torch.Tensor],
    trust_radius: float = 0.1,
    iterations: int = 4,
    optimizer: torch.optim.Optimizer | None = None,
    scales: Sequence[torch.Tensor] | None = None,
) -> float:
    """Update a network's weights in place by one Newton step with conjugate gradients; see `optimizers.NewtonCG` (Eqs 4 to 7).

    It needs a few vectors of the weights' size in addition to what PyTorch stores for the loss. A step takes at most `iterations` products.

    Args:
        loss_fn: the loss, a scalar tensor that PyTorch can differentiate twice, such as the mean of `loss`; called once.
        parameters: the weights; those that require no gradient do not change.
        trust_radius: maximum step length, Euclidean over all weights, > 0.
        iterations: maximum number of products with the Hessian, >= 1.
        optimizer: a PyTorch optimizer of the same weights, such as `torch.optim.Adam`, which receives the negative step as its gradient;
            None to apply the step itself.
        scales: for each weight that requires a gradient a tensor of its shape, > 0: directions, and the trust radius, refer to the weights
            over their scales. With the fourth root of 1 / v, where v is Adam's mean square of the gradient, the first direction is Adam's.

    Returns:
        The loss before the step.

    Raises:
        InputError: a loss that is not a scalar or does not depend on the weights, derivatives that are not finite, options out of range.
    """
    checks.number("NewtonCG", "trust_radius", trust_radius, above=0.0)
    checks.integer("NewtonCG", "iterations", iterations, at_least=1)
    weights = [weight for weight in parameters if weight.requires_grad]
    value = loss_fn()
    if not isinstance(value, torch.Tensor) or value.ndim != 0:
        got = tuple(value.shape) if isinstance(value, torch.Tensor) else type(value).__name__
        raise InputError(f"grey_box.newton_cg_step: loss_fn must return a scalar tensor, say a mean, got {got}")
    if not weights or not value.requires_grad:
        raise InputError("grey_box.newton_cg_step: the loss depends on no weight that requires a gradient")
    scale = _scale(scales, weights)
    gradient = _ravel(torch.autograd.grad(value, weights, create_graph=True, materialize_grads=True))
    _check_finite("gradient", gradient)

    def product(v: np.ndarray) -> np.ndarray:
        if not gradient.requires_grad:  # the loss is linear in the weights
            return np.zeros(gradient.numel())
        direction = torch.from_numpy(scale * v)
        result = _ravel(torch.autograd.grad(gradient, weights, direction, retain_graph=True, materialize_grads=True))
        _check_finite("product with the Hessian", result)
        return scale * result.numpy()

    step = conjugate_gradients.solve(scale * gradient.detach().numpy(), product, trust_radius, iterations)
    _apply_step(torch.from_numpy(scale * step), weights, optimizer)
    return value.item()


def _scale(scales: Sequence[torch.Tensor] | None, weights: Sequence[torch.Tensor]) -> np.ndarray:
    """Return all scales in one vector, or ones. Raise `InputError` if shapes differ from the weights', or scales are not positive."""
    if scales is None:
        return np.ones(sum(weight.numel() for weight in weights))
    if [tuple(scale.shape) for scale in scales] != [tuple(weight.shape) for weight in weights]:
        raise InputError("grey_box.newton_cg_step: scales must have the shapes of the weights that require a gradient")
    vector = _ravel([scale.detach() for scale in scales]).numpy()
    if not (np.isfinite(vector) & (vector > 0.0)).all():
        raise InputError("grey_box.newton_cg_step: scales must be finite and above 0")
    return vector


def _apply_step(step: torch.Tensor, weights: Sequence[torch.Tensor], optimizer: torch.optim.Optimizer | None) -> None:
    with torch.no_grad():
        for weight, part in zip(weights, step.split([w.numel() for w in weights]), strict=True):
            move = part.reshape(weight.shape).to(weight)
            if optimizer is None:
                weight += move
            else:
                weight.grad = -move
    if optimizer is not None:
        optimizer.step()
        optimizer.zero_grad()


def _ravel(tensors: Sequence[torch.Tensor]) -> torch.Tensor:
    return torch.cat([x.reshape(-1).to("cpu", torch.float64) for x in tensors])


def _check_finite(name: str, vector: torch.Tensor) -> None:
    if not torch.isfinite(vector).all():
        raise InputError(f"grey_box.newton_cg_step: the {name} is not finite: the weights have diverged")


@dataclass(frozen=True)
class _BlackBox:
    """f and its smoothing options: values (K,), gradients (K, n) and Hessian-vector products (K, n) of K items, each by one call of f."""

    f: Callable[..., Any]
    batched: bool
    sigma: Any
    options: SamplingOptions
    joint: bool = False
    derivatives: list[JointDerivatives] = field(default_factory=list)
    """Derivatives of each item from the last `first_order`; [] without `joint`."""

    def values(self, phi: np.ndarray) -> np.ndarray:
        return self._evaluate(phi, np.arange(len(phi)))

    def first_order(self, phi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if self.joint:
            return self._joint_first_order(phi)

        def call(item: int) -> _Call:
            def value_and_gradient(f: Function) -> tuple[float, np.ndarray]:
                gradient, _ = estimate_gradient(f, phi[item], self.sigma, self._item_options(item))
                return f(phi[item][None])[0], gradient

            return value_and_gradient

        values, gradients = zip(*self._batched_calls([call(item) for item in range(len(phi))]), strict=True)
        return np.array(values), np.array(gradients)

    def _joint_first_order(self, phi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        def call(item: int) -> _Call:
            options = self._item_options(item)
            point = (phi[item], self.sigma, options.samples, options.seed, options.low_discrepancy)
            return lambda f: joint(f, *point)

        self.derivatives[:] = self._batched_calls([call(item) for item in range(len(phi))])
        return np.array([one.value for one in self.derivatives]), np.array(
            [one.gradient()[0] for one in self.derivatives]
        )

    def product(self, phi: np.ndarray, v: np.ndarray) -> np.ndarray:
        if self.joint:
            return np.array([one.hvp(direction)[0] for one, direction in zip(self.derivatives, v, strict=True)])

        def call(item: int) -> _Call:
            # Twice the samples, so that each side of the difference has the same samples as the gradient.
            options = replace(self._item_options(item), samples=2 * self.options.samples)
            return lambda f: estimate_hvp(f, phi[item], v[item], self.sigma, options)[0]

        return np.array(self._batched_calls([call(item) for item in range(len(phi))]))

    def _item_options(self, item: int) -> SamplingOptions:
        return replace(self.options, seed=Key(self.options.seed).fold(item).uint32())

    def _batched_calls(self, calls: Sequence[_Call]) -> list[Any]:
        """Return the result of each item's call, with all their evaluations in one call of f.

        The points of an estimator depend on its samples, not on values. Each call therefore runs twice: to record the points, and with
        the values. This is cheap relative to rendering, which is faster in one batch.
        """
        recorded: list[list[np.ndarray]] = []
        for call in calls:
            points: list[np.ndarray] = []

            def record(x: np.ndarray, points: list[np.ndarray] = points) -> np.ndarray:
                points.append(x)
                return np.zeros(len(x))

            call(record)
            recorded.append(points)
        parts = [(item, x) for item, points in enumerate(recorded) for x in points]
        answers = iter(())
        if parts:  # there are none if v is zero
            items = np.repeat([item for item, _ in parts], [len(x) for _, x in parts])
            values = self._evaluate(np.concatenate([x for _, x in parts]), items)
            answers = iter(np.split(values, np.cumsum([len(x) for _, x in parts])[:-1]))
        return [call(lambda _: next(answers)) for call in calls]

    def _evaluate(self, points: np.ndarray, items: np.ndarray) -> np.ndarray:
        results = self.f(points, items) if self.batched else self.f(points)
        values = numbers(results, "grey_box.loss: f must return numbers")
        if values.shape != (len(points),):
            raise InputError(
                f"grey_box.loss: f must return shape ({len(points)},) for {points.shape}, got {values.shape}"
            )
        finite = np.isfinite(values)
        lost = np.setdiff1d(items, items[finite])  # `SmoothedFunction` drops non-finite values of the other items
        if lost.size:
            place = np.array2string(points[items == lost[0]][0], threshold=8, precision=4)
            raise InputError(f"grey_box.loss: f is not finite at {place}" + f", item {lost[0]}" * self.batched)
        return values


class _Loss(torch.autograd.Function):
    """Autograd function from φ (K, n) to f(φ) (K,)."""

    @staticmethod
    def forward(ctx: Any, phi: torch.Tensor, box: _BlackBox) -> torch.Tensor:
        values, gradient = box.first_order(phi.detach().numpy())
        ctx.box = box
        ctx.save_for_backward(phi, torch.from_numpy(gradient))
        return torch.from_numpy(values)

    @staticmethod
    def backward(ctx: Any, weight: torch.Tensor) -> tuple[torch.Tensor, None]:
        phi, gradient = ctx.saved_tensors
        return weight[:, None] * _Gradient.apply(phi, gradient, ctx.box), None


class _Gradient(torch.autograd.Function):
    """Autograd function from φ (K, n) to its estimated ∇ S f(φ) (K, n). Its derivative is the symmetric Hessian: Hᵀ v = H v."""

    @staticmethod
    def forward(ctx: Any, phi: torch.Tensor, gradient: torch.Tensor, box: _BlackBox) -> torch.Tensor:
        ctx.box = box
        ctx.save_for_backward(phi)
        return gradient.clone()

    @staticmethod
    def backward(ctx: Any, v: torch.Tensor) -> tuple[torch.Tensor, None, None]:
        (phi,) = ctx.saved_tensors
        return _Product.apply(phi, v, ctx.box), None, None


class _Product(torch.autograd.Function):
    """Autograd function from φ and v (K, n) to ∇² S f(φ) v (K, n). Its derivative is an error instead of zero."""

    @staticmethod
    def forward(ctx: Any, phi: torch.Tensor, v: torch.Tensor, box: _BlackBox) -> torch.Tensor:
        return torch.from_numpy(box.product(phi.detach().numpy(), v.detach().numpy()))

    @staticmethod
    def backward(ctx: Any, *_: Any) -> Any:
        raise InputError("grey_box.loss: there are no derivatives of third order")
