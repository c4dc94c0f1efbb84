"""Methods by name: an estimator and an optimizer that go together, with the options that people set.

One file per method; each registers a class of documented options whose `build` makes the two parts.
"""

from unrender.methods.base import Method, Options, method, methods

__all__ = ["Method", "Options", "method", "methods"]
