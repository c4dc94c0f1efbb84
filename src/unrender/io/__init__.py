"""Files: atomic writing, and reading within limits."""

from typing import TYPE_CHECKING

from unrender.core import lazy

if TYPE_CHECKING:
    from unrender.io.volumes import Grid, read_grid, write_grid

__getattr__ = lazy.attach(__name__, {"Grid": "volumes", "read_grid": "volumes", "write_grid": "volumes"})
__all__ = ["Grid", "read_grid", "write_grid"]
