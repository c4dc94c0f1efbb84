"""The rules of `auto`: each looks at the traits of a problem and returns a plan, or a part of one, with its reason.

`RULES` decide between ways to estimate; the first that returns a plan decides. Among path gradients, the rules of `kinds` decide for the
unknowns of their kind, and those of `sampling` decide how images are rendered.
"""

from unrender.methods.rules.newton import cameras, cameras_by_paths, few_numbers
from unrender.methods.rules.paths import paths, paths_and_perturbed, perturbed

__all__ = ["RULES"]

RULES = (cameras, cameras_by_paths, few_numbers, paths_and_perturbed, perturbed, paths)
"""From a problem's traits to a plan, or None."""
