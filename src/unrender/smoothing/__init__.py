"""Derivatives of a function smoothed by a Gaussian, from evaluations alone. Public as `unrender.smoothed`."""

from unrender.smoothing.function import gradient, hessian, hvp
from unrender.smoothing.joint import JointDerivatives, joint
from unrender.smoothing.sampling import Function

__all__ = ["Function", "JointDerivatives", "gradient", "hessian", "hvp", "joint"]
