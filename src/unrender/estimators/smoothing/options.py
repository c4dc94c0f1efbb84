"""How a smoothed derivative is estimated: the one set of options that `unrender.smoothed`, the estimator and the grey box share."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SamplingOptions:
    """Options of an estimate of a smoothed derivative; `smoothed.gradient` and `smoothed.hvp` document their meaning.

    Attributes:
        samples: evaluations of f, for all elements together with `aggregate`, for each element without.
        seed: of the draws.
        aggregate: one draw from the mixture over all elements serves all of them.
        antithetic: draws in pairs z, −z.
        baseline: f(θ) is subtracted where that reduces variance.
        low_discrepancy: draws from scrambled Sobol sequences.
        product: every dimension from its own gradient kernel at once, in place of `aggregate`; gradients only.
        orthogonal: draws of standard normals whose directions are orthogonal, as many as there are dimensions, in place of the mixtures.
        epsilon: half the distance of a central difference in units of σ, > 0; products only.
    """

    samples: int
    seed: int = 0
    aggregate: bool = True
    antithetic: bool = True
    baseline: bool = True
    low_discrepancy: bool = False
    product: bool = False
    orthogonal: bool = False
    epsilon: float = 0.1
