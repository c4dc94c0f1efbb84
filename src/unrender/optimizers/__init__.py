"""Optimizers, which compute steps from gradient estimates."""

from unrender import schedules
from unrender.optimizers.averaged_newton import AveragedNewton
from unrender.optimizers.base import Optimizer
from unrender.optimizers.chain import Chain
from unrender.optimizers.cma_es import CMAES
from unrender.optimizers.lbfgs import LBFGS
from unrender.optimizers.newton import Newton, NewtonCG
from unrender.optimizers.partitioned import Partitioned
from unrender.optimizers.recipes import SGD, Adam, MetaAdam, ScheduleFree
from unrender.optimizers.successive import Successive

__all__ = [
    "CMAES",
    "LBFGS",
    "SGD",
    "Adam",
    "AveragedNewton",
    "Chain",
    "MetaAdam",
    "Newton",
    "NewtonCG",
    "Optimizer",
    "Partitioned",
    "ScheduleFree",
    "Successive",
    "schedules",
]
