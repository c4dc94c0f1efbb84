"""Options of a smoothed derivative, which `unrender.smoothed`, the estimator and the grey box share."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SamplingOptions:
    """Options of an estimate of a smoothed derivative; see `smoothed.gradient` and `smoothed.hvp`.

    Attributes:
        samples: evaluations of f: for all elements together with `aggregate`, for each element otherwise.
        seed: random seed of the perturbations.
        aggregate: one sample from the mixture over all elements serves all of them.
        antithetic: samples in pairs z, −z.
        baseline: f(θ) is subtracted if this reduces variance.
        low_discrepancy: samples from scrambled Sobol sequences.
        product: every dimension from its own gradient kernel at once, instead of `aggregate`; gradients only.
        orthogonal: standard normals with orthogonal directions, as many as there are dimensions, instead of the mixtures.
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
