"""How much of a mini-batch is drawn uniformly: as much as the evidence for an importance map asks for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

SHARES = np.array([0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8])
"""Those that are compared."""
MOST = float(SHARES[-1])
"""The share without evidence. The second moment of the gradient is then at most 1 / 0.8 = 1.25 times that of uniform sampling, whatever
the map."""


_UNKNOWN = 3.0
"""Samples' worth of second moment that n effective samples may have missed: 3 of 3 + n at most, with 95 % confidence (rule of three)."""


@dataclass(frozen=True)
class ShareEvidence:
    """Second moments of the gradient under other probabilities, from samples drawn since the map that they judge.

    One row for each of the two factors, ∂L/∂I and ∂I/∂θ: a sample's own factor, times the map of the other.

    Attributes:
        moments: running sums of y / p(λ) for each share λ, and last for uniform sampling, (2, shares + 1).
        squares: running sums of (y / p(1))², (2,).
    """

    moments: np.ndarray = field(default_factory=lambda: np.zeros((2, len(SHARES) + 1)))
    squares: np.ndarray = field(default_factory=lambda: np.zeros(2))


def observed(
    evidence: ShareEvidence,
    samples: np.ndarray,
    density: np.ndarray,
    decay: float,
    gain: Callable[[np.ndarray], np.ndarray] | None = None,
) -> ShareEvidence:
    """The evidence with further samples.

    Args:
        evidence: so far.
        samples: y, second moments that a sample tells over its own probability relative to uniform sampling, (2, N): their sum
            estimates the second moment under uniform sampling.
        density: q, the map at each sample, relative to uniform sampling, (N,).
        decay: weight of what was known before.
        gain: one over the second moment under a probability relative to uniform sampling, for that of a sample under uniform sampling;
            None for the probability itself.
    """
    mixed = SHARES[:, None] + (1 - SHARES[:, None]) * density
    mixed = mixed if gain is None else gain(mixed)
    moments = np.concatenate([samples @ (1 / mixed).T, samples.sum(axis=1, keepdims=True)], axis=1)
    return ShareEvidence(evidence.moments * decay + moments, evidence.squares * decay + np.square(samples).sum(axis=1))


def choose(evidence: ShareEvidence, cost: float = 1.0, gain: Callable[[np.ndarray], np.ndarray] | None = None) -> float:
    """The share λ of uniform draws in p = λ + (1 - λ) q that minimises a pessimistic estimate of the gradient's second moment over that of
    uniform sampling:

        J(λ) = (1 - ε) R(λ) / R(1) + ε / λ,        R(λ) = Σ y / p(λ),        ε = 3 / (3 + n),        n = (Σ y)² / Σ y².

    n is the effective number of samples, and ε the share of the second moment that they may have missed, as much as three more samples
    like them (the rule of three: 95 % confidence). The map may be zero there, which costs 1 / λ. J is the larger of that of the two
    factors. Without evidence λ is `MOST`; heavy tails, of which few samples are all, keep it large.

    Args:
        evidence: of samples.
        cost: of a path drawn by the map, over that of one drawn uniformly: J is multiplied by λ + (1 - λ) times it.
        gain: that of `observed`: of λ, in place of λ in ε / λ.
    """
    least = SHARES if gain is None else gain(SHARES)
    worst = np.zeros(len(SHARES))
    for moments, square in zip(evidence.moments, evidence.squares, strict=True):
        uniform = float(moments[-1])
        if not (uniform > 0 and square > 0):
            return MOST
        unknown = _UNKNOWN / (_UNKNOWN + uniform**2 / float(square))
        worst = np.maximum(worst, (1 - unknown) * moments[:-1] / uniform + unknown / least)
    return float(SHARES[np.argmin(worst * (SHARES + (1 - SHARES) * cost))])
