"""Derivatives of a function smoothed by a Gaussian, from evaluations alone. Public as `unrender.smoothed`."""

from unrender.smoothing.function import Function, JointDerivatives, gradient, hessian, hvp, together

__all__ = ["Function", "JointDerivatives", "gradient", "hessian", "hvp", "together"]
