"""The diagonal of a Hessian from curvatures along directions: a draw tells one sum of its elements, weighted by what is known.

With H diagonal, zᵀ H v = Σᵢ zᵢ vᵢ Hᵢᵢ is linear in the diagonal: one equation a draw. The equations of a step move the diagonal by a share
of the least change, in the Euclidean norm, that fulfils all of them (with one equation and v = z the quasi-Cauchy update of Zhu, Nazareth
and Wolkowicz 1999; with many the block method of Kaczmarz). n equations tell the whole diagonal. Where H has elements off the
diagonal, draws of independent signs average them out over steps.
"""

from __future__ import annotations

import numpy as np

LEAST = 0.15
"""The least element of a diagonal that is used, as a share of their mean magnitude."""
RIDGE = 0.01
"""What is added to the squared length of each equation's row, as a share of their mean: equations that nearly repeat others are noise."""


def isotropic(rows: np.ndarray, values: np.ndarray) -> float:
    """The c for which rows · (c, c, ...) = values in least squares: rows (B, n), values (B,); 0 where all rows sum to 0."""
    sums = rows.sum(axis=1)
    square = float(sums @ sums)
    return float(sums @ values) / square if square > 0.0 else 0.0


def corrected(diagonal: np.ndarray, rows: np.ndarray, values: np.ndarray, rate: float) -> np.ndarray:
    """The diagonal d (n,) moved by the share `rate`, ω in (0, 1], toward the nearest one with A d = y: rows A (B, n), values y (B,).

    d + ω Aᵀ (A Aᵀ + ρ I)⁻¹ (y − A d) with ρ of `RIDGE`. O(B² n + B³) time, O(B n + B²) memory.
    """
    gram = rows @ rows.T
    ridge = RIDGE * float(np.mean(np.diagonal(gram)))
    if ridge == 0.0:
        return diagonal.copy()
    gram[np.diag_indices(len(gram))] += ridge
    return diagonal + rate * (rows.T @ np.linalg.solve(gram, values - rows @ diagonal))


def positive(diagonal: np.ndarray) -> np.ndarray:
    """The diagonal (n,) with no element below `LEAST` times their mean magnitude: a positive definite matrix to divide by,
    unless all of them are 0.

    Elements that noise or one step's renders made small or negative would make the longest steps.
    """
    return np.maximum(diagonal, LEAST * float(np.mean(np.abs(diagonal))))
