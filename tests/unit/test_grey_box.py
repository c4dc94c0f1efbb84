"""A black box behind a PyTorch network: shapes, errors, how often the black box is evaluated, the step of Newton-CG.

Its derivatives are held to closed forms in `tests/statistical/test_grey_box_chain_rule.py`.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import unrender as ur
from unrender.core.random import Key


def paraboloid(x: np.ndarray) -> np.ndarray:
    """Of Hessian 2 in every direction, at every smoothing."""
    return np.sum((x - 0.5) ** 2, axis=1)


def paraboloids(x: np.ndarray, items: np.ndarray) -> np.ndarray:
    return paraboloid(x) + items


class Counted:
    """f, and how many points each of its calls evaluated."""

    def __init__(self, f: Callable[..., np.ndarray]):
        self.f = f
        self.calls: list[int] = []

    def __call__(self, *arguments: np.ndarray) -> np.ndarray:
        self.calls.append(len(arguments[0]))
        return self.f(*arguments)


def test_without_pytorch_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    _ = ur.smoothed  # what grey_box imports before: SciPy looks for PyTorch in sys.modules
    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.delitem(sys.modules, "unrender.estimators.smoothing.grey_box", raising=False)
    monkeypatch.delitem(vars(ur), "grey_box", raising=False)
    with pytest.raises(ur.InputError, match=r"grey_box needs PyTorch .*: pip install torch$"):
        _ = ur.grey_box
    assert "grey_box" not in ur.__all__  # or `from unrender import *` would fail


@pytest.fixture
def torch() -> Any:
    """PyTorch is an extra, of gigabytes on some systems, which `make test` does not install."""
    return pytest.importorskip("torch")


@pytest.fixture
def loss(torch: Any) -> Callable[..., Any]:
    return ur.grey_box.loss


def test_one_point_gives_its_value_and_the_smoothed_gradient(torch: Any, loss: Any) -> None:
    phi = torch.tensor([0.1, 0.2, 0.3], requires_grad=True)
    value = loss(paraboloid, phi, [0.1, 0.2, 0.3], 64, seed=7, antithetic=False)
    value.backward()
    assert value.shape == ()
    assert value.dtype == phi.dtype
    points = phi.detach().double().numpy()
    assert value.item() == pytest.approx(paraboloid(points[None])[0])
    expected, _ = ur.smoothed.gradient(
        paraboloid, points, [0.1, 0.2, 0.3], 64, Key(7).fold(0).uint32(), antithetic=False
    )
    np.testing.assert_allclose(phi.grad.numpy(), expected, rtol=1e-6)


def test_a_batch_gives_a_value_for_each_item(torch: Any, loss: Any) -> None:
    phi = torch.rand(5, 3, dtype=torch.float64, requires_grad=True)
    values = loss(paraboloids, phi, 0.1, 16)
    assert values.shape == (5,)
    np.testing.assert_allclose(values.detach(), paraboloids(phi.detach().numpy(), np.arange(5)))
    with torch.no_grad():
        assert torch.equal(loss(paraboloids, phi, 0.1, 16), values)


def test_each_order_is_one_call_of_the_black_box(torch: Any, loss: Any) -> None:
    f = Counted(paraboloids)
    phi = torch.rand(5, 3, requires_grad=True)
    total = loss(f, phi, 0.1, 16).sum()
    (gradient,) = torch.autograd.grad(total, phi, create_graph=True)
    assert f.calls == [5 * (1 + 16)]
    v = torch.ones(5, 3)
    v[2] = 0
    (product,) = torch.autograd.grad(gradient, phi, v, retain_graph=True)
    assert f.calls[1:] == [4 * 2 * 16]  # nothing is to be known of the third item
    assert (product[2] == 0).all()
    torch.autograd.grad(gradient, phi, torch.zeros(5, 3))
    assert len(f.calls) == 2
    with torch.no_grad():
        loss(f, phi, 0.1, 16)
    assert f.calls[2:] == [5]


def test_joint_products_cost_no_call_of_the_black_box(torch: Any, loss: Any) -> None:
    f = Counted(paraboloids)
    phi = torch.rand(5, 3, dtype=torch.float64, requires_grad=True)
    values = loss(f, phi, 0.1, 64, joint=True)
    np.testing.assert_allclose(values.detach().numpy(), paraboloids(phi.detach().numpy(), np.arange(5)))
    (gradient,) = torch.autograd.grad(values.sum(), phi, create_graph=True)
    basis = [torch.autograd.grad(gradient, phi, v.expand(5, 3), retain_graph=True)[0].numpy() for v in torch.eye(3)]
    assert f.calls == [5 * (1 + 64)]
    hessians = np.stack(basis, axis=1)
    np.testing.assert_allclose(hessians, hessians.transpose(0, 2, 1), atol=1e-9)
    assert np.abs(hessians.mean(axis=0) - 2 * np.eye(3)).max() < 1.0


def test_first_and_second_order_take_the_same_draws_and_equal_seeds_repeat_them(torch: Any, loss: Any) -> None:
    seen: list[np.ndarray] = []

    def watched(x: np.ndarray) -> np.ndarray:
        seen.append(x)
        return paraboloid(x)

    phi = torch.zeros(2, dtype=torch.float64, requires_grad=True)
    for seed in (3, 3, 4):
        (gradient,) = torch.autograd.grad(loss(watched, phi, 1.0, 8, seed=seed), phi, create_graph=True)
        torch.autograd.grad(gradient, phi, torch.tensor([1.0, 0.0], dtype=torch.float64))
    first, second = seen[:2]
    np.testing.assert_allclose(second[:8] - [0.1, 0], first[:8], atol=1e-12)  # a tenth of σ ahead
    np.testing.assert_allclose(second[8:] + [0.1, 0], first[:8], atol=1e-12)
    assert np.array_equal(seen[0], seen[2])
    assert np.array_equal(seen[1], seen[3])
    assert not np.array_equal(seen[0], seen[4])


def test_a_third_order_is_refused(torch: Any, loss: Any) -> None:
    phi = torch.zeros(2, requires_grad=True)
    (gradient,) = torch.autograd.grad(loss(paraboloid, phi, 0.1, 16), phi, create_graph=True)
    (product,) = torch.autograd.grad(gradient.sum(), phi, create_graph=True)
    with pytest.raises(ur.InputError, match="no derivatives of third order"):
        torch.autograd.grad(product.sum(), phi)


def test_bad_input_is_one_line(torch: Any, loss: Any) -> None:
    phi = torch.zeros(2, requires_grad=True)
    for arguments, message in [
        ((paraboloid, phi, 0.0, 16), "sigma must be above 0"),
        ((paraboloid, phi, [0.1, -0.1], 16), "sigma must be above 0"),
        ((paraboloid, phi, [0.1, 0.1, 0.1], 16), "sigma must be a finite number or a vector"),
        ((paraboloid, phi, 0.1, 2), "samples must be a whole number of at least 4"),
        ((paraboloid, [0.0, 0.0], 0.1, 16), "phi must be a floating-point tensor .* got list"),
        (
            (paraboloid, torch.zeros(2, dtype=torch.int64), 0.1, 16),
            "phi must be a floating-point tensor .* got torch.int64",
        ),
        ((paraboloid, torch.zeros(2, 2, 2), 0.1, 16), r"phi must be a floating-point tensor .* \(2, 2, 2\)"),
        ((paraboloid, torch.zeros(0, 2), 0.1, 16), r"phi must be a floating-point tensor .* \(0, 2\)"),
        ((paraboloid, phi * torch.nan, 0.1, 16), "phi has elements that are not finite"),
        ((lambda x: x, phi, 0.1, 16), r"f must return shape \(17,\) for \(17, 2\), got \(17, 2\)"),
        ((lambda x: paraboloid(x) * np.nan, phi, 0.1, 16), "f is not finite at"),
        (
            (lambda x, items: np.where(items == 1, np.inf, 0), phi.expand(3, 2), 0.1, 16),
            "f is not finite at .*, item 1",
        ),
    ]:
        with pytest.raises(ur.InputError, match=message):
            loss(*arguments)


def test_a_black_box_that_fails_at_second_order_is_one_line_too(torch: Any, loss: Any) -> None:
    phi = torch.zeros(2, requires_grad=True)
    failing = []
    value = loss(lambda x: paraboloid(x) * (np.nan if failing else 1), phi, 0.1, 16)
    (gradient,) = torch.autograd.grad(value, phi, create_graph=True)
    failing.append(True)
    with pytest.raises(ur.InputError, match="f is not finite at"):
        torch.autograd.grad(gradient.sum(), phi)


class Line:
    """φ = W x: the loss is a quadratic form of W, so one step of Newton-CG without a tight radius ends at its least."""

    def __init__(self, torch: Any):
        self.weights = torch.zeros(2, 3, requires_grad=True)
        self.frozen = torch.ones(2)
        self.x = torch.tensor([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.3, 0.3, 1.0]])

    def loss(self) -> Any:
        return ur.grey_box.loss(lambda x, _: paraboloid(x), self.x @ self.weights.T, 0.1, 4096).mean()


def test_newton_cg_reaches_the_least_of_a_quadratic_form(torch: Any) -> None:
    line = Line(torch)
    before = ur.grey_box.newton_cg_step(line.loss, [line.weights, line.frozen], trust_radius=10.0, iterations=8)
    assert before == pytest.approx(0.5)
    assert line.loss().item() < 0.02 * before
    assert (line.frozen == 1).all()


def test_newton_cg_goes_to_the_radius_where_the_loss_bends_downwards(torch: Any) -> None:
    w = torch.tensor([0.3, 0.1], requires_grad=True)
    start = w.detach().clone()
    ur.grey_box.newton_cg_step(lambda: ur.grey_box.loss(lambda x: -paraboloid(x), w, 0.1, 256), [w], trust_radius=0.25)
    step = (w - start).detach()
    assert float(step.norm()) == pytest.approx(0.25, rel=1e-4)
    assert float(step.sum()) < 0  # away from the maximum at 0.5


def test_newton_cg_passes_its_step_through_an_optimizer(torch: Any) -> None:
    a, b = Line(torch), Line(torch)
    ur.grey_box.newton_cg_step(a.loss, [a.weights], trust_radius=0.1)
    optimizer = torch.optim.SGD([b.weights], lr=0.5)
    ur.grey_box.newton_cg_step(b.loss, [b.weights], trust_radius=0.1, optimizer=optimizer)
    np.testing.assert_allclose(b.weights.detach(), 0.5 * a.weights.detach(), rtol=1e-5)
    assert b.weights.grad is None
    adam = Line(torch)
    ur.grey_box.newton_cg_step(adam.loss, [adam.weights], optimizer=torch.optim.Adam([adam.weights], lr=1e-2))
    np.testing.assert_allclose(adam.weights.detach(), 1e-2 * np.sign(a.weights.detach()), rtol=1e-3)


def test_newton_cg_steps_along_the_gradient_where_the_loss_is_linear(torch: Any) -> None:
    w = torch.zeros(2, requires_grad=True)
    ur.grey_box.newton_cg_step(lambda: w.sum(), [w], trust_radius=0.1)
    np.testing.assert_allclose(w.detach(), -0.1 / np.sqrt(2), rtol=1e-6)


def test_newton_cg_in_the_metric_of_its_scales(torch: Any) -> None:
    """Of ½ Σ h w² in the scales 1 / √h one product tells the whole step; without them it does not. The radius is in the metric, too."""
    bend = torch.tensor([0.1, 1.0, 10.0])

    def after(scales: Any, radius: float = 100.0) -> np.ndarray:
        w = torch.ones(3, requires_grad=True)
        ur.grey_box.newton_cg_step(lambda: 0.5 * (bend * w * w).sum(), [w], radius, iterations=1, scales=scales)
        return w.detach().numpy()

    np.testing.assert_allclose(after([bend**-0.5]), 0, atol=1e-6)
    assert np.abs(after(None)).max() > 0.5
    np.testing.assert_allclose(after([torch.ones(3)]), after(None), rtol=1e-6)
    moved = (after([bend**-0.5], 0.3) - 1) * np.sqrt(bend.numpy())
    assert np.linalg.norm(moved) == pytest.approx(0.3, rel=1e-5)
    w = torch.ones(3, requires_grad=True)
    for scales, message in (([torch.ones(2)], "scales must have the shapes"), ([torch.zeros(3)], "finite and above 0")):
        with pytest.raises(ur.InputError, match=message):
            ur.grey_box.newton_cg_step(lambda: w.sum(), [w], scales=scales)


def test_newton_cg_refuses_what_is_no_loss(torch: Any) -> None:
    line = Line(torch)
    step = ur.grey_box.newton_cg_step
    for loss_fn, weights, message in [
        (lambda: line.weights, [line.weights], r"loss_fn must return a scalar tensor, say a mean, got \(2, 3\)"),
        (lambda: 1.0, [line.weights], "loss_fn must return a scalar tensor, say a mean, got float"),
        (lambda: torch.ones(()), [line.weights], "depends on no weight"),
        (line.loss, [line.frozen], "depends on no weight"),
        (lambda: line.weights.sum() * torch.nan, [line.weights], "the gradient is not finite"),
    ]:
        with pytest.raises(ur.InputError, match=message):
            step(loss_fn, weights)
    with pytest.raises(ur.InputError, match="trust_radius must be"):
        step(line.loss, [line.weights], trust_radius=0.0)
    assert (line.weights == 0).all()


def test_second_order_of_a_large_network_builds_no_matrix(torch: Any) -> None:
    """A step through 268 000 weights, whose largest tensor is a vector of the weights."""
    from torch.utils._python_dispatch import TorchDispatchMode  # pyright: ignore[reportMissingImports]

    class Largest(TorchDispatchMode):
        elements = 0

        def __torch_dispatch__(self, f: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
            found = f(*args, **(kwargs or {}))
            for x in found if isinstance(found, (tuple, list)) else [found]:
                if isinstance(x, torch.Tensor):
                    self.elements = max(self.elements, x.numel())
            return found

    torch.manual_seed(0)
    net = torch.nn.Sequential(torch.nn.Linear(1024, 256), torch.nn.Tanh(), torch.nn.Linear(256, 5))
    count = sum(w.numel() for w in net.parameters())
    assert count > 263_000
    x = torch.rand(4, 1024)
    with Largest() as largest:
        before = ur.grey_box.newton_cg_step(
            lambda: ur.grey_box.loss(paraboloids, net(x), 0.1, 64).mean(), net.parameters(), trust_radius=0.05
        )
    assert ur.grey_box.loss(paraboloids, net(x), 0.1, 64).mean().item() < before
    assert largest.elements <= count
