"""Statistical formulas. `meta`, `recursion`, `roughness` and `welford` run on NumPy and Dr.Jit arrays, the other modules on NumPy's."""

from unrender.statistics import gaussian, meta, recursion, welford
from unrender.statistics.recursion import control_variate_variance, control_weight

__all__ = ["control_variate_variance", "control_weight", "gaussian", "meta", "recursion", "welford"]
