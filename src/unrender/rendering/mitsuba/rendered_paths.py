"""State of a rendering that its adjoint needs, and dropped samples."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from unrender.core.dropped import DropReport
from unrender.core.trees import Tree
from unrender.rendering.mitsuba import film
from unrender.rendering.mitsuba.camera_paths import is_finite
from unrender.rendering.mitsuba.film_response import film_samples
from unrender.rendering.renderer import SampleRequest, Space


@dataclass(frozen=True)
class Paths:
    """State of a rendering that `adjoint` needs to replay its paths.

    Attributes:
        request: request of the rendering.
        radiance: radiance per lane (`FilmResponse.stored`).
        radiance_previous: that of the previous state; None unless a pair was rendered.
        space: sample space of the pair.
        previous: parameters of the previous state; None unless a pair was rendered.
        vertices: result of `TracePass` if paths are cached; else None.
        keys: parameters whose lookups the vertices refer to.
    """

    request: SampleRequest
    radiance: Any
    radiance_previous: Any = None
    space: Space = "path"
    previous: Tree | None = None
    vertices: dict[str, Any] | None = None
    keys: tuple[str, ...] = ()


_MOST_PENDING = 64
"""Maximum number of launches with unread counts, since each reading waits for all launches before it."""
_PENDING_SHARE = 8
"""At most one of so many launches has an unread count, so that short runs report their dropped samples, too."""


class DroppedSamples:
    """Samples whose radiance is not finite. They contribute nothing to an image or a gradient, and are counted.

    Args:
        at_once: read each count immediately. Otherwise counts of several launches are read together, so that launches overlap.
    """

    def __init__(self, at_once: bool) -> None:
        self._report = DropReport()
        self._at_once = at_once
        self._pending: list[tuple[Any, int]] = []
        self._launches = 0

    @property
    def count(self) -> int:
        """Number of samples dropped so far."""
        self.read()
        return self._report.count

    def develop(self, radiance: Any, spp: int, groups: int, shape: tuple[int, ...]) -> mi.TensorXf:
        """Return the image that `film.develop` makes of the finite samples, and count the dropped ones."""
        self._launches += 1
        if len(self._pending) > min(_MOST_PENDING, self._launches // _PENDING_SHARE):
            self.read()
        samples = film_samples(radiance)
        finite, lanes = is_finite(samples), dr.width(samples)
        finite_radiance = mi.Color3f(dr.select(finite, samples, 0))
        dropped = dr.count(~finite)
        dr.eval(finite_radiance, dropped)
        self._pending.append((dropped, lanes))
        if self._at_once:
            self.read()
        return film.develop(finite_radiance, spp, groups, shape)

    def read(self) -> None:
        """Add up the counts of earlier launches."""
        for dropped, lanes in self._pending:
            self._report.add(int(dropped.numpy()[0]), lanes, "samples of a picture are not finite")
        self._pending.clear()
