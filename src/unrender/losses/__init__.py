"""Losses, all but one per pixel and channel: value and derivative, and whether the derivative is linear in the image.

Why linearity matters: an image estimate I with E[I] = F gives E[∂ℓ(I)] = ∂ℓ(F) only where ∂ℓ is linear. Otherwise the
gradient is biased by the image's noise, however many steps are averaged (Nicolet et al. 2023, section 4).

The loss of a problem is the sum over views of weight · mean over pixels and channels of mask · value. A loss of whole
images sees the reference where the mask is 0: mean of ℓ(R + mask · (I − R), R). Any function of images in Dr.Jit or PyTorch is a loss
of whole images (`FunctionLoss`).
"""

from unrender.losses.base import Loss
from unrender.losses.censored import Censored
from unrender.losses.function import FunctionLoss
from unrender.losses.perceptual import Perceptual
from unrender.losses.pixelwise import L1, L2, Huber, RelativeL2

__all__ = ["L1", "L2", "Censored", "FunctionLoss", "Huber", "Loss", "Perceptual", "RelativeL2"]
