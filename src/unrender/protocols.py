"""What components are, for those who write their own: each protocol lists the methods that an object must have.

No class needs to inherit from them: an object that has the methods is one (`typing.Protocol`). `Callback` is the exception, a class
whose methods do nothing until they are overridden.
"""

from unrender.estimators.base import Estimate, Estimator
from unrender.images.base import ImageEstimate, ImageEstimator, PairRequest
from unrender.losses.base import Loss
from unrender.optimizers.base import Optimizer
from unrender.pixels.base import MiniBatch, PixelSampler
from unrender.preconditioners.base import Preconditioner
from unrender.rendering.renderer import ParameterInfo, Renderer, Rendering, SampleRequest
from unrender.runs.callbacks import Callback
from unrender.schedules.functions import Schedule

__all__ = [
    "Callback",
    "Estimate",
    "Estimator",
    "ImageEstimate",
    "ImageEstimator",
    "Loss",
    "MiniBatch",
    "Optimizer",
    "PairRequest",
    "ParameterInfo",
    "PixelSampler",
    "Preconditioner",
    "Renderer",
    "Rendering",
    "SampleRequest",
    "Schedule",
]
