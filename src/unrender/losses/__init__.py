"""Losses of images: value, derivative, and whether the derivative is linear in the image.

Linearity matters for bias. An image estimate I with E[I] = F satisfies E[∂ℓ(I)] = ∂ℓ(F) only if ∂ℓ is linear. Otherwise the image's noise
biases the gradient, even when many steps are averaged (Nicolet et al. 2023, section 4).

The loss of a problem is the sum over views of weight · mean over pixels and channels of mask · value. A loss of full images gets the
reference where the mask is 0: mean of ℓ(R + mask · (I − R), R). Any function of images in Dr.Jit or PyTorch can be a loss of full images
(`FunctionLoss`).
"""

from unrender.losses import metrics as metrics
from unrender.losses.function import FunctionLoss
from unrender.losses.perceptual import Perceptual
from unrender.losses.pixelwise import L1, L2, Censored, Huber, Loss, RelativeL2

__all__ = ["L1", "L2", "Censored", "FunctionLoss", "Huber", "Loss", "Perceptual", "RelativeL2"]
