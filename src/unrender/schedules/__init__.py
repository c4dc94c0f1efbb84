"""Schedules: factors of a learning rate or of a smoothing width, as functions of the step."""

from unrender.schedules.functions import Constant, Cosine, Exponential, Inverse, InverseRoot, Schedule, Steps, Warmup

__all__ = ["Constant", "Cosine", "Exponential", "Inverse", "InverseRoot", "Schedule", "Steps", "Warmup"]
