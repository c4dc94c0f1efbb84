"""Optimizers, which compute steps from gradient estimates."""

from unrender import schedules
from unrender.optimizers.averaged_newton import AveragedNewton
from unrender.optimizers.base import Optimizer
from unrender.optimizers.cma_es import CMAES
from unrender.optimizers.newton import LBFGS, Newton, NewtonCG
from unrender.optimizers.partitioned import Partitioned, Successive
from unrender.optimizers.recipes import SGD, Adam, Chain, MetaAdam, ScheduleFree

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
