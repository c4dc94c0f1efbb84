"""Gallery: problems made by code, with known true values."""

from unrender.gallery.catalogue import names, options, problem, summary
from unrender.gallery.fields import Option
from unrender.gallery.sunlit_vase import photographs

__all__ = ["Option", "names", "options", "photographs", "problem", "summary"]
