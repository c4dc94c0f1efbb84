"""Optimisation runs: the loop, its callbacks, run folders and resuming."""

from typing import TYPE_CHECKING

from unrender.core import lazy

if TYPE_CHECKING:
    from unrender.runs.image_sensitivity import sensitivity
    from unrender.runs.live import Live
    from unrender.runs.map_uncertainty import uncertainty

__getattr__ = lazy.attach(
    __name__, {"Live": "live", "sensitivity": "image_sensitivity", "uncertainty": "map_uncertainty"}
)
__all__ = ["Live", "sensitivity", "uncertainty"]
