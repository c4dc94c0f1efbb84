"""Protocols of user-written components, and the types of their arguments and results.

An object implements a protocol by having its methods (`typing.Protocol`); it need not inherit. `Callback` is a base class, whose methods
do nothing until they are overridden. Capability types state what an estimator computes and what an optimizer requires.
"""

from unrender.estimators.base import Estimate, Estimator
from unrender.estimators.capabilities import (
    Capabilities,
    Capability,
    FreshGradient,
    Gradient,
    GradientNoise,
    Hessian,
    HessianNoise,
    HessianProduct,
    LossFunction,
    ScoreCovariance,
    Smoothing,
    Variance,
)
from unrender.images.base import ImageEstimate, ImageEstimator, PairRequest
from unrender.losses.pixelwise import Loss
from unrender.optimizers.base import Optimizer
from unrender.optimizers.transforms.base import StepTransform, StepUpdate, TransformState
from unrender.parameterisations import Parameterisation, Transform
from unrender.pixels.base import MiniBatch, PixelSampler
from unrender.preconditioners.base import Preconditioner
from unrender.rendering.renderer import ParameterInfo, Renderer, Rendering, RenderSession, SampleRequest
from unrender.runs.callbacks import Callback
from unrender.schedules import Schedule

__all__ = [
    "Callback",
    "Capabilities",
    "Capability",
    "Estimate",
    "Estimator",
    "FreshGradient",
    "Gradient",
    "GradientNoise",
    "Hessian",
    "HessianNoise",
    "HessianProduct",
    "ImageEstimate",
    "ImageEstimator",
    "Loss",
    "LossFunction",
    "MiniBatch",
    "Optimizer",
    "PairRequest",
    "ParameterInfo",
    "Parameterisation",
    "PixelSampler",
    "Preconditioner",
    "RenderSession",
    "Renderer",
    "Rendering",
    "SampleRequest",
    "Schedule",
    "ScoreCovariance",
    "Smoothing",
    "StepTransform",
    "StepUpdate",
    "Transform",
    "TransformState",
    "Variance",
]
