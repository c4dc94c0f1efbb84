"""Image estimators: what the loss is evaluated at."""

from unrender.images.denoised import Denoised
from unrender.images.plain import Plain
from unrender.images.recursive_control_variate import RecursiveControlVariate

__all__ = ["Denoised", "Plain", "RecursiveControlVariate"]
