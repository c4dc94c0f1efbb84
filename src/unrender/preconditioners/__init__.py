"""Preconditioners: linear maps of one parameter's gradients and steps."""

from unrender.preconditioners.base import Preconditioner
from unrender.preconditioners.sobolev import LargeSteps, Sobolev

__all__ = ["LargeSteps", "Preconditioner", "Sobolev"]
