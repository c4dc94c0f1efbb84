"""Derivatives by the weights of a network before a black box, against closed forms: torch's own through the network and the
smoothed function, which is known. Both terms of the second order count, and a lost one is seen."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import pytest
from scipy import stats

import unrender as ur
from tiers import slow

torch: Any = None


@pytest.fixture(autouse=True, scope="module")
def with_torch() -> None:
    """Import the extra, which `make test` does not install, not at collection: every test process would take seconds for it."""
    global torch
    torch = pytest.importorskip("torch")


N = 3
SIGMA = np.array([0.4, 0.6, 0.5])
RUNS = 60
A = np.array([0.9, -0.6, 0.5])
B = np.array([[1.0, 0.5, 0.0], [-0.2, 0.8, 0.3], [0.4, 0.0, 0.6]])


class Quadratic:
    """(x − c)ᵀ B (x − c), which smoothing moves by a constant; each item has its c."""

    def f(self, x: np.ndarray, items: np.ndarray) -> np.ndarray:
        x = x - 0.3 * items[:, None]
        return np.einsum("bi,ij,bj->b", x, B, x)

    def smoothed(self, phi: Any) -> Any:
        x = phi - 0.3 * torch.arange(len(phi), dtype=phi.dtype)[:, None]
        return torch.einsum("bi,ij,bj->b", x, torch.from_numpy(B), x)


class Sine:
    """sin(a·x + item), damped by exp(−aᵀ Σ a / 2)."""

    def f(self, x: np.ndarray, items: np.ndarray) -> np.ndarray:
        return np.sin(x @ A + items)

    def smoothed(self, phi: Any) -> Any:
        damping = float(np.exp(-0.5 * np.sum((A * SIGMA) ** 2)))
        return damping * torch.sin(phi @ torch.from_numpy(A) + torch.arange(len(phi), dtype=phi.dtype))


class Step:
    """1 where a·x > item / 4, else 0, whose own derivatives are zero; smoothed, a normal distribution function."""

    def f(self, x: np.ndarray, items: np.ndarray) -> np.ndarray:
        return (x @ A > items / 4).astype(float)

    def smoothed(self, phi: Any) -> Any:
        s = float(np.sqrt(np.sum((A * SIGMA) ** 2)))
        t = phi @ torch.from_numpy(A) - torch.arange(len(phi), dtype=phi.dtype) / 4
        return torch.special.ndtr(t / s)


def network(kind: str) -> Any:
    """Of a few weights: linear (φ without second derivative), or with a hidden layer (with one)."""
    torch.manual_seed(1)
    hidden = [torch.nn.Linear(2, 3), torch.nn.Tanh()] if kind == "tanh" else []
    return torch.nn.Sequential(*hidden, torch.nn.Linear(3 if hidden else 2, N)).double()


X = np.random.default_rng(5).normal(size=(4, 2))
"""Four items of two inputs."""


def derivatives(net: Any, losses: Any) -> tuple[np.ndarray, np.ndarray]:
    """Of the weighted sum of losses: by all weights, and its Hessian's product with a fixed direction."""
    weights = list(net.parameters())
    total = losses @ torch.tensor([0.5, 1.0, 0.7, 0.2], dtype=torch.float64)
    gradient = _flat(torch.autograd.grad(total, weights, create_graph=True))
    v = torch.randn(len(gradient), generator=torch.Generator().manual_seed(3), dtype=gradient.dtype)
    product = _flat(torch.autograd.grad(gradient, weights, v, materialize_grads=True))
    return gradient.detach().numpy(), product.numpy()


def _flat(tensors: Iterable[Any]) -> Any:
    return torch.cat([x.reshape(-1) for x in tensors])


