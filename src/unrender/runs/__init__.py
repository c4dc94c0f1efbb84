"""The descent, its callbacks, and how a run is resumed."""

from typing import TYPE_CHECKING

from unrender.core import lazy

if TYPE_CHECKING:
    from unrender.runs.callbacks import TensorBoard
    from unrender.runs.live import Live

__getattr__, _ = lazy.attach(
    __name__,
    {
        "Live": "live",
        "TensorBoard": "callbacks",
    },
)
__all__ = [
    "Live",
    "TensorBoard",
]
