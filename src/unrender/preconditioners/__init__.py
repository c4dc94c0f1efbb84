"""Preconditioners: linear maps of one parameter's gradients and steps."""

from unrender.preconditioners.base import Preconditioner
from unrender.preconditioners.large_steps import LargeSteps
from unrender.preconditioners.sobolev import Sobolev

__all__ = ["LargeSteps", "Preconditioner", "Sobolev"]