def estimates(
    case: Any, net: Any, f: Callable[..., Any] | None = None, **options: Any
) -> tuple[np.ndarray, np.ndarray]:
    """`derivatives` of the grey box for each of the seeds: (RUNS, weights) twice."""
    x = torch.from_numpy(X)
    runs = [
        derivatives(net, ur.grey_box.loss(f or case.f, net(x), SIGMA, 256, seed=seed, **options))
        for seed in range(RUNS)
    ]
    first, second = zip(*runs, strict=True)
    return np.array(first), np.array(second)


def agrees(found: np.ndarray, truth: np.ndarray, bias: float = 0.0) -> bool:
    """Whether the mean over runs is the truth within its standard error, corrected for the number of weights.

    Args:
        bias: what the central difference may be off by, a share of the largest element.
    """
    excess = np.maximum(np.abs(found.mean(axis=0) - truth) - bias * np.abs(truth).max(), 0)
    error = found.std(axis=0, ddof=1) / np.sqrt(len(found))
    return bool((excess <= stats.t.isf(1e-3 / (2 * truth.size), len(found) - 1) * error + 1e-9).all())


@pytest.mark.parametrize("kind", [slow("linear"), "tanh"])
@pytest.mark.parametrize("case", [Quadratic(), Sine(), Step()], ids=lambda case: type(case).__name__)
def test_weights_have_the_derivatives_of_the_closed_form(case: Any, kind: str) -> None:
    net = network(kind)
    first, second = estimates(case, net)
    gradient, product = derivatives(net, case.smoothed(net(torch.from_numpy(X))))
    assert agrees(first, gradient)
    assert agrees(second, product, bias=0.01)


@pytest.mark.parametrize(
    "options",
    [
        {"aggregate": False},
        slow({"antithetic": False}),
        slow({"low_discrepancy": True}),
        slow({"epsilon": 0.5}),
        {"joint": True},
    ],
    ids=str,
)
def test_so_do_they_with_every_option(options: dict[str, Any]) -> None:
    case, net = Quadratic(), network("tanh")
    first, second = estimates(case, net, **options)
    gradient, product = derivatives(net, case.smoothed(net(torch.from_numpy(X))))
    assert agrees(first, gradient)
    assert agrees(second, product)  # a quadratic form's central difference is exact at any width


def test_a_lost_term_is_seen() -> None:
    """Each of the two terms of the second order, the weights of the items, the items themselves."""
    case, net = Sine(), network("tanh")
    first, second = estimates(case, net)
    x = torch.from_numpy(X)
    gradient, product = derivatives(net, case.smoothed(net(x)))

    # Without the curvature of the network: the smoothed function behind φ's linearisation. Without that of the smoothed function: its
    # linearisation behind φ.
    curved = net(x)
    at_phi = curved.detach().requires_grad_()
    (g,) = torch.autograd.grad(case.smoothed(at_phi).sum(), at_phi)
    _, of_network = derivatives(net, (curved * g).sum(dim=1))
    of_smoothed = product - of_network
    assert agrees(second, product, bias=0.01)
    assert not agrees(second, of_network, bias=0.01)
    assert not agrees(second, of_smoothed, bias=0.01)

    assert not agrees(1.1 * first, gradient)
    assert not agrees(1.1 * second, product, bias=0.01)
    swapped, _ = estimates(case, net, lambda points, items: case.f(points, items[::-1]))
    assert not agrees(swapped, gradient)


@pytest.mark.slow
def test_items_draw_independently() -> None:
    """So that the noise of a batch's mean falls with its size."""
    case = Sine()

    def variance(items: int) -> float:
        rows = []
        for seed in range(RUNS):
            phi = torch.zeros(N, dtype=torch.float64, requires_grad=True)
            ur.grey_box.loss(
                lambda x, _: case.f(x, np.zeros(len(x))), phi.expand(items, N), SIGMA, 64, seed
            ).mean().backward()
            rows.append(phi.grad.numpy())
        return float(np.var(rows, axis=0).sum())

    assert variance(16) < 2 / 16 * variance(1)
