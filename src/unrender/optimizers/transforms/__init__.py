"""Step transforms: parts of a step with `init` and `update`, which `unrender.optimizers.Chain` composes."""

from unrender.optimizers.transforms.agreement_rate import AgreementRate
from unrender.optimizers.transforms.averages import DecayingSum, GradientMean, ScheduleFreeAverage
from unrender.optimizers.transforms.fitted_sobolev import ApplyPreconditioner, FittedSobolev
from unrender.optimizers.transforms.lasting_agreement import LastingAgreement
from unrender.optimizers.transforms.scale import ClipDirection, ScaleByDeviation, ScaleByRms
from unrender.optimizers.transforms.shrinkage import PullToStart, WienerShrinkage

__all__ = [
    "AgreementRate",
    "ApplyPreconditioner",
    "ClipDirection",
    "DecayingSum",
    "FittedSobolev",
    "GradientMean",
    "LastingAgreement",
    "PullToStart",
    "ScaleByDeviation",
    "ScaleByRms",
    "ScheduleFreeAverage",
    "WienerShrinkage",
]
