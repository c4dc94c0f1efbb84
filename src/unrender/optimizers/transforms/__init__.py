"""Step transforms: parts of a step with `init` and `update`, which `unrender.optimizers.Chain` composes."""

from unrender.optimizers.transforms.agreement_rate import AgreementRate
from unrender.optimizers.transforms.fitted_sobolev import ApplyPreconditioner, FittedSobolev
from unrender.optimizers.transforms.lasting_agreement import LastingAgreement
from unrender.optimizers.transforms.momentum import DecayingSum, GradientMean
from unrender.optimizers.transforms.pull_to_start import PullToStart
from unrender.optimizers.transforms.scale import ClipDirection, ScaleByDeviation, ScaleByRms
from unrender.optimizers.transforms.schedule_free_average import ScheduleFreeAverage
from unrender.optimizers.transforms.wiener_shrinkage import WienerShrinkage

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
