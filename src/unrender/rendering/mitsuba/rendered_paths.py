"""What a session keeps of a rendering."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi

from unrender.core.trees import Tree
from unrender.rendering.renderer import SampleRequest, Space

__all__ = ["Paths"]


@dataclass(frozen=True)
class Paths:
    """What `adjoint` needs to walk the paths of a rendering again.

    Attributes:
        request: the samples taken.
        radiance: per lane.
        radiance_previous: likewise of the previous state; None unless a pair was rendered.
        space: where the pair shares its samples.
        previous: parameters of the previous state; None unless a pair was rendered.
    """

    request: SampleRequest
    radiance: mi.Spectrum
    radiance_previous: mi.Spectrum | None = None
    space: Space = "path"
    previous: Tree | None = None
