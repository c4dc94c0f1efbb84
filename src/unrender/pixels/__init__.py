"""Pixel samplers, which choose the pixels that a step renders: all, or a mini-batch."""

from unrender.pixels.adaptive import Adaptive, LossProportional
from unrender.pixels.adaptive_counts import AdaptiveCounts
from unrender.pixels.uniform import All, Uniform, Views

__all__ = ["Adaptive", "AdaptiveCounts", "All", "LossProportional", "Uniform", "Views"]
