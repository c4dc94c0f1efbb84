"""Methods by name: a matching estimator and optimizer, with user options.

A method is a class of documented options whose `build` returns both parts.
"""

from unrender.methods.base import Method, Options, method, methods

__all__ = ["Method", "Options", "method", "methods"]
