"""Image estimators, which estimate the image at which the loss is evaluated."""

from unrender.images.base import Plain
from unrender.images.denoising import Denoised
from unrender.images.recursive_control_variate import RecursiveControlVariate

__all__ = ["Denoised", "Plain", "RecursiveControlVariate"]
