"""Differences of GPU variants that would change results.

A bitmap or grid lies in texture memory, which holds a copy of the parameter. After one backward pass the leaf gets no gradient from the
copy, so each pass needs a new leaf. A lookup with a mask selects between the texture and a null pointer, which Dr.Jit cannot record
outside a virtual call and ends the process. Texture units interpolate with 8-bit weights; `accel = false` would avoid all this, but then
Dr.Jit 1.5 reads an uninitialised handle while it records.

A kernel traces rays in one OptiX scene only. With a second scene the rays of both meet the first one's shapes, and Dr.Jit only prints a
warning.
"""

from __future__ import annotations

from typing import Any

import mitsuba as mi

from unrender.backend import variant


def is_gpu() -> bool:
    """Return whether the current variant runs on a GPU: textures are copies, and a kernel traces one scene."""
    return variant.is_on_gpu(mi.variant())


def lookup_mask(active: Any) -> Any:
    """Return the mask of a texture lookup outside a virtual call. On a GPU there is none, so the caller discards inactive lanes."""
    return True if is_gpu() else active
