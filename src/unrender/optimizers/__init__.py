"""Optimizers, which compute steps from gradient estimates."""

from unrender import schedules
from unrender.optimizers.adam import Adam
from unrender.optimizers.averaged_newton import AveragedNewton
from unrender.optimizers.base import Optimizer
from unrender.optimizers.chain import Chain
from unrender.optimizers.cma_es import CMAES
from unrender.optimizers.lbfgs import LBFGS
from unrender.optimizers.meta_adam import MetaAdam
from unrender.optimizers.newton import Newton
from unrender.optimizers.newton_cg import NewtonCG
from unrender.optimizers.partitioned import Partitioned
from unrender.optimizers.schedule_free import ScheduleFree
from unrender.optimizers.sgd import SGD

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
    "schedules",
]
