"""Choice of the fraction of uniform samples in a mini-batch, from the evidence for the importance map."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from unrender.core import checks
from unrender.core.errors import InputError

SHARES = np.array([0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8])
"""Candidate fractions."""
MOST = float(SHARES[-1])
"""Fraction without evidence. The second moment of the gradient is then at most 1 / 0.8 = 1.25 times that of uniform sampling, for any
map."""


_UNKNOWN = 3.0
"""Second moment that n effective samples may have missed, in samples: at most 3 of 3 + n with 95 % confidence (rule of three)."""


def check(owner: str, share: float | None) -> None:
    """Raise `InputError` for a fraction that is neither None nor in (0, 1]."""
    if share is not None and not checks.number(owner, "uniform", share, above=0.0) <= 1:
        raise InputError(f"{owner}: uniform must be a share in (0, 1], got {share!r}")


@dataclass(frozen=True)
class ShareEvidence:
    """Second moments of the gradient under other probabilities, from samples that are newer than the map.

    Each of the two factors, ∂L/∂I and ∂I/∂θ, has one row: the sample's own factor times the map of the other.

    Attributes:
        moments: running sums of y / p(λ) for each fraction λ, and last for uniform sampling, (2, fractions + 1).
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
    """Return the evidence updated by further samples.

    Args:
        samples: y, second moments of the samples divided by their probability relative to uniform sampling, (2, N). Their sum estimates
            the second moment under uniform sampling.
        density: q, the map at each sample, relative to uniform sampling, (N,).
        decay: weight of the earlier evidence.
        gain: inverse of the second moment as a function of the probability relative to uniform sampling, in units of its value for
            uniform sampling; None for the probability itself.
    """
    mixed = SHARES[:, None] + (1 - SHARES[:, None]) * density
    mixed = mixed if gain is None else gain(mixed)
    moments = np.concatenate([samples @ (1 / mixed).T, samples.sum(axis=1, keepdims=True)], axis=1)
    return ShareEvidence(evidence.moments * decay + moments, evidence.squares * decay + np.square(samples).sum(axis=1))


def choose(evidence: ShareEvidence, cost: float = 1.0, gain: Callable[[np.ndarray], np.ndarray] | None = None) -> float:
    """Return the fraction λ of uniform samples in p = λ + (1 - λ) q with the smallest pessimistic second moment.

    The estimate is relative to the second moment of uniform sampling:

        J(λ) = (1 - ε) R(λ) / R(1) + ε / λ,        R(λ) = Σ y / p(λ),        ε = 3 / (3 + n),        n = (Σ y)² / Σ y².

    n is the effective number of samples. ε is the share of the second moment that they may have missed, as much as three more such
    samples (rule of three: 95 % confidence). The map may be zero there, which costs 1 / λ. J is the larger of both factors' values.
    Without evidence λ is `MOST`. Heavy tails, which a few samples dominate, keep λ large.

    Args:
        cost: relative cost of a path sampled by the map; J is multiplied by λ + (1 - λ) times it.
        gain: `gain` of `observed`; gain(λ) replaces λ in ε / λ.
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
