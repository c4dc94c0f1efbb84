"""Problems made by code, ready to run, their truth known."""

from unrender.gallery.fields import Option
from unrender.gallery.registry import names, options, problem, summary

__all__ = ["Option", "names", "options", "problem", "summary"]
