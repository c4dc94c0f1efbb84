"""Changes of the variable that an optimizer moves: one rate for a reflectance, a radiance of 5000 and an extinction."""

from unrender.parameterisations.base import Parameterisation
from unrender.parameterisations.elementwise import Identity, Log, Logit, Softplus

__all__ = ["Identity", "Log", "Logit", "Parameterisation", "Softplus"]
