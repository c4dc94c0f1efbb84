"""Statistical formulas made of operators: the same code runs on NumPy and on Dr.Jit arrays."""

from unrender.statistics import gaussian, meta, recursion, welford
from unrender.statistics.recursion import control_variate_variance, control_weight

__all__ = ["control_variate_variance", "control_weight", "gaussian", "meta", "recursion", "welford"]
