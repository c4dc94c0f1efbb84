"""Estimates of a Hessian, or of its diagonal, from curvatures along random directions.

A full matrix B moves towards the nearest symmetric matrix with B v = h, where h is the product of the Hessian with a direction v: Powell's
symmetric Broyden update; Gower and Richtárik 2017 on random directions.

For a diagonal H, zᵀ H v = Σᵢ zᵢ vᵢ Hᵢᵢ is linear in the diagonal, so each pair of directions gives one equation. A step moves the
diagonal by a fraction ω of the smallest change, in the Euclidean norm, that satisfies all its equations. With one equation and v = z this
is the quasi-Cauchy update of Zhu, Nazareth and Wolkowicz 1999; with several it is the block method of Kaczmarz. n independent equations
determine the diagonal. The off-diagonal elements of H average out over steps if the directions have independent random signs.
"""

from __future__ import annotations

import numpy as np

LEAST = 0.15
"""Smallest usable element of a diagonal, relative to the mean magnitude of its elements."""
RIDGE = 0.01
"""Regularisation of the equations, relative to their mean squared row length. It damps equations that nearly repeat others."""


def symmetric(matrix: np.ndarray, v: np.ndarray, product: np.ndarray, rate: float) -> np.ndarray:
    """Return the symmetric B (n, n) moved by `rate` in (0, 1] towards the nearest symmetric one with B v = `product`, v a unit vector."""
    missing = product - matrix @ v
    update = np.outer(missing, v) + np.outer(v, missing) - float(v @ missing) * np.outer(v, v)
    return matrix + rate * update


def isotropic(rows: np.ndarray, values: np.ndarray) -> float:
    """Return the least-squares solution c of rows · (c, c, ...) = values, with rows (B, n) and values (B,); 0 where every row sums to
    0."""
    sums = rows.sum(axis=1)
    square = float(sums @ sums)
    return float(sums @ values) / square if square > 0.0 else 0.0


def corrected(diagonal: np.ndarray, rows: np.ndarray, values: np.ndarray, rate: float) -> np.ndarray:
    """Return the diagonal d (n,) moved by the fraction ω = `rate` in (0, 1] toward the nearest solution of A d = y.

    A is `rows` (B, n) and y is `values` (B,). The result is d + ω Aᵀ (A Aᵀ + ρ I)⁻¹ (y − A d), with ρ from `RIDGE`. Takes O(B² n + B³)
    time and O(B n + B²) memory.
    """
    gram = rows @ rows.T
    ridge = RIDGE * float(np.mean(np.diagonal(gram)))
    if ridge == 0.0:
        return diagonal.copy()
    gram[np.diag_indices(len(gram))] += ridge
    return diagonal + rate * (rows.T @ np.linalg.solve(gram, values - rows @ diagonal))


def updated(stored: np.ndarray | None, rows: np.ndarray, values: np.ndarray, rate: float) -> np.ndarray:
    """Return the diagonal after a step's equations, (n,): `corrected`, from `isotropic` if there is none yet.

    Args:
        stored: diagonal before the step, (n,), or None.
        rows, values, rate: see `corrected`.
    """
    before = np.full(rows.shape[1], isotropic(rows, values)) if stored is None else stored
    return corrected(before, rows, values, rate)


def positive(diagonal: np.ndarray) -> np.ndarray:
    """Clamp the elements of a diagonal (n,) to at least `LEAST` times their mean magnitude.

    The result is positive definite unless all elements are 0. Elements that are small or negative only because of noise would otherwise
    cause the longest steps.
    """
    return np.maximum(diagonal, LEAST * float(np.mean(np.abs(diagonal))))
