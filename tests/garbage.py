"""What the garbage collector passes over, so that a collection after each file takes little time."""

from __future__ import annotations

import gc
import sys


def freeze_without_scenes() -> bool:
    """Exempt all objects from later collections, unless parameters of a scene are among them: they would never be collected.

    Return whether it did.
    """
    loaded = sys.modules.get("mitsuba.python.util")
    if loaded and any(issubclass(type(each), loaded.SceneParameters) for each in gc.get_objects()):
        return False
    gc.freeze()
    return True
