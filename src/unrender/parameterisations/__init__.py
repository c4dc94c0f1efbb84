"""Changes of variables for the optimizer, so that one learning rate suits reflectances, radiances and extinctions alike."""

from unrender.parameterisations.base import Parameterisation
from unrender.parameterisations.elementwise import Identity, Log

__all__ = ["Identity", "Log", "Parameterisation"]
