"""Which pixels a step looks at."""

from unrender.pixels.all import All

__all__ = ["All"]
