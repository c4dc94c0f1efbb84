"""Derivatives of a function smoothed by a Gaussian, from evaluations alone. Public as `unrender.smoothed`."""

from unrender.estimators.smoothing.function import JointDerivatives, gradient, hessian, hvp, joint
from unrender.estimators.smoothing.sampling import Function

__all__ = ["Function", "JointDerivatives", "gradient", "hessian", "hvp", "joint"]
