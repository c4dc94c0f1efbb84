"""The inverse problem: a scene, its unknown parameters and the reference images."""

from typing import TYPE_CHECKING

from unrender.core import lazy

if TYPE_CHECKING:
    from unrender.scene.coarse_to_fine import CoarseToFine

__getattr__ = lazy.attach(__name__, {"CoarseToFine": "coarse_to_fine"})
__all__ = ["CoarseToFine"]
