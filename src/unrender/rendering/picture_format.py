"""Contents of a renderer's pictures: pixel formats of films, and properties of surfaces in place of radiance (AOVs)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol, runtime_checkable

from unrender.rendering.renderer import Renderer


@dataclass(frozen=True)
class PictureFormat:
    """Pixel format of a film.

    Attributes:
        colour: "rgb" (linear), "luminance" or "xyz". Images of the renderer are RGB; "luminance" makes all three channels equal.
        signed: whether pixels may be negative, because of negative lobes of the filter, colours of spectra outside sRGB, or
            because the images are not radiance.
        aov: property of the first surface in place of radiance, one of `rendering.AOVS`; "" for radiance.
        stores_alpha: whether the film stores alpha, which images of the renderer do not have.
    """

    colour: Literal["rgb", "luminance", "xyz"] = "rgb"
    signed: bool = False
    aov: str = ""
    stores_alpha: bool = False


@runtime_checkable
class WithFormats(Protocol):
    """A renderer whose films have explicit pixel formats."""

    def formats(self) -> Sequence[PictureFormat]:
        """Return the format of each sensor's film."""
        ...


def format_of(renderer: Any, sensor: int) -> PictureFormat:
    """Return the format of a sensor's film; signed RGB if the renderer has no films."""
    return renderer.formats()[sensor] if isinstance(renderer, WithFormats) else PictureFormat(signed=True)


@runtime_checkable
class AovRenderer(Protocol):
    """A renderer that can render properties of the first visible surface."""

    def with_aov(self, name: str) -> Renderer:
        """Return the renderer with one of `AOVS` in place of radiance. Raise `InputError` if the scene does not support it. Repeated calls
        return the same renderer."""
        ...
