"""Rules of `auto`: functions from the traits of a problem to a plan, or to a part of one, with its reason.

`RULES` choose the gradient estimator; the first rule that returns a plan decides.
"""

from unrender.methods.rules.newton import cameras, cameras_by_paths, few_numbers
from unrender.methods.rules.paths import paths_and_perturbed, paths_then_newton, perturbed

__all__ = ["RULES"]

RULES = (cameras, cameras_by_paths, few_numbers, paths_and_perturbed, perturbed, paths_then_newton)
"""Functions from a problem's traits to a plan, or None."""
