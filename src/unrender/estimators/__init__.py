"""Estimators of the loss gradient from images."""

from typing import TYPE_CHECKING

from unrender.core import lazy

if TYPE_CHECKING:
    from unrender.estimators.gauss_newton import GaussNewton
    from unrender.estimators.hybrid import HybridGradient
    from unrender.estimators.loss_values import LossValues
    from unrender.estimators.meta import MetaEstimator
    from unrender.estimators.path import PathGradient, StockGradient
    from unrender.estimators.path_then_newton import PathThenNewton
    from unrender.estimators.smoothed import SmoothedDerivatives

__getattr__ = lazy.attach(
    __name__,
    {
        "GaussNewton": "gauss_newton",
        "HybridGradient": "hybrid",
        "LossValues": "loss_values",
        "MetaEstimator": "meta",
        "PathGradient": "path",
        "PathThenNewton": "path_then_newton",
        "SmoothedDerivatives": "smoothed",
        "StockGradient": "path",
    },
)
__all__ = [
    "GaussNewton",
    "HybridGradient",
    "LossValues",
    "MetaEstimator",
    "PathGradient",
    "PathThenNewton",
    "SmoothedDerivatives",
    "StockGradient",
]
